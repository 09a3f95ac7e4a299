"""Polygon lights against area quadrature of slices and of the material, lights above, across and below the horizon."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import domains, models, reference, shading
from tests import truth
from tests.hard_cases import unit
from tests.marks import FLOAT64_FIRST
from tests.shading.slices import cosine_slices, random_slices

QUAD = np.array([[-0.5, -0.5, 1.0], [-0.5, 0.5, 1.2], [0.5, 0.5, 1.2], [0.5, -0.5, 1.0]])  # emits downwards
DEGREE, COUNT = 4, 8  # of slices; of points that are shaded together, so that all share compiled code
BRDFS = {
    "lambertian": lambda: models.Lambertian(0.8),
    "glossy": lambda: models.Ggx(0.5, 0.04),
    "sharp": lambda: models.Ggx(0.25, 0.04),
    "phong": lambda: models.Phong(0.5, 20.0),
}


def scene(rng, count=COUNT):
    """Points below and beside the light; the first one has it wholly below its horizon, the second half."""
    position = rng.uniform(-1, 1, (count, 3)) * [1, 1, 0.2]
    normal = unit(rng.normal(size=(count, 3)) * 0.5 + [0, 0, 1])
    normal[:2] = [0, 0, -1], unit([1, 0.2, -0.3])
    position[1] = [0.1, 0, 0.3]
    view = unit(0.6 * unit(rng.normal(size=(count, 3))) + normal)
    view[2] = normal[2]
    return position, normal, view


def surface_of(position, normal, view, dtype=np.float32):
    return shading.Surface(*(a.astype(dtype) for a in (normal, view, position)))


# ---- truth


def local_outline(points, position, normal):
    """The outline above the horizon, by plain clipping, and the frame (rows)."""
    normal = unit(normal)
    x = unit(np.cross(normal, [0.3, 0.5, -0.7]))
    frame = np.stack([x, np.cross(normal, x), normal])
    local, kept = (points - position) @ frame.T, []
    for a, b in zip(local, np.roll(local, -1, axis=0), strict=True):
        kept += [a] if a[2] > 0 else []
        kept += [a + (b - a) * a[2] / (a[2] - b[2])] if (a[2] > 0) != (b[2] > 0) else []
    return unit(kept) if kept else None, frame


def quadrature(integrand, points, position, normal, nodes=24):
    """Integral of integrand(directions in the local frame, frame) over the light, whatever its winding."""
    outline, frame = local_outline(points, position, normal)
    if outline is None:
        return 0.0
    w, area = truth.triangle_rule(outline, nodes)
    return np.sign(float(area.sum())) * area.astype(float) @ integrand(w.astype(float), frame)


_slices_at = jax.jit(jax.vmap(lambda slices, view: slices.at(view), (None, 0)))


def expected_radiance(slices, light, position, normal, view, points=QUAD):
    """The clipped integral of the interpolated slice times light(world directions) [N, ...], SciPy's harmonics."""
    frames = np.stack([local_outline(points, p, n)[1] for p, n in zip(position, normal, strict=True)])
    local = np.einsum("pij,pj->pi", frames, unit(view)).astype(slices.coefficients.dtype)
    radiance = []
    for p, n, c in zip(position, normal, np.asarray(_slices_at(slices, local), float), strict=True):
        values = lambda w, frame, c=c: ((truth.scipy_basis(w, DEGREE) @ c) * light(w @ frame).T).T
        radiance.append(quadrature(values, points, p, n))
    return np.stack(np.broadcast_arrays(*radiance))


def expected(slices, points, position, normal, view):
    return expected_radiance(slices, lambda w: np.ones(len(w)), position, normal, view, points)


