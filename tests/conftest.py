"""Settings of every test: shape checks on, both precisions by fixture, no silent promotion of types or ranks."""

import jax
import jaxtyping
import numpy as np
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_disable_most_optimizations", True)  # most of the time is compiling

_HOOK = jaxtyping.install_import_hook("shisd", "beartype.beartype")  # before the package is imported anywhere


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """The precision of a test: float32 as users have it by default, float64 with x64 switched on for this test only."""
    with jax.enable_x64(request.param == "float64"):
        yield np.dtype(request.param)


@pytest.fixture
def x64():
    """Float64 for this test only."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def as_user():
    """The package as a user runs it, without the shape checks of the tests: errors must then be our own."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def rng():
    return np.random.default_rng(20150801)


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_code():
    yield
    jax.clear_caches()
