"""Lights: which side of flat ones is lit, every field of lights and materials in the gradient, turning, errors."""

import functools
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import domains, harmonics, models, shading
from shisd.shading._shade import PATHS
from tests.hard_cases import unit
from tests.models.materials import BRDFS, array
from tests.shading.slices import cosine_slices, random_slices

# ---- the rule of sides

SLOTS = 6  # corners of every outline here, the last of them repeated, so that compiled code is shared
OUTLINES = {  # counter-clockwise seen from below, the side that is lit
    "triangle": [[0, 0, 1], [0, 1, 1], [1, 0, 1]],
    "square": [[-0.5, -0.5, 1], [-0.5, 0.5, 1], [0.5, 0.5, 1], [0.5, -0.5, 1]],
    "not convex": [[0, 0, 1], [0, 1, 1], [0.4, 1, 1], [0.4, 0.4, 1], [1, 0.4, 1], [1, 0, 1]],
    "not planar": [[-0.5, -0.5, 0.8], [-0.5, 0.5, 1.2], [0.5, 0.5, 0.8], [0.5, -0.5, 1.2]],
    "far away": [[300, 400, 501], [300, 401, 501], [301, 401, 501], [301, 400, 501]],
}
ORIGINS = np.array([[0.1, 0.2, 0.0], [0.3, -0.2, 0.5], [-1.5, 0.7, 0.2], [0.2, 0.1, -3.0]])  # below
CONSTANT = [np.sqrt(4 * np.pi)]  # a portal's light
LIGHTS = {
    "one-sided": lambda points: models.PolygonLight(points),
    "two-sided": lambda points: models.PolygonLight(points, two_sided=True),
    "portal": lambda points: models.PortalLight(points, jnp.asarray(CONSTANT, points.dtype)),
}


def corners(name):
    points = np.asarray(OUTLINES[name], float)
    return points[np.minimum(np.arange(SLOTS), len(points) - 1)]


def origins(name):
    return ORIGINS + ([300, 400, 500] if name == "far away" else [0, 0, 0])


def signed_solid_angle(points, origin):
    """Van Oosterom and Strackee 1983, a fan of triangles: negative on the lit side, for there outlines run clockwise
    about the sphere.
    """
    a, *rest = unit(np.asarray(points, float) - np.asarray(origin, float))
    total = 0.0
    for b, c in zip(rest[:-1], rest[1:], strict=True):
        total += 2 * np.arctan2(np.linalg.det([a, b, c]), 1 + a @ b + b @ c + c @ a)
    return total


@functools.partial(jax.jit, static_argnums=0)
def areas(kind, points, places):
    area = lambda o: domains.solid_angle(LIGHTS[kind](points).outline(o))
    return jax.vmap(area)(places)


@pytest.mark.parametrize("name", OUTLINES)
@pytest.mark.parametrize("kind", LIGHTS)
def test_outlines_are_positive_where_they_are_lit_and_nothing_behind(kind, name, dtype):
    points, below = corners(name), origins(name)
    centre = points.mean(axis=0)
    above = 2 * centre - below  # through the middle to the other side
    places = np.concatenate([below, above])
    exact = np.array([-signed_solid_angle(points, o) for o in places])
    assert np.all(exact[: len(below)] > 0) and np.all(exact[len(below) :] < 0)
    expected = np.abs(exact) if kind == "two-sided" else np.maximum(exact, 0)
    got = np.asarray(areas(kind, array(points, dtype), array(places, dtype)))
    assert got.dtype == dtype
    if name == "far away" and dtype == np.float32:  # what is passed is rounded to 3e-5 already
        np.testing.assert_allclose(got, expected, rtol=0, atol=3e-4)
    else:
        np.testing.assert_allclose(got, expected, rtol=0, atol=2e-6 if dtype == np.float32 else 2e-14)
    assert np.all(got[expected == 0] == 0) and np.all(got[expected > 0] > 0)


@pytest.mark.parametrize("kind", LIGHTS)
def test_outlines_are_nothing_in_their_plane(kind, dtype):
    places = array([[3, 4, 1], [-2, 0.3, 1], [0.1, 0.2, 1], [7, -5, 1]], dtype)  # beside it and on it
    assert np.all(np.asarray(areas(kind, array(corners("square"), dtype), places)) == 0)