def form_factors(points, position, normal):
    """Lambert's formula for what is above the horizon, 1 / (2 pi) sum of angle times edge normal, dot normal."""
    factors = []
    for p, n in zip(position, normal, strict=True):
        v, _ = local_outline(points, p, n)
        if v is None:
            factors.append(0.0)
            continue
        across = np.cross(v, np.roll(v, -1, axis=0))
        sine = np.linalg.norm(across, axis=1)
        angle = np.arctan2(sine, np.sum(v * np.roll(v, -1, axis=0), axis=1))
        factors.append(abs(np.sum(angle * across[:, 2] / np.where(sine > 0, sine, 1))) / (2 * np.pi))
    return np.array(factors)


# ---- one light: values and gradients of all tests here from one piece of compiled code in each precision


@functools.cache
def slices_of(name, degree, dtype, domain="upper"):
    return shading.tabulate_brdf(BRDFS[name](), degree, domain=domain)


@functools.cache
def random(dtype):
    return random_slices(DEGREE, np.dtype(dtype), domain="upper")


@functools.cache
def white(dtype):
    return cosine_slices(DEGREE, np.dtype(dtype))


@jax.jit
def _shade(slices, geometry, weights):
    def radiance(points, position, normal, view):
        light = models.PolygonLight(points, two_sided=True)
        return shading.shade(slices, light, shading.Surface(normal, view, position))

    value, pull = jax.vjp(radiance, *geometry)
    return value, pull(weights)


def shade(slices, points, position, normal, view, weights=None):
    """Radiance [COUNT] of a two-sided light of at most five corners, and gradients of weights @ radiance by them."""
    five = points[np.minimum(np.arange(5), len(points) - 1)]
    dtype = slices.coefficients.dtype
    weights = np.ones(COUNT) if weights is None else weights
    geometry = [np.asarray(a, dtype) for a in (five, position, normal, view)]
    value, (d_points, *rest) = jax.tree.map(np.asarray, _shade(slices, geometry, np.asarray(weights, dtype)))
    return value, (np.add.reduceat(d_points, np.arange(len(points))), *rest)


def slopes(slices, geometry, weights, moves, step):
    """Of weights @ expected radiance, by differences, when one of the arrays at a time makes its move."""
    found = []
    for i, move in enumerate(moves):
        at = lambda t, i=i, move=move: [a + t * move if j == i else a for j, a in enumerate(geometry)]
        ends = (expected(slices, *at(t)) for t in (step, -step))
        found.append(weights @ np.subtract(*ends) / (2 * step))
    return np.array(found)


VALUE = {"float32": 1e-6, "float64": 5e-15}  # of the largest; measured 3e-7, 2e-15
SLOPE = {"float32": 1.5e-5, "float64": 1e-6}  # of the sum of all parts; measured 6e-6, 3e-7 (of the differences)


def check_slope(gradient, move, want, dtype, name):
    parts = gradient * move
    tolerance = SLOPE[dtype.name] * np.sum(np.abs(parts))
    np.testing.assert_allclose(np.sum(parts), want, rtol=0, atol=tolerance, err_msg=name)


@FLOAT64_FIRST
def test_values_and_gradients_of_the_slice(dtype, rng):
    """The clipped integral of the interpolated slice and its change with outline, position, normal and view."""
    slices, geometry, weights = random(dtype.name), [QUAD, *scene(rng)], rng.normal(size=COUNT)
    geometry = [a.astype(dtype).astype(float) for a in geometry]
    got, gradients = shade(slices, *geometry, weights)
    want = expected(slices, *geometry)
    assert got.dtype == dtype and got[0] == 0
    np.testing.assert_allclose(got, want, rtol=0, atol=VALUE[dtype.name] * np.max(np.abs(want)))
    for gradient in gradients[1:]:
        np.testing.assert_array_equal(gradient[0], 0)  # of what is below the horizon
    moves = [rng.normal(size=a.shape) for a in geometry]
    moves[3] -= np.sum(moves[3] * geometry[3], axis=1, keepdims=True) * geometry[3]
    with jax.enable_x64(True):
        want = slopes(random("float64"), geometry, weights, moves, 1e-5)
    for name, *each in zip(("points", "position", "normal", "view"), gradients, moves, want, strict=True):
        check_slope(*each, dtype, name)


