"""Radiance from distant light: ISD15 Eq. 22 for batches of normals and views.

Eq. 22 sums, over rotated axes R z_k and bands, the lobe weights times the light convolved with that band's zonal
harmonic. By the addition theorem this is the product of the lobe's coefficients with the light's coefficients in the
local frame. On a CPU the latter is fastest: turning the light is two products with constant matrices, shared by every
lobe axis, where Eq. 22 as it stands evaluates (L+1)^2 harmonics at 2L+1 axes per pixel. tests/bench compares the
candidates.

notation: R = (t, b, n) local to world; e = light coefficients; R^T e = light in the local frame.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from shisd import _checks
from shisd._numerics import normalize
from shisd._typing import Array, Float
from shisd.harmonics._rotation import rotate_many
from shisd.shading._lobes import Lobes, lookup_table, slice_values

_NUMBERS_AT_ONCE = 1 << 19  # coefficients of turned light held at a time: what one tile of pixels needs stays in cache


def shade_environment(
    lobes: Lobes,
    light_coefficients: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None = None,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer under distant light (ISD15 Eq. 22).

    Arguments: `lobes` from `tabulate_brdf`; `light_coefficients` [*colour, n], SH coefficients of the incident
    radiance in world space; `normals` and `views` [..., 3] in world space, of any length, pointing away from the
    surface; `tangents` [..., 3], the local x axis of anisotropic materials (needed for these, ignored for others; only
    its part along the surface counts). Colours of lobes and light broadcast: scalar or RGB. Bands that only one of the
    two has add nothing. Returns [..., *colour] in W/(m2 sr), or the light's unit. A view below the horizon gives 0; a
    zero or NaN normal or view gives NaN.
    Derivatives: in every floating argument, both modes, any order; smooth where a view lies along its normal and where
    a normal lies along any axis of the world. The cut at the horizon is a discontinuity of the view, with no gradient.
    Accuracy: Eq. 22 to 1e-5 in float32 and 1e-12 in float64, relative to the largest radiance.
    Cost: about L^3 products per pixel. Memory: one tile of at most 2048 pixels, about 2 MB per array, and the
    result; the same with gradients.
    Source: ISD15 Eq. 20-22.
    """
    if not isinstance(lobes, Lobes):
        raise ValueError(f"`lobes` must come from shading.tabulate_brdf; got {type(lobes).__name__}.")
    if lobes.domain != "sphere":
        raise ValueError("`lobes` were fitted above the horizon only; tabulate them with domain='sphere'.")
    e, light_degree = _checks.coefficients("light_coefficients", light_coefficients)
    if e.ndim > 2:
        raise ValueError(f"`light_coefficients` must have shape [n] or [colour, n]; got {list(e.shape)}.")
    named = {"normals": normals, "views": views}
    if not lobes.isotropic:
        if tangents is None:
            raise ValueError("`tangents` [..., 3] are needed: this material is anisotropic.")
        named["tangents"] = tangents
    arrays = {name: _checks.vectors(name, value) for name, value in named.items()}
    shapes = {name: list(a.shape) for name, a in arrays.items()}
    try:
        shape = np.broadcast_shapes(*(a.shape for a in arrays.values()))
        colour = np.broadcast_shapes(lobes.colour, e.shape[:-1])
    except ValueError as error:
        raise ValueError(
            f"batch axes {shapes}, or colours of `lobes` {list(lobes.colour)} and `light_coefficients` "
            f"{list(e.shape[:-1])}, do not broadcast."
        ) from error
    dtype = jnp.result_type(lobes.weights, e, *arrays.values())
    frames = [jnp.broadcast_to(a.astype(dtype), shape).reshape(-1, 3) for a in arrays.values()]
    degree = min(light_degree, lobes.degree)
    lobes = jax.tree.map(lambda x: x.astype(dtype), lobes)
    radiance = _shade(lobes, e[..., : (degree + 1) ** 2].astype(dtype), *frames)
    return radiance.reshape(*shape[:-1], *colour)


@eqx.filter_jit
def _shade(lobes: Lobes, e: Float[Array, "*c n"], *frames: Float[Array, "p 3"]) -> Float[Array, " p *colour"]:
    degree = int(np.sqrt(e.shape[-1])) - 1
    table = lookup_table(lobes, degree)
    colour = np.broadcast_shapes(lobes.colour, e.shape[:-1])
    count = frames[0].shape[0]
    if count == 0:
        return jnp.zeros((0, *colour), e.dtype)
    size = min(count, 2048, 1 << max(1, _NUMBERS_AT_ONCE // e.size).bit_length() - 1)
    tiles = -(-count // size)
    fill = lambda a: jnp.concatenate([a, jnp.broadcast_to(a[-1:], (tiles * size - count, 3))]).reshape(tiles, size, 3)

    @jax.checkpoint
    def shade_tile(tile: tuple[Array, ...]) -> Float[Array, " p *colour"]:
        normal, view, *tangent = (normalize(a) for a in tile)
        r = _frame(normal) if lobes.isotropic else _tangent_frame(normal, tangent[0])
        light = rotate_many(e.reshape(-1, e.shape[-1]), jnp.swapaxes(r, 1, 2), degree, lobes.isotropic)
        local = jnp.einsum("pij,pi->pj", r, view)
        slices = slice_values(table, local, lobes)  # [*colour, n, p]
        light = jnp.moveaxis(light.reshape(light.shape[0], *e.shape[:-1], size), 0, -2)
        shape = (*colour, *light.shape[-2:])
        radiance = jnp.sum(jnp.broadcast_to(slices, shape) * jnp.broadcast_to(light, shape), axis=-2)
        return jnp.where((local[:, 2] < 0).reshape(-1, *(1,) * len(colour)), 0, jnp.moveaxis(radiance, -1, 0))

    radiance = jax.lax.map(shade_tile, tuple(fill(a) for a in frames))
    return radiance.reshape(tiles * size, *radiance.shape[2:])[:count]


@jax.custom_jvp
def _frame(normal: Float[Array, "p 3"]) -> Float[Array, "p 3 3"]:
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


@_frame.defjvp
def _frame_jvp(primals, tangents):
    (normal,), (dn,) = primals, tangents
    r = _frame(normal)
    return r, jnp.cross(jnp.cross(normal, dn)[:, :, None], r, axis=1)


def _tangent_frame(normal: Float[Array, "p 3"], tangent: Float[Array, "p 3"]) -> Float[Array, "p 3 3"]:
    """R = (t, b, n), t along the part of the tangent that is orthogonal to n."""
    t = normalize(tangent - jnp.sum(normal * tangent, axis=-1, keepdims=True) * normal)
    return jnp.stack([t, jnp.cross(normal, t), normal], axis=-1)
