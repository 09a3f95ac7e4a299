"""Fits above the horizon: what an expansion is below it does not matter where light is cut off there."""

import functools

import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._typing import Array, Float
from shisd.harmonics.internal import associated_legendre, of_order

RIDGE = 1e-6  # of fits above the horizon


def fit_above(c: Float[Array, "*batch n"], ridge: float) -> Float[Array, "*batch n"]:
    """Expansions that fit functions above the horizon, from projections of these functions, which vanish below it."""
    modes, shares = hemisphere_modes(_checks.degree_of(c.shape[-1]))
    modes = jnp.asarray(modes, c.dtype)
    return ((c @ modes) * jnp.asarray(1 / (shares + ridge), c.dtype).reshape((1,) * (c.ndim - 1) + (-1,))) @ modes.T


@functools.cache
def hemisphere_modes(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal expansions [n, n], in columns, orthogonal on the upper hemisphere too, and their shares of it.

    The eigenvectors of the matrix H of integrals of y_i y_j above the horizon, one block for every order m. With b the
    projection of a function that vanishes below, the least squares fit above, regularised, is (H + ridge)^-1 b.
    """
    modes, shares = np.zeros(((degree + 1) ** 2,) * 2), np.zeros((degree + 1) ** 2)
    blocks = hemisphere_blocks(degree)
    for m in range(-degree, degree + 1):
        own = of_order(degree, m)
        values, vectors = np.linalg.eigh(blocks[abs(m)])
        modes[np.ix_(own, own)] = vectors
        shares[own] = np.maximum(values, 0)
    return modes, shares


@functools.cache
def hemisphere_blocks(degree: int) -> list[np.ndarray]:
    """For every order m, integrals above the horizon of products of y_l^m, rows and columns l = m ... degree."""
    z, weight = unit_gauss(degree + 1)
    p = associated_legendre(np.arccos(z), degree)  # a product of two of one order is a polynomial of z
    return [2 * np.pi * (p[m:, m] * weight) @ p[m:, m].T for m in range(degree + 1)]


@functools.cache
def unit_gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on [0, 1]."""
    node, weight = np.polynomial.legendre.leggauss(count)
    return (node + 1) / 2, weight / 2
