"""Isotropic decomposition with any mother kernels, ISD15 section 5.2: weights <-> coefficients, and filtering by Eq. 6.

notation: phi_l = mother kernel of level l, beta[l, n] = its zonal coefficients, z_lk = axes of level l, lambda[l, k] =
weights, i = (n, m) = index of a coefficient, pi_n = sqrt(4 pi / (2n+1)),

    M[i, (l, k)] = beta[l, n] pi_n y_n^m(z_lk)  (Eq. 17),   c = M lambda

Three choices differ from the paper. Kernels are scaled to unit norm, as zonal harmonics are: that alone divides the
condition number of Gaussians by 3 to 20. Every level may use all its axes, not only 2l+1 of them: with 2L+1 axes at
each level there are twice as many unknowns as coefficients, the weights of least norm are taken, and the condition
number of Gaussians at degree 20 falls from 2e4 to 70. And the axes of the levels need not lie on each other:
`directions` may hold a list per level, which is what kernels that live near their axis need (ISD15 section 7.2).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._methods import method
from shisd._module import Module
from shisd._numerics import normalize, safe_sqrt, same_dtype
from shisd._sharding import by_device
from shisd._status import Status, settled
from shisd._typing import Array, ArrayLike, Bool, Float, Scalar
from shisd.decomposition import _basis
from shisd.decomposition._directions import check_count
from shisd.decomposition._kernels import AbstractKernel
from shisd.harmonics import convolve, evaluate, sh_basis, synthesize_map
from shisd.harmonics.internal import sample_map


class Decomposition(NamedTuple):
    """What `IsotropicBasis.solve` returns."""

    weights: Float[Array, "*batch l k"]
    error: Float[Array, "*batch"]
    condition_number: Scalar
    status: Status


class IsotropicBasis(Module):
    """Kernels phi_l(w . z_lk) of all levels l = 0 ... L about given axes (ISD15 Eq. 5).

    Arguments: `kernel`, the mother kernels (`GaussianKernel()`, `FunctionKernel(f)`, ...), cut off above band L and
    scaled to unit norm unless `unit_norm=False`. `directions`: [K, 3], K >= 2L+1, axes that all levels share, or
    [L+1, K, 3], separate ones for each level, of any length but zero: `separate_directions(degree)` are good. For
    kernels that are not of one parity, z and -z are two axes. Static `degree` L. Static `nested`: level l uses only the
    first 2l+1 of its axes, as in the paper, and M is square.
    Refusals: wrong shapes are a ValueError here. At run time it is an error if all kernels vanish on a band, and, in
    `weights`, if the condition number, divided by at most (L+1)^2, exceeds eps^(-1/2), which a `ridge` cures.
    Derivatives: every method, in axes, kernel widths, coefficients, weights and rotations.
    Source: ISD15 Eq. 5-6 and 15-19.
    """

    kernel: AbstractKernel
    directions: Float[Array, "*levels K 3"]
    degree: int = eqx.field(static=True)
    nested: bool = eqx.field(static=True)
    unit_norm: bool = eqx.field(static=True)

    def __init__(
        self,
        kernel: AbstractKernel,
        directions: ArrayLike,
        degree: int,
        *,
        nested: bool = False,
        unit_norm: bool = True,
    ):
        if not isinstance(kernel, AbstractKernel):
            raise ValueError(
                f"`kernel` must be a kernel of shisd.decomposition; got {type(kernel).__name__}. Wrap a function "
                "phi(x, l) as FunctionKernel(phi)."
            )
        z, self.degree = _checks.vectors("directions", directions), _checks.degree(degree)
        if z.ndim == 3 and z.shape[0] != self.degree + 1:
            raise ValueError(
                f"`directions` must have shape [K, 3], or [degree + 1, K, 3] = [{self.degree + 1}, K, 3] for separate "
                f"axes at each level; got {list(z.shape)}."
            )
        check_count(z[0] if z.ndim == 3 else z, self.degree)
        self.kernel, self.directions = kernel, normalize(z)
        self.nested, self.unit_norm = bool(nested), bool(unit_norm)

    @property
    def size(self) -> int:
        """The number K of axes per level."""
        return self.directions.shape[-2]

    @method
    def zonal(self) -> Float[Array, "{self.degree}+1 {self.degree}+1"]:
        """Zonal coefficients beta[l, n] of the kernels, scaled as the basis uses them."""
        return _zonal(self)

    @method
    def matrix(self) -> Float[Array, "n {self.degree}+1 {self.size}"]:
        """M of ISD15 Eq. 17 as [(L+1)^2, L+1, K]; zero for axes that a nested level does not use."""
        return _matrix(self)

    @method
    def weights(self, coefficients: ArrayLike, *, ridge: float = 0.0) -> Float[Array, "*batch l k"]:
        """Weights of least norm whose kernels add up to an expansion.

        Arguments: `coefficients` [..., (L+1)^2]. Static `ridge` >= 0, in units of the mean eigenvalue of M M^T: with it
        the weights minimise |M w - c|^2 + ridge |w|^2. Returns [..., L+1, K].
        Accuracy: coefficients come back within 10 eps times the condition number, for every kernel here.
        Cost: one QR of [(L+1) K, (L+1)^2]; for `LegendreKernel` band by band.
        """
        c = _basis.check_coefficients(coefficients, self.degree)
        return by_device(_weights, {"coefficients": c}, self, _checks.number("ridge", ridge))

    @method
    def solve(self, coefficients: ArrayLike, *, ridge: float = 0.0, throw: bool = True) -> Decomposition:
        """`weights` with what is known about them.

        Returns (weights [..., L+1, K], error [...], condition_number, status): `error` is |M weights - c| / |c|, zero
        where c is; the condition number that of M, without ridge; the `shisd.Status` ok, or `ill_conditioned` where
        `weights` refuses, which is an error but with `throw=False`.
        """
        c = _basis.check_coefficients(coefficients, self.degree)
        weights, error, bad = by_device(_with_error, {"coefficients": c}, self, _checks.number("ridge", ridge))
        status = Status.where(jnp.any(bad), Status.ill_conditioned, Status.ok)
        return settled(Decomposition(weights, error, _condition_number(self), status), status, throw)

    @method
    def coefficients(self, weights: ArrayLike) -> Float[Array, "*batch n"]:
        """SH coefficients [..., (L+1)^2] of a weighted sum, c = M lambda, from `weights` [..., L+1, K]."""
        return _expand(self, _basis.check_weights(weights, self.degree, self.size, self.nested))

    @method
    def evaluate(self, weights: ArrayLike, directions: ArrayLike) -> Float[Array, "*batch"]:
        """Values of a weighted sum of the kernels, cut off above band L, at `directions` [..., 3] of any length.

        Arguments: `weights` [L+1, K]. Returns [...].
        """
        return evaluate(self.coefficients(weights), directions)

    @method
    def condition_number(self) -> Scalar:
        """The largest over the smallest of the (L+1)^2 singular values of M (ISD15 Fig. 13).

        Derivatives: first order.
        """
        return _condition_number(self)

    @method
    def filter(self, weights: ArrayLike, signal: ArrayLike, rotations: ArrayLike) -> Float[Array, "*batch_colour"]:
        """Integrals of a signal times a turned kernel, sum lambda[l, k] (f * phi_l)(R z_lk), on the fly (ISD15 Eq. 6).

        Arguments: `weights` [..., L+1, K] of the kernel and `rotations` R [..., 3, 3] that turn it into the frame of
        the signal; leading axes broadcast. `signal` [*colour, (L+1)^2], SH coefficients. Returns [..., *colour].
        Accuracy: exact up to rounding, 10 eps times the condition number (tests).
        Cost: for every rotation the harmonics at all axes; memory does not grow with the number of rotations.
        """
        signal = _basis.check_coefficients(signal, self.degree)
        batch, signal = self._rotated(weights, rotations, signal)
        return by_device(_filter, batch, self, signal)

    @method
    def prefilter(self, signal: ArrayLike, height: int) -> Float[Array, "levels h w *colour"]:
        """Maps of the signal convolved with each mother kernel, f * phi_l (ISD15 Eq. 6): what `filter_maps` looks up.

        Arguments: `signal` [*colour, (L+1)^2], SH coefficients; static `height`. Returns equirectangular maps
        [L+1, height, 2 height, *colour]. Lookups are linear between texels, so errors fall with 1/height^2.
        """
        return _prefilter(self, _basis.check_coefficients(signal, self.degree), _checks.integer("height", height, 1))

    @method
    def filter_maps(self, weights: ArrayLike, maps: ArrayLike, rotations: ArrayLike) -> Float[Array, "*batch_colour"]:
        """As `filter`, by lookups in the maps of `prefilter`."""
        texels = _checks.real_array("maps", maps)
        if texels.ndim not in (3, 4) or texels.shape[0] != self.degree + 1:
            raise ValueError(
                f"`maps` must come from `prefilter`, [{self.degree + 1}, H, 2 H, *colour]; got {list(texels.shape)}."
            )
        batch, texels = self._rotated(weights, rotations, texels)
        return by_device(_filter_maps, batch, self, texels)

    def _blocks(self, m: Float[Array, "n l k"]) -> Float[Array, "l rows k"]:
        """The blocks M_l of a kernel whose level l is band l, stacked and padded."""
        index, mask = _basis.padding(self.degree)
        levels = np.arange(self.degree + 1, dtype=np.int32)[:, None]
        return jnp.where(mask[:, :, None], m[index, levels], 0)

    def _solve(
        self, m: Float[Array, "n l k"], c: Float[Array, "*batch n"], ridge: float
    ) -> tuple[Float[Array, "*batch l k"], Bool[Array, " bad"]]:
        if self.kernel.diagonal:
            weights, bad = _basis.weights_by_band(self._blocks(m), c, self.degree, ridge)
            return _basis.used_only(weights, self.nested), bad
        n = m.shape[0]
        columns = c.reshape(-1, n).T
        weights, bad = _basis.minimum_norm(m.reshape(1, n, -1), columns[None], np.ones((1, n), bool), ridge)
        return _basis.used_only(weights[0].T.reshape(*c.shape[:-1], *m.shape[1:]), self.nested), bad

    def _condition(self, m: Float[Array, "n l k"]) -> Scalar:
        if not self.kernel.diagonal:
            s = jnp.linalg.svd(m.reshape(m.shape[0], -1), compute_uv=False)
            return s[0] / s[-1]
        s = jax.lax.map(lambda a: jnp.linalg.svd(a, compute_uv=False), self._blocks(m))  # [L+1, 2L+1], falling
        levels = np.arange(self.degree + 1, dtype=np.int32)
        return jnp.max(s[:, 0]) / jnp.min(s[levels, 2 * levels])

    def _filtered(self, signal: Float[Array, "*colour n"]) -> Float[Array, "levels *colour n"]:
        """Coefficients of f * phi_l."""
        levels = self.degree + 1
        return convolve(signal, self.zonal().reshape(levels, *(1,) * (signal.ndim - 1), levels))

    def _rotated(self, weights: ArrayLike, rotations: ArrayLike, signal: Array) -> tuple[dict[str, Array], Array]:
        """Checked weights and rotations as rows of one batch, and the signal, in one dtype."""
        weights = _basis.check_weights(weights, self.degree, self.size, self.nested)
        r = _checks.real_array("rotations", rotations)
        if r.shape[-2:] != (3, 3):
            raise ValueError(f"`rotations` must have shape [..., 3, 3]; got {list(r.shape)}.")
        try:
            np.broadcast_shapes(weights.shape[:-2], r.shape[:-2])
        except ValueError as error:
            raise ValueError(
                f"leading axes of `weights` {list(weights.shape)} and `rotations` {list(r.shape)} do not broadcast."
            ) from error
        dtype = jnp.result_type(weights, r, self.directions, signal)
        rows = {"weights": weights, "rotations": r}
        flat = lambda a: a.astype(dtype).reshape(*a.shape[:-2], a.shape[-2] * a.shape[-1])
        return {name: flat(a) for name, a in rows.items()}, signal.astype(dtype)


_SINGULAR = (
    "The kernels of the basis do not span all bands: M is singular to working precision. Axes may be shared between "
    "levels or lie on each other; take decomposition.separate_directions(degree), or a `ridge` above 0."
)


def _apply(m: Float[Array, "n l k"], weights: Float[Array, "*batch l k"]) -> Float[Array, "*batch n"]:
    m, weights = same_dtype(m, weights)
    return jnp.einsum("nlk,...lk->...n", m, weights, precision="highest")


@eqx.filter_jit
def _zonal(basis: IsotropicBasis) -> Float[Array, "levels bands"]:
    beta = basis.kernel.zonal(basis.degree, dtype=basis.directions.dtype)
    if basis.unit_norm:
        beta = beta / jnp.sqrt(jnp.sum(beta * beta, axis=1, keepdims=True))
    vanish = jnp.max(jnp.abs(beta), axis=0) <= 10 * float(jnp.finfo(beta.dtype).eps) * jnp.max(jnp.abs(beta))
    beta = eqx.error_if(beta, ~jnp.all(jnp.isfinite(beta)), "A level of the `kernel` is zero or not finite.")
    messages = [
        f"All levels of the `kernel` vanish on band {n}: nothing in that band can be represented. Take a kernel "
        "that is not even or odd, narrower ones, or zonal harmonics (LegendreKernel)."
        for n in range(basis.degree + 1)
    ]
    return eqx.branched_error_if(beta, jnp.any(vanish), jnp.argmax(vanish), messages)


@eqx.filter_jit
def _matrix(basis: IsotropicBasis) -> Float[Array, "n l k"]:
    y = sh_basis(_basis.unit_axes(basis.directions), basis.degree)  # [*levels, K, n]
    m = convolve(y, _zonal(basis)[:, None])  # a delta at the axis, convolved with the kernel
    return _basis.used_only(jnp.moveaxis(m, -1, 0), basis.nested)


@eqx.filter_jit
def _weights(batch: dict[str, Array], basis: IsotropicBasis, ridge: float) -> Float[Array, "*batch l k"]:
    weights, bad = basis._solve(_matrix(basis), batch["coefficients"], ridge)
    return _basis.refused(weights, bad, _basis.unresolved(basis.degree) if basis.kernel.diagonal else [_SINGULAR])


@eqx.filter_jit
def _with_error(batch: dict[str, Array], basis: IsotropicBasis, ridge: float) -> tuple[Array, Array, Array]:
    m, c = _matrix(basis), batch["coefficients"]
    weights, bad = basis._solve(m, c, ridge)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(c), axis=-1, keepdims=True))
    scale = jnp.where(largest > 0, largest, 1)  # squares of large and of small numbers leave the range
    norm = lambda a: safe_sqrt(jnp.sum((a / scale) ** 2, axis=-1))
    size = norm(c)
    error = norm(_apply(m, weights) - c) / jnp.where(size > 0, size, 1)
    return weights, error, jnp.broadcast_to(jnp.any(bad), error.shape)


@eqx.filter_jit
def _expand(basis: IsotropicBasis, weights: Float[Array, "*batch l k"]) -> Float[Array, "*batch n"]:
    return _apply(_matrix(basis), weights)


@eqx.filter_jit
def _condition_number(basis: IsotropicBasis) -> Scalar:
    return basis._condition(_matrix(basis))


@eqx.filter_jit
def _filter(batch: dict[str, Array], basis: IsotropicBasis, signal: Array) -> Float[Array, "*batch_colour"]:
    filtered = basis._filtered(signal)  # [L+1, *colour, n]

    def one(w: Float[Array, "l k"], z: Float[Array, "*levels k 3"]) -> Array:
        y = jnp.broadcast_to(sh_basis(z, basis.degree), (*w.shape, signal.shape[-1]))
        return jnp.einsum("lk,lkn,l...n->...", w, y, filtered)

    return _turned(one, batch, basis)


@eqx.filter_jit
def _prefilter(basis: IsotropicBasis, signal: Array, height: int) -> Float[Array, "levels h w *colour"]:
    return jnp.moveaxis(synthesize_map(basis._filtered(signal), height), 2, 0)


@eqx.filter_jit
def _filter_maps(batch: dict[str, Array], basis: IsotropicBasis, texels: Array) -> Float[Array, "*batch_colour"]:
    def one(w: Float[Array, "l k"], z: Float[Array, "*levels k 3"]) -> Array:
        z = jnp.broadcast_to(z, (*w.shape, 3))
        look_up = jax.vmap(lambda image, at: sample_map(image, at, texels="samples"))
        return jnp.einsum("lk,lk...->...", w, look_up(texels, z))

    return _turned(one, batch, basis)


def _turned(one: Callable[[Array, Array], Array], batch: dict[str, Array], basis: IsotropicBasis) -> Array:
    """one(weights, R z) for all rotations."""
    shape = np.broadcast_shapes(*(a.shape[:-1] for a in batch.values()))
    flat = {name: jnp.broadcast_to(a, (*shape, a.shape[-1])).reshape(-1, a.shape[-1]) for name, a in batch.items()}
    axes = _basis.unit_axes(basis.directions).astype(flat["weights"].dtype)

    def turned(row: dict[str, Array]) -> Array:
        z = jnp.einsum("ij,...j->...i", row["rotations"].reshape(3, 3), axes, precision="highest")
        return one(row["weights"].reshape(basis.degree + 1, basis.size), z)

    values = jax.lax.map(turned, flat)
    return values.reshape(*shape, *values.shape[1:])
