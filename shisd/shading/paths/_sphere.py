"""Radiance from balls of light at finite distance: ISD15 Eq. 33 and 34, without occlusion.

From every point a ball is a cap, a zonal light about the direction to its center a. Its coefficients are closed
expressions of the ratio of radius and distance (`domains._region.cap_coefficients`), and about another axis they are
z_l y_l^m(a) (Eq. 34): in the local frame nothing is rotated but a.

notation: a = direction to the center, in the local frame; z_l = integral of P_l over the cap; R local to world.
"""

import equinox as eqx
import jax.numpy as jnp

from shisd._numerics import times
from shisd._typing import Array, Float
from shisd.domains.internal import cap_coefficients
from shisd.models import SphereLight
from shisd.models.internal import versine
from shisd.shading._material import slices_everywhere
from shisd.shading._tiles import shade_tiles, stacked, sum_lights
from shisd.shading.paths._path import local_path
from shisd.shading.slices._slices import Slices, lookup_table, slice_values


@eqx.filter_jit
def _shade(
    points: dict[str, Float[Array, "p 3"]], slices: Slices, lights: list[SphereLight], colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    table, stacks = lookup_table(slices), stacked(lights)

    def of_tile(
        frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"], positions: Float[Array, "p 3"]
    ) -> Float[Array, "*colour p"]:
        c = slice_values(table, local, slices)
        zero = jnp.zeros((*colour, len(local)), c.dtype)

        def of_light(light: SphereLight) -> Float[Array, "*colour p"]:
            to_center = light.center[None] - positions
            t = versine(light, jnp.sum(to_center**2, axis=1))
            inside = (t >= 2)[:, None]  # then any axis will do
            a = jnp.einsum("pij,pi->pj", frame, jnp.where(inside, frame[:, :, 2], to_center))
            lit = jnp.sum(times(c, cap_coefficients(t, a, slices.degree).T), axis=-2)
            return jnp.broadcast_to(times(lit, light.emission[..., None]), zero.shape)

        return sum_lights(of_light, stacks, zero)

    return shade_tiles(slices, points, colour, 1024, of_tile, stacks)


PATH = local_path(slices_everywhere, _shade)
