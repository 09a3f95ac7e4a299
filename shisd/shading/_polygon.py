"""Radiance from polygon lights and portals: CSH18 Eq. 12 to 14, in the local frame of every point.

The light's outline, relative to the point, is cut off at the horizon and projected on the sphere; the material's slice
is integrated over it exactly. With the slice as weights on zonal functions about shared axes this is one fused sum over
their moments (`domains.moments.fold`), and nothing per pixel is a matrix.

Where radiance depends on direction, the integrand is a product. Its matrix M, from the coefficients of a slice to those
of slice times light, is the same for all points; with b = integrals of the basis over the outline, the radiance is
b . M c, and M^T b are the coefficients of the light that comes through the outline. They are made in world space, and
only they are turned to the local frame.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._numerics import dot, normalize, times
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Float
from shisd.domains import HaarBasis
from shisd.domains.internal import (
    Loop,
    clip,
    clip_to_cells,
    fold_expansion,
    loop_coefficients,
    loop_solid_angle,
    on_sphere,
    zonal_inverse,
)
from shisd.harmonics.internal import bands, rotate_many
from shisd.models import PolygonLight, PortalLight
from shisd.models.internal import product_matrices
from shisd.shading._incidence import incidence_integrals
from shisd.shading._surface import (
    as_type,
    finite_mark,
    finite_or_nan,
    in_tiles,
    local_lights,
    masks,
    shade_points,
    shade_tiles,
    stacked,
    sum_lights,
    surface,
)
from shisd.shading.slices._slices import Slices, check_slices, lookup_factors, lookup_table, slice_values

Light = PolygonLight | PortalLight
_TILE = 2048  # pixels at a time
_SMALL_TILE = 128  # where every pixel holds the moments about all axes
_Y_00 = math.sqrt(1 / (4 * math.pi))


def shade_polygon(
    material: Slices,
    light: PolygonLight | Sequence[PolygonLight],
    positions: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None = None,
    *,
    mask: ArrayLike | None = None,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer, lit by polygons, without occlusion (CSH18 Eq. 12).

    Arguments: `material` from `tabulate_brdf`, best with domain="upper"; `light`, one or several; `positions` [..., 3]
    in world space; `normals`, `views` and, for anisotropic materials, `tangents` [..., 3], and `mask`, as in
    `shade_environment`. Returns [..., *colour] in the unit of the emission. What lies below the horizon of a point is
    cut off; a light wholly below it, seen from behind, or whose plane holds the point, adds 0, with gradient 0. A view
    that is not above the horizon gives 0. A NaN anywhere, or a zero normal or view, gives NaN, with NaN gradients.
    Derivatives: in every floating argument: positions, outline and emission of the lights, material, frame; the first
    exact for views along the normal as well, second ones not there.
    Accuracy: exact for the tabulated slice, to 1e-12 in float64 and 3e-5 of the largest radiance in float32. Against
    quadrature of the material itself, with domain="upper" and degree 20: relative RMSE below 3e-5 for Lambertian, 1e-4
    for GGX of alpha 0.5.
    Cost: moments at L+1 axes, 2L+1 for anisotropic materials, for every pixel, light and colour of the material; half
    as many edges again where the horizon cuts a light in any of 2048 pixels that follow each other, nothing where it is
    dark in all; of lights with a profile, that of `shade_portal`. Lights of equal shapes (corners, colours, profile)
    are one piece of compiled code, whatever their number. Memory: one tile of 2048 pixels, also for gradients.
    """
    return _shade_lights(material, light, PolygonLight, "light", positions, normals, views, tangents, mask)


