import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import harmonics

LOW = {"float32": 1e-4, "float64": 1e-9}


def spikes(degree: int, dtype) -> jnp.ndarray:
    """Two truncated delta functions: strong ringing, mean 1.5 / (4 pi)."""
    directions = jnp.asarray([[0.3, -0.5, 0.81], [-0.2, 0.7, -0.1]], dtype)
    return jnp.asarray([1.0, 0.5], dtype) @ harmonics.sh_basis(directions, degree)


def lowest(c, height: int) -> float:
    with jax.enable_x64(True):
        return float(harmonics.synthesize_map(jnp.asarray(np.asarray(c, np.float64)), height).min())


def test_window_values(dtype):
    l = np.arange(6)
    eps = float(jnp.finfo(dtype).eps)
    hann, lanczos = harmonics.hann_window(5), harmonics.lanczos_window(5)
    assert hann.dtype == lanczos.dtype == dtype
    np.testing.assert_allclose(hann, 0.5 * (1 + np.cos(np.pi * l / 6)), atol=2 * eps)
    np.testing.assert_allclose(lanczos, np.sinc(l / 6), atol=2 * eps)
    np.testing.assert_allclose(
        harmonics.laplacian_window(5, jnp.asarray(0.01, dtype)), 1 / (1 + 0.01 * (l * (l + 1.0)) ** 2), rtol=4 * eps
    )


def test_windows_vanish_from_their_width_on():
    for window in (harmonics.hann_window(6, 4), harmonics.lanczos_window(6, 4)):
        assert window[0] == 1
        assert np.all(window[1:4] > 0)
        assert np.all(window[4:] == 0)


def test_windows_are_differentiable(x64):
    for window in (harmonics.hann_window, harmonics.lanczos_window, harmonics.laplacian_window):
        check_grads(jax.jit(lambda w, window=window: window(4, w)), (jnp.asarray(5.3),), order=1, modes=("fwd", "rev"))


def test_apply_window_repeats_factors_over_orders(dtype, rng):
    c = jnp.asarray(rng.normal(size=(2, 9)), dtype)
    got = harmonics.apply_window(c, jnp.asarray([1, 2, 3], dtype))
    assert got.dtype == dtype
    np.testing.assert_allclose(got, np.asarray(c) * [1, 2, 2, 2, 3, 3, 3, 3, 3])


@pytest.mark.parametrize(
    "degree", (3, pytest.param(1, marks=pytest.mark.slow), pytest.param(12, marks=pytest.mark.slow))
)
def test_dering_reaches_the_floor_and_no_more(dtype, degree):
    c = spikes(degree, dtype)
    mean = float(c[0]) / np.sqrt(4 * np.pi)
    result = harmonics.dering(c, floor=0.01)
    assert result.coefficients.dtype == result.strength.dtype == dtype
    assert result.strength > 0
    # The finest grid misses the minimum by at most a half step: 1e-4 of the mean here.
    got = lowest(result.coefficients, 100 * (degree + 1))
    assert -LOW[dtype.name] < (got - 0.01) / mean < 3e-4
    window = harmonics.laplacian_window(degree, result.strength)
    np.testing.assert_allclose(result.coefficients, harmonics.apply_window(c, window), rtol=1e-5)
    weaker = harmonics.apply_window(c, harmonics.laplacian_window(degree, 0.99 * result.strength))
    assert lowest(weaker, 100 * (degree + 1)) < 0.01


def test_dering_is_exact_where_the_minimum_is_known(dtype):
    """f = 1 + 3 z: the lowest point is the pole -z, where 1 - 3 / (1 + 4 s) = 0."""
    c = jnp.zeros(16, dtype).at[0].set(np.sqrt(4 * np.pi)).at[2].set(3 * np.sqrt(4 * np.pi / 3))
    result = harmonics.dering(c)
    np.testing.assert_allclose(result.strength, 0.5, rtol=LOW[dtype.name])


