"""Mirror reflections of distant light, filtered over the footprint of a pixel: ISD15 section 6.2, Eq. 28-29.

A footprint filters the light with a Gaussian of covariance C (`_footprint`), here carried from the tangent plane to the
sphere along great circles. Band l of the light, a wave of direction k in the tangent plane, is filtered by
exp(-l (l+1) k.C k / 2). If C is round that is the Gauss-Weierstrass kernel, one factor for a band. If not, Fourier
series over k give coefficients of order m about r, with (l (l+1))^(m/2) replaced by the sphere's
sqrt((l+m)! / (l-m)!). All is smooth in C: there are no eigenvectors, whose derivatives break where C is round.

notation: r = mirror direction; tau = trace of C; e = light coefficients.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from shisd import _checks
from shisd._module import Module
from shisd._numerics import angle_multiples, normalize, safe_sqrt
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Float
from shisd.harmonics import project_map, synthesize_map
from shisd.harmonics.internal import (
    angles_of,
    bands,
    basis_at,
    gradient_gather,
    pair_many,
    place,
    rows,
    sample_map,
    series_table,
    turned_series,
    zonal_norms,
)
from shisd.models import DistantLight
from shisd.shading._footprint import Footprint
from shisd.shading._frames import frame
from shisd.shading._surface import masks
from shisd.shading._tiles import as_type, finite_mark, finite_or_nan, in_tiles, shade_points

_NUMBERS_AT_ONCE = 1 << 18  # coefficients of footprints in a tile

Points = dict[str, Float[Array, "p 3"]]


class MirrorMaps(Module):
    """A map and what Gaussians of a few `variances` [levels], in rad^2, make of it: `texels` [H, 2H, levels, colours].

    The first variance is 0, its level the map itself.
    """

    texels: Float[Array, "h w levels colours"]
    variances: Float[Array, " levels"]
    colour: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def from_texels(cls, texels: ArrayLike, *, levels: int = 13, degree: int | None = None) -> "MirrorMaps":
        """Filter a map with Gaussians of a few widths, once for any number of pixels: see `reflect`.

        Arguments: `texels` [H, 2H] or [H, 2H, colour] as in `harmonics.project_map`; static `levels` >= 2, the map
        itself and widths from 3 / degree, at most 0.5, to 1 rad in equal ratios; static `degree` at which the map is
        filtered, by default H - 1, at most 255.
        Derivatives: linear in the texels. Cost: one projection, and a synthesis for each level.
        """
        texels, levels = _checks.real_array("texels", texels), _checks.integer("levels", levels, minimum=2)
        if texels.ndim not in (2, 3) or texels.shape[1] != 2 * texels.shape[0] or 0 in texels.shape:
            raise ValueError(f"`texels` must have shape [H, 2H] or [H, 2H, colour]; got {list(texels.shape)}.")
        degree = min(len(texels) - 1, 255) if degree is None else _checks.degree(degree)
        variances = np.concatenate([[0], np.geomspace(min(3 / max(degree, 1), 0.5), 1, levels - 1) ** 2])
        e = project_map(texels, degree).reshape(-1, 1, (degree + 1) ** 2)
        kept = jnp.asarray(np.exp(-np.outer(variances[1:], _half_eigenvalues(degree)))[:, bands(degree)], e.dtype)
        filtered = synthesize_map(jnp.swapaxes(e * kept[None], 0, 1), len(texels))
        maps = jnp.concatenate([texels.reshape(*texels.shape[:2], 1, -1), filtered], axis=2)
        return cls(maps, jnp.asarray(variances, maps.dtype), texels.shape[2:])


def reflect(
    footprint: Footprint, light: DistantLight | MirrorMaps, *, anisotropic: bool = False, mask: ArrayLike | None = None
) -> Float[Array, "*batch_colour"]:
    """Radiance of perfect mirrors under distant light, filtered over the footprint of each pixel.

    Arguments: `footprint` [...]; `light`, a `models.DistantLight`, or `MirrorMaps` of a map; `mask` [...] as in
    `Surface`. Returns [..., *colour], in the light's unit. NaN in a footprint gives NaN, with NaN gradients.

    With a `DistantLight` the Gaussian meets the light's harmonics (Eq. 28, 22 and 29). Static `anisotropic`: as it is,
    or a round one of the same mean variance (option 3 of ISD15 section 6.2, its choice; the other is option 1).
    Accuracy: against a Gaussian carried to the sphere, relative to the light, 0.06 of its variance, anisotropic 0.15,
    beside the rounding of `harmonics.evaluate`. The round one leaves out the shape: 20 % where C is sixteen to one.
    Light that is cut off at a degree L rings around lamps wherever footprints are narrower than about 3 / L: take a
    higher degree, a window (`harmonics.hann_window`), or maps. Cost: two thirds of the sum over `harmonics.sh_basis`
    from degree 30 on, 1.5 of it at 16; anisotropic, about L^3 products. Memory: one tile of at most 512 pixels.

    With `MirrorMaps` (Eq. 17 and 28, option 2) it is 13 lookups for each pixel, whatever the footprint and degree. The
    footprint is a sum of round Gaussians of variance det C / tau, near that of its narrow side, about directions that
    are displaced by C z / sqrt(tau), whose covariance C^2 / tau is the rest of C. The z are those of a rule of degree 5
    for Gaussians in space: the centre and the vertices of an icosahedron. Accuracy: that of the lookups, and of the
    rule: 0.4 % of the light for a C of four to one, 7 % for sixteen, 17 % for a hundred to one. A narrow side wider
    than 1 rad is cut to that.

    Derivatives: in every floating argument, both modes, also where the footprint is round or a point. With light as
    coefficients those of second order are NaN at mirror directions along the z axis; with maps those in directions jump
    between texels, as in `Environment.radiance`, and those in variances between levels.
    """
    points, dtype = _points(footprint, mask)
    if isinstance(light, MirrorMaps):
        if anisotropic:
            raise ValueError("`anisotropic` belongs to a DistantLight: MirrorMaps always follow the footprint's shape.")
        dtype = jnp.promote_types(dtype, light.texels.dtype)
        return by_device(shade_points, as_type(points, dtype), _from_maps, as_type(light, dtype))
    if not isinstance(light, DistantLight):
        raise ValueError(f"`light` must be a models.DistantLight or shading.MirrorMaps; got {type(light).__name__}.")
    dtype = jnp.promote_types(dtype, light.coefficients.dtype)
    path = _anisotropic if anisotropic else _isotropic
    return by_device(shade_points, as_type(points, dtype), path, light.coefficients.astype(dtype))


# ---- light as coefficients


def _points(footprint: object, mask: ArrayLike | None) -> tuple[dict[str, Array], jnp.dtype]:
    if not isinstance(footprint, Footprint):
        raise ValueError(f"`footprint` must come from shading.footprint; got {type(footprint).__name__}.")
    d, axes = _checks.vectors("footprint.directions", footprint.directions), footprint.axes
    if axes.shape != (*d.shape, 2):
        raise ValueError(f"`footprint.axes` must have shape {[*d.shape, 2]}; got {list(axes.shape)}.")
    points, masked = (
        {"directions": d, "along_columns": axes[..., 0], "along_rows": axes[..., 1]},
        masks(mask),
    )
    try:
        np.broadcast_shapes(*(a.shape for a in (points | masked).values()))
    except ValueError as error:
        shapes = f"`mask` {list(masked['mask'].shape[:-1])} and `footprint.directions` {list(d.shape)}"
        raise ValueError(f"{shapes} do not broadcast.") from error
    return points | masked, jnp.result_type(d, axes)


def _half_eigenvalues(degree: int) -> np.ndarray:
    """l (l+1) / 2: minus the Laplacian of a band, times a variance of 1."""
    l = np.arange(degree + 1.0)
    return l * (l + 1) / 2


@eqx.filter_jit
def _isotropic(points: Points, e: Float[Array, "*colour n"]) -> Float[Array, " p *colour"]:
    degree = _checks.degree_of(e.shape[-1])
    half, shared = jnp.asarray(_half_eigenvalues(degree)[:, None], e.dtype), finite_mark(e)

    def shade(tile: Points) -> Float[Array, " p *colour"]:
        variance = jnp.sum(tile["along_columns"] ** 2 + tile["along_rows"] ** 2, axis=1) / 2
        u = normalize(tile["directions"])
        values = _filtered(e.reshape(-1, e.shape[-1]), u, jnp.exp(-half * variance[None]))
        return finite_or_nan(values.T.reshape(-1, *e.shape[:-1]), [u, *tile.values()], shared)

    size = (1 << 15) // (degree // 2 + 1) ** 2  # larger tiles leave the cache
    return in_tiles(shade, points, min(512, max(128, size)))


@jax.custom_jvp
def _filtered(e: Float[Array, "f n"], u: Float[Array, "p 3"], k: Float[Array, "l p"]) -> Float[Array, "f p"]:
    """sum over l of k_l(p) sum over m of e_lm y_lm(u): polar functions by parity of degree and order, then the light.

    Coefficients meet the polar functions of one order before its azimuth: no basis is built.
    """
    degree = len(k) - 1
    n = degree // 2 + 1
    series, light = jnp.asarray(series_table(degree, np.dtype(u.dtype))), _by_parity(e, degree)
    k = jnp.pad(k, ((0, 2 * n - degree - 1), (0, 0)))
    theta, phi = (angle_multiples(c, s, 2 * n) for c, s in angles_of(u).reshape(2, 2, -1))
    total = jnp.zeros((e.shape[0], u.shape[0]), e.dtype)
    for p in range(2):  # of the degree
        for q in range(2):  # of the order
            polar = (series[p, q].reshape(n * n, n) @ theta[q][p::2]).reshape(n, n, -1) * k[None, p::2]
            waves = jnp.einsum("hai,hip->hap", light[p, q], polar).reshape(n, 2, *total.shape)
            cos, sin = (w[q::2, None] for w in phi)
            total += jnp.sum(waves[:, 0] * cos + waves[:, 1] * sin, axis=0)
    return total


def _filtered_jvp(primals, tangents):
    (e, u, k), (de, du, dk) = primals, tangents
    values = _filtered(e, u, k)
    change, degree = jnp.zeros_like(values), len(k) - 1
    if not isinstance(de, SymbolicZero):  # through the basis: the transposes of the series are not smooth at the poles
        change += _filtered_by_basis(de, u, k)
    if not isinstance(dk, SymbolicZero):
        change += _filtered_by_basis(e, u, dk)
    if degree > 0 and not isinstance(du, SymbolicZero):
        gradients = [
            sum(jnp.asarray(factor[None], e.dtype) * e[:, index] for index, factor in terms)
            for terms in gradient_gather(degree, transpose=True)
        ]
        slopes = _filtered(jnp.concatenate(gradients), u, k[1:]).reshape(3, *values.shape)
        change += jnp.sum(slopes * du.T[:, None], axis=0)
    return values, change


_filtered.defjvp(_filtered_jvp, symbolic_zeros=True)


def _filtered_by_basis(e: Float[Array, "f n"], u: Float[Array, "p 3"], k: Float[Array, "l p"]) -> Float[Array, "f p"]:
    degree = len(k) - 1
    return e @ (basis_at(u, degree).T * k[bands(degree)])


def _by_parity(e: Float[Array, "f n"], degree: int) -> Float[Array, "2 2 h a i"]:
    """Coefficients with l = 2 i + p, |m| = 2 h + q as [p, q, h, (sign of m, f), i]; zero where there are none."""
    n, none = degree // 2 + 1, (degree + 1) ** 2
    m, l = np.mgrid[: 2 * n, : 2 * n]
    inside = (m <= l) & (l <= degree)
    plus, minus = np.where(inside, place(l, m), none), np.where(inside & (m > 0), place(l, -m), none)
    norm = jnp.asarray(np.where(m > 0, np.sqrt(2), 1)[None, None], e.dtype)
    both = jnp.pad(e, ((0, 0), (0, 1)))[:, np.stack([plus, minus]).astype(np.int32)] * norm  # f, sign, m, l
    both = both.reshape(-1, 2, n, 2, n, 2).transpose(5, 3, 2, 1, 0, 4)
    return both.reshape(2, 2, n, -1, n)


@eqx.filter_jit
def _anisotropic(points: Points, e: Float[Array, "*colour n"]) -> Float[Array, " p *colour"]:
    degree = _checks.degree_of(e.shape[-1])
    series, shared = turned_series(e.reshape(-1, e.shape[-1]), degree), finite_mark(e)

    def shade(tile: Points) -> Float[Array, " p *colour"]:
        r = frame(normalize(tile["directions"]))
        a, b = (jnp.einsum("pi,pij->jp", tile[name], r) for name in ("along_columns", "along_rows"))
        plus, minus = _gaussian(a[0] ** 2 + b[0] ** 2, a[0] * a[1] + b[0] * b[1], a[1] ** 2 + b[1] ** 2, degree)
        values = pair_many(plus[:, None], minus[:, None], series, jnp.swapaxes(r, 1, 2), degree, True)
        return finite_or_nan(values.T.reshape(-1, *e.shape[:-1]), [r, *tile.values()], shared)

    return in_tiles(shade, points, min(512, max(64, _NUMBERS_AT_ONCE // e.shape[-1])))


def _gaussian(
    xx: Float[Array, " p"], xy: Float[Array, " p"], yy: Float[Array, " p"], degree: int
) -> tuple[Float[Array, "rows p"], Float[Array, "rows p"]]:
    """Coefficients of Gaussians of these covariances about the pole, as `harmonics._pairing` orders them."""
    tables = _gaussian_tables(degree)
    cos, sin, half = (jnp.asarray(a, xx.dtype) for a in (tables.cos, tables.sin, tables.half_eigenvalues))
    spread = cos**2 @ xx[None] + sin**2 @ yy[None] + 2 * cos * sin @ xy[None]  # k.C k [directions, p]
    kept = jnp.exp(-half * spread[None])
    c = jnp.einsum("lad,ldp->lap", jnp.asarray(tables.to_orders, xx.dtype), kept).reshape(-1, len(xx))
    c = jnp.pad(c, ((0, 1), (0, 0)))
    return c[tables.plus], c[tables.minus]


class _GaussianTables(NamedTuple):
    cos: np.ndarray  # [d, 1] of directions k
    sin: np.ndarray
    half_eigenvalues: np.ndarray  # [l, 1, 1], l (l+1) / 2
    to_orders: np.ndarray  # [l, a, d], from values over k to orders 0, 2, 4 ... of cosines, then of sines
    plus: np.ndarray  # where `_pairing` takes its rows from, m >= 0
    minus: np.ndarray


@functools.cache
def _gaussian_tables(degree: int) -> _GaussianTables:
    # sqrt((l+m)! / (l-m)!) / (l (l+1))^(m/2) is the root of the product of 1 - i (i-1) / (l (l+1)) over i = 1 ... m
    count, even = degree + 4, np.arange(0, degree + 1, 2)  # the series over k, even, to aliases beyond the degree
    angle = np.pi * np.arange(count) / count
    half = _half_eigenvalues(degree)
    i = np.arange(1, degree + 1)
    steps = np.maximum(1 - i * (i - 1) / np.maximum(2 * half[:, None], 1), 0)
    ladder = np.sqrt(np.cumprod(np.concatenate([np.ones((degree + 1, 1)), steps], axis=1), axis=1))[:, even]
    ladder[0, 1:] = 0
    factor = ladder * zonal_norms(degree)[:, None] / count
    factor *= (-1.0) ** (even // 2) * np.where(even > 0, np.sqrt(2), 1)
    waves = np.stack([np.cos(np.outer(even, angle)), np.sin(np.outer(even, angle))])
    to_orders = (factor[:, None, :, None] * waves[None]).reshape(degree + 1, -1, count)
    plus, minus, k = rows(degree)

    def places(index: np.ndarray, first: int) -> np.ndarray:
        l = np.append(bands(degree), 0)[index]
        there = (index < (degree + 1) ** 2) & (k % 2 == 0)
        return np.where(there, l * 2 * len(even) + first + k // 2, to_orders.shape[0] * to_orders.shape[1])

    index = [places(plus, 0), places(minus, len(even))]
    return _GaussianTables(
        np.cos(angle)[:, None], np.sin(angle)[:, None], half[:, None, None], to_orders,
        *(where.astype(np.int32) for where in index),
    )  # fmt: skip


# ---- light as maps


@functools.cache
def _icosahedron() -> tuple[np.ndarray, np.ndarray]:
    """Weights [13] and points [13, 3] of the rule."""
    golden = (1 + np.sqrt(5)) / 2
    corners = np.array([(0, a, b * golden) for a in (-1, 1) for b in (-1, 1)])
    corners = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)]) * np.sqrt(5 / (1 + golden**2))
    return np.array([0.4] + [0.05] * 12), np.concatenate([np.zeros((1, 3)), corners])


@eqx.filter_jit
def _from_maps(points: Points, maps: MirrorMaps) -> Float[Array, " p *colour"]:
    height, width, levels, colours = maps.texels.shape
    weights, z = (jnp.asarray(a, maps.texels.dtype) for a in _icosahedron())
    lower, upper = maps.variances[:-1, None], maps.variances[1:, None]
    texels, shared = maps.texels.reshape(height, width, -1), finite_mark(maps.texels)

    def shade(tile: Points) -> Float[Array, " p *colour"]:
        u, axes = normalize(tile["directions"]), jnp.stack([tile["along_columns"], tile["along_rows"]], axis=2)
        c = axes @ jnp.swapaxes(axes, 1, 2)
        trace = jnp.sum(axes**2, axis=(1, 2))
        safe = jnp.where(trace > 0, trace, 1)
        det = jnp.sum(jnp.cross(axes[:, :, 0], axes[:, :, 1]) ** 2, axis=1)
        v = jnp.einsum("pij,zj->zpi", c, z) / jnp.where(trace > 0, jnp.sqrt(safe), 1)[None, :, None]
        square = jnp.sum(v * v, axis=2, keepdims=True)
        angle = safe_sqrt(square)
        sinc = jnp.where(square > 0, jnp.sin(angle) / jnp.where(square > 0, angle, 1), 1)
        around = jnp.cos(angle) * u[None] + sinc * v
        looked = sample_map(texels, around, texels="samples").reshape(*around.shape[:2], levels, colours)
        share = jnp.clip(((det / safe)[None] - lower) / (upper - lower), 0, 1)  # of the upper of two levels
        ends = jnp.pad(share, ((1, 1), (0, 0)), constant_values=((1, 0), (0, 0)))
        values = jnp.einsum("z,zplc,lp->pc", weights, looked, ends[:-1] - ends[1:])
        return finite_or_nan(values.reshape(-1, *maps.colour), [u, *tile.values()], shared)

    return in_tiles(shade, points, 1024)
