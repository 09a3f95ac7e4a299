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

The derivative of an integral in the vertices is an integral along the moving edges. It has a recurrence of its own and
is exact where vertices coincide. That in the axes is the derivative of the differences: as an integral along the edges,
which turn back, it would lose a factor 1/h again.

Vertices are unit to rounding only, which tilts the sum a + b of nearly opposite ones; `sides` sets it right, and what
is a sum over the ends of an edge near pi is taken from it.

layout: polygons are v[x y z, vertex, p], points p last as vector lanes; axes d[k, x y z]. What belongs to edges is
[e, p] or [x y z, e, p]; to one edge [p] or [x y z, p], or, for all axes at once, [e, 1, p] or [x y z, e, 1, p].
notation: alpha = a - c = tau - kappa c with tau at right angles to c; t = tan(theta/2); q, dq = P_l(u) at a and the
difference quotient (P_l(u1) - P_l(u0)) / theta; a letter with `_c` belongs to the reference.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from shisd._numerics import arctan2, cross, dot, safe_sqrt
from shisd._typing import Array, Float

Loop = Float[Array, "3 s p"]
Edges = TypeVar("Edges", "_Edges", "_Spans")
Value = TypeVar("Value")

_OPERATIONS = 1600  # in one kernel: XLA cuts longer ones up, which makes them scalar code


def fold(
    weights: Float[Array, "k l q"], axes: Float[Array, "k 3"], v: Loop, degree: int, spare: int = 0
) -> Float[Array, " p"]:
    """sum over k and l >= 1 of weights[k, l] l (l+1) I_l(axes[k]) for every polygon. Weights may be shared (q = 1).

    The last `spare` edges cost time only if one of them has a length, in any polygon.
    """
    if degree == 0:
        return jnp.zeros(v.shape[2:], v.dtype)
    if _edges_at_once(degree) > 0:
        return _fold(weights, axes, v, degree, spare)
    return _sum_all(moments(axes, v, degree) * _by_degree(weights))


def _by_degree(weights: Float[Array, "k l q"]) -> Float[Array, "bands k q"]:
    """Weights of I_l, from l = 1 on."""
    l = np.arange(1, weights.shape[1])
    return jnp.swapaxes(weights, 0, 1)[1:] * jnp.asarray(l * (l + 1), weights.dtype)[:, None, None]


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def _fold(weights: Array, axes: Array, v: Loop, degree: int, spare: int) -> Float[Array, " p"]:
    arcs = _arcs(v)
    return _fold_edges(weights, axes, arcs.c, arcs.total, arcs.edges, degree, spare)


