"""Polygon lights against area quadrature of the material itself, lights above, across and below the horizon."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import decomposition, domains, models, reference, shading
from tests import truth
from tests.hard_cases import unit
from tests.marks import FLOAT32_FIRST

QUAD = np.array([[-0.5, -0.5, 1.0], [-0.5, 0.5, 1.2], [0.5, 0.5, 1.2], [0.5, -0.5, 1.0]])  # emits downwards
BRDFS = {
    "lambertian": lambda: models.Lambertian(0.8),
    "glossy": lambda: models.Ggx(0.5, 0.04),
    "sharp": lambda: models.Ggx(0.25, 0.04),
    "phong": lambda: models.Phong(0.5, 20.0),
}


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
    """Integral of integrand(directions in the local frame, frame) over the light, whatever its winding."""
    outline, frame = local_outline(points, position, normal)
    if outline is None:
        return 0.0
    w, area = truth.triangle_rule(outline, nodes)
    return np.sign(float(area.sum())) * area.astype(float) @ integrand(w.astype(float), frame)


@functools.cache
def lobes_of(name, degree, dtype, domain="upper"):
    basis = decomposition.RotatedZonalBasis(decomposition.optimized_directions(degree, dtype=dtype), degree)
    return shading.tabulate_brdf(BRDFS[name](), basis, domain=domain)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "bound", "gain"),
    [("lambertian", 3e-5, 5), ("glossy", 1e-4, 5), ("sharp", 3e-3, 3), ("phong", 2e-4, 0)],
)
def test_radiance_of_the_material(name, bound, gain, dtype, rng):
    """Relative RMSE at degree 20, interpolation of views included, and how much worse ordinary projection is."""
    position, normal, view = scene(rng, 64)
    with jax.enable_x64(True):
        expected = np.asarray(
            reference.shade_polygon_quadrature(BRDFS[name](), QUAD, 1.0, position, normal, view, nodes=48)
        )
    assert 0 < np.sum(expected == 0) < 10
    rms = lambda got: np.sqrt(np.mean((np.asarray(got) - expected) ** 2) / np.mean(np.square(expected)))
    light = models.PolygonLight(QUAD.astype(dtype))
    arrays = [a.astype(dtype) for a in (position, normal, view)]
    shade = lambda domain: shading.shade_polygon(lobes_of(name, 20, dtype.name, domain), light, *arrays)
    got = shade("upper")
    assert got.dtype == dtype and got[0] == 0
    assert rms(got) < bound, rms(got)
    assert rms(shade("sphere")) > gain * rms(got)


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


def expected_radiance(lobes, light, position, normal, view, points=QUAD):
    """The clipped integral of the interpolated slice times light(world directions) [N, colour], SciPy's harmonics."""
    radiance = []
    for p, n, v in zip(position, normal, view, strict=True):
        _, frame = local_outline(points, p, n)
        c = np.asarray(lobes.slice_coefficients(jnp.asarray(frame @ v, lobes.weights.dtype)), float)
        values = lambda w, frame, c=c: (truth.scipy_basis(w, 4) @ c)[:, None] * light(w @ frame)
        radiance.append(quadrature(values, points, p, n) * np.ones(3))
    return np.stack(radiance)


HARD = {
    "1e-4 away": [[-0.5, -0.5, 1e-4], [-0.5, 0.5, 1e-4], [0.5, 0.5, 1e-4], [0.5, -0.5, 1e-4]],
    "an edge on the horizon": [[1, -0.4, 0], [1.2, -0.4, 0.8], [1.1, 0.5, 0.9], [1, 0.5, 0]],
    "a corner on the horizon": [[1, 0, 0], [1.2, -0.4, 0.8], [1.1, 0.2, 0.9], [1, 0.5, 0.3]],
    "across the horizon, turning inwards": [[1, -1, -0.3], [1, 0, 0.8], [1, 0.2, -0.4], [1, 0.4, 0.7], [1, 1, -0.2]],
}


