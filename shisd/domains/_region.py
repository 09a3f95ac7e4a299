"""Caps and hemispheres, whose integrals have closed forms."""

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike

from shisd import _checks
from shisd._numerics import normalize
from shisd._typing import Array, Float, Scalar
from shisd.harmonics import legendre


class SphericalCap(eqx.Module):
    """The directions within `angle` of an axis.

    Arguments: `axis` [3], of any length but zero; `angle` in rad, from 0 to pi.
    """

    axis: Float[Array, "3"]
    angle: Scalar

    def __init__(self, axis: ArrayLike, angle: ArrayLike):
        a = _checks.vectors("axis", axis)
        if a.shape != (3,):
            raise ValueError(f"`axis` must have shape [3]; got {list(a.shape)}.")
        size = _checks.real_array("angle", angle)
        if size.shape != ():
            raise ValueError(f"`angle` must be one number; got shape {list(size.shape)}.")
        self.axis, self.angle = normalize(a), size.astype(a.dtype)

    def zonal_integrals(self, degree: int) -> Float[Array, " l"]:
        """2 pi times the integral of P_l(x) from cos(angle) to 1, l = 0 ... degree."""
        x = jnp.cos(self.angle)
        p = legendre(x, degree + 1)
        l = jnp.arange(1, degree + 1)
        # 1 - x without cancellation; (P_{l-1} - P_{l+1})/(2l+1)
        first = 2 * jnp.sin(self.angle / 2) ** 2
        return 2 * jnp.pi * jnp.concatenate([first[None], (p[:degree] - p[2:]) / (2 * l + 1).astype(x.dtype)])


def hemisphere(normal: ArrayLike) -> SphericalCap:
    """The directions w with w . normal >= 0."""
    return SphericalCap(normal, jnp.pi / 2)
