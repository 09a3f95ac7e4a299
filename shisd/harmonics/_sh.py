"""Real spherical harmonics: the basis, and expansions without the basis.

Follows ISD15s Eq. 3-5 for the definition and its stable normalised recurrence, run once on the host in float64. At run
time the polar functions are evaluated from their Fourier series in the polar angle (`_tables.polar_series`) as matrix
products: on float32 this is about ten times more exact at degree 100 than running the recurrence.

Derivatives do not come from these formulas: the gradient of the solid harmonic r^l y_l^m is a combination of harmonics
of degree l-1, so it is exact at the poles, to every order.

notation: u = (x, y, z), rho = sqrt(x^2 + y^2) = sin(theta), z = cos(theta); y_l^m as in ISD15 Eq. 7.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from shisd import _checks
from shisd._numerics import angle_multiples, normalize
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Float
from shisd.harmonics import _layout, _tables

_POINTS_AT_ONCE = 1 << 15  # beyond this, expansions are evaluated in tiles so that memory stays bounded


def sh_basis(directions: ArrayLike, degree: int) -> Float[Array, "*batch n"]:
    """Real orthonormal spherical harmonics y_l^m of each direction.

    Arguments: `directions` [..., 3], of any length (only the direction counts; a zero vector gives NaN); static
    `degree` L >= 0. Returns [..., (L+1)^2] in the dtype of `directions`, index l*(l+1)+m.
    Derivatives: in `directions`, every order, both modes, exact at the poles.
    Accuracy: 1e-13 at degree 30 and 1e-12 at degree 100 in float64; 3e-6 at degree 16 and 3e-5 at degree 100 in
    float32. Cost: a matrix product of 2(L+1) terms per coefficient; the result is (L+1)^2 numbers per direction,
    so to evaluate an expansion use `evaluate`.
    Source: ISD15 Eq. 7, ISD15s Eq. 3-5.
    """
    degree = _checks.degree(degree)
    return by_device(_jitted_basis, {"directions": _checks.vectors("directions", directions)}, degree)


def evaluate(coefficients: ArrayLike, directions: ArrayLike) -> Float[Array, "*batch"]:
    """Values of spherical-harmonic expansions: sum over (l, m) of coefficients[l, m] y_l^m(direction).

    Arguments: `coefficients` [..., (L+1)^2]; `directions` [..., 3] of any length (a zero vector gives NaN). The batch
    axes broadcast as in NumPy: coefficients [3, 1, n] at directions [N, 3] give [3, N].
    Derivatives: in both arguments, every order, both modes, exact at the poles.
    Accuracy: as `sh_basis`, relative to the sum of the absolute coefficients.
    Cost: where no axis batches both arguments, the basis is never built: the expansion becomes a Fourier series in both
    angles, (L+1)(2L+1) products per point, in tiles of bounded memory.
    """
    c, degree = _checks.coefficients("coefficients", coefficients)
    d = _checks.vectors("directions", directions)
    if c.dtype != d.dtype:
        dtype = jnp.promote_types(c.dtype, d.dtype)
        c, d = c.astype(dtype), d.astype(dtype)
    try:
        np.broadcast_shapes(c.shape[:-1], d.shape[:-1])
    except ValueError as error:
        raise ValueError(
            f"batch axes of `coefficients` {list(c.shape)} and `directions` {list(d.shape)} do not broadcast; "
            "for every expansion at every direction pass coefficients[..., None, :]."
        ) from error
    rank = max(c.ndim, d.ndim)
    c, d = (a.reshape((1,) * (rank - a.ndim) + a.shape) for a in (c, d))
    return by_device(_evaluate, {"coefficients": c, "directions": d}, degree)


@functools.partial(jax.jit, static_argnums=1)
def _jitted_basis(batch: dict[str, Float[Array, "*batch 3"]], degree: int) -> Float[Array, "*batch n"]:
    return basis_at(normalize(batch["directions"]), degree)


@functools.partial(jax.jit, static_argnums=1)
def _evaluate(batch: dict[str, Array], degree: int) -> Float[Array, "*batch"]:
    """`coefficients` and `directions` of equal rank, their batch axes broadcast."""
    c, u = batch["coefficients"], normalize(batch["directions"])
    rank = c.ndim - 1
    if any(i > 1 and j > 1 for i, j in zip(c.shape[:-1], u.shape[:-1], strict=True)):
        return jnp.sum(c * basis_at(u, degree), axis=-1)
    values = _expand(c.reshape(-1, c.shape[-1]), u.reshape(-1, 3), degree)
    values = values.reshape(c.shape[:-1] + u.shape[:-1])
    pairs = [axis for pair in zip(range(rank), range(rank, 2 * rank), strict=True) for axis in pair]
    return values.transpose(pairs).reshape(np.broadcast_shapes(c.shape[:-1], u.shape[:-1]))


def angles_of(u: Float[Array, "points 3"]) -> Float[Array, "4 points"]:
    """cos(theta), sin(theta), cos(phi), sin(phi). phi = 0 at the poles, where every y_l^m with m != 0 vanishes."""
    x, y, z = u.T
    rho = jnp.sqrt(x * x + y * y)
    safe = jnp.where(rho > 0, rho, 1)
    return jnp.stack([z, rho, jnp.where(rho > 0, x / safe, 1), y / safe])


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def basis_at(u: Float[Array, "*batch 3"], degree: int) -> Float[Array, "*batch n"]:
    """The basis at unit vectors; off the sphere (in derivatives) the solid harmonics r^l y_l^m."""
    series, factors = (jnp.asarray(table, u.dtype) for table in _basis_tables(degree))
    # [2 (L+1), points], points in the vector lanes: cosines, then sines.
    theta, phi = (
        jnp.concatenate(angle_multiples(cos, sin, degree + 1))
        for cos, sin in angles_of(u.reshape(-1, 3)).reshape(2, 2, -1)
    )
    polar = theta.T @ series
    # a product with a 0-1 matrix, not an indexed copy, so that angles are not made again for every coefficient
    azimuth = phi.T @ factors
    return (polar * azimuth[:, _layout.orders(degree) + degree]).reshape(*u.shape[:-1], (degree + 1) ** 2)


def weighted_sums(values: Float[Array, "*p_f"], u: Float[Array, "p 3"], degree: int) -> Float[Array, "*f_n"]:
    """Sums over points of values times harmonics, through those of values times waves in theta and phi: no basis.

    Derivatives: in the values; those in the unit vectors are left out.
    """
    series, _ = _basis_tables(degree)
    tile = 1024  # larger ones leave the cache
    fill = lambda a: jnp.pad(a, ((0, -a.shape[0] % tile), (0, 0))).reshape(-1, tile, a.shape[1])
    flat = values.reshape(values.shape[0], -1)
    angles = angles_of(jax.lax.stop_gradient(u)).T

    @jax.checkpoint
    def add(total: Array, some: tuple[Array, Array]) -> tuple[Array, None]:
        v, angles = some
        theta, phi = (angle_multiples(c, s, degree + 1) for c, s in angles.T.reshape(2, 2, -1))
        polar, waves = jnp.concatenate(theta), jnp.concatenate([phi[1][1:][::-1], phi[0]])  # orders from -degree
        weighted = (v.T[:, None] * polar[None]).reshape(-1, tile)
        return total + weighted @ waves.T, None

    start = jnp.zeros((flat.shape[1] * series.shape[0], 2 * degree + 1), flat.dtype)
    sums, _ = jax.lax.scan(add, start, (fill(flat), fill(angles)))
    sums = sums.reshape(flat.shape[1], series.shape[0], -1)[:, :, _layout.orders(degree) + degree]
    return jnp.sum(sums * jnp.asarray(series[None], u.dtype), axis=1).reshape(*values.shape[1:], -1)


@basis_at.defjvp
def _basis_jvp(degree, primals, tangents):
    (u,), (du,) = primals, tangents
    y = basis_at(u, degree)
    flat = y.reshape(-1, y.shape[-1])
    ones = jnp.ones((1, y.shape[-1]), y.dtype)  # a broadcast as a product: its transpose, a sum, is slow as a loop
    dy = jnp.zeros_like(flat)
    for rate, terms in zip(du.reshape(-1, 3).T, _tables.gradient_gather(degree, transpose=False), strict=True):
        slope = sum(jnp.asarray(factor[None], y.dtype) * flat[:, index] for index, factor in terms)
        dy += (rate[:, None] @ ones) * slope
    return y, dy.reshape(y.shape)


@functools.cache
def _basis_tables(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Polar series of every coefficient over cos, then sin(k theta); map from cos, then sin(m phi) to the orders."""
    m = _layout.orders(degree)
    table = _tables.polar_series(degree)[np.abs(m), :, _layout.bands(degree)].T * np.where(m == 0, 1, np.sqrt(2))
    series = np.concatenate([np.where(m % 2 == 0, table, 0), np.where(m % 2 == 1, table, 0)])
    factors = np.zeros((2 * (degree + 1), 2 * degree + 1))
    m = np.arange(-degree, degree + 1)
    factors[np.where(m >= 0, m, degree + 1 - m), m + degree] = 1
    return series, factors


