"""Weights on few of many axes, chosen greedily: in the spirit of the few zonal lobes of Nowrouzezahrai et al. 2012.

notation: M_l, lambda_l, c_l as in `_basis`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

from shisd import _checks
from shisd._sharding import whole
from shisd._typing import Array, ArrayLike, Float
from shisd.decomposition._basis import RotatedZonalBasis, by_band, minimum_norm, padding


def sparse_weights(
    basis: RotatedZonalBasis, coefficients: ArrayLike, count: int
) -> tuple[Float[Array, "*batch l K"], Array]:
    """Weights on only `count` axes of a basis, and which: greedy, each axis with all of its bands.

    Every step takes the axis that lowers the squared error most, all weights being free (orthogonal least squares).

    Arguments: `basis`; `coefficients` [..., (L+1)^2], which share the axes: use jax.vmap or jax.lax.map to choose for
    each; static `count`, 1 to K. Returns weights [..., L+1, K], zero on the other axes, and the axes' indices [count]
    in the order of choice.
    Derivatives: in coefficients and axes, the choice held fixed.
    Accuracy: the least squares fit on these axes, with a ridge of the rounding. Cost: count x K x L^2.
    """
    c, given = _checks.coefficients("coefficients", coefficients)
    if given != basis.degree:
        raise ValueError(f"`coefficients` must be of the basis' degree {basis.degree}; got degree {given}.")
    count = _checks.integer("count", count, 1)
    if count > basis.size:
        raise ValueError(f"`count` must be at most the {basis.size} axes of the basis; got {count}.")
    return _choose(basis, whole(c), count)


@eqx.filter_jit
def _choose(basis: RotatedZonalBasis, c: Float[Array, "*batch n"], count: int) -> tuple[Array, Array]:
    m = basis._matrices().astype(c.dtype)  # [L+1, 2L+1, K]
    target = by_band(c, basis.degree)  # [L+1, 2L+1, B]
    tolerance = float(jnp.finfo(c.dtype).eps) ** 0.5

    def choose(carry, _):
        # `left` are the axes' columns less their part along those chosen, so that each gain is exact
        left, rest = carry
        length2 = jnp.sum(left * left, axis=1)  # [L+1, K]
        fresh = length2 > tolerance
        match = jnp.einsum("lmk,lmb->lkb", left, rest, precision="highest")
        gain = jnp.sum(jnp.where(fresh, jnp.sum(match**2, axis=-1) / jnp.where(fresh, length2, 1), 0), axis=0)
        k = jnp.argmax(gain)
        q = left[:, :, k] * jnp.where(fresh[:, k], jax.lax.rsqrt(jnp.where(fresh, length2, 1)[:, k]), 0)[:, None]
        project = lambda a: a - q[:, :, None] * jnp.einsum("lm,lmk->lk", q, a, precision="highest")[:, None]
        return (project(left), project(rest)), k

    _, chosen = jax.lax.scan(choose, jax.lax.stop_gradient((m, target)), length=count)
    # Where a band has no more coefficients than axes, least norm: least squares there have no derivatives in the axes.
    columns = m[:, :, chosen]
    wide = min((count + 1) // 2, basis.degree + 1)
    mask = padding(basis.degree)[1][:wide]
    few, _ = minimum_norm(columns[:wide], target[:wide], mask, 4 * tolerance**2)  # which resolves any axes

    def solve(band):
        columns, right = band
        q, r = jnp.linalg.qr(jnp.concatenate([columns, tolerance * jnp.eye(count, dtype=c.dtype)]))
        return solve_triangular(r, jnp.matmul(q[: len(columns)].T, right, precision="highest"))

    if wide <= basis.degree:
        rest = jax.lax.map(solve, (columns[wide:], target[wide:]))  # one band after another: see `_basis`
        few = jnp.concatenate([few, rest])
    weights = jnp.zeros((basis.degree + 1, basis.size, target.shape[-1]), c.dtype).at[:, chosen].set(few)
    return jnp.moveaxis(weights, -1, 0).reshape(*c.shape[:-1], basis.degree + 1, basis.size), chosen