@pytest.mark.parametrize("kind", LIGHTS)
def test_outlines_are_not_numbers_where_something_is_not(kind, dtype):
    vertices = jax.jit(lambda points, o: LIGHTS[kind](points).outline(o).vertices)
    for origin in ([0, 0, 0], [0, 0, 2]):
        assert np.isfinite(vertices(array(corners("square"), dtype), array(origin, dtype))).all()
        for slot, axis in ((0, 2), (2, 0)):
            points = corners("square")
            points[slot, axis] = np.nan
            assert np.isnan(vertices(array(points, dtype), array(origin, dtype))).any()
    assert np.isnan(vertices(array(corners("square"), dtype), array([0, np.nan, 0], dtype))).any()


def test_one_outline_is_as_in_a_batch(x64):
    points, places = array(corners("not convex"), np.float64), array(ORIGINS, np.float64)
    single = [domains.solid_angle(LIGHTS["one-sided"](points).outline(o)) for o in places]
    np.testing.assert_allclose(areas("one-sided", points, places), single, rtol=1e-14)


@pytest.mark.parametrize("name", OUTLINES)
@pytest.mark.parametrize("kind", LIGHTS)
def test_gradients_of_outlines_are_those_of_the_formula(kind, name, x64, rng):
    points, below = corners(name), origins(name)
    places = np.concatenate([below[:1], 2 * points.mean(axis=0) - below[:1]])
    moves = [rng.normal(size=a.shape) for a in (points, places)]
    moves[0][len(OUTLINES[name]) :] = moves[0][len(OUTLINES[name]) - 1]
    tangents = tuple(jnp.asarray(a) for a in moves)
    _, slope = jax.jvp(functools.partial(areas, kind), (jnp.asarray(points), jnp.asarray(places)), tangents)
    step, exact = 1e-5, []
    for i, lit in enumerate((True, kind == "two-sided")):
        ends = [abs(signed_solid_angle(points + t * moves[0], places[i] + t * moves[1][i])) for t in (step, -step)]
        exact.append((ends[0] - ends[1]) / (2 * step) * lit)
    np.testing.assert_allclose(slope, exact, rtol=2e-8, atol=1e-7 if name == "far away" else 2e-9)
    assert kind == "two-sided" or slope[1] == 0


@functools.partial(jax.jit, static_argnums=0)
def seen(kind, material, points, places, normals):
    light = LIGHTS[kind](points)
    if kind == "portal":  # radiance 1 + z / 2, so that it is not the path of constant light
        light = models.PortalLight(points, jnp.asarray([*CONSTANT, 0, 0.5 * np.sqrt(4 * np.pi / 3), 0], points.dtype))
    above = lambda o, n: domains.solid_angle(domains.clip_to_hemisphere(light.outline(o), n))
    return shading.shade(material, light, shading.Surface(normals, normals, places)), jax.vmap(above)(places, normals)


@pytest.mark.parametrize("kind", LIGHTS)
def test_a_white_surface_is_lit_exactly_where_the_outline_is_above_its_horizon(kind, x64, rng):
    material = cosine_slices(1, np.float64)
    for name in ("square", "not convex"):
        places = rng.uniform(-1.5, 1.5, (64, 3)) + [0, 0, 1]
        places[:8, 2] = 1  # in the plane
        normals = unit(rng.normal(size=(64, 3)))
        arrays = (jnp.asarray(a) for a in (corners(name), places, normals))
        radiance, area = (np.asarray(a) for a in seen(kind, material, *arrays))
        lit = area > 1e-9
        assert np.all(np.abs(area[~lit]) < 1e-13) and 8 <= np.sum(lit) <= 56
        assert np.all(radiance[lit] > 0) and np.all(np.abs(radiance[~lit]) < 1e-15)
        assert np.all(radiance[:8] == 0)


# ---- the gradient in every field

DEGREE, POINTS = 2, 4
EXEMPT = {".visibility.noise": "what the rays of a bake leave of error: told, not shaded with"}
STEP = 1e-5


@pytest.fixture
def surface(rng):
    """Points below QUAD and beside the ball, on a mesh of two triangles."""
    normals = unit(rng.normal(size=(POINTS, 3)) * 0.3 + [0, 0, 1])
    views = unit(rng.normal(size=(POINTS, 3)) * 0.4 + normals)
    return shading.Surface(
        *(jnp.asarray(a) for a in (normals, views, rng.uniform(-0.3, 0.3, (POINTS, 3)), [[1.0, 0.2, 0.1]])),
        triangles=jnp.asarray([0, 1, 1, 0]),
        barycentric=jnp.asarray(rng.dirichlet([2, 2, 2], POINTS)),
    )  # fmt: skip


