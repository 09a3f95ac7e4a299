"""Radiance from distant light: ISD15 Eq. 22 for batches of normals and views.

Eq. 22 sums, over rotated axes R z_k and bands, the lobe weights times the light convolved with that band's zonal
harmonic. By the addition theorem this is the product of the lobe's coefficients, turned to the world, with the light's
(`harmonics._pairing`). On a CPU that is fastest: Eq. 22 as it stands evaluates (L+1)^2 harmonics at 2L+1 axes per
pixel, and to turn the light is to turn three colours. tests/bench compares the candidates.

notation: R = (t, b, n) local to world; e = light coefficients.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._sharding import by_device
from shisd._typing import Array, Float
from shisd.harmonics.internal import pair_many, turned_series
from shisd.models import DistantLight
from shisd.shading._material import distant_form
from shisd.shading._matrix import BrdfMatrix, matrix_orders
from shisd.shading._surface import Surface
from shisd.shading._tiles import padded, shade_points, shade_tiles
from shisd.shading.paths._path import Path
from shisd.shading.slices._slices import Slices, slice_orders

_NUMBERS_AT_ONCE = 3 << 18  # coefficients of slices in a tile: small ones keep one core busy, large ones leave caches
_LARGEST_TILE = 4096


def radiance(
    form: Slices | BrdfMatrix, lights: list[DistantLight], points: dict[str, Array], _: Surface
) -> Float[Array, "*batch_colour"]:
    e = sum_distant(lights, form.degree)
    return by_device(shade_points, points, _shade, form, e, np.broadcast_shapes(form.colour, e.shape[:-1]))


PATH = Path(distant_form, radiance, local=False)


def sum_distant(lights: list[DistantLight], degree: int) -> Float[Array, "*colour n"]:
    """All lights together, up to the highest of their degrees and at most `degree`."""
    size = (min(degree, max(light.degree for light in lights)) + 1) ** 2
    colour = np.broadcast_shapes(*(light.colour for light in lights))
    return functools.reduce(jnp.add, (padded(light.coefficients, size, colour) for light in lights))


@eqx.filter_jit
def _shade(
    points: dict[str, Float[Array, "p 3"]], form: Slices | BrdfMatrix, e: Float[Array, "*c n"], colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    degree = _checks.degree_of(e.shape[-1])
    look_up = slice_orders(form, degree) if isinstance(form, Slices) else matrix_orders(form, degree)
    series = turned_series(e.reshape(-1, e.shape[-1]), degree)

    def of_tile(frame: Float[Array, "p 3 3"], local: Float[Array, "p 3"]) -> Float[Array, "*colour p"]:
        to_local = jnp.swapaxes(frame, 1, 2)
        return pair_many(*look_up(local), series, to_local, degree, form.isotropic).reshape(*colour, -1)

    numbers = (degree + 1) ** 2 * int(np.prod(form.colour))
    size = min(_LARGEST_TILE, max(1, _NUMBERS_AT_ONCE // numbers))
    return shade_tiles(form, points, colour, size, of_tile, e)
