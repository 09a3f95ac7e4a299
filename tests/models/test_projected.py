"""Expansions in both directions, against harmonics of SciPy summed one by one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import models, shading
from tests.models.materials import array, evaluate, hemisphere, spherical
from tests.truth import scipy_basis

DEGREE = 3


def anisotropic(rng, colour=()):
    n = (DEGREE + 1) ** 2
    return rng.normal(size=(*colour, n, n)) / n


def isotropic(rng, colour=()):
    return rng.normal(size=(*colour, DEGREE + 1, DEGREE + 1, DEGREE + 1)) / DEGREE**2


FORMS = {True: isotropic, False: anisotropic}


@pytest.mark.parametrize("form", FORMS)
def test_value_is_the_sum_over_pairs_of_harmonics(form, rng, dtype):
    c = FORMS[form](rng, (3,))
    wi, wo = hemisphere(rng, 50), hemisphere(rng, 50)
    y_i, y_o = scipy_basis(wi, DEGREE), scipy_basis(wo, DEGREE)
    if form:  # one term for every m, l, l', with cos(m (phi_i - phi_o)) from products of sines and cosines
        expected = np.zeros((50, 3))
        for m in range(DEGREE + 1):
            for l in range(m, DEGREE + 1):
                for k in range(m, DEGREE + 1):
                    both = sum(y_i[:, l * l + l + s] * y_o[:, k * k + k + s] for s in {m, -m})
                    expected += both[:, None] * (c[:, m, l, k] + c[:, m, k, l]) / 2
    else:
        expected = np.einsum("ni,cij,nj->nc", y_i, (c + np.swapaxes(c, 1, 2)) / 2, y_o)
    brdf = models.ProjectedBrdf(array(c, dtype), isotropic=form)
    got = evaluate(brdf, array(wi, dtype), array(wo, dtype))
    assert got.dtype == dtype and brdf.degree == DEGREE
    np.testing.assert_allclose(got, expected, atol=3e-6 if dtype == np.float32 else 1e-13)
    full = models.ProjectedBrdf(brdf.full_coefficients(), isotropic=False)
    np.testing.assert_allclose(evaluate(full, array(wi, dtype), array(wo, dtype)), got, atol=3e-6)


@pytest.mark.parametrize("form", FORMS)
def test_it_is_zero_below_the_horizon_and_turns_where_it_says_so(form, rng, x64):
    brdf = models.ProjectedBrdf(FORMS[form](rng), isotropic=form)
    wi, wo = hemisphere(rng, 50), hemisphere(rng, 50)
    there = np.asarray(evaluate(brdf, wi, wo))
    np.testing.assert_array_equal(evaluate(brdf, wi * [1, 1, -1], wo), 0)
    np.testing.assert_array_equal(evaluate(brdf, wi, wo * [1, 1, -1]), 0)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    assert np.allclose(evaluate(brdf, wi @ turn, wo @ turn), there, atol=1e-13) == brdf.isotropic == form
    assert np.allclose(evaluate(brdf, wi * [1, -1, 1], wo * [1, -1, 1]), there, atol=1e-13) == form


def test_clamped_values_are_the_positive_part(rng):
    c = isotropic(rng)
    wi, wo = (array(hemisphere(rng, 50), np.float32) for _ in range(2))
    free = np.asarray(evaluate(models.ProjectedBrdf(c, isotropic=True), wi, wo))
    clamped = evaluate(models.ProjectedBrdf(c, isotropic=True, clamp=True), wi, wo)
    assert free.min() < 0
    np.testing.assert_allclose(clamped, np.maximum(free, 0), atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_derivatives_also_at_the_normal(form, rng, x64):
    c, bend = FORMS[form](rng), rng.normal(size=(2, 3)) * [1, 1, 0]
    normal, slant = np.array([0, 0, 1.0]), spherical(0.8, 0.3)

    @jax.jit
    def f(t, c, wi, wo):
        move = lambda w, by: (w + by) / jnp.sqrt(jnp.sum((w + by) ** 2))
        brdf = models.ProjectedBrdf(c, isotropic=form)
        return brdf.value_cosine(move(wi, t[0] * bend[0]), move(wo, t[1] * bend[1]))

    for wi, wo in ((normal, normal), (normal, slant), (slant, slant), (slant, normal)):
        check_grads(lambda t, c, wi=wi, wo=wo: f(t, c, wi, wo), (jnp.zeros(2), c), 1, rtol=1e-5, atol=1e-7)


def test_errors_say_what_to_pass(as_user):
    for shape, form in (((4, 4, 4, 4), False), ((5, 5), False), ((4, 9), False), ((2, 4, 4), False), ((4, 4), True),
                        ((2, 3, 3, 3), True), ((3, 3, 4), True)):  # fmt: skip
        with pytest.raises(ValueError, match=r"`coefficients` must have shape .*\[L\+1|\(L\+1\)"):
            models.ProjectedBrdf(np.zeros(shape), isotropic=form)
    with pytest.raises(ValueError, match="`wi` must have shape"):
        models.ProjectedBrdf(np.zeros((4, 4)), isotropic=False).value(np.zeros((2, 3)), np.zeros(3))


def test_it_compiles_once_for_all_coefficients(rng):
    f = eqx.filter_jit(eqx.debug.assert_max_traces(lambda b, wi, wo: b.value(wi, wo), max_traces=1))
    w = np.array([0, 0.6, 0.8], np.float32)
    values = [float(f(models.ProjectedBrdf(array(isotropic(rng), np.float32), isotropic=True), w, w)) for _ in range(3)]
    assert len(set(values)) == 3
    assert 0 < float(models.ProjectedBrdf(isotropic(rng), isotropic=True).lobe_width) <= 1


@pytest.mark.slow
def test_its_table_holds_its_slices(rng, x64):
    """The slice from a direction, times the cosine, by quadrature in the table and as an expansion here."""
    brdf = models.ProjectedBrdf(isotropic(rng) + 1, isotropic=True)
    lobes = shading.tabulate_brdf(brdf, 8, elevations=32)
    assert float(lobes.error) < 1e-6
    view = spherical(0.7, 0.4)
    x, w = np.polynomial.legendre.leggauss(40)
    phi = 2 * np.pi * np.arange(40) / 40
    wi = spherical(np.arccos((x[:, None] + 1) / 2), phi).reshape(-1, 3)
    slices = np.asarray(evaluate(brdf, wi, np.broadcast_to(view, wi.shape))) * wi[:, 2]
    expected = (slices * np.repeat(w / 2, 40) * 2 * np.pi / 40) @ scipy_basis(wi, 8)
    got = lobes.at(jnp.asarray(view))
    np.testing.assert_allclose(got, expected, atol=1e-4 * np.abs(expected).max())
