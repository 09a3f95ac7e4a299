"""Expansions on a stretched sphere: a linear map of directions widens a lobe before it is expanded.

Linearly transformed cosines (Heitz et al. 2016) map one cosine; here any expansion is mapped, so that sharp lobes need
few bands. CSH18 (section 6.2) names this as future work. Great arcs stay great arcs, so integrals over polygons are
those of the expansion over the mapped polygon, and exact.

What is broad under the lobe, or cut off at the horizon beside it, a few plain harmonics take up: a base of degree 2
halves the error of grazing slices (GGX of alpha 0.25 at 85 degrees and degree 8: 0.043, with it 0.023).

notation: A = the map, w' = A w / |A w|; s = its five numbers (`_stretch`); Phi(s) = columns det(A) |A w|^-3 y(w') at
the samples w, and those y(w) of the base, times the roots of their weights; t = samples, so weighed; c(s) =
coefficients that minimise |Phi c - t|^2 + r^2 |c|^2: variable projection (Golub and Pereyra 1973).
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.scipy.linalg import solve_triangular

from shisd import _checks
from shisd._methods import method
from shisd._module import Module
from shisd._numerics import normalize
from shisd._status import Status, settled
from shisd._typing import Array, ArrayLike, Float, Scalar
from shisd.decomposition._stretch import SIZE, log_stretch, map_directions, moments_starts, stretch
from shisd.harmonics import evaluate, sh_basis
from shisd.harmonics.internal import orders

RIDGE = 1e-6
_NEAR = 1e-8  # times the squared size of s, added to the squared error: decides where no map is better than another


class TransformedExpansion(Module):
    """An expansion beyond a map, and a base: det(A) / |A w|^3 sum_lm c_lm y_lm(A w / |A w|) + sum_lm b_lm y_lm(w).

    Arguments: `transform` [3, 3], A, of positive determinant, its scale without effect; `coefficients` [*colour,
    (degree + 1)^2], c; `base` [*colour, (base degree + 1)^2], b, none unless given. Its integral over a polygon,
    `domains.integrate(f, polygon)`, is that of the expansion over the mapped polygon and that of the base.
    Derivatives: everywhere, in all.
    """

    transform: Float[Array, "3 3"]
    coefficients: Float[Array, "*colour n"]
    base: Float[Array, "*colour k"] | None

    def __init__(self, transform: ArrayLike, coefficients: ArrayLike, base: ArrayLike | None = None):
        a, (c, _) = _checks.real_array("transform", transform), _checks.coefficients("coefficients", coefficients)
        b = None if base is None else _checks.coefficients("base", base)[0]
        if a.shape != (3, 3):
            raise ValueError(f"`transform` must have shape [3, 3]; got {list(a.shape)}.")
        if b is not None and b.shape[:-1] != c.shape[:-1]:
            raise ValueError(f"`base` {list(b.shape)} and `coefficients` {list(c.shape)} are of other colours.")
        dtype = jnp.result_type(a, c, *([] if b is None else [b]))
        self.transform, self.coefficients = a.astype(dtype), c.astype(dtype)
        self.base = None if b is None else b.astype(dtype)

    @property
    def degree(self) -> int:
        return _checks.degree_of(self.coefficients.shape[-1])

    @method
    def directions(self, directions: ArrayLike) -> Float[Array, "*batch 3"]:
        """Where directions [..., 3] are mapped to, as unit vectors."""
        return normalize(_checks.vectors("directions", directions).astype(self.transform.dtype) @ self.transform.T)

    @method
    def evaluate(self, directions: ArrayLike) -> Float[Array, "*colour_batch"]:
        """Values [*colour, ...] towards `directions` [..., 3] of any length."""
        w = normalize(_checks.vectors("directions", directions).astype(self.transform.dtype))
        mapped, jacobian = map_directions(self.transform, w)
        for_each = lambda c: c.reshape(*c.shape[:-1], *(1,) * (w.ndim - 1), -1)
        values = evaluate(for_each(self.coefficients), mapped)
        values = values * jnp.broadcast_to(jacobian, values.shape)
        return values if self.base is None else values + evaluate(for_each(self.base), w)


class TransformedFit(NamedTuple):
    """What `fit_transformed` returns."""

    expansion: TransformedExpansion
    error: Float[Array, "*colour"]
    status: Status


class Setting(NamedTuple):
    """What is static in fits."""

    degree: int
    base: int | None
    even: bool
    max_steps: int
    tolerance: float

    def used(self, degree: int) -> np.ndarray:
        """Rows of the harmonics that are fitted."""
        return np.flatnonzero(orders(degree) >= 0) if self.even else np.arange((degree + 1) ** 2)

    @property
    def free(self) -> np.ndarray:
        """The numbers of a map that are searched."""
        return np.arange(SIZE // 2 if self.even else 0, SIZE)


def fit_transformed(
    directions: ArrayLike,
    values: ArrayLike,
    solid_angles: ArrayLike,
    degree: int,
    *,
    base_degree: int | None = None,
    start: ArrayLike | None = None,
    even: bool = False,
    ridge: float = RIDGE,
    max_steps: int = 64,
    tolerance: float = 1e-4,
    throw: bool = True,
) -> TransformedFit:
    """The map of directions beyond which an expansion of a low degree is nearest to samples of a lobe.

    The map moves by Powell's dogleg method from each start; coefficients are the best for it at every step.

    Arguments: `directions` [N, 3]; `values` [*colour, N], colours share the map; `solid_angles` [N] >=
    0 in sr, the weights of the samples. Where there are none, as below the horizon, nothing holds the expansion. Static
    `base_degree`: plain harmonics to that degree are fitted beside it. `start` [3, 3] or [S, 3, 3], maps of positive
    determinant; by default four, from the moments of the samples. Static `even`: the lobe is even in y, as seen by a
    view in the plane of x and z, and so are map and expansion; samples with y >= 0 do then. `ridge` > 0 limits
    coefficients that the samples hardly show: rounding grows like 1 / sqrt(ridge). Static `max_steps` of each start, 0
    for the best expansion beyond a given map, whose error is what the search makes small; `tolerance` of a step of the
    map that ends the search.
    Returns (expansion, error, status): a map that is symmetric and of determinant 1, for others with the same A^T A
    only turn the expansion; `error` [*colour], RMS over the samples, relative to the brightest colour; a
    `shisd.Status`, ok or `step_limit`, which is an error but with `throw=False`, where the best expansion is kept.
    Derivatives: in samples and weights, first ones, by the implicit function theorem, right where the search ended at a
    minimum; with max_steps=0 in the start too.
    Cost: steps x N x (degree + 1)^4 x 9, or 5 and (degree + 1)^4 / 4 of even lobes.
    """
    base = None if base_degree is None else _checks.integer("base_degree", base_degree)
    even, ridge = bool(even), _checks.number("ridge", ridge, positive=True)
    tolerance = _checks.number("tolerance", tolerance, positive=True)
    setting = Setting(_checks.degree(degree), base, even, _checks.integer("max_steps", max_steps), tolerance)
    w, y, areas = _samples(directions, values, solid_angles)
    if start is None:
        starts = None
    else:
        starts = _checks.real_array("start", start).astype(w.dtype)
        if starts.shape[-2:] != (3, 3) or starts.ndim not in (2, 3):
            raise ValueError(f"`start` must have shape [3, 3] or [S, 3, 3]; got {list(starts.shape)}.")
    found = _fit(starts, w, y, areas, ridge, setting)
    return settled(found, found.status, throw)


@eqx.filter_jit
def _fit(starts: Array | None, w: Array, y: Array, areas: Array, ridge: float, setting: Setting) -> TransformedFit:
    if starts is None:
        s = moments_starts(w, y, areas, setting.even)
    else:
        s = jax.vmap(log_stretch)(starts.reshape(-1, 3, 3))
    best, ended = search(s, w, y, areas, jnp.asarray(ridge, w.dtype), setting)
    c, base, error = project_beyond(best, w, y, areas, jnp.asarray(ridge, w.dtype), setting)
    expansion = TransformedExpansion(stretch(best, even=setting.even), c, base)
    return TransformedFit(expansion, error, Status.where(ended, Status.ok, Status.step_limit))


def search(
    starts: Float[Array, "starts 5"], w: Array, y: Array, areas: Array, ridge: Scalar, setting: Setting
) -> tuple[Array, Array]:
    """The best map found, and whether its search ended before the limit of steps."""
    if setting.max_steps == 0:
        ended = jnp.ones((), bool)
        if len(starts) == 1:
            return starts[0], ended
        errors = jax.lax.map(lambda s: jnp.sum(project_beyond(s, w, y, areas, ridge, setting)[2] ** 2), starts)
        return starts[jnp.nanargmin(errors)], ended
    return _search(starts, w, y, areas, ridge, setting)


@functools.partial(jax.custom_jvp, nondiff_argnums=(5,))
def _search(starts: Array, w: Array, y: Array, areas: Array, ridge: Scalar, setting: Setting) -> tuple[Array, Array]:
    dtype, wide = w.dtype, jax.dtypes.canonicalize_dtype(np.float64)  # the one that optimistix's own numbers have
    starts, w, y, areas, ridge = (x.astype(wide) for x in (starts, w, y, areas, ridge))
    target, free = _target(y, areas), setting.free
    place = lambda p: jnp.zeros(SIZE, w.dtype).at[free].set(p, unique_indices=True)

    def residuals(p: Array, _: None) -> Array:
        return jnp.concatenate([_projected(*_columns(place(p), w, areas, ridge, setting), target), _NEAR**0.5 * p])

    def run(s: Array) -> tuple[Array, Array, Array]:
        solver = optx.Dogleg(setting.tolerance, setting.tolerance)
        found = optx.least_squares(residuals, solver, s[free], max_steps=setting.max_steps, throw=False)
        error = jnp.sum(residuals(found.value, None) ** 2)
        return place(found.value), error, found.result == optx.RESULTS.successful

    maps, errors, ended = jax.lax.map(run, starts)
    best = jnp.nanargmin(errors)
    return maps[best].astype(dtype), ended[best]


@_search.defjvp
def _search_jvp(setting, primals, tangents):
    """At a minimum the slope of the squared error in the map stays 0 as the samples change."""
    starts, *samples = primals
    s, ended = _search(starts, *samples, setting)
    slope = lambda s, w, y, areas, ridge: _slope(s, w, y, areas, ridge, setting)[setting.free]
    place = lambda p: jnp.zeros(SIZE, s.dtype).at[setting.free].set(p, unique_indices=True)
    curvature = jax.jacfwd(slope)(s, *samples)[:, setting.free]
    change = jax.jvp(lambda *samples: slope(s, *samples), tuple(samples), tangents[1:])[1]
    return (s, ended), (place(-jnp.linalg.solve(curvature, change)), np.zeros((), jax.dtypes.float0))


def _slope(s: Array, w: Array, y: Array, areas: Array, ridge: Scalar, setting: Setting) -> Float[Array, " 5"]:
    """Of half the squared error of the best expansion, in the map; its derivatives are exact, once."""
    target = _target(y, areas)
    c = _coefficients(*_columns(s, w, areas, ridge, setting), target)

    def half_error(s: Array) -> Array:
        columns, root = _columns(s, w, areas, ridge, setting)
        return jnp.sum((columns @ c - target) ** 2) / 2 + root**2 * jnp.sum(c**2) / 2 + _NEAR * jnp.sum(s**2) / 2

    return jax.grad(half_error)(s)


def project_beyond(
    s: Float[Array, " 5"], w: Array, y: Float[Array, "*colour N"], areas: Array, ridge: Scalar, setting: Setting
) -> tuple[Float[Array, "*colour n"], Float[Array, "*colour k"] | None, Float[Array, "*colour"]]:
    """Coefficients of the nearest expansion beyond a map, those of the base, and its relative error by colour."""
    columns, root = _columns(s, w, areas, ridge, setting)
    target = _target(y, areas)
    c = _coefficients(columns, root, target)
    error = jnp.sqrt(jnp.sum((columns @ c - target) ** 2, axis=0)).reshape(y.shape[:-1])
    c = c.T * _norm(y, areas)

    def full(c: Array, degree: int) -> Array:
        rows = jnp.zeros((len(c), (degree + 1) ** 2), c.dtype).at[:, setting.used(degree)].set(c, unique_indices=True)
        return rows.reshape(*y.shape[:-1], -1)

    count = len(setting.used(setting.degree))
    base = None if setting.base is None else full(c[:, count:], setting.base)
    return full(c[:, :count], setting.degree), base, error


def _norm(y: Array, areas: Array) -> Scalar:
    """Of the largest colour: those that are dark count for little."""
    square = jnp.max(jnp.sum(y.reshape(-1, y.shape[-1]) ** 2 * areas[None], axis=1))
    return jnp.sqrt(jnp.where(square > 0, square, 1))  # black is met by nothing


def _target(y: Array, areas: Array) -> Float[Array, "N colours"]:
    return (y.reshape(-1, y.shape[-1]) * jnp.sqrt(areas)[None] / _norm(y, areas)).T


def _columns(s: Array, w: Array, areas: Array, ridge: Scalar, setting: Setting) -> tuple[Float[Array, "N n"], Array]:
    """Phi and r, a share of its columns' mean square."""
    root = jnp.sqrt(areas)
    mapped, jacobian = map_directions(stretch(s, even=setting.even), w)
    columns = sh_basis(mapped, setting.degree)[:, setting.used(setting.degree)] * (jacobian * root)[:, None]
    if setting.base is not None:
        base = sh_basis(w, setting.base)[:, setting.used(setting.base)] * root[:, None]
        columns = jnp.concatenate([columns, base], axis=1)
    return columns, jnp.sqrt(ridge * jnp.sum(columns**2) / columns.shape[1])