HARD = {
    "1e-4 away": [[-0.5, -0.5, 1e-4], [-0.5, 0.5, 1e-4], [0.5, 0.5, 1e-4], [0.5, -0.5, 1e-4]],
    "an edge on the horizon": [[1, -0.4, 0], [1.2, -0.4, 0.8], [1.1, 0.5, 0.9], [1, 0.5, 0]],
    "a corner on the horizon": [[1, 0, 0], [1.2, -0.4, 0.8], [1.1, 0.2, 0.9], [1, 0.5, 0.3]],
    "across the horizon, turning inwards": [[1, -1, -0.3], [1, 0, 0.8], [1, 0.2, -0.4], [1, 0.4, 0.7], [1, 1, -0.2]],
}


@pytest.mark.parametrize("name", HARD)
def test_hard_cases(name, dtype, rng):
    """Values against quadrature, gradients against its differences; what is on the horizon stays there."""
    points, up = np.asarray(HARD[name], float), np.tile([0.0, 0, 1], (COUNT, 1))
    points = points.astype(dtype).astype(float)
    views = unit(rng.normal(size=(COUNT, 3)) * [1, 1, 0.3] + up)
    views[0] = up[0]
    weights = rng.normal(size=COUNT)
    got, gradients = shade(random(dtype.name), points, 0 * up, up, views, weights)
    move = rng.normal(size=points.shape) * np.where(points[:, 2:] == 0, [1, 1, 0], 1) * (points[0, 2] or 1)
    turn, h, t = np.cross(rng.normal(size=views.shape), views), 1e-4, 1e-6
    integrals = lambda p: quadrature(lambda w, _: truth.scipy_basis(w, DEGREE), p, 0 * up[0], up[0], nodes=40)
    with jax.enable_x64(True):
        frame = local_outline(points, 0 * up[0], up[0])[1]
        slices = random("float64")
        c = lambda v: np.asarray(_slices_at(slices, unit(v) @ frame.T))
        want = c(views) @ integrals(points)
        by_points = weights @ c(views) @ (integrals(points + h * move) - integrals(points - h * move)) / (2 * h)
        by_views = weights @ (c(views + t * turn) - c(views - t * turn)) @ integrals(points) / (2 * t)
    np.testing.assert_allclose(got, want, rtol=0, atol=VALUE[dtype.name] * np.max(np.abs(want)))
    check_slope(gradients[0], move, by_points, dtype, "points")
    check_slope(gradients[3], turn, by_views, dtype, "view")


def test_a_point_in_the_plane_of_the_light_is_dark():
    points = np.array([[1.0, -1, 0], [1, 1, 0], [2, 1, 0], [2, -1, 0]])
    up = np.tile([0.0, 0, 1], (COUNT, 1))
    value, gradients = shade(random("float32"), points, 0 * up, up, up)
    for x in (value, *gradients):
        np.testing.assert_array_equal(x, 0)


FAR = [[64, -128, 32], [1000, 3000, -2000], [3e4, 7e4, 1e4], [-5e5, 4e6, 100], [1e7, 3e6, -8e6]]


@pytest.mark.parametrize("offset", FAR, ids=lambda o: f"{np.linalg.norm(o):.0e}")
def test_far_from_the_origin(offset, rng):
    """Scenes whose coordinates are whole numbers are the same to the last bit; all are those of Lambert's formula."""
    whole = np.array([[1, -1, 2], [-1, -1, 2], [-1, 1, 2], [1, 1, 2]])
    position = rng.integers(-2, 2, (COUNT, 3)) * [1, 1, 0]
    _, normal, view = scene(rng)
    here, there = (shade(random("float32"), whole + o, position + o, normal, view) for o in (np.zeros(3), offset))
    jax.tree.map(np.testing.assert_array_equal, there, here)
    # a small tilted lamp, as float32 holds it there; points beside it, some nearly in its plane
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    lamp = (0.05 * whole * [1, 1, 0]) @ turn + offset
    position = rng.normal(size=(COUNT, 3)) * [1, 1, 0.1] @ turn + offset
    lamp, position = (a.astype(np.float32).astype(float) for a in (lamp, position))
    if np.linalg.norm(offset) < 1e4:  # beyond, its corners fall together
        got, _ = shade(white("float32"), lamp, position, normal, view)
        np.testing.assert_allclose(got, form_factors(lamp, position, normal), rtol=2e-4, atol=1e-9)


