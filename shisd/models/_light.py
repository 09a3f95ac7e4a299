"""Local lights."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike

from shisd import _checks
from shisd._typing import Array, Float
from shisd.harmonics import product_matrix


class PolygonLight(eqx.Module):
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


class PortalLight(eqx.Module):
    """A window: a polygon in world space through which distant light is seen (CSH18 section 5.1).

    Arguments: `points` [S, 3] as those of a `PolygonLight`, counter-clockwise seen from the side that is lit;
    `coefficients` [n] or [colour, n], SH coefficients of the distant radiance in world space; static `degree`, the
    highest of the lobes to be lit by it (or of the expansions wanted of it).
    The matrix of the product of a lobe with the distant light, `product` [*colour, (Le+degree+1)^2, (degree+1)^2], is
    computed here, once for all points and views (CSH18 Eq. 14), without loss.
    """

    points: Float[Array, "s 3"]
    coefficients: Float[Array, "*colour_n"]
    product: Float[Array, "*colour_n_m"]
    degree: int = eqx.field(static=True)
    two_sided: ClassVar[bool] = False

    def __init__(self, points: ArrayLike, coefficients: ArrayLike, degree: int):
        p, (c, _) = _checks.outline("points", points), _checks.expansion("coefficients", coefficients)
        self.degree = _checks.degree(degree)
        dtype = jnp.promote_types(p.dtype, c.dtype)
        self.points, self.coefficients = p.astype(dtype), c.astype(dtype)
        self.product = lobe_product(self.coefficients, self.degree)

    @property
    def colour(self) -> tuple[int, ...]:
        return self.coefficients.shape[:-1]


def lobe_product(light: Float[Array, "*colour_n"], degree: int) -> Float[Array, "*colour_n_m"]:
    """From coefficients of a lobe of this degree to those of its product with a light, all of them."""
    light_degree = _checks.degree_of(light.shape[-1])
    rows = [product_matrix(c, light_degree + degree, input_degree=degree) for c in light.reshape(-1, light.shape[-1])]
    return jnp.stack(rows).reshape(*light.shape[:-1], *rows[0].shape)
