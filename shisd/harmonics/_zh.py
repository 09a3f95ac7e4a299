"""Zonal harmonics: Legendre series and the m = 0 functions y_l^0.

notation: P_l(x), x = cosine to the axis. Recurrence in degree, DLMF 14.10.3; y_l^0(x) = sqrt((2l+1)/4 pi) P_l(x).
"""

import jax.numpy as jnp
from jax.typing import ArrayLike

from shisd import _checks
from shisd._typing import Array, Float
from shisd.harmonics import _tables


def legendre(x: ArrayLike, degree: int) -> Float[Array, "*batch n"]:
    """Legendre polynomials P_0(x) ... P_L(x).

    Arguments: `x` [...], cosines in [-1, 1]; static `degree` L >= 0. Returns [..., L+1] in the dtype of `x`.
    Derivatives: in `x`, to every order, also at the ends, where P_l'(1) = l(l+1)/2.
    Source: DLMF 14.10.3.
    """
    x, degree = _checks.real_array("x", x), _checks.degree(degree)
    p = [jnp.ones_like(x), x]
    for l in range(2, degree + 1):
        p.append(((2 * l - 1) * x * p[l - 1] - (l - 1) * p[l - 2]) / l)
    return jnp.stack(p[: degree + 1], axis=-1)


def zonal_basis(x: ArrayLike, degree: int) -> Float[Array, "*batch n"]:
    """Zonal harmonics y_0^0 ... y_L^0 as functions of the cosine `x` to their axis: sqrt((2l+1)/4 pi) P_l(x).

    Arguments, result, derivatives: as `legendre`.
    """
    p = legendre(x, degree)
    return p * jnp.broadcast_to(jnp.asarray(_tables.zonal_norms(p.shape[-1] - 1), dtype=p.dtype), p.shape)
