"""Distant light that something hides in part."""

from shisd import _checks
from shisd._module import Module
from shisd._typing import Array, ArrayLike, Float
from shisd.models._visibility import Visibility
from shisd.models.lights._distant import DistantLight, ZonalLight


class Occluded(Module):
    """Distant light times visibility (ISD15 Eq. 25): the product of both expansions, with all its bands.

    Arguments: `light`, a `DistantLight` or `ZonalLight`; `visibility`, what each point sees of the sphere, in world
    space: a `models.Visibility` of a mesh, of which every point is told its place (`Surface.triangles` and
    `.barycentric`), or of single points, in their order; or SH coefficients [n], the same for all points, as
    `models.cap_visibility` gives them, or [..., n] for each.
    """

    light: DistantLight | ZonalLight
    visibility: Visibility | Float[Array, "*batch n"]

    def __init__(self, light: DistantLight | ZonalLight, visibility: Visibility | ArrayLike):
        if not isinstance(light, DistantLight | ZonalLight):
            raise ValueError(
                f"`light` must be a models.DistantLight or ZonalLight, which alone can be occluded; got "
                f"{type(light).__name__}."
            )
        self.light = light
        if isinstance(visibility, Visibility):
            self.visibility = visibility
        else:
            self.visibility = _checks.coefficients("visibility", visibility)[0]

    @property
    def colour(self) -> tuple[int, ...]:
        return self.light.colour