def test_dering_leaves_what_is_above_the_floor_alone(x64):
    c = jnp.zeros(16).at[:4].set(jnp.asarray([4.0, 0.1, -0.2, 0.3]))
    result = harmonics.dering(c)
    assert result.strength == 0
    np.testing.assert_array_equal(result.coefficients, c)
    gradient = jax.grad(lambda c: harmonics.dering(c).coefficients[3:].sum())(c)
    np.testing.assert_allclose(gradient, np.arange(16) >= 3)


def test_dering_treats_each_expansion_of_a_batch_by_itself(x64):
    c = jnp.stack([spikes(3, np.float64), jnp.zeros(16).at[0].set(1), 2 * spikes(3, np.float64)])[:, None]
    result = harmonics.dering(c)
    assert result.coefficients.shape == (3, 1, 16)
    assert result.strength.shape == (3, 1)
    assert result.strength[1, 0] == 0
    np.testing.assert_allclose(result.strength[0], result.strength[2], rtol=1e-9)
    np.testing.assert_allclose(result.strength[0, 0], harmonics.dering(c[0, 0]).strength, rtol=1e-9)


def test_no_window_helps_a_mean_below_the_floor(dtype):
    c = jnp.zeros(16, dtype).at[0].set(-1).at[1].set(0.1)
    with pytest.raises(Exception, match="above its own mean"):
        harmonics.dering(c)
    result = harmonics.dering(c, throw=False)
    assert result.strength == np.inf
    np.testing.assert_array_equal(result.coefficients, c.at[1].set(0))
    assert bool(result.status == harmonics.WindowStatus.mean_below_floor)
    nan = harmonics.dering(c.at[2].set(np.nan), throw=False)
    assert bool(nan.status == harmonics.WindowStatus.mean_below_floor)


@pytest.mark.slow
def test_derivatives_of_dering_are_those_of_the_implicit_function(x64, rng):
    c = spikes(3, np.float64)
    v = jnp.asarray(rng.normal(size=c.shape))
    both = jax.jit(lambda c, floor: harmonics.dering(c, floor=floor)[:2])
    floor = jnp.asarray(0.01)
    h = 1e-4
    tangents = jax.jvp(both, (c, floor), (v, jnp.asarray(0.02)))[1]
    ahead, behind = both(c + h * v, floor + h * 0.02), both(c - h * v, floor - h * 0.02)
    for tangent, plus, minus in zip(tangents, ahead, behind, strict=True):
        difference = (plus - minus) / (2 * h)
        np.testing.assert_allclose(tangent, difference, atol=1e-5 * float(jnp.max(jnp.abs(difference))))
    gradient = jax.grad(lambda c: both(c, floor)[1])(c)
    forward = jax.jvp(lambda c: both(c, floor)[1], (c,), (v,))[1]
    np.testing.assert_allclose(gradient @ v, forward, rtol=1e-10)


@pytest.mark.slow
def test_jit_and_vmap_agree_with_the_plain_call(x64):
    c = jnp.stack([spikes(3, np.float64), spikes(3, np.float64)[::-1].at[0].set(1)])
    plain = harmonics.dering(c)
    np.testing.assert_allclose(jax.jit(harmonics.dering)(c).strength, plain.strength, rtol=1e-9)
    vmapped = jax.vmap(lambda c: harmonics.dering(c).strength)(c)
    np.testing.assert_allclose(vmapped, plain.strength, rtol=1e-9)


def test_errors_name_the_argument(as_user):
    c = np.ones(4, np.float32)
    with pytest.raises(ValueError, match="`coefficients`"):
        harmonics.dering(np.ones(5, np.float32))
    with pytest.raises(ValueError, match="`floor`"):
        harmonics.dering(c, floor=np.zeros(2, np.float32))
    with pytest.raises(ValueError, match=r"`window` must have shape \[2\]"):
        harmonics.apply_window(c, np.ones(3, np.float32))
    with pytest.raises(ValueError, match="`degree`"):
        harmonics.hann_window(-1)
    with pytest.raises(ValueError, match="`width`"):
        harmonics.lanczos_window(3, np.ones(2, np.float32))
    with pytest.raises(ValueError, match="`strength`"):
        harmonics.laplacian_window(3, "strong")
