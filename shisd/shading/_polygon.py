"""Radiance from polygon lights: CSH18 Eq. 12, in the local frame of every point.

The light's outline, relative to the point, is cut off at the horizon and projected on the sphere; the material's slice
is integrated over it exactly. With the slice as weights on zonal functions about shared axes this is one fused sum over
their moments (`domains._moments.fold`), and nothing per pixel is a matrix.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from shisd import _checks
from shisd._numerics import normalize
from shisd._typing import Array, Float
from shisd.domains import _moments
from shisd.domains._integrate import zonal_inverse
from shisd.domains._polygon import clip, loop_solid_angle
from shisd.models import PolygonLight
from shisd.shading._environment import _frame, _tangent_frame
from shisd.shading._lobes import Lobes, lookup_table, slice_values

_TILE = 128  # pixels at a time


def shade_polygon(
    lobes: Lobes,
    light: PolygonLight | Sequence[PolygonLight],
    positions: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None = None,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer, lit by polygons, without occlusion (CSH18 Eq. 12).

    Arguments: `lobes` from `tabulate_brdf`, best with domain="upper"; `light`, one or several; `positions` [..., 3] in
    world space; `normals`, `views` and, for anisotropic materials, `tangents` [..., 3], as in `shade_environment`.
    Returns [..., *colour] in the unit of the emission. What lies below the horizon of a point is cut off; a light
    wholly below it, seen from behind, or whose plane holds the point, adds 0, with gradient 0. A view below the horizon
    gives 0.
    Derivatives: in every floating argument: positions, outline and emission of the lights, material, frame.
    Accuracy: exact for the tabulated slice, to 1e-12 in float64 and 3e-5 of the largest radiance in float32. With
    domain="upper" and degree 20, against quadrature of the material itself: 1e-5 for Lambertian, 1e-4 for GGX of alpha
    0.5 (relative RMSE).
    Cost: moments at 2L+1 axes for every pixel, light and colour of the material. Memory: one tile of 128 pixels.
    """
    if not isinstance(lobes, Lobes):
        raise ValueError(f"`lobes` must come from shading.tabulate_brdf; got {type(lobes).__name__}.")
    lights = (light,) if isinstance(light, PolygonLight) else tuple(light)
    if not lights or not all(isinstance(x, PolygonLight) for x in lights):
        raise ValueError("`light` must be a models.PolygonLight or a sequence of at least one.")
    named = {"positions": positions, "normals": normals, "views": views}
    if not lobes.isotropic:
        if tangents is None:
            raise ValueError("`tangents` [..., 3] are needed: this material is anisotropic.")
        named["tangents"] = tangents
    arrays = {name: _checks.vectors(name, value) for name, value in named.items()}
    try:
        shape = np.broadcast_shapes(*(a.shape for a in arrays.values()))
        colour = np.broadcast_shapes(lobes.colour, *(x.emission.shape for x in lights))
    except ValueError as error:
        shapes = {name: list(a.shape) for name, a in arrays.items()}
        raise ValueError(f"batch axes {shapes}, or colours of `lobes` and `light`, do not broadcast.") from error
    dtype = jnp.result_type(lobes.weights, *arrays.values(), *(x.points for x in lights))
    flat = [jnp.broadcast_to(a.astype(dtype), shape).reshape(-1, 3) for a in arrays.values()]
    lobes, lights = jax.tree.map(lambda x: x.astype(dtype), (lobes, lights))
    return _shade(lobes, lights, *flat).reshape(*shape[:-1], *colour)


@eqx.filter_jit
def _shade(lobes: Lobes, lights: tuple[PolygonLight, ...], *frames: Float[Array, "p 3"]) -> Array:
    degree, table = lobes.degree, lookup_table(lobes)
    colour = np.broadcast_shapes(lobes.colour, *(x.emission.shape for x in lights))
    count = frames[0].shape[0]
    if count == 0:
        return jnp.zeros((0, *colour), table.dtype)
    size = min(count, _TILE)
    tiles = -(-count // size)
    fill = lambda a: jnp.concatenate([a, jnp.broadcast_to(a[-1:], (tiles * size - count, 3))]).reshape(tiles, size, 3)

    @jax.checkpoint
    def shade_tile(tile: tuple[Array, ...]) -> Float[Array, " p *colour"]:
        position, *directions = tile
        normal, view, *tangent = (normalize(a) for a in directions)
        r = _frame(normal) if lobes.isotropic else _tangent_frame(normal, tangent[0])
        local = jnp.einsum("pij,pi->pj", r, view)
        slices = slice_values(table, local, lobes).reshape(-1, table.shape[-2], size)
        weights = [_zonal_weights(s, degree) for s in slices]
        radiance = jnp.zeros((size, *colour), table.dtype)
        for light in lights:
            v, solid_angle, facing = _outline(light, position, r)
            constant = slices[:, 0] * (solid_angle * np.sqrt(1 / (4 * np.pi)))[None]
            axes = jnp.asarray(zonal_inverse(degree, v.dtype)[0])
            rest = jnp.stack([_moments.fold(w, axes, v, degree) for w in weights])
            lit = jnp.moveaxis(((constant + rest) * facing[None]).reshape(*lobes.colour, size), -1, 0)
            pad = (1,) * (len(colour) - len(lobes.colour))
            radiance += lit.reshape(size, *pad, *lobes.colour) * jnp.broadcast_to(light.emission, colour)[None]
        return jnp.where((local[:, 2] < 0).reshape(-1, *(1,) * len(colour)), 0, radiance)

    radiance = jax.lax.map(shade_tile, tuple(fill(a) for a in frames))
    return radiance.reshape(tiles * size, *colour)[:count]


def _outline(light: PolygonLight, position: Array, r: Array) -> tuple[Array, Array, Array]:
    """The light above the horizon on the local sphere, its solid angle, and -1 in front, 0 or 1 behind.

    In front of a light, its outline runs clockwise as seen from outside the sphere.
    """
    relative = light.points.T[:, :, None] - position.T[:, None]
    local = jnp.einsum("pij,isp->jsp", r, relative)
    outwards = jnp.cross(light.points, jnp.roll(light.points, -1, 0)).sum(axis=0)
    side = jnp.sign(outwards @ relative[:, 0])
    facing = side if light.two_sided else jnp.minimum(side, 0)
    facing = jnp.where(jnp.max(local[2], axis=0) > 0, facing, 0)
    points = clip(local, local[2])
    v = jnp.moveaxis(normalize(jnp.moveaxis(points, 0, -1)), -1, 0)
    up = jnp.broadcast_to(jnp.asarray([0, 0, 1], v.dtype)[:, None], (3, v.shape[2]))
    return v, loop_solid_angle(v, 2 * np.pi, up), facing


def _zonal_weights(c: Float[Array, "n p"], degree: int) -> Float[Array, "l k p"]:
    """Weights on the moments about the shared axes that integrate an expansion: lambda_l = (inverse_l)^T c_l."""
    _, inverse = zonal_inverse(degree, c.dtype)
    bands = [slice(l * l, (l + 1) ** 2) for l in range(degree + 1)]
    return jnp.stack([jnp.asarray(inverse[b].T) @ c[b] for b in bands])
