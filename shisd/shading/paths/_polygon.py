"""Radiance from polygon lights and portals: CSH18 Eq. 12 to 14, in the local frame of every point.

The light's outline, relative to the point, is cut off at the horizon and projected on the sphere; the material's slice
is integrated over it exactly. With the slice as weights on zonal functions about shared axes this is one fused sum over
their moments (`domains.moments.fold`), and nothing per pixel is a matrix.

Where radiance depends on direction, the integrand is a product. Its matrix M, from the coefficients of a slice to those
of slice times light, is the same for all points; with b = integrals of the basis over the outline, the radiance is
b . M c, and M^T b are the coefficients of the light that comes through the outline. They are made in world space, and
only they are turned to the local frame.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._numerics import dot, times
from shisd._typing import Array, Float
from shisd.domains.internal import Loop, clip, loop_coefficients, on_sphere
from shisd.harmonics.internal import product_matrices, rotate_many
from shisd.models import PolygonLight, PortalLight
from shisd.models.internal import facing
from shisd.shading._incidence import Y_00, angle_above
from shisd.shading._material import LocalForms, local_forms
from shisd.shading._quadrature import Quadrature
from shisd.shading._tiles import shade_tiles, stacked, sum_lights
from shisd.shading.paths._cut import above_horizon, at_points, in_frame, integrals_of, tile
from shisd.shading.paths._path import local_path
from shisd.shading.slices._slices import Slices, lookup_table, slice_values

Light = PolygonLight | PortalLight
SMALL_TILE = 128  # pixels at a time, where every pixel holds the moments about all axes


@eqx.filter_jit
def _shade(
    points: dict[str, Float[Array, "p 3"]], forms: LocalForms, lights: list[Light], colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    kinds = stacked(lights)
    form = forms.directional
    model = form if isinstance(form, Quadrature) else None
    slices = form if isinstance(form, Slices) else None
    stacks = [(stack, _products(stack, slices) if model is None else _expansions(stack)) for stack in kinds]
    uniform = integrals_of(forms.uniform)
    directional = None if slices is None else functools.partial(_directional, slices, lookup_table(slices))

    def of_tile(
        frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"], positions: Float[Array, "p 3"]
    ) -> Float[Array, "*colour p"]:
        zero = jnp.zeros((*colour, positions.shape[0]), positions.dtype)

        def of_light(one: tuple[Light, Array | None]) -> Float[Array, "*colour p"]:
            light, product = one
            relative = light.points.T[:, :, None] - positions.T[:, None]
            above = dot(frame[:, :, 2].T[:, None], relative)
            sign = jnp.where(jnp.max(above, axis=0) > 0, facing(light, relative), 0)
            outline = in_frame(frame, relative)
            if product is None:
                lit = above_horizon(functools.partial(uniform, local), forms.colour, outline, above, sign)
                lit = times(lit, light.incident() * Y_00)
            elif model is not None:
                points = functools.partial(at_points, model, local, (frame, product))
                lit = above_horizon(points, np.broadcast_shapes(model.colour, light.colour), outline, above, sign)
            else:
                lit = directional(frame, local, outline, product)  # type: ignore[misc]  # with a product they are there
            return jnp.broadcast_to(times(lit, sign), zero.shape)

        return sum_lights(of_light, stacks, zero)

    alike = all(product is None for _, product in stacks)
    size = tile(forms.uniform) if alike or model is not None else SMALL_TILE
    return shade_tiles(forms, points, colour, size, of_tile, kinds)


PATH = local_path(local_forms, _shade)


def _expansions(stack: Light) -> Float[Array, " lights *colour_n"] | None:
    """Coefficients of lights by direction; None where they are constant."""
    incident = jax.vmap(lambda light: light.incident())(stack)
    return None if incident.shape[-1] == 1 else incident


def _directional(
    slices: Slices, table: Array, frame: Array, local: Array, outline: Loop, product: Float[Array, "*colour_n_m"]
) -> Float[Array, "*colour p"]:
    """Integrals of slices times the light's radiance, over its outline above the horizon."""
    c, v = slice_values(table, local, slices), on_sphere(clip(outline, outline[2]))
    to_local = jnp.swapaxes(frame, 1, 2)
    world = in_frame(to_local, v)
    seen = through(product, world, angle_above(v)).reshape(-1, c.shape[-2], v.shape[2])
    seen = rotate_many(jnp.moveaxis(seen, 0, 1), to_local, slices.degree, slices.isotropic)
    seen = jnp.moveaxis(seen, 1, 0).reshape(*product.shape[:-2], *c.shape[-2:])
    return jnp.sum(times(c, seen), axis=-2)


def _products(stack: Light, slices: Slices | None) -> Float[Array, " lights *colour_n_m"] | None:
    """Matrices of the products with slices; None where light is constant."""
    if slices is None:
        if stack.incident().shape[-1] > 1:
            raise ValueError(
                f"`material` has only slices beyond maps, which do not go with a {type(stack).__name__} whose light "
                "depends on direction: pass shading.prepare(brdf, degree)."
            )
        return None
    return jax.lax.map(lambda light: product_of(light, slices.degree), stack)


def product_of(light: Light, degree: int) -> Float[Array, "*colour_n_m"] | None:
    """From coefficients of a slice to those of slice times light; None where light is constant."""
    incident = light.incident()
    light_degree = _checks.degree_of(incident.shape[-1])
    return None if light_degree == 0 else product_matrices(incident, light_degree + degree, degree)


def through(product: Float[Array, "*colour_n_m"], v: Loop, solid_angle: Array) -> Float[Array, "*c n p"]:
    """Coefficients of a light cut off outside loops."""
    b = loop_coefficients(v, solid_angle, _checks.degree_of(product.shape[-2]))
    return jnp.einsum("...tn,tp->...np", product, b)