def test_projected_light_far_from_the_origin(rng):
    quad = np.array([[1, -1, 2], [-1, -1, 2], [-1, 1, 2], [1, 1, 2]])
    position = rng.integers(-2, 2, (4, 3)) * [1, 1, 0]
    single = lambda a: a.astype(np.float32)
    at = lambda o: np.asarray(project(models.PolygonLight(single(quad + o), COLOURS), single(position + o)))
    here = at(np.zeros(3))
    assert np.all(here[:, 0, 0] > 0.05)
    for offset in FAR:
        np.testing.assert_array_equal(at(np.asarray(offset)), here)


@pytest.mark.parametrize("turn", [1, -1])
def test_projected_light_close_to_a_lamp(turn):
    """Nearly a hemisphere, from either side: the solid angle of a rectangle in closed form, by its four quarters."""
    quad = np.array([[1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]], np.float32)[::turn]
    position = np.array([[0.1, 0.2, z] for z in (-0.01, -1e-5, -1e-7, 1e-7, 1e-6, 0.3)], np.float32)
    light = models.PolygonLight(np.ascontiguousarray(quad), COLOURS, two_sided=True)
    got = np.asarray(project(light, position))[:, :, 0] * np.sqrt(4 * np.pi)
    x, y, z = position.astype(float).T
    sides = [(a, b) for a in (1 - x, 1 + x) for b in (1 - y, 1 + y)]
    truth = sum(np.arctan(a * b / (np.abs(z) * np.sqrt(a * a + b * b + z * z))) for a, b in sides)
    np.testing.assert_allclose(got, truth[:, None] * COLOURS, rtol=2e-6)


def test_several_lights(rng):
    """Those of one kind in a loop, others beside them: the sum of what each adds, with their gradients."""
    slices, (position, normal, view) = random("float32"), (a.astype(np.float32) for a in scene(rng))
    quads = [(QUAD + 0.3 * rng.normal(size=3)).astype(np.float32) for _ in range(3)]
    emission, red = np.array([2.0, 0.5], np.float32), np.array([2.0, 0.0, 1.0], np.float32)

    @jax.jit
    def total(quads, emission):
        seen = [models.PolygonLight(q, e) for q, e in zip(quads, emission, strict=False)]
        behind = models.PolygonLight(quads[0][::-1], 7.0)
        both = models.PolygonLight(quads[2][::-1], red, two_sided=True)
        return shading.shade(slices, [*seen, behind, both], shading.Surface(normal, view, position))

    (each, slopes) = zip(*(shade(slices, q, position, normal, view) for q in quads), strict=True)
    value, pull = jax.vjp(total, quads, emission)
    want = emission @ each[:2]
    np.testing.assert_allclose(value, want[:, None] + each[2][:, None] * red, rtol=2e-6, atol=1e-7)
    assert np.max(value) > 0.1
    by_quads, by_emission = pull(np.ones((COUNT, 3), np.float32))
    np.testing.assert_allclose(by_emission, 3 * np.sum(each[:2], axis=1), rtol=2e-6)
    for got, slope, factor in zip(by_quads, slopes, (3 * emission[0], 3 * emission[1], 3), strict=True):
        np.testing.assert_allclose(got, factor * slope[0], atol=2e-6 * factor * np.max(np.abs(slope[0])))


