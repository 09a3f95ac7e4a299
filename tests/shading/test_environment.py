"""ISD15 Eq. 22 against its own literal form, against quadrature, and in its derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import decomposition, models, shading
from tests.truth import scipy_basis

DEGREE = 6
COUNT = 128
SLOW = pytest.mark.slow  # the same check on more cases; each compiles for many seconds
SINGLE, DOUBLE = np.dtype("float32"), np.dtype("float64")


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def scene(rng, count, dtype, colour=(3,)):
    """Random light, normals and views above the horizon, tangents."""
    normals, tangents = unit(rng.normal(size=(count, 3))), unit(rng.normal(size=(count, 3)))
    views = unit(rng.normal(size=(count, 3)))
    views *= np.where(np.sum(views * normals, axis=1) < 0, -1, 1)[:, None]
    light = rng.normal(size=(*colour, (DEGREE + 1) ** 2))
    return tuple(a.astype(dtype) for a in (light, normals, views, tangents))


def tabulate(brdf, **options):
    return shading.tabulate_brdf(brdf, DEGREE, elevations=16, azimuths=8, **options)


def shade(material, coefficients, normals, views, tangents=None):
    surface = shading.Surface(normals, views, tangents=tangents)
    return shading.shade(material, models.DistantLight(coefficients), surface)


@functools.cache
def slices_of(material, dtype=SINGLE):
    """Tabulated once per precision; called with x64 switched as the dtype says."""
    return tabulate(MATERIALS[material]())


def any_frame(normal):
    """Columns t, b, n: a frame of another make than the library's."""
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    t = unit(np.cross(helper, normal))
    return np.stack([t, np.cross(normal, t), normal], axis=-1)


def basis():
    return decomposition.RotatedZonalBasis(decomposition.fibonacci_directions(2 * DEGREE + 1), DEGREE)


def equation_22(axes, weights, light, rotation):
    """sum over l, k of pi_l lambda_l^k sum over m of e_l^m y_l^m(R z_k), with SciPy's harmonics, in float64."""
    y = scipy_basis(axes @ rotation.T, DEGREE)
    total = 0.0
    for l in range(DEGREE + 1):
        band = slice(l * l, (l + 1) ** 2)
        total = total + np.sqrt(4 * np.pi / (2 * l + 1)) * np.sum(
            weights[..., l, :] * (light[..., band] @ y[:, band].T), -1
        )
    return total


MATERIALS = {
    "diffuse": lambda: models.Lambertian([0.2, 0.5, 0.8]),
    "glossy": lambda: models.Ggx(0.4, 0.3),
    "brushed": lambda: models.Ggx([0.3, 0.6], [0.9, 0.6, 0.3]),
}


EACH = [(material, dtype) for material in MATERIALS for dtype in ("float32", "float64")]
SELDOM = (("diffuse", "float32"), ("diffuse", "float64"), ("brushed", "float32"))  # others have the same code


@pytest.mark.parametrize(
    ("material", "dtype"), [pytest.param(*e, marks=SLOW) if e in SELDOM else e for e in EACH], indirect=["dtype"]
)
def test_radiance_is_equation_22(material, dtype, rng):
    slices = slices_of(material, dtype)
    light, normals, views, tangents = scene(rng, COUNT, dtype)
    got = shade(slices, light, normals, views, tangents)
    assert got.shape == (COUNT, 3) and got.dtype == dtype
    frames = []
    for normal, tangent in zip(*(unit(a[:100].astype(float)) for a in (normals, tangents)), strict=True):
        t = unit(tangent - normal * (normal @ tangent))
        frames.append(any_frame(normal) if slices.isotropic else np.stack([t, np.cross(normal, t), normal], axis=-1))
    local = np.einsum("pij,pi->pj", frames, unit(views[:100].astype(float))).astype(dtype)
    axes = np.asarray(basis().directions, float)
    weights = np.asarray(jax.jit(jax.vmap(lambda view: basis().weights(slices.at(view))))(local), float)
    expected = np.array([equation_22(axes, w, light.astype(float), r) for w, r in zip(weights, frames, strict=True)])
    bound = 1e-5 if dtype == np.float32 else 1e-12
    assert np.max(np.abs(got[:100] - expected)) <= bound * np.max(np.abs(expected))


