"""Distant light from all around: an equirectangular map of radiance."""

import os
import warnings
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from shisd import _checks, harmonics, io
from shisd._module import Module
from shisd._typing import Array, ArrayLike, DTypeLike, Float
from shisd.harmonics.internal import sample_map
from shisd.models.lights._distant import DistantLight


def _map(value: ArrayLike) -> Array:
    texels = _checks.any_array("texels", value)
    if jnp.issubdtype(texels.dtype, jnp.integer):
        raise ValueError(f"`texels` must be linear radiance in float32 or float64; got dtype {texels.dtype}.")
    texels = _checks.real_array("texels", texels)
    shape = list(texels.shape)
    if texels.ndim not in (2, 3) or (texels.ndim == 3 and texels.shape[2] != 3):
        raise ValueError(f"`texels` must have shape [H, 2H] or [H, 2H, 3]; got {shape}. Use jax.vmap for batches.")
    if texels.shape[0] == 0 or texels.shape[1] != 2 * texels.shape[0]:
        raise ValueError(f"`texels` must be twice as wide as high: an equirectangular map of the sphere; got {shape}.")
    return texels


class Environment(Module):
    """Radiance from every direction, as texels of an equirectangular map.

    Texel (j, i) of [H, W = 2H] is centred at theta = pi (j + 1/2) / H from +z and phi = 2 pi (i + 1/2) / W from +x
    towards +y: row 0 touches the zenith. It is the mean radiance over its cell, as in a photograph, so that its power
    is texel times solid angle, of which `coefficients`, `radiance`, `solid_angles` and `shisd.reference` all know.
    Directions point away from the surface, to the light.

    Arguments: `texels` [H, 2H] or [H, 2H, 3], W/(m2 sr) or linear RGB. Their values are not checked here; `load` does.
    Errors: ValueError for a map that is not 2:1, and for integers, which are no radiance yet: make an 8-bit picture
    linear first. Derivatives: in the texels and in directions.
    """

    texels: Float[Array, "h w *colour"] = eqx.field(converter=_map)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        source: Literal["shisd", "blender", "radiance", "mitsuba", "filament", "three.js"] = "shisd",
        up: Literal["y", "z"] | None = None,
        bad_texels: Literal["clamp", "refuse"] = "clamp",
        layer: str | None = None,
        dtype: DTypeLike = np.float32,
    ) -> "Environment":
        """The map in an OpenEXR or Radiance file (`shisd.io.read_image`), turned as the program `source` shows it.

        - "shisd": row 0 is the zenith, +z; the left edge is +x and columns turn towards +y, counter-clockwise seen from
          above. A panorama seen from inside turns clockwise: read like this, its scene is mirrored.
        - "blender" (Cycles): +z up, the middle of the picture is +x, and columns turn from -x over +y to +x.
        - "radiance": the same, as rtrace makes pictures by `view360stereo.cal` (one eye's half). Maps of `genssky` turn
          the other way, from -x over -y to +x.
        - "mitsuba" (3.9): its own frame has +y up, and `up="y"` takes it as (z, x, y), so that the zenith is +z here
          too: the middle of the picture is +x, where Mitsuba has +z. `up="z"` is for scenes whose emitter is turned by
          rotate([1, 0, 0], 90): directions are then those of the scene, the middle of the picture is -y. Mitsuba puts
          the first and last rows onto the poles: up to half a texel of difference in theta.
        - "filament", mirrored as its cmgen does unless told not to: as "mitsuba", with texels where they are here.
        - "three.js": +y up too; the middle of the picture is its +x, which is +y here, or +x with `up="z"`.
        `up` is the axis that is up in the scene of `source`; by default that of the program itself. A map has its poles
        on this axis; a texel stays what it is. `layer` is that of `read_image`.

        Texels that are no radiance are counted: with `bad_texels="clamp"` NaN becomes 0, infinity the largest finite
        value of the map or of half precision, 65504, whichever is more, negative values 0, and a UserWarning gives the
        counts; `bad_texels="refuse"` raises ValueError.
        Other errors: as `read_image`, and ValueError for a map that is not 2:1 or has no finite value.
        Source: Cycles' direction_to_equirectangular; Radiance's src/cal/cal/view360stereo.cal; Mitsuba's envmap, which
        the tests ask; Filament's equirectangularToCubemap and mirrorCubemap (libs/ibl); three.js' equirectUv.
        """
        if source not in _LEFT_EDGE:
            raise ValueError(f"`source` must be one of {', '.join(map(repr, _LEFT_EDGE))}; got {source!r}.")
        left_edge = _LEFT_EDGE[source]
        if up is not None and up not in left_edge:
            raise ValueError(f"`up` must be {' or '.join(map(repr, left_edge))} for source={source!r}; got {up!r}.")
        if bad_texels not in ("clamp", "refuse"):
            raise ValueError(f'`bad_texels` must be "clamp" or "refuse"; got {bad_texels!r}.')
        texels = io.read_image(path, layer=layer)
        height, width = texels.shape[:2]
        if width != 2 * height:
            raise ValueError(f"{os.fspath(path)}: an environment is twice as wide as high; this is {width} x {height}.")
        if (turn := left_edge[up or next(iter(left_edge))]) is not None:
            if turn * width % 1:
                raise ValueError(f"{os.fspath(path)}: a height that is even is needed to turn the map; it is {height}.")
            texels = np.roll(texels[:, ::-1], round(turn * width), axis=1)
        array = jnp.asarray(_as_radiance(texels, os.fspath(path), bad_texels).astype(dtype))
        if array.dtype != np.dtype(dtype):
            raise ValueError(f"`dtype` {np.dtype(dtype)} needs jax_enable_x64.")
        return cls(array)

    @classmethod
    def from_function(
        cls, function: Callable[[Float[Array, "count 3"]], Float[Array, "count ..."]], height: int
    ) -> "Environment":
        """The map of [height, 2 height] texels that hold function(directions [N, 3]), [N] or [N, 3], at their centres.

        That is its mean over a texel to second order in the size of texels.
        """
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
        from_pole = np.minimum(np.arange(height), np.arange(height)[::-1]) + 0.5
        angles = 2 * np.sin(step * from_pole) * np.sin(step / 2) * step
        return jnp.asarray(angles, self.texels.dtype)

    def coefficients(self, degree: int, *, texels: Literal["cells", "samples"] = "cells") -> Float[Array, "*colour n"]:
        """SH coefficients [*colour, (degree + 1)^2] of the map (`shisd.harmonics.project_map`)."""
        return harmonics.project_map(self.texels, degree, texels=texels)

    def light(self, degree: int, *, texels: Literal["cells", "samples"] = "cells") -> DistantLight:
        """The map as `DistantLight` of this degree."""
        return DistantLight(self.coefficients(degree, texels=texels))

    def radiance(
        self, directions: ArrayLike, *, texels: Literal["cells", "samples"] = "cells"
    ) -> Float[Array, "*batch_and_colour"]:
        """Radiance [..., *colour] from directions [..., 3]: that of the texel there.

        With texels="samples" bilinear between texel centres: smooth in a picture, but next to the poles of another
        power. Directions of any length are accepted; a zero vector or one that is not finite gives NaN. Output dtype is
        that of the directions. Derivatives: in texels and directions; those in directions are 0, or between samples
        jump from texel to texel.
        """
        return sample_map(self.texels, directions, texels=texels)


