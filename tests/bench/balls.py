"""Balls of light over a glossy floor: error and cost of `shade` with a `SphereLight`, beside Monte Carlo.

The truth is Gauss quadrature over the cap that the ball covers, of the material itself, 48 nodes by 96, in float64 on a
part of the points. Monte Carlo takes directions uniform over the cap from a lattice that is shifted for every point.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from shisd import models, shading
from shisd.models import SphereLight
from shisd.models.internal import versine
from tests.bench.area_lights import lattice
from tests.bench.timing import interleaved

COUNT, JUDGED = 16384, 256
MATERIALS = {"GGX 0.5": models.Ggx(0.5, 0.3), "GGX 0.25": models.Ggx(0.25, 0.3)}
BALLS = {"lamp": (np.array([0.4, 0.2, 1.0]), 0.3), "bulb": (np.array([0.4, 0.2, 1.0]), 0.05)}
EYE = np.array([0.0, -3.0, 2.0])


def floor(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, normals and views [N, 3] of a square of the floor."""
    side = int(np.sqrt(count))
    x, y = np.meshgrid(*[np.linspace(-1.5, 1.5, side)] * 2)
    positions = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    views = EYE - positions
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    arrays = positions, np.broadcast_to([0.0, 0.0, 1.0], positions.shape), views
    return tuple(np.asarray(a, np.float32) for a in arrays)


def over_caps(brdf, light: SphereLight, uv: jax.Array, weights: jax.Array, positions, views, shift=None) -> jax.Array:
    """Sum over directions (u, v) of the unit square spread uniformly over each cap; normals along +z."""

    def one(position, view, shift):
        to_center = light.center - position
        d2 = to_center @ to_center
        t, z = versine(light, d2), to_center / jnp.sqrt(d2)
        x = jnp.cross(z, jnp.where(jnp.abs(z[0]) < 0.7, jnp.eye(3)[0], jnp.eye(3)[1]).astype(z.dtype))
        x /= jnp.linalg.norm(x)
        u, v = jnp.moveaxis((uv + shift[None]) % 1, 1, 0)
        gap = t * u
        sine, phi = jnp.sqrt(gap * (2 - gap)), 2 * np.pi * v
        ring = jnp.cos(phi)[:, None] * x[None] + jnp.sin(phi)[:, None] * jnp.cross(z, x)[None]
        w = (1 - gap)[:, None] * z[None] + sine[:, None] * ring
        values = jax.vmap(lambda wi: brdf.value_cosine(wi, view))(w)
        return 2 * np.pi * t * light.emission * (weights @ values)

    shift = jnp.zeros((len(positions), 2), positions.dtype) if shift is None else shift
    return jax.lax.map(lambda row: one(*row), (positions, views, shift), batch_size=256)


def tables(quick: bool) -> dict[str, list[dict]]:
    """Title and rows of the table."""
    positions, normals, views = floor(COUNT)
    some = np.linspace(0, COUNT - 1, JUDGED).astype(int)
    shift = np.random.default_rng(0).uniform(size=(COUNT, 2)).astype(np.float32)
    x, w = np.polynomial.legendre.leggauss(48)
    u, v = np.meshgrid((x + 1) / 2, np.arange(96) / 96, indexing="ij")
    fine = np.stack([u.ravel(), v.ravel()], axis=1), np.repeat(w / 2, 96) / 96
    shaded = lambda material, light: shading.shade(material, light, shading.Surface(normals, views, positions))
    rows = []
    for name, brdf in list(MATERIALS.items())[: 1 if quick else None]:
        for ball, (center, radius) in BALLS.items():
            with jax.enable_x64(True):
                exact = SphereLight(center, radius, np.ones(()))
                arrays = (jnp.asarray(a[some], float) for a in (positions, views))
                truth = np.asarray(jax.jit(over_caps)(brdf, exact, *map(jnp.asarray, fine), *arrays))
            light = SphereLight(center.astype(np.float32), radius)
            methods = {}
            for degree in (8, 16):
                material = shading.tabulate_brdf(brdf, degree)
                methods[f"shade, SphereLight, degree {degree}"] = functools.partial(shaded, material, light)
            for count in (16, 64):
                uv, weight = lattice(count).astype(np.float32), np.full(count, 1 / count, np.float32)
                sampled = jax.jit(functools.partial(over_caps, brdf, light, uv, weight))
                methods[f"Monte Carlo, {count} samples"] = functools.partial(sampled, positions, views, shift)
            times = interleaved(methods, seconds=0.2)
            rms = np.sqrt(np.mean(truth**2))
            for method, function in methods.items():
                error = np.asarray(function(), float)[some] - truth
                rows.append({
                    "material": name,
                    "light": ball,
                    "method": method,
                    "error": float(np.sqrt(np.mean(error**2)) / rms),
                    "us/point": times[method].best / COUNT * 1e6,
                })  # fmt: skip
    return {"Balls of light over a floor": rows}
