"""Truth from independent libraries, which no code under test takes part in."""

import numpy as np
from scipy.special import sph_harm_y


def scipy_basis(directions, degree):
    """SciPy's complex harmonics, whose phase is Condon-Shortley's, as real ones: ISD15 Eq. 7."""
    d = np.asarray(directions, float)
    theta, phi = np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2]), np.arctan2(d[..., 1], d[..., 0])
    l = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    m = np.concatenate([np.arange(-k, k + 1) for k in range(degree + 1)])
    y = sph_harm_y(l, np.abs(m), theta[..., None], phi[..., None])
    return np.where(m == 0, y.real, np.sqrt(2) * np.where(m > 0, y.real, y.imag))


def triangle_rule(vertices, nodes):
    """Directions and signed solid angles that integrate over a spherical polygon smaller than a hemisphere.

    A fan of flat triangles from the middle, edges cut in arcs below half a radian; Gauss-Legendre in both collapsed
    coordinates, projected: area elements are det(a, b, c) s / |p|^3 at p = a + s (b - a + t (c - b)). Converges
    exponentially for smooth integrands, in extended precision.
    """
    unit = lambda x: x / np.sqrt(np.sum(x * x, axis=-1, keepdims=True))
    v = unit(np.asarray(vertices, np.longdouble))
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
