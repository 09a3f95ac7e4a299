"""Integrals of products of two expansions, one of them turned by many rotations: sum over n of s_n (R c)_n.

With R = Z(a) Y(b) Z(g) and Y(b) = J Z(-b) J as in `_rotation`, this is (Z(b) J Z(-a) s) . (J Z(g) c). The right side
is a trigonometric polynomial in g, the same for all rotations: nothing of the size of c is turned for each of them, and
all colours of c cost one product with a constant matrix. J exchanges y and z, and so the parities in y and in z: three
quarters of it are zeros. Coefficients of one parity and a few degrees stand together, apart for m >= 0 and m < 0: turns
about z then multiply whole blocks, and J is a few small dense products.

notation: k = |m|; A = orders with l + k even, B = odd; x = coefficients of m >= 0, y = of m < 0, [rows, colours, p];
[degrees, orders, colours, p] in a block.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from shisd._numerics import rows_of
from shisd._typing import Array, Float
from shisd.harmonics import _layout, _tables
from shisd.harmonics._rotation import QUARTER, rates, swapped_series, turns

_NEAR = 0.01  # sine of the angle to the pole
_DEGREES_TOGETHER = 4  # more make fewer and larger products, with more zeros in them

Parts = tuple[Array, ...]  # xa, ya, xb, yb
Bands = dict[int, np.ndarray]  # by offset, diagonals [degrees, to] of matrices that join neighbouring orders
Series = tuple[Array, ...]  # of even, then of odd multiples of g


class Each(NamedTuple):
    """Expansions c, one set of colours for every rotation, as s is given: m >= 0 and m < 0, [rows, colours, p]."""

    x: Array
    y: Array


Waves = list[Array]  # cosines and sines [L+1, p] of the multiples of an angle


class _Block(NamedTuple):
    """A few degrees of one parity. `a`, `b`: their orders. Matrices [degrees, to, from] between classes of orders."""

    a: np.ndarray
    b: np.ndarray
    plus: np.ndarray  # where the coefficients are, A then B; (L+1)^2 where there is none
    minus: np.ndarray
    swap: tuple[np.ndarray, ...]  # J: xa from xa, ya from xb, xb from ya, yb from yb
    about_x: tuple[Bands, ...]  # rates of rotation: xa from yb, ya from xb, xb from ya, yb from xa
    about_y: tuple[Bands, ...]  # xa from xb, ya from yb, xb from xa, yb from ya


@functools.cache
def _blocks(degree: int) -> tuple[_Block, ...]:
    none = (degree + 1) ** 2
    exchange, about_x, about_y = _tables.swap_matrices(degree), *_generators(degree)
    blocks = []
    for parity in range(min(2, degree + 1)):
        of_parity = np.arange(parity, degree + 1, 2)
        for last in range(len(of_parity), 0, -_DEGREES_TOGETHER):
            degrees = of_parity[max(0, last - _DEGREES_TOGETHER) : last]
            l = degrees[:, None]
            a, b = (np.arange(first, max(first, degrees[-1]) + 1, 2) for first in (parity, 1 - parity))
            xa, xb = (_layout.place(l, k, none) for k in (a, b))
            ya, yb = (np.where(k > 0, _layout.place(l, -k, none), none) for k in (a, b))
            part = functools.partial(_part, degrees, none)
            near = lambda *which, part=part: _diagonals(part(*which))
            blocks.append(_Block(
                a, b, np.concatenate([xa.ravel(), xb.ravel()]), np.concatenate([ya.ravel(), yb.ravel()]),
                (part(exchange, xa, xa), part(exchange, ya, xb), part(exchange, xb, ya), part(exchange, yb, yb)),
                (near(about_x, xa, yb), near(about_x, ya, xb), near(about_x, xb, ya), near(about_x, yb, xa)),
                (near(about_y, xa, xb), near(about_y, ya, yb), near(about_y, xb, xa), near(about_y, yb, ya)),
            ))  # fmt: skip
    return tuple(blocks)


def _part(
    degrees: np.ndarray, none: int, matrices: Sequence[np.ndarray], to: np.ndarray, source: np.ndarray
) -> np.ndarray:
    """Rows `to` and columns `source` of the matrix of each of some degrees; zero where there is no coefficient."""
    cut = lambda l, index: np.where(index < none, index - l * l, 2 * l + 1)
    return np.stack([
        np.pad(matrices[l], (0, 1))[np.ix_(cut(l, t), cut(l, s))] for l, t, s in zip(degrees, to, source, strict=True)
    ])  # fmt: skip


def _diagonals(matrices: np.ndarray) -> Bands:
    _, rows, columns = matrices.shape
    diagonals = {}
    for offset in (-1, 0, 1):
        i = np.arange(max(0, -offset), min(rows, columns - offset))
        diagonals[offset] = np.zeros((len(matrices), rows))
        diagonals[offset][:, i] = matrices[:, i, i + offset]
    return {offset: d for offset, d in diagonals.items() if d.any()} or {0: diagonals[0]}


def _generators(degree: int) -> list[list[np.ndarray]]:
    """For x and y, the generator of every band as a matrix."""
    matrices = []
    for terms in _tables.generator_gather(degree)[:2]:
        bands = [np.zeros((2 * l + 1, 2 * l + 1)) for l in range(degree + 1)]
        for index, factor in terms:
            for n in np.flatnonzero(factor):
                l = int(np.sqrt(n))
                bands[l][n - l * l, index[n] - l * l] += factor[n]
        matrices.append(bands)
    return matrices


def rows(degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients of m >= 0 and of m < 0, and |m|, in the order of `pair_many`; (L+1)^2 where there is none."""
    blocks = _blocks(degree)
    k = [np.broadcast_to(k, (len(b.swap[0]), len(k))).ravel() for b in blocks for k in (b.a, b.b)]
    plus, minus = (np.concatenate([getattr(b, name) for b in blocks]).astype(np.int32) for name in ("plus", "minus"))
    return plus, minus, np.concatenate(k).astype(np.int32)


