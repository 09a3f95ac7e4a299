"""Radiance from distant light that is symmetric about an axis.

By the addition theorem a zonal light sum_l z_l y_l^0(w . a) has the coefficients pi_l z_l y_l^m(a), so in the local
frame they are harmonics at the local direction of the axis: nothing is rotated.

notation: a = axis; z_l = coefficients of the zonal light; pi_l = sqrt(4 pi/(2l+1)); R = (t, b, n) local to world.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from shisd._numerics import normalize, times
from shisd._sharding import by_device
from shisd._typing import Array, Float
from shisd.harmonics import sh_basis
from shisd.harmonics.internal import bands, zonal_norms
from shisd.models import ZonalLight
from shisd.shading._material import slices_everywhere
from shisd.shading._surface import Surface
from shisd.shading._tiles import padded, shade_points, shade_tiles, sum_lights
from shisd.shading.paths._path import Path
from shisd.shading.slices._slices import Slices, lookup_table, slice_values


def radiance(
    slices: Slices, lights: list[ZonalLight], points: dict[str, Array], _: Surface
) -> Float[Array, "*batch_colour"]:
    size = 1 + min(slices.degree, max(light.degree for light in lights))
    colour = np.broadcast_shapes(*(light.colour for light in lights))

    axes = jnp.stack([light.axis for light in lights])
    z = jnp.stack([padded(light.coefficients, size, colour) for light in lights])
    colour = np.broadcast_shapes(slices.colour, colour)
    return by_device(shade_points, points, _shade, slices, normalize(axes), z, colour)


PATH = Path(slices_everywhere, radiance, local=False)


@eqx.filter_jit
def _shade(
    points: dict[str, Float[Array, "p 3"]],
    slices: Slices,
    axes: Float[Array, "s 3"],
    z: Float[Array, "s *c l"],
    colour: tuple[int, ...],
) -> Float[Array, " p *colour"]:
    degree = z.shape[-1] - 1
    l = bands(degree)
    z = (z / jnp.broadcast_to(jnp.asarray(zonal_norms(degree), z.dtype), z.shape))[..., l]
    table = lookup_table(slices, degree)

    def of_tile(frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"]) -> Float[Array, "*colour p"]:
        c = slice_values(table, local, slices)

        def of_light(one: tuple[Array, Array]) -> Float[Array, "*c n p"]:
            axis, own = one
            return times(own[..., None], sh_basis(jnp.einsum("pij,i->pj", frame, axis), degree).T)

        light = sum_lights(of_light, [(axes, z)], jnp.zeros((*z.shape[1:], len(local)), z.dtype))
        return jnp.sum(times(c, light), axis=-2)

    return shade_tiles(slices, points, colour, 1024, of_tile, (axes, z))
