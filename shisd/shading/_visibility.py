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
from shisd._typing import Array, ArrayLike, Float
from shisd.decomposition import RotatedZonalBasis
from shisd.harmonics import multiply
from shisd.harmonics.internal import Each, pair_many, rows
from shisd.models import Visibility
from shisd.models.internal import product_matrices, surface_corners
from shisd.shading._environment import shade_environment
from shisd.shading._surface import shade_points, shade_tiles, surface
from shisd.shading.slices._slices import Slices, check_slices, slice_orders

_NUMBERS_AT_ONCE = 3 << 18  # of visible light in a tile


def shade_environment_visibility(
    material: Slices,
    light_coefficients: ArrayLike,
    visibility: Visibility | ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None = None,
    *,
    triangle: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    mask: ArrayLike | None = None,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer under distant light, with occlusion (ISD15 Eq. 25).

    Arguments: `visibility` is a `models.Visibility`, with the `triangle` [...] that each point lies in and its
    barycentric `weights` [..., 3] there, or without both where it is that of single points, in their order; or SH
    coefficients [n], one visibility for all points, as `models.cap_visibility` gives them; or [..., n] for each. The
    others, `mask` too, and what is returned as in `shade_environment`.
    Light, visibility and material may have any degrees: what is integrated is the product of the three expansions,
    exact with all bands of the light up to the sum of the degrees of visibility and material.
    Derivatives: in every floating argument: material, light, visibility, weights, frame.
    Accuracy: 1e-5 in float32 and 1e-12 in float64, relative to the largest radiance, for the expansions given. The band
    limit of visibility blurs shadows over about pi / degree.
    Cost: for every point and colour of the light a product with a matrix [(L+1)^2, (Lv+1)^2], and the slice turned to
    the world. Memory: one tile of points; coefficients for each point are the caller's.
    Source: ISD15 Eq. 25 and appendix A.
    """
    check_slices(material, everywhere=True)
    e, _ = _checks.expansion("light_coefficients", light_coefficients)
    vectors = {"normals": normals, "views": views}
    if isinstance(visibility, Visibility) and triangle is None and weights is None and len(visibility.triangles) == 0:
        visibility = visibility.coefficients
    if isinstance(visibility, Visibility):
        if triangle is None or weights is None:
            raise ValueError("`triangle` [...] and `weights` [..., 3] are needed: `visibility` is that of a mesh.")
        corners, vectors["weights"] = surface_corners(visibility, triangle, weights)
        own, v = {"corners": corners}, visibility.coefficients
        dtypes = [e.dtype, v.dtype]
    else:
        if triangle is not None or weights is not None:
            raise ValueError("`triangle` and `weights` belong to a models.Visibility; pass that as `visibility`.")
        c, _ = _checks.coefficients("visibility", visibility)
        if c.ndim == 1:
            return shade_environment(material, multiply(e, c, material.degree), normals, views, tangents, mask=mask)
        own, v, dtypes = {"visibility": c}, None, [e.dtype, c.dtype]
    light = [("light_coefficients", e.shape[:-1])]
    material, points, colour = surface("material", material, tangents, light, dtypes, mask, **vectors)
    try:
        np.broadcast_shapes(*(a.shape[:-1] for a in (points | own).values()))
    except ValueError as error:
        shapes = {name: list(a.shape) for name, a in (points | own).items()}
        raise ValueError(f"batch axes {shapes} do not broadcast.") from error
    dtype = material.coefficients.dtype
    if v is None:
        own = {"visibility": own["visibility"].astype(dtype)}
    else:
        v = v.astype(dtype)
    return by_device(shade_points, points | own, _shade, material, e.astype(dtype), v, colour)


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
    return basis.weights(jnp.swapaxes(product_matrices(e, basis.degree, _checks.degree(degree)), -1, -2))


@eqx.filter_jit
def _shade(
    points: dict[str, Array], material: Slices, e: Float[Array, "*c n"], v: Array | None, colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    """Points have "corners" and "weights" of vertices, whose coefficients are `v` [V, nv], or each its "visibility"."""
    degree, look_up = material.degree, slice_orders(material, material.degree)
    size = (points["visibility"] if v is None else v).shape[-1]
    product = product_matrices(e, degree, _checks.degree_of(size)).reshape(-1, (degree + 1) ** 2, size)
    product = jnp.pad(product, ((0, 0), (0, 1), (0, 0)))
    plus, minus = (jnp.swapaxes(product[:, index], 0, 1) for index in rows(degree)[:2])

    def radiance(frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"], **at: Array) -> Float[Array, "*colour p"]:
        seen = at["visibility"] if v is None else jnp.einsum("pc,pcn->pn", at["weights"], v[at["corners"]])
        light = Each(*((m.reshape(-1, size) @ seen.T).reshape(*m.shape[:2], -1) for m in (plus, minus)))
        values = pair_many(*look_up(local), light, jnp.swapaxes(frame, 1, 2), degree, material.isotropic)
        return jnp.broadcast_to(values.reshape(*colour, -1), (*colour, len(local)))

    tile = _NUMBERS_AT_ONCE // ((degree + 1) ** 2 * len(product))
    return shade_tiles(material, points, colour, max(64, tile), radiance, (e, v))