def every_light(rng):
    """Lights of every kind, with each kind of visibility, and with and without a profile."""
    c = lambda *shape: jnp.asarray(rng.normal(size=shape))
    sky, zonal = models.DistantLight(c(3, 9)), models.ZonalLight(c(3), c(3))
    mesh = models.Visibility(c(4, 4), np.array([[0, 1, 2], [0, 2, 3]]), jnp.asarray([0.1, 0.2, 0.3, 0.4]))
    of_points = models.Visibility(c(POINTS, 4), np.zeros((0, 3), int), jnp.asarray(0.1))
    square = jnp.asarray(corners("square")[:4])
    return {
        "distant": sky,
        "zonal": zonal,
        "distant behind a mesh": models.Occluded(sky, mesh),
        "zonal behind what each point sees": models.Occluded(zonal, of_points),
        "zonal behind coefficients": models.Occluded(zonal, c(4)),
        "distant behind those of each point": models.Occluded(sky, c(POINTS, 4)),
        "ball": models.SphereLight(jnp.asarray([0.4, 0.3, 1.5]), jnp.asarray(0.3), jnp.asarray([1.0, 0.8, 0.5])),
        "polygon": models.PolygonLight(square, jnp.asarray([1.0, 0.8, 0.5])),
        "polygon with a profile": models.PolygonLight(square + 0.1, jnp.asarray([0.5, 0.8, 1.0]), profile=c(4)),
        "portal": models.PortalLight(square - 0.2, c(3, 4)),
    }


def check_fields(model, value_and_slope, rng):
    """value_and_slope(model, move), the slope along a move, against differences field by field; each has an effect."""
    leaves, tree = jax.tree_util.tree_flatten_with_path(model)
    nothing = [jnp.zeros_like(leaf) if eqx.is_inexact_array(leaf) else None for _, leaf in leaves]
    still = jax.tree.unflatten(tree, nothing)
    scale = abs(float(value_and_slope(model, still)[0]))
    for i, (path, field) in enumerate(leaves):
        if nothing[i] is None:
            continue
        name = jax.tree_util.keystr(path)
        change = jnp.asarray(rng.uniform(0.5, 1.5, field.shape) * np.where(field == 0, 0.05, np.abs(field)))
        move = jax.tree.unflatten(tree, [*nothing[:i], change, *nothing[i + 1 :]])
        exact = float(value_and_slope(model, move)[1])
        at = lambda t, i=i, new=field, change=change: eqx.tree_at(
            lambda m: jax.tree.leaves(m)[i], model, new + t * change
        )
        ends = [float(value_and_slope(at(t), still)[0]) for t in (STEP, -STEP)]
        numerical = (ends[0] - ends[1]) / (2 * STEP)
        if any(name.endswith(exempt) for exempt in EXEMPT):
            assert numerical == exact == 0, name
        else:
            assert abs(numerical) > 1e-5 * scale, f"{name} has no effect: {numerical}, {exact}, of {scale}"
            assert abs(exact - numerical) <= 1e-5 * abs(numerical) + 1e-8 * scale, f"{name}: {exact}, {numerical}"


def along(function, model, move):
    """function(model), and its derivative along a move with None for what is not floating."""
    fields, rest = eqx.partition(model, eqx.is_inexact_array)
    return jax.jvp(lambda fields: function(eqx.combine(fields, rest)), (fields,), (move,))


@eqx.filter_jit
def _along_lights(named, move, material, surface):
    return along(lambda n: _weighted(shading.shade(material, list(n.values()), surface)), named, move)


def _weighted(radiance):
    return jnp.sum(radiance * jnp.linspace(0.5, 1.5, radiance.size).reshape(radiance.shape))


def test_every_field_of_a_light_is_in_the_gradient(x64, rng, surface):
    named = every_light(rng)
    assert {type(light) for light in named.values()} == set(PATHS)
    material = random_slices(DEGREE, np.float64)
    check_fields(named, lambda named, move: _along_lights(named, move, material, surface), rng)