def turned_series(c: Float[Array, "f n"], degree: int) -> Series:
    """J Z(g) c of expansions as `pair_many` takes it: matrices [f, cosines and sines of multiples of g, coefficients].

    Even multiples meet coefficients of m >= 0 of even degrees and of m < 0 of odd degrees, odd multiples the others.
    """
    series = jnp.pad(jnp.moveaxis(swapped_series(c, degree), 0, -1), ((0, 0), (0, 0), (0, 1)))
    chosen = [[b.plus if b.a[0] == k else b.minus for b in _blocks(degree)] for k in range(min(2, degree + 1))]
    parts = [jnp.concatenate([series[:, k : degree + 1 : 2], series[:, degree + 1 + k :: 2]], axis=1) for k in range(2)]
    return tuple(part[..., np.concatenate(index)] for part, index in zip(parts, chosen, strict=False))


@functools.partial(jax.custom_jvp, nondiff_argnums=(4, 5))
def pair_many(
    x: Float[Array, "rows f p"], y: Float[Array, "rows f p"], series: Series | Each, r: Float[Array, "p 3 3"],
    degree: int, upright: bool = False,
) -> Float[Array, "f3 p"]:  # fmt: skip
    """sum over n of s_n (R c)_n, for an s of every rotation, ordered as `rows` says, and `turned_series` of a c.

    Instead of the series of a c that all share, `Each` has one for every rotation; then s takes all turns, for it has
    the fewest colours. Of the numbers of colours of s and c one may be 1. `upright` promises that R z has y = 0 <= x.
    Derivatives: exact wherever the pole stays in place, to every order.
    """
    a, b, g = turns(r, max(degree, 1))
    return _pair(_split(x, y, degree), series, None if upright else a, b, g, degree)


