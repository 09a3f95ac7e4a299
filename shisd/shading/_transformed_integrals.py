"""Integrals over polygons of slices beyond maps of directions.

Great arcs stay great arcs beyond a linear map, so the outline, cut off at the horizon, is mapped and the expansion is
integrated over it as ever; the base over the outline as it is. Slices of isotropic materials and their maps are even
across the plane of view and normal, where everything is done (`_incidence`).

A view along the normal has no such plane. There the derivative across it is that of views next to it: a difference of
both sides, which leaves an error of the square of the angle.

notation: theta = elevation of the view where tables are looked up, s = sin(theta); A = the map; u = an outline in the
frame given, v = in that of the plane, x, y, z with z the normal.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from shisd._lanes import in_lanes
from shisd._numerics import cross, dot
from shisd._typing import Array, Bool, Float
from shisd.decomposition.internal import stretch
from shisd.domains.internal import Loop, fold_expansion, incidence_inverse, loop_solid_angle, on_sphere, zonal_inverse
from shisd.shading import _views
from shisd.shading._incidence import Y_00, angle_above, back, rows_at, turned
from shisd.shading.slices._slices import lookup_table, slice_values
from shisd.shading.slices._transformed import BASE, TransformedSlices, parts_of

_STEEP = 1e-3  # s up to which the plane turns too fast


class Tables(NamedTuple):
    """What is looked up: rows of maps [rows, columns], of expansions and bases [colours, rows, columns]."""

    maps: Array
    lobes: Array
    base: Array


def tables_of(slices: TransformedSlices) -> Tables:
    maps, lobes, base = (lookup_table(part) for part in parts_of(slices))
    of_colours = lambda table: table.reshape(-1, *table.shape[-2:])
    return Tables(maps, of_colours(lobes), of_colours(base))


def integrals(
    slices: TransformedSlices, tables: Tables, view: Float[Array, "p 3"], u: Loop, spare: int
) -> Float[Array, "*colour p"]:
    """Integrals towards views, as the tables have them, over outlines above the horizon.

    The last `spare` edges seldom have a length. Derivatives: the first in all, exact for every view; those in the view
    along the sphere.
    """
    if slices.isotropic:
        values = _even_integrals(tables, view, u, slices.degree, spare)
    else:
        maps, lobes, base = (
            slice_values(table, view, part) for table, part in zip(tables, parts_of(slices), strict=True)
        )
        values = _of_map(maps[-5:], lobes, base, u, slices.degree, spare, even=False)
    return values.reshape(*slices.colour, -1)


def _of_map(
    s: Float[Array, "5 p"],
    lobes: Float[Array, "c rows p"],
    base: Float[Array, "c k p"],
    v: Loop,
    degree: int,
    spare: int,
    *,
    even: bool,
) -> Float[Array, "c p"]:
    return _of_rows(lobes, base, *_beyond(s, v, even), v, degree, spare, even=even)


def _beyond(s: Float[Array, "5 p"], v: Loop, even: bool) -> tuple[Loop, Float[Array, "3 p"]]:
    return in_lanes(functools.partial(_mapped, even=even), (s, v))


def _of_rows(
    lobes: Float[Array, "c rows p"],
    base: Float[Array, "c k p"],
    mapped: Loop,
    up: Float[Array, "3 p"],
    v: Loop,
    degree: int,
    spare: int,
    *,
    even: bool,
) -> Float[Array, "c p"]:
    """Expansions over the mapped outline, and bases over the outline itself."""
    inverse = incidence_inverse if even else zonal_inverse
    wide, plain = loop_solid_angle(mapped, 2 * np.pi, up), angle_above(v)

    def of_colour(rows: tuple[Array, Array]) -> Float[Array, " p"]:
        lobe, under = rows
        constant = Y_00 * (lobe[0] * wide + under[0] * plain)
        beyond = fold_expansion(lobe, mapped, *inverse(degree, v.dtype), spare)
        return constant + beyond + fold_expansion(under, v, *inverse(BASE, v.dtype), spare)

    # colours in a loop: compiled code would grow with their number
    return of_colour((lobes[0], base[0]))[None] if len(lobes) == 1 else jax.lax.map(of_colour, (lobes, base))


def _mapped(s: Float[Array, "5 q"], v: Float[Array, "3 s r"], *, even: bool) -> tuple[Loop, Float[Array, "3 q"]]:
    """The outline beyond the map, and there a direction from which all of it is within a quarter turn: A^-T z."""
    a = stretch(s, even=even)
    mapped = on_sphere(jnp.stack([dot(row[:, None], v) for row in a]))
    up = cross(a[0], a[1])  # the last column of the inverse transposed, but for the determinant, which is positive
    return mapped, on_sphere(up[:, None])[:, 0]


def _rows(tables: Tables, theta: Float[Array, " p"], degree: int) -> tuple[Array, Array, Array]:
    """Maps [5, p], expansions and bases [c, rows, p] towards views of these elevations."""
    s, lobes, base = (rows_at(table, theta, d) for table, d in zip(tables, (2, degree, BASE), strict=True))
    s = s[-3:]
    return jnp.concatenate([jnp.zeros_like(s[:2]), s]), lobes, base


def _in_plane(tables: Tables, theta: Float[Array, " p"], v: Loop, degree: int, spare: int) -> Float[Array, "c p"]:
    return _of_map(*_rows(tables, theta, degree), v, degree, spare, even=True)


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def _even_integrals(tables: Tables, view: Float[Array, "p 3"], u: Loop, degree: int, spare: int) -> Array:
    return _in_plane(tables, _views.elevation(view), turned(u, *_views.azimuth(view)), degree, spare)


def _even_integrals_jvp(degree, spare, primals, tangents):
    """The outline moves, and what is looked up; where it moves with theta alone, so does one number for each pixel."""
    (tables, view, u), (d_tables, d_view, du) = primals, tangents
    theta, (cos, sin) = _views.elevation(view), _views.azimuth(view)
    v, sine = turned(u, cos, sin), jnp.sin(theta)
    rows = lambda theta: _rows(tables, theta, degree)
    (s, lobes, base), (s_rises, lobes_rise, base_rises) = jax.jvp(rows, (theta,), (jnp.ones_like(theta),))
    mapped, up = _beyond(s, v, True)
    value = _of_rows(lobes, base, mapped, up, v, degree, spare, even=True)
    change, ds, dv = jnp.zeros_like(value), jnp.zeros_like(s), jnp.zeros_like(v)
    d_moved = {name: d for name, d in d_tables._asdict().items() if not isinstance(d, SymbolicZero)}
    if d_moved:
        of_moved = lambda moved: _in_plane(tables._replace(**moved), theta, v, degree, spare)
        change += jax.jvp(of_moved, ({name: getattr(tables, name) for name in d_moved},), (d_moved,))[1]
    if not isinstance(du, SymbolicZero):
        dv += turned(du, cos, sin)
    if not isinstance(d_view, SymbolicZero):
        dx, dy, dz = d_view.T
        d_theta = view[:, 2] * (cos * dx + sin * dy) - sine * dz
        change += _of_rows(lobes_rise, base_rises, mapped, up, v, degree, spare, even=True) * d_theta[None]
        ds += s_rises * d_theta[None]
        across, steep = cos * dy - sin * dx, sine < _STEEP
        dv += back(v) * (across * jnp.where(steep, 0, 1 / jnp.where(steep, 1, sine)))[None, None]
        change += _at_normal(tables, v, steep, degree, spare) * jnp.where(steep, across, 0)[None]
    if not (isinstance(du, SymbolicZero) and isinstance(d_view, SymbolicZero)):
        change += _moves((s, lobes, base), v, ds, dv, degree, spare)
    return value, change


_even_integrals.defjvp(_even_integrals_jvp, symbolic_zeros=True)


def _moves(
    rows: tuple[Array, Array, Array], v: Loop, ds: Float[Array, "5 p"], dv: Loop, degree: int, spare: int
) -> Float[Array, "c p"]:
    """The change as the map and the outline move."""
    s, lobes, base = rows
    (mapped, up), (d_mapped, _) = jax.jvp(lambda s, v: _beyond(s, v, True), (s, v), (ds, dv))
    up = jax.lax.stop_gradient(up)  # no angle depends on it
    over = lambda mapped, v: _of_rows(lobes, base, mapped, up, v, degree, spare, even=True)
    return jax.jvp(over, (mapped, v), (d_mapped, dv))[1]


def _at_normal(tables: Tables, v: Loop, steep: Bool[Array, " p"], degree: int, spare: int) -> Float[Array, "c p"]:
    """The change with a step across the plane of views next to the normal, if any are `steep`, or else 0."""
    none = lambda: jnp.zeros((tables.lobes.shape[0], v.shape[2]), v.dtype)

    def next_to_it() -> Float[Array, "c p"]:
        both = jnp.concatenate([v, v * jnp.asarray([-1, -1, 1], v.dtype)[:, None, None]], axis=2)
        side = jnp.concatenate([jnp.ones_like(v[0, 0]), -jnp.ones_like(v[0, 0])])
        move = back(both) * side[None, None] / (2 * _STEEP)
        rows = _rows(tables, jnp.full_like(both[0, 0], _STEEP), degree)
        turns = _moves(rows, both, jnp.zeros_like(rows[0]), move, degree, spare)
        return turns[:, : v.shape[2]] + turns[:, v.shape[2] :]

    return jax.lax.cond(jnp.any(steep), next_to_it, none)
