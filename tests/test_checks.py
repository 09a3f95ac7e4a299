"""What callers pass wrongly is named, at once and in one line where it is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import _checks, harmonics


def test_either_byte_order_is_read(x64):
    for dtype in (">f4", "<f4", ">f8", "<f8", ">i2"):
        got = _checks.real_array("x", np.arange(3).astype(dtype))
        assert got.dtype == (np.float64 if dtype[1:] in ("f8", "i2") else np.float32)
        np.testing.assert_array_equal(got, [0, 1, 2])
    c = np.array([1, 2j, 3, 4])
    np.testing.assert_array_equal(
        harmonics.convert(c.astype(">c16"), "scipy", "shisd"), harmonics.convert(c, "scipy", "shisd")
    )


@pytest.mark.parametrize(
    ("value", "came"),
    [
        (np.ones(3, np.longdouble), f"dtype {np.dtype(np.longdouble)}. Pass float32 or float64"),
        (np.ones(3, np.float16), "dtype float16. Pass float32 or float64"),
        (np.ones(3, ">f2"), "dtype float16. Pass float32 or float64"),
        (np.ones(3, complex), "dtype complex"),
        (np.ones(3, bool), "dtype bool"),
        (np.array(["a"]), "dtype <U1"),
        ("red", "str"),
        (None, "NoneType"),
    ],
)
def test_arrays_that_are_not_real_numbers_are_named(as_user, value, came):
    with pytest.raises(ValueError, match=rf"`x` must (be an array of|hold) real numbers; got {came}"):
        _checks.real_array("x", value)


@pytest.mark.parametrize(
    ("value", "came"), [(3.0, "3.0"), (np.float32(3), r"np.float32\(3.0\)"), ("3", "'3'"), (np.ones(2), "ndarray")]
)
def test_integers_that_are_none_are_shown(value, came):
    with pytest.raises(ValueError, match=rf"^`degree` must be a Python integer; got {came}\.$"):
        _checks.degree(value)


def test_integers_that_are_traced_are_told_apart():
    with pytest.raises(ValueError, match="`degree` must be a Python integer known while tracing"):
        jax.jit(_checks.degree)(3)


def test_values_are_judged_at_once_where_they_are_known():
    ones = jnp.ones(2)
    assert _checks.require(ones, ones > 0, "no") is ones
    with pytest.raises(ValueError, match="^`x` must be > 1.$"):
        _checks.require(ones, np.array([True, False]), "`x` must be > 1.")
    checked = jax.jit(lambda x: _checks.require(x, x > 0, "`x` must be > 0."))
    np.testing.assert_array_equal(checked(ones), ones)
    with pytest.raises(Exception, match="`x` must be > 0."):
        checked(-ones).block_until_ready()
