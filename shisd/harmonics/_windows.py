"""Windows: one factor for each degree, against the ringing of truncated expansions.

Follows Sloan 2008, *Stupid Spherical Harmonics (SH) Tricks*: the Hann window of a given width, and the window
that penalises the squared Laplacian, made no stronger than needed for the function to stay above a floor. The minimum
over the sphere is sought on a grid first, then by Newton steps from the lowest points.

notation: s = strength, w_l(s) = 1 / (1 + s l^2 (l+1)^2).
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from shisd import _checks
from shisd._numerics import normalize, tangents
from shisd._sharding import by_device
from shisd._status import Status, settled
from shisd._typing import Array, ArrayLike, Float, Scalar
from shisd.harmonics import _layout, _quadrature, _sh, _tables, _transform

_CANDIDATES, _STEPS = 8, 6  # local minima of the grid that are refined, and Newton steps from each
_RUNGS = 48  # strengths that are tried before the bisection


def hann_window(degree: int, width: ArrayLike | None = None) -> Float[Array, " bands"]:
    """Factors (1 + cos(pi l / width)) / 2 of the degrees l = 0 ... `degree`; zero from l = width on.

    Arguments: static `degree` L; `width` > 0, L + 1 unless given (0 or less raises). Returns [L+1] in
    the dtype of `width`.
    Derivatives: in `width`.
    Source: Sloan 2008.
    """
    degree = _checks.degree(degree)
    w = _checks.scalar("width", degree + 1 if width is None else width)
    w = _checks.require(w, w > 0, "`width` must be > 0.")
    ratio = jnp.arange(degree + 1).astype(w.dtype) / jnp.broadcast_to(w, (degree + 1,))
    return jnp.where(ratio < 1, (1 + jnp.cos(jnp.pi * ratio)) / 2, 0)


def laplacian_window(degree: int, strength: ArrayLike) -> Float[Array, " bands"]:
    """Factors 1 / (1 + strength l^2 (l+1)^2) of the degrees l = 0 ... `degree`.

    Arguments: static `degree` L; `strength` >= 0. Returns [L+1] in the dtype of `strength`.
    They minimise the squared difference plus `strength` times the squared Laplacian.
    Derivatives: in `strength`, every order.
    Source: Sloan 2008.
    """
    degree, s = _checks.degree(degree), _checks.scalar("strength", strength)
    s = _checks.require(s, s >= 0, "`strength` must be >= 0.")
    return 1 / (1 + s * jnp.asarray(_curvature(degree), s.dtype))


def apply_window(coefficients: ArrayLike, window: ArrayLike) -> Float[Array, "*batch n"]:
    """Coefficients [..., (L+1)^2] times the factors `window` [L+1] of their degrees.

    Derivatives: linear in each argument.
    """
    c, degree = _checks.coefficients("coefficients", coefficients)
    window = _checks.real_array("window", window)
    if window.shape != (degree + 1,):
        raise ValueError(
            f"`window` must have shape [{degree + 1}], one factor for each degree of `coefficients`; got "
            f"{list(window.shape)}."
        )
    dtype = jnp.promote_types(c.dtype, window.dtype)
    return c.astype(dtype) * jnp.broadcast_to(window.astype(dtype)[_layout.bands(degree).astype(np.int32)], c.shape)


class Deringed(NamedTuple):
    """What `dering` returns."""

    coefficients: Float[Array, "*batch n"]
    strength: Float[Array, "*batch"]
    status: Status


def dering(coefficients: ArrayLike, *, floor: ArrayLike = 0.0, throw: bool = True) -> Deringed:
    """The expansion under the weakest `laplacian_window` for which it is nowhere below `floor`.

    Arguments: `coefficients` [..., (L+1)^2], each expansion by itself; `floor`, a number. Where the expansion is above
    the floor already, it is returned as it is, with strength 0. Where its mean is not above the floor, no window can
    help: an error, or with `throw=False` the mean alone, with strength inf, and `mean_below_floor` as the status.
    Returns (coefficients [..., (L+1)^2], strength [...], status), one `shisd.Status` for all.
    Derivatives: of first order, both modes, by the implicit function theorem at the lowest direction; 0 where the
    strength is 0. Not smooth where the lowest direction changes, nor where the strength becomes positive.
    Accuracy: the minimum over the sphere reaches `floor` to 1e-9 of (mean - floor) in float64, 1e-4 in float32.
    Cost: about 100 syntheses on grids of 4 (L+1) x 8 (L+1).
    Source: Sloan 2008.
    """
    c, degree = _checks.coefficients("coefficients", coefficients)
    floor = _checks.scalar("floor", floor).astype(c.dtype)
    windowed, strength, hopeless = by_device(_dering_each, {"coefficients": c}, floor, degree)
    status = Status.where(jnp.any(hopeless), Status.mean_below_floor, Status.ok)
    return settled(Deringed(windowed, strength, status), status, throw)


@functools.partial(jax.jit, static_argnums=2)
def _dering_each(batch: dict[str, Array], floor: Scalar, degree: int) -> tuple[Array, ...]:
    c = batch["coefficients"]
    each = jax.vmap(lambda c: _dering(c, floor, degree))(c.reshape(math.prod(c.shape[:-1]), c.shape[-1]))
    windowed, strength, hopeless = (x.reshape(*c.shape[:-1], *x.shape[1:]) for x in each)
    return windowed, strength, hopeless


def _dering(c: Float[Array, " n"], floor: Scalar, degree: int) -> tuple[Array, Array, Array]:
    curvature = jnp.asarray(_curvature(degree)[_layout.bands(degree)], c.dtype)

    def windowed(c, log_strength):
        return c / (1 + jnp.exp(log_strength) * curvature)

    def clearance(log_strength, args):
        """(minimum - floor) / (mean - floor); by the envelope theorem the lowest direction is held fixed."""
        c, floor = args
        smooth = windowed(c, log_strength)
        height = _sh.evaluate(smooth, _lowest_direction(jax.lax.stop_gradient(smooth), degree)) - floor
        return height / scale

    hopeless = ~(_mean(c) > floor)
    fixed = jax.lax.stop_gradient((c, floor))
    scale = jnp.where(hopeless, 1, _mean(fixed[0]) - fixed[1])
    needed = ~(clearance(jnp.asarray(-np.inf, c.dtype), fixed) >= 0)
    # The minimum need not grow with the strength everywhere, so the root is bracketed by the weakest of a ladder of
    # strengths that is enough, from 1e-6 for the highest band to 1e6 for the lowest. The grid sees most of the minimum,
    # so that the bracket reaches one step further.
    ladder = np.linspace(np.log(1e-6 / max(float(_curvature(degree)[-1]), 1.0)), np.log(1e6), _RUNGS)
    rungs = jnp.asarray(ladder, c.dtype)
    enough = jax.lax.map(lambda x: jnp.min(_on_grid(windowed(fixed[0], x), degree)) >= fixed[1], rungs)
    hopeless = needed & (hopeless | ~jnp.any(enough))
    first = rungs[jnp.argmax(enough)]
    rung = float(ladder[1] - ladder[0])
    lower, upper = first - rung, first + rung
    active = needed & ~hopeless
    root = optx.root_find(
        lambda x, args: jnp.where(active, clearance(x, args), x - upper),
        optx.Bisection(rtol=0, atol=1e-11 if c.dtype == np.float64 else 1e-6, flip=False),
        upper,
        args=(c, floor),
        options={"lower": lower, "upper": upper},
        max_steps=45,
        throw=False,
    ).value
    strength = jnp.where(active, jnp.exp(root), 0)
    mean = jnp.where(np.arange(c.size) == 0, c, 0)
    return jnp.where(hopeless, mean, c / (1 + strength * curvature)), jnp.where(hopeless, jnp.inf, strength), hopeless


def _lowest_direction(c: Float[Array, " n"], degree: int) -> Float[Array, "3"]:
    """Where the expansion is lowest: the local minima of a grid, refined by Newton steps in the tangent plane."""
    height = 4 * (degree + 1)
    grid = jnp.asarray(_map_directions(height), c.dtype)
    values = _on_grid(c, degree)
    across = jnp.roll(values, height, axis=1)  # the neighbours of the first and last rows lie across the pole
    above = jnp.concatenate([across[:1], values[:-1]])
    below = jnp.concatenate([values[1:], across[-1:]])
    beside = jnp.minimum(jnp.roll(values, 1, axis=1), jnp.roll(values, -1, axis=1))
    local = values <= jnp.minimum(jnp.minimum(above, below), beside)
    _, places = jax.lax.top_k(jnp.where(local, -values, -jnp.inf).reshape(-1), _CANDIDATES)
    starts, spacing = grid[places], np.pi / height
    lattice = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(9, 2)
    unit = (1e-4 if c.dtype == np.float64 else 1e-2) / (degree + 1)  # far below the finest wave, far above rounding

    def step(u, _):
        frame = jnp.stack(tangents(u))
        f = _sh.evaluate(c, u[None] + jnp.asarray(unit * lattice, c.dtype) @ frame).reshape(3, 3)
        slope_x, slope_y = (f[2, 1] - f[0, 1]) / 2, (f[1, 2] - f[1, 0]) / 2
        xx, yy = f[2, 1] - 2 * f[1, 1] + f[0, 1], f[1, 2] - 2 * f[1, 1] + f[1, 0]
        xy = (f[2, 2] - f[2, 0] - f[0, 2] + f[0, 0]) / 4
        # Made positive definite: a minimum along a curve has one curvature of zero.
        least = (xx + yy) / 2 - jnp.hypot((xx - yy) / 2, xy)
        lift = jnp.maximum(1e-3 * (jnp.abs(xx) + jnp.abs(yy)) - least, 0)
        xx, yy = xx + lift, yy + lift
        determinant = xx * yy - xy * xy
        t = jnp.stack([xy * slope_y - yy * slope_x, xy * slope_x - xx * slope_y])
        t = unit * t / jnp.where(determinant > 0, determinant, 1)
        t = t * spacing / jnp.maximum(jnp.hypot(t[0], t[1]), spacing)
        return normalize(u + t @ frame), None

    refined = jax.vmap(lambda u: jax.lax.scan(step, u, length=_STEPS)[0])(starts)
    candidates = jnp.concatenate([starts, refined])
    return candidates[jnp.argmin(_sh.evaluate(c, candidates))]


def _on_grid(c: Float[Array, " n"], degree: int) -> Float[Array, "h w"]:
    height = 4 * (degree + 1)
    return _transform.synthesize(c, "fejer", height, 2 * height)


@functools.cache
def _map_directions(height: int) -> np.ndarray:
    theta, _ = _quadrature.fejer_rows(height)
    return _quadrature.grid_directions(theta, 2 * height).reshape(-1, 3)


@functools.cache
def _curvature(degree: int) -> np.ndarray:
    l = np.arange(degree + 1.0)
    return (l * (l + 1)) ** 2


def _mean(c: Float[Array, " n"]) -> Scalar:
    return c[0] * float(_tables.zonal_norms(0)[0])
