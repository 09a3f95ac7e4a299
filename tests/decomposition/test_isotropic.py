"""Isotropic decomposition with mother kernels: the matrix, exact inverses, ridge, filtering, refusals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import Status, decomposition
from shisd.decomposition import IsotropicBasis, RotatedZonalBasis
from tests import truth
from tests.marks import FLOAT32_FIRST

DEGREE = 5
WIDTHS = 3.0 * np.arange(1, 22)
KERNELS = {
    "Legendre": decomposition.LegendreKernel,
    "Gaussian": decomposition.GaussianKernel,
    "Phong": decomposition.PhongKernel,
    "Gauss-Legendre": decomposition.GaussLegendreKernel,
    "discs": decomposition.CapKernel,
    "function": lambda: decomposition.FunctionKernel(lambda x, l: 1 / (1.1 + 1 / (l + 1) - x) ** (l + 1)),
}


def unit(rng, *shape):
    z = rng.standard_normal((*shape, 3))
    return z / np.linalg.norm(z, axis=-1, keepdims=True)


def rotations(rng, *shape):
    q = np.linalg.qr(rng.standard_normal((*shape, 3, 3)))[0]
    return q * np.linalg.det(q)[..., None, None]


@eqx.filter_jit
def there_and_back(basis, c):
    found = basis.solve(c)
    back = basis.coefficients(found.weights)
    return found, back, basis.weights(back)


def check_round_trip(kernel, z, degree, nested, dtype, rng):
    basis = IsotropicBasis(kernel, z, degree, nested=nested)
    c = rng.standard_normal((3, (degree + 1) ** 2)).astype(dtype)
    found, back, again = there_and_back(basis, c)
    assert found.weights.shape == (3, degree + 1, basis.size) and found.weights.dtype == back.dtype == dtype
    limit = 10 * np.finfo(dtype).eps * float(found.condition_number)
    norm = lambda a: np.linalg.norm(np.asarray(a, float))
    assert norm(back - c) <= limit * norm(c)
    assert norm(again - found.weights) <= limit * norm(found.weights)
    assert np.all(np.asarray(found.error) <= limit)
    return float(found.condition_number)


@FLOAT32_FIRST
@pytest.mark.parametrize("nested", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["all", "2l+1"])
@pytest.mark.parametrize("name", KERNELS)
def test_band_limited_functions_are_reproduced_within_ten_eps_times_the_condition(name, nested, dtype, rng):
    check_round_trip(KERNELS[name](), decomposition.separate_directions(DEGREE), DEGREE, nested, dtype, rng)


@pytest.mark.slow
@pytest.mark.parametrize("name", KERNELS)
def test_they_are_at_degree_20_too(name, dtype, rng):
    z = decomposition.separate_directions(20)
    condition = check_round_trip(KERNELS[name](), z, 20, False, dtype, rng)
    if name in ("Gaussian", "Phong", "Gauss-Legendre", "discs"):
        assert condition < 400  # separate axes, all of them at every level
    if name in ("Gaussian", "Phong") and dtype == np.float64:
        assert check_round_trip(KERNELS[name](), z, 20, True, dtype, rng) < 1e5  # the paper's square M
        shared = IsotropicBasis(KERNELS[name](), decomposition.optimized_directions(20), 20)
        assert shared.condition_number() > 1e8  # where levels share axes: hardly, or not, invertible


@pytest.mark.parametrize("name", KERNELS)
def test_the_matrix_is_the_projection_of_the_kernels(name, x64):
    # Eq. 17 against integrals of y_n^m times the kernel turned to its axis, by a product rule and SciPy's harmonics
    degree, nodes = 3, 400
    kernel, z = KERNELS[name](), decomposition.separate_directions(degree)
    basis = IsotropicBasis(kernel, z, degree, unit_norm=False)
    m = np.asarray(basis.matrix())
    theta = np.linspace(0, np.pi, nodes + 1)[:-1] + np.pi / nodes / 2
    phi = np.arange(2 * nodes) * np.pi / nodes
    t, p = (g.ravel() for g in np.meshgrid(theta, phi, indexing="ij"))
    w = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)
    area = np.sin(t) * (np.pi / nodes) ** 2
    y = truth.scipy_basis(w, degree)
    for l, k in ((0, 0), (1, 2), (2, 5), (3, 6)):
        values = np.asarray(kernel(w @ np.asarray(z[l, k]), l)) * area
        limit = 2e-3 if name == "discs" else 2e-5  # what the midpoint rule leaves
        np.testing.assert_allclose(m[:, l, k], values @ y, atol=limit * np.abs(m[:, l]).max())


def test_scaling_to_unit_norm_divides_by_the_norm_of_the_bands_kept(x64):
    z, beta = decomposition.separate_directions(4), np.asarray(decomposition.GaussianKernel().zonal(4))
    scaled = IsotropicBasis(decomposition.GaussianKernel(), z, 4)
    np.testing.assert_allclose(scaled.zonal(), beta / np.linalg.norm(beta, axis=1, keepdims=True), rtol=1e-13)
    plain = IsotropicBasis(decomposition.GaussianKernel(), z, 4, unit_norm=False)
    np.testing.assert_allclose(plain.zonal(), beta, rtol=1e-13)


@pytest.mark.parametrize("nested", [False, True], ids=["shared", "nested"])
def test_zonal_harmonics_are_the_rotated_zonal_basis(nested, x64, rng):
    z, c = decomposition.optimized_directions(DEGREE), rng.standard_normal((2, (DEGREE + 1) ** 2))
    ours = IsotropicBasis(decomposition.LegendreKernel(), z, DEGREE, nested=nested)
    theirs = RotatedZonalBasis(z, DEGREE, nested=nested)
    weights = ours.weights(c)
    np.testing.assert_allclose(weights, theirs.weights(c), atol=1e-13)
    np.testing.assert_allclose(ours.coefficients(weights), theirs.coefficients(weights), atol=1e-13)
    w = unit(rng, 6)
    np.testing.assert_allclose(ours.evaluate(weights[0], w), theirs.evaluate(weights[0], w), atol=1e-12)
    bands = truth.band_matrices(z, DEGREE)
    singular = [np.linalg.svd(m[:, : 2 * l + 1] if nested else m, compute_uv=False) for l, m in enumerate(bands)]
    expected = max(s[0] for s in singular) / min(s[-1] for s in singular)
    np.testing.assert_allclose(ours.condition_number(), expected, rtol=1e-10)


@pytest.mark.parametrize("name", ["Gaussian", "Legendre"])
def test_ridge_solves_the_normal_equations(name, x64, rng):
    basis = IsotropicBasis(KERNELS[name](), decomposition.separate_directions(3), 3)
    c, ridge = rng.standard_normal(16), 1e-3
    m = np.asarray(basis.matrix()).reshape(16, -1)
    found = basis.solve(c, ridge=ridge)
    if name == "Gaussian":
        expected = m.T @ np.linalg.solve(m @ m.T + ridge * np.trace(m @ m.T) / 16 * np.eye(16), c)
    else:  # one band after another: a mean eigenvalue of K / (2l+1) each
        scale = np.concatenate([np.full(2 * l + 1, 7 / (2 * l + 1)) for l in range(4)])
        expected = m.T @ np.linalg.solve(m @ m.T + ridge * np.diag(scale), c)
    np.testing.assert_allclose(np.ravel(found.weights), expected, atol=1e-12)
    residual = np.linalg.norm(m @ expected - c) / np.linalg.norm(c)
    np.testing.assert_allclose(found.error, residual, rtol=1e-9)
    assert residual > 1e-5
    np.testing.assert_allclose(found.condition_number, np.linalg.cond(m), rtol=1e-9)


def test_ridge_cures_axes_that_levels_share(rng):
    z, c = decomposition.optimized_directions(7), rng.standard_normal(64).astype(np.float32)
    basis = IsotropicBasis(decomposition.GaussianKernel(), z, 7, nested=True)  # condition 1e7
    with pytest.raises(RuntimeError, match="separate_directions"):
        basis.weights(c)
    with pytest.raises(ValueError, match="separate_directions"):
        basis.solve(c)
    assert basis.solve(c, throw=False).status == Status.ill_conditioned
    found = basis.solve(c, ridge=1e-6)
    assert found.status == Status.ok
    y = truth.scipy_basis(np.asarray(z, float), 7)  # [K, n]
    x, gauss = np.polynomial.legendre.leggauss(200)
    m = np.zeros((64, 8, 15))
    bands = np.repeat(np.arange(8), 2 * np.arange(8) + 1)
    for l in range(8):
        p = np.polynomial.legendre.legvander(x, 7)
        beta = (gauss * np.exp(-(1 - x) * l * l)) @ p * np.sqrt(2 * np.arange(8) + 1)
        pi = np.sqrt(4 * np.pi / (2 * np.arange(8) + 1))
        m[:, l, : 2 * l + 1] = ((beta / np.linalg.norm(beta) * pi)[bands] * y[: 2 * l + 1]).T
    m = m.reshape(64, -1)
    square = m @ m.T
    left = c - square @ np.linalg.solve(square + 1e-6 * np.trace(square) / 64 * np.eye(64), c)
    np.testing.assert_allclose(found.error, np.linalg.norm(left) / np.linalg.norm(c), rtol=2e-2)


def test_residuals_at_every_scale(rng):
    basis = IsotropicBasis(decomposition.GaussianKernel(), decomposition.separate_directions(3), 3)
    c = rng.standard_normal(16)
    m = np.asarray(basis.matrix(), float).reshape(16, -1)
    square = m @ m.T
    left = c - square @ np.linalg.solve(square + 1e-2 * np.trace(square) / 16 * np.eye(16), c)
    expected = np.linalg.norm(left) / np.linalg.norm(c)
    residual = basis.solve((c * np.array([[1], [1e25], [1e-30], [np.nan]])).astype(np.float32), ridge=1e-2).error
    np.testing.assert_allclose(residual, [expected] * 3 + [np.nan], rtol=1e-4)


def test_a_zero_function_has_zero_weights_and_no_residual(x64):
    found = IsotropicBasis(decomposition.GaussianKernel(), decomposition.separate_directions(3), 3).solve(np.zeros(16))
    assert float(found.error) == 0 and np.all(np.asarray(found.weights) == 0)


# --- filtering --------------------------------------------------------------------------------------------------------


@FLOAT32_FIRST
@pytest.mark.parametrize("name", [pytest.param("Legendre", marks=pytest.mark.slow), "Gaussian"])
def test_filtering_is_the_integral_of_signal_times_turned_kernel(name, dtype, rng):
    basis = IsotropicBasis(KERNELS[name](), decomposition.separate_directions(DEGREE), DEGREE)
    c = rng.standard_normal((4, 1, 36)).astype(dtype)
    signal, r = rng.standard_normal((3, 36)).astype(dtype), rotations(rng, 2).astype(dtype)
    got = basis.filter(basis.weights(c), signal, r)
    assert got.shape == (4, 2, 3) and got.dtype == dtype
    theta, weight = np.polynomial.legendre.leggauss(12)
    z, phi = (g.ravel() for g in np.meshgrid(theta, np.arange(24) * np.pi / 12, indexing="ij"))
    w = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
    area = np.repeat(weight, 24) * np.pi / 12
    kernel = truth.scipy_basis(w, DEGREE) @ np.asarray(c, float)[:, 0].T  # [w, 4] in the local frame
    turned = [truth.scipy_basis(w @ a.T, DEGREE) @ signal.T for a in r]
    expected = np.stack([(kernel * area[:, None]).T @ x for x in turned], axis=1)
    limit = 10 * np.finfo(dtype).eps * float(basis.condition_number())
    np.testing.assert_allclose(got, expected, atol=limit * np.abs(expected).max())


def test_axes_that_a_level_does_not_use_stay_out_where_the_condition_is_bad(x64, rng):
    degree = 7  # condition 1e7: the rounding that a solve leaves on unused axes is large
    basis = IsotropicBasis(
        decomposition.GaussianKernel(), decomposition.optimized_directions(degree), degree, nested=True
    )
    c, signal = rng.standard_normal(64), rng.standard_normal(64)
    weights = basis.weights(c)
    assert np.all(np.asarray(weights)[np.arange(15) > 2 * np.arange(8)[:, None]] == 0)
    limit = 1e-15 * float(basis.condition_number()) * np.linalg.norm(c) * np.linalg.norm(signal)
    np.testing.assert_allclose(basis.filter(weights, signal, np.eye(3)), c @ signal, atol=limit)
    np.testing.assert_allclose(
        basis.filter(weights + 1, signal, np.eye(3)),
        basis.filter(jnp.where(weights, weights + 1, 0), signal, np.eye(3)),
        atol=1e-6,
    )


@pytest.mark.parametrize("shared", [pytest.param(True, marks=pytest.mark.slow), False], ids=["shared", "separate"])
def test_lookups_in_filtered_maps_converge_to_filtering(shared, x64, rng):
    z = decomposition.optimized_directions(3) if shared else decomposition.separate_directions(3)
    basis = IsotropicBasis(decomposition.GaussianKernel(), z, 3)
    weights, signal, r = basis.weights(rng.standard_normal(16)), rng.standard_normal((2, 16)), rotations(rng, 40)
    exact = np.asarray(basis.filter(weights, signal, r))
    errors = []
    for height in (32, 128):
        maps = basis.prefilter(signal, height)
        assert maps.shape == (4, height, 2 * height, 2)
        errors.append(np.abs(np.asarray(basis.filter_maps(weights, maps, r)) - exact).max() / np.abs(exact).max())
    assert errors[0] < 3e-2 and errors[1] < errors[0] / 8


# --- derivatives ------------------------------------------------------------------------------------------------------


def test_gradients_match_finite_differences(x64, rng):
    z, c = decomposition.separate_directions(3), rng.standard_normal(16)
    goal, signal, r = rng.standard_normal((4, 7)), rng.standard_normal(16), rotations(rng)

    def losses(z, widths, c, r):
        basis = IsotropicBasis(decomposition.GaussianKernel(widths), z, 3)
        weights = basis.weights(c, ridge=1e-6)
        return jnp.stack([jnp.sum(weights * goal), basis.filter(weights, signal, r), jnp.log(basis.condition_number())])

    arguments = (z, jnp.asarray([0.5, 1.0, 4.0, 9.0]), jnp.asarray(c), jnp.asarray(r))
    step = [rng.standard_normal(a.shape) for a in arguments]
    along = jax.jit(lambda s: losses(*(a + s * d for a, d in zip(arguments, step, strict=True))))
    h = 1e-5
    difference = (along(h) - along(-h)) / (2 * h)
    forward = jax.jit(lambda: jax.jvp(losses, arguments, tuple(jnp.asarray(d) for d in step))[1])()
    np.testing.assert_allclose(forward, difference, rtol=1e-6)
    gradients = jax.jit(jax.jacrev(losses, argnums=(0, 1, 2, 3)))(*arguments)
    reverse = sum(np.reshape(g, (3, -1)) @ np.ravel(d) for g, d in zip(gradients, step, strict=True))
    np.testing.assert_allclose(reverse, difference, rtol=1e-6)


def test_the_condition_number_can_be_lowered_by_gradient(x64):
    z = decomposition.separate_directions(3)

    @jax.jit
    def step(z):
        basis = lambda z: IsotropicBasis(decomposition.GaussianKernel(), z, 3)
        loss, gradient = jax.value_and_grad(lambda z: jnp.log(basis(z).condition_number()))(z)
        return loss, z - 0.02 * gradient / jnp.sqrt(jnp.sum(gradient**2))

    first, z = step(z)
    for _ in range(5):
        last, z = step(z)
    assert last < first - 0.01


# --- bad input --------------------------------------------------------------------------------------------------------


def test_kernels_that_vanish_on_a_band_are_refused(as_user):
    two_sided = decomposition.FunctionKernel(lambda x, l: x ** (4 * l))  # ISD15's Phong as printed
    basis = IsotropicBasis(two_sided, decomposition.separate_directions(3), 3)
    with pytest.raises(RuntimeError, match="All levels of the `kernel` vanish on band 1"):
        basis.weights(np.ones(16))
    nothing = decomposition.FunctionKernel(lambda x, l: 0 * x)
    with pytest.raises(RuntimeError, match="A level of the `kernel` is zero or not finite"):
        IsotropicBasis(nothing, decomposition.separate_directions(1), 1).weights(np.ones(4))


def test_equal_axes_are_refused_by_the_solve(as_user):
    z = np.tile(decomposition.separate_directions(2)[:1, :1], (3, 5, 1))
    with pytest.raises(RuntimeError, match=r"do not span all bands[\s\S]*`ridge` above 0"):
        IsotropicBasis(decomposition.GaussianKernel(), z, 2).weights(np.ones(9))
    with pytest.raises(RuntimeError, match="do not resolve degree 1"):
        IsotropicBasis(decomposition.LegendreKernel(), z, 2).weights(np.ones(9))
    with pytest.raises(RuntimeError, match="vector that is zero or not finite"):
        IsotropicBasis(decomposition.GaussianKernel(), 0 * z, 2).weights(np.ones(9))


def test_bad_shapes_are_refused(as_user):
    z, kernel = decomposition.separate_directions(2), decomposition.GaussianKernel()
    basis = IsotropicBasis(kernel, z, 2)
    for make, message in (
        (lambda: IsotropicBasis(np.exp, z, 2), r"`kernel` must be a kernel.*got ufunc.*FunctionKernel"),
        (lambda: IsotropicBasis(kernel, z[:2], 2), r"\[degree \+ 1, K, 3\] = \[3, K, 3\].*got \[2, 5, 3\]"),
        (lambda: IsotropicBasis(kernel, z[:, :4], 2), r"at least 2\*degree \+ 1 = 5 axes for degree 2; got 4"),
        (lambda: basis.weights(np.ones(4)), "`coefficients` must be of the basis' degree 2"),
        (lambda: basis.weights(np.ones(9), ridge=-1.0), "`ridge` must be finite and >= 0; got -1.0"),
        (lambda: basis.weights(np.ones(9), ridge=np.inf), "`ridge` must be finite and >= 0; got inf"),
        (lambda: basis.coefficients(np.ones((3, 4))), r"`weights` must have shape .*\[..., 3, 5\]; got \[3, 4\]"),
        (lambda: basis.filter(np.ones((3, 5)), np.ones(9), np.ones((2, 3))), r"`rotations` must have shape"),
        (lambda: basis.filter(np.ones((2, 3, 5)), np.ones(9), np.ones((4, 3, 3))), "do not broadcast"),
        (
            lambda: basis.filter_maps(np.ones((3, 5)), np.ones((2, 4, 8)), np.eye(3)),
            "`maps` must come from `prefilter`",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            make()
