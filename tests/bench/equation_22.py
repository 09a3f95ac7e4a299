"""Ways to evaluate ISD15 Eq. 22 for an isotropic material, with the error of each against exact slices in float64.

literal: the equation as it stands, vmapped: SH at all rotated axes of all pixels, products per band.
tiled: the same in tiles of 64 pixels, so that the stacked basis stays in the cache.
tables: the light convolved with each band's zonal harmonic, tabulated over directions, looked up bilinearly.
rotated: light turned to the local frame by constant matrices, `shading.shade` with a `DistantLight`.
The first three interpolate weights linearly in elevation, as ISD15's shader does.
"""

import jax
import jax.numpy as jnp
import numpy as np

from shisd import harmonics, models, shading
from shisd.harmonics.internal import bands
from shisd.shading.slices._tabulate import project_slices


def local_frames(normals, views):
    """Frames whose x axis lies below the view, and the elevation of the view."""
    z = jnp.sum(normals * views, axis=-1, keepdims=True)
    x = views - z * normals
    x = x / jnp.linalg.norm(x, axis=-1, keepdims=True)
    return jnp.stack([x, jnp.cross(normals, x), normals], axis=-1), jnp.arctan2(jnp.sqrt(1 - z[..., 0] ** 2), z[..., 0])


def interpolated_weights(weights, theta):
    """Weights [V, L+1, K] at one elevation, linearly."""
    count = weights.shape[0]
    position = jnp.clip(theta * count / (np.pi / 2) - 0.5, 0, count - 1)
    lower = jnp.clip(position.astype(int), 0, count - 2)
    t = position - lower
    return (1 - t) * weights[lower] + t * weights[lower + 1]


def literal(basis, table, light):
    degree = basis.degree
    convolved = light * jnp.asarray(np.sqrt(4 * np.pi / (2 * bands(degree) + 1)), light.dtype)

    def pixel(normal, view):
        frame, theta = local_frames(normal, view)
        y = harmonics.sh_basis(basis.directions @ frame.T, degree)  # [K, n]
        weights = interpolated_weights(table, theta)
        total = 0.0
        for l in range(degree + 1):
            band = slice(l * l, (l + 1) ** 2)
            total += (convolved[:, band] @ y[:, band].T) @ weights[l]
        return total

    return pixel


def tables(basis, table, light, height):
    degree = basis.degree
    scale = np.sqrt(4 * np.pi / (2 * np.arange(degree + 1) + 1))
    split = light[:, None, :] * jnp.asarray(
        (bands(degree) == np.arange(degree + 1)[:, None]) * scale[:, None], light.dtype
    )
    maps = harmonics.synthesize_map(split.reshape(-1, split.shape[-1]), height, 2 * height)  # [H, 2H, 3 * (L+1)]
    maps = jnp.concatenate([jnp.roll(maps[:1], height, 1), maps, jnp.roll(maps[-1:], height, 1)])  # across the poles
    maps = jnp.concatenate([maps, maps[:, :1]], axis=1)

    def pixel(normal, view):
        frame, theta = local_frames(normal, view)
        d = basis.directions @ frame.T
        polar = jnp.arctan2(jnp.hypot(d[:, 0], d[:, 1]), d[:, 2]) * height / np.pi + 0.5
        azimuth = (jnp.arctan2(d[:, 1], d[:, 0]) * height / np.pi - 0.5) % (2 * height)
        j, i = jnp.clip(polar.astype(int), 0, height), jnp.clip(azimuth.astype(int), 0, 2 * height - 1)
        u, v = (polar - j)[:, None], (azimuth - i)[:, None]
        value = (1 - u) * ((1 - v) * maps[j, i] + v * maps[j, i + 1]) + u * (
            (1 - v) * maps[j + 1, i] + v * maps[j + 1, i + 1]
        )
        weights = interpolated_weights(table, theta)
        return jnp.einsum("kcl,lk->c", value.reshape(-1, 3, degree + 1), weights)

    return pixel


def methods(material, basis, light):
    """name -> jitted function of (normals, views) [N, 3] -> [N, 3]."""
    table = material.weights(basis)
    exact, lookup = literal(basis, table, light), tables(basis, table, light, 8 * (basis.degree + 1))
    tiled = lambda pixel: jax.jit(lambda n, v: jax.lax.map(lambda nv: pixel(*nv), (n, v), batch_size=64))
    return {
        "literal": jax.jit(jax.vmap(exact)),
        "tiled": tiled(exact),
        "tables": tiled(lookup),
        "rotated": jax.jit(lambda n, v: shading.shade(material, models.DistantLight(light), shading.Surface(n, v))),
    }


def exact_slices(brdf, light, normals, views):
    """Every pixel's own slice projected by quadrature and turned to the world, in float64: no table."""
    degree = int(np.sqrt(light.shape[-1])) - 1
    with jax.enable_x64(True):

        def pixel(normal, view):
            frame, theta = local_frames(normal, view)
            local = jnp.stack([jnp.sin(theta), jnp.zeros_like(theta), jnp.cos(theta)])
            c = project_slices(brdf, local[None], degree, 32 + degree)[0][0]
            return jnp.asarray(light, float) @ harmonics.rotate(c, frame)

        return np.asarray(jax.lax.map(lambda nv: pixel(*nv), (jnp.asarray(normals, float), jnp.asarray(views, float))))