MATERIALS = {  # two structures of slices, so that code of `shade` is shared
    **{name: make for name, make in BRDFS.items() if name != "ggx_glass"},  # has the fields of gold
    "cook_torrance_direct": lambda: models.CookTorrance(0.6, 0.1, [0.5, 0.6, 0.7], 1.8, direct=True),
    "measured": lambda: models.MeasuredBrdf(np.random.default_rng(1).uniform(0.1, 1, (90, 90, 180, 3))),
    "projected": lambda: models.ProjectedBrdf(np.random.default_rng(1).normal(size=(3, 3, 3, 3)), isotropic=True),
    "projected_anisotropic": lambda: models.ProjectedBrdf(
        np.random.default_rng(1).normal(size=(9, 9)), isotropic=False
    ),
}


def test_every_material_is_here():
    assert {type(make()) for make in MATERIALS.values()} == {
        kind for kind in models.AbstractBrdf.__subclasses__() if kind.__module__.startswith("shisd")
    }


def _prepared(brdf):
    material = shading.prepare(brdf, DEGREE, elevations=4, azimuths=4, quadrature=48, throw=False)
    return material.distant.coefficients, material.local.coefficients


@eqx.filter_jit
def _along_slices(brdf, move):
    return along(_prepared, brdf, move)


@eqx.filter_jit
def _along_radiance(slices, slope, isotropic, lights, surface):
    def value(slices):
        distant, local = (
            shading.Slices(c, isotropic=isotropic, domain=d) for c, d in zip(slices, ("sphere", "upper"), strict=True)
        )
        return _weighted(shading.shade(shading.Material(distant, local), lights, surface))

    return jax.jvp(value, (slices,), (slope,))


@pytest.mark.parametrize("name", MATERIALS)
def test_every_field_of_a_material_is_in_the_gradient(name, x64, rng, surface):
    """By the chain rule of `prepare` and `shade`: all materials share the compiled code of `shade`."""
    brdf = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), MATERIALS[name]())
    lights = [models.DistantLight(rng.uniform(0.5, 1, 9)), models.PolygonLight(corners("square")[:4])]

    def value_and_slope(brdf, move):
        return _along_radiance(*_along_slices(brdf, move), brdf.isotropic, lights, surface)

    check_fields(brdf, value_and_slope, rng)


# ---- one light as another


@pytest.mark.parametrize("colour", [(), (3,)])
def test_a_turned_light_comes_from_turned_directions(colour, dtype, rng):
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    light = models.DistantLight(array(rng.normal(size=(*colour, 25)), dtype))
    turned = light.rotated(array(rotation, dtype))
    assert turned.colour == light.colour == colour and turned.degree == light.degree == 4
    assert turned.coefficients.dtype == dtype
    w = unit(rng.normal(size=(20, 3)))
    there = harmonics.evaluate(turned.coefficients[..., None, :], array(w @ rotation.T, dtype))
    here = harmonics.evaluate(light.coefficients[..., None, :], array(w, dtype))
    np.testing.assert_allclose(there, here, rtol=0, atol=2e-5 if dtype == np.float32 else 1e-13)


@pytest.mark.parametrize("colour", [(), (3,)])
def test_a_zonal_light_is_a_sum_of_legendre_polynomials(colour, dtype, rng):
    axis, z = 3 * unit(rng.normal(size=3)), rng.normal(size=(*colour, 5))
    light = models.ZonalLight(array(axis, dtype), array(z, dtype))
    assert light.degree == 4 and light.colour == light.distant().colour == colour
    w = unit(rng.normal(size=(20, 3)))
    series = z * np.sqrt((2 * np.arange(5) + 1) / (4 * np.pi))
    exact = np.polynomial.legendre.legval(w @ unit(axis), series.T)
    got = np.asarray(harmonics.evaluate(light.distant().coefficients[..., None, :], array(w, dtype)))
    assert got.dtype == dtype
    np.testing.assert_allclose(got, exact, rtol=0, atol=1e-5 if dtype == np.float32 else 1e-13)


def test_a_map_as_distant_light(rng):
    environment = models.Environment(rng.uniform(0, 1, (8, 16, 3)).astype(np.float32))
    for texels in ("cells", "samples"):
        light = environment.light(3, texels=texels)
        assert isinstance(light, models.DistantLight) and light.degree == 3 and light.colour == (3,)
        np.testing.assert_array_equal(light.coefficients, environment.coefficients(3, texels=texels))


# ---- errors

