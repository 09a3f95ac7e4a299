"""A path at a degree, judged: its error relative to the radiance, for the worst colour or of all together."""

import functools
from dataclasses import dataclass

import numpy as np

from shisd.planning._bands import Material, Seen, worst
from shisd.planning._paths import Path, Table


@dataclass(frozen=True, eq=False)
class Choice:
    """A path at a degree for a material and a light, with its relative RMS error and the bound on it, as in `Entry`."""

    path: type[Path]
    material: Material
    light: Seen
    degree: int
    error: float
    bound: float

    @functools.cached_property
    def cost(self) -> float:
        return self.path.cost(self.material, self.light, self.degree)

    @property
    def name(self) -> str:
        if self.path is not Table:
            return self.path.name
        return f"{'isotropic' if self.material.isotropic else 'anisotropic'} {self.path.name}"


def judge(path: type[Path], material: Material, light: Seen, degree: int, *, pooled: bool = False) -> Choice:
    """A path at a degree, by the colour for which its error is largest, or `pooled` by the sum of squares of all."""
    error, bound, radiance = path.errors(material, light, degree)
    if pooled:
        error, bound, radiance = (np.sqrt(np.sum(np.square(x), keepdims=True)) for x in (error, bound, radiance))
    return Choice(path, material, light, degree, worst(error, radiance), worst(bound, radiance))
