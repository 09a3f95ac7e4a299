"""Other ways to integrate zonal harmonics, and radiance, over polygons: what the closed form is measured against.

Harmonics: polygons [P, S, 3] have unit vertices, the interior on the left of each edge, edges shorter than pi.
Radiance: polygons [N, S, 3] are planar and convex, in the local frame of each of N points (normal +z, the point at the
origin), vertices at any distance; unit `views` [N, 3] are in the same frame. Both sides of a polygon emit radiance 1.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import legendre
from scipy.optimize import least_squares

from shisd.harmonics import _sh, _tables
from shisd.reference._monte_carlo import Estimate

# ---- integrals of zonal harmonics, NumPy


def spherical_polygons(rng, count: int, sides: int, size: float) -> np.ndarray:
    """Convex polygons [count, sides, 3], counter-clockwise seen from outside, of angular radius `size`."""
    unit = lambda x: x / np.linalg.norm(x, axis=-1, keepdims=True)
    z, x = unit(rng.normal(size=(2, count, 1, 3)))
    x = unit(np.cross(x, z))
    angle = 2 * np.pi * (np.arange(sides) + rng.uniform(-0.3, 0.3, (count, sides)))[..., None] / sides
    return np.cos(size) * z + np.sin(size) * (np.cos(angle) * x + np.sin(angle) * np.cross(z, x))


def solid_angles(polygons: np.ndarray) -> np.ndarray:
    """Solid angles [P] in sr, by a fan of triangles (van Oosterom and Strackee 1983); the dtype is the input's."""
    a, b, c = polygons[:, :1], polygons[:, 1:-1], polygons[:, 2:]
    volume = np.sum(a * np.cross(b - a, c - a), axis=-1)
    return 2 * np.sum(np.arctan2(volume, 1 + np.sum(a * b + b * c + c * a, axis=-1)), axis=1)


def edge_quadrature(polygons: np.ndarray, axes: np.ndarray, degree: int) -> np.ndarray:
    """Integrals [P, K, L+1] of P_l(omega . axes[k]) in float64: for l >= 1, 1/(l(l+1)) sum_edges g integral of P_l'.

    Gauss-Legendre along each edge, to rounding. The edge formula is Stokes's theorem, since P_l(omega . d) is
    -1/(l(l+1)) times its own Laplacian (Wang and Ramamoorthi 2018 have it with recurrences along the edge).
    """
    a, d = np.asarray(polygons, float), np.asarray(axes, float)
    theta, normals, tangents = _edges(a)
    x, weights = legendre.leggauss(degree + 12)
    angle = theta[..., None, None] * (x[:, None] + 1) / 2
    u = (np.cos(angle) * a[:, :, None] + np.sin(angle) * tangents[:, :, None]) @ d.T  # [P, S, Q, K]
    moments = [np.repeat(solid_angles(a)[:, None], len(d), axis=1)]
    for l in range(1, degree + 1):
        derivative = legendre.legval(u, legendre.legder(np.eye(degree + 1)[l]))
        along = np.einsum("q,psqk->psk", weights / 2, derivative) * theta[..., None]
        moments.append(np.sum(normals @ d.T * along, axis=1) / (l * (l + 1)))
    return np.stack(moments, axis=-1)


def line_coefficients(v: jax.Array, degree: int) -> jax.Array:
    """Integrals of the basis [p, (L+1)^2] over loops [3, s, p], zero for l = 0: from lines along the edges, no axes.

    y_lm is -1/(l(l+1)) times its Laplacian, so its integral is that of n . grad(r^l y_lm) along the edges over l(l+1);
    the gradient is three harmonics of degree l-1. On p(t) = a + t (b - a), n ds = (a x b) dt / |p|^2: smooth wherever
    vertices coincide. Each edge is halved; (L/2) theta + 6 Gauss nodes on each half.
    """
    x, w = (jnp.asarray(g, v.dtype) for g in legendre.leggauss(int(0.4 * degree) + 6))
    end = jnp.roll(v, -1, 1)
    middle = v + end
    middle = middle / jnp.sqrt(jnp.sum(middle * middle, axis=0))[None]
    a, b = jnp.concatenate([v, middle], axis=1), jnp.concatenate([middle, end], axis=1)
    p = a[:, :, None] + ((x + 1) / 2)[None, None, :, None] * (b - a)[:, :, None]
    length2 = jnp.sum(p * p, axis=0)
    y = _sh.basis_at(jnp.moveaxis(p / jnp.sqrt(length2)[None], 0, -1).reshape(-1, 3), degree - 1)
    weight = (w / 2)[None, :, None] / length2
    lines = jnp.einsum("sqpn,sqp,isp->ipn", y.reshape(*length2.shape, -1), weight, jnp.cross(a, b - a, axis=0))
    lines = jnp.pad(lines, ((0, 0), (0, 0), (0, 2 * degree + 1)))
    result = jnp.zeros_like(lines[0])
    for line, terms in zip(lines, _tables.gradient_gather(degree, transpose=False), strict=True):
        for index, factor in terms:
            result += jnp.asarray(factor[None], v.dtype) * line[:, index]
    l = _tables.bands(degree)
    return result * jnp.asarray(1 / np.maximum(l * (l + 1), 1) * (l > 0), v.dtype)[None]


