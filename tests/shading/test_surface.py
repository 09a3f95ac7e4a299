"""What holds for all that shades: NaN stays NaN, masks, views on the horizon, and few sizes of compiled code."""

import functools
import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import models, shading
from shisd.shading import _tiles
from tests.hard_cases import unit
from tests.shading.slices import random_slices

COUNT = 4
SQUARE = np.array([[1, -1, 2], [-1, -1, 2], [-1, 1, 2], [1, 1, 2]], np.float32)  # emits downwards
FLOAT32 = np.dtype("float32")
sphere, upper = (functools.cache(functools.partial(random_slices, 1, FLOAT32, domain=d)) for d in ("sphere", "upper"))


@functools.cache
def both():
    return shading.Material(sphere(), upper())


@functools.cache
def brushed():
    c = np.array(sphere().coefficients)[:, None] * np.float32([1, 0.5, 0.8, 1.5])[None, :, None]
    return shading.Slices(c, isotropic=False)


def of(material, light=models.DistantLight):
    return lambda x, at, mask: shading.shade(material(), light(x), shading.Surface(**at, mask=mask))


def mirror(**options):
    def shade(x, at, mask):
        axes = 0.1 * jnp.stack([at["along_columns"], at["along_rows"]], axis=-1)
        footprint = shading.Footprint(at["directions"], axes)
        return shading.reflect(footprint, models.DistantLight(x), mask=mask, **options)

    return shade


@functools.cache
def matrix():
    blocks = tuple(jnp.asarray(np.ones((2 - m, 3 - m), np.float32)) for m in range(2))
    return shading.BrdfMatrix(blocks, jnp.zeros((), FLOAT32), 1, 2, True)


FRAMES, LOCAL = ("normals", "views"), ("positions", "normals", "views")
MIRROR = "directions", "along_columns", "along_rows"
HARMONICS = np.float32([1, 0.3, -0.2, 0.5])
SEEN = np.tile(HARMONICS, (COUNT, 1))


@functools.cache
def mesh():
    return models.Visibility(SEEN * np.float32([[1], [0.5], [2], [0.8]]), np.array([[0, 1, 2], [1, 2, 3]]))


def on_mesh(x, at, mask):
    places = {"triangles": jnp.where(mask, 1, -1), "barycentric": at["barycentric"]}
    light = models.Occluded(models.DistantLight(x), mesh())
    return shading.shade(sphere(), light, shading.Surface(at["normals"], at["views"], mask=mask, **places))


EACH = {  # what shades, its light, and which arrays of points it takes
    "environment": (of(sphere), HARMONICS, FRAMES),
    "brushed": (of(brushed), HARMONICS, (*FRAMES, "tangents")),
    "matrix": (of(matrix), HARMONICS, FRAMES),
    "zonal": (of(sphere, lambda x: models.ZonalLight(x, HARMONICS[:2])), HARMONICS[:3], FRAMES),
    "visibility": (of(sphere, lambda x: models.Occluded(models.DistantLight(x), SEEN)), HARMONICS, FRAMES),
    "mesh": (on_mesh, HARMONICS, (*FRAMES, "barycentric")),
    "sphere": (of(sphere, lambda x: models.SphereLight(x, 0.5)), np.float32([0.2, 0.3, 2]), LOCAL),
    "polygon": (of(upper, models.PolygonLight), SQUARE, LOCAL),
    "portal": (of(upper, lambda x: models.PortalLight(x, HARMONICS)), SQUARE, LOCAL),
    "several": (
        of(both, lambda x: [models.PolygonLight(x), models.DistantLight(HARMONICS), models.SphereLight(x[0], 0.5)]),
        SQUARE,
        LOCAL,
    ),
    "projected": (
        lambda x, at, mask: shading.project_light(models.PolygonLight(x), at["positions"], 1, mask=mask),
        SQUARE,
        LOCAL[:1],
    ),
    "mirror": (mirror(), HARMONICS, MIRROR),
    "anisotropic mirror": (mirror(anisotropic=True), HARMONICS, MIRROR),
}


