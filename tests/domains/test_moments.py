"""Zonal and axial moments against quadrature in extended precision, with their derivatives."""

import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import domains
from shisd.domains.moments import fold, moments
from tests import truth
from tests.hard_cases import AXES_AT_POLYGONS, HALF_TURNS, POLYGONS, TINY, axes_for, padded, random_polygon, unit

ROOT = Path(__file__).resolve().parent.parent.parent
DEGREE, AXES = 40, 9
WEIGHTS = np.cos(np.arange(AXES * (DEGREE + 1))).reshape(AXES, -1)

CASES = {name: (v, axes_for(v, np.random.default_rng(7))) for name, v in (POLYGONS | HALF_TURNS | TINY).items()}
CASES |= {name: (v, np.tile(d, (AXES, 1))) for name, (v, d) in AXES_AT_POLYGONS.items()}


@eqx.filter_jit
def evaluated(vertices, axes, weights):
    """Of all moments to degree 40 a weighted sum's gradients in vertices and axes, and the moments."""

    def total(v, d):
        values = domains.zonal_moments(domains.SphericalPolygon(v), d, DEGREE)
        return jnp.sum(values * weights), values

    return jax.grad(total, (0, 1), has_aux=True)(vertices, axes)


def derivatives(vertices, axes, size):
    """Motions of vertices and of axes, two each, and the derivatives of the weighted sum along them."""
    rng, v, d = np.random.default_rng(4), vertices.astype(np.longdouble), axes.astype(np.longdouble)
    total = lambda v, d: np.sum(WEIGHTS * truth.edge_moments(v, d, DEGREE, 24))
    least = min(size, float(np.min(np.linalg.norm(vertices + np.roll(vertices, -1, axis=0), axis=1))))
    tries = [], []
    for _ in range(2):
        move, turn = rng.normal(size=v.shape), rng.normal(size=d.shape)
        along = truth.derivative(lambda t: total(v + t * move, d), 2e-4 * least)  # noqa: B023
        # padding repeats the first vertex, which moves with it
        tries[0].append((padded(move), along))
        tries[1].append((turn, truth.derivative(lambda t: total(v, d + t * turn), 3e-4)))  # noqa: B023
    return tries


# float32 and float64, of the polygon as float32 has it: values, derivatives in vertices and in axes; with the tests'
# compiler options and with users', whichever is worse
LIMITS = {
    "coincident vertices": ((1e-06, 1e-06, 3e-06), (4e-15, 1e-13, 6e-13)),
    "collinear vertices": ((1e-06, 1e-06, 9e-06), (4e-15, 6e-15, 2e-13)),
    "edge near pi": ((4e-07, 6e-06, 7e-06), (8e-16, 7e-14, 8e-13)),
    "sliver": ((1e-02, 1e-05, 9e-03), (1e-11, 2e-12, 1e-10)),  # 5e-5 wide: one rounding is 1e-3 of that in float32
    "solid angle 1e-8": ((2e-06, 7e-05, 3e-05), (1e-12, 2e-11, 1e-11)),
    "one degree square": ((2e-05, 5e-05, 3e-05), (1e-14, 2e-13, 9e-12)),
    "non-convex": ((4e-06, 2e-05, 4e-06), (5e-15, 3e-14, 2e-13)),
    "clockwise": ((1e-06, 3e-06, 5e-06), (2e-15, 4e-15, 3e-13)),
    "near a hemisphere": ((9e-07, 1e-06, 5e-06), (2e-15, 3e-12, 1e-13)),
    "edge 1e-01 rad short of pi": ((2e-06, 3e-06, 2e-05), (5e-15, 4e-14, 3e-13)),
    "edge 1e-02 rad short of pi": ((3e-07, 5e-06, 2e-05), (4e-15, 7e-13, 1e-13)),
    "edge 1e-03 rad short of pi": ((6e-07, 1e-05, 1e-05), (8e-14, 2e-12, 2e-13)),
    "edge 1e-04 rad short of pi": ((7e-07, 5e-06, 1e-05), (1e-13, 3e-11, 4e-13)),
    "edge 1e-05 rad short of pi": ((3e-07, 1e-05, 8e-06), (2e-11, 5e-10, 6e-11)),
    "edge 1e-06 rad short of pi": (None, (7e-10, 7e-09, 5e-11)),  # refused in float32
    "solid angle 2e-06": ((2e-06, 4e-05, 8e-06), (3e-14, 3e-13, 4e-12)),
    "solid angle 2e-08": ((2e-06, 2e-06, 9e-06), (1e-12, 3e-12, 4e-12)),
    "solid angle 2e-10": ((2e-06, 5e-05, 6e-06), (5e-12, 7e-11, 6e-12)),
    "solid angle 2e-12": ((2e-06, 1e-05, 1e-05), (7e-11, 5e-10, 9e-11)),
    "vertex at the axis": ((1e-06, 3e-05, 9e-06), (4e-15, 4e-14, 8e-13)),
    "vertex opposite to the axis": ((1e-06, 2e-05, 1e-04), (4e-15, 3e-14, 4e-13)),
    "axis in the plane of an edge": ((4e-07, 8e-07, 2e-06), (3e-15, 5e-15, 2e-13)),
    "axis on an edge": ((3e-07, 2e-05, 9e-07), (3e-15, 1e-14, 2e-12)),
    "axis normal to an edge": ((2e-07, 2e-06, 1e-05), (3e-15, 3e-15, 2e-13)),
}


