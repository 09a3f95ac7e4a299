"""Slices for tests that need no material: no table is compiled for them."""

import jax.numpy as jnp
import numpy as np

from shisd import shading
from shisd.harmonics.internal import bands, orders
from shisd.shading import _views


def random_slices(degree, dtype, colour=(), views=8, domain="sphere"):
    """Smooth random slices, even across the plane of view, as those of isotropic materials are."""
    l, m = bands(degree), orders(degree)
    start, change = np.random.default_rng(3).normal(size=(2, *colour, 1, len(l))) * (m >= 0) / (1 + l) ** 2
    theta = _views.elevations(views)[:, None]
    return slices_of((start + change * np.cos(theta)) * np.sin(theta) ** np.maximum(m, 0), dtype, domain)


def cosine_slices(degree, dtype, views=8):
    """max(cos, 0) / pi above the horizon: a white Lambertian, exact from degree 1 on."""
    c = np.zeros((views, (degree + 1) ** 2))
    c[:, 2] = np.sqrt(4 * np.pi / 3) / np.pi
    return slices_of(c, dtype, "upper")


def slices_of(c, dtype, domain):
    return shading.Slices(jnp.asarray(c, dtype), domain=domain)
