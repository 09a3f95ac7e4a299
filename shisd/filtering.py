"""Noisy and sparse measurements of BRDFs made smooth: coefficients by regularised least squares, filters, MERL tables.

Follows ISD15 section 6.3 (Eq. 30-32): the 4D data are projected on harmonics of both directions and filtered by a
separable von Mises-Fisher kernel, which multiplies bands. It differs in the projection: samples are scattered and only
above the horizon, so coefficients are fitted, not integrated, with a penalty on the Laplacian that decides where there
are no samples.

Tables of bins around the highlight hold values that span many decades, which no expansion of moderate degree follows.
`denoise_merl` is therefore a penalised least squares fit of their logarithm on the table's own angles. There the noise
is even, highlights are straight ridges, and reciprocity is the period of phi_d.

notation: C as in ISD15 Eq. 30; k_l, pi_l = coefficients of the kernel (Eq. 31) and of the delta function; W = weights,
z = the smooth logarithm, P = penalty of each cosine wave.
"""

import functools
import math
import os
import warnings
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg
from jax.typing import DTypeLike

from shisd import _checks, io
from shisd._numerics import normalize, safe_sqrt
from shisd._progress import Progress, reporting
from shisd._typing import Array, ArrayLike, Float, Scalar
from shisd.decomposition.internal import gaussian_zonal
from shisd.harmonics import sh_basis
from shisd.harmonics.internal import bands, of_order, zonal_norms
from shisd.models import MeasuredBrdf, ProjectedBrdf
from shisd.models.internal import fill_nearest, symmetric

_TILE = 1024  # samples whose harmonics are in memory at a time
_SMOOTHNESS = (1.0, 10.0, 100.0, 1000.0)  # what is tried for tables
_PROBES = 256  # pairs of directions at which coverage is judged


class FitStatus(eqx.Enumeration):
    """How a fit ended."""

    ok = "The fit is found."
    uncovered = (
        "Samples leave out parts of the hemisphere that this degree resolves; the ridge decides there. Lower `degree`, "
        "raise `ridge`, or add samples."
    )
    step_limit = "The solver used up its steps. Raise `max_steps` or `ridge`, or lower `degree`."


class BrdfFit(NamedTuple):
    """The result of `fit_brdf`.

    `error`: RMS of the residual over that of the samples, both weighted. `coverage`: share of 256 pairs of directions,
    spread by cosine, that have a sample within pi / (2 degree + 2) of both. `missing`: values that were left out.
    """

    brdf: ProjectedBrdf
    error: Scalar
    coverage: Scalar
    missing: Array
    status: FitStatus


def fit_brdf(
    wi: ArrayLike,
    wo: ArrayLike,
    values: ArrayLike,
    degree: int,
    *,
    isotropic: bool,
    ridge: ArrayLike = 1e-5,
    weights: ArrayLike | None = None,
    max_steps: int = 300,
) -> BrdfFit:
    """The band-limited BRDF nearest to scattered samples: regularised projection (ISD15 Eq. 30).

    Minimises the weighted mean of (f - values)^2 plus `ridge` times the mean over sphere x sphere of the squared
    Laplacian of f, its sum over both directions: a wave of degree l in both is halved near l = (4 ridge)^(-1/4).

    Arguments: `wi`, `wo` [N, 3] of any length, local frame; `values` [N, *colour] in 1/sr; `weights` [N] >= 0, by
    default equal. Give 1 / values^2, with a floor, where noise is a share of the value, and solid angles where samples
    are unevenly spread. `ridge` > 0. Static `degree` L, `isotropic`, `max_steps` of conjugate gradients.
    Negative, infinite and NaN values, and directions that are not above the horizon, are missing: left out and counted.
    It is an error at run time if a colour has no value with weight left. Where samples cover only a part, the ridge
    decides on the rest: `coverage` below 0.8 sets the status, which the caller reads.
    Derivatives: in `values`, `weights` and `ridge`, by the implicit function theorem; not in the directions.
    Accuracy: the solver's residual is 1e-6 in float32 and 1e-10 in float64, relative; a BRDF of this degree is found
    again from exact samples, ridge 1e-9, to 1 % in float32 and 1e-4 in float64 (tests).
    Cost: steps x N x (n^2, or (L+1)^3 / 3), in bounded memory.
    """
    degree, max_steps = _checks.degree(degree), _checks.integer("max_steps", max_steps, 1)
    wi, wo, y = _checks.vectors("wi", wi), _checks.vectors("wo", wo), _checks.real_array("values", values)
    if wi.ndim != 2 or wo.shape != wi.shape:
        raise ValueError(f"`wi` and `wo` must have one shape [N, 3]; got {list(wi.shape)} and {list(wo.shape)}.")
    if y.ndim not in (1, 2) or y.shape[0] != len(wi) or y.shape[1:] not in ((), (3,)):
        raise ValueError(f"`values` must have shape [N] or [N, 3] with N = {len(wi)}; got {list(y.shape)}.")
    w = jnp.ones_like(y, shape=y.shape[:1]) if weights is None else _checks.real_array("weights", weights)
    if w.shape != y.shape[:1]:
        raise ValueError(f"`weights` must have shape [N] = [{len(wi)}]; got {list(w.shape)}.")
    if not isinstance(isotropic, bool):
        raise ValueError(f"`isotropic` must be True or False; got {isotropic!r}.")
    ridge = _checks.scalar("ridge", ridge)
    return _fit(wi.astype(y.dtype), wo.astype(y.dtype), y, w.astype(y.dtype), ridge.astype(y.dtype), degree, isotropic,
                max_steps)  # fmt: skip


