"""Slices beyond maps of directions under polygons: exact integrals of them, and how near they are to materials."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import models, shading
from tests import truth
from tests.hard_cases import unit
from tests.marks import FLOAT64_FIRST

LAMP = np.array([[-0.9, 1.1, 1.8], [1, 1, 1.6], [1.2, -0.8, 1.4], [-1.0, -1, 1.5]])
DEGREE, VIEWS = 3, 8


def random_slices(dtype, isotropic=True, colour=()):
    """Smooth ones, as those of materials: of order m like sin(theta)^m."""
    rng = np.random.default_rng(4)

    def smooth(degree, size, colour=()):
        theta = (np.arange(VIEWS) + 0.5) * np.pi / (2 * VIEWS)
        l = np.concatenate([[l] * (2 * l + 1) for l in range(degree + 1)])
        m = np.concatenate([np.arange(-l, l + 1) for l in range(degree + 1)])
        start, change = size * rng.normal(size=(2, *colour, 1, len(m))) / (1 + l)
        kept = m >= 0 if isotropic else np.ones_like(m)
        c = (start + change * np.cos(theta)[:, None]) * np.sin(theta)[:, None] ** np.abs(m) * kept
        if isotropic:
            return c.astype(dtype)
        phi = 2 * np.pi * np.arange(12) / 12
        turns = 1 + 0.3 * np.sin(theta)[:, None, None] ** 2 * np.cos(2 * phi)[:, None]
        return (c[..., :, None, :] * turns).astype(dtype)

    maps, lobes, base = smooth(2, 1.0), smooth(DEGREE, 1.0, colour), smooth(2, 1.0, colour)
    return shading.TransformedSlices(maps[..., 4:], lobes, base, isotropic=isotropic)


def scene(rng):
    """Points with the lamp above, across the horizon and behind, views at and near the normal and the horizon."""
    normals = unit(np.array([[0, 0, 1.0], [0.1, 0.2, 1], [-0.8, 0.1, 0.3], [0, 0.9, 0.2], [0, 0, 1], [0.2, 0.1, 1]]))
    positions = np.array([[0, 0, 0.0], [0.3, 0.2, 0], [0.1, 0, 0.2], [-0.4, 0.6, 0.1], [0.2, -0.5, 0], [0, 0, 3]])
    views = unit(normals + 0.9 * unit(rng.normal(size=(6, 3))))
    views[0] = normals[0]
    views[4] = unit(normals[4] + [30, 10, 0])
    return positions, normals, views


@jax.jit
def radiance(slices, lamp, position, normal, view):
    tangents = jnp.cross(normal, jnp.asarray([0.3, 0.9, -0.2], normal.dtype)[None])
    surface = shading.Surface(normal, view, position, tangents=None if slices.isotropic else tangents)
    return shading.shade(slices, models.PolygonLight(lamp), surface)


def expected(slices, lamp, position, normal, view):
    values = []
    for p, n, v in zip(position, normal, view, strict=True):
        frame = truth.frame_of(np.asarray(n, np.longdouble))
        if not slices.isotropic:
            t = unit(np.cross(n, [0.3, 0.9, -0.2]))
            frame = np.stack([t, np.cross(n, t), n])
        outline = truth.outline_above(lamp, p, frame)
        if outline is None:
            values.append(np.zeros(slices.colour))
            continue
        w, area = truth.triangle_rule(outline, 24)
        lobe = slices.at(jnp.asarray(frame @ v, slices.coefficients.dtype))
        values.append(-np.asarray(lobe.evaluate(w.astype(float)), float) @ area.astype(float))
    return np.array(values)


@FLOAT64_FIRST
@pytest.mark.parametrize("isotropic", [True, False])
def test_integrals_are_exact(isotropic, dtype, rng):
    geometry = scene(rng)
    with jax.enable_x64(True):
        want = expected(random_slices(np.float64, isotropic), LAMP, *geometry)
    got = radiance(random_slices(dtype, isotropic), *(a.astype(dtype) for a in (LAMP, *geometry)))
    assert got.dtype == dtype and got[5] == 0 and np.min(np.abs(want[:5])) > 1e-3
    np.testing.assert_allclose(got, want, rtol=0, atol=(1e-6 if dtype == np.float32 else 3e-15) * np.max(np.abs(want)))


@pytest.mark.parametrize("isotropic", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_derivatives_in_everything(isotropic, x64, rng):
    """Against differences, also where the view lies along the normal."""
    slices, arguments = random_slices(np.float64, isotropic), (LAMP, *scene(rng))
    weights = rng.normal(size=6)
    total = lambda *arguments: weights @ radiance(*arguments)
    gradients = jax.jit(jax.grad(total, argnums=range(5)))(slices, *arguments)
    for i, gradient in enumerate(gradients):
        move = jax.tree.map(lambda a: 0.3 * rng.normal(size=a.shape), gradient)
        if i == 0:  # of which only what is even across the plane of view means something
            even = lambda c, m: c * (m >= 0) if isotropic else c
            orders = lambda degree: np.concatenate([np.arange(-l, l + 1) for l in range(degree + 1)])
            move = shading.TransformedSlices(
                even(move.maps, np.arange(-2, 3)), even(move.coefficients, orders(DEGREE)), even(move.base, orders(2)),
                isotropic=isotropic,
            )  # fmt: skip

        def at(t, i=i, move=move):
            moved = [slices, *arguments]
            moved[i] = jax.tree.map(lambda a, b: a + t * b, moved[i], move)
            return total(*moved)

        step = 1e-4
        want = (8 * (at(step) - at(-step)) - at(2 * step) + at(-2 * step)) / (12 * step)
        parts = [np.sum(np.asarray(g) * m) for g, m in zip(*map(jax.tree.leaves, (gradient, move)), strict=True)]
        if i == 0:
            parts = parts[:3]  # errors have no part in radiance
        np.testing.assert_allclose(sum(parts), want, atol=1e-8 * (1 + abs(want)), err_msg=str(i))


def test_views_are_looked_up_at_their_nodes(dtype):
    """At the nodes of the table slices are those of the table, turned with the view."""
    slices = random_slices(dtype, colour=(3,))
    theta = (np.arange(VIEWS) + 0.5) * np.pi / (2 * VIEWS)
    for j in (0, 3, VIEWS - 1):
        lobe = slices.at(unit(np.array([np.sin(theta[j]), 0, np.cos(theta[j]) / 3])).astype(dtype))
        error = 2e-6 if dtype == np.float32 else 1e-14
        np.testing.assert_allclose(lobe.coefficients, slices.coefficients[:, j], atol=error)
        np.testing.assert_allclose(lobe.base, slices.base[:, j], atol=error)
        turned = slices.at(unit(np.array([0, np.sin(theta[j]), np.cos(theta[j]) / 3])).astype(dtype))
        w = unit(np.random.default_rng(0).normal(size=(20, 3))).astype(dtype)
        np.testing.assert_allclose(
            turned.evaluate(w @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], dtype)), lobe.evaluate(w), atol=30 * error
        )


# ---- materials


def slice_error(slices, brdf, theta):
    """Of what is interpolated, over the norm of the first colour's slice, [*colour]."""
    view = np.array([np.sin(theta), 0, np.cos(theta)])
    x, weight = np.polynomial.legendre.leggauss(48)
    x, weight = (x + 1) / 2, weight / 2
    mirror, up, side = np.array([-view[0], 0, view[2]]), np.array([view[2], 0, view[0]]), np.array([0, 1, 0])
    chi, width = np.concatenate([(k + x) * np.pi / 16 for k in range(32)]), float(brdf.lobe_width) * 0.5
    reach = np.arcsinh(np.arctan2(view[2], -view[0] * np.cos(chi)) / width)
    psi = width * np.sinh(np.outer(reach, x))
    area = (
        np.sin(psi) * width * np.cosh(np.outer(reach, x)) * np.outer(reach * np.tile(weight, 32), weight) * np.pi / 16
    )
    ring = np.outer(np.cos(chi), up) + np.outer(np.sin(chi), side)
    w = (np.cos(psi)[..., None] * mirror + np.sin(psi)[..., None] * ring[:, None]).reshape(-1, 3)
    share = (1 - unit(w + view) @ view) ** 5
    f = truth.ggx_cosine(w, view, float(brdf.alpha)) / (0.04 + 0.96 * share)
    got = np.asarray(slices.at(view.astype(np.float32)).evaluate(w.astype(np.float32)))
    norm = np.sqrt(np.sum(f**2 * area.ravel()))
    return [np.sqrt(np.sum((g - e) ** 2 * area.ravel())) / norm for g, e in zip(got, (f, f * share), strict=False)]


