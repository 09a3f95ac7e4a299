"""Surface points, as every shading verb takes them: their checks, their frames, and one tile of them after another."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from shisd import _checks
from shisd._numerics import normalize
from shisd._typing import Array, ArrayLike, Float

Shape = tuple[int, ...]


@runtime_checkable
class Surface(Protocol):
    """What is asked of a material, tabulated or as a matrix."""

    @property
    def isotropic(self) -> bool: ...
    @property
    def colour(self) -> Shape: ...


Material = TypeVar("Material", bound=Surface)
_DIRECTIONS = ("normals", "views", "tangents")
_LANES = 64  # a tile is a multiple of this many points


def surface(
    name: str,
    material: Material,
    tangents: ArrayLike | None,
    light: Iterable[tuple[str, Shape]],
    dtypes: Iterable[DTypeLike],
    **vectors: ArrayLike,
) -> tuple[Material, dict[str, Array], Shape]:
    """The material and arrays [..., 3] in the common dtype, and the colour of material and `light` together.

    `name` is that of the material's argument, `tangents` are taken where it needs them, `light` names the colour axes
    of each light.
    """
    if not material.isotropic:
        if tangents is None:
            raise ValueError("`tangents` [..., 3] are needed: this material is anisotropic.")
        vectors["tangents"] = tangents
    arrays = {key: _checks.vectors(key, value) for key, value in vectors.items()}
    colours = [(name, material.colour), *light]
    try:
        np.broadcast_shapes(*(a.shape for a in arrays.values()))
        colour = np.broadcast_shapes(*(c for _, c in colours))
    except ValueError as error:
        shapes = {key: list(a.shape) for key, a in arrays.items()}
        named = " and ".join(f"`{key}` {list(c)}" for key, c in colours)
        raise ValueError(f"batch axes {shapes}, or colours of {named}, do not broadcast.") from error
    dtype = jnp.result_type(*jax.tree.leaves(material), *dtypes, *arrays.values())
    cast = lambda x: x.astype(dtype)
    return jax.tree.map(cast, material), jax.tree.map(cast, arrays), colour


def local_lights(name: str, light: Any, kind: type) -> tuple:
    """One light of this kind or a sequence of them, as a tuple."""
    lights = tuple(light) if isinstance(light, Sequence) else (light,)
    if not lights or not all(isinstance(x, kind) for x in lights):
        raise ValueError(f"`{name}` must be a models.{kind.__name__} or a sequence of at least one.")
    return lights


def shade_points(points: dict[str, Array], shade: Callable[..., Array], *arguments: Any) -> Array:
    """`shade(points, *arguments)`, which takes flat points [p, k]; instead of p, the result has their batch axes."""
    shape = np.broadcast_shapes(*(a.shape[:-1] for a in points.values()))
    flat = {name: jnp.broadcast_to(a, (*shape, a.shape[-1])).reshape(-1, a.shape[-1]) for name, a in points.items()}
    values = shade(flat, *arguments)
    return values.reshape(*shape, *values.shape[1:])


def shade_tiles(
    material: Surface,
    points: dict[str, Array],
    colour: Shape,
    size: int,
    radiance: Callable[..., Float[Array, "*colour p"]],
) -> Float[Array, " p *colour"]:
    """`radiance(frame, local, **others)` of all points, `size` at a time; 0 where the view is below the horizon.

    `frame` [p, 3, 3] is local to world, `local` [p, 3] is the view in it, and `others` are the `points` of the tile
    that are not directions.
    """

    def shade_tile(tile: dict[str, Array]) -> Float[Array, " p *colour"]:
        directions = {name: normalize(a) for name, a in tile.items() if name in _DIRECTIONS}
        others = {name: a for name, a in tile.items() if name not in _DIRECTIONS}
        normal = directions["normals"]
        r = frame(normal) if material.isotropic else tangent_frame(normal, directions["tangents"])
        local = jnp.einsum("pij,pi->pj", r, directions["views"])
        values = radiance(r, local, **others)
        return jnp.where((local[:, 2] < 0).reshape(-1, *(1,) * len(colour)), 0, jnp.moveaxis(values, -1, 0))

    return in_tiles(shade_tile, points, size)


def in_tiles(function: Callable[[dict[str, Array]], Array], rows: dict[str, Array], size: int) -> Array:
    """function(rows) for at most `size` rows at a time, all tiles alike; the backward pass makes each tile again."""
    count = len(next(iter(rows.values())))
    if count == 0:
        first = {name: jax.ShapeDtypeStruct((1, *a.shape[1:]), a.dtype) for name, a in rows.items()}
        one = jax.eval_shape(function, first)
        return jnp.zeros((0, *one.shape[1:]), one.dtype)
    tiles = -(-count // size)
    size = min(count, size, -(-count // (tiles * _LANES)) * _LANES)  # of equal size, for little to fill up
    more = tiles * size - count
    fill = lambda a: jnp.concatenate([a, jnp.repeat(a[-1:], more, axis=0)]).reshape(tiles, size, -1)
    values = jax.lax.map(jax.checkpoint(function), {name: fill(a) for name, a in rows.items()})
    return values.reshape(tiles * size, *values.shape[2:])[:count]


@jax.custom_jvp
def frame(normal: Float[Array, "p 3"]) -> Float[Array, "p 3 3"]:
    """R with R z = n and R^T z = (sin, 0, cos), for isotropic materials, which do not mind a turn about n.

    No choice of such frames is smooth everywhere. But what they are used for does not depend on the choice, so its
    derivative may follow any: the frame that turns no more than the normal does, about n x dn.
    """
    x, y, z = normal[:, 0], normal[:, 1], normal[:, 2]
    rho = jnp.sqrt(x * x + y * y)
    safe = jnp.where(rho > 0, rho, 1)
    cos, sin, zero = jnp.where(rho > 0, x / safe, 1), y / safe, jnp.zeros_like(x)
    rows = [[-cos * z, sin, x], [-sin * z, -cos, y], [rho, zero, z]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


@frame.defjvp
def _frame_jvp(primals, tangents):
    (normal,), (dn,) = primals, tangents
    r = frame(normal)
    return r, jnp.cross(jnp.cross(normal, dn)[:, :, None], r, axis=1)


def tangent_frame(normal: Float[Array, "p 3"], tangent: Float[Array, "p 3"]) -> Float[Array, "p 3 3"]:
    """R = (t, b, n), t along the part of the tangent that is orthogonal to n."""
    t = normalize(tangent - jnp.sum(normal * tangent, axis=-1, keepdims=True) * normal)
    return jnp.stack([t, jnp.cross(normal, t), normal], axis=-1)
