"""Slices of materials: coefficients of cosine-weighted BRDFs by view, interpolated smoothly (ISD15 Eq. 21)."""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._methods import method
from shisd._module import Module
from shisd._typing import Array, ArrayLike, Float, Scalar
from shisd.decomposition import RotatedZonalBasis
from shisd.harmonics.internal import bands, orders, place, rows
from shisd.shading import _views
from shisd.shading.slices import _energies
from shisd.shading.slices._upper import RIDGE, fit_above


class Tabulated(Module):
    """Coefficients [*colour, V, n] by view, or [*colour, V, A, n] of anisotropic materials."""

    coefficients: eqx.AbstractVar[Array]
    isotropic: eqx.AbstractVar[bool]

    @property
    def degree(self) -> int:
        return _checks.degree_of(self.coefficients.shape[-1])

    @property
    def colour(self) -> tuple[int, ...]:
        return self.coefficients.shape[: -2 if self.isotropic else -3]


class Slices(Tabulated):
    """SH coefficients of a material's cosine-weighted slices, tabulated over local view directions (ISD15 Eq. 21).

    Arguments: `coefficients` [*colour, V, (L+1)^2] for isotropic materials, in views at elevations (j + 1/2) (pi/2)/V
    from the normal and azimuth 0 (the slice of azimuth phi is this one turned by phi); [*colour, V, A, (L+1)^2] for
    anisotropic ones (static `isotropic` False), with azimuths 2 pi i/A. `error`: that of the quadrature of the slices,
    estimated, relative to their RMS over the picture of a sphere (see `tabulate_brdf`). Static `domain`: where the
    slices stand for the material, everywhere ("sphere") or only above the horizon ("upper").
    As rotated zonal harmonics: `weights` and `from_weights`.
    """

    coefficients: Float[Array, "*colour_views n"]
    error: Scalar
    isotropic: bool = eqx.field(static=True)
    domain: Literal["sphere", "upper"] = eqx.field(static=True)

    def __init__(
        self,
        coefficients: ArrayLike,
        *,
        error: ArrayLike = 0.0,
        isotropic: bool = True,
        domain: Literal["sphere", "upper"] = "sphere",
    ):
        c, _ = _checks.coefficients("coefficients", coefficients)
        views = 1 if isotropic else 2
        if c.ndim not in (views + 1, views + 2):
            form = "V" if isotropic else "V, A"
            raise ValueError(f"`coefficients` must have shape [{form}, n] or [colour, {form}, n]; got {list(c.shape)}.")
        check_domain(domain)
        self.coefficients, self.isotropic, self.domain = c, bool(isotropic), domain
        self.error = jnp.asarray(error, c.dtype)

    @method
    def at(self, view: Float[Array, "3"]) -> Float[Array, "*colour n"]:
        """SH coefficients, in the local frame, of the slice seen from the local direction `view` [3], interpolated.

        Derivatives: in the view and the coefficients, also at the normal.
        """
        table = lookup_table(self)
        view = _checks.vectors("view", view).astype(table.dtype)
        return slice_values(table, view[None], self)[..., 0]

    def cut(self, degree: int) -> "Slices":
        """The same up to a lower `degree`."""
        degree = _checks.degree(degree)
        if degree > self.degree:
            raise ValueError(f"`degree` must be at most that of the slices, {self.degree}; got {degree}.")
        if self.domain != "sphere":
            raise ValueError("slices fitted above the horizon are not cut: cut those on the sphere, then fit.")
        return self._with(self.coefficients[..., : (degree + 1) ** 2], "sphere")

    def above_horizon(self, *, ridge: float = RIDGE) -> "Slices":
        """Of the same degree, fitted above the horizon only, for light that is cut off there (`tabulate_brdf`)."""
        if self.domain != "sphere":
            raise ValueError("these slices are fitted above the horizon already.")
        ridge = _checks.number("ridge", ridge, positive=True)
        return self._with(fit_above(self.coefficients, ridge), "upper")

    def _with(self, coefficients: Array, domain: Literal["sphere", "upper"]) -> "Slices":
        return Slices(coefficients, error=self.error, isotropic=self.isotropic, domain=domain)

    @method
    def energies(self) -> Float[Array, "*colour_views l"]:
        """Energies of the bands, in 1/sr: the squared norm that each adds to the lower ones.

        Returns [*colour, V, L+1], or [*colour, V, A, L+1] of anisotropic materials. Of slices fitted above the horizon,
        norms are those above it, of the best fit of each degree there.
        Derivatives: in the coefficients.
        """
        return _energies.band_energies(self.coefficients, self.domain)

    def needed_degree(self, tolerance: float, *, worst: bool = False) -> int:
        """The smallest degree whose slices differ from these by at most `tolerance`, relative to their RMS.

        Arguments: static `tolerance`; the RMS is over the views of a sphere's picture, by colour, of which the worst
        counts; `worst=True` takes the worst view instead. The light is not asked: `planning` does that, and needs less
        where the light is smooth.
        The choice is made from values, not under jit. Slices end at their own degree, and what is beyond cannot be
        seen: where their last two bands are needed for the tolerance (odd ones vanish for a Lambertian), that is an
        error.
        """
        tolerance = _checks.number("tolerance", tolerance, positive=True)
        try:
            energies = np.asarray(self.energies(), float)
        except jax.errors.TracerArrayConversionError as error:
            raise ValueError("the degree is chosen from values: call needed_degree outside jit and grad.") from error
        if not np.all(np.isfinite(energies)):
            raise ValueError("the slices hold NaN or infinity: their degree cannot be chosen.")
        found = _energies.needed_degree(energies.reshape(-1, *energies.shape[len(self.colour) :]), tolerance, worst)
        if found > max(self.degree - 2, 0):
            raise ValueError(
                f"slices of degree {self.degree} need their last bands for `tolerance` {tolerance}, and may need more: "
                "make them of a higher degree."
            )
        return found

    @method
    def weights(self, basis: RotatedZonalBasis) -> Float[Array, "*colour_views l k"]:
        """RZH weights of the slices, of least norm (ISD15 Eq. 21), on a `basis` of their degree.

        Those of one view are `basis.weights(slices.at(view))` (Eq. 22). Derivatives: in the axes too.
        """
        if not isinstance(basis, RotatedZonalBasis) or basis.degree != self.degree:
            raise ValueError(f"`basis` must be a decomposition.RotatedZonalBasis of degree {self.degree}.")
        return basis.weights(self.coefficients)

    @classmethod
    def from_weights(
        cls,
        basis: RotatedZonalBasis,
        weights: ArrayLike,
        *,
        error: ArrayLike = 0.0,
        isotropic: bool = True,
        domain: Literal["sphere", "upper"] = "sphere",
    ) -> "Slices":
        """From RZH weights [*colour, V, L+1, K], or [*colour, V, A, L+1, K] of anisotropic materials.

        Derivatives: in the weights and the axes, so that lobe directions can be fitted to pictures.
        """
        if not isinstance(basis, RotatedZonalBasis):
            raise ValueError(f"`basis` must be a decomposition.RotatedZonalBasis; got {type(basis).__name__}.")
        c = basis.coefficients(weights)
        return cls(c, error=error, isotropic=isotropic, domain=domain)


