"""Plans: predictions against brute force, paths against the general one, tolerances against quadrature."""

import functools
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import Status, harmonics, models, planning, reference, shading
from shisd.planning import _paths
from shisd.planning._bands import Distant, Material, known_light, known_material, predict
from shisd.planning._choice import _choose
from shisd.planning._paths import Maps, Points, Polygon, Table
from shisd.planning._prediction import judge
from tests.hard_cases import unit
from tests.models.materials import GOLD_PAINT

LAMP = np.array([[-0.5, -0.5, 1.5], [-0.5, 0.5, 1.5], [0.5, 0.5, 1.5], [0.5, -0.5, 1.5]], np.float32)
MATERIALS = {"clay": models.Lambertian(np.float32([0.7, 0.5, 0.4])), "satin": models.Ggx(0.6, 0.3)}
MAX_DEGREE = 10


def room(direction):
    """Two soft lights of different colour; no axis of symmetry."""
    soft = lambda axis, sharpness: jnp.exp(sharpness * (direction @ jnp.asarray(unit(axis), direction.dtype) - 1))
    return jnp.stack([soft([1, 0.5, 1], 6.0), soft([0, 1, 0.3], 4.0), soft([1, 0, 0], 5.0)], axis=-1)


def sky(direction):
    height = direction @ jnp.asarray(unit([0.3, -0.2, 1]), direction.dtype)
    return (1 + height)[:, None] * jnp.asarray([[0.2, 0.3, 0.5]], direction.dtype)


def pixels(rng, count):
    """Positions on a ball below the lamp, normals of any direction, and views as over a sphere's picture."""
    positions, normals, side = unit(rng.normal(size=(3, count, 3)))
    side = unit(np.cross(normals, side))
    sine = np.sqrt(rng.uniform(0, 0.98, (count, 1)))
    views = np.sqrt(1 - sine**2) * normals + sine * side
    return tuple(a.astype(np.float32) for a in (0.5 * positions, normals, views))


def surface(positions, normals, views, *tangents, **options):
    return shading.Surface(normals, views, positions, *tangents, **options)


@functools.cache
def scene():
    lights = {
        "room": models.Environment.from_function(room, 32),
        "sky": models.Environment.from_function(sky, 32),
        "lamp": models.PolygonLight(LAMP, np.float32([3, 2, 1])),
    }
    return planning.Scene(MATERIALS, lights, pixels(np.random.default_rng(2), 12)[0])


@functools.cache
def planned():
    return planning.plan(scene(), 0.03, max_degree=MAX_DEGREE)


def general(material, light, degree, positions, normals, views, path="table"):
    """One light at one degree by the path that always works, filtered, or by points."""
    if path == "points":
        return shading.shade(shading.Quadrature(material, degree), light, shading.Surface(normals, views, positions))
    if path == "filtered":  # and as well as a table
        filtered = shading.prefilter(shading.tabulate_brdf(material, degree), light.light(degree), tolerance=1e-4)
        return filtered.radiance(shading.Surface(normals, views))
    if isinstance(light, models.Environment):
        slices = shading.tabulate_brdf(material, degree)
        return shading.shade(slices, light.light(degree), shading.Surface(normals, views))
    slices = shading.tabulate_brdf(material, degree, domain="upper")
    return shading.shade(slices, light, shading.Surface(normals, views, positions))


def test_prediction_is_the_mean_over_rotations_and_the_bound_holds(x64, rng):
    degree, count = 3, 4000
    n = (degree + 1) ** 2
    slices, light = rng.normal(size=(2, n)) * np.repeat([1, 2, 0.5, 1.5], [1, 3, 5, 7])
    rotations = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    rotations *= np.linalg.det(rotations)[:, None, None]
    turned = jax.jit(jax.vmap(lambda r: harmonics.rotate(jnp.asarray(light), r)))(rotations)
    norms = lambda c: np.sqrt(np.add.reduceat(c * c, np.arange(degree + 1) ** 2))
    for least in (0, 2):
        products = np.asarray(turned)[:, least**2 :] @ slices[least**2 :]
        s = norms(slices) * (np.arange(degree + 1) >= least)
        (rms,), (bound,) = predict(s[None, None], norms(light)[None, None], np.ones(1))
        square = products**2
        noise = np.std(square) / np.mean(square) / np.sqrt(count)
        assert abs(np.mean(square) / rms**2 - 1) < 4 * noise
        assert np.max(np.abs(products)) <= bound


