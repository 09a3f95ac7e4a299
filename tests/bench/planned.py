"""What `planning.plan` chooses for one material under one light, beside what is chosen by hand.

For every tolerance from 10 % to 0.1 %, of all colours together; what was chosen at a larger one is left out, and so is
planning where that still holds. Where no path meets a tolerance, it is the nearest, and the last. Settings name the
tolerance, the path and its degree, or the order of points. `setup`: the seconds of planning, compiling included where
it is the first of its kind.
"""

import dataclasses
import time
import warnings

import jax
import jax.numpy as jnp

from shisd import planning
from tests.bench.harness import Method

TOLERANCES = (0.1, 0.03, 0.01, 0.003, 0.001)
MARGIN = 1.5
FAMILY, NAME = "shisd, planned", "it"
POINTS = 48  # of surfaces, from which local lights are judged


def methods(forward, brdf, light, positions=None, normals=None) -> list[Method]:
    """forward(plan, *inputs) shades the material `NAME` by a plan; of the same shapes it is compiled once."""
    few = {name: jnp.asarray(x[:POINTS]) for name, x in (("points", positions), ("normals", normals)) if x is not None}
    scene = planning.Scene({NAME: brdf}, {"light": light}, **few)
    found: dict[tuple[str, int], Method] = {}
    least = float("inf")
    for tolerance in TOLERANCES:
        if MARGIN * least <= tolerance:
            continue
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of tolerances that are not met
            made = planning.plan(scene, tolerance, max_degree=30, margin=MARGIN, pooled=True, throw=False)
        jax.block_until_ready(made)
        seconds = time.perf_counter() - start
        (entry,) = made.entries
        least = entry.error
        if (entry.path, entry.degree) not in found:
            setting = f"{tolerance:g}: {entry.path} {entry.degree}"
            plain = dataclasses.replace(made, entries=(), tolerance=1.0)  # what is predicted would be compiled in
            found[entry.path, entry.degree] = Method(FAMILY, setting, forward, plain, setup=seconds, ours=True)
        if not entry.met:
            break
    return list(found.values())
