"""Sums of a few isotropic lobes whose axes, and widths, are free: what non-linear fits find.

notation: z_j = axes, kappa_j = sharpness, a_j = weights; y_l^0 = zonal harmonics; pi_l = sqrt(4 pi / (2l+1)).

Values are linear in the weights: f(w) = sum_m columns[m](w) a_m. Fits use that (`fit_lobes`).
"""

import abc

import equinox as eqx
import jax.numpy as jnp

from shisd import _checks
from shisd._methods import method
from shisd._module import Module
from shisd._numerics import normalize
from shisd._typing import Array, ArrayLike, Float
from shisd.decomposition._kernels import gaussian_zonal
from shisd.harmonics import convolve, sh_basis, zonal_basis


class AbstractLobes(Module):
    """A weighted sum of isotropic lobes about axes of their own: `GaussianLobes` or `ZonalLobes`."""

    directions: eqx.AbstractVar[Float[Array, "J 3"]]
    weights: eqx.AbstractVar[Array]

    @property
    def size(self) -> int:
        """The number J of lobes."""
        return self.directions.shape[0]

    @method
    def evaluate(self, directions: ArrayLike) -> Float[Array, "*colour_batch"]:
        """Values [*colour, ...] at directions w [..., 3], taken as unit vectors along them.

        Derivatives: in every field and in the directions, every order.
        """
        w = normalize(_checks.vectors("directions", directions))
        dtype = jnp.promote_types(w.dtype, self.weights.dtype)
        columns = self.columns(w.reshape(-1, 3).astype(dtype))
        values = jnp.einsum("nm,...m->...n", columns, self.linear.astype(dtype), precision="highest")
        return values.reshape(*values.shape[:-1], *w.shape[:-1])

    @abc.abstractmethod
    def coefficients(self, degree: int) -> Float[Array, "*colour n"]:
        """SH coefficients [*colour, (degree + 1)^2] of the sum; static `degree`.

        Derivatives: in every field, every order.
        """

    @abc.abstractmethod
    def columns(self, w: Float[Array, "N 3"]) -> Float[Array, "N m"]:
        """What the weights multiply, at unit directions."""

    @abc.abstractmethod
    def with_linear(self, linear: Float[Array, "*colour m"]) -> "AbstractLobes":
        """These lobes with other weights, in the order of `columns`."""

    @property
    @abc.abstractmethod
    def linear(self) -> Float[Array, "*colour m"]:
        """The weights in the order of `columns`."""


class GaussianLobes(AbstractLobes):
    """Spherical Gaussians: f(w) = sum_j weights[j] exp(sharpness[j] (w . z_j - 1)).

    Arguments: `directions` [J, 3], axes of any length but zero; `sharpness` [J] >= 0, the inverse square of a width in
    rad; `weights` [*colour, J], the value of each lobe at its axis. Colours share axes and widths.
    Accuracy: coefficients 4e-14 and 1e-6 of each lobe's largest in float64 and float32, to degree 64 and sharpness 1e5;
    values of narrow lobes in float32 as good as their rounded axes.
    Source: ISD15 Eq. 19 and section 7.2; Wang et al. 2009 (mixtures).
    """

    directions: Float[Array, "J 3"]
    sharpness: Float[Array, " J"]
    weights: Float[Array, "*colour J"]

    def __init__(self, directions: ArrayLike, sharpness: ArrayLike, weights: ArrayLike):
        self.directions, self.weights = _axes_and_weights(directions, weights)
        self.sharpness = _checks.real_array("sharpness", sharpness)
        if self.sharpness.shape != (self.size,):
            raise ValueError(
                f"`sharpness` must have shape [J] = [{self.size}], as many as `directions`; got "
                f"{list(self.sharpness.shape)}."
            )

    @method
    def coefficients(self, degree: int) -> Float[Array, "*colour n"]:
        zonal = gaussian_zonal(self.sharpness, _checks.degree(degree))  # [J, L+1]
        lobes = _rotated(self.directions, zonal)
        return jnp.einsum("...j,jn->...n", self.weights, lobes, precision="highest")

    def columns(self, w: Float[Array, "N 3"]) -> Float[Array, "N J"]:
        chord = w[:, None] - normalize(self.directions)[None].astype(w.dtype)  # 1 - w.z = |w - z|^2 / 2 keeps digits
        return jnp.exp(-self.sharpness.astype(w.dtype)[None] / 2 * jnp.sum(chord * chord, axis=-1))

    def with_linear(self, linear: Float[Array, "*colour J"]) -> "GaussianLobes":
        return GaussianLobes(self.directions, self.sharpness, linear)

    @property
    def linear(self) -> Float[Array, "*colour J"]:
        return self.weights


