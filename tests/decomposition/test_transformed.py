"""Expansions beyond maps of directions, and their fits, against SciPy's exponential of matrices and harmonics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from shisd import Status, decomposition, domains
from shisd.decomposition._stretch import log_stretch, stretch
from tests import truth
from tests.hard_cases import unit
from tests.marks import FLOAT64_FIRST

EVEN = np.array([0, 0, 1, 1, 1])


def form(s):
    """S of w^T S w = sum over m of s_m y_2^m(w), from values of the harmonics alone."""
    pairs = [np.eye(3)[i] + np.eye(3)[j] for i in range(3) for j in range(i, 3)]
    w = unit(np.array(pairs))
    rows = np.array([[(1 if i == j else 2) * x[i] * x[j] for i in range(3) for j in range(i, 3)] for x in w])
    e = np.linalg.solve(rows, truth.scipy_basis(w, 2)[:, 4:] @ s)
    return np.array([[e[0], e[1], e[2]], [e[1], e[3], e[4]], [e[2], e[4], e[5]]])


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("size", [1e-5, 0.3, 3.0, 8.0])
def test_a_map_is_the_exponential_of_half_its_form(size, even, dtype, rng):
    s = (size * rng.normal(size=(4, 5)) * (EVEN if even else 1)).astype(dtype)
    maps = np.asarray(jax.jit(lambda s: stretch(s, even=even))(jnp.asarray(s.T)))
    assert maps.dtype == dtype
    for k, own in enumerate(s.astype(float)):
        expected = expm(form(own) / 2)
        error = (3e-7 if dtype == np.float32 else 1e-15 * (1 + size)) * (1 + size)
        np.testing.assert_allclose(maps[..., k], expected, rtol=0, atol=error * np.max(np.abs(expected)))
        np.testing.assert_allclose(np.linalg.det(expected), 1, rtol=3e-12)
    if dtype == np.float64:
        turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        np.testing.assert_allclose(log_stretch(jnp.asarray(7 * turned @ expected)), s[-1], atol=5e-14 * np.exp(size))


def random_expansion(rng, dtype, colour=()):
    s, c, b = 0.8 * rng.normal(size=5), rng.normal(size=(*colour, 9)), rng.normal(size=(*colour, 4))
    return decomposition.TransformedExpansion(*(x.astype(dtype) for x in (3 * expm(form(s) / 2), c, b)))


@pytest.mark.parametrize("colour", [(), (3,)])
def test_values_and_integrals(colour, dtype, rng):
    f = random_expansion(rng, dtype, colour)
    v = np.array([[0.2, 0.1, 1], [1, 0.2, 0.3], [0.1, 1, 0.4]])
    w, area = truth.triangle_rule(unit(v), 24)
    a, c, b = (np.asarray(x, float) for x in (f.transform, f.coefficients, f.base))
    mapped = w @ a.T
    length = np.sqrt(np.sum(mapped**2, axis=1))
    expected = c @ (truth.scipy_basis(mapped / length[:, None], 2) * (np.linalg.det(a) / length**3)[:, None]).T
    expected = (expected + b @ truth.scipy_basis(w.astype(float), 1).T).astype(float)
    error = dict(rtol=0, atol=(4e-6 if dtype == np.float32 else 2e-14) * np.max(np.abs(expected)))
    got = f.evaluate(2 * w.astype(dtype))
    assert got.dtype == dtype and got.shape == (*colour, len(w))
    np.testing.assert_allclose(got, expected, **error)
    polygon = domains.SphericalPolygon(unit(v).astype(dtype))
    beyond = domains.SphericalPolygon(f.directions(polygon.vertices))
    whole = domains.integrate(f.coefficients, beyond) + domains.integrate(f.base, polygon)
    np.testing.assert_allclose(
        whole,
        expected @ area.astype(float),
        rtol=0,
        atol=(2e-7 if dtype == np.float32 else 2e-15) * np.max(np.abs(expected)),
    )


def samples(rng, count=1200):
    w = unit(rng.normal(size=(count, 3)))
    return w, np.full(count, 4 * np.pi / count)


@FLOAT64_FIRST
@pytest.mark.parametrize("even", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_fit_finds_the_map_again(even, dtype, rng):
    w, areas = samples(rng)
    s, sign = np.array([0.4, -0.3, -0.9, 0.7, 0.5]) * (EVEN if even else 1), np.array([0, 0, 1, 1])
    c = np.array([1, 0.2, 0.8, -0.3, 0.1, -0.2, 0.3, 0.1, 0.2]) * ([1, 0, 1, 1, 0, 0, 1, 1, 1] if even else 1)
    lobe = decomposition.TransformedExpansion(expm(form(s) / 2), c, np.array([0.1, 0, 0.2, 0.1]) * sign)
    y = np.asarray(lobe.evaluate(w))
    fit = decomposition.fit_transformed(
        w.astype(dtype), np.stack([y, 2 * y, 0 * y]).astype(dtype), areas.astype(dtype), 2,
        base_degree=1, even=even, ridge=1e-9, start=np.eye(3), max_steps=200, tolerance=1e-7, throw=False,
    )  # fmt: skip
    assert fit.expansion.transform.dtype == dtype and fit.error.shape == (3,)
    assert np.all(np.asarray(fit.error) < (1e-5 if dtype == np.float32 else 1e-6)) and fit.error[2] == 0
    np.testing.assert_allclose(log_stretch(fit.expansion.transform), s, atol=2e-6)
    got = fit.expansion.evaluate(w[:50].astype(dtype))
    np.testing.assert_allclose(got[1], 2 * y[:50], atol=2e-6 * np.max(np.abs(y)))
    black = fit.expansion.evaluate(w[:5].astype(dtype))[2]
    np.testing.assert_array_equal(black, 0)


@pytest.mark.slow
def test_a_narrow_lobe_needs_few_bands_beyond_a_map(rng):
    """A lobe with long tails, of 3 degrees half width: 40 times nearer than any plain expansion of its degree."""
    x, y = np.meshgrid(np.linspace(0, 2 * np.pi, 40, endpoint=False), np.sinh(np.linspace(0.03, 3.6, 60)) / 20)
    polar = np.minimum(y, 3.1).ravel()
    w = np.stack([np.sin(polar) * np.cos(x.ravel()), np.sin(polar) * np.sin(x.ravel()), np.cos(polar)], axis=1)
    areas = np.sin(polar) * np.repeat(np.gradient(np.minimum(y[:, 0], 3.1)), 40) * 2 * np.pi / 40
    values = 1 / (1 + (polar / 0.05) ** 2) ** 2
    arguments = [a.astype(np.float32) for a in (w, values, areas)]
    plain = decomposition.fit_transformed(*arguments, 4, start=np.eye(3, dtype=np.float32), max_steps=0)
    fit = decomposition.fit_transformed(*arguments, 4)
    assert fit.error < 0.02 and plain.error > 40 * fit.error
    assert fit.status == Status.ok


def test_derivatives_of_a_fit(x64, rng):
    """In the samples, by the implicit function theorem, against differences of fits."""
    w, areas = samples(rng, 80)
    lobe, change = (np.asarray(random_expansion(rng, np.float64).evaluate(w)) for _ in range(2))

    def found(t):
        y = lobe + 0.2 * change + t * change
        fit = decomposition.fit_transformed(
            w, y, areas * (1 + t * w[:, 0]), 1, start=np.eye(3), even=True, max_steps=100, tolerance=1e-8, throw=False
        )
        return jnp.concatenate([fit.expansion.transform.ravel(), fit.expansion.coefficients, fit.error[None]])

    with_slope = jax.jit(lambda t: jax.jvp(found, (t,), (1.0,)))
    step, slope = 1e-3, with_slope(0.0)[1]
    at = lambda t: with_slope(t * step)[0]
    expected = (8 * (at(1) - at(-1)) - at(2) + at(-2)) / (12 * step)
    np.testing.assert_allclose(slope, expected, atol=5e-6 * np.max(np.abs(expected)))
    back = jax.jit(jax.grad(lambda t: found(t) @ np.arange(14.0)))(0.0)
    np.testing.assert_allclose(back, slope @ np.arange(14.0), rtol=1e-13)


def test_outcomes_and_errors(as_user, rng):
    w, areas = (a.astype(np.float32) for a in samples(rng, 60))
    y = np.exp(3 * w[:, 2])
    with pytest.raises(ValueError, match="steps were used up"):
        decomposition.fit_transformed(w, y, areas, 1, max_steps=1)
    assert decomposition.fit_transformed(w, y, areas, 1, max_steps=1, throw=False).status == Status.step_limit
    with pytest.raises(ValueError, match=r"`directions` must have shape \[N, 3\].*got \[60, 3\], \[59\] and \[60\]"):
        decomposition.fit_transformed(w, y[1:], areas, 1)
    with pytest.raises(ValueError, match=r"`start` must have shape \[3, 3\] or \[S, 3, 3\]; got \[3\]"):
        decomposition.fit_transformed(w, y, areas, 1, start=np.ones(3))
    with pytest.raises(ValueError, match=r"`transform` must have shape \[3, 3\]; got \[2, 2\]"):
        decomposition.TransformedExpansion(np.eye(2), np.ones(4))
    with pytest.raises(ValueError, match="`base` .* are of other colours"):
        decomposition.TransformedExpansion(np.eye(3), np.ones((3, 4)), np.ones(4))