@pytest.mark.parametrize("name", CASES)
def test_values_and_derivatives(name):
    """Of values over the solid angle, and of derivatives over the largest."""
    vertices, axes = (x.astype(np.float32) for x in CASES[name])
    exact = truth.edge_moments(vertices, axes, DEGREE, 24).astype(float)
    whole = abs(exact[0, 0])
    tries = derivatives(vertices, axes, np.sqrt(whole))
    for dtype, limits in zip((np.float32, np.float64), LIMITS[name], strict=True):
        with jax.enable_x64(dtype == np.float64):
            arguments = padded(vertices).astype(dtype), axes.astype(dtype), WEIGHTS.astype(dtype)
            if limits is None:
                with pytest.raises(Exception, match="opposite"):
                    evaluated(*arguments)
                continue
            gradients, got = evaluated(*arguments)
        assert got.dtype == dtype
        errors = [np.max(np.abs(np.asarray(got, float) - exact)) / whole]
        for gradient, moves in zip(gradients, tries, strict=True):
            slopes = np.array([(np.sum(np.asarray(gradient, float) * move), along) for move, along in moves], float)
            errors.append(np.max(np.abs(slopes[:, 0] - slopes[:, 1])) / np.max(np.abs(slopes[:, 1])))
        assert all(e <= limit for e, limit in zip(errors, limits, strict=True)), (dtype.__name__, errors, limits)


@pytest.mark.skipif("SHISD_TESTS_AS_USERS" not in os.environ, reason="tests have no fused multiplications")
def test_axes_at_right_angles_to_a_vertex():
    """In a batch, where a sign that is left to roundings is not the same in all kernels."""
    rng, degree, count = np.random.default_rng(5), 16, 16
    vertices = unit(rng.normal(size=(count, 4, 3))).astype(np.float32)
    axes = unit(np.cross(vertices[:, :1].astype(float), rng.normal(size=(count, AXES, 3)))).astype(np.float32)
    weights = WEIGHTS[:, : degree + 1]

    def total(v, d):
        values = domains.zonal_moments(domains.SphericalPolygon(v), d, degree)
        return jnp.sum(values * jnp.asarray(weights, jnp.float32)), values

    batch = jax.vmap(jax.grad(total, 1, has_aux=True))
    slopes, got = jax.jit(batch)(vertices, axes)
    l = np.arange(degree + 1)
    bands = np.repeat(l, 2 * l + 1)
    for i, (v, d) in enumerate(zip(vertices, axes, strict=True)):
        y, y_slopes = (x.astype(float) for x in truth.harmonics(d.astype(np.longdouble), degree))
        c = truth.edge_coefficients(v.astype(np.longdouble), degree).astype(float) * 4 * np.pi / (2 * bands + 1)
        exact = (c * y) @ (bands[:, None] == l)
        np.testing.assert_allclose(got[i][:, 1:], exact[:, 1:], atol=1e-6)
        slope = np.einsum("kn,n,knx->kx", weights[:, bands], c, y_slopes)
        wrong = slopes[i] - slope
        wrong -= np.sum(wrong * d, axis=1, keepdims=True) * d  # along the sphere
        np.testing.assert_allclose(wrong, 0, atol=1e-5 * np.max(np.abs(slope)))


