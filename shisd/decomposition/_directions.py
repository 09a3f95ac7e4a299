"""Sets of lobe axes: Fibonacci, low-discrepancy, random, the shipped optimised table, and the optimiser that made it.

ISD15 section 5.1 spreads 2l+1 directions per band, or shares one list among bands ("lobe sharing"). Two differences
here. First, these are *axes*: a zonal harmonic about -z is the one about z times (-1)^l, so z and -z serve every band
alike, and sets are spread over the upper hemisphere, one direction per antipodal pair. 2L+1 Fibonacci *points* of the
sphere are worse than that: they map to themselves under a half-turn about a horizontal line, which makes L+1 symmetric
sums of lobes, but for odd L band L has only L symmetric functions, so the band is singular. Second, directions can be
optimised for the conditioning that ISD15 section 5 asks for.
"""

import functools
import importlib.resources
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from shisd import _checks
from shisd._numerics import normalize
from shisd._progress import Progress, reporting
from shisd._status import Status, settled
from shisd._typing import Array, ArrayLike, DTypeLike, Float, Scalar
from shisd.harmonics import legendre

TABLE_DEGREE = 64


def fibonacci_directions(count: int, *, dtype: DTypeLike = float) -> Float[Array, "{count} 3"]:
    """A Fibonacci spiral of `count` axes: golden-angle steps in azimuth, equal steps in z from 1 to 0.

    Arguments: static `count` >= 1. Returns unit vectors [count, 3] with z > 0, in `dtype` (default: JAX's float).
    Worst-band condition number of 2L+1 of them for degree L: 2 to 240 up to degree 20, at worst 2400 up to degree 32.
    """
    i = np.arange(_checks.integer("count", count, 1))
    return jnp.asarray(_on_sphere((i + 0.5) / i.size, i * (np.sqrt(5) - 1) / 2), dtype=dtype)


def low_discrepancy_directions(count: int, *, dtype: DTypeLike = float) -> Float[Array, "{count} 3"]:
    """The first `count` Halton points (bases 2 and 3) as axes: a longer set begins with the shorter ones.

    Arguments: static `count` >= 1. Returns unit vectors [count, 3] with z > 0, in `dtype` (default: JAX's float).
    Worst-band condition number of 2L+1 of them for degree L: 2 to 540 up to degree 20, at worst 7000 up to degree 32.
    """
    i = np.arange(1, _checks.integer("count", count, 1) + 1)
    return jnp.asarray(_on_sphere(_radical_inverse(i, 2), _radical_inverse(i, 3)), dtype=dtype)


def separate_directions(degree: int, *, dtype: DTypeLike = float) -> Float[Array, "{degree}+1 2*{degree}+1 3"]:
    """Axes of their own for each level l = 0 ... L of an `IsotropicBasis`: no two levels look alike.

    Arguments: static `degree`. Returns unit vectors [L+1, 2L+1, 3] over the whole sphere, in `dtype` (default: JAX's
    float): one sequence of Halton points, cut into runs of 2L+1, so that the first 2l+1 of a level are spread as well.
    Condition number of M at degree 20, Gaussians: 69; 2e4 if only 2l+1 axes serve level l; 1e10 if levels share them.
    """
    levels, count = _checks.degree(degree) + 1, 2 * degree + 1
    i = np.arange(1, levels * count + 1)
    z = _on_sphere(2 * _radical_inverse(i, 2) - 1, _radical_inverse(i, 3))
    return jnp.asarray(z.reshape(levels, count, 3), dtype=dtype)


def random_directions(count: int, key: Array, *, dtype: DTypeLike = float) -> Float[Array, "{count} 3"]:
    """`count` independent axes, uniform on the upper hemisphere.

    Arguments: static `count` >= 1; a JAX random `key`. Returns unit vectors [count, 3] with z >= 0, in `dtype`
    (default: JAX's float). Pairs may be close: condition numbers of 100 to 10000 are common, so draw more than 2L+1 or
    improve them with `optimize_directions`.
    """
    z = normalize(jax.random.normal(key, (_checks.integer("count", count, 1), 3), dtype=dtype))
    return jnp.where(z[:, 2:] < 0, -z, z)


