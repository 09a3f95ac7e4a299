"""The recurrence in the degree for integrals of P_l(w . d), and that for cosine powers.

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

notation, beside the package's: q, dq = P_l(u) at a and the difference quotient (P_l(u1) - P_l(u0)) / theta; a letter
with `_c` belongs to the reference.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from shisd._numerics import dot
from shisd._typing import Array, Float
from shisd.domains.moments._edges import Arcs, Edges, Loop, arcs_of, sum_first, unpack


class Factors(NamedTuple):
    """The numbers in the recurrences for degree l, NumPy's where code is unrolled and JAX's in a loop."""

    up: Any  # (2l-1)/l
    back: Any  # (l-1)/l
    back2: Any  # ((l-1)/l)^2
    source: Any  # (2l-1)/l^2
    odd: Any  # 2l-1
    laplacian: Any  # 1/(l(l+1))
    next: Any  # 1/(l+1)


def factors_of(first: int, degree: int, dtype: jnp.dtype) -> Factors:
    """Of degrees `first` ... `degree`, on the host."""
    l = np.arange(first, degree + 1.0)
    odd = 2 * l - 1
    values = (odd / l, (l - 1) / l, ((l - 1) / l) ** 2, odd / l**2, odd, 1 / (l * (l + 1)), 1 / (l + 1))
    return Factors(*(x.astype(dtype) for x in values))


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

    def advance(self, point: _Point, n: Factors) -> _Point:
        """From degree l-1 to l: |P_l| of |u| by its differences in l."""
        step = n.back * point.step - n.up * self.gap * point.size
        size, sign = point.size + step, point.sign * self.sign
        return _Point(step, size, sign, sign * size, point.r, point.r0 + n.odd * point.p)


def _leading(x: Array) -> Array:
    """Half of the digits, of which products are exact.

    XLA makes the sign below again in each kernel that reads it, with fused multiplications in one and not in another.
    Of rounded products next to zero those came to different signs, and moments were wrong by any factor (jax 0.10.2).
    """
    form = jnp.finfo(x.dtype)
    return jax.lax.reduce_precision(x, form.nexp, (form.nmant - 1) // 2)


def reference(c: Array, d: Array) -> _Reference:
    sign = jnp.where(dot(_leading(d), _leading(c)) < 0, -1, 1).astype(c.dtype)
    offset = (d[0] - sign * c[0], d[1] - sign * c[1], d[2] - sign * c[2])
    gap = 0.5 * dot(offset, offset)
    return _Reference(sign * (1 - gap), sign, gap, offset)


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

    def advance(self, x: _State, c: _Point, n: Factors) -> _State:
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


def zonal_terms(edges: list[Edges], d: Array, c: _Reference) -> list[_Zonal]:
    """Of edges that follow each other, whose common vertices are projected once."""
    heights = [c.project(edge.tau, edge.kappa) for edge in edges]
    heights.append(c.project(edges[-1].tau_next, edges[-1].kappa_next))
    return [_zonal(edge, d, c, y0, y1) for edge, y0, y1 in zip(edges, heights[:-1], heights[1:], strict=True)]


def _zonal(edge: Edges, d: Array, c: _Reference, y0: Array, y1: Array) -> _Zonal:
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


def _all_edges(arcs: Arcs, axes: Float[Array, "k 3"]) -> tuple[Array, _Reference, Edges, "_Zonal"]:
    """T [k, p], and by edge, axis and polygon the reference [1, k, p], the edges [e, 1, p] and both [e, k, p]."""
    d = axes.T[:, None, :, None]
    c, edges = reference(arcs.c[:, None, None], d), unpack(Edges, arcs.edges[:, :, None])
    ends = c.project(edges.tau, edges.kappa), c.project(edges.tau_next, edges.kappa_next)
    return dot(arcs.total[:, None], d[:, 0]), c, edges, _zonal(edges, d, c, *ends)


def sweep(v: Loop, axes: Float[Array, "k 3"], degree: int) -> Float[Array, "l k p"]:
    total, c, _, x = _all_edges(arcs_of(v), axes)
    first = 0.5 * total
    if degree == 1:
        return first[None]

    def step(state: tuple[_Point, _State], n: Factors) -> tuple[tuple[_Point, _State], Array]:
        point, edges = state
        edges = x.advance(edges, point, n)
        point = c.advance(point, n)
        return (point, edges), (total * point.r[0] + sum_first(x.along * edges.s)) * n.laplacian

    _, rest = jax.lax.scan(step, (c.start(), x.start()), factors_of(2, degree, v.dtype))
    return jnp.concatenate([first[None], rest])


def powers(axes: Float[Array, "k 3"], v: Loop, solid_angle: Float[Array, " p"], order: int) -> Float[Array, "n k p"]:
    """Integrals of (w . axes[k])^n for n = 0 ... order (Arvo 1995).

    n F_n = (n-1) (1 - g^2) F_{n-2} - [u^(n-1) u'] along the edges, (n+1) A_n = (n-1) A_{n-2} + sum of g F_{n-1}.
    """
    total, _, edges, x = _all_edges(arcs_of(v), axes)
    slope = x.end_slope + edges.t * x.both  # u'(a)

    def step(state: tuple[Array, ...], n: Array) -> tuple[tuple[Array, ...], Array]:
        f0, f, a0, a, p0, p1 = state  # F_n / theta and A_n of n-2 and n-1, u^(n-1) at the ends
        ends = jnp.where(edges.over_angle == 0, -p0 * x.u0, (p1 * x.end_slope - p0 * slope) * edges.over_angle)
        following = ((n - 1) * a0 + sum_first(x.along * f)) / (n + 1)
        return (f, ((n - 1) * (1 - x.g2) * f0 - ends) / n, a, following, p0 * x.u0, p1 * x.u1), following

    a0, a = jnp.broadcast_to(solid_angle[None], total.shape), 0.5 * total
    start = (jnp.ones_like(x.u0), x.mean_u, a0, a, x.u0, x.u1)
    _, rest = jax.lax.scan(step, start, jnp.arange(2, order + 1, dtype=v.dtype))
    return jnp.concatenate([jnp.stack([a0, a])[: order + 1], rest])
