"""Fits, filters and clean tables, against dense algebra, Bessel functions and materials that are known."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.special import ive

from shisd import Status, filtering, io, models
from shisd.io.internal import merl_above_horizon
from tests.marks import FLOAT32_FIRST
from tests.models.materials import GOLD_PAINT, albedos, array, evaluate, hemisphere, pairs, spherical, spoiled
from tests.truth import scipy_basis

OK, UNCOVERED, STEP_LIMIT = (
    Status.ok, Status.uncovered, Status.step_limit,
)  # fmt: skip
N = 1500
ELEVATIONS = (0.0, 0.5, 1.0, 1.3)


def cosine_spread(rng, count):
    """Directions with density cos / pi."""
    u = rng.random(count)
    return spherical(np.arcsin(np.sqrt(u)), 2 * np.pi * rng.random(count))


@FLOAT32_FIRST
@pytest.mark.parametrize("isotropic", [True, False])
def test_a_band_limited_brdf_is_found_again(isotropic, rng, dtype):
    shape = (3, 4, 4, 4) if isotropic else (3, 9, 9)
    truth = models.ProjectedBrdf(array(0.2 * rng.normal(size=shape), dtype), isotropic=isotropic)
    constant = (0,) * (len(shape) - 1)
    c = truth.coefficients.at[(slice(None), *constant)].add(12.0)  # positive
    truth = models.ProjectedBrdf(c, isotropic=isotropic)
    wi, wo = (array(cosine_spread(rng, N), dtype) for _ in range(2))
    y = evaluate(truth, wi, wo)
    assert np.min(y) > 0
    found = filtering.fit_brdf(wi, wo, y, truth.degree, isotropic=isotropic, ridge=1e-9)
    assert found.status == OK and found.brdf.coefficients.dtype == dtype and int(found.missing) == 0
    got, y = np.asarray(evaluate(found.brdf, wi, wo)), np.asarray(y)
    error = np.sqrt(np.mean((got - y) ** 2) / np.mean(y**2))
    assert error < (0.01 if dtype == np.float32 else 1e-4), error


def test_it_is_the_dense_regularised_least_squares_solution(rng, x64):
    """All entries of C as unknowns, Gram matrix and penalty written out."""
    degree, ridge = 2, 1e-3
    wi, wo, w = cosine_spread(rng, 300), cosine_spread(rng, 300), rng.random(300)
    y = rng.random(300)
    a = np.einsum("ni,nj->nij", scipy_basis(wi, degree), scipy_basis(wo, degree))
    a = ((a + a.transpose(0, 2, 1)) / 2).reshape(300, -1)
    l = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    laplacian = ((l * (l + 1))[:, None] + (l * (l + 1))[None]).ravel() ** 2 / (4 * np.pi) ** 2
    gram = (a.T * w) @ a / w.sum() + ridge * np.diag(laplacian)
    expected = np.linalg.lstsq(gram, a.T @ (w * y) / w.sum(), rcond=None)[0].reshape(9, 9)
    found = filtering.fit_brdf(wi, wo, y, degree, isotropic=False, ridge=ridge, weights=w)
    np.testing.assert_allclose(found.brdf.coefficients, expected, atol=1e-7)
    residual = y - a @ expected.ravel()
    np.testing.assert_allclose(found.error, np.sqrt(w @ residual**2 / (w @ y**2)), rtol=1e-6)


@pytest.mark.slow
def test_missing_values_count_for_nothing(rng):
    wi, wo = (array(cosine_spread(rng, N), np.float32) for _ in range(2))
    y = array(rng.random((N, 3)), np.float32)
    bad = y.at[:200].set(np.nan).at[200:300, 1].set(-1.0).at[300:310].set(np.inf)
    wi_bad = wi.at[310:320, 2].multiply(-1).at[320].set(0.0)
    fit = lambda wi, wo, y, w: filtering.fit_brdf(wi, wo, y, 3, isotropic=True, weights=w)
    ones = jnp.ones(N, np.float32)
    found = fit(wi_bad, wo, bad, ones)
    assert int(found.missing) == 3 * (200 + 10 + 11) + 100
    without = fit(wi, wo, y, ones.at[:200].set(0).at[300:321].set(0))
    got, expected = (np.asarray(evaluate(f.brdf, wi, wo))[:, ::2] for f in (found, without))
    np.testing.assert_allclose(got, expected, atol=2e-3)
    with pytest.raises(Exception, match="without any valid value"):
        jax.block_until_ready(fit(wi, wo, y.at[:, 2].set(-1.0), ones))


@pytest.mark.slow
def test_partial_coverage_is_told(rng):
    wi, wo = (array(cosine_spread(rng, N), np.float32) for _ in range(2))
    y = jnp.ones((N, 3), np.float32)
    cut = jnp.where(((wi[:, 2] > 0.8) & (wo[:, 2] > 0.8))[:, None], y, -1)
    found, partial = (filtering.fit_brdf(wi, wo, y, 3, isotropic=True, throw=False) for y in (y, cut))
    assert found.status == OK and float(found.coverage) > 0.95
    assert partial.status == UNCOVERED and float(partial.coverage) < 0.7
    across = evaluate(partial.brdf, *(array(hemisphere(rng, N), np.float32) for _ in range(2)))
    np.testing.assert_allclose(across, 1, atol=0.02)  # the flattest continuation


@pytest.mark.slow
def test_too_few_steps_are_told(rng):
    wi, wo = (array(cosine_spread(rng, N), np.float32) for _ in range(2))
    bumpy = evaluate(models.Ggx(0.3), wi, wo)
    assert filtering.fit_brdf(wi, wo, bumpy, 4, isotropic=True, max_steps=1, throw=False).status == STEP_LIMIT
    with pytest.raises(ValueError, match="Raise `max_steps`"):
        filtering.fit_brdf(wi, wo, bumpy, 4, isotropic=True, max_steps=1)


@pytest.mark.slow
def test_the_fit_is_differentiable(rng, x64):
    wi, wo = cosine_spread(rng, 100), cosine_spread(rng, 100)
    w = rng.normal(size=(9, 9))

    @jax.jit
    def f(y, weights, ridge):
        brdf = filtering.fit_brdf(wi, wo, y, 2, isotropic=False, ridge=ridge, weights=weights).brdf
        return jnp.sum(brdf.coefficients * w)

    arguments = jnp.asarray(1 + rng.random(100)), jnp.asarray(1 + rng.random(100)), jnp.asarray(1e-2)
    check_grads(f, arguments, 1, modes=["rev"], rtol=1e-4, eps=1e-5)


def test_factors_are_ratios_of_bessel_functions(dtype):
    """k_l / pi_l = i_l(kappa) / i_0(kappa), modified spherical Bessel functions from SciPy."""
    degree, kappas = 30, np.array([0.0, 1e-3, 0.7, 20.0, 600.0, 1e5])
    one = models.ProjectedBrdf(jnp.ones((degree + 1,) * 3, dtype), isotropic=True)
    got = jax.jit(jax.vmap(lambda kappa: filtering.smooth_brdf(one, kappa).coefficients))(array(kappas, dtype))
    l, k = np.arange(degree + 1), kappas[1:, None]
    factors = np.concatenate([[l == 0], ive(l + 0.5, k) / ive(0.5, k)])
    expected = np.broadcast_to((factors[:, :, None] * factors[:, None])[:, None], got.shape)
    assert got.dtype == dtype and np.all(got[:, :, 0, 0] == 1)
    np.testing.assert_allclose(got, expected, atol=1e-5 if dtype == np.float32 else 1e-12)


@pytest.mark.slow
def test_the_filter_is_the_mean_over_the_kernel(rng, x64):
    """ISD15's convolution by quadrature over both spheres, and the integral over them, which stays."""
    n, kappa = 9, 7.0
    brdf = models.ProjectedBrdf(rng.normal(size=(n, n)), isotropic=False)
    smooth = filtering.smooth_brdf(brdf, kappa)
    x, gauss = np.polynomial.legendre.leggauss(40)
    phi = 2 * np.pi * np.arange(20) / 20
    w = spherical(np.arccos(x)[:, None], phi).reshape(-1, 3)
    weight = np.repeat(gauss, 20) * 2 * np.pi / 20
    wi, wo = spherical(0.4, 1.0), spherical(0.9, -2.0)
    kernel = lambda axis: weight * kappa / (4 * np.pi * np.sinh(kappa)) * np.exp(kappa * (w @ axis))
    y = scipy_basis(w, 2)
    expected = (kernel(wi) @ y) @ np.asarray(brdf.full_coefficients()) @ (kernel(wo) @ y)
    np.testing.assert_allclose(smooth.value(wi, wo), expected, rtol=1e-9)
    assert smooth.coefficients[0, 0] == brdf.coefficients[0, 0]  # integral / (4 pi)
    np.testing.assert_allclose(filtering.smooth_brdf(brdf, 0.0).coefficients.ravel()[1:], 0, atol=1e-15)
    np.testing.assert_allclose(filtering.smooth_brdf(brdf, np.inf).coefficients, brdf.coefficients, rtol=1e-6)
    f = jax.jit(lambda kappa: filtering.smooth_brdf(brdf, kappa).value(wi, wo))
    for k in (1e-3, 2.0, 1e3):
        check_grads(f, (jnp.asarray(k),), 1, rtol=1e-4, atol=1e-6, eps=1e-5)
    slope = jax.grad(f)(0.0)  # the limit from nearby
    np.testing.assert_allclose(slope, jax.grad(f)(1e-6), rtol=1e-5)


