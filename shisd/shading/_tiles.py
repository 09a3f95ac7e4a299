"""Batches of surface points, one tile of them after another, in their frames.

What depends on the number of points is compiled again for every new one. So a batch is filled up to one of few sizes,
with copies of its last point, before it meets the code that takes long to compile.
"""

import functools
import math
from collections.abc import Callable, Iterable
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from shisd._numerics import normalize
from shisd._typing import Array, DTypeLike, Float
from shisd.shading._frames import frame, tangent_frame

Shape = tuple[int, ...]
Light = TypeVar("Light")
Pytree = TypeVar("Pytree")
_DIRECTIONS = ("normals", "views", "tangents")
_LANES = 64  # a tile is a multiple of this many points
_ELSEWHERE = np.array([0.3217, 0.2741, 0.9063])  # a point and a direction, in place of what is masked


@runtime_checkable
class Form(Protocol):
    """What is asked of a material, tabulated or as a matrix."""

    @property
    def isotropic(self) -> bool: ...
    @property
    def colour(self) -> Shape: ...


def as_type(tree: Pytree, dtype: DTypeLike) -> Pytree:
    """The same with all floating arrays in this dtype."""
    return jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def floating_type(tree: Any) -> jnp.dtype:
    """The dtype that all floating arrays of a pytree promote to."""
    dtypes = (x.dtype for x in jax.tree.leaves(tree))
    return jnp.result_type(*(dtype for dtype in dtypes if jnp.issubdtype(dtype, jnp.floating)))


def stacked(lights: Iterable[Light]) -> list[Light]:
    """Lights of one kind and of equal shapes as one, whose arrays have a first axis for them."""
    kinds: dict[Any, list[Light]] = {}
    for light in lights:
        leaves, kind = jax.tree.flatten(light)
        kinds.setdefault((kind, *(x.shape for x in leaves)), []).append(light)
    return [jax.tree.map(lambda *x: jnp.stack(x), *group) for group in kinds.values()]


def sum_parts(parts: Iterable[tuple[Array, Shape]]) -> Array:
    """Sum of radiances [*batch, *colour], each with its own colour axes; batch axes and colours broadcast."""
    parts = list(parts)
    most = max(len(colour) for _, colour in parts)
    fit = lambda x, c: x.reshape(*x.shape[: x.ndim - len(c)], *(1,) * (most - len(c)), *c)
    values = [fit(x, colour) for x, colour in parts]
    shape = np.broadcast_shapes(*(x.shape for x in values))
    return functools.reduce(jnp.add, (jnp.broadcast_to(x, shape) for x in values))


def padded(c: Float[Array, "*own n"], size: int, colour: Shape) -> Float[Array, "*colour size"]:
    """The first `size` coefficients, zero beyond those there are, of all colours."""
    c = c[..., :size]
    c = jnp.pad(c, [(0, 0)] * (c.ndim - 1) + [(0, size - c.shape[-1])])
    return jnp.broadcast_to(c, (*colour, size))


def sum_lights(radiance: Callable[[Any], Array], stacks: Iterable[Any], total: Array) -> Array:
    """`total` and radiance(light) of every light of stacks: the code of one light for each stack, in a loop.

    The backward pass makes each light again, within a tile that it makes again: what it would keep of all lights is
    never made.
    """
    add = jax.checkpoint(lambda x, light: (x + radiance(light), None), prevent_cse=False)
    for stack in stacks:
        if len(jax.tree.leaves(stack)[0]) == 1:
            total += radiance(jax.tree.map(lambda x: x[0], stack))
        else:
            total = jax.lax.scan(add, total, stack)[0]
    return total


def shade_points(points: dict[str, Array], shade: Callable[..., Array], *arguments: Any) -> Array:
    """`shade(points, *arguments)`, which takes flat points [p, k]; instead of p, the result has their batch axes.

    Points where the array "mask" is False are replaced before anything is done with them; there the result is 0.
    `shade` sees few values of p: powers of two up to 64, then eight to every doubling, at most an eighth too many.
    """
    shape = np.broadcast_shapes(*(a.shape[:-1] for a in points.values()))
    return _shaped(shade(_flat(points, shape), *arguments), points.get("mask"), shape)


@functools.partial(jax.jit, static_argnames="shape")
def _flat(points: dict[str, Array], shape: Shape) -> dict[str, Array]:
    flat = {name: jnp.broadcast_to(a, (*shape, a.shape[-1])).reshape(-1, a.shape[-1]) for name, a in points.items()}
    count = math.prod(shape)
    mask = flat.pop("mask", None)
    if mask is not None and count > 0:
        # a point that is there, so that lights, too, get no gradient but a finite one times zero
        first = jnp.argmax(mask[:, 0])
        other = {name: jnp.where(mask[first], a[first], _elsewhere(name, a)) for name, a in flat.items()}
        flat = {name: jnp.where(mask, a, jax.lax.stop_gradient(other[name])[None]) for name, a in flat.items()}
    more = _filled(count) - count
    return {name: jnp.concatenate([a, jnp.repeat(a[-1:], more, axis=0)]) for name, a in flat.items()}


