"""Noisy MERL tables with holes made smooth.

Bins around the highlight hold values that span many decades, which no expansion of moderate degree follows. So it is a
penalised least squares fit of their logarithm on the table's own angles. There the noise is even, highlights are
straight ridges, and reciprocity is the period of phi_d.

notation: W = weights, z = the smooth logarithm, P = penalty of each cosine wave.
"""

import functools
import os
import warnings
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg

from shisd import _checks, io
from shisd._progress import Progress, reporting
from shisd._typing import Array, ArrayLike, DTypeLike, Float
from shisd.io.internal import MERL_BINS, merl_above_horizon, merl_directions
from shisd.models import MeasuredBrdf
from shisd.models.internal import fill_nearest

_SMOOTHNESS = (1.0, 10.0, 100.0, 1000.0)  # what is tried


class DenoisedMerl(NamedTuple):
    """What `denoise_merl` returns."""

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
    Returns (brdf, smoothness, noise, missing, extrapolated), brdf a `models.MeasuredBrdf`; `smoothness` as used;
    `noise`: RMS relative difference to the bins that it was chosen by, NaN when it was given; `missing`: values above
    the horizon that were not valid; `extrapolated`: pairs of theta_h and theta_d above the horizon without a valid bin.
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
    if table.shape != (*MERL_BINS, 3):
        raise ValueError(f"`source` must be a path or a table [90, 90, 180, 3]; got shape {list(table.shape)}.")
    if smoothness is not None:
        smoothness = _checks.number("smoothness", smoothness, positive=True)
    above = merl_above_horizon()[..., None]
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
    wi, wo = merl_directions()
    theta_h = np.pi / 2 * ((np.arange(90) + 0.5) / 90) ** 2
    theta_d = np.pi / 2 * (np.arange(90) + 0.5) / 90
    solid_angles = np.outer(np.sin(theta_h) * (np.arange(90) + 0.5), np.sin(theta_d) * np.cos(theta_d))
    return solid_angles[..., None] * np.maximum(wi[..., 2], 0) * np.maximum(wo[..., 2], 0)