@pytest.mark.slow
def test_scattered_anisotropic_samples_lose_two_thirds_of_their_noise(rng):
    truth = models.Ggx([0.5, 0.9], 0.9)
    wi, wo, ti, to = (array(cosine_spread(rng, 10000), np.float32) for _ in range(4))
    exact, y = np.asarray(evaluate(truth, ti, to)), np.asarray(evaluate(truth, wi, wo))
    noisy = y * np.exp(0.35 * rng.standard_normal(10000)).astype(np.float32)
    noisy[rng.random(10000) < 0.2] = np.nan
    found = filtering.fit_brdf(wi, wo, noisy, 5, isotropic=False, ridge=3e-4)
    assert found.status == OK
    rms = lambda x: np.sqrt(np.nanmean(x**2))
    error = rms(np.asarray(evaluate(found.brdf, ti, to)) - exact)
    assert 3 * error < rms(noisy - y), (error, rms(noisy - y))
    with jax.enable_x64(True):
        brdf = jax.tree.map(lambda a: a.astype(jnp.float64), found.brdf)
        wi, wo = cosine_spread(rng, 300), cosine_spread(rng, 300)
        np.testing.assert_allclose(evaluate(brdf, wi, wo), evaluate(brdf, wo, wi), atol=1e-12)


def test_errors_say_what_to_pass(as_user):
    w, y = np.ones((5, 3), np.float32), np.ones(5, np.float32)
    for arguments, options, message in (
        ((w[0], w[0], y, 2), {}, r"`wi` and `wo` must have one shape \[N, 3\]; got \[3\]"),
        ((w, w[:4], y, 2), {}, r"`wi` and `wo` must have one shape"),
        ((w, w, y[:4], 2), {}, r"`values` must have shape \[N\] or \[N, 3\] with N = 5; got \[4\]"),
        ((w, w, y, -1), {}, "`degree` must be >= 0"),
        ((w, w, y, 2), {"weights": y[:3]}, r"`weights` must have shape \[N\] = \[5\]"),
        ((w, w, y, 2), {"ridge": y}, "`ridge` must be a scalar"),
        ((w, w, y, 2), {"max_steps": 0}, "`max_steps` must be >= 1"),
    ):
        with pytest.raises(ValueError, match=message):
            filtering.fit_brdf(*arguments, isotropic=True, **options)
    with pytest.raises(ValueError, match="`isotropic` must be True or False; got None"):
        filtering.fit_brdf(w, w, y, 2, isotropic=None)
    brdf = models.ProjectedBrdf(np.ones((4, 4), np.float32), isotropic=False)
    with pytest.raises(ValueError, match="`brdf` must be a models.ProjectedBrdf; got Lambertian"):
        filtering.smooth_brdf(models.Lambertian(0.5), 2.0)
    with pytest.raises(ValueError, match="`kappa` must be a scalar"):
        filtering.smooth_brdf(brdf, np.ones(2))
    for kappa in (-1.0, np.nan):
        with pytest.raises(Exception, match="`kappa` must be >= 0"):
            jax.block_until_ready(filtering.smooth_brdf(brdf, kappa))
    with pytest.raises(ValueError, match=r"table \[90, 90, 180, 3\]; got shape \[3\]"):
        filtering.denoise_merl(np.ones(3))
    with pytest.raises(ValueError, match="`smoothness` must be finite and > 0; got 0.0"):
        filtering.denoise_merl(np.ones((90, 90, 180, 3)), smoothness=0)
    with pytest.raises(ValueError, match="`source` has a colour without a positive value"):
        filtering.denoise_merl(np.full((90, 90, 180, 3), -1.0), smoothness=1)