def test_lines_along_edges_are_areas():
    """The truth above and its solid angles against quadrature over areas, which shares nothing with it."""
    for name in ("non-convex", "clockwise", "edge 1e-03 rad short of pi"):
        vertices, axes = CASES[name]
        by_area = truth.zonal_moments(vertices, axes, 12, 24)
        by_line = truth.edge_moments(vertices, axes, 12, 24).astype(float)
        np.testing.assert_allclose(by_line, by_area, atol=1e-14, err_msg=name)


def moments_error(vertices, axes, dtype):
    """The largest error over the solid angle to degree 100, for the polygon and the axes as rounded."""
    vertices, axes = vertices.astype(dtype), axes.astype(dtype)
    got = domains.zonal_moments(domains.SphericalPolygon(padded(vertices)), axes, 100)
    exact = truth.edge_moments(vertices, axes, 100, 60).astype(float)
    return np.max(np.abs(np.asarray(got, float) - exact)) / abs(exact[0, 0])


def test_moments_to_degree_100(dtype, rng):
    """At random, from large to small; 24 small triangles, since rare ones are much worse than the median."""
    axes = unit(rng.normal(size=(9, 3)))
    limits = {1.0: (1e-6, 1e-13), 0.3: (1e-5, 1e-13), 0.06: (1e-5, 1e-13), 1e-3: (1e-5, 1e-12)}
    for size, limit in limits.items():
        errors = [moments_error(random_polygon(rng, count, size), axes, dtype) for count in (3, 4, 8, 3, 4, 8)]
        assert max(errors) < limit[dtype == np.float64], (size, errors)
    if dtype == np.float32:
        errors = [moments_error(random_polygon(rng, 3, 0.08), axes, dtype) for _ in range(24)]
        assert np.median(errors) < 2e-6 and max(errors) < 1e-5, (np.median(errors), max(errors))


def loss(vertices, axes, degree):
    """A smooth function of all moments; vertices and axes of any length."""
    norm = lambda x: x / jnp.sqrt(jnp.sum(x * x, axis=-1, keepdims=True))
    m = domains.zonal_moments(domains.SphericalPolygon(norm(vertices)), axes, degree)
    return jnp.sum(m * jnp.asarray(np.cos(np.arange(m.size)).reshape(m.shape), m.dtype))


@pytest.mark.slow
def test_second_derivatives_and_both_modes(x64, rng):
    vertices, axes = random_polygon(rng, 4, 0.8), unit(rng.normal(size=(2, 3)))
    check_grads(lambda v, d: loss(v, d, 3), (vertices, axes), order=2, rtol=1e-5, atol=1e-6)


def test_wholes_parts_and_outsides(dtype, rng):
    """Parts add up, winding is a sign, the outside of a polygon is the sphere without it, and octants are the sphere.

    All about nine axes to degree 100, where one function is compiled already.
    """
    v = random_polygon(rng, 4, 1.0).astype(dtype)
    axes = unit(rng.normal(size=(9, 3))).astype(dtype)
    m = lambda x, **options: np.asarray(
        domains.zonal_moments(domains.SphericalPolygon(padded(x), **options), axes, 100), float
    )
    tolerance, sphere = {"float64": 1e-13, "float32": 2e-5}[dtype.name], 4 * np.pi * np.eye(101)[:1]
    np.testing.assert_allclose(m(v), m(v[[0, 1, 2]]) + m(v[[0, 2, 3]]), atol=tolerance)
    np.testing.assert_allclose(m(v[::-1]), -m(v), atol=tolerance)
    np.testing.assert_allclose(m(np.roll(v, 1, axis=0)), m(v), atol=tolerance)
    np.testing.assert_allclose(m(v[::-1], largest=4 * np.pi) + m(v), sphere.repeat(9, 0), atol=tolerance)
    signs = [(x, y, z) for x in (1, -1) for y in (1, -1) for z in (1, -1)]
    octants = [np.diag(s).astype(dtype)[:: np.prod(s)] for s in signs]
    np.testing.assert_allclose(sum(map(m, octants)), sphere.repeat(9, 0), atol=tolerance)