def check_domain(domain: object) -> None:
    if domain not in ("sphere", "upper"):
        raise ValueError(f"`domain` must be 'sphere' or 'upper'; got {domain!r}.")


def lookup_table(slices: Slices, degree: int | None = None) -> Float[Array, "*colour n columns"]:
    """What `slice_values` looks up, up to `degree`: splines in elevation times Fourier series in azimuth.

    Columns: V+4 spline coefficients; for anisotropic materials, that for every cosine, then every sine component.
    """
    degree = slices.degree if degree is None else degree
    c = slices.coefficients[..., : (degree + 1) ** 2]
    if slices.isotropic:
        return _views.spline_table(jnp.swapaxes(c, -1, -2), np.abs(orders(degree)))
    azimuths = c.shape[-2]
    k = np.arange(azimuths // 2 + 1)
    phases = np.outer(k, 2 * np.pi * np.arange(azimuths) / azimuths)
    norm = np.where((k == 0) | (2 * k == azimuths), 1, 2)[:, None] / azimuths
    parts = []
    for wave in (np.cos(phases) * norm, np.sin(phases) * norm):
        component = jnp.einsum("ka,...van->...nkv", jnp.asarray(wave, c.dtype), c)
        spline = _views.spline_table(component, k)
        parts.append(spline.reshape(*spline.shape[:-2], -1))
    return jnp.concatenate(parts, axis=-1)


def slice_values(table: Float[Array, "*colour n columns"], view: Float[Array, "p 3"], slices: Slices) -> Array:
    """Interpolated SH coefficients of the slices, in the local frame: [*colour, n, p]."""
    c = table @ lookup_factors(view, slices)
    if not slices.isotropic:
        return c
    # the table holds the slice of azimuth 0; turned by phi, m mixes with -m
    degree = _checks.degree_of(table.shape[-2])
    m, l = orders(degree), bands(degree)
    cos, sin = _views.azimuth_factors(view, degree + 1)
    sin = sin[np.abs(m)] * jnp.asarray(-np.sign(m)[:, None], c.dtype)
    cos, sin = (jnp.broadcast_to(f, c.shape) for f in (cos[np.abs(m)], sin))
    return cos * c + sin * c[..., place(l, -m), :]


def slice_orders(slices: Slices, degree: int) -> Callable[[Float[Array, "p 3"]], tuple[Array, Array]]:
    """`slice_values` in the order of `harmonics._pairing`, m >= 0 and m < 0 apart: two arrays [rows, colours, p]."""
    waves = _views.azimuth_factors if slices.isotropic else None
    return products_in_order(lookup_table(slices, degree), degree, lambda view: lookup_factors(view, slices), waves)


def products_in_order(
    table: Float[Array, "*colour n columns"],
    degree: int,
    factors: Callable[[Float[Array, "p 3"]], Float[Array, "columns p"]],
    waves: Callable[[Float[Array, "p 3"], int], tuple[Array, Array]] | None,
) -> Callable[[Float[Array, "p 3"]], tuple[Array, Array]]:
    """table @ factors(view) in the order of `harmonics._pairing`: two arrays [rows, colours, p] for every view.

    Of isotropic materials only rows m >= 0, at azimuth 0; `waves(view, L+1)` are the cosines and sines for the others.
    """
    table = jnp.pad(table.reshape(-1, *table.shape[-2:]), ((0, 0), (0, 1), (0, 0)))
    *signs, k = rows(degree)
    plus, minus = (jnp.swapaxes(table[:, index], 0, 1) for index in signs)
    spread = jnp.asarray(k[:, None] == np.arange(max(degree, 1) + 1), table.dtype)

    def product(table: Float[Array, "rows colours columns"], factors: Float[Array, "columns p"]) -> Array:
        flat = table.reshape(-1, table.shape[-1])  # a product of matrices, and so is its transpose
        return (flat @ factors).reshape(*table.shape[:2], -1)

    def look_up(view: Float[Array, "p 3"]) -> tuple[Array, Array]:
        columns = factors(view)
        x = product(plus, columns)
        if waves is None:
            return x, product(minus, columns)
        # a product with a 0-1 matrix, whose transpose is one too: that of an indexed copy would be slow
        cos, sin = ((spread @ f)[:, None] for f in waves(view, max(degree, 1) + 1))
        return cos * x, sin * x

    return look_up


def lookup_factors(view: Float[Array, "p 3"], slices: Slices) -> Float[Array, "columns p"]:
    """What the columns of `lookup_table` are multiplied by."""
    if slices.isotropic:
        return _views.spline_weights(_views.elevation(view), slices.coefficients.shape[-2])
    spline = _views.spline_weights(_views.elevation(view), slices.coefficients.shape[-3])
    waves = jnp.stack(_views.azimuth_factors(view, slices.coefficients.shape[-2] // 2 + 1))  # [2, k, p]
    return (waves[:, :, None] * spline[None, None]).reshape(-1, view.shape[0])
