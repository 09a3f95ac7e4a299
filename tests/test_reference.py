"""The reference estimators against closed values, against each other, and their error bars against the truth."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import models, reference
from tests import truth
from tests.marks import FLOAT32_FIRST

SUN_ROW, SUN_COLUMN, HEIGHT = 60, 37, 256


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def points(rng, count, dtype="float32"):
    """Normals and views above their horizon."""
    normals = unit(rng.normal(size=(count, 3)))
    views = unit(rng.normal(size=(count, 3)))
    views *= np.sign(np.sum(normals * views, axis=1, keepdims=True))
    return normals.astype(dtype), views.astype(dtype)


def colour(*values):
    return np.array(values, "float32")


def room(height=32, dtype="float32"):
    """A coloured sky with three small lamps, one of them across the seam of the map and one at the pole."""
    rng = np.random.default_rng(7)
    texels = rng.gamma(0.5, size=(height, 2 * height, 3))
    texels[10, 20] = texels[3, 0] = texels[3, -1] = texels[0, 5] = (400, 300, 200)
    return models.Environment(jnp.asarray(texels, dtype))


def sigmas(estimate, truth, doubt=0.0):
    """Signed distance from the truth, itself uncertain by `doubt`, in standard errors; 1e-6 of rounding is free."""
    error = np.asarray(estimate.value - truth)
    return error / np.sqrt(np.asarray(estimate.standard_error) ** 2 + doubt**2 + (1e-6 * np.max(np.abs(truth))) ** 2)


BRDFS = {
    "lambertian": lambda: models.Lambertian(colour(0.8, 0.5, 0.2)),
    "phong": lambda: models.Phong(specular=0.7, exponent=40.0, diffuse=0.1),
    "ggx": lambda: models.Ggx(0.25),
    "narrow": lambda: models.Ggx(0.1, f0=colour(1.0, 0.8, 0.3)),
    "plastic": lambda: models.CookTorrance(roughness=0.4, metallic=0.0, albedo=colour(0.7, 0.1, 0.1)),
}


@FLOAT32_FIRST
def test_white_furnace_gives_albedo_times_radiance(dtype, rng):
    normals, views = points(rng, 50, dtype)
    albedo, radiance = np.array([0.8, 0.5, 0.2], dtype), 2.5
    brdf = models.Lambertian(albedo)
    environment = models.Environment(jnp.full((16, 32), radiance, dtype))
    estimate = reference.shade_environment(brdf, environment, normals, views, key=jax.random.key(1), samples=1024)
    truth = np.broadcast_to(albedo * radiance, (50, 3))
    assert estimate.value.shape == estimate.standard_error.shape == (50, 3)
    assert estimate.value.dtype == dtype
    assert np.max(np.abs(sigmas(estimate, truth))) < 5
    assert np.max(estimate.standard_error / truth) < 0.01
    exact = reference.shade_environment_quadrature(brdf, environment, normals[:5], views[:5], supersampling=16)
    assert exact.dtype == dtype
    np.testing.assert_allclose(exact, truth[:5], rtol=1e-3)  # the middle rule meets the kink at the horizon


@pytest.mark.parametrize(
    "name", ["phong", *(pytest.param(name, marks=pytest.mark.slow) for name in BRDFS if name != "phong")]
)
def test_the_two_estimators_agree(name, rng):
    normals, views = points(rng, 48)
    brdf, environment = BRDFS[name](), room()
    estimate = reference.shade_environment(brdf, environment, normals, views, key=jax.random.key(2), samples=4096)
    truth = reference.shade_environment_quadrature(brdf, environment, normals, views, supersampling=12)
    coarse = reference.shade_environment_quadrature(brdf, environment, normals, views, supersampling=6)
    doubt = np.abs(truth - coarse)
    assert np.sqrt(np.mean(doubt**2)) < 2e-3 * np.sqrt(np.mean(truth**2))
    z = sigmas(estimate, truth, doubt)
    assert np.max(np.abs(z)) < 5
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.3  # the error bars mean what they say


class Even(models.AbstractBrdf):
    """As much from everywhere above the horizon: value_cosine = 1."""

    isotropic = True
    lobe_width = 1.0

    def value(self, wi, wo):
        return jnp.where(wi[2] > 0, 1 / jnp.where(wi[2] > 0, wi[2], 1), 0)


def test_power_of_single_texels():
    """Radiance times solid angle, for a material that weighs no direction and texels above the horizon: to rounding."""
    height, places = 8, [(0, 3), (1, 0), (2, 15)]
    texels = np.zeros((height, 2 * height, 3), np.float32)
    for colour, place in enumerate(places):
        texels[(*place, colour)] = 1e4
    up = np.array([[0, 0, 1], [0.02, -0.01, 1]], np.float32)
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    exact = 1e4 * np.pi / height * np.tile((edges[:-1] - edges[1:])[[j for j, _ in places]], (2, 1))
    environment = models.Environment(texels)
    got = reference.shade_environment_quadrature(Even(), environment, up, up, supersampling=2)
    np.testing.assert_allclose(got, exact, rtol=5e-7)
    estimate = reference.shade_environment(Even(), environment, up, up, key=jax.random.key(8), samples=4096)
    assert np.max(np.abs(sigmas(estimate, exact))) < 4
    assert np.max(estimate.standard_error / exact) < 0.05


@pytest.mark.slow
def test_a_lobe_under_a_small_sun_by_hand():
    """One bright texel of radiance L: the result is L f cos(theta) times the texel's solid angle, up to the lobe's
    curvature over one texel, about 1e-3 here."""
    radiance, exponent = 1e4, 20.0
    texels = np.zeros((HEIGHT, 2 * HEIGHT), np.float32)
    texels[SUN_ROW, SUN_COLUMN] = radiance
    theta = math.pi * (SUN_ROW + 0.5) / HEIGHT
    phi = math.pi * (SUN_COLUMN + 0.5) / HEIGHT
    sun = np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])
    solid_angle = math.pi / HEIGHT * (math.cos(math.pi * SUN_ROW / HEIGHT) - math.cos(math.pi * (SUN_ROW + 1) / HEIGHT))

    normal = unit(np.array([0.3, 0.2, 0.9]))
    view = unit(np.array([-0.5, 0.1, 0.8]))
    mirrored = 2 * np.dot(normal, view) * normal - view
    lobe = (exponent + 2) / (2 * math.pi) * np.dot(mirrored, sun) ** exponent
    by_hand = radiance * solid_angle * lobe * np.dot(normal, sun)

    brdf, environment = models.Phong(specular=1.0, exponent=exponent), models.Environment(jnp.asarray(texels))
    where = normal[None].astype("f4"), view[None].astype("f4")
    estimate = reference.shade_environment(brdf, environment, *where, key=jax.random.key(3), samples=8192)
    quadrature = reference.shade_environment_quadrature(brdf, environment, *where, supersampling=3)
    assert abs(float(quadrature[0]) - by_hand) < 2e-3 * by_hand
    assert abs(float(estimate.value[0]) - by_hand) < 5 * float(estimate.standard_error[0]) + 2e-3 * by_hand
    assert float(estimate.standard_error[0]) < 0.02 * by_hand


def test_error_bars_shrink_with_samples_and_points_are_independent(rng):
    normals, views = points(rng, 1)
    normals, views = np.repeat(normals, 400, axis=0), np.repeat(views, 400, axis=0)
    bars = []
    for samples in (128, 2048):
        estimate = reference.shade_environment(
            models.Ggx(0.3), room(), normals, views, key=jax.random.key(4), samples=samples
        )
        spread = np.std(estimate.value, axis=0)
        bars.append(np.sqrt(np.mean(estimate.standard_error**2, axis=0)))
        np.testing.assert_allclose(bars[-1], spread, rtol=0.15)  # the bar is the spread of independent estimates
    assert np.all(bars[1] < bars[0] / 4)  # at least as fast as plain Monte Carlo


def test_dark_cases_are_zero(rng):
    normals, views = points(rng, 8)
    brdf = models.Ggx(0.3)
    black = models.Environment(jnp.zeros((8, 16, 3)))
    for environment, view in ((black, views), (room(), -views)):
        estimate = reference.shade_environment(brdf, environment, normals, view, key=jax.random.key(5), samples=64)
        quadrature = reference.shade_environment_quadrature(brdf, environment, normals, view, supersampling=1)
        for value in (estimate.value, estimate.standard_error, quadrature):
            np.testing.assert_array_equal(value, np.zeros((8, 3)))


def test_tangents_turn_an_anisotropic_lobe(rng):
    brdf, environment = models.Ggx(np.float32([0.1, 0.5])), room()
    normals, views = points(rng, 6)
    along = np.asarray(jax.random.normal(jax.random.key(0), (6, 3)))
    across = np.cross(normals, along)
    results = []
    for tangents in (along, across):
        estimate = reference.shade_environment(
            brdf, environment, normals, views, key=jax.random.key(6), samples=4096, tangents=tangents
        )
        truth = reference.shade_environment_quadrature(
            brdf, environment, normals, views, supersampling=8, tangents=tangents
        )
        assert np.max(np.abs(sigmas(estimate, truth))) < 5
        results.append(truth)
    assert np.max(np.abs(results[0] - results[1])) > 0.1 * np.max(results[0])
    turned = reference.shade_environment_quadrature(
        models.Ggx(np.float32([0.5, 0.1])), environment, normals, views, supersampling=8, tangents=along
    )
    np.testing.assert_allclose(turned, results[1], rtol=2e-4, atol=1e-4)


def test_what_cannot_be_shaded_is_refused(as_user):
    brdf, environment = models.Lambertian(0.5), room()
    normals = np.ones((4, 3), np.float32)
    for shade, options in (
        (reference.shade_environment, {"key": jax.random.key(0)}),
        (reference.shade_environment_quadrature, {}),
    ):
        with pytest.raises(ValueError, match=r"`normals` and `views` must both have shape \[N, 3\]"):
            shade(brdf, environment, normals, normals[0], **options)
        with pytest.raises(ValueError, match="`tangents` must have the shape of `normals`"):
            shade(brdf, environment, normals, normals, tangents=normals[:2], **options)
        with pytest.raises(ValueError, match="this BRDF is anisotropic"):
            shade(models.Ggx(np.float32([0.1, 0.2])), environment, normals, normals, **options)
    with pytest.raises(ValueError, match="`samples`"):
        reference.shade_environment(brdf, environment, normals, normals, key=jax.random.key(0), samples=0)
    with pytest.raises(ValueError, match="`supersampling`"):
        reference.shade_environment_quadrature(brdf, environment, normals, normals, supersampling=0)


BRDF = models.Ggx(0.5, 0.04)
STAR = np.array([[0.9, 0.3, 0.5, 0.2, 0.8, 0.3]] * 3).T * np.stack(
    [np.sin(np.arange(6) * np.pi / 3), np.cos(np.arange(6) * np.pi / 3), np.zeros(6)], axis=1
) + [0.1, 0.0, 1.0]  # turns inwards twice; emits downwards


def polygon_scene(rng, count):
    position, normal = rng.uniform(-0.8, 0.8, (count, 3)) * [1, 1, 0.3], rng.normal(size=(count, 3)) + [0, 0, 1]
    return position, normal, normal + 0.5 * rng.normal(size=(count, 3))


def test_polygons_by_area_and_by_quadrature(x64, rng):
    """Both agree, and for a constant integrand over the hemisphere with an independent rule on the sphere."""
    position, normal, view = polygon_scene(rng, 24)
    radiance = lambda w: jnp.stack([jnp.ones(w.shape[0]), 1 + w[:, 0]], axis=-1)
    shade = lambda nodes: np.asarray(
        reference.shade_polygon_quadrature(BRDF, STAR, radiance, position, normal, view, nodes=nodes)
    )
    exact = shade(48)
    np.testing.assert_allclose(shade(40), exact, atol=1e-12 * exact.max())
    estimate = reference.shade_polygon(
        BRDF, STAR, radiance, position, normal, view, key=jax.random.key(3), samples=2048
    )
    off = (np.asarray(estimate.value) - exact) / np.maximum(np.asarray(estimate.standard_error), 1e-12)
    lit = exact[:, 0] > 0
    assert np.max(np.abs(off[lit])) < 5 and 0.7 < np.sqrt(np.mean(off[lit] ** 2)) < 1.4
    for p, n, got in zip(position, normal, reference.shade_polygon_quadrature(
        models.Lambertian(np.pi), STAR, 1.0, position, normal, normal, nodes=48
    ), strict=True):  # fmt: skip
        w, area = truth.triangle_rule((STAR - p) / np.linalg.norm(STAR - p, axis=1, keepdims=True), 60)
        cosine = w.astype(float) @ (n / np.linalg.norm(n))
        if cosine.min() > 0:
            np.testing.assert_allclose(got, -float(area.astype(float) @ cosine), rtol=1e-10)


def test_polygons_seen_from_behind_are_dark(rng):
    position, normal, view = (x.astype(np.float32) for x in polygon_scene(rng, 4))
    star = STAR[::-1].astype(np.float32).copy()
    for shade in (
        lambda **options: reference.shade_polygon_quadrature(BRDF, star, 1.0, position, normal, view, **options),
        lambda **options: (
            reference.shade_polygon(
                BRDF, star, 1.0, position, normal, view, key=jax.random.key(0), samples=32, **options
            ).value
        ),
    ):
        np.testing.assert_array_equal(shade(), 0)
        assert np.any(np.asarray(shade(two_sided=True)) > 0)


def test_rays_that_are_stopped_bring_nothing(rng):
    normals = np.tile(np.array([0, 0, 1], "float32"), (3, 1))
    positions = np.array([[0, 0, 0], [5, 0, 0], [9, 0, 0]], "float32")
    visible = lambda p, w: (p[:, 0] < 1) | ((p[:, 0] < 6) & (w[:, 0] > 0))  # all, half of them, none
    sky = models.Environment(jnp.full((8, 16, 3), 2.0))
    where = {"positions": positions, "visible": visible, "key": jax.random.key(3), "samples": 2048}
    got = reference.shade_environment(models.Lambertian(0.5), sky, normals, normals, **where)
    np.testing.assert_allclose(got.value[:, 0], [1.0, 0.5, 0.0], atol=0.01)
    assert np.all(np.abs(got.value[1] - 0.5) < 4 * got.standard_error[1]) and np.all(got.standard_error[2] == 0)
    with pytest.raises(ValueError, match="`positions` and `visible` belong together"):
        reference.shade_environment(models.Lambertian(0.5), sky, normals, normals, key=where["key"], visible=visible)