def test_code_does_not_grow_with_lights_and_colours(rng):
    surface = surface_of(*scene(rng))
    quads = [(QUAD + i).astype(np.float32) for i in range(20)]

    def size(slices, count):
        shade = lambda quads: shading.shade(slices, [models.PolygonLight(q) for q in quads], surface)
        return len(jax.jit(shade).lower(quads[:count]).as_text().splitlines())

    assert size(random("float32"), 20) < 1.1 * size(random("float32"), 2)
    one, rgb = (size(random_slices(2, np.dtype("float32"), c, domain="upper"), 1) for c in ((), (3,)))
    assert rgb < 1.1 * one


@pytest.mark.slow
def test_gradients_keep_no_tile_of_each_light(rng):
    surface = surface_of(*scene(rng, 2048))
    quads = np.stack([QUAD + i for i in range(20)]).astype(np.float32)

    def memory(count):
        lights = lambda quads: [models.PolygonLight(q) for q in quads]
        shade = lambda quads: shading.shade(random("float32"), lights(quads), surface).sum()
        return jax.jit(jax.grad(shade)).lower(quads[:count]).compile().memory_analysis().temp_size_in_bytes

    assert memory(20) < 1.1 * memory(2)  # measured 1.00


@pytest.mark.slow
def test_a_portal_is_the_light_behind_it(rng):
    """Several windows, and what changes with the light in their field; far away as at the origin."""
    slices, (position, normal, view) = random("float32"), (np.round(64 * a) / 64 for a in scene(rng, 4))
    quads, e = [np.round(64 * (QUAD + move)) / 64 for move in ([0, 0, 0], [0.25, 0.5, 0])], rng.normal(size=(2, 4))
    windows = [models.PortalLight(q.astype(np.float32), c.astype(np.float32)) for q, c in zip(quads, e, strict=True)]

    @jax.jit
    def shade(windows, position):
        return jnp.sum(shading.shade(slices, windows, shading.Surface(*frame, position)), axis=0)

    frame = [a.astype(np.float32) for a in (normal, view)]
    both = jax.jit(jax.value_and_grad(shade))
    value, gradient = both(windows, position.astype(np.float32))
    light = lambda w: truth.scipy_basis(w, 1)
    want = np.array([np.sum(expected_radiance(slices, light, position, normal, view, q), axis=0) for q in quads])
    np.testing.assert_allclose(value, np.sum(want * e), rtol=1e-5)
    for window, term in zip(gradient, want, strict=True):
        np.testing.assert_allclose(window.coefficients, term, atol=1e-5 * np.max(np.abs(term)))
    black = eqx.tree_at(lambda w: [x.coefficients for x in w], windows, [np.zeros(4, np.float32)] * 2)
    assert both(black, position.astype(np.float32))[0] == 0
    offset = np.float32([16384, -32768, 8192])
    moved = eqx.tree_at(lambda w: [x.points for x in w], windows, [x.points + offset[None] for x in windows])
    assert both(moved, (position + offset).astype(np.float32))[0] == value


COLOURS = np.float32([1, 2])
project = jax.jit(lambda light, position: shading.project_light(light, position, 3))


def check_projected(got, radiance, position, degree, tolerance):
    for p, c in zip(position, np.asarray(got), strict=True):
        w, area = (x.astype(float) for x in truth.triangle_rule(unit(QUAD - p), 24))
        want = -(radiance(w).T * area) @ truth.scipy_basis(w, degree)
        np.testing.assert_allclose(c, want, atol=tolerance * np.max(np.abs(want)))


