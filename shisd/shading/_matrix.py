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
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike

from shisd import _checks
from shisd._numerics import angle_multiples, normalize, safe_sqrt
from shisd._sharding import by_device
from shisd._typing import Array, Float, Scalar
from shisd.decomposition import RotatedZonalBasis
from shisd.harmonics import _quadrature, _tables, sh_basis
from shisd.harmonics._pairing import pair_many, turned_series
from shisd.models import AbstractBrdf
from shisd.shading import _views
from shisd.shading._lobes import RIDGE, Lobes, hemisphere_blocks, products_in_order, resolved, slices_at
from shisd.shading._surface import frame, in_tiles, shade_points, tangent_frame

_VIEW_RIDGE = 1e-10  # of fits over views
_NUMBERS_AT_ONCE, _LARGEST_TILE = 3 << 18, 4096  # as in `_environment`


class BrdfMatrix(eqx.Module):
    """The matrix F of a material, from harmonics of the view to those of its cosine-weighted slice.

    blocks: for isotropic materials, the block [*colour, L+1-m, Lv+1-m] of every order m up to the lesser of L and Lv,
    rows l = m ... L and columns l' = m ... Lv; for anisotropic ones the whole F [*colour, (L+1)^2, (Lv+1)^2] alone.
    `quadrature_error` and `domain` as in `Lobes`. F means something for views above the horizon only.
    """

    blocks: tuple[Float[Array, "*colour _ _"], ...]
    quadrature_error: Scalar
    degree: int = eqx.field(static=True)
    view_degree: int = eqx.field(static=True)
    isotropic: bool = eqx.field(static=True)
    domain: Literal["sphere", "upper"] = eqx.field(static=True, default="sphere")

    @property
    def colour(self) -> tuple[int, ...]:
        return self.blocks[0].shape[:-2]

    def matrix(self) -> Float[Array, "*colour n n_view"]:
        """F as a whole, [*colour, (L+1)^2, (Lv+1)^2]."""
        if not self.isotropic:
            return self.blocks[0]
        full = jnp.zeros((*self.colour, (self.degree + 1) ** 2, (self.view_degree + 1) ** 2), self.blocks[0].dtype)
        for m in range(1 - len(self.blocks), len(self.blocks)):
            rows, columns = _of_order(self.degree, m), _of_order(self.view_degree, m)
            full = full.at[..., rows[:, None], columns[None, :]].set(self.blocks[abs(m)])
        return full

    def slice_coefficients(self, view: Float[Array, "3"]) -> Float[Array, "*colour n"]:
        """SH coefficients, in the local frame, of the slice seen from the local direction `view` [3], F y(view).

        Derivatives: in the view and the matrix, both modes, any order, also at the normal.
        """
        view = _checks.vectors("view", view).astype(self.blocks[0].dtype)
        return jnp.einsum("...ij,j->...i", self.matrix(), sh_basis(view, self.view_degree))

    def coefficients(self, views: int = 64, azimuths: int = 64) -> Float[Array, "*colour_views n"]:
        """SH coefficients of slices at the views of a table, as `Lobes.coefficients` has them."""
        theta = _views.elevations(_checks.integer("views", views, 1))
        phi = 2 * np.pi * np.arange(_checks.integer("azimuths", azimuths, 1)) / azimuths
        grid = np.meshgrid(theta, phi[:1] if self.isotropic else phi, indexing="ij")
        y = _tables.basis(_directions(*(a.ravel() for a in grid)), self.view_degree)
        c = jnp.einsum("...ij,vj->...vi", self.matrix(), jnp.asarray(y, self.blocks[0].dtype))
        return c if self.isotropic else c.reshape(*self.colour, *grid[0].shape, -1)

    def lobes(self, basis: RotatedZonalBasis, *, views: int = 64) -> Lobes:
        """These slices as a table, for the verbs that take lobes; `basis` of the same degree."""
        if not isinstance(basis, RotatedZonalBasis) or basis.degree != self.degree:
            raise ValueError(f"`basis` must be a decomposition.RotatedZonalBasis of degree {self.degree}.")
        c = self.coefficients(_checks.integer("views", views, 4), _azimuths(self.degree, self.view_degree))
        return Lobes(basis, basis.weights(c), self.quadrature_error, self.isotropic, self.domain)


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
    Cost: Lv + 32 slices (times 2 max(L, Lv) + 4 azimuths for anisotropic materials) of quadrature^2 evaluations.
    """
    if not isinstance(brdf, AbstractBrdf):
        raise ValueError(f"`brdf` must be a models.AbstractBrdf; got {type(brdf).__name__}.")
    degree = _checks.degree(degree)
    view_degree = degree + 8 if view_degree is None else _checks.integer("view_degree", view_degree)
    if domain not in ("sphere", "upper"):
        raise ValueError(f"`domain` must be 'sphere' or 'upper'; got {domain!r}.")
    nodes = 32 + degree if quadrature is None else _checks.integer("quadrature", quadrature, 4)
    dtype = jnp.result_type(brdf.lobe_width)
    blocks, error = _project(brdf, degree, view_degree, dtype, nodes, RIDGE if domain == "upper" else None)
    blocks = _checked(blocks, error, float(tolerance)) if throw else blocks
    return BrdfMatrix(blocks, error, degree, view_degree, brdf.isotropic, domain)


@eqx.filter_jit
def _checked(blocks: tuple[Array, ...], error: Scalar, tolerance: float) -> tuple[Array, ...]:
    return resolved(blocks, error, tolerance)


@eqx.filter_jit
def _project(
    brdf: AbstractBrdf, degree: int, view_degree: int, dtype: DTypeLike, quadrature: int, ridge: float | None
) -> tuple[tuple[Array, ...], Scalar]:
    azimuths = _azimuths(degree, view_degree)
    z, _ = _view_nodes(view_degree)
    c, error = slices_at(np.arccos(z), brdf, degree, dtype, azimuths, quadrature, ridge)

    def fitted(samples: Float[Array, "*batch v n"], m: int) -> Float[Array, "*batch n k"]:
        to_modes, to_coefficients = (jnp.asarray(a, dtype) for a in _view_fit(view_degree, m))
        return (jnp.swapaxes(samples, -1, -2) @ to_modes) @ to_coefficients

    if brdf.isotropic:
        return tuple(fitted(c[..., _of_order(degree, m)], m) for m in range(min(degree, view_degree) + 1)), error
    phi = 2 * np.pi * np.arange(azimuths) / azimuths
    columns = []
    for m in range(-view_degree, view_degree + 1):
        wave = (np.cos(m * phi) if m >= 0 else np.sin(-m * phi)) * (1 if m == 0 else 2) / azimuths
        columns.append(fitted(jnp.einsum("...vai,a->...vi", c, jnp.asarray(wave, dtype)), abs(m)))
    order = np.concatenate([_of_order(view_degree, m) for m in range(-view_degree, view_degree + 1)])
    return (jnp.concatenate(columns, axis=-1)[..., np.argsort(order)],), error


def _azimuths(degree: int, view_degree: int) -> int:
    """Of the views of anisotropic materials: a slice's order m goes round m times with the view."""
    return max(32, 2 * max(degree, view_degree) + 4)


