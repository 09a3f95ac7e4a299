"""Scattered samples of BRDFs made coefficients by regularised least squares, and smooth by a filter.

Follows ISD15 section 6.3 (Eq. 30-32): the 4D data are projected on harmonics of both directions and filtered by a
separable von Mises-Fisher kernel, which multiplies bands. It differs in the projection: samples are scattered and only
above the horizon, so coefficients are fitted, not integrated, with a penalty on the Laplacian that decides where there
are no samples.

notation: C as in ISD15 Eq. 30; k_l, pi_l = coefficients of the kernel (Eq. 31) and of the delta function.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.sparse.linalg import cg

from shisd import _checks
from shisd._numerics import normalize, safe_sqrt
from shisd._status import Status, settled
from shisd._typing import Array, ArrayLike, Float, Scalar
from shisd.decomposition.internal import gaussian_zonal
from shisd.harmonics import sh_basis
from shisd.harmonics.internal import bands, of_order, zonal_norms
from shisd.models import ProjectedBrdf
from shisd.models.internal import symmetric

_TILE = 1024  # samples whose harmonics are in memory at a time
_PROBES = 256  # pairs of directions at which coverage is judged


class BrdfFit(NamedTuple):
    """What `fit_brdf` returns."""

    brdf: ProjectedBrdf
    error: Scalar
    coverage: Scalar
    missing: Array
    status: Status


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
    throw: bool = True,
) -> BrdfFit:
    """The band-limited BRDF nearest to scattered samples: regularised projection (ISD15 Eq. 30).

    Minimises the weighted mean of (f - values)^2 plus `ridge` times the mean over sphere x sphere of the squared
    Laplacian of f, its sum over both directions: a wave of degree l in both is halved near l = (4 ridge)^(-1/4).

    Arguments: `wi`, `wo` [N, 3] of any length, local frame; `values` [N, *colour] in 1/sr; `weights` [N] >= 0, by
    default equal. Give 1 / values^2, with a floor, where noise is a share of the value, and solid angles where samples
    are unevenly spread. `ridge` > 0. Static `degree` L, `isotropic`, `max_steps` of conjugate gradients.
    Negative, infinite and NaN values, and directions that are not above the horizon, are missing: left out and counted.
    It is an error at run time if a colour has no value with weight left. Where samples cover only a part, the ridge
    decides on the rest.
    Returns (brdf, error, coverage, missing, status), brdf a `models.ProjectedBrdf`. `error`: RMS of the residual over
    that of the samples, both weighted. `coverage`: share of 256 pairs of directions, spread by cosine, that have a
    sample within pi / (2 degree + 2) of both. `missing`: values that were left out. The `shisd.Status` is ok,
    `step_limit`, or, for a coverage below 0.8, `uncovered`: errors, but with `throw=False`.
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
    found = _fit(wi.astype(y.dtype), wo.astype(y.dtype), y, w.astype(y.dtype), ridge.astype(y.dtype), degree, isotropic,
                 max_steps)  # fmt: skip
    return settled(found, found.status, throw)


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
    status = Status.where(coverage < 0.8, Status.uncovered, Status.ok)
    status = Status.where(left <= 1e-8, status, Status.step_limit)
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
