"""Materials themselves at Gauss points on lights, against quadrature of a textbook's formula and closed values."""

from typing import ClassVar
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import models, shading
from shisd._lanes import kernel_takes, one_kernel
from tests import truth
from tests.hard_cases import unit
from tests.marks import FLOAT64_FIRST

ALPHA = 0.4
CENTERED = np.array([[1, 0.2, 0], [0.3, 1, 0], [-0.9, 0.6, 0], [-1, -0.5, 0], [0.1, -0.8, 0], [0.8, -0.6, 0]])[::-1]
OUTLINES = {
    "three corners": np.array([[-1, 1, 1.5], [1, 0.7, 1.4], [0.3, -1.2, 1.8]]),
    "four corners": np.array([[-0.9, 1.1, 1.8], [1, 1, 1.6], [1.2, -0.8, 1.4], [-1, -1, 1.5]]),
    "six corners": CENTERED + [0.2, 0.1, 1.4],
    "not convex": np.array([[1, 0, 1.5], [1, -1, 1.5], [-1, -1, 1.5], [-1, 0.9, 1.5], [0, -0.5, 1.5]]),
    "upright": np.array([[1.0, -1, -1], [1, -1, 1.5], [1, 1, 1.5], [1, 1, -1]]),
}


def scene():
    """Points below the lamps, with the horizon across them and with the lamp behind it."""
    normals = unit(np.array([[0, 0, 1.0], [0.1, 0.2, 1], [-0.8, 0.1, 0.3], [0, 0.9, 0.2], [0, 0.3, -1]]))
    positions = np.array([[0, 0, 0.0], [0.3, 0.2, 0], [0.1, 0, 0.2], [-0.4, 0.6, 0.1], [0.2, -0.5, 0]])
    views = unit(normals + 0.8 * unit(np.array([[1.0, 0, 0], [0, 1, 1], [0.4, -1, 0.2], [-1, 0.3, 1], [0.2, 0, 0]])))
    return positions, normals, views


def expected(points, light, geometry, nodes=24):
    """light(w in the world) GGX (w) over what is above the horizon; [P]."""
    values = []
    for position, normal, view in zip(*geometry, strict=True):
        frame = truth.frame_of(normal)
        outline = truth.outline_above(points, position, frame)
        if outline is None:
            values.append(0.0)
            continue
        w, area = truth.triangle_rule(outline, nodes)
        values.append(-np.sum(truth.ggx_cosine(w, frame @ view, ALPHA) * light(w @ frame) * area))
    return np.array(values, float)


def shade(material, light, geometry, dtype=np.float64):
    positions, normals, views = (a.astype(dtype) for a in geometry)
    return np.asarray(shading.shade(material, light, shading.Surface(normals, views, positions)))


def ggx(dtype=np.float64, alpha=ALPHA):
    return models.Ggx(np.asarray(alpha, dtype), np.asarray(0.04, dtype))


LIMITS = {  # of the largest radiance, at order 4 and 16
    "three corners": (5e-3, 2e-11), "four corners": (5e-3, 1.5e-12), "six corners": (5e-3, 1.5e-11),
    "not convex": (4e-3, 6e-12), "upright": (3e-2, 4e-9),
}  # fmt: skip


@pytest.mark.parametrize("name", OUTLINES)
def test_radiance_of_the_model(name, x64):
    points, geometry = OUTLINES[name], scene()
    want = expected(points, lambda w: 1, geometry)
    errors = [
        np.max(np.abs(shade(shading.Quadrature(ggx(), order), models.PolygonLight(points), geometry) - want))
        for order in (4, 16)
    ]
    assert np.max(want) > 1e-3 and np.all(errors < np.array(LIMITS[name]) * np.max(want)), errors


@FLOAT64_FIRST
def test_light_that_depends_on_direction(dtype, rng):
    """A window and a lamp with a profile, which plain slices would need a product for."""
    points, geometry = OUTLINES["six corners"], scene()
    c = np.concatenate([[3.0], rng.normal(size=8)])
    sky = lambda w: truth.scipy_basis(w.astype(float), 2) @ c
    material = shading.Quadrature(ggx(dtype), 16)
    error = 3e-6 if dtype == np.float32 else 2e-11
    window = models.PortalLight(points.astype(dtype), np.stack([c, 2 * c]).astype(dtype))
    want = expected(points, sky, geometry)
    got = shade(material, window, geometry, dtype)
    assert got.dtype == dtype and got.shape == (5, 2)
    np.testing.assert_allclose(got, want[:, None] * [1, 2], rtol=0, atol=error * np.max(np.abs(want)))
    lamp = models.PolygonLight(points.astype(dtype), np.asarray(2, dtype), profile=c.astype(dtype))
    want = 2 * expected(points, lambda w: sky(-w), geometry)
    np.testing.assert_allclose(shade(material, lamp, geometry, dtype), want, rtol=0, atol=error * np.max(np.abs(want)))


