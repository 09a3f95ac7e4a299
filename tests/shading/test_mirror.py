"""Mirrors: footprints against finite differences of mirror directions, filters against quadrature over the Gaussian."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import harmonics, models, shading
from tests.hard_cases import unit
from tests.marks import FLOAT32_FIRST, FLOAT64_FIRST
from tests.truth import scipy_basis

DEGREE = 6
EYE = np.array([0.3, -0.2, 4.0])


def on_surface(columns, rows, size, surface):
    """Normals and positions where rays through a pinhole at EYE meet a surface z(x, y), in float64."""
    scale = 0.5 / size
    rays = np.stack([(columns - size / 2) * scale, -(rows - size / 2) * scale, -np.ones_like(columns)], axis=-1)
    distance = np.full(columns.shape, 3.0)
    for _ in range(60):  # Newton, z(x, y) = height
        x = EYE + distance[..., None] * rays
        height, slope_x, slope_y = surface(x[..., 0], x[..., 1])
        normal = np.stack([-slope_x, -slope_y, np.ones_like(height)], axis=-1)
        distance = distance - (x[..., 2] - height) / np.sum(normal * rays, axis=-1)
    return unit(normal), EYE + distance[..., None] * rays


def sphere(x, y):
    z = np.sqrt(2.5**2 - x * x - y * y)
    return z - 1.5, -x / z, -y / z


SURFACES = {
    "sphere": sphere,
    "ellipsoid": lambda x, y: (
        lambda z: (0.6 * z, 0.6 * -0.5 * x / z, 0.6 * -0.2 * y / z)
    )(np.sqrt(2 - 0.5 * x * x - 0.2 * y * y)),
    "saddle": lambda x, y: (0.3 * x * y + 0.1 * x * x, 0.3 * y + 0.2 * x, 0.3 * x),
    "plane": lambda x, y: (0.2 * x - 0.1 * y, 0.2 + 0 * x, -0.1 + 0 * x),
}  # fmt: skip


def mirror_directions(columns, rows, size, surface):
    n, x = on_surface(columns, rows, size, surface)
    o = unit(EYE - x)
    return 2 * np.sum(n * o, axis=-1, keepdims=True) * n - o


def pixel_grid(size):
    columns, rows = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    return columns, rows


def exact_axes(size, surface, width=0.5, step=1e-4):
    columns, rows = pixel_grid(size)
    at = lambda i, j: mirror_directions(columns + i, rows + j, size, surface)
    difference = lambda i, j: (at(i, j) - at(-i, -j)) * (width / (2 * step))
    return at(0, 0), np.stack([difference(step, 0), difference(0, step)], axis=-1)


def made(size, surface, dtype, seen=None):
    n, x = on_surface(*pixel_grid(size), size, surface)
    seen = np.ones((size, size), bool) if seen is None else seen
    return shading.footprint(n.astype(dtype), x.astype(dtype), EYE.astype(dtype), seen)


@FLOAT64_FIRST
@pytest.mark.parametrize("name", SURFACES)
def test_footprints_from_images_are_derivatives_of_the_mirror_direction(name, dtype):
    errors = []
    for size in (16, 32):
        directions, axes = exact_axes(size, SURFACES[name])
        got = made(size, SURFACES[name], dtype)
        assert got.directions.dtype == got.axes.dtype == dtype
        np.testing.assert_allclose(got.directions, directions, atol=1e-6)
        error = np.linalg.norm(got.axes - axes, axis=(-2, -1)) / np.linalg.norm(axes, axis=(-2, -1))
        half = slice(size // 4, -size // 4)
        errors.append((np.max(error), np.max(error[1:-1, 1:-1]), np.max(error[half, half])))
    assert errors[1][0] < 0.03 and errors[1][1] < 2e-3, errors
    if dtype == np.float64:  # first order at the border, second order inside
        assert errors[1][0] < 0.65 * errors[0][0] and errors[1][2] < 0.3 * errors[0][2], errors


def test_footprints_from_derivatives_are_exact(x64):
    size, step = 8, 1e-4
    columns, rows = pixel_grid(size)
    at = lambda i, j: on_surface(columns + i, rows + j, size, SURFACES["saddle"])
    dn, dx = (
        np.stack([(at(step, 0)[k] - at(-step, 0)[k]), (at(0, step)[k] - at(0, -step)[k])], axis=-1) / (2 * step)
        for k in (0, 1)
    )
    n, x = at(0, 0)
    directions, axes = exact_axes(size, SURFACES["saddle"], width=0.7)
    got = shading.Footprint.from_derivatives(3 * n, x, EYE, 3 * dn, dx, filter_width=0.7)
    np.testing.assert_allclose(got.directions, directions, atol=1e-13)
    np.testing.assert_allclose(got.axes, axes, atol=1e-9)


@FLOAT32_FIRST
def test_surfaces_do_not_mix_at_a_silhouette(dtype):
    """A near plane covers a part of a curved surface: away from the rim nothing changes, at it each keeps its own."""
    size = 24
    cover = np.hypot(*(p - 12 for p in pixel_grid(size))) < 6
    near = lambda x, y: (2 + 0.2 * x, 0.2 + 0 * x, 0 * y)
    n, x = (np.where(cover[..., None], a, b) for a, b in zip(
        on_surface(*pixel_grid(size), size, near), on_surface(*pixel_grid(size), size, SURFACES["sphere"]), strict=True
    ))  # fmt: skip
    got = shading.footprint(n.astype(dtype), x.astype(dtype), EYE.astype(dtype), np.ones_like(cover))
    axes = np.where(cover[..., None, None], exact_axes(size, near)[1], exact_axes(size, SURFACES["sphere"])[1])
    error = np.linalg.norm(got.axes - axes, axis=(-2, -1)) / np.linalg.norm(axes, axis=(-2, -1))
    assert np.max(error) < 0.05


SIZE = 5
SEEN = np.ones((SIZE, SIZE), bool)
SEEN[2:, 2] = SEEN[4, 3:] = SEEN[3, :2] = False  # leaves [4, :2] one neighbour each


@functools.cache
def weighted_footprints():
    """A sum of all parts of footprints, compiled once."""
    weights = np.random.default_rng(1).normal(size=(SIZE, SIZE, 3, 3))

    @jax.jit
    def total(n, x, eye, width):
        footprint = shading.footprint(n, x, eye, SEEN, filter_width=width)
        return jnp.sum(footprint.axes * weights[..., :2]) + jnp.sum(footprint.directions * weights[..., 2])

    return total


@pytest.mark.parametrize("name", ["plane", "ellipsoid"])
def test_derivatives_of_footprints(name, x64):
    """Also of a flat mirror, whose shape operator is zero, and of pixels with a single neighbour."""
    n, x = (jnp.asarray(a) for a in on_surface(*pixel_grid(SIZE), SIZE, SURFACES[name]))
    arguments = n, x, jnp.asarray(EYE), jnp.asarray(0.5)
    check_grads(weighted_footprints(), arguments, order=1, modes=["rev"], atol=1e-5, rtol=1e-5, eps=1e-6)


def test_what_is_not_seen_does_not_matter(x64):
    n, x = on_surface(*pixel_grid(SIZE), SIZE, SURFACES["saddle"])
    values, slopes = [], []
    for other in (0, 7, np.nan):
        arguments = (jnp.asarray(np.where(SEEN[..., None], a, other)) for a in (n, x))
        value, pull = jax.vjp(weighted_footprints(), *arguments, jnp.asarray(EYE), jnp.asarray(0.5))
        values.append(value)
        slopes.append(pull(jnp.ones_like(value)))
    assert values[0] == values[1] == values[2]
    for given in slopes:
        jax.tree.map(np.testing.assert_array_equal, given, slopes[0])
        assert all(np.all(np.isfinite(slope)) for slope in given)


def test_pixels_without_neighbours():
    seen = np.zeros((SIZE, SIZE), bool)
    seen[2, 2] = True
    n, x = (a.astype(np.float32) for a in on_surface(*pixel_grid(SIZE), SIZE, SURFACES["saddle"]))
    got = shading.footprint(n, x, EYE.astype(np.float32), seen)
    np.testing.assert_array_equal(got.axes, 0)
    np.testing.assert_array_equal(np.asarray(got.directions)[~seen], np.broadcast_to([0, 0, -1], (SIZE**2 - 1, 3)))
    expected = mirror_directions(*pixel_grid(SIZE), SIZE, SURFACES["saddle"])[2, 2]
    np.testing.assert_allclose(got.directions[2, 2], expected, atol=1e-6)


# ---- filters


def quadrature(e, directions, axes, degree):
    """Mean of the light over a Gaussian in the tangent plane, carried along great circles: Gauss-Hermite."""
    node, weight = np.polynomial.hermite_e.hermegauss(40)
    z = np.stack(np.meshgrid(node, node), axis=-1).reshape(-1, 2)
    w = np.outer(weight, weight).ravel() / np.sum(weight) ** 2
    z, w = z[w > 1e-12], w[w > 1e-12]
    v = np.einsum("pij,zj->pzi", axes, z)
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    around = np.cos(angle) * directions[:, None] + np.sinc(angle / np.pi) * v
    return np.einsum("z,pzn,cn->pc", w, scipy_basis(around, degree), e)


def footprints(rng, major, ratio, count=12):
    """Of one shape, turned at random; the first two at the poles."""
    r = unit(rng.normal(size=(count, 3)))
    r[:2] = [[0, 0, 1], [0, 0, -1]]
    tangents = np.linalg.qr(np.concatenate([r[:, :, None], rng.normal(size=(count, 3, 2))], axis=2))[0][:, :, 1:]
    angle = rng.uniform(0, np.pi, count)
    turn = np.stack([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]).transpose(2, 0, 1)
    return r, tangents @ np.diag([major, major * ratio]) @ turn


def light(rng, degree):
    bands = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    return rng.normal(size=(3, (degree + 1) ** 2)) / (1 + bands)


@pytest.mark.parametrize("anisotropic", [False, True])
def test_filters_against_quadrature(anisotropic, dtype, rng):
    e = light(rng, DEGREE)
    for major, ratio in ((0, 1), (0.05, 1), (0.2, 1), (0.3, 0.25), (0.2, 0)):
        if not anisotropic and ratio != 1:
            continue
        r, axes = footprints(rng, major, ratio)
        expected = quadrature(e, r, axes, DEGREE)
        footprint = shading.Footprint(r.astype(dtype), axes.astype(dtype))
        got = shading.reflect(footprint, models.DistantLight(e.astype(dtype)), anisotropic=anisotropic)
        assert got.dtype == dtype and got.shape == (12, 3)
        # of the largest radiance; a round Gaussian is one factor for each band either way
        tolerance = (2e-6 if dtype == np.float32 else 1e-12) + (0.06 if ratio == 1 else 0.15) * major**2
        np.testing.assert_allclose(got, expected, atol=tolerance * np.max(np.abs(expected)), err_msg=f"{major} {ratio}")


def test_round_is_the_mean_over_turns(x64, rng):
    """One Gaussian of the mean variance keeps what does not depend on orientation, to first order."""
    e, (r, axes) = light(rng, DEGREE), footprints(rng, 0.1, 0.5)
    got = shading.reflect(shading.Footprint(r, axes), models.DistantLight(e))
    turned = np.stack([axes, np.cross(r[:, :, None], axes, axis=1)])
    expected = np.mean([quadrature(e, r, a, DEGREE) for a in turned], axis=0)
    np.testing.assert_allclose(got, expected, atol=3e-3 * np.max(np.abs(expected)))


def test_the_gauss_weierstrass_kernel_is_nearer_than_others():
    """Zonal coefficients of a Gaussian carried along great circles, beside those of exp(k (cos - 1)) of that width."""
    width, degree = 0.1, 30
    node, weight = np.polynomial.legendre.leggauss(300)
    psi, weight = (node + 1) / 2, weight / 2
    legendre = np.polynomial.legendre.legvander(np.cos(psi), degree)
    mean = lambda density: density @ legendre / np.sum(density)
    true = mean(weight * psi * np.exp(-(psi**2) / (2 * width**2)))
    von_mises_fisher = mean(weight * np.sin(psi) * np.exp((np.cos(psi) - 1) / width**2))
    l = np.arange(degree + 1)
    axes = width * np.eye(3)[:, :2]
    e = np.stack([np.eye((degree + 1) ** 2)[k * k + k] / np.sqrt((2 * k + 1) / (4 * np.pi)) for k in l])
    footprint = shading.Footprint(np.float32([0, 0, 1]), np.float32(axes))
    ours = shading.reflect(footprint, models.DistantLight(np.float32(e)))
    assert np.max(np.abs(ours - true)) < 0.07 * width**2 < np.max(np.abs(von_mises_fisher - true))


@pytest.mark.slow
def test_degree_100_in_float32(rng):
    degree = 100
    e, (r, axes) = light(rng, degree).astype(np.float32), footprints(rng, 0.02, 0.5, count=60)
    l = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    variance = np.sum(axes**2, axis=(1, 2)) / 2
    kept = np.exp(-np.outer(variance, l * (l + 1)) / 2)
    r32 = r.astype(np.float32)
    expected = np.einsum("pn,cn->pc", kept * scipy_basis(r32.astype(float), degree), e)
    got = shading.reflect(shading.Footprint(r32, axes.astype(np.float32)), models.DistantLight(e))
    np.testing.assert_allclose(got, expected, atol=5e-5 * np.max(np.abs(expected)))


def hard_footprints(rng):
    """Round at one pole, points at the other and elsewhere, thin ones, and one of no special shape."""
    r, axes = footprints(rng, 0.2, 0.4, count=5)
    axes[0] = footprints(rng, 0.2, 1, count=5)[1][0]
    axes[1:3] = 0
    axes[3] *= [1, 0]
    return r, axes


def filter_of(r, e, anisotropic):
    """Radiance by tangent vectors at `r`, axes and light."""

    @jax.jit
    def radiance(v, axes, e):
        footprint = shading.Footprint(r + v - jnp.sum(v * r, axis=1, keepdims=True) * r, axes)
        return shading.reflect(footprint, models.DistantLight(e), anisotropic=anisotropic)

    return radiance


@pytest.mark.slow
@pytest.mark.parametrize("anisotropic", [False, True])
def test_derivatives_of_filters(anisotropic, x64, rng):
    e, (r, axes) = jnp.asarray(light(rng, 2)), hard_footprints(rng)
    arguments = jnp.zeros_like(r), jnp.asarray(axes), e
    check_grads(filter_of(r, e, anisotropic), arguments, order=1, modes=["rev"], atol=1e-6, rtol=1e-6, eps=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("anisotropic", [False, True])
def test_second_derivatives_of_filters(anisotropic, x64, rng):
    """Away from the poles, where they are NaN."""
    e, (r, axes) = jnp.asarray(light(rng, 2)), hard_footprints(rng)
    r[:2], axes[:2] = footprints(rng, 0.2, 1, count=4)[0][2:], 0
    arguments = jnp.zeros_like(r), jnp.asarray(axes), e
    check_grads(filter_of(r, e, anisotropic), arguments, order=2, atol=1e-4, rtol=1e-4, eps=1e-4)


@pytest.mark.parametrize("anisotropic", [False, True])
def test_tiles_and_batches(anisotropic, rng):
    e, (r, axes) = models.DistantLight(light(rng, 3).astype(np.float32)), footprints(rng, 0.1, 0.5, count=530)
    r, axes = r.astype(np.float32), axes.astype(np.float32)
    axes[7] = np.nan
    shade = jax.jit(lambda r, a: shading.reflect(shading.Footprint(r, a), e, anisotropic=anisotropic))
    whole = shade(r, axes)
    assert np.all(np.isnan(whole[7])) and np.all(np.isfinite(np.delete(whole, 7, axis=0)))
    np.testing.assert_allclose(jax.vmap(shade)(r[:4].reshape(2, 2, 3), axes[:4].reshape(2, 2, 3, 2)).reshape(4, 3),
                               whole[:4], atol=1e-5)  # fmt: skip
    assert shade(r[:0], axes[:0]).shape == (0, 3)


# ---- maps


def test_filtered_maps_against_quadrature(rng):
    degree, height = 8, 128
    e = light(rng, degree).astype(np.float32)
    maps = shading.MirrorMaps.from_texels(harmonics.synthesize_map(e, height), levels=25)
    for major, ratio, tolerance in ((0, 1, 2e-3), (0.1, 1, 3e-3), (0.15, 0.5, 4e-3), (0.2, 0.25, 2e-2)):
        r, axes = footprints(rng, major, ratio)
        expected = quadrature(e, r, axes, degree)
        footprint = shading.Footprint(r.astype(np.float32), axes.astype(np.float32))
        got = shading.reflect(footprint, maps)
        error = np.max(np.abs(got - expected)) / np.max(np.abs(expected))
        assert error < tolerance, f"{major} {ratio}: {error}"


@pytest.mark.slow
def test_derivatives_of_filtered_maps(x64, rng):
    """Within texels, of round, pointlike and thin footprints; the direction of a point is that of its texel."""
    maps = shading.MirrorMaps.from_texels(harmonics.synthesize_map(light(rng, 4), 16), levels=5)
    r, axes = footprints(rng, 0.3, 0.4, count=6)
    axes[2], axes[3] = footprints(rng, 0.2, 1, count=6)[1][2], 0
    shade = jax.jit(lambda r, a: shading.reflect(shading.Footprint(r, a), maps))
    check_grads(shade, (jnp.asarray(r[2:]), jnp.asarray(axes[2:])), order=1, atol=1e-5, rtol=1e-5, eps=1e-7)


def test_errors_name_the_argument(as_user):
    image, seen, eye = np.ones((4, 5, 3), np.float32), np.ones((4, 5), bool), np.ones(3, np.float32)
    footprint = shading.Footprint(jnp.ones((4, 3)), jnp.ones((4, 3, 2)))
    sky, maps = models.DistantLight(np.ones(4, np.float32)), shading.MirrorMaps.from_texels(np.ones((4, 8), np.float32))
    cases = [
        (lambda: shading.footprint(image, image[:3], eye, seen), r"`normals` and `positions` must have shape"),
        (lambda: shading.footprint(image, image, eye, seen.astype(int)), r"`seen` \[H, W\], bool; got"),
        (lambda: shading.footprint(image, image, image, seen), r"`eye` must have shape \[3\]"),
        (lambda: shading.footprint(image, image, eye, seen, filter_width=eye), "`filter_width` must be"),
        (
            lambda: shading.Footprint.from_derivatives(image, image, eye, image, image),
            r"`normal_derivatives` must have shape \[..., 3, 2\]",
        ),
        (lambda: shading.reflect(image, sky), "`footprint` must come from shading.footprint"),
        (lambda: models.DistantLight(np.ones(5, np.float32)), "`coefficients` must have"),
        (lambda: shading.Footprint(eye, image), r"`axes` must have shape \[..., 3, 2\]; got \[4, 5, 3\]"),
        (
            lambda: shading.reflect(shading.Footprint(image, np.ones((3, 2))), sky),
            r"`footprint.axes` must have shape \[4, 5, 3, 2\]; got \[3, 2\]",
        ),
        (lambda: shading.reflect(footprint, image), "`light` must be a models.DistantLight or shading.MirrorMaps"),
        (lambda: shading.reflect(footprint, maps, anisotropic=True), "`anisotropic` belongs to a DistantLight"),
        (lambda: shading.MirrorMaps.from_texels(image), r"`texels` must have shape \[H, 2H\]"),
        (lambda: shading.MirrorMaps.from_texels(np.ones((4, 8), np.float32), levels=1), "`levels` must be >= 2"),
    ]  # fmt: skip
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()
