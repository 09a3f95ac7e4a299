"""Filtered maps against the integrals that they stand for, in values, predicted errors and derivatives."""

import functools

import equinox as eqx
import jax
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import models, shading
from tests.marks import FLOAT32_FIRST

DEGREE = 6


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def directions(rng, count):
    """Normals all around, and views as a sphere's picture has them, by the square of the sine of their elevation."""
    normals = unit(rng.normal(size=(count, 3)))
    side = unit(np.cross(normals, rng.normal(size=(count, 3))))
    sine = np.sqrt(rng.uniform(size=(count, 1)))
    return normals, sine * side + np.sqrt(1 - sine**2) * normals


def light(rng, dtype=np.float64):
    l = np.repeat(np.arange(DEGREE + 1), 2 * np.arange(DEGREE + 1) + 1)
    return models.DistantLight((rng.normal(size=(3, len(l))) / (1 + l)).astype(dtype))


MATERIALS = {
    "diffuse": lambda: models.Lambertian(0.7),
    "glossy": lambda: models.Ggx(0.4, np.array([0.9, 0.6, 0.3])),
    "rough": lambda: models.Ggx(0.8, np.array([0.9, 0.6, 0.3])),
}


@functools.cache
def slices_of(material, dtype):
    return shading.tabulate_brdf(MATERIALS[material](), DEGREE, elevations=32)


@FLOAT32_FIRST
@pytest.mark.parametrize("material", ["glossy", pytest.param("diffuse", marks=pytest.mark.slow)])
def test_error_is_as_predicted(material, dtype, rng):
    slices, sky = slices_of(material, dtype), light(rng, dtype)
    surface = shading.Surface(*(x.astype(dtype) for x in directions(rng, 4000)))
    truth = np.asarray(shading.shade(slices, sky, surface))
    for tolerance in (0.1, 0.01, 1e-6):
        filtered = shading.prefilter(slices, sky, tolerance=tolerance)
        got = filtered.radiance(surface)
        assert got.dtype == dtype and got.shape == (4000, 3)
        error = np.max(np.sqrt(np.mean((np.asarray(got) - truth) ** 2, axis=0) / np.mean(truth**2, axis=0)))
        predicted = float(filtered.error)
        assert predicted <= tolerance
        assert predicted / 2 - 5e-4 < error < 2 * predicted + 5e-4  # 5e-4: the splines, with all channels
    if material == "glossy":
        first, other = shading.prefilter(slices, sky), slices_of("rough", dtype)
        moved = models.DistantLight(2 * sky.coefficients[::-1])
        truth = np.asarray(shading.shade(other, moved, surface))
        filtered = jax.jit(lambda light: shading.prefilter(other, light, like=first))(moved)
        left = np.asarray(filtered.radiance(surface)) - truth
        error = np.max(np.sqrt(np.mean(left**2, axis=0) / np.mean(truth**2, axis=0)))
        assert error > 5 * float(first.error)  # its channels are for another material
        np.testing.assert_allclose(filtered.error, error, rtol=0.2)
    if material == "diffuse":  # view-independent and zonal about the normal
        assert int(shading.prefilter(slices, sky, tolerance=1e-4).channels) == 1 and not bool(filtered.mirror)


@pytest.mark.slow
def test_derivatives_where_frames_turn(x64, rng):
    filtered = shading.prefilter(slices_of("glossy", np.dtype("float64")), light(rng), tolerance=1e-2)
    axis = np.concatenate([np.eye(3), -np.eye(3), unit(rng.normal(size=(3, 3)))])
    tilted = unit(axis + 0.4 * unit(rng.normal(size=axis.shape)))
    for n, v in ((axis, tilted), (tilted, axis), (axis, axis), (unit(axis + tilted), tilted)):  # last: mirrored to axes
        check_grads(lambda n, v: filtered.radiance(shading.Surface(n, v)), (n, v), 1, ["fwd", "rev"], 1e-4, 1e-4, 1e-6)


@pytest.mark.slow
def test_tables_are_linear_in_light_and_material_under_jit(x64, rng):
    slices, sky = slices_of("glossy", np.dtype("float64")), light(rng)
    first, surface = shading.prefilter(slices, sky, tolerance=1e-3), shading.Surface(*directions(rng, 50))
    scaled = lambda x, factor: eqx.tree_at(lambda x: x.coefficients, x, x.coefficients * factor)

    @jax.jit
    def radiance(gain, scale):
        return shading.prefilter(scaled(slices, gain), scaled(sky, scale), like=first).radiance(surface)

    np.testing.assert_allclose(radiance(2.0, 3.0), 6 * first.radiance(surface), rtol=1e-9, atol=1e-9)
    slope = jax.jacrev(radiance, (0, 1))(1.0, 1.0)
    for got in slope:
        np.testing.assert_allclose(got, first.radiance(surface), rtol=1e-9, atol=1e-9)


def test_no_light_and_views_below(rng):
    slices = slices_of("glossy", np.dtype("float32"))
    n, v = (x.astype(np.float32) for x in directions(rng, 5))
    dark = shading.prefilter(slices, models.DistantLight(np.zeros((3, (DEGREE + 1) ** 2), np.float32)))
    assert np.all(np.asarray(dark.radiance(shading.Surface(n, v))) == 0) and float(dark.error) == 0
    lit = shading.prefilter(slices, light(rng, np.float32))
    assert np.all(np.asarray(lit.radiance(shading.Surface(n, -v))) == 0)
    assert np.all(np.isnan(lit.radiance(shading.Surface(np.zeros_like(n), v))))


def test_what_cannot_be_filtered_is_refused(rng, as_user):
    slices, sky = slices_of("glossy", np.dtype("float32")), light(rng, np.float32)
    e = np.asarray(sky.coefficients)
    for bad in (0.0, np.inf):
        with pytest.raises(ValueError, match="`tolerance` must be finite and > 0"):
            shading.prefilter(slices, sky, tolerance=bad)
    with pytest.raises(ValueError, match="`light` must be finite"):
        shading.prefilter(slices, models.DistantLight(e * np.float32(np.nan)))
    with pytest.raises(ValueError, match="`material` must be finite"):
        shading.prefilter(shading.Slices(slices.coefficients * np.nan), sky)
    with pytest.raises(ValueError, match="pass that as `like`"):
        jax.jit(lambda light: shading.prefilter(slices, light).maps)(sky)
    with pytest.raises(ValueError, match=r"`light` must be a models.DistantLight or Environment; got ndarray\."):
        shading.prefilter(slices, e)
    with pytest.raises(ValueError, match="`coefficients` must have"):
        shading.prefilter(slices, models.DistantLight(e[:, :5]))
    other = shading.prefilter(slices, models.DistantLight(e[:, :9]))
    for wrong in (other, slices):
        with pytest.raises(ValueError, match="`like` must come from shading.prefilter at degree 6"):
            shading.prefilter(slices, sky, like=wrong)
    with pytest.raises(ValueError, match="`material` is anisotropic.*; use shading.shade"):
        shading.prefilter(shading.Slices(np.zeros((8, 8, 49), np.float32), isotropic=False), sky)
    with pytest.raises(ValueError, match=r"`surface` must be a shading.Surface of normals and views; got ndarray\."):
        other.radiance(e)
    with pytest.raises(ValueError, match="do not broadcast"):
        other.radiance(shading.Surface(np.ones((4, 3), np.float32), np.ones((5, 3), np.float32)))
