"""The integrand of radiance in the local frame: value_cosine times incident radiance."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from shisd import _checks
from shisd._numerics import normalize
from shisd._typing import Array, ArrayLike, Float
from shisd.models import AbstractBrdf

Radiance = ArrayLike | Callable[[Array], Array]


def local_frames(
    normals: ArrayLike, views: ArrayLike, tangents: ArrayLike | None, brdf: AbstractBrdf
) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
    """World-to-local rotations (rows: tangent, bitangent, normal) and local views."""
    normal, view = _checks.vectors("normals", normals), _checks.vectors("views", views)
    if normal.ndim != 2 or normal.shape != view.shape:
        message = f"`normals` and `views` must both have shape [N, 3]; got {list(normal.shape)} and {list(view.shape)}."
        raise ValueError(message)
    normal, view = normalize(normal), normalize(view)
    if tangents is not None:
        tangent = _checks.vectors("tangents", tangents)
        if tangent.shape != normal.shape:
            raise ValueError(f"`tangents` must have the shape of `normals`, [N, 3]; got {list(tangent.shape)}.")
        tangent = normalize(tangent - jnp.sum(tangent * normal, axis=-1, keepdims=True) * normal)
    elif not brdf.isotropic:
        raise ValueError("`tangents` [N, 3] are needed: this BRDF is anisotropic.")
    else:  # any tangent will do; this one has no singular normal (Duff et al. 2017)
        x, y, z = normal[:, 0], normal[:, 1], normal[:, 2]
        sign = jnp.where(z < 0, -jnp.ones_like(z), jnp.ones_like(z))
        a = -1 / (sign + z)
        tangent = jnp.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x], axis=-1)
    frames = jnp.stack([tangent, jnp.cross(normal, tangent), normal], axis=1)
    return frames, jnp.sum(frames * view[:, None, :], axis=-1)


def integrand(brdf: AbstractBrdf, radiance: Radiance, frame: Array, wo: Array, wi: Array) -> Array:
    """value_cosine times radiance [..., *colour] at local directions [..., 3]; 0 when the view is below the horizon."""
    values = jax.vmap(lambda w: brdf.value_cosine(w, wo))(wi.reshape(-1, 3))
    values = values.reshape(wi.shape[:-1] + values.shape[1:])
    lead = wi.ndim - 1
    if callable(radiance):
        light = jnp.asarray(radiance(wi @ frame))
    else:
        light = jnp.asarray(radiance, values.dtype)
        light = light.reshape((1,) * lead + light.shape)
    product = times(values, light, lead)
    return jnp.where(wo[2] > 0, product, jnp.zeros_like(product))


def times(brdf_values: Array, radiance: Array, lead: int) -> Array:
    """Product of two arrays [*lead, *colour], either of which may lack the colour axis."""
    ndim = max(brdf_values.ndim, radiance.ndim)
    pad = lambda x: x.reshape(x.shape[:lead] + (1,) * (ndim - x.ndim) + x.shape[lead:])
    return pad(brdf_values) * pad(radiance)