def axial_moments(polygons: np.ndarray, axes: np.ndarray, degree: int, dtype=np.float64) -> np.ndarray:
    """Integrals A_n [P, K, L+1] of (omega . axes[k])^n, in `dtype` throughout (Arvo 1995; CSH18).

    With u = omega . d, g = n . d for the edge's normal n, c^2 = 1 - g^2 and F_n the integral of u^n along an edge,
    n F_n = (n-1) c^2 F_{n-2} - [u^(n-1) u'] and (n+1) A_n = (n-1) A_{n-2} + sum_edges g F_{n-1}.
    """
    a, d = np.asarray(polygons, dtype), np.asarray(axes, dtype)
    theta, normals, tangents = _edges(a)
    b = np.roll(a, -1, axis=1)
    sine, cosine = np.linalg.norm(np.cross(a, b - a), axis=-1)[..., None], np.sum(a * b, axis=-1)[..., None]
    u0, u1, g, du0 = a @ d.T, b @ d.T, normals @ d.T, tangents @ d.T
    du1 = du0 * cosine - u0 * sine
    edge = [np.broadcast_to(theta[..., None], u0.shape), du0 - du1]
    area = [np.repeat(solid_angles(a)[:, None], len(d), axis=1), np.sum(g * edge[0], axis=1) / dtype(2)]
    power0, power1 = u0, u1
    for n in range(2, degree + 1):
        area.append((dtype(n - 1) * area[n - 2] + np.sum(g * edge[n - 1], axis=1)) / dtype(n + 1))
        edge.append((dtype(n - 1) * (1 - g * g) * edge[n - 2] - (power1 * du1 - power0 * du0)) / dtype(n))
        power0, power1 = power0 * u0, power1 * u1
    return np.stack(area[: degree + 1], axis=-1)


def zonal_from_axial(moments: np.ndarray) -> np.ndarray:
    """Integrals [..., L+1] of P_l from those of powers, by the coefficients of P_l, which grow like (1 + sqrt 2)^l."""
    degree = moments.shape[-1] - 1
    coefficients = np.zeros((degree + 1, degree + 1))
    for l in range(degree + 1):
        coefficients[l, : l + 1] = legendre.leg2poly(np.eye(degree + 1)[l])[: l + 1]
    return moments @ coefficients.T.astype(moments.dtype)


