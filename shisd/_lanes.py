"""Batches in vector lanes, as one kernel on a CPU: for functions of few operations on each of many points.

What is fast has points on the last axis. `jax.vmap` would put its batch on the first, where one point each is left for
the vectors; here it becomes more points. And XLA's CPU backend starts every fusion of a loop's body anew, of which each
takes longer than the arithmetic for some hundred points (jax 0.10.2: clipping a quad 0.37 us so, 0.05 in one kernel).
"""

import functools
import os
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from shisd._typing import Array

Result = TypeVar("Result")

LANES = 128  # points at a time
_TAG = {"xla_cpu_small_call": "true", "inlineable": "false"}


def in_lanes(function: Callable[..., Result], arrays: tuple[Array, ...], shared: tuple[Array, ...] = ()) -> Result:
    """function(*arrays, *shared) of arrays [..., p or 1], for every p apart; under `vmap` its batch goes along with p.

    So are results. `function` takes any mixture of p and 1, for a batch of some arrays makes a mixture of ones. It has
    no products of matrices and no sums over an axis, which the kernel does not allow. Where `shared` has a batch, and
    in derivatives of `function`, `vmap` does as it always does.
    """
    own = len(arrays)
    lanes = custom_vmap(lambda *inputs: _in_chunks(function, inputs[:own], inputs[own:]))

    @lanes.def_vmap
    def more_lanes(size: int, batched: list[bool], *inputs: Array) -> tuple[Result, Result]:
        everywhere = lambda result: (result, jax.tree.map(lambda _: True, result))
        if any(batched[own:]):
            return everywhere(jax.vmap(function, in_axes=tuple(0 if b else None for b in batched))(*inputs))
        count = max(a.shape[-1] for a in inputs[:own])

        def spread(a: Array, has_batch: bool) -> Array:
            if not has_batch and a.shape[-1] == 1:
                return a
            a = jnp.moveaxis(a, 0, -2) if has_batch else jnp.broadcast_to(a[..., None, :], (*a.shape[:-1], size, count))
            return jnp.broadcast_to(a, (*a.shape[:-1], count)).reshape(*a.shape[:-2], size * count)

        def gathered(a: Array) -> Array:
            a = jnp.broadcast_to(a, (*a.shape[:-1], size * count))
            return jnp.moveaxis(a.reshape(*a.shape[:-1], size, count), -2, 0)

        result = lanes(*(spread(a, b) for a, b in zip(inputs[:own], batched, strict=False)), *inputs[own:])
        return everywhere(jax.tree.map(gathered, result))

    call = jax.custom_jvp(lambda *inputs: lanes(*inputs))
    call.defjvp(lambda primals, tangents: jax.jvp(function, primals, tangents))
    return call(*arrays, *shared)


def _in_chunks(function: Callable[..., Result], arrays: tuple[Array, ...], shared: tuple[Array, ...]) -> Result:
    count = max(a.shape[-1] for a in arrays)
    if count <= LANES or not one_kernel():
        return function(*arrays, *shared)
    chunks = -(-count // LANES)

    def fill_up(a: Array) -> Array:
        more = chunks * LANES - count
        return a if a.shape[-1] == 1 or more == 0 else jnp.concatenate([a, *[a[..., -1:]] * more], axis=-1)

    def loop(result: Result, arrays: list[Array], shared: tuple[Array, ...]) -> Result:
        def chunk(i: Array, result: Result) -> Result:
            part = lambda a: a if a.shape[-1] == 1 else jax.lax.dynamic_slice_in_dim(a, i * LANES, LANES, -1)
            put = lambda all, own: jax.lax.dynamic_update_slice_in_dim(all, own, i * LANES, -1)
            return jax.tree.map(put, result, function(*map(part, arrays), *shared))

        return jax.lax.fori_loop(0, chunks, chunk, result)

    filled = [fill_up(a) for a in arrays]
    # the loop is all that is in the kernel: what is outside of loops may be split between threads, which fails in it
    result = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(function, *filled, *shared))
    return jax.tree.map(lambda a: a[..., :count], _tagged(jax.jit(loop)(result, filled, shared)))


_VECTOR = set(
    "abs acos add add_any and asin atan atan2 broadcast_in_dim cbrt ceil clamp concatenate convert_element_type copy "
    "cos cosh div eq erf exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg "
    "not or pow reduce_and reduce_max reduce_min reduce_or reduce_sum rem reshape round rsqrt select_n sign sin sinh "
    "slice sqrt square squeeze stack stop_gradient sub tan tanh transpose xor".split()
)
_CALLS = {"jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "checkpoint", "remat2"}


def kernel_takes(function: Callable, *inputs: object) -> bool:
    """Whether a function that others wrote can be part of `in_lanes`: arithmetic, and sums over short axes, as of xyz.

    What cannot fails where the whole program is compiled, too late to do without the kernel.
    """
    return one_kernel() and _is_vector_code(jax.make_jaxpr(function)(*inputs).jaxpr)


def inner_programs(equation: Any) -> list:
    """Of a call in a traced program."""
    return [getattr(x, "jaxpr", x) for x in equation.params.values() if hasattr(x, "jaxpr") or hasattr(x, "eqns")]


def _is_vector_code(jaxpr: Any) -> bool:
    for equation in jaxpr.eqns:
        inner = inner_programs(equation)
        if equation.primitive.name not in (_CALLS if inner else _VECTOR) or not all(map(_is_vector_code, inner)):
            return False
    return True


@functools.cache
def one_kernel() -> bool:
    """Whether the backend takes the tag, which no documentation promises: asked once, by a loop whose end is known.

    The environment variable SHISD_ONE_KERNEL=0 says no, should a version of XLA take it and fail.
    """
    if jax.default_backend() != "cpu" or os.environ.get("SHISD_ONE_KERNEL") == "0":
        return False
    add = jax.jit(lambda x: jax.lax.fori_loop(0, 5, lambda i, y: y + x, jnp.zeros_like(x)))
    try:
        with jax.ensure_compile_time_eval():
            found = jax.jit(lambda x: 2 * _tagged(add(x)))(jnp.arange(3, dtype=jnp.float32))
            return found.tolist() == [0, 10, 20]
    except Exception:  # of whatever kind a version of JAX refuses it with
        return False


def _tagged(result: Result) -> Result:
    """The result of a call of `jax.jit`, which becomes one kernel."""
    from jax.experimental.xla_metadata import set_xla_metadata  # not in every version

    return set_xla_metadata(result, **_TAG)  # type: ignore[return-value]  # as it takes a value