@eqx.filter_jit
def _fit(
    wi: Float[Array, "n 3"],
    wo: Float[Array, "n 3"],
    values: Array,  # [n] or [n, 3]
    weights: Float[Array, " n"],
    ridge: Scalar,
    degree: int,
    isotropic: bool,
    max_steps: int,
) -> BrdfFit:
    y = values.reshape(len(values), -1)
    there = jnp.all(jnp.isfinite(wi) & jnp.isfinite(wo), axis=1) & (wi[:, 2] > 0) & (wo[:, 2] > 0)
    valid = there[:, None] & jnp.isfinite(y) & (y >= 0)
    normal = jnp.asarray([[0, 0, 1]], y.dtype)
    wi, wo = (jax.lax.stop_gradient(normalize(jnp.where(there[:, None], w, normal))) for w in (wi, wo))
    wi, wo = _turned(wi, wo) if isotropic else (wi, wo)
    y, w = jnp.where(valid, y, 0), jnp.where(valid, weights[:, None], 0)
    total = jnp.sum(w, axis=0, keepdims=True)
    total = eqx.error_if(total, ~jnp.all(total > 0), "`values` has a colour without any valid value that has weight.")
    w = eqx.error_if(w, ~jnp.all((w >= 0) & jnp.isfinite(w)), "`weights` must be finite and not negative.") / total
    ridge = eqx.error_if(ridge, ~(ridge > 0), "`ridge` must be > 0.")

    tiles = [jnp.pad(a, ((0, -len(a) % _TILE), (0, 0))).reshape(-1, _TILE, a.shape[1]) for a in (wi, wo, y, w)]
    tiles[:2] = [jnp.where(jnp.sum(a * a, axis=-1, keepdims=True) > 0, a, normal[None]) for a in tiles[:2]]

    def error(c: Array, share: float) -> tuple[Array, Scalar]:
        """Half the derivative in c of the mean square of f - share * values, summed over colours, and that mean."""

        @jax.checkpoint
        def add(sums: tuple[Array, Scalar], some: list[Array]) -> tuple[tuple[Array, Scalar], None]:
            wi, wo, y, w = some
            y_i, y_o = sh_basis(wi, degree), sh_basis(wo, degree)
            f, transpose = jax.vjp(lambda c: _pairs(c, y_i, y_o, isotropic), c)
            rest = f - share * y
            return (sums[0] + transpose(w * rest)[0], sums[1] + jnp.sum(w * rest * rest)), None

        return jax.lax.scan(add, (jnp.zeros_like(c), jnp.zeros((), c.dtype)), tiles)[0]

    l = np.arange(degree + 1) if isotropic else bands(degree)
    curvature = ((l * (l + 1))[:, None] + (l * (l + 1))[None, :]) ** 2.0
    repeats = np.where(np.arange(degree + 1) > 0, 2, 1)[:, None, None] if isotropic else 1  # cosines and sines
    share = jnp.asarray(repeats / (16 * np.pi**2), y.dtype)  # of a squared coefficient in the mean over sphere x sphere
    share = jnp.broadcast_to(share, (degree + 1,) * 3 if isotropic else curvature.shape)
    penalty = (ridge * share * jnp.broadcast_to(jnp.asarray(curvature, y.dtype), share.shape))[None]
    zero = jnp.zeros((y.shape[1], *share.shape), y.dtype)
    right = -error(zero, 1.0)[0]
    mean = jnp.sum(w * y, axis=0) * (4 * np.pi)
    c, _ = cg(
        lambda c: error(c, 0.0)[0] + penalty * c,
        right,
        zero.at[(slice(None), *(0,) * share.ndim)].set(mean),
        tol=1e-10 if y.dtype.itemsize > 4 else 1e-6,
        maxiter=max_steps,
        M=lambda r: r / (share[None] + penalty),  # the diagonal, if samples covered the sphere
    )
    slope, square = error(c, 1.0)
    tiny = jnp.finfo(y.dtype).tiny
    left = jnp.sum((slope + penalty * c) ** 2) / jnp.maximum(jnp.sum(right**2), tiny)
    relative = safe_sqrt(square / jnp.maximum(jnp.sum(w * y * y), tiny))

    coverage = _coverage(wi, wo, jnp.any(w > 0, axis=1), degree, isotropic)
    status = FitStatus.where(coverage < 0.8, FitStatus.uncovered, FitStatus.ok)
    status = FitStatus.where(left <= 1e-8, status, FitStatus.step_limit)
    brdf = ProjectedBrdf(c.reshape(*values.shape[1:], *share.shape), isotropic=isotropic)
    return BrdfFit(brdf, relative, coverage, jnp.sum(~valid), status)


