"""Slow, plainly right estimators with error bars, to judge the fast paths by.

They share no formula with them: no harmonics, no expansion, no closed form. Radiance is the integral over the upper
hemisphere of value_cosine(wi, wo) times the map's radiance, constant on each texel, taken two ways: by Monte Carlo with
multiple importance sampling (Veach 1995, balance heuristic) for whole pictures, and by a plain sum over texels for a
few pixels. Of polygons, the integral is over their area: by Monte Carlo, and by Gauss quadrature of what is above the
horizon.
"""

import functools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._module import Module
from shisd._numerics import normalize
from shisd._typing import Array, ArrayLike, Float
from shisd.models import AbstractBrdf, Environment

Radiance = ArrayLike | Callable[[Array], Array]
Visible = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Estimate(Module):
    """A value and one standard deviation of its own error, in the units of the value."""

    value: Array
    standard_error: Array


def shade_environment(
    brdf: AbstractBrdf,
    environment: Environment,
    normals: ArrayLike,
    views: ArrayLike,
    *,
    key: Array,
    samples: int = 1024,
    tangents: ArrayLike | None = None,
    positions: ArrayLike | None = None,
    visible: Visible | None = None,
) -> Estimate:
    """Radiance [N, *colour] leaving N points towards their views under a distant environment, by Monte Carlo.

    Arguments: world `normals` and `views` [N, 3], made unit here, both away from the surface; `tangents` [N, 3] set the
    local x axis of anisotropic BRDFs (made orthogonal to the normal); static `samples` per point, rounded up so that
    they fill whole cells. A view below the horizon gives 0. With occlusion: `positions` [N, 3], where rays start, and
    `visible`, a function on the host of NumPy arrays, starts [M, 3] and directions [M, 3], that says for each ray
    whether it leaves the scene [M] (for trimesh: lambda p, w: ~mesh.ray.intersects_any(p, w)).
    Method: of eight samples, six follow the map's power, one the cosine, and one GGX half vectors as wide as
    `brdf.lobe_width`, each two to a cell of a stratified unit square. All are weighed by the balance heuristic, so the
    result is unbiased for any BRDF.
    Accuracy: `standard_error` is the root of sum (a - b)^2 over the pairs, unbiased in its square. Points have
    independent errors.
    Derivatives: none promised. Cost: N x samples evaluations of BRDF and map; memory for one tile of points.
    """
    samples = _checks.integer("samples", samples, minimum=1)
    frames, local_views = _frames(normals, views, tangents, brdf)
    if (positions is None) != (visible is None):
        raise ValueError("`positions` and `visible` belong together; pass both for occlusion.")
    starts = jnp.zeros_like(local_views) if positions is None else _checks.vectors("positions", positions)
    if starts.shape != local_views.shape:
        raise ValueError(f"`positions` must have the shape of `normals`, [N, 3]; got {list(starts.shape)}.")
    return _monte_carlo(brdf, environment, frames, local_views, starts, visible, key, -(-samples // 16))


def shade_environment_quadrature(
    brdf: AbstractBrdf,
    environment: Environment,
    normals: ArrayLike,
    views: ArrayLike,
    *,
    supersampling: int = 2,
    tangents: ArrayLike | None = None,
) -> Array:
    """The same radiance [N, *colour] as a sum over every texel of the map, each cut in supersampling^2 parts.

    Parts have their exact solid angle and are evaluated at their middle in angle, so the error falls with the square of
    `supersampling` once parts are finer than the lobe. No noise and no error bar: compare two settings.
    Cost: H x W x supersampling^2 evaluations per point, one row of the map in memory at a time: for a few points.
    """
    supersampling = _checks.integer("supersampling", supersampling, minimum=1)
    frames, local_views = _frames(normals, views, tangents, brdf)
    return _quadrature(brdf, environment, frames, local_views, supersampling)


def shade_polygon(
    brdf: AbstractBrdf,
    points: ArrayLike,
    radiance: Radiance,
    positions: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    *,
    key: Array,
    samples: int = 1024,
    two_sided: bool = False,
    tangents: ArrayLike | None = None,
) -> Estimate:
    """Radiance [N, *colour] leaving N points towards their views, lit by a flat polygon, by Monte Carlo over its area.

    Arguments: `points` [S, 3] as those of a `models.PolygonLight`; `radiance`, an array [*colour] or a function of unit
    world directions [M, 3] from the surface to the light, with values [M, *colour]; `positions` [N, 3]; the others as
    in `shade_environment`.
    Method: points on the triangles of a fan, of negative weight where an outline that is not convex turns back, two to
    a cell of a stratified unit square. The variance grows where the light comes close.
    Accuracy, derivatives and cost: as `shade_environment`.
    """
    samples = _checks.integer("samples", samples, minimum=1)
    frames, local_views = _frames(normals, views, tangents, brdf)
    corners, where = _polygon_points(points, positions, frames)
    return _polygon_monte_carlo(brdf, radiance, corners, two_sided, where, frames, local_views, key, -(-samples // 2))


def shade_polygon_quadrature(
    brdf: AbstractBrdf,
    points: ArrayLike,
    radiance: Radiance,
    positions: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    *,
    nodes: int = 32,
    two_sided: bool = False,
    tangents: ArrayLike | None = None,
) -> Array:
    """The same radiance by Gauss-Legendre quadrature: nodes^2 on each triangle of what is above the horizon.

    Converges exponentially for smooth materials and radiance: compare two settings of `nodes`. In float64 it reaches
    rounding; a light that is closer than its size, or a lobe that is narrow, needs more nodes.
    Cost: 2 S nodes^2 evaluations per point, one point in memory at a time: for a few points.
    """
    nodes = _checks.integer("nodes", nodes, minimum=1)
    frames, local_views = _frames(normals, views, tangents, brdf)
    corners, where = _polygon_points(points, positions, frames)
    return _polygon_quadrature(brdf, radiance, corners, two_sided, where, frames, local_views, nodes)


def _frames(
    normals: ArrayLike, views: ArrayLike, tangents: ArrayLike | None, brdf: AbstractBrdf
) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
    """World-to-local rotations (rows: tangent, bitangent, normal) and local views."""
    normal, view = _checks.vectors("normals", normals), _checks.vectors("views", views)
    if normal.ndim != 2 or normal.shape != view.shape:
        message = f"`normals` and `views` must both have shape [N, 3]; got {list(normal.shape)} and {list(view.shape)}."
        raise ValueError(message)
    normal, view = normalize(normal), normalize(view)
    if tangents is not None:
        tangent = _checks.vectors("tangents", tangents)
        if tangent.shape != normal.shape:
            raise ValueError(f"`tangents` must have the shape of `normals`, [N, 3]; got {list(tangent.shape)}.")
        tangent = normalize(tangent - jnp.sum(tangent * normal, axis=-1, keepdims=True) * normal)
    elif not brdf.isotropic:
        raise ValueError("`tangents` [N, 3] are needed: this BRDF is anisotropic.")
    else:  # any tangent will do; this one has no singular normal (Duff et al. 2017)
        x, y, z = normal[:, 0], normal[:, 1], normal[:, 2]
        sign = jnp.where(z < 0, -jnp.ones_like(z), jnp.ones_like(z))
        a = -1 / (sign + z)
        tangent = jnp.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x], axis=-1)
    frames = jnp.stack([tangent, jnp.cross(normal, tangent), normal], axis=1)
    return frames, jnp.sum(frames * view[:, None, :], axis=-1)


def _times(brdf_values: Array, radiance: Array, lead: int) -> Array:
    """Product of two arrays [*lead, *colour], either of which may lack the colour axis."""
    ndim = max(brdf_values.ndim, radiance.ndim)
    pad = lambda x: x.reshape(x.shape[:lead] + (1,) * (ndim - x.ndim) + x.shape[lead:])
    return pad(brdf_values) * pad(radiance)


def _integrand(brdf: AbstractBrdf, radiance: Radiance, frame: Array, wo: Array, wi: Array) -> Array:
    """value_cosine times radiance [..., *colour] at local directions [..., 3]; 0 when the view is below the horizon."""
    values = jax.vmap(lambda w: brdf.value_cosine(w, wo))(wi.reshape(-1, 3))
    values = values.reshape(wi.shape[:-1] + values.shape[1:])
    lead = wi.ndim - 1
    if callable(radiance):
        light = jnp.asarray(radiance(wi @ frame))
    else:
        light = jnp.asarray(radiance, values.dtype)
        light = light.reshape((1,) * lead + light.shape)
    product = _times(values, light, lead)
    return jnp.where(wo[2] > 0, product, jnp.zeros_like(product))


# ---- Monte Carlo


@functools.cache
def _strata(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners and sizes [cells, 2] of a grid of at least `count` nearly square cells over the unit square."""
    rows = math.isqrt(count)
    columns = -(-count // rows)
    corners = np.stack(np.divmod(np.arange(rows * columns), columns), axis=-1) / [rows, columns]
    return corners, np.broadcast_to([1 / rows, 1 / columns], corners.shape)


class _MapDensity(Module):
    """A density on the sphere that follows a map, up to sin(theta) inside a texel.

    A texel is chosen by its power, then a point of it, uniformly in theta and phi.
    """

    row_cdf: Array  # [1, H + 1]
    column_cdf: Array  # [H, W + 1]
    density: Environment  # [H, W], per rad^2 of theta and phi

    def sample(self, u: Array) -> Array:
        """Directions [..., 3] from uniform numbers [..., 2]."""
        row, down = _invert(self.row_cdf, jnp.zeros(u.shape[:-1], int), u[..., 0])
        column, along = _invert(self.column_cdf, row, u[..., 1])
        step = np.pi / len(self.column_cdf)
        theta, phi = step * (row.astype(u.dtype) + down), step * (column.astype(u.dtype) + along)
        return _polar(jnp.cos(theta), jnp.sin(theta), phi)

    def __call__(self, directions: Array) -> Array:
        """Density [...] in 1/sr at unit `directions` [..., 3]."""
        sine = jnp.sqrt(directions[..., 0] ** 2 + directions[..., 1] ** 2)
        return self.density.radiance(directions) / jnp.maximum(sine, 1e-9)


def _map_density(environment: Environment) -> _MapDensity:
    texels = jnp.maximum(environment.texels, 0)
    power = texels.reshape(*texels.shape[:2], -1).mean(axis=-1)
    solid_angles = environment.solid_angles()[:, None]
    mass = jnp.where(jnp.sum(power) > 0, power, jnp.ones_like(power)) * solid_angles
    rows = jnp.sum(mass, axis=1)
    row_cdf = _cdf(rows[None])
    column_cdf = _cdf(jnp.where(rows[:, None] > 0, mass, jnp.ones_like(mass)))
    probability = jnp.diff(row_cdf[0])[:, None] * jnp.diff(column_cdf)  # of the rounded tables, which are sampled
    return _MapDensity(row_cdf, column_cdf, Environment(probability / (np.pi / len(mass)) ** 2))


def _cdf(mass: Array) -> Array:
    """Cumulative sums [R, n + 1] of each row, from exactly 0 to exactly 1."""
    total = jnp.cumsum(mass, axis=1)
    return jnp.concatenate([jnp.zeros_like(mass[:, :1]), total / total[:, -1:]], axis=1)


def _invert(cdf: Array, row: Array, u: Array) -> tuple[Array, Array]:
    """The bin of cdf[row] that holds u, by bisection, and the position of u in it, from 0 to 1."""

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = (low + high) // 2
        below = cdf[row, middle] <= u
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    bins = cdf.shape[1] - 1
    bounds = jnp.zeros_like(row), jnp.full_like(row, bins)
    low, high = jax.lax.fori_loop(0, math.ceil(math.log2(bins)), halve, bounds)  # a loop keeps XLA from recomputing it
    start, stop = cdf[row, low], cdf[row, high]
    return low, (u - start) / (stop - start)


def _polar(cosine: Array, sine: Array, phi: Array) -> Array:
    return jnp.stack([sine * jnp.cos(phi), sine * jnp.sin(phi), cosine], axis=-1)


def _sample_cosine(u: Array) -> Array:
    return _polar(jnp.sqrt(1 - u[..., 0]), jnp.sqrt(u[..., 0]), 2 * np.pi * u[..., 1])


def _sample_ggx(u: Array, wo: Array, alpha: Array) -> Array:
    """Mirror directions of wo [3] about half vectors of density D(h) cos h (Walter et al. 2007, Eq. 35)."""
    tan2 = alpha**2 * u[..., 0] / (1 - u[..., 0])
    cosine = 1 / jnp.sqrt(1 + tan2)
    half = _polar(cosine, cosine * jnp.sqrt(tan2), 2 * np.pi * u[..., 1])
    return 2 * (half @ wo)[..., None] * half - jnp.broadcast_to(wo, half.shape)


def _ggx_density(wi: Array, wo: Array, alpha: Array) -> Array:
    half = wi + jnp.broadcast_to(wo, wi.shape)
    length = jnp.sqrt(jnp.sum(half * half, axis=-1))
    half = half / jnp.maximum(length, 1e-6)[..., None]
    cos2 = half[..., 2] ** 2
    sin2 = half[..., 0] ** 2 + half[..., 1] ** 2
    d = alpha**2 / (np.pi * (alpha**2 * cos2 + sin2) ** 2)
    return d * jnp.abs(half[..., 2]) / (4 * jnp.maximum(jnp.abs(half @ wo), 1e-6))


@eqx.filter_jit
def _monte_carlo(
    brdf: AbstractBrdf,
    environment: Environment,
    frames: Array,
    views: Array,
    starts: Array,
    visible: Visible | None,
    key: Array,
    count: int,
) -> Estimate:
    """At least `count` pairs of samples that follow the cosine, `count` of half vectors, six times that of the map."""
    light = _map_density(environment)
    alpha = jnp.clip(jnp.asarray(brdf.lobe_width, views.dtype), 0.01, 1.0)
    grids = [_strata(n) for n in (6 * count, count, count)]
    corners, widths = (jnp.asarray(np.concatenate(part)[None], views.dtype) for part in zip(*grids, strict=True))
    cells = [len(corner) for corner, _ in grids]
    splits = np.cumsum(cells)[:-1]
    sizes = [2.0 * n for n in cells]

    def one(point: tuple[Array, ...]) -> tuple[Array, Array]:  # barriers stop XLA from repeating work
        frame, wo, start, key = point
        jitter = jax.random.uniform(key, (2, sum(cells), 2), views.dtype)  # two independent points in every cell
        u = jax.lax.optimization_barrier(corners + widths * jitter)
        u_light, u_cosine, u_ggx = jnp.split(u, splits, axis=1)
        wi = [light.sample(u_light) @ frame.T, _sample_cosine(u_cosine), _sample_ggx(u_ggx, wo, alpha)]
        wi = jax.lax.optimization_barrier(jnp.concatenate(wi, axis=1))
        # balance heuristic: each sample is divided by the sum of (number of samples) x (density) over the strategies
        density = sizes[0] * light(wi @ frame) + sizes[1] / np.pi * jnp.maximum(wi[..., 2], 0)
        density += sizes[2] * _ggx_density(wi, wo, alpha)
        inverse = jnp.where(density > 0, 1 / jnp.where(density > 0, density, jnp.ones_like(density)), 0)
        if visible is not None:
            inverse = jnp.where(_leaves(visible, start, wi @ frame), inverse, 0)
        terms = _times(inverse, _integrand(brdf, environment.radiance, frame, wo, wi), 2)
        value = jnp.sum(terms, axis=(0, 1))
        return value, jnp.sqrt(jnp.sum((terms[0] - terms[1]) ** 2, axis=0))

    keys = jax.random.split(key, views.shape[0])
    return Estimate(*_tiled(one, (frames, views, starts, keys), max(1, 2**15 // (2 * sum(cells)))))


def _leaves(visible: Visible, start: Float[Array, "3"], directions: Float[Array, "*batch 3"]) -> Array:
    """`visible` of rays from one point, [...]; of many points in one call."""

    def host(starts: ArrayLike, directions: ArrayLike) -> np.ndarray:
        rays = (np.asarray(x, float).reshape(-1, 3) for x in (starts, directions))
        return np.asarray(visible(*rays), bool).reshape(np.shape(directions)[:-1])

    shape = jax.ShapeDtypeStruct(directions.shape[:-1], bool)
    starts = jnp.broadcast_to(start, directions.shape)
    return jax.pure_callback(host, shape, starts, directions, vmap_method="broadcast_all")


def _tiled(function: Callable, arguments: tuple[Array, ...], size: int) -> tuple[Array, ...]:
    """vmap in tiles of `size`, the last one filled up: one body to compile, and memory for one tile."""
    count = arguments[0].shape[0]
    size = max(1, min(size, count))
    index = jnp.arange(-(-count // size) * size).reshape(-1, size) % max(1, count)
    results = jax.lax.map(lambda i: jax.vmap(function)(tuple(a[i] for a in arguments)), index)
    return tuple(r.reshape(-1, *r.shape[2:])[:count] for r in results)


# ---- quadrature


@eqx.filter_jit
def _quadrature(brdf: AbstractBrdf, environment: Environment, frames: Array, views: Array, supersampling: int) -> Array:
    height, width = (supersampling * n for n in environment.texels.shape[:2])
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = 2 * np.pi * (np.arange(width) + 0.5) / width
    solid_angles = jnp.asarray(2 * np.pi / width * 2 * np.sin(theta) * np.sin(np.pi / height / 2), views.dtype)
    cosines, sines = jnp.asarray(np.cos(theta), views.dtype), jnp.asarray(np.sin(theta), views.dtype)
    texels = np.arange(height, dtype=np.int32) // supersampling
    circle = jnp.asarray(np.stack([np.cos(phi), np.sin(phi)], axis=-1), views.dtype)

    def one(point: tuple[Array, Array]) -> Array:
        frame, wo = point

        def row(part: tuple[Array, ...]) -> Array:
            cosine, sine, solid_angle, texel = part
            world = jnp.concatenate([sine * circle, jnp.full_like(circle[:, :1], cosine)], axis=1)
            light = jnp.repeat(environment.texels[texel], supersampling, axis=0)
            return solid_angle * jnp.sum(_integrand(brdf, lambda _: light, frame, wo, world @ frame.T), axis=0)

        return jnp.sum(jax.lax.map(row, (cosines, sines, solid_angles, texels)), axis=0)

    return jax.lax.map(one, (frames, views))


# ---- polygons


def _polygon_points(points: ArrayLike, positions: ArrayLike, frames: Array) -> tuple[Array, Array]:
    corners, where = _checks.outline("points", points), _checks.vectors("positions", positions)
    if where.shape != (frames.shape[0], 3):
        raise ValueError(f"`positions` must have the shape of `normals`, [N, 3]; got {list(where.shape)}.")
    return corners.astype(frames.dtype), where.astype(frames.dtype)


def _faces(corners: Array, two_sided: bool, where: Array) -> tuple[Array, Array]:
    """The unit normal of the emitting side, and whether a point sees light."""
    edges = corners[1:] - corners[:1]
    normal = jnp.sum(jnp.cross(edges[:-1], edges[1:]), axis=0)
    normal /= jnp.sqrt(jnp.sum(normal * normal))
    side = jnp.dot(where - corners[0], normal)
    return normal, (side != 0) & two_sided | (side > 0)


@eqx.filter_jit
def _polygon_monte_carlo(
    brdf: AbstractBrdf, radiance: Radiance, corners: Array, two_sided: bool, where: Array, frames: Array, views: Array,
    key: Array, count: int,
) -> Estimate:  # fmt: skip
    cell, width = (jnp.asarray(x[None], views.dtype) for x in _strata(count))
    triangles = jnp.cross(corners[1:-1] - corners[:1], corners[2:] - corners[:1]) / 2

    def one(point: tuple[Array, ...]) -> tuple[Array, Array]:
        position, frame, wo, key = point
        normal, seen = _faces(corners, two_sided, position)
        signed = triangles @ normal
        stops = _cdf(jnp.abs(signed)[None])[0]
        u = cell + width * jax.random.uniform(key, (2, cell.shape[1], 2), views.dtype)
        index = jnp.clip(jnp.sum(u[..., :1] >= stops[1:-1][None, None], axis=-1), 0, signed.shape[0] - 1)
        x = jnp.sqrt((u[..., 0] - stops[index]) / (stops[index + 1] - stops[index]))[..., None]
        far = corners[1 + index] + u[..., 1:] * (corners[2 + index] - corners[1 + index])
        offset = ((1 - x) * corners[0][None, None] + x * far - position[None, None]).reshape(-1, 3)
        distance2 = jnp.sum(offset * offset, axis=1)
        wi = offset / jnp.sqrt(distance2)[:, None]
        weight = jnp.sign(signed)[index].reshape(-1) * jnp.sum(jnp.abs(signed)) * jnp.abs(wi @ normal) / distance2
        terms = _times(jnp.where(seen, weight, 0), _integrand(brdf, radiance, frame, wo, wi @ frame.T), 1)
        terms = terms.reshape(2, -1, *terms.shape[1:]) / index.size
        return jnp.sum(terms, axis=(0, 1)), jnp.sqrt(jnp.sum((terms[0] - terms[1]) ** 2, axis=0))

    keys = jax.random.split(key, views.shape[0])
    return Estimate(*_tiled(one, (where, frames, views, keys), max(1, 2**15 // (2 * cell.shape[1]))))


@eqx.filter_jit
def _polygon_quadrature(
    brdf: AbstractBrdf, radiance: Radiance, corners: Array, two_sided: bool, where: Array, frames: Array, views: Array,
    nodes: int,
) -> Array:  # fmt: skip
    x, w = np.polynomial.legendre.leggauss(nodes)
    s, t = (g.reshape(-1) for g in np.meshgrid((x + 1) / 2, (x + 1) / 2, indexing="ij"))
    weight = jnp.asarray(np.outer(w, w).reshape(-1) / 4 * s, views.dtype)
    s, t = (jnp.asarray(g, views.dtype)[:, None] for g in (s, t))

    def one(point: tuple[Array, ...]) -> Array:
        position, frame, wo = point
        normal, seen = _faces(corners, two_sided, position)
        a = corners - position[None]
        height, following = a @ frame[2], jnp.roll(a, -1, axis=0)
        next_height = jnp.roll(height, -1)
        # the parts of the edges that are above the horizon, joined along it
        start, stop = (jnp.clip(x, 0, 1) for x in _crossings(height, next_height))
        ends = [a + x[:, None] * (following - a) for x in (start, stop)]
        above = jnp.repeat((height > 0) | (next_height > 0), 2)
        place = jnp.where(above, jnp.arange(above.shape[0]), -1)
        last = jax.lax.cummax(place)  # an edge below repeats the point before it
        outline = jnp.stack(ends, axis=1).reshape(-1, 3)[jnp.where(last < 0, jnp.max(place), last)]
        lit, some = jnp.any(above) & seen, outline[0]

        def triangle(edge: tuple[Array, Array]) -> Array:
            b, c = edge
            area = jnp.dot(jnp.cross(b - some, c - some), normal)
            offset = some[None] + s * ((b - some)[None] + t * (c - b)[None])
            distance2 = jnp.sum(offset * offset, axis=1)
            wi = offset / jnp.sqrt(distance2)[:, None]
            weights = weight * area * jnp.abs(wi @ normal) / distance2
            return jnp.sum(_times(weights, _integrand(brdf, radiance, frame, wo, wi @ frame.T), 1), axis=0)

        total = jnp.sum(jax.lax.map(triangle, (outline, jnp.roll(outline, -1, axis=0))), axis=0)
        return jnp.where(lit, total, jnp.zeros_like(total))

    return jax.lax.map(one, (where, frames, views))


def _crossings(height: Array, following: Array) -> tuple[Array, Array]:
    """The parameters on an edge between which it is above the horizon."""
    crosses = (height > 0) != (following > 0)
    at = height / jnp.where(crosses, height - following, 1)
    return jnp.where(crosses & (height <= 0), at, 0), jnp.where(crosses & (height > 0), at, 1)