class ZonalLobes(AbstractLobes):
    """Few axes, each with a zonal profile of its own: f(w) = sum_j sum_l weights[l, j] y_l^0(w . z_j).

    The sum of a `RotatedZonalBasis` whose axes need not resolve anything. Arguments: `directions` [J, 3], axes of any
    length but zero; `weights` [*colour, L+1, J]. `coefficients` of a degree above L are zero there.
    Accuracy: coefficients 1e-6 and 1e-14 of the norm of a band's weights, float32 and float64.
    Source: ISD15 Eq. 12; Nowrouzezahrai et al. 2012 (few fitted zonal lobes).
    """

    directions: Float[Array, "J 3"]
    weights: Float[Array, "*colour l J"]

    def __init__(self, directions: ArrayLike, weights: ArrayLike):
        self.directions, self.weights = _axes_and_weights(directions, weights)
        if self.weights.ndim < 2:
            raise ValueError(f"`weights` must have shape [*colour, L+1, J]; got {list(self.weights.shape)}.")

    @property
    def degree(self) -> int:
        return self.weights.shape[-2] - 1

    @method
    def coefficients(self, degree: int) -> Float[Array, "*colour n"]:
        own = min(_checks.degree(degree), self.degree)
        zonal = jnp.moveaxis(self.weights[..., : own + 1, :], -1, -2)  # [*colour, J, l]
        c = jnp.sum(_rotated(self.directions, zonal), axis=-2)
        return jnp.pad(c, [(0, 0)] * (c.ndim - 1) + [(0, (degree + 1) ** 2 - c.shape[-1])])

    def columns(self, w: Float[Array, "N 3"]) -> Float[Array, "N m"]:
        x = jnp.einsum("ni,ji->nj", w, normalize(self.directions).astype(w.dtype), precision="highest")
        return jnp.moveaxis(zonal_basis(x, self.degree), -1, -2).reshape(w.shape[0], -1)

    def with_linear(self, linear: Float[Array, "*colour m"]) -> "ZonalLobes":
        return ZonalLobes(self.directions, linear.reshape(*linear.shape[:-1], -1, self.size))

    @property
    def linear(self) -> Float[Array, "*colour m"]:
        return self.weights.reshape(*self.weights.shape[:-2], -1)


def _axes_and_weights(directions: ArrayLike, weights: ArrayLike) -> tuple[Float[Array, "J 3"], Array]:
    z, a = _checks.vectors("directions", directions), _checks.real_array("weights", weights)
    if z.ndim != 2 or z.shape[0] == 0:
        raise ValueError(f"`directions` must have shape [J, 3], J >= 1; got {list(z.shape)}. Batch with jax.vmap.")
    if a.shape[-1:] != z.shape[:1]:
        raise ValueError(f"`weights` must have one of {z.shape[0]} lobes on the last axis; got {list(a.shape)}.")
    return z, a


def _rotated(directions: Float[Array, "J 3"], zonal: Float[Array, "*batch J l"]) -> Float[Array, "*batch J n"]:
    """SH coefficients of lobes with the zonal coefficients `zonal` about `directions` (ISD15 Eq. 9)."""
    return convolve(sh_basis(normalize(directions).astype(zonal.dtype), zonal.shape[-1] - 1), zonal)
