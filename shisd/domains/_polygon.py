"""Spherical polygons: construction, clipping to a hemisphere, solid angle.

The layout inside is that of `moments`: v[x y z, vertex, p], one loop per point p, unused slots filled by repeating a
vertex, since edges of no length add nothing to any integral.
"""

import functools
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._lanes import in_lanes
from shisd._module import Module
from shisd._numerics import arctan2, cross, dot, normalize, same_dtype
from shisd._typing import Array, ArrayLike, Float
from shisd.domains.moments import Loop, sides
from shisd.domains.moments._edges import sum_first

Result = TypeVar("Result")


class SphericalPolygon(Module):
    """A region of the sphere bounded by great arcs between unit vertices; with leading axes many such regions.

    Arguments: `vertices` [..., slots, 3], unit vectors, each arc shorter than pi; `count`, how many of them are used
    (all, unless given; it may be traced): the slots after them are padding, whatever they hold.
    Of many polygons, the functions of `domains` give results with their leading axes, as `jax.vmap` does over polygons
    without; both are fast.
    Orientation: positive when counter-clockwise seen from outside the sphere, the interior on the left of every edge.
    Reversed winding changes the sign of every integral. Outlines need not be convex. Where an outline crosses itself,
    each part counts as often as the outline winds around it.
    A curve alone does not tell a polygon from the reversed outline of what is outside it: their integrals differ by
    those over the whole sphere. Solid angles are taken in (`largest` - 4 pi, `largest`], static, by default (-2 pi, 2
    pi]: every polygon that fits in a hemisphere, with the sign of its winding. For polygons that are larger than a
    hemisphere pass largest = 4 pi: what is on the left of the edges. Rounding never chooses between the ends of that
    range: a great circle is 2 pi, both ways round, as each has a hemisphere on its left; an outline that surrounds
    nothing is 0, also with largest = 4 pi.
    Bad input: fewer than three vertices or a wrong shape is a ValueError; vertices that are NaN or off the sphere by
    more than 1e-3, and arcs of length pi, which no plane determines, are errors in the functions of `domains`. Points
    in space become polygons with `polygon_from_points`.
    """

    vertices: Float[Array, "*batch slots 3"]
    largest: float = eqx.field(static=True)

    def __init__(self, vertices: ArrayLike, count: ArrayLike | None = None, *, largest: float = 2 * np.pi):
        v = _checks.outline("vertices", vertices, many=True)
        if not isinstance(largest, float | int | np.floating) or not 0 < largest <= 4 * np.pi:
            raise ValueError(f"`largest` must be a solid angle above 0 and at most 4 pi; got {largest}.")
        self.vertices = v if count is None else _used(v, count)
        self.largest = float(largest)

    @property
    def slots(self) -> int:
        return self.vertices.shape[-2]

    def loop(self) -> Loop:
        """Checked unit vertices as [3, slots, 1], of one polygon."""
        v = self.vertices.T[..., None]
        off = jnp.abs(dot(v, v) - 1)
        middle = sides(v)[1]
        v = eqx.error_if(
            v,
            ~jnp.all(off < 2e-3),
            "`vertices` of a polygon must be unit vectors: one is NaN or off the sphere, or `count` is out of range. "
            "For points in space use polygon_from_points.",
        )
        v = eqx.error_if(
            v,
            jnp.any(dot(middle, middle) < 100 * jnp.finfo(v.dtype).eps ** 2),
            "Two consecutive `vertices` of a polygon are opposite: no arc is the shortest. Put a vertex between them.",
        )
        # Vertices that are unit to rounding stay as they are: to round them again would move small polygons.
        unit = on_sphere(v)
        value = jnp.where((off < 8 * jnp.finfo(v.dtype).eps)[None], v, unit)
        return jax.lax.stop_gradient(value - unit) + unit


def for_each(function: Callable[[SphericalPolygon], Result], polygon: SphericalPolygon) -> Result:
    """function(polygon), or of many, of each: results with their leading axes."""
    for _ in polygon.vertices.shape[:-2]:
        function = jax.vmap(function)
    return function(polygon)


def _used(vertices: Float[Array, "*batch slots 3"], count: ArrayLike) -> Float[Array, "*batch slots 3"]:
    """The first `count` vertices, the other slots filled with the last of them; NaN for a traced count out of range."""
    slots = vertices.shape[-2]
    if not isinstance(count, jax.Array):
        if _checks.integer("count", count, 3) > slots:
            raise ValueError(f"`count` must be from 3 to the number of slots, {slots}; got {count}.")
    elif count.ndim or not jnp.issubdtype(count.dtype, jnp.integer):
        raise ValueError(f"`count` must be one integer; got {count.dtype} of shape {list(count.shape)}.")
    n = jnp.asarray(count, jnp.int32)
    last = jnp.minimum(np.arange(slots, dtype=np.int32), n - 1)
    return jnp.where((n >= 3) & (n <= slots), vertices[..., last, :], jnp.nan)