@pytest.mark.parametrize("name", HARD)
def test_hard_cases(name, dtype):
    """Values against quadrature, gradients against those of a light that is moved a little."""
    points = np.asarray(HARD[name], dtype)
    lobes, up = lobes_of("glossy", 4, dtype.name), np.asarray([[0, 0, 1]], dtype)
    view = unit([[0.4, -0.3, 0.6]]).astype(dtype)
    shade = jax.jit(lambda q: shading.shade_polygon(lobes, models.PolygonLight(q, two_sided=True), 0 * up, up, view)[0])
    expected = expected_radiance(lobes, lambda w: 1, 0 * up, up, view, points.astype(float))[0, 0]
    np.testing.assert_allclose(shade(points), expected, rtol={"float64": 1e-11, "float32": 1e-4}[dtype.name])
    if dtype == np.float64:
        lift = np.asarray([0, 0, 1e-11 if name == "1e-4 away" else -1e-7])  # what is on the horizon counts as cut
        gradient = jax.grad(shade)
        scale = np.max(np.abs(gradient(points)))
        np.testing.assert_allclose(gradient(points), gradient(points + lift), atol=2e-5 * scale)


@pytest.mark.slow
def test_light_by_direction(dtype, rng):
    """A profile at the light, and distant light through the same outline; in front, and from behind nothing."""
    position, normal, view = scene(rng, 6)
    lobes, e = lobes_of("glossy", 4, dtype.name), rng.normal(size=(3, 16)).astype(dtype)
    tolerance = {"float64": 1e-12, "float32": 3e-5}[dtype.name]
    points, arrays = QUAD.astype(dtype), [a.astype(dtype) for a in (position, normal, view)]
    portal = models.PortalLight(points, e)
    distant = lambda w: truth.scipy_basis(w, 3) @ e.astype(float).T
    leaving = lambda w: 0.7 * distant(-w)
    light = models.PolygonLight(points, np.asarray(0.7, dtype), profile=e)
    for got, radiance in (
        (shading.shade_portal(lobes, portal, *arrays), distant),
        (shading.shade_polygon(lobes, light, *arrays), leaving),
    ):
        expected = expected_radiance(lobes, radiance, position, normal, view)
        assert got.dtype == dtype
        np.testing.assert_allclose(got, expected, atol=tolerance * np.max(np.abs(expected)))
    outside = models.PortalLight(points[::-1].copy(), e)
    np.testing.assert_array_equal(shading.shade_portal(lobes, outside, *arrays), 0)


def test_a_uniform_profile_and_several_portals(rng):
    position, normal, view = (a.astype(np.float32) for a in scene(rng, 5))
    lobes, quad = lobes_of("glossy", 4, "float32"), QUAD.astype(np.float32)
    one = np.asarray([np.sqrt(4 * np.pi)], np.float32)
    plain = np.asarray(shading.shade_polygon(lobes, models.PolygonLight(quad), position, normal, view))
    shaped = models.PolygonLight(quad, np.asarray([1, 2], np.float32), profile=one)
    got = shading.shade_polygon(lobes, [shaped, models.PolygonLight(quad)], position, normal, view)
    np.testing.assert_allclose(got, plain[:, None] * [2, 3], rtol=1e-4, atol=1e-6)
    portal = models.PortalLight(quad, one)
    got = shading.shade_portal(lobes, [portal, portal], position, normal, view)
    np.testing.assert_allclose(got, 2 * plain, rtol=1e-4, atol=1e-6)


