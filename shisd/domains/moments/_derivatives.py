"""The moments with their derivatives.

The derivative of an integral in the vertices is an integral along the moving edges. It has a recurrence of its own and
is exact where vertices coincide. That in the axes is the derivative of the differences: as an integral along the edges,
which turn back, it would lose a factor of the polygon's size.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from shisd._lanes import in_lanes
from shisd._numerics import dot
from shisd._typing import Array, Float
from shisd.domains.moments._edges import Loop, Spans, spans_of, unpack
from shisd.domains.moments._recurrence import Factors, factors_of, sweep


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def moments(axes: Float[Array, "k 3"], v: Loop, degree: int) -> Float[Array, "l k p"]:
    """I_l(axes[k]) for l = 1 ... degree."""
    return in_lanes(functools.partial(sweep, degree=degree), (v,), (axes,))


def _moments_jvp(degree, primals, tangents):
    (axes, v), (d_axes, dv) = primals, tangents
    change = None
    if isinstance(d_axes, SymbolicZero):
        values = moments(axes, v, degree)
    else:  # of differences, like the values: the lines that the vertices turn along would lose a factor of the size
        values, change = jax.jvp(lambda a: sweep(v, a, degree), (axes,), (d_axes,))
    if not isinstance(dv, SymbolicZero):
        moved = _moved(axes, v, dv, degree)
        change = moved if change is None else change + moved
    return values, jnp.zeros_like(values) if change is None else change


def _moved(axes: Float[Array, "k 3"], v: Loop, dv: Loop, degree: int) -> Float[Array, "l k p"]:
    """Changes of the moments with the vertices."""
    a, b, normal = in_lanes(functools.partial(_at_vertices, degree=degree), (v,), (axes,))
    start, end = (x[:, None] for x in speeds(normal, dv))
    return -jnp.sum(start[None] * a + end[None] * b, axis=1)


def _at_vertices(v: Loop, axes: Float[Array, "k 3"], degree: int) -> tuple[Array, Array, Loop]:
    """The integrals of `at_vertices` for l = 1 ... degree, [l, e, k, p] each, and theta n."""
    packed = spans_of(v)
    spans = unpack(Spans, packed[:, :, None])
    terms = boundary(spans, axes.T[:, None, :, None])

    def step(state: _BoundaryState, n: Factors) -> tuple[_BoundaryState, tuple[Array, Array]]:
        state = terms.advance(state, n)
        return state, at_vertices(spans, state.middle, state.chord)

    return *jax.lax.scan(step, terms.start(), factors_of(1, degree, v.dtype))[1], unpack(Spans, packed).normal


moments.defjvp(_moments_jvp, symbolic_zeros=True)


class _BoundaryState(NamedTuple):
    """P_{l-1}(u) at a and its quotient, E and D, V_{l-1} and the two last Z, over theta, with those of degree l-2."""

    q0: Array
    q: Array
    dq0: Array
    dq: Array
    e0: Array
    e: Array
    s0: Array
    s: Array
    middle: Array
    chord: Array
    z_middle0: Array
    z_middle: Array
    z_chord0: Array
    z_chord: Array


class _Boundary(NamedTuple):
    """What the integrals V_l of P_l(u) w ds along an edge need, from which come derivatives.

    Integrating P_l w' by parts, with d' the part of d in the plane of the edge and Z_l the integral of P_l'(u) w ds:
    (l+1) V_l = d' D_l - Z_{l-1} - [P_l w'],  Z_l = Z_{l-2} + (2l-1) V_{l-1}, and the integral of u P_l is V_l . d.
    Components along the middle of the edge and along its chord; all divided by theta.
    """

    u0: Array
    u1: Array
    slope: Array  # (u1 - u0) / theta
    d_middle: Array
    d_chord: Array
    weight: Array  # sin(theta/2) / theta
    angle: Array
    half_cosine: Array

    def start(self) -> _BoundaryState:
        zero, one = jnp.zeros_like(self.u0), jnp.ones_like(self.u0)
        middle = 2 * self.weight + zero
        return _BoundaryState(zero, one, zero, zero, zero, one, zero, zero, middle, zero, zero, zero, zero, zero)

    def advance(self, x: _BoundaryState, n: Factors) -> _BoundaryState:
        """From degree l-1 to l."""
        q = n.up * self.u0 * x.q - n.back * x.q0
        dq = n.up * (self.u1 * x.dq + self.slope * x.q) - n.back * x.dq0
        s = x.s0 + n.odd * x.e
        e = n.up * (self.d_middle * x.middle + self.d_chord * x.chord) - n.back * x.e0
        chord = n.next * (self.d_chord * s - x.z_chord - self.half_cosine * dq)  # of the order of angle^2
        chord = jnp.where(self.angle * n.odd < _short(s.dtype), self.angle**2 / 12 * self.d_chord * s, chord)
        return _BoundaryState(
            x.q, q, x.dq, dq, x.e, e, x.s, s,
            n.next * (self.d_middle * s - x.z_middle + self.weight * (2 * q + self.angle * dq)),
            chord,
            x.z_middle, x.z_middle0 + n.odd * x.middle, x.z_chord, x.z_chord0 + n.odd * x.chord,
        )  # fmt: skip


def _short(dtype: jnp.dtype) -> float:
    """Below about which (2l-1) theta the leading term of an odd integral along an edge beats its recurrence.

    The recurrence knows the integral to a rounding of 1, of which (l theta)^2 / 12 is left; the term, to (l theta)^4.
    """
    return float(2e4 * jnp.finfo(dtype).eps) ** 0.25


def boundary(span: Spans, d: Array) -> _Boundary:
    u0, u1, rise = dot(span.start, d), dot(span.end, d), dot(span.chord, d)
    return _Boundary(
        u0, u1,
        slope=rise * span.over_angle,
        d_middle=0.5 * dot(span.middle, d) * span.over_half_cosine,
        d_chord=0.5 * rise * span.over_half_sine,
        weight=jnp.where(span.over_angle == 0, 0.5, span.half_sine * span.over_angle),
        angle=span.angle, half_cosine=1 / span.over_half_cosine,
    )  # fmt: skip


def at_vertices(span: Spans, middle: Array, chord: Array) -> tuple[Array, Array]:
    """Integrals of P_l(u) times the weights of a and of b in w = (sin(theta - s) a + sin(s) b) / sin(theta)."""
    middle, chord = 0.5 * middle * span.over_half_cosine, 0.5 * chord * span.over_half_sine
    return middle - chord, middle + chord


def speeds(normal: Loop, dv: Loop) -> tuple[Array, Array]:
    """Of theta n of every edge: its products with the velocities of both ends, [e, p]."""
    return dot(normal, dv), dot(normal, jnp.roll(dv, -1, 1))
