"""Few lobes fitted to samples by non-linear least squares, their weights by linear least squares inside.

ISD15 section 7.2 calls fits of Gaussian mixtures expensive and unstable, and compares with them; tests/bench does too.
Measured on slices of four materials, 1 to 7 Gaussians: Levenberg-Marquardt ends at the errors of BFGS, but takes many
times as long; with the weights among its unknowns BFGS needs more steps. So it is BFGS, weights projected out.

notation: Phi(p) = columns of the lobes at the parameters p (axes, log sharpness), times the root of the solid angles;
a(p) = the weights that minimise |Phi a - y|^2: variable projection (Golub and Pereyra 1973).
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.scipy.linalg import cho_factor, cho_solve

from shisd import _checks
from shisd._numerics import normalize
from shisd._status import Status, settled
from shisd._typing import Array, ArrayLike, Float, Scalar
from shisd.decomposition._mixtures import AbstractLobes, GaussianLobes


class LobeFit(NamedTuple):
    """What `fit_lobes` returns."""

    lobes: AbstractLobes
    error: Scalar
    steps: Array
    status: Status


def fit_lobes(
    start: int | AbstractLobes | Sequence[AbstractLobes],
    directions: ArrayLike,
    values: ArrayLike,
    solid_angles: ArrayLike,
    *,
    starts: int = 1,
    key: Array | None = None,
    max_steps: int = 256,
    tolerance: float | None = None,
    ridge: float = 0.0,
    throw: bool = True,
) -> LobeFit:
    """The lobes nearest to samples of a function on the sphere, in least squares weighed by solid angle.

    Axes and widths move by BFGS from each start; weights are the best for them at every step. The best result wins.

    Arguments: `start`, how many Gaussians, which begin at the peaks of the samples; or GaussianLobes or ZonalLobes, one
    or several of one kind and size: their weights are not used, except for the degree of ZonalLobes. With a number, the
    second and further of static `starts` vary the first at random, from `key` (0 unless given). `directions` [N, 3];
    `values` [*colour, N]; `solid_angles` [N] >= 0 in sr, the weights of the samples. Colours share axes and widths.
    Samples should cover the whole sphere, for nothing holds lobes down where there are none. `ridge` >= 0 adds the
    squared norms of the lobes, so many times, to the squared error: large lobes that cancel are then avoided, and
    neighbouring fits can be interpolated (1e-2 is enough); it is at least what rounding needs. Static `max_steps` for
    each start; `tolerance` of the parameters and of the squared error over that of the samples, by default eps^(1/2).
    Returns (lobes, error, steps, status): `error` relative, RMS over the samples; steps of all starts; a
    `shisd.Status`, ok, `step_limit`, `coincident` or `degenerate`. Other than ok it is an error, but with
    `throw=False`, where the best lobes are kept.
    Derivatives: none; differentiate `evaluate` or `coefficients` of the result.
    Accuracy: mixtures of 1, 3 and 7 Gaussians are found again from 861 samples and 3 starts, their axes within 1e-9 rad
    in float64 and 4e-6, 3e-4 and 1e-3 rad in float32.
    Cost: steps x N x (columns)^2; `make bench` reports the time.
    """
    ridge = _checks.number("ridge", ridge)
    if isinstance(start, int):
        lobes = list(lobe_starts(directions, values, solid_angles, start, starts=starts, key=key))
    else:
        lobes = [start] if isinstance(start, AbstractLobes) else list(start)
    _check_starts(lobes)
    w, y, areas = _samples(directions, values, solid_angles)
    unknowns = sum(x.size for x in jax.tree.leaves(_parameters(lobes[0]))) - lobes[0].size  # axes have two each
    unknowns += lobes[0].linear.shape[-1] * (y.size // w.shape[0])
    if y.size < unknowns:
        raise ValueError(f"`values` has {y.size} samples for {unknowns} unknowns. Add samples or use fewer lobes.")
    stacked = jax.tree.map(lambda *x: jnp.stack(x).astype(w.dtype), *lobes)
    eps = float(jnp.finfo(w.dtype).eps)
    penalty = jnp.asarray(max(ridge, 8 * lobes[0].linear.shape[-1] * eps), w.dtype)
    max_steps = _checks.integer("max_steps", max_steps, 1)
    near = eps**0.5 if tolerance is None else _checks.number("tolerance", tolerance, positive=True)
    found = _fit(stacked, w, y, areas, penalty, max_steps, near)
    return settled(found, found.status, throw)


@eqx.filter_jit
def _fit(
    starts: AbstractLobes,
    w: Array,
    y: Float[Array, "*colour N"],
    areas: Array,
    ridge: Scalar,
    max_steps: int,
    tolerance: float,
) -> LobeFit:
    root = jnp.sqrt(areas / jnp.max(areas))[:, None]
    target = y.reshape(-1, w.shape[0]).T * root  # [N, C]
    largest = jnp.max(jnp.abs(target))  # first, for squares of large and of small numbers leave the range
    largest = eqx.error_if(largest, ~(largest > 0), "`values` are zero wherever they count: there is nothing to fit.")
    length = jnp.sqrt(jnp.sum((target / largest) ** 2))
    target = target / largest / length

    def error2(columns, weights):
        rest = columns @ weights - target
        return jnp.sum(rest * rest)

    def loss(parameters, template):
        columns = _place(template, parameters).columns(w) * root
        # at the best weights the loss is flat in them, so its gradient need not follow them
        a = _best_weights(jax.lax.stop_gradient(columns), target, ridge)
        return error2(columns, a) + ridge * jnp.sum((_lengths(columns)[:, None] * a) ** 2)

    def run(template):
        template = _checked_start(template)
        first = _parameters(template)
        found = optx.minimise(loss, optx.BFGS(tolerance, tolerance), first, template, max_steps=max_steps, throw=False)
        before, after = loss(first, template), loss(found.value, template)
        better = after <= before  # False for NaN
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), found.value, first)
        status = Status.where(found.result == optx.RESULTS.successful, Status.ok, Status.step_limit)
        return best, jnp.where(better, after, before), found.stats["num_steps"], status

    # One start after another: batched factorisations may wait for each other for ever (see `_basis`).
    parameters, losses, steps, status = jax.lax.map(run, starts)
    best = jnp.argmin(jnp.where(jnp.isfinite(losses), losses, jnp.inf))
    parameters, template, status = jax.tree.map(lambda x: x[best], (parameters, starts, status))
    lobes = _place(template, parameters)
    columns = lobes.columns(w) * root
    weights = _best_weights(columns, target, ridge)
    seen_by = jnp.sum(columns**2, axis=0) ** 2 / jnp.sum(columns**4, axis=0)  # samples, or NaN
    status = Status.where(_coincide(lobes), Status.coincident, status)
    found = jnp.all(seen_by > 1.5) & jnp.all(jnp.isfinite(weights))
    status = Status.where(found, status, Status.degenerate)
    lobes = lobes.with_linear((largest * (length * weights.T)).reshape(*y.shape[:-1], -1))
    return LobeFit(lobes, jnp.sqrt(error2(columns, weights)), jnp.sum(steps), status)


def lobe_starts(
    directions: ArrayLike,
    values: ArrayLike,
    solid_angles: ArrayLike,
    count: int,
    *,
    starts: int = 1,
    key: Array | None = None,
) -> tuple[GaussianLobes, ...]:
    """Starts for `fit_lobes`: `count` Gaussians peeled off the largest peaks of the samples one by one, and variations.

    At the sample where the rest is largest, the width of sixteen that lowers it most is taken and its Gaussian
    subtracted. The second and further of `starts` are the first with axes moved by half a width and widths by a factor
    of about 2, at random from `key` (0 unless given).

    Arguments: samples as in `fit_lobes`; static `count` and `starts`, at least 1. Sharpness lies between 0.5 and
    that of the highest sample, 2 pi over its solid angle. Derivatives: none.
    """
    w, y, areas = _samples(directions, values, solid_angles)
    count, starts = _checks.integer("count", count, 1), _checks.integer("starts", starts, 1)
    largest = jnp.max(jnp.abs(y))
    scale = jnp.where(largest > 0, largest, 1)
    first = _peel(w, y.reshape(-1, w.shape[0]) / scale, areas, count)
    first = first.with_linear(first.weights * scale)
    key = jax.random.key(0) if key is None else key
    z, log_sharpness = first.directions, jnp.log(first.sharpness)
    variations = [first]
    for one in jax.random.split(key, starts - 1):
        turn, widen = jax.random.split(one)
        step = jax.random.normal(turn, z.shape, z.dtype) / (2 * jnp.sqrt(first.sharpness)[:, None])
        factor = 0.7 * jax.random.normal(widen, log_sharpness.shape, z.dtype)
        variations.append(GaussianLobes(normalize(z + step), jnp.exp(log_sharpness + factor), first.weights))
    return tuple(v.with_linear(v.weights.reshape(*y.shape[:-1], count)) for v in variations)


@eqx.filter_jit
def _peel(w: Float[Array, "N 3"], y: Float[Array, "C N"], areas: Float[Array, " N"], count: int) -> GaussianLobes:
    root = jnp.sqrt(areas)[:, None]
    target = y.T * root
    peak = areas[jnp.argmax(jnp.where(areas > 0, jnp.sum(y * y, axis=0), 0))]
    widths = 0.5 * jnp.maximum(4 * np.pi / peak, 2) ** jnp.asarray(np.arange(16) / 15, w.dtype)
    ridge = jnp.asarray(8 * count * jnp.finfo(w.dtype).eps, w.dtype)

    def peel(columns, j):
        rest = target - columns @ _best_weights(columns, target, ridge)
        top = jnp.argmax(jnp.sum(rest * rest, axis=1) / jnp.maximum(areas, jnp.finfo(w.dtype).tiny))
        ladder = widths * (1 + j.astype(w.dtype) / (32 * count))  # a hair apart, so that no two lobes are ever one
        shapes = GaussianLobes(jnp.tile(w[top], (16, 1)), ladder, jnp.ones_like(ladder)).columns(w) * root  # [N, 16]
        match = jnp.sum((shapes.T @ rest) ** 2, axis=1) / jnp.sum(shapes * shapes, axis=0)
        k = jnp.argmax(match)
        return columns.at[:, j].set(shapes[:, k]), (w[top], ladder[k])

    empty = jnp.zeros((w.shape[0], count), w.dtype)
    columns, (z, sharpness) = jax.lax.scan(peel, empty, jnp.arange(count))
    return GaussianLobes(z, sharpness, _best_weights(columns, target, ridge).T)


def _best_weights(columns: Float[Array, "N m"], target: Float[Array, "N c"], ridge: Scalar) -> Float[Array, "m c"]:
    """Weights of least squares, of columns scaled to unit length plus `ridge`: they may be alike, or zero.

    Normal equations, faster than QR, and one step of refinement for the digits they lose.
    """
    norm = _lengths(columns)
    scaled = columns / norm[None]
    gram = scaled.T @ scaled + ridge * jnp.eye(norm.size, dtype=norm.dtype)
    factor = cho_factor(gram)
    a = cho_solve(factor, scaled.T @ target)
    a = a + cho_solve(factor, scaled.T @ (target - scaled @ a) - ridge * a)
    return a / norm[:, None]


def _lengths(columns: Float[Array, "N m"]) -> Float[Array, " m"]:
    square = jnp.sum(columns * columns, axis=0)
    return jnp.sqrt(jnp.where(square > 0, square, 1))


def _parameters(lobes: AbstractLobes) -> tuple[Array, ...]:
    """What a fit moves: axes of any length, and logarithms, so that widths stay positive."""
    if isinstance(lobes, GaussianLobes):
        return normalize(lobes.directions), jnp.log(lobes.sharpness)
    return (normalize(lobes.directions),)


def _place(lobes: AbstractLobes, parameters: tuple[Array, ...]) -> AbstractLobes:
    lobes = eqx.tree_at(lambda x: x.directions, lobes, normalize(parameters[0]))
    if isinstance(lobes, GaussianLobes):
        lobes = eqx.tree_at(lambda x: x.sharpness, lobes, jnp.exp(parameters[1]))
    return lobes


def _samples(
    directions: ArrayLike, values: ArrayLike, solid_angles: ArrayLike
) -> tuple[Float[Array, "N 3"], Float[Array, "*colour N"], Float[Array, " N"]]:
    w, y = _checks.vectors("directions", directions), _checks.real_array("values", values)
    areas = _checks.real_array("solid_angles", solid_angles)
    if w.ndim != 2:
        raise ValueError(f"`directions` must have shape [N, 3]; got {list(w.shape)}.")
    if y.shape[-1:] != w.shape[:1]:
        raise ValueError(f"`values` must have shape [*colour, N] with N = {w.shape[0]} samples; got {list(y.shape)}.")
    if areas.shape != w.shape[:1]:
        raise ValueError(f"`solid_angles` must have shape [N] = [{w.shape[0]}]; got {list(areas.shape)}.")
    dtype = jnp.result_type(w, y, areas)
    w, y, areas = normalize(w).astype(dtype), y.astype(dtype), areas.astype(dtype)
    finite = jnp.all(jnp.isfinite(w)) & jnp.all(jnp.isfinite(y)) & jnp.all(jnp.isfinite(areas) & (areas >= 0))
    message = "`directions`, `values` or `solid_angles` has NaN, infinite, zero-length or negative entries."
    return w, eqx.error_if(y, ~finite, message), areas


def _check_starts(starts: Sequence[AbstractLobes]) -> None:
    if not starts or not all(isinstance(s, AbstractLobes) for s in starts):
        raise ValueError("`start` must be GaussianLobes or ZonalLobes, a sequence of them, or a number of Gaussians.")
    shapes = [jax.tree.map(jnp.shape, s) for s in starts]
    if any(s != shapes[0] for s in shapes):
        raise ValueError("the lobes of `start` must be of one kind, number and degree.")


def _checked_start(lobes: AbstractLobes) -> AbstractLobes:
    wrong = ~jnp.all(jnp.isfinite(normalize(lobes.directions)))
    if isinstance(lobes, GaussianLobes):
        wrong |= ~jnp.all((lobes.sharpness > 0) & jnp.isfinite(lobes.sharpness))
    message = "`start` has an axis that is zero or not finite, or a sharpness that is not positive."
    return eqx.tree_at(lambda x: x.directions, lobes, eqx.error_if(lobes.directions, wrong, message))


def _coincide(lobes: AbstractLobes) -> Array:
    """Whether two lobes are one and the same, within a hundredth of their width: they move as one, or cancel."""
    z = lobes.directions
    apart2 = lambda sign: jnp.sum((z[:, None] - sign * z[None]) ** 2, axis=-1)
    if isinstance(lobes, GaussianLobes):
        k = lobes.sharpness[:, None]
        twins = (apart2(1) * k < 1e-4) & (jnp.abs(k / k.T - 1) < 1e-2)
    else:
        twins = jnp.minimum(apart2(1), apart2(-1)) < 1e-4
    return jnp.any(twins & ~np.eye(len(z), dtype=bool))
