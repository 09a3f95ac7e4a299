"""Monte Carlo for a distant environment in float32, as fast as XLA makes it on a CPU: what shading is compared with.

Points are a Hammersley net, shifted on the torus for every pixel by a table of random numbers, as real-time renderers
take them from a texture. The map is sampled through a pool of 65,536 directions, one in each cell of a stratified unit
square, drawn before by inversion of its distribution (row, then column): a sample costs one look-up and no search, as
with the pre-sampled lights of Wyman and Panteleev 2021. GGX is sampled by visible normals (Dupuy and Benyoub 2023),
Lambert by the cosine. Both strategies together share the samples by the balance heuristic. Radiance is that of the
nearest texel. Samples stand before pixels: pixels are vector lanes.

Point lights: the same few directions for all pixels, spread by the map's distribution (as Agarwal et al. 2003).

Derivatives hold the sampled directions of the light in the world, those of the material, and all densities fixed
(detached sampling).
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from shisd._numerics import dot

POOL = 256  # cells of the pool along each side of the unit square
NUMBERS = 1 << 18  # samples of a tile


# ---- the light


def light_tables(texels: np.ndarray, seed: int = 0) -> dict[str, jax.Array]:
    """Texels with their density per sr [H W, 4], and the pool: directions [N, 3] and the texels that they hit [N]."""
    height = len(texels)
    theta = np.pi * np.arange(height + 1) / height
    cell = (np.cos(theta[:-1]) - np.cos(theta[1:]))[:, None] * (np.pi / height)
    mass = np.asarray(texels, float).mean(axis=2) * cell
    mass /= mass.sum()
    table = np.concatenate([texels, (mass / cell)[..., None]], axis=2).reshape(-1, 4)
    u = (np.indices((POOL, POOL)).reshape(2, -1) + np.random.default_rng(seed).random((2, POOL**2))) / POOL
    row, down = _invert(mass.sum(axis=1)[None], np.zeros(POOL**2, int), u[0])
    column, along = _invert(mass, row, u[1])
    z = (1 - down) * np.cos(theta[row]) + down * np.cos(theta[row + 1])
    phi = np.pi / height * (column + along)
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1)
    return {
        "texels": jnp.asarray(table, jnp.float32),
        "directions": jnp.asarray(directions, jnp.float32),
        "hits": jnp.asarray(row * 2 * height + column, jnp.int32),
    }


def shifts(count: int, seed: int = 1) -> jax.Array:
    """Shifts of the nets [count, 5]: two for the light; one, and cosine and sine of the second, for the material."""
    u = np.random.default_rng(seed).random((count, 4))
    turn = 2 * np.pi * u[:, 3:]
    return jnp.asarray(np.concatenate([u[:, :3], np.cos(turn), np.sin(turn)], axis=1), jnp.float32)


def _invert(mass, row, u):
    """The bin of a row of `mass` that holds u, and the position in it."""
    total = np.cumsum(mass, axis=1)
    total /= np.where(total[:, -1:] > 0, total[:, -1:], 1)
    place = np.searchsorted((total + np.arange(len(total))[:, None]).ravel(), u + row, side="right")
    bins = np.clip(place - row * mass.shape[1], 0, mass.shape[1] - 1)
    stop = total[row, bins]
    start = np.where(bins > 0, total[row, bins - 1], 0)
    return bins, np.clip((u - start) / np.maximum(stop - start, 1e-300), 0, 1)


def texel_of(x, y, z, height):
    """The flat index of the texel that holds a direction."""
    row = jnp.clip((arccos(z) * (height / np.pi)).astype(jnp.int32), 0, height - 1)
    phi = arctan2(y, x)
    column = (jnp.where(phi < 0, phi + 2 * np.pi, phi) * (height / np.pi)).astype(jnp.int32)
    return row * (2 * height) + jnp.clip(column, 0, 2 * height - 1)


def arccos(x):
    """Abramowitz and Stegun 4.4.46, error 2e-8: polynomials are vectorised, XLA's own arc functions are not."""
    series = (1.5707963050, -0.2145988016, 0.0889789874, -0.0501743046, 0.0308918810, -0.0170881256, 0.0066700901,
              -0.0012624911)  # fmt: skip
    size = jnp.abs(x)
    value = jnp.sqrt(jnp.maximum(1 - size, 0)) * _polynomial(series, size)
    return jnp.where(x < 0, np.pi - value, value)


