import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import harmonics
from tests.marks import FLOAT32_FIRST
from tests.models.materials import spherical
from tests.truth import scipy_basis

slow = lambda *values: pytest.param(*values, marks=pytest.mark.slow)
TOLERANCE = {"float32": 2e-6, "float64": 1e-14}


def by_brute_force(a: np.ndarray, b: np.ndarray, degree: int) -> np.ndarray:
    """Project the product of values on a rule of far higher degree than needed, with SciPy's harmonics."""
    z, w = np.polynomial.legendre.leggauss(22)
    w, phi = np.repeat(w * 2 * np.pi / 44, 44), 2 * np.pi * np.arange(44) / 44
    y = scipy_basis(spherical(np.arccos(z)[:, None], phi[None]).reshape(-1, 3), 12)
    values = (y[:, : a.size] @ a) * (y[:, : b.size] @ b)
    return (values * w) @ y[:, : (degree + 1) ** 2]


def unit(index: int, degree: int, dtype) -> jnp.ndarray:
    return jnp.zeros((degree + 1) ** 2, dtype).at[index].set(1)


def test_known_triple_products(dtype):
    """From the monomials: y_0 y_j = y_j / sqrt(4 pi), z z = 1/3 + ..., x y is one harmonic."""
    tolerance = TOLERANCE[dtype.name]
    y0, y, z, x = (unit(i, 1, dtype) for i in range(4))
    product = lambda a, b: np.asarray(harmonics.multiply(a, b, 2))
    np.testing.assert_allclose(product(y0, z), np.eye(9)[2] / np.sqrt(4 * np.pi), atol=tolerance)
    zz = np.zeros(9)
    zz[0], zz[6] = 1 / np.sqrt(4 * np.pi), 1 / np.sqrt(5 * np.pi)
    np.testing.assert_allclose(product(z, z), zz, atol=tolerance)
    np.testing.assert_allclose(product(x, y), np.eye(9)[4] * np.sqrt(3 / (20 * np.pi)), atol=tolerance)


@pytest.mark.parametrize(
    ("a", "b", "degree"), [(3, 4, 2), (2, 3, 9), slow(0, 0, 0), slow(3, 4, 7), slow(6, 1, 6), slow(11, 12, 12)]
)
def test_product_is_exact(dtype, rng, a, b, degree):
    f, g = rng.normal(size=(a + 1) ** 2), rng.normal(size=(b + 1) ** 2)
    exact = by_brute_force(f, g, degree)
    got = harmonics.multiply(f.astype(dtype), g.astype(dtype), degree)
    assert got.dtype == dtype
    np.testing.assert_allclose(got, exact, rtol=0, atol=TOLERANCE[dtype.name] * np.linalg.norm(f) * np.linalg.norm(g))


@FLOAT32_FIRST
def test_batches_broadcast(dtype, rng):
    a, b = jnp.asarray(rng.normal(size=(2, 1, 9)), dtype), jnp.asarray(rng.normal(size=(3, 4)), dtype)
    got = harmonics.multiply(a, b, 3)
    assert got.shape == (2, 3, 16)
    for i in range(2):
        for j in range(3):
            np.testing.assert_allclose(got[i, j], harmonics.multiply(a[i, 0], b[j], 3), atol=20 * TOLERANCE[dtype.name])


def test_precisions_promote(x64):
    with jax.numpy_dtype_promotion("standard"):
        assert harmonics.multiply(np.ones(4, np.float32), np.ones(9), 2).dtype == np.float64


@pytest.mark.parametrize(
    ("g", "degree", "inputs"),
    [(2, 4, 4), (9, 3, 3), (3, 5, 2), slow(0, 0, 0), slow(4, 2, 2), slow(5, 5, 5)],
)
def test_matrix_is_symmetric_and_multiplies(dtype, rng, g, degree, inputs):
    """Also between degrees: with `degree` the sum of both, nothing of the product is lost."""
    c, f = rng.normal(size=(g + 1) ** 2), rng.normal(size=(inputs + 1) ** 2)
    matrix = np.asarray(harmonics.product_matrix(c.astype(dtype), degree, input_degree=inputs))
    assert matrix.dtype == dtype and matrix.shape == ((degree + 1) ** 2, f.size)
    if inputs == degree:
        np.testing.assert_array_equal(matrix, matrix.T)
    size = np.linalg.norm(c) * np.linalg.norm(f)
    np.testing.assert_allclose(matrix @ f, by_brute_force(c, f, degree), atol=TOLERANCE[dtype.name] * size)


def test_matrix_of_one_is_the_identity(dtype):
    one = jnp.asarray([np.sqrt(4 * np.pi)], dtype)
    np.testing.assert_allclose(harmonics.product_matrix(one, 6), np.eye(49), atol=5 * TOLERANCE[dtype.name])


def test_matrix_of_a_positive_function_is_positive_definite(x64):
    light = harmonics.project(lambda w: jnp.exp(3 * w[:, 0]), 12, quadrature_degree=60)
    eigenvalues = jnp.linalg.eigvalsh(harmonics.product_matrix(light, 6))
    assert np.exp(-3) - 1e-4 < eigenvalues.min()
    assert eigenvalues.max() < np.exp(3) + 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("degree", (20, 30))
