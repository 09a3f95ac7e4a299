import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import Status, harmonics
from tests.harmonics.test_transform import basis_of_map
from tests.truth import scipy_basis

LOW = {"float32": 1e-4, "float64": 1e-9}


def spikes(degree: int) -> np.ndarray:
    """Two truncated delta functions: strong ringing, mean 1.5 / (4 pi)."""
    return np.array([1.0, 0.5]) @ scipy_basis([[0.3, -0.5, 0.81], [-0.2, 0.7, -0.1]], degree)


def lowest(c, height: int) -> float:
    """The least value on a map of texel centres, by SciPy's harmonics along rows and columns."""
    return float(np.min(basis_of_map(height, 2 * height, math.isqrt(len(c)) - 1) @ np.asarray(c, float)))


def test_window_values(dtype):
    l = np.arange(7)
    eps = float(jnp.finfo(dtype).eps)
    hann = harmonics.hann_window(6)
    assert hann.dtype == dtype
    np.testing.assert_allclose(hann, 0.5 * (1 + np.cos(np.pi * l / 7)), atol=2 * eps)
    np.testing.assert_allclose(
        harmonics.laplacian_window(6, np.asarray(0.01, dtype)), 1 / (1 + 0.01 * (l * (l + 1.0)) ** 2), rtol=4 * eps
    )
    hann = harmonics.hann_window(6, 4)  # zero from its width on
    np.testing.assert_allclose(hann, np.where(l < 4, 0.5 * (1 + np.cos(np.pi * l / 4)), 0), atol=2 * eps)


def test_widths_and_strengths_that_are_none_are_refused(as_user):
    for width in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="^`width` must be > 0.$"):
            harmonics.hann_window(4, width)
    for strength in (-1e-3, np.nan):
        with pytest.raises(ValueError, match="^`strength` must be >= 0.$"):
            harmonics.laplacian_window(4, strength)


def test_windows_are_differentiable(x64):
    """By differences of the closed forms above, in longdouble."""
    at, h, l = np.longdouble(5.3), np.longdouble(1e-6), np.arange(5)
    forms = {
        harmonics.hann_window: lambda w: (1 + np.cos(np.pi * l / w)) / 2,
        harmonics.laplacian_window: lambda w: 1 / (1 + w * (l * (l + 1)) ** 2),
    }
    for window, form in forms.items():
        got = jax.jacfwd(lambda w, window=window: window(4, w))(jnp.asarray(float(at)))
        np.testing.assert_allclose(got, (form(at + h) - form(at - h)) / (2 * h), atol=1e-11)


def test_apply_window_repeats_factors_over_orders(dtype, rng):
    c = jnp.asarray(rng.normal(size=(2, 9)), dtype)
    got = harmonics.apply_window(c, jnp.asarray([1, 2, 3], dtype))
    assert got.dtype == dtype
    np.testing.assert_allclose(got, np.asarray(c) * [1, 2, 2, 2, 3, 3, 3, 3, 3])


FLOOR = 0.01


def expansions(dtype) -> np.ndarray:
    """Degree 3: two spikes; 1 + FLOOR + 3 z; what is above the floor; a mean below it; what is not finite."""
    c = np.zeros((5, 16))
    c[0] = spikes(3)
    c[1, [0, 2]] = (1 + FLOOR) * np.sqrt(4 * np.pi), 3 * np.sqrt(4 * np.pi / 3)
    c[2, :4] = 4.0, 0.1, -0.2, 0.3
    c[3, :2] = -1, 0.1
    c[4, :3] = 1, 0, np.nan
    return c.astype(dtype)


def test_dering_takes_each_expansion_by_itself(dtype):
    c = expansions(dtype)
    result = harmonics.dering(c, floor=FLOOR, throw=False)
    got, strength = (np.asarray(x) for x in result[:2])
    assert got.dtype == strength.dtype == dtype
    assert bool(result.status == Status.mean_below_floor)
    # of the spikes the floor is reached, and no more; the finest grid misses the minimum by half a step: 3e-4
    mean = float(c[0, 0]) / np.sqrt(4 * np.pi)
    assert strength[0] > 0 and -LOW[dtype.name] < (lowest(got[0], 400) - FLOOR) / mean < 3e-4
    l = np.repeat(np.arange(4.0), 2 * np.arange(4) + 1)
    window = lambda s: 1 / (1 + s * (l * (l + 1)) ** 2)
    np.testing.assert_allclose(got[0], c[0] * window(strength[0]), rtol=4 * np.finfo(dtype).eps)
    assert lowest(c[0] * window(0.99 * strength[0]), 400) < FLOOR
    # the lowest point of the second is the pole -z, where 1 - 3 / (1 + 4 s) = 0
    np.testing.assert_allclose(strength[1], 0.5, rtol=LOW[dtype.name])
    # the third stays, and no window helps the last two
    assert strength[2] == 0
    np.testing.assert_array_equal(got[2], c[2])
    np.testing.assert_array_equal(strength[3:], np.inf)
    np.testing.assert_array_equal(got[3:], np.where(np.arange(16) == 0, c[3:], 0))
    with pytest.raises(ValueError, match="^No window lifts an expansion above its own mean"):
        harmonics.dering(c, floor=FLOOR)
    good = harmonics.dering(np.repeat(c[2:3], 5, axis=0), floor=FLOOR)
    assert bool(good.status == Status.ok)
    np.testing.assert_array_equal(good.strength, np.zeros(5))


@pytest.mark.slow
@pytest.mark.parametrize("degree", (1, 12))
def test_dering_reaches_the_floor_and_no_more(dtype, degree):
    c = spikes(degree).astype(dtype)
    mean = float(c[0]) / np.sqrt(4 * np.pi)
    result = harmonics.dering(c, floor=FLOOR)
    got = lowest(result.coefficients, 100 * (degree + 1))
    assert -LOW[dtype.name] < (got - FLOOR) / mean < 3e-4
    weaker = harmonics.apply_window(c, harmonics.laplacian_window(degree, 0.99 * result.strength))
    assert lowest(weaker, 100 * (degree + 1)) < FLOOR


@pytest.mark.slow
def test_a_mean_below_the_floor_is_an_error_of_the_gradient_too(x64):
    gradient = jax.jit(jax.grad(lambda c: harmonics.dering(c, floor=FLOOR).coefficients.sum()))
    with pytest.raises(RuntimeError, match="above its own mean"):
        jax.block_until_ready(gradient(jnp.asarray(expansions(float)[3])))


@pytest.mark.slow
def test_what_is_above_the_floor_has_the_gradient_of_the_identity(x64):
    gradient = jax.grad(lambda c: harmonics.dering(c).coefficients[3:].sum())(jnp.asarray(expansions(float)[2]))
    np.testing.assert_allclose(gradient, np.arange(16) >= 3)


@pytest.mark.slow
def test_derivatives_of_dering_are_those_of_the_implicit_function(x64, rng):
    c = jnp.asarray(spikes(3))
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
    c = jnp.stack([jnp.asarray(spikes(3)), jnp.asarray(spikes(3))[::-1].at[0].set(1)])
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
        harmonics.hann_window(3, np.ones(2, np.float32))
    with pytest.raises(ValueError, match="`strength`"):
        harmonics.laplacian_window(3, "strong")