def optimized_directions(degree: int, *, dtype: DTypeLike = float) -> Float[Array, "2*{degree}+1 3"]:
    """The best known 2L+1 shared axes for degree L = 0 ... 64, from the shipped table.

    Arguments: static `degree`. Returns unit vectors [2L+1, 3] with z >= 0, in `dtype` (default: JAX's float). The first
    2l+1 of them also serve band l alone (`RotatedZonalBasis(..., nested=True)`), less well.
    Accuracy: worst-band condition numbers 2.3, 2.9, 4.4, 6.4, 8.8, 15.0 at degree 4, 8, 12, 20, 32, 64; with `nested`
    5.7, 5.9, 29, 150, 130, 376.
    Limits: no 2L+1 axes do better than 1.60, 1.77, 1.86, 1.95, 2.02 at degree 4, 8, 12, 20, 32, by linear programming
    (tests/bench/conditioning.py): how much of the gap can be closed is not known.
    Source: `optimize_directions`; tests/bench/make_directions.py makes the table.
    """
    degree = _checks.degree(degree)
    if degree > TABLE_DEGREE:
        raise ValueError(
            f"`degree` must be <= {TABLE_DEGREE}, where the table ends; got {degree}. Use "
            f"decomposition.fibonacci_directions({2 * degree + 1}), and improve them with "
            "decomposition.optimize_directions if their condition numbers matter."
        )
    return jnp.asarray(_table()[degree**2 : (degree + 1) ** 2], dtype=dtype)


def conditioning_loss(
    directions: ArrayLike,
    degree: int,
    *,
    power: ArrayLike = 8.0,
    nested: bool = False,
    bands: Sequence[int] | None = None,
) -> Scalar:
    """A smooth bound on the worst band's log condition number: what `optimize_directions` makes small.

    With mu the 2l+1 eigenvalues of M_l M_l^T (ISD15 Eq. 10), which are the nonzero ones of the Gram matrix
    P_l(z_i . z_j), in units of their mean:

        loss = 1/(2p) log sum_l (sum_i mu_i^p) (sum_i mu_i^-p)

    It exceeds max_l log cond(M_l) by at most log((2L+1) sqrt(L+1)) / p, and tends to it as `power` p grows. At p = 1 it
    is the mean eigenvalue times the mean inverse, the frame potential of least squares.

    Arguments: `directions` [K, 3], nonzero, taken as unit vectors along them; static `degree` L, with K >= 2L+1;
    `power` > 0 and finite, else the loss is NaN; static `nested`: band l has only the first 2l+1 axes; static `bands`:
    those that count, by default 0 ... L (for axes that serve band l alone, bands=(l,)).
    Derivatives: in directions, first order, both modes, also where eigenvalues meet, because the sums are symmetric in
    them. Infinite or NaN for singular sets.
    """
    z, degree = _checks.vectors("directions", directions), _checks.degree(degree)
    check_count(z, degree)
    power = jnp.asarray(power, dtype=z.dtype)
    power = jnp.where((power > 0) & (power < jnp.inf), power, jnp.nan)
    return _loss(normalize(z), power, degree, bool(nested), _bands(bands, degree))


