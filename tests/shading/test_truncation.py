"""What `Prefiltered.truncation` predicts, against the bands beyond the degree."""

import numpy as np
import pytest

from shisd import models, shading
from tests.bench.lobes import load_map
from tests.shading.test_prefiltered import directions

DEGREE = 255


def squares(slices, light):
    """Mean squares [colours, l] of radiance over all orientations and the views of a sphere's picture."""
    theta = (np.arange(slices.coefficients.shape[-2]) + 0.5) * np.pi / 2 / slices.coefficients.shape[-2]
    of_slices = np.einsum("v,...vl->...l", np.sin(2 * theta) / np.sum(np.sin(2 * theta)), slices.energies())
    e = np.asarray(light.coefficients, float) ** 2
    degree = slices.degree
    starts = np.arange(degree + 1) ** 2
    return of_slices * np.add.reduceat(e, starts, axis=-1) / (2 * np.arange(degree + 1) + 1)


@pytest.mark.parametrize("falls", [0.6, 0.9])
def test_exponential_falls_are_continued_exactly(falls, rng):
    """Light whose bands fall, on slices that do not."""
    degree, more = 15, 60
    l = np.repeat(np.arange(more + 1), 2 * np.arange(more + 1) + 1)
    c = np.zeros((8, (more + 1) ** 2), np.float32)
    c[:, np.arange(more + 1) * np.arange(1, more + 2)] = 1  # zonal
    slices = shading.Slices(c)
    light = models.DistantLight((rng.choice([-1, 1], len(l)) * falls**l).astype(np.float32))  # 2l+1 of them, over 2l+1
    bands = squares(slices, light)
    exact = np.sqrt(np.sum(bands[degree + 1 :]) / np.sum(bands))
    got = float(shading.prefilter(slices.cut(degree), light).truncation)
    np.testing.assert_allclose(got, exact, rtol=1e-3)
    flat = models.DistantLight(np.ones((degree + 1) ** 2, np.float32))
    assert float(shading.prefilter(slices.cut(degree), flat).truncation) == 1
    assert float(shading.prefilter(slices.cut(2), light).truncation) == 1
    assert float(shading.prefilter(slices, models.DistantLight(0 * light.coefficients)).truncation) == 0


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.02, 0.05, 0.1])
def test_truncation_is_as_predicted_on_photographs(alpha):
    """Within a factor of 2 from degree 64 on."""
    brdf = models.Ggx(np.float32(alpha), np.array([0.95, 0.64, 0.54], np.float32))
    slices = shading.tabulate_brdf(brdf, DEGREE, elevations=24, quadrature=288, throw=False)
    for name in ("interior", "studio"):
        sky = load_map(name)
        bands = squares(slices, sky.light(DEGREE))
        for degree in (64, 128):
            exact = np.sqrt(np.max(np.sum(bands[:, degree + 1 :], axis=1) / np.sum(bands, axis=1)))
            got = float(shading.prefilter(slices.cut(degree), sky, tolerance=0.1).truncation)
            assert exact / 2 < got < 2 * exact, f"{alpha} {name} {degree}: predicted {got:.1e}, exact {exact:.1e}"


@pytest.mark.slow
def test_truncation_is_that_of_pictures(rng):
    brdf = models.Ggx(np.float32(0.05), np.array([0.95, 0.64, 0.54], np.float32))
    slices = shading.tabulate_brdf(brdf, 160, elevations=24, throw=False)
    sky, surface = load_map("interior"), shading.Surface(*(x.astype(np.float32) for x in directions(rng, 20000)))
    fine, coarse = (shading.prefilter(slices.cut(d), sky, tolerance=3e-3) for d in (160, 64))
    truth = np.asarray(fine.radiance(surface))
    error = np.sqrt(np.mean((np.asarray(coarse.radiance(surface)) - truth) ** 2, axis=0) / np.mean(truth**2, axis=0))
    assert np.max(error) / 2 < float(coarse.truncation) < 2 * np.max(error)
