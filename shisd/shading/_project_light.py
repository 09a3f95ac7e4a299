"""The light that polygons and portals send to points, as an expansion: what precomputed transfer takes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._numerics import times
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Float
from shisd.domains import HaarBasis
from shisd.domains.internal import clip_to_cells, loop_coefficients, loop_solid_angle, on_sphere
from shisd.models.internal import facing, towards
from shisd.shading._incidence import Y_00
from shisd.shading._surface import masks
from shisd.shading._tiles import as_type, finite_mark, finite_or_nan, in_tiles, shade_points
from shisd.shading.paths._polygon import SMALL_TILE, Light, product_of, through


def project_light(
    light: Light, positions: ArrayLike, basis: int | HaarBasis, *, mask: ArrayLike | None = None
) -> Float[Array, "*batch_colour_n"]:
    """Coefficients of the radiance that a light sends to points, for precomputed transfer (CSH18 section 6.1).

    Arguments: a `PolygonLight` or `PortalLight`; `positions` [..., 3] in world space; static `basis`, the degree of
    spherical harmonics or a `domains.HaarBasis`; `mask` [...] as in `Surface`.
    Returns [..., *colour, n], the function of direction in world space, without a horizon: zero outside the outline,
    and everywhere for a point behind the light. A NaN anywhere gives NaN, with NaN gradients.
    Derivatives: in positions and all that the light is made of.
    Accuracy: exact; 1e-11 of the largest coefficient in float64 and 1e-4 in float32.
    Cost: moments to the degree of the basis plus that of the light; for Haar wavelets, in every cell.
    """
    if not isinstance(light, Light):
        raise ValueError(f"`light` must be a models.PolygonLight or PortalLight; got {type(light).__name__}.")
    if not isinstance(basis, HaarBasis):
        basis = _checks.integer("basis", basis)
    p = _checks.vectors("positions", positions)
    dtype = jnp.promote_types(p.dtype, light.points.dtype)
    light = as_type(light, dtype)
    return by_device(shade_points, {"positions": p.astype(dtype)} | masks(mask), _project, light, basis)


@eqx.filter_jit
def _project(
    points: dict[str, Float[Array, "p 3"]], light: Light, basis: int | HaarBasis
) -> Float[Array, " p *colour_n"]:
    incident, shared = light.incident(), finite_mark(light)
    product = None if isinstance(basis, HaarBasis) else product_of(light, basis)

    def project(tile: dict[str, Array]) -> Float[Array, " p *colour_n"]:
        relative = light.points.T[:, :, None] - tile["positions"].T[:, None]
        sign, v = facing(light, relative), on_sphere(relative)
        if isinstance(basis, HaarBasis):
            v = clip_to_cells(v, basis.levels)
            angle = loop_solid_angle(v, 2 * np.pi)
            integrals = incident @ loop_coefficients(v, angle, _checks.degree_of(incident.shape[-1]))
            c = basis.coefficients(integrals.reshape(*integrals.shape[:-1], -1, basis.size))
            c = jnp.swapaxes(c, -1, -2)  # [*colour, n, p], as below
        else:
            # close to a light its outline is nearly a hemisphere: which one, rounding must not decide
            angle = loop_solid_angle(v, 2 * np.pi, towards(light, relative))
            if product is None:
                c = times(loop_coefficients(v, angle, basis), (incident * Y_00)[..., None])
            else:
                c = through(product, v, angle)
        return finite_or_nan(jnp.moveaxis(times(c, sign), -1, 0), tile.values(), shared)

    size = 1 + 2048 // basis.size if isinstance(basis, HaarBasis) else SMALL_TILE
    return in_tiles(project, points, size)
