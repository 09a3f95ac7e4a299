"""Local lights."""

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike

from shisd import _checks
from shisd._typing import Array, Float


class PolygonLight(eqx.Module):
    """A flat polygon in world space that emits the same radiance in every direction.

    Arguments: `points` [S, 3], S >= 3, in the unit of length of the scene, any outline, counter-clockwise seen from the
    side that emits; `emission`, scalar or [colour], in W/(m2 sr); static `two_sided`: the other side emits as well.
    Points that are not of one plane are taken as the outline that they show from each shading point.
    """

    points: Float[Array, "s 3"]
    emission: Float[Array, "*colour"]
    two_sided: bool = eqx.field(static=True)

    def __init__(self, points: ArrayLike, emission: ArrayLike = 1.0, *, two_sided: bool = False):
        p, e = _checks.vectors("points", points), _checks.real_array("emission", emission)
        if p.ndim != 2 or p.shape[0] < 3:
            raise ValueError(f"`points` must have shape [S, 3] with at least 3 points; got {list(p.shape)}.")
        if e.ndim > 1:
            raise ValueError(f"`emission` must be a scalar or [colour]; got shape {list(e.shape)}.")
        dtype = jnp.promote_types(p.dtype, e.dtype)
        self.points, self.emission, self.two_sided = p.astype(dtype), e.astype(dtype), bool(two_sided)