def arctan2(y, x):
    """Abramowitz and Stegun 4.4.49, error 1e-5."""
    ax, ay = jnp.abs(x), jnp.abs(y)
    t = jnp.minimum(ax, ay) / jnp.maximum(jnp.maximum(ax, ay), 1e-30)
    angle = t * _polynomial((0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351), t * t)
    angle = jnp.where(ay > ax, np.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, np.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


def _polynomial(coefficients, x):
    value = jnp.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * x + c
    return value


# ---- the estimators


@functools.cache
def net(count: int) -> np.ndarray:
    """Hammersley's points [count, 2], count a power of two."""
    bits = count.bit_length() - 1
    i = np.arange(count)
    reverse = sum(((i >> b) & 1) << (bits - 1 - b) for b in range(bits)) if bits else np.zeros(1, int)
    return np.stack([(i + 0.5) / count, (reverse + 0.5) / count], axis=1)


def radiance(parameters, normals, views, *, of_light: int, of_material: int, glossy: bool):
    """Radiance [P, 3] from so many samples of the light and of the material.

    parameters: those of `light_tables`; `shifts` [P, 5] of `shifts`; `albedo` [3], or `alpha` and `f0` [3] of GGX.
    """
    texels = parameters["texels"]

    def seen(n, v, nv, l, hits):
        """What samples in the directions `l`, three arrays [S, P], on the texels `hits` add to the radiance."""
        rows = take(texels, hits)
        nl, vl = dot(n, l), dot(v, l)
        f, own, fresnel = material(parameters, nl, nv, vl, glossy)
        density = of_light * rows[..., 3] if of_light else 0
        density = jax.lax.stop_gradient(density + of_material * own if of_material else density)
        weight = jnp.where(nl > 0, f / jnp.where(density > 0, density, 1), 0)
        return totals([weight * fresnel(c) * rows[..., c] for c in range(3)])

    def tile(n, v, shift):
        n, v, shift = n.T[:, None], v.T[:, None], shift.T
        nv = dot(n, v)
        total = 0.0
        if of_light:
            u = (jnp.asarray(net(of_light), n.dtype)[:, :, None] + shift[None, :2]) % 1
            cell = jnp.minimum((u * POOL).astype(jnp.int32), POOL - 1)
            cell = cell[:, 0] * POOL + cell[:, 1]
            l = take(parameters["directions"], cell)
            total += seen(n, v, nv, (l[..., 0], l[..., 1], l[..., 2]), take(parameters["hits"], cell))
        if of_material:
            l = jax.lax.stop_gradient(sample(parameters, n, v, nv, shift[2:, None], of_material, glossy))
            total += seen(n, v, nv, l, texel_of(*l, height_of(texels)))
        return total

    size = max(64, NUMBERS // (of_light + of_material))
    return in_tiles(tile, size, normals, views, parameters["shifts"])


def point_lights(parameters, normals, views, *, glossy: bool):
    """Radiance [P, 3] under the same few lights for all pixels: `lights` [S, 6], directions and powers."""
    lights = parameters["lights"]

    def tile(n, v):
        n, v = n.T, v.T
        l = [lights[:, i, None] for i in range(3)]
        nl, vl = dot(l, n[:, None]), dot(l, v[:, None])
        f, _, fresnel = material(parameters, nl, dot(n, v)[None], vl, glossy)
        weight = jnp.where(nl > 0, f, 0)
        return totals([weight * fresnel(c) * lights[:, 3 + c, None] for c in range(3)])

    return in_tiles(tile, max(64, NUMBERS // len(lights)), normals, views)


def lights_of_map(light: dict, count: int) -> jax.Array:
    """So many directions [count, 6] spread by the map's distribution, with their share of the power."""
    cell = np.minimum(net(count) * POOL, POOL - 1).astype(int) @ [POOL, 1]
    rows = light["texels"][light["hits"][cell]]
    return jnp.concatenate([light["directions"][cell], rows[:, :3] / (count * rows[:, 3:])], axis=1)


def material(parameters, nl, nv, vl, glossy):
    """value_cosine without its Fresnel factor, the density of `sample`, and the Fresnel factor of a colour."""
    if not glossy:
        albedo = parameters["albedo"]
        return nl / np.pi, nl / np.pi, lambda c: albedo[c]
    a2, f0 = parameters["alpha"] ** 2, parameters["f0"]
    h2 = jnp.maximum(2 + 2 * vl, 1e-9)
    nh = nl + nv
    d = a2 / (np.pi * (nh * nh / h2 * (a2 - 1) + 1) ** 2)
    smith = lambda x: x + jnp.sqrt(x * x * (1 - a2) + a2)
    visible = d / smith(nv)
    t = 1 - jnp.sqrt(h2) / 2
    t5 = t * t * t * t * t
    return visible * nl / smith(nl), visible / 2, lambda c: f0[c] + (1 - f0[c]) * t5


def sample(parameters, n, v, nv, shift, count, glossy):
    """World directions, three arrays [S, P], by the cosine or by visible normals."""
    points = net(count)
    u = (jnp.asarray(points[:, :1], n.dtype) + shift[0]) % 1  # [S, P]
    angle = 2 * np.pi * points[:, 1:]
    cos, sin = (jnp.asarray(f(angle), n.dtype) for f in (np.cos, np.sin))
    cos, sin = cos * shift[1] - sin * shift[2], sin * shift[1] + cos * shift[2]
    t, b = tangents(n)
    if not glossy:
        radius, z = jnp.sqrt(u), jnp.sqrt(1 - u)
        return tuple(radius * (cos * t[i] + sin * b[i]) + z * n[i] for i in range(3))
    alpha = parameters["alpha"]
    vx, vy = alpha * dot(t, v), alpha * dot(b, v)
    scale = jax.lax.rsqrt(vx * vx + vy * vy + nv * nv)
    sx, sy, sz = vx * scale, vy * scale, nv * scale
    z = (1 - u) * (1 + sz) - sz
    radius = jnp.sqrt(jnp.maximum(1 - z * z, 0))
    hx, hy, hz = alpha * (radius * cos + sx), alpha * (radius * sin + sy), jnp.maximum(z + sz, 0)
    scale = jax.lax.rsqrt(hx * hx + hy * hy + hz * hz)
    h = tuple(scale * (hx * t[i] + hy * b[i] + hz * n[i]) for i in range(3))
    vh = 2 * dot(v, h)
    return tuple(vh * h[i] - v[i] for i in range(3))


@jax.custom_jvp
def totals(terms):
    """Sums [P, 3] over the samples of three arrays [S, P], in one pass: XLA would make their factors once for each."""
    zero = np.zeros((), terms[0].dtype)
    add = lambda a, b: tuple(x + y for x, y in zip(a, b, strict=True))
    return jnp.stack(jax.lax.reduce(tuple(terms), (zero,) * 3, add, (0,)), axis=-1)


@totals.defjvp
def _totals_jvp(primals, tangents):
    return totals(*primals), jnp.stack([jnp.sum(x, axis=0) for x in tangents[0]], axis=-1)


def tangents(n):
    """Two unit vectors across a normal, components first (Duff et al. 2017)."""
    x, y, z = n
    sign = jnp.where(z < 0, -1.0, 1.0).astype(n.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


def take(table, index):
    return table.at[index].get(mode="promise_in_bounds")


def height_of(texels):
    return int(np.sqrt(len(texels) / 2))


def in_tiles(function, size, *arrays):
    """function of [size, k] rows of all arrays at a time, the size made a power of two that divides their length."""
    size = math.gcd(1 << int(size).bit_length() - 1, len(arrays[0]))
    tiles = [a.reshape(-1, size, a.shape[-1]) for a in arrays]
    values = jax.lax.map(jax.checkpoint(lambda rows: function(*rows)), tiles)
    return values.reshape(-1, values.shape[-1])