def optimize_directions(
    directions: ArrayLike,
    degree: int,
    *,
    nested: bool = False,
    bands: Sequence[int] | None = None,
    mirror: Literal["x", "y", "z"] | None = None,
    powers: Sequence[float] = (1.0, 3.0, 8.0),
    max_steps: int = 256,
    throw: bool = True,
    progress: Progress = None,
) -> Float[Array, "K 3"]:
    """`directions` moved to lower the worst condition number of bands 0 ... `degree`.

    BFGS on a smooth bound on the logarithm of that number, of a power raised through `powers`: low ones spread all
    axes, high ones work on the worst band. Finds a local minimum that depends on the start; deterministic.

    Arguments: `directions` [K, 3], the start, nonzero, or several starts [S, K, 3], of which the best result is
    returned; static `degree` L, with K >= 2L+1; static `nested`: band l has only the first 2l+1 axes; static
    `bands`: those that count, by default 0 ... L (for axes that serve band l alone, bands=(l,)); at most `max_steps`
    steps per power. Static `mirror`: keep the set closed under reflection at the plane "x" = 0, "y" = 0 or
    "z" = 0: its first axis lies in the plane, and 2i is the image of 2i - 1 (K must be odd); the start gives the axes
    1, 3, 5, ... A set closed under reflection at "y" has weights that come in pairs for isotropic materials seen along
    x. Axes are antipodal in themselves: z and -z are one. `progress`: None, True for a bar of tqdm, or a function of
    powers that are done and in all, over all starts.
    Returns unit vectors [K, 3] in the same order, hemispheres not restored. Work in float64 for the last digits.
    Where every start is singular, it is an error (`shisd.Status.ill_conditioned`); with `throw=False` the first comes
    back as it is, and the basis refuses it.
    Derivatives: none are meant; differentiate `RotatedZonalBasis.condition_numbers`.
    Cost: at each step the eigenvalues of a K x K matrix for every band; `make bench` reports the time.
    """
    starts = _checks.vectors("directions", directions)
    several, degree = starts.ndim == 3 and len(starts) > 0, _checks.degree(degree)
    check_count(starts[0] if several else starts, degree)
    if mirror not in (None, "x", "y", "z"):
        raise ValueError(f"`mirror` must be None, 'x', 'y' or 'z'; got {mirror!r}.")
    if mirror is not None and starts.shape[-2] % 2 == 0:
        raise ValueError(f"`mirror` needs an odd number of axes: one in the plane, and pairs; got {starts.shape[-2]}.")
    steps, plane = _checks.integer("max_steps", max_steps, 1), None if mirror is None else "xyz".index(mirror)
    levels = [_checks.number("powers", power, positive=True) for power in powers]
    if not levels:
        raise ValueError("`powers` must hold at least one power.")
    starts = normalize(starts if several else starts[None])
    found, losses = [], []
    with reporting(progress, len(starts) * len(levels), "directions") as step:
        for start in starts:
            z = start if plane is None else jnp.concatenate([start[:1], start[1::2]])
            for power in levels:
                z, loss = _minimise(z, jnp.asarray(power, z.dtype), degree, steps, bool(nested), _bands(bands, degree),
                                    plane)  # fmt: skip
                jax.block_until_ready(z)
                step()
            found.append(z)
            losses.append(loss)
    least = jnp.stack(losses)
    best = jnp.stack(found)[jnp.nanargmin(least)]
    status = Status.where(jnp.any(jnp.isfinite(least)), Status.ok, Status.ill_conditioned)
    return settled(normalize(best if plane is None else _mirrored(best, plane)), status, throw)


@eqx.filter_jit
def _minimise(
    free: Float[Array, "k 3"],
    power: Scalar,
    degree: int,
    max_steps: int,
    nested: bool,
    bands: tuple[int, ...],
    plane: int | None,
) -> tuple[Float[Array, "k 3"], Scalar]:
    """Axes of a lower loss, and that loss; those that came where it is not lower or not a number."""
    whole = (lambda z: z) if plane is None else lambda z: _mirrored(z, plane)
    loss = lambda z, power: _loss(normalize(whole(z)), power, degree, nested, bands)
    tolerance = float(jnp.finfo(free.dtype).eps) ** 0.5
    solver = optx.BFGS(rtol=tolerance, atol=tolerance)
    found = normalize(optx.minimise(loss, solver, free, power, max_steps=max_steps, throw=False).value)
    before, after = loss(free, power), loss(found, power)
    return jnp.where(after < before, found, free), jnp.where(after < before, after, before)


