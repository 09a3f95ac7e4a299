"""Energies of the bands of slices, and the degree that they need."""

import functools
from typing import Literal

import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._typing import Array, Float
from shisd.harmonics.internal import bands, of_order
from shisd.shading import _views
from shisd.shading.slices._upper import RIDGE, hemisphere_blocks


def band_energies(c: Float[Array, "*batch n"], domain: Literal["sphere", "upper"]) -> Float[Array, "*batch l"]:
    """The squared norm on the domain that each band adds to the best fit by the lower ones."""
    degree = _checks.degree_of(c.shape[-1])
    if domain == "upper":
        c = c @ jnp.asarray(_successive(degree), c.dtype)
    member = bands(degree)[:, None] == np.arange(degree + 1)
    return jnp.square(c) @ jnp.asarray(member, c.dtype)


def needed_degree(energies: np.ndarray, tolerance: float, worst: bool) -> int:
    """The smallest degree that leaves at most `tolerance` of the RMS, or of the worst view, by [colour, V, (A,) l]."""
    if not worst:
        share = np.sin(2 * _views.elevations(energies.shape[1]))  # of a sphere's picture
        energies = np.einsum("v,cval->cl", share, energies.reshape(*energies.shape[:2], -1, energies.shape[-1]))
    above = np.cumsum(energies[..., ::-1], axis=-1)[..., ::-1]  # of bands l and higher
    needed = np.any(above > tolerance**2 * above[..., :1], axis=tuple(range(above.ndim - 1)))
    return max(int(np.count_nonzero(needed)) - 1, 0)


@functools.cache
def _successive(degree: int) -> np.ndarray:
    """Transposed, from coefficients to those by functions orthonormal above the horizon, made of y_l^m by rising l."""
    table, blocks = np.zeros(((degree + 1) ** 2,) * 2), hemisphere_blocks(degree)
    for m in range(-degree, degree + 1):
        index = of_order(degree, m)
        table[np.ix_(index, index)] = np.linalg.cholesky(blocks[abs(m)] + RIDGE * np.eye(len(index)))
    return table
