"""Radiance from distant light that a mesh hides in part: ISD15 Eq. 25 and appendix A.

With v = visibility in the frame of the world, E = light and c = the slice turned to the world,

    I = integral of v E (R c) = sum over j of u_j (R c)_j,   u_j = integral of v E y_j = sum over i of M_ij v_i,

where M is the matrix of products with E, exact. The paper takes the same steps in another order: it multiplies the
slice by gamma, the weights of E y_j on rotated zonal harmonics, and looks up v at their axes. On a CPU M v is one
product of matrices for many pixels, faster than visible light interpolated between vertices, and a pixel turns its
slice, which has the fewest colours. One v for all pixels is a light of its own.

notation: u = coefficients of the visible light; R = (t, b, n) local to world.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._sharding import by_device
from shisd._typing import Array, Float
from shisd.decomposition import RotatedZonalBasis
from shisd.harmonics import multiply
from shisd.harmonics.internal import Each, pair_many, product_matrices, rows
from shisd.models import DistantLight, Occluded, Visibility, ZonalLight
from shisd.models.internal import surface_corners
from shisd.shading._material import slices_everywhere
from shisd.shading._surface import Surface, broadcast_batch
from shisd.shading._tiles import shade_points, shade_tiles, sum_parts
from shisd.shading.paths import _distant
from shisd.shading.paths._path import Path
from shisd.shading.slices._slices import Slices, slice_orders

_NUMBERS_AT_ONCE = 3 << 18  # of visible light in a tile


def radiance(
    slices: Slices, lights: list[Occluded], points: dict[str, Array], surface: Surface
) -> Float[Array, "*batch_colour"]:
    colour = lambda light: np.broadcast_shapes(slices.colour, light.colour)
    return sum_parts((_one(slices, light, points, surface), colour(light)) for light in lights)


PATH = Path(slices_everywhere, radiance, local=False)


def _one(slices: Slices, light: Occluded, points: dict[str, Array], surface: Surface) -> Float[Array, "*batch_colour"]:
    distant, visibility = _distant_light(light.light), light.visibility
    if isinstance(visibility, Visibility) and len(visibility.triangles) == 0:
        visibility = visibility.coefficients
    if isinstance(visibility, Visibility):
        if surface.triangles is None or surface.barycentric is None:
            raise ValueError(
                "`surface` needs `triangles` [...] and `barycentric` [..., 3]: `visibility` is that of a mesh."
            )
        corners, barycentric = surface_corners(
            visibility, *_places(surface.triangles, surface.barycentric, surface.mask)
        )
        own, v = {"corners": corners, "barycentric": barycentric}, visibility.coefficients
    elif visibility.ndim == 1:
        visible = DistantLight(multiply(distant.coefficients, visibility, slices.degree))
        return _distant.radiance(slices, [visible], points, surface)
    else:
        own, v = {"visibility": visibility}, None
    broadcast_batch({name: a.shape[:-1] for name, a in (points | own).items()})
    colour = np.broadcast_shapes(slices.colour, light.colour)
    return by_device(shade_points, points | own, _shade, slices, distant.coefficients, v, colour)


def _distant_light(light: DistantLight | ZonalLight) -> DistantLight:
    return light.distant() if isinstance(light, ZonalLight) else light


def _places(triangles: Array, barycentric: Array, mask: Array | None) -> tuple[Array, Array]:
    """Places of points on a mesh, of one batch shape; in the first triangle where there is no surface."""
    masked = () if mask is None else mask.shape
    batch = np.broadcast_shapes(triangles.shape, barycentric.shape[:-1], masked)
    index = jnp.broadcast_to(triangles, batch)
    if mask is not None:
        index = jnp.where(jnp.broadcast_to(mask, batch), index, 0)
    return index, jnp.broadcast_to(barycentric, (*batch, 3))


def visibility_gamma(light: DistantLight, basis: RotatedZonalBasis, degree: int) -> Float[Array, "*c n l k"]:
    """gamma of ISD15's appendix A: weights on rotated zonal harmonics of the light times every harmonic.

    Arguments: `light`, a `models.DistantLight`; the `basis` to decompose into; static `degree` of the harmonics.
    Returns [*colour, (degree + 1)^2, L+1, K]: row j is E y_j up to the degree L of the basis, exact. With these, the
    shader of the paper's supplement needs no rotation; `shade` does not need them.
    Derivatives: in the light and the axes of the basis.
    """
    if not isinstance(light, DistantLight):
        raise ValueError(f"`light` must be a models.DistantLight; got {type(light).__name__}.")
    if not isinstance(basis, RotatedZonalBasis):
        raise ValueError(f"`basis` must be a decomposition.RotatedZonalBasis; got {type(basis).__name__}.")
    matrices = product_matrices(light.coefficients, basis.degree, _checks.degree(degree))
    return basis.weights(jnp.swapaxes(matrices, -1, -2))


@eqx.filter_jit
def _shade(
    points: dict[str, Array], slices: Slices, e: Float[Array, "*c n"], v: Array | None, colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    """Points have "corners" and "barycentric" of vertices with coefficients `v` [V, nv], or each its "visibility"."""
    degree, look_up = slices.degree, slice_orders(slices, slices.degree)
    size = (points["visibility"] if v is None else v).shape[-1]
    product = product_matrices(e, degree, _checks.degree_of(size)).reshape(-1, (degree + 1) ** 2, size)
    product = jnp.pad(product, ((0, 0), (0, 1), (0, 0)))
    plus, minus = (jnp.swapaxes(product[:, index], 0, 1) for index in rows(degree)[:2])

    def of_tile(frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"], **at: Array) -> Float[Array, "*colour p"]:
        seen = at["visibility"] if v is None else jnp.einsum("pc,pcn->pn", at["barycentric"], v[at["corners"]])
        light = Each(*((m.reshape(-1, size) @ seen.T).reshape(*m.shape[:2], -1) for m in (plus, minus)))
        values = pair_many(*look_up(local), light, jnp.swapaxes(frame, 1, 2), degree, slices.isotropic)
        return jnp.broadcast_to(values.reshape(*colour, -1), (*colour, len(local)))

    tile = _NUMBERS_AT_ONCE // ((degree + 1) ** 2 * len(product))
    return shade_tiles(slices, points, colour, max(64, tile), of_tile, (e, v))
