"""Rotated zonal harmonics: exact inverse maps, least norm, conditioning, derivatives, refusals."""

import logging

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import decomposition
from shisd.decomposition import RotatedZonalBasis
from shisd.decomposition._directions import conditioning_loss, low_discrepancy_directions, random_directions
from tests import truth
from tests.marks import FLOAT32_FIRST

SETS = {
    "fibonacci": lambda l: decomposition.fibonacci_directions(2 * l + 1),
    "low discrepancy": lambda l: low_discrepancy_directions(2 * l + 1),
    "random": lambda l: random_directions(2 * l + 1, jax.random.key(l)),
    "optimized": decomposition.optimized_directions,
    "more than needed": lambda l: decomposition.fibonacci_directions(3 * l + 4),
}


def unit(rng, *shape):
    z = rng.standard_normal((*shape, 3))
    return z / np.linalg.norm(z, axis=-1, keepdims=True)


# compiled once per degree, number of axes and dtype: eager tests would spend their time on compiling single operations
weights_of = eqx.filter_jit(RotatedZonalBasis.weights)
coefficients_of = eqx.filter_jit(RotatedZonalBasis.coefficients)
evaluate_of = eqx.filter_jit(RotatedZonalBasis.evaluate)
conditions_of = eqx.filter_jit(RotatedZonalBasis.condition_numbers)


def band(array, l):
    return np.asarray(array, np.float64)[..., l * l : (l + 1) ** 2]


@eqx.filter_jit
def there_and_back(basis, coefficients):
    weights = basis.weights(coefficients)
    back = basis.coefficients(weights)
    return weights, back, basis.weights(back), basis.condition_numbers()


@FLOAT32_FIRST
@pytest.mark.parametrize("nested", [False, True], ids=["shared", "nested"])
@pytest.mark.parametrize("degree", [0, 4, 8, pytest.param(20, marks=pytest.mark.slow)])
def test_round_trips_are_as_exact_as_the_condition_allows(degree, nested, dtype, rng):
    norms = lambda a: np.linalg.norm(np.asarray(a, np.float64), axis=-1)
    eps = np.finfo(dtype).eps
    for name, make in SETS.items():
        basis = RotatedZonalBasis(make(degree), degree, nested=nested)
        c = rng.standard_normal((5, (degree + 1) ** 2)).astype(dtype)
        w, back, again, conditions = (np.asarray(a) for a in there_and_back(basis, c))
        assert w.dtype == back.dtype == dtype
        assert np.all(norms(again - w) <= 10 * eps * conditions * norms(w)), f"{name}: weights -> weights"
        for l in range(degree + 1):
            limit = 10 * eps * norms(w)[:, l] * np.sqrt(basis.size)
            assert np.all(norms(band(back, l) - band(c, l)) <= limit), f"{name}: coefficients of band {l}"


@pytest.mark.parametrize("nested", [False, True], ids=["shared", "nested"])
def test_any_weights_survive_where_a_band_is_square(nested, x64, rng):
    basis = RotatedZonalBasis(decomposition.optimized_directions(5), 5, nested=nested)
    w = np.where(np.arange(11) <= 2 * np.arange(6)[:, None], rng.standard_normal((6, 11)), 0)
    again = np.asarray(weights_of(basis, coefficients_of(basis, w)))
    bands = range(6) if nested else [5]
    for l in bands:
        np.testing.assert_allclose(again[l], w[l], atol=1e-13)


@pytest.mark.parametrize("name", SETS)
def test_weights_are_those_of_least_norm(name, x64, rng):
    degree = 6
    z, c = SETS[name](degree), rng.standard_normal((4, 49))
    w = np.asarray(weights_of(RotatedZonalBasis(z, degree), c))
    for l, m in enumerate(truth.band_matrices(z, degree)):
        expected = band(c, l) @ np.linalg.pinv(m).T
        np.testing.assert_allclose(w[:, l], expected, atol=1e-14 * np.linalg.cond(m) ** 2)


def test_nested_weights_solve_the_prefix(x64, rng):
    degree = 6
    z, c = decomposition.optimized_directions(degree), rng.standard_normal(49)
    w = np.asarray(weights_of(RotatedZonalBasis(z, degree, nested=True), c))
    for l, m in enumerate(truth.band_matrices(z, degree)):
        used = slice(2 * l + 1)
        np.testing.assert_allclose(w[l, used], np.linalg.solve(m[:, used], band(c, l)), rtol=1e-11, atol=1e-12)
        assert np.all(w[l, 2 * l + 1 :] == 0)


