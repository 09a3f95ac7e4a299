"""The methods that closed forms on polygons are compared with, each against something simpler."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.special import eval_legendre

from shisd import models
from tests.bench import native, polygons
from tests.truth import scipy_basis

pytestmark = pytest.mark.slow  # the baselines of benchmarks, not the library


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def planar_polygons(rng, count, height, sides=4, radius=0.8):
    """Convex, about points at `height`, facing the origin."""
    points = polygons.spherical_polygons(rng, count, sides, 1.0)
    flat = unit(points - points.mean(axis=1, keepdims=True)) * radius
    centre = np.concatenate([rng.uniform(-1, 1, (count, 2)), np.full((count, 1), height)], axis=-1)
    return flat + centre[:, None]


def views_above(rng, count):
    v = unit(rng.normal(size=(count, 3)))
    return v * np.where(v[:, 2:] < 0, [1, 1, -1], 1)


def over_area(polygon, function, count=48):
    """Integral of a function of unit directions [Q, 3] over the directions to a planar polygon: product rule."""
    x, w = legendre.leggauss(count)
    x, w = (x + 1) / 2, w / 2
    total = 0.0
    for b, c in zip(polygon[1:-1], polygon[2:], strict=True):
        a = polygon[0]
        s, t = x[:, None, None], x[None, :, None]
        points = (a + s * ((1 - t) * (b - a) + t * (c - a))).reshape(-1, 3)
        distance = np.linalg.norm(points, axis=-1)
        weight = (w * x)[:, None] * w * np.abs(points @ np.cross(b - a, c - a)).reshape(count, count)
        total = total + np.tensordot(weight.reshape(-1) / distance**3, function(points / distance[:, None]), 1)
    return total


@jax.jit
def values(brdf, directions, view):
    return jax.vmap(brdf.value_cosine, (0, None))(directions, view)


def brdf_integral(brdf, polygon, view, count):
    return over_area(polygon, lambda wi: np.asarray(values(brdf, jnp.asarray(wi), jnp.asarray(view)), float), count)


def sigmas(estimate, truth):
    return np.asarray(estimate.value - truth) / (np.asarray(estimate.standard_error) + 2e-6 * np.max(np.abs(truth)))


# ---- integrals of zonal harmonics


@pytest.mark.parametrize("sides", [3, 4, 6])
def test_the_edge_formula_is_the_integral_over_the_area(rng, sides):
    v, d = polygons.spherical_polygons(rng, 3, sides, 0.6), unit(rng.normal(size=(5, 3)))
    values = polygons.edge_quadrature(v, d, 20)
    for polygon, value in zip(v, values, strict=True):
        truth = over_area(polygon, lambda w: eval_legendre(np.arange(21), (w @ d.T)[..., None]))
        np.testing.assert_allclose(value, truth, atol=1e-10)


needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")


@needs_compiler
@pytest.mark.parametrize("difference", [False, True])
@pytest.mark.parametrize(
    ("degree", "sides", "size"), [(1, 4, 0.5), (2, 3, 1.5), (7, 5, 1.0), (8, 4, 0.2), (20, 4, 1.2)]
)
def test_native_code_matches_quadrature(rng, difference, degree, sides, size):
    v = polygons.spherical_polygons(rng, 37, sides, size).astype(np.float32)
    d = unit(rng.normal(size=(2 * degree + 1, 3))).astype(np.float32)
    d[0], d[1], d[2] = v[0, 0], -v[0, 1], unit(np.cross(v[0, 0], v[0, 1]))
    v[1, 1] = v[1, 0]  # an edge of no length
    weights = (rng.normal(size=(degree + 1, len(d))) / np.sqrt(len(d))).astype(np.float32)
    truth = np.einsum("pkl,lk->p", polygons.edge_quadrature(v, d, degree)[..., 1:], weights[1:])
    value = native.polygon_moments(v, d, weights, difference=difference)
    assert value.dtype == np.float32
    np.testing.assert_allclose(value, truth, atol=1e-5)


@needs_compiler
@pytest.mark.parametrize("difference", [False, True])
def test_native_code_in_sixteen_lanes_and_one_degree_at_a_time(rng, difference):
    v, d = polygons.spherical_polygons(rng, 20, 4, 0.9), unit(rng.normal(size=(3, 3)))
    truth = polygons.edge_quadrature(v, d, 9)
    for l in range(1, 10):
        weights = np.zeros((10, 3))
        weights[l, l % 3] = 1
        for lanes in (8, 16):
            value = native.polygon_moments(v, d, weights, difference=difference, lanes=lanes)
            np.testing.assert_allclose(value, truth[:, l % 3, l], atol=1e-5, err_msg=f"degree {l}, {lanes} lanes")


@needs_compiler
def test_the_difference_form_keeps_the_digits_of_small_polygons(rng):
    v = polygons.spherical_polygons(rng, 64, 4, 0.01).astype(np.float32)
    d, weights = unit(rng.normal(size=(17, 3))).astype(np.float32), rng.normal(size=(9, 17)).astype(np.float32)
    truth = np.einsum("pkl,lk->p", polygons.edge_quadrature(unit(v.astype(float)), d, 8)[..., 1:], weights[1:])
    error = lambda difference: np.max(np.abs(native.polygon_moments(v, d, weights, difference=difference) - truth))
    largest = np.max(np.abs(truth))
    assert error(True) < 1e-5 * largest, error(True) / largest
    assert error(False) > 1e-5 * largest, error(False) / largest


def test_native_code_says_what_is_missing(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(RuntimeError, match="No g\\+\\+"):
        native.library.__wrapped__()
    for arguments, name in [
        ((np.zeros((2, 7, 3)), np.zeros((5, 3)), np.zeros((3, 5))), "polygons"),
        ((np.zeros((2, 4, 3)), np.zeros((5, 2)), np.zeros((3, 5))), "axes"),
        ((np.zeros((2, 4, 3)), np.zeros((5, 3)), np.zeros((5, 3))), "weights"),
    ]:
        with pytest.raises(ValueError, match=f"`{name}`"):
            native.polygon_moments(*arguments)


def test_axial_moments_are_right_and_lose_their_digits(rng):
    v, d = polygons.spherical_polygons(rng, 10, 4, 0.5), unit(rng.normal(size=(41, 3)))
    truth = over_area(v[0], lambda w: (w @ d.T)[..., None] ** np.arange(6))
    np.testing.assert_allclose(polygons.axial_moments(v[:1], d, 5)[0], truth, atol=1e-12)
    truth = polygons.edge_quadrature(v, d, 40)

    def error(dtype, degree):
        moments = polygons.axial_moments(v, d, degree, dtype)
        assert moments.dtype == dtype
        wrong = polygons.zonal_from_axial(moments)[..., -1] - truth[..., degree]
        return np.max(np.abs(wrong)) / np.max(np.abs(truth[..., degree]))

    assert error(np.float64, 8) < 1e-12, error(np.float64, 8)
    assert error(np.float32, 8) < 1e-3, error(np.float32, 8)
    assert error(np.float32, 20) > 0.3, error(np.float32, 20)
    assert error(np.float64, 40) > 0.03, error(np.float64, 40)


def test_lines_without_axes_give_the_integrals_of_the_basis(x64, rng):
    v = polygons.spherical_polygons(rng, 3, 5, 0.6)
    got = polygons.line_coefficients(jnp.asarray(v.transpose(2, 1, 0)), 12)
    expected = [over_area(p, lambda w: scipy_basis(w, 12)) for p in v]
    np.testing.assert_allclose(got[:, 1:], np.stack(expected)[:, 1:], atol=1e-12)


# ---- radiance


METHODS = {"area": polygons.monte_carlo_area, "solid angle": polygons.monte_carlo_solid_angle}
HEIGHTS = {"above": 1.5, "across": 0.3}


@pytest.mark.parametrize("height", HEIGHTS)
@pytest.mark.parametrize("method", METHODS)
def test_monte_carlo_gives_lamberts_form_factor(rng, method, height):
    corners = jnp.asarray(planar_polygons(rng, 64, HEIGHTS[height]), jnp.float32)
    truth = np.asarray(jax.vmap(polygons.form_factor)(corners))
    views = jnp.asarray(views_above(rng, 64), jnp.float32)
    estimate = METHODS[method](models.Lambertian(np.float32(1)), corners, views, key=jax.random.key(1), samples=512)
    off = sigmas(estimate, truth)
    assert np.max(np.abs(off)) < 5, np.max(np.abs(off))
    assert 0.8 < np.sqrt(np.mean(off**2)) < 1.25, np.sqrt(np.mean(off**2))
    assert np.median(estimate.standard_error / truth) < 0.05


@pytest.mark.parametrize("method", METHODS)
def test_monte_carlo_of_a_glossy_colour_matches_quadrature(rng, method):
    corners, views = planar_polygons(rng, 12, 1.2), views_above(rng, 12)
    brdf = models.Ggx(0.3, f0=np.array([1.0, 0.5, 0.1], np.float32))
    truth = np.stack([brdf_integral(brdf, p, v, 100) for p, v in zip(corners, views, strict=True)])
    estimate = METHODS[method](
        brdf, jnp.asarray(corners, jnp.float32), jnp.asarray(views, jnp.float32), key=jax.random.key(2), samples=4096
    )
    assert estimate.value.shape == (12, 3)
    assert np.max(np.abs(sigmas(estimate, truth))) < 5, sigmas(estimate, truth)


@pytest.mark.parametrize("method", METHODS)
def test_polygons_below_the_horizon_and_small_ones(rng, method):
    views = jnp.asarray(views_above(rng, 64), jnp.float32)
    below = jnp.asarray(planar_polygons(rng, 64, -3.0), jnp.float32)
    small = jnp.asarray(planar_polygons(rng, 64, 2.0, radius=1e-3), jnp.float32)
    radiance = lambda p: (
        METHODS[method](models.Lambertian(np.float32(1)), p, views, key=jax.random.key(3), samples=512).value
    )
    np.testing.assert_array_equal(radiance(below), 0)
    np.testing.assert_allclose(radiance(small), jax.vmap(polygons.form_factor)(small), rtol=1e-3)


def test_form_factor_is_exact_across_the_horizon(x64):
    """A square wall that stands on the ground: closed value of a vertical rectangle with a corner in front."""
    a, b, distance = 0.7, 1.9, 0.6
    wall = np.array([[distance, 0, -1], [distance, 0, b], [distance, a, b], [distance, a, -1]])
    truth = (np.arctan(a / distance) - distance / np.hypot(b, distance) * np.arctan(a / np.hypot(b, distance))) / (
        2 * np.pi
    )
    for corners in (wall, wall[::-1], np.roll(wall, 2, axis=0)):
        np.testing.assert_allclose(polygons.form_factor(jnp.asarray(corners.copy())), truth, rtol=1e-13)
    np.testing.assert_allclose(polygons.form_factor(jnp.asarray(wall - [0, 0, 3])), 0, atol=0)


def test_the_cosine_is_its_own_transform(rng):
    table = polygons.fit_ltc(models.Lambertian(np.array([0.8, 0.2, 0.5], np.float32)), 3)
    np.testing.assert_allclose(table.inverse, np.broadcast_to([1, 0, 0, 1], (3, 4)), atol=1e-3)
    corners = jnp.asarray(planar_polygons(rng, 8, 0.5), jnp.float32)
    value = polygons.ltc_radiance(table, corners, jnp.asarray(views_above(rng, 8), jnp.float32))
    truth = np.asarray(jax.vmap(polygons.form_factor)(corners))[:, None] * [0.8, 0.2, 0.5]
    np.testing.assert_allclose(value, truth, atol=1e-3)


def test_transformed_cosines_integrate_their_own_density(rng):
    table = polygons.fit_ltc(models.Ggx(np.float32(0.3)), 8)
    row = 4
    inverse = polygons.ltc_matrix(np.asarray(table.inverse[row], float))
    theta = float(table.step) * row
    turn = 0.8
    view = np.array([np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.cos(theta)])
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    corners = planar_polygons(rng, 6, 0.9)
    value = polygons.ltc_radiance(
        table, jnp.asarray(corners, jnp.float32), jnp.asarray(np.tile(view, (6, 1)), jnp.float32)
    )
    truth = [over_area(p @ rotation, lambda w: polygons.ltc_density(inverse, w), 200) for p in corners]
    np.testing.assert_allclose(value / table.amplitude[row], truth, atol=1e-4)


def test_transformed_cosines_approximate_a_microfacet_model(rng):
    brdf = models.Ggx(np.float32(0.3))
    corners, views = planar_polygons(rng, 40, 1.5), views_above(rng, 40)
    truth = np.array([brdf_integral(brdf, p, v, 60) for p, v in zip(corners, views, strict=True)])

    table = polygons.fit_ltc(brdf, 16)
    value = polygons.ltc_radiance(table, jnp.asarray(corners, jnp.float32), jnp.asarray(views, jnp.float32))
    for selected, most in ((views[:, 2] > 0.5, 0.08), (views[:, 2] <= 0.5, 0.2)):
        error = np.sqrt(np.mean((np.asarray(value) - truth)[selected] ** 2) / np.mean(truth[selected] ** 2))
        assert error < most, (error, most)
