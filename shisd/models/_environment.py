"""Distant light from all around: an equirectangular map of radiance."""

import os
import warnings
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from shisd import _checks, harmonics, io
from shisd._module import Module
from shisd._typing import Array, ArrayLike, Float


def _map(value: ArrayLike) -> Array:
    texels = _checks.real_array("texels", value)
    shape = list(texels.shape)
    if texels.ndim not in (2, 3) or (texels.ndim == 3 and texels.shape[2] != 3):
        raise ValueError(f"`texels` must have shape [H, 2H] or [H, 2H, 3]; got {shape}. Use jax.vmap for batches.")
    if texels.shape[0] == 0 or texels.shape[1] != 2 * texels.shape[0]:
        raise ValueError(f"`texels` must be twice as wide as high: an equirectangular map of the sphere; got {shape}.")
    return texels


class Environment(Module):
    """Radiance from every direction, as texels of an equirectangular map.

    Texel (j, i) of [H, W = 2H] is centred at theta = pi (j + 1/2) / H from +z and phi = 2 pi (i + 1/2) / W from +x
    towards +y: row 0 touches the zenith. Directions point away from the surface, to the light.

    Arguments: `texels` [H, 2H] or [H, 2H, 3], W/(m2 sr) or linear RGB. Their values are not checked here; `load` does.
    Errors: ValueError for a map that is not 2:1. Derivatives: in the texels and in directions.
    """

    texels: Float[Array, "h w *colour"] = eqx.field(converter=_map)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        bad_texels: Literal["clamp", "refuse"] = "clamp",
        dtype: DTypeLike = np.float32,
    ) -> "Environment":
        """The map in an OpenEXR or Radiance file (`shisd.io.read_image`).

        Convention: row 0 is the zenith, +z; the left edge is +x and columns turn towards +y, counter-clockwise seen
        from above. A panorama seen from inside turns clockwise, so its scene appears mirrored; where that matters, pass
        `Environment(texels[:, ::-1])`. Programs that put their first and last rows onto the poles (Mitsuba 3.9) differ
        by half a texel.

        Texels that are no radiance are counted: with `bad_texels="clamp"` NaN becomes 0, infinity the largest finite
        value of the map, negative values 0, and a UserWarning gives the counts; `bad_texels="refuse"` raises
        ValueError.
        Other errors: as `read_image`, and ValueError for a map that is not 2:1 or has no finite value.
        """
        if bad_texels not in ("clamp", "refuse"):
            raise ValueError(f'`bad_texels` must be "clamp" or "refuse"; got {bad_texels!r}.')
        texels = io.read_image(path)
        height, width = texels.shape[:2]
        if width != 2 * height:
            raise ValueError(f"{os.fspath(path)}: an environment is twice as wide as high; this is {width} x {height}.")
        colours = texels.reshape(height * width, -1)
        nan, infinite, negative = np.isnan(colours), np.isinf(colours), (colours < 0) & np.isfinite(colours)
        if np.any(nan | infinite | negative):
            counts = ", ".join(
                f"{np.sum(np.any(bad, axis=1))} {name}"
                for name, bad in (("NaN", nan), ("infinite", infinite), ("negative", negative))
            )
            found = f"{os.fspath(path)}: {counts} texels of {height * width}"
            if bad_texels == "refuse":
                raise ValueError(f'{found}. Pass bad_texels="clamp" to replace them.')
            finite = np.isfinite(texels)
            if not finite.any():
                raise ValueError(f"{found}: no finite value is left.")
            largest = max(float(np.max(texels[finite])), 0.0)
            texels = np.clip(np.nan_to_num(texels, nan=0.0, posinf=largest), 0, None)
            warnings.warn(f"{found} set to 0, {largest:.6g} and 0.", UserWarning, stacklevel=2)
        array = jnp.asarray(texels.astype(dtype))
        if array.dtype != np.dtype(dtype):
            raise ValueError(f"`dtype` {np.dtype(dtype)} needs jax_enable_x64.")
        return cls(array)

    @classmethod
    def from_function(
        cls, function: Callable[[Float[Array, "count 3"]], Float[Array, "count ..."]], height: int
    ) -> "Environment":
        """The map of [height, 2 height] texels whose centres hold function(directions [N, 3]), [N] or [N, 3]."""
        height = _checks.integer("height", height, minimum=1)
        directions = jnp.asarray(_directions(height), jnp.result_type(float)).reshape(-1, 3)
        values = _checks.real_array("function(directions)", function(directions))
        if values.shape not in ((len(directions),), (len(directions), 3)):
            raise ValueError(f"`function` must map [{len(directions)}, 3] to [N] or [N, 3]; got {list(values.shape)}.")
        return cls(values.reshape(height, 2 * height, *values.shape[1:]))

    def directions(self) -> Float[Array, "h w 3"]:
        """The directions of the texel centres."""
        return jnp.asarray(_directions(len(self.texels)), self.texels.dtype)

    def solid_angles(self) -> Float[Array, " h"]:
        """The solid angle of one texel of each row, in sr, exact; times W they sum to 4 pi."""
        height = len(self.texels)
        step = np.pi / height
        angles = 2 * np.sin(step * (np.arange(height) + 0.5)) * np.sin(step / 2) * (2 * np.pi / (2 * height))
        return jnp.asarray(angles, self.texels.dtype)

    def coefficients(self, degree: int) -> Float[Array, "*colour n"]:
        """SH coefficients [*colour, (degree + 1)^2] of the map (`shisd.harmonics.project_map`)."""
        return harmonics.project_map(self.texels, degree)

    def radiance(self, directions: ArrayLike) -> Float[Array, "*batch_and_colour"]:
        """Radiance [..., *colour] from directions [..., 3], bilinear between texel centres.

        phi wraps around; next to a pole the row beyond is the same row half a turn away. Directions of any length are
        accepted. Output dtype is that of the directions. Derivatives: in texels and directions; those in directions
        jump between texels. At a pole itself phi is taken as 0 and derivatives in directions are zero.
        """
        return harmonics.sample_map(self.texels, directions)


def _directions(height: int) -> np.ndarray:
    """Texel centres [H, 2H, 3] in float64."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = np.pi * (np.arange(2 * height) + 0.5) / height
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None]
    return np.stack(np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), cosine), axis=-1)
