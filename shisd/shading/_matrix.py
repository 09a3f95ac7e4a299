"""Materials projected doubly, on harmonics of the light's direction and of the view (CSH18 section 5.1).

The matrix F of a material gives the coefficients of its cosine-weighted slice for a view wo by a product,
c_i(wo) = sum_j F_ij y_j(wo). Turning both directions about the normal changes nothing for an isotropic material: F then
joins only equal orders m, by one block that m and -m share.

The paper integrates over all views. But a material ends at the view's horizon, where such a sum takes half the value
and rings: measured on GGX with degrees 16 to 32 of the view, 7 to 26 % of the slices' RMS, and half of a grazing slice.
Here the view side is fitted above the horizon instead, which leaves 2e-4 or less.

notation: z = cosine of the view's elevation, s its sine; p_l'^m = associated Legendre functions, sqrt(2) p_l'^m(z)
cos(m phi) = y_l'^m(wo) for m > 0; T_k = Chebyshev polynomials, cos(k theta) = T_k(z).
"""

import functools
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._methods import method
from shisd._module import Module
from shisd._numerics import angle_multiples, safe_sqrt
from shisd._typing import Array, DTypeLike, Float, Scalar
from shisd.harmonics import sh_basis
from shisd.harmonics.internal import associated_legendre, gauss_rows, host_basis, of_order
from shisd.models import AbstractBrdf
from shisd.shading import _views
from shisd.shading.slices._slices import Slices, check_domain, products_in_order
from shisd.shading.slices._tabulate import by_convergence, slices_at
from shisd.shading.slices._upper import RIDGE, fit_above

_VIEW_RIDGE = 1e-10  # of fits over views


class BrdfMatrix(Module):
    """The matrix F of a material, from harmonics of the view to those of its cosine-weighted slice.

    blocks: for isotropic materials, the block [*colour, L+1-m, Lv+1-m] of every order m up to the lesser of L and Lv,
    rows l = m ... L and columns l' = m ... Lv; for anisotropic ones the whole F [*colour, (L+1)^2, (Lv+1)^2] alone.
    `error` and `domain` as in `Slices`. F means something for views above the horizon only.
    """

    blocks: tuple[Float[Array, "*colour _ _"], ...]
    error: Scalar
    degree: int = eqx.field(static=True)
    view_degree: int = eqx.field(static=True)
    isotropic: bool = eqx.field(static=True)
    domain: Literal["sphere", "upper"] = eqx.field(static=True, default="sphere")

    @property
    def colour(self) -> tuple[int, ...]:
        return self.blocks[0].shape[:-2]

    @method
    def matrix(self) -> Float[Array, "*colour n n_view"]:
        """F as a whole, [*colour, (L+1)^2, (Lv+1)^2]."""
        if not self.isotropic:
            return self.blocks[0]
        full = jnp.zeros((*self.colour, (self.degree + 1) ** 2, (self.view_degree + 1) ** 2), self.blocks[0].dtype)
        for m in range(1 - len(self.blocks), len(self.blocks)):
            rows, columns = of_order(self.degree, m), of_order(self.view_degree, m)
            full = full.at[..., rows[:, None], columns[None, :]].set(self.blocks[abs(m)])
        return full

    @method
    def at(self, view: Float[Array, "3"]) -> Float[Array, "*colour n"]:
        """SH coefficients, in the local frame, of the slice seen from the local direction `view` [3], F y(view).

        Derivatives: in the view and the matrix, both modes, any order, also at the normal.
        """
        view = _checks.vectors("view", view).astype(self.blocks[0].dtype)
        return jnp.einsum("...ij,j->...i", self.matrix(), sh_basis(view, self.view_degree))

    @method
    def slices(self, *, elevations: int = 64, azimuths: int | None = None) -> Slices:
        """These slices as a table of views at `elevations` and, of anisotropic materials, `azimuths` (None: enough)."""
        theta = _views.elevations(_checks.integer("elevations", elevations, 4))
        azimuths = _azimuths(self.degree, self.view_degree) if azimuths is None else azimuths
        phi = 2 * np.pi * np.arange(_checks.integer("azimuths", azimuths, 1)) / azimuths
        grid = np.meshgrid(theta, phi[:1] if self.isotropic else phi, indexing="ij")
        y = host_basis(_directions(*(a.ravel() for a in grid)), self.view_degree)
        c = jnp.einsum("...ij,vj->...vi", self.matrix(), jnp.asarray(y, self.blocks[0].dtype))
        c = c if self.isotropic else c.reshape(*self.colour, *grid[0].shape, -1)
        return Slices(c, error=self.error, isotropic=self.isotropic, domain=self.domain)