def check_denoised(brdf, path, rng, smoothness):
    """Three times less RMS error than the noise, albedo to 1 %, reciprocity to 1e-12."""
    io.write_merl(path, brdf)
    clean, above = io.read_merl(path), merl_above_horizon()
    io.write_merl(path, spoiled(clean, rng), overwrite=True)
    noisy = io.read_merl(path)
    seen = above & np.all(noisy >= 0, axis=-1)
    result = filtering.denoise_merl(path, smoothness=smoothness)
    assert result.missing == np.sum((noisy < 0) & above[..., None]) and result.extrapolated < 300
    rms = lambda error: np.sqrt(np.mean(error**2))
    error, noise = rms((np.asarray(result.brdf.table) - clean)[above]), rms((noisy - clean)[seen])
    assert 3 * error < noise, (error, noise)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        io.write_merl(path, clean, overwrite=True)
        before, after = (albedos(m, ELEVATIONS, (90, 120)) for m in (models.MeasuredBrdf.from_merl(path), result.brdf))
    np.testing.assert_allclose(after, before, rtol=0.01)
    np.testing.assert_allclose(after.mean(axis=0), before.mean(axis=0), rtol=0.01)
    with jax.enable_x64(True):
        wi, wo = pairs(rng, 400, 1e-3)
        double = models.MeasuredBrdf(result.brdf.table.astype(jnp.float64))
        there, back = np.asarray(evaluate(double, wi, wo)), np.asarray(evaluate(double, wo, wi))
        assert np.max(np.abs(there - back)) <= 1e-12 * np.max(there)


@pytest.mark.slow
def test_a_noisy_table_with_holes_becomes_clean(tmp_path, rng):
    check_denoised(models.Ggx(0.3, [0.9, 0.5, 0.2]), tmp_path / "ggx.binary", rng, 10.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gold_paint", "shiny"])
def test_many_materials_become_clean(name, tmp_path, rng):
    brdf = {
        "gold_paint": models.SgdMicrofacet(**GOLD_PAINT),
        "shiny": models.Ggx(0.1, [0.9, 0.5, 0.2]),
    }[name]
    check_denoised(brdf, tmp_path / "material.binary", rng, None)


def test_a_large_gap_is_told_and_filled_within_the_range_of_the_data():
    table = np.ones((90, 90, 180, 3))
    table[:40] = -1
    table[60:70, :, :, 1] = np.nan
    with pytest.warns(UserWarning, match="have no valid bin; they are extrapolated"):
        told = []
        result = filtering.denoise_merl(table, smoothness=10.0, mirrored=True, progress=lambda *now: told.append(now))
    assert told == [(1, 3), (2, 3), (3, 3)]
    np.testing.assert_allclose(result.brdf.table, 1, atol=1e-3)
    assert np.isnan(result.noise)
