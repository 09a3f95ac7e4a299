"""Rotated zonal harmonics, ISD15 section 5.1: weights <-> spherical harmonic coefficients, and evaluation.

notation: z_k = axes, lambda[l, k] = weights, c_l = coefficients of band l, pi_l = sqrt(4 pi / (2l+1)),
(M_l)[m, k] = pi_l y_l^m(z_k), so that c_l = M_l lambda_l (Eq. 10). The columns of M_l have unit length.

The paper inverts a square M_l per band and shares axes by taking the first 2l+1 for band l (`nested`). By default we
let all K >= 2L+1 axes serve every band and take the weights of least norm, lambda_l = M_l^+ c_l: lower bands are then
better conditioned, and the integrals that use the weights need every axis in every band anyway. Both are one
computation: QR of M_l^T, whose error grows with cond(M_l) (normal equations: its square), the columns that a band does
not use set to zero in M_l. All bands are padded to 2L+1 rows and stacked, so that one loop serves them.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

from shisd import _checks
from shisd._methods import method
from shisd._module import Module
from shisd._numerics import normalize, same_dtype
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Bool, Float
from shisd.decomposition._directions import check_count
from shisd.harmonics import sh_basis


class RotatedZonalBasis(Module):
    """The kernels y_l^0(w . z_k) of all bands l = 0 ... L about shared axes z_k (ISD15 Eq. 8 and 12).

    Arguments: `directions` [K, 3], K >= 2L+1 axes, of any length but zero: the field holds unit vectors. Static
    `degree` L. Static `nested`: band l uses only the first 2l+1 axes, as in ISD15's shader (its weights on the others
    are zero); the default uses all axes in every band, with weights of least norm.
    Refusals: too few axes or a wrong shape is a ValueError here. An axis that is zero or not finite is an error in
    every method, and axes that do not resolve a band (equal, opposite, all in a plane) are one in `weights`: their
    condition number, divided by at most 2l+1, exceeds eps^(-1/2), about 3e3 in float32 and 7e7 in float64.
    `condition_numbers` reports such sets. `decomposition.optimized_directions(degree)` are good axes.
    Derivatives: every method, in axes, coefficients, weights and directions, both modes and any order (condition
    numbers: first order).
    Source: ISD15 Eq. 8-12.
    """

    directions: Float[Array, "K 3"]
    degree: int = eqx.field(static=True)
    nested: bool = eqx.field(static=True)

    def __init__(self, directions: ArrayLike, degree: int, *, nested: bool = False):
        z, self.degree = _checks.vectors("directions", directions), _checks.degree(degree)
        check_count(z, self.degree)
        self.directions = normalize(z)
        self.nested = bool(nested)

    @property
    def size(self) -> int:
        """The number K of axes."""
        return self.directions.shape[0]

    @method
    def weights(self, coefficients: ArrayLike) -> Float[Array, "*batch {self.degree}+1 {self.size}"]:
        """Weights of the rotated zonal harmonics that add up to an expansion: lambda_l = M_l^+ c_l (ISD15 Eq. 11).

        Arguments: `coefficients` [..., (L+1)^2]. Returns [..., L+1, K], zeros where a nested band has no axis.
        Accuracy: `weights(coefficients(w))` returns w, if it is of least norm, within 10 eps times the condition number
        of its band for K up to 61 (measured 7), and 11 for K = 95 in float32, where sums over K are what rounds.
        Coefficients come back within 10 eps sqrt(K) times the norm of a band's weights.
        Cost: L+1 QR decompositions of K x (2L+1); batches of coefficients share them.
        """
        return by_device(_weights, {"coefficients": check_coefficients(coefficients, self.degree)}, self)

    @method
    def coefficients(self, weights: ArrayLike) -> Float[Array, "*batch n"]:
        """SH coefficients of a weighted sum, the inverse of `weights`: c_l = M_l lambda_l (ISD15 Eq. 10).

        Arguments: `weights` [..., L+1, K]. Returns [..., (L+1)^2]. A nested basis ignores the weights of axes that a
        band does not use, in `evaluate` too.
        """
        weights = check_weights(weights, self.degree, self.size, self.nested)
        weights, m = same_dtype(weights, self._matrices())
        c = jnp.einsum("lmk,...lk->...lm", m, weights, precision="highest")
        _, mask = padding(self.degree)
        return c[..., mask]

    @method
    def evaluate(self, weights: ArrayLike, directions: ArrayLike) -> Float[Array, "*batch"]:
        """The function value sum_l sum_k lambda[l, k] y_l^0(w . z_k) (ISD15 Eq. 12) by zonal sums.

        Arguments: `weights` [..., L+1, K] and `directions` w [..., 3], taken as unit vectors along them; their leading
        axes broadcast. Returns [...].
        Cost: directions x K x L, without a stored basis.
        Source: Clenshaw's summation of the recurrence DLMF 14.10.3.
        """
        weights = check_weights(weights, self.degree, self.size, self.nested)
        weights, axes = same_dtype(weights, unit_axes(self.directions))
        w, axes = same_dtype(normalize(_checks.vectors("directions", directions)), axes)
        x = jnp.einsum("...i,ki->...k", w, axes, precision="highest")
        shape = jnp.broadcast_shapes(x.shape, (*weights.shape[:-2], self.size))
        x = jnp.broadcast_to(x, shape)
        # sum_l a_l P_l(x) = b_0,  b_l = a_l + (2l+1)/(l+1) x b_{l+1} - (l+1)/(l+2) b_{l+2}
        b, after = jnp.zeros_like(x), jnp.zeros_like(x)
        for l in range(self.degree, -1, -1):
            a = jnp.broadcast_to(weights[..., l, :], shape) / _pi(self.degree)[l].item()
            b, after = a + (2 * l + 1) / (l + 1) * x * b - (l + 1) / (l + 2) * after, b
        return jnp.sum(b, axis=-1)

    @method
    def condition_numbers(self) -> Float[Array, " {self.degree}+1"]:
        """cond(M_l) of every band: the largest over the smallest of its 2l+1 singular values (ISD15 section 7.2).

        This bounds how much relative errors of coefficients grow in weights. It is 1 for band 0, and of the order of
        1/eps, or infinite, for a band that the axes do not resolve.
        """
        return _condition_numbers(self)

    def _matrices(self) -> Float[Array, "{self.degree}+1 2*{self.degree}+1 {self.size}"]:
        """M_l of all bands, stacked; zero in rows beyond the 2l+1 of a band and in columns of axes it does not use."""
        index, mask = padding(self.degree)
        y = jnp.swapaxes(sh_basis(unit_axes(self.directions), self.degree), 0, 1)
        m = jnp.where(mask.T[:, :, None], y[index.T], 0) * jnp.asarray(_pi(self.degree), dtype=y.dtype)[None, :, None]
        return jnp.swapaxes(used_only(m, self.nested), 0, 1)


@eqx.filter_jit
def _weights(batch: dict[str, Array], basis: RotatedZonalBasis) -> Float[Array, "*batch l k"]:
    weights, bad = weights_by_band(basis._matrices(), batch["coefficients"], basis.degree)
    return used_only(refused(weights, bad, unresolved(basis.degree)), basis.nested)


@eqx.filter_jit
def _condition_numbers(basis: RotatedZonalBasis) -> Float[Array, " l"]:
    s = jax.lax.map(lambda a: jnp.linalg.svd(a, compute_uv=False), basis._matrices())  # [L+1, 2L+1], falling
    bands = np.arange(basis.degree + 1)
    return s[:, 0] / s[bands, 2 * bands]


def weights_by_band(
    m: Float[Array, "bands n K"], c: Float[Array, "*batch coefs"], degree: int, ridge: float = 0.0
) -> tuple[Float[Array, "*batch bands K"], Bool[Array, " bands"]]:
    """Weights of least norm for matrices M_l, stacked and padded as `padding` says, and which bands are bad."""
    weights, bad = minimum_norm(m, by_band(c, degree), padding(degree)[1], ridge)
    return jnp.moveaxis(weights, -1, 0).reshape(*c.shape[:-1], *weights.shape[:-1]), bad


def by_band(c: Float[Array, "*batch coefs"], degree: int) -> Float[Array, "bands n columns"]:
    """Coefficients as columns, one band above another, padded as `padding` says."""
    index, mask = padding(degree)
    return jnp.moveaxis(jnp.where(mask, c.reshape(-1, c.shape[-1])[:, index], 0), 0, -1)


def minimum_norm(
    m: Float[Array, "bands n K"],
    c: Float[Array, "bands n batch"],
    mask: np.ndarray,
    ridge: float = 0.0,
) -> tuple[Float[Array, "bands K batch"], Bool[Array, " bands"]]:
    """x of least norm with m x = c in every band, for right-hand sides that are zero outside `mask` [bands, n].

    With `ridge`, x minimises |m x - c|^2 + ridge s |x|^2, s = the mean eigenvalue of m m^T. Bad are the bands whose
    condition number exceeds eps^(-1/2), eps the rounding of m. The result has the dtype that m and c promote to.

    notation: q r = (m^T, sqrt(ridge s) 1), q_1 = the rows of q beside m^T, x = q_1 r^-T c. Padding columns of m^T have
    a one in a row of their own, which keeps full rank, as derivatives of QR need, and leaves the columns in use alone.
    Normal equations would be faster, but their gradients in float32 are 10 to 1000 times less exact at condition
    numbers 40 to 400.
    """
    eps = float(jnp.finfo(m.dtype).eps)
    m, c = same_dtype(m, c)
    eye, used = np.eye(mask.shape[1]), np.broadcast_to(mask[:, None, :], (*mask.shape, mask.shape[1]))
    own_rows = jnp.asarray(np.where(used, 0, eye), m.dtype)
    if ridge:
        mean = jnp.sum(m * m, axis=(1, 2)) / jnp.asarray(mask.sum(axis=1), m.dtype)
        own_rows += jnp.sqrt(ridge * mean)[:, None, None] * jnp.asarray(np.where(used, eye, 0), m.dtype)
    stacked = jnp.concatenate([jnp.swapaxes(m, -1, -2), own_rows], axis=1)
    # One band after another: jaxlib's batched LAPACK calls wait for threads of the pool from inside the pool, and two
    # at once on two cores wait for ever (seen with jaxlib 0.10.2).
    q, r = jax.lax.map(lambda a: tuple(jnp.linalg.qr(a)), stacked)

    # With n = 2l+1 rows, cond_F / n <= cond_2 <= cond_F: no singular values are needed.
    r_inverse = jax.lax.map(lambda a: solve_triangular(a, jnp.eye(r.shape[-1], dtype=r.dtype)), r)
    norm = lambda a: jnp.sqrt(jnp.sum(jnp.where(mask[:, None, :] & mask[:, :, None], a * a, 0), axis=(1, 2)))
    condition = norm(r) * norm(r_inverse) / jnp.asarray(mask.sum(axis=1), dtype=r.dtype)
    bad = ~(jax.lax.stop_gradient(condition) <= eps**-0.5)
    solution = jax.lax.map(lambda a: solve_triangular(*a, trans="T"), (r, c))
    return jnp.matmul(q[:, : m.shape[-1]], solution, precision="highest"), bad


def refused(weights: Array, bad: Bool[Array, " bands"], messages: list[str]) -> Array:
    """`weights`, or the error of the first band that is bad."""
    check = lambda one: eqx.branched_error_if(one, jnp.any(bad), jnp.argmax(bad), messages)
    return _checks.held(weights, check)


def unresolved(degree: int) -> list[str]:
    """The messages of all bands."""
    return [
        f"The `directions` of the basis do not resolve degree {l}: its matrix is singular to working precision. Two "
        "axes may be equal or opposite (z and -z are one axis), or all may lie in a plane or on a cone. Use "
        "decomposition.optimized_directions(degree), add directions, or improve these with "
        "decomposition.optimize_directions."
        for l in range(degree + 1)
    ]


def unit_axes(directions: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Unit axes, also after an optimiser has moved the field of a basis."""
    z = normalize(directions)
    message = "`directions` of the basis has a vector that is zero or not finite. Pass unit axes."
    return _checks.require(z, jnp.isfinite(z), message)