def _pairs(
    c: Float[Array, "colours ..."], y_i: Float[Array, "p n"], y_o: Float[Array, "p n"], isotropic: bool
) -> Float[Array, "p colours"]:
    """Expansions at pairs of directions, turned to azimuth 0 of wi if isotropic."""
    c = symmetric(c)

    def sums(c: Array, y_i: Array, y_o: Array) -> Array:
        columns = jnp.moveaxis(c, 0, 1).reshape(c.shape[1], -1)  # one product of matrices for all colours
        terms = (y_i @ columns).reshape(len(y_i), c.shape[0], -1) * y_o[:, None]
        # summed as a product: XLA for CPUs (jax 0.10.2, float32) makes garbage of a sum fused with the product above
        return (terms.reshape(-1, terms.shape[-1]) @ jnp.ones((terms.shape[-1], 1), c.dtype)).reshape(terms.shape[:2])

    if not isotropic:
        return sums(c, y_i, y_o)
    total = jnp.zeros((len(y_i), len(c)), c.dtype)
    for m in range(c.shape[-1]):  # at azimuth 0 of wi, harmonics of negative order vanish
        own = of_order(c.shape[-1] - 1, m)
        total += sums(c[:, m, m:, m:], y_i[:, own], y_o[:, own])
    return total


def _coverage(wi: Array, wo: Array, used: Array, degree: int, isotropic: bool) -> Scalar:
    """Share of probing pairs that have a used sample within pi / (2L+2) of both, exchanged or not."""
    steps = 1.1673039783 ** -np.arange(1, 5)  # x^5 = x + 1: an additive sequence that fills four dimensions evenly
    u = (0.5 + np.arange(1, _PROBES + 1)[:, None] * steps) % 1
    polar, azimuth = np.arcsin(np.sqrt(u[:, :2])), 2 * np.pi * u[:, 2:]
    probes = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    least = math.cos(np.pi / (2 * degree + 2))
    a, b = (_turned(wi, wo), _turned(wo, wi)) if isotropic else ((wi, wo), (wo, wi))

    def near(pair: Float[Array, "2 3"]) -> Array:
        p, q = _turned(pair[:1], pair[1:]) if isotropic else (pair[:1], pair[1:])
        close = lambda w, z: jnp.sum(w * z, axis=1) >= least
        return jnp.any(used & ((close(a[0], p) & close(a[1], q)) | (close(b[0], p) & close(b[1], q))))

    return jnp.mean(jax.lax.map(near, jnp.asarray(probes, wi.dtype)).astype(wi.dtype))


