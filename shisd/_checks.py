"""Checks of what callers pass: each error names the argument, what came and what to pass.

Shapes, types and static arguments are known while tracing, so these checks cost nothing at run time.
"""

import math
import numbers
import operator
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from shisd._typing import Array, ArrayLike

T = TypeVar("T")


def any_array(name: str, value: ArrayLike) -> Array:
    """`value` as a JAX array of any dtype that JAX has, from either byte order."""
    came = type(value).__name__
    if isinstance(value, np.ndarray | np.generic):
        came = f"dtype {value.dtype}"
        if not value.dtype.isnative:
            value = value.astype(value.dtype.newbyteorder("="))
    try:
        return jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be an array of real numbers; got {came}. Pass float32 or float64.") from error


def real_array(name: str, value: ArrayLike) -> Array:
    """`value` as a floating JAX array: float32 and float64 stay, integers become floats."""
    array = any_array(name, value)
    if array.dtype in (jnp.float32, jnp.float64):
        return array
    if jnp.issubdtype(array.dtype, jnp.integer) and not jnp.issubdtype(array.dtype, jnp.bool_):
        return array.astype(float)
    raise ValueError(f"`{name}` must hold real numbers; got dtype {array.dtype}. Pass float32 or float64.")


def scalar(name: str, value: ArrayLike) -> Array:
    """`value` as one floating number."""
    array = real_array(name, value)
    if array.ndim:
        raise ValueError(f"`{name}` must be a scalar; got shape {list(array.shape)}. Batch it with jax.vmap.")
    return array


def colour(name: str, value: ArrayLike) -> Array:
    """`value` as one floating number for all colours, or one for each."""
    array = real_array(name, value)
    if array.ndim > 1:
        raise ValueError(f"`{name}` must be a scalar or [colour]; got shape {list(array.shape)}.")
    return array


def vectors(name: str, value: ArrayLike) -> Array:
    """`value` as floating vectors [..., 3]."""
    array = real_array(name, value)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(f"`{name}` must have shape [..., 3]; got {list(array.shape)}.")
    return array


def matrix(name: str, value: ArrayLike) -> Array:
    """`value` as one floating [3, 3] matrix."""
    array = real_array(name, value)
    if array.shape != (3, 3):
        raise ValueError(f"`{name}` must have shape [3, 3]; got {list(array.shape)}. Batch it with jax.vmap.")
    return array


def coefficients(name: str, value: ArrayLike) -> tuple[Array, int]:
    """`value` as floating SH coefficients [..., (L+1)^2], and the degree L."""
    array = real_array(name, value)
    size = array.shape[-1] if array.ndim else 0
    if not is_square(size):
        hint = " Colours come first: pass its transpose." if array.ndim == 2 and is_square(array.shape[0]) else ""
        raise ValueError(
            f"`{name}` must have (degree + 1)**2 coefficients on its last axis; got {list(array.shape)}.{hint}"
        )
    return array, degree_of(size)


def is_square(size: int) -> bool:
    return size > 0 and math.isqrt(size) ** 2 == size


def expansion(name: str, value: ArrayLike) -> tuple[Array, int]:
    """`value` as the floating coefficients [n] or [colour, n] of one function of direction, and the degree."""
    c, degree = coefficients(name, value)
    if c.ndim > 2:
        raise ValueError(f"`{name}` must have shape [n] or [colour, n]; got {list(c.shape)}.")
    return c, degree


def degree_of(size: int) -> int:
    """The degree L of (L+1)^2 coefficients."""
    return math.isqrt(size) - 1


def outline(name: str, value: ArrayLike, *, many: bool = False) -> Array:
    """`value` as the floating points [S, 3] of a polygon, or [..., S, 3] of `many`."""
    array = vectors(name, value)
    if array.ndim < 2 or (array.ndim > 2 and not many) or array.shape[-2] < 3:
        form = "[..., S, 3]" if many else "[S, 3]"
        raise ValueError(f"`{name}` must have shape {form} with at least 3 points; got {list(array.shape)}.")
    return array


def integer(name: str, value: object, minimum: int = 0) -> int:
    """`value` as a static Python integer of at least `minimum`."""
    if isinstance(value, (bool, np.bool_)):
        raise ValueError(f"`{name}` must be an integer >= {minimum}; got {value!r}.")
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except Exception as error:  # a tracer raises JAX's own error type
        known = " known while tracing" if isinstance(value, Tracer) else ""
        came = repr(value) if isinstance(value, numbers.Number | str) else type(value).__name__
        raise ValueError(f"`{name}` must be a Python integer{known}; got {came}.") from error
    if number < minimum:
        raise ValueError(f"`{name}` must be >= {minimum}; got {number}.")
    return number


def require(value: T, good: Any, message: str) -> T:
    """`value`, where all of `good` is true. Where it is not, a ValueError at once, or under jit an error at run time.

    What is known is judged here and not by `eqx.error_if`, whose message stands among twenty lines of others.
    """
    if isinstance(good, Tracer):
        return eqx.error_if(value, ~jnp.all(good), message)
    if not np.all(good):
        raise ValueError(message)
    return value


def held(tree: T, check: Callable[[Array], Array]) -> T:
    """`tree`, whose floating arrays and their derivatives need `check(1)`, which gives it back or is a run-time error.

    The 1 is a factor of all. An error of the value alone is dropped with it, where only the gradient is used: that of
    what is linear in the value does not need it.
    """
    one = check(jnp.ones(()))
    return jax.tree.map(lambda x: x * one.astype(x.dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def degree(value: object) -> int:
    """The static argument `degree`, the highest band L, inclusive."""
    return integer("degree", value)


def number(name: str, value: object, *, positive: bool = False) -> float:
    """`value` as a static Python number, finite and not negative, or above 0 if `positive`."""
    try:
        found = float(value)  # type: ignore[arg-type]
    except Exception as error:  # a tracer raises JAX's own error type
        raise ValueError(f"`{name}` must be a number known while tracing; got {type(value).__name__}.") from error
    if not (math.isfinite(found) and (found > 0 if positive else found >= 0)):
        raise ValueError(f"`{name}` must be finite and {'>' if positive else '>='} 0; got {found}.")
    return found
