"""Integrals over regions of the sphere: of zonal functions, of cosine powers, and of any expansion (CSH18 Eq. 1).

An expansion is integrated through zonal functions about shared axes, which are all that `moments` computes: with K
axes z_k that resolve each band, I_l(z_k) = 4 pi/(2l+1) sum_m y_l^m(z_k) c_l^m determines the integrals c_l^m of the
basis. The other route, without axes, writes the gradient of r^l y_l^m as harmonics of degree l-1 and integrates those
along the edges by quadrature (`line_coefficients` in tests/bench). It is smooth to every order and more accurate for
large polygons, but takes longer, and small polygons lose digits in it.
"""

import functools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._numerics import dot, normalize, same_dtype
from shisd._typing import Array, ArrayLike, DTypeLike, Float, Scalar
from shisd.decomposition import TransformedExpansion, fibonacci_directions, optimized_directions
from shisd.decomposition.internal import TABLE_DEGREE
from shisd.domains._polygon import SphericalPolygon, for_each, loop_solid_angle
from shisd.domains._region import SphericalCap, cap_coefficients, cap_integrals
from shisd.domains.moments import Loop, fold, moments, powers
from shisd.harmonics import legendre
from shisd.harmonics.internal import host_basis

Region = SphericalPolygon | SphericalCap


def zonal_moments(region: Region, axes: ArrayLike, degree: int) -> Float[Array, "*batch k l"]:
    """Integrals of P_l(w . axis) over a region, for every axis and l = 0 ... degree.

    Arguments: a `SphericalPolygon` or `SphericalCap`; `axes` [K, 3], of any length but zero; static `degree` L.
    Returns [K, L+1] in sr, or [..., K, L+1] of many polygons.
    Derivatives: in vertices and axes, both modes, any order; the first exact where vertices coincide and where an axis
    lies on a vertex or in the plane of an edge. Second derivatives at coincident vertices are finite but not the limit.
    Accuracy: error over solid angle at every degree up to 100, for axes at random. float64: 1e-13 for polygons above
    0.05 rad, 1e-12 below. float32: 1e-6 above 0.5 rad; below, at every size, 2e-6 in the median and 5e-5 at worst
    (triangles at right angles to the axis). At degree 40, with edges up to 1e-5 rad short of pi, solid angles down to
    2e-12 sr, axes on vertices, on edges and inside: 2e-5 in float32, derivatives 1e-4 of the largest (1e-2 for slivers
    5e-5 rad wide). In float64 vertices are known to 1e-16 rad, of which the size of a polygon and what an edge lacks to
    pi are multiples.
    Cost: one sweep over the degrees, about 30 operations for every degree, axis and edge.
    """
    degree = _checks.degree(degree)
    d = _axes(axes)
    _check_region(region)
    return _zonal_moments(region, d, degree)


def axial_moments(polygon: SphericalPolygon, axes: ArrayLike, order: int) -> Float[Array, "*batch k n"]:
    """Integrals of the cosine powers (w . axis)^n over a polygon, n = 0 ... order (Arvo 1995; CSH18 section 4).

    Arguments: `polygon`; `axes` [K, 3], of any length but zero; static `order` N. Returns [K, N+1] in sr, or
    [..., K, N+1] of many polygons.
    Sums of them with coefficients that alternate, such as those of Legendre polynomials, lose every digit near order 20
    in float32 and 40 in float64: use `zonal_moments` for these.
    Derivatives: in vertices and axes, both modes.
    Accuracy: 5e-14 in float64 and 5e-6 in float32 to order 20, for polygons of about a radian; small ones lose digits.
    """
    order = _checks.integer("order", order)
    d = _axes(axes)
    if not isinstance(polygon, SphericalPolygon):
        raise ValueError(f"`polygon` must be a domains.SphericalPolygon; got {type(polygon).__name__}.")
    return _axial_moments(polygon, d, order)