def test_projected_light(rng):
    """Coefficients of what a light sends to a point, against quadrature; several points and colours."""
    position = scene(rng, 4)[0]
    got = project(models.PolygonLight(QUAD.astype(np.float32), COLOURS), position.astype(np.float32))
    assert got.dtype == np.float32
    check_projected(got, lambda w: np.broadcast_to(COLOURS, (len(w), 2)), position, 3, 5e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "bound", "gain"),
    [("lambertian", 3e-5, 5), ("glossy", 1e-4, 5), ("sharp", 3e-3, 3), ("phong", 2e-4, 0)],
)
def test_radiance_of_the_material(name, bound, gain, dtype, rng):
    """Relative RMSE at degree 20, interpolation of views included, and how much worse ordinary projection is."""
    position, normal, view = scene(rng, 64)
    with jax.enable_x64(True):
        expected = np.asarray(
            reference.shade_polygon_quadrature(BRDFS[name](), QUAD, 1.0, position, normal, view, nodes=48)
        )
    assert 0 < np.sum(expected == 0) < 10
    rms = lambda got: np.sqrt(np.mean((np.asarray(got) - expected) ** 2) / np.mean(np.square(expected)))
    light, surface = models.PolygonLight(QUAD.astype(dtype)), surface_of(position, normal, view, dtype)
    shade = lambda domain: shading.shade(slices_of(name, 20, dtype.name, domain), light, surface)
    got = shade("upper")
    assert got.dtype == dtype and got[0] == 0
    assert rms(got) < bound, rms(got)
    assert rms(shade("sphere")) > gain * rms(got)


@pytest.mark.slow
def test_light_by_direction(dtype, rng):
    """A profile at the light, and distant light through the same outline; in front, and from behind nothing."""
    position, normal, view = scene(rng, 6)
    slices, e = slices_of("glossy", 4, dtype.name), rng.normal(size=(3, 16)).astype(dtype)
    tolerance = {"float64": 1e-12, "float32": 3e-5}[dtype.name]
    points, surface = QUAD.astype(dtype), surface_of(position, normal, view, dtype)
    portal = models.PortalLight(points, e)
    distant = lambda w: truth.scipy_basis(w, 3) @ e.astype(float).T
    leaving = lambda w: 0.7 * distant(-w)
    light = models.PolygonLight(points, np.asarray(0.7, dtype), profile=e)
    for one, radiance in ((portal, distant), (light, leaving)):
        got = shading.shade(slices, one, surface)
        expected = expected_radiance(slices, radiance, position, normal, view)
        assert got.dtype == dtype
        np.testing.assert_allclose(got, expected, atol=tolerance * np.max(np.abs(expected)))
    outside = models.PortalLight(points[::-1].copy(), e)
    np.testing.assert_array_equal(shading.shade(slices, outside, surface), 0)


@pytest.mark.slow
def test_projected_portals_and_wavelets(dtype, rng):
    """Coefficients of what a light sends to a point, against quadrature; several points and colours."""
    position = scene(rng, 4)[0].astype(dtype)
    e, quad = rng.normal(size=(3, 9)).astype(dtype), QUAD.astype(dtype)
    lights = {
        "plain": (models.PolygonLight(quad, np.asarray([1, 2], dtype)), lambda w: np.broadcast_to([1, 2], (len(w), 2))),
        "portal": (models.PortalLight(quad, e), lambda w: truth.scipy_basis(w, 2) @ e.astype(float).T),
    }
    haar = domains.HaarBasis(1)
    for light, radiance in lights.values():
        got, cells = (np.asarray(shading.project_light(light, position, basis)) for basis in (5, haar))
        assert got.dtype == cells.dtype == dtype
        for p, c, h in zip(position, got, cells, strict=True):
            w, area = (x.astype(float) for x in truth.triangle_rule(unit(QUAD - p), 40))
            expected = -(radiance(w) * area[:, None]).T @ truth.scipy_basis(w, 5)
            np.testing.assert_allclose(c, expected, atol={"float64": 1e-11, "float32": 1e-4}[dtype.name])
            # the wavelets' integral, and in SciPy's basis what is left of it within each octant
            total = np.asarray(haar.values(h)) @ haar.areas
            scale = np.sqrt(4 * np.pi)
            np.testing.assert_allclose(
                total, expected[:, 0] * scale, atol={"float64": 1e-11, "float32": 1e-4}[dtype.name]
            )


