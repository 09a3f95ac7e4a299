"""Settings of every test: shape checks on, both precisions by fixture, no silent promotion of types or ranks."""

import gc
import os
import platform

import jax
import jaxlib
import jaxtyping
import numpy as np
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Most of the time is compiling: without most optimisations, and by XLA's older code for fusions, it is a quarter; as
# one part, not 32 for threads, a tenth less again. The older code repeats sums of products with another rounding in
# other fusions, so it goes without instructions that have one. XLA reads its flags once, and ends the program at one
# that it does not know. Programs that tests start are as users run them, and so are all with SHISD_TESTS_AS_USERS=1.
_FLAGS = "--xla_cpu_use_fusion_emitters=false --xla_cpu_max_isa=AVX --xla_cpu_parallel_codegen_split_count=1"
if "SHISD_TESTS_AS_USERS" not in os.environ:
    jax.config.update("jax_disable_most_optimizations", True)
    if (0, 7) <= jaxlib.version.__version_info__[:2] <= (0, 10) and platform.machine() == "x86_64":
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XLA_FLAGS", f"{os.environ.get('XLA_FLAGS', '')} {_FLAGS}")
            jax.devices()

gc.disable()  # tracing makes very many objects that stay: collected after each file only, it is 5 % less time

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


def pytest_collection_finish():
    gc.freeze()  # what is imported by now stays


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_code():
    yield
    jax.clear_caches()
