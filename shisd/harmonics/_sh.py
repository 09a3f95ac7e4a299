"""Real spherical harmonics (placeholder formulation: rows of the recurrence, points last)."""

import jax.numpy as jnp
from jax.typing import ArrayLike

from shisd import _checks
from shisd._numerics import normalize
from shisd._typing import Array, Float
from shisd.harmonics import _tables


def sh_basis(directions: ArrayLike, degree: int) -> Float[Array, "*batch n"]:
    directions = normalize(_checks.vectors("directions", directions))
    degree = _checks.degree(degree)
    s, a, b = _tables.recurrence(degree)
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    out = {}
    c, q = jnp.ones_like(x), jnp.zeros_like(x)
    pmm = jnp.full_like(x, float(jnp.sqrt(1 / (4 * jnp.pi))))
    for m in range(degree + 1):
        if m:
            c, q = c * x - q * y, q * x + c * y
            pmm = float(s[m]) * pmm
        prev, cur = jnp.zeros_like(x), pmm
        for l in range(m, degree + 1):
            if l > m:
                prev, cur = cur, float(a[l, m]) * z * cur - float(b[l, m]) * prev
            if m == 0:
                out[l, 0] = cur
            else:
                out[l, m] = float(jnp.sqrt(2.0)) * cur * c
                out[l, -m] = float(jnp.sqrt(2.0)) * cur * q
    return jnp.stack([out[l, m] for l in range(degree + 1) for m in range(-l, l + 1)], axis=-1)


def evaluate(coefficients: ArrayLike, directions: ArrayLike) -> Float[Array, "*batch"]:
    c, degree = _checks.coefficients("coefficients", coefficients)
    return jnp.sum(c * sh_basis(directions, degree), axis=-1)
