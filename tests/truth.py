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


def harmonics(directions, degree):
    """Real harmonics [N, n] of unit vectors along `directions`, and their derivatives along the sphere [N, n, 3].

    The normalised recurrence in degree (ISD15s Eq. 3-5) and its derivative, Cartesian, in extended precision: y_l^m is
    a polynomial in z times the real or imaginary part of (x + i y)^m, so poles are ordinary points.
    """
    u = np.asarray(directions, np.longdouble)
    u = u / np.max(np.abs(u), axis=-1, keepdims=True)
    u = u / np.sqrt(np.sum(u * u, axis=-1, keepdims=True))
    x, y, z = u.T
    m = np.arange(degree + 1)
    power = [np.ones_like(x), np.zeros_like(x)]
    cos, sin = [power[0]], [power[1]]
    for _ in range(degree):
        power = [power[0] * x - power[1] * y, power[0] * y + power[1] * x]
        cos.append(power[0])
        sin.append(power[1])
    cos, sin = np.stack(cos), np.stack(sin)  # [m, N]
    less = lambda wave: m[:, None] * np.concatenate([0 * wave[:1], wave[:-1]])  # m (x + i y)^(m-1)
    q = np.zeros((3, degree + 1, len(x)), np.longdouble)  # degrees l-2, l-1, l
    dq = np.zeros_like(q)
    values = np.zeros(((degree + 1) ** 2, len(x)), np.longdouble)
    slopes = np.zeros((3, *values.shape), np.longdouble)
    for l in range(degree + 1):
        k = m[:l].astype(np.longdouble)[:, None]
        q, dq = np.roll(q, -1, axis=0), np.roll(dq, -1, axis=0)
        a, b = np.sqrt((4 * l * l - 1) / (l * l - k * k)), np.sqrt(((l - 1) ** 2 - k * k) / abs(4 * (l - 1) ** 2 - 1))
        q[2, :l] = a * (z * q[1, :l] - b * q[0, :l])
        dq[2, :l] = a * (q[1, :l] + z * dq[1, :l] - b * dq[0, :l])
        one = np.longdouble(1)
        q[2, l] = -np.sqrt((2 * l + one) / (2 * l)) * q[1, l - 1] if l else 1 / np.sqrt(4 * np.arctan2(one, 0) * 2)
        dq[2, l] = 0
        scale = np.where(np.arange(l + 1) > 0, np.sqrt(2 * one), one)[:, None]
        for sign, wave, wave_x, wave_y in ((1, cos, less(cos), -less(sin)), (-1, sin, less(sin), less(cos))):
            at = l * l + l + sign * m[: l + 1]
            at, take = (at, slice(0, l + 1)) if sign > 0 else (at[1:], slice(1, l + 1))
            p, dp = scale[take] * q[2, take], scale[take] * dq[2, take]
            values[at] = p * wave[take]
            slopes[:, at] = p * wave_x[take], p * wave_y[take], dp * wave[take]
    slopes = np.moveaxis(slopes, 0, -1)
    slopes = slopes - np.sum(slopes * u, axis=-1, keepdims=True) * u
    return values.T, np.swapaxes(slopes, 0, 1)


def solid_angle(vertices):
    """Of a polygon [S, 3] that fits in a hemisphere, signed by its winding: a fan of triangles, in extended precision.

    Each by the angle of van Oosterom and Strackee, with differences to the first vertex in place of products of three.
    """
    v = _unit(vertices)
    a, b, c = v[:1], v[1:-1], v[2:]
    volume, along = np.sum(a * np.cross(b - a, c - a), axis=-1), 1 + np.sum(a * b + b * c + c * a, axis=-1)
    return 2 * np.sum(np.arctan2(volume, along))


def part_above(vertices, *normals):
    """The part of a polygon [S, 3] where w . normal >= 0 for each of the normals: edges one after another."""
    v = _unit(vertices)
    for normal in normals:
        height, kept = v @ np.asarray(normal, np.longdouble), []
        for a, b, h, k in zip(v, np.roll(v, -1, axis=0), height, np.roll(height, -1), strict=True):
            kept += [a] * bool(h >= 0) + [_unit(abs(k) * a + abs(h) * b)] * bool(h * k < 0)
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
    d = _unit(axes)
    u, along = p @ d.T, line @ d.T
    legendre, slope = [np.ones_like(u), u], [np.zeros_like(u), np.ones_like(u)]
    for l in range(2, degree + 1):
        legendre.append(((2 * l - 1) * u * legendre[-1] - (l - 1) * legendre[-2]) / l)
        slope.append(slope[-2] + (2 * l - 1) * legendre[-2])
    rest = [np.sum(slope[l] * along, axis=0) / (l * (l + 1)) for l in range(1, degree + 1)]
    return np.stack([np.full(len(d), solid_angle(vertices)), *rest], axis=-1)


def _edge_lines(vertices, nodes, halvings):
    """Points on the edges of a polygon, and n ds there with n the inward normal, both [N, 3].

    On chords p(t) = a + t (b - a) of parts of the edges, with n ds = (a x b) dt / |p|^2.
    """
    v = _unit(vertices)
    for _ in range(halvings):
        v = np.stack([v, _unit(v + np.roll(v, -1, axis=0))], axis=1).reshape(-1, 3)
    end = np.roll(v, -1, axis=0)
    x, w = np.polynomial.legendre.leggauss(nodes)
    p = v[:, None] + ((x + 1) / 2)[:, None] * (end - v)[:, None]
    line = np.cross(v, end - v)[:, None] * (w / 2)[:, None] / np.sum(p * p, axis=-1, keepdims=True)
    return _unit(p.reshape(-1, 3)), line.reshape(-1, 3)


def _unit(vectors):
    x = np.asarray(vectors, np.longdouble)
    return x / np.sqrt(np.sum(x * x, axis=-1, keepdims=True))


_CENTRAL = {-3: -1 / 60, -2: 3 / 20, -1: -3 / 4, 1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
_FORWARD = {0: -49 / 20, 1: 6, 2: -15 / 2, 3: 20 / 3, 4: -15 / 4, 5: 6 / 5, 6: -1 / 6}


def derivative(function, step, *, forward=False):
    """The derivative of function(t) at 0, in extended precision: differences of sixth order, central or forward."""
    rule = _FORWARD if forward else _CENTRAL
    return sum(np.longdouble(weight) * function(k * step) for k, weight in rule.items()) / np.longdouble(step)
