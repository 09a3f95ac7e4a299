"""Polygons that emit light."""

import math

import equinox as eqx
import jax.numpy as jnp

from shisd import _checks
from shisd._module import Module
from shisd._numerics import times
from shisd._typing import Array, ArrayLike, Float
from shisd.domains import SphericalPolygon
from shisd.harmonics.internal import bands
from shisd.models.lights._outline import outline

_Y_00 = math.sqrt(1 / (4 * math.pi))


class PolygonLight(Module):
    """A flat polygon in world space that emits, from every point, the same radiance.

    Arguments: `points` [S, 3], S >= 3, in the unit of length of the scene, any outline, counter-clockwise seen from the
    side that emits; `emission`, scalar or [colour], in W/(m2 sr); `profile` [n] or [colour, n], SH coefficients, in
    world space, of a factor by the direction in which light leaves (1 unless given); static `two_sided`: the other side
    emits as well.
    Points that are not of one plane are taken as the outline that they show from each shading point.
    """

    points: Float[Array, "s 3"]
    emission: Float[Array, "*colour"]
    profile: Float[Array, "*colour_n"] | None
    two_sided: bool = eqx.field(static=True)

    def __init__(
        self,
        points: ArrayLike,
        emission: ArrayLike = 1.0,
        *,
        profile: ArrayLike | None = None,
        two_sided: bool = False,
    ):
        p, e = _checks.outline("points", points), _checks.colour("emission", emission)
        f = None if profile is None else _checks.expansion("profile", profile)[0]
        if f is not None and f.ndim == 2 and e.ndim == 1 and 1 not in (len(f), len(e)) and len(f) != len(e):
            raise ValueError(f"colours of `emission` {list(e.shape)} and `profile` {list(f.shape)} do not broadcast.")
        dtype = jnp.result_type(p, e, *(() if f is None else (f,)))
        self.points, self.emission, self.two_sided = p.astype(dtype), e.astype(dtype), bool(two_sided)
        self.profile = None if f is None else f.astype(dtype)

    @property
    def colour(self) -> tuple[int, ...]:
        return jnp.broadcast_shapes(self.emission.shape, () if self.profile is None else self.profile.shape[:-1])

    def outline(self, origin: ArrayLike) -> SphericalPolygon:
        """The outline on the sphere of directions from `origin` [3]: of positive area where the light is seen from a
        side that emits, of none behind it. Derivatives: in both.
        """
        return outline(self, origin)

    def incident(self) -> Float[Array, "*colour_n"]:
        """SH coefficients of the radiance that comes through the outline, by the direction it comes from."""
        if self.profile is None:
            return self.emission[..., None] / _Y_00
        parity = (-1.0) ** bands(_checks.degree_of(self.profile.shape[-1]))
        return times(times(self.profile, jnp.asarray(parity, self.profile.dtype)), self.emission[..., None])
