"""Polygons, clipping and solid angles against quadrature, winding numbers and closed values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import domains
from tests import truth
from tests.hard_cases import HALF_TURNS, POLYGONS, SLOTS, TINY, padded, random_polygon, ring, unit
from tests.marks import FLOAT64_FIRST


def area(vertices, **options):
    return domains.solid_angle(domains.SphericalPolygon(padded(vertices), **options))


@jax.jit
def areas(vertices):
    return jax.vmap(lambda v: domains.solid_angle(domains.SphericalPolygon(v)))(vertices)


@pytest.mark.parametrize("name", POLYGONS | HALF_TURNS | TINY)
def test_solid_angle_of_hard_cases(name, dtype):
    """Areas for the list; fans of triangles in extended precision for the limits of what has a direction or an area."""
    vertices = (POLYGONS | HALF_TURNS | TINY)[name].astype(np.float32)
    if name == "edge 1e-06 rad short of pi" and dtype == np.float32:
        with pytest.raises(Exception, match="opposite"):
            area(vertices.astype(dtype))
        return
    expected = truth.triangle_rule(vertices, 60)[1].sum() if name in POLYGONS else truth.solid_angle(vertices)
    known = 1e-15 / abs(expected) ** 0.5 if name in TINY else 4e-9 if name in HALF_TURNS else 1e-11
    # of the sliver 6e-4 where products are fused with sums, a tenth of it where not
    relative = {"float64": known, "float32": 2e-3 if name == "sliver" else 4e-7}[dtype.name]
    np.testing.assert_allclose(float(area(vertices.astype(dtype))), float(expected), rtol=float(relative))


@pytest.mark.parametrize("count", [3, 5, 12, 36])
def test_a_great_circle_is_a_hemisphere(count, dtype, rng):
    """Turned at random, both ways round; to what 32 roundings allow."""
    turns = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]
    v = ring(2 * np.pi * np.arange(36) / count, np.pi / 2) @ turns
    v[:, count:] = v[:, :1]
    v = np.concatenate([v, v[:, ::-1]]).astype(dtype)
    np.testing.assert_allclose(areas(v), 2 * np.pi, atol=256 * np.finfo(dtype).eps)


@pytest.mark.parametrize("name", TINY)
def test_small_and_nearly_whole(name, dtype):
    """Where what is on the left of the edges is meant: not the whole sphere, unless that is on the left."""
    v = TINY[name].astype(np.float32)
    exact = float(truth.solid_angle(v))
    relative = {"float64": 1e-15 / exact**0.5, "float32": 1e-6}[dtype.name]
    v = v.astype(dtype)
    np.testing.assert_allclose(area(v, largest=4 * np.pi), exact, rtol=relative)
    np.testing.assert_allclose(area(v[::-1], largest=4 * np.pi), 4 * np.pi - exact, rtol=np.finfo(dtype).eps)
    assert area(np.repeat(v[:1], 3, axis=0), largest=4 * np.pi) == 0


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
    """Solid angles of the parts above and below against those of edges cut one after another; moments add up."""
    vertices = POLYGONS[name].astype(dtype)
    polygon = domains.SphericalPolygon(padded(vertices))
    axes = unit(rng.normal(size=(3, 3))).astype(dtype)
    tolerance = {"float64": 1e-14, "float32": 3e-6}[dtype.name]
    for normal in unit(rng.normal(size=(3, 3))).astype(dtype):
        above, below = (domains.clip_to_hemisphere(polygon, s * normal) for s in (1, -1))
        assert above.vertices.dtype == dtype and above.slots == SLOTS + SLOTS // 2
        assert np.min(np.asarray(above.vertices) @ normal) > -1e-6
        parts = [np.asarray(domains.zonal_moments(p, axes, 6)) for p in (above, below, polygon)]
        np.testing.assert_allclose(parts[0] + parts[1], parts[2], atol=tolerance)
        expected = [float(truth.solid_angle(truth.part_above(vertices, s * normal))) for s in (1, -1)]
        np.testing.assert_allclose([parts[0][0, 0], parts[1][0, 0]], expected, atol=tolerance)


@FLOAT64_FIRST
def test_clipping_at_the_limits(dtype):
    v = random_polygon(np.random.default_rng(1), 4, 0.5).astype(dtype)
    polygon, up = domains.SphericalPolygon(v), unit(v.sum(axis=0)).astype(dtype)
    whole = domains.clip_to_hemisphere(polygon, up)
    np.testing.assert_allclose(domains.solid_angle(whole), domains.solid_angle(polygon), rtol=1e-6)
    nothing = lambda v: domains.solid_angle(
        domains.clip_to_hemisphere(domains.SphericalPolygon(v, largest=4 * np.pi), -up)
    )
    value, slope = jax.value_and_grad(nothing)(jnp.asarray(v))
    assert value == 0
    np.testing.assert_array_equal(slope, 0)


@pytest.mark.slow
def test_gradient_of_clipping(x64):
    v, normal = POLYGONS["non-convex"], unit([0.7, 0.2, 0.4])
    c = np.cos(np.arange(25.0))

    def clipped(v, normal):
        unit_v = v / jnp.sqrt(jnp.sum(v * v, axis=1, keepdims=True))
        return domains.integrate(c, domains.clip_to_hemisphere(domains.SphericalPolygon(unit_v), normal))

    check_grads(clipped, (v, normal), order=1, rtol=1e-6, atol=1e-8)


def test_polygons_from_points(dtype):
    """A square pyramid: 4 arcsin(ab / sqrt((a^2 + h^2) (b^2 + h^2))), positive when counter-clockwise from outside."""
    corners = np.asarray([[1, 1, 2], [-1, 1, 2], [-1, -1, 2], [1, -1, 2]], dtype) * 10
    origin, expected = np.asarray([0, 0, -20], dtype), 4 * np.arcsin(100 / (100 + 40**2))
    polygon = domains.polygon_from_points(corners, origin)
    tolerance = {"float64": 1e-14, "float32": 1e-6}[dtype.name]
    np.testing.assert_allclose(domains.solid_angle(polygon), expected, rtol=tolerance)
    backwards = domains.polygon_from_points(corners[::-1], origin)
    np.testing.assert_allclose(domains.solid_angle(backwards), -expected, rtol=tolerance)
    assert polygon.vertices.dtype == dtype
    for distance in 10.0 ** np.arange(2, 8):  # of coordinates that float32 has as they are
        shift = (np.round(distance * np.array([0.5, -1, 0.75]) / 4) * 4).astype(dtype)
        moved = domains.polygon_from_points(corners + shift, origin + shift)
        np.testing.assert_array_equal(moved.vertices, polygon.vertices, err_msg=str(distance))


def test_points_of_numpy_are_subtracted_as_they_are():
    """Coordinates that float32 does not have."""
    corners = np.array([[0.1, 0.1, 0.2], [-0.1, 0.1, 0.2], [-0.1, -0.1, 0.2], [0.1, -0.1, 0.2]])
    shift = np.array([3e5, 4e6, 100.0])
    near, far = (domains.polygon_from_points(corners + x, x) for x in (0 * shift, shift))
    np.testing.assert_allclose(far.vertices, near.vertices, atol=2e-7)


def test_padding_and_traced_counts(rng):
    v = random_polygon(rng, 5, 0.7).astype(np.float32)
    filled = np.concatenate([v, np.full((3, 3), np.nan, np.float32)])
    value = jax.jit(lambda n: domains.solid_angle(domains.SphericalPolygon(filled, n)))
    np.testing.assert_allclose(value(5), float(truth.solid_angle(v)), rtol=1e-6)
    np.testing.assert_allclose(value(4), float(truth.solid_angle(v[:4])), rtol=1e-6)
    for count in (2, 9):
        with pytest.raises(Exception, match="count"):
            value(count)


def test_float32_stays_float32_with_x64_on(x64):
    """Traced only; the settings of all tests refuse silent promotion."""
    octant, c, d = np.eye(3, dtype=np.float32), np.ones(9, np.float32), np.ones((2, 3), np.float32)
    basis = domains.HaarBasis(1)
    polygon = lambda v: domains.SphericalPolygon(v, 3)
    cap = lambda v: domains.SphericalCap(v[0], 0.5)
    calls = [
        *[lambda v, make=make: domains.zonal_moments(make(v), d, 3) for make in (polygon, cap)],
        *[lambda v, make=make: domains.polygon_coefficients(make(v), 3) for make in (polygon, cap)],
        *[lambda v, make=make: domains.integrate(c, make(v)) for make in (polygon, cap)],
        lambda v: domains.axial_moments(polygon(v), d, 3),
        lambda v: domains.solid_angle(polygon(v)),
        lambda v: domains.clip_to_hemisphere(polygon(v), v[0]).vertices,
        lambda v: domains.polygon_from_points(v, np.zeros(3, np.float32)).vertices,
        lambda v: basis.project(polygon(v)),
        lambda v: basis.values(jnp.ones(basis.size, v.dtype)),
        lambda v: basis.coefficients(jnp.ones(basis.size, v.dtype)),
        lambda v: basis.evaluate(jnp.ones(basis.size, v.dtype), v),
    ]
    for i, call in enumerate(calls):
        assert jax.eval_shape(call, octant).dtype == np.float32, i
    assert jax.eval_shape(jax.grad(lambda v: jnp.sum(calls[0](v))), octant).dtype == np.float32
    assert jax.eval_shape(lambda v: domains.zonal_moments(polygon(v), d.astype(float), 3), octant).dtype == float
    assert jax.eval_shape(lambda v: domains.zonal_moments(cap(v), d.astype(float), 3), octant).dtype == float


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: domains.SphericalPolygon(np.zeros((2, 3))), "at least 3 points"),
        (lambda: domains.SphericalPolygon(np.zeros((3, 2))), "must have shape"),
        (lambda: domains.SphericalPolygon(np.eye(3), 2), "`count` must be >= 3"),
        (lambda: domains.SphericalPolygon(np.eye(3), 4), "`count` must be from 3 to the number of slots, 3; got 4"),
        (lambda: domains.SphericalPolygon(np.eye(3), 3.0), "`count` must be"),
        (lambda: domains.SphericalPolygon(np.eye(3), jnp.ones(1, jnp.int32)), "`count` must be one integer"),
        (lambda: domains.SphericalPolygon(np.eye(3), largest="all"), "`largest` must be"),
        (lambda: domains.clip_to_hemisphere(domains.SphericalPolygon(np.eye(3)), [0.0, 0.0, 0.0]), "`normal` is zero"),
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