def polygon_coefficients(region: Region, degree: int) -> Float[Array, "*batch n"]:
    """SH coefficients of the indicator of a region: the integrals over it of every y_l^m, [(L+1)^2].

    Returns [..., (L+1)^2] of many polygons.

    Derivatives: in the vertices, or axis and angle, as `zonal_moments`.
    Accuracy: 1e-11 in float64 and 2e-5 in float32 of the largest, at degree 20; 2e-2 for slivers in float32.
    Cost: `zonal_moments` for 2L+1 axes (4L+2 above degree 64), and (2L+1)^3 / 3 products.
    """
    degree = _checks.degree(degree)
    _check_region(region)
    return _coefficients(region, degree)


def integrate(coefficients: ArrayLike | TransformedExpansion, region: Region) -> Float[Array, "*batch"]:
    """The integral of SH expansions over a region (CSH18 Eq. 1).

    Arguments: `coefficients` [..., (L+1)^2]; a `SphericalPolygon` or `SphericalCap`. Returns [...], or of many polygons
    [..., *their axes]. To each polygon its own coefficients: `jax.vmap(integrate)(coefficients, polygons)`.
    Of a `decomposition.TransformedExpansion` over a polygon: beyond the map that is a polygon again.
    Derivatives: in all floating arguments.
    Accuracy: relative, in the median of random expansions of degree 20, 1e-13 in float64 and 2e-5 in float32.
    """
    if isinstance(coefficients, TransformedExpansion):
        return _integral_beyond(coefficients, region)
    c, degree = _checks.coefficients("coefficients", coefficients)
    _check_region(region)
    if isinstance(region, SphericalPolygon) and c.ndim == 1:
        return _integral(c, region, degree)
    c, basis = same_dtype(c, _coefficients(region, degree))
    return jnp.tensordot(c, basis, axes=(-1, -1), precision="highest")


def _integral_beyond(f: TransformedExpansion, region: Region) -> Float[Array, "*batch"]:
    if not isinstance(region, SphericalPolygon):
        raise ValueError(
            f"a TransformedExpansion is integrated over a domains.SphericalPolygon; got {type(region).__name__}."
        )
    mapped = SphericalPolygon(f.directions(region.vertices), largest=region.largest)
    whole = integrate(f.coefficients, mapped)
    return whole if f.base is None else jnp.add(*same_dtype(whole, integrate(f.base, region)))


def _axes(axes: ArrayLike) -> Float[Array, "k 3"]:
    d = _checks.vectors("axes", axes)
    if d.ndim != 2:
        raise ValueError(f"`axes` must have shape [K, 3]; got {list(d.shape)}.")
    return d


def _check_region(region: object) -> None:
    if not isinstance(region, SphericalPolygon | SphericalCap):
        raise ValueError(
            f"the region must be a domains.SphericalPolygon or domains.SphericalCap; got {type(region).__name__}."
        )


def _checked_axes(axes: Array) -> Array:
    d = normalize(axes)
    return eqx.error_if(d, ~jnp.all(jnp.isfinite(d)), "`axes` has a vector that is zero or not finite.")


@eqx.filter_jit
def _zonal_moments(region: Region, axes: Array, degree: int) -> Float[Array, "*batch k l"]:
    d = _checked_axes(axes)
    if isinstance(region, SphericalCap):
        axis, d = same_dtype(region.axis, d)
        cosine = dot(d.T, axis[:, None])
        return cap_integrals(region.versine.astype(d.dtype), degree)[None] * legendre(cosine, degree)

    def of_polygon(polygon: SphericalPolygon) -> Float[Array, "k l"]:
        v, axes = same_dtype(polygon.loop(), d)
        angle = jnp.broadcast_to(loop_solid_angle(v, polygon.largest)[None, None], (1, axes.shape[0], 1))
        rest = [moments(axes, v, degree)] if degree else []
        return jnp.concatenate([angle, *rest])[..., 0].T

    return for_each(of_polygon, region)


@eqx.filter_jit
def _axial_moments(polygon: SphericalPolygon, axes: Array, order: int) -> Float[Array, "*batch k n"]:
    checked = _checked_axes(axes)

    def of_one(polygon: SphericalPolygon) -> Float[Array, "k n"]:
        v, d = same_dtype(polygon.loop(), checked)
        return powers(d, v, loop_solid_angle(v, polygon.largest), order)[..., 0].T

    return for_each(of_one, polygon)


