"""Integrals over polygons of slices of isotropic materials, by zonal functions about axes in the plane of incidence.

Such a slice is even across the plane of view and normal. So L+1 axes in that plane do what takes 2L+1 otherwise
(`domains._integrate.incidence_inverse`), and what is interpolated over views depends on their elevation only.

A view along the normal has no such plane. The value is right whichever is taken, since the slice is even across all.
The derivative is not that of the formula, in which the plane then turns infinitely fast: the rule below has the limit.

notation: theta = elevation of the view, s = sin(theta); frame x, y, z with z the normal and y across the plane; c_m =
rows of the slice, of which c_m / s is smooth for m > 0; u = an outline in the frame given, v = in that of the plane.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from shisd._numerics import times
from shisd._typing import Array, Float
from shisd.domains.internal import Loop, fold_expansion, incidence_inverse, loop_solid_angle
from shisd.harmonics.internal import orders
from shisd.shading import _views

Y_00 = math.sqrt(1 / (4 * math.pi))
_STEEP = 0.01  # s up to which the plane turns too fast


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def incidence_integrals(
    table: Float[Array, "n columns"], view: Float[Array, "p 3"], u: Loop, degree: int, spare: int
) -> Float[Array, " p"]:
    """Integrals, without their constants, of slices from `lookup_table` towards local unit views, over outlines.

    The last `spare` edges seldom have a length.

    Derivatives: the first exact for every view, along the normal too; those in the view along the sphere.
    """
    return _fold(rows_at(table, _views.elevation(view), degree), turned(u, *_views.azimuth(view)), degree, spare)


def _incidence_integrals_jvp(degree, spare, primals, tangents):
    (table, view, u), (d_table, d_view, du) = primals, tangents
    value = incidence_integrals(table, view, u, degree, spare)
    theta, (cos, sin) = _views.elevation(view), _views.azimuth(view)
    v, change, dv, across = turned(u, cos, sin), jnp.zeros_like(value), jnp.zeros_like(u), None
    if not isinstance(d_table, SymbolicZero):
        in_table = lambda t: _fold(rows_at(t, theta, degree), v, degree, spare)
        change += jax.jvp(in_table, (table,), (d_table,))[1]
    if not isinstance(d_view, SymbolicZero):
        dx, dy, dz = d_view.T
        along, across = cos * dx + sin * dy, cos * dy - sin * dx
        _, steeper = jax.jvp(lambda t: rows_at(table, t, degree), (theta,), (jnp.ones_like(theta),))
        change += _fold(steeper, v, degree, spare) * (view[:, 2] * along - jnp.sin(theta) * dz)
    if not isinstance(du, SymbolicZero):
        dv += turned(du, cos, sin)
    if not (isinstance(du, SymbolicZero) and across is None):
        change += _outline_moves(table, theta, v, dv, across, degree, spare)
    return value, change


incidence_integrals.defjvp(_incidence_integrals_jvp, symbolic_zeros=True)


def _outline_moves(
    table: Array, theta: Array, v: Loop, dv: Loop, across: Array | None, degree: int, spare: int
) -> Array:
    """Change of the integrals where v moves by dv and the view by `across`, at right angles to the plane."""

    def moves(by: Loop, over_sine: bool) -> Array:
        rows = rows_at(table, theta, degree, over_sine=over_sine)
        return jax.jvp(lambda v: _fold(rows, v, degree, spare), (v,), (by,))[1]

    if across is None:
        return moves(dv, False)
    # the plane turns by across / s, and v in it turns back
    turn, sine = back(v) * across[None, None], jnp.sin(theta)
    steep = sine < _STEEP
    dv += turn * jnp.where(steep, 0, 1 / jnp.where(steep, 1, sine))[None, None]
    none, at_normal = lambda: jnp.zeros_like(theta), lambda: moves(jnp.where(steep[None, None], turn, 0), True)
    return moves(dv, False) + jax.lax.cond(jnp.any(steep), at_normal, none)


def rows_at(table: Array, theta: Array, degree: int, *, over_sine: bool = False) -> Float[Array, "*c rows p"]:
    """Rows m >= 0 of slices in the frame of the plane; `over_sine`, those with m > 0 over s, for m = 0 zeros."""
    m = orders(degree)
    rows = table[..., m >= 0, :] @ _views.spline_weights(theta, table.shape[-1] - 4)
    scale = (0.0, 1.0) if over_sine else (1.0, jnp.sin(theta)[None])
    return times(rows, jnp.where(m[m >= 0][:, None] > 0, scale[1], scale[0]))


def _fold(rows: Float[Array, "rows p"], v: Loop, degree: int, spare: int) -> Float[Array, " p"]:
    return fold_expansion(rows, v, *incidence_inverse(degree, rows.dtype), spare)


def turned(u: Loop, cos: Array, sin: Array) -> Loop:
    """The frame turned about z to this azimuth, and u in it."""
    cos, sin = cos[None], sin[None]
    return jnp.stack([cos * u[0] + sin * u[1], cos * u[1] - sin * u[0], u[2]])


def back(v: Loop) -> Loop:
    """How an outline moves in the frame of a plane that turns about z."""
    return jnp.stack([v[1], -v[0], jnp.zeros_like(v[0])])


def angle_above(v: Loop) -> Float[Array, " p"]:
    """Solid angles of outlines above the horizon."""
    up = jnp.broadcast_to(jnp.asarray([0, 0, 1], v.dtype)[:, None], (3, v.shape[2]))
    return loop_solid_angle(v, 2 * np.pi, up)
