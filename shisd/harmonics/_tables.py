"""Constant tables of the basis, made on the host in float64 and rounded once where they are used.

notation: p[l, m] = the normalised associated Legendre function with the Condon-Shortley phase, as in ISD15s Eq. 3-5:
y_l^m = sqrt(2) p[l, m] cos(m phi), p[l, 0], sqrt(2) p[l, m] sin(m phi) for order m > 0, m = 0, -m < 0.
"""

import functools

import numpy as np


@functools.cache
def recurrence(degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factors of ISD15s Eq. 4 and 5: p[m, m] = s[m] sin p[m-1, m-1], p[l, m] = a[l, m] cos p[l-1, m] - b[l, m] p[l-2, m].

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


@functools.cache
def zonal_norms(degree: int) -> np.ndarray:
    """sqrt((2l + 1) / 4 pi), the value of y_l^0 at its pole."""
    return np.sqrt((2 * np.arange(degree + 1) + 1) / (4 * np.pi))


@functools.cache
def bands(degree: int) -> np.ndarray:
    """The degree l of each coefficient."""
    return np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)


@functools.cache
def orders(degree: int) -> np.ndarray:
    """The order m of each coefficient."""
    return np.concatenate([np.arange(-l, l + 1) for l in range(degree + 1)])
