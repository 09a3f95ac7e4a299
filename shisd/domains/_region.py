"""Caps and hemispheres, whose integrals have closed forms."""

import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._module import Module
from shisd._numerics import normalize
from shisd._typing import Array, ArrayLike, Float, Scalar
from shisd.harmonics import sh_basis
from shisd.harmonics.internal import bands, legendre_of_versine


class SphericalCap(Module):
    """The directions within `angle` of an axis.

    Arguments: `axis` [3], of any length but zero; `angle` in rad, from 0 to pi. All integrals are NaN for others.
    """

    axis: Float[Array, "3"]
    angle: Scalar

    def __init__(self, axis: ArrayLike, angle: ArrayLike):
        a = _checks.vectors("axis", axis)
        if a.shape != (3,):
            raise ValueError(f"`axis` must have shape [3]; got {list(a.shape)}.")
        self.axis, self.angle = normalize(a), _checks.scalar("angle", angle).astype(a.dtype)

    @property
    def versine(self) -> Scalar:
        """1 - cos(angle), without cancellation; NaN where the angle is not from 0 to pi."""
        bad = (self.angle < 0) | (self.angle > np.pi * (1 + 1e-6))  # as float32 rounds pi
        return 2 * jnp.sin(self.angle / 2) ** 2 * jnp.where(bad, np.nan, jnp.ones_like(self.angle))


def cap_integrals(versine: Float[Array, "*batch"], degree: int) -> Float[Array, "*batch l"]:
    """Integrals of P_l(w . axis) over caps, l = 0 ... degree: 2 pi times those of P_l(x) from 1 - t to 1.

    t = `versine` of a cap's angle, in [0, 2].
    By Legendre's equation they are 2 pi (1 - x^2) P_l'(x) / (l (l+1)) at x = 1 - t, and P_l' is the sum of (2k+1) P_k
    for k = l-1, l-3, ...: no digit is lost in small caps, as it is in (P_{l-1} - P_{l+1}) / (2l+1).
    """
    t = versine[..., None]
    if degree == 0:
        return 2 * np.pi * t
    l, k = np.arange(1, degree + 1), np.arange(degree)[:, None]
    slopes = np.where((k < l) & ((l - k) % 2 == 1), (2 * k + 1) / (l * (l + 1)), 0)
    p = legendre_of_versine(versine, degree - 1)
    rest = t * (2 - t) * jnp.matmul(p, jnp.asarray(slopes, t.dtype), precision="highest")
    return 2 * np.pi * jnp.concatenate([t, rest], axis=-1)


def cap_coefficients(versine: Float[Array, "*batch"], axis: Float[Array, "*batch 3"], degree: int) -> Array:
    """SH coefficients [..., n] of the indicators of caps about axes [..., 3], of any length but zero."""
    return cap_integrals(versine, degree)[..., np.asarray(bands(degree))] * sh_basis(axis, degree)


def hemisphere(normal: ArrayLike) -> SphericalCap:
    """The directions w with w . normal >= 0."""
    return SphericalCap(normal, jnp.pi / 2)
