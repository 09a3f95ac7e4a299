"""What `shade` has to know of a path."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from shisd._sharding import by_device
from shisd._typing import Array
from shisd.shading._material import Material
from shisd.shading._surface import Surface
from shisd.shading._tiles import Form, shade_points


class Path(NamedTuple):
    """One way from a material and lights of its kinds to radiance.

    `form(material, light)`: what it takes of the material, or ValueError, for a light of this name; `radiance(form,
    lights, points, surface)`: [..., *colour] of their colours, all in one dtype, `points` the arrays [..., k] of the
    surface that it uses; static `local`: positions are among them.
    """

    form: Callable[[Material, str], Form]
    radiance: Callable[[Any, list, dict[str, Array], Surface], Array]
    local: bool


def local_path(form: Callable[[Material, str], Form], shade: Callable[..., Array]) -> Path:
    """That of lights at finite distance, by `shade(points, slices, lights, colour)`, as `shade_points` takes it."""

    def radiance(slices: Any, lights: list, points: dict[str, Array], _: Surface) -> Array:
        colour = np.broadcast_shapes(slices.colour, *(light.colour for light in lights))
        return by_device(shade_points, points, shade, slices, lights, colour)

    return Path(form, radiance, local=True)