@FLOAT32_FIRST
def test_projected_light(dtype, rng):
    """Coefficients of what a light sends to a point, against quadrature; several points and colours."""
    position = scene(rng, 4)[0].astype(dtype)
    e, quad = rng.normal(size=(3, 9)).astype(dtype), QUAD.astype(dtype)
    lights = {
        "plain": (models.PolygonLight(quad, np.asarray([1, 2], dtype)), lambda w: np.broadcast_to([1, 2], (len(w), 2))),
        "portal": (models.PortalLight(quad, e), lambda w: truth.scipy_basis(w, 2) @ e.astype(float).T),
    }
    haar = domains.HaarBasis(1)
    for light, radiance in lights.values():
        got, cells = (np.asarray(shading.project_light(light, position, basis)) for basis in (5, haar))
        assert got.dtype == cells.dtype == dtype
        for p, c, h in zip(position, got, cells, strict=True):
            w, area = (x.astype(float) for x in truth.triangle_rule(unit(QUAD - p), 40))
            expected = -(radiance(w) * area[:, None]).T @ truth.scipy_basis(w, 5)
            np.testing.assert_allclose(c, expected, atol={"float64": 1e-11, "float32": 1e-4}[dtype.name])
            # the wavelets' integral, and in SciPy's basis what is left of it within each octant
            total = np.asarray(haar.values(h)) @ haar.areas
            scale = np.sqrt(4 * np.pi)
            np.testing.assert_allclose(
                total, expected[:, 0] * scale, atol={"float64": 1e-11, "float32": 1e-4}[dtype.name]
            )


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
    check_grads(radiance, arguments, order=1, rtol=1e-6, atol=1e-8)
    below = lambda points: jnp.sum(radiance(points, 1.0, position[:1], normal[:1], view[:1]))
    np.testing.assert_array_equal(jax.grad(below)(jnp.asarray(QUAD)), 0)


@pytest.mark.slow
@pytest.mark.parametrize("sine", [0.0, 1e-7, 0.009, 0.011], ids="s={}".format)
def test_derivatives_of_views_near_the_normal(sine, x64, rng):
    """Where the plane of incidence turns ever faster, on both sides of where its rule changes; in the material too."""
    position, normal, _ = scene(rng, 4)
    lobes, azimuth = lobes_of("sharp", 6, "float64"), rng.uniform(0, 2 * np.pi, (4, 1))
    x = unit(np.cross(normal, [0.3, 0.5, -0.7]))
    view = normal + sine * (np.cos(azimuth) * x + np.sin(azimuth) * np.cross(normal, x))

    def radiance(weights, points, view, normal):
        material = eqx.tree_at(lambda m: m.weights, lobes, jnp.asarray(weights))
        return shading.shade_polygon(material, models.PolygonLight(points), position[2:], normal[2:], view[2:])

    arguments = (lobes.weights, QUAD, view, normal)
    for i, x in enumerate(arguments):  # a change of all weights is rough in the view: not both at a time
        only = lambda x, i=i: radiance(*arguments[:i], x, *arguments[i + 1 :])
        check_grads(only, (jnp.asarray(x),), order=1, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_derivatives_of_portals(x64, rng):
    position, normal, view = (a[1:4] for a in scene(rng, 4))
    lobes = lobes_of("glossy", 4, "float64")
    shade = lambda points, e, *surface: shading.shade_portal(lobes, models.PortalLight(points, e), *surface)
    check_grads(shade, (QUAD, rng.normal(size=9), position, normal, view), order=1, rtol=1e-6, atol=1e-8)
    project = lambda points, p: shading.project_light(models.PolygonLight(points), p, domains.HaarBasis(1))
    check_grads(project, (QUAD, position), order=1, rtol=1e-6, atol=1e-8, eps=1e-5)


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
    with pytest.raises(ValueError, match="`light` must be"):
        shading.project_light(QUAD, up, 2)
    with pytest.raises(ValueError, match="`portal` must be a models.PortalLight"):
        shading.shade_portal(lobes, models.PolygonLight(QUAD), up, up, up)
    with pytest.raises(ValueError, match="do not broadcast"):
        models.PolygonLight(QUAD, np.ones(2), profile=np.ones((3, 4)))
    with pytest.raises(ValueError, match="`domain` must be"):
        shading.tabulate_brdf(models.Lambertian(0.5), lobes.basis, domain="lower")
