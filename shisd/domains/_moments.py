"""Moments of spherical polygons: integrals of P_l(w . d) and of (w . d)^n, exact in one pass along the edges.

By the divergence theorem on the sphere, for l >= 1,

    I_l(d) = integral of P_l(w . d) over the polygon = sum over edges of g D_l / (l (l+1)),

where D_l is the integral of P_l'(u) ds, u(s) = w(s) . d along the great arc a -> b of length theta, and g = n . d, n =
its inward normal. With E_l the integral of P_l(u) ds and [u' P] the difference between the ends, integration by parts
closes the recurrence:

    E_l = ((l-1)/l)^2 E_{l-2} - (2l-1)/l^2 ([u' P_{l-1}] + g^2 D_{l-1}),   D_l = D_{l-2} + (2l-1) E_{l-1}

(the arrangement of Wang and Ramamoorthi 2018; Arvo 1995 and CSH18 do the same with powers of u, which cancel).

As it stands, a polygon of size h loses a factor 1/h^2 of accuracy: edges of length h add up to an area of h^2, and each
[u' P] is a difference of nearly equal numbers. Both go away when every quantity is carried as its difference to what it
is at a reference vertex c: there E_l / theta = P_l(c . d) and D_l / theta = P_l'(c . d), and what is left is small in
proportion to the size. All differences obey recurrences whose sources are differences of vertices, which are exact.
Then I_l = (P_l'(c . d) T + sum of G (D_l/theta - P_l'(c . d))) / (l (l+1)), with G = theta g and T = sum of G, whose
leading parts cancel by hand. One formula thus serves every size, in both precisions.

The derivative of an integral is an integral along the moving edges. It has a recurrence of its own and is exact where
vertices coincide.

layout: polygons are v[x y z, vertex, p], points p last as vector lanes; axes d[k, x y z]; edges [e, k, p].
notation: alpha = a - c = tau - kappa c with tau at right angles to c; t = tan(theta/2); q, dq = P_l(u) at a and the
difference quotient (P_l(u1) - P_l(u0)) / theta; a letter with `_c` belongs to the reference.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from shisd._numerics import cross, dot, safe_sqrt
from shisd._typing import Array, Float

Loop = Float[Array, "3 s p"]

_UNROLLED = 32  # up to this degree a sweep is one straight line of code, which XLA keeps in registers


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def fold(weights: Float[Array, "l k q"], axes: Float[Array, "k 3"], v: Loop, degree: int) -> Float[Array, " p"]:
    """sum over l >= 1 and k of weights[l, k] I_l(axes[k]) for every polygon. Weights may be shared (q = 1)."""
    if degree == 0:
        return jnp.zeros(v.shape[2:], v.dtype)
    terms, total = _zonal_terms(_arcs(v), axes)
    value = _sum_all(0.5 * weights[1] * total)
    if degree == 1:
        return value
    flat = _flat(weights, total)

    def step(state: tuple, n: _Factors, w: Array, edge: _Zonal) -> tuple:
        *rest, value = state
        following, change = edge.advance(tuple(rest), n)
        return *following, value + (n.laplacian * w) * change

    for edge in _edges(terms):
        *_, part = _sweep(step, (*edge.start(), jnp.zeros_like(edge.u0)), degree, flat, edge)
        value += _sum_all(part.reshape(total.shape))
    return value


def _fold_jvp(degree, primals, tangents):
    (weights, axes, v), (d_weights, d_axes, dv) = primals, tangents
    value = fold(weights, axes, v, degree)
    change = jnp.zeros_like(value)
    if degree == 0:
        return value, change
    if not isinstance(d_weights, SymbolicZero):
        change += _sum_all(moments(axes, v, degree) * d_weights[1:])
    if not (isinstance(d_axes, SymbolicZero) and isinstance(dv, SymbolicZero)):
        arcs = _arcs(v)
        terms, speeds = _boundary_terms(arcs, axes), _edge_speeds(arcs, axes, d_axes, dv)

        def step(state: tuple, n: _Factors, w: Array, edge: _Boundary) -> tuple:
            *rest, middle, chord = state
            following, middle_l, chord_l = edge.advance(tuple(rest), n)
            return *following, middle + w * middle_l, chord + w * chord_l

        shape = terms.u0.shape[1:]
        flat = _flat(weights, terms.u0[0])
        for e, edge in enumerate(_edges(terms)):
            zero = jnp.zeros_like(edge.u0)
            *_, middle, chord = _sweep(step, (*edge.start(), zero, zero), degree, flat, edge, first=1)
            # Reshaped, a result cannot take the place of one of the terms in memory, for which see `_edges`.
            middle, chord = jax.lax.optimization_barrier((middle.reshape(shape), chord.reshape(shape)))
            for speed, weight in zip(speeds, _Boundary(*(x[e] for x in terms)).at_vertices(middle, chord), strict=True):
                change -= _sum_all(speed[e] * weight)
    return value, change


fold.defjvp(_fold_jvp, symbolic_zeros=True)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def moments(axes: Float[Array, "k 3"], v: Loop, degree: int) -> Float[Array, "l k p"]:
    """I_l(axes[k]) for l = 1 ... degree."""
    terms, total = _zonal_terms(_arcs(v), axes)
    first = 0.5 * total
    if degree == 1:
        return first[None]

    def step(state: tuple, n: _Factors) -> tuple[tuple, Array]:
        state, change = terms.advance(state, n)
        return state, _sum_edges(change) * n.laplacian

    _, rest = jax.lax.scan(step, terms.start(), _factors(2, degree, v.dtype))
    return jnp.concatenate([first[None], rest])


def _moments_jvp(degree, primals, tangents):
    (axes, v), (d_axes, dv) = primals, tangents
    values = moments(axes, v, degree)
    if isinstance(d_axes, SymbolicZero) and isinstance(dv, SymbolicZero):
        return values, jnp.zeros_like(values)
    arcs = _arcs(v)
    terms, speeds = _boundary_terms(arcs, axes), _edge_speeds(arcs, axes, d_axes, dv)

    def step(state: tuple, n: _Factors) -> tuple[tuple, Array]:
        state, middle, chord = terms.advance(state, n)
        a, b = terms.at_vertices(middle, chord)
        return state, _sum_edges(speeds[0] * a + speeds[1] * b)

    _, change = jax.lax.scan(step, terms.start(), _factors(1, degree, v.dtype))
    return values, -change


moments.defjvp(_moments_jvp, symbolic_zeros=True)


def powers(axes: Float[Array, "k 3"], v: Loop, solid_angle: Float[Array, " p"], order: int) -> Float[Array, "n k p"]:
    """Integrals of (w . axes[k])^n for n = 0 ... order (Arvo 1995).

    n F_n = (n-1) (1 - g^2) F_{n-2} - [u^(n-1) u'] along the edges, (n+1) A_n = (n-1) A_{n-2} + sum of g F_{n-1}.
    """
    arcs = _arcs(v)
    terms, total = _zonal_terms(arcs, axes)
    u0, u1 = terms.u0, terms.u1
    slope0 = terms.end_slope + terms.mean_u * arcs.angle[:, None]  # u'(a)
    inside, none, inverse_angle = 1 - terms.g2, arcs.none[:, None], arcs.inverse(arcs.angle)[:, None]
    a = [jnp.broadcast_to(solid_angle[None], total.shape), 0.5 * total]
    f = [jnp.ones_like(u0), terms.mean_u]  # F_n / theta
    p0, p1 = u0, u1
    for n in range(2, order + 1):
        ends = jnp.where(none, -p0 * u0, (p1 * terms.end_slope - p0 * slope0) * inverse_angle)
        f.append(((n - 1) * inside * f[n - 2] - ends) / n)
        a.append(((n - 1) * a[n - 2] + _sum_edges(terms.along * f[n - 1])) / (n + 1))
        p0, p1 = p0 * u0, p1 * u1
    return jnp.stack(a[: order + 1])


class _Factors(NamedTuple):
    """The numbers in the recurrences for degree l."""

    up: Array | np.ndarray  # (2l-1)/l
    back: Array | np.ndarray  # (l-1)/l
    back2: Array | np.ndarray  # ((l-1)/l)^2
    source: Array | np.ndarray  # (2l-1)/l^2
    odd: Array | np.ndarray  # 2l-1
    laplacian: Array | np.ndarray  # 1/(l(l+1))
    next: Array | np.ndarray  # 1/(l+1)


def _factors(first: int, degree: int, dtype: jnp.dtype) -> _Factors:
    """Of degrees `first` ... `degree`, on the host."""
    l = np.arange(first, degree + 1.0)
    odd = 2 * l - 1
    values = (odd / l, (l - 1) / l, ((l - 1) / l) ** 2, odd / l**2, odd, 1 / (l * (l + 1)), 1 / (l + 1))
    return _Factors(*(x.astype(dtype) for x in values))


class _Arcs(NamedTuple):
    """The edges a -> b of polygons, without reference to an axis, each [vertex, p] or [x y z, vertex, p]."""

    start: Array
    end: Array
    c: Array  # the reference vertex [x y z, p]
    tau: Array  # a = c + tau - kappa c
    tau_next: Array
    kappa: Array
    kappa_next: Array
    chord: Array  # b - a
    none: Array  # so short that it has no direction: its recurrence is that of a point
    short: Array  # below a right angle
    t: Array  # tan(theta/2)
    tail: Array  # arctan(t)/t - 1
    angle: Array  # theta
    sine: Array
    half_sine: Array  # sin(theta/2)
    half_cosine: Array
    ratio_1: Array  # theta / sin(theta) - 1
    normal: Array  # theta n
    total: Array  # its sum over the edges [x y z, p]

    def inverse(self, x: Array) -> Array:
        """1/x, 0 on edges of no length."""
        return jnp.where(self.none, 0, 1 / jnp.where(self.none, 1, x))


def _arcs(v: Loop) -> _Arcs:
    c = jax.lax.stop_gradient(v[:, :1])  # nothing depends on the choice of c
    offset = v - c
    tau = offset - dot(offset, c)[None] * c
    cosine = dot(v, c)
    near = cosine > 0.5
    tau2 = dot(tau, tau)
    kappa = jnp.where(near, tau2 / (1 + jnp.sqrt(jnp.where(near, 1 - tau2, 1))), 1 - cosine)
    end, tau_next, kappa_next = jnp.roll(v, -1, 1), jnp.roll(tau, -1, 1), jnp.roll(kappa, -1, 0)
    chord, middle = tau_next - tau - (kappa_next - kappa)[None] * c, v + end
    chord2, middle2 = dot(chord, chord), dot(middle, middle)
    t2 = chord2 / middle2
    short = t2 < 1
    t, tail = safe_sqrt(t2), _arctan_tail(t2)
    ratio, ratio_1 = (1 + t2) * (1 + tail), t2 + tail * (1 + t2)  # theta / sin(theta)
    normal = ratio[None] * cross(v, jnp.where(short[None], chord, middle))
    around = cross(jnp.broadcast_to(c, v.shape), chord)  # these add up to 0
    parts = ratio_1[None] * around + ratio[None] * cross(tau - kappa[None] * c, chord)
    long = normal - around  # the same, where the chord is not small
    arcs = _Arcs(
        v, end, c[:, 0], tau, tau_next, kappa, kappa_next, chord,
        none=t2 < (64 * jnp.finfo(v.dtype).eps) ** 2, short=short,
        t=t, tail=tail, angle=2 * t * (1 + tail), sine=2 * t / (1 + t2),
        half_sine=0.5 * safe_sqrt(chord2), half_cosine=0.5 * safe_sqrt(middle2),
        ratio_1=ratio_1, normal=normal,
        total=_sum_edges(jnp.moveaxis(jnp.where(short[None], parts, long), 1, 0)),
    )  # fmt: skip
    return jax.lax.optimization_barrier(arcs)  # kept as arrays: XLA would compute them again for every axis


class _Zonal(NamedTuple):
    """What the recurrence for I_l needs of edges and axes, in arrays of one shape."""

    u0: Array
    u1: Array
    y0: Array  # u0 - u_c
    y1: Array
    slope: Array  # (u1 - u0) / theta
    end_slope: Array  # u' at b
    mean_u: Array  # E_1 / theta
    g2: Array
    along: Array  # G = theta g
    of_value: Array  # coefficients, in the difference of [u' P_l] + g^2 D_l to its value at c, of P_l(u_c) ...
    of_derivative: Array  # ... and of P_l'(u_c)
    sign: Array  # of u_c
    gap: Array  # 1 - |u_c|
    share: Array  # T over the number of edges

    def start(self) -> tuple:
        zero, one = jnp.zeros_like(self.u0), jnp.ones_like(self.u0)
        reference = (-self.gap, 1 - self.gap, self.sign, one, zero, one)
        return zero, self.y0, zero, zero, zero, -self.of_value, zero, zero, *reference

    def advance(self, state: tuple, n: _Factors) -> tuple[tuple, Array]:
        """From degree l-1 to l: the new state, and what the edge adds to l (l+1) I_l."""
        q0, q, dq0, dq, e0, e, s0, s, step_c, size_c, sign_c, p_c0, r_c0, r_c = state
        up, back = n.up, n.back
        p_c = sign_c * size_c
        ends = self.end_slope * dq - self.mean_u * q + self.g2 * s + self.of_value * p_c + self.of_derivative * r_c
        e_next, s_next = n.back2 * e0 - n.source * ends, s0 + n.odd * e
        dq_next = up * (self.u1 * dq + self.slope * (q + self.y1 * r_c)) - back * dq0
        q_next = up * (self.u0 * q + self.y0 * p_c) - back * q0
        # |P_l| of |u_c| by its differences in l, exact near u_c = +-1
        step_c = back * step_c - up * self.gap * size_c
        r_next = r_c0 + n.odd * p_c
        reference = (step_c, size_c + step_c, sign_c * self.sign, p_c, r_c, r_next)
        change = s_next * self.along + r_next * self.share
        return (q, q_next, dq, dq_next, e, e_next, s, s_next, *reference), change


def _zonal_terms(arcs: _Arcs, axes: Float[Array, "k 3"]) -> tuple[_Zonal, Float[Array, "k p"]]:
    """The terms [e, k, p], and T."""
    d, c = axes.T[:, :, None], arcs.c[:, None]
    # c . d and differences to it, exact also where d is near c or -c
    sign = jnp.where(dot(d, c) < 0, -1, 1).astype(c.dtype)
    offset = d - sign[None] * c
    gap = 0.5 * dot(offset, offset)
    u_c = (sign * (1 - gap))[None]
    project = lambda tau, kappa: dot(tau[:, :, None], offset[:, None]) - kappa[:, None] * u_c
    y0, y1 = project(arcs.tau, arcs.kappa), project(arcs.tau_next, arcs.kappa_next)
    u0, u1 = u_c + y0, u_c + y1
    rise = project(arcs.tau_next - arcs.tau, arcs.kappa_next - arcs.kappa)  # u1 - u0
    t, tail, ratio_1 = arcs.t[:, None], arcs.tail[:, None], arcs.ratio_1[:, None]
    inverse_angle, over_sine, over_t = (arcs.inverse(x)[:, None] for x in (arcs.angle, arcs.sine, arcs.t))
    slope, both = rise * inverse_angle, u0 + u1
    end_slope = jnp.where(arcs.short[:, None], rise * over_sine - u1 * t, u1 * over_t - both * over_sine)
    along = dot(arcs.normal[:, :, None], d[:, None])
    total = dot(arcs.total[:, None], d)
    terms = _Zonal(
        u0, u1, y0, y1, slope, end_slope,
        mean_u=both * (0.5 / (1 + tail)),
        g2=jnp.where(arcs.none[:, None], 1 - u1 * u1, (along * inverse_angle) ** 2),
        along=along,
        of_value=both * (0.5 * tail / (1 + tail)) - 0.5 * (y0 + y1),
        of_derivative=end_slope * (u1 * t - slope * ratio_1) - y1 * (u1 + u_c),
        sign=sign[None], gap=gap[None], share=total[None] / len(u0),
    )  # fmt: skip
    return _Zonal(*(jnp.broadcast_to(x, u0.shape) for x in terms)), total


class _Boundary(NamedTuple):
    """What the integrals V_l of P_l(u) w ds along the edges need, from which come derivatives.

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
    length: Array  # theta
    half_cosine: Array
    inverse_half_sine: Array

    def start(self) -> tuple:
        zero, one = jnp.zeros_like(self.u0), jnp.ones_like(self.u0)
        return zero, one, zero, zero, zero, one, zero, zero, 2 * self.weight, zero, zero, zero, zero, zero

    def advance(self, state: tuple, n: _Factors) -> tuple[tuple, Array, Array]:
        """From degree l-1 to l: the new state, and the two components of V_l."""
        q0, q, dq0, dq, e0, e, s0, s, middle, chord, z_middle0, z_middle, z_chord0, z_chord = state
        up, back = n.up, n.back
        q_next, dq_next = up * self.u0 * q - back * q0, up * (self.u1 * dq + self.slope * q) - back * dq0
        s_next = s0 + n.odd * e
        e_next = up * (self.d_middle * middle + self.d_chord * chord) - back * e0
        z_middle_next, z_chord_next = z_middle0 + n.odd * middle, z_chord0 + n.odd * chord
        middle = n.next * (self.d_middle * s_next - z_middle + self.weight * (2 * q_next + self.length * dq_next))
        chord = n.next * (self.d_chord * s_next - z_chord - self.half_cosine * dq_next)
        z = (z_middle, z_middle_next, z_chord, z_chord_next)
        return (q, q_next, dq, dq_next, e, e_next, s, s_next, middle, chord, *z), middle, chord

    def at_vertices(self, middle: Array, chord: Array) -> tuple[Array, Array]:
        """Integrals of P_l(u) times the weights of a and of b in w = (sin(theta - s) a + sin(s) b) / sin(theta)."""
        middle, chord = 0.5 * middle / self.half_cosine, 0.5 * chord * self.inverse_half_sine
        return middle - chord, middle + chord


def _boundary_terms(arcs: _Arcs, axes: Float[Array, "k 3"]) -> _Boundary:
    """The terms [e, k, p]."""
    d = axes.T[:, None, :, None]
    u0, u1 = (dot(x[:, :, None], d) for x in (arcs.start, arcs.end))
    rise = dot((arcs.tau_next - arcs.tau - (arcs.kappa_next - arcs.kappa)[None] * arcs.c[:, None])[:, :, None], d)
    half_sine, half_cosine, angle = arcs.half_sine, arcs.half_cosine[:, None], arcs.angle
    inverse_angle, inverse_half_sine = (arcs.inverse(x)[:, None] for x in (angle, half_sine))
    terms = _Boundary(
        u0, u1,
        slope=rise * inverse_angle,
        d_middle=0.5 * (u0 + u1) / half_cosine,
        d_chord=0.5 * rise * inverse_half_sine,
        weight=jnp.where(arcs.none, 0.5, half_sine * inverse_angle[:, 0])[:, None],
        length=angle[:, None], half_cosine=half_cosine, inverse_half_sine=inverse_half_sine,
    )  # fmt: skip
    return _Boundary(*(jnp.broadcast_to(x, u0.shape) for x in terms))


def _edges(terms: _Zonal | _Boundary) -> list:
    """The terms of each edge as plain vectors over axes and points, so that one kernel runs over memory in order."""
    return [type(terms)(*jax.lax.optimization_barrier([x[e].reshape(-1) for x in terms])) for e in range(len(terms.u0))]


def _flat(weights: Float[Array, "l k q"], like: Float[Array, "k p"]) -> Float[Array, "l kp"]:
    return jnp.broadcast_to(weights, (weights.shape[0], *like.shape)).reshape(weights.shape[0], -1)


def _edge_speeds(
    arcs: _Arcs, axes: Float[Array, "k 3"], d_axes: Array | SymbolicZero, dv: Array | SymbolicZero
) -> tuple[Array, Array]:
    """theta n . velocity of both ends of every edge [e, k or 1, p], in the frame that turns with each axis."""
    speeds = [jnp.zeros_like(arcs.angle)[:, None]] * 2
    if not isinstance(dv, SymbolicZero):
        speeds = [dot(arcs.normal, x)[:, None] for x in (dv, jnp.roll(dv, -1, 1))]
    if not isinstance(d_axes, SymbolicZero):
        turn = jnp.cross(axes, d_axes).T[:, None, :, None]
        ends = (arcs.start, arcs.end)
        speeds = [s - dot(turn, cross(x, arcs.normal)[:, :, None]) for s, x in zip(speeds, ends, strict=True)]
    return speeds[0], speeds[1]


def _sweep(
    step: Callable, state: tuple, degree: int, weights: Float[Array, "l kp"], edge: tuple, first: int = 2
) -> tuple:
    """`state` after steps of degree `first` ... `degree`, as straight code or, for high degrees, as a loop."""
    factors = _factors(first, degree, weights.dtype)
    if degree > _UNROLLED:
        body = lambda state, x: (step(state, *x, edge), None)
        return jax.lax.scan(body, state, (factors, weights[first:]))[0]
    for l in range(first, degree + 1):
        state = step(state, _Factors(*(f[l - first] for f in factors)), weights[l], edge)
    return state


def _sum_all(x: Array) -> Float[Array, " p"]:
    """Sum over all axes but the last: as a product with ones, since XLA turns sums into slow library calls."""
    x = x.reshape(-1, x.shape[-1])
    return (jnp.ones((1, x.shape[0]), x.dtype) @ x)[0]


def _sum_edges(x: Array) -> Array:
    """Sum over the first axis, written out for the same reason."""
    return functools.reduce(jnp.add, [x[i] for i in range(x.shape[0])])


def _arctan_tail(t2: Array) -> Array:
    """arctan(t)/t - 1 as a function of t^2, without cancellation."""
    small = t2 < 0.01
    x = jnp.where(small, t2, 0)
    series = jnp.zeros_like(x)
    for k in range(9, 0, -1):
        series = x * ((-1.0) ** k / (2 * k + 1) + series)
    t = jnp.sqrt(jnp.where(small, 1, t2))
    return jnp.where(small, series, jnp.arctan(t) / t - 1)
