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

from shisd._numerics import normalize
from shisd._typing import Array, Float
from shisd.domains import _moments
from shisd.domains._integrate import zonal_inverse
from shisd.domains._polygon import clip, loop_solid_angle
from shisd.models import PolygonLight
from shisd.shading._lobes import Lobes, lookup_table
from shisd.shading._surface import shade_tiles, surface

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
    emission = [(f"light {i}", x.emission.shape) for i, x in enumerate(lights)]
    dtypes = [x.points.dtype for x in lights]
    vectors = {"positions": positions, "normals": normals, "views": views}
    lobes, points, shape, colour = surface(lobes, tangents, emission, dtypes, **vectors)
    lights = jax.tree.map(lambda x: x.astype(lobes.weights.dtype), lights)
    return _shade(lobes, lights, points, colour).reshape(*shape, *colour)


@eqx.filter_jit
def _shade(
    lobes: Lobes,
    lights: tuple[PolygonLight, ...],
    points: dict[str, Float[Array, "p 3"]],
    colour: tuple[int, ...],
) -> Float[Array, " p *colour"]:
    degree, table = lobes.degree, lookup_table(lobes)
    axes = jnp.asarray(zonal_inverse(degree, table.dtype)[0])

    def radiance(
        frame: Float[Array, "p 3 3"], slices: Float[Array, "*s n p"], positions: Float[Array, "p 3"]
    ) -> Float[Array, "*colour p"]:
        slices = slices.reshape(-1, *slices.shape[-2:])
        weights = [_zonal_weights(s, degree) for s in slices]
        total = jnp.zeros((*colour, positions.shape[0]), table.dtype)
        for light in lights:
            v, solid_angle, facing = _outline(light, positions, frame)
            constant = slices[:, 0] * (solid_angle * np.sqrt(1 / (4 * np.pi)))[None]
            rest = jnp.stack([_moments.fold(w, axes, v, degree) for w in weights])
            lit = ((constant + rest) * facing[None]).reshape(*lobes.colour, -1)
            total += jnp.broadcast_to(lit, total.shape) * jnp.broadcast_to(light.emission[..., None], total.shape)
        return total

    return shade_tiles(lobes, table, points, colour, _TILE, radiance)


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