@pytest.mark.parametrize("nested", [False, True], ids=["shared", "nested"])
@pytest.mark.parametrize("degree", [0, 1, 8, pytest.param(20, marks=pytest.mark.slow)])
def test_evaluation_equals_the_expansion(degree, nested, dtype, rng):
    basis = RotatedZonalBasis(decomposition.optimized_directions(degree), degree, nested=nested)
    c, w = rng.standard_normal((degree + 1) ** 2).astype(dtype), unit(rng, 3, 7).astype(dtype)
    w[0, 0] = [0, 0, 1]
    w[0, 1] = [0, 0, -1]
    weights = weights_of(basis, c)
    got = evaluate_of(basis, weights, w)
    assert got.shape == (3, 7) and got.dtype == dtype
    expected = truth.scipy_basis(np.reshape(w, (-1, 3)).astype(np.float64), degree) @ c
    scale = np.sqrt((2 * degree + 1) / (4 * np.pi)) * np.abs(np.asarray(weights)).sum()
    np.testing.assert_allclose(np.ravel(got), expected, atol=10 * np.finfo(dtype).eps * scale)


def test_evaluation_at_degree_32_in_float32(rng):
    basis = RotatedZonalBasis(decomposition.optimized_directions(32), 32)
    weights, w = rng.standard_normal((33, 65)).astype(np.float32), unit(rng, 50).astype(np.float32)
    got = np.asarray(evaluate_of(basis, weights, w))
    x = w.astype(np.float64) @ np.asarray(basis.directions, np.float64).T
    norms = np.sqrt((2 * np.arange(33) + 1) / (4 * np.pi))
    expected = sum(np.polynomial.legendre.legval(x[:, k], norms * weights[:, k]) for k in range(65))
    np.testing.assert_allclose(got, expected, atol=3e-6 * np.abs(expected).max() * 10)


def test_nested_basis_ignores_weights_outside_its_prefixes(x64, rng):
    basis = RotatedZonalBasis(decomposition.optimized_directions(3), 3, nested=True)
    w, at = rng.standard_normal((4, 7)), unit(rng, 5)
    c = coefficients_of(basis, w)
    np.testing.assert_allclose(evaluate_of(basis, w, at), truth.scipy_basis(at, 3) @ np.asarray(c), atol=1e-13)


def test_rotating_the_axes_rotates_the_function(x64, rng):
    rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    z, w, at = decomposition.optimized_directions(5), rng.standard_normal((6, 11)), unit(rng, 9)
    plain, turned = RotatedZonalBasis(z, 5), RotatedZonalBasis(z @ rotation.T, 5)
    np.testing.assert_allclose(evaluate_of(turned, w, at), evaluate_of(plain, w, at @ rotation), atol=1e-13)
    np.testing.assert_allclose(conditions_of(turned), conditions_of(plain), rtol=1e-12)
    np.testing.assert_allclose(
        truth.scipy_basis(at, 5) @ np.asarray(coefficients_of(turned, w)), evaluate_of(turned, w, at), atol=1e-13
    )


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("nested", [False, True], ids=["shared", "nested"])
def test_condition_numbers_agree_with_numpy(name, nested, x64):
    z = SETS[name](7)
    got = conditions_of(RotatedZonalBasis(z, 7, nested=nested))
    np.testing.assert_allclose(got, truth.conditions(z, 7, nested), rtol=1e-9)


def test_axes_of_any_length_are_normalised_and_opposite_axes_serve_alike(x64, rng):
    z, c = np.array(decomposition.optimized_directions(4)), rng.standard_normal(25)
    basis = RotatedZonalBasis(z, 4)
    scaled = RotatedZonalBasis(z * rng.uniform(1e-3, 1e3, (9, 1)), 4)
    np.testing.assert_allclose(scaled.directions, basis.directions, atol=1e-15)
    flipped = RotatedZonalBasis(z * np.where(np.arange(9) % 2, 1.0, -1.0)[:, None], 4)
    np.testing.assert_allclose(conditions_of(flipped), conditions_of(basis), rtol=1e-12)
    signs = np.where(np.arange(9) % 2, 1.0, -1.0) ** np.arange(5)[:, None]
    np.testing.assert_allclose(weights_of(flipped, c), signs * np.asarray(weights_of(basis, c)), atol=1e-13)


# --- batches, jit, precision ------------------------------------------------------------------------------------------


