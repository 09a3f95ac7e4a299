"""Balls that emit light."""

import jax
import jax.numpy as jnp

from shisd import _checks
from shisd._module import Module
from shisd._numerics import times
from shisd._typing import Array, ArrayLike, Float, Scalar
from shisd.domains.internal import cap_integrals
from shisd.harmonics.internal import zonal_norms


class SphereLight(Module):
    """A ball that emits, from every point of its surface and in all directions, the same radiance (ISD15 section 7.3).

    Arguments: `center` [3] and `radius` > 0, in the unit of length of the scene; `emission`, scalar or [colour], in
    W/(m2 sr).
    """

    center: Float[Array, "3"]
    radius: Scalar
    emission: Float[Array, "*colour"]

    def __init__(self, center: ArrayLike, radius: ArrayLike, emission: ArrayLike = 1.0):
        c, r, e = (
            _checks.vectors("center", center), _checks.real_array("radius", radius),
            _checks.colour("emission", emission),
        )  # fmt: skip
        if c.shape != (3,) or r.shape != ():
            raise ValueError(
                f"`center` must have shape [3] and `radius` be one number; got {list(c.shape)}, {list(r.shape)}."
            )
        dtype = jnp.result_type(c, r, e)
        self.center, self.radius, self.emission = c.astype(dtype), r.astype(dtype), e.astype(dtype)

    @property
    def colour(self) -> tuple[int, ...]:
        return self.emission.shape

    def zonal_coefficients(self, distance: ArrayLike, degree: int) -> Float[Array, "*batch_colour_l"]:
        """Coefficients of y_l^0 about the direction to the center, of the radiance at a distance from it (Eq. 33).

        Arguments: `distance` [...], in the unit of length of the scene; static `degree`. Returns [..., *colour, L+1].
        Inside the ball its surface is all around: the constant radiance. A `radius` that is not positive gives NaN. At
        the surface the value jumps by that of a hemisphere; from outside its derivative goes there to infinity, as that
        of the solid angle does.
        """
        d, degree = _checks.real_array("distance", distance), _checks.degree(degree)
        dtype = jnp.promote_types(d.dtype, self.radius.dtype)
        d, light = d.astype(dtype), jax.tree.map(lambda x: x.astype(dtype), self)
        z = times(cap_integrals(versine(light, d * d), degree), jnp.asarray(zonal_norms(degree), dtype))
        return times(z.reshape(*d.shape, *(1,) * len(self.colour), degree + 1), light.emission[..., None])


def versine(light: SphereLight, distance2: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """1 - cos of the angle that a ball covers, by the square of the distance; 2 inside of it, NaN of one of no size.

    With s = sin = radius / distance, it is s^2 / (1 + sqrt(1 - s^2)), which keeps its digits for small balls.
    """
    radius2 = light.radius**2 * jnp.where(light.radius > 0, 1, jnp.nan)
    inside = distance2 <= radius2
    sine2 = radius2 / jnp.where(inside, 2 * radius2, distance2)
    return jnp.where(inside, 2, sine2 / (1 + jnp.sqrt(1 - sine2)))
