"""Batches sharded over devices: the same values as on one, each device its own points, one sum for shared gradients.

The number of devices is fixed when JAX starts, so each test is a program of its own, with four simulated devices.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
SCENE = """
import re
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import NamedSharding, PartitionSpec as P
from shisd import decomposition, domains, harmonics, models, shading

rng = np.random.default_rng(3)
unit = lambda *shape: (lambda x: (x / np.linalg.norm(x, axis=-1, keepdims=True)).astype(np.float32))(
    rng.normal(size=(*shape, 3)))
degree = 2
basis = decomposition.RotatedZonalBasis(decomposition.optimized_directions(degree), degree)
directions = basis.directions
weights = jnp.asarray(rng.normal(size=(3, 4, degree + 1, len(directions))), jnp.float32)
slices = shading.Slices.from_weights(basis, weights)
upper = shading.Slices.from_weights(basis, weights, domain="upper")
coefficients = jnp.asarray(rng.normal(size=(3, (degree + 1) ** 2)), jnp.float32)
light = models.DistantLight(coefficients)
corners = np.asarray([[1, -0.5, 0.2], [1, 0.5, 0.2], [1, 0, 1]], np.float32)
lamp = models.PolygonLight(corners, np.ones(3, np.float32))
mesh = jax.make_mesh((4,), ("points",), axis_types=(jax.sharding.AxisType.Explicit,))
grid = jax.make_mesh((2, 2), ("rows", "columns"), axis_types=(jax.sharding.AxisType.Explicit,) * 2)

def over(array, *axes, mesh=mesh):
    return jax.device_put(array, NamedSharding(mesh, P(*axes)))

def collectives(compiled):
    names = "all-gather", "all-reduce", "all-to-all", "collective-permute", "reduce-scatter"
    return {name: n for name in names if (n := len(re.findall(rf" {name}(?:-start)?\\(", compiled.as_text())))}

def shade(slices, light, *surface):
    return shading.shade(slices, light, shading.Surface(*surface))

def close(a, b):
    a, b = np.asarray(a), np.asarray(b)
    assert a.shape == b.shape and np.max(np.abs(a - b)) <= 3e-6 * np.max(np.abs(b)), np.max(np.abs(a - b))
"""


def program(code):
    flags = "--xla_force_host_platform_device_count=4"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error", "-c", SCENE + code]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_values_and_gradients_of_sharded_points_are_those_of_one_device():
    program("""
normals, views = unit(64), unit(64)
sharded = over(normals, "points"), over(views, "points")
forward = jax.jit(shade).lower(slices, light, *sharded).compile()
assert collectives(forward) == {}
radiance = forward(slices, light, *sharded)
assert radiance.sharding.spec[0] == "points" and len(radiance.addressable_shards) == 4

def loss(slices, light, normals, views):
    radiance = shade(slices, light, normals, views)
    return jnp.sum(radiance**2), radiance

gradient = jax.jit(jax.grad(loss, (0, 1, 2), has_aux=True))
expected, one = gradient(slices, light, normals, views)
close(radiance, one)
compiled = gradient.lower(slices, light, *sharded).compile()
assert collectives(compiled) == {"all-reduce": 1}, collectives(compiled)  # outside of the loop over tiles
jax.tree.map(close, compiled(slices, light, *sharded)[0], expected)
try:
    over(unit(65), "points")
except ValueError as error:
    assert "divide" in str(error)
else:
    raise AssertionError("65 points on 4 devices")
""")


@pytest.mark.slow
def test_values_and_gradients_under_polygons_are_those_of_one_device():
    program("""
positions, *points = np.float32(0.1) * unit(64), unit(64), unit(64)
points.append(positions)
sharded = [over(p, "points") for p in points]
forward = jax.jit(shade).lower(upper, lamp, *sharded).compile()
assert collectives(forward) == {}
close(forward(upper, lamp, *sharded), jax.jit(shade)(upper, lamp, *points))
loss = lambda slices, lamp, *points: jnp.sum(shade(slices, lamp, *points) ** 2)
gradient = jax.jit(jax.grad(loss, (0, 1, 2, 4)))
jax.tree.map(close, gradient(upper, lamp, *sharded), gradient(upper, lamp, *points))
""")


@pytest.mark.slow
def test_every_verb_takes_sharded_batches():
    program("""
normals, views = unit(8, 6), unit(8, 6)
both = dict(mesh=grid)
one = shade(slices, light, normals, views)
for n, v in [
    (over(normals, "rows", "columns", **both), over(views, "rows", None, **both)),
    (over(normals, ("rows", "columns"), **both), views),
    (over(normals, None, "columns", **both), over(views, None, "columns", **both)),
]:
    close(shade(slices, light, n, v), one)
n = over(normals, "rows", "columns", **both)
close(shade(slices, light, n, views[0, 0]), shade(slices, light, normals, views[0, 0]))
gradient = jax.jit(jax.grad(lambda light, n: jnp.sum(shade(slices, light, n, views) ** 2)))
of_sharded = gradient(light, over(normals, "rows", **both))
close(of_sharded.coefficients, gradient(light, normals).coefficients)  # an axis of the mesh without use
try:
    shade(slices, light, n, over(views, "columns", **both))
except ValueError as error:
    assert "sharded alike" in str(error) and "`views`" in str(error)
else:
    raise AssertionError("normals and views sharded differently")

d = over(normals, "rows", "columns", **both)
close(harmonics.sh_basis(d, 3), harmonics.sh_basis(normals, 3))
close(harmonics.evaluate(coefficients[:, None, None], d), harmonics.evaluate(coefficients[:, None, None], normals))
many = unit(1 << 18)
evaluate = jax.jit(harmonics.evaluate).lower(coefficients[:, None], over(many, "points")).compile()
assert collectives(evaluate) == {}
close(evaluate(coefficients[:, None], over(many, "points")), harmonics.evaluate(coefficients[:, None], many))

window = models.PortalLight(corners, coefficients)
p = over(normals, "rows", "columns", **both)
portal = lambda positions: shade(upper, window, normals, views, positions)
close(portal(p), portal(normals))
ball = models.SphereLight([0.2, 0.1, 3], 0.5)
several = [light, models.ZonalLight([0, 0.6, 0.8], [1, 0.5]), models.Occluded(light, coefficients[0]), ball, window]
mixed = lambda positions: shade(slices, several, normals, views, positions)
close(mixed(p), mixed(normals))
for basis in (2, domains.HaarBasis(1)):
    close(shading.project_light(lamp, p, basis), shading.project_light(lamp, normals, basis))

# in a shard_map of the caller's, whatever the axis type
automatic = jax.make_mesh((4,), ("points",), axis_types=(jax.sharding.AxisType.Auto,))
lit = lambda n, v: shade(slices, light, n, v)
close(jax.shard_map(lit, mesh=automatic, in_specs=P("points"), out_specs=P("points"))(normals, views), one)
""")
