"""Balls of light against quadrature over the caps that they cover, and against polygons."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import models, shading
from shisd.shading import _views
from tests.hard_cases import ring, unit
from tests.marks import FLOAT32_FIRST, FLOAT64_FIRST
from tests.shading.slices import random_slices
from tests.truth import scipy_basis

DEGREE, VIEWS = 6, 8


def cap_rule(axis, angle, nodes=24):
    """Directions and solid angles over a cap: Gauss-Legendre in the cosine, even steps in the azimuth."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    versine = (x + 1) * np.sin(angle / 2) ** 2
    polar = 2 * np.arcsin(np.sqrt(versine / 2))
    turns = 2 * np.pi * np.arange(nodes) / nodes
    directions = np.concatenate([ring(turns, t, axis) for t in polar])
    return directions, np.repeat(w * np.sin(angle / 2) ** 2 * 2 * np.pi / nodes, nodes)


def random_rotation(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.linalg.det(q)


DISTANCES = np.array([1.0 + 1e-6, 1.1, 2.0, 30.0, 1e4])


def test_zonal_coefficients_are_integrals_over_the_cap(dtype):
    l = np.arange(41)
    light = models.SphereLight(np.zeros(3), 1.0, np.array([2.0, 0.5], dtype))
    got = light.zonal_coefficients(DISTANCES.astype(dtype), 40)
    assert got.dtype == dtype and got.shape == (5, 2, 41)
    for distance, row in zip(DISTANCES, got, strict=True):
        d = np.longdouble(dtype.type(distance))
        t = (1 / d**2) / (1 + np.sqrt(1 - 1 / d**2))
        x, w = np.polynomial.legendre.leggauss(40)
        z = 1 - (x.astype(np.longdouble) + 1) / 2 * t
        p = np.polynomial.legendre.legvander(z, 40)
        expected = 2 * np.pi * (w / 2 * t) @ p * np.sqrt((2 * l + 1) / (4 * np.pi))
        tolerance = (1e-6 if dtype == np.float32 else 1e-13) * np.max(np.abs(expected))
        np.testing.assert_allclose(row[0], 2 * expected, rtol=0, atol=2 * tolerance, err_msg=f"distance {distance}")
        np.testing.assert_allclose(row[1], 0.5 * expected, rtol=0, atol=0.5 * tolerance)


@FLOAT64_FIRST
def test_it_is_the_integral_of_the_slice_over_the_cap(dtype, rng):
    slices = random_slices(DEGREE, dtype)
    node = 5
    view = np.array([np.sin(_views.elevations(VIEWS)[node]), 0, np.cos(_views.elevations(VIEWS)[node])])
    c = np.asarray(slices.coefficients[node], float)
    to_center, radii, expected = [], (0.02, 0.5, 1.0, 1.99), []
    for radius in radii:
        to_center.append(2 * unit(rng.normal(size=3) + [0, 0, 0.5]))
        w, area = cap_rule(to_center[-1], np.arcsin(radius / 2))
        expected.append(area @ scipy_basis(w, DEGREE) @ c)
    for radius, direction, value in zip(radii, to_center, expected, strict=True):
        turn, position = random_rotation(rng), rng.normal(size=3)
        light = models.SphereLight((position + turn @ direction).astype(dtype), radius, np.array([3.0, 1.0], dtype))
        surface = shading.Surface(*(x.astype(dtype) for x in (turn[:, 2], turn @ view, position)))
        got = shading.shade(slices, light, surface)
        assert got.dtype == dtype and got.shape == (2,)
        scale = 3e-5 if dtype == np.float32 else 1e-10
        np.testing.assert_allclose(got, [3 * value, value], rtol=scale, err_msg=f"radius {radius}")


@pytest.mark.slow
def test_a_polygon_of_64_corners_is_nearly_a_ball(x64, rng):
    slices = random_slices(DEGREE, np.float64)
    center, angle, corners = np.array([0.4, -0.3, 2.0]), 0.3, 64
    solid_angle = 2 * np.pi * (1 - np.cos(angle))
    # the ring whose polygon has the solid angle of the cap: sum of angles, 64 times those of one corner
    from scipy.optimize import brentq

    area = lambda a: 2 * np.pi - corners * 2 * np.arctan(np.tan(np.pi / corners) * np.cos(a))
    around = brentq(lambda a: area(a) - solid_angle, angle, 1.01 * angle, xtol=1e-14)
    outline = ring(-2 * np.pi * np.arange(corners) / corners, around, center)
    radius = np.sin(angle) * np.linalg.norm(center)
    views = unit(np.array([[0.0, 0, 1], [0.5, 0.2, 1], [-1, 2, 0.7]]))
    normals, positions = np.broadcast_to([0.0, 0, 1], (3, 3)), np.zeros((3, 3))
    surface = shading.Surface(normals, views, positions)
    ball = shading.shade(slices, models.SphereLight(center, radius, 1.5), surface)
    flat = shading.shade(slices, models.PolygonLight(outline, 1.5, two_sided=True), surface)
    np.testing.assert_allclose(ball, flat, rtol=1e-6)


@pytest.mark.slow
@FLOAT32_FIRST
def test_several_balls_and_colours(dtype, rng):
    slices = random_slices(DEGREE, dtype, (3,))
    lights = [models.SphereLight(np.array([0.5, 0.2, 3.0], dtype), 0.5, np.array([3.0, 2.0, 1.0], dtype)),
              models.SphereLight(np.array([-2.0, 0.2, 1.0], dtype), 1.5)]  # fmt: skip
    normals, positions = unit(rng.normal(size=(4, 3))).astype(dtype), (0.1 * rng.normal(size=(4, 3))).astype(dtype)
    views = unit(normals + 0.5 * rng.normal(size=(4, 3))).astype(dtype)
    got = shading.shade(slices, lights, shading.Surface(normals, views, positions))
    expected = 0.0
    for light in lights:
        axes = np.asarray(light.center) - positions
        z = light.zonal_coefficients(np.linalg.norm(axes, axis=1), DEGREE)
        one = lambda axis, z, *frame: shading.shade(slices, models.ZonalLight(axis, z), shading.Surface(*frame))
        expected += np.asarray(jax.jit(jax.vmap(one))(axes, z, normals, views))
    np.testing.assert_allclose(got, expected, rtol=1e-4 if dtype == np.float32 else 1e-11)


@pytest.mark.slow
def test_anisotropic(x64, rng):
    slices = shading.tabulate_brdf(models.Ggx(np.array([0.3, 0.6])), DEGREE, elevations=VIEWS, azimuths=16)
    light = models.SphereLight(np.array([0.5, 0.2, 3.0]), 0.7)
    normals, tangents = unit(rng.normal(size=(2, 4, 3)))
    views = unit(normals + 0.5 * rng.normal(size=(4, 3)))
    surface = shading.Surface(normals, views, np.zeros((4, 3)), tangents)
    got = shading.shade(slices, light, surface)
    z = light.zonal_coefficients(np.linalg.norm(light.center), DEGREE)
    np.testing.assert_allclose(got, shading.shade(slices, models.ZonalLight(light.center, z), surface), rtol=1e-11)


def test_inside_the_ball_light_is_all_around(x64, rng):
    slices = random_slices(DEGREE, np.float64)
    normals, views = np.array([[0.0, 0, 1]] * 3), unit(np.array([[0.3, 0.1, 1]] * 3))
    positions = np.array([[0.0, 0, 0], [0.5, 0.5, 0.2], [0.0, 0.0, -0.999]])
    ball = lambda radius: models.SphereLight(jnp.zeros(3), radius, 2.0)
    shade = jax.jit(lambda p, radius: shading.shade(slices, ball(radius), shading.Surface(normals, views, p)))
    constant = np.array([2 * np.sqrt(4 * np.pi)])
    expected = shading.shade(slices, models.DistantLight(constant), shading.Surface(normals, views))
    np.testing.assert_allclose(shade(positions, 1.0), expected, rtol=1e-12)
    for gradient in jax.jacobian(shade, argnums=(0, 1))(positions, 1.0):
        np.testing.assert_array_equal(gradient, 0)
    assert np.all(np.isnan(shade(positions, 0.0))), "a ball of no size is an error that shows"


@pytest.mark.slow
def test_derivatives(x64, rng):
    slices = random_slices(DEGREE, np.float64)
    normals = unit(rng.normal(size=(3, 3)))
    views, positions = unit(normals + 0.6 * rng.normal(size=(3, 3))), rng.normal(size=(3, 3))
    views[0] = normals[0]

    def radiance(center, radius, emission, positions, normals, views):
        light = models.SphereLight(center, radius, emission)
        return shading.shade(slices, light, shading.Surface(normals, views, positions))

    arguments = np.array([0.5, 4.0, 2.0]), np.array(1.2), np.array([1.0, 2.0]), positions, normals, views
    arguments = tuple(jnp.asarray(a) for a in arguments)
    # 9e-7 for each component of a view along its normal, by splines of even functions; 1e-11 elsewhere
    check_grads(jax.jit(radiance), arguments, order=1, atol=4e-6, rtol=4e-6, eps=1e-5)
    small = jax.jit(jax.grad(lambda r: jnp.sum(radiance(arguments[0], r, *arguments[2:]))))
    # radiance goes with the square of a small radius, so its slope over the radius has a limit
    np.testing.assert_allclose(small(1e-6) / 1e-6, small(1e-4) / 1e-4, rtol=1e-6)


def test_errors_name_the_argument(as_user):
    slices = random_slices(DEGREE, np.float32)
    p, n = np.zeros((2, 3), np.float32), np.array([[0, 0, 1.0]] * 2, np.float32)
    light = models.SphereLight(np.ones(3, np.float32), 0.5)
    with pytest.raises(ValueError, match=r"`center` must have shape \[3\] and `radius` be one number; got \[1, 3\]"):
        models.SphereLight(np.ones((1, 3)), 0.5)
    with pytest.raises(ValueError, match="`emission` must be a scalar or"):
        models.SphereLight(np.ones(3), 0.5, np.ones((1, 3)))
    with pytest.raises(ValueError, match="`lights` must be one of models.*SphereLight; got ndarray. SH coefficients"):
        shading.shade(slices, p, shading.Surface(n, n, p))
    with pytest.raises(
        ValueError, match=r"`lights` \[1\] must be one of models.*SphereLight; got Environment. Pass `light\(deg"
    ):
        shading.shade(slices, [light, models.Environment(np.ones((2, 4)))], shading.Surface(n, n, p))
    with pytest.raises(ValueError, match="`positions` must have shape"):
        shading.Surface(n, n, p[:, :2])
    with pytest.raises(ValueError, match=r"`surface` needs `positions` \[..., 3\]: a light is local"):
        shading.shade(slices, light, shading.Surface(n, n))
    with pytest.raises(ValueError, match="fitted above the horizon only, and a SphereLight shines on it from all"):
        shading.shade(random_slices(DEGREE, np.float32, domain="upper"), light, shading.Surface(n, n, p))