def polygon_from_points(
    points: ArrayLike, origin: ArrayLike, count: ArrayLike | None = None, *, largest: float = 2 * np.pi
) -> SphericalPolygon:
    """The spherical polygon that a polygon in space covers, seen from a point.

    Arguments: `points` [..., slots, 3] and `origin` [..., 3], in any unit of length, whose leading axes broadcast;
    `count` and `largest` as in `SphericalPolygon`. Counter-clockwise from outside the sphere is clockwise as seen from
    `origin`.
    Derivatives: in both, undefined (NaN) where a point coincides with `origin`. Points of a plane through `origin`
    cover nothing.
    Accuracy: a difference is taken first, of NumPy arrays and lists in float64 whatever the result's dtype; how far
    both are from the origin of space thus does not matter, beyond the rounding of the coordinates that are passed.
    """
    p, o = same_dtype(_checks.outline("points", points, many=True), _checks.vectors("origin", origin))
    try:
        batch = np.broadcast_shapes(p.shape[:-2], o.shape[:-1])
    except ValueError as error:
        raise ValueError(f"`origin` {list(o.shape)} does not go with `points` {list(p.shape)}.") from error
    if isinstance(points, jax.Array) or isinstance(origin, jax.Array):
        shape = (*batch, *p.shape[-2:])
        relative = jnp.broadcast_to(p, shape) - jnp.broadcast_to(o[..., None, :], shape)
    else:
        relative = jnp.asarray(np.asarray(points, float) - np.asarray(origin, float)[..., None, :], p.dtype)
    return SphericalPolygon(normalize(relative), count, largest=largest)


def clip_to_hemisphere(polygon: SphericalPolygon, normal: ArrayLike) -> SphericalPolygon:
    """The part of a polygon where w . normal >= 0, in slots + slots // 2 slots.

    Arguments: the `polygon`, non-convex and of either winding, which fits in some open hemisphere (every polygon that
    is seen from a point does; of others the result may be off by the whole hemisphere); `normal` [3], of any length but
    zero. Several crossings leave one outline, whose parts are joined by arcs along the horizon that cancel.
    Returns a polygon of coincident vertices, whose integrals and their gradients are zero, where nothing is above.
    Derivatives: in both. Where a vertex lies on the horizon, those of the side on which it is cut off.
    """
    n = _checks.vectors("normal", normal)
    if n.shape != (3,):
        raise ValueError(f"`normal` must have shape [3]; got {list(n.shape)}.")
    return _clip(polygon, n)


@eqx.filter_jit
def _clip(polygon: SphericalPolygon, normal: Float[Array, "3"]) -> SphericalPolygon:
    n = normalize(normal)
    n = eqx.error_if(n, ~jnp.all(jnp.isfinite(n)), "`normal` is zero or not finite.")

    def of_one(polygon: SphericalPolygon) -> Float[Array, "slots 3"]:
        v, axis = same_dtype(polygon.loop(), n)
        return on_sphere(clip(v, dot(v, axis[:, None, None])))[..., 0].T

    return SphericalPolygon(for_each(of_one, polygon), largest=polygon.largest)


def solid_angle(polygon: SphericalPolygon) -> Float[Array, "*batch"]:
    """Solid angle of a polygon in sr, positive for counter-clockwise winding, in (largest - 4 pi, largest].

    Returns [...] of many polygons.
    Derivatives: in the vertices. Accuracy: relative 4e-7 in float32, of the vertices as they are, down to 2e-12 sr and
    to edges 1e-5 rad short of pi (6e-4 for slivers 5e-5 rad wide); in float64 1e-12 down to 1e-6 sr, and below that
    what 1e-16 rad of the vertices makes.
    Source: the angle of van Oosterom and Strackee 1983 for each triangle of a fan.
    """
    return _solid_angle(polygon)


@eqx.filter_jit
def _solid_angle(polygon: SphericalPolygon) -> Float[Array, "*batch"]:
    return for_each(lambda one: loop_solid_angle(one.loop(), one.largest)[0], polygon)


def loop_solid_angle(
    v: Float[Array, "3 s r"], largest: float, fallback: Float[Array, "3 q"] | None = None
) -> Float[Array, " p"]:
    """Solid angles of loops, in (largest - 4 pi, largest] up to rounding.

    The fan starts at the first vertex, or where another is nearly opposite, at `fallback`: where it is given, it is a
    direction that no vertex is more than a quarter turn away from, and the fan adds up to what is meant.
    Derivatives: in the vertices, along the sphere.
    """
    return _angle(v, fallback, largest)


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _angle(v: Float[Array, "3 s r"], fallback: Float[Array, "3 q"] | None, largest: float) -> Float[Array, " p"]:
    return in_lanes(functools.partial(_fan, largest=largest), (v,) if fallback is None else (v, fallback))


