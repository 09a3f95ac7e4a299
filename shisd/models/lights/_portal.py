"""Windows through which distant light is seen."""

import jax.numpy as jnp

from shisd import _checks
from shisd._module import Module
from shisd._typing import Array, ArrayLike, Float
from shisd.domains import SphericalPolygon
from shisd.models.lights._outline import outline


class PortalLight(Module):
    """A window: a polygon in world space through which distant light is seen (CSH18 section 5.1).

    Arguments: `points` [S, 3] as those of a `PolygonLight`, counter-clockwise seen from the side that is lit;
    `coefficients` [n] or [colour, n], SH coefficients of the distant radiance in world space.
    """

    points: Float[Array, "s 3"]
    coefficients: Float[Array, "*colour_n"]

    def __init__(self, points: ArrayLike, coefficients: ArrayLike):
        p, (c, _) = _checks.outline("points", points), _checks.expansion("coefficients", coefficients)
        dtype = jnp.promote_types(p.dtype, c.dtype)
        self.points, self.coefficients = p.astype(dtype), c.astype(dtype)

    @property
    def two_sided(self) -> bool:
        return False

    @property
    def colour(self) -> tuple[int, ...]:
        return self.coefficients.shape[:-1]

    def outline(self, origin: ArrayLike) -> SphericalPolygon:
        """The window on the sphere of directions from `origin` [3]: of positive area on the side that is lit, of none
        on the other. Derivatives: in both.
        """
        return outline(self, origin)

    def incident(self) -> Float[Array, "*colour_n"]:
        """SH coefficients of the radiance that comes through the window, by the direction it comes from."""
        return self.coefficients
