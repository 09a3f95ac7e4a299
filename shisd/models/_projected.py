"""BRDFs as expansions in harmonics of both directions: f(wi, wo) = y(wi)^T C y(wo) above the horizon (ISD15 Eq. 30).

Reciprocity is C = C^T, and only the symmetric part of C is ever used. A material that turns and mirrors into itself has
C[(l, m), (l', m')] = B[|m|, l, l'] for m = m' and zero otherwise, so that f depends on the azimuths by cos(m (phi_i -
phi_o)) alone. Both forms are contracted with the harmonics themselves, never with azimuths, so the normal is an
ordinary direction.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._typing import Array, ArrayLike, Float, Scalar, Vector
from shisd.harmonics import sh_basis
from shisd.harmonics.internal import bands, by_band, orders
from shisd.models._brdf import AbstractBrdf, Colour, above_horizon


class ProjectedBrdf(AbstractBrdf):
    """A band-limited BRDF, f(wi, wo) = sum over i, j of C[i, j] y_i(wi) y_j(wo) above the horizon (ISD15 Eq. 30).

    Arguments: `coefficients` C [*colour, n, n] with n = (L+1)^2, in 1/sr; with `isotropic=True` the compact form B
    [*colour, L+1, L+1, L+1] over (m, l, l'), where entries with l < m or l' < m belong to no harmonic and are ignored.
    Colour is () or (3,). Static `isotropic`, and `clamp`: negative values, which truncated expansions have beside
    narrow lobes, become 0. That adds the integral of the negative part: what a filter keeps exactly is kept no more.
    Reciprocal by construction: the part of C that is not symmetric is dropped. Energy: as fitted.
    What the expansion does below the horizon is free, and is not seen.
    Derivatives: in C and both directions, exact at the normal; 0 where clamped.
    Accuracy: rounding of `harmonics.sh_basis`, relative to the sum of the absolute terms.
    Cost: n^2 products per pair, or 2 (L+1)^3 when isotropic; for many wi at one wo, n each.
    """

    coefficients: Array
    isotropic: bool = eqx.field(static=True)
    clamp: bool = eqx.field(static=True)

    def __init__(self, coefficients: ArrayLike, *, isotropic: bool, clamp: bool = False):
        c = _checks.real_array("coefficients", coefficients)
        axes = 3 if isotropic else 2
        own = c.shape[-axes:]
        square = len(own) == axes and len(set(own)) == 1 and own[0] > 0
        if not square or c.shape[:-axes] not in ((), (3,)) or not (isotropic or math.isqrt(own[0]) ** 2 == own[0]):
            form = "[L+1, L+1, L+1] for an isotropic" if isotropic else "[(L+1)**2, (L+1)**2] for an anisotropic"
            raise ValueError(f"`coefficients` must have shape {form} material, after [3] for RGB; got {list(c.shape)}.")
        self.coefficients = jax.lax.convert_element_type(c, c.dtype)
        self.isotropic, self.clamp = bool(isotropic), bool(clamp)

    @property
    def degree(self) -> int:
        size = self.coefficients.shape[-1]
        return size - 1 if self.isotropic else _checks.degree_of(size)

    def value(self, wi: ArrayLike, wo: ArrayLike) -> Colour:
        wi, wo, above, elsewhere = above_horizon(wi, wo, self)
        value = self.slice_coefficients(wo) @ sh_basis(wi, self.degree)
        return jnp.where(above, jnp.maximum(value, 0) if self.clamp else value, elsewhere)

    def slice_coefficients(self, wo: Vector) -> Float[Array, "*colour n"]:
        """SH coefficients of wi -> f(wi, wo), without the cosine and with no horizon."""
        y = sh_basis(wo, self.degree)
        c = symmetric(self.coefficients.astype(y.dtype))
        if not self.isotropic:
            return c @ y
        return from_orders(jnp.einsum("...mlk,mk->...ml", by_order(c), to_orders(y)))

    def full_coefficients(self) -> Float[Array, "*colour n n"]:
        """C [*colour, n, n] of either form."""
        c = symmetric(self.coefficients)
        if not self.isotropic:
            return c
        l, m = bands(self.degree), orders(self.degree)
        same = jnp.asarray(m[:, None] == m[None, :])
        of_pairs = c[..., np.abs(m)[:, None], l[:, None], l[None]]
        return jnp.where(jnp.broadcast_to(same, of_pairs.shape), of_pairs, 0)

    @property
    def lobe_width(self) -> Scalar:
        """That of the narrowest lobe of this degree, 1.6 / (L + 1) rad."""
        return jnp.asarray(min(1.6 / (self.degree + 1), 1), self.coefficients.dtype)


def symmetric(c: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    return (c + jnp.swapaxes(c, -1, -2)) / 2


def by_order(c: Float[Array, "*colour m l k"]) -> Float[Array, "*colour orders l k"]:
    """The compact form for every order m = -L ... L."""
    degree = c.shape[-1] - 1
    return c[..., np.abs(np.arange(-degree, degree + 1)), :, :]


def to_orders(y: Float[Array, "*batch n"]) -> Float[Array, "*batch orders l"]:
    """What is indexed l (l+1) + m, as a matrix of m = -L ... L and l = 0 ... L, zero where l < |m|."""
    return jnp.swapaxes(by_band(y, _checks.degree_of(y.shape[-1])), -1, -2)


def from_orders(c: Float[Array, "*batch orders l"]) -> Float[Array, "*batch n"]:
    degree = c.shape[-1] - 1
    return c[..., orders(degree) + degree, bands(degree)]
