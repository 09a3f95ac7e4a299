"""Radiance under a polygon light: points over its area, and Gauss quadrature of what is above the horizon."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._typing import Array, ArrayLike
from shisd.models import AbstractBrdf
from shisd.reference._integrand import Radiance, integrand, local_frames, times
from shisd.reference._monte_carlo import Estimate, cumulative, strata, tiled


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
    frames, local_views = local_frames(normals, views, tangents, brdf)
    corners, where = _polygon_points(points, positions, frames)
    return _monte_carlo(brdf, radiance, corners, two_sided, where, frames, local_views, key, -(-samples // 2))


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
    frames, local_views = local_frames(normals, views, tangents, brdf)
    corners, where = _polygon_points(points, positions, frames)
    return _quadrature(brdf, radiance, corners, two_sided, where, frames, local_views, nodes)


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
def _monte_carlo(
    brdf: AbstractBrdf, radiance: Radiance, corners: Array, two_sided: bool, where: Array, frames: Array, views: Array,
    key: Array, count: int,
) -> Estimate:  # fmt: skip
    cell, width = (jnp.asarray(x[None], views.dtype) for x in strata(count))
    triangles = jnp.cross(corners[1:-1] - corners[:1], corners[2:] - corners[:1]) / 2

    def one(point: tuple[Array, ...]) -> tuple[Array, Array]:
        position, frame, wo, key = point
        normal, seen = _faces(corners, two_sided, position)
        signed = triangles @ normal
        stops = cumulative(jnp.abs(signed)[None])[0]
        u = cell + width * jax.random.uniform(key, (2, cell.shape[1], 2), views.dtype)
        index = jnp.clip(jnp.sum(u[..., :1] >= stops[1:-1][None, None], axis=-1), 0, signed.shape[0] - 1)
        x = jnp.sqrt((u[..., 0] - stops[index]) / (stops[index + 1] - stops[index]))[..., None]
        far = corners[1 + index] + u[..., 1:] * (corners[2 + index] - corners[1 + index])
        offset = ((1 - x) * corners[0][None, None] + x * far - position[None, None]).reshape(-1, 3)
        distance2 = jnp.sum(offset * offset, axis=1)
        wi = offset / jnp.sqrt(distance2)[:, None]
        weight = jnp.sign(signed)[index].reshape(-1) * jnp.sum(jnp.abs(signed)) * jnp.abs(wi @ normal) / distance2
        terms = times(jnp.where(seen, weight, 0), integrand(brdf, radiance, frame, wo, wi @ frame.T), 1)
        terms = terms.reshape(2, -1, *terms.shape[1:]) / index.size
        return jnp.sum(terms, axis=(0, 1)), jnp.sqrt(jnp.sum((terms[0] - terms[1]) ** 2, axis=0))

    keys = jax.random.split(key, views.shape[0])
    return Estimate(*tiled(one, (where, frames, views, keys), max(1, 2**15 // (2 * cell.shape[1]))))


@eqx.filter_jit
def _quadrature(
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
            return jnp.sum(times(weights, integrand(brdf, radiance, frame, wo, wi @ frame.T), 1), axis=0)

        total = jnp.sum(jax.lax.map(triangle, (outline, jnp.roll(outline, -1, axis=0))), axis=0)
        return jnp.where(lit, total, jnp.zeros_like(total))

    return jax.lax.map(one, (where, frames, views))


def _crossings(height: Array, following: Array) -> tuple[Array, Array]:
    """The parameters on an edge between which it is above the horizon."""
    crosses = (height > 0) != (following > 0)
    at = height / jnp.where(crosses, height - following, 1)
    return jnp.where(crosses & (height <= 0), at, 0), jnp.where(crosses & (height > 0), at, 1)
