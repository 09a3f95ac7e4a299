"""Quadrature on the sphere: rows of constant polar angle, uniform in azimuth.

Rows are either the nodes of Gauss and Legendre, which integrate the highest degree for their number, or those of
Fejér's first rule, which are the pixel centres of an equirectangular image. Both are made on the host in float64.

notation: theta_j, w_j = polar angle and weight of row j, sum_j w_j f(cos theta_j) ~ integral of f(z) dz over [-1, 1].
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._typing import Array, DTypeLike, Float


def sphere_rule(degree: int, *, dtype: DTypeLike | None = None) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
    """Points and weights that integrate every spherical harmonic up to `degree`, inclusive, exactly over the sphere.

    Arguments: static `degree` >= 0; `dtype`, JAX's default float unless given. Returns unit directions [N, 3] and
    positive weights [N] in sr, whose sum is 4 pi; N = ceil((degree + 1) / 2) (degree + 1), rows of equal z one by one.
    Accuracy: made in float64 and rounded once; 1e-15 of the integral of |f| in float64.
    Source: the product of Gauss-Legendre nodes in z and the trapezoidal rule in azimuth.
    """
    degree = _checks.degree(degree)
    directions, weights = _product_rule(degree)
    dtype = jax.dtypes.canonicalize_dtype(float) if dtype is None else dtype
    return jnp.asarray(directions, dtype), jnp.asarray(weights, dtype)


@functools.cache
def _product_rule(degree: int) -> tuple[np.ndarray, np.ndarray]:
    theta, weights = gauss_rows(degree // 2 + 1)
    columns = degree + 1
    return grid_directions(theta, columns).reshape(-1, 3), np.repeat(weights, columns) * (2 * np.pi / columns)


def grid_directions(theta: np.ndarray, columns: int) -> np.ndarray:
    """Unit vectors [rows, columns, 3] at the polar angles `theta` and the azimuths 2 pi (i + 1/2) / columns."""
    theta, phi = np.meshgrid(theta, azimuths(columns), indexing="ij")
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def azimuths(columns: int) -> np.ndarray:
    """The azimuths 2 pi (i + 1/2) / columns."""
    return 2 * np.pi * (np.arange(columns) + 0.5) / columns


@functools.cache
def gauss_rows(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """theta_j and w_j of Gauss-Legendre, exact for polynomials in z of degree < 2 rows.

    Newton's method in theta, P_n from its difference form in t = 1 - cos(theta) (see `_zh`), so that angles and weights
    are exact to rounding near the poles too: 1e-14 of each weight at 400 rows, where numpy's `leggauss` has 6e-10.
    """
    theta = np.pi * (np.arange((rows + 1) // 2) + 0.75) / (rows + 0.5)
    slope = np.ones_like(theta)
    for _ in range(6):
        t = 2 * np.sin(theta / 2) ** 2
        p, step = np.ones_like(t), -t  # P_l and P_(l+1) - P_l
        for l in range(1, rows):
            p = p + step
            step = (l * step - (2 * l + 1) * t * p) / (l + 1)
        p = p + step
        slope = rows * (step - t * p) / np.sin(theta)  # dP_n/dtheta = n (cos(theta) P_n - P_(n-1)) / sin(theta)
        theta = theta - p / slope
    weights = 2 / slope**2
    mirrored = slice(None, rows // 2)
    return np.append(theta, np.pi - theta[mirrored][::-1]), np.append(weights, weights[mirrored][::-1])


@functools.cache
def fejer_rows(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """theta_j = pi (j + 1/2) / rows and w_j of Fejér's first rule, exact for polynomials in z of degree < rows."""
    theta = np.pi * (np.arange(rows) + 0.5) / rows
    k = np.arange(1, (rows - 1) // 2 + 1)
    return theta, 2 / rows * (1 - 2 * np.cos(2 * np.outer(theta, k)) @ (1 / (4.0 * k * k - 1)))