def _edges(a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lengths [P, S], unit normals towards the interior and unit tangents at the start [P, S, 3]."""
    b = np.roll(a, -1, axis=1)
    cross = np.cross(a, b - a)
    sine = np.linalg.norm(cross, axis=-1)
    normals = cross / np.where(sine > 0, sine, 1)[..., None].astype(a.dtype)
    return np.arctan2(sine, np.sum(a * b, axis=-1)), normals, np.cross(normals, a)


# ---- radiance by Monte Carlo, JAX


@functools.partial(jax.jit, static_argnames="samples")
def monte_carlo_area(brdf, polygons: jax.Array, views: jax.Array, *, key: jax.Array, samples: int) -> Estimate:
    """Radiance [N, *colour] from points uniform in area on a fan of triangles, at least `samples` for each point.

    Points are jittered in a grid, two to a cell, which also gives the standard error. No clipping: what is below the
    horizon counts zero. The variance grows where a polygon comes close or is seen at grazing angles.
    """

    def one(polygon, view, u):
        edges = polygon[1:] - polygon[:1]
        normals = jnp.cross(edges[:-1], edges[1:]) / 2
        fan, x, y = _choose(jnp.linalg.norm(normals, axis=-1), u)
        x, y = jnp.sqrt(x)[..., None], y[..., None]
        base = polygon[1 + fan] + y * (polygon[2 + fan] - polygon[1 + fan])
        position = (1 - x) * polygon[None, None, 0] + x * base
        distance = jnp.linalg.norm(position, axis=-1)
        solid_angle = jnp.abs(position @ jnp.sum(normals, axis=0)) / distance**3
        return _values(brdf, position / distance[..., None], view), solid_angle

    return _monte_carlo(one, polygons, views, key, samples)


@functools.partial(jax.jit, static_argnames="samples")
def monte_carlo_solid_angle(brdf, polygons: jax.Array, views: jax.Array, *, key: jax.Array, samples: int) -> Estimate:
    """Radiance [N, *colour] from directions uniform in solid angle on a fan of spherical triangles, clipped at z = 0.

    Map: Arvo 1995, *Stratified sampling of spherical triangles*. The point C' of the side AC that cuts off the wanted
    area is solved for in the tangent of half its distance from A, which keeps float32's digits in small triangles.
    Jitter and standard error as in `monte_carlo_area`.
    """

    def one(polygon, view, u):
        starts, ends, *_ = clip_at_horizon(polygon)
        corners = _unit(jnp.stack([starts, ends], axis=1).reshape(-1, 3))
        a, b, c = corners[:1], corners[1:-1], corners[2:]
        to_b, to_c = b - a, c - a
        w = _unit(to_c - jnp.sum(to_c * a, axis=-1, keepdims=True) * a)
        cross, ab, bw = jnp.cross(a, to_b), b @ a[0], jnp.sum(b * w, axis=-1)
        volume = jnp.sum(w * cross, axis=-1)
        areas = 2 * jnp.arctan2(jnp.sum(to_c * cross, axis=-1), 1 + ab + jnp.sum(b * c, axis=-1) + c @ a[0])
        fan, x, y = _choose(jnp.abs(areas), u)
        sine, cosine = jnp.sin(x * areas[fan] / 2), jnp.cos(x * areas[fan] / 2)
        below = volume[fan] * cosine - bw[fan] * sine
        t = sine * (1 + ab[fan]) / jnp.where(below == 0, 1, below)
        b, t = b[fan], t[..., None]
        moved = ((1 - t * t) * a[None] + 2 * t * w[fan]) / (1 + t * t)
        chord = moved - b
        versine = (y * jnp.sum(chord * chord, axis=-1) / 2)[..., None]  # 1 - cos of the distance from B
        side = _unit(moved - jnp.sum(moved * b, axis=-1, keepdims=True) * b)
        direction = (1 - versine) * b + jnp.sqrt(versine * (2 - versine)) * side
        return _values(brdf, direction, view), jnp.broadcast_to(jnp.sum(jnp.abs(areas)), x.shape)

    return _monte_carlo(one, polygons, views, key, samples)


def clip_at_horizon(polygon: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The part above z = 0 of a convex polygon [S, 3]: starts and ends [S, 3] of its edges, and the points [3] where it
    leaves and enters, between which it closes along the horizon. Edges below are points; all is 0 if nothing is above.
    """
    a, b = polygon, jnp.roll(polygon, -1, axis=0)
    above, above_next = a[:, 2:] > 0, b[:, 2:] > 0
    crosses = above != above_next
    rise = jnp.where(crosses, a[:, 2:] - b[:, 2:], 1)
    crossing = (a + a[:, 2:] / rise * (b - a)) * jnp.asarray([[1, 1, 0]], a.dtype)
    leave = jnp.sum(jnp.where(crosses & above, crossing, 0), axis=0)
    enter = jnp.sum(jnp.where(crosses & above_next, crossing, 0), axis=0)
    outside = jnp.where(crosses, crossing, leave[None])
    return jnp.where(above, a, outside), jnp.where(above_next, b, outside), leave, enter


def _monte_carlo(one, polygons: jax.Array, views: jax.Array, key: jax.Array, samples: int) -> Estimate:
    """Means of value times solid angle over a grid of at least samples / 2 cells with two points each."""
    cells = -(-samples // 2)
    rows = math.isqrt(cells)
    columns = -(-cells // rows)
    corner = np.stack(np.divmod(np.arange(rows * columns), columns), axis=-1)
    corner, size = (jnp.asarray(x, polygons.dtype) for x in (corner[None], [[[rows, columns]]]))

    def estimate(arguments):
        polygon, view, key = arguments
        u = (corner + jax.random.uniform(key, (2, rows * columns, 2), polygons.dtype)) / size
        values, solid_angle = one(polygon, view, u)
        terms = values * solid_angle.reshape(solid_angle.shape + (1,) * (values.ndim - 2))
        spread = jnp.sqrt(jnp.sum((terms[0] - terms[1]) ** 2, axis=0)) / (2 * rows * columns)
        return Estimate(jnp.mean(terms, axis=(0, 1)), spread)

    return jax.lax.map(estimate, (polygons, views, jax.random.split(key, len(views))), batch_size=64)


def _choose(sizes: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A triangle by its size from u[..., 0], what is left of that number, and u[..., 1]."""
    stops = jnp.cumsum(sizes)
    target = u[..., 0] * stops[-1]
    index = jnp.sum(target[..., None] >= stops[None, None, :-1], axis=-1)
    size = sizes[index]
    left = (target - stops[index] + size) / jnp.where(size > 0, size, 1)
    return index, jnp.clip(left, 0, 1), u[..., 1]


def _values(brdf, directions: jax.Array, view: jax.Array) -> jax.Array:
    values = jax.vmap(lambda wi: brdf.value_cosine(wi, view))(directions.reshape(-1, 3))
    return values.reshape(directions.shape[:-1] + values.shape[1:])


def _unit(vectors: jax.Array) -> jax.Array:
    length = jnp.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / jnp.where(length > 0, length, 1)


# ---- linearly transformed cosines (Heitz, Dupuy, Hill, Neubelt 2016), called HDHN16


class LtcTable(NamedTuple):
    """Inverse matrices [[m0, 0, m1], [0, 1, 0], [m2, 0, m3]] and amplitudes at evenly spaced polar angles of the view.

    They act in the frame whose x axis lies below the view.
    """

    step: jax.Array  # rad, between two views
    inverse: jax.Array  # [V, 4]
    amplitude: jax.Array  # [V, *colour]: the albedo


def fit_ltc(brdf, views: int = 32) -> LtcTable:
    """Linearly transformed cosines for an isotropic BRDF at `views` polar angles from 0 to 89 degrees (HDHN16).

    Quadrature gives the albedo and the mean direction Z of f cos. Then D(w) = |M^-1| max((M^-1 w).z, 0) / (pi
    |M^-1 w|^4), with M = [X Y Z] [[m11, 0, m13], [0, m22, 0], [0, 0, 1]], is fitted to f cos / albedo in m11, m22, m13:
    least squares over the whole sphere, weighted by solid angle, each view started from the one before it. Colours
    share the matrix of their mean.
    """
    if not brdf.isotropic:
        raise ValueError("`brdf` must be isotropic: an LTC table has one view angle.")
    width = float(brdf.lobe_width)
    thetas = np.linspace(0, np.radians(89), views)
    directions, solid_angles = _nodes(width)
    values = jax.jit(jax.vmap(brdf.value_cosine, (0, None)))
    rows, amplitudes, shape = [], [], np.array([np.log(width), np.log(width), 0])
    for theta in thetas:
        sine, cosine = np.sin(theta), np.cos(theta)
        mirrored = directions @ np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])  # +z to (-sine, 0, cosine)
        f = np.asarray(values(jnp.asarray(mirrored, float), jnp.asarray([sine, 0, cosine], float)), float)
        amplitudes.append(solid_angles @ f)
        density = f.reshape(len(f), -1).mean(axis=1)
        density /= solid_angles @ density
        z = (solid_angles * density) @ mirrored
        z /= np.hypot(z[0], z[2])
        frame = np.array([[z[2], 0, z[0]], [0, 1, 0], [-z[0], 0, z[2]]])
        root = np.sqrt(solid_angles)
        inverse = lambda p, frame=frame: np.linalg.inv(
            frame @ np.array([[np.exp(p[0]), 0, p[2]], [0, np.exp(p[1]), 0], [0, 0, 1]])
        )
        residual = lambda p, inverse=inverse, nodes=mirrored, density=density, root=root: (
            root * (ltc_density(inverse(p), nodes) - density)
        )
        shape = least_squares(residual, shape, method="lm").x
        m = inverse(shape)
        rows.append(np.array([m[0, 0], m[0, 2], m[2, 0], m[2, 2]]) / m[1, 1])
    return LtcTable(*(jnp.asarray(x, float) for x in (thetas[1], np.stack(rows), np.stack(amplitudes))))


def ltc_matrix(row: np.ndarray) -> np.ndarray:
    """The inverse matrix [3, 3] from a row of the table."""
    m0, m1, m2, m3 = row
    return np.array([[m0, 0, m1], [0, 1, 0], [m2, 0, m3]])


def ltc_density(inverse: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The clamped cosine max(z, 0) / pi transformed by the inverse of `inverse` [3, 3] (HDHN16), per sr."""
    moved = directions @ inverse.T
    return np.linalg.det(inverse) * np.maximum(moved[:, 2], 0) / (np.pi * np.sum(moved**2, axis=1) ** 2)


@jax.jit
def ltc_radiance(table: LtcTable, polygons: jax.Array, views: jax.Array) -> jax.Array:
    """Radiance [N, *colour]: albedo times the form factor of the polygon taken back to the cosine (HDHN16).

    The matrix is interpolated linearly in the view's polar angle. The moved polygon is clipped exactly at its horizon.
    """
    sine = jnp.hypot(views[:, 0], views[:, 1])
    along = jnp.where(sine[:, None] > 0, views[:, :2], jnp.asarray([[1, 0]], views.dtype))
    along = along / jnp.where(sine > 0, sine, 1)[:, None]
    position = jnp.clip(jnp.arctan2(sine, views[:, 2]) / table.step, 0, len(table.inverse) - 1)
    lower = jnp.minimum(position.astype(int), len(table.inverse) - 2)
    t = position - lower.astype(position.dtype)
    between = lambda x: x[lower] + t.reshape(t.shape + (1,) * (x.ndim - 1)) * (x[lower + 1] - x[lower])
    m0, m1, m2, m3 = between(table.inverse).T[:, :, None]
    x = polygons[..., 0] * along[:, :1] + polygons[..., 1] * along[:, 1:]
    y = polygons[..., 1] * along[:, :1] - polygons[..., 0] * along[:, 1:]
    z = polygons[..., 2]
    factor = jax.vmap(form_factor)(jnp.stack([m0 * x + m1 * z, y, m2 * x + m3 * z], axis=-1))
    amplitude = between(table.amplitude)
    return amplitude * factor.reshape(factor.shape + (1,) * (amplitude.ndim - 1))


def form_factor(polygon: jax.Array) -> jax.Array:
    """Integral of max(z, 0) / pi over the directions to a convex polygon [S, 3]: Lambert's sum over clipped edges."""
    starts, ends, leave, enter = clip_at_horizon(polygon)
    a, b = jnp.concatenate([starts, leave[None]]), jnp.concatenate([ends, enter[None]])
    cross = jnp.cross(a, b - a)
    length = jnp.linalg.norm(cross, axis=-1)
    angles = jnp.arctan2(length, jnp.sum(a * b, axis=-1))
    return jnp.abs(jnp.sum(angles * cross[:, 2] / jnp.where(length > 0, length, 1))) / (2 * np.pi)


def _nodes(width: float, polar: int = 64, azimuths: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Directions and solid angles of a quadrature of the sphere, half of its rings within about `width` of +z."""
    x, weights = legendre.leggauss(polar)
    s = (x + 1) / 2
    psi = 2 * np.arctan(width / 2 * s / (1 - s))
    dpsi = width * weights / 2 / (1 - s) ** 2 / (1 + (width / 2 * s / (1 - s)) ** 2)
    phi = 2 * np.pi * (np.arange(azimuths) + 0.5) / azimuths
    ring = np.stack([np.cos(phi), np.sin(phi), np.ones_like(phi)], axis=-1)
    height = np.stack([np.sin(psi), np.sin(psi), np.cos(psi)], axis=-1)
    solid_angles = np.repeat(np.sin(psi) * dpsi * 2 * np.pi / azimuths, azimuths)
    return (height[:, None] * ring).reshape(-1, 3), solid_angles