def test_batches_equal_loops_and_vmap(x64, rng):
    basis = RotatedZonalBasis(decomposition.optimized_directions(3), 3)
    c, at = jnp.asarray(rng.standard_normal((2, 3, 16))), jnp.asarray(unit(rng, 2, 3))
    same = lambda a, b: np.testing.assert_allclose(a, b, atol=1e-14)
    each = lambda method: eqx.filter_jit(eqx.filter_vmap(eqx.filter_vmap(method)))
    w = weights_of(basis, c)
    assert w.shape == (2, 3, 4, 7)
    same(w, [[weights_of(basis, c[i, j]) for j in range(3)] for i in range(2)])
    same(each(basis.weights)(c), w)
    same(each(basis.coefficients)(w), coefficients_of(basis, w))
    values = evaluate_of(basis, w, at)
    assert values.shape == (2, 3)
    same(each(basis.evaluate)(w, at), values)
    same(evaluate_of(basis, w, at[0])[1], evaluate_of(basis, w[1], at[0]))  # batches broadcast
    assert weights_of(basis, c[:0]).shape == (0, 3, 4, 7)


def test_sets_of_axes_can_be_vmapped(x64, rng):
    sets = jnp.stack([decomposition.fibonacci_directions(7), low_discrepancy_directions(7)])
    c = jnp.asarray(rng.standard_normal(16))
    got = jax.jit(jax.vmap(lambda z: RotatedZonalBasis(z, 3).weights(c)))(sets)
    for z, w in zip(sets, got, strict=True):
        np.testing.assert_allclose(w, weights_of(RotatedZonalBasis(z, 3), c), atol=1e-12)


@FLOAT32_FIRST
def test_jit_equals_eager_and_compiles_once(dtype, rng):
    z = decomposition.optimized_directions(3)
    c, at = rng.standard_normal(16).astype(dtype), unit(rng, 5).astype(dtype)

    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def run(basis, c, at):
        w = basis.weights(c)
        return w, basis.coefficients(w), basis.evaluate(w, at), basis.condition_numbers()

    for axes in (z, z[::-1], -z):
        basis = RotatedZonalBasis(axes, 3)
        w = basis.weights(c)
        eager = w, basis.coefficients(w), basis.evaluate(w, at), basis.condition_numbers()
        for a, b in zip(run(basis, c, at), eager, strict=True):
            assert a.dtype == dtype
            np.testing.assert_allclose(a, b, atol=30 * np.finfo(dtype).eps, rtol=30 * np.finfo(dtype).eps)


def test_float32_axes_keep_their_precision_where_x64_is_on(x64, as_user):
    z = decomposition.optimized_directions(2, dtype=np.float32)
    plane = circle(5) @ np.linalg.qr([[1, 2, 3], [2, 1, -1], [0, 1, 1.0]])[0]
    for dtype in (np.float32, np.float64):  # of the coefficients
        assert weights_of(RotatedZonalBasis(z, 2), np.ones(9, dtype)).dtype == dtype
        for singular in (plane, np.concatenate([z[:1], z[:4]])):
            with pytest.raises(RuntimeError, match="do not resolve degree"):
                weights_of(RotatedZonalBasis(singular.astype(np.float32), 2), np.ones(9, dtype))


def test_methods_compile_once_and_jit_takes_them(rng, caplog):
    z, c = decomposition.optimized_directions(2), rng.standard_normal(9).astype(np.float32)
    basis, gaussian = RotatedZonalBasis(z, 2), decomposition.GaussianKernel()
    few = decomposition.GaussianLobes(z, np.ones(5, np.float32), np.ones(5, np.float32))
    weights = jax.jit(basis.weights)(c)
    np.testing.assert_allclose(weights, basis.weights(c), atol=1e-6)
    calls = (
        lambda: basis.weights(c),
        basis.condition_numbers,
        lambda: basis.coefficients(weights),
        lambda: basis.evaluate(weights, z),
        lambda: few.coefficients(2),
        lambda: decomposition.ZonalLobes(z, weights).evaluate(z),
        lambda: conditioning_loss(z, 2),
        lambda: gaussian.zonal(2),
        lambda: gaussian(c, 1),
        decomposition.IsotropicBasis(gaussian, decomposition.separate_directions(1), 1).matrix,
    )
    for call in calls:
        call()
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        for call in calls:
            call()
    assert not [record.message for record in caplog.records if "ompil" in record.message]


# --- derivatives ------------------------------------------------------------------------------------------------------


def test_derivatives_of_every_method(x64, rng):
    z = low_discrepancy_directions(6)
    c, at = jnp.asarray(rng.standard_normal(9)), jnp.asarray(unit(rng, 4))
    fixed = jnp.asarray(rng.standard_normal((3, 6)))

    @jax.jit
    def everything(z, c, fixed, at):
        basis = RotatedZonalBasis(z, 2)
        conditions = basis.condition_numbers()[1:]
        return basis.weights(c), basis.coefficients(fixed), basis.evaluate(fixed, at), conditions

    check_grads(everything, (z, c, fixed, at), order=1, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["weights", "evaluate"])
