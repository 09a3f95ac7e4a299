"""Rotation of expansions by matrices: (R f)(w) = f(R^T w).

A rotation is a turn about z, one about y, one about z; the turn about y is one about z between two exchanges of y and
z. On coefficients, turns about z mix m with -m and the exchange is the constant matrix J_l of each band ("Z J Z J Z").
The angles enter only through their cosines and sines and never leave this file. They are not smooth where the pole
stays in place, but the result is: its derivative is taken from the generators of rotation, which need no angle.

notation: R = Rz(a) Ry(b) Rz(g); c = coefficients; J_l = `_tables.swap_matrices`.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from shisd import _checks
from shisd._numerics import angle_multiples
from shisd._typing import Array, ArrayLike, Float
from shisd.harmonics import _layout, _tables


def rotate(coefficients: ArrayLike, rotation: ArrayLike) -> Float[Array, "*batch n"]:
    """Coefficients of the rotated expansion (R f)(w) = f(R^T w).

    Arguments: `coefficients` [..., (L+1)^2]; `rotation` [3, 3], orthonormal with determinant +1 (batch it with
    jax.vmap). A matrix that is not, by more than 1e-3, raises; of one that is nearer, the nearest rotation is taken.
    Derivatives: in both arguments, every order, both modes, exact at the identity and wherever the pole stays in place.
    In `rotation` they are taken along the group of rotations: the part of a tangent that leaves it has no effect.
    Accuracy: 1e-12 at degree 100 in float64, 1e-5 in float32, relative to the largest coefficient of the band.
    Cost: two products with constant matrices of each band.
    Source: Z J Z J Z with J after Pinchon and Hoggan 2007; convention of ISD15 Eq. 1.
    """
    c, degree = _checks.coefficients("coefficients", coefficients)
    r = _checks.matrix("rotation", rotation)
    dtype = jnp.promote_types(c.dtype, r.dtype)
    c, r = c.astype(dtype), r.astype(dtype)
    message = "`rotation` must be orthonormal with determinant +1 (R^T R = 1, right-handed)."
    return _rotate(c, _checks.require(r, _is_rotation(r), message), degree)


@jax.jit
def _is_rotation(r: Float[Array, "3 3"]) -> Array:
    drift = jnp.abs(r.T @ r - jnp.eye(3, dtype=r.dtype))
    return jnp.all(drift < 1e-3) & (jnp.dot(jnp.cross(r[:, 0], r[:, 1]), r[:, 2]) > 0)


@functools.partial(jax.jit, static_argnums=2)
def _rotate(c: Float[Array, "*batch n"], r: Float[Array, "3 3"], degree: int) -> Float[Array, "*batch n"]:
    for _ in range(3):  # to the nearest rotation: drifts of 1e-3, 1e-6, 1e-12 (Newton's method, Higham 1986)
        r = 1.5 * r - 0.5 * r @ (r.T @ r)
    flat = c.reshape(math.prod(c.shape[:-1]), c.shape[-1]).T[..., None]
    return rotate_many(flat, r[None], degree)[..., 0].T.reshape(c.shape)


QUARTER = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # turn about x


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def rotate_many(
    c: Float[Array, "f n"] | Float[Array, "n f p"], r: Float[Array, "p 3 3"], degree: int, upright: bool = False
) -> Float[Array, "n f p"]:
    """Expansions rotated by every matrix, or each by its own, unchecked. Rotations stand last: they are vector lanes.

    `upright` promises that R z has y = 0 <= x, so that a = 0 and the last turn is left out.
    """
    a, b, (cos_g, sin_g) = turns(r, degree)
    return _finish(_swap_turned(c, cos_g, sin_g, degree), None if upright else a, b, degree)


def _rotate_many_jvp(degree, upright, primals, tangents):
    (c, r), (dc, dr) = primals, tangents
    x = rotate_many(c, r, degree, upright)
    dx = jnp.zeros_like(x)
    if not isinstance(dc, SymbolicZero):
        dx += _rotate_many_away_from_pole(dc, r, degree)
    if not isinstance(dr, SymbolicZero):
        for w, terms in zip(rates(r, dr), _tables.generator_gather(degree), strict=True):
            for index, factor in terms:
                dx += jnp.asarray(factor[:, None, None], x.dtype) * w[None, None] * x[index]
    return x, dx


rotate_many.defjvp(_rotate_many_jvp, symbolic_zeros=True)


def rates(r: Float[Array, "p 3 3"], dr: Float[Array, "p 3 3"]) -> list[Array]:
    """Rates of rotation [p] about x, y and z of the target frame: the skew part of dR R^T."""
    rate = jnp.einsum("pij,pkj->pik", dr, r)
    return [(rate[:, j, i] - rate[:, i, j]) / 2 for i, j in ((1, 2), (2, 0), (0, 1))]


def _rotate_many_away_from_pole(c: Array, r: Float[Array, "p 3 3"], degree: int) -> Array:
    """`rotate_many` with smooth angles: linear in c, so its transpose is differentiated as it stands.

    Where R nearly keeps the z axis, R = (R Q^T) Q with the quarter turn Q about x; R Q^T takes z far from z.
    """
    quarter = jnp.asarray(QUARTER, r.dtype)
    near = r[:, 2, 2] ** 2 > 0.5
    a, b, (cos_g, sin_g) = turns(jnp.where(near[:, None, None], r @ quarter.T, r), degree)
    flip = jnp.asarray(np.where(_layout.orders(degree) < 0, -1, 1)[:, None, None], c.dtype)
    shared = c.ndim == 2
    quartered = swap(c.T[..., None] if shared else c, degree) * flip
    quartered = quartered[..., 0].T if shared else quartered
    turned = (_swap_turned(x, cos_g, sin_g, degree) for x in (quartered, c))
    x = jnp.where(near[None, None], *turned)
    return _finish(x, a, b, degree)


def turns(r: Float[Array, "p 3 3"], degree: int) -> list[list[Array]]:
    """Cosines and sines [L+1, p] of the multiples of the three angles of each rotation."""
    cos, sin = (jnp.stack(parts) for parts in zip(*_angles(r), strict=True))
    cos, sin = angle_multiples(cos, sin, degree + 1)
    return [[cos[:, i], sin[:, i]] for i in range(3)]


def _finish(x: Float[Array, "n f p"], a: list[Array] | None, b: list[Array], degree: int) -> Float[Array, "n f p"]:
    """Z(a) J Z(-b) of x: the turn about y is J Z(-b) J, whose first exchange is already in x."""
    cos_b, sin_b = b
    x = swap(_turn(x, cos_b, -sin_b, degree), degree)
    return x if a is None else _turn(x, a[0], a[1], degree)


def _angles(r: Float[Array, "p 3 3"]) -> tuple[tuple[Array, Array], tuple[Array, Array], tuple[Array, Array]]:
    """(cos, sin) of a, b, g. Where R leaves the z axis in place, a = 0 and g is the whole turn."""
    sin_b = jnp.sqrt(r[:, 0, 2] ** 2 + r[:, 1, 2] ** 2)
    safe = jnp.where(sin_b > 0, sin_b, 1)
    cos_a, sin_a = jnp.where(sin_b > 0, r[:, 0, 2] / safe, 1), r[:, 1, 2] / safe
    cos_b = r[:, 2, 2]
    x, y = cos_a * r[:, 0, 0] + sin_a * r[:, 1, 0], cos_a * r[:, 1, 0] - sin_a * r[:, 0, 0]
    return (cos_a, sin_a), (cos_b, sin_b), (cos_b * x - sin_b * r[:, 2, 0], y)


def _turn(x: Float[Array, "n f p"], cos: Array, sin: Array, degree: int) -> Float[Array, "n f p"]:
    """The turn about z whose multiples have these cosines and sines [L+1, p]."""
    m, l = _layout.orders(degree), _layout.bands(degree)
    sign = jnp.asarray(-np.sign(m)[:, None], x.dtype)
    return cos[np.abs(m)][:, None] * x + (sign * sin[np.abs(m)])[:, None] * x[_layout.place(l, -m)]


def swap(x: Float[Array, "n f p"], degree: int) -> Float[Array, "n f p"]:
    """y and z exchanged: J_l on every band."""
    groups, place = _swap_groups(degree)
    bands = [jnp.einsum("lij,ljfp->lifp", jnp.asarray(j, x.dtype), x[index]) for index, j in groups]
    return jnp.concatenate([b.reshape(b.shape[0] * b.shape[1], *x.shape[1:]) for b in bands])[place]


@functools.cache
def _swap_groups(degree: int) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """J_l of eight bands together, filled up to the size of the last: one product for each band is slow to compile.

    For each group the coefficients [l, 2l+1] that it takes, where the filling repeats those of the band, and matrices;
    and where each coefficient then is.
    """
    groups, place, start, swaps = [], [], 0, _tables.swap_matrices(degree)
    for first in range(0, degree + 1, 8):
        l = np.arange(first, min(first + 8, degree + 1))[:, None]
        m = np.arange(2 * l[-1, 0] + 1)
        matrices = np.stack([np.pad(swaps[k], (0, m.size - 2 * k - 1)) for k in l[:, 0]])
        groups.append(((l * l + np.minimum(m, 2 * l)).astype(np.int32), matrices))
        place.append(np.flatnonzero(m <= 2 * l) + start)
        start += l.size * m.size
    return groups, np.concatenate(place).astype(np.int32)


def _swap_turned(c: Array, cos: Array, sin: Array, degree: int) -> Float[Array, "n f p"]:
    """`swap` of `_turn`; of coefficients [f, n] that all rotations share, one product with the cosines and sines."""
    if c.ndim == 3:
        return swap(_turn(c, cos, sin, degree), degree)
    return jnp.tensordot(swapped_series(c, degree), jnp.concatenate([cos, sin]), 1)


def swapped_series(c: Float[Array, "f n"], degree: int) -> Float[Array, "n f k"]:
    """J Z(g) c as factors of cos(k g), k = 0 ... L, then of sin(k g)."""
    cosine, sine = [], []
    for l, j in enumerate(_tables.swap_matrices(degree)):
        plus, minus = c[None, :, l * l + l : (l + 1) ** 2], c[None, :, l * l : l * l + l + 1][..., ::-1]
        j_plus = jnp.asarray(j[:, None, l:], c.dtype)
        j_minus = jnp.asarray(j[:, None, l::-1] * (np.arange(l + 1) > 0), c.dtype)  # m = 0 counts once
        pad = ((0, 0), (0, 0), (0, degree - l))
        cosine.append(jnp.pad(j_plus * plus + j_minus * minus, pad))
        sine.append(jnp.pad(j_minus * plus - j_plus * minus, pad))
    return jnp.concatenate([jnp.concatenate(cosine), jnp.concatenate(sine)], axis=-1)