def test_products_of_high_degree(x64, rng, degree):
    a, b = (jnp.asarray(rng.normal(size=(degree + 1) ** 2)) for _ in range(2))
    w = jnp.asarray(rng.normal(size=(50, 3)))
    full = harmonics.multiply(a, b, 2 * degree)
    exact = harmonics.evaluate(a, w) * harmonics.evaluate(b, w)
    np.testing.assert_allclose(harmonics.evaluate(full, w), exact, atol=1e-12 * jnp.abs(exact).max())
    truncated = harmonics.product_matrix(a, degree) @ b
    np.testing.assert_allclose(truncated, full[: (degree + 1) ** 2], atol=1e-12 * jnp.abs(full).max())


def test_convolution_with_a_zonal_kernel(dtype, rng):
    c, k = rng.normal(size=(2, 16)), rng.normal(size=4)
    got = harmonics.convolve(jnp.asarray(c, dtype), jnp.asarray(k, dtype))
    assert got.dtype == dtype
    l = np.repeat(np.arange(4), 2 * np.arange(4) + 1)
    np.testing.assert_allclose(got, c * np.sqrt(4 * np.pi / (2 * l + 1)) * k[l], rtol=5 * jnp.finfo(dtype).eps)
    assert harmonics.convolve(jnp.asarray(c[:, None], dtype), jnp.ones((3, 4), dtype)).shape == (2, 3, 16)


def test_convolution_is_the_integral_against_the_turned_kernel(x64, rng):
    """(k * f)(d) = integral of k(dot(d, w)) f(w) dw, all from SciPy and NumPy."""
    c, k = rng.normal(size=25), rng.normal(size=5)
    d = np.array([[0.6, 0.0, 0.8], [0.0, 0.0, -1.0]])
    z, w = np.polynomial.legendre.leggauss(6)
    phi = 2 * np.pi * np.arange(10) / 10
    directions = spherical(np.arccos(z)[:, None], phi[None]).reshape(-1, 3)
    kernel = np.polynomial.legendre.legval(d @ directions.T, k * np.sqrt((2 * np.arange(5) + 1) / (4 * np.pi)))
    direct = (kernel * (scipy_basis(directions, 4) @ c)) @ np.repeat(w * 2 * np.pi / 10, 10)
    np.testing.assert_allclose(scipy_basis(d, 4) @ np.asarray(harmonics.convolve(c, k)), direct, atol=2e-14)


def test_gradients(x64, rng):
    a, b, k = (jnp.asarray(rng.normal(size=n)) for n in (9, 16, 3))
    check_grads(jax.jit(lambda a, b: harmonics.multiply(a, b, 4)), (a, b), order=1, modes=("fwd", "rev"))
    check_grads(jax.jit(lambda a: harmonics.product_matrix(a, 3)), (a,), order=1, modes=("fwd", "rev"))
    check_grads(jax.jit(harmonics.convolve), (a, k), order=1, modes=("fwd", "rev"))


@FLOAT32_FIRST
def test_jit_and_vmap_agree_with_the_plain_call(dtype, rng):
    a, b = jnp.asarray(rng.normal(size=(3, 9)), dtype), jnp.asarray(rng.normal(size=(3, 9)), dtype)
    tolerance = 20 * TOLERANCE[dtype.name]
    for verb in (lambda a, b: harmonics.multiply(a, b, 3), lambda a, b: harmonics.product_matrix(a + b, 2)):
        plain = jnp.stack([verb(x, y) for x, y in zip(a, b, strict=True)])
        np.testing.assert_allclose(jax.vmap(verb)(a, b), plain, atol=tolerance)
        np.testing.assert_allclose(jax.jit(verb)(a[0], b[0]), plain[0], atol=tolerance)


def test_errors_name_the_argument(as_user):
    ok, bad = np.zeros(4, np.float32), np.zeros(5, np.float32)
    with pytest.raises(ValueError, match="`a`"):
        harmonics.multiply(bad, ok, 1)
    with pytest.raises(ValueError, match="`b`"):
        harmonics.multiply(ok, bad, 1)
    with pytest.raises(ValueError, match="`degree`"):
        harmonics.multiply(ok, ok, -1)
    with pytest.raises(ValueError, match="do not broadcast"):
        harmonics.multiply(np.zeros((2, 4), np.float32), np.zeros((3, 4), np.float32), 1)
    with pytest.raises(ValueError, match="`coefficients`"):
        harmonics.product_matrix(np.zeros((2, 4), np.float32), 1)
    with pytest.raises(ValueError, match=r"`zonal` must have shape \[..., 2\]"):
        harmonics.convolve(ok, np.zeros(3, np.float32))
    with pytest.raises(ValueError, match="do not broadcast"):
        harmonics.convolve(np.zeros((2, 4), np.float32), np.zeros((3, 2), np.float32))
