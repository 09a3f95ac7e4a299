"""Polygons, clipping and solid angles against quadrature, winding numbers and closed values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import domains
from tests import truth
from tests.hard_cases import POLYGONS, SLOTS, padded, random_polygon, ring, unit
from tests.marks import FLOAT64_FIRST


def area(vertices, **options):
    return domains.solid_angle(domains.SphericalPolygon(padded(vertices), **options))


@pytest.mark.parametrize("name", POLYGONS)
def test_solid_angle_of_hard_cases(name, dtype):
    vertices = POLYGONS[name].astype(dtype)
    expected = float(truth.triangle_rule(vertices, 60)[1].sum())
    relative = {"float64": 1e-12, "float32": 1e-4}[dtype.name] * (30 if name == "sliver" else 1)
    np.testing.assert_allclose(area(vertices), expected, rtol=relative)


def test_solid_angles_beyond_a_hemisphere(dtype):
    """A ring of arcs is at most a cap; its outline is also that of what is outside, with the other sign."""
    tolerance = {"float64": 1e-13, "float32": 1e-5}[dtype.name]
    for radius in (1.5, 1.65, 2.0, 3.0):
        v = ring(np.arange(8) * np.pi / 4, radius).astype(dtype)
        small = ring(np.arange(8) * np.pi / 4, np.pi - radius)
        rest = float(truth.triangle_rule(small, 60)[1].sum()) if radius > np.pi / 2 else None
        left = 4 * np.pi - rest if rest else float(truth.triangle_rule(v, 60)[1].sum())
        np.testing.assert_allclose(area(v, largest=4 * np.pi), left, rtol=tolerance)
        np.testing.assert_allclose(area(v), left if rest is None else -rest, rtol=10 * tolerance)
        np.testing.assert_allclose(area(v[::-1]), -area(v), rtol=tolerance)
    np.testing.assert_allclose(area(np.eye(3, dtype=dtype)), np.pi / 2, rtol=tolerance)
    octahedron = np.asarray([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]], dtype)
    assert np.isfinite(area(octahedron))  # every vertex has an opposite


@pytest.mark.slow
def test_gradient_of_the_solid_angle(x64, rng):
    f = lambda v: domains.solid_angle(domains.SphericalPolygon(v / jnp.sqrt(jnp.sum(v * v, axis=1, keepdims=True))))
    check_grads(f, (padded(random_polygon(rng, 5, 1.0)),), order=2, rtol=1e-6, atol=1e-6)


@FLOAT64_FIRST
@pytest.mark.parametrize("name", ["non-convex", "clockwise", "near a hemisphere", "collinear vertices"])
def test_clipping_keeps_what_is_above(name, dtype, rng):
    """Moments of the part above and of the part below add up, and the solid angle above is the quadrature's."""
    vertices = POLYGONS[name].astype(dtype)
    w, area_rule = (x.astype(float) for x in truth.triangle_rule(vertices, 100))
    polygon = domains.SphericalPolygon(padded(vertices))
    axes = unit(rng.normal(size=(3, 3))).astype(dtype)
    tolerance = {"float64": 1e-12, "float32": 1e-5}[dtype.name]
    for normal in unit(rng.normal(size=(3, 3))).astype(dtype):
        above, below = (domains.clip_to_hemisphere(polygon, s * normal) for s in (1, -1))
        assert above.vertices.dtype == dtype and above.slots == SLOTS + SLOTS // 2
        assert np.min(above.vertices @ normal) > -1e-6
        parts = [np.asarray(domains.zonal_moments(p, axes, 6)) for p in (above, below, polygon)]
        np.testing.assert_allclose(parts[0] + parts[1], parts[2], atol=tolerance)
        expected = float(area_rule[w @ normal.astype(float) > 0].sum())  # a step, which the rule resolves to 1e-2
        assert abs(float(domains.solid_angle(above)) - expected) < 1e-2


