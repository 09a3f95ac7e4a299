"""Radiance from distant light: ISD15 Eq. 22 for batches of normals and views.

Eq. 22 sums, over rotated axes R z_k and bands, the lobe weights times the light convolved with that band's zonal
harmonic. By the addition theorem this is the product of the lobe's coefficients, turned to the world, with the light's
(`harmonics._pairing`). On a CPU that is fastest: Eq. 22 as it stands evaluates (L+1)^2 harmonics at 2L+1 axes per
pixel, and to turn the light is to turn three colours. tests/bench compares the candidates.

notation: R = (t, b, n) local to world; e = light coefficients.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Float
from shisd.harmonics.internal import pair_many, turned_series
from shisd.shading._surface import Surface, shade_points, shade_tiles, surface
from shisd.shading.slices._slices import Slices, check_slices, slice_orders

_NUMBERS_AT_ONCE = 3 << 18  # coefficients of slices in a tile: small ones keep one core busy, large ones leave caches
_LARGEST_TILE = 4096


def shade_environment(
    material: Slices,
    light_coefficients: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None = None,
    *,
    mask: ArrayLike | None = None,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer under distant light (ISD15 Eq. 22).

    Arguments: `material` from `tabulate_brdf`; `light_coefficients` [*colour, n], SH coefficients of the incident
    radiance in world space; `normals` and `views` [..., 3] in world space, of any length, pointing away from the
    surface; `tangents` [..., 3], the local x axis of anisotropic materials (needed for these, ignored for others; only
    its part along the surface counts); `mask` [...], bool: where it is False, radiance is 0 with gradient 0, whatever
    the other arrays hold there, as pixels of the background do. Colours of material and light broadcast: scalar or RGB.
    Bands that only one of the two has add nothing. Returns [..., *colour] in W/(m2 sr), or the light's unit. A view
    that is not above the horizon gives 0. A NaN anywhere, a zero normal or view, and a tangent along the normal give
    NaN, with NaN gradients.
    Derivatives: in every floating argument, both modes, any order, also where a normal lies along an axis of the world;
    where a view lies along its normal, the first. The cut at the horizon is a discontinuity of the view, with no
    gradient.
    Accuracy: Eq. 22 to 1e-5 in float32 and 1e-12 in float64, relative to the largest radiance.
    Cost: about L^3 products per pixel. The batch is filled up to one of few sizes, by at most an eighth (powers of two
    up to 64), so that a new number of pixels seldom compiles anything that takes long. Memory: one tile of at most 4096
    pixels, about 3 MB per array, and the result; the same with gradients.
    Source: ISD15 Eq. 20-22.
    """
    check_slices(material, everywhere=True)
    e, light_degree = _checks.expansion("light_coefficients", light_coefficients)
    light = [("light_coefficients", e.shape[:-1])]
    vectors = {"normals": normals, "views": views}
    material, points, colour = surface("material", material, tangents, light, [e.dtype], mask, **vectors)
    degree = min(light_degree, material.degree)
    e = e[..., : (degree + 1) ** 2].astype(material.coefficients.dtype)
    return by_device(shade_points, points, _shade, material, e, colour)


@eqx.filter_jit
def _shade(
    points: dict[str, Float[Array, "p 3"]], material: Slices, e: Float[Array, "*c n"], colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    return shade_slices(points, material, slice_orders(material, _checks.degree_of(e.shape[-1])), e, colour)


def shade_slices(
    points: dict[str, Float[Array, "p 3"]],
    material: Surface,
    look_up: Callable[[Float[Array, "p 3"]], tuple[Array, Array]],
    e: Float[Array, "*c n"],
    colour: tuple[int, ...],
) -> Float[Array, " p *colour"]:
    """Radiance from the slices that `look_up` gives for local views, in the order of `harmonics._pairing`."""
    degree = _checks.degree_of(e.shape[-1])
    series = turned_series(e.reshape(-1, e.shape[-1]), degree)

    def radiance(frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"]) -> Float[Array, "*colour p"]:
        to_local = jnp.swapaxes(frame, 1, 2)
        return pair_many(*look_up(local), series, to_local, degree, material.isotropic).reshape(*colour, -1)

    numbers = (degree + 1) ** 2 * int(np.prod(material.colour))
    size = min(_LARGEST_TILE, max(1, _NUMBERS_AT_ONCE // numbers))
    return shade_tiles(material, points, colour, size, radiance, e)
