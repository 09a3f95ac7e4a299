"""The scene that is planned for: materials, lights, and points that see the local ones."""

import numpy as np
from typing_extensions import TypeAliasType

from shisd import _checks
from shisd._module import Module
from shisd._numerics import normalize
from shisd._typing import Array, ArrayLike, Float
from shisd.models import AbstractBrdf, DistantLight, Environment, PolygonLight, PortalLight

Light = TypeAliasType("Light", DistantLight | Environment | PolygonLight | PortalLight)


class Scene(Module):
    """What is to be shaded: every material under the sum of all lights, without occlusion.

    Arguments: `materials` and `lights` by name; a light is a `models.DistantLight`, an `Environment`, a
    `PolygonLight` or a `PortalLight`; `points` [N, 3], representative positions of surfaces, which judge the local
    lights. A dozen will do: each costs a projection. `normals` [N, 3] of the surfaces there, from which points on lamps
    are judged, are worth passing, with some dozens of points; without them surfaces face all ways everywhere.
    """

    materials: dict[str, AbstractBrdf]
    lights: dict[str, Light]
    points: Float[Array, "n 3"] | None
    normals: Float[Array, "n 3"] | None

    def __init__(
        self,
        materials: dict[str, AbstractBrdf],
        lights: dict[str, Light],
        points: ArrayLike | None = None,
        normals: ArrayLike | None = None,
    ):
        if not materials or not lights:
            raise ValueError(
                f"a scene needs at least one of `materials` and of `lights`; got {len(materials)} and {len(lights)}."
            )
        for name, brdf in materials.items():
            if not isinstance(brdf, AbstractBrdf):
                raise ValueError(f"`materials`[{name!r}] must be a models.AbstractBrdf; got {type(brdf).__name__}.")
        for name, light in lights.items():
            if isinstance(light, PolygonLight | PortalLight):
                if points is None:
                    raise ValueError(f"`lights`[{name!r}] is local; pass `points` [N, 3] that see it.")
            elif not isinstance(light, DistantLight | Environment):
                raise ValueError(
                    f"`lights`[{name!r}] must be a models.DistantLight, Environment, PolygonLight or PortalLight; got "
                    f"{type(light).__name__}."
                )
        self.materials, self.lights = dict(materials), dict(lights)
        self.points = None if points is None else _checks.vectors("points", points).reshape(-1, 3)
        if self.points is not None and len(self.points) == 0:
            raise ValueError("`points` must hold at least one position.")
        self.normals = None if normals is None else normalize(_checks.vectors("normals", normals).reshape(-1, 3))
        if self.normals is not None and (self.points is None or len(self.normals) != len(self.points)):
            count = "no `points`" if self.points is None else f"{len(self.points)} `points`"
            raise ValueError(f"`normals` must be those of `points`; got {len(self.normals)} and {count}.")
        if self.normals is not None and not np.all(np.isfinite(self.normals)):
            raise ValueError("`normals` has a vector that is zero or not finite.")