# the azimuth of the left edge of the picture over 2 pi, from which columns turn clockwise, by the axis that is up, the
# program's own first; None: +x, counter-clockwise
_LEFT_EDGE: dict[str, dict[str, float | None]] = {
    "shisd": {"z": None},
    "blender": {"z": 1 / 2},
    "radiance": {"z": 1 / 2},
    "mitsuba": {"y": 1 / 2, "z": 1 / 4},
    "filament": {"y": 1 / 2, "z": 1 / 4},
    "three.js": {"y": 3 / 4, "z": 1 / 2},
}


def _as_radiance(texels: np.ndarray, path: str, bad_texels: str) -> np.ndarray:
    """`texels` with those that are no radiance counted, and replaced or refused."""
    finite = np.isfinite(texels)
    largest = max(float(np.max(texels, where=finite, initial=0)), 65504)
    kinds = {"NaN": (np.isnan(texels), 0), "infinite": (np.isposinf(texels), largest), "negative": (texels < 0, 0)}
    total, found, done, clean = texels.shape[0] * texels.shape[1], [], [], texels
    for name, (bad, value) in kinds.items():
        if count := int(np.sum(np.any(bad.reshape(total, -1), axis=1))):
            found.append(f"{count} {name} texel{'s' * (count > 1)}")
            done.append(f"{found[-1]} set to {value:.6g}")
            clean = np.where(bad, np.float32(value), clean)
    if not found:
        return texels
    if bad_texels == "refuse":
        raise ValueError(f'{path}: {", ".join(found)} of {total}. Pass bad_texels="clamp" to replace them.')
    if not finite.any():
        raise ValueError(f"{path}: {', '.join(found)} of {total}: no finite value is left.")
    warnings.warn(f"{path}: {', '.join(done)}, of {total}.", UserWarning, stacklevel=3)
    return clean


def _directions(height: int) -> np.ndarray:
    """Texel centres [H, 2H, 3] in float64."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = np.pi * (np.arange(2 * height) + 0.5) / height
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None]
    return np.stack(np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), cosine), axis=-1)