SQUARE = np.asarray(OUTLINES["square"], np.float32)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: models.DistantLight(np.zeros(5, np.float32)),
            "`coefficients` must have (degree + 1)**2 coefficients on its last axis; got [5].",
        ),
        (
            lambda: models.DistantLight(np.zeros((2, 3, 4), np.float32)),
            "`coefficients` must have shape [n] or [colour, n]; got [2, 3, 4].",
        ),
        (
            lambda: models.DistantLight(np.zeros(4, complex)),
            "`coefficients` must hold real numbers; got dtype complex64. Pass float32 or float64.",
        ),
        (
            lambda: models.DistantLight(np.zeros(4, np.float32)).rotated(np.eye(2, dtype=np.float32)),
            "`rotation` must have shape [3, 3]; got [2, 2]. Batch it with jax.vmap.",
        ),
        (lambda: models.ZonalLight(np.zeros(2), [1.0]), "`axis` must have shape [..., 3]; got [2]."),
        (
            lambda: models.ZonalLight(np.zeros((2, 3)), [1.0]),
            "`axis` must have shape [3]; got [2, 3]. Pass a list of lights for several.",
        ),
        (
            lambda: models.ZonalLight([0, 0, 1], np.zeros((2, 3, 4))),
            "`coefficients` must have shape [L+1] or [colour, L+1]; got [2, 3, 4].",
        ),
        (
            lambda: models.ZonalLight([0, 0, 1], []),
            "`coefficients` must have shape [L+1] or [colour, L+1]; got [0].",
        ),
        (
            lambda: models.Occluded(models.SphereLight([0, 0, 1], 0.1), [1.0]),
            "`light` must be a models.DistantLight or ZonalLight, which alone can be occluded; got SphereLight.",
        ),
        (
            lambda: models.Occluded(np.zeros(4), [1.0]),
            "`light` must be a models.DistantLight or ZonalLight, which alone can be occluded; got ndarray.",
        ),
        (
            lambda: models.Occluded(models.DistantLight([1.0]), np.zeros((2, 3))),
            "`visibility` must have (degree + 1)**2 coefficients on its last axis; got [2, 3].",
        ),
        (
            lambda: models.SphereLight([[0, 0, 1]], 0.1),
            "`center` must have shape [3] and `radius` be one number; got [1, 3], [].",
        ),
        (
            lambda: models.SphereLight([0, 0, 1], [0.1, 0.2]),
            "`center` must have shape [3] and `radius` be one number; got [3], [2].",
        ),
        (
            lambda: models.SphereLight([0, 0, 1], 0.1, np.ones((2, 3))),
            "`emission` must be a scalar or [colour]; got shape [2, 3].",
        ),
        (
            lambda: models.PolygonLight(SQUARE[:2]),
            "`points` must have shape [S, 3] with at least 3 points; got [2, 3].",
        ),
        (lambda: models.PolygonLight(SQUARE[:, :2]), "`points` must have shape [..., 3]; got [4, 2]."),
        (
            lambda: models.PolygonLight(SQUARE, np.ones((1, 3))),
            "`emission` must be a scalar or [colour]; got shape [1, 3].",
        ),
        (
            lambda: models.PolygonLight(SQUARE, profile=np.zeros(3)),
            "`profile` must have (degree + 1)**2 coefficients on its last axis; got [3].",
        ),
        (
            lambda: models.PolygonLight(SQUARE, np.ones(3), profile=np.zeros((2, 4))),
            "colours of `emission` [3] and `profile` [2, 4] do not broadcast.",
        ),
        (
            lambda: models.PortalLight(SQUARE[None], [1.0]),
            "`points` must have shape [S, 3] with at least 3 points; got [1, 4, 3].",
        ),
        (
            lambda: models.PortalLight(SQUARE, np.zeros((1, 3, 4))),
            "`coefficients` must have shape [n] or [colour, n]; got [1, 3, 4].",
        ),
        (
            lambda: models.PortalLight(SQUARE, [1.0]).outline(np.zeros((2, 3))),
            "`origin` must have shape [3]; got [2, 3]. Batch it with jax.vmap.",
        ),
        (
            lambda: models.PolygonLight(SQUARE).outline([0, 0]),
            "`origin` must have shape [..., 3]; got [2].",
        ),
    ],
)
def test_wrong_arguments_are_named(as_user, make, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        make()
