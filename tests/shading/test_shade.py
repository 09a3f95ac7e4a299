"""The one verb: several lights of any kinds, materials made ready, and errors where a path does not exist."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import models, shading
from tests.hard_cases import unit
from tests.marks import FLOAT32_FIRST
from tests.shading.slices import random_slices

DEGREE = 4
QUAD = np.array([[-1, -1, 3], [-1, 1, 3], [1, 1, 3], [1, -1, 3]])
N = (DEGREE + 1) ** 2


def lights_of(rng, dtype):
    """Of every kind, grey and RGB ones in turn."""
    number = lambda *shape: rng.normal(size=shape).astype(dtype)
    cast = lambda x: np.asarray(x, dtype)
    return {
        "grey map": models.DistantLight(number(N)),
        "map": models.DistantLight(number(3, N)),
        "sky": models.ZonalLight(number(3), number(DEGREE + 1)),
        "sun": models.ZonalLight(number(3), number(3, DEGREE + 3)),
        "occluded map": models.Occluded(models.DistantLight(number(3, N)), number(9)),
        "occluded sky": models.Occluded(models.ZonalLight(number(3), number(3)), number(5, 9)),
        "ball": models.SphereLight(cast([0, 1, 2]), cast(0.5), cast(2)),
        "red ball": models.SphereLight(cast([1, 1, 2]), cast(0.7), cast([3, 1, 0.5])),
        "quad": models.PolygonLight(cast(QUAD), cast([1, 2, 3])),
        "triangle": models.PolygonLight(cast(QUAD[:3] + [0.5, 0, 0]), cast(4)),
        "profiled": models.PolygonLight(cast(QUAD - [0.3, 0, 0]), cast(1), profile=number(4), two_sided=True),
        "window": models.PortalLight(cast(QUAD + [0, 0.4, 0]), number(3, 9)),
        "far ball": models.SphereLight(cast([0, -1, 3]), cast(0.5), cast(1)),
        "low map": models.DistantLight(number(3, 4)),
    }


def surface_of(rng, dtype):
    """One normal, five positions and views: batch axes broadcast."""
    views = unit(rng.normal(size=(5, 3)) + [0, 0, 3])
    return shading.Surface(*(x.astype(dtype) for x in (np.array([0.2, 0, 2]), views, 0.5 * rng.normal(size=(5, 3)))))


def bound(dtype):
    return 3e-6 if dtype == np.float32 else 1e-13


def close(got, expected):
    assert got.dtype == expected.dtype and got.shape == expected.shape
    np.testing.assert_allclose(got, expected, atol=bound(got.dtype) * np.max(np.abs(expected)))


FEW = ("grey map", "low map", "sun", "occluded map", "occluded sky", "ball", "quad", "profiled")


@FLOAT32_FIRST
@pytest.mark.parametrize("colour", [(), pytest.param((3,), marks=pytest.mark.slow)])
def test_lights_of_mixed_kinds_add_up(colour, dtype, rng):
    """A few of them on grey slices, all on RGB ones."""
    slices, lights, surface = random_slices(DEGREE, dtype, colour), lights_of(rng, dtype), surface_of(rng, dtype)
    lights = lights if colour else {name: lights[name] for name in FEW}
    shade = lambda *names: shading.shade(slices, [lights[name] for name in names], surface)
    single = {name: np.asarray(shading.shade(slices, light, surface)) for name, light in lights.items()}
    for name, value in single.items():
        assert value.dtype == dtype and value.shape == (5, *(colour or lights[name].colour))
        assert np.min(np.max(np.abs(value.reshape(5, -1)), axis=1)) > 1e-3, name  # they are lit
        assert np.array_equal(shade(name), value)
    close(shade(*lights), sum(v if v.ndim == 2 else v[:, None] for v in single.values()))
    grey = shade("grey map", "ball")
    assert lights["grey map"].colour == lights["ball"].colour == () and grey.shape == (5, *colour)
    close(grey, single["grey map"] + single["ball"])


def test_sequences_batches_and_jit(rng):
    slices, surface = random_slices(DEGREE, np.float32), surface_of(rng, np.float32)
    lights = tuple(lights_of(rng, np.float32)[name] for name in ("map", "sky", "ball"))
    expected = shading.shade(slices, list(lights), surface)
    close(shading.shade(slices, lights, surface), expected)
    close(jax.jit(shading.shade)(slices, lights, surface), expected)
    spread = [jnp.broadcast_to(x, (5, 3)) for x in (surface.normals, surface.views, surface.positions)]
    close(shading.shade(slices, lights, shading.Surface(*spread)), expected)
    close(jax.vmap(lambda *rows: shading.shade(slices, lights, shading.Surface(*rows)))(*spread), expected)
    _, views, positions = spread
    pairs = shading.shade(slices, lights, shading.Surface(surface.normals, views[:, None], positions))
    assert pairs.shape == (5, 5, 3)
    close(pairs[np.arange(5), np.arange(5)], expected)


def test_the_widest_precision_decides(x64, rng):
    single, double = np.dtype("float32"), np.dtype("float64")
    slices, surface = random_slices(DEGREE, single), surface_of(rng, single)
    lights = [lights_of(rng, single)["map"], lights_of(rng, double)["ball"]]
    with jax.numpy_dtype_promotion("standard"):
        assert shading.shade(slices, lights, surface).dtype == double
        assert shading.shade(slices, lights[:1], surface).dtype == single


BRDFS = {"isotropic": lambda: models.Ggx(0.6, [0.9, 0.5, 0.2]), "anisotropic": lambda: models.Ggx([0.5, 0.7], 0.3)}
OPTIONS = {"elevations": 8, "azimuths": 8}


@functools.cache
def made(kind, degree, **options):
    return shading.prepare(BRDFS[kind](), degree, **options, **OPTIONS)


def same(got, expected):
    assert (got.domain, got.isotropic, got.degree) == (expected.domain, expected.isotropic, expected.degree)
    np.testing.assert_array_equal(got.coefficients, expected.coefficients)


@pytest.mark.parametrize("kind", ["isotropic", pytest.param("anisotropic", marks=pytest.mark.slow)])
def test_a_prepared_material_has_the_slices_of_tabulate_brdf(kind):
    sphere = shading.tabulate_brdf(BRDFS[kind](), 3, **OPTIONS)
    upper = shading.tabulate_brdf(BRDFS[kind](), 3, domain="upper", **OPTIONS)
    equal, more, less = made(kind, 3), made(kind, 2, local_degree=3), made(kind, 3, local_degree=1)
    same(equal.distant, sphere)
    same(equal.local, upper)
    same(more.distant, sphere.cut(2))
    np.testing.assert_array_equal(more.distant.coefficients, sphere.coefficients[..., :9])
    same(more.local, upper)
    same(less.distant, sphere)
    same(less.local, sphere.cut(1).above_horizon())


def test_each_light_takes_its_form_of_the_material(rng):
    material = made("isotropic", 3, local_degree=2)
    lights, surface = lights_of(rng, np.float32), surface_of(rng, np.float32)
    for light in (lights[name] for name in ("map", "occluded map", "ball", "quad")):
        form = material.local if isinstance(light, models.PolygonLight | models.PortalLight) else material.distant
        np.testing.assert_array_equal(shading.shade(material, light, surface), shading.shade(form, light, surface))
    pair = [lights["map"], lights["quad"]]
    close(shading.shade(material, pair, surface), sum(shading.shade(material, light, surface) for light in pair))
    matrix = shading.project_brdf(BRDFS["isotropic"](), 2, view_degree=4, quadrature=48)
    mixed = shading.Material(matrix, material.local)  # a matrix for maps, slices for lamps
    expected = shading.shade(matrix, lights["map"], surface) + shading.shade(material, lights["quad"], surface)
    close(shading.shade(mixed, pair, surface), expected)


# ---- holes


def fails(message, *arguments):
    with pytest.raises(ValueError, match=rf"^{re.escape(message)}$"):
        shading.shade(*arguments)


def test_slices_above_the_horizon_are_for_local_light(as_user, rng):
    lights, surface = lights_of(rng, np.float32), surface_of(rng, np.float32)
    for upper in (random_slices(2, np.float32, domain="upper"), shading.Material(None, random_slices(2, np.float32))):
        for name in ("map", "sky", "occluded map", "ball"):
            fails(
                f"`material` was fitted above the horizon only, and a {type(lights[name]).__name__} shines on it from "
                "all around: pass shading.prepare(brdf, degree), or slices with domain='sphere'.",
                upper,
                [lights["quad"], lights[name]],
                surface,
            )
    distant = shading.Material(random_slices(2, np.float32))
    for name in ("quad", "window"):
        kind = type(lights[name]).__name__
        fails(
            f"`material` has no slices for a {kind}: pass shading.prepare(brdf, degree), or `slices()` of a matrix.",
            distant,
            lights[name],
            surface,
        )


def test_matrices_are_for_maps(as_user, rng):
    lights, surface = lights_of(rng, np.float32), surface_of(rng, np.float32)
    blocks = (np.ones((N, 1), np.float32),)
    matrix = shading.BrdfMatrix(blocks, np.zeros((), np.float32), DEGREE, 0, False)
    for name in ("sky", "occluded map", "ball"):
        kind = type(lights[name]).__name__
        fails(
            f"`material` is a BrdfMatrix, which goes with DistantLight only; for a {kind} pass its `slices()`.",
            matrix,
            lights[name],
            surface,
        )
    for name in ("quad", "window"):
        kind = type(lights[name]).__name__
        fails(
            f"`material` has no slices for a {kind}: pass shading.prepare(brdf, degree), or `slices()` of a matrix.",
            matrix,
            [lights["map"], lights[name]],
            surface,
        )
    fails(
        "`material` is a BrdfMatrix that was fitted above the horizon only: for polygons and portals pass its "
        "`slices()`, for other lights one with domain='sphere'.",
        shading.BrdfMatrix(blocks, np.zeros((), np.float32), DEGREE, 0, False, "upper"),
        lights["map"],
        surface,
    )


KINDS = "models.DistantLight, ZonalLight, Occluded, PolygonLight, PortalLight, SphereLight"


def test_what_is_no_light(as_user, rng):
    slices, lights, surface = random_slices(2, np.float32), lights_of(rng, np.float32), surface_of(rng, np.float32)
    e = np.ones((3, 9), np.float32)
    hint = "SH coefficients go into models.DistantLight."
    fails(f"`lights` must be one of {KINDS}; got ndarray. {hint}", slices, e, surface)
    fails(f"`lights` must be one of {KINDS}; got ArrayImpl. {hint}", slices, jnp.asarray(e), surface)
    fails(f"`lights` [1] must be one of {KINDS}; got ndarray. {hint}", slices, [lights["map"], e], surface)
    sky = models.Environment(np.ones((2, 4, 3), np.float32))
    hint = "Pass `light(degree)` of the map."
    fails(f"`lights` must be one of {KINDS}; got Environment. {hint}", slices, sky, surface)
    fails(f"`lights` [0] must be one of {KINDS}; got Environment. {hint}", slices, [sky, lights["map"]], surface)
    fails(f"`lights` must be one of {KINDS}; got NoneType.", slices, None, surface)
    fails("`lights` is empty: pass at least one light.", slices, [], surface)


def test_what_a_surface_lacks(as_user, rng):
    slices, lights, full = random_slices(2, np.float32), lights_of(rng, np.float32), surface_of(rng, np.float32)
    plain = shading.Surface(full.normals, full.views)
    for name in ("ball", "quad", "window"):
        fails("`surface` needs `positions` [..., 3]: a light is local.", slices, [lights["map"], lights[name]], plain)
    brushed = shading.Slices(np.zeros((4, 4, 9), np.float32), isotropic=False)
    for name in lights:
        fails("`surface` needs `tangents` [..., 3]: this material is anisotropic.", brushed, lights[name], full)
    corners = np.array([[0, 1, 2]])
    mesh = models.Visibility(np.ones((3, 4), np.float32), corners)
    fails(
        "`surface` needs `triangles` [...] and `barycentric` [..., 3]: `visibility` is that of a mesh.",
        slices,
        models.Occluded(lights["map"], mesh),
        full,
    )
    for wrong in (full.normals, (full.normals, full.views), None):
        came = type(wrong).__name__
        fails(f"`surface` must be a shading.Surface of normals and views; got {came}.", slices, lights["map"], wrong)


def test_what_is_no_material(as_user, rng):
    light, surface = lights_of(rng, np.float32)["map"], surface_of(rng, np.float32)
    sources = "shading.prepare, tabulate_brdf, transform_brdf or project_brdf, or be a Quadrature"
    where = f"`material` must come from {sources}; got"
    fails(f"{where} Lambertian. Make it ready by shading.prepare.", models.Lambertian(0.5), light, surface)
    fails(f"{where} ndarray.", np.ones((8, 9), np.float32), light, surface)


def test_colours_that_do_not_broadcast(as_user, rng):
    lights, surface = lights_of(rng, np.float32), surface_of(rng, np.float32)
    two = models.DistantLight(np.ones((2, 4), np.float32))
    fails(
        "colours of `material` [] and `light 0` [3] and `light 1` [2] do not broadcast.",
        random_slices(2, np.float32),
        [lights["red ball"], two],
        surface,
    )
    fails(
        "colours of `material` [3] and `light 0` [2] do not broadcast.",
        random_slices(2, np.float32, (3,)),
        two,
        surface,
    )


def test_materials_are_made_of_forms_that_fit(as_user):
    upper, sphere = (random_slices(2, np.float32, domain=domain) for domain in ("upper", "sphere"))
    for message, arguments in (
        ("a material needs `distant`, `local` or `lamps` slices; got none.", (None, None)),
        ("`distant` must be shading.Slices or BrdfMatrix; got int.", (1, None)),
        ("`distant` was fitted above the horizon only; make it with domain='sphere'.", (upper, sphere)),
        ("`local` must be shading.Slices or Quadrature; got int.", (sphere, 1)),
    ):
        with pytest.raises(ValueError, match=rf"^{re.escape(message)}$"):
            shading.Material(*arguments)
    with pytest.raises(ValueError, match=r"^`local_degree` must be >= 0; got -1\.$"):
        shading.prepare(models.Lambertian(0.5), 2, local_degree=-1)
