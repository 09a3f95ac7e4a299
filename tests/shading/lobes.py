"""Lobes for tests that need slices, not materials: no table is compiled for them."""

import jax.numpy as jnp
import numpy as np

from shisd import decomposition, shading
from shisd.harmonics import _tables
from shisd.shading import _views


def random_lobes(degree, dtype, colour=(), views=8):
    """Smooth random slices, even across the plane of view, as those of isotropic materials are."""
    basis = decomposition.RotatedZonalBasis(decomposition.optimized_directions(degree, dtype=dtype), degree)
    l, m = _tables.bands(degree), _tables.orders(degree)
    start, change = np.random.default_rng(3).normal(size=(2, *colour, 1, len(l))) * (m >= 0) / (1 + l) ** 2
    theta = _views.elevations(views)[:, None]
    c = (start + change * np.cos(theta)) * np.sin(theta) ** np.maximum(m, 0)
    return shading.Lobes(basis, basis.weights(c.astype(dtype)), jnp.zeros((), dtype), isotropic=True)
