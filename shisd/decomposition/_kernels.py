"""Mother kernels phi_0 ... phi_L of an isotropic decomposition, one per level (ISD15 section 5.2).

notation: x = w.z, the cosine to the axis, t = 1 - x; beta[l, n] = <phi_l, y_n^0>, zonal coefficients (ISD15 Eq. 16).

    beta[l, n] = 2 pi sqrt((2n+1) / 4 pi) integral over x of phi_l(x) P_n(x)

Integrals are taken by Gauss-Legendre over the part of the sphere where the kernel lives, 0 <= t <= h, with Legendre
polynomials as functions of t, so that narrow kernels keep their digits in float32. For the Gaussian there is a closed
form, 2 exp(-k) i_n(k) with modified spherical Bessel functions i_n; its upward recurrence loses everything for n > k,
and the downward one needs sqrt(k) more terms than are wanted. Quadrature is as exact for every k at a fixed cost:
4e-14 and 1e-6 of the largest coefficient in float64 and float32, from k = 0 to 1e5, against 40 digits.

ISD15's Phong profile x^(4l) is taken on the hemisphere x > 0: on the whole sphere it is even, no level has an odd
band, and the decomposition does not exist.
"""

import abc
import math
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._module import Module
from shisd._typing import Array, ArrayLike, DTypeLike, Float, Scalar
from shisd.harmonics import legendre, zonal_basis
from shisd.harmonics.internal import gauss_rows, legendre_of_versine, zonal_norms


def _per_level(name: str) -> Callable[[ArrayLike | None], Array | None]:
    """A converter for a field with one width per level."""

    def convert(value: ArrayLike | None) -> Array | None:
        if value is None:
            return None
        array = _checks.real_array(name, value)
        if array.ndim != 1:
            raise ValueError(f"`{name}` must have shape [levels], one for each level; got {list(array.shape)}.")
        return array

    return convert


def _widths(
    widths: Array | None, degree: int, law: Callable[[int], float], dtype: DTypeLike
) -> Float[Array, " levels"]:
    """The widths of levels 0 ... `degree`, given or by a law."""
    if widths is None:
        return jnp.asarray([law(l) for l in range(degree + 1)], dtype)
    if len(widths) <= degree:
        raise ValueError(f"The kernel has widths for {len(widths)} levels; degree {degree} needs {degree + 1}.")
    widths = widths[: degree + 1].astype(dtype)
    good = (widths >= 0) & (widths < jnp.inf)
    return _checks.require(widths, good, "The widths of the kernel must be finite and not negative.")


class AbstractKernel(Module):
    """Isotropic functions of the cosine to their axis, one for each level l = 0, 1, 2, ...

    A kernel of your own: `FunctionKernel(function)`.
    """

    diagonal: ClassVar[bool] = False  # whether level l consists of band l alone

    @abc.abstractmethod
    def __call__(self, x: ArrayLike, level: int) -> Float[Array, "*batch"]:
        """phi_level(x) at cosines `x` [...] to the axis, in the dtype of `x`; static `level`."""

    @abc.abstractmethod
    def zonal(self, degree: int, *, dtype: DTypeLike = float) -> Float[Array, "{degree}+1 {degree}+1"]:
        """Zonal coefficients beta[l, n] of levels l = 0 ... L, up to band n = L (ISD15 Eq. 16). Static `degree` L.

        Derivatives: in the parameters of the kernel.
        """


class LegendreKernel(AbstractKernel):
    """phi_l = y_l^0, the zonal harmonics themselves: rotated zonal harmonics (ISD15 section 5.1). beta is one."""

    diagonal: ClassVar[bool] = True

    def __call__(self, x: ArrayLike, level: int) -> Float[Array, "*batch"]:
        return zonal_basis(x, level)[..., -1]

    def zonal(self, degree: int, *, dtype: DTypeLike = float) -> Float[Array, "{degree}+1 {degree}+1"]:
        return jnp.eye(_checks.degree(degree) + 1, dtype=dtype)


class _BellKernel(AbstractKernel):
    """What is made of exp(-sharpness[l] (1 - x))."""

    sharpness: Float[Array, " levels"] | None = eqx.field(converter=_per_level("sharpness"), default=None)

    def _sharpness(self, degree: int, dtype: DTypeLike) -> Float[Array, " levels"]:
        return _widths(self.sharpness, degree, lambda l: l**2, dtype)

    def _bell(self, x: Array, level: int) -> tuple[Array, Scalar]:
        """The Gaussian of a level, and its sharpness."""
        k = self._sharpness(_checks.integer("level", level), x.dtype)[-1]
        return jnp.exp(-k * (1 - x)), k


