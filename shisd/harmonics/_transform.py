"""Transforms between spherical functions on a grid of rows and columns and their spherical-harmonic coefficients.

Follows the separation of variables of every fast transform: Fourier series along each row, then one sum over the rows
for each order m. The second step differs: rows are first reduced to their Fourier series in the polar angle, one matrix
product, since the normalised associated Legendre functions are short series there too (`_tables.polar_series`). The
tables then no longer grow with the number of rows, and the product is not bound by memory as sums with the Legendre
functions of each row are.

Rows are symmetric about the equator, and so is each function, with the sign (-1)^(l+m): sums and differences of
mirrored rows halve the work again.

notation: rows j, columns c, order m = 2 h + q, degree l = 2 i + p, Fourier index in the polar angle 2 k + p (it has the
parity of l), r = 0 for cos(m phi) and 1 for sin(m phi), f = one of several functions.
"""

import functools
import math
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from shisd import _checks
from shisd._numerics import normalize, safe_sqrt
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, DTypeLike, Float
from shisd.harmonics import _layout, _quadrature, _tables

Rows = Literal["gauss", "fejer", "cells"]
Texels = Literal["cells", "samples"]
_FINEST = 2048  # quadrature degree at which `project` gives up: 2 million directions


def project_map(image: ArrayLike, degree: int, *, texels: Texels = "cells") -> Float[Array, "*colour n"]:
    """Spherical-harmonic coefficients of an equirectangular map.

    Arguments: `image` [H, W, *colour], whose texel (j, i) has its centre at theta = pi (j + 1/2)/H (row 0 touches +z)
    and phi = 2 pi (i + 1/2)/W from +x towards +y; static `degree` L; static `texels`, what a texel is:
    - "cells", the mean over its cell, as in photographs and renderings. The function that is constant on each cell is
      integrated exactly, at any degree: sqrt(4 pi) times coefficient 0 is the sum of texels times solid angles.
    - "samples", the value of a smooth function at its centre, as `synthesize_map` gives it: exact for a map
      band-limited to degree M when M < H and L + M < W. Of any other map, the coefficients are those of its
      trigonometric interpolant in the polar angle, which has another power next to the poles. L < min(H, W/2).
    Returns [*colour, (L+1)^2] in the dtype of `image`. A texel that is not finite makes every coefficient of its colour
    NaN: clean the map first.
    Derivatives: linear in `image`.
    Accuracy: 1e-13 of the largest coefficient at degree 128 in float64, 3e-7 in float32.
    Cost: one FFT (or a small matrix product) per row, and a product over half the rows; measured by `make bench`.
    """
    image, degree = _checks.real_array("image", image), _checks.degree(degree)
    if image.ndim < 2 or 0 in image.shape[:2]:
        raise ValueError(f"`image` must have shape [H, W, *colour]; got {list(image.shape)}.")
    height, width = image.shape[:2]
    largest = min(height - 1, (width - 1) // 2)
    check_texels(texels)
    if texels == "samples" and degree > largest:
        raise ValueError(f"`degree` {degree} is too high for {height} x {width} samples; pass {largest} or less.")
    return analyse(image, "cells" if texels == "cells" else "fejer", degree)


def check_texels(texels: object) -> None:
    if texels not in ("cells", "samples"):
        raise ValueError(f'`texels` must be "cells" or "samples"; got {texels!r}.')


def project(
    function: Callable[[Array], ArrayLike],
    degree: int,
    *,
    quadrature_degree: int | None = None,
    tolerance: float = 1e-3,
) -> Float[Array, "*colour n"]:
    """Spherical-harmonic coefficients of a function of direction.

    Arguments: `function` maps unit directions [N, 3], in JAX's default float, to values [N] or [N, *colour]; static
    `degree` L. Returns [*colour, (L+1)^2] in the dtype of the values.
    The product rule is made finer, its degree doubled from max(2 L, 64) on, until no coefficient changes by more than
    `tolerance` times the mean of |function| times sqrt(4 pi) (for light, the largest coefficient of band 0); then the
    finer rule's are returned. ValueError where degree 2048 is not enough, as for steps and narrow peaks. What is so
    narrow that both of the first rules miss it, below 3 degrees across, is not seen. Under `jax.jit`, where no value is
    known, the rule is that of degree 256, or 4 L if that is more, and an error at run time says that it changes too
    much against half of it.
    `quadrature_degree` >= 2 L sets the degree of the rule instead, and nothing is compared: 2 L is exact for functions
    band-limited to L, otherwise what lies above degree `quadrature_degree` - L is aliased into the result.
    Derivatives: in whatever `function` is differentiable in, through its values.
    Cost: (q + 1)^2 / 2 directions for a rule of degree q.
    """
    degree = _checks.degree(degree)
    if quadrature_degree is not None:
        rule = _checks.integer("quadrature_degree", quadrature_degree)
        if rule < 2 * degree:
            raise ValueError(f"`quadrature_degree` must be >= 2 * degree = {2 * degree}; got {rule}.")
        return _by_rule(function, degree, rule)[0]
    rule = max(2 * degree, 64)
    coarse, _ = _by_rule(function, degree, rule)
    if isinstance(coarse, Tracer):
        rule = max(4 * degree, 256)
        coarse, _ = _by_rule(function, degree, rule // 2)
        fine, scale = _by_rule(function, degree, rule)
        message = f"`project` has not converged to `tolerance` {tolerance} at quadrature degree {rule}: pass a higher"
        return _checks.require(fine, ~(_change(fine, coarse, scale) > tolerance), f"{message} `quadrature_degree`.")
    while True:
        rule *= 2
        fine, scale = _by_rule(function, degree, rule)
        change = float(_change(fine, coarse, scale))
        if not change > tolerance:  # also where it is NaN
            return fine
        if 2 * rule > max(_FINEST, 8 * degree):
            raise ValueError(
                f"`project` has not converged: from quadrature degree {rule // 2} to {rule}, coefficients change by "
                f"{change:.1e} of the mean, above `tolerance` {tolerance}. Pass tolerance={2 * change:.1e}, or "
                f"quadrature_degree={2 * rule}."
            )
        coarse = fine


def _by_rule(function: Callable[[Array], ArrayLike], degree: int, rule: int) -> tuple[Array, Array]:
    """Coefficients by the product rule of degree `rule`, and the integral of |function| over sqrt(4 pi), [*colour]."""
    directions, weights = _quadrature.sphere_rule(rule)
    values = _checks.real_array("function(directions)", function(directions))
    if values.ndim == 0 or values.shape[0] != directions.shape[0]:
        raise ValueError(
            f"`function` must return [{directions.shape[0]}, *colour] for as many directions; got {list(values.shape)}."
        )
    scale = jnp.tensordot(weights.astype(values.dtype), jnp.abs(values), 1) / math.sqrt(4 * math.pi)
    return analyse(values.reshape(rule // 2 + 1, rule + 1, *values.shape[1:]), "gauss", degree), scale


@jax.jit
def _change(fine: Float[Array, "*f n"], coarse: Float[Array, "*f n"], scale: Float[Array, "*f"]) -> Array:
    return jnp.max(jnp.max(jnp.abs(fine - coarse), axis=-1) / jnp.where(scale > 0, scale, 1), initial=0)


def synthesize_map(coefficients: ArrayLike, height: int, width: int | None = None) -> Float[Array, "h w *colour"]:
    """The equirectangular map of an expansion: its values at the texel centres, of which `project_map` with
    texels="samples" is the inverse.

    Arguments: `coefficients` [*colour, (L+1)^2]; static `height` and `width`, 2 * height unless given, at any size.
    Returns [height, width, *colour].
    Derivatives: linear in `coefficients`.
    """
    c, _ = _checks.coefficients("coefficients", coefficients)
    height = _checks.integer("height", height, minimum=1)
    width = 2 * height if width is None else _checks.integer("width", width, minimum=1)
    return synthesize(c, "fejer", height, width)


def sample_map(
    image: ArrayLike, directions: ArrayLike, *, texels: Texels = "cells"
) -> Float[Array, "*batch_and_colour"]:
    """Values of an equirectangular map [H, W, *colour] at `directions` [..., 3]: [..., *colour].

    Static `texels` as in `project_map`: of "cells", the texel that the direction is in, so that the integral over a
    cell is its texel times its solid angle; of "samples", bilinear between texel centres, where phi wraps around and
    the row beyond a pole is the same row half a turn away (W even).
    Directions of any length are accepted; a zero vector or one that is not finite gives NaN. At a pole itself phi is
    taken as 0. Output dtype is that of the directions. Derivatives: in `image` and directions. Those in directions are
    0 in cells; between samples they jump from texel to texel, and are 0 at a pole itself.
    """
    image, w = _checks.real_array("image", image), _checks.vectors("directions", directions)
    if image.ndim not in (2, 3) or 0 in image.shape[:2]:
        raise ValueError(f"`image` must have shape [H, W] or [H, W, colour]; got {list(image.shape)}.")
    check_texels(texels)
    if texels == "samples" and image.shape[1] % 2:
        raise ValueError(f"`image` must have an even width, to be continued across the poles; got {list(image.shape)}.")
    return by_device(_sample, {"directions": w}, image, texels)


@functools.partial(jax.jit, static_argnums=2)
def _sample(batch: dict[str, Array], image: Array, texels: Texels) -> Array:
    w = normalize(batch["directions"])
    height, width = image.shape[:2]
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    sine2 = x * x + y * y
    at_pole = sine2 == 0
    sine = safe_sqrt(sine2)
    theta = jnp.where(at_pole, jnp.where(z < 0, np.pi, 0).astype(z.dtype), jnp.arctan2(sine, z))
    phi = jnp.arctan2(jnp.where(at_pole, 0, y), jnp.where(at_pole, 1, x))

    def texel(row: Array, column: Array) -> Array:
        beyond = (row < 0) | (row >= height)  # across a pole
        column = jnp.where(beyond, column + width // 2, column) % width
        value = image[jnp.clip(row, 0, height - 1), column].astype(w.dtype)
        return value if value.ndim > row.ndim else value[..., None]

    if texels == "cells":
        (row, v), (column, u) = _split(theta * (height / np.pi)), _split(phi * (width / (2 * np.pi)))
        value = texel(jnp.clip(row, 0, height - 1), column) + 0 * (u + v)[..., None]  # NaN of NaN
    else:
        (row, v), (column, u) = _split(theta * (height / np.pi) - 0.5), _split(phi * (width / (2 * np.pi)) - 0.5)
        u, v = u[..., None], v[..., None]
        upper = (1 - u) * texel(row, column) + u * texel(row, column + 1)
        lower = (1 - u) * texel(row + 1, column) + u * texel(row + 1, column + 1)
        value = (1 - v) * upper + v * lower
    return value if image.ndim == 3 else value[..., 0]


def _split(position: Float[Array, "*batch"]) -> tuple[Array, Array]:
    """Whole part and fraction."""
    whole = jnp.floor(position)
    return whole.astype(int), position - whole


def analyse(values: Float[Array, "rows columns *f"], rule: Rows, degree: int) -> Float[Array, "*f n"]:
    """Coefficients of functions on a grid: rows of the rule, columns at the azimuths 2 pi (i + 1/2) / columns."""
    rows, columns = values.shape[:2]
    tables = (
        _azimuth_table(columns, degree, values.dtype, rule == "cells"),
        _row_table(rule, rows, degree, values.dtype, columns),
        series_table(degree, values.dtype),
    )
    return _analyse(values, *tables, degree)


def synthesize(c: Float[Array, "*f n"], rule: Rows, rows: int, columns: int) -> Float[Array, "{rows} {columns} *f"]:
    """Values of expansions on a grid: the same rows and columns."""
    _, degree = _checks.coefficients("coefficients", c)
    tables = (
        _azimuth_table(columns, degree, c.dtype, False),
        _row_table(rule, rows, degree, c.dtype, None),
        series_table(degree, c.dtype),
    )
    return _synthesize(c, *tables, degree, rows, columns)


# The tables are arguments of the compiled functions, not constants in them.
@functools.partial(jax.jit, static_argnums=4)
def _analyse(values: Array, azimuth: Array, polar: Array, series: Array, degree: int) -> Float[Array, "*f n"]:
    rows, half, functions = values.shape[0], polar.shape[2], values.shape[2:]
    values = jnp.moveaxis(values.reshape(*values.shape[:2], -1), -1, 0)
    if jnp.iscomplexobj(azimuth):
        bins = jnp.fft.rfft(values)[..., : azimuth.size]
        bins = jnp.pad(bins, ((0, 0), (0, 0), (0, azimuth.size - bins.shape[-1]))) * azimuth.reshape(1, 1, -1)
        orders = jnp.stack([bins.real, -bins.imag], axis=-1)
    else:
        # As a plain matrix product: the same sum as an einsum is slower.
        orders = values.reshape(-1, values.shape[-1]) @ azimuth.reshape(values.shape[-1], -1)
        orders = orders.reshape(-1, rows, *azimuth.shape[1:])
    north, south = orders[:, :half], orders[:, rows - half :][:, ::-1]
    folded = jnp.stack([north + south, north - south]).reshape(2, -1, half, series.shape[2], 2, 2)  # even, odd in z
    even, odd = folded[..., 0, :], folded[..., 1, :]  # of the orders
    paired = jnp.stack([jnp.stack([even[0], odd[1]]), jnp.stack([even[1], odd[0]])])  # l + m even: even in z
    waves = jnp.einsum("pqjk,pqfjhr->pqhkfr", polar, paired)
    blocks = jnp.einsum("pqhik,pqhkfr->fpqhir", series, waves)
    blocks = blocks.reshape(blocks.shape[0], 8 * series.shape[2] ** 2)
    return blocks[:, _block_index(degree)].reshape(*functions, (degree + 1) ** 2)


@functools.partial(jax.jit, static_argnums=(4, 5, 6))
def _synthesize(
    c: Array, azimuth: Array, polar: Array, series: Array, degree: int, rows: int, columns: int
) -> Float[Array, "rows columns *f"]:
    n, functions = degree // 2 + 1, c.shape[:-1]
    c = c.reshape(-1, c.shape[-1])
    source = np.full(8 * n**2, c.shape[-1])
    source[_block_index(degree)] = np.arange(c.shape[-1])
    blocks = jnp.pad(c, ((0, 0), (0, 1)))[:, source].reshape(-1, 2, 2, n, n, 2)
    waves = jnp.einsum("pqhik,fpqhir->pqhkfr", series, blocks)
    paired = jnp.einsum("pqjk,pqhkfr->pqfjhr", polar, waves)
    even = jnp.stack([paired[0, 0], paired[1, 1]], axis=-2)  # in z, by the parity q of the order
    odd = jnp.stack([paired[1, 0], paired[0, 1]], axis=-2)
    orders = jnp.concatenate([even + odd, (even - odd)[:, : rows // 2][:, ::-1]], axis=1)
    orders = orders.reshape(-1, rows, 2 * n, 2)
    if not jnp.iscomplexobj(azimuth):
        values = orders.reshape(-1, 4 * n) @ azimuth.reshape(columns, -1).T
        return jnp.moveaxis(values.reshape(-1, rows, columns), 0, -1).reshape(rows, columns, *functions)
    halves = jnp.where(np.arange(2 * n) == 0, columns, columns / 2).astype(azimuth.dtype)
    bins = jax.lax.complex(orders[..., 0], -orders[..., 1]) * (halves * jnp.conj(azimuth)).reshape(1, 1, -1)
    values = jnp.fft.irfft(bins[..., : degree + 1], n=columns)
    return jnp.moveaxis(values, 0, -1).reshape(rows, columns, *functions)


@functools.cache
def _azimuth_table(columns: int, degree: int, dtype: DTypeLike, cells: bool) -> np.ndarray:
    """cos and sin(m phi) at the columns [c, m, r], times sqrt(2) for m > 0; or the phases [m] of a Fourier transform.

    Of `cells`, their means over the columns: sin(x) / x of the value in the middle, x = m times half a column.
    Few orders or few columns: a matrix product is faster than the transform.
    """
    m = np.arange(2 * (degree // 2 + 1))
    norms = np.where(m == 0, 1, np.sqrt(2)) * (np.sinc(m / columns) if cells else 1)
    if columns > max(256, 2 * degree) and degree > 32:
        return rounded(norms * np.exp(-1j * np.pi * m / columns), np.result_type(dtype, np.complex64))
    m_phi = np.outer(_quadrature.azimuths(columns), m)
    return rounded(norms[:, None] * np.stack([np.cos(m_phi), np.sin(m_phi)], axis=-1), dtype)


@functools.cache
def _row_table(rule: Rows, rows: int, degree: int, dtype: DTypeLike, columns: int | None) -> np.ndarray:
    """cos(k theta) for even orders and sin(k theta) for odd ones on the northern rows, as [p, q, j, k].

    With the number of columns, for analysis: the functionals f -> integral of f cos(k theta) sin(theta) d theta.
    """
    theta, weights = _quadrature.gauss_rows(rows) if rule == "gauss" else _quadrature.fejer_rows(rows)
    half = (rows + 1) // 2
    theta, k = theta[:half], np.arange(2 * (degree // 2 + 1))
    if columns is not None and rule != "gauss":
        table = (_cell_moments if rule == "cells" else _interpolated_moments)(theta, rows, k)
    else:
        k_theta = np.outer(theta, k)
        table = np.stack([np.cos(k_theta), np.sin(k_theta)])  # q j k
    if columns is not None:
        if rule == "gauss":
            table *= weights[:half, None]
        table *= 2 * np.pi / columns
        table[:, rows // 2 :] /= 2  # a row on the equator is its own mirror image and counts twice
    return rounded(np.stack([table[:, :, 0::2], table[:, :, 1::2]]), dtype)


def _cell_moments(theta: np.ndarray, rows: int, k: np.ndarray) -> np.ndarray:
    """Integrals of cos(k theta) sin(theta) and of sin(k theta) sin(theta) over each row, as [q, j, k].

    The products are sums of sin and of cos(n theta), n = k + 1 and k - 1, each of whose integrals is its value in the
    middle times 2 sin(n step / 2) / n: no recurrence in degree, so nothing grows, whatever the degree and the rows.
    """
    up, down = ((np.outer(theta, n), np.pi / rows * np.sinc(n / (2 * rows)) / 2) for n in (k + 1, k - 1))
    even = np.sin(up[0]) * up[1] - np.sin(down[0]) * down[1]
    return np.stack([even, np.cos(down[0]) * down[1] - np.cos(up[0]) * up[1]])


def _interpolated_moments(theta: np.ndarray, rows: int, k: np.ndarray) -> np.ndarray:
    """Moments of the trigonometric interpolant through the rows, with cos(k theta) and with sin(k theta), as [q, j, k].

    The interpolant is of degree `rows` - 1 in cosines or `rows` in sines. To integrate it, rather than to weight the
    rows by Fejér's rule, makes the analysis exact for every degree below the number of rows.
    """
    n = np.arange(rows + 1)
    ends = np.where((n == 0) | (n == rows), 1, 2) / rows
    n_theta = np.outer(theta, n)
    plus, minus = _cosine_moment(n[:, None] + k), _cosine_moment(n[:, None] - k)
    return np.stack([(np.cos(n_theta) * ends) @ (minus + plus) / 2, (np.sin(n_theta) * ends) @ (minus - plus) / 2])


def _cosine_moment(n: np.ndarray) -> np.ndarray:
    """Integral of cos(n theta) sin(theta) over [0, pi]: 2 / (1 - n^2) for even n, else 0."""
    even = n % 2 == 0
    return np.where(even, 2 / (1.0 - np.where(even, n, 0) ** 2), 0)


@functools.cache
def series_table(degree: int, dtype: DTypeLike) -> np.ndarray:
    """`_tables.polar_series` in blocks of equal parities [p, q, h, i, k]."""
    n = degree // 2 + 1
    series = np.zeros((2 * n,) * 3)
    series[: degree + 1, : degree + 1, : degree + 1] = _tables.polar_series(degree)  # m, k, l
    blocks = series.reshape(n, 2, n, 2, n, 2)  # h q k p i p
    return rounded(np.stack([blocks[:, :, :, p, :, p].transpose(1, 0, 3, 2) for p in (0, 1)]), dtype)


@functools.cache
def _block_index(degree: int) -> np.ndarray:
    """Where the block layout [p, q, h, i, r] keeps the coefficients of index l*(l+1)+m."""
    n = degree // 2 + 1
    l, m = _layout.bands(degree), _layout.orders(degree)
    place = (l % 2, np.abs(m) % 2, np.abs(m) // 2, l // 2, (m < 0).astype(int))
    return np.ravel_multi_index(place, (2, 2, n, n, 2)).astype(np.int32)  # int64 fails once traced in both precisions


def rounded(table: np.ndarray, dtype: DTypeLike) -> np.ndarray:
    """`table` in `dtype`, at an address that JAX on a CPU uses in place rather than copy at every call."""
    size = table.size * np.dtype(dtype).itemsize
    memory = np.empty(size + 64, np.uint8)
    start = -memory.ctypes.data % 64
    rounded = memory[start : start + size].view(dtype).reshape(table.shape)
    rounded[...] = table
    rounded.flags.writeable = False
    return rounded
