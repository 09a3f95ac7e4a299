"""Integrals of expansions over polygons and caps against area quadrature with SciPy's harmonics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import domains
from tests import truth
from tests.hard_cases import POLYGONS, padded, random_polygon, ring, unit


def basis_integrals(vertices, degree, nodes):
    w, area = truth.triangle_rule(vertices, nodes)
    return area.astype(float) @ truth.scipy_basis(w.astype(float), degree)


def test_random_expansions_of_degree_20(dtype, rng):
    errors = []
    for count, size in ((3, 1.0), (4, 0.5), (8, 0.8), (4, 0.05)):
        v = random_polygon(rng, count, size).astype(dtype)
        c = rng.normal(size=(50, 441)).astype(dtype)
        got = np.asarray(domains.integrate(c, domains.SphericalPolygon(padded(v))))
        expected = c.astype(float) @ basis_integrals(v, 20, 24)
        assert got.dtype == dtype and got.shape == (50,)
        errors.append(np.abs(got - expected) / np.abs(expected))
    bound = {"float64": 1e-13, "float32": 2e-5}[dtype.name]
    assert np.median(np.concatenate(errors)) < bound


def test_coefficients_of_hard_cases(dtype):
    for name, vertices in POLYGONS.items():
        v = vertices.astype(dtype)
        expected = basis_integrals(v, 8, 40)
        got = domains.polygon_coefficients(domains.SphericalPolygon(padded(v)), 8)
        tolerance = {"float64": 1e-11, "float32": 1e-2 if name in {"sliver", "solid angle 1e-8"} else 1e-4}[dtype.name]
        np.testing.assert_allclose(got, expected, atol=tolerance * np.max(np.abs(expected)), err_msg=name)


@pytest.mark.slow
def test_high_degree_uses_more_axes(x64, rng):
    v = random_polygon(rng, 4, 0.4)
    got = domains.polygon_coefficients(domains.SphericalPolygon(padded(v)), 40)
    np.testing.assert_allclose(got, basis_integrals(v, 40, 30), atol=1e-13)


@pytest.mark.slow
def test_caps_and_polygons_with_many_sides_agree(dtype):
    """A 64-gon is a cap up to its missing slivers; a hemisphere and its opposite make the sphere."""
    tolerance = {"float64": 1e-13, "float32": 1e-5}[dtype.name]
    axis = unit([1.0, -2.0, 0.5]).astype(dtype)
    cap = domains.SphericalCap(axis, np.asarray(0.6, dtype))
    polygon = domains.SphericalPolygon(ring(np.arange(64) * np.pi / 32, 0.6, axis).astype(dtype))
    a, b = (np.asarray(domains.polygon_coefficients(r, 6)) for r in (cap, polygon))
    np.testing.assert_allclose(a, b, atol=4e-3)
    assert a.dtype == dtype
    np.testing.assert_allclose(a[0] * np.sqrt(4 * np.pi), 2 * np.pi * (1 - np.cos(0.6)), rtol=tolerance)
    axes = unit([[1, 0, 0], [0.3, 0.2, -1]]).astype(dtype)
    z = domains.zonal_moments(cap, axes, 6)
    for l in range(7):
        y = truth.scipy_basis(axes, l)[:, l * l :]
        np.testing.assert_allclose(z[:, l], 4 * np.pi / (2 * l + 1) * y @ a[l * l : (l + 1) ** 2], atol=tolerance)
    halves = sum(np.asarray(domains.polygon_coefficients(domains.hemisphere(s * axis), 4)) for s in (1, -1))
    np.testing.assert_allclose(halves, np.sqrt(4 * np.pi) * np.eye(25)[0], atol=tolerance)


def test_gradients(x64, rng):
    v, c = random_polygon(rng, 4, 0.7), rng.normal(size=16)
    norm = lambda x: x / jnp.sqrt(jnp.sum(x * x, axis=1, keepdims=True))
    check_grads(lambda c, v: domains.integrate(c, domains.SphericalPolygon(norm(v))), (c, v), 1, rtol=1e-6, atol=1e-8)
    cap = lambda axis, angle: domains.integrate(c, domains.SphericalCap(axis, angle))
    check_grads(cap, (unit([1.0, 2.0, 0.3]), np.asarray(0.7)), 1, rtol=1e-6, atol=1e-8)


def test_batches_by_vmap(rng):
    v = np.stack([random_polygon(rng, 4, s) for s in (1.0, 0.1)]).astype(np.float32)
    c = rng.normal(size=9).astype(np.float32)
    many = jax.vmap(lambda v: domains.integrate(c, domains.SphericalPolygon(v)))(v)
    one = [domains.integrate(c, domains.SphericalPolygon(x)) for x in v]
    np.testing.assert_allclose(many, one, rtol=2e-5)
