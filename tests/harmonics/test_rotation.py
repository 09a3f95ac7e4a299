"""Rotation of expansions: as functions, as a group, and in its derivatives where angles would fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from shisd import harmonics
from tests.harmonics.test_sh import unit
from tests.truth import scipy_basis

TURNS = {
    "none": [0, 0, 0],
    "any": [0.3, -0.4, 0.7],
    "about the pole": [0, 0, 1.2],
    "pole to pole": [np.pi, 0, 0],
    "half turn, tilted": [2.0, 0.5, 0],
    "nearly none": [1e-6, 2e-6, 0],
}


@pytest.mark.parametrize("degree", [0, 1, 9, 30])
def test_rotated_function(degree, dtype, rng):
    """(R f)(w) = f(R^T w), with SciPy's basis on both sides."""
    c, d = rng.normal(size=(2, (degree + 1) ** 2)).astype(dtype), unit(rng.normal(size=(40, 3)))
    for turn in TURNS.values():
        r = Rotation.from_rotvec(turn).as_matrix().astype(dtype)
        got = harmonics.rotate(c, r)
        assert got.dtype == dtype
        expected = scipy_basis(d @ r.astype(float), degree) @ c.T.astype(float)
        error = np.max(np.abs(scipy_basis(d, degree) @ np.asarray(got, float).T - expected))
        assert error <= (1e-5 if dtype == np.float32 else 1e-13) * np.max(np.abs(expected))


def test_rotations_are_a_group(x64, rng):
    c = rng.normal(size=31**2)
    a, b = Rotation.random(2, random_state=3).as_matrix()
    np.testing.assert_allclose(harmonics.rotate(harmonics.rotate(c, b), a), harmonics.rotate(c, a @ b), atol=1e-12)
    np.testing.assert_allclose(harmonics.rotate(harmonics.rotate(c, a), a.T), c, atol=1e-12)
    energy = lambda x: [np.sum(np.asarray(x[l * l : (l + 1) ** 2]) ** 2) for l in range(31)]
    np.testing.assert_allclose(energy(harmonics.rotate(c, a)), energy(c), rtol=1e-12)


@pytest.mark.slow  # half a minute of compiling
def test_degree_100(x64, rng):
    c, r = rng.normal(size=101**2), Rotation.random(random_state=5).as_matrix()
    back = harmonics.rotate(harmonics.rotate(c, r), r.T)
    assert np.max(np.abs(back - c)) <= 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("turn", TURNS)
def test_derivatives(turn, x64, rng):
    """In the coefficients and along the group, to second order and mixed, also where the pole stays in place."""
    c, base = jnp.asarray(rng.normal(size=(2, 25))), jnp.asarray(Rotation.from_rotvec(TURNS[turn]).as_matrix())

    def rotated(c, w):
        x, y, z = w
        zero = jnp.zeros_like(x)
        skew = jnp.stack([jnp.stack(row) for row in [[zero, -z, y], [z, zero, -x], [-y, x, zero]]])
        turn = jnp.eye(3) + skew + skew @ skew / 2 + skew @ skew @ skew / 6  # the exponential, to second derivatives
        return harmonics.rotate(c, turn @ base)

    check_grads(jax.jit(rotated), (c, jnp.zeros(3)), order=2, atol=1e-4, rtol=1e-4, eps=1e-4)


def test_batches(rng):
    c, r = (
        rng.normal(size=(3, 16)).astype(np.float32),
        Rotation.random(4, random_state=1).as_matrix().astype(np.float32),
    )
    batched = jax.vmap(harmonics.rotate, (None, 0))(c, r)
    np.testing.assert_allclose(batched, np.stack([harmonics.rotate(c, q) for q in r]), atol=1e-6)


def test_what_is_not_a_rotation_is_refused(as_user):
    c = np.ones(9, np.float32)
    for matrix in (2 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)):
        with pytest.raises(Exception, match="`rotation` must be orthonormal with determinant"):
            harmonics.rotate(c, matrix.astype(np.float32))
    with pytest.raises(ValueError, match=r"`rotation` must have shape \[3, 3\]; got \[2, 2\]"):
        harmonics.rotate(c, np.eye(2, dtype=np.float32))
