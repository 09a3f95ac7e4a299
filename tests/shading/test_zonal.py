"""Zonal light against the same light as coefficients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import decomposition, harmonics, models, shading
from tests.hard_cases import unit
from tests.marks import FLOAT32_FIRST
from tests.shading.slices import random_slices

DEGREE = 5
MATERIALS = {  # of the precision of the moment
    "glossy": lambda: models.Ggx(0.4, 0.3),
    "brushed": lambda: models.Ggx(np.array([0.3, 0.6]), np.array([0.9, 0.6, 0.3])),
}


def tabulate(material):
    return shading.tabulate_brdf(MATERIALS[material](), DEGREE, elevations=16, azimuths=16)


def shade(slices, light, normals, views, tangents=None):
    return shading.shade(slices, light, shading.Surface(normals, views, tangents=tangents))


def scene(rng, count, dtype):
    normals, views, tangents = unit(rng.normal(size=(3, count, 3)))
    views *= np.where(np.sum(views * normals, axis=1) < 0, -1, 1)[:, None]
    axis, z = 2 * unit(rng.normal(size=3)), rng.normal(size=(3, DEGREE + 1))
    return tuple(a.astype(dtype) for a in (axis, z, normals, views, tangents))


@FLOAT32_FIRST
@pytest.mark.parametrize("material", ["smooth", *(pytest.param(m, marks=pytest.mark.slow) for m in MATERIALS)])
def test_it_is_the_light_of_these_coefficients(material, dtype, rng):
    slices = random_slices(DEGREE, dtype) if material == "smooth" else tabulate(material)
    axis, z, *where = scene(rng, 200, dtype)
    where[1][0], where[0][1] = where[0][0], axis  # a view along the normal, a normal along the axis
    e = harmonics.convolve(harmonics.sh_basis(axis, DEGREE)[None], z)
    expected = shade(slices, models.DistantLight(e), *where)
    got = shade(slices, models.ZonalLight(axis, z), *where)
    assert got.dtype == dtype and got.shape == (200, 3)
    bound = 3e-6 if dtype == np.float32 else 1e-13
    np.testing.assert_allclose(got, expected, atol=bound * np.max(np.abs(expected)))
    low = shade(slices, models.ZonalLight(axis, z[0, :3]), *where)
    of_low = shade(slices, models.DistantLight(e[0, :9]), *where)
    np.testing.assert_allclose(low, of_low, atol=bound * np.max(np.abs(expected)))
    distant = models.ZonalLight(axis, z).distant()
    np.testing.assert_allclose(distant.coefficients, e, atol=bound * np.max(np.abs(e)))


@FLOAT32_FIRST
def test_several_lights_add_up(dtype, rng):
    slices = random_slices(DEGREE, dtype)
    axis, z, normals, views, _ = scene(rng, 20, dtype)
    lights = [models.ZonalLight(axis, z), models.ZonalLight(-axis[::-1], z[::-1])]
    got = shade(slices, lights, normals, views)
    expected = sum(np.asarray(shade(slices, light, normals, views)) for light in lights)
    np.testing.assert_allclose(got, expected, atol=(3e-6 if dtype == np.float32 else 1e-13) * np.max(np.abs(expected)))


def test_eq_24(x64, rng):
    slices = random_slices(DEGREE, np.float64)
    basis = decomposition.RotatedZonalBasis(decomposition.optimized_directions(DEGREE), DEGREE)
    axis, z, normals, views, _ = scene(rng, 6, np.float64)
    got = shade(slices, models.ZonalLight(axis, z[0]), normals, views)
    # the sum over rotated axes as it stands: view in the x-z plane of each frame, z_l times Legendre series
    for normal, view, value in zip(normals, views, got, strict=True):
        x = unit(view - (view @ normal) * normal)
        world = basis.directions @ np.stack([x, np.cross(normal, x), normal])
        p = np.polynomial.legendre.legvander(np.asarray(world) @ unit(axis), DEGREE)  # y_l^0 pi_l = P_l
        weights = basis.weights(slices.at(jnp.array([np.sqrt(1 - (view @ normal) ** 2), 0, view @ normal])))
        np.testing.assert_allclose(value, np.sum(np.asarray(weights) * z[0][:, None] * p.T), rtol=1e-9)


@pytest.mark.slow
def test_derivatives(x64, rng):
    slices = tabulate("glossy")
    arguments = tuple(jnp.asarray(a) for a in scene(rng, 3, np.float64)[:4])
    radiance = jax.jit(lambda axis, z, *a: shade(slices, models.ZonalLight(axis, z), *a))
    check_grads(radiance, arguments, order=1, atol=1e-5, rtol=1e-5, eps=1e-5)


def test_errors_name_the_argument(as_user, rng):
    axis, z, normals, views, _ = scene(rng, 2, np.float32)
    message = r"`axis` must have shape \[3\]; got \[2, 3\]\. Pass a list of lights for several\."
    with pytest.raises(ValueError, match=message):
        models.ZonalLight(np.stack([axis, axis]), z)
    for wrong in (z[None], z[0, 0], z[:, :0]):
        message = r"`coefficients` must have shape \[L\+1\] or \[colour, L\+1\]; got \[.*\]\."
        with pytest.raises(ValueError, match=message):
            models.ZonalLight(axis, wrong)
    with pytest.raises(
        ValueError, match="`material` must come from shading.prepare, tabulate_brdf, transform_brdf or project_brdf"
    ):
        shade(1, models.ZonalLight(axis, z), normals, views)