def test_diffuse_surface_in_constant_light(dtype):
    light = jnp.zeros(49, dtype).at[0].set(np.sqrt(4 * np.pi))  # radiance 1 from everywhere
    normals = jnp.asarray(np.concatenate([np.eye(3), -np.eye(3)]), dtype)
    got = shade(tabulate(models.Lambertian(0.7)), light, normals, normals)
    np.testing.assert_allclose(got, 0.7, rtol=3e-6)


@pytest.mark.slow
def test_band_limited_light_against_quadrature(x64, rng):
    """The slice integrated directly against the light, at a tabulated view: no spline, no RZH, no frame of ours."""
    brdf = models.Ggx(0.4, [0.3, 0.5, 0.9])
    slices = tabulate(brdf)
    light, normals, _, _ = scene(rng, 5, np.float64)
    theta, nodes, weights = (3 + 0.5) * np.pi / 32, *np.polynomial.legendre.leggauss(400)
    z, phi = (nodes + 1) / 2, (np.arange(800) + 0.5) * 2 * np.pi / 800
    sine = np.sqrt(1 - z**2)[:, None]
    wi = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.broadcast_to(z[:, None], (400, 800))], axis=-1).reshape(
        -1, 3
    )
    area = np.repeat(weights / 2 * 2 * np.pi / 800, 800)
    wo = jnp.asarray([np.sin(theta), 0, np.cos(theta)])
    kernel = np.asarray(jax.vmap(lambda w: brdf.value_cosine(w, wo))(jnp.asarray(wi)))
    for normal in normals:
        frame = any_frame(normal)
        radiance = scipy_basis(wi @ frame.T, DEGREE) @ light.T
        expected = np.sum(kernel * radiance * area[:, None], axis=0)
        got = shade(slices, light, normal, frame @ np.asarray(wo))
        np.testing.assert_allclose(got, expected, atol=2e-6 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_views_between_the_nodes_are_interpolated_well(x64):
    """Slices at other elevations than the tabulated ones, against a finer table that has them as nodes."""
    brdf = models.Ggx(0.3, 0.04)
    default = shading.tabulate_brdf(brdf, DEGREE)
    finer = shading.tabulate_brdf(brdf, DEGREE, elevations=192)  # every third node is one of the 64
    c = np.asarray(finer.coefficients)
    theta = (np.arange(192) + 0.5) * np.pi / 384
    views = jnp.stack([jnp.sin(theta), 0 * theta, jnp.cos(theta)], axis=-1)
    got = jax.vmap(default.at)(views)
    error = np.max(np.abs(got - c), axis=1) / np.max(np.abs(c))
    assert np.max(error[:-6]) < 1e-5
    assert np.max(error) < 1e-3  # beyond the last node, half a degree above the horizon


@pytest.mark.parametrize(
    "material", ["glossy", pytest.param("diffuse", marks=SLOW), pytest.param("brushed", marks=SLOW)]
)
def test_derivatives_in_every_argument(material, x64, rng):
    slices = slices_of(material, DOUBLE)
    light, normals, views, tangents = (jnp.asarray(a) for a in scene(rng, 3, np.float64))

    weights = slices.weights(basis())

    def radiance(light, normals, views, tangents, axes):
        moved = decomposition.RotatedZonalBasis(axes, DEGREE)
        own = shading.Slices.from_weights(moved, weights, isotropic=slices.isotropic)
        return shade(own, light, normals, views, tangents)

    arguments = (light, normals, views, tangents, basis().directions)
    check_grads(jax.jit(radiance), arguments, order=1, atol=1e-5, rtol=1e-5, eps=1e-5)


@pytest.mark.slow
def test_second_derivatives_in_the_geometry(x64, rng):
    slices = slices_of("glossy", DOUBLE)
    light, normals, views, _ = (jnp.asarray(a) for a in scene(rng, 2, np.float64))
    radiance = lambda n, v: jnp.sum(shade(slices, light, n, v))
    check_grads(radiance, (normals, views), order=2, modes=["rev"], atol=1e-4, rtol=1e-4, eps=1e-5)


OCCT = lambda roughness: models.CookTorrance(roughness, 0.3, [0.7, 0.5, 0.2])


@pytest.mark.slow
@pytest.mark.parametrize("brdf", [models.Ggx, OCCT], ids=["ggx", "occt"])
def test_derivative_in_the_material(brdf, x64, rng):
    light, normals, views, _ = (jnp.asarray(a) for a in scene(rng, 3, np.float64))
    radiance = lambda alpha: shade(tabulate(brdf(alpha), throw=False), light, normals, views)
    check_grads(radiance, (jnp.asarray(0.45),), order=1, modes=["fwd", "rev"], atol=1e-5, rtol=1e-5, eps=1e-4)


@pytest.mark.slow
def test_one_gradient_from_material_and_light_to_a_loss(x64, rng):
    """The chain that fits use: parameters of an anisotropic material -> slices -> picture -> loss."""
    light, normals, views, tangents = (jnp.asarray(a) for a in scene(rng, 4, np.float64))
    values = {"alpha": jnp.asarray([0.6, 0.4]), "f0": jnp.asarray([0.5, 0.3, 0.1]), "light": light[..., :9]}

    @jax.jit
    def loss(p):
        brdf = models.Ggx(p["alpha"], p["f0"])
        slices = shading.tabulate_brdf(brdf, 2, elevations=4, azimuths=8, quadrature=16, throw=False)
        return jnp.mean((shade(slices, p["light"], normals, views, tangents) - 0.3) ** 2)

    gradient = jax.jit(jax.grad(loss))(values)
    for name, x in values.items():
        step = jnp.asarray(rng.normal(size=x.shape))
        slope = (loss(values | {name: x + 1e-5 * step}) - loss(values | {name: x - 1e-5 * step})) / 2e-5
        # The nodes follow the narrower alpha, without gradient: its finite differences see the quadrature's error too.
        tolerance = 1e-4 if name == "alpha" else 1e-7
        np.testing.assert_allclose(jnp.sum(gradient[name] * step), slope, rtol=tolerance, atol=1e-9, err_msg=name)


AXES = {"+z": [0.0, 0, 1], "-z": [0.0, 0, -1], "+x": [1.0, 0, 0]}


@pytest.mark.parametrize("axis", ["+z", pytest.param("-z", marks=SLOW), pytest.param("+x", marks=SLOW)])
@pytest.mark.parametrize("material", ["glossy", pytest.param("brushed", marks=SLOW)])
def test_special_geometry_is_ordinary(axis, material, x64, rng):
    """A normal along an axis of the world, seen along the normal: value and gradient are the limits from nearby."""
    slices = slices_of(material, DOUBLE)
    light = jnp.asarray(scene(rng, 1, np.float64)[0])
    normal, tangent = jnp.asarray(AXES[axis]), jnp.asarray(unit(np.array([0.3, 0.5, 0.4])))
    radiance = lambda n, v: jnp.sum(shade(slices, light, n, v, tangent))
    value_and_gradient = jax.jit(jax.value_and_grad(radiance, (0, 1)))
    value, gradient = value_and_gradient(normal, normal)
    for offset in rng.normal(size=(3, 3)):
        near, near_gradient = value_and_gradient(normal + 1e-6 * offset, normal + 1e-6 * offset[::-1])
        np.testing.assert_allclose(near, value, atol=1e-4)
        for a, b in zip(near_gradient, gradient, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-3 * (1 + np.max(np.abs(b))))
    for i in range(2):  # and they are what finite differences see
        for step in np.eye(3):
            move = lambda h, step=step, i=i: radiance(*(normal + (h * step if j == i else 0) for j in range(2)))
            slope = (move(1e-5) - move(-1e-5)) / 2e-5
            np.testing.assert_allclose(gradient[i] @ step, slope, atol=1e-5 * (1 + abs(slope)))


def test_view_below_the_horizon_is_black(dtype):
    light = jnp.ones((3, 49), dtype)
    normal = jnp.asarray([[0, 0, 1.0]], dtype)
    view = jnp.asarray([[0.3, 0.1, -0.2]], dtype)
    assert np.array_equal(shade(slices_of("diffuse", dtype), light, normal, view), np.zeros((1, 3)))


def test_shapes_colours_and_lengths(rng):
    slices = slices_of("glossy")
    light, normals, views, _ = scene(rng, 6, np.float32)
    flat = shade(slices, light, normals, views)
    shaped = shade(slices, light, 3 * normals.reshape(2, 3, 3), 0.2 * views.reshape(2, 3, 3))
    np.testing.assert_allclose(shaped.reshape(6, 3), flat, rtol=1e-5, atol=1e-6)
    assert shade(slices, light[0], normals[0], views).shape == (6,)
    assert shade(slices, light, normals[:0], views[:0]).shape == (0, 3)
    coloured = shade(slices_of("diffuse"), light[0], normals, views)
    broadcast = shade(slices_of("diffuse"), np.tile(light[:1], (3, 1)), normals, views)
    np.testing.assert_allclose(coloured, broadcast, rtol=1e-5, atol=1e-6)


def test_extra_bands_of_light_or_material_add_nothing(rng):
    slices = slices_of("glossy")
    light, normals, views, _ = scene(rng, 4, np.float32)
    low = light[:, :16]
    padded = np.concatenate([low, np.zeros((3, 33), np.float32)], axis=1)
    higher = np.concatenate([light, rng.normal(size=(3, 51)).astype(np.float32)], axis=1)
    of = lambda e: shade(slices, e, normals, views)
    np.testing.assert_allclose(of(low), of(padded), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(of(higher), of(light), rtol=1e-5, atol=1e-5)


def test_gradients_do_not_store_every_pixel(rng):
    """Reverse mode holds a tile's coefficients, not pixels x coefficients."""
    slices = slices_of("glossy")
    light, normals, views, _ = scene(rng, 65536, np.float32)
    loss = lambda n: jnp.sum(shade(slices, light, n, views) ** 2)
    memory = jax.jit(jax.grad(loss)).lower(jnp.asarray(normals)).compile().memory_analysis()
    assert memory.temp_size_in_bytes < 65536 * 49 * 3 * 4


def test_a_basis_stands_for_its_degree():
    of = lambda degree: shading.tabulate_brdf(models.Lambertian(0.5), degree, elevations=4).coefficients
    np.testing.assert_array_equal(of(basis()), of(DEGREE))


def test_errors_name_the_argument(as_user, rng):
    light, normals, views, _ = scene(rng, 2, np.float32)
    slices = slices_of("glossy")
    with pytest.raises(ValueError, match=r"`normals` must have shape \[\.\.\., 3\]; got \[2, 2\]"):
        shade(slices, light, normals[:, :2], views)
    with pytest.raises(ValueError, match=r"batch axes do not broadcast: `normals` \[2\], `views` \[3\]"):
        shade(slices, light, normals, np.tile(views, (2, 1))[:3])
    with pytest.raises(ValueError, match=r"`coefficients` must have \(degree \+ 1\)\*\*2 .*; got \[3, 7\]"):
        shade(slices, light[:, :7], normals, views)
    with pytest.raises(ValueError, match="`surface` needs `tangents`"):
        shade(slices_of("brushed"), light, normals, views)
    with pytest.raises(ValueError, match="`brdf` must be a models.AbstractBrdf"):
        shading.tabulate_brdf("gold", 2)
    with pytest.raises(ValueError, match="`azimuths` must be even"):
        shading.tabulate_brdf(models.Lambertian(0.5), 2, azimuths=7)


def test_coarse_quadrature_is_refused():
    with pytest.raises(Exception, match="quadrature does not resolve this material"):
        tabulate(models.Ggx(0.05), quadrature=8)
    assert tabulate(models.Ggx(0.05), quadrature=8, throw=False).error > 1e-3