class GaussianKernel(_BellKernel):
    """Spherical Gaussians phi_l = exp(-sharpness[l] (1 - x)), by default with sharpness l^2 (ISD15 Eq. 19).

    Arguments: `sharpness` [levels] >= 0, or None for l^2. Positive everywhere, at most 1.
    """

    def __call__(self, x: ArrayLike, level: int) -> Float[Array, "*batch"]:
        x = _checks.real_array("x", x)
        return self._bell(x, level)[0]

    def zonal(self, degree: int, *, dtype: DTypeLike = float) -> Float[Array, "{degree}+1 {degree}+1"]:
        degree = _checks.degree(degree)
        return gaussian_zonal(self._sharpness(degree, dtype), degree)


class GaussLegendreKernel(_BellKernel):
    """phi_l = exp(-sharpness[l] (1 - x)) P_l(x), by default with sharpness l^2: zonal harmonics kept near their axis.

    Arguments: as `GaussianKernel`. Source: ISD15 section 7.2, "Gauss-Legendre".
    """

    def __call__(self, x: ArrayLike, level: int) -> Float[Array, "*batch"]:
        x = _checks.real_array("x", x)
        return self._bell(x, level)[0] * legendre(x, level)[..., -1]

    def zonal(self, degree: int, *, dtype: DTypeLike = float) -> Float[Array, "{degree}+1 {degree}+1"]:
        degree = _checks.degree(degree)
        k = self._sharpness(degree, dtype)
        t, p, weights = _near_axis(_extent(k), degree, degree + _NODES)
        levels = np.arange(degree + 1, dtype=np.int32)
        own = p[levels, :, levels] / jnp.asarray(zonal_norms(degree), k.dtype)[:, None]  # P_l at its own nodes
        return jnp.einsum("lq,lqn->ln", weights * jnp.exp(-k[:, None] * t) * own, p)


class PhongKernel(AbstractKernel):
    """phi_l = max(x, 0)^exponents[l], by default with exponent 4 l (ISD15 section 7.2).

    Arguments: `exponents` [levels] >= 0, or None for 4 l. An exponent of 0 stands for the constant 1.
    Source: zonal coefficients in closed form, by I_(n+2) = I_n (a - n) / (a + n + 3) for the integrals I_n of x^a P_n
    over [0, 1], from I_0 = 1 / (a+1) and I_1 = 1 / (a+2).
    """

    exponents: Float[Array, " levels"] | None = eqx.field(converter=_per_level("exponents"), default=None)

    def __call__(self, x: ArrayLike, level: int) -> Float[Array, "*batch"]:
        x = _checks.real_array("x", x)
        a = self._exponents(_checks.integer("level", level), x.dtype)[-1]
        above = jnp.where(x > 0, jnp.where(x > 0, x, 1) ** a, 0)
        return jnp.where(jnp.isnan(x), x, jnp.where(a == 0, 1, above))

    def zonal(self, degree: int, *, dtype: DTypeLike = float) -> Float[Array, "{degree}+1 {degree}+1"]:
        degree = _checks.degree(degree)
        a = self._exponents(degree, dtype)[:, None]
        n = np.arange(degree + 1)[None].astype(a.dtype)
        steps = jnp.where(n > 1, (a - n + 2) / (a + n + 1), 1 / (a + n + 1))  # from n - 2 to n
        even, odd = (jnp.cumprod(steps[:, i::2], axis=1) for i in (0, 1))
        integrals = jnp.zeros((degree + 1, degree + 1), a.dtype).at[:, 0::2].set(even).at[:, 1::2].set(odd)
        integrals = jnp.where(a == 0, jnp.where(n == 0, 2, 0).astype(a.dtype), integrals)
        return integrals * jnp.asarray(2 * np.pi * zonal_norms(degree), a.dtype)[None]

    def _exponents(self, degree: int, dtype: DTypeLike) -> Float[Array, " levels"]:
        return _widths(self.exponents, degree, lambda l: 4 * l, dtype)