def check_coefficients(coefficients: ArrayLike, degree: int) -> Float[Array, "*batch n"]:
    c, given = _checks.coefficients("coefficients", coefficients)
    if given != degree:
        raise ValueError(
            f"`coefficients` must be of the basis' degree {degree}, {(degree + 1) ** 2} numbers on the last axis; got "
            f"{list(c.shape)}, degree {given}. Truncate or pad with zeros."
        )
    return c


def check_weights(weights: ArrayLike, degree: int, size: int, nested: bool) -> Float[Array, "*batch l k"]:
    weights = _checks.real_array("weights", weights)
    if weights.shape[-2:] != (degree + 1, size):
        raise ValueError(
            f"`weights` must have shape [..., degree + 1, K] = [..., {degree + 1}, {size}]; got {list(weights.shape)}."
        )
    return used_only(weights, nested)


def used_only(values: Float[Array, "*batch l k"], nested: bool) -> Float[Array, "*batch l k"]:
    """Zero where band l of a nested basis does not use axis k, which is where k > 2l.

    Solves leave rounding there, and where M is ill conditioned there is a lot of it.
    """
    if not nested:
        return values
    used = np.arange(values.shape[-1]) <= 2 * np.arange(values.shape[-2])[:, None]
    return jnp.where(jnp.broadcast_to(used, values.shape), values, 0)


@functools.cache
def padding(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Where band l, padded to 2L+1 entries, finds its coefficients, and which entries are real: both [L+1, 2L+1]."""
    l, j = np.arange(degree + 1)[:, None], np.arange(2 * degree + 1)
    mask = j <= 2 * l
    return np.where(mask, l * l + j, 0).astype(np.int32), mask  # int32: one type of index, whether x64 is on or off


@functools.cache
def _pi(degree: int) -> np.ndarray:
    """pi_l = sqrt(4 pi / (2l+1)) of ISD15 Eq. 9."""
    return np.sqrt(4 * np.pi / (2 * np.arange(degree + 1) + 1))