@functools.cache
def made(alpha, degree):
    return shading.transform_brdf(models.Ggx(np.float32(alpha), np.float32([1, 0, 0.5])), degree)


MEASURED = {  # of the slices for F = 1, at 60, 75 and 85 degrees
    (0.02, 4): (3e-4, 1.1e-3, 8.8e-3), (0.05, 4): (1.2e-3, 5.9e-3, 3.3e-2), (0.1, 4): (4.5e-3, 1.6e-2, 6.5e-2),
    (0.25, 4): (9.3e-3, 3.0e-2, 7.1e-2), (0.5, 4): (6.5e-3, 1.5e-2, 3.0e-2),
    (0.02, 8): (2e-4, 5e-4, 3.6e-3), (0.05, 8): (6e-4, 1.9e-3, 2.0e-2), (0.1, 8): (1.3e-3, 3.6e-3, 2.2e-2),
    (0.25, 8): (1.4e-3, 6.1e-3, 2.4e-2), (0.5, 8): (1.2e-3, 3.6e-3, 1.2e-2),
}  # fmt: skip
NEEDED = {4: (1.5e-2, 5e-2, 1e-1), 8: (2.5e-3, 1.3e-2, 4.5e-2)}


@pytest.mark.parametrize(
    ("alpha", "degree"), [pytest.param(*e, marks=() if e == (0.1, 4) else pytest.mark.slow) for e in MEASURED]
)
def test_slices_of_ggx_between_the_nodes(alpha, degree):
    """For F = 1 and the Fresnel term of Schlick, over the norm for F = 1."""
    slices, brdf = made(alpha, degree), models.Ggx(np.float32(alpha))
    limits = [
        min(1.5 * measured, needed) for measured, needed in zip(MEASURED[alpha, degree], NEEDED[degree], strict=True)
    ]
    for theta, limit in zip((20.3, 60, 75, 85), (limits[0], *limits), strict=True):
        assert max(slice_error(slices, brdf, np.radians(theta))) < limit, theta
    assert max(slice_error(slices, brdf, np.radians(89.9))) < 0.25
    assert np.max(np.asarray(slices.errors)[0, :21]) < limits[0]