def cases(*arrays):
    """The names of those that take these arrays of points.

    Slow: several lights, each of which is there alone, and portals, which share tiles and outlines with polygons.
    """
    mark = lambda name: pytest.mark.slow if name in ("several", "portal") else ()
    return [pytest.param(n, marks=mark(n)) for n, (_, _, points) in EACH.items() if {*arrays} <= {*points}]


@functools.cache
def compiled(name):
    """Values and gradients of their sum, by light and points."""
    function = EACH[name][0]
    for material in (sphere, upper, both, brushed, matrix, mesh):
        material()  # outside of the trace, for all to keep

    @jax.jit
    def value_and_gradients(light, points, mask):
        value, pull = jax.vjp(lambda light, points: function(light, points, mask), light, points)
        return value, pull(jnp.ones_like(value))

    return value_and_gradients


def shade(name, light, points, mask=None):
    mask = np.ones(COUNT, bool) if mask is None else mask
    value, (by_light, by_points) = compiled(name)(light, {k: points[k] for k in EACH[name][2]}, mask)
    return np.asarray(value).reshape(COUNT, -1), np.asarray(by_light), jax.tree.map(np.asarray, by_points)


def some_points(rng):
    points = {k: unit(rng.normal(size=(COUNT, 3))) for k in ("directions", "along_columns", "along_rows", "tangents")}
    points["normals"] = 2 * unit(0.3 * rng.normal(size=(COUNT, 3)) + [0, 0, 1])
    points["views"] = unit(points["normals"] + 0.8 * rng.normal(size=(COUNT, 3)))
    points["positions"] = 0.3 * rng.normal(size=(COUNT, 3))
    points["barycentric"] = rng.dirichlet(np.ones(3), size=COUNT)
    return {k: x.astype(np.float32) for k, x in points.items()}


@pytest.mark.parametrize("name", cases())
def test_nan_stays_nan(name, rng):
    """In value and in every gradient, of the points that have it or of all; a zero direction is one too."""
    light, points, names = EACH[name][1], some_points(rng), EACH[name][2]
    clean, by_light, _ = shade(name, light, points)
    assert np.all(np.isfinite(clean)) and np.all(clean != 0) and np.any(by_light != 0)
    for where in names:
        for bad in ([np.nan, 0, 1], [0, 0, 0]) if where in ("normals", "views", "directions") else ([0, 0, np.nan],):
            changed = points | {where: np.array(points[where])}
            changed[where][1] = bad
            value, by_light, by_points = shade(name, light, changed)
            assert np.all(np.isnan(value[1])), (where, bad)
            np.testing.assert_array_equal(np.delete(value, 1, axis=0), np.delete(clean, 1, axis=0))
            for other in names:
                assert np.all(np.isnan(by_points[other][1])), (where, bad, other)
                assert np.all(np.isfinite(np.delete(by_points[other], 1, axis=0)))
    broken = np.array(light)
    broken.flat[1] = np.nan
    value, by_light, by_points = shade(name, broken, points)
    assert np.all(np.isnan(value)) and np.all(np.isnan(by_light.flat[1]))
    for where in names:
        assert np.all(np.isnan(by_points[where])), where


@pytest.mark.parametrize("name", cases())
def test_masks(name, rng):
    """0 with gradient 0, whatever stands there; the rest, and gradients of the light, as without these points."""
    light, points, mask = EACH[name][1], some_points(rng), np.array([False, True, False, True])
    bad = {k: np.where(mask[:, None], x, np.float32([[np.nan], [0], [0], [0]])) for k, x in points.items()}
    other = {k: x[[1, 1, 3, 3]] for k, x in points.items()}  # those that are there, twice
    (value, by_light, by_points), (twice, by_light_twice, _) = shade(name, light, bad, mask), shade(name, light, other)
    np.testing.assert_array_equal(value[~mask], 0)
    np.testing.assert_allclose(value[mask], twice[[0, 2]], rtol=2e-6, atol=1e-7)
    np.testing.assert_allclose(2 * by_light, by_light_twice, atol=5e-6 * np.max(np.abs(by_light_twice)))
    for gradient in by_points.values():
        np.testing.assert_array_equal(gradient[~mask], 0)
        assert np.all(np.isfinite(gradient)) and np.any(gradient[mask] != 0)
    value, by_light, by_points = shade(name, light, {k: x * np.nan for k, x in points.items()}, mask & False)
    for x in (value, by_light, *by_points.values()):
        np.testing.assert_array_equal(x, 0)