def _angle_jvp(largest: float, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """An edge from a to b takes (da + db) . (a x b) / (1 + a . b) away: what an arc sweeps, integrated along it."""
    (v, fallback), (dv, _) = primals, tangents
    value = _angle(v, fallback, largest)
    change = -sum_first(dot(in_lanes(_inward, (v,)), dv + jnp.roll(dv, -1, 1)))
    return value, jnp.broadcast_to(change, value.shape)


_angle.defjvp(_angle_jvp)


def _inward(v: Float[Array, "3 s r"]) -> Float[Array, "3 s r"]:
    """(a x b) / (1 + a . b) of all edges: normals by the tangent of half of their length."""
    chord, middle = sides(v)
    short = dot(chord, chord) < dot(middle, middle)
    return 2 * cross(v, jnp.where(short[None], chord, middle)) / dot(middle, middle)[None]


def _fan(
    v: Float[Array, "3 s r"], fallback: Float[Array, "3 q"] | None = None, *, largest: float
) -> Float[Array, " p"]:
    first = jax.lax.stop_gradient(v[:, 0])
    risky = functools.reduce(jnp.minimum, list(dot(v, first[:, None]))) < -0.9
    other = _far_from_opposites(jax.lax.stop_gradient(v)) if fallback is None else jax.lax.stop_gradient(fallback)
    apex = jnp.where(risky[None], other, first)[:, None]
    chord, middle = sides(v)
    short = dot(chord, chord) < dot(middle, middle)
    across = dot(apex - v, cross(v, jnp.where(short[None], chord, middle)))
    along = dot(middle, apex + 0.5 * middle)
    angle = 2 * sum_first(arctan2(across, along))
    if fallback is not None:
        return angle
    # Both ends of the range are one outline, and rounding decides between them: a hemisphere is 2 pi, nothing is 0.
    size = sum_first(jnp.sqrt(dot(apex - v, apex - v) * dot(chord, chord)))
    rounding = 16 * jnp.finfo(v.dtype).eps * size
    from_lowest = angle - (largest - 4 * np.pi) + (rounding if largest > 2 * np.pi else -rounding)
    turns = jnp.floor(jax.lax.stop_gradient(from_lowest) / (4 * np.pi))
    return angle - (4 * np.pi) * turns


def _far_from_opposites(v: Loop) -> Float[Array, "3 p"]:
    """Of the 14 directions to the faces and corners of a cube, the one that is farthest from opposite to a vertex."""
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3) / np.sqrt(3)

    def step(best: tuple[Array, Array], candidate: Float[Array, "3"]) -> tuple[tuple[Array, Array], None]:
        nearest = functools.reduce(jnp.minimum, list(dot(candidate, v)))
        better = nearest > best[0]
        return (jnp.where(better, nearest, best[0]), jnp.where(better[None], candidate[:, None], best[1])), None

    worst = jnp.full(v.shape[2:], -jnp.inf, v.dtype), jnp.zeros_like(v[:, 0])
    return jax.lax.scan(step, worst, jnp.asarray(np.concatenate([faces, corners]), v.dtype))[0][1]


def on_sphere(points: Loop) -> Loop:
    """Loops of points of any length as unit vertices: `normalize` written out, whose sums over this axis are slower."""
    largest = functools.reduce(jnp.maximum, list(jnp.abs(points)))
    scaled = points / jax.lax.stop_gradient(largest)[None]
    return scaled / jnp.sqrt(dot(scaled, scaled))[None]


def clip(points: Loop, height: Float[Array, "s p"]) -> Float[Array, "3 t p"]:
    """Loops cut off where `height`, linear along their edges, is negative: t = s + s // 2 slots.

    Sutherland and Hodgman 1974, without branches; of flat polygons and of spherical ones, whose arcs are projected
    chords. Lengths are not kept: see `on_sphere`.
    """
    slots = points.shape[1]
    inside = height > 0
    height_next, inside_next = jnp.roll(height, -1, 0), jnp.roll(inside, -1, 0)
    crosses = inside != inside_next
    part = height / jnp.where(crosses, height - height_next, 1)
    crossing = points + jnp.where(crosses, part, 0)[None] * (jnp.roll(points, -1, 1) - points)
    slot = jnp.arange(slots + slots // 2, dtype=jnp.int32)[:, None]
    # with nothing inside, coincident vertices; otherwise slots beyond the last keep the first that is found
    result = jnp.broadcast_to(jax.lax.stop_gradient(points[:, :1]), (3, slot.shape[0], points.shape[2]))
    count = jnp.zeros(height.shape[1:], jnp.int32)
    for i in range(slots):
        for found, x in ((inside[i], points[:, i]), (crosses[i], crossing[:, i])):
            here = found[None] & ((slot == count[None]) | (count == 0)[None])
            result = jnp.where(here[None], x[:, None], result)
            count += found.astype(jnp.int32)
    return result
