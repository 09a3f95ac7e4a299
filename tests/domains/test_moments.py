"""Zonal and axial moments against area quadrature in extended precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import domains
from shisd.domains import _moments
from tests import truth
from tests.hard_cases import POLYGONS, axes_for, padded, random_polygon, unit


def solid_angle(vertices):
    return abs(truth.triangle_rule(vertices, 16)[1].sum().astype(float))


def moments_error(vertices, axes, degree, dtype, size=1.5):
    """Largest error over the solid angle, against the polygon and the axes as rounded."""
    vertices, axes = vertices.astype(dtype), axes.astype(dtype)
    got = domains.zonal_moments(domains.SphericalPolygon(padded(vertices)), axes, degree)
    assert got.dtype == dtype and got.shape == (len(axes), degree + 1)
    return np.max(
        np.abs(got - truth.zonal_moments(vertices, axes, degree, 14 + int(0.4 * degree * size)))
    ) / solid_angle(vertices)


@pytest.mark.parametrize("size", [1.0, 0.3, 0.06, 1e-3])
def test_moments_to_degree_100(size, dtype, rng):
    errors = [
        moments_error(random_polygon(rng, count, size), unit(rng.normal(size=(9, 3))), 100, dtype, size)
        for count in (3, 4, 8, 3, 4, 8)
    ]
    double = 1e-13 if size > 0.05 else 1e-12
    single = 2e-6 if size > 0.2 else 5e-5 if size > 0.05 else 1e-4
    assert max(errors) < {"float64": double, "float32": single}[dtype.name]


def test_small_triangles_to_degree_100_in_float32(rng):
    """The rounding of P_l at the reference counts l times their size: rare cases are much worse than the median."""
    axes, f = unit(rng.normal(size=(9, 3))).astype(np.float32), np.float32
    errors = [moments_error(random_polygon(rng, 3, 0.08), axes, 100, f, 0.1) for _ in range(24)]
    assert np.median(errors) < 2e-6 and max(errors) < 5e-5, (np.median(errors), max(errors))


@pytest.mark.parametrize("name", POLYGONS)
def test_hard_cases(name, dtype, rng):
    """Rounding the vertices of an edge near pi turns its plane: truth is for the rounded polygon."""
    vertices = POLYGONS[name]
    bound = {"float64": 1e-12, "float32": 1e-4}[dtype.name]
    if name in {"sliver", "solid angle 1e-8"}:
        bound *= 30  # 5e-5 and 1e-4 wide: one rounding is 1e-3 of that in float32
    assert moments_error(vertices, axes_for(vertices, rng), 40, dtype, 3.0) < bound


def loss(vertices, axes, degree):
    """A smooth function of all moments; vertices and axes of any length."""
    norm = lambda x: x / jnp.sqrt(jnp.sum(x * x, axis=-1, keepdims=True))
    m = domains.zonal_moments(domains.SphericalPolygon(norm(vertices)), axes, degree)
    return jnp.sum(m * jnp.asarray(np.cos(np.arange(m.size)).reshape(m.shape), m.dtype))


@pytest.mark.slow
@pytest.mark.parametrize("name", POLYGONS)
def test_gradients_of_hard_cases_are_the_limit(name, x64, rng):
    """Against differences of the quadrature, at coincident vertices and wherever axes and edges meet."""
    vertices = POLYGONS[name]
    axes, degree = axes_for(vertices, rng), 12
    scale = min(1.0, np.sqrt(solid_angle(vertices)))
    weights = np.cos(np.arange(len(axes) * (degree + 1))).reshape(len(axes), -1)
    nodes = 60 if name in {"edge near pi", "near a hemisphere"} else 16
    value = lambda v, d: float(np.sum(weights * truth.zonal_moments(v, d, degree, nodes)))
    gradient, axis_gradient = jax.jit(jax.grad(loss, (0, 1)), static_argnums=2)(padded(vertices), axes, degree)
    for _ in range(2):
        step = rng.normal(size=vertices.shape)
        step -= np.sum(step * vertices, axis=1, keepdims=True) * vertices
        h = 1e-4 * scale
        along = lambda s: value(unit(vertices + s * h * step), axes)  # noqa: B023
        expected = (8 * (along(1) - along(-1)) - (along(2) - along(-2))) / (12 * h)
        # padding repeats the first vertex, which the quadrature moves along with it
        moved = padded(step)
        np.testing.assert_allclose(np.sum(gradient * moved), expected, rtol=1e-6, atol=1e-7 * scale)
    step = rng.normal(size=axes.shape)
    along = lambda s: value(vertices, unit(axes + s * 1e-4 * step))
    expected = (8 * (along(1) - along(-1)) - (along(2) - along(-2))) / 12e-4
    np.testing.assert_allclose(np.sum(axis_gradient * step), expected, rtol=1e-6, atol=1e-7 * scale**2)


@pytest.mark.slow
def test_second_derivatives_and_both_modes(x64, rng):
    vertices, axes = random_polygon(rng, 4, 0.8), unit(rng.normal(size=(2, 3)))
    check_grads(lambda v, d: loss(v, d, 3), (vertices, axes), order=2, rtol=1e-5, atol=1e-6)


def test_a_whole_and_its_parts(dtype, rng):
    v = random_polygon(rng, 4, 1.0).astype(dtype)
    axes = unit(rng.normal(size=(5, 3))).astype(dtype)
    m = lambda x: np.asarray(domains.zonal_moments(domains.SphericalPolygon(padded(x)), axes, 20))
    tolerance = {"float64": 1e-13, "float32": 2e-5}[dtype.name]
    np.testing.assert_allclose(m(v), m(v[[0, 1, 2]]) + m(v[[0, 2, 3]]), atol=tolerance)
    np.testing.assert_allclose(m(v[::-1]), -m(v), atol=tolerance)
    np.testing.assert_allclose(m(np.roll(v, 1, axis=0)), m(v), atol=tolerance)


def test_the_outside_of_a_polygon(dtype, rng):
    """More than a hemisphere: reversed, it is the sphere without the polygon."""
    v = random_polygon(rng, 4, 0.7).astype(dtype)
    axes = unit(rng.normal(size=(5, 3))).astype(dtype)
    inside = domains.zonal_moments(domains.SphericalPolygon(padded(v)), axes, 20)
    outside = domains.zonal_moments(domains.SphericalPolygon(padded(v[::-1]), largest=4 * np.pi), axes, 20)
    whole = 4 * np.pi * np.eye(21)[0]
    tolerance = {"float64": 1e-13, "float32": 2e-5}[dtype.name]
    np.testing.assert_allclose(np.asarray(inside) + np.asarray(outside), np.tile(whole, (5, 1)), atol=tolerance)


def test_the_octants_cover_the_sphere(dtype):
    """Zero for l > 0, and 4 pi, whatever the axis; every edge is a quarter circle."""
    axes = unit([[0, 0, 1], [1, 2, 3], [-1, 0.5, 0]]).astype(dtype)
    total = 0
    for sx in (1, -1):
        for sy in (1, -1):
            for sz in (1, -1):
                v = np.diag([sx, sy, sz]).astype(dtype)
                v = v if sx * sy * sz > 0 else v[::-1]
                total = total + np.asarray(domains.zonal_moments(domains.SphericalPolygon(padded(v)), axes, 30))
    expected = np.zeros((3, 31))
    expected[:, 0] = 4 * np.pi
    np.testing.assert_allclose(total, expected, atol={"float64": 1e-14, "float32": 1e-5}[dtype.name])


def test_powers_against_quadrature_and_closed_values(dtype, rng):
    """Arvo's closed value: over an octant, the integral of z is pi/4 and of z^2 is pi/6."""
    octant = domains.SphericalPolygon(np.eye(3, dtype=dtype))
    tolerance = {"float64": 1e-14, "float32": 1e-6}[dtype.name]
    z = np.asarray([[0, 0, 1]], dtype)
    np.testing.assert_allclose(
        domains.axial_moments(octant, z, 2)[0], [np.pi / 2, np.pi / 4, np.pi / 6], rtol=tolerance
    )
    v, axes = random_polygon(rng, 5, 1.0).astype(dtype), unit(rng.normal(size=(4, 3))).astype(dtype)
    w, area = truth.triangle_rule(v, 24)
    d = np.asarray(axes, np.longdouble)
    cosine = w @ (d / np.sqrt(np.sum(d * d, axis=1, keepdims=True))).T
    expected = np.einsum("p,pkn->kn", area, cosine[..., None] ** np.arange(21)).astype(float)
    got = domains.axial_moments(domains.SphericalPolygon(padded(v)), axes, 20)
    np.testing.assert_allclose(got, expected, atol=5 * tolerance)