def test_materials_take_it_under_all_local_lights(rng):
    geometry = tuple(a.astype(np.float32) for a in scene())
    points = OUTLINES["four corners"].astype(np.float32)
    model = shading.Quadrature(ggx(np.float32), 2)
    plain = shading.Slices(np.zeros((8, 9), np.float32), domain="upper")
    both = shading.Material(None, plain, model)
    window = models.PortalLight(points, np.ones(4, np.float32))
    ball = models.SphereLight(np.float32([0, 0, 2]), np.float32(0.5))
    for light in (models.PolygonLight(points), window, ball):
        got = shade(both, light, geometry, np.float32)
        np.testing.assert_array_equal(got, shade(model, light, geometry, np.float32))
        assert np.max(got) > 1e-3


def test_windows_take_it_beside_maps_for_lamps():
    """One material: maps under a lamp, points under a window."""
    geometry = tuple(a.astype(np.float32) for a in scene())
    points, model = OUTLINES["four corners"].astype(np.float32), shading.Quadrature(ggx(np.float32), 2)
    maps = shading.TransformedSlices(*(np.zeros(x, np.float32) for x in ((8, 5), (8, 9), (8, 9))))
    both = shading.Material(None, model, maps)
    lamp, window = models.PolygonLight(points), models.PortalLight(points, np.ones(4, np.float32))
    got = shade(both, [lamp, window], geometry, np.float32)
    np.testing.assert_array_equal(got, shade(model, window, geometry, np.float32))  # the maps hold nothing
    np.testing.assert_array_equal(
        shade(shading.Material(None, model), lamp, geometry, np.float32), shade(model, lamp, geometry, np.float32)
    )


BALLS = [([0.4, 0.3, 1.5], 0.3, 1.5e-5), ([0, 0, 1], 0.6, 1e-4), ([1, 0, 0.2], 0.5, 5e-4)]


@pytest.mark.parametrize("center, radius, error", BALLS)
def test_balls_are_polygons_of_their_solid_angle(center, radius, error, x64):
    """A white surface, wholly lit, receives pi sin^2 of the half angle times the cosine; anything, from quadrature."""
    positions = np.array([[0, 0, 0.0], [0.3, -0.2, 0], [-0.5, 0.1, 0]])
    geometry = positions, np.tile([0, 0, 1.0], (3, 1)), unit(np.array([[1.0, 0, 1], [0, 0.3, 1], [-2, 1, 1]]))
    light = models.SphereLight(np.array(center, float), radius)
    away = np.array(center) - positions
    distance = np.linalg.norm(away, axis=1)
    above = away[:, 2] > radius
    white = shade(shading.Quadrature(models.Lambertian(np.float64(1)), 6), light, geometry)
    lit = (radius / distance) ** 2 * away[:, 2] / distance
    np.testing.assert_allclose(white[above], lit[above], rtol=error)
    turns = 2 * np.pi * (np.arange(400) + 0.5) / 400
    x, weight = np.polynomial.legendre.leggauss(300)
    want = []
    for a, d, view in zip(away, distance, geometry[2], strict=True):
        versine = (radius / d) ** 2 / (1 + np.sqrt(1 - (radius / d) ** 2)) * (x + 1) / 2
        frame = truth.frame_of(a).astype(float)
        sine = np.sqrt(versine * (2 - versine))[:, None, None]
        w = (1 - versine)[:, None, None] * frame[2] + sine * (
            np.cos(turns)[:, None] * frame[0] + np.sin(turns)[:, None] * frame[1]
        )
        size = (radius / d) ** 2 / (1 + np.sqrt(1 - (radius / d) ** 2)) * np.pi / 400
        want.append(np.einsum("st,s->", truth.ggx_cosine(w, view, ALPHA), weight) * size)
    got = shade(shading.Quadrature(ggx(), 16), light, geometry)
    np.testing.assert_allclose(got, want, atol=error * np.max(want))


