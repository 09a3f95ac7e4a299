"""Lobes of a material at all the degrees that its paths ask for, from one table."""

import jax.numpy as jnp
import numpy as np

from shisd.decomposition import RotatedZonalBasis, optimized_directions
from shisd.harmonics.internal import host_basis, zonal_norms
from shisd.models import AbstractBrdf
from shisd.shading import Lobes, tabulate_brdf
from shisd.shading.internal import RIDGE, fit_above


class Tables:
    """Lobes of a material, tabulated once to some degree; those of lower degrees are cut from them, on the host."""

    def __init__(self, brdf: AbstractBrdf, degree: int, views: int):
        self._all = tabulate_brdf(brdf, RotatedZonalBasis(optimized_directions(degree), degree), views=views)
        weights = np.asarray(self._all.weights, float)
        self._coefficients = np.concatenate(
            [weights[..., l, :] @ m.T for l, m in enumerate(_band_matrices(degree))], axis=-1
        )
        self._made: dict[tuple[int, bool], Lobes] = {}

    def lobes(self, degree: int, above: bool = False) -> Lobes:
        if (degree, above) not in self._made:
            self._made[degree, above] = self._cut(degree, above)
        return self._made[degree, above]

    def _cut(self, degree: int, above: bool) -> Lobes:
        c = self._coefficients[..., : (degree + 1) ** 2]
        if above:
            c = np.asarray(fit_above(jnp.asarray(c, float), RIDGE), float)
        bands = np.split(c, np.arange(1, degree + 1) ** 2, axis=-1)
        weights = [b @ np.linalg.pinv(m).T for b, m in zip(bands, _band_matrices(degree), strict=True)]
        basis = RotatedZonalBasis(optimized_directions(degree), degree)
        every, domain = self._all, "upper" if above else "sphere"
        table = jnp.asarray(np.stack(weights, axis=-2), float)
        return Lobes(basis, table, every.quadrature_error, every.isotropic, domain)


def _band_matrices(degree: int) -> list[np.ndarray]:
    """M_l of the optimised axes (ISD15 Eq. 10), for every band."""
    y = host_basis(np.asarray(optimized_directions(degree), float), degree)
    norms = zonal_norms(degree)
    return [y[:, l * l : (l + 1) ** 2].T / norms[l] for l in range(degree + 1)]
