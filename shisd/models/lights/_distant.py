"""Light from so far away that it is the same at every point: any, and what is symmetric about an axis."""

import jax.numpy as jnp

from shisd import _checks
from shisd._module import Module
from shisd._numerics import normalize, times
from shisd._typing import Array, ArrayLike, Float
from shisd.harmonics import rotate, sh_basis
from shisd.harmonics.internal import bands, zonal_norms


class DistantLight(Module):
    """Distant light from all around, as its expansion.

    Arguments: `coefficients` [n] or [colour, n], SH coefficients of the incident radiance in world space, by the
    direction it comes from; in W/(m2 sr), or any linear unit. Those of a map: `Environment.light`.
    """

    coefficients: Float[Array, "*colour_n"]

    def __init__(self, coefficients: ArrayLike):
        self.coefficients, _ = _checks.expansion("coefficients", coefficients)

    @property
    def colour(self) -> tuple[int, ...]:
        return self.coefficients.shape[:-1]

    @property
    def degree(self) -> int:
        return _checks.degree_of(self.coefficients.shape[-1])

    def rotated(self, rotation: ArrayLike) -> "DistantLight":
        """This light turned by `rotation` [3, 3] (`harmonics.rotate`): what came from w comes from R w.

        Derivatives: in both. Cost: about L^3 products, once for all points, where a map would be projected again.
        """
        return DistantLight(rotate(self.coefficients, rotation))


class ZonalLight(Module):
    """Distant light that is symmetric about an axis: a sky gradient, a cap, a sun, a constant (ISD15 Eq. 23).

    Arguments: `axis` [3] in world space, of any length but zero; `coefficients` [L+1] or [colour, L+1], those of y_l^0
    about it. Those of usual profiles: `decomposition.CapKernel`, `GaussianKernel`, ..., `.zonal`.
    """

    axis: Float[Array, "3"]
    coefficients: Float[Array, "*colour_l"]

    def __init__(self, axis: ArrayLike, coefficients: ArrayLike):
        a, z = _checks.vectors("axis", axis), _checks.real_array("coefficients", coefficients)
        if a.shape != (3,):
            raise ValueError(f"`axis` must have shape [3]; got {list(a.shape)}. Pass a list of lights for several.")
        if z.ndim not in (1, 2) or 0 in z.shape:
            raise ValueError(f"`coefficients` must have shape [L+1] or [colour, L+1]; got {list(z.shape)}.")
        dtype = jnp.promote_types(a.dtype, z.dtype)
        self.axis, self.coefficients = a.astype(dtype), z.astype(dtype)

    @property
    def colour(self) -> tuple[int, ...]:
        return self.coefficients.shape[:-1]

    @property
    def degree(self) -> int:
        return self.coefficients.shape[-1] - 1

    def distant(self) -> DistantLight:
        """The same light with all its harmonics, pi_l z_l y_l^m(axis) with pi_l = sqrt(4 pi / (2l+1)) (Eq. 24)."""
        z = times(self.coefficients, jnp.asarray(1 / zonal_norms(self.degree), self.axis.dtype))
        return DistantLight(times(z[..., bands(self.degree)], sh_basis(normalize(self.axis), self.degree)))
