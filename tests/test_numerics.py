import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd._numerics import arctan2

ERROR = {"float32": 3e-7, "float64": 3e-15}


def test_arctan2_has_the_angle_of_numpy(dtype):
    rng = np.random.default_rng(0)
    edges = [0.0, 1.0, np.tan(np.pi / 8), np.sqrt(0.5)]  # axes, diagonals, and where another series begins
    y, x = np.array([[a, b] for a in (*edges, *(-e for e in edges)) for b in (*edges, *(-e for e in edges))]).T
    y, x = (np.concatenate([a, rng.normal(size=500), rng.normal(size=500) * 1e-12]).astype(dtype) for a in (y, x))
    got = arctan2(jnp.asarray(y), jnp.asarray(x))
    truth = np.arctan2(y.astype(np.longdouble) + 0.0, x.astype(np.longdouble) + 0.0)
    assert got.dtype == dtype
    assert np.max(np.abs(np.asarray(got) - truth)) < ERROR[np.dtype(dtype).name]


@pytest.mark.parametrize("at", [(0.3, 0.3), (-0.2, 0.2), (0.0, 1.0), (1.0, 0.0), (0.7, -0.1), (-0.4, -0.9)])
def test_arctan2_has_the_derivatives_of_the_angle(at):
    """On diagonals and axes too, where the formula changes."""
    with jax.enable_x64(True):
        check_grads(jax.jit(arctan2), tuple(jnp.asarray(x, float) for x in at), 2, ["fwd", "rev"], eps=1e-4)