@pytest.mark.slow
def test_powers_differentiate(x64, rng):
    v, axes = random_polygon(rng, 3, 0.8), unit(rng.normal(size=(2, 3)))
    norm = lambda x: x / jnp.sqrt(jnp.sum(x * x, axis=-1, keepdims=True))
    check_grads(
        lambda v, d: domains.axial_moments(domains.SphericalPolygon(norm(v)), d, 4), (v, axes), 1, rtol=1e-6, atol=1e-8
    )


@pytest.mark.slow
def test_high_degree_and_fold_agree(dtype, rng):
    """The loop and the unrolled sweep of the fused sum, against the moments."""
    v = jnp.asarray(np.stack([random_polygon(rng, 4, s) for s in (1.0, 0.01)]).transpose(2, 1, 0), dtype)
    axes = jnp.asarray(unit(rng.normal(size=(3, 3))), dtype)
    for degree in (1, 7, 40, 70):
        w = jnp.asarray(rng.normal(size=(3, degree + 1, 1)), dtype)
        expected = jnp.einsum("lkp,klq->p", _moments.moments(axes, v, degree), w[:, 1:])
        l = np.maximum(np.arange(degree + 1), 1)
        got = _moments.fold(w / jnp.asarray(l * (l + 1), dtype)[None, :, None], axes, v, degree)
        np.testing.assert_allclose(got, expected, rtol={"float64": 1e-11, "float32": 1e-3}[dtype.name], atol=1e-9)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda p: domains.zonal_moments(p, [0.0, 0.0, 1.0], 2), "`axes` must have shape"),
        (lambda p: domains.zonal_moments(p, [[0.0, 0.0, 1.0]], -1), "`degree` must be >= 0"),
        (lambda p: domains.zonal_moments(p, [[0.0, 0.0, 0.0]], 2), "zero or not finite"),
        (lambda p: domains.zonal_moments("square", [[0.0, 0.0, 1.0]], 2), "SphericalPolygon or domains.SphericalCap"),
        (lambda p: domains.axial_moments(p, [[0.0, 0.0, 1.0]], -1), "`order` must be >= 0"),
    ],
)
def test_bad_input_is_named(call, message, as_user):
    with pytest.raises(Exception, match=message):
        call(domains.SphericalPolygon(np.eye(3, dtype=np.float32)))
