"""The basis and expansions against SciPy and mpmath, at the poles and in every derivative."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import harmonics
from tests import truth
from tests.marks import FLOAT32_FIRST
from tests.truth import scipy_basis


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def hard_directions(dtype, rng):
    """Random directions, both poles, and points at many distances from the poles and the equator."""
    near = [
        [s * 10.0**-k, t * 10.0**-k, z] for k in (1, 3, 5, 7, 20) for s, t, z in ((1, 0, 1), (-1, 2, -1), (0, -1, 1))
    ]
    equator = [[1, 0, 0], [0, -1, 0], [1, 1, 1e-6], [-1, 1, -1e-9]]
    poles = [[0, 0, 1], [0, 0, -1]]
    return unit(np.concatenate([rng.normal(size=(60, 3)), near, equator, poles])).astype(dtype)


def test_the_first_band_states_the_convention(dtype):
    x, y, z = unit(np.array([0.36, -0.48, 0.8]))
    got = harmonics.sh_basis(np.array([x, y, z], dtype), 1)
    expected = [np.sqrt(1 / (4 * np.pi)), *(np.sqrt(3 / (4 * np.pi)) * np.array([-y, z, -x]))]
    np.testing.assert_allclose(got, expected, rtol=3 * np.finfo(dtype).eps)
    assert got.dtype == dtype


LIMITS = {("float64", 30): 1e-13, ("float64", 100): 1e-12, ("float32", 16): 3e-6, ("float32", 100): 3e-5}


@pytest.mark.parametrize("degree", [0, 1, 16, 100, pytest.param(30, marks=pytest.mark.slow)])
def test_basis_against_scipy(degree, dtype, rng):
    d = hard_directions(dtype, rng)
    got = np.asarray(harmonics.sh_basis(d, degree))
    assert got.shape == (len(d), (degree + 1) ** 2) and got.dtype == dtype
    error = np.abs(got - scipy_basis(d, degree))
    limit = next(v for (name, top), v in LIMITS.items() if name == dtype.name and degree <= top)
    i, j = np.unravel_index(np.argmax(error), error.shape)
    assert error[i, j] <= limit, f"direction {d[i]}, index {j}: {got[i, j]}"


def test_basis_in_forty_digits(x64):
    """A few values up to degree 100 by the textbook recurrence, with factorials: SciPy has no part in them."""
    mpmath.mp.dps = 60
    d = unit(np.array([[0.3, -0.2, 0.5], [1e-3, 2e-3, -1.0], [0.8, 0.6, 0.01]]))
    got = np.asarray(harmonics.sh_basis(d, 100))
    for direction, row in zip(d, got, strict=True):
        x, y, z = (mpmath.mpf(float(v)) for v in direction)
        r = mpmath.sqrt(x * x + y * y + z * z)
        cosine, phi = z / r, mpmath.atan2(y, x)
        for l, m in [(100, 0), (100, 1), (100, 37), (99, 98), (57, 20), (3, 2)]:
            before, polar = mpmath.mpf(0), (-1) ** m * mpmath.fac2(2 * m - 1) * mpmath.sqrt(1 - cosine**2) ** m  # P_m^m
            for k in range(m + 1, l + 1):  # DLMF 14.10.3
                before, polar = polar, ((2 * k - 1) * cosine * polar - (k + m - 1) * before) / (k - m)
            norm = mpmath.sqrt((2 * l + 1) / (4 * mpmath.pi) * mpmath.factorial(l - m) / mpmath.factorial(l + m))
            value = norm * polar * (mpmath.sqrt(2) if m else 1)
            for order, wave in ((m, mpmath.cos(m * phi)), (-m, mpmath.sin(m * phi)))[: 2 if m else 1]:
                assert abs(row[l * (l + 1) + order] - float(value * wave)) <= 1e-12, (l, order)


@pytest.mark.slow
def test_degree_200(x64, rng):
    d = hard_directions(np.float64, rng)[-40:]
    assert np.max(np.abs(harmonics.sh_basis(d, 200) - scipy_basis(d, 200))) <= 1e-11


def test_length_does_not_matter_and_no_direction_is_not_a_number(dtype):
    """Values and gradients, also of band 0 alone, whose only function is a constant."""
    d = np.array([0.3, -0.2, 0.5], dtype)
    lengths = np.array([1e-30, 1e-3, 1e3, 1e30], dtype)
    got = np.asarray(harmonics.sh_basis(lengths[:, None] * d, 4))
    np.testing.assert_allclose(got, np.repeat(got[:1], 4, axis=0), rtol=0, atol=8 * np.finfo(dtype).eps)
    bad = np.array([[0, 0, 0], [np.nan, 0, 1], [0, 0, np.inf]], dtype)
    constants = [np.ones(n, dtype) for n in (1, 9)]
    verbs = [lambda w, n=n: harmonics.sh_basis(w, n) for n in (0, 2)]
    verbs += [lambda w, c=c: harmonics.evaluate(c, w) for c in constants]
    verbs += [lambda w, c=c: harmonics.evaluate(np.tile(c, (3, 1)), w) for c in constants]  # each its own expansion
    values = jax.jit(lambda w: [verb(w) for verb in verbs])(bad)
    slopes = jax.jit(lambda w: [jax.grad(lambda w, verb=verb: jnp.sum(verb(w)))(w) for verb in verbs])(bad)
    assert all(np.isnan(x).all() for x in values + slopes)
    for degree in (0, 2):
        assert np.isnan(harmonics.legendre(bad[1, :1], degree)).all()


DEGREE = 5
POINTS = np.array([[0, 0, 1.0], [0, 0, -1.0], [1e-7, 0, 1], [0, 1e-4, -1], [1, 0, 0], [0.3, -0.5, 0.7]])


def solid_polynomials(p):
    """r^2 y_2^m and r^3 y_3^m / ... as polynomials: -sqrt(15/4pi) yz, ... for l = 2, and y_3^3, written out."""
    x, y, z = p
    r2 = x * x + y * y + z * z
    band2 = [
        np.sqrt(15 / (4 * np.pi)) * x * y,
        -np.sqrt(15 / (4 * np.pi)) * y * z,
        np.sqrt(5 / (16 * np.pi)) * (3 * z * z - r2),
        -np.sqrt(15 / (4 * np.pi)) * x * z,
        np.sqrt(15 / (16 * np.pi)) * (x * x - y * y),
    ]
    return jnp.stack([b / r2 for b in band2] + [-np.sqrt(35 / (32 * np.pi)) * x * (x * x - 3 * y * y) / r2**1.5])


INDICES = np.array([4, 5, 6, 7, 8, 15])


@pytest.mark.parametrize("order", [1, 2, 3])
def test_derivatives_against_polynomials(order, x64):
    """Value to third derivative of l = 2 and 3, differentiated as the rational functions of x, y, z that they are."""
    ours, theirs = lambda p: harmonics.sh_basis(p, 3)[INDICES], solid_polynomials
    for _ in range(order):
        ours, theirs = jax.jacfwd(ours), jax.jacfwd(theirs)
    points = jnp.asarray(POINTS)
    np.testing.assert_allclose(jax.jit(jax.vmap(ours))(points), jax.jit(jax.vmap(theirs))(points), atol=1e-10)


@pytest.mark.slow
def test_gradients_of_the_basis(x64):
    check_grads(jax.jit(lambda d: harmonics.sh_basis(d, DEGREE)), (jnp.asarray(POINTS),), order=2, atol=1e-5, rtol=1e-5)


@pytest.mark.slow
def test_gradients_of_expansions(x64, rng):
    c = jnp.asarray(rng.normal(size=(2, 1, (DEGREE + 1) ** 2)))
    check_grads(jax.jit(harmonics.evaluate), (c, jnp.asarray(POINTS)), order=2, atol=1e-5, rtol=1e-5)


def test_gradients_against_those_of_the_recurrence(dtype, rng):
    """Of expansions in directions and coefficients, and of the basis, against extended precision; poles included."""
    degree = 16
    d, c = hard_directions(dtype, rng), rng.normal(size=(degree + 1) ** 2).astype(dtype)
    values, slopes = truth.harmonics(d, degree)
    exact = np.einsum("pni,n->pi", slopes, c.astype(np.longdouble))
    both = jax.jit(jax.grad(lambda d, c: jnp.sum(harmonics.evaluate(c, d)), (0, 1)))
    in_directions, in_coefficients = (np.asarray(x) for x in both(d, c))
    of_basis = jax.jit(jax.grad(lambda d: jnp.sum(harmonics.sh_basis(d, degree) @ c)))(d)
    limit = 5e-6 if dtype == np.float32 else 1e-14
    for got in (in_directions, np.asarray(of_basis)):
        assert np.max(np.abs(got - exact)) <= limit * np.max(np.abs(exact))
    total = np.sum(values, axis=0)
    assert np.max(np.abs(in_coefficients - total)) <= limit * len(d)


@pytest.mark.parametrize("degree", [0, 7, 64, pytest.param(1, marks=pytest.mark.slow)])
def test_expansions_against_the_basis(degree, dtype, rng):
    d = hard_directions(dtype, rng)
    c = rng.normal(size=(3, 1, (degree + 1) ** 2)).astype(dtype)
    got = harmonics.evaluate(c, d)
    assert got.shape == (3, len(d)) and got.dtype == dtype
    expected = c[:, 0].astype(float) @ scipy_basis(d, degree).T
    assert np.max(np.abs(got - expected)) <= 10 * np.finfo(dtype).eps * np.max(np.sum(np.abs(c), axis=-1))


def test_batches_broadcast_as_in_numpy(rng):
    c, d = rng.normal(size=(4, 9)).astype(np.float32), unit(rng.normal(size=(5, 4, 3))).astype(np.float32)
    expected = np.einsum("fn,pfn->pf", c, scipy_basis(d, 2))
    np.testing.assert_allclose(harmonics.evaluate(c, d), expected, atol=1e-5)
    np.testing.assert_allclose(harmonics.evaluate(c[0], d[0, 0]), expected[0, 0], atol=1e-5)
    np.testing.assert_allclose(harmonics.evaluate(c[:, None], d[:, 0]), c @ scipy_basis(d[:, 0], 2).T, atol=1e-5)


def test_many_points_are_tiled(rng):
    d = unit(rng.normal(size=((1 << 15) + 7, 3))).astype(np.float32)
    c = rng.normal(size=9).astype(np.float32)
    np.testing.assert_allclose(harmonics.evaluate(c, d), scipy_basis(d, 2) @ c, atol=1e-5)
    slope = jax.grad(lambda c: jnp.sum(harmonics.evaluate(c, d)))(jnp.asarray(c))
    np.testing.assert_allclose(slope, np.sum(scipy_basis(d, 2), axis=0), atol=1e-5 * len(d))


@FLOAT32_FIRST
def test_transformations_agree(dtype, rng):
    d = jnp.asarray(hard_directions(dtype, rng)[:7])
    whole = harmonics.sh_basis(d, 4)
    tolerance = 20 * np.finfo(dtype).eps
    np.testing.assert_allclose(jax.vmap(lambda p: harmonics.sh_basis(p, 4))(d), whole, atol=tolerance)
    np.testing.assert_allclose(jnp.stack([harmonics.sh_basis(p, 4) for p in d]), whole, atol=tolerance)
    with jax.disable_jit():
        np.testing.assert_allclose(harmonics.sh_basis(d, 4), whole, atol=tolerance)


def test_errors_name_the_argument(as_user):
    d = np.ones((2, 3), np.float32)
    for degree, message in [
        (-1, "`degree` must be >= 0; got -1"),
        (2.5, "`degree` must be a Python integer"),
        (True, "got True"),
    ]:
        with pytest.raises(ValueError, match=message):
            harmonics.sh_basis(d, degree)
    with pytest.raises(ValueError, match="`degree` must be a Python integer known while tracing"):
        jax.jit(harmonics.sh_basis)(d, 2)
    with pytest.raises(ValueError, match=r"`directions` must have shape \[\.\.\., 3\]; got \[2, 2\]"):
        harmonics.sh_basis(d[:, :2], 2)
    with pytest.raises(ValueError, match="`directions` must hold real numbers; got dtype complex64"):
        harmonics.sh_basis(d * 1j, 2)
    with pytest.raises(ValueError, match=r"`coefficients` must have \(degree \+ 1\)\*\*2 coefficients .* got \[5\]"):
        harmonics.evaluate(np.ones(5, np.float32), d)
    with pytest.raises(ValueError, match="do not broadcast"):
        harmonics.evaluate(np.ones((3, 9), np.float32), d)