def _turned(a: Float[Array, "N 3"], b: Float[Array, "N 3"]) -> tuple[Array, Array]:
    """The pair turned and mirrored so that a has azimuth 0 and b one in [0, pi]."""
    rho = safe_sqrt(a[:, 0] ** 2 + a[:, 1] ** 2)
    cos, sin = (jnp.where(rho > 0, x / jnp.where(rho > 0, rho, 1), i) for x, i in ((a[:, 0], 1), (a[:, 1], 0)))
    turned = jnp.stack([cos * b[:, 0] + sin * b[:, 1], jnp.abs(cos * b[:, 1] - sin * b[:, 0]), b[:, 2]], axis=1)
    return jnp.stack([rho, jnp.zeros_like(rho), a[:, 2]], axis=1), turned


def smooth_brdf(brdf: ProjectedBrdf, kappa: ArrayLike) -> ProjectedBrdf:
    """The BRDF convolved in both directions with a von Mises-Fisher kernel, K exp(kappa (wi.z + wo.z)) (ISD15 Eq. 32).

    Coefficients are multiplied by k_l k_l' / (pi_l pi_l'), which is exactly 1 at l = l' = 0: the integral over sphere x
    sphere, of the expansion with what it is below the horizon, is kept to the last bit, and so is reciprocity.

    Arguments: `kappa` >= 0, scalar; the kernel's standard deviation is about kappa^(-1/2) rad along each axis. 0 leaves
    the mean alone; from 1e8 on nothing changes. Negative or NaN: an error at run time.
    Derivatives: in the coefficients and in `kappa`, every order. Accuracy: of the factors, 1e-12 in float64 and 1e-5 in
    float32 (tests).
    """
    if not isinstance(brdf, ProjectedBrdf):
        raise ValueError(f"`brdf` must be a models.ProjectedBrdf; got {type(brdf).__name__}. Fit one with fit_brdf.")
    kappa = _checks.scalar("kappa", kappa)
    c, degree = brdf.coefficients, brdf.degree
    factor = _von_mises_fisher(kappa.astype(c.dtype), degree)
    factor = factor if brdf.isotropic else factor[bands(degree)]
    both = jnp.broadcast_to(factor[:, None] * factor[None, :], c.shape)
    return ProjectedBrdf(c * both, isotropic=brdf.isotropic, clamp=brdf.clamp)


def _von_mises_fisher(kappa: Scalar, degree: int) -> Float[Array, " bands"]:
    """k_l / pi_l, with k_0 / pi_0 = 1."""
    kappa = eqx.error_if(kappa, ~(kappa >= 0), "`kappa` must be >= 0.")
    k = gaussian_zonal(jnp.minimum(kappa, 1e8), degree) / jnp.asarray(zonal_norms(degree), kappa.dtype)
    return jnp.concatenate([jnp.ones_like(k[:1]), k[1:] / k[0]])


class DenoisedMerl(NamedTuple):
    """The result of `denoise_merl`.

    `smoothness` as used; `noise`: RMS relative difference to the bins that it was chosen by, NaN when it was given;
    `missing`: values above the horizon that were not valid; `extrapolated`: pairs of theta_h and theta_d above the
    horizon without one valid bin.
    """

    brdf: MeasuredBrdf
    smoothness: float
    noise: float
    missing: int
    extrapolated: int


