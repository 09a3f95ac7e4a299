"""Batches in vector lanes: one kernel or plain code, by `vmap` or not, the values and derivatives are the same."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import _lanes
from shisd._lanes import LANES, in_lanes
from shisd.domains._polygon import loop_solid_angle
from shisd.domains.moments._fold import fold
from shisd.shading import _transformed_integrals
from tests.hard_cases import ring


@pytest.fixture(params=["one kernel", "plain"])
def kernel(request, monkeypatch):
    if request.param == "one kernel" and not _lanes.one_kernel():
        pytest.skip("this backend has no such kernels")
    monkeypatch.setattr(_lanes, "one_kernel", lambda: request.param == "one kernel")
    return request.param


def function(x, y, a):
    """Loops over rows of `a` [k, 3], with a choice; x [3, p], y [2, p] or [2, 1]: results [p] and [4, p]."""

    def step(total, row):
        more = row[0] * jnp.sin(x[0]) + row[1] * x[1] * y[0] + jnp.where(x[2] > 0, row[2], y[1])
        return total + more * total, None

    total = jax.lax.scan(step, 1 + 0 * x[0], a)[0]
    return total, jnp.concatenate([x * total[None], total[None]])


def expected(x, y, a):
    total = 1 + 0 * x[0]
    for row in a:
        total = total * (1 + row[0] * np.sin(x[0]) + row[1] * x[1] * y[0] + np.where(x[2] > 0, row[2], y[1]))
    return total, np.concatenate([x * total, total[None]])


def close(got, want, dtype):
    for g, w in zip(got, want, strict=True):
        assert g.dtype == dtype and g.shape == w.shape
        np.testing.assert_allclose(g, w, rtol=0, atol=(1e-6 if dtype == np.float32 else 1e-14) * np.max(np.abs(w)))


def inputs(rng, count, dtype, *batch):
    shapes = [(*batch, 3, count), (2, 1), (5, 3)]
    return [(0.5 * rng.normal(size=shape)).astype(dtype) for shape in shapes]


@pytest.mark.parametrize("count", [1, LANES, LANES + 1, 3 * LANES, 20_000])
def test_any_number_of_points(count, kernel, dtype, rng):
    x, y, a = inputs(rng, count, dtype)
    run = jax.jit(lambda x, y, a: in_lanes(function, (x, y), (a,)))
    close(run(x, y, a), expected(x, y, a), dtype)
    chosen = jax.jit(
        lambda x, y, a: jax.lax.cond(x[0, 0] > -9, lambda: in_lanes(function, (x, y), (a,)), lambda: function(x, y, a))
    )
    close(chosen(x, y, a), expected(x, y, a), dtype)


def test_batches_of_vmap_are_points(kernel, rng):
    x, y, a = inputs(rng, 3, np.float32, 70)
    run = lambda x, y, a: in_lanes(function, (x, y), (a,))
    want = [np.stack(w) for w in zip(*(expected(one, y, a) for one in x), strict=True)]
    close(jax.jit(jax.vmap(run, in_axes=(0, None, None)))(x, y, a), want, np.float32)
    close(
        jax.jit(jax.vmap(jax.vmap(run, (0, None, None)), (0, None, None)))(x.reshape(7, 10, 3, 3), y, a),
        [w.reshape(7, 10, *w.shape[1:]) for w in want],
        np.float32,
    )
    own = (0.5 * rng.normal(size=(70, 2, 1))).astype(np.float32)
    want = [np.stack(w) for w in zip(*(expected(x[0], y, a) for y in own), strict=True)]
    close(jax.jit(jax.vmap(run, in_axes=(None, 0, None)))(x[0], own, a), want, np.float32)
    rows = (0.5 * rng.normal(size=(70, 5, 3))).astype(np.float32)
    want = [np.stack(w) for w in zip(*(expected(x[0], y, a) for a in rows), strict=True)]
    close(jax.jit(jax.vmap(run, in_axes=(None, None, 0)))(x[0], y, rows), want, np.float32)


RNG = np.random.default_rng(3)
TURNS = np.linalg.qr(RNG.normal(size=(4, 3, 3)))[0].astype(np.float32)
LOOPS = (TURNS @ ring(range(5), 1.0).T.astype(np.float32))[..., None]
WEIGHTS, FORMS = (RNG.normal(size=(4, *shape, 1)).astype(np.float32) for shape in ((3, 4), (5,)))
maps = functools.partial(_transformed_integrals._mapped, even=False)


@pytest.mark.parametrize(
    ("run", "arguments"),
    [
        (lambda w, v: fold(w, jnp.asarray(TURNS[0]), v, 3), (WEIGHTS, LOOPS)),
        (lambda v, up: loop_solid_angle(v, 2 * np.pi, up), (LOOPS, TURNS[..., :1])),
        (lambda s, v: in_lanes(maps, (s, v)), (FORMS, LOOPS)),
    ],
    ids=["fold", "solid angle", "maps"],
)
def test_a_batch_of_one_array_of_one_point(run, arguments):
    for i in range(2):
        given = [jnp.asarray(a if n == i else a[0]) for n, a in enumerate(arguments)]
        got = jax.vmap(run, [0 if n == i else None for n in range(2)])(*given)
        want = [run(*(jnp.asarray(a[k if n == i else 0]) for n, a in enumerate(arguments))) for k in range(4)]
        for g, *w in zip(jax.tree.leaves(got), *map(jax.tree.leaves, want), strict=True):
            np.testing.assert_allclose(g, np.stack(w), rtol=2e-6, atol=1e-6)


def test_derivatives_by_both_modes_and_their_own(kernel, x64, rng):
    x, y, a = map(jnp.asarray, inputs(rng, 2 * LANES, np.float64))
    total = lambda run: lambda x, y, a: jnp.sum(run(x, y, a)[1] ** 2)
    lanes, plain = total(lambda x, y, a: in_lanes(function, (x, y), (a,))), total(function)
    for derive in (jax.grad, jax.jacfwd):
        got, want = (jax.jit(derive(f, argnums=(0, 1, 2)))(x, y, a) for f in (lanes, plain))
        close(got, want, np.float64)
    twice = lambda f: jax.jit(jax.grad(lambda y: jnp.sum(jax.grad(f, 1)(x, y, a) ** 2)))(y)
    np.testing.assert_allclose(twice(lanes), twice(plain), rtol=1e-12)


def test_a_backend_that_does_not_take_the_tag_goes_without(monkeypatch):
    ask = _lanes.one_kernel.__wrapped__
    assert isinstance(ask(), bool)
    jax.jit(lambda x: x + float(ask()))(1.0)  # while tracing too

    def refuse(result):
        raise NotImplementedError("unknown attribute")

    for tagged, usable in ((refuse, False), (lambda result: result + 1, False), (lambda result: result, True)):
        monkeypatch.setattr(_lanes, "_tagged", tagged)
        assert ask() is (usable and jax.default_backend() == "cpu")
    monkeypatch.setenv("SHISD_ONE_KERNEL", "0")
    assert ask() is False
    monkeypatch.delenv("SHISD_ONE_KERNEL")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert ask() is False