def _mirrored(free: Float[Array, "h 3"], plane: int) -> Float[Array, "k 3"]:
    """One axis in the plane, then pairs."""
    flip = jnp.asarray(np.where(np.arange(3) == plane, -1, 1), free.dtype)[None]
    first = free[:1] * jnp.asarray(np.arange(3) != plane, free.dtype)[None]
    pairs = jnp.stack([free[1:], free[1:] * flip], axis=1).reshape(-1, 3)
    return jnp.concatenate([first, pairs])


@eqx.filter_jit
def _loss(z: Float[Array, "K 3"], power: Scalar, degree: int, nested: bool, bands: tuple[int, ...]) -> Scalar:
    size, counts = z.shape[0], 2 * np.asarray(bands)[:, None] + 1
    # Legendre polynomials at cosines that rounding left above 1 are harmless: the recurrence is a polynomial.
    gram = jnp.moveaxis(legendre(jnp.einsum("ic,jc->ij", z, z), degree), -1, 0)[np.asarray(bands, np.int32)]
    axes = np.broadcast_to(counts if nested else size, counts.shape)  # that a band uses
    if nested:
        used = np.arange(size) < axes
        gram = jnp.where(used[:, :, None] & used[:, None, :], gram, 0)
    mu = jnp.linalg.eigvalsh(gram) / jnp.asarray(axes / counts, dtype=z.dtype)
    kept = np.arange(size) >= size - counts  # they ascend, so the last 2l+1 belong to band l
    log_mu = jnp.where(kept, jnp.log(jnp.where(kept, mu, 1)), -jnp.inf)
    inverse = jnp.where(kept, -log_mu, -jnp.inf)
    products = jax.nn.logsumexp(power * log_mu, axis=1) + jax.nn.logsumexp(power * inverse, axis=1)
    return jax.nn.logsumexp(products) / (2 * power)


def _bands(bands: Sequence[int] | None, degree: int) -> tuple[int, ...]:
    if bands is None:
        return tuple(range(degree + 1))
    chosen = tuple(_checks.integer("bands", l) for l in bands)
    if not chosen or max(chosen) > degree:
        raise ValueError(f"`bands` must hold at least one degree, none above {degree}; got {list(chosen)}.")
    return chosen


def check_count(directions: Array, degree: int) -> None:
    """ValueError unless `directions` is one list of enough axes for `degree`."""
    if directions.ndim != 2:
        raise ValueError(f"`directions` must have shape [K, 3]; got {list(directions.shape)}. Batch with jax.vmap.")
    if directions.shape[0] < 2 * degree + 1:
        raise ValueError(
            f"`directions` must hold at least 2*degree + 1 = {2 * degree + 1} axes for degree {degree}; got "
            f"{directions.shape[0]}. Add directions, lower the degree, or use decomposition.optimized_directions."
        )


def _on_sphere(z: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Heights and turns on the sphere, areas kept: azimuth = 2 pi v."""
    sine, azimuth = np.sqrt(1 - z * z), 2 * np.pi * v
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), z], axis=-1)


def _radical_inverse(i: np.ndarray, base: int) -> np.ndarray:
    """The digits of the integers `i` in `base`, mirrored behind the point."""
    total, scale = np.zeros(i.shape), 1.0
    while i.any():
        i, digit = np.divmod(i, base)
        scale /= base
        total += scale * digit
    return total


@functools.cache
def _table() -> np.ndarray:
    """All degrees one after another: rows L^2 ... (L+1)^2 - 1 are the 2L+1 axes of degree L."""
    with importlib.resources.files("shisd.decomposition").joinpath("data/optimized_directions.npz").open("rb") as file:
        with np.load(file) as data:
            return data["directions"]
