"""The split sum of real-time engines (Karis 2013, OCCT section 6): one look-up in a filtered map, one in a BRDF table.

The map is filtered with GGX's lobe for n = v = r at the material's own alpha, weighted by the cosine, exactly (by
spherical harmonics), so no error comes from interpolation between levels of roughness; a diffuse material looks up
irradiance along the normal. Look-ups are bilinear.
"""

import functools

import jax.numpy as jnp
import numpy as np

from shisd import harmonics
from shisd._numerics import dot
from tests.bench.lobes import padded
from tests.bench.monte_carlo import arccos, arctan2, in_tiles, net, take

VIEWS = 256  # cosines of the BRDF table


def radiance(parameters, normals, views, *, glossy: bool):
    """Radiance [P, 3]; parameters: `texels` [(H+2) (2H+1), 4] of `filtered`, `scale` [VIEWS, 3]."""

    def tile(n, v):
        n, v = n.T, v.T
        nv = dot(n, v)
        value = lookup(parameters["texels"], *(2 * nv * n - v if glossy else n))
        if not glossy:
            return value * parameters["scale"][:1]
        place = jnp.clip(nv * VIEWS - 0.5, 0, VIEWS - 1)
        lower = jnp.minimum(place.astype(jnp.int32), VIEWS - 2)
        t = (place - lower.astype(n.dtype))[:, None]
        table = parameters["scale"]
        return value * ((1 - t) * take(table, lower) + t * take(table, lower + 1))

    return in_tiles(tile, 1 << 14, normals, views)


def lookup(texels, x, y, z):
    """Bilinear values [P, 3] of a padded map."""
    height = int(round((np.sqrt(25 + 8 * (len(texels) - 2)) - 5) / 4))  # of (H + 2) (2 H + 1) texels
    v = arccos(z) * (height / np.pi) + 0.5
    phi = arctan2(y, x)
    u = (jnp.where(phi < 0, phi + 2 * np.pi, phi) * (height / np.pi) - 0.5) % (2 * height)
    j, i = jnp.clip(v.astype(jnp.int32), 0, height), jnp.clip(u.astype(jnp.int32), 0, 2 * height - 1)
    v, u = (v - j.astype(v.dtype))[:, None], (u - i.astype(u.dtype))[:, None]
    first = j * (2 * height + 1) + i
    upper = (1 - u) * take(texels, first) + u * take(texels, first + 1)
    first = first + 2 * height + 1
    lower = (1 - u) * take(texels, first) + u * take(texels, first + 1)
    return ((1 - v) * upper + v * lower)[:, :3]


def filtered(coefficients, kernel, height: int):
    """The map convolved with a function of the angle, normalised: texels [(H+2) (2H+1), 4], rows of 16 bytes."""
    degree = min(height - 1, int(np.sqrt(coefficients.shape[-1])) - 1)
    x, weight = (0.5 * g + shift for g, shift in zip(gauss(256), (0.5, 0), strict=True))  # kernels vanish below 0
    p = np.polynomial.legendre.legvander(x, degree) * (weight * kernel(x))[:, None]
    bands = (p.sum(axis=0) / p[:, 0].sum())[np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)]
    c = coefficients[:, : (degree + 1) ** 2] * jnp.asarray(bands, coefficients.dtype)[None]
    texels = padded(harmonics.synthesize_map(c, height), height)
    return jnp.pad(texels, ((0, 0), (0, 1)))


gauss = functools.cache(np.polynomial.legendre.leggauss)


def ggx_kernel(alpha: float):
    """D(h) (n.l) of GGX where n = v: the half vector is half the angle of l away."""
    return lambda x: np.maximum(x, 0) / (((1 + x) / 2) * (alpha**2 - 1) + 1) ** 2


def cosine_kernel(x):
    return np.maximum(x, 0)


def ggx_scale(alpha: float, f0: np.ndarray, count: int = 4096) -> np.ndarray:
    """Albedo of GGX [VIEWS, 3] for every cosine of the view, by visible normals: f0 scale + bias."""
    u, turn = net(count).T
    table = []
    for cos in (np.arange(VIEWS) + 0.5) / VIEWS:
        v = np.array([np.sqrt(1 - cos * cos), 0, cos])
        s = np.array([alpha * v[0], 0, cos]) / np.hypot(alpha * v[0], cos)
        z = (1 - u) * (1 + s[2]) - s[2]
        r = np.sqrt(np.maximum(1 - z * z, 0))
        x, y = r * np.cos(2 * np.pi * turn), r * np.sin(2 * np.pi * turn)
        h = np.stack([alpha * (x + s[0]), alpha * y, np.maximum(z + s[2], 0)])
        h /= np.linalg.norm(h, axis=0)
        vh = v @ h
        lz = np.maximum(2 * vh * h[2] - cos, 0)
        masking = 2 * lz / (lz + np.sqrt(lz * lz * (1 - alpha**2) + alpha**2))
        t5 = (1 - vh) ** 5
        table.append(np.mean(masking * (1 - t5)) * f0 + np.mean(masking * t5))
    return np.array(table)