def test_the_cheapest_valid_path_is_found():
    chosen = {(e.material, e.light): e for e in planned().entries}
    assert planned().status == Status.ok and len(chosen) == 6
    assert all(e.error <= 0.03 / 1.5 and e.error <= e.bound for e in chosen.values())
    assert chosen["clay", "room"].path == chosen["clay", "sky"].path == "irradiance"
    assert chosen["satin", "room"].path == "filtered"
    assert chosen["satin", "sky"].joined == "room" and chosen["satin", "sky"].cost == 0
    assert chosen["satin", "lamp"].path == chosen["clay", "lamp"].path == "points"
    clay = known_material(MATERIALS["clay"], MAX_DEGREE, 4)
    lamp = known_light("lamp", scene().lights["lamp"], scene().points, MAX_DEGREE)
    constant, cosine = (judge(Polygon, clay, lamp, degree).error for degree in (0, 1))
    assert cosine < 0.02 < constant  # the cosine above the horizon, where the fit is
    text = str(planned())
    assert all(word in text for word in ("visibility", "irradiance", "filtered", "added to room"))


def test_lights_with_an_axis_are_not_rotated(rng):
    told = []
    brushed = models.Ggx(np.float32([0.4, 0.7]), 0.5)  # others may be filtered for
    alone = planning.Scene({"it": brushed}, {"sky": scene().lights["sky"]})
    made = planning.plan(alone, 0.01, max_degree=4, elevations=16, progress=lambda *counts: told.append(counts))
    assert told == [(1, 2), (2, 2)]
    (entry,) = made.entries
    assert entry.path == "zonal light" and entry.degree == 1
    _, normals, views = pixels(rng, 50)
    tangents = np.cross(normals, [0.3, -0.8, 0.5]).astype(np.float32)
    slices = shading.tabulate_brdf(brushed, 1, elevations=16)
    expected = shading.shade(slices, scene().lights["sky"].light(1), shading.Surface(normals, views, None, tangents))
    got = made.shade("it", shading.Surface(normals, views, None, tangents))
    np.testing.assert_allclose(got, expected, atol=1e-4 * np.max(np.abs(expected)))


