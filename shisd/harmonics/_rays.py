"""Expansions of functions that are known on rays from an axis, in frames whose pole is elsewhere.

First sums along each ray, with waves in its polar angle, then over the rays, with waves in their azimuth: 2 L products
for each point, where sums with harmonics of the other frame take 4 L^2 (`_sh.weighted_sums`). Then the expansion about
the axis is turned, by J Z J as in `_rotation`; three quarters of J vanish, as y -> -y and z -> -z only change signs.

notation: polar angle psi from the axis and azimuth chi about it; degree l = 2 i + p, order m = 2 h + q, Fourier index
2 k + p in psi (`_transform`); r = 0 for cos(m chi), 1 for sin(m chi). With y and z exchanged, orders are 2 j + s of the
parity s of p + r, negative where p != q. v = frames, f = functions.
"""

import functools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from shisd._numerics import angle_multiples, times
from shisd._typing import Array, DTypeLike, Float
from shisd.harmonics import _layout, _tables
from shisd.harmonics._transform import rounded, series_table

RayTables = tuple[Array | np.ndarray, Array | np.ndarray]


@functools.cache
def ray_tables(degree: int, dtype: DTypeLike, even: bool) -> RayTables:
    """Series in psi [p, q, h, i, k] and J [p, q, r, i, h, j], to be passed to what is compiled. `even`: r = 0 alone."""
    n = degree // 2 + 1
    swaps = np.zeros((2, 2, 1 if even else 2, n, n, n))
    for l, swap in enumerate(_tables.swap_matrices(degree)):
        p = l % 2
        for q, r in np.ndindex(2, swaps.shape[2]):
            m, k = np.arange(q, l + 1, 2), np.arange((p + r) % 2, l + 1, 2)
            block = swap[np.ix_(l - m if r else l + m, l + k if p == q else l - k)]
            swaps[p, q, r, l // 2, : len(m), : len(k)] = block
    return series_table(degree, dtype), rounded(swaps, dtype)


def ray_waves(cos: Float[Array, " points"], sin: Float[Array, " points"], degree: int) -> Float[Array, "waves points"]:
    """What values along a ray are multiplied by: cosines, then sines, of the multiples of psi."""
    return jnp.concatenate(angle_multiples(cos, sin, 2 * (degree // 2 + 1)))


def sums_about(
    along: Float[Array, "rays waves f"],
    cos: Float[Array, " rays"],
    sin: Float[Array, " rays"],
    even: bool,
    ends: Sequence[int] | np.ndarray = (),
) -> Float[Array, "q h r k p groups_f"]:
    """Sums over rays, at azimuths of these cosines and sines, of sums along them; `even` in chi: without sines.

    `ends` parts the rays into groups, whose sums stand one after another in f.
    """
    n = along.shape[1] // 4
    waves = jnp.stack(angle_multiples(cos, sin, 2 * n)[: 1 if even else 2])
    waves *= jnp.asarray(np.where(np.arange(2 * n) == 0, 1, np.sqrt(2))[None, :, None], waves.dtype)
    groups = zip(jnp.split(waves, ends, axis=2), jnp.split(along, ends), strict=True)
    pairs = [(w.reshape(-1, n, 2, len(a)), a.reshape(-1, 2, n, 2, a.shape[2])) for w, a in groups]
    return jnp.concatenate([jnp.einsum("rhqx,xqkpf->qhrkpf", *pair) for pair in pairs], axis=-1)


def turned_from_axis(
    sums: Float[Array, "v q h r k p f"],
    theta: tuple[Array, Array],
    phi: tuple[Array, Array] | None,
    degree: int,
    tables: RayTables,
) -> Float[Array, "v f n"]:
    """Coefficients of what is turned by Rz(phi) Ry(-theta), from cosines and sines [v] of the angles; phi None is 0."""
    series, swaps = tables
    v, _, n, r, *_ = sums.shape

    def multiples(angle: tuple[Array, Array]) -> Array:
        cos, sin = angle
        return jnp.stack(angle_multiples(cos, sin, 2 * n)).reshape(2, n, 2, v)

    def turn(x: Array, waves: Array, sign: np.ndarray, axis: int) -> Array:
        cos, sin = jnp.broadcast_to(waves[..., None], (2, *x.shape))
        return cos * x + sin * times(jnp.asarray(sign, x.dtype), jnp.flip(x, axis))

    x = jnp.einsum("pqhik,vqhrkpf->pqrihvf", series, sums)
    x = jnp.einsum("pqrihj,pqrihvf->pqrijvf", swaps, x)
    parity = (np.arange(2)[:, None] + np.arange(r)) % 2
    waves = multiples(theta)[:, :, parity].transpose(0, 2, 3, 1, 4)  # [2, p, r, j, v]
    x = turn(x, waves[:, :, None, :, None], (1 - 2 * np.eye(2)).reshape(2, 2, 1, 1, 1, 1, 1), 1)
    x = jnp.einsum("pqrihj,pqrijvf->pqrihvf", swaps, x)
    if phi is None:
        x = jnp.concatenate([x, jnp.zeros_like(x)], axis=2)
    else:
        waves = jnp.swapaxes(multiples(phi), 1, 2)  # [2, q, h, v]
        x = turn(x, waves[:, None, :, None, None], np.array([-1, 1]).reshape(2, 1, 1, 1, 1), 2)
    return jnp.moveaxis(x.reshape(-1, v, x.shape[-1])[_place(degree)], 0, -1)


@functools.cache
def _place(degree: int) -> np.ndarray:
    """Where [p, q, r, i, h] holds y_l^m."""
    n = degree // 2 + 1
    l, m = _layout.bands(degree), _layout.orders(degree)
    place = (l % 2, np.abs(m) % 2, (m < 0).astype(int), l // 2, np.abs(m) // 2)
    return np.ravel_multi_index(place, (2, 2, 2, n, n)).astype(np.int32)