def test_powers_against_quadrature_and_closed_values(dtype, rng):
    """Over an octant the integral of z^n is pi/2 / (n+1), of which Arvo has n = 1 and 2."""
    tolerance, z = {"float64": 1e-14, "float32": 1e-6}[dtype.name], np.asarray([[0, 0, 1]] * 4, dtype)
    m = lambda v, d: np.asarray(domains.axial_moments(domains.SphericalPolygon(padded(v)), d, 80))
    np.testing.assert_allclose(
        m(np.eye(3, dtype=dtype), z), np.tile(np.pi / 2 / np.arange(1, 82), (4, 1)), rtol=5 * tolerance
    )
    v, axes = random_polygon(rng, 5, 1.0).astype(dtype), unit(rng.normal(size=(4, 3))).astype(dtype)
    w, area = truth.triangle_rule(v, 24)
    d = np.asarray(axes, np.longdouble)
    cosine = w @ (d / np.sqrt(np.sum(d * d, axis=1, keepdims=True))).T
    expected = np.einsum("p,pkn->kn", area, cosine[..., None] ** np.arange(21)).astype(float)
    np.testing.assert_allclose(m(v, axes)[:, :21], expected, atol=5 * tolerance)


@pytest.mark.slow
def test_powers_differentiate(x64, rng):
    v, axes = random_polygon(rng, 3, 0.8), unit(rng.normal(size=(2, 3)))
    norm = lambda x: x / jnp.sqrt(jnp.sum(x * x, axis=-1, keepdims=True))
    check_grads(
        lambda v, d: domains.axial_moments(domains.SphericalPolygon(norm(v)), d, 4), (v, axes), 1, rtol=1e-6, atol=1e-8
    )


def test_fold_agrees_with_moments(x64, rng):
    """The unrolled sweep of a weighted sum, its value and its gradient in the outline, at degree 7."""
    v = np.stack([random_polygon(rng, 4, s) for s in (1.0, 0.01)]).transpose(2, 1, 0)
    v, axes, w = jnp.asarray(v), jnp.asarray(unit(rng.normal(size=(3, 3)))), jnp.asarray(rng.normal(size=(3, 8, 1)))
    l = np.arange(1.0, 8)
    folded = lambda v: fold(w, axes, v, 7)
    summed = lambda v: jnp.einsum("lkp,klq,l->p", moments(axes, v, 7), w[:, 1:], l * (l + 1))
    (got, back), (expected, back_expected) = (jax.vjp(jax.jit(f), v) for f in (folded, summed))
    gradient, expected_gradient = back(jnp.ones(2))[0], back_expected(jnp.ones(2))[0]
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    np.testing.assert_allclose(gradient, expected_gradient, atol=1e-11)


@pytest.mark.slow
def test_high_degree_and_fold_agree(dtype, rng):
    """The loop and the unrolled sweep of the fused sum, against the moments."""
    v = jnp.asarray(np.stack([random_polygon(rng, 4, s) for s in (1.0, 0.01)]).transpose(2, 1, 0), dtype)
    axes = jnp.asarray(unit(rng.normal(size=(3, 3))), dtype)
    for degree in (1, 7, 40, 70):
        w = jnp.asarray(rng.normal(size=(3, degree + 1, 1)), dtype)
        expected = jnp.einsum("lkp,klq->p", moments(axes, v, degree), w[:, 1:])
        l = np.maximum(np.arange(degree + 1), 1)
        got = fold(w / jnp.asarray(l * (l + 1), dtype)[None, :, None], axes, v, degree)
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


def run_as_users_compile(selection):
    """Tests of this file with all of XLA's optimisations, which the tests leave out."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", __file__]
    command += ["-k", f"{selection} and not users"]
    run = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "SHISD_TESTS_AS_USERS": "1"}, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.slow
def test_hard_cases_as_users_compile_them():
    run_as_users_compile("test_values_and_derivatives")


def test_right_angles_as_users_compile_them():
    run_as_users_compile("right_angles")