@functools.partial(jax.jit, static_argnames=("degree", "spare"))  # so that it is traced once
def _fold_edges(
    weights: Array, axes: Array, center: Array, total: Array, edges: Array, degree: int, spare: int
) -> Array:
    """Axes in turn; for each, edges and degrees are straight code over plain vectors of points.

    That becomes one kernel in vector registers. Arrays over axes and points, or more than a few operands, would make it
    scalar code, since LLVM could not tell that they do not overlap. Edges beyond those of one kernel, and spare ones,
    are further turns of it, left out where no edge has a length.
    """
    factors = _factors(2, degree, edges.dtype)

    def group(value: Array, edges: Float[Array, "rows p"], share: Array) -> Array:
        def axis(value: Array, d: Array, w: Array) -> Array:
            c = _reference(center, d)
            terms = _zonal_terms([_unpack(_Edges, edge) for edge in jnp.split(edges, size)], d, c)
            point, states = c.start(), [t.start() for t in terms]
            sums, sum_c = [jnp.zeros_like(c.gap) for _ in terms], w[1]
            for l in range(2, degree + 1):
                n = _Factors(*(f[l - 2] for f in factors))
                states = [t.advance(s, point, n) for t, s in zip(terms, states, strict=True)]
                point = c.advance(point, n)
                sums = [x + w[l] * s.s for x, s in zip(sums, states, strict=True)]
                sum_c += w[l] * point.r
            change = dot(share, d) * sum_c + sum(t.along * x for t, x in zip(terms, sums, strict=True))
            return value + change

        return _for_axes(axis, value, axes, weights)

    value = jnp.zeros_like(total[0])
    usual = edges.shape[1] - spare
    size = math.ceil(usual / math.ceil(usual / _edges_at_once(degree)))
    groups = math.ceil(usual / size) + math.ceil(spare / size)
    none = jnp.zeros((edges.shape[0], groups * size - edges.shape[1], edges.shape[2]), edges.dtype)
    edges = jnp.concatenate([edges, none], axis=1)
    parts = jnp.moveaxis(edges, 1, 0).reshape(groups, -1, edges.shape[2])  # rows of one array: others are copied
    if groups == 1:
        return group(value, parts[0], total)

    def group_if_any(value: Array, part: tuple[Array, Array, Array]) -> tuple[Array, None]:
        used, edges, share = part
        return jax.lax.cond(used, group, lambda value, *_: value, value, edges, share), None

    used = jnp.any((_unpack(_Edges, edges).over_angle != 0).reshape(groups, -1), axis=1)
    shares = jnp.concatenate([total[None], jnp.zeros((groups - 1, *total.shape), total.dtype)])
    return jax.lax.scan(group_if_any, value, (used, parts, shares))[0]