@eqx.filter_jit
def _coefficients(region: Region, degree: int) -> Float[Array, "*batch n"]:
    if isinstance(region, SphericalCap):
        return cap_coefficients(region.versine, region.axis, degree)

    def of_polygon(polygon: SphericalPolygon) -> Float[Array, " n"]:
        v = polygon.loop()
        return loop_coefficients(v, loop_solid_angle(v, polygon.largest), degree)[:, 0]

    return for_each(of_polygon, region)


@eqx.filter_jit
def _integral(c: Float[Array, " n"], polygon: SphericalPolygon, degree: int) -> Float[Array, "*batch"]:
    """As one sum over moments, which are not kept."""

    def of_one(polygon: SphericalPolygon) -> Scalar:
        own, v = same_dtype(c, polygon.loop())
        constant = own[0] * math.sqrt(1 / (4 * np.pi)) * loop_solid_angle(v, polygon.largest)
        return (constant + fold_expansion(own[:, None], v, *zonal_inverse(degree, v.dtype)))[0]

    return for_each(of_one, polygon)


def loop_coefficients(v: Loop, solid_angle: Float[Array, " p"], degree: int) -> Float[Array, "n p"]:
    """Integrals of the basis over loops, [(L+1)^2, p]."""
    constant = (solid_angle * math.sqrt(1 / (4 * np.pi)))[None]
    if degree == 0:
        return constant
    axes, inverse = zonal_inverse(degree, v.dtype)
    zonal = moments(jnp.asarray(axes), v, degree)  # l k p
    bands = [jnp.asarray(inverse[l]) @ zonal[l - 1] for l in range(1, degree + 1)]
    return jnp.concatenate([constant, *bands])


def fold_expansion(
    c: Float[Array, "rows p"], v: Loop, axes: np.ndarray, inverse: list[np.ndarray], spare: int = 0
) -> Float[Array, " p"]:
    """Integrals of expansions, each over its loop, without their constants, with the rows and axes of an inverse.

    They are weights (inverse_l)^T c_l on moments. The last `spare` edges seldom have a length.
    """
    weights, used = [], 0
    for l, matrix in enumerate(inverse):
        weights.append(jnp.asarray(matrix.T / max(l * (l + 1), 1)) @ c[used : used + len(matrix)])
        used += len(matrix)
    return fold(jnp.stack(weights, axis=1), jnp.asarray(axes), v, len(inverse) - 1, spare)


@functools.cache
def zonal_inverse(degree: int, dtype: DTypeLike) -> tuple[np.ndarray, list[np.ndarray]]:
    """Axes [K, 3], and for every l the matrix [2l+1, K] from I_l(z_k) to the integrals of y_l^m."""
    with jax.ensure_compile_time_eval():
        if degree <= TABLE_DEGREE:
            axes = np.asarray(optimized_directions(degree, dtype=dtype))
        else:
            axes = np.asarray(fibonacci_directions(2 * (2 * degree + 1), dtype=dtype))
    return axes, _inverses(axes, degree, lambda l: slice(l * l, (l + 1) ** 2))


@functools.cache
def incidence_inverse(degree: int, dtype: DTypeLike) -> tuple[np.ndarray, list[np.ndarray]]:
    """The same for integrands that are even in y: axes [L+1, 3] in the plane y = 0, matrices [l+1, L+1] for m >= 0.

    About the y axis such a function has orders m = -l, -l+2, ... l only, and its zonal functions about axes in the
    plane are their Fourier series. At L+1 equal steps over half a turn these are orthogonal: the condition number of a
    band is the ratio of the largest to the least |y_l^m| on the equator, about (pi l)^(1/4).
    """
    angle = np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)
    axes = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1).astype(dtype)
    return axes, _inverses(axes, degree, lambda l: slice(l * l + l, (l + 1) ** 2))


def _inverses(axes: np.ndarray, degree: int, rows: Callable[[int], slice]) -> list[np.ndarray]:
    z = axes.astype(float)
    y = host_basis(z / np.linalg.norm(z, axis=1, keepdims=True), degree)
    return [np.linalg.pinv(4 * np.pi / (2 * l + 1) * y[:, rows(l)]).astype(axes.dtype) for l in range(degree + 1)]
