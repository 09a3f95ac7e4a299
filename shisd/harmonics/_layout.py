"""How coefficients are laid out: y_l^m at l (l + 1) + m, bands one after another."""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np

from shisd._typing import Array, Float


@functools.cache
def bands(degree: int) -> np.ndarray:
    """The degree l of each coefficient. Indices are int32 in either precision, so that no trace depends on the mode."""
    l = np.arange(degree + 1, dtype=np.int32)
    return np.repeat(l, 2 * l + 1)


@functools.cache
def orders(degree: int) -> np.ndarray:
    """The order m of each coefficient."""
    return np.concatenate([np.arange(-l, l + 1, dtype=np.int32) for l in range(degree + 1)])


def place(l: Any, m: Any, none: int | None = None) -> Any:
    """Where y_l^m stands; `none` where |m| > l, unless it is None and there are no such."""
    index = l * l + l + m
    return index if none is None else np.where(np.abs(m) <= l, index, none)


def of_order(degree: int, m: int) -> np.ndarray:
    """Where the coefficients of order m are, l = |m| ... degree."""
    return place(np.arange(abs(m), degree + 1), m)


def by_band(c: Float[Array, "*batch n"], degree: int) -> Float[Array, "*batch l m"]:
    """Coefficients by band and order m = -L ... L, zero where |m| > l."""
    l, m = np.arange(degree + 1, dtype=np.int32)[:, None], np.arange(-degree, degree + 1, dtype=np.int32)
    padded = jnp.concatenate([c, jnp.zeros_like(c[..., :1])], axis=-1)
    return padded[..., place(l, m, (degree + 1) ** 2).astype(np.int32)]