@pytest.mark.parametrize("name", cases("views"))
def test_a_view_on_the_horizon_sees_nothing(name, rng):
    points = some_points(rng)
    points["normals"], points["tangents"] = np.float32([[0, 0, 2]] * COUNT), np.float32([[1, 0.5, 0]] * COUNT)
    points["views"] = np.float32([[1, 0, 0], [-0.6, 0.8, 0], [0, 1, -1e-6], [0, 1, 1e-3]])
    value = shade(name, EACH[name][1], points)[0]
    np.testing.assert_array_equal(value[:3], 0)
    assert np.all(value[3] != 0)


def test_a_tangent_along_the_normal_is_no_frame(rng):
    points = some_points(rng)
    n = unit(points["normals"].astype(float))
    across = unit(np.cross(n, [0.3, -0.5, 0.2]))
    points["tangents"] = (3 * (n + [[0], [1e-6], [1e-3], [1]] * across)).astype(np.float32)
    value, _, by_points = shade("brushed", EACH["brushed"][1], points)
    np.testing.assert_array_equal(np.isnan(value[:, 0]), [True, True, False, False])
    np.testing.assert_array_equal(np.isnan(by_points["tangents"][:, 0]), [True, True, False, False])


def test_a_new_number_of_points_compiles_nothing_heavy(caplog, rng):
    """Also where gradients are taken outside jit."""
    loss = lambda e, n, v: jnp.sum(shading.shade(sphere(), models.DistantLight(e), shading.Surface(n, v)))
    sphere()
    run = lambda count: jax.grad(loss)(HARMONICS, *np.float32(unit(rng.normal(size=(2, count, 3)))))
    names = lambda: [r.getMessage().split()[4] for r in caplog.records if "Finished XLA compilation" in r.getMessage()]
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        run(1000)
        assert sum("_shade" in name for name in names()) == 2
        caplog.clear()
        run(1001)
    assert not any("_shade" in name for name in names()), names()


def test_batches_are_filled_up_to_few_sizes():
    sizes = [_tiles._filled(n) for n in range(1 << 13)]
    assert all(n <= s for n, s in enumerate(sizes)) and len(set(sizes)) == 1 + 7 + 8 * 7
    assert max(s / n for n, s in enumerate(sizes[65:], 65)) < 9 / 8


def test_masks_are_named_where_they_are_wrong(as_user):
    n = np.ones((3, 3), np.float32)
    with pytest.raises(ValueError, match="`mask` must be bool"):
        shading.shade(sphere(), models.DistantLight(HARMONICS), shading.Surface(n, n, mask=np.ones(3)))
    with pytest.raises(ValueError, match="do not broadcast"):
        shading.shade(sphere(), models.DistantLight(HARMONICS), shading.Surface(n, n, mask=np.ones(2, bool)))
    with pytest.raises(ValueError, match="`mask` .* do not broadcast"):
        footprint = shading.Footprint(n, np.ones((3, 3, 2), np.float32))
        shading.reflect(footprint, models.DistantLight(HARMONICS), mask=np.ones(2, bool))


def test_indices_that_the_precision_cannot_hold_are_refused_also_inside_compiled_code(as_user):
    at = {"normals": [0, 0, 1.0], "views": [0, 0, 1.0], "barycentric": [1.0, 0, 0]}
    for wrap in (lambda f: f, jax.jit):
        kept = wrap(lambda: shading.Surface(**at, triangles=np.array([2**31 - 1])).triangles)()
        assert kept.dtype == np.int32 and kept == 2**31 - 1
        with pytest.raises(ValueError, match=r"^`triangles` must fit into int32; got up to 2147483648\."):
            wrap(lambda: shading.Surface(**at, triangles=np.array([2**31])).triangles)()