@functools.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _expand(c: Float[Array, "f n"], u: Float[Array, "points 3"], degree: int) -> Float[Array, "f points"]:
    """Every expansion at every unit vector, as a double Fourier series."""
    even, odd = _fourier(c, degree)

    def at(u: Float[Array, "points 3"]) -> Float[Array, "f points"]:
        z, rho, *phi = angles_of(u)
        cos_phi, sin_phi = (a[None] for a in phi)
        cos, sin = angle_multiples(z, rho, degree + 1)
        waves = ((even @ cos, degree // 2 + 1), (odd @ sin, (degree + 1) // 2))
        e, o = (w.reshape(c.shape[0], 2, orders, u.shape[0]) for w, orders in waves)
        x, y = jnp.zeros((2, c.shape[0], u.shape[0]), c.dtype)
        for m in range(degree, -1, -1):  # Horner's rule for the real part of sum (e_m - i e_-m) exp(i m phi)
            wave = (o if m % 2 else e)[:, :, m // 2]
            x, y = x * cos_phi - y * sin_phi + wave[:, 0], x * sin_phi + y * cos_phi - wave[:, 1]
        return x

    return _in_tiles(at, u, _POINTS_AT_ONCE)


def _in_tiles(function, u: Float[Array, "points 3"], size: int) -> Float[Array, "f points"]:
    """`function` of all points, at most `size` at a time."""
    if u.shape[0] <= size:
        return function(u)
    whole = u.shape[0] // size
    tiles = jax.lax.map(function, u[: whole * size].reshape(whole, size, 3))
    tiles = jnp.moveaxis(tiles, 0, 1).reshape(tiles.shape[1], -1)
    return jnp.concatenate([tiles, function(u[whole * size :])], axis=1) if u.shape[0] % size else tiles


def _expand_jvp(degree, primals, tangents):
    (c, u), (dc, du) = primals, tangents
    values = _expand(c, u, degree)
    dvalues = jnp.zeros_like(values)
    if not isinstance(dc, SymbolicZero):  # through the basis: the transpose of the series is not smooth at the poles
        dvalues += _expand_by_basis(dc, u, degree)
    if degree > 0 and not isinstance(du, SymbolicZero):
        gradients = [
            sum(jnp.asarray(factor[None, :], c.dtype) * c[:, index] for index, factor in terms)
            for terms in _tables.gradient_gather(degree, transpose=True)
        ]
        slopes = _expand(jnp.concatenate(gradients), u, degree - 1).reshape(3, *values.shape)
        dvalues += jnp.sum(slopes * du.T[:, None, :], axis=0)
    elif not isinstance(du, SymbolicZero):
        dvalues += 0 * (u * du).T[:1]  # NaN where u is
    return values, dvalues


_expand.defjvp(_expand_jvp, symbolic_zeros=True)


def _expand_by_basis(c: Float[Array, "f n"], u: Float[Array, "points 3"], degree: int) -> Float[Array, "f points"]:
    """The same values as products with the basis, which is made again in the backward pass rather than stored."""
    return _in_tiles(jax.checkpoint(lambda u: c @ basis_at(u, degree).T), u, _POINTS_AT_ONCE // 8)


def _fourier(c: Float[Array, "f n"], degree: int) -> tuple[Array, Array]:
    """Double Fourier coefficients of expansions, for even and for odd orders m: [f * 2 * orders, L+1 over k]."""
    l = np.arange(degree + 1, dtype=np.int32)
    m = l[:, None]
    positive = jnp.where((l >= m)[None], c[:, _layout.place(l, m, 0)], 0)  # [f, m, l]
    negative = jnp.where(((l >= m) & (m > 0))[None], c[:, _layout.place(l, -m, 0)], 0)
    both = jnp.stack([positive, negative], axis=1)
    scaled = _tables.polar_series(degree) * np.where(m == 0, 1, np.sqrt(2))[:, :, None]
    series = jnp.asarray(scaled, c.dtype)
    even = jnp.einsum("mkl,fsml->fsmk", series[0::2], both[:, :, 0::2])
    odd = jnp.einsum("mkl,fsml->fsmk", series[1::2], both[:, :, 1::2])
    return even.reshape(-1, degree + 1), odd.reshape(-1, degree + 1)
