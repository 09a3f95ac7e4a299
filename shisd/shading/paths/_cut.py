"""Integrals of a material, in whatever form, over outlines in local frames, cut off at the horizon."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from shisd._lanes import in_lanes
from shisd._numerics import dot, times
from shisd._typing import Array, Float
from shisd.domains.internal import Loop, clip, fold_expansion, on_sphere, zonal_inverse
from shisd.harmonics import evaluate
from shisd.shading._incidence import Y_00, angle_above, incidence_integrals
from shisd.shading._material import LampForm
from shisd.shading._quadrature import Quadrature, integrate, reflected
from shisd.shading._transformed_integrals import integrals, tables_of
from shisd.shading.slices._slices import Slices, lookup_factors, lookup_table, slice_values
from shisd.shading.slices._transformed import dense_views


def tile(form: LampForm) -> int:
    """Pixels at a time: more of a material at points, whose loops have few operations."""
    return 1024 if isinstance(form, Quadrature) else 256


def above_horizon(
    integrals: Callable[[Loop, int], Array], colour: tuple[int, ...], outline: Loop, above: Array, sign: Array
) -> Float[Array, "*colour p"]:
    """`integrals(v, spare)` over outlines cut off at the horizon, whose last `spare` edges seldom have a length."""
    dark = sign == 0
    spare = outline.shape[1] // 2  # edges, unless the horizon cuts an outline of this tile

    def lit() -> Float[Array, "*colour p"]:
        whole = lambda: jnp.concatenate([outline, *[outline[:, :1]] * spare], axis=1)
        all_whole = jnp.all((jnp.min(above, axis=0) > 0) | dark)
        cut = jax.lax.cond(all_whole, whole, lambda: in_lanes(clip, (outline, above)))
        return integrals(in_lanes(on_sphere, (cut,)), spare)

    nothing = lambda: jnp.zeros((*colour, outline.shape[2]), outline.dtype)
    return jax.lax.cond(jnp.all(dark), nothing, lit)


def in_frame(frame: Float[Array, "p 3 3"], v: Loop) -> Loop:
    """frame^T v, written out: as an einsum the gradient of a lamp takes 1.5 times as long (degree 8, jax 0.10.2)."""
    return jnp.stack([dot(axis[:, None], v) for axis in jnp.moveaxis(frame, 0, -1).swapaxes(0, 1)])


def integrals_of(slices: LampForm, *, wide: bool = False) -> Callable[[Array, Loop, int], Array]:
    """integrals(local views, v, spare) of a material over outlines, `wide` ones that may be all of the hemisphere."""
    if isinstance(slices, Quadrature):
        return lambda local, v, spare: at_points(slices, local, None, v, spare, center=wide)
    if isinstance(slices, Slices):
        return functools.partial(_uniform, slices, lookup_table(slices))
    tables = tables_of(slices)
    return lambda local, v, spare: integrals(slices, tables, dense_views(local), v, spare)


def at_points(
    material: Quadrature, local: Array, light: tuple[Array, Array] | None, v: Loop, _: int, *, center: bool = False
) -> Float[Array, "*colour p"]:
    """Integrals of the model itself, times `light`: frames, and coefficients in world space."""
    frame, incident = (None, None) if light is None else light
    own = (local.T,) if frame is None else (local.T, jnp.moveaxis(frame, 0, -1))
    return integrate(_at_point, (material, incident), own, v, material.order, center)


def _at_point(shared: tuple[Quadrature, Array | None], own: tuple[Array, ...], w: Float[Array, "3 p"]) -> Array:
    (material, incident), (view, *frame) = shared, own
    values = reflected(material, view, w)
    if incident is None:
        return values
    world = jnp.stack([dot(row, w) for row in frame[0]], axis=-1)
    return times(values, evaluate(incident[..., None, :], world))


def _uniform(slices: Slices, table: Array, local: Array, v: Loop, spare: int) -> Float[Array, "*colour p"]:
    """Integrals of plain slices."""
    angle = angle_above(v)
    if slices.isotropic:
        constant, of_colours = table[..., 0, :] @ lookup_factors(local, slices), table
        of_one = lambda t: incidence_integrals(t, local, v, slices.degree, spare)
    else:
        of_colours = slice_values(table, local, slices)
        constant, inverse = of_colours[..., 0, :], zonal_inverse(slices.degree, table.dtype)
        of_one = lambda c: fold_expansion(c, v, *inverse, spare)
    # colours in a loop: compiled code would grow with their number
    rest = jax.lax.map(of_one, of_colours) if slices.colour else of_one(of_colours)
    return times(constant, angle * Y_00) + rest
