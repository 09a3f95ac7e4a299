"""Edges of spherical polygons, as the recurrences read them.

notation, beside the package's: alpha = a - c = tau - kappa c with tau at right angles to c; t = tan(theta/2).

Vertices are unit to rounding only, which tilts the sum a + b of nearly opposite ones; `sides` sets it right, and what
is a sum over the ends of an edge near pi is taken from it.
"""

import functools
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from shisd._numerics import arctan2, cross, dot, safe_sqrt
from shisd._typing import Array, Float

Loop = Float[Array, "3 s p"]


class Edges(NamedTuple):
    """Edges a -> b, without reference to an axis. What is over a length is 0 where there is none."""

    tau: Array  # a = c + tau - kappa c
    tau_next: Array  # of b
    d_tau: Array  # their difference
    middle: Array  # a + b
    normal: Array  # theta n
    kappa: Array
    kappa_next: Array
    d_kappa: Array
    over_angle: Array  # 1/theta
    over_sine: Array
    t: Array  # tan(theta/2)
    over_t: Array
    ratio_1: Array  # theta / sin(theta) - 1
    mean: Array  # t / theta
    excess: Array  # 1/2 - t / theta


class Spans(NamedTuple):
    """Edges a -> b, as their derivatives need them."""

    start: Array
    end: Array
    chord: Array  # b - a
    middle: Array  # a + b
    normal: Array  # theta n
    angle: Array  # theta
    over_angle: Array
    half_sine: Array  # sin(theta/2)
    over_half_sine: Array
    over_half_cosine: Array


Kind = TypeVar("Kind", Edges, Spans)
_VECTORS = {"tau", "tau_next", "d_tau", "normal", "start", "end", "chord", "middle"}


def _pack(edges: Edges | Spans) -> Float[Array, "rows e p"]:
    """One array, kept as such, so that its parts are not made again for every axis."""
    edges = jax.lax.optimization_barrier(edges)
    rows = [x if name in _VECTORS else x[None] for name, x in edges._asdict().items()]
    return jax.lax.optimization_barrier(jnp.concatenate(rows))


def unpack(kind: type[Kind], rows: Array) -> Kind:
    parts, used = [], 0
    for name in kind._fields:
        size = 3 if name in _VECTORS else 1
        parts.append(rows[used : used + size] if size == 3 else rows[used])
        used += size
    return kind(*parts)


class Arcs(NamedTuple):
    edges: Float[Array, "rows e p"]
    c: Float[Array, "3 p"]  # the reference vertex
    total: Float[Array, "3 p"]  # the sum of theta n over the edges


def arcs_of(v: Loop) -> Arcs:
    c = jax.lax.stop_gradient(v[:, :1])  # nothing depends on the choice of c
    offset = v - c
    tau = offset - dot(offset, c)[None] * c
    cosine = dot(v, c)
    near = cosine > 0.5
    tau2 = dot(tau, tau)
    kappa = jnp.where(near, tau2 / (1 + jnp.sqrt(jnp.where(near, 1 - tau2, 1))), 1 - cosine)
    tau_next, kappa_next = jnp.roll(tau, -1, 1), jnp.roll(kappa, -1, 0)
    d_tau, d_kappa = tau_next - tau, kappa_next - kappa
    chord, middle = d_tau - d_kappa[None] * c, sides(v)[1]
    t2, tail, part, normal = _turns(v, chord, middle)
    none, t, ratio, ratio_1 = _none(t2), safe_sqrt(t2), (1 + t2) * part, t2 + tail * (1 + t2)
    around = cross(jnp.broadcast_to(c, v.shape), chord)  # these add up to 0
    parts = ratio_1[None] * around + ratio[None] * cross(tau - kappa[None] * c, chord)
    parts = jnp.where((t2 < 1)[None], parts, normal - around)  # the same, where the chord is not small
    edges = Edges(
        tau, tau_next, d_tau, middle, normal, kappa, kappa_next, d_kappa,
        over_angle=_over(2 * t * part, none), over_sine=_over(2 * t / (1 + t2), none),
        t=t, over_t=_over(t, none), ratio_1=ratio_1, mean=0.5 / part, excess=0.5 * tail / part,
    )  # fmt: skip
    total = sum_first(jnp.moveaxis(parts, 1, 0))
    return Arcs(_pack(edges), *jax.lax.optimization_barrier((c[:, 0], total)))


def spans_of(v: Loop) -> Float[Array, "rows e p"]:
    chord, middle = sides(v)
    t2, _, part, normal = _turns(v, chord, middle)
    none, angle, half_sine = _none(t2), 2 * safe_sqrt(t2) * part, 0.5 * safe_sqrt(dot(chord, chord))
    over_half_cosine = 2 / jnp.sqrt(dot(middle, middle))
    spans = Spans(
        v, jnp.roll(v, -1, 1), chord, middle, normal, angle,
        _over(angle, none), half_sine, _over(half_sine, none), over_half_cosine,
    )  # fmt: skip
    return _pack(spans)


def sides(v: Loop) -> tuple[Loop, Loop]:
    """Of every edge b - a and a + b, these at right angles to those.

    Of nearly opposite vertices, whose lengths are 1 to rounding only, the sum as it stands is tilted.
    """
    end = jnp.roll(v, -1, 1)
    chord, middle = end - v, v + end
    chord2, middle2 = dot(chord, chord), dot(middle, middle)
    tilt = jnp.where(chord2 < middle2, 0, dot(chord, middle) / jnp.maximum(chord2, middle2))
    return chord, middle - tilt[None] * chord


def _turns(start: Loop, chord: Loop, middle: Loop) -> tuple[Array, Array, Array, Loop]:
    """Of edges: t^2, arctan(t)/t - 1, arctan(t)/t, and theta n."""
    t2 = dot(chord, chord) / dot(middle, middle)
    tail, part = _arctan_parts(t2)
    normal = ((1 + t2) * part)[None] * cross(start, jnp.where((t2 < 1)[None], chord, middle))
    return t2, tail, part, normal


def _none(t2: Array) -> Array:
    """Of no length, or one whose square is none: its recurrence is that of a point."""
    return t2 < 1e4 * jnp.finfo(t2.dtype).tiny


def _over(x: Array, none: Array) -> Array:
    return jnp.where(none, 0, 1 / jnp.where(none, 1, x))


def _arctan_parts(t2: Array) -> tuple[Array, Array]:
    """arctan(t)/t - 1 and arctan(t)/t as functions of t^2, without cancellation."""
    small = t2 < 0.01
    x = jnp.where(small, t2, 0)
    series = jnp.zeros_like(x)
    for k in range(9, 0, -1):
        series = x * ((-1.0) ** k / (2 * k + 1) + series)
    t = jnp.sqrt(jnp.where(small, 1, t2))
    part = jnp.where(small, 1 + series, arctan2(t, jnp.ones_like(t)) / t)
    return jnp.where(small, series, part - 1), part


def sum_first(x: Array) -> Array:
    """Sum over the first axis, written out: as `jnp.sum` gradients of a lamp take 1.8 times as long (jax 0.10.2)."""
    return functools.reduce(jnp.add, [x[i] for i in range(x.shape[0])])
