"""Local lights."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from shisd import _checks
from shisd._module import Module
from shisd._numerics import times
from shisd._typing import Array, ArrayLike, Float, Scalar
from shisd.domains.internal import cap_integrals
from shisd.harmonics import product_matrix
from shisd.harmonics.internal import zonal_norms


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
        p, e = _checks.outline("points", points), _checks.real_array("emission", emission)
        if e.ndim > 1:
            raise ValueError(f"`emission` must be a scalar or [colour]; got shape {list(e.shape)}.")
        f = None if profile is None else _checks.expansion("profile", profile)[0]
        if f is not None and f.ndim == 2 and e.ndim == 1 and 1 not in (len(f), len(e)) and len(f) != len(e):
            raise ValueError(f"colours of `emission` {list(e.shape)} and `profile` {list(f.shape)} do not broadcast.")
        dtype = jnp.result_type(p, e, *(() if f is None else (f,)))
        self.points, self.emission, self.two_sided = p.astype(dtype), e.astype(dtype), bool(two_sided)
        self.profile = None if f is None else f.astype(dtype)

    @property
    def colour(self) -> tuple[int, ...]:
        return jnp.broadcast_shapes(self.emission.shape, () if self.profile is None else self.profile.shape[:-1])


class PortalLight(Module):
    """A window: a polygon in world space through which distant light is seen (CSH18 section 5.1).

    Arguments: `points` [S, 3] as those of a `PolygonLight`, counter-clockwise seen from the side that is lit;
    `coefficients` [n] or [colour, n], SH coefficients of the distant radiance in world space.
    """

    points: Float[Array, "s 3"]
    coefficients: Float[Array, "*colour_n"]
    two_sided: ClassVar[bool] = False

    def __init__(self, points: ArrayLike, coefficients: ArrayLike):
        p, (c, _) = _checks.outline("points", points), _checks.expansion("coefficients", coefficients)
        dtype = jnp.promote_types(p.dtype, c.dtype)
        self.points, self.coefficients = p.astype(dtype), c.astype(dtype)

    @property
    def colour(self) -> tuple[int, ...]:
        return self.coefficients.shape[:-1]


def product_matrices(light: Float[Array, "*colour_n"], degree: int, input_degree: int) -> Float[Array, "*colour_n_m"]:
    """`harmonics.product_matrix` of the light of every colour."""
    of_one = lambda c: product_matrix(c, degree, input_degree=input_degree)
    return of_one(light) if light.ndim == 1 else jax.vmap(of_one)(light)


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
            _checks.real_array("emission", emission),
        )  # fmt: skip
        if c.shape != (3,) or r.shape != ():
            raise ValueError(
                f"`center` must have shape [3] and `radius` be one number; got {list(c.shape)}, {list(r.shape)}."
            )
        if e.ndim > 1:
            raise ValueError(f"`emission` must be a scalar or [colour]; got shape {list(e.shape)}.")
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