def project_brdf(
    brdf: AbstractBrdf,
    degree: int,
    *,
    view_degree: int | None = None,
    domain: Literal["sphere", "upper"] = "sphere",
    quadrature: int | None = None,
    tolerance: float = 1e-3,
    throw: bool = True,
) -> BrdfMatrix:
    """The doubly projected matrix of a material (CSH18 section 5.1), fitted over the views above the horizon.

    Arguments: `brdf`; static `degree` L of the slices and `view_degree` Lv of their dependence on the view, by default
    L + 8; `domain`, `quadrature`, `tolerance` and `throw` as in `tabulate_brdf`. The result has the dtype of the
    material's parameters.
    Derivatives: in every parameter of the material, both modes.
    Accuracy: against the slice of each view at the same degree, RMS over views relative to that of the slices, for GGX
    of alpha 0.25 to 0.5: with Lv = L + 8 below 1e-4, in float32 too (2e-4 with domain="upper", and for alpha 0.25 by
    0.5); with Lv = L from 2e-3 to 5e-2. Lv < L leaves out what a lobe needs to follow its mirror direction.
    Cost: 1.8 (Lv + 32) slices (times 2 max(L, Lv) + 4 azimuths for anisotropic materials) of quadrature^2 evaluations.
    """
    if not isinstance(brdf, AbstractBrdf):
        raise ValueError(f"`brdf` must be a models.AbstractBrdf; got {type(brdf).__name__}.")
    degree = _checks.degree(degree)
    view_degree = degree + 8 if view_degree is None else _checks.integer("view_degree", view_degree)
    check_domain(domain)
    tolerance, ridge = _checks.number("tolerance", tolerance, positive=True), RIDGE if domain == "upper" else None
    dtype = jnp.result_type(brdf.lobe_width)
    made = lambda nodes: _project(brdf, degree, view_degree, dtype, nodes, ridge)
    blocks, error = by_convergence(made, 32 + degree, quadrature, tolerance, throw)
    return BrdfMatrix(blocks, error, degree, view_degree, brdf.isotropic, domain)


@eqx.filter_jit
def _project(
    brdf: AbstractBrdf, degree: int, view_degree: int, dtype: DTypeLike, quadrature: int, ridge: float | None
) -> tuple[tuple[Array, ...], Scalar]:
    azimuths = _azimuths(degree, view_degree)
    z, _ = _view_nodes(view_degree)
    c, error = slices_at(np.arccos(z), brdf, degree, dtype, azimuths, quadrature, (ridge,))
    if ridge is not None:
        c = fit_above(c, ridge)

    def fitted(samples: Float[Array, "*batch v n"], m: int) -> Float[Array, "*batch n k"]:
        to_modes, to_coefficients = (jnp.asarray(a, dtype) for a in _view_fit(view_degree, m))
        return (jnp.swapaxes(samples, -1, -2) @ to_modes) @ to_coefficients

    if brdf.isotropic:
        return tuple(fitted(c[..., of_order(degree, m)], m) for m in range(min(degree, view_degree) + 1)), error
    phi = 2 * np.pi * np.arange(azimuths) / azimuths
    columns = []
    for m in range(-view_degree, view_degree + 1):
        wave = (np.cos(m * phi) if m >= 0 else np.sin(-m * phi)) * (1 if m == 0 else 2) / azimuths
        columns.append(fitted(jnp.einsum("...vai,a->...vi", c, jnp.asarray(wave, dtype)), abs(m)))
    order = np.concatenate([of_order(view_degree, m) for m in range(-view_degree, view_degree + 1)])
    return (jnp.concatenate(columns, axis=-1)[..., np.argsort(order)],), error


def _azimuths(degree: int, view_degree: int) -> int:
    """Of the views of anisotropic materials: a slice's order m goes round m times with the view."""
    return max(32, 2 * max(degree, view_degree) + 4)


