"""Radiance from balls of light at finite distance: ISD15 Eq. 33 and 34, without occlusion.

From every point a ball is a cap, a zonal light about the direction to its center a. Its coefficients are closed
expressions of the ratio of radius and distance (`domains._region.cap_coefficients`), and about another axis they are
z_l y_l^m(a) (Eq. 34): in the local frame nothing is rotated but a.

notation: a = direction to the center, in the local frame; z_l = integral of P_l over the cap; R local to world.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp

from shisd._numerics import times
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Float
from shisd.domains.internal import cap_coefficients
from shisd.models import SphereLight
from shisd.models.internal import versine
from shisd.shading._surface import as_type, local_lights, shade_points, shade_tiles, stacked, sum_lights, surface
from shisd.shading.slices._slices import Slices, check_slices, lookup_table, slice_values


def shade_sphere(
    material: Slices,
    light: SphereLight | Sequence[SphereLight],
    positions: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None = None,
    *,
    mask: ArrayLike | None = None,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer, lit by balls, without occlusion (ISD15 Eq. 34).

    Arguments: `material` from `tabulate_brdf`, with domain="sphere"; `light`, one or several; `positions` [..., 3] in
    world space; the others, `mask` too, and what is returned as in `shade_environment`, in the unit of the emission.
    What lies below the horizon of a point adds nothing, as far as the material's degree resolves the cosine's edge. A
    point inside a ball has its surface all around; a `radius` that is zero or negative gives NaN.
    Derivatives: in every floating argument: position, radius and emission of the lights, positions, material, frame;
    both modes, any order, where the view or a ball lie along the normal the first. Those in position and radius go to
    infinity at the surface of a ball.
    Accuracy: exact for the tabulated slice, to 1e-12 in float64 and 1e-5 of the largest radiance in float32.
    Cost: (L+1)^2 harmonics for every light and point. Memory: one tile of 1024 points.
    """
    check_slices(material, everywhere=True)
    lights = local_lights("light", light, SphereLight)
    colours = [(f"light {i}", x.colour) for i, x in enumerate(lights)]
    vectors = {"positions": positions, "normals": normals, "views": views}
    dtypes = [x.center.dtype for x in lights]
    material, points, colour = surface("material", material, tangents, colours, dtypes, mask, **vectors)
    lights = as_type(lights, material.coefficients.dtype)
    return by_device(shade_points, points, _shade, material, lights, colour)


@eqx.filter_jit
def _shade(
    points: dict[str, Float[Array, "p 3"]], material: Slices, lights: tuple[SphereLight, ...], colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    table, stacks = lookup_table(material), stacked(lights)

    def radiance(
        frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"], positions: Float[Array, "p 3"]
    ) -> Float[Array, "*colour p"]:
        slices = slice_values(table, local, material)
        zero = jnp.zeros((*colour, len(local)), slices.dtype)

        def of_light(light: SphereLight) -> Float[Array, "*colour p"]:
            to_center = light.center[None] - positions
            t = versine(light, jnp.sum(to_center**2, axis=1))
            inside = (t >= 2)[:, None]  # then any axis will do
            a = jnp.einsum("pij,pi->pj", frame, jnp.where(inside, frame[:, :, 2], to_center))
            lit = jnp.sum(times(slices, cap_coefficients(t, a, material.degree).T), axis=-2)
            return jnp.broadcast_to(times(lit, light.emission[..., None]), zero.shape)

        return sum_lights(of_light, stacks, zero)

    return shade_tiles(material, points, colour, 1024, radiance, stacks)
