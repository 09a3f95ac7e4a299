"""Integrals of expansions over polygons and caps against area quadrature with SciPy's harmonics."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import decomposition, domains
from tests import truth
from tests.hard_cases import HALF_TURNS, POLYGONS, TINY, padded, random_polygon, ring, unit
from tests.marks import FLOAT64_FIRST


@pytest.mark.parametrize("name", POLYGONS | HALF_TURNS | TINY)
def test_coefficients_and_integrals_of_hard_cases(name, rng):
    """To degree 20, of polygons as float32 has them, against lines along the edges: error of the largest."""
    vertices = (POLYGONS | HALF_TURNS | TINY)[name].astype(np.float32)
    expected = truth.edge_coefficients(vertices, 20, 24).astype(float)
    c = rng.normal(size=(50, 441)).astype(np.float32)
    for dtype, limit in ((np.float32, 2e-5), (np.float64, 5e-11)):
        limit *= 1000 if name == "sliver" else 100 if name == "edge 1e-06 rad short of pi" else 1
        with jax.enable_x64(dtype == np.float64):
            polygon = domains.SphericalPolygon(padded(vertices).astype(dtype))
            if name == "edge 1e-06 rad short of pi" and dtype == np.float32:
                with pytest.raises(Exception, match="opposite"):
                    domains.polygon_coefficients(polygon, 20)
                continue
            got = np.asarray(domains.polygon_coefficients(polygon, 20))
            whole = np.asarray(domains.integrate(c.astype(dtype), polygon))
        assert got.dtype == dtype and whole.dtype == dtype and whole.shape == (50,)
        error = np.max(np.abs(got - expected)) / np.max(np.abs(expected))
        assert error < limit, (dtype.__name__, error)
        rms = np.sqrt(np.sum(expected**2))  # of an expansion whose coefficients are about 1
        error = np.max(np.abs(whole - c.astype(float) @ expected)) / rms
        assert error < 2 * limit, (dtype.__name__, error)


@FLOAT64_FIRST
def test_expansions_beyond_maps(dtype, rng):
    """Of two colours, with a base and without, over many polygons, against area quadrature of its values."""
    polygons = np.stack([random_polygon(rng, 5, 0.6) for _ in range(3)])
    a, c, b = np.eye(3) + 0.3 * rng.normal(size=(3, 3)), rng.normal(size=(2, 25)), rng.normal(size=(2, 9))
    wanted = lambda f: np.stack([np.asarray(f.evaluate(w)) @ area for w, area in rules], axis=-1)
    rules = [[x.astype(dtype) for x in truth.triangle_rule(p.astype(dtype), 24)] for p in polygons]
    for base in (None, b.astype(dtype)):
        f = decomposition.TransformedExpansion(a.astype(dtype), c.astype(dtype), base)
        got = domains.integrate(f, domains.SphericalPolygon(polygons.astype(dtype)))
        assert got.dtype == dtype and got.shape == (2, 3)
        want = wanted(f)
        assert np.max(np.abs(got - want)) < (1.5e-6 if dtype == np.float32 else 5e-15) * np.max(np.abs(want))
    with pytest.raises(ValueError, match="is integrated over a domains.SphericalPolygon; got SphericalCap"):
        domains.integrate(f, domains.SphericalCap(np.array([0, 0, 1], dtype), dtype.type(0.5)))


@pytest.mark.slow
def test_high_degree_uses_more_axes(x64, rng):
    v = random_polygon(rng, 4, 0.4)
    got = domains.polygon_coefficients(domains.SphericalPolygon(padded(v)), 70)
    np.testing.assert_allclose(got, truth.edge_coefficients(v, 70, 40).astype(float), atol=1e-13)


@pytest.mark.parametrize("angle", [-1.0, 4.0, np.nan])
def test_what_is_no_angle_is_nan(angle):
    axis = np.array([0, 0, 1], np.float32)
    value = lambda angle: domains.integrate(np.ones(9, np.float32), domains.SphericalCap(axis, angle))
    got, slope = jax.value_and_grad(value)(np.float32(angle))
    assert np.isnan(got) and np.isnan(slope)
    np.testing.assert_allclose(value(np.pi), np.sqrt(4 * np.pi), rtol=1e-6)


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


def test_gradient_in_the_outline(x64, rng):
    """Along a random motion, against differences of lines along the edges."""
    v, c, move = random_polygon(rng, 4, 0.7), rng.normal(size=25), rng.normal(size=(4, 3))
    value = lambda v: domains.integrate(c, domains.SphericalPolygon(v))
    expected = truth.derivative(lambda t: truth.edge_coefficients(v + t * move.astype(np.longdouble), 4) @ c, 1e-3)
    np.testing.assert_allclose(np.sum(jax.jit(jax.grad(value))(v) * move), float(expected), rtol=1e-12)


@pytest.mark.slow
def test_gradients(x64, rng):
    v, c = random_polygon(rng, 4, 0.7), rng.normal(size=16)
    norm = lambda x: x / jnp.sqrt(jnp.sum(x * x, axis=1, keepdims=True))
    polygon = jax.jit(lambda c, v: domains.integrate(c, domains.SphericalPolygon(norm(v))))
    check_grads(polygon, (c, v), 1, rtol=1e-6, atol=1e-8)
    cap = jax.jit(lambda axis, angle: domains.integrate(c, domains.SphericalCap(axis, angle)))
    check_grads(cap, (unit([1.0, 2.0, 0.3]), np.asarray(0.7)), 1, rtol=1e-6, atol=1e-8)


@pytest.fixture
def many(rng):
    """More polygons than fit into the lanes of one kernel, their coefficients to degree 4, and an expansion."""
    v = np.stack([padded(random_polygon(rng, 4, s)) for s in rng.uniform(0.1, 1, 150)]).astype(np.float32)
    expected = np.stack([truth.edge_coefficients(x[:4], 4) for x in v]).astype(float)
    return v, expected, rng.normal(size=25).astype(np.float32)


near = functools.partial(np.testing.assert_allclose, atol=5e-6, rtol=0)


def test_one_expansion_over_many_polygons(many):
    v, expected, c = many
    near(domains.integrate(c, domains.SphericalPolygon(v.reshape(50, 3, *v.shape[1:]))).reshape(150), expected @ c)
    one = lambda v: domains.integrate(c, domains.SphericalPolygon(v))
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(one)))(v)
    near(values, expected @ c)
    near(slopes[0], jax.grad(one)(v[0]))


@pytest.mark.slow
def test_many_polygons_by_leading_axes_and_by_vmap(many, rng):
    v, expected, _ = many
    c, own = rng.normal(size=(3, 25)).astype(np.float32), rng.normal(size=(150, 25)).astype(np.float32)
    polygons = domains.SphericalPolygon(v.reshape(50, 3, *v.shape[1:]))
    near(domains.polygon_coefficients(polygons, 4).reshape(150, 25), expected)
    near(domains.integrate(c, polygons).reshape(3, 150), c @ expected.T)
    one = lambda c, v: domains.integrate(c, domains.SphericalPolygon(v))
    near(jax.jit(jax.vmap(one))(own, v), np.sum(expected * own, axis=1))
    coefficients = jax.vmap(lambda v: domains.polygon_coefficients(domains.SphericalPolygon(v), 4))
    near(jax.jit(coefficients)(v), expected)
    axes = unit(rng.normal(size=(2, 3))).astype(np.float32)
    for function in (domains.zonal_moments, domains.axial_moments):
        got = function(polygons, axes, 2)
        assert got.shape == (50, 3, 2, 3)
        near(got[7, 1], function(domains.SphericalPolygon(v[22]), axes, 2))
    angles = np.sqrt(4 * np.pi) * expected[:, 0]
    near(domains.solid_angle(polygons).reshape(150), angles)
    cut = domains.clip_to_hemisphere(polygons, axes[0])
    assert cut.vertices.shape == (50, 3, 3 * polygons.slots // 2, 3)
    near(cut.vertices[7, 1], domains.clip_to_hemisphere(domains.SphericalPolygon(v[22]), axes[0]).vertices)
    seen = domains.polygon_from_points(3 * v[:, :4], np.zeros(3, np.float32))
    near(domains.solid_angle(seen), angles)
    with pytest.raises(ValueError, match=r"`origin` \[2, 3\] does not go with `points` \[150, 4, 3\]"):
        domains.polygon_from_points(3 * v[:, :4], np.zeros((2, 3), np.float32))
