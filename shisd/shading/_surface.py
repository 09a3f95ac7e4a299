"""Surface points: where they are, which way they face, and from where they are seen."""

import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._module import Module
from shisd._typing import Array, ArrayLike, Float


class Surface(Module):
    """Points of surfaces, as a picture or any other batch has them; batch axes broadcast.

    Arguments: `normals` and `views` [..., 3] in world space, of any length, pointing away from the surface, views
    towards the eye; `positions` [..., 3] in world space, which local lights need; `tangents` [..., 3], the local x axis
    of anisotropic materials, of which only the part along the surface counts; `mask` [...], bool: where it is False
    there is no surface, as in a picture's background, and radiance is 0 with gradient 0, whatever the other arrays hold
    there. `triangles` [...] and `barycentric` [..., 3]: where each point lies on the mesh of a `models.Visibility`,
    the index of a triangle and the weights of its corners.
    Arrays that are not needed may be left out, and are ignored. Wrong shapes are ValueErrors here; a zero normal or
    view, a tangent along its normal, and NaN give radiance NaN.
    """

    normals: Float[Array, "*batch 3"]
    views: Float[Array, "*batch 3"]
    positions: Float[Array, "*batch 3"] | None
    tangents: Float[Array, "*batch 3"] | None
    mask: Array | None
    triangles: Array | None
    barycentric: Float[Array, "*batch 3"] | None

    def __init__(
        self,
        normals: ArrayLike,
        views: ArrayLike,
        positions: ArrayLike | None = None,
        tangents: ArrayLike | None = None,
        *,
        mask: ArrayLike | None = None,
        triangles: ArrayLike | None = None,
        barycentric: ArrayLike | None = None,
    ):
        given = {"positions": positions, "tangents": tangents, "barycentric": barycentric}
        vectors = {"normals": normals, "views": views} | {k: v for k, v in given.items() if v is not None}
        arrays = {name: _checks.vectors(name, value) for name, value in vectors.items()}
        self.normals, self.views = arrays["normals"], arrays["views"]
        self.positions, self.tangents = arrays.get("positions"), arrays.get("tangents")
        self.barycentric = arrays.get("barycentric")
        self.mask = None if mask is None else bools(mask)
        self.triangles = None if triangles is None else _indices(triangles)
        if (triangles is None) != (barycentric is None):
            raise ValueError("`triangles` [...] and `barycentric` [..., 3] belong together: pass both or none.")
        shapes = {name: a.shape[:-1] for name, a in arrays.items()}
        shapes |= {n: a.shape for n, a in (("mask", self.mask), ("triangles", self.triangles)) if a is not None}
        broadcast_batch(shapes)

    def points(self, *names: str) -> dict[str, Array]:
        """Arrays [..., k] by name, with the mask [..., 1] where there is one."""
        return {name: getattr(self, name) for name in names} | masks(self.mask)


def broadcast_batch(shapes: dict[str, tuple[int, ...]]) -> None:
    """Batch axes by name, which must broadcast."""
    try:
        np.broadcast_shapes(*shapes.values())
    except ValueError as error:
        named = ", ".join(f"`{name}` {list(shape)}" for name, shape in shapes.items())
        raise ValueError(f"batch axes do not broadcast: {named}.") from error


def masks(mask: ArrayLike | None) -> dict[str, Array]:
    """The argument `mask` [...] as an array [..., 1] among those of points; none without one."""
    return {} if mask is None else {"mask": bools(mask)[..., None]}


def bools(mask: ArrayLike) -> Array:
    """The argument `mask` as an array."""
    array = jnp.asarray(mask)
    if array.dtype != bool:
        raise ValueError(f"`mask` must be bool [...], True where there is a surface; got dtype {array.dtype}.")
    return array


def _indices(triangles: ArrayLike) -> Array:
    array = _checks.any_array("triangles", triangles)
    if not jnp.issubdtype(array.dtype, jnp.integer):
        raise ValueError(f"`triangles` must be integers [...]; got dtype {array.dtype}.")
    if not isinstance(triangles, jax.Array):
        given = np.asarray(triangles)  # `array` may be traced
        if np.any(given != given.astype(array.dtype)):
            raise ValueError(f"`triangles` must fit into {array.dtype}; got up to {np.max(np.abs(given))}.")
    return array


def check_surface(surface: object) -> None:
    if not isinstance(surface, Surface):
        raise ValueError(f"`surface` must be a shading.Surface of normals and views; got {type(surface).__name__}.")
