"""Local frames: the normal as z axis, and any or a given direction as x axis."""

import jax
import jax.numpy as jnp

from shisd._numerics import normalize
from shisd._typing import Array, Float

_PARALLEL = 100  # eps, sine of the angle between tangent and normal below which two digits of the frame are not left


@jax.custom_jvp
def frame(normal: Float[Array, "p 3"]) -> Float[Array, "p 3 3"]:
    """R with R z = n and R^T z = (sin, 0, cos), for isotropic materials, which do not mind a turn about n.

    No choice of such frames is smooth everywhere. But what they are used for does not depend on the choice, so its
    derivative may follow any: the frame that turns no more than the normal does, about n x dn.
    """
    x, y, z = normal[:, 0], normal[:, 1], normal[:, 2]
    rho = jnp.sqrt(x * x + y * y)
    safe = jnp.where(rho > 0, rho, 1)
    cos, sin, zero = jnp.where(rho > 0, x / safe, 1), y / safe, jnp.zeros_like(x)
    rows = [[-cos * z, sin, x], [-sin * z, -cos, y], [rho, zero, z]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


@frame.defjvp
def _frame_jvp(primals, tangents):
    (normal,), (dn,) = primals, tangents
    r = frame(normal)
    return r, jnp.cross(jnp.cross(normal, dn)[:, :, None], r, axis=1)


def tangent_frame(normal: Float[Array, "p 3"], tangent: Float[Array, "p 3"]) -> Float[Array, "p 3 3"]:
    """R = (t, b, n), t along the part of the unit tangent that is orthogonal to n; NaN where only rounding is left."""
    t = tangent - jnp.sum(normal * tangent, axis=-1, keepdims=True) * normal
    parallel = jnp.sum(t * t, axis=-1, keepdims=True) <= (_PARALLEL * jnp.finfo(t.dtype).eps) ** 2
    t = normalize(jnp.where(parallel, jnp.nan, 1) * t)
    return jnp.stack([t, jnp.cross(normal, t), normal], axis=-1)