def _edges_at_once(degree: int) -> int:
    return (_OPERATIONS // degree - 7) // 18  # a step takes 18 operations for each edge, and 7 for all


def _fold_jvp(degree, spare, primals, tangents):
    (weights, axes, v), (d_weights, d_axes, dv) = primals, tangents
    value = _fold(weights, axes, v, degree, spare)
    change = jnp.zeros_like(value)
    if not isinstance(d_weights, SymbolicZero):
        change += _sum_all(moments(axes, v, degree) * _by_degree(d_weights))
    if not isinstance(d_axes, SymbolicZero):
        turned = jax.jvp(lambda a: moments(a, v, degree), (axes,), (d_axes,))[1]
        change += _sum_all(turned * _by_degree(weights))
    if not isinstance(dv, SymbolicZero):
        spans = _spans(v)
        at_vertices = _fold_boundary(weights, axes, spans, degree)
        for speed, weight in zip(_speeds(_unpack(_Spans, spans), dv), at_vertices, strict=True):
            change -= _sum_first(speed * weight)
    return value, change


_fold.defjvp(_fold_jvp, symbolic_zeros=True)


@functools.partial(jax.jit, static_argnames="degree")
def _fold_boundary(weights: Array, axes: Array, spans: Float[Array, "rows e p"], degree: int) -> tuple[Array, Array]:
    """sum over k and l of weights[k, l] l (l+1) times the integrals of `_at_vertices`, [e, p] each.

    Both sums are the parts of one complex number: of two results XLA would make two kernels, each with all the work.
    """
    factors = _factors(1, degree, spans.dtype)
    zero = jnp.zeros_like(spans[0, 0])

    def edge(span: Float[Array, "rows p"]) -> Array:
        def axis(total: Array, d: Array, w: Array) -> Array:
            terms = _boundary(_unpack(_Spans, span), d)
            state, middle, chord = terms.start(), zero, zero
            for l in range(1, degree + 1):
                state = terms.advance(state, _Factors(*(f[l - 1] for f in factors)))
                w_l = l * (l + 1.0) * w[l]
                middle, chord = middle + w_l * state.middle, chord + w_l * state.chord
            return total + jax.lax.complex(middle, chord)

        return _for_axes(axis, jax.lax.complex(zero, zero), axes, weights)

    def edge_if_any(span: Float[Array, "rows p"]) -> Array:
        nothing = lambda _: jax.lax.complex(zero, zero)
        return jax.lax.cond(jnp.any(_unpack(_Spans, span).over_angle != 0), edge, nothing, span)

    sums = jax.lax.map(edge_if_any, jnp.moveaxis(spans, 1, 0))
    return _at_vertices(_unpack(_Spans, spans), sums.real, sums.imag)


def _for_axes(body: Callable, value: Value, axes: Array, weights: Array) -> Value:
    """body(value, d, w) for all axes in turn.

    Axis and weights are fetched a step ahead: the body then reads arrays, not rows at an address that it has to find,
    which would keep LLVM from vector code.
    """
    fetch = lambda k: (axes[k], weights[k])

    def step(state: tuple, following: Array) -> tuple[tuple, None]:
        value, (d, w) = state
        return (body(value, d, w), fetch(following)), None

    count = axes.shape[0]
    following = jnp.arange(1, count + 1, dtype=jnp.int32) % count
    return jax.lax.scan(step, (value, fetch(0)), following)[0][0]


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def moments(axes: Float[Array, "k 3"], v: Loop, degree: int) -> Float[Array, "l k p"]:
    """I_l(axes[k]) for l = 1 ... degree."""
    return _sweep(axes, v, degree)


def _sweep(axes: Float[Array, "k 3"], v: Loop, degree: int) -> Float[Array, "l k p"]:
    total, c, _, x = _all_edges(_arcs(v), axes)
    first = 0.5 * total
    if degree == 1:
        return first[None]

    def step(state: tuple[_Point, _State], n: _Factors) -> tuple[tuple[_Point, _State], Array]:
        point, edges = state
        edges = x.advance(edges, point, n)
        point = c.advance(point, n)
        return (point, edges), (total * point.r[0] + _sum_first(x.along * edges.s)) * n.laplacian

    _, rest = jax.lax.scan(step, (c.start(), x.start()), _factors(2, degree, v.dtype))
    return jnp.concatenate([first[None], rest])


def _moments_jvp(degree, primals, tangents):
    (axes, v), (d_axes, dv) = primals, tangents
    change = None
    if isinstance(d_axes, SymbolicZero):
        values = moments(axes, v, degree)
    else:  # of differences, like the values: the lines that the vertices turn along would lose a factor of the size
        values, change = jax.jvp(lambda a: _sweep(a, v, degree), (axes,), (d_axes,))
    if not isinstance(dv, SymbolicZero):
        moved = _moved(axes, v, dv, degree)
        change = moved if change is None else change + moved
    return values, jnp.zeros_like(values) if change is None else change


def _moved(axes: Float[Array, "k 3"], v: Loop, dv: Loop, degree: int) -> Float[Array, "l k p"]:
    """Changes of the moments with the vertices."""
    packed = _spans(v)
    start, end = (x[:, None] for x in _speeds(_unpack(_Spans, packed), dv))
    spans = _unpack(_Spans, packed[:, :, None])
    terms = _boundary(spans, axes.T[:, None, :, None])

    def step(state: _BoundaryState, n: _Factors) -> tuple[_BoundaryState, Array]:
        state = terms.advance(state, n)
        a, b = _at_vertices(spans, state.middle, state.chord)
        return state, _sum_first(start * a + end * b)

    return -jax.lax.scan(step, terms.start(), _factors(1, degree, v.dtype))[1]


moments.defjvp(_moments_jvp, symbolic_zeros=True)


def powers(axes: Float[Array, "k 3"], v: Loop, solid_angle: Float[Array, " p"], order: int) -> Float[Array, "n k p"]:
    """Integrals of (w . axes[k])^n for n = 0 ... order (Arvo 1995).

    n F_n = (n-1) (1 - g^2) F_{n-2} - [u^(n-1) u'] along the edges, (n+1) A_n = (n-1) A_{n-2} + sum of g F_{n-1}.
    """
    total, _, edges, x = _all_edges(_arcs(v), axes)
    slope = x.end_slope + edges.t * x.both  # u'(a)

    def step(state: tuple[Array, ...], n: Array) -> tuple[tuple[Array, ...], Array]:
        f0, f, a0, a, p0, p1 = state  # F_n / theta and A_n of n-2 and n-1, u^(n-1) at the ends
        ends = jnp.where(edges.over_angle == 0, -p0 * x.u0, (p1 * x.end_slope - p0 * slope) * edges.over_angle)
        following = ((n - 1) * a0 + _sum_first(x.along * f)) / (n + 1)
        return (f, ((n - 1) * (1 - x.g2) * f0 - ends) / n, a, following, p0 * x.u0, p1 * x.u1), following

    a0, a = jnp.broadcast_to(solid_angle[None], total.shape), 0.5 * total
    start = (jnp.ones_like(x.u0), x.mean_u, a0, a, x.u0, x.u1)
    _, rest = jax.lax.scan(step, start, jnp.arange(2, order + 1, dtype=v.dtype))
    return jnp.concatenate([jnp.stack([a0, a])[: order + 1], rest])


class _Factors(NamedTuple):
    """The numbers in the recurrences for degree l, NumPy's where code is unrolled and JAX's in a loop."""

    up: Any  # (2l-1)/l
    back: Any  # (l-1)/l
    back2: Any  # ((l-1)/l)^2
    source: Any  # (2l-1)/l^2
    odd: Any  # 2l-1
    laplacian: Any  # 1/(l(l+1))
    next: Any  # 1/(l+1)


def _factors(first: int, degree: int, dtype: jnp.dtype) -> _Factors:
    """Of degrees `first` ... `degree`, on the host."""
    l = np.arange(first, degree + 1.0)
    odd = 2 * l - 1
    values = (odd / l, (l - 1) / l, ((l - 1) / l) ** 2, odd / l**2, odd, 1 / (l * (l + 1)), 1 / (l + 1))
    return _Factors(*(x.astype(dtype) for x in values))


# ---- edges


class _Edges(NamedTuple):
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


class _Spans(NamedTuple):
    """Edges a -> b, as `_Boundary` needs them."""

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


_VECTORS = {"tau", "tau_next", "d_tau", "normal", "start", "end", "chord", "middle"}


def _pack(edges: _Edges | _Spans) -> Float[Array, "rows e p"]:
    """One array, kept as such: XLA would make its parts again for every axis."""
    edges = jax.lax.optimization_barrier(edges)
    rows = [x if name in _VECTORS else x[None] for name, x in edges._asdict().items()]
    return jax.lax.optimization_barrier(jnp.concatenate(rows))


def _unpack(kind: type[Edges], rows: Array) -> Edges:
    parts, used = [], 0
    for name in kind._fields:
        size = 3 if name in _VECTORS else 1
        parts.append(rows[used : used + size] if size == 3 else rows[used])
        used += size
    return kind(*parts)


class _Arcs(NamedTuple):
    edges: Float[Array, "rows e p"]
    c: Float[Array, "3 p"]  # the reference vertex
    total: Float[Array, "3 p"]  # the sum of theta n over the edges


def _arcs(v: Loop) -> _Arcs:
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
    edges = _Edges(
        tau, tau_next, d_tau, middle, normal, kappa, kappa_next, d_kappa,
        over_angle=_over(2 * t * part, none), over_sine=_over(2 * t / (1 + t2), none),
        t=t, over_t=_over(t, none), ratio_1=ratio_1, mean=0.5 / part, excess=0.5 * tail / part,
    )  # fmt: skip
    total = _sum_first(jnp.moveaxis(parts, 1, 0))
    return _Arcs(_pack(edges), *jax.lax.optimization_barrier((c[:, 0], total)))


def _spans(v: Loop) -> Float[Array, "rows e p"]:
    chord, middle = sides(v)
    t2, _, part, normal = _turns(v, chord, middle)
    none, angle, half_sine = _none(t2), 2 * safe_sqrt(t2) * part, 0.5 * safe_sqrt(dot(chord, chord))
    over_half_cosine = 2 / jnp.sqrt(dot(middle, middle))
    spans = _Spans(
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


# ---- the recurrence for I_l


class _Point(NamedTuple):
    """P_{l-1}(u_c), by its size and sign, P_{l-2}' and P_{l-1}'."""

    step: Array  # of the size, from degree l-2
    size: Array
    sign: Array
    p: Array
    r0: Array
    r: Array


class _Reference(NamedTuple):
    """An axis, as the reference vertex sees it: exact also where it is near c or -c."""

    u: Array  # c . d
    sign: Array
    gap: Array  # 1 - |u|
    offset: tuple[Array, Array, Array]  # d - sign c

    def project(self, tau: Array, kappa: Array) -> Array:
        """d . (tau - kappa c): the height of a vertex over c, or a difference of heights."""
        return dot(tau, self.offset) - kappa * self.u

    def start(self) -> _Point:
        size = 1 - self.gap
        return _Point(-self.gap, size, self.sign, self.u, jnp.zeros_like(size), jnp.ones_like(size))

    def advance(self, point: _Point, n: _Factors) -> _Point:
        """From degree l-1 to l: |P_l| of |u| by its differences in l."""
        step = n.back * point.step - n.up * self.gap * point.size
        size, sign = point.size + step, point.sign * self.sign
        return _Point(step, size, sign, sign * size, point.r, point.r0 + n.odd * point.p)


def _reference(c: Array, d: Array) -> _Reference:
    sign = jnp.where(dot(d, c) < 0, -1, 1).astype(c.dtype)
    offset = (d[0] - sign * c[0], d[1] - sign * c[1], d[2] - sign * c[2])
    gap = 0.5 * dot(offset, offset)
    return _Reference(sign * (1 - gap), sign, gap, offset)


def _all_edges(arcs: _Arcs, axes: Float[Array, "k 3"]) -> tuple[Array, _Reference, _Edges, "_Zonal"]:
    """T [k, p], and by edge, axis and polygon the reference [1, k, p], the edges [e, 1, p] and both [e, k, p]."""
    d = axes.T[:, None, :, None]
    c, edges = _reference(arcs.c[:, None, None], d), _unpack(_Edges, arcs.edges[:, :, None])
    ends = c.project(edges.tau, edges.kappa), c.project(edges.tau_next, edges.kappa_next)
    return dot(arcs.total[:, None], d[:, 0]), c, edges, _zonal(edges, d, c, *ends)


class _State(NamedTuple):
    """Differences to the reference of P_l(u) at a, its quotient, E_l and D_l over theta, at degrees l-2 and l-1."""

    q0: Array
    q: Array
    dq0: Array
    dq: Array
    e0: Array
    e: Array
    s0: Array
    s: Array


class _Zonal(NamedTuple):
    """What the recurrence for I_l needs of an edge and an axis."""

    u0: Array
    u1: Array
    y0: Array  # u0 - u_c
    y1: Array
    both: Array  # u0 + u1
    slope: Array  # (u1 - u0) / theta
    end_slope: Array  # u' at b
    mean_u: Array  # E_1 / theta
    g2: Array
    along: Array  # G = theta g
    of_value: Array  # coefficients, in the difference of [u' P_l] + g^2 D_l to its value at c, of P_l(u_c) ...
    of_derivative: Array  # ... and of P_l'(u_c)

    def start(self) -> _State:
        zero = jnp.zeros_like(self.u0)
        return _State(zero, self.y0, zero, zero, zero, -self.of_value, zero, zero)

    def advance(self, x: _State, c: _Point, n: _Factors) -> _State:
        """From degree l-1 to l. The edge adds G (D_l/theta + P_l'(u_c)) to l (l+1) I_l."""
        ends = (
            self.end_slope * x.dq - self.mean_u * x.q + self.g2 * x.s + self.of_value * c.p + self.of_derivative * c.r
        )
        return _State(
            x.q, n.up * (self.u0 * x.q + self.y0 * c.p) - n.back * x.q0,
            x.dq, n.up * (self.u1 * x.dq + self.slope * (x.q + self.y1 * c.r)) - n.back * x.dq0,
            x.e, n.back2 * x.e0 - n.source * ends,
            x.s, x.s0 + n.odd * x.e,
        )  # fmt: skip


def _zonal_terms(edges: list[_Edges], d: Array, c: _Reference) -> list[_Zonal]:
    """Of edges that follow each other, whose common vertices are projected once."""
    heights = [c.project(edge.tau, edge.kappa) for edge in edges]
    heights.append(c.project(edges[-1].tau_next, edges[-1].kappa_next))
    return [_zonal(edge, d, c, y0, y1) for edge, y0, y1 in zip(edges, heights[:-1], heights[1:], strict=True)]


def _zonal(edge: _Edges, d: Array, c: _Reference, y0: Array, y1: Array) -> _Zonal:
    u0, u1, rise = c.u + y0, c.u + y1, c.project(edge.d_tau, edge.d_kappa)
    slope, both, along = rise * edge.over_angle, dot(edge.middle, d), dot(edge.normal, d)
    short = edge.t < 1
    end_slope = jnp.where(short, rise * edge.over_sine - u1 * edge.t, u1 * edge.over_t - both * edge.over_sine)
    below_slope = jnp.where(short, u1 * edge.t - slope * edge.ratio_1, slope - end_slope)
    return _Zonal(
        u0, u1, y0, y1, both, slope, end_slope,
        mean_u=both * edge.mean,
        g2=jnp.where(edge.over_angle == 0, 1 - u1 * u1, (along * edge.over_angle) ** 2),
        along=along,
        of_value=both * edge.excess - 0.5 * (y0 + y1),
        of_derivative=end_slope * below_slope - y1 * (u1 + c.u),
    )  # fmt: skip


# ---- the recurrence for its derivatives


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

    def advance(self, x: _BoundaryState, n: _Factors) -> _BoundaryState:
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


def _boundary(span: _Spans, d: Array) -> _Boundary:
    u0, u1, rise = dot(span.start, d), dot(span.end, d), dot(span.chord, d)
    return _Boundary(
        u0, u1,
        slope=rise * span.over_angle,
        d_middle=0.5 * dot(span.middle, d) * span.over_half_cosine,
        d_chord=0.5 * rise * span.over_half_sine,
        weight=jnp.where(span.over_angle == 0, 0.5, span.half_sine * span.over_angle),
        angle=span.angle, half_cosine=1 / span.over_half_cosine,
    )  # fmt: skip


def _at_vertices(span: _Spans, middle: Array, chord: Array) -> tuple[Array, Array]:
    """Integrals of P_l(u) times the weights of a and of b in w = (sin(theta - s) a + sin(s) b) / sin(theta)."""
    middle, chord = 0.5 * middle * span.over_half_cosine, 0.5 * chord * span.over_half_sine
    return middle - chord, middle + chord


def _speeds(spans: _Spans, dv: Loop) -> tuple[Array, Array]:
    """theta n . velocity of both ends of every edge, [e, p]."""
    return dot(spans.normal, dv), dot(spans.normal, jnp.roll(dv, -1, 1))


def _sum_all(x: Array) -> Float[Array, " p"]:
    """Sum over all axes but the last: as a product with ones, since XLA turns sums into slow library calls."""
    x = x.reshape(-1, x.shape[-1])
    return (jnp.ones((1, x.shape[0]), x.dtype) @ x)[0]


def _sum_first(x: Array) -> Array:
    """Sum over the first axis, written out for the same reason."""
    return functools.reduce(jnp.add, [x[i] for i in range(x.shape[0])])


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
