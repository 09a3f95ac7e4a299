import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import harmonics
from tests.marks import FLOAT32_FIRST
from tests.truth import scipy_basis

DEGREE = 100
# Both ends and how they are approached, the middle, and points off the sphere by rounding.
POINTS = np.concatenate(
    [1 - 10.0 ** np.arange(-7, 0.1, 0.5), 10.0 ** np.arange(-7, 0.1, 0.5) - 1, np.linspace(-0.95, 0.95, 21), [1, -1]]
)
PROMISE = {"float32": 1e-6, "float64": 3e-15}


def exact(x: np.ndarray, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P_l(x), P_l'(x), P_l''(x) by recurrence in 40 digits."""
    with mpmath.workdps(40):
        rows = []
        for value in x:
            z = mpmath.mpf(float(value))
            p, d, s = [mpmath.mpf(1), z], [mpmath.mpf(0), mpmath.mpf(1)], [mpmath.mpf(0), mpmath.mpf(0)]
            for l in range(2, degree + 1):
                p.append(((2 * l - 1) * z * p[l - 1] - (l - 1) * p[l - 2]) / l)
                d.append(d[l - 2] + (2 * l - 1) * p[l - 1])
                s.append(s[l - 2] + (2 * l - 1) * d[l - 1])
            rows.append([[float(v) for v in series[: degree + 1]] for series in (p, d, s)])
    return tuple(np.array(rows).transpose(1, 0, 2))


def test_the_oracle_agrees_with_mpmath():
    p, _, _ = exact(np.array([0.3, -0.99]), 30)
    for row, x in zip(p, (0.3, -0.99), strict=True):
        np.testing.assert_allclose(row, [float(mpmath.legendre(l, x)) for l in range(31)], atol=1e-14)


def test_values_up_to_degree_100(dtype):
    x = POINTS.astype(dtype)
    got = harmonics.legendre(jnp.asarray(x), DEGREE)
    assert got.dtype == dtype
    error = np.abs(np.asarray(got, np.float64) - exact(x, DEGREE)[0])
    worst = np.unravel_index(error.argmax(), error.shape)
    assert error.max() < PROMISE[dtype.name], (x[worst[0]], worst[1], error.max())


def test_first_and_second_derivatives_up_to_degree_100(dtype):
    x = jnp.asarray(POINTS.astype(dtype))
    ones = jnp.ones_like(x)
    first = lambda x: jax.jvp(lambda x: harmonics.legendre(x, DEGREE), (x,), (ones,))[1]
    second = lambda x: jax.jvp(first, (x,), (ones,))[1]
    _, d, s = exact(np.asarray(x), DEGREE)
    l = np.arange(DEGREE + 1)
    at_one = l * (l + 1) / 2, (l - 1) * l * (l + 1) * (l + 2) / 8
    for got, truth, scale in zip((jax.jit(first)(x), jax.jit(second)(x)), (d, s), at_one, strict=True):
        error = np.abs(np.asarray(got, np.float64) - truth) / np.maximum(scale, 1)
        worst = np.unravel_index(error.argmax(), error.shape)
        assert error.max() < 2 * PROMISE[dtype.name], (POINTS[worst[0]], worst[1], error.max())


@pytest.mark.parametrize("degree", (0, 1, 2, 16, 17, 18, 33))
def test_every_length_of_series(dtype, degree):
    x = np.array([[-1.0, -0.4, 0.0], [0.2, 0.9, 1.0]]).astype(dtype)
    got = harmonics.legendre(jnp.asarray(x), degree)
    assert got.shape == (2, 3, degree + 1)
    truth = exact(x.ravel(), degree)[0].reshape(got.shape)
    np.testing.assert_allclose(np.asarray(got), truth, atol=PROMISE[dtype.name], rtol=0)


def test_scalars_integers_and_empty_batches():
    assert harmonics.legendre(0.5, 3).shape == (4,)
    np.testing.assert_allclose(harmonics.legendre(1, 3), np.ones(4))
    assert harmonics.legendre(jnp.zeros((0, 2)), 5).shape == (0, 2, 6)


def test_zonal_basis_is_the_order_zero_column_of_the_basis(dtype, rng):
    w = rng.normal(size=(20, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    z, l = w[:, 2].astype(dtype), np.arange(13)
    got = harmonics.zonal_basis(z, 12)
    assert got.dtype == dtype
    w[:, :2] *= np.sqrt(1 - z.astype(float) ** 2)[:, None] / np.hypot(w[:, 0], w[:, 1])[:, None]
    w[:, 2] = z
    exact = scipy_basis(w, 12)[:, l * l + l]
    np.testing.assert_allclose(got, exact, atol=1e-6 if dtype == np.float32 else 1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("degree", (5, 20))
def test_gradients(x64, degree):
    x = jnp.array([-1.0, -0.7, 0.0, 0.3, 1.0])
    check_grads(jax.jit(lambda x: harmonics.legendre(x, degree)), (x,), order=2, modes=("fwd", "rev"), eps=1e-6)


@FLOAT32_FIRST
def test_jit_and_vmap_agree_with_the_plain_call(dtype):
    x = jnp.linspace(-1, 1, 9, dtype=dtype)
    plain = harmonics.legendre(x, 20)
    eps = float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(jax.jit(lambda x: harmonics.legendre(x, 20))(x), plain, atol=20 * eps)
    np.testing.assert_allclose(jax.vmap(lambda x: harmonics.legendre(x, 20))(x), plain, atol=20 * eps)


def test_errors_name_the_argument(as_user):
    with pytest.raises(ValueError, match="`degree`"):
        harmonics.legendre(0.5, -1)
    with pytest.raises(ValueError, match="`degree`"):
        jax.jit(harmonics.legendre)(0.5, 3)
    with pytest.raises(ValueError, match="`x`"):
        harmonics.legendre(1j, 3)
