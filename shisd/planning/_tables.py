"""Slices of a material at all the degrees that its paths ask for, from one table."""

import jax.numpy as jnp

from shisd.models import AbstractBrdf
from shisd.shading import Slices, tabulate_brdf
from shisd.shading.internal import RIDGE, fit_above


class Tables:
    """Slices of a material, tabulated once to some degree; those of lower degrees are cut from them."""

    def __init__(self, brdf: AbstractBrdf, degree: int, views: int):
        self._all = tabulate_brdf(brdf, degree, views=views)
        self._made: dict[tuple[int, bool], Slices] = {}

    def slices(self, degree: int, above: bool = False) -> Slices:
        if (degree, above) not in self._made:
            self._made[degree, above] = self._cut(degree, above)
        return self._made[degree, above]

    def _cut(self, degree: int, above: bool) -> Slices:
        every, domain = self._all, "upper" if above else "sphere"
        c = jnp.asarray(every.coefficients[..., : (degree + 1) ** 2], float)  # as all that is planned
        if above:
            c = fit_above(c, RIDGE)
        return Slices(c, quadrature_error=every.quadrature_error, isotropic=every.isotropic, domain=domain)
