"""Weighted sums of moments, without the moments: the recurrences in vector registers, one axis after the other."""

import functools
import math
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from shisd._lanes import in_lanes
from shisd._numerics import dot
from shisd._typing import Array, Float
from shisd.domains.moments._derivatives import at_vertices, boundary, moments, speeds
from shisd.domains.moments._edges import Edges, Loop, Spans, arcs_of, spans_of, sum_first, unpack
from shisd.domains.moments._recurrence import Factors, factors_of, reference, zonal_terms

Value = TypeVar("Value")

_OPERATIONS = 1600  # in one kernel: without the limit a lamp at degree 8 takes twice as long (jax 0.10.2)


def fold(
    weights: Float[Array, "k l q"], axes: Float[Array, "k 3"], v: Float[Array, "3 s r"], degree: int, spare: int = 0
) -> Float[Array, " p"]:
    """sum over k and l >= 1 of weights[k, l] l (l+1) I_l(axes[k]) for every polygon. Weights or loops may be shared.

    The last `spare` edges cost time only if one of them has a length, in any polygon.
    """
    if degree == 0:
        return _zero(weights, v)
    if _edges_at_once(degree) > 0:
        return _fold(weights, axes, v, degree, spare)
    return _sum_all(moments(axes, v, degree) * _by_degree(weights))


def _by_degree(weights: Float[Array, "k l q"]) -> Float[Array, "bands k q"]:
    """Weights of I_l, from l = 1 on."""
    l = np.arange(1, weights.shape[1])
    return jnp.swapaxes(weights, 0, 1)[1:] * jnp.asarray(l * (l + 1), weights.dtype)[:, None, None]


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def _fold(weights: Array, axes: Array, v: Float[Array, "3 s q"], degree: int, spare: int) -> Float[Array, " p"]:
    return in_lanes(functools.partial(_fold_loops, degree=degree, spare=spare), (weights, v), (axes,))


def _fold_loops(weights: Array, v: Float[Array, "3 s q"], axes: Array, degree: int, spare: int) -> Float[Array, " p"]:
    arcs = arcs_of(v)
    return _fold_edges(weights, axes, arcs.c, arcs.total, arcs.edges, degree, spare)


@functools.partial(jax.jit, static_argnames=("degree", "spare"))  # so that it is traced once
def _fold_edges(
    weights: Array, axes: Array, center: Array, total: Array, edges: Array, degree: int, spare: int
) -> Array:
    """Axes in turn; for each, edges and degrees are straight code over plain vectors of points.

    That becomes one kernel in vector registers. Arrays over axes and points, or more than a few operands, would make it
    scalar code, since LLVM could not tell that they do not overlap. Kind beyond those of one kernel, and spare ones,
    are further turns of it, left out where no edge has a length.
    """
    factors = factors_of(2, degree, edges.dtype)

    def group(value: Array, edges: Float[Array, "rows p"], share: Array) -> Array:
        def axis(value: Array, d: Array, w: Array) -> Array:
            c = reference(center, d)
            terms = zonal_terms([unpack(Edges, edge) for edge in jnp.split(edges, size)], d, c)
            point, states = c.start(), [t.start() for t in terms]
            sums, sum_c = [jnp.zeros_like(c.gap) for _ in terms], w[1]
            for l in range(2, degree + 1):
                n = Factors(*(f[l - 2] for f in factors))
                states = [t.advance(s, point, n) for t, s in zip(terms, states, strict=True)]
                point = c.advance(point, n)
                sums = [x + w[l] * s.s for x, s in zip(sums, states, strict=True)]
                sum_c += w[l] * point.r
            change = dot(share, d) * sum_c + sum(t.along * x for t, x in zip(terms, sums, strict=True))
            return value + change

        return _for_axes(axis, value, axes, weights)

    value = _zero(weights, total)
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

    used = jnp.any((unpack(Edges, edges).over_angle != 0).reshape(groups, -1), axis=1)
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
        *weights_of_ends, normal = in_lanes(functools.partial(_fold_boundaries, degree=degree), (weights, v), (axes,))
        for speed, weight in zip(speeds(normal, dv), weights_of_ends, strict=True):
            change -= sum_first(speed * weight)
    return value, change


_fold.defjvp(_fold_jvp, symbolic_zeros=True)


def _fold_boundaries(weights: Array, v: Float[Array, "3 s q"], axes: Array, degree: int) -> tuple[Array, Array, Loop]:
    spans = spans_of(v)
    return *_fold_boundary(weights, axes, spans, degree), unpack(Spans, spans).normal


@functools.partial(jax.jit, static_argnames="degree")
def _fold_boundary(weights: Array, axes: Array, spans: Float[Array, "rows e p"], degree: int) -> tuple[Array, Array]:
    """sum over k and l of weights[k, l] l (l+1) times the integrals of `at_vertices`, [e, p] each.

    Both sums are the parts of one complex number, and so come out of one loop.
    """
    factors = factors_of(1, degree, spans.dtype)
    zero = _zero(weights, spans)

    def edge(span: Float[Array, "rows p"]) -> Array:
        def axis(total: Array, d: Array, w: Array) -> Array:
            terms = boundary(unpack(Spans, span), d)
            state, middle, chord = terms.start(), zero, zero
            for l in range(1, degree + 1):
                state = terms.advance(state, Factors(*(f[l - 1] for f in factors)))
                w_l = l * (l + 1.0) * w[l]
                middle, chord = middle + w_l * state.middle, chord + w_l * state.chord
            return total + jax.lax.complex(middle, chord)

        return _for_axes(axis, jax.lax.complex(zero, zero), axes, weights)

    def edge_if_any(span: Float[Array, "rows p"]) -> Array:
        nothing = lambda _: jax.lax.complex(zero, zero)
        return jax.lax.cond(jnp.any(unpack(Spans, span).over_angle != 0), edge, nothing, span)

    sums = jax.lax.map(edge_if_any, jnp.moveaxis(spans, 1, 0))
    return at_vertices(unpack(Spans, spans), sums.real, sums.imag)


def _zero(weights: Array, points: Array) -> Float[Array, " p"]:
    return jnp.zeros(np.broadcast_shapes(weights.shape[-1:], points.shape[-1:]), points.dtype)


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


def _sum_all(x: Array) -> Float[Array, " p"]:
    """Sum over all axes but the last."""
    return jnp.sum(x.reshape(-1, x.shape[-1]), axis=0)