@FLOAT64_FIRST
def test_clipping_at_the_limits(dtype):
    v = random_polygon(np.random.default_rng(1), 4, 0.5).astype(dtype)
    polygon, up = domains.SphericalPolygon(v), unit(v.sum(axis=0)).astype(dtype)
    whole = domains.clip_to_hemisphere(polygon, up)
    np.testing.assert_allclose(domains.solid_angle(whole), domains.solid_angle(polygon), rtol=1e-6)
    nothing = lambda v: domains.solid_angle(domains.clip_to_hemisphere(domains.SphericalPolygon(v), -up))
    assert nothing(v) == 0
    np.testing.assert_array_equal(jax.grad(nothing)(jnp.asarray(v)), 0)


@pytest.mark.slow
def test_gradient_of_clipping(x64):
    v, normal = POLYGONS["non-convex"], unit([0.7, 0.2, 0.4])
    c = np.cos(np.arange(25.0))

    def clipped(v, normal):
        unit_v = v / jnp.sqrt(jnp.sum(v * v, axis=1, keepdims=True))
        return domains.integrate(c, domains.clip_to_hemisphere(domains.SphericalPolygon(unit_v), normal))

    check_grads(clipped, (v, normal), order=1, rtol=1e-6, atol=1e-8)


def test_polygons_from_points(dtype):
    corners = np.asarray([[1, 1, 2], [-1, 1, 2], [-1, -1, 2], [1, -1, 2]], dtype) * 10
    origin = np.asarray([0, 0, -20], dtype)
    polygon = domains.polygon_from_points(corners, origin)
    expected = 4 * np.arcsin(100 / (100 + 40**2))  # square pyramid: 4 arcsin(ab / sqrt((a^2+h^2)(b^2+h^2)))
    np.testing.assert_allclose(abs(domains.solid_angle(polygon)), expected, rtol=1e-5)
    assert polygon.vertices.dtype == dtype


def test_padding_and_traced_counts(rng):
    v = random_polygon(rng, 5, 0.7).astype(np.float32)
    filled = np.concatenate([v, np.full((3, 3), 7, np.float32)])
    value = jax.jit(lambda n: domains.solid_angle(domains.SphericalPolygon(filled, n)))
    np.testing.assert_allclose(value(5), area(v), rtol=1e-6)
    np.testing.assert_allclose(value(4), area(v[:4]), rtol=1e-6)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: domains.SphericalPolygon(np.zeros((2, 3))), "at least 3 slots"),
        (lambda: domains.SphericalPolygon(np.zeros((3, 2))), "must have shape"),
        (lambda: domains.SphericalPolygon(np.eye(3), 2), "`count` must be from 3"),
        (lambda: domains.SphericalPolygon(np.eye(3), largest=20), "`largest` must be"),
        (lambda: domains.solid_angle(domains.SphericalPolygon(2 * np.eye(3))), "must be unit vectors"),
        (lambda: domains.solid_angle(domains.SphericalPolygon(np.eye(3) * np.nan)), "must be unit vectors"),
        (lambda: domains.solid_angle(domains.SphericalPolygon(np.eye(3)[[0, 0, 1]] * [[1], [-1], [1]])), "opposite"),
        (lambda: domains.polygon_from_points(np.eye(3), [0.0, 0.0]), "`origin`"),
        (lambda: domains.clip_to_hemisphere(domains.SphericalPolygon(np.eye(3)), [1.0, 0.0]), "`normal` must"),
        (lambda: domains.SphericalCap([0.0, 1.0], 1.0), "`axis` must"),
        (lambda: domains.integrate(np.ones(5), domains.hemisphere([0.0, 0.0, 1.0])), "coefficients"),
        (lambda: domains.polygon_coefficients(domains.hemisphere([0.0, 0.0, 1.0]), -1), "`degree` must be >= 0"),
        (lambda: domains.polygon_coefficients(np.eye(3), 2), "the region must be"),
    ],
)
def test_bad_input_is_named(call, message, as_user):
    with pytest.raises(Exception, match=message):
        call()
