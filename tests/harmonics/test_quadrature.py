import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from shisd import harmonics
from shisd.harmonics import _quadrature

DEGREES = (0, 1, 2, 3, 8, 13, 40)


def monomial(a: int, b: int, c: int) -> float:
    """Integral of x^a y^b z^c over the sphere: 2 prod Gamma((a_i + 1) / 2) / Gamma(sum (a_i + 1) / 2), or zero."""
    if a % 2 or b % 2 or c % 2:
        return 0.0
    gammas = [math.gamma((n + 1) / 2) for n in (a, b, c)]
    return 2 * math.prod(gammas) / math.gamma((a + b + c + 3) / 2)


@pytest.mark.parametrize("degree", DEGREES)
def test_rule_has_the_promised_size_unit_directions_and_positive_weights(dtype, degree):
    directions, weights = harmonics.sphere_rule(degree)
    assert directions.shape == (math.ceil((degree + 1) / 2) * (degree + 1), 3)
    assert weights.shape == directions.shape[:1]
    assert directions.dtype == weights.dtype == dtype
    eps = float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=3 * eps)
    assert weights.min() > 0
    assert abs(np.sum(np.asarray(weights), dtype=np.float64) - 4 * np.pi) < 30 * eps


@pytest.mark.parametrize("degree", (0, 1, 2, 3, 8, 13))
def test_every_monomial_up_to_the_degree_is_exact(dtype, degree):
    directions, weights = (np.asarray(v, np.float64) for v in harmonics.sphere_rule(degree))
    tolerance = 1e-6 if dtype == np.float32 else 1e-14
    for a in range(degree + 1):
        for b in range(degree + 1 - a):
            for c in range(degree + 1 - a - b):
                got = weights @ (directions ** np.array([a, b, c])).prod(axis=1)
                assert abs(got - monomial(a, b, c)) < tolerance, (a, b, c, got, monomial(a, b, c))


@pytest.mark.parametrize("degree", (1, 2, 7, 8))
def test_the_next_degree_is_not_exact(x64, degree):
    directions, weights = harmonics.sphere_rule(degree)
    moments = weights @ harmonics.sh_basis(directions, degree + 1)
    assert jnp.max(jnp.abs(moments[1:])) > 1e-3


def test_rule_can_be_asked_for_in_either_precision(x64):
    directions, weights = harmonics.sphere_rule(4, dtype=jnp.float32)
    assert directions.dtype == weights.dtype == jnp.float32


def test_rule_is_a_constant_under_jit(dtype):
    jitted = jax.jit(lambda: harmonics.sphere_rule(5))()
    for a, b in zip(jitted, harmonics.sphere_rule(5), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("rows", (1, 2, 3, 16, 101, 300))
def test_gauss_rows_against_mpmath(rows):
    theta, weights = _quadrature.gauss_rows(rows)
    assert np.all(np.diff(theta) > 0)
    with mpmath.workdps(40):
        for j in {0, 1, rows // 3, rows // 2, rows - 1} & set(range(rows)):
            exact = mpmath.findroot(lambda t: mpmath.legendre(rows, mpmath.cos(t)), mpmath.mpf(theta[j]))
            z = mpmath.cos(exact)
            slope = rows * (mpmath.legendre(rows - 1, z) - z * mpmath.legendre(rows, z)) / (1 - z * z)
            weight = 2 / ((1 - z * z) * slope**2)
            assert abs(theta[j] - exact) < 1e-15 * theta[j], j
            assert abs(weights[j] / weight - 1) < 1e-14, j


@pytest.mark.parametrize("rows", (1, 2, 3, 4, 9, 64, 101))
def test_fejer_rows_are_pixel_centres_and_exact_below_their_number(rows):
    theta, weights = _quadrature.fejer_rows(rows)
    np.testing.assert_allclose(theta, np.pi * (np.arange(rows) + 0.5) / rows, rtol=1e-15)
    for power in range(rows):
        exact = 0 if power % 2 else 2 / (power + 1)
        assert abs(weights @ np.cos(theta) ** power - exact) < 1e-14, power


@pytest.mark.parametrize("degree", (-1, 2.0, True, "3"))
def test_degree_is_checked(as_user, degree):
    with pytest.raises(ValueError, match="`degree`"):
        harmonics.sphere_rule(degree)
