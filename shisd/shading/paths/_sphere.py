"""Radiance from balls of light at finite distance: ISD15 Eq. 33 and 34, without occlusion.

From every point a ball is a cap, a zonal light about the direction to its center a. Its coefficients are closed
expressions of the ratio of radius and distance (`domains._region.cap_coefficients`), and about another axis they are
z_l y_l^m(a) (Eq. 34): in the local frame nothing is rotated but a.

Where the material has a form for lamps, beyond maps or as points, it is integrated over the polygon of as many corners
that has the cap's solid angle, cut off at the horizon.

notation: a = direction to the center, in the local frame; z_l = integral of P_l over the cap; R local to world.
"""

import functools
import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp

from shisd._numerics import normalize, tangents, times
from shisd._typing import Array, Float
from shisd.domains.internal import cap_coefficients
from shisd.models import SphereLight
from shisd.models.internal import versine
from shisd.shading._material import LampForm, Material, slices_everywhere
from shisd.shading._tiles import shade_tiles, stacked, sum_lights
from shisd.shading.paths._cut import above_horizon, in_frame, integrals_of, tile
from shisd.shading.paths._path import local_path
from shisd.shading.slices._slices import Slices, lookup_table, slice_values

_SIDES = 12


@eqx.filter_jit
def _shade(
    points: dict[str, Float[Array, "p 3"]], form: Slices | LampForm, lights: list[SphereLight], colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    stacks = stacked(lights)
    of_ball = _of_caps(form) if isinstance(form, Slices) else _of_outlines(form)

    def of_tile(
        frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"], positions: Float[Array, "p 3"]
    ) -> Float[Array, "*colour p"]:
        zero = jnp.zeros((*colour, len(local)), local.dtype)

        def of_light(light: SphereLight) -> Float[Array, "*colour p"]:
            to_center = light.center[None] - positions
            t = versine(light, jnp.sum(to_center**2, axis=1))
            axis = jnp.where((t >= 2)[:, None], frame[:, :, 2], to_center)  # inside, any will do
            return jnp.broadcast_to(times(of_ball(frame, local, t, axis), light.emission[..., None]), zero.shape)

        return sum_lights(of_light, stacks, zero)

    size = 1024 if isinstance(form, Slices) else tile(form)
    return shade_tiles(form, points, colour, size, of_tile, stacks)


def _of_caps(slices: Slices) -> Callable[[Array, Array, Array, Array], Array]:
    table = lookup_table(slices)

    def of_ball(frame: Array, local: Array, t: Array, axis: Array) -> Float[Array, "*colour p"]:
        a = jnp.einsum("pij,pi->pj", frame, axis)
        return jnp.sum(times(slice_values(table, local, slices), cap_coefficients(t, a, slices.degree).T), axis=-2)

    return of_ball


def _of_outlines(form: LampForm) -> Callable[[Array, Array, Array, Array], Array]:
    """Balls as regular polygons of their solid angle, cut off at the horizon; from inside, as all of the hemisphere."""
    integrals = integrals_of(form, wide=True)

    def of_ball(frame: Array, local: Array, t: Array, axis: Array) -> Float[Array, "*colour p"]:
        inside = t >= 2
        v = in_frame(frame, _outline(jnp.where(inside, 1, t), normalize(axis).T))
        above = jnp.where(inside, 1, v[2])
        lit = (jnp.max(above, axis=0) > 0).astype(v.dtype)
        return above_horizon(functools.partial(integrals, local), form.colour, v, above, lit)

    return of_ball


def _outline(t: Float[Array, " p"], a: Float[Array, "3 p"]) -> Float[Array, "3 s p"]:
    """A regular polygon about a, of the solid angle 2 pi t of a cap: cos(rho) tan(A) = tan(A (1 - t)), A = pi / sides.

    Half a side, the center and a corner are a triangle with a right angle, A at the center and B at the corner, where
    tan(B) = cot(A) / cos(rho); its excess A + B - pi/2 is t A. Its corners follow from a in world space, and so
    depend on no frame.
    """
    part = math.pi / _SIDES
    versed = jnp.sin(part * t) / (math.sin(part) * jnp.cos(part * (1 - t)))
    sine = jnp.sqrt(versed * (2 - versed))
    across, upon = tangents(a)
    angles = [2 * math.pi * (i + 0.5) / _SIDES for i in range(_SIDES)]
    ring = jnp.stack([across * math.cos(k) + upon * math.sin(k) for k in angles], axis=1)
    return a[:, None] * (1 - versed)[None, None] + ring * sine[None, None]


def _form(material: Material, light: str) -> Slices | LampForm:
    return slices_everywhere(material, light) if material.lamps is None else material.lamps


PATH = local_path(_form, _shade)