def shade_portal(
    material: Slices,
    portal: PortalLight | Sequence[PortalLight],
    positions: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None = None,
    *,
    mask: ArrayLike | None = None,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer, lit by distant light through windows (CSH18 Eq. 13).

    Arguments: `portal`, one or several; the others and what is returned as in `shade_polygon`, in the unit of the
    distant light.
    Derivatives: in every floating argument: positions, outline and distant light of the portals, material, frame.
    Accuracy: exact for the tabulated slice and the expansion of the distant light, to 1e-12 in float64 and 3e-5 of the
    largest radiance in float32.
    Cost: for every pixel and portal, moments to degree Le + L at twice as many axes (CSH18 Eq. 14 needs all bands of
    the product), and for each colour a product with a matrix [(L+1)^2, (Le+L+1)^2], which is made once in every call.
    """
    return _shade_lights(material, portal, PortalLight, "portal", positions, normals, views, tangents, mask)


def project_light(
    light: Light, positions: ArrayLike, basis: int | HaarBasis, *, mask: ArrayLike | None = None
) -> Float[Array, "*batch_colour_n"]:
    """Coefficients of the radiance that a light sends to points, for precomputed transfer (CSH18 section 6.1).

    Arguments: a `PolygonLight` or `PortalLight`; `positions` [..., 3] in world space; static `basis`, the degree of
    spherical harmonics or a `domains.HaarBasis`; `mask` [...] as in `shade_environment`.
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


def _shade_lights(
    material: Slices,
    light: Light | Sequence[Light],
    kind: type,
    name: str,
    positions: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None,
    mask: ArrayLike | None,
) -> Float[Array, "*batch_colour"]:
    check_slices(material, everywhere=False)
    lights = local_lights(name, light, kind)
    colours = [(f"{name} {i}", x.colour) for i, x in enumerate(lights)]
    vectors = {"positions": positions, "normals": normals, "views": views}
    dtypes = [x.points.dtype for x in lights]
    material, points, colour = surface("material", material, tangents, colours, dtypes, mask, **vectors)
    lights = as_type(lights, material.coefficients.dtype)
    return by_device(shade_points, points, _shade, material, lights, colour)


@eqx.filter_jit
def _shade(
    points: dict[str, Float[Array, "p 3"]], material: Slices, lights: tuple[Light, ...], colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    table = lookup_table(material)
    kinds = stacked(lights)
    stacks = [(stack, _products(stack, material.degree)) for stack in kinds]

    def radiance(
        frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"], positions: Float[Array, "p 3"]
    ) -> Float[Array, "*colour p"]:
        zero = jnp.zeros((*colour, positions.shape[0]), table.dtype)

        def of_light(one: tuple[Light, Array | None]) -> Float[Array, "*colour p"]:
            light, product = one
            relative = light.points.T[:, :, None] - positions.T[:, None]
            above = dot(frame[:, :, 2].T[:, None], relative)
            sign = jnp.where(jnp.max(above, axis=0) > 0, _facing(light, relative), 0)
            outline = _in_frame(frame, relative)
            if product is None:
                lit = times(_uniform(material, table, local, outline, above, sign), _constant_radiance(light))
            else:
                lit = _directional(material, table, frame, local, outline, product)
            return jnp.broadcast_to(times(lit, sign), zero.shape)

        return sum_lights(of_light, stacks, zero)

    size = _TILE if all(product is None for _, product in stacks) else _SMALL_TILE
    return shade_tiles(material, points, colour, size, radiance, kinds)


def _uniform(material: Slices, table: Array, local: Array, outline: Loop, above: Array, sign: Array) -> Array:
    """Integrals of slices over the outline above the horizon, [*colour, p]."""
    dark = sign == 0
    spare = outline.shape[1] // 2  # edges, unless the horizon cuts an outline of this tile

    def integrals() -> Float[Array, "*colour p"]:
        whole = lambda: jnp.concatenate([outline, *[outline[:, :1]] * spare], axis=1)
        all_whole = jnp.all((jnp.min(above, axis=0) > 0) | dark)
        v = on_sphere(jax.lax.cond(all_whole, whole, lambda: clip(outline, above)))
        angle = loop_solid_angle(v, 2 * np.pi, _up(v))
        if material.isotropic:
            constant, of_colours = table[..., 0, :] @ lookup_factors(local, material), table
            of_one = lambda t: incidence_integrals(t, local, v, material.degree, spare)
        else:
            of_colours = slice_values(table, local, material)
            constant, inverse = of_colours[..., 0, :], zonal_inverse(material.degree, table.dtype)
            of_one = lambda c: fold_expansion(c, v, *inverse, spare)
        # colours in a loop: compiled code would grow with their number
        rest = jax.lax.map(of_one, of_colours) if material.colour else of_one(of_colours)
        return times(constant, angle * _Y_00) + rest

    nothing = lambda: jnp.zeros((*material.colour, len(local)), table.dtype)
    return jax.lax.cond(jnp.all(dark), nothing, integrals)


def _directional(
    material: Slices, table: Array, frame: Array, local: Array, outline: Loop, product: Float[Array, "*colour_n_m"]
) -> Float[Array, "*colour p"]:
    """Integrals of slices times the light's radiance, over its outline above the horizon."""
    c, v = slice_values(table, local, material), on_sphere(clip(outline, outline[2]))
    to_local = jnp.swapaxes(frame, 1, 2)
    world = _in_frame(to_local, v)
    seen = _through(product, world, loop_solid_angle(v, 2 * np.pi, _up(v))).reshape(-1, c.shape[-2], v.shape[2])
    seen = rotate_many(jnp.moveaxis(seen, 0, 1), to_local, material.degree, material.isotropic)
    seen = jnp.moveaxis(seen, 1, 0).reshape(*product.shape[:-2], *c.shape[-2:])
    return jnp.sum(times(c, seen), axis=-2)


@eqx.filter_jit
def _project(
    points: dict[str, Float[Array, "p 3"]], light: Light, basis: int | HaarBasis
) -> Float[Array, " p *colour_n"]:
    incident, shared = incident_radiance(light), finite_mark(light)
    product = None if isinstance(basis, HaarBasis) else _product(light, basis)

    def project(tile: dict[str, Array]) -> Float[Array, " p *colour_n"]:
        relative = light.points.T[:, :, None] - tile["positions"].T[:, None]
        sign, v = _facing(light, relative), on_sphere(relative)
        if isinstance(basis, HaarBasis):
            v = clip_to_cells(v, basis.levels)
            angle = loop_solid_angle(v, 2 * np.pi)
            integrals = incident @ loop_coefficients(v, angle, _checks.degree_of(incident.shape[-1]))
            c = basis.coefficients(integrals.reshape(*integrals.shape[:-1], -1, basis.size))
            c = jnp.swapaxes(c, -1, -2)  # [*colour, n, p], as below
        else:
            # close to a light its outline is nearly a hemisphere: which one, rounding must not decide
            angle = loop_solid_angle(v, 2 * np.pi, _towards(light, relative))
            if product is None:
                c = times(loop_coefficients(v, angle, basis), _constant_radiance(light)[..., None])
            else:
                c = _through(product, v, angle)
        return finite_or_nan(jnp.moveaxis(times(c, sign), -1, 0), tile.values(), shared)

    size = 1 + 2048 // basis.size if isinstance(basis, HaarBasis) else _SMALL_TILE
    return in_tiles(project, points, size)


def _facing(light: Light, relative: Loop) -> Float[Array, " p"]:
    """-1 in front of a light, where its outline runs clockwise as seen from outside the sphere; 0 or 1 behind it."""
    side = jnp.sign(_normal(light) @ relative[:, 0])
    return side if light.two_sided else jnp.minimum(side, 0)


def _normal(light: Light) -> Float[Array, "3"]:
    """Normal of a light's plane, of any length: of differences to a vertex, exact far from the origin."""
    edges = light.points - light.points[:1]
    return jnp.cross(edges, jnp.roll(edges, -1, 0)).sum(axis=0)


def _towards(light: Light, relative: Loop) -> Float[Array, "3 p"]:
    """Directions from points straight to a light's plane: no vertex is more than a quarter turn away."""
    normal = normalize(_normal(light))
    return normal[:, None] * jnp.sign(normal @ relative[:, 0])[None]


def _up(v: Loop) -> Float[Array, "3 p"]:
    return jnp.broadcast_to(jnp.asarray([0, 0, 1], v.dtype)[:, None], (3, v.shape[2]))


def _in_frame(frame: Float[Array, "p 3 3"], v: Loop) -> Loop:
    """frame^T v, written out: XLA has no fast code for many small products."""
    return jnp.stack([dot(axis[:, None], v) for axis in jnp.moveaxis(frame, 0, -1).swapaxes(0, 1)])


def incident_radiance(light: Light) -> Float[Array, "*colour_n"]:
    """SH coefficients of the radiance that comes through the outline, by the direction it comes from."""
    if isinstance(light, PortalLight):
        return light.coefficients
    if light.profile is None:
        return light.emission[..., None] / _Y_00
    parity = (-1.0) ** bands(_checks.degree_of(light.profile.shape[-1]))
    return times(times(light.profile, jnp.asarray(parity, light.profile.dtype)), light.emission[..., None])


def _constant_radiance(light: Light) -> Float[Array, "*colour 1"]:
    return incident_radiance(light) * _Y_00


def _products(stack: Light, degree: int) -> Float[Array, " lights *colour_n_m"] | None:
    return jax.lax.map(lambda light: _product(light, degree), stack)


def _product(light: Light, degree: int) -> Float[Array, "*colour_n_m"] | None:
    """From coefficients of a slice to those of slice times light; None where light is constant."""
    incident = incident_radiance(light)
    light_degree = _checks.degree_of(incident.shape[-1])
    return None if light_degree == 0 else product_matrices(incident, light_degree + degree, degree)


def _through(product: Float[Array, "*colour_n_m"], v: Loop, solid_angle: Array) -> Float[Array, "*c n p"]:
    """Coefficients of a light cut off outside loops."""
    b = loop_coefficients(v, solid_angle, _checks.degree_of(product.shape[-2]))
    return jnp.einsum("...tn,tp->...np", product, b)
