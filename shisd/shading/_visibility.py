"""Radiance from distant light that a mesh hides in part: ISD15 Eq. 25 and appendix A.

With v = visibility in the frame of the world, E = light and c = the slice turned to the world,

    I = integral of v E (R c) = sum over j of u_j (R c)_j,   u_j = integral of v E y_j = sum over i of M_ij v_i,

where M is the matrix of products with E, exact. The paper takes the same steps in another order: it multiplies every
pixel's slice by gamma, the weights of E y_j on rotated zonal harmonics, and looks up v at their axes. But M and
interpolation commute. So M meets each vertex once, where these are fewer than the pixels, and a pixel turns its slice:
of all factors that with the fewest colours.

notation: u = coefficients of the visible light at each vertex; R = (t, b, n) local to world.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from shisd import _checks
from shisd._sharding import by_device
from shisd._typing import Array, Float
from shisd.decomposition import RotatedZonalBasis
from shisd.harmonics import product_matrix
from shisd.harmonics._rotation import rotate_many
from shisd.models import Visibility
from shisd.models._visibility import surface_corners
from shisd.shading._lobes import Lobes, check_lobes, lookup_table, slice_values
from shisd.shading._surface import shade_points, shade_tiles, surface

_NUMBERS_AT_ONCE = 3 << 17  # of visible light in a tile


def shade_environment_visibility(
    lobes: Lobes,
    light_coefficients: ArrayLike,
    visibility: Visibility | ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None = None,
    *,
    triangle: ArrayLike | None = None,
    weights: ArrayLike | None = None,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer under distant light, with occlusion (ISD15 Eq. 25).

    Arguments: `visibility` is a `models.Visibility`, with the `triangle` [...] that each point lies in and its
    barycentric `weights` [..., 3] there; or SH coefficients [n], one visibility for all points, as
    `models.cap_visibility` gives them; or [..., n] for each. The others and what is returned as in `shade_environment`.
    Light, visibility and lobes may have any degrees: what is integrated is the product of the three expansions, exact
    with all bands of the light up to the sum of the degrees of visibility and lobes.
    Derivatives: in every floating argument: material, light, visibility, weights, frame.
    Accuracy: 1e-5 in float32 and 1e-12 in float64, relative to the largest radiance, for the expansions given. The band
    limit of visibility blurs shadows over about pi / degree.
    Cost: for every vertex a product with a matrix [(L+1)^2, (Lv+1)^2], for every point three rows of visible light and
    the slice turned to the world. Memory: visible light of the vertices, and one tile of points; coefficients for each
    point are the caller's.
    Source: ISD15 Eq. 25 and appendix A.
    """
    check_lobes(lobes, everywhere=True)
    e, _ = _checks.expansion("light_coefficients", light_coefficients)
    vectors = {"normals": normals, "views": views}
    if isinstance(visibility, Visibility):
        if triangle is None or weights is None:
            raise ValueError("`triangle` [...] and `weights` [..., 3] are needed: `visibility` is that of a mesh.")
        corners, vectors["weights"] = surface_corners(visibility, triangle, weights)
        own, v = {"corners": corners}, visibility.coefficients
    else:
        if triangle is not None or weights is not None:
            raise ValueError("`triangle` and `weights` belong to a models.Visibility; pass that as `visibility`.")
        c, _ = _checks.coefficients("visibility", visibility)
        own, v = ({}, c[None]) if c.ndim == 1 else ({"visibility": c}, None)
    given = [e.dtype] + [x.dtype for x in (v, own.get("visibility")) if x is not None]
    light = [("light_coefficients", e.shape[:-1])]
    lobes, points, colour = surface(lobes, tangents, light, given, **vectors)
    try:
        np.broadcast_shapes(*(a.shape[:-1] for a in (points | own).values()))
    except ValueError as error:
        shapes = {name: list(a.shape) for name, a in (points | own).items()}
        raise ValueError(f"batch axes {shapes} do not broadcast.") from error
    dtype = lobes.weights.dtype
    e, v, c = (None if x is None else x.astype(dtype) for x in (e, v, own.get("visibility")))
    points |= own if c is None else {"visibility": c}
    return by_device(shade_points, points, _shade, lobes, e, v, colour)


def visibility_gamma(light_coefficients: ArrayLike, basis: RotatedZonalBasis, degree: int) -> Float[Array, "*c n l k"]:
    """gamma of ISD15's appendix A: weights on rotated zonal harmonics of the light times every harmonic.

    Arguments: `light_coefficients` [n] or [colour, n]; the `basis` to decompose into; static `degree` of the harmonics.
    Returns [*colour, (degree + 1)^2, L+1, K]: row j is E y_j up to the degree L of the basis, exact. With these, the
    shader of the paper's supplement needs no rotation; `shade_environment_visibility` does not need them.
    Derivatives: in the light and the axes of the basis.
    """
    e, _ = _checks.expansion("light_coefficients", light_coefficients)
    if not isinstance(basis, RotatedZonalBasis):
        raise ValueError(f"`basis` must be a decomposition.RotatedZonalBasis; got {type(basis).__name__}.")
    return basis.weights(jnp.swapaxes(_products(e, basis.degree, _checks.degree(degree)), -1, -2))


@eqx.filter_jit
def _shade(
    points: dict[str, Array], lobes: Lobes, e: Float[Array, "*c n"], v: Array | None, colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    """`v` [V, nv] are the coefficients that points share; points have "corners" or a "visibility" of their own."""
    degree, table = lobes.degree, lookup_table(lobes)
    own = points["visibility"] if v is None else v
    product = _products(e, degree, _checks.degree_of(own.shape[-1])).reshape(-1, table.shape[-2], own.shape[-1])
    to_visible = lambda v: jnp.einsum("cij,vj->vci", product, v)
    shared = v is not None and ("corners" not in points or len(v) < len(points["normals"]))
    rows = to_visible(v) if shared else v

    def visible_light(at: dict[str, Array]) -> Float[Array, "p c n"]:
        if rows is None:
            return to_visible(at["visibility"])
        if not at:
            return rows
        weight = lambda i: at["weights"][:, i].reshape(-1, *(1,) * (rows.ndim - 1))
        between = sum(weight(i) * rows[at["corners"][:, i]] for i in range(3))
        return between if shared else to_visible(between)

    def radiance(frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"], **at: Array) -> Float[Array, "*colour p"]:
        slices = slice_values(table, local, lobes)
        slices = rotate_many(jnp.moveaxis(slices.reshape(-1, *slices.shape[-2:]), 0, 1), frame, degree)
        slices = jnp.moveaxis(slices, 1, 0)  # colour, n, p
        u = visible_light(at)
        u = jnp.broadcast_to(jnp.moveaxis(u, 0, -1), (*u.shape[1:], len(local)))
        return jnp.broadcast_to(jnp.sum(slices * u, axis=1).reshape(*colour, -1), (*colour, len(local)))

    size = max(64, _NUMBERS_AT_ONCE // int(np.prod(product.shape[:2])))
    return shade_tiles(lobes, points, colour, size, radiance)


def _products(e: Float[Array, "*c n"], degree: int, input_degree: int) -> Float[Array, "*c i j"]:
    """For every colour the matrix from coefficients of visibility to those of its product with the light."""
    one = lambda c: product_matrix(c, degree, input_degree=input_degree)
    return one(e) if e.ndim == 1 else jax.vmap(one)(e)