def test_second_derivatives(method, x64, rng):
    z = low_discrepancy_directions(6)
    c, at = jnp.asarray(rng.standard_normal(9)), jnp.asarray(unit(rng, 4))
    mixed = jnp.asarray(rng.standard_normal((3, 6)))

    def loss(z, c, at):
        basis = RotatedZonalBasis(z, 2)
        return jnp.sum(mixed * basis.weights(c)) if method == "weights" else jnp.sum(basis.evaluate(mixed, at) ** 2)

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))
    check_grads(gradient, (z, c, at), order=1, modes=("fwd", "rev"), atol=1e-5, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [4, 12])
def test_derivatives_of_weights_and_conditions(degree, x64, rng):
    z, c = decomposition.optimized_directions(degree), jnp.asarray(rng.standard_normal((degree + 1) ** 2))
    weights = jax.jit(lambda z, c: RotatedZonalBasis(z, degree).weights(c))
    check_grads(weights, (z, c), order=1, modes=("fwd", "rev"), atol=1e-5, rtol=1e-5)
    start = decomposition.fibonacci_directions(2 * degree + 1)
    conditions = jax.jit(lambda z: jnp.log(RotatedZonalBasis(z, degree).condition_numbers()[1:]))
    check_grads(conditions, (start,), order=1, modes=("fwd", "rev"), atol=1e-3, rtol=1e-3)


def test_a_basis_changed_by_gradient_steps_stays_consistent(x64, rng):
    # the function does not depend on the axes: every derivative of evaluate(weights(c)) in them is zero
    basis = RotatedZonalBasis(decomposition.optimized_directions(3), 3)
    basis = eqx.tree_at(lambda b: b.directions, basis, 1.3 * basis.directions)  # off the sphere
    c, at = rng.standard_normal(16), unit(rng, 6)
    loss = lambda b: jnp.sum(b.evaluate(b.weights(c), at) ** 2)
    value, gradient = eqx.filter_jit(eqx.filter_value_and_grad(loss))(basis)
    np.testing.assert_allclose(value, np.sum((truth.scipy_basis(at, 3) @ c) ** 2), rtol=1e-12)
    np.testing.assert_allclose(gradient.directions, np.zeros((7, 3)), atol=1e-12 * value)


@pytest.mark.parametrize("nested", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["shared", "nested"])
def test_axes_at_the_poles_are_ordinary(nested, x64, rng):
    z = np.array(low_discrepancy_directions(6))
    z[0], z[5] = [0, 0, 1], [0, 0, -1]  # one axis, so five remain
    c = jnp.asarray(rng.standard_normal(9))
    weights = jax.jit(lambda z: RotatedZonalBasis(z, 2, nested=nested).weights(c))
    check_grads(weights, (jnp.asarray(z),), order=1, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6)


# --- refusals ---------------------------------------------------------------------------------------------------------


def circle(count, height=0.0):
    phi = 2 * np.pi * np.arange(count) / count + 0.1
    return np.stack([np.cos(phi), np.sin(phi), np.full(count, height)], axis=-1)


def spread(count, **replaced):
    z = np.array(decomposition.fibonacci_directions(count))
    for key, value in replaced.items():
        z[int(key[1:])] = value if value is not None else z[0]
    return z


SINGULAR = {
    "two equal axes": lambda l: spread(2 * l + 1, _1=None),
    "two opposite axes": lambda l: np.concatenate([-spread(2 * l + 1)[-1:], spread(2 * l + 1)[1:]]),
    "all in a horizontal plane": lambda l: circle(2 * l + 1),
    "all in a tilted plane": lambda l: circle(2 * l + 1) @ np.linalg.qr([[1, 2, 3], [2, 1, -1], [0, 1, 1.0]])[0],
}


@pytest.mark.parametrize("name", SINGULAR)
@pytest.mark.parametrize("degree", [1, 4, pytest.param(20, marks=pytest.mark.slow)])
def test_singular_sets_are_refused_with_the_band(name, degree, dtype, as_user):
    z = SINGULAR[name](degree).astype(dtype)
    basis = RotatedZonalBasis(z, degree)
    worst = degree if "two" in name else 1
    with pytest.raises(RuntimeError, match=rf"do not resolve degree {worst}:[\s\S]*optimized_directions"):
        jax.block_until_ready(weights_of(basis, jnp.zeros((degree + 1) ** 2, dtype)))
    assert not np.all(np.asarray(conditions_of(basis)) < 0.01 / np.finfo(dtype).eps)