@pytest.mark.slow
def test_gradients_in_the_material(x64):
    """Of radiance in the roughness, through the fit, against differences."""
    geometry = scene(np.random.default_rng(0))

    def total(alpha):
        slices = shading.transform_brdf(models.Ggx(alpha, 1.0), 2, elevations=8, quadrature=16)
        return jnp.sum(radiance(slices, LAMP, *geometry))

    slope = jax.jit(jax.grad(total))(jnp.asarray(0.3))
    step = 1e-3
    at = jax.jit(total)
    want = (at(0.3 + step) - at(0.3 - step)) / (2 * step)
    np.testing.assert_allclose(slope, want, rtol=5e-3)


@pytest.mark.slow
def test_brushed_materials():
    brdf = models.Ggx(np.float32([0.1, 0.3]), np.float32(1))
    slices = shading.transform_brdf(brdf, 4, elevations=12, azimuths=16, quadrature=12)
    assert slices.maps.shape == (12, 16, 5) and not slices.isotropic
    error = np.asarray(slices.errors)
    assert np.max(error[0]) < 0.01 and np.max(error[:6]) < 0.1 and np.max(error) < 0.3


def test_prepared_materials_take_them_under_lamps(as_user, rng):
    slices = random_slices(np.float32)
    plain = shading.Slices(np.zeros((8, 16), np.float32), domain="upper")
    position, normal, view = (a.astype(np.float32) for a in scene(rng))
    surface, lamp = shading.Surface(normal, view, position), models.PolygonLight(LAMP.astype(np.float32))
    both = shading.Material(None, plain, slices)
    np.testing.assert_array_equal(shading.shade(both, lamp, surface), shading.shade(slices, lamp, surface))
    window = models.PortalLight(LAMP.astype(np.float32), np.ones(4, np.float32))
    assert np.all(np.asarray(shading.shade(both, window, surface)) == 0)
    with pytest.raises(ValueError, match="only slices beyond maps, which do not go with a PortalLight"):
        shading.shade(slices, window, surface)
    with pytest.raises(ValueError, match="`lamps` must be shading.TransformedSlices"):
        shading.Material(None, plain, plain)
    with pytest.raises(ValueError, match="of an isotropic and an anisotropic material"):
        shading.Material(None, plain, random_slices(np.float32, isotropic=False))


def test_errors_name_the_argument(as_user):
    maps, c, base = np.zeros((8, 5)), np.zeros((3, 8, 9)), np.zeros((3, 8, 9))
    with pytest.raises(ValueError, match=r"`maps` must have shape \[V, 5\].*got \[8, 4\]"):
        shading.TransformedSlices(maps[:, :4], c, base)
    with pytest.raises(ValueError, match=r"`maps` \[7, 5\] and `coefficients` \[3, 8, 9\] are of other views"):
        shading.TransformedSlices(maps[:7], c, base)
    with pytest.raises(ValueError, match=r"`base` must have shape \[3, 8, 9\]; got \[3, 8, 4\]"):
        shading.TransformedSlices(maps, c, base[..., :4])
    with pytest.raises(ValueError, match="`brdf` must be a models.AbstractBrdf; got float"):
        shading.transform_brdf(0.3, 4)


def test_gradients_in_one_field_are_those_in_all(x64, rng):
    c, maps = rng.normal(size=(2, 8, 9)), 0.1 * rng.normal(size=(8, 5))
    slices = shading.TransformedSlices(maps, c[0], c[1])
    lamp = models.PolygonLight(np.array([[-0.5, -0.5, 1.5], [-0.5, 0.5, 1.5], [0.5, 0.5, 1.5], [0.5, -0.5, 1.5]]))
    surface = shading.Surface(np.array([0.0, 0, 1]), np.array([0.6, 0, 0.8]), np.zeros(3))
    total = jax.jit(lambda slices: shading.shade(slices, lamp, surface))
    whole = jax.grad(total)(slices)
    for name in ("maps", "coefficients", "base"):
        field = lambda s, name=name: getattr(s, name)
        alone = jax.grad(lambda x, field=field: total(eqx.tree_at(field, slices, x)))(field(slices))
        assert np.max(np.abs(alone)) > 1e-3
        np.testing.assert_allclose(alone, field(whole), rtol=1e-12, atol=1e-14)
