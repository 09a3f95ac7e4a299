"""Expansions of functions on rays from an axis, against the same expansions rotated."""

import jax.numpy as jnp
import numpy as np
import pytest

from shisd import harmonics
from shisd.harmonics.internal import gauss_rows, orders, ray_tables, ray_waves, sums_about, turned_from_axis
from tests.marks import FLOAT32_FIRST


@FLOAT32_FIRST
@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("degree", [1, 5, 8])
def test_sums_over_rays_are_turned_from_the_axis(degree, even, dtype, rng):
    c = rng.normal(size=(2, (degree + 1) ** 2)).astype(dtype)
    c = np.where(orders(degree) < 0, 0, c).astype(dtype) if even else c
    psi, weight = (x[None, :].astype(dtype) for x in gauss_rows(degree + 1))
    chi = (np.arange(2 * degree + 1)[:, None] * (2 * np.pi / (2 * degree + 1))).astype(dtype)
    w = np.stack(np.broadcast_arrays(np.sin(psi) * np.cos(chi), np.sin(psi) * np.sin(chi), np.cos(psi)), axis=-1)
    values = np.asarray(harmonics.evaluate(c[:, None, None], w)) * weight * dtype.type(2 * np.pi / (2 * degree + 1))
    waves = ray_waves(jnp.cos(psi[0]), jnp.sin(psi[0]), degree)
    along = jnp.einsum("ky,fxy->xkf", waves, jnp.asarray(values))
    ends = (degree,)  # the rays in two groups, whose sums add up to that of all
    sums = sums_about(along, jnp.cos(chi[:, 0]), jnp.sin(chi[:, 0]), even, ends)
    sums = sums[..., :2] + sums[..., 2:]

    theta, phi = np.array([0.3, 2.0], dtype), np.zeros(2, dtype) if even else np.array([1.0, 4.0], dtype)
    tables = ray_tables(degree, dtype, even)
    pair = lambda x: (jnp.cos(x), jnp.sin(x))
    sums = jnp.broadcast_to(sums, (2, *sums.shape))
    got = turned_from_axis(sums, pair(theta), None if even else pair(phi), degree, tables)
    assert got.dtype == dtype
    for found, t, p in zip(got, theta, phi, strict=True):
        about_y = np.array([[np.cos(t), 0, -np.sin(t)], [0, 1, 0], [np.sin(t), 0, np.cos(t)]])
        about_z = np.array([[np.cos(p), -np.sin(p), 0], [np.sin(p), np.cos(p), 0], [0, 0, 1]])
        expected = harmonics.rotate(c, (about_z @ about_y).astype(dtype))
        np.testing.assert_allclose(found, expected, atol=1e-5 if dtype == np.float32 else 1e-13)