def _solve(columns: Array, ridge: Array, target: Array) -> tuple[Float[Array, "n colours"], Array, Array, Array]:
    """Coefficients of least squares, residuals [N + n, colours], those of the ridge last, and the QR factors."""
    n = columns.shape[1]
    q, r = _orthonormal(jnp.concatenate([columns, ridge * jnp.eye(n, dtype=columns.dtype)]))
    target = jnp.concatenate([target, jnp.zeros((n, target.shape[1]), target.dtype)])
    share = q.T @ target
    return solve_triangular(r, share), target - q @ share, q, r


def _orthonormal(a: Float[Array, "m n"]) -> tuple[Float[Array, "m n"], Float[Array, "n n"]]:
    """Q and R of a tall matrix from Cholesky factors of A^T A, shifted at first, then of Q^T Q (Fukaya et al. 2020).

    Not `jnp.linalg.qr`, whose threads wait for each other again and again: beside another program on two cores it made
    a table of slices in 53 s and not in 0.8 s (jax 0.10.2).
    """
    n, eps = a.shape[1], float(jnp.finfo(a.dtype).eps)
    one = r = jnp.eye(n, dtype=a.dtype)
    for shift in (10 * n * eps, 0.0, 0.0):
        gram = a.T @ a
        factor = jnp.linalg.cholesky(gram + shift * jnp.trace(gram) * one)
        a = a @ solve_triangular(factor, one, lower=True).T
        r = factor.T @ r
    return a, r


