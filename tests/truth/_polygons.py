"""Integrals over spherical polygons: by quadrature of the area, and by lines along edges, in extended precision."""

import numpy as np

from tests.truth._derivatives import derivative
from tests.truth._harmonics import harmonics
from tests.truth._vectors import tangential, unit


def triangle_rule(vertices, nodes):
    """Directions and signed solid angles that integrate over a spherical polygon smaller than a hemisphere.

    A fan of flat triangles from the middle, edges cut in arcs below half a radian; Gauss-Legendre in both collapsed
    coordinates, projected: area elements are det(a, b, c) s / |p|^3 at p = a + s (b - a + t (c - b)). Converges
    exponentially for smooth integrands, in extended precision.
    """
    v = unit(vertices)
    apex = unit(v.mean(axis=0))
    x, w = np.polynomial.legendre.leggauss(nodes)
    x, w = (x + 1) / 2, w / 2
    s, t = (g.reshape(-1, 1) for g in np.meshgrid(x, x, indexing="ij"))
    weight = np.outer(w, w).reshape(-1)
    points, areas = [], []
    for a, b in zip(v, np.roll(v, -1, axis=0), strict=True):
        chord = np.cross(a, b - a)
        angle = np.arctan2(np.sqrt(chord @ chord), a @ b)
        parts = max(1, int(np.ceil(angle / 0.5)))
        at = [np.sin((1 - k / parts) * angle) * a + np.sin(k / parts * angle) * b for k in range(1, parts)]
        arc = [a, *(unit(p) for p in at), b]
        for start, stop in zip(arc[:-1], arc[1:], strict=True):
            p = apex + s * (start - apex + t * (stop - start))
            length = np.sqrt(np.sum(p * p, axis=1))
            points.append(p / length[:, None])
            areas.append(weight * (apex @ np.cross(start - apex, stop - start)) * s[:, 0] / length**3)
    return np.concatenate(points), np.concatenate(areas)


def zonal_moments(vertices, axes, degree, nodes):
    """Integrals of P_l(w . axis) over a polygon [K, L+1], by `triangle_rule` and Legendre's recurrence."""
    w, area = triangle_rule(vertices, nodes)
    d = np.asarray(axes, np.longdouble)
    x = w @ (d / np.sqrt(np.sum(d * d, axis=1, keepdims=True))).T
    before, p, moments = np.zeros_like(x), np.ones_like(x), []
    for l in range(degree + 1):
        moments.append(area @ p)
        before, p = p, ((2 * l + 1) * x * p - l * before) / (l + 1)
    return np.stack(moments, axis=-1).astype(float)


def solid_angle(vertices):
    """Of a polygon [S, 3] that fits in a hemisphere, signed by its winding: a fan of triangles, in extended precision.

    Each by the angle of van Oosterom and Strackee, with differences to the first vertex in place of products of three.
    """
    v = unit(vertices)
    a, b, c = v[:1], v[1:-1], v[2:]
    volume, along = np.sum(a * np.cross(b - a, c - a), axis=-1), 1 + np.sum(a * b + b * c + c * a, axis=-1)
    return 2 * np.sum(np.arctan2(volume, along))


def part_above(vertices, *normals):
    """The part of a polygon [S, 3] where w . normal >= 0 for each of the normals: edges one after another."""
    v = unit(vertices)
    for normal in normals:
        height, kept = v @ np.asarray(normal, np.longdouble), []
        for a, b, h, k in zip(v, np.roll(v, -1, axis=0), height, np.roll(height, -1), strict=True):
            kept += [a] * bool(h >= 0) + [unit(abs(k) * a + abs(h) * b)] * bool(h * k < 0)
        v = np.array(kept).reshape(-1, 3)
    return v


def edge_coefficients(vertices, degree, nodes=16, halvings=2):
    """Integrals [n] of the harmonics over a polygon [S, 3] from lines along its edges, in extended precision.

    y_lm is -1/(l(l+1)) times its Laplacian, so its integral is that of n . grad y_lm along the edges over l(l+1).
    """
    p, line = _edge_lines(vertices, nodes, halvings)
    _, slopes = harmonics(p, degree)
    l = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    integrals = np.einsum("pni,pi->n", slopes, line) / np.maximum(l * (l + 1), 1)
    integrals[0] = solid_angle(vertices) / np.sqrt(4 * np.arctan2(np.longdouble(1), 0) * 2)
    return integrals


def edge_moments(vertices, axes, degree, nodes=16, halvings=2):
    """Integrals [K, L+1] of P_l(w . axis) over a polygon by the same lines: of P_l'(w . axis) n . axis over l(l+1)."""
    p, line = _edge_lines(vertices, nodes, halvings)
    d = unit(axes)
    u, along = p @ d.T, line @ d.T
    legendre, slope = [np.ones_like(u), u], [np.zeros_like(u), np.ones_like(u)]
    for l in range(2, degree + 1):
        legendre.append(((2 * l - 1) * u * legendre[-1] - (l - 1) * legendre[-2]) / l)
        slope.append(slope[-2] + (2 * l - 1) * legendre[-2])
    rest = [np.sum(slope[l] * along, axis=0) / (l * (l + 1)) for l in range(1, degree + 1)]
    return np.stack([np.full(len(d), solid_angle(vertices)), *rest], axis=-1)


def moment_slopes(vertices, axes, weights, size):
    """Derivatives of the sum of weights [K, L+1] times moments of a polygon, whose angular size is about `size`.

    Along two random motions of the vertices and two of the axes (arguments 0 and 1): (argument, motion, derivative).
    """
    degree = weights.shape[1] - 1
    l = np.arange(degree + 1)
    bands = np.repeat(l, 2 * l + 1)
    scale = weights * 4 * np.pi / (2 * l + 1)

    def total(integrals, y):
        return np.sum((y * integrals) @ (bands[:, None] == l) * scale)

    v, d = np.asarray(vertices, np.longdouble), np.asarray(axes, np.longdouble)
    y, integrals = harmonics(d, degree)[0], edge_coefficients(v, degree)
    rng, step, tries = np.random.default_rng(4), 1e-4 * min(1.0, float(size)), []
    for _ in range(2):
        move = tangential(rng, v)
        moved = lambda t, move=move: total(edge_coefficients(v + t * move, degree), y)
        tries.append((0, move, derivative(moved, step)))
        move = tangential(rng, d)
        turned = lambda t, move=move: total(integrals, harmonics(d + t * move, degree)[0])
        tries.append((1, move, derivative(turned, 1e-4)))
    return tries


def _edge_lines(vertices, nodes, halvings):
    """Points on the edges of a polygon, and n ds there with n the inward normal, both [N, 3].

    On chords p(t) = a + t (b - a) of parts of the edges, with n ds = (a x b) dt / |p|^2.
    """
    v = unit(vertices)
    for _ in range(halvings):
        v = np.stack([v, unit(v + np.roll(v, -1, axis=0))], axis=1).reshape(-1, 3)
    end = np.roll(v, -1, axis=0)
    x, w = np.polynomial.legendre.leggauss(nodes)
    p = v[:, None] + ((x + 1) / 2)[:, None] * (end - v)[:, None]
    line = np.cross(v, end - v)[:, None] * (w / 2)[:, None] / np.sum(p * p, axis=-1, keepdims=True)
    return unit(p.reshape(-1, 3)), line.reshape(-1, 3)
