"""A material itself, at Gauss points on a light: for smooth materials under lamps the cheapest way to some per mille.

What a light shows above the horizon is a fan of quadrilaterals between unit vertices. Over the bilinear patch x(u, v)
between four of them

    integral of f = integral of f(x / |x|) x . (x_u x x_v) / |x|^3 du dv,

which Gauss-Legendre rules take in u and v. Where a quadrilateral is not convex its patch leaves it, and comes back with
the other sign: the integral is that over the outline. Unit vertices, and not those of the light, keep |x| alike where
one end of the light is near and the other far.

When vertices move, an edge x(t) = a + t (b - a) sweeps dx . (a x b) / |x|^3 dt of solid angle. The integral changes by
that times f(x / |x|), over all edges (Reynolds' transport theorem): values of f only, along lines.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from shisd import _checks
from shisd._lanes import in_lanes, kernel_takes
from shisd._module import Module
from shisd._numerics import cross, dot, times
from shisd._typing import Array, Float
from shisd.domains.internal import Loop, on_sphere
from shisd.models import AbstractBrdf

Result = TypeVar("Result")
Patch = tuple[Array, Array, Array, Array]  # a component of x at (0, 0), its changes with u and v, and with both


class Quadrature(Module):
    """A material under polygons and portals by Gauss points on them, at which the model itself is evaluated.

    Arguments: `brdf`; static `order`, points along each side of a quadrilateral: a light of S points has order^2 for
    every two of its points beyond two, and half as many again where the horizon cuts it.
    It stands in a `Material` as `lamps`, or goes to `shade` as it is. The error is that of the rule: it falls
    exponentially with the order, the slower the sharper the lobe and the nearer the light. There is no other: nothing
    is expanded, and nothing tabulated.
    Derivatives: in the light's points, positions and frames that of the integral, as the model at points of the edges;
    it has an error of its own, smaller than that of the rule's derivative (a wall that the horizon cuts, alpha 0.5,
    order 4: 8e-3 for 1.6e-1). In views and the model, that of the rule. All orders, both modes. A gradient in
    the lamp takes 4 times the value, in everything 9 times (0.21, 0.85 and 1.9 us a point: order 4, a panel, GGX).
    Cost: a model that is arithmetic alone is part of one kernel, 3 to 4 times faster than one that looks tables up or
    multiplies matrices.
    """

    brdf: AbstractBrdf
    order: int = eqx.field(static=True)
    isotropic: bool = eqx.field(static=True)

    def __init__(self, brdf: AbstractBrdf, order: int = 4):
        if not isinstance(brdf, AbstractBrdf):
            raise ValueError(f"`brdf` must be a models.AbstractBrdf; got {type(brdf).__name__}.")
        self.brdf, self.order = brdf, _checks.integer("order", order, 1)
        self.isotropic = brdf.isotropic

    @property
    def colour(self) -> tuple[int, ...]:
        direction = jax.ShapeDtypeStruct((3,), np.float32)
        return jax.eval_shape(self.brdf.value, direction, direction).shape


def reflected(
    material: Quadrature, view: Float[Array, "3 p"], w: Float[Array, "3 p"]
) -> Float[Array, "*colour p"]:
    """What goes towards local views of unit light from local directions, for each solid angle."""
    return jax.vmap(material.brdf.value_cosine, (1, 1), -1)(w, view)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 4, 5))
def integrate(
    function: Callable, shared: Any, own: tuple[Array, ...], v: Loop, order: int, center: bool
) -> Float[Array, "*colour p"]:
    """The integral of function(shared, own, w) over every loop of unit vertices, in a fan from the first of them.

    Or, with `center`, from a direction amid them, which outlines up to the whole hemisphere need. `own` arrays are
    [..., p].
    """
    return _in_kernel(lambda f, v: _over_area(f, v, order, center), function, shared, own, v)


def _integrate_jvp(function: Callable, order: int, center: bool, primals: tuple, tangents: tuple):
    """In the inputs that of the rule, in the vertices that of the integral."""
    (shared, own, v), (*d_inputs, dv) = primals, tangents
    over_area = lambda f, v: _over_area(f, v, order, center)
    leaves, form = jax.tree.flatten((shared, own))
    moves = {i: d for i, d in enumerate(jax.tree.leaves(d_inputs)) if not isinstance(d, SymbolicZero)}

    def area(moved: dict[int, Array]) -> Array:
        shared, own = form.unflatten([moved.get(i, leaf) for i, leaf in enumerate(leaves)])
        return _in_kernel(over_area, function, shared, own, v)

    value, change = jax.jvp(area, ({i: leaves[i] for i in moves},), (moves,))
    if not isinstance(dv, SymbolicZero):
        inward = cross(v, jnp.roll(v, -1, 1))
        at_ends = _in_kernel(lambda f, v: _over_edges(f, v, order), function, shared, own, v)
        for weights, by in zip(at_ends, (dv, jnp.roll(dv, -1, 1)), strict=True):
            swept = dot(inward, by)
            change -= functools.reduce(jnp.add, [times(weights[i], swept[i]) for i in range(v.shape[1])])
    return value, change


integrate.defjvp(_integrate_jvp, symbolic_zeros=True)


def _in_kernel(
    rule: Callable[[Callable, Loop], Result], function: Callable, shared: Any, own: tuple[Array, ...], v: Loop
) -> Result:
    """rule(w -> function(shared, own, w), v), in one kernel if the function can be in it: 3 to 4 times faster."""
    leaves, form = jax.tree.flatten(shared)
    count = max(a.shape[-1] for a in (v, *own))

    def of_lanes(v: Loop, *inputs: Array) -> Result:
        mine, leaves = inputs[: len(own)], inputs[len(own) :]
        most = max(a.shape[-1] for a in (v, *mine))
        v, *mine = (jnp.broadcast_to(a, (*a.shape[:-1], most)) for a in (v, *mine))
        return rule(functools.partial(function, form.unflatten(leaves), tuple(mine)), v)

    like = lambda a: jax.ShapeDtypeStruct((*a.shape[:-1], count), a.dtype)
    if kernel_takes(function, shared, tuple(map(like, own)), like(v[:, 0])):
        return in_lanes(of_lanes, (v, *own), tuple(leaves))
    return of_lanes(v, *own, *leaves)


def _over_edges(function: Callable, v: Loop, order: int) -> tuple[Array, Array]:
    """Integrals [s, *colour, p] of f(x / |x|) / |x|^3 (1 - t) and of f(x / |x|) / |x|^3 t along edges, dt.

    Times what the normals a x b make of the speeds of their ends, these are the sweep.
    """
    t, weight = np.polynomial.legendre.leggauss(order)
    rule = jnp.asarray(np.stack([(t + 1) / 2, weight / 2], axis=1), v.dtype)
    edges = jnp.moveaxis(v, 1, 0), jnp.moveaxis(jnp.roll(v, -1, 1) - v, 1, 0)
    zero = jnp.zeros(jax.eval_shape(function, v[:, 0]).shape, v.dtype)

    def of_edge(_: None, edge: tuple[Array, Array]) -> tuple[None, tuple[Array, Array]]:
        start, chord = edge

        def node(totals: tuple[Array, Array], row: Array) -> tuple[tuple[Array, Array], None]:
            t, weight = row
            x = start + t * chord
            square = dot(x, x)
            over = jax.lax.rsqrt(square)
            value = times(function(x * over[None]), weight * over / square)
            return (totals[0] + (1 - t) * value, totals[1] + t * value), None

        along = lambda: jax.lax.scan(node, (zero, zero), rule)[0]
        return None, jax.lax.cond(jnp.any(chord != 0), along, lambda: (zero, zero))

    return jax.lax.scan(of_edge, None, edges)[1]


def _over_area(
    function: Callable[[Float[Array, "3 p"]], Float[Array, "*colour p"]], v: Loop, order: int, center: bool
) -> Float[Array, "*colour p"]:
    slots = v.shape[1]
    if center:
        first = np.arange(1, slots + 1, 2)
        second = first % slots + 1
        corners = np.stack([0 * first, first, second, np.where(first < slots, second % slots + 1, second)])
        v = jnp.concatenate([_amid(v)[:, None], v], axis=1)
    else:
        first = np.arange(1, slots - 1, 2)
        corners = np.stack([0 * first, first, first + 1, np.minimum(first + 2, slots - 1)])
    of_corner = [[jnp.stack([v[i, k] for k in at]) for i in range(3)] for at in corners]  # arrays [quads, p]
    patches = [(a, b - a, d - a, (a - b) - (d - c)) for a, b, c, d in zip(*of_corner, strict=True)]
    rule = jnp.asarray(_rule(order), v.dtype)

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def node(total: Array, row: Array, patch: list[Patch]) -> Array:
        # component by component: of stacked ones XLA makes no vector code, least of all in derivatives
        u, v, weight = row
        x = tuple(a + u * along_u + v * (along_v + u * skew) for a, along_u, along_v, skew in patch)
        by_u = [along_u + v * skew for _, along_u, _, skew in patch]
        by_v = [along_v + u * skew for _, _, along_v, skew in patch]
        square = dot(x, x)
        over = jax.lax.rsqrt(square)
        solid_angle = _triple(x, by_u, by_v) * over / square
        return total + times(function(jnp.stack([y * over for y in x])), weight * solid_angle)

    def of_patch(total: Array, patch: list[Patch]) -> tuple[Array, None]:
        nodes = lambda total, patch: jax.lax.scan(lambda t, row: (node(t, row, patch), None), total, rule)[0]
        used = functools.reduce(jnp.logical_or, [jnp.any(x != 0) for row in patch for x in row[1:]])
        return jax.lax.cond(used, nodes, lambda total, _: total, total, patch), None

    total = jnp.zeros(jax.eval_shape(function, v[:, 0]).shape, v.dtype)
    return jax.lax.scan(of_patch, total, patches)[0]


def _triple(a: Sequence[Array], b: Sequence[Array], c: Sequence[Array]) -> Array:
    """a . (b x c)."""
    part = lambda i, j, k: a[i] * (b[j] * c[k] - b[k] * c[j])
    return part(0, 1, 2) + part(1, 2, 0) + part(2, 0, 1)


def _amid(v: Loop) -> Float[Array, "3 p"]:
    """The mean of the vertices, or where there is none, of the horizon, straight up."""
    mean = jnp.mean(v, axis=1)
    up = jnp.asarray([0, 0, 1], v.dtype)[:, None] * (1 - dot(mean, mean))[None]
    return on_sphere((mean + up)[:, None])[:, 0]


def _rule(order: int) -> Float[np.ndarray, "n 3"]:
    """u, v and weight."""
    x, weight = np.polynomial.legendre.leggauss(order)
    u, v = np.meshgrid((x + 1) / 2, (x + 1) / 2)
    return np.stack([u.ravel(), v.ravel(), np.outer(weight, weight).ravel() / 4], axis=1)