def _coefficients(columns: Array, ridge: Array, target: Array) -> Float[Array, "n colours"]:
    """c, by a step of Newton's method at c, where it is 0: so its first derivatives are those of c."""
    c, _, _, r = jax.lax.stop_gradient(_solve(columns, ridge, target))
    uphill = columns.T @ (columns @ c - target) + ridge**2 * c
    uphill = uphill - jax.lax.stop_gradient(uphill)  # but for rounding
    return c - solve_triangular(r, solve_triangular(r, uphill, trans="T"))


def _projected(columns: Float[Array, "N n"], ridge: Array, target: Float[Array, "N colours"]) -> Array:
    """What least squares leave of the target, with its derivative in the columns (Golub and Pereyra 1973, Eq. 4.10)."""
    c, rest, q, r = jax.lax.stop_gradient(_solve(columns, ridge, target))
    change = lambda x: x - jax.lax.stop_gradient(x)
    moved = change(jnp.concatenate([columns @ c, ridge * c]))
    turned = change(columns.T @ rest[: len(columns)] + ridge * rest[len(columns) :])
    return (rest - moved + q @ (q.T @ moved - solve_triangular(r, turned, trans="T"))).ravel()


def _samples(directions: ArrayLike, values: ArrayLike, solid_angles: ArrayLike) -> tuple[Array, Array, Array]:
    """Directions as unit vectors [N, 3], values [*colour, N] and weights [N], in one dtype."""
    w, y = _checks.vectors("directions", directions), _checks.real_array("values", values)
    areas = _checks.real_array("solid_angles", solid_angles)
    if w.ndim != 2 or y.ndim < 1 or y.shape[-1] != len(w) or areas.shape != (len(w),):
        raise ValueError(
            "`directions` must have shape [N, 3], `values` [*colour, N] and `solid_angles` [N]; got "
            f"{list(w.shape)}, {list(y.shape)} and {list(areas.shape)}."
        )
    dtype = jnp.result_type(w, y, areas)
    return normalize(w.astype(dtype)), y.astype(dtype), areas.astype(dtype)
