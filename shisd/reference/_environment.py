"""Radiance under a distant environment: multiple importance sampling, and a sum over texels."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._typing import Array, ArrayLike, Float
from shisd.models import AbstractBrdf, Environment
from shisd.reference._integrand import integrand, local_frames, times
from shisd.reference._monte_carlo import Estimate, ggx_density, map_density, sample_cosine, sample_ggx, strata, tiled

Visible = Callable[[np.ndarray, np.ndarray], np.ndarray]


def shade_environment(
    brdf: AbstractBrdf,
    environment: Environment,
    normals: ArrayLike,
    views: ArrayLike,
    *,
    key: Array,
    samples: int = 1024,
    tangents: ArrayLike | None = None,
    positions: ArrayLike | None = None,
    visible: Visible | None = None,
) -> Estimate:
    """Radiance [N, *colour] leaving N points towards their views under a distant environment, by Monte Carlo.

    Arguments: world `normals` and `views` [N, 3], made unit here, both away from the surface; `tangents` [N, 3] set the
    local x axis of anisotropic BRDFs (made orthogonal to the normal); static `samples` per point, rounded up so that
    they fill whole cells. A view below the horizon gives 0. With occlusion: `positions` [N, 3], where rays start, and
    `visible`, a function on the host of NumPy arrays, starts [M, 3] and directions [M, 3], that says for each ray
    whether it leaves the scene [M] (for trimesh: lambda p, w: ~mesh.ray.intersects_any(p, w)).
    Method: of eight samples, six follow the map's power, one the cosine, and one GGX half vectors as wide as
    `brdf.lobe_width`, each two to a cell of a stratified unit square. All are weighed by the balance heuristic, so the
    result is unbiased for any BRDF.
    Accuracy: `standard_error` is the root of sum (a - b)^2 over the pairs, unbiased in its square. Points have
    independent errors.
    Derivatives: none promised. Cost: N x samples evaluations of BRDF and map; memory for one tile of points.
    """
    samples = _checks.integer("samples", samples, minimum=1)
    frames, local_views = local_frames(normals, views, tangents, brdf)
    if (positions is None) != (visible is None):
        raise ValueError("`positions` and `visible` belong together; pass both for occlusion.")
    starts = jnp.zeros_like(local_views) if positions is None else _checks.vectors("positions", positions)
    if starts.shape != local_views.shape:
        raise ValueError(f"`positions` must have the shape of `normals`, [N, 3]; got {list(starts.shape)}.")
    return _monte_carlo(brdf, environment, frames, local_views, starts, visible, key, -(-samples // 16))


def shade_environment_quadrature(
    brdf: AbstractBrdf,
    environment: Environment,
    normals: ArrayLike,
    views: ArrayLike,
    *,
    supersampling: int = 2,
    tangents: ArrayLike | None = None,
) -> Array:
    """The same radiance [N, *colour] as a sum over every texel of the map, each cut in supersampling^2 parts.

    Parts have their exact solid angle and are evaluated at their middle in angle, so the error falls with the square of
    `supersampling` once parts are finer than the lobe. No noise and no error bar: compare two settings.
    Cost: H x W x supersampling^2 evaluations per point, one row of the map in memory at a time: for a few points.
    """
    supersampling = _checks.integer("supersampling", supersampling, minimum=1)
    frames, local_views = local_frames(normals, views, tangents, brdf)
    return _quadrature(brdf, environment, frames, local_views, supersampling)


@eqx.filter_jit
def _monte_carlo(
    brdf: AbstractBrdf,
    environment: Environment,
    frames: Array,
    views: Array,
    starts: Array,
    visible: Visible | None,
    key: Array,
    count: int,
) -> Estimate:
    """At least `count` pairs of samples that follow the cosine, `count` of half vectors, six times that of the map."""
    light = map_density(environment)
    alpha = jnp.clip(jnp.asarray(brdf.lobe_width, views.dtype), 0.01, 1.0)
    grids = [strata(n) for n in (6 * count, count, count)]
    corners, widths = (jnp.asarray(np.concatenate(part)[None], views.dtype) for part in zip(*grids, strict=True))
    cells = [len(corner) for corner, _ in grids]
    splits = np.cumsum(cells)[:-1]
    sizes = [2.0 * n for n in cells]

    def one(point: tuple[Array, ...]) -> tuple[Array, Array]:  # barriers keep work from being repeated
        frame, wo, start, key = point
        jitter = jax.random.uniform(key, (2, sum(cells), 2), views.dtype)  # two independent points in every cell
        u = jax.lax.optimization_barrier(corners + widths * jitter)
        u_light, u_cosine, u_ggx = jnp.split(u, splits, axis=1)
        wi = [light.sample(u_light) @ frame.T, sample_cosine(u_cosine), sample_ggx(u_ggx, wo, alpha)]
        wi = jax.lax.optimization_barrier(jnp.concatenate(wi, axis=1))
        # balance heuristic: each sample is divided by the sum of (number of samples) x (density) over the strategies
        density = sizes[0] * light(wi @ frame) + sizes[1] / np.pi * jnp.maximum(wi[..., 2], 0)
        density += sizes[2] * ggx_density(wi, wo, alpha)
        inverse = jnp.where(density > 0, 1 / jnp.where(density > 0, density, jnp.ones_like(density)), 0)
        if visible is not None:
            inverse = jnp.where(_leaves(visible, start, wi @ frame), inverse, 0)
        terms = times(inverse, integrand(brdf, environment.radiance, frame, wo, wi), 2)
        value = jnp.sum(terms, axis=(0, 1))
        return value, jnp.sqrt(jnp.sum((terms[0] - terms[1]) ** 2, axis=0))

    keys = jax.random.split(key, views.shape[0])
    return Estimate(*tiled(one, (frames, views, starts, keys), max(1, 2**15 // (2 * sum(cells)))))


def _leaves(visible: Visible, start: Float[Array, "3"], directions: Float[Array, "*batch 3"]) -> Array:
    """`visible` of rays from one point, [...]; of many points in one call."""

    def host(starts: ArrayLike, directions: ArrayLike) -> np.ndarray:
        rays = (np.asarray(x, float).reshape(-1, 3) for x in (starts, directions))
        return np.asarray(visible(*rays), bool).reshape(np.shape(directions)[:-1])

    shape = jax.ShapeDtypeStruct(directions.shape[:-1], bool)
    starts = jnp.broadcast_to(start, directions.shape)
    return jax.pure_callback(host, shape, starts, directions, vmap_method="broadcast_all")


@eqx.filter_jit
def _quadrature(brdf: AbstractBrdf, environment: Environment, frames: Array, views: Array, supersampling: int) -> Array:
    height, width = (supersampling * n for n in environment.texels.shape[:2])
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = 2 * np.pi * (np.arange(width) + 0.5) / width
    solid_angles = jnp.asarray(2 * np.pi / width * 2 * np.sin(theta) * np.sin(np.pi / height / 2), views.dtype)
    cosines, sines = jnp.asarray(np.cos(theta), views.dtype), jnp.asarray(np.sin(theta), views.dtype)
    texels = np.arange(height, dtype=np.int32) // supersampling
    circle = jnp.asarray(np.stack([np.cos(phi), np.sin(phi)], axis=-1), views.dtype)

    def one(point: tuple[Array, Array]) -> Array:
        frame, wo = point

        def row(part: tuple[Array, ...]) -> Array:
            cosine, sine, solid_angle, texel = part
            world = jnp.concatenate([sine * circle, jnp.full_like(circle[:, :1], cosine)], axis=1)
            light = jnp.repeat(environment.texels[texel], supersampling, axis=0)
            return solid_angle * jnp.sum(integrand(brdf, lambda _: light, frame, wo, world @ frame.T), axis=0)

        return jnp.sum(jax.lax.map(row, (cosines, sines, solid_angles, texels)), axis=0)

    return jax.lax.map(one, (frames, views))