def _pair_many_jvp(degree, upright, primals, tangents):
    (x, y, series, r), (dx, dy, d_series, dr) = primals, tangents
    value = pair_many(x, y, series, r, degree, upright)
    change, lobe = jnp.zeros_like(value), _split(x, y, degree)
    zero = lambda t, like: jnp.zeros_like(like) if isinstance(t, SymbolicZero) else t
    if not all(isinstance(t, SymbolicZero) for t in (dx, dy, dr)):
        moved = _split(zero(dx, x), zero(dy, y), degree)
        if not isinstance(dr, SymbolicZero):  # s . G R c = (-G s) . R c with the generator G, as in `rotate_many`
            turning = _turning(lobe, [-w for w in rates(r, dr)], degree)
            moved = [tuple(p + q for p, q in zip(s, t, strict=True)) for s, t in zip(moved, turning, strict=True)]
        change += _pair_away_from_pole(moved, series, r, degree)
    if not all(isinstance(t, SymbolicZero) for t in d_series):
        d_series = jax.tree.map(zero, d_series, series, is_leaf=lambda t: isinstance(t, SymbolicZero))
        change += _pair_away_from_pole(lobe, d_series, r, degree)
    return value, change


pair_many.defjvp(_pair_many_jvp, symbolic_zeros=True)


def _pair_away_from_pole(s: list[Parts], series: Series | Each, r: Float[Array, "p 3 3"], degree: int) -> Array:
    """`pair_many` with smooth angles: where R nearly keeps the z axis, s . R c = Q s . Q R c with Q, a quarter turn."""
    near = r[:, 2, 2] ** 2 > 1 - _NEAR**2

    def away() -> tuple[list[Parts], Array]:
        turned = [(xa, -ya, xb, -yb) for xa, ya, xb, yb in _swapped(s, degree)]
        pick = lambda q, p: jnp.where(near[None, None, None], q, p)
        parts = [tuple(pick(q, p) for p, q in zip(*both, strict=True)) for both in zip(s, turned, strict=True)]
        return parts, jnp.where(near[:, None, None], jnp.asarray(QUARTER, r.dtype) @ r, r)

    s, r = jax.lax.cond(jnp.any(near), away, lambda: (s, r))
    a, b, g = turns(r, max(degree, 1))
    return _pair(s, series, a, b, g, degree)  # of upright rotations a = 0, but its derivative is not


