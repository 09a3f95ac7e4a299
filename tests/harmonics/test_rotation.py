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


@pytest.mark.parametrize("degree", [1, 9, *(pytest.param(degree, marks=pytest.mark.slow) for degree in (0, 30))])
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
    c = rng.normal(size=10**2)
    a, b = Rotation.random(2, random_state=3).as_matrix()
    np.testing.assert_allclose(harmonics.rotate(harmonics.rotate(c, b), a), harmonics.rotate(c, a @ b), atol=1e-12)
    np.testing.assert_allclose(harmonics.rotate(harmonics.rotate(c, a), a.T), c, atol=1e-12)
    energy = lambda x: [np.sum(np.asarray(x[l * l : (l + 1) ** 2]) ** 2) for l in range(10)]
    np.testing.assert_allclose(energy(harmonics.rotate(c, a)), energy(c), rtol=1e-12)


@pytest.mark.slow
def test_degree_100(x64, rng):
    c, r = rng.normal(size=101**2), Rotation.random(random_state=5).as_matrix()
    turned = np.asarray(harmonics.rotate(c, r))
    assert np.max(np.abs(harmonics.rotate(turned, r.T) - c)) <= 1e-12
    d = unit(rng.normal(size=(10, 3)))
    expected = scipy_basis(d @ r, 100) @ c
    assert np.max(np.abs(scipy_basis(d, 100) @ turned - expected)) <= 1e-12 * np.max(np.abs(expected))


def test_high_degrees_are_no_longer_programs():
    """Bands go through together: a product for each would take a quarter of a minute to compile at degree 64."""
    r = np.eye(3, dtype=np.float32)
    lines = [
        len(jax.jit(harmonics.rotate).lower(np.ones((degree + 1) ** 2, np.float32), r).as_text().splitlines())
        for degree in (8, 64)
    ]
    assert lines[1] < 3 * lines[0], lines


def drifted(rng, size):
    """Rotations with errors of `size`, and the nearest rotations: U V^T of their singular value decomposition."""
    r = Rotation.random(3, random_state=4).as_matrix() + size * rng.uniform(-1, 1, (3, 3, 3))
    u, _, v = np.linalg.svd(r)
    return r, u @ v


def test_matrices_a_little_off_are_taken_as_the_nearest_rotation(dtype, rng):
    c = rng.normal(size=10**2).astype(dtype)
    drift = 1e-4 if dtype == np.float32 else 3e-4
    for off, exact in zip(*drifted(rng, drift), strict=True):
        got, expected = (np.asarray(harmonics.rotate(c, r.astype(dtype))) for r in (off, exact))
        assert np.max(np.abs(got - expected)) <= (1e-5 if dtype == np.float32 else 1e-13)
        np.testing.assert_allclose(np.linalg.norm(got), np.linalg.norm(c), rtol=1e-6)


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
