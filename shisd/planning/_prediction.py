"""Predicted errors: what a path at a degree leaves out of a material and a light, from norms of their bands."""

from typing import NamedTuple

import numpy as np

from shisd.planning._bands import Material, Seen
from shisd.planning._paths import Path, Table

_DARK = 1e-6  # of the brightest colour's radiance: a colour below it is rounding


class Choice(NamedTuple):
    """A path at a degree, with its relative RMS error, the bound on it and its cost, as in `Entry`."""

    path: type[Path]
    degree: int
    error: float
    bound: float
    cost: float

    def name(self, material: Material) -> str:
        if self.path is not Table:
            return self.path.name
        return f"{'isotropic' if material.isotropic else 'anisotropic'} {self.path.name}"


def judge(path: type[Path], material: Material, light: Seen, degree: int) -> Choice:
    """A path at a degree, by the colour for which its error is largest."""
    error, bound = predict(*path.left_out(material, light, degree), material.shares)
    radiance = predict(material.norms, light.norms, material.shares)[0]
    dark = radiance <= _DARK * np.max(radiance)
    relative = lambda x: float(np.max(np.where(dark, 0, x / np.where(dark, 1, radiance))))
    return Choice(path, degree, relative(error), relative(bound), path.cost(material, light, degree))


def predict(slices: np.ndarray, lights: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """RMS of the product of slices and lights, and a bound on it, from norms of their bands [C, V, l] and [C, P, l].

    One for each colour [C]. The RMS is over views by their `shares` [V], points, and all rotations between slices and
    lights; the bound holds for the worst of the rotations.
    """
    energy = np.einsum("v,cvl->cl", shares, slices**2) * np.mean(lights**2, axis=1)
    worst = slices @ np.swapaxes(lights, 1, 2)  # [C, V, P]
    square = np.sum(energy / (2 * np.arange(slices.shape[-1]) + 1), axis=-1)
    return np.sqrt(square), np.sqrt(np.mean(np.einsum("v,cvp->cp", shares, worst**2), axis=1))
