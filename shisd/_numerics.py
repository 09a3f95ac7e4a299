"""Small numerical helpers that every stage shares."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from shisd._typing import Array, Float


def normalize(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Unit vectors along `vectors`, without overflow or underflow at any scale; a zero vector gives NaN.

    The scale changes nothing, so derivatives need not pass through it: 1 / scale^2 would overflow.
    """
    scaled = vectors / jax.lax.stop_gradient(jnp.max(jnp.abs(vectors), axis=-1, keepdims=True))
    return scaled / jnp.sqrt(jnp.sum(scaled * scaled, axis=-1, keepdims=True))


def angle_multiples(
    cos: Float[Array, "*batch"], sin: Float[Array, "*batch"], count: int
) -> tuple[Float[Array, " {count} *batch"], Float[Array, " {count} *batch"]]:
    """cos(k a) and sin(k a) for k = 0 ... count-1 on a new first axis, from cos(a) and sin(a).

    Powers of a unit complex number as products of two short tables, a few of them at once: k = giant * i + baby. Every
    power is at most 2 log2(count) products away from the first, so the rounding grows with k, not with k^2.
    """
    baby = 1 << (max(count - 1, 1).bit_length() + 1) // 2
    giant = -(-count // baby)
    c, s = _chain(cos, sin, baby + 1)
    big_c, big_s = _chain(c[baby], s[baby], giant)
    c, s = (jnp.stack(p[:baby])[None] for p in (c, s))
    big_c, big_s = (jnp.stack(p)[:, None] for p in (big_c, big_s))
    shape = (giant * baby, *cos.shape)
    return (big_c * c - big_s * s).reshape(shape)[:count], (big_s * c + big_c * s).reshape(shape)[:count]


def _chain(cos: Array, sin: Array, count: int) -> tuple[list[Array], list[Array]]:
    """The first `count` powers by halving: power k is the product of powers k // 2 and k - k // 2."""
    c, s = [1 + 0 * cos, cos], [0 * sin, sin]  # NaN also of the angle that is not a number
    for k in range(2, count):
        i, j = k // 2, k - k // 2
        c.append(c[i] * c[j] - s[i] * s[j])
        s.append(s[i] * c[j] + c[i] * s[j])
    return c[:count], s[:count]


Vector = Array | tuple[Array, Array, Array]  # components on the first axis


def dot(a: Vector, b: Vector) -> Array:
    """Scalar products of vectors whose components are on the first axis."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Array:
    """Vector products, components on the first axis."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def tangents(u: Vector) -> tuple[Array, Array]:
    """Two unit vectors that complete the unit vectors u to frames (Duff et al. 2017), components on the first axis."""
    x, y, z = u
    sign = jnp.where(z < 0, -1, 1).astype(z.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    return jnp.stack([1 + sign * x * x * a, sign * b, -sign * x]), jnp.stack([b, sign + y * y * a, -y])


def same_dtype(a: Array, b: Array) -> tuple[Array, Array]:
    """Both in the dtype that they promote to, also where JAX promotes nothing by itself."""
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.promote_types(a.dtype, b.dtype)
    return a.astype(dtype), b.astype(dtype)


def times(a: Array, b: Array) -> Array:
    """Products of arrays whose axes broadcast from the last one, whatever their number."""
    shape = jnp.broadcast_shapes(a.shape, b.shape)
    return jnp.broadcast_to(a, shape) * jnp.broadcast_to(b, shape)


def rows_of(x: Float[Array, " p"], factors: np.ndarray) -> Float[Array, "n p"]:
    """x times every factor, as a product of matrices, as is its transpose."""
    return jnp.asarray(factors[:, None], x.dtype) @ x[None]


def safe_sqrt(x: Array) -> Array:
    """Square roots whose derivative at 0 is 0, not infinite. Of less than 0: 0, as of rounding; of NaN: NaN."""
    nothing = x <= 0
    return jnp.where(nothing, 0, jnp.sqrt(jnp.where(nothing, 1, x)))


@jax.custom_jvp
def arctan2(y: Array, x: Array) -> Array:
    """The angle of (x, y) in (-pi, pi], to 3e-7 in float32 and 3e-15 in float64; 0 and -0 are the same.

    jnp.arctan2 is a call for every element on a CPU, which keeps all that is computed with it from vector code.
    """
    a, b = jnp.abs(y), jnp.abs(x)
    large, small = jnp.maximum(a, b), jnp.minimum(a, b)
    wide = small > math.tan(np.pi / 8) * large  # then the angle to the diagonal
    over = jnp.where(wide, small + large, jnp.where(large > 0, large, 1))
    t = jnp.where(wide, small - large, small) / over
    series = jnp.zeros_like(t)
    for coefficient in _arctan_series(13 if t.dtype.itemsize > 4 else 6)[::-1]:
        series = series * (t * t) + coefficient
    angle = jnp.where(wide, np.pi / 4, 0) + t * series
    angle = jnp.where(a > b, np.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, np.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


@arctan2.defjvp
def _arctan2_jvp(primals, tangents):
    (y, x), (dy, dx) = primals, tangents
    return arctan2(y, x), (x * dy - y * dx) / (x * x + y * y)


@functools.cache
def _arctan_series(degree: int) -> list[float]:
    """Coefficients of arctan(t) / t over powers of t^2, for t up to tan(pi / 8)."""
    quotient = lambda t2: np.arctan(np.sqrt(t2)) / np.sqrt(t2)
    near = Chebyshev.interpolate(quotient, degree, domain=[0, np.tan(np.pi / 8) ** 2])
    return [float(c) for c in near.convert(kind=Polynomial).coef]