def test_axes_on_the_cone_of_a_zero_are_refused(dtype, as_user):
    # the cosine to the cone's axis is 1 / sqrt(3), where P_2 = 0: the row m = 0 of M_2 vanishes
    z = circle(5, 1 / np.sqrt(2)).astype(dtype)
    with pytest.raises(RuntimeError, match=r"do not resolve degree 2: [\s\S]*on a cone"):
        jax.block_until_ready(weights_of(RotatedZonalBasis(z, 2), jnp.zeros(9, dtype)))


@pytest.mark.parametrize("transform", ["jit", "grad", "vmap"])
def test_refusals_work_under_transformations(transform, x64, as_user):
    z = jnp.asarray(SINGULAR["two equal axes"](2))
    loss = lambda z, c: jnp.sum(RotatedZonalBasis(z, 2).weights(c))
    call = {"jit": loss, "grad": jax.grad(loss), "vmap": jax.vmap(loss, (None, 0))}[transform]
    with pytest.raises(RuntimeError, match="do not resolve degree 2"):
        jax.block_until_ready(jax.jit(call)(z, jnp.ones((3, 9) if transform == "vmap" else 9)))


def test_refusals_are_there_where_only_the_gradient_is_used(x64, as_user):
    z = jnp.asarray(SINGULAR["two equal axes"](2))
    with pytest.raises(RuntimeError, match="do not resolve degree 2"):  # linear: its gradient needs no value
        jax.block_until_ready(jax.jit(jax.grad(lambda c: jnp.sum(RotatedZonalBasis(z, 2).weights(c))))(jnp.ones(9)))


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
@pytest.mark.parametrize("method", ["weights", "coefficients", "evaluate", "condition_numbers"])
def test_zero_and_non_finite_axes_are_refused_by_every_method(bad, method, as_user):
    z = np.array(decomposition.fibonacci_directions(3))
    z[1] = bad
    basis = RotatedZonalBasis(z, 1)
    call = {
        "weights": lambda: weights_of(basis, jnp.ones(4)),
        "coefficients": lambda: coefficients_of(basis, jnp.ones((2, 3))),
        "evaluate": lambda: evaluate_of(basis, jnp.ones((2, 3)), jnp.ones(3)),
        "condition_numbers": lambda: conditions_of(basis),
    }[method]
    with pytest.raises(RuntimeError, match="vector that is zero or not finite"):
        jax.block_until_ready(call())


def test_static_problems_are_value_errors(as_user):
    z = decomposition.fibonacci_directions(9)
    for arguments, message in (
        ((z, -1), "`degree` must be >= 0; got -1"),
        ((z, 2.0), "`degree` must be a Python integer"),
        ((z, True), "`degree` must be an integer"),
        ((z[:8], 4), r"at least 2\*degree \+ 1 = 9 axes for degree 4; got 8.*optimized_directions"),
        ((z[0], 0), r"must have shape \[K, 3\]; got \[3\]"),
        ((z[None], 0), r"must have shape \[K, 3\]; got \[1, 9, 3\]"),
        ((z[:, :2], 0), r"must have shape \[\.\.\., 3\]"),
        ((np.ones((3, 3)) + 1j, 0), "must hold real numbers"),
        (("axes", 0), "must be an array of real numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            RotatedZonalBasis(*arguments)
    basis = RotatedZonalBasis(z, 4)
    assert basis.size == 9 and basis.degree == 4 and not basis.nested
    with pytest.raises(ValueError, match=r"basis' degree 4, 25 numbers.*got \[16\], degree 3"):
        basis.weights(jnp.ones(16))
    with pytest.raises(ValueError, match=r"\(degree \+ 1\)\*\*2"):
        basis.weights(jnp.ones(24))
    for method in (basis.coefficients, lambda w: basis.evaluate(w, z)):
        with pytest.raises(ValueError, match=r"\[\.\.\., degree \+ 1, K\] = \[\.\.\., 5, 9\]; got \[9, 5\]"):
            method(jnp.ones((9, 5)))


def test_barely_resolved_sets_pass_and_say_so_by_their_condition(dtype, rng):
    z = spread(5)
    z[1] = z[0] + 3e-2 * np.array([1, -1, 0])
    basis = RotatedZonalBasis(z.astype(dtype), 2)
    conditions = np.asarray(conditions_of(basis))
    assert 30 < conditions[2] < 3000
    assert np.all(np.isfinite(np.asarray(weights_of(basis, rng.standard_normal(9).astype(dtype)))))
