"""Radiance from distant light that is symmetric about an axis: a sky gradient, a cap, a sun, a constant.

By the addition theorem a zonal light sum_l z_l y_l^0(w . a) has the coefficients pi_l z_l y_l^m(a), so in the local
frame they are harmonics at the local direction of the axis: nothing is rotated.

notation: a = axis; z_l = coefficients of the zonal light; pi_l = sqrt(4 pi/(2l+1)); R = (t, b, n) local to world.
"""

import equinox as eqx
import jax.numpy as jnp

from shisd import _checks
from shisd._numerics import normalize, times
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Float
from shisd.harmonics import sh_basis
from shisd.harmonics.internal import bands, zonal_norms
from shisd.shading._surface import shade_points, shade_tiles, sum_lights, surface
from shisd.shading.slices._slices import Slices, check_slices, lookup_table, slice_values


def shade_zonal(
    material: Slices,
    axis: ArrayLike,
    zonal_coefficients: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None = None,
    *,
    mask: ArrayLike | None = None,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer under distant light that is symmetric about an axis.

    Arguments: `material` from `tabulate_brdf`; `axis` [3] in world space, of any length but zero; `zonal_coefficients`
    [*colour, L+1], those of y_l^0 about it (those of usual profiles: `decomposition.CapKernel`, `GaussianKernel`, ...,
    `.zonal`); for S lights [S, 3] and [S, *colour, L+1]; the others, `mask` too, and what is returned as in
    `shade_environment`.
    For one material under the same lights at very many points, `prefilter` makes reflection maps of them.
    Derivatives: in every floating argument, both modes, any order; where view or axis lie along the normal, the first.
    Accuracy: that of `shade_environment` with the same light.
    Cost: (L+1)^2 harmonics per pixel and light where `shade_environment` rotates, about L^3 products.
    Source: ISD15 Eq. 23 and 24.
    """
    check_slices(material, everywhere=True)
    a, z = _checks.vectors("axis", axis), _checks.real_array("zonal_coefficients", zonal_coefficients)
    if a.ndim > 2 or 0 in a.shape:
        raise ValueError(f"`axis` must have shape [3], or [S, 3] for S lights; got {list(a.shape)}.")
    lights = a.shape[:-1]
    if z.ndim - len(lights) not in (1, 2) or z.shape[-1] == 0 or z.shape[: len(lights)] != lights:
        lead = "".join(f"{n}, " for n in lights)
        raise ValueError(
            f"`zonal_coefficients` must have shape [{lead}L+1] or [{lead}colour, L+1]; got {list(z.shape)}."
        )
    if not lights:
        a, z = a[None], z[None]
    light, dtypes = [("zonal_coefficients", z.shape[1:-1])], [a.dtype, z.dtype]
    vectors = {"normals": normals, "views": views}
    material, points, colour = surface("material", material, tangents, light, dtypes, mask, **vectors)
    dtype = material.coefficients.dtype
    z = z[..., : material.degree + 1].astype(dtype)
    return by_device(shade_points, points, _shade, material, normalize(a.astype(dtype)), z, colour)


@eqx.filter_jit
def _shade(
    points: dict[str, Float[Array, "p 3"]],
    material: Slices,
    axes: Float[Array, "s 3"],
    z: Float[Array, "s *c l"],
    colour: tuple[int, ...],
) -> Float[Array, " p *colour"]:
    degree = z.shape[-1] - 1
    l = bands(degree)
    z = (z / jnp.broadcast_to(jnp.asarray(zonal_norms(degree), z.dtype), z.shape))[..., l]

    table = lookup_table(material, degree)

    def radiance(frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"]) -> Float[Array, "*colour p"]:
        slices = slice_values(table, local, material)

        def of_light(one: tuple[Array, Array]) -> Float[Array, "*c n p"]:
            axis, own = one
            return times(own[..., None], sh_basis(jnp.einsum("pij,i->pj", frame, axis), degree).T)

        light = sum_lights(of_light, [(axes, z)], jnp.zeros((*z.shape[1:], len(local)), z.dtype))
        return jnp.sum(times(slices, light), axis=-2)

    return shade_tiles(material, points, colour, 1024, radiance, (axes, z))