def test_inside_a_ball_light_is_all_around(x64):
    """By points, and beyond maps: a white surface sends back all of it."""
    geometry = tuple(a[:3] for a in scene())
    light = models.SphereLight(np.zeros(3), 2.0)
    white = shade(shading.Quadrature(models.Lambertian(np.float64(1)), 8), light, geometry)
    np.testing.assert_allclose(white, 1, rtol=5e-5)
    c = np.zeros((8, 4))
    c[:, 2] = np.sqrt(4 * np.pi / 3) / np.pi
    beyond = shading.TransformedSlices(np.zeros((8, 5)), c, np.zeros((8, 9)))
    np.testing.assert_allclose(shade(beyond, light, geometry), 1, rtol=2e-15)


def test_derivatives_in_everything(x64, rng):
    points, (positions, normals, views) = OUTLINES["upright"], scene()
    kept = slice(0, 3)
    weights = rng.normal(size=3)

    def total(alpha, points, center, positions, normals, views):
        surface = shading.Surface(normals, views, positions)
        lights = [models.PolygonLight(points), models.SphereLight(center, 0.4)]
        return weights @ shading.shade(shading.Quadrature(models.Ggx(alpha, 0.5), 24), lights, surface)

    arguments = [jnp.asarray(a) for a in (0.4, points, [0.4, 0.5, 1.2], positions[kept], normals[kept], views[kept])]
    both = jax.jit(jax.value_and_grad(total, argnums=range(6)))
    slopes = both(*arguments)[1]
    for i, slope in enumerate(slopes):
        move = rng.normal(size=slope.shape)
        ends = [both(*(a + t * move if k == i else a for k, a in enumerate(arguments)))[0] for t in (1e-5, -1e-5)]
        want = (ends[0] - ends[1]) / 2e-5
        assert abs(want) > 1e-4
        np.testing.assert_allclose(np.sum(np.asarray(slope) * move), want, rtol=9e-9, err_msg=str(i))


class Tabulated(models.AbstractBrdf):
    """Lambertian by a table and a product of matrices, neither of which one kernel takes."""

    isotropic: ClassVar[bool] = True
    table: jax.Array

    @property
    def lobe_width(self):
        return jnp.ones((), self.table.dtype)

    def value(self, wi, wo):
        place = (2 * jnp.abs(wi[2])).astype(jnp.int32)
        return self.table.astype(wi.dtype)[place] * (jnp.outer(wo, wo) @ wo @ wo)


@FLOAT64_FIRST
def test_many_points_in_one_kernel_and_what_it_does_not_take(dtype):
    """Each as it is alone."""
    light, few = models.PolygonLight(OUTLINES["upright"].astype(dtype)), scene()
    many = tuple(np.tile(a, (60, 1)) for a in few)
    by = lambda brdf, where: shade(shading.Quadrature(brdf, 5), light, where, dtype)
    found = []
    asked = lambda *inputs: found.append(kernel_takes(*inputs)) or found[-1]
    with mock.patch("shisd.shading._quadrature.kernel_takes", asked):
        matt = by(models.Lambertian(np.asarray(0.5, dtype)), many)
        shiny = by(ggx(dtype), many)
        same = by(Tabulated(jnp.full(3, 0.5 / np.pi, dtype)), many)
    assert found == [one_kernel(), one_kernel(), False]
    limit = {"rtol": 2e-6 if dtype == np.float32 else 1e-13, "atol": 1e-7 if dtype == np.float32 else 1e-15}
    np.testing.assert_allclose(same, matt, **limit)
    np.testing.assert_allclose(shiny, np.tile(by(ggx(dtype), few), 60), **limit)


def test_errors_name_the_argument(as_user):
    with pytest.raises(ValueError, match="`brdf` must be a models.AbstractBrdf; got float"):
        shading.Quadrature(0.3)
    with pytest.raises(ValueError, match="`order` must be >= 1; got 0"):
        shading.Quadrature(models.Lambertian(0.5), 0)
    surface = shading.Surface(np.ones(3), np.ones(3))
    with pytest.raises(ValueError, match="or be a Quadrature; got Lambertian. Make it ready by shading.prepare"):
        shading.shade(models.Lambertian(0.5), models.DistantLight(np.ones(1)), surface)
    with pytest.raises(ValueError, match="fitted above the horizon only, and a DistantLight shines"):
        shading.shade(shading.Quadrature(models.Lambertian(0.5)), models.DistantLight(np.ones(1)), surface)
