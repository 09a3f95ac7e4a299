"""Other programs' spherical harmonics: coefficients of the same function in their bases.

All are orthonormal over the sphere with index l*(l+1)+m. They differ in signs, axes and in being real or complex.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._typing import Array, ArrayLike, Float
from shisd.harmonics import _tables

CONVENTIONS = ("shisd", "sphericart", "unsigned", "e3nn", "scipy")


def convert(coefficients: ArrayLike, source: str, target: str) -> Array:
    """Coefficients of the same function of direction in another convention.

    Arguments: `coefficients` [..., (L+1)^2] in the convention `source`; the names are
    - "shisd": real, Condon-Shortley phase, y_1 = sqrt(3/4pi) (-y, z, -x);
    - "sphericart" and "unsigned", the graphics basis: real, without that phase, y_1 = sqrt(3/4pi) (y, z, x);
    - "e3nn": real in its "integral" normalisation, pole +y, y_1 = sqrt(3/4pi) (x, y, z);
    - "scipy": the complex Y_l^m of scipy.special.sph_harm_y, the function itself real. From it, the real part is kept.
    Returns [..., (L+1)^2] in the dtype of `coefficients`, or the complex dtype of that precision for "scipy".
    Derivatives: linear in `coefficients`.
    Accuracy: a few roundings; e3nn needs a rotation of each band, 1e-14 at degree 30.
    """
    for name, value in (("source", source), ("target", target)):
        if value not in CONVENTIONS:
            raise ValueError(f"`{name}` must be one of {', '.join(map(repr, CONVENTIONS))}; got {value!r}.")
    if source == "scipy":
        c = _from_complex(_complex_coefficients(coefficients))
    else:
        c, _ = _checks.coefficients("coefficients", coefficients)
        if source == "e3nn":
            c = _flip(_turn(c, back=True))
        elif source != "shisd":
            c = _flip(c)
    if target == "scipy":
        return _to_complex(c)
    if target == "e3nn":
        return _turn(_flip(c), back=False)
    return c if target == "shisd" else _flip(c)


def _degree(c: Array) -> int:
    return _checks.coefficients("coefficients", c)[1]


def _flip(c: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """With the Condon-Shortley phase to without, and back."""
    odd = np.broadcast_to(_tables.orders(_degree(c)) % 2 == 1, c.shape)
    return jnp.where(odd, -c, c)


def _turn(c: Float[Array, "*batch n"], back: bool) -> Float[Array, "*batch n"]:
    """Unsigned harmonics with pole +z to those with pole +y, or back: y_e3nn(x, y, z) = y_unsigned(z, x, y).

    (x, y, z) -> (z, x, y) is the exchange of y and z, then that of the first two. `_tables.swap_matrices` is the first,
    and phi -> pi/2 - phi the second; both are their own inverses.
    """
    degree = _degree(c)
    bands = []
    for l, swap in enumerate(_tables.swap_matrices(degree)):
        m = np.arange(-l, l + 1)
        signs = np.where(m % 2 == 1, -1, 1)
        turn = _tables.quarter_mirror(l) @ (signs[:, None] * swap * signs)
        turn = jnp.asarray(turn.T if back else turn, c.dtype)
        bands.append(jnp.einsum("ij,...j->...i", turn, c[..., l * l : (l + 1) ** 2]))
    return jnp.concatenate(bands, axis=-1)


def _complex_coefficients(value: ArrayLike) -> Array:
    c = _checks.any_array("coefficients", value)
    if not jnp.issubdtype(c.dtype, jnp.complexfloating):
        raise ValueError(f"`coefficients` must be complex where `source` is 'scipy'; got dtype {c.dtype}.")
    _degree(c.real)
    return c


def _pairs(c: Array) -> tuple[Array, Array]:
    """The coefficients of order |m| and of order -|m|, at every index."""
    l, m = _tables.bands(_degree(c.real)), np.abs(_tables.orders(_degree(c.real)))
    return c[..., l * l + l + m], c[..., l * l + l - m]


def _to_complex(c: Float[Array, "*batch n"]) -> Array:
    """c_lm = (a - i b) / sqrt(2), c_l-m = (-1)^m (a + i b) / sqrt(2) for a y_l^m + b y_l^-m, m > 0."""
    m = np.broadcast_to(_tables.orders(_degree(c)), c.shape)
    a, b = _pairs(c)
    real = jnp.where(m == 0, c, math.sqrt(0.5) * jnp.where((m < 0) & (m % 2 == 1), -a, a))
    imaginary = jnp.where(m == 0, 0, math.sqrt(0.5) * jnp.where((m < 0) & (m % 2 == 0), b, -b))
    return jax.lax.complex(real, imaginary)


def _from_complex(c: Array) -> Float[Array, "*batch n"]:
    """The coefficients of the real part of the function."""
    m = np.broadcast_to(_tables.orders(_degree(c.real)), c.shape)
    plus, minus = _pairs(c)
    minus = jnp.where(m % 2 == 1, -minus, minus)
    a, b = (plus.real + minus.real) / 2, (minus.imag - plus.imag) / 2
    return jnp.where(m == 0, c.real, math.sqrt(2) * jnp.where(m > 0, a, b))
