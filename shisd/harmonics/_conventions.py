"""Other programs' spherical harmonics: coefficients of the same function in their bases.

All have the index l*(l+1)+m. They differ in signs, norms, axes and in being real or complex.

notation: A_l = 2 pi times the integral of z P_l(z) over 0 < z < 1, what the clamped cosine does to band l (Ramamoorthi
and Hanrahan 2001); K_lm = |y_l^m| over filament's polynomials 1; y, z, x; xy, yz, 3z^2 - 1, xz, x^2 - y^2.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._typing import Array, ArrayLike, Float
from shisd.harmonics import _layout, _tables

CONVENTIONS = ("shisd", "sphericart", "unsigned", "e3nn", "scipy", "3dgs", "ambix", "three.js", "filament")
HIGHEST_DEGREE = {"3dgs": 3, "three.js": 2, "filament": 2}

_A = np.pi * np.repeat([1, 2 / 3, 1 / 4], [1, 3, 5])
_K = np.sqrt(np.array([1, 3, 3, 3, 15, 15, 5 / 4, 15, 15 / 4]) / (4 * np.pi))


def convert(coefficients: ArrayLike, source: str, target: str) -> Array:
    """Coefficients of the same function of direction in another convention.

    Arguments: `coefficients` [..., (L+1)^2] in the convention `source`; the names are
    - "shisd": real, Condon-Shortley phase, y_1 = sqrt(3/4pi) (-y, z, -x);
    - "sphericart" and "unsigned", the graphics basis: real, without that phase, y_1 = sqrt(3/4pi) (y, z, x);
    - "e3nn": real in its "integral" normalisation, pole +y, y_1 = sqrt(3/4pi) (x, y, z);
    - "scipy": the complex Y_l^m of scipy.special.sph_harm_y, the function itself real. From it, the real part is kept;
    - "3dgs": 3D Gaussian splatting to degree 3 (graphdeco-inria/gaussian-splatting, utils/sh_utils.py). Its constants
      C0 to C3 have the signs of "shisd". Its tensors [N, 16, 3] hold colour last: exchange the last two axes. Its files
      hold colour first: `f_dc` as [3, 1], then `f_rest` as [3, 15]. The 0.5 that its renderer adds is no part of the
      coefficients. Its directions lead from the camera to the Gaussian;
    - "ambix": channels of ambisonics, order ACN, norm SN3D, without that phase (Nachbar et al. 2011; the encoder of
      kronihias/ambix). Each is the integral of the function times Y_l^m, where Y_0 = 1 and Y_1 = (y, z, x), so that a
      source of strength 1 has W = 1; sqrt((2l+1)/4pi) times it is "unsigned". x is ahead, y left, z up;
    - "three.js": SphericalHarmonics3 to degree 2 (mrdoob/three.js, src/math), which is "unsigned" with constants of six
      digits in `getAt`;
    - "filament": irradiance over pi as cmgen writes it for the shader, to degree 2 (google/filament,
      libs/ibl/src/CubemapSH.cpp), of the radiance that the other conventions describe. It is A_l/pi K_lm times
      "unsigned", A_l = pi, 2pi/3, pi/4 and K_lm = y_lm over its polynomial in the shader's sum
      s_0 + s_1 y + s_2 z + s_3 x + s_4 xy + s_5 yz + s_6 (3z^2 - 1) + s_7 xz + s_8 (x^2 - y^2).
      What cmgen mirrored stays mirrored.
    No axis is turned: x, y and z are those of the program. Scenes of three.js and filament have +y up, ours +z, and
    `rotate` by [[1, 0, 0], [0, 0, -1], [0, 1, 0]] brings theirs to ours.
    Returns [..., (L+1)^2] in the dtype of `coefficients`, or the complex dtype of that precision for "scipy".
    Derivatives: linear in `coefficients`.
    Bad input: a degree above that of a convention is a ValueError.
    Accuracy: a few roundings; e3nn needs a rotation of each band, 1e-14 at degree 30.
    """
    for name, value in (("source", source), ("target", target)):
        if value not in CONVENTIONS:
            raise ValueError(f"`{name}` must be one of {', '.join(map(repr, CONVENTIONS))}; got {value!r}.")
    if source == "scipy":
        c = _complex_coefficients(coefficients)
    else:
        c, _ = _checks.coefficients("coefficients", coefficients)
    for name in (source, target):
        highest = HIGHEST_DEGREE.get(name, _degree(c))
        if _degree(c) > highest:
            raise ValueError(
                f"`coefficients` have degree {_degree(c)}, and {name!r} ends at degree {highest}; "
                f"pass the first {(highest + 1) ** 2}."
            )
    return _from_shisd(_to_shisd(c, source), target)


def _to_shisd(c: Array, source: str) -> Float[Array, "*batch n"]:
    if source == "scipy":
        return _from_complex(c)
    if source == "e3nn":
        return _scale(_turn(c, back=True), _factors("unsigned", _degree(c)))
    return _scale(c, 1 / _factors(source, _degree(c)))


def _from_shisd(c: Float[Array, "*batch n"], target: str) -> Array:
    if target == "scipy":
        return _to_complex(c)
    if target == "e3nn":
        return _turn(_scale(c, _factors("unsigned", _degree(c))), back=False)
    return _scale(c, _factors(target, _degree(c)))


def _degree(c: Array) -> int:
    return _checks.degree_of(c.shape[-1])


def _factors(convention: str, degree: int) -> np.ndarray:
    """What takes our coefficients to those of a real convention with our axes, [(L+1)^2]."""
    l, m = _layout.bands(degree), _layout.orders(degree)
    unsigned = np.where(m % 2 == 1, -1.0, 1.0)
    if convention in ("shisd", "3dgs"):
        return np.ones(m.size)
    if convention == "ambix":
        return unsigned * np.sqrt(4 * np.pi / (2 * l + 1))
    if convention == "filament":
        return unsigned * (_A / np.pi * _K)[: m.size]
    return unsigned


def _scale(c: Float[Array, "*batch n"], factors: np.ndarray) -> Float[Array, "*batch n"]:
    return c * jnp.broadcast_to(jnp.asarray(factors, c.dtype), c.shape)


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
    _checks.coefficients("coefficients", c.real)
    return c


def _pairs(c: Array) -> tuple[Array, Array]:
    """The coefficients of order |m| and of order -|m|, at every index."""
    l, m = _layout.bands(_degree(c)), np.abs(_layout.orders(_degree(c)))
    return c[..., _layout.place(l, m)], c[..., _layout.place(l, -m)]


def _to_complex(c: Float[Array, "*batch n"]) -> Array:
    """c_lm = (a - i b) / sqrt(2), c_l-m = (-1)^m (a + i b) / sqrt(2) for a y_l^m + b y_l^-m, m > 0."""
    m = np.broadcast_to(_layout.orders(_degree(c)), c.shape)
    a, b = _pairs(c)
    real = jnp.where(m == 0, c, math.sqrt(0.5) * jnp.where((m < 0) & (m % 2 == 1), -a, a))
    imaginary = jnp.where(m == 0, 0, math.sqrt(0.5) * jnp.where((m < 0) & (m % 2 == 0), b, -b))
    return jax.lax.complex(real, imaginary)


def _from_complex(c: Array) -> Float[Array, "*batch n"]:
    """The coefficients of the real part of the function."""
    m = np.broadcast_to(_layout.orders(_degree(c)), c.shape)
    plus, minus = _pairs(c)
    minus = jnp.where(m % 2 == 1, -minus, minus)
    a, b = (plus.real + minus.real) / 2, (minus.imag - plus.imag) / 2
    return jnp.where(m == 0, c.real, math.sqrt(2) * jnp.where(m > 0, a, b))