@pytest.mark.slow
def test_derivatives(x64, rng):
    position, normal, view = scene(rng, 4)
    slices = slices_of("glossy", 4, "float64")

    def radiance(points, emission, position, normal, view):
        light = models.PolygonLight(points, emission)
        return shading.shade(slices, light, shading.Surface(normal, view, position))

    arguments = (QUAD, np.asarray(1.3), position[1:], normal[1:], view[1:])
    check_grads(radiance, arguments, order=1, rtol=1e-6, atol=1e-8)
    below = lambda points: jnp.sum(radiance(points, 1.0, position[:1], normal[:1], view[:1]))
    np.testing.assert_array_equal(jax.grad(below)(jnp.asarray(QUAD)), 0)


@pytest.mark.slow
@pytest.mark.parametrize("sine", [0.0, 1e-7, 0.009, 0.011], ids="s={}".format)
def test_derivatives_of_views_near_the_normal(sine, x64, rng):
    """Where the plane of incidence turns ever faster, on both sides of where its rule changes; in the material too."""
    position, normal, _ = scene(rng, 4)
    slices, azimuth = slices_of("sharp", 6, "float64"), rng.uniform(0, 2 * np.pi, (4, 1))
    x = unit(np.cross(normal, [0.3, 0.5, -0.7]))
    view = normal + sine * (np.cos(azimuth) * x + np.sin(azimuth) * np.cross(normal, x))

    def radiance(coefficients, points, view, normal):
        material = eqx.tree_at(lambda m: m.coefficients, slices, jnp.asarray(coefficients))
        return shading.shade(material, models.PolygonLight(points), shading.Surface(normal[2:], view[2:], position[2:]))

    arguments = (slices.coefficients, QUAD, view, normal)
    for i, x in enumerate(arguments):  # a change of all coefficients is rough in the view: not both at a time
        only = lambda x, i=i: radiance(*arguments[:i], x, *arguments[i + 1 :])
        check_grads(only, (jnp.asarray(x),), order=1, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_derivatives_of_portals(x64, rng):
    position, normal, view = (a[1:4] for a in scene(rng, 4))
    slices = slices_of("glossy", 4, "float64")

    def shade(points, e, position, normal, view):
        return shading.shade(slices, models.PortalLight(points, e), shading.Surface(normal, view, position))

    check_grads(shade, (QUAD, rng.normal(size=9), position, normal, view), order=1, rtol=1e-6, atol=1e-8)
    project = lambda points, p: shading.project_light(models.PolygonLight(points), p, domains.HaarBasis(1))
    check_grads(project, (QUAD, position), order=1, rtol=1e-6, atol=1e-8, eps=1e-5)


def test_bad_input_is_named(as_user):
    slices, up = random("float32"), np.asarray([0, 0, 1], np.float32)
    with pytest.raises(ValueError, match="fitted above the horizon"):
        shading.shade(slices, models.DistantLight(np.ones(9, np.float32)), shading.Surface(up, up))
    with pytest.raises(ValueError, match="`lights` is empty: pass at least one"):
        shading.shade(slices, [], shading.Surface(up, up, up))
    with pytest.raises(ValueError, match="at least 3 points"):
        models.PolygonLight(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="`emission` must be"):
        models.PolygonLight(QUAD, np.ones((2, 3)))
    with pytest.raises(ValueError, match="`light` must be"):
        shading.project_light(QUAD, up, 2)
    with pytest.raises(ValueError, match="`light` must be a models.PolygonLight or PortalLight; got SphereLight"):
        shading.project_light(models.SphereLight(up, 0.5), up, 2)
    with pytest.raises(ValueError, match="`lights` must be one of models.*PortalLight.*; got SphericalPolygon"):
        shading.shade(slices, domains.SphericalPolygon(np.eye(3)), shading.Surface(up, up, up))
    with pytest.raises(ValueError, match="`surface` needs `positions`"):
        shading.shade(slices, models.PortalLight(QUAD, np.ones(4)), shading.Surface(up, up))
    with pytest.raises(ValueError, match="do not broadcast"):
        models.PolygonLight(QUAD, np.ones(2), profile=np.ones((3, 4)))
    with pytest.raises(ValueError, match="`domain` must be"):
        shading.tabulate_brdf(models.Lambertian(0.5), 2, domain="lower")
