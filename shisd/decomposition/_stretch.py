"""Linear maps of directions that stretch the sphere, by the logarithm of their metric.

An expansion beyond a map A, |A w|^-3 det(A) f(A w / |A w|), depends on A^T A alone, for f may be turned as one likes;
and not on its scale. So a map has five numbers, or three where it is even in y, and every choice of them is a map: A =
exp(S / 2), S symmetric and without trace, given by the expansion of degree 2 that it is,

    w^T S w = sum over m of s_m y_2^m(w),

which turns as expansions do. Between maps of lobes that only turn, S goes along smoothly.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from shisd._numerics import normalize
from shisd._typing import Array, Float

SIZE = 5
_DOUBLINGS = 6
_A, _B = math.sqrt(15 / (4 * math.pi)) / 2, math.sqrt(5 / (16 * math.pi))
# rows xx, xy, xz, yy, yz, zz of S from s_m, m = -2 ... 2
_ENTRIES = np.array([
    [0, 0, -_B, 0, _A],
    [_A, 0, 0, 0, 0],
    [0, 0, 0, -_A, 0],
    [0, 0, -_B, 0, -_A],
    [0, -_A, 0, 0, 0],
    [0, 0, 2 * _B, 0, 0],
])  # fmt: skip
_FULL = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # where an entry of the matrix is in that order

Symmetric = tuple[Array, ...]  # entries xx, xy, xz, yy, yz, zz


def stretch(s: Array, *, even: bool = False) -> Array:
    """A = exp(S / 2) [3, 3, ...] of s [5, ...]; static `even`: s_m = 0 for m < 0, and A keeps the plane y = 0."""
    half = [sum(float(f) / 2 * s[m] for m, f in enumerate(row) if f) for row in _ENTRIES]
    half = [x + jnp.zeros_like(s[0]) for x in half]
    entries = _exp_even(*half) if even else _exp(tuple(half))
    return jnp.stack([jnp.stack([entries[i] for i in row]) for row in _FULL])


def log_stretch(a: Float[Array, "3 3"]) -> Float[Array, " 5"]:
    """s of the map with the metric of A, but for its scale."""
    size, axes = jnp.linalg.eigh(a.T @ a)
    return from_matrix((axes * jnp.log(size)[None]) @ axes.T)


def from_matrix(matrix: Float[Array, "3 3"]) -> Float[Array, " 5"]:
    """s of a symmetric S, without its trace."""
    upper = jnp.stack([matrix[i, j] for i, j in zip(*np.triu_indices(3), strict=True)])
    return jnp.asarray(np.linalg.pinv(_ENTRIES), matrix.dtype) @ upper


def _exp_even(xx: Array, xy: Array, xz: Array, yy: Array, yz: Array, zz: Array) -> Symmetric:
    mean, difference = (xx + zz) / 2, (xx - zz) / 2
    square = difference**2 + xz**2
    small = square < 1e-4
    root = jnp.sqrt(jnp.where(small, 1, square))
    cosh = jnp.where(small, 1 + square / 2 * (1 + square / 12), jnp.cosh(root))
    sinh = jnp.where(small, 1 + square / 6 * (1 + square / 20), jnp.sinh(root) / root)
    scale = jnp.exp(mean)
    return (
        scale * (cosh + sinh * difference), xy, scale * sinh * xz, jnp.exp(yy), yz, scale * (cosh - sinh * difference)
    )  # fmt: skip


def _exp(x: Symmetric) -> Symmetric:
    """By the series of exp(x) - 1 of the matrix over 2^6, doubled as often: e -> 2 e + e^2 keeps the digits of small x.

    All factors commute, so products are symmetric.
    """
    x = tuple(a / 2**_DOUBLINGS for a in x)
    one, zero = jnp.ones_like(x[0]), jnp.zeros_like(x[0])
    identity = (one, zero, zero, one, zero, one)
    result = x
    for k in range(10 if one.dtype.itemsize > 4 else 6, 1, -1):
        result = _product(x, tuple(i + p / k for i, p in zip(identity, result, strict=True)))
    for _ in range(_DOUBLINGS):
        result = tuple(2 * e + p for e, p in zip(result, _product(result, result), strict=True))
    return tuple(i + e for i, e in zip(identity, result, strict=True))


def _product(a: Symmetric, b: Symmetric) -> Symmetric:
    rows = lambda m: [[m[i] for i in row] for row in _FULL]
    left, right = rows(a), rows(b)
    i, j = np.triu_indices(3)
    return tuple(
        left[p][0] * right[0][q] + left[p][1] * right[1][q] + left[p][2] * right[2][q]
        for p, q in zip(i, j, strict=True)
    )


def map_directions(a: Float[Array, "3 3"], w: Float[Array, "*batch 3"]) -> tuple[Array, Array]:
    """Unit vectors mapped, and the solid angle there for that here."""
    mapped = w @ a.T
    length = jnp.sqrt(jnp.sum(mapped**2, axis=-1, keepdims=True))
    return mapped / length, jnp.linalg.det(a) / length[..., 0] ** 3


def moments_starts(w: Array, y: Float[Array, "*colour N"], areas: Array, even: bool) -> Float[Array, "4 5"]:
    """Maps that widen a lobe of samples y until it fills the sphere, and half, a quarter and an eighth as far."""
    mass = jnp.sum(jnp.abs(y.reshape(-1, len(w))), axis=0) * areas
    mass = mass / jnp.sum(mass)
    plane = jnp.asarray([1.0, 0 if even else 1, 1], w.dtype)
    z = normalize(mass @ w * plane)
    aside = w - (w @ z)[:, None] * z[None]
    spread = (aside * mass[:, None]).T @ aside
    if even:
        spread = spread * plane[:, None] * plane[None] + jnp.diag((1 - plane) * spread[1, 1])
    extent, axes = jnp.linalg.eigh(spread)  # that of z first, which is 0
    extent = jnp.concatenate([jnp.ones_like(extent[:1]), jnp.maximum(extent[1:], 1e-12)])
    size = -jnp.log(extent)[None] - jnp.log(4.0 ** jnp.arange(4, dtype=w.dtype))[:, None]  # logarithms of the metric
    size = jnp.maximum(size, 0).at[:, 0].set(0)
    matrices = jnp.einsum("ik,sk,jk->sij", axes, size, axes)
    return jax.vmap(from_matrix)(matrices)
