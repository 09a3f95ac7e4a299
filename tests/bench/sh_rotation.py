"""Shading by rotation of spherical harmonics for every pixel: what ISD15 compares with (its section 7.1).

The light is turned to the local frame, or the material's slice to the world, and a dot product follows. A rotation is
Z J Z J Z (Pinchon and Hoggan 2007), as in e3nn, applied factor by factor: turns mix m with -m, J is a constant matrix
of each band. Making every pixel's matrices first, as e3nn's `wigner_D`, took ten times as long at degree 4 and 8, two
busy cores. Coefficients stand before pixels, pixels in tiles. Slices are interpolated linearly in elevation.
"""

import jax.numpy as jnp
import numpy as np

from shisd._numerics import dot
from shisd.harmonics import _tables
from tests.bench.monte_carlo import in_tiles

NUMBERS = 1 << 19  # coefficients turned at a time


def radiance(parameters, normals, views, *, turned: str):
    """Radiance [P, 3]; parameters: `slices` [V, 3, n] at elevations (j + 1/2) (pi/2)/V, `light` [3, n]."""
    slices, light = parameters["slices"], parameters["light"]
    degree = int(np.sqrt(light.shape[-1])) - 1

    def tile(n, v):
        n, v = n.T, v.T
        z = dot(n, v)
        x = v - z * n
        sine = jnp.sqrt(dot(x, x))
        x = x / sine
        y = jnp.cross(n, x, axis=0)
        local = interpolated(slices, jnp.arctan2(sine, z)).T.reshape(-1, 3, n.shape[1])  # [n, 3, P]
        if turned == "light":
            c = jnp.broadcast_to(light.T[:, :, None], local.shape)
            c = rotated(c, jnp.stack([x, y, n]), degree)
            return jnp.einsum("ncp,ncp->pc", c, local)
        c = rotated(local, jnp.stack([x, y, n], axis=1), degree)
        return jnp.einsum("ncp,cn->pc", c, light)

    return in_tiles(tile, max(64, NUMBERS // light.size), normals, views)


def interpolated(slices, theta):
    """Slices [P, 3 n] at elevations [P], the coefficients before colours."""
    count = len(slices)
    table = jnp.swapaxes(slices, 1, 2).reshape(count, -1)
    position = jnp.clip(theta * (count / (np.pi / 2)) - 0.5, 0, count - 1)
    lower = jnp.clip(position.astype(jnp.int32), 0, count - 2)
    t = (position - lower.astype(theta.dtype))[:, None]
    return (1 - t) * table[lower] + t * table[lower + 1]


def rotated(c, r, degree):
    """Coefficients [n, 3, P] of (R f)(w) = f(R^T w), R [3, 3, P] = Rz(a) Ry(b) Rz(g)."""
    safe = jnp.maximum(jnp.sqrt(r[0, 2] ** 2 + r[1, 2] ** 2), 1e-7)
    cos_a, sin_a, cos_b = r[0, 2] / safe, r[1, 2] / safe, r[2, 2]
    x, y = cos_a * r[0, 0] + sin_a * r[1, 0], cos_a * r[1, 0] - sin_a * r[0, 0]
    c = swap(turn(c, cos_b * x - safe * r[2, 0], y, degree), degree)
    c = swap(turn(c, cos_b, -safe, degree), degree)
    return turn(c, cos_a, sin_a, degree)


def turn(c, cos, sin, degree):
    """The turn about z by the angle of these cosines and sines [P]."""
    m, l = _tables.orders(degree), _tables.bands(degree)
    cosines, sines = [jnp.ones_like(cos), cos], [jnp.zeros_like(sin), sin]
    for _ in range(2, degree + 1):
        cosines.append(cosines[-1] * cos - sines[-1] * sin)
        sines.append(sines[-1] * cos + cosines[-2] * sin)
    sign = jnp.asarray(-np.sign(m)[:, None, None], c.dtype)
    cosines, sines = (jnp.stack(a)[np.abs(m)][:, None] for a in (cosines, sines))
    return cosines * c + sign * sines * c[l * l + l - m]


def swap(c, degree):
    """y and z exchanged: J_l on every band."""
    matrices = _tables.swap_matrices(degree)
    return jnp.concatenate([
        jnp.tensordot(jnp.asarray(j, c.dtype), c[l * l : (l + 1) ** 2], 1) for l, j in enumerate(matrices)
    ])  # fmt: skip