def _pair(
    s: list[Parts], series: Series | Each, a: Waves | None, b: Waves, g: Waves, degree: int
) -> Float[Array, "f3 p"]:
    """(Z(b) J Z(-a) s) . (J Z(g) c), or (Z(-g) J Z(b) J Z(-a) s) . c."""
    if a is not None:
        s = _turned(s, a[0], -a[1], degree)
    s = _turned(_swapped(s, degree), b[0], b[1], degree)
    if isinstance(series, Each):
        s = _turned(_swapped(s, degree), g[0], -g[1], degree)
        products = [p * q for both in zip(s, _split(*series, degree), strict=True) for p, q in zip(*both, strict=True)]
        return functools.reduce(jnp.add, [jnp.sum(p, axis=(0, 1)) for p in products])
    totals = []
    for k, matrices in enumerate(series):
        kept = [parts[i + (block.a[0] != k)] for block, parts in zip(_blocks(degree), s, strict=True) for i in (0, 2)]
        lobe = jnp.concatenate([z.reshape(-1, *z.shape[2:]) for z in kept])
        waves = jnp.concatenate([g[0][k::2], g[1][k::2]])
        # flat products of matrices, whose transposes are such too, and sums as products with ones
        if lobe.shape[1] == 1:
            sums = matrices.reshape(-1, len(lobe)) @ lobe[:, 0]
        else:
            matrices = jnp.broadcast_to(matrices, (lobe.shape[1], *matrices.shape[1:]))
            sums = jnp.concatenate([m @ lobe[:, i] for i, m in enumerate(matrices)])
        sums = (sums.reshape(-1, *waves.shape) * waves[None]).reshape(sums.shape)
        ones = np.kron(np.eye(len(sums) // len(waves)), np.ones(len(waves)))
        totals.append(jnp.asarray(ones, sums.dtype) @ sums)
    return functools.reduce(jnp.add, totals)


# ---- block by block


def _split(x: Float[Array, "rows f p"], y: Float[Array, "rows f p"], degree: int) -> list[Parts]:
    shapes = [(len(block.swap[0]), len(k)) for block in _blocks(degree) for k in (block.a, block.b)]
    cut = lambda z: jax.lax.split(z, [degrees * orders for degrees, orders in shapes])  # slices transpose slowly
    plus, minus = ([p.reshape(*s, *z.shape[1:]) for p, s in zip(cut(z), shapes, strict=True)] for z in (x, y))
    return [(plus[i], minus[i], plus[i + 1], minus[i + 1]) for i in range(0, len(shapes), 2)]


def _swapped(s: list[Parts], degree: int) -> list[Parts]:
    """J s."""
    return [_product(block.swap, (xa, xb, ya, yb)) for block, (xa, ya, xb, yb) in zip(_blocks(degree), s, strict=True)]


def _turning(s: list[Parts], about: list[Array], degree: int) -> list[Parts]:
    """G s of rotation at these rates [p] about x, y and z."""
    changes = []
    for block, (xa, ya, xb, yb) in zip(_blocks(degree), s, strict=True):
        a, b = (jnp.asarray(k[None, :, None, None], xa.dtype) for k in (block.a, block.b))
        about_x, about_y = _neighbours(block.about_x, (yb, xb, ya, xa)), _neighbours(block.about_y, (xb, yb, xa, ya))
        about_z = (-a * ya, a * xa, -b * yb, b * xb)
        rates = [[rows_of(w, np.ones(x[..., 0].size)).reshape(x.shape) for w in about] for x in (xa, xb)]
        terms = zip(about_x, about_y, about_z, (rates[0], rates[0], rates[1], rates[1]), strict=True)
        changes.append(tuple(wx * x + wy * y + wz * z for x, y, z, (wx, wy, wz) in terms))
    return changes


def _turned(s: list[Parts], cos: Array, sin: Array, degree: int) -> list[Parts]:
    """Z s for the turn whose multiples have these cosines and sines [L+1, p]."""
    turned = []
    for block, (xa, ya, xb, yb) in zip(_blocks(degree), s, strict=True):
        (ca, sa), (cb, sb) = ([w[k[0] :: 2][: len(k)][None, :, None] for w in (cos, sin)] for k in (block.a, block.b))
        turned.append((ca * xa - sa * ya, ca * ya + sa * xa, cb * xb - sb * yb, cb * yb + sb * xb))
    return turned


def _product(matrices: tuple[np.ndarray, ...], parts: Parts) -> Parts:
    return tuple(jnp.einsum("lij,ljfp->lifp", jnp.asarray(m, x.dtype), x) for m, x in zip(matrices, parts, strict=True))


def _neighbours(diagonals: tuple[Bands, ...], parts: Parts) -> Parts:
    product = lambda x, offset, d: jnp.asarray(d[:, :, None, None], x.dtype) * _shifted(x, offset, d.shape[1])
    return tuple(
        functools.reduce(jnp.add, [product(x, offset, d) for offset, d in bands.items()])
        for bands, x in zip(diagonals, parts, strict=True)
    )


def _shifted(x: Float[Array, "l k f p"], offset: int, size: int) -> Float[Array, "l k2 f p"]:
    """Rows k + offset of x for `size` rows k, zeros where there are none."""
    first, last = max(0, offset), min(x.shape[1], size + offset)
    before = max(0, -offset)
    return jnp.pad(x[:, first:last], ((0, 0), (before, size - before - (last - first)), (0, 0), (0, 0)))
