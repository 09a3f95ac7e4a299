"""Polygon lights against area quadrature of the material itself, lights above, across and below the horizon."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import decomposition, models, shading
from tests import truth
from tests.hard_cases import unit

QUAD = np.array([[-0.5, -0.5, 1.0], [-0.5, 0.5, 1.2], [0.5, 0.5, 1.2], [0.5, -0.5, 1.0]])  # emits downwards
BRDFS = {"lambertian": lambda: models.Lambertian(0.8), "glossy": lambda: models.Ggx(0.5, 0.04)}


def scene(rng, count):
    """Points below and beside the light; the first one has it wholly below its horizon, the second half."""
    position = rng.uniform(-1, 1, (count, 3)) * [1, 1, 0.2]
    normal = unit(rng.normal(size=(count, 3)) * 0.5 + [0, 0, 1])
    normal[:2] = [0, 0, -1], unit([1, 0.2, -0.3])
    position[1] = [0.1, 0, 0.3]
    view = unit(0.6 * unit(rng.normal(size=(count, 3))) + normal)
    view[2] = normal[2]
    return position, normal, view


def local_outline(points, position, normal):
    """The outline above the horizon, by plain clipping, and the frame (rows)."""
    x = unit(np.cross(normal, [0.3, 0.5, -0.7]))
    frame = np.stack([x, np.cross(normal, x), normal])
    local, kept = (points - position) @ frame.T, []
    for a, b in zip(local, np.roll(local, -1, axis=0), strict=True):
        kept += [a] if a[2] > 0 else []
        kept += [a + (b - a) * a[2] / (a[2] - b[2])] if (a[2] > 0) != (b[2] > 0) else []
    return unit(kept) if kept else None, frame


def quadrature(integrand, points, position, normal, nodes=40):
    """Integral of integrand(directions in the local frame, frame) over the light, unsigned."""
    outline, frame = local_outline(points, position, normal)
    if outline is None:
        return 0.0
    w, area = truth.triangle_rule(outline, nodes)
    return abs(float(np.sum(integrand(w.astype(float), frame) * area.astype(float))))


@functools.cache
def lobes_of(name, degree, dtype, domain="upper"):
    basis = decomposition.RotatedZonalBasis(decomposition.optimized_directions(degree, dtype=dtype), degree)
    return shading.tabulate_brdf(BRDFS[name](), basis, domain=domain)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bound"), [("lambertian", 3e-5), ("glossy", 1e-4)])
def test_radiance_of_the_material(name, bound, dtype, rng):
    """Relative RMSE at degree 20, interpolation of views included; ordinary projection is many times worse."""
    position, normal, view = scene(rng, 16)
    brdf = BRDFS[name]()
    expected = []
    for p, n, v in zip(position, normal, view, strict=True):
        values = lambda w, frame, v=v: jax.vmap(lambda wi: brdf.value_cosine(wi, jnp.asarray(frame @ v)))(
            jnp.asarray(w)
        )
        with jax.enable_x64(True):
            expected.append(quadrature(values, QUAD, p, n))
    rms = lambda got: np.sqrt(np.mean((got - expected) ** 2) / np.mean(np.square(expected)))
    light = models.PolygonLight(QUAD.astype(dtype))
    arrays = [a.astype(dtype) for a in (position, normal, view)]
    got = shading.shade_polygon(lobes_of(name, 20, dtype.name), light, *arrays)
    assert got.dtype == dtype and got[0] == 0
    assert rms(np.asarray(got)) < bound
    plain = shading.shade_polygon(lobes_of(name, 20, dtype.name, "sphere"), light, *arrays)
    assert rms(np.asarray(plain)) > 5 * rms(np.asarray(got))


def test_exact_for_the_tabulated_slice(dtype, rng):
    """The clipped integral of the interpolated slice, with SciPy's harmonics."""
    position, normal, view = scene(rng, 6)
    lobes = lobes_of("glossy", 4, dtype.name)
    light = models.PolygonLight(QUAD.astype(dtype), two_sided=True)
    got = np.asarray(shading.shade_polygon(lobes, light, *(a.astype(dtype) for a in (position, normal, view))))
    expected = []
    for p, n, v in zip(position, normal, view, strict=True):
        _, frame = local_outline(QUAD, p, n)
        c = np.asarray(lobes.slice_coefficients(jnp.asarray(frame @ v, dtype)), float)
        expected.append(quadrature(lambda w, _, c=c: truth.scipy_basis(w, 4) @ c, QUAD, p, n))
    tolerance = {"float64": 1e-12, "float32": 3e-5}[dtype.name]
    np.testing.assert_allclose(got, expected, atol=tolerance * np.max(expected))


def test_sides_colours_and_several_lights(rng):
    position, normal, view = (a.astype(np.float32) for a in scene(rng, 5))
    lobes = lobes_of("glossy", 4, "float32")
    shade = lambda light: np.asarray(shading.shade_polygon(lobes, light, position, normal, view))
    quad = QUAD.astype(np.float32)
    front, back = models.PolygonLight(quad), models.PolygonLight(quad[::-1].copy())
    assert np.any(shade(front) > 0)
    np.testing.assert_array_equal(shade(back), 0)
    both = models.PolygonLight(quad[::-1].copy(), two_sided=True)
    np.testing.assert_allclose(shade(both), shade(front), rtol=2e-4, atol=1e-6)
    red = models.PolygonLight(quad, np.asarray([2.0, 0.0, 1.0], np.float32))
    assert shade(red).shape == (5, 3)
    np.testing.assert_allclose(shade(red), shade(front)[:, None] * [2, 0, 1], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(shade([front, red]), shade(front)[:, None] * [3, 1, 2], rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_derivatives(x64, rng):
    position, normal, view = scene(rng, 4)
    lobes = lobes_of("glossy", 4, "float64")

    def radiance(points, emission, position, normal, view):
        light = models.PolygonLight(points, emission)
        return shading.shade_polygon(lobes, light, position, normal, view)

    arguments = (QUAD, np.asarray(1.3), position[1:], normal[1:], view[1:])
    check_grads(radiance, arguments, order=1, rtol=1e-5, atol=1e-7)
    below = lambda points: jnp.sum(radiance(points, 1.0, position[:1], normal[:1], view[:1]))
    np.testing.assert_array_equal(jax.grad(below)(jnp.asarray(QUAD)), 0)


def test_a_point_in_the_plane_of_the_light_is_dark():
    lobes = lobes_of("glossy", 4, "float32")
    light = models.PolygonLight(np.asarray([[1, -1, 0], [1, 1, 0], [2, 1, 0], [2, -1, 0]], np.float32), two_sided=True)
    up = np.asarray([[0, 0, 1]], np.float32)
    value, gradient = jax.value_and_grad(lambda p: shading.shade_polygon(lobes, light, p, up, up)[0])(0 * up)
    assert value == 0 and np.all(np.isfinite(gradient))


def test_bad_input_is_named(as_user):
    lobes, up = lobes_of("glossy", 4, "float32"), np.asarray([0, 0, 1], np.float32)
    with pytest.raises(ValueError, match="fitted above the horizon"):
        shading.shade_environment(lobes, np.ones(9, np.float32), up, up)
    with pytest.raises(ValueError, match="`light` must be"):
        shading.shade_polygon(lobes, [], up, up, up)
    with pytest.raises(ValueError, match="at least 3 points"):
        models.PolygonLight(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="`emission` must be"):
        models.PolygonLight(QUAD, np.ones((2, 3)))
    with pytest.raises(ValueError, match="`domain` must be"):
        shading.tabulate_brdf(models.Lambertian(0.5), lobes.basis, domain="lower")