def _of_order(degree: int, m: int) -> np.ndarray:
    """Where the coefficients of order m are, l = |m| ... degree."""
    l = np.arange(abs(m), degree + 1)
    return l * l + l + m


def _directions(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


@functools.cache
def _view_nodes(view_degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss nodes z in (0, 1) of the views that are projected, and solid angles of their rings."""
    theta, weight = _quadrature.gauss_rows(view_degree + 32)
    return (1 + np.cos(theta)) / 2, np.pi * weight


@functools.cache
def _view_fit(view_degree: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    """From samples at the nodes, azimuth 0, to coefficients of y_l'^m, l' = |m| ... Lv: [nodes, k] and [k, Lv+1-m].

    Regularised least squares above the horizon, through modes that are orthonormal there: what rounding adds to
    modes that are small there stays small there, which it does not in one product with large numbers of both signs.
    """
    z, weight = _view_nodes(view_degree)
    p = _tables.associated_legendre(np.arccos(z), view_degree)[m:, m] * (1 if m == 0 else np.sqrt(2))
    u, s, v = np.linalg.svd((p * np.sqrt(weight)).T, full_matrices=False)
    return np.sqrt(weight)[:, None] * u, (s / (s * s + _VIEW_RIDGE))[:, None] * v


# ---- Radiance


def shade_matrix(
    matrix: BrdfMatrix,
    light_coefficients: ArrayLike,
    normals: ArrayLike,
    views: ArrayLike,
    tangents: ArrayLike | None = None,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer under distant light: `shade_environment` with a matrix.

    Arguments: `matrix` from `project_brdf` with domain="sphere"; the others and what is returned as in
    `shade_environment`.
    Derivatives: in every floating argument, both modes; the first exact for views along the normal as well, second ones
    not there. The cut at the horizon is a discontinuity of the view, with no gradient.
    Accuracy: exact for the slices of the matrix, to 1e-5 of the largest radiance in float32 and 1e-12 in float64.
    Cost: as `shade_environment`, with Lv + 1 numbers per coefficient of a slice to multiply, instead of V + 4, which
    are not what takes long; for anisotropic materials (Lv + 1)^2 instead of (V + 4) (2 L + 6), which are: at degree 8
    a third of its time, with gradients too, for Lv = 16 and V = 32.
    Source: CSH18 section 5.1; ISD15 Eq. 20-22.
    """
    if not isinstance(matrix, BrdfMatrix):
        raise ValueError(f"`matrix` must come from shading.project_brdf; got {type(matrix).__name__}.")
    if matrix.domain != "sphere":
        raise ValueError("`matrix` was fitted above the horizon only; project the material with domain='sphere'.")
    e, light_degree = _checks.expansion("light_coefficients", light_coefficients)
    vectors = {"normals": normals, "views": views}
    if not matrix.isotropic:
        if tangents is None:
            raise ValueError("`tangents` [..., 3] are needed: this material is anisotropic.")
        vectors["tangents"] = tangents
    points = {name: _checks.vectors(name, value) for name, value in vectors.items()}
    try:
        np.broadcast_shapes(*(a.shape for a in points.values()))
        colour = np.broadcast_shapes(matrix.colour, e.shape[:-1])
    except ValueError as error:
        shapes = {name: list(a.shape) for name, a in points.items()}
        colours = f"`matrix` {list(matrix.colour)} and `light_coefficients` {list(e.shape[:-1])}"
        raise ValueError(f"batch axes {shapes}, or colours of {colours}, do not broadcast.") from error
    dtype = jnp.result_type(*matrix.blocks, e, *points.values())
    matrix, points = jax.tree.map(lambda x: x.astype(dtype), (matrix, points))
    e = e[..., : (min(light_degree, matrix.degree) + 1) ** 2].astype(dtype)
    return by_device(shade_points, points, _shade, matrix, e, colour)


@eqx.filter_jit
def _shade(
    points: dict[str, Float[Array, "p 3"]], matrix: BrdfMatrix, e: Float[Array, "*c n"], colour: tuple[int, ...]
) -> Float[Array, " p *colour"]:
    degree = _checks.degree_of(e.shape[-1])
    series = turned_series(e.reshape(-1, e.shape[-1]), degree)
    if matrix.isotropic:
        factors = lambda view: _chebyshev(view, matrix.view_degree)
        look_up = products_in_order(_polar_table(matrix, degree), degree, factors, _waves)
    else:
        table = matrix.blocks[0][..., : (degree + 1) ** 2, :]
        look_up = products_in_order(table, degree, lambda view: sh_basis(view, matrix.view_degree).T, None)

    def shade(tile: dict[str, Float[Array, "p 3"]]) -> Float[Array, " p *colour"]:
        directions = {name: normalize(a) for name, a in tile.items()}
        normal = directions["normals"]
        r = frame(normal) if matrix.isotropic else tangent_frame(normal, directions["tangents"])
        view = jnp.einsum("pij,pi->pj", r, directions["views"])
        values = pair_many(*look_up(view), series, jnp.swapaxes(r, 1, 2), degree, matrix.isotropic)
        return jnp.where(view[:, 2] < 0, 0, values).T.reshape(-1, *colour)

    numbers = (degree + 1) ** 2 * int(np.prod(matrix.colour))
    return in_tiles(shade, points, min(_LARGEST_TILE, max(1, _NUMBERS_AT_ONCE // numbers)))


def _polar_table(matrix: BrdfMatrix, degree: int) -> Float[Array, "*colour n k"]:
    """Rows m >= 0 of slices at azimuth 0 over `_waves`, as sums of Chebyshev polynomials of z."""
    series, blocks = _chebyshev_series(matrix.view_degree), matrix.blocks[: degree + 1]
    rows = [b[..., : degree + 1 - m, :] @ jnp.asarray(series[m, m:], b.dtype) for m, b in enumerate(blocks)]
    order = np.concatenate([_of_order(degree, m) for m in range(len(blocks))])
    table = jnp.zeros((*matrix.colour, (degree + 1) ** 2, matrix.view_degree + 1), rows[0].dtype)
    return table.at[..., order, :].set(jnp.concatenate(rows, axis=-2))


@functools.cache
def _chebyshev_series(degree: int) -> np.ndarray:
    """Of y_l^m at azimuth 0 over 1, s or s^2, for m = 0, odd and even m: [m, l, k], polynomials of z."""
    theta = np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)
    m = np.arange(degree + 1)[:, None, None]
    p = np.swapaxes(_tables.associated_legendre(theta, degree), 0, 1) / np.sin(theta) ** np.where(m % 2, 1, 2 * (m > 0))
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


# ---- Degrees


def band_energies(material: Lobes | BrdfMatrix) -> Float[Array, "*colour_views l"]:
    """Energies of the bands of a material's slices, the squared norm that each adds to the lower ones.

    Returns [*colour, V, L+1] for isotropic materials, [*colour, V, A, L+1] for anisotropic ones, in 1/sr: for the views
    of `material.coefficients()`. Where the slices were fitted above the horizon, norms are those above it, of the best
    fit of each degree there.
    Derivatives: in the material.
    """
    _check_material(material)
    c, degree = material.coefficients(), material.degree
    if material.domain == "upper":
        c = c @ jnp.asarray(_successive(degree), c.dtype)
    member = _tables.bands(degree)[:, None] == np.arange(degree + 1)
    return jnp.square(c) @ jnp.asarray(member, c.dtype)


def material_degree(material: Lobes | BrdfMatrix, tolerance: float, *, worst: bool = False) -> int:
    """The smallest degree whose slices differ from those given by at most `tolerance`, relative to their RMS.

    Arguments: `material`; static `tolerance`; the RMS is over the views of a sphere's picture, by colour, of which the
    worst counts; `worst=True` takes the worst view instead. The light is not asked: `planning` does that, and needs
    less where the light is smooth.
    The choice is made from values, not under jit. Slices end at the degree of the material, and what is beyond cannot
    be seen: where its last two bands are needed for the tolerance (odd ones vanish for a Lambertian), that is an error.
    """
    _check_material(material)
    if not tolerance > 0:
        raise ValueError(f"`tolerance` must be > 0; got {tolerance}.")
    try:
        energy = np.asarray(band_energies(material), float)
    except jax.errors.TracerArrayConversionError as error:
        raise ValueError("the degree is chosen from values: call material_degree outside jit and grad.") from error
    if not np.all(np.isfinite(energy)):
        raise ValueError("`material` must be finite; its slices hold NaN or infinity.")
    energy = energy.reshape(-1, *energy.shape[len(material.colour) :])  # [colour, V, (A,) l]
    if not worst:
        share = np.sin(2 * _views.elevations(energy.shape[1]))
        energy = np.einsum("v,cv...l->cl", share, energy)
    above = np.cumsum(energy[..., ::-1], axis=-1)[..., ::-1]  # of bands l and higher
    needed = np.any(above > tolerance**2 * above[..., :1], axis=tuple(range(above.ndim - 1)))
    found = int(np.count_nonzero(needed)) - 1
    if found > max(material.degree - 2, 0):
        raise ValueError(
            f"`material` of degree {material.degree} needs its last bands for `tolerance` {tolerance}, and may need "
            "more: pass one of a higher degree."
        )
    return max(found, 0)


def _check_material(material: object) -> None:
    if not isinstance(material, Lobes | BrdfMatrix):
        name = type(material).__name__
        raise ValueError(f"`material` must come from shading.tabulate_brdf or shading.project_brdf; got {name}.")


@functools.cache
def _successive(degree: int) -> np.ndarray:
    """Transposed, from coefficients to those by functions orthonormal above the horizon, made of y_l^m by rising l."""
    table, blocks = np.zeros(((degree + 1) ** 2,) * 2), hemisphere_blocks(degree)
    for m in range(-degree, degree + 1):
        index = _of_order(degree, m)
        table[np.ix_(index, index)] = np.linalg.cholesky(blocks[abs(m)] + RIDGE * np.eye(len(index)))
    return table