class CapKernel(AbstractKernel):
    """Discs: phi_l = 1 within angles[l] of the axis, 0 beyond.

    Arguments: `angles` [levels] in rad, above 0 and at most pi, or None for 2.405 / (l + 1/2), where P_l has its first
    zero, at most pi. A filter with such a kernel is a mean over discs. Its values have no derivative in the angle; its
    coefficients do.
    """

    angles: Float[Array, " levels"] | None = eqx.field(converter=_per_level("angles"), default=None)

    def __call__(self, x: ArrayLike, level: int) -> Float[Array, "*batch"]:
        x = _checks.real_array("x", x)
        inside = (x >= jnp.cos(self._angles(_checks.integer("level", level), x.dtype)[-1])).astype(x.dtype)
        return jnp.where(jnp.isnan(x), x, inside)

    def zonal(self, degree: int, *, dtype: DTypeLike = float) -> Float[Array, "{degree}+1 {degree}+1"]:
        degree = _checks.degree(degree)
        extent = 2 * jnp.sin(self._angles(degree, dtype) / 2) ** 2
        _, p, weights = _near_axis(extent, degree, degree // 2 + 1)  # exact for polynomials
        return jnp.einsum("lq,lqn->ln", weights, p)

    def _angles(self, degree: int, dtype: DTypeLike) -> Float[Array, " levels"]:
        angles = _widths(self.angles, degree, lambda l: min(2.405 / (l + 0.5), np.pi), dtype)
        largest = np.pi * (1 + 2 * float(jnp.finfo(angles.dtype).eps))
        good = (angles > 0) & (angles <= largest)
        return _checks.require(angles, good, "`angles` must be above 0 and at most pi.")


class FunctionKernel(AbstractKernel):
    """phi_l(x) = function(x, l): any isotropic profiles, for cosines x [N] to their axis and a Python integer l.

    Arguments: `function`, pure and in JAX; whatever it closes over has gradients if it is a pytree (an `eqx.Module`
    with `__call__`, or a `jax.tree_util.Partial`). Static `quadrature`, the nodes over [-1, 1] for its coefficients, by
    default 256 + 2 degree. They are integrated again with three quarters of the nodes; where that changes one by more
    than 1e-3 of the largest of its level, as it does for profiles with jumps or narrower than the nodes, it is an error
    at run time.
    """

    function: Callable[[Array, int], Array]
    quadrature: int | None = eqx.field(static=True, default=None)

    def __call__(self, x: ArrayLike, level: int) -> Float[Array, "*batch"]:
        x = _checks.real_array("x", x)
        value = _checks.real_array("function(x, level)", self.function(x, _checks.integer("level", level)))
        if value.shape not in ((), x.shape):
            raise ValueError(f"`function` must map x {list(x.shape)} to as many values; got {list(value.shape)}.")
        return jnp.broadcast_to(value.astype(x.dtype), x.shape)

    def zonal(self, degree: int, *, dtype: DTypeLike = float) -> Float[Array, "{degree}+1 {degree}+1"]:
        degree = _checks.degree(degree)
        nodes = 256 + 2 * degree if self.quadrature is None else _checks.integer("quadrature", self.quadrature, 4)
        fine, coarse = (self._integrals(degree, count, dtype) for count in (nodes, 3 * nodes // 4))
        limit = 1e-3 * jnp.max(jnp.abs(fine), axis=1, keepdims=True)
        return _checks.require(
            fine,
            jnp.abs(fine - coarse) <= limit,
            f"The quadrature does not resolve `function` by {nodes} nodes: three quarters of them give other zonal "
            f"coefficients, or it is not finite. Pass `quadrature={2 * nodes}`, a smoother function, or CapKernel for "
            "discs.",
        )

    def _integrals(self, degree: int, nodes: int, dtype: DTypeLike) -> Float[Array, "{degree}+1 {degree}+1"]:
        t, p, weights = _near_axis(jnp.full(1, 2.0, dtype), degree, nodes)
        values = jnp.stack([self(1 - t[0], l) for l in range(degree + 1)])
        return (values * weights) @ p[0]


def gaussian_zonal(sharpness: Float[Array, "*batch"], degree: int) -> Float[Array, "*batch n"]:
    """Zonal coefficients [..., L+1] of exp(-sharpness (1 - x)), sharpness [...] >= 0.

    Accuracy: 4e-14 and 1e-6 of the largest, float64 and float32, to degree 64 and sharpness 1e5 (tests).
    Derivatives: in the sharpness, every order.
    """
    k = sharpness.reshape(-1)
    t, p, weights = _near_axis(_extent(k), degree, degree // 2 + _NODES)
    zonal = jnp.einsum("lq,lqn->ln", weights * jnp.exp(-k[:, None] * t), p)
    return zonal.reshape(*sharpness.shape, degree + 1)


_NODES = 32  # for exp(-t) over the part of its range that is above the rounding, beside half of the polynomial's degree


def _extent(sharpness: Float[Array, " k"]) -> Float[Array, " k"]:
    """h, beyond which exp(-sharpness t) is below the rounding."""
    negligible = -math.log(float(jnp.finfo(sharpness.dtype).eps)) + 2
    return jnp.minimum(2, negligible / jnp.maximum(sharpness, negligible / 2))


def _near_axis(h: Float[Array, " k"], degree: int, nodes: int) -> tuple[Array, Array, Array]:
    """Nodes t in [0, h] [k, q], P_n(1 - t) [k, q, n], and weights [k, q] whose sums are integrals over the sphere.

    The factors sqrt((2n+1) / 4 pi) of y_n^0 are in the second.
    """
    theta, gauss = gauss_rows(nodes)
    t = h[:, None] * jnp.asarray(np.sin(theta / 2) ** 2, h.dtype)[None]
    p = legendre_of_versine(t, degree) * jnp.asarray(zonal_norms(degree), h.dtype)[None, None]
    return t, p, h[:, None] * jnp.asarray(np.pi * gauss, h.dtype)[None]
