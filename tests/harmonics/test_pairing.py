"""s . (R c) against quadrature of both functions with SciPy's harmonics, and its derivatives where the pole stays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from shisd import harmonics
from shisd.harmonics import _pairing
from tests.truth import scipy_basis


def rotations(rng, count):
    special = [[0, 0, 0], [np.pi, 0, 0], [0, np.pi, 0], [0, 0, 1.0], [np.pi / 2, 0, 0], [0, 1e-4, 0]]
    return np.concatenate([Rotation.from_rotvec(special).as_matrix(), Rotation.random(count, rng).as_matrix()])


def in_order(s, degree):
    """s [colours, n, p] as `pair_many` takes it: rows of m >= 0, rows of m < 0."""
    plus, minus, _ = _pairing.rows(degree)
    s = jnp.pad(jnp.asarray(s), ((0, 0), (0, 1), (0, 0)))
    return tuple(jnp.swapaxes(s[:, index], 0, 1) for index in (plus, minus))


slow = lambda *values: pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.parametrize(("degree", "colours"), [(1, (3, 1)), (11, (1, 3)), slow(0, (1, 3)), slow(7, (3, 3))])
def test_products_with_turned_expansions(degree, colours, dtype, rng):
    r = rotations(rng, 10)
    s = rng.normal(size=(colours[0], (degree + 1) ** 2, len(r)))
    c = rng.normal(size=(colours[1], (degree + 1) ** 2))
    with jax.enable_x64(True):
        w, area = (np.asarray(x) for x in harmonics.sphere_rule(2 * degree, dtype=np.float64))
    expected = np.empty((max(colours), len(r)))
    for i, turn in enumerate(r):
        values = scipy_basis(w, degree) @ s[..., i].T, scipy_basis(w @ turn, degree) @ c.T  # (R c)(w) = c(R^T w)
        expected[:, i] = np.einsum("p,pf,pf->f", area, *np.broadcast_arrays(*values))
    x, y = in_order(s.astype(dtype), degree)
    pair = jax.jit(lambda x, y, c, r: _pairing.pair_many(x, y, _pairing.turned_series(c, degree), r, degree))
    got = pair(x, y, jnp.asarray(c, dtype), jnp.asarray(r, dtype))
    assert got.dtype == dtype
    scale = np.sqrt(np.sum(s**2, axis=1).max() * np.sum(c**2, axis=1).max())
    np.testing.assert_allclose(got, expected, atol=(1e-6 if dtype == "float32" else 1e-14) * scale * (degree + 1))


@pytest.mark.slow
@pytest.mark.parametrize("start", ["identity", "half turn", "anywhere"])
def test_derivatives_along_the_group(start, x64, rng):
    degree = 3
    r0 = {"identity": np.eye(3), "half turn": np.diag([1.0, -1, -1]), "anywhere": rotations(rng, 1)[-1]}[start]
    x, y = in_order(rng.normal(size=(1, (degree + 1) ** 2, 1)), degree)
    c = jnp.asarray(rng.normal(size=(2, (degree + 1) ** 2)))

    def turned(w):
        """R0 after the rotation vector w, by the exponential series: smooth at w = 0."""
        k = jnp.cross(jnp.eye(3), w[None])
        terms = [jnp.eye(3)]
        for i in range(1, 16):
            terms.append(terms[-1] @ k / i)
        return (sum(terms) @ r0)[None]

    series = lambda c: _pairing.turned_series(jnp.asarray(c), degree)
    value = jax.jit(lambda w, x, c: _pairing.pair_many(jnp.asarray(x), y, series(c), turned(w), degree))
    check_grads(value, (jnp.zeros(3), x, c), order=2, modes=["fwd", "rev"], atol=1e-5, rtol=1e-5)