def _elsewhere(name: str, a: Array) -> Array:
    """A row of an array of points, for batches in which all is masked."""
    row = np.roll(_ELSEWHERE, name == "tangents") if a.shape[1] == 3 else np.zeros(a.shape[1])
    return jnp.asarray(row, a.dtype)


def _filled(count: int) -> int:
    """The size that a batch is filled up to."""
    octave = 1 << max(count - 1, 0).bit_length()
    step = octave if octave <= _LANES else octave // 16
    return -(-count // step) * step


@functools.partial(jax.jit, static_argnames="shape")
def _shaped(values: Array, mask: Array | None, shape: Shape) -> Array:
    colour = values.shape[1:]
    values = values[: math.prod(shape)].reshape(*shape, *colour)
    if mask is None:
        return values
    return jnp.where(jnp.broadcast_to(mask[..., 0], shape).reshape(*shape, *(1,) * len(colour)), values, 0)


def shade_tiles(
    material: Form,
    points: dict[str, Array],
    colour: Shape,
    size: int,
    radiance: Callable[..., Float[Array, "*colour p"]],
    light: Any,
) -> Float[Array, " p *colour"]:
    """`radiance(frame, local, **others)` of all points, `size` at a time; 0 where no view is above the horizon.

    `frame` [p, 3, 3] is local to world, `local` [p, 3] is the view in it, and `others` are the `points` of the tile
    that are not directions. A point, material or `light` that is not finite gives NaN.
    """
    shared = finite_mark(material, light)

    def shade_tile(tile: dict[str, Array]) -> Float[Array, " p *colour"]:
        directions = {name: normalize(a) for name, a in tile.items() if name in _DIRECTIONS}
        others = {name: a for name, a in tile.items() if name not in _DIRECTIONS}
        normal = directions["normals"]
        r = frame(normal) if material.isotropic else tangent_frame(normal, directions["tangents"])
        local = jnp.einsum("pij,pi->pj", r, directions["views"])
        values = radiance(r, local, **others)
        seen = (local[:, 2] > 0).reshape(-1, *(1,) * len(colour))
        return finite_or_nan(jnp.where(seen, jnp.moveaxis(values, -1, 0), 0), [r, local, *others.values()], shared)

    return in_tiles(shade_tile, points, size)


def in_tiles(function: Callable[[dict[str, Array]], Array], rows: dict[str, Array], size: int) -> Array:
    """function(rows) for at most `size` rows at a time, all tiles alike; the backward pass makes each tile again."""
    count = len(next(iter(rows.values())))
    if count == 0:
        first = {name: jax.ShapeDtypeStruct((1, *a.shape[1:]), a.dtype) for name, a in rows.items()}
        one = jax.eval_shape(function, first)
        return jnp.zeros((0, *one.shape[1:]), one.dtype)
    tiles = -(-count // size)
    size = min(count, size, -(-count // (tiles * _LANES)) * _LANES)  # of equal size, for little to fill up
    more = tiles * size - count
    fill = lambda a: jnp.concatenate([a, jnp.repeat(a[-1:], more, axis=0)]).reshape(tiles, size, -1)
    values = jax.lax.map(jax.checkpoint(function), {name: fill(a) for name, a in rows.items()})
    return values.reshape(tiles * size, *values.shape[2:])[:count]


def finite_mark(*arrays: Any) -> Array:
    """A sum of all floating numbers in these pytrees that is finite where all are, of next to no size."""
    floating = [x for x in jax.tree.leaves(arrays) if jnp.issubdtype(x.dtype, jnp.floating)]
    return functools.reduce(jnp.add, [jnp.sum(x * jnp.finfo(x.dtype).tiny) for x in floating])


def finite_or_nan(values: Float[Array, "p ..."], own: Iterable[Array], shared: Array) -> Float[Array, "p ..."]:
    """`values`, but NaN, with NaN derivatives, where a point's `own` arrays [p, ...] or what all share is not finite.

    `shared` is a `finite_mark`. Comparisons, on which choices depend, take NaN for "no": without this NaN becomes dark.
    """
    mark = jax.vmap(lambda own: finite_mark(own))(list(own)) + shared
    none = jnp.where(jnp.isfinite(mark), 0, jnp.nan) * mark
    return values + none.reshape(-1, *(1,) * (values.ndim - 1))