@pytest.mark.parametrize("zonal", [[1.0, 0.5, 0.2], [1.0, 0.0, -0.6], [0.7]], ids=["tilted", "even", "constant"])
def test_the_axis_of_a_light_is_found(zonal):
    """Also where the light has no first moment, and where it has no axis at all."""
    axis = jnp.asarray(unit([1.0, 2.0, -0.5]), jnp.float32)
    e = harmonics.convolve(harmonics.sh_basis(axis, len(zonal) - 1), jnp.asarray(zonal))
    light = known_light("it", models.DistantLight(e), None, 4)
    assert np.max(light.off_axis) < 1e-6
    if len(zonal) > 1:
        np.testing.assert_allclose(abs(light.axis @ np.asarray(axis)), 1, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("material", ["clay", "satin"])
def test_a_plan_is_the_general_path_at_its_degrees(material, rng):
    where = pixels(rng, 40)
    entries = [e for e in planned().entries if e.material == material]
    expected = 0.0
    for e in entries:
        lit = general(MATERIALS[material], scene().lights[e.light], e.degree, *where, e.path)
        expected = expected + np.asarray(lit).reshape(40, -1)
    got = planned().shade(material, surface(*where))
    assert got.shape == (40, 3) and got.dtype == np.float32
    near = 3e-5 * np.max(expected) if material == "clay" else 0.6 * entries[0].error * np.sqrt(np.mean(expected**2))
    assert np.sqrt(np.mean((got - expected) ** 2)) < near  # channels have their share of the error
    jitted = jax.jit(lambda s: planned().shade(material, s))
    np.testing.assert_allclose(jitted(surface(*where)), got, atol=1e-5 * np.max(expected))
    below = planned().shade(material, surface(where[0], where[1], -where[2]))
    assert np.array_equal(below, np.zeros((40, 3)))
    mask = np.arange(40) % 3 > 0
    where[1][0] = np.nan
    masked = planned().shade(material, surface(*where, mask=mask))
    np.testing.assert_allclose(masked, np.where(mask[:, None], got, 0), atol=1e-5 * np.max(expected))
    one = planned().shade(material, surface(where[0], where[1][1], where[2][1]))
    same = planned().shade(material, surface(where[0], *(np.tile(a[1], (40, 1)) for a in where[1:])))
    np.testing.assert_allclose(one, same, atol=1e-5 * np.max(expected))


@pytest.mark.parametrize("light", ["room", pytest.param("lamp", marks=pytest.mark.slow)])
@pytest.mark.parametrize("material", MATERIALS)
def test_the_tolerance_is_met_against_quadrature(material, light, rng):
    """Every pair by itself, at pixels that the plan has not seen."""
    brdf, source = MATERIALS[material], scene().lights[light]
    made = planning.plan(planning.Scene({"it": brdf}, {"light": source}, scene().points), 0.03, max_degree=MAX_DEGREE)
    where = pixels(rng, 200 if light == "room" else 2000)
    if light == "room":
        truth = reference.shade_environment_quadrature(brdf, source, *where[1:])
    else:
        truth = reference.shade_polygon_quadrature(brdf, LAMP, source.emission, *where)
    mean = lambda x: np.mean(np.square(x), axis=0)
    error = np.max(np.sqrt(mean(made.shade("it", surface(*where)) - truth) / mean(truth)))  # of the worst colour
    assert error < 0.03
    if (material, light) != ("clay", "lamp"):  # which is exact but for the ridge
        most = 3 if made.entries[0].path == "points" else 2  # few pixels make most of its error
        assert 1 / most < error / made.entries[0].error < most


def test_errors_are_those_of_the_worst_colour(rng):
    """A dim red light of high bands beside a bright blue one of low bands: in the mean of colours red would be lost."""
    slices, shares, e = rng.normal(size=(1, 3, 49)), np.array([0.2, 0.5, 0.3]), np.zeros((3, 49))
    e[0, 0], e[0, 36:], e[2, :4] = 0.01, 0.01, 3.0
    light = Distant(e, True)
    energy = shares @ np.add.reduceat(slices[0] ** 2, np.arange(7) ** 2, axis=-1)
    red = energy * [1, 0, 0, 0, 0, 0, 13] / (2 * np.arange(7) + 1)
    material = Material(slices, np.zeros(3), shares, False, True, 4, MATERIALS["clay"])
    for degree, expected in ((5, np.sqrt(red[6] / np.sum(red))), (6, 0.0)):
        np.testing.assert_allclose(judge(Table, material, light, degree).error, expected, rtol=1e-12)
    blue = 9 * energy[0] + 9 * energy[1]
    together = judge(Table, material, light, 5, pooled=True).error
    np.testing.assert_allclose(together, np.sqrt(1e-4 * red[6] / (1e-4 * np.sum(red) + blue)), rtol=1e-12)


def test_what_cannot_be_met_is_said():
    alone = planning.Scene({"mirror": models.Ggx(0.1)}, {"room": scene().lights["room"]})
    with pytest.warns(UserWarning, match=r"`tolerance` 0.001 .* mirror under room .* Raise `max_degree`"):
        made = planning.plan(alone, 1e-3, max_degree=3, throw=False)
    assert made.status == Status.tolerance_not_met and made.entries[0].degree == 3 and "NOT MET" in str(made)
    with pytest.raises(ValueError, match="is not met at degree 3"):
        planning.plan(alone, 1e-3, max_degree=3)


def test_points_are_chosen_where_they_are_cheapest(rng):
    """Under a lamp, of a wide lobe; of one so narrow that it lies between them, they know nothing."""
    lamp = models.PolygonLight(LAMP, np.float32(2))
    made = planning.plan(planning.Scene({"it": models.Ggx(0.5)}, {"lamp": lamp}, scene().points), 0.03, max_degree=4)
    (entry,) = made.entries
    assert entry.path == "points" and made.status == Status.ok
    where = pixels(rng, 2000)
    truth = reference.shade_polygon_quadrature(models.Ggx(0.5), LAMP, lamp.emission, *where)
    error = np.sqrt(np.mean((made.shade("it", surface(*where)) - truth) ** 2) / np.mean(np.square(truth)))
    assert 0.6 < error / entry.error < 1.6 and error < 0.03
    mirror = known_material(models.Phong(1.0, 1e9), 16, 4)
    assert judge(Points, mirror, known_light("lamp", lamp, scene().points, 16), 16).error > 1


@pytest.mark.slow
def test_maps_are_chosen_for_sharp_materials():
    """Also where the lobe is too narrow for any number of points to be the truth."""
    lamp, brdf = models.PolygonLight(LAMP), models.Ggx(0.03, 0.5)
    known = known_light("it", lamp, pixels(np.random.default_rng(3), 64)[0], 16)
    material = known_material(brdf, 16, 64)
    with mock.patch.object(_paths, "_FACING", 48):  # the same pixels here and there, as few make most of the error
        judged = {degree: judge(Maps, material, known, degree).error for degree in (4, 8)}
        seen = _paths._samples(material, known)[0]
    shape = (64, 48, 3)
    where = [np.broadcast_to(x, shape).reshape(-1, 3) for x in (seen.positions, seen.normals, seen.views)]
    truth = reference.shade_polygon_quadrature(brdf, LAMP, lamp.emission, *where, nodes=144)
    for degree in (4, 8):
        form = material.beyond_maps(degree)
        error = np.sqrt(np.mean((shading.shade(form, lamp, surface(*where)) - truth) ** 2) / np.mean(truth**2))
        assert 0.5 < judged[degree] / error < 2, (degree, judged[degree], error)
    _paths._samples.cache_clear()
    chosen = _choose(judge, material, known, 0.02, 16)
    assert chosen.path is Maps and chosen.degree == 4
    assert not Maps.serves(material, known_light("it", models.PortalLight(LAMP, np.ones(1)), where[0][:4], 4))


def test_what_values_of_a_model_cost():
    """Series and tables make most of it: SGD takes 30 times as long as GGX."""
    cost = lambda brdf: known_material(brdf, 1, 4).evaluation
    satin, painted = cost(MATERIALS["satin"]), cost(models.SgdMicrofacet(**GOLD_PAINT))
    assert 2 < satin < 8 and 15 * satin < painted < 60 * satin


def test_points_are_judged_from_the_surfaces_of_the_scene(rng):
    """A ball beside an upright lamp, whose near side faces it: surfaces that face all ways there predict 2.4 times."""
    lamp = models.PolygonLight(LAMP @ np.float32([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]))
    where = pixels(rng, 1500)
    where = where[1] * np.float32(0.5), *where[1:]
    satin = known_material(models.Ggx(0.5), 16, 4)
    got = shading.shade(shading.Quadrature(models.Ggx(0.5), 4), lamp, surface(*where))
    want = reference.shade_polygon_quadrature(models.Ggx(0.5), lamp.points, lamp.emission, *where, nodes=24)
    error = np.sqrt(np.mean((got - want) ** 2) / np.mean(want**2))
    known = known_light("it", lamp, where[0][:64], 16, where[1][:64])
    assert 0.6 < judge(Points, satin, known, 4).error / error < 1.6, error


def test_light_is_filtered_where_a_table_costs_more(rng):
    """For a narrower lobe, two lights together; the cost is that of the maps."""
    lights, brdf = {name: scene().lights[name] for name in ("room", "sky")}, models.Ggx(0.25, 0.3)
    made = planning.plan(planning.Scene({"it": brdf}, lights), 0.03, max_degree=16)
    first, second = made.entries
    assert first.path == second.path == "filtered" and second.joined == "room" and made.status == Status.ok
    filtered = made.paths["it"][0].filtered
    maps = np.count_nonzero(np.any(np.asarray(filtered.expand), axis=1))
    assert 0 < filtered.error < 0.6 * first.error and first.cost == 65 + 1.9 * 3 * maps
    _, n, v = where = pixels(rng, 512)
    truth = sum(reference.shade_environment_quadrature(brdf, light, n, v) for light in lights.values())
    mean = lambda x: np.mean(np.square(x), axis=0)
    error = np.max(np.sqrt(mean(made.shade("it", surface(*where)) - truth) / mean(truth)))
    assert 0.2 < error / first.error < 1 and error < 0.03, (error, first.error)  # both lights beside one
    red = models.DistantLight(lights["room"].coefficients(16) * np.float32([[1], [0], [0]]))
    alone = planning.plan(planning.Scene({"it": brdf}, {"red": red}), 0.03, max_degree=16)
    assert alone.entries[0].path == "filtered" and np.all(np.asarray(alone.shade("it", surface(*where)))[:, 1:] == 0)


@pytest.mark.slow
def test_windows(rng):
    """The light through it, and the radiance, against quadrature of both."""
    e = rng.normal(size=9).astype(np.float32) * 0.2
    e[0] = 2.0
    portal, brdf = models.PortalLight(LAMP, e), MATERIALS["satin"]
    made = planning.plan(planning.Scene({"it": brdf}, {"window": portal}, scene().points), 0.03, max_degree=8)
    assert made.entries[0].path == "points" and made.status == Status.ok
    where = pixels(rng, 2000)
    through = lambda w: harmonics.evaluate(e, w)
    truth = reference.shade_polygon_quadrature(brdf, LAMP, through, *where)
    error = np.sqrt(np.mean((made.shade("it", surface(*where)) - truth) ** 2) / np.mean(np.square(truth)))
    assert 0.5 < error / made.entries[0].error < 2 and error < 0.03


@pytest.mark.slow
def test_anisotropic_materials(rng):
    brdf = models.Ggx(np.float32([0.4, 0.7]), 0.5)
    made = planning.plan(planning.Scene({"it": brdf}, {"room": scene().lights["room"]}), 0.03, max_degree=MAX_DEGREE)
    assert made.entries[0].path == "anisotropic table"
    _, normals, views = pixels(rng, 200)
    tangents = np.cross(normals, [0.3, -0.8, 0.5]).astype(np.float32)
    truth = reference.shade_environment_quadrature(brdf, scene().lights["room"], normals, views, tangents=tangents)
    error = np.asarray(made.shade("it", surface(None, normals, views, tangents))) - truth
    assert 0.5 < np.sqrt(np.mean(error**2) / np.mean(np.square(truth))) / made.entries[0].error < 2


@pytest.mark.parametrize("material", ["clay", pytest.param("satin", marks=pytest.mark.slow)])
def test_derivatives_in_the_geometry(material, x64, rng):
    lights = {"sky": models.DistantLight(rng.normal(size=9))}
    if material == "satin":
        lights |= {"lamp": models.PolygonLight(LAMP.astype(float), 2.0)}
    known = planning.Scene({material: MATERIALS[material]}, lights, np.zeros((1, 3)))
    made = planning.plan(known, 1e-5, max_degree=4)  # so many points that rule and derivative agree
    where = tuple(jnp.asarray(a, float) for a in pixels(rng, 3))
    shade = jax.jit(lambda p, n, v: made.shade(material, surface(p, n, v)))
    assert shade(*where).dtype == np.float64
    check_grads(shade, where, order=1, modes=["rev"], atol=1e-5, rtol=1e-5, eps=1e-5)


@pytest.mark.parametrize("material", MATERIALS)
def test_what_has_no_direction_has_no_radiance(material, rng):
    """Whichever path is taken: NaN, and others as without it."""
    positions, normals, views = pixels(rng, 6)
    clean = planned().shade(material, surface(positions, normals, views))
    for i in range(2):
        for bad in (0, np.nan):
            arrays = [np.array(normals), np.array(views)]
            arrays[i][2] = bad
            value = np.asarray(planned().shade(material, surface(positions, *arrays)))
            assert np.all(np.isnan(value[2]))
            np.testing.assert_array_equal(np.delete(value, 2, axis=0), np.delete(clean, 2, axis=0))


def test_errors_name_the_argument(as_user, rng):
    with pytest.raises(ValueError, match="at least one of `materials` and of `lights`; got 0 and 3"):
        planning.Scene({}, scene().lights)
    with pytest.raises(ValueError, match=r"`lights`\['lamp'\] is local; pass `points`"):
        planning.Scene(MATERIALS, {"lamp": scene().lights["lamp"]})
    with pytest.raises(ValueError, match="`points` must hold at least one"):
        planning.Scene(MATERIALS, scene().lights, np.zeros((0, 3)))
    with pytest.raises(ValueError, match="`normals` must be those of `points`; got 3 and 2 `points`"):
        planning.Scene(MATERIALS, scene().lights, np.zeros((2, 3)), np.ones((3, 3)))
    for bad in (0.0, np.nan):
        with pytest.raises(ValueError, match="`normals` has a vector that is zero or not finite"):
            planning.Scene(MATERIALS, scene().lights, np.zeros((2, 3)), np.float32([[0, 0, 1], [bad, bad, bad]]))
    with pytest.raises(ValueError, match=r"`materials`\['gold'\] must be a models.AbstractBrdf; got str"):
        planning.Scene({"gold": "gold"}, scene().lights)
    with pytest.raises(
        ValueError, match=r"`lights`\['bad'\] must be a models.DistantLight, .* PortalLight; got ndarray"
    ):
        planning.Scene(MATERIALS, {"bad": np.ones(9)})
    with pytest.raises(ValueError, match="`scene` must be a planning.Scene"):
        planning.plan(MATERIALS, 0.1)
    for bad in (0.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="`tolerance` must be finite and > 0"):
            planning.plan(scene(), bad)
    with pytest.raises(ValueError, match="`margin` must be >= 1"):
        planning.plan(scene(), 0.1, margin=0.5)
    with pytest.raises(ValueError, match="`margin` must be finite"):
        planning.plan(scene(), 0.1, margin=np.inf)
    with pytest.raises(ValueError, match="`max_degree` must be <= 64"):
        planning.plan(scene(), 0.1, max_degree=65)
    with pytest.raises(ValueError, match=r"must be finite"):
        planning.plan(planning.Scene(MATERIALS, {"bad": models.DistantLight(np.array([np.nan]))}), 0.1, max_degree=2)
    positions, normals, views = pixels(rng, 3)
    with pytest.raises(ValueError, match="`material` must be one of 'clay', 'satin'; got 'gold'"):
        planned().shade("gold", surface(positions, normals, views))
    with pytest.raises(ValueError, match="`surface` needs `positions`"):
        planned().shade("clay", shading.Surface(normals, views))
    with pytest.raises(ValueError, match="`surface` must be a shading.Surface of normals and views; got ndarray"):
        planned().shade("clay", positions)
    with pytest.raises(ValueError, match="do not broadcast"):
        planned().shade("clay", surface(positions, normals[:2], views))
