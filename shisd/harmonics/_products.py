"""Products of expansions.

Products are made where they are simple: on a grid that is fine enough for the result to be exact. The grid is a product
of rows and columns, so every step is a transform in one variable, and no basis is built over the points of the grid.

notation: g, f = expansions of degrees L_g, L; p_lm, T_m(phi) = polar and azimuthal factors of y_l^m.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Float
from shisd.harmonics import _layout, _quadrature, _tables, _transform


def multiply(a: ArrayLike, b: ArrayLike, degree: int) -> Float[Array, "*batch n"]:
    """Coefficients, up to `degree`, of the product of two expansions; exact, with no error of truncation or aliasing.

    Arguments: `a` [..., (La+1)^2] and `b` [..., (Lb+1)^2], of any two degrees, whose batch axes broadcast; static
    `degree`. Above La + Lb the product has no coefficients, and zeros are returned.
    Derivatives: linear in each argument.
    Accuracy: 1e-14 in float64 and 1e-6 in float32 of the product of the norms at degree 16.
    Cost: two syntheses and one analysis on (La + Lb + degree)^2 / 2 points.
    """
    (a, _), (b, _) = _checks.coefficients("a", a), _checks.coefficients("b", b)
    degree = _checks.degree(degree)
    dtype = jnp.promote_types(a.dtype, b.dtype)
    try:
        np.broadcast_shapes(a.shape[:-1], b.shape[:-1])
    except ValueError as error:
        raise ValueError(f"batch axes of `a` {list(a.shape)} and `b` {list(b.shape)} do not broadcast.") from error
    return by_device(_multiply, {"a": a.astype(dtype), "b": b.astype(dtype)}, degree)


def _multiply(batch: dict[str, Array], degree: int) -> Float[Array, "*batch n"]:
    a, b = batch["a"], batch["b"]
    top = _checks.degree_of(a.shape[-1]) + _checks.degree_of(b.shape[-1])
    kept, rank = min(degree, top), max(a.ndim, b.ndim) - 1
    rows, columns = _grid(top + kept)

    def on_grid(c: Array) -> Array:
        values = _transform.synthesize(c, "gauss", rows, columns)
        return values.reshape(rows, columns, *[1] * (rank + 1 - c.ndim), *c.shape[:-1])

    product = _transform.analyse(on_grid(a) * on_grid(b), "gauss", kept)
    return jnp.pad(product, (*((0, 0),) * rank, (0, (degree + 1) ** 2 - (kept + 1) ** 2)))


def product_matrix(
    coefficients: ArrayLike, degree: int, *, input_degree: int | None = None
) -> Float[Array, "n_out n_in"]:
    """The matrix of f -> (g f), from coefficients of f up to `input_degree` to those of the product up to `degree`.

    matrix[i, j] = integral over the sphere of y_i g y_j, the triple product of ISD15; exact. With `input_degree` Li,
    `degree` unless given, it is symmetric; with degree = Lg + Li nothing of the product is lost.

    Arguments: `coefficients` of g [(Lg+1)^2], of any degree (bands above L + Li have no effect); static `degree` L.
    Returns [(L+1)^2, (Li+1)^2].
    Derivatives: linear in `coefficients`.
    Cost: (L+1)^2 (Li+1)^2 times the number of rows, (Lg + L + Li) / 2 + 1; the integral over azimuth is done once for
    each row and pair of orders.
    """
    c, degree_g = _checks.coefficients("coefficients", coefficients)
    degree = _checks.degree(degree)
    inputs = degree if input_degree is None else _checks.integer("input_degree", input_degree)
    if c.ndim != 1:
        raise ValueError(f"`coefficients` must be one expansion; got {list(c.shape)}. Batch it with jax.vmap.")
    kept = min(degree_g, degree + inputs)
    rows, columns = _grid(kept + degree + inputs)
    g = _transform.synthesize(c[: (kept + 1) ** 2], "gauss", rows, columns)
    tables = (jnp.asarray(table, c.dtype) for table in _matrix_tables(degree, inputs, rows, columns))
    matrix = _product_matrix(g, *tables, degree, inputs)
    return matrix if inputs != degree else (matrix + matrix.T) / 2


@functools.partial(jax.jit, static_argnums=(5, 6))
def _product_matrix(
    g: Array, azimuth: Array, polar: Array, azimuth_in: Array, polar_in: Array, degree: int, inputs: int
) -> Float[Array, "n_out n_in"]:
    pairs = jnp.einsum("jc,cm,cn->jmn", g, azimuth, azimuth_in)  # integral of T_m g T_m' along row j
    columns = pairs[:, :, _index(_layout.orders(inputs) + inputs)] * polar_in.T[:, None, :]  # [row, m, column]
    matrix = jnp.einsum("mlj,jmn->mln", polar, columns)
    return matrix[_index(_layout.orders(degree) + degree), _index(_layout.bands(degree))]


@functools.cache
def _matrix_tables(degree: int, inputs: int, rows: int, columns: int) -> tuple[np.ndarray, ...]:
    """T_m at the columns [c, m] and p_lm at the rows, times texel areas, by order [m, l, j]; of the input by [n, j]."""
    theta, weights = _quadrature.gauss_rows(rows)

    def azimuth(degree: int) -> np.ndarray:
        m = np.arange(-degree, degree + 1)
        m_phi = np.outer(_quadrature.azimuths(columns), np.abs(m))
        return np.where(m < 0, np.sin(m_phi), np.cos(m_phi)) * np.where(m == 0, 1, np.sqrt(2))

    p = _tables.associated_legendre(theta, max(degree, inputs))
    areas = weights * (2 * np.pi / columns)
    polar = p[: degree + 1, np.abs(np.arange(-degree, degree + 1))].transpose(1, 0, 2) * areas
    return azimuth(degree), polar, azimuth(inputs), p[_layout.bands(inputs), np.abs(_layout.orders(inputs))]


def _index(table: np.ndarray) -> np.ndarray:
    return table.astype(np.int32)  # an int64 table that was traced without x64 fails in a trace with it


def _grid(degree: int) -> tuple[int, int]:
    """Rows and columns of the smallest product rule that is exact up to `degree`."""
    return degree // 2 + 1, degree + 1


def product_matrices(light: Float[Array, "*colour_n"], degree: int, input_degree: int) -> Float[Array, "*colour_n_m"]:
    """`product_matrix` of the light of every colour."""
    of_one = lambda c: product_matrix(c, degree, input_degree=input_degree)
    return of_one(light) if light.ndim == 1 else jax.vmap(of_one)(light)


def convolve(coefficients: ArrayLike, zonal: ArrayLike) -> Float[Array, "*batch n"]:
    """Coefficients of an expansion convolved with a zonal kernel over all rotations.

    result[l, m] = sqrt(4 pi / (2l + 1)) coefficients[l, m] zonal[l].

    Arguments: `coefficients` [..., (L+1)^2]; `zonal` [..., L+1], the coefficients of y_l^0 of the kernel about +z.
    Batch axes broadcast.
    Derivatives: linear in each argument.
    Source: ISD15 Eq. 13.
    """
    c, degree = _checks.coefficients("coefficients", coefficients)
    k = _checks.real_array("zonal", zonal)
    if k.ndim == 0 or k.shape[-1] != degree + 1:
        raise ValueError(f"`zonal` must have shape [..., {degree + 1}], one number for each band; got {list(k.shape)}.")
    dtype = jnp.promote_types(c.dtype, k.dtype)
    try:
        shape = np.broadcast_shapes(c.shape[:-1], k.shape[:-1])
    except ValueError as error:
        raise ValueError(
            f"batch axes of `coefficients` {list(c.shape)} and `zonal` {list(k.shape)} do not broadcast."
        ) from error
    factors = k.astype(dtype) / jnp.broadcast_to(jnp.asarray(_tables.zonal_norms(degree), dtype), k.shape)
    factors = jnp.broadcast_to(factors[..., _index(_layout.bands(degree))], (*shape, c.shape[-1]))
    return jnp.broadcast_to(c.astype(dtype), factors.shape) * factors
