"""Batches sharded over devices: every device computes the part that it holds, and nothing is sent.

Which axes are sharded is read from the arrays' types, where JAX keeps it for explicit mesh axes (`jax.make_mesh` makes
these). Left to itself XLA gathers the whole batch on every device: it cannot tell that tiles need not cross the parts.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax.sharding import NamedSharding, PartitionSpec

from shisd._typing import Array


def by_device(function: Callable[..., Any], batch: dict[str, Array], *shared: Any) -> Any:
    """function(batch, *shared), on every device for its own part of the batch.

    The leading axes of the arrays [..., k] in `batch` broadcast, and are the leading axes of the result. `shared` is
    whole on every device; its gradient is one sum over the devices. `function` is static: no lambda or closure. It may
    return several arrays.
    """
    rank = max(a.ndim for a in batch.values()) - 1
    axes: list[Any] = [None] * rank
    mesh = None
    for a in batch.values():
        sharding = jax.typeof(a).sharding
        for i, axis in enumerate(sharding.spec[:-1], rank - a.ndim + 1):
            if axis is None:
                continue
            if axes[i] not in (None, axis):
                types = ", ".join(f"`{name}` {jax.typeof(a)}" for name, a in batch.items())
                raise ValueError(f"batch axes must be sharded alike; got {types}.")
            axes[i], mesh = axis, sharding.mesh
    if mesh is None:
        return function(batch, *shared)
    return _by_device(function, batch, shared, tuple(axes), mesh)


def whole(a: Array) -> Array:
    """A batch that is worked on together, whole on every device."""
    own = jax.typeof(a).sharding
    if all(axis is None for axis in own.spec):
        return a
    return jax.sharding.reshard(a, NamedSharding(own.mesh, PartitionSpec()))


@eqx.filter_jit
def _by_device(function: Callable[..., Any], batch: dict[str, Array], shared: Any, axes: tuple, mesh: Any) -> Any:
    def spec(a: Array) -> PartitionSpec:
        own = axes[len(axes) - a.ndim + 1 :]
        return PartitionSpec(*(axis if n > 1 else None for axis, n in zip(own, a.shape[:-1], strict=True)), None)

    specs = jax.tree.map(spec, batch)
    traced, static = eqx.partition(shared, eqx.is_array)
    place = lambda a, own: jax.sharding.reshard(a, NamedSharding(mesh, own))
    batch = jax.tree.map(place, batch, specs)
    traced = jax.tree.map(lambda a: place(a, PartitionSpec()), traced)
    local = lambda batch, traced: function(batch, *eqx.combine(traced, static))
    # Unchecked, the sum over devices in the gradient of what is shared is outside of `function`, not in its loops.
    mapped = jax.shard_map(
        local, mesh=mesh, in_specs=(specs, PartitionSpec()), out_specs=PartitionSpec(*axes), check_vma=False
    )
    return mapped(batch, traced)
