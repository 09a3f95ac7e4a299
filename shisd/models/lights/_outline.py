"""Flat lights as points see them: which side is lit, and which way round the outline runs from there.

The one rule: the points of a light run counter-clockwise seen from the side that it lights. On the sphere of directions
about a point on that side the same outline runs clockwise seen from outside, for who stands inside a sphere sees the
mirror image of what is seen from outside, and there regions are positive when counter-clockwise
(`domains.SphericalPolygon`). So the outline as it stands has negative integrals where it is lit, `facing` is -1 there,
and their product is right on either side. `outline` turns the points round instead.
"""

from typing import Protocol, runtime_checkable

import jax.numpy as jnp

from shisd import _checks
from shisd._numerics import normalize
from shisd._typing import Array, ArrayLike, Float
from shisd.domains import SphericalPolygon, polygon_from_points
from shisd.domains.internal import Loop


@runtime_checkable
class Flat(Protocol):
    """A polygon in space that lights one side, or both."""

    @property
    def points(self) -> Float[Array, "s 3"]: ...
    @property
    def two_sided(self) -> bool: ...


def facing(light: Flat, relative: Loop) -> Float[Array, " p"]:
    """-1 on the side that a light lights; behind it 0, or 1 if it lights both. `relative` [3, S, p]: points of the
    light less those that are lit.
    """
    side = jnp.sign(_normal(light) @ relative[:, 0])
    return side if light.two_sided else jnp.minimum(side, 0)


def towards(light: Flat, relative: Loop) -> Float[Array, "3 p"]:
    """Directions from points straight to a light's plane: no vertex is more than a quarter turn away."""
    normal = normalize(_normal(light))
    return normal[:, None] * jnp.sign(normal @ relative[:, 0])[None]


def outline(light: Flat, origin: ArrayLike) -> SphericalPolygon:
    """The outline as seen from `origin` [3], of positive area if it is lit there and of none if it is dark."""
    o = _checks.vectors("origin", origin)
    if o.ndim != 1:
        raise ValueError(f"`origin` must have shape [3]; got {list(o.shape)}. Batch it with jax.vmap.")
    dtype = jnp.promote_types(o.dtype, light.points.dtype)
    points, o = light.points.astype(dtype), o.astype(dtype)
    side = facing(light, (points - o[None]).T[..., None])
    dark = jnp.where(side == 0, jnp.broadcast_to(points[:1], points.shape), jnp.nan)
    return polygon_from_points(jnp.where(side < 0, points[::-1], jnp.where(side > 0, points, dark)), o)


def _normal(light: Flat) -> Float[Array, "3"]:
    """Normal of a light's plane, of any length: of differences to a vertex, exact far from the origin."""
    edges = light.points - light.points[:1]
    return jnp.cross(edges, jnp.roll(edges, -1, 0)).sum(axis=0)