def denoise_merl(
    source: str | os.PathLike[str] | np.ndarray,
    *,
    smoothness: float | None = None,
    mirrored: bool = False,
    dtype: DTypeLike = np.float32,
    progress: Progress = None,
) -> DenoisedMerl:
    """A clean material from a noisy MERL table with holes.

    Fits the logarithm z of the table: least squares over the valid bins plus `smoothness` times the squared Laplacian,
    second differences in bins over theta_h, theta_d and phi_d. What does not depend on phi_d is seen by many bins and
    costs a thousandth. A thousandth of the median is added before the logarithm is taken, so zeros are ordinary values.
    Every colour is then scaled so that the energy over its valid bins, weighted by solid angles and cosines, is that of
    the data. The result is reciprocal as every MERL table is, by the period of phi_d.

    Arguments: `source`, a path for `io.read_merl` or a table [90, 90, 180, 3] in 1/sr. Negative and non-finite bins are
    missing. `smoothness` > 0; None takes the one of 1, 10, 100 and 1000 that best predicts a tenth of the bins from the
    others. `mirrored=True` makes bins at phi_d and 180 degrees - phi_d one, as they are for materials that are their
    own mirror image: half the work and less noise, but what a table holds of differences is lost. `progress`: None,
    True for a bar of tqdm, or a function of fits that are done and in all.
    Bins below the horizon take the nearest value from above it; large gaps stay within the range of the data.
    Errors: those of `read_merl`; ValueError for another shape, a colour without a positive value, or a float64 result
    without x64. Where more than a tenth of the pairs of theta_h and theta_d have no valid bin, it warns.
    Derivatives: none; it runs on the host, in float32, and `dtype` is that of the result.
    Accuracy: from 10 % noise and half of the bins, RMS errors over the bins fall to a third or less, and albedos change
    by less than 1 %, noise's own mean included, for plastic, gold paint and GGX of alpha 0.1 and 0.3 (tests). Poles of
    1/cos^2 at grazing angles, as of the ABC model, are not followed in their last bins.
    Cost: at most 60 steps of six products with [90, 90] matrices, for each try and colour.
    """
    table = np.asarray(source, np.float64) if isinstance(source, np.ndarray) else io.read_merl(source)
    if table.shape != (*io.MERL_BINS, 3):
        raise ValueError(f"`source` must be a path or a table [90, 90, 180, 3]; got shape {list(table.shape)}.")
    if smoothness is not None:
        smoothness = _checks.number("smoothness", smoothness, positive=True)
    above = io.merl_above_horizon()[..., None]
    valid = np.isfinite(table) & (table >= 0) & above
    table = np.where(valid, table, 0)
    if not (table > 0).any(axis=(0, 1, 2)).all():
        raise ValueError("`source` has a colour without a positive value above the horizon.")
    missing = int(np.sum(above & ~valid))
    seen = above.any(axis=(2, 3))
    extrapolated = int(np.sum(seen & ~valid.any(axis=(2, 3))))
    if extrapolated > 0.1 * seen.sum():
        warnings.warn(f"{extrapolated} of {seen.sum()} pairs of theta_h and theta_d have no valid bin; they are "
                      "extrapolated.", UserWarning, stacklevel=2)  # fmt: skip

    fold = (lambda a: (a + a[:, :, ::-1])[:, :, :90]) if mirrored else (lambda a: a)
    count = fold(valid.astype(np.float64))
    mean = fold(table) / np.maximum(count, 1)
    dark = np.array([np.median(table[..., c][table[..., c] > 0]) for c in range(3)]) / 1000
    log, count = (np.moveaxis(a, -1, 0).astype(np.float32) for a in (np.log(mean + dark), count))
    noise = float("nan")
    with reporting(progress, 3 if smoothness is not None else 3 + len(_SMOOTHNESS), "fits") as step:

        def fit(y: np.ndarray, w: np.ndarray, smoothness: float) -> np.ndarray:
            z = np.asarray(_smooth(y, w, smoothness), np.float64)
            step()
            return z

        if smoothness is None:
            smoothness, noise = _choose(log, count, fit)
        z = [fit(y, w, smoothness) for y, w in zip(log, count, strict=True)]
    lowest, highest = (f(np.where(count > 0, log, np.nan), axis=(1, 2, 3)) for f in (np.nanmin, np.nanmax))
    smooth = np.maximum(np.exp(np.clip(np.stack(z, axis=-1), lowest, highest)) - dark, 0)
    smooth = np.concatenate([smooth, smooth[:, :, ::-1]], axis=2) if mirrored else smooth
    energy = _bin_energy()[..., None]
    smooth *= np.sum(energy * table, axis=(0, 1, 2)) / np.sum(energy * smooth * valid, axis=(0, 1, 2))
    filled = fill_nearest(smooth, np.broadcast_to(above, smooth.shape))
    result = jnp.asarray(filled.astype(dtype))  # type: ignore[union-attr]  # every colour has valid bins
    if result.dtype != np.dtype(dtype):
        raise ValueError(f"`dtype` {np.dtype(dtype)} needs jax_enable_x64.")
    return DenoisedMerl(MeasuredBrdf(result), float(smoothness), noise, missing, extrapolated)


