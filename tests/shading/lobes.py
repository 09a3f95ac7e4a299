"""Lobes for tests that need slices, not materials: no table is compiled for them."""

import jax.numpy as jnp
import numpy as np

from shisd import decomposition, shading
from shisd.harmonics import _tables
from shisd.shading import _views


def random_lobes(degree, dtype, colour=(), views=8, domain="sphere"):
    """Smooth random slices, even across the plane of view, as those of isotropic materials are."""
    l, m = _tables.bands(degree), _tables.orders(degree)
    start, change = np.random.default_rng(3).normal(size=(2, *colour, 1, len(l))) * (m >= 0) / (1 + l) ** 2
    theta = _views.elevations(views)[:, None]
    return lobes_of_slices((start + change * np.cos(theta)) * np.sin(theta) ** np.maximum(m, 0), dtype, domain)


def cosine_lobes(degree, dtype, views=8):
    """max(cos, 0) / pi above the horizon: a white Lambertian, exact from degree 1 on."""
    c = np.zeros((views, (degree + 1) ** 2))
    c[:, 2] = np.sqrt(4 * np.pi / 3) / np.pi
    return lobes_of_slices(c, dtype, "upper")


def lobes_of_slices(c, dtype, domain):
    degree = round(np.sqrt(c.shape[-1])) - 1
    basis = decomposition.RotatedZonalBasis(decomposition.optimized_directions(degree, dtype=dtype), degree)
    weights = basis.weights(c.astype(dtype))
    return shading.Lobes(basis, weights, jnp.zeros((), dtype), isotropic=True, domain=domain)