def _directions(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


@functools.cache
def _view_nodes(view_degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss nodes z in (0, 1) of the views that are projected, and solid angles of their rings."""
    theta, weight = gauss_rows(view_degree + 32)
    return (1 + np.cos(theta)) / 2, np.pi * weight


@functools.cache
def _view_fit(view_degree: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """From samples at the nodes, azimuth 0, to coefficients of y_l'^m, l' = |m| ... Lv: [nodes, k] and [k, Lv+1-m].

    Regularised least squares above the horizon, through modes that are orthonormal there: what rounding adds to
    modes that are small there stays small there, which it does not in one product with large numbers of both signs.
    """
    z, weight = _view_nodes(view_degree)
    p = associated_legendre(np.arccos(z), view_degree)[m:, m] * (1 if m == 0 else np.sqrt(2))
    u, s, v = np.linalg.svd((p * np.sqrt(weight)).T, full_matrices=False)
    return np.sqrt(weight)[:, None] * u, (s / (s * s + _VIEW_RIDGE))[:, None] * v


def matrix_orders(matrix: BrdfMatrix, degree: int) -> Callable[[Float[Array, "p 3"]], tuple[Array, Array]]:
    """`BrdfMatrix.at` of many views up to `degree`, as `slices.slice_orders`."""
    if matrix.isotropic:
        factors = lambda view: _chebyshev(view, matrix.view_degree)
        return products_in_order(_polar_table(matrix, degree), degree, factors, _waves)
    table = matrix.blocks[0][..., : (degree + 1) ** 2, :]
    return products_in_order(table, degree, lambda view: sh_basis(view, matrix.view_degree).T, None)


def _polar_table(matrix: BrdfMatrix, degree: int) -> Float[Array, "*colour n k"]:
    """Rows m >= 0 of slices at azimuth 0 over `_waves`, as sums of Chebyshev polynomials of z."""
    series, blocks = _chebyshev_series(matrix.view_degree), matrix.blocks[: degree + 1]
    rows = [b[..., : degree + 1 - m, :] @ jnp.asarray(series[m, m:], b.dtype) for m, b in enumerate(blocks)]
    order = np.concatenate([of_order(degree, m) for m in range(len(blocks))])
    table = jnp.zeros((*matrix.colour, (degree + 1) ** 2, matrix.view_degree + 1), rows[0].dtype)
    return table.at[..., order, :].set(jnp.concatenate(rows, axis=-2))


@functools.cache
def _chebyshev_series(degree: int) -> np.ndarray:
    """Of y_l^m at azimuth 0 over 1, s or s^2, for m = 0, odd and even m: [m, l, k], polynomials of z."""
    theta = np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)
    m = np.arange(degree + 1)[:, None, None]
    p = np.swapaxes(associated_legendre(theta, degree), 0, 1) / np.sin(theta) ** np.where(m % 2, 1, 2 * (m > 0))
    waves = np.cos(np.outer(theta, m)) * np.where(m.ravel() > 0, 2, 1) / (degree + 1)
    return p * np.where(m > 0, np.sqrt(2), 1) @ waves


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _chebyshev(view: Float[Array, "p 3"], degree: int) -> Float[Array, "k p"]:
    """T_k(z) of unit vectors, k = 0 ... degree; from the sine too, which keeps the digits of small elevations."""
    return angle_multiples(view[:, 2], safe_sqrt(view[:, 0] ** 2 + view[:, 1] ** 2), degree + 1)[0]


@_chebyshev.defjvp
def _chebyshev_jvp(degree, primals, tangents):
    (view,), (d_view,) = primals, tangents
    value = _chebyshev(view, degree)
    k, j = np.arange(degree + 1)[:, None], np.arange(degree + 1)
    slope = np.where((j < k) & ((k - j) % 2 == 1), np.where(j > 0, 2 * k, k), 0)  # T_k' = k U_(k-1), a sum of T_j
    return value, (jnp.asarray(slope, value.dtype) @ value) * d_view[None, :, 2]


def _waves(view: Float[Array, "p 3"], count: int) -> tuple[Float[Array, "m p"], Float[Array, "m p"]]:
    """cos(m phi) and sin(m phi), m = 0 ... count-1, times s for odd m and s^2 for even m > 0."""
    cos, sin = _views.azimuth_factors(view, count)
    x, y = view[None, :, 0], view[None, :, 1]
    before_cos, before_sin = (jnp.concatenate([f[:1], f[:-1]]) for f in (cos, sin))
    m = np.arange(count)[:, None]
    even = jnp.asarray((m % 2 == 0) & (m > 0))
    return jnp.where(even, x * before_cos - y * before_sin, cos), jnp.where(even, x * before_sin + y * before_cos, sin)