def _choose(log: np.ndarray, count: np.ndarray, fit: Callable[..., np.ndarray]) -> tuple[float, float]:
    """The smoothness that best predicts bins that were held out, over the mean of colours, and the RMS difference."""
    known = np.all(count > 0, axis=0)
    y = log.mean(axis=0)
    w = np.where(known, count.mean(axis=0), 0).astype(np.float32)
    out = known & (np.random.default_rng(0).random(known.shape) < 0.1)
    if not out.any():
        raise ValueError("`source` has too few bins that are valid in all colours to choose by; pass `smoothness`.")
    errors = [np.average((fit(y, np.where(out, 0, w), s) - y)[out] ** 2, weights=w[out]) for s in _SMOOTHNESS]
    return _SMOOTHNESS[int(np.argmin(errors))], float(np.sqrt(np.min(errors)))


@jax.jit
def _smooth(y: Float[Array, "90 90 p"], w: Float[Array, "90 90 p"], smoothness: ArrayLike) -> Array:
    """Minimises sum w (z - y)^2 + smoothness |D z|^2, D the Laplacian in bins, by conjugate gradients over waves."""
    *matrices, curvature = _waves(y.shape[2])
    cosines, along_phi = (jnp.asarray(m, y.dtype) for m in matrices)
    waves = lambda z: jnp.einsum("ah,bd,cp,hdp->abc", cosines, cosines, along_phi, z, optimize="optimal")
    bins = lambda c: jnp.einsum("ah,bd,cp,abc->hdp", cosines, cosines, along_phi, c, optimize="optimal")
    penalty = jnp.asarray(curvature, y.dtype) * jnp.asarray(smoothness, y.dtype)
    row = jnp.sum(w, axis=2, keepdims=True)
    over = jnp.sum(w * y, axis=2, keepdims=True)
    start = jnp.where(row > 0, over / jnp.where(row > 0, row, 1), jnp.sum(over) / jnp.sum(row))
    c, _ = cg(
        lambda c: waves(w * bins(c)) + penalty * c,
        waves(w * y),
        waves(jnp.broadcast_to(start, y.shape)),
        tol=1e-5,
        maxiter=60,
        M=lambda r: r / (jnp.mean(w) + penalty),
    )
    return bins(c)


@functools.cache
def _waves(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orthonormal waves [k, bin] over theta_h and theta_d, and over phi_d; squared eigenvalues of the Laplacian.

    Over phi_d they are even about both ends of 90 bins, or periodic in 180. For k = 0 in phi_d a thousandth is taken.
    """
    k = np.arange(90)
    cosines = np.cos(np.pi * np.outer(k, k + 0.5) / 90) * np.where(k == 0, 1, np.sqrt(2))[:, None] / np.sqrt(90)
    one = 2 - 2 * np.cos(np.pi * k / 90)
    along_phi, two = cosines, one
    if size > 90:
        k = np.arange(1, size)
        angles = np.pi / size * np.outer(2 * ((k + 1) // 2), np.arange(size) + 0.5)
        along_phi = np.where(k[:, None] % 2 == 1, np.cos(angles), np.sin(angles)) * np.sqrt(2 / size)
        along_phi[-1] = (-1.0) ** np.arange(size) / np.sqrt(size)  # of half the bins' number, there is only one wave
        along_phi = np.concatenate([np.full((1, size), 1 / np.sqrt(size)), along_phi])
        two = 2 - 2 * np.cos(2 * np.pi * np.concatenate([[0], (k + 1) // 2]) / size)
    curvature = (one[:, None, None] + one[None, :, None] + two[None, None, :]) ** 2
    curvature[:, :, 0] /= 1000
    return cosines, along_phi, curvature


def _bin_energy() -> np.ndarray:
    """cos_i cos_o dwi dwo of each bin of a MERL table, up to a factor; zero below the horizon."""
    wi, wo = io.merl_directions()
    theta_h = np.pi / 2 * ((np.arange(90) + 0.5) / 90) ** 2
    theta_d = np.pi / 2 * (np.arange(90) + 0.5) / 90
    solid_angles = np.outer(np.sin(theta_h) * (np.arange(90) + 0.5), np.sin(theta_d) * np.cos(theta_d))
    return solid_angles[..., None] * np.maximum(wi[..., 2], 0) * np.maximum(wo[..., 2], 0)
