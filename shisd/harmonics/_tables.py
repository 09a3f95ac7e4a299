"""Constant tables of the basis, made on the host in float64 and rounded once where they are used.

notation: p[l, m] = the normalised associated Legendre function with the Condon-Shortley phase, as in ISD15s Eq. 3-5:
y_l^m = sqrt(2) p[l, m] cos(m phi), p[l, 0], sqrt(2) p[l, m] sin(m phi) for order m > 0, m = 0, -m < 0.
"""

import functools
from collections.abc import Sequence

import numpy as np

from shisd.harmonics._layout import bands, orders, place

Gather = tuple[tuple[np.ndarray, np.ndarray], ...]


@functools.cache
def recurrence(degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factors of ISD15s Eq. 4, 5: p[m, m] = s[m] sin p[m-1, m-1], p[l, m] = a[l, m] cos p[l-1, m] - b[l, m] p[l-2, m].

    a[m+1, m] = sqrt(2m + 3) with b[m+1, m] = 0 is the second line of Eq. 4 in the form of Eq. 5.
    """
    l, m = np.meshgrid(np.arange(degree + 1.0), np.arange(degree + 1.0), indexing="ij")
    s = -np.sqrt((2 * l[:, 0] + 1) / np.maximum(2 * l[:, 0], 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        a = np.sqrt((2 * l + 1) * (2 * l - 1) / ((l + m) * (l - m)))
        b = np.sqrt((l + m - 1) * (l - m - 1) * (2 * l + 1) / ((l + m) * (l - m) * (2 * l - 3)))
    a, b = np.where(l > m, a, 0), np.where(l > m + 1, b, 0)
    return s, a, b


def associated_legendre(theta: np.ndarray, degree: int) -> np.ndarray:
    """p[l, m] at the polar angles `theta` [N], as [L+1, L+1, N] (zero for m > l), float64 on the host."""
    s, a, b = recurrence(degree)
    sin, cos = np.sin(theta), np.cos(theta)
    p = np.zeros((degree + 1, degree + 1, theta.size))
    p[0, 0] = np.sqrt(1 / (4 * np.pi))
    for m in range(1, degree + 1):
        p[m, m] = s[m] * sin * p[m - 1, m - 1]
    for l in range(1, degree + 1):
        p[l, :l] = a[l, :l, None] * cos * p[l - 1, :l]
        if l > 1:
            p[l, : l - 1] -= b[l, : l - 1, None] * p[l - 2, : l - 1]
    return p


def host_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """y_l^m at unit vectors [N, 3], as [N, (L+1)^2], float64 on the host."""
    x, y, z = directions.T
    m, l = orders(degree), bands(degree)
    p = associated_legendre(np.arctan2(np.hypot(x, y), z), degree)[l, np.abs(m)].T
    angle = np.outer(np.arctan2(y, x), np.abs(m))
    return p * np.where(m == 0, 1, np.sqrt(2) * np.where(m > 0, np.cos(angle), np.sin(angle)))


@functools.cache
def zonal_norms(degree: int) -> np.ndarray:
    """sqrt((2l + 1) / 4 pi), the value of y_l^0 at its pole."""
    return np.sqrt((2 * np.arange(degree + 1) + 1) / (4 * np.pi))


@functools.cache
def polar_series(degree: int) -> np.ndarray:
    """Fourier series of p in the polar angle, as [L+1, L+1, L+1] over (m, k, l).

    p[l, m](theta) = sum_k series[m, k, l] cos(k theta) for even m and sum_k series[m, k, l] sin(k theta) for odd m:
    sin^m times a polynomial of degree l - m in cos. Sampled at L + 2 midpoints, where the sums are orthogonal.
    """
    count = degree + 2
    theta = (np.arange(count) + 0.5) * np.pi / count
    p = associated_legendre(theta, degree)
    k_theta = np.outer(np.arange(degree + 1), theta)
    cos, sin = np.cos(k_theta) * 2 / count, np.sin(k_theta) * 2 / count
    cos[0] /= 2
    series = np.empty((degree + 1,) * 3)
    series[0::2] = np.einsum("kj,lmj->mkl", cos, p[:, 0::2], optimize=True)
    series[1::2] = np.einsum("kj,lmj->mkl", sin, p[:, 1::2], optimize=True)
    return series


@functools.cache
def gradient_terms(degree: int) -> tuple[list[tuple[int, int, float]], ...]:
    """The gradient of r^l y_l^m as a combination of y_(l-1): (row, column, factor) of the nonzero entries, for x, y, z.

    row is the index of (l, m), column that of (l-1, m'). From (d_x +- i d_y) r^l Y_l^m = +-k sqrt((l -+ m)(l -+ m - 1))
    r^(l-1) Y_(l-1)^(m +- 1) and d_z r^l Y_l^m = k sqrt(l^2 - m^2) r^(l-1) Y_(l-1)^m with k^2 = (2l+1)/(2l-1)
    (Hobson 1931, 89; checked against finite differences in the tests).
    """
    terms: tuple[list, ...] = ([], [], [])

    def add(axis: int, l: int, m: int, m_from: int, factor: float) -> None:
        if abs(m_from) < l and factor:
            terms[axis].append((place(l, m), place(l - 1, m_from), factor))

    for l in range(1, degree + 1):
        k = np.sqrt((2 * l + 1) / (2 * l - 1))
        for m in range(-l, l + 1):
            add(2, l, m, m, k * np.sqrt(l * l - m * m))
        up = k * np.sqrt(l * (l - 1)) / np.sqrt(2)
        add(0, l, 0, 1, up)
        add(1, l, 0, -1, up)
        for m in range(1, l + 1):
            up, down = k * np.sqrt((l - m) * (l - m - 1)) / 2, k * np.sqrt((l + m) * (l + m - 1)) / 2
            if m == 1:  # y_0 has no partner of order -0
                add(0, l, 1, 0, -np.sqrt(2) * down)
                add(1, l, -1, 0, -np.sqrt(2) * down)
            else:
                add(0, l, m, m - 1, -down)
                add(0, l, -m, 1 - m, -down)
                add(1, l, m, 1 - m, down)
                add(1, l, -m, m - 1, -down)
            add(0, l, m, m + 1, up)
            add(0, l, -m, -m - 1, up)
            add(1, l, m, -m - 1, up)
            add(1, l, -m, m + 1, -up)
    return terms


@functools.cache
def gradient_gather(degree: int, transpose: bool) -> tuple[Gather, ...]:
    """`gradient_terms` for x, y, z over the rows (or, transposed, over the columns)."""
    size = degree * degree if transpose else (degree + 1) ** 2
    gathers = []
    for axis in gradient_terms(degree):
        row, column, factor = [t[0] for t in axis], [t[1] for t in axis], [t[2] for t in axis]
        gathers.append(_gather(column, row, factor, size) if transpose else _gather(row, column, factor, size))
    return tuple(gathers)


@functools.cache
def generator_gather(degree: int) -> tuple[Gather, ...]:
    """Coefficients of the rotation rates: (G_i c) is the derivative of c under rotation about axis i = x, y, z.

    G_n = -i L_n with L_+- Y_l^m = sqrt((l -+ m)(l +- m + 1)) Y_l^(m +- 1), written for the real functions.
    """
    terms: tuple[list, ...] = ([], [], [])

    def add(axis: int, l: int, m_to: int, m_from: int, factor: float) -> None:
        if abs(m_to) <= l and factor:
            terms[axis].append((place(l, m_to), place(l, m_from), factor))

    for l in range(1, degree + 1):
        for m in range(-l, l + 1):
            add(2, l, m, -m, -float(m))
        a = np.sqrt(l * (l + 1) / 2)
        add(0, l, -1, 0, a)
        add(1, l, 1, 0, -a)
        for m in range(1, l + 1):
            a, b = np.sqrt((l - m) * (l + m + 1)) / 2, np.sqrt((l + m) * (l - m + 1)) / 2
            if m == 1:  # y_0 has no partner of order -0
                add(0, l, 0, -1, -np.sqrt(2) * b)
                add(1, l, 0, 1, np.sqrt(2) * b)
            else:
                add(0, l, 1 - m, m, b)
                add(0, l, m - 1, -m, -b)
                add(1, l, m - 1, m, b)
                add(1, l, 1 - m, -m, b)
            add(0, l, -m - 1, m, a)
            add(0, l, m + 1, -m, -a)
            add(1, l, m + 1, m, -a)
            add(1, l, -m - 1, -m, -a)
    size = (degree + 1) ** 2
    return tuple(_gather([t[0] for t in axis], [t[1] for t in axis], [t[2] for t in axis], size) for axis in terms)


def _gather(target: Sequence[int], source: Sequence[int], factor: Sequence[float], size: int) -> Gather:
    """A sparse matrix as (index, factor) pairs: (A v)[i] = sum over pairs of factor[i] * v[index[i]]."""
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    filled = np.zeros(size, int)
    for t, s, f in zip(target, source, factor, strict=True):
        if filled[t] == len(pairs):
            pairs.append((np.zeros(size, np.int32), np.zeros(size)))
        index, weight = pairs[filled[t]]
        index[t], weight[t] = s, f
        filled[t] += 1
    return tuple(pairs)


@functools.cache
def swap_matrices(degree: int) -> tuple[np.ndarray, ...]:
    """J_l of every band: y_l(x, z, y) = J_l y_l(x, y, z). Symmetric, orthogonal, its own inverse.

    From Wigner's d(pi/2), by its recurrence in degree at fixed orders (Varshalovich et al. 1988, 4.8.2, at cos = 0),
    since the swap is the quarter turn about x followed by y -> -y, and a turn about x is one about y seen from
    Rz(pi/2).
    """
    m = np.arange(-degree, degree + 1)
    row, column = np.meshgrid(m, m, indexing="ij")
    start = np.maximum(np.abs(row), np.abs(column))
    d_start = _wigner_start(degree)
    before, now, matrices = np.zeros_like(d_start), np.zeros_like(d_start), []
    for l in range(degree + 1):
        if l > 0:
            k = l - 1  # d^l from d^(l-1) and d^(l-2)
            with np.errstate(invalid="ignore", divide="ignore"):
                root = np.sqrt(np.maximum((l * l - row**2) * (l * l - column**2), 0.0))
                back = np.sqrt(np.maximum((k * k - row**2) * (k * k - column**2), 0.0))
                after = (
                    (-(2 * k + 1) * row * column * now - l * back * before) / (k * root) if k else np.zeros_like(now)
                )
            before, now = now, np.where(start < l, np.nan_to_num(after), 0.0)
            if l == 1:
                now[degree, degree] = 0.0  # d^1_00 = cos(pi/2)
        now = np.where(start == l, d_start, now)
        inner = slice(degree - l, degree + l + 1)
        matrices.append(_swap_from_wigner(now[inner, inner], l))
    return tuple(matrices)


def quarter_mirror(l: int) -> np.ndarray:
    """x and y exchanged, phi -> pi/2 - phi, on one band: cos(m phi) and sin(m phi) of each order are mixed."""
    m = np.arange(-l, l + 1)
    cos, sin = np.round(np.cos(np.abs(m) * np.pi / 2)), np.round(np.sin(np.abs(m) * np.pi / 2))
    mirror = np.zeros((2 * l + 1,) * 2)
    mirror[l + m, l + m] = np.where(m < 0, -cos, cos)
    mirror[l + m, l - m] += np.where(m == 0, 0, sin)
    return mirror


def _wigner_start(degree: int) -> np.ndarray:
    """d^j_(m, m')(pi/2) with j = max(|m|, |m'|), for every m, m': 2^-j sqrt(binomial(2j, j + m')) up to a sign."""
    d = np.zeros((2 * degree + 1,) * 2)
    for j in range(degree + 1):
        value = np.empty(2 * j + 1)  # over m' = -j ... j
        value[2 * j] = 0.5**j
        for i in range(2 * j, 0, -1):  # from m' = i - j to m' - 1
            value[i - 1] = value[i] * np.sqrt(i / (2 * j - i + 1))
        m = np.arange(-j, j + 1)
        inner = slice(degree - j, degree + j + 1)
        d[degree + j, inner] = value * (-1.0) ** (j - m)  # d^j_(j, m')
        d[degree - j, inner] = value
        d[inner, degree + j] = value
        d[inner, degree - j] = value * (-1.0) ** (j + m)
    return d


def _swap_from_wigner(d: np.ndarray, l: int) -> np.ndarray:
    """J_l from d^l(pi/2): real form of the turn about y, turned by Rz(-pi/2) . Rz(pi/2), then y -> -y."""
    turn = np.zeros_like(d)  # the quarter turn about y keeps cos(m phi) and sin(m phi) functions apart
    p = np.arange(1, l + 1)
    sign = (-1.0) ** p
    plus, minus = d[np.ix_(l + p, l + p)], d[np.ix_(l + p, l - p)] * sign
    turn[l, l] = d[l, l]
    turn[l, l + 1 :] = np.sqrt(2) * d[l, l + 1 :]
    turn[l + 1 :, l] = np.sqrt(2) * d[l + 1 :, l]
    turn[np.ix_(l + p, l + p)] = plus + minus
    turn[np.ix_(l - p, l - p)] = plus - minus
    z = np.zeros_like(d)  # Rz(pi/2)
    m = np.arange(-l, l + 1)
    z[l + m, l + m] = np.round(np.cos(m * np.pi / 2))
    z[l + m, l - m] -= np.round(np.sin(m * np.pi / 2))
    return np.where(m < 0, -1.0, 1.0)[:, None] * (z.T @ turn @ z)
