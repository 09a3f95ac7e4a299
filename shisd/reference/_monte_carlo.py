"""Monte Carlo: estimates from two samples in every cell of a unit square, and directions that follow a density."""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from shisd._module import Module
from shisd._typing import Array
from shisd.models import Environment


class Estimate(Module):
    """A value and one standard deviation of its own error, in the units of the value."""

    value: Array
    standard_error: Array


@functools.cache
def strata(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners and sizes [cells, 2] of a grid of at least `count` nearly square cells over the unit square."""
    rows = math.isqrt(count)
    columns = -(-count // rows)
    corners = np.stack(np.divmod(np.arange(rows * columns), columns), axis=-1) / [rows, columns]
    return corners, np.broadcast_to([1 / rows, 1 / columns], corners.shape)


def tiled(function: Callable, arguments: tuple[Array, ...], size: int) -> tuple[Array, ...]:
    """vmap in tiles of `size`, the last one filled up: one body to compile, and memory for one tile."""
    count = arguments[0].shape[0]
    size = max(1, min(size, count))
    index = jnp.arange(-(-count // size) * size).reshape(-1, size) % max(1, count)
    results = jax.lax.map(lambda i: jax.vmap(function)(tuple(a[i] for a in arguments)), index)
    return tuple(r.reshape(-1, *r.shape[2:])[:count] for r in results)


class MapDensity(Module):
    """A density on the sphere that follows a map, up to sin(theta) inside a texel.

    A texel is chosen by its power, then a point of it, uniformly in theta and phi.
    """

    row_cdf: Array  # [1, H + 1]
    column_cdf: Array  # [H, W + 1]
    density: Environment  # [H, W], per rad^2 of theta and phi

    def sample(self, u: Array) -> Array:
        """Directions [..., 3] from uniform numbers [..., 2]."""
        row, down = _invert(self.row_cdf, jnp.zeros(u.shape[:-1], int), u[..., 0])
        column, along = _invert(self.column_cdf, row, u[..., 1])
        step = np.pi / len(self.column_cdf)
        theta, phi = step * (row.astype(u.dtype) + down), step * (column.astype(u.dtype) + along)
        return _polar(jnp.cos(theta), jnp.sin(theta), phi)

    def __call__(self, directions: Array) -> Array:
        """Density [...] in 1/sr at unit `directions` [..., 3]."""
        sine = jnp.sqrt(directions[..., 0] ** 2 + directions[..., 1] ** 2)
        return self.density.radiance(directions) / jnp.maximum(sine, 1e-9)


def map_density(environment: Environment) -> MapDensity:
    """The density that follows the mean of the colours, each at least 0; uniform for a black map."""
    texels = jnp.maximum(environment.texels, 0)
    power = texels.reshape(*texels.shape[:2], -1).mean(axis=-1)
    solid_angles = environment.solid_angles()[:, None]
    mass = jnp.where(jnp.sum(power) > 0, power, jnp.ones_like(power)) * solid_angles
    rows = jnp.sum(mass, axis=1)
    row_cdf = cumulative(rows[None])
    column_cdf = cumulative(jnp.where(rows[:, None] > 0, mass, jnp.ones_like(mass)))
    probability = jnp.diff(row_cdf[0])[:, None] * jnp.diff(column_cdf)  # of the rounded tables, which are sampled
    return MapDensity(row_cdf, column_cdf, Environment(probability / (np.pi / len(mass)) ** 2))


def cumulative(mass: Array) -> Array:
    """Cumulative sums [R, n + 1] of each row, from exactly 0 to exactly 1."""
    total = jnp.cumsum(mass, axis=1)
    return jnp.concatenate([jnp.zeros_like(mass[:, :1]), total / total[:, -1:]], axis=1)


def _invert(cdf: Array, row: Array, u: Array) -> tuple[Array, Array]:
    """The bin of cdf[row] that holds u, by bisection, and the position of u in it, from 0 to 1."""

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = (low + high) // 2
        below = cdf[row, middle] <= u
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    bins = cdf.shape[1] - 1
    bounds = jnp.zeros_like(row), jnp.full_like(row, bins)
    low, high = jax.lax.fori_loop(0, math.ceil(math.log2(bins)), halve, bounds)  # a loop, so that it is computed once
    start, stop = cdf[row, low], cdf[row, high]
    return low, (u - start) / (stop - start)


def sample_cosine(u: Array) -> Array:
    """Directions of density cos(theta) / pi."""
    return _polar(jnp.sqrt(1 - u[..., 0]), jnp.sqrt(u[..., 0]), 2 * np.pi * u[..., 1])


def sample_ggx(u: Array, wo: Array, alpha: Array) -> Array:
    """Mirror directions of wo [3] about half vectors of density D(h) cos h (Walter et al. 2007, Eq. 35)."""
    tan2 = alpha**2 * u[..., 0] / (1 - u[..., 0])
    cosine = 1 / jnp.sqrt(1 + tan2)
    half = _polar(cosine, cosine * jnp.sqrt(tan2), 2 * np.pi * u[..., 1])
    return 2 * (half @ wo)[..., None] * half - jnp.broadcast_to(wo, half.shape)


def ggx_density(wi: Array, wo: Array, alpha: Array) -> Array:
    """Density [...] in 1/sr of `sample_ggx` at wi [..., 3]."""
    half = wi + jnp.broadcast_to(wo, wi.shape)
    length = jnp.sqrt(jnp.sum(half * half, axis=-1))
    half = half / jnp.maximum(length, 1e-6)[..., None]
    cos2 = half[..., 2] ** 2
    sin2 = half[..., 0] ** 2 + half[..., 1] ** 2
    d = alpha**2 / (np.pi * (alpha**2 * cos2 + sin2) ** 2)
    return d * jnp.abs(half[..., 2]) / (4 * jnp.maximum(jnp.abs(half @ wo), 1e-6))


def _polar(cosine: Array, sine: Array, phi: Array) -> Array:
    return jnp.stack([sine * jnp.cos(phi), sine * jnp.sin(phi), cosine], axis=-1)
