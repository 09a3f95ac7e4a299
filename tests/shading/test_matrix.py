"""Doubly projected matrices against quadrature over both directions, against tables, and in their derivatives."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import decomposition, models, shading
from tests.hard_cases import unit
from tests.marks import FLOAT32_FIRST
from tests.models.materials import hemisphere_rule
from tests.truth import scipy_basis

SINGLE = np.dtype("float32")
DEGREE, VIEW_DEGREE = 3, 5
N, N_VIEW = (DEGREE + 1) ** 2, (VIEW_DEGREE + 1) ** 2
ALPHAS, COLOUR = {"isotropic": (0.6, 0.6), "anisotropic": (0.5, 0.8)}, (0.9, 0.5, 0.2)
KINDS = ["isotropic", pytest.param("anisotropic", marks=pytest.mark.slow)]


def ggx(kind, dtype=np.float64):
    alpha = ALPHAS[kind][0] if kind == "isotropic" else ALPHAS[kind]
    return models.Ggx(np.asarray(alpha, dtype), np.asarray(COLOUR, dtype))


@functools.cache
def matrix_of(kind, dtype):
    """Made once per precision; called with x64 switched as the dtype says."""
    return shading.project_brdf(ggx(kind, dtype), DEGREE, view_degree=VIEW_DEGREE)


@functools.cache
def both_of(domain, dtype):
    """The table and the matrix of one material, degree 6; 16 views, and 8 degrees more for the views."""
    brdf = models.Ggx(np.asarray(0.4, dtype), np.asarray(0.04, dtype))
    table = shading.tabulate_brdf(brdf, 6, elevations=16, domain=domain)
    return table, shading.project_brdf(brdf, 6, domain=domain)


def slices_of(kind, w, wo):
    """f(w, wo) cos(w) of GGX [colours, w, wo], from slopes and Schlick's Fresnel term."""
    slope2 = lambda d: ((ALPHAS[kind] * d[..., :2] / d[..., 2:]) ** 2).sum(-1)
    masking = lambda d: 2 / (1 + np.sqrt(1 + slope2(d)))
    half = w[:, None] + wo[None]
    half /= np.sqrt(np.einsum("wvi,wvi->wv", half, half))[..., None]
    tangent2 = ((half[..., :2] / half[..., 2:] / ALPHAS[kind]) ** 2).sum(-1)
    distribution = 1 / (np.pi * np.prod(ALPHAS[kind]) * half[..., 2] ** 4 * (1 + tangent2) ** 2)
    value = distribution * masking(w)[:, None] * masking(wo) / (4 * wo[:, 2])
    fresnel = (1 - np.einsum("wvi,vi->wv", half, wo)) ** 5
    return [value * (f0 + (1 - f0) * fresnel) for f0 in COLOUR]


def sphere(polar, azimuth):
    w, area = hemisphere_rule(polar, azimuth)
    return np.concatenate([w, -w]), np.concatenate([area, area])


def scene(rng, count, dtype):
    normals, views, tangents = unit(rng.normal(size=(3, count, 3)))
    views *= np.where(np.sum(views * normals, axis=1) < 0, -1, 1)[:, None]
    return tuple(a.astype(dtype) for a in (rng.normal(size=(3, N)), normals, views, tangents))


@FLOAT32_FIRST
@pytest.mark.parametrize("kind", KINDS)
def test_elements_are_integrals_over_both_directions(kind, dtype):
    """CSH18's elements are integrals of f y_i y_j over both directions: F times the integrals of y_j y_k above."""
    wo, solid_angle = hemisphere_rule(16, 12 if kind == "isotropic" else 24)
    y_view = scipy_basis(wo, VIEW_DEGREE)
    above = (y_view * solid_angle[:, None]).T @ y_view
    w, area = hemisphere_rule(110, 200)
    y = scipy_basis(w, DEGREE) * area[:, None]
    got = matrix_of(kind, dtype)
    assert got.colour == (3,) and got.blocks[0].dtype == dtype and got.matrix().shape == (3, N, N_VIEW)
    for matrix, values in zip(np.asarray(got.matrix(), float), slices_of(kind, w, wo), strict=True):
        elements = (y.T @ values * solid_angle) @ y_view
        bound = 3e-6 if dtype == np.float32 else 3e-7  # the quadrature over w here has 1e-7
        np.testing.assert_allclose(matrix @ above, elements, atol=bound)


@pytest.mark.slow
@FLOAT32_FIRST
@pytest.mark.parametrize("domain", ["sphere", pytest.param("upper", marks=pytest.mark.slow)])
def test_slices_are_those_of_the_table(domain, dtype):
    """The table holds slices of each view, without any expansion over views."""
    table, matrix = both_of(domain, dtype)
    got, expected = (np.asarray(x.coefficients, float) for x in (matrix.slices(elevations=16), table))
    w, area = sphere(20, 40) if domain == "sphere" else hemisphere_rule(20, 40)  # where norms are taken
    norm = lambda c: np.sqrt(np.square(c @ scipy_basis(w, 6).T) @ area)
    ratio = norm(got - expected) / norm(expected)
    # rounding of fits above the horizon adds 7e-5 to each in float32
    assert np.sqrt(np.mean(ratio**2)) < (2e-4 if (domain, dtype) == ("upper", SINGLE) else 1e-4), ratio
    assert np.max(ratio) < 1e-3, ratio


@pytest.mark.slow
def test_without_the_cosine_the_elements_are_symmetric(x64):
    """Helmholtz reciprocity: f(w, wo) = f(wo, w), so B_ij = B_ji."""

    class Uncosined(models.AbstractBrdf):
        brdf: models.Ggx
        isotropic = True

        def value(self, wi, wo):
            return self.brdf.value(wi, wo) / jnp.where(wi[2] > 0, wi[2], 1)

        lobe_width = property(lambda self: self.brdf.lobe_width)

    matrix = shading.project_brdf(Uncosined(models.Ggx(0.6, 0.3)), 4, view_degree=4).matrix()
    wo, solid_angle = hemisphere_rule(20, 40)
    y = scipy_basis(wo, 4)
    elements = np.asarray(matrix) @ (y * solid_angle[:, None]).T @ y
    np.testing.assert_allclose(elements, elements.T, atol=1e-6 * np.max(np.abs(elements)))


@FLOAT32_FIRST
@pytest.mark.parametrize("kind", KINDS)
def test_radiance_is_the_product_of_slice_and_light(kind, dtype, rng):
    matrix = matrix_of(kind, dtype)
    light, normals, views, tangents = scene(rng, 200, dtype)
    views[0] = normals[0]
    got = shading.shade(matrix, models.DistantLight(light), shading.Surface(normals, views, tangents=tangents))
    assert got.dtype == dtype and got.shape == (200, 3)
    n, v, t = (unit(a.astype(float)) for a in (normals, views, tangents))
    t = unit(t - np.sum(t * n, axis=1, keepdims=True) * n)
    frames = np.stack([t, np.cross(n, t), n], axis=-1)
    slices = np.einsum(
        "cij,pj->pci", np.asarray(matrix.matrix(), float), scipy_basis(np.einsum("pij,pi->pj", frames, v), VIEW_DEGREE)
    )
    w, area = sphere(12, 16)
    weighted = scipy_basis(w, DEGREE) * area[:, None]
    turned = np.stack([scipy_basis(w @ r.T, DEGREE).T @ weighted for r in frames])  # [p, world, local]
    expected = np.einsum("pci,pji,cj->pc", slices, turned, light.astype(float))
    np.testing.assert_allclose(got, expected, atol=(1e-5 if dtype == np.float32 else 1e-12) * np.max(np.abs(expected)))


@pytest.mark.slow
def test_matrix_and_table_shade_alike(rng):
    matrix = matrix_of("isotropic", SINGLE)
    light, normals, views, _ = scene(rng, 200, np.float32)
    shade = lambda material, e: shading.shade(material, models.DistantLight(e), shading.Surface(normals, views))
    expected = shade(matrix.slices(), light)
    np.testing.assert_allclose(shade(matrix, light), expected, atol=1e-4 * np.max(np.abs(expected)))
    low = shade(matrix, light[:, :4])  # a light of fewer bands
    padded = np.where(np.arange(N) < 4, light, np.float32(0))
    np.testing.assert_allclose(low, shade(matrix, padded), atol=2e-6 * np.max(np.abs(low)))
    below = shading.shade(matrix, models.DistantLight(light), shading.Surface(normals, -normals))
    assert np.all(np.asarray(below) == 0)


@pytest.mark.slow
def test_derivatives(x64, rng):
    """In light, normals and views; the first view lies along its normal."""
    light, normals, views, _ = scene(rng, 2, np.float64)
    views[0] = normals[0]
    shapes = [(3, DEGREE + 1 - m, VIEW_DEGREE + 1 - m) for m in range(DEGREE + 1)]
    blocks = tuple(jnp.asarray(rng.normal(size=shape)) for shape in shapes)
    matrix = shading.BrdfMatrix(blocks, jnp.zeros(()), DEGREE, VIEW_DEGREE, True)
    radiance = jax.jit(lambda e, *a: shading.shade(matrix, models.DistantLight(e), shading.Surface(*a)))
    check_grads(radiance, (light, normals, views), order=1, atol=1e-5, rtol=1e-5, eps=1e-5)


@pytest.mark.slow
def test_derivatives_in_the_material(x64):
    def first_block(alpha):
        return shading.project_brdf(models.Ggx(alpha), 1, view_degree=1, quadrature=16, throw=False).blocks[0]

    check_grads(jax.jit(first_block), (jnp.asarray(0.6),), order=1, atol=1e-6, rtol=1e-5, eps=1e-4)


@pytest.mark.slow
def test_lambertian(x64):
    """Bands of max(cos, 0) / pi in closed form (Ramamoorthi and Hanrahan 2001, Eq. 19); no degree of the view."""
    even = [2 * math.factorial(l) / ((l + 2) * (l - 1) * 2**l * math.factorial(l // 2) ** 2) for l in (2, 4, 6, 8)]
    zonal = np.array([1, 2 / 3, even[0], 0, even[1], 0, even[2], 0, even[3]])
    expected = (2 * np.arange(9) + 1) / (4 * np.pi) * zonal**2
    matrix = shading.project_brdf(models.Lambertian(1.0), 8, view_degree=0)
    assert [b.shape for b in matrix.blocks] == [(9, 1)]
    light = np.r_[np.sqrt(4 * np.pi), np.zeros(15)]  # radiance 1 from everywhere
    np.testing.assert_allclose(
        shading.shade(matrix, models.DistantLight(light), shading.Surface(np.eye(3), np.eye(3))), 1, rtol=1e-8
    )
    slices = matrix.slices()
    energy = slices.energies()
    assert energy.shape == (64, 9)
    np.testing.assert_allclose(energy, np.broadcast_to(expected, (64, 9)), atol=1e-8)
    left = np.sqrt(1 - np.cumsum(expected) / np.sum(expected))  # of what these bands hold
    for degree in (1, 2, 4):
        assert slices.needed_degree(1.01 * left[degree]) == degree
    assert slices.needed_degree(0.99 * left[2]) == 4
    with pytest.raises(ValueError, match="need their last bands for `tolerance` 1e-05"):
        slices.needed_degree(1e-5)
    upper = shading.project_brdf(models.Lambertian(1.0), 8, view_degree=0, domain="upper").slices()
    np.testing.assert_allclose(np.sum(upper.energies()[0, :2]), 2 / 3 / np.pi, rtol=1e-5)
    assert upper.needed_degree(1e-3) == 1  # cos is of degree 1 above the horizon


@pytest.mark.parametrize("colour", [(), (3,)])
def test_degree_of_slices_with_azimuths_counts_all_of_them(colour, rng):
    theta = (np.arange(4) + 0.5) * np.pi / 8
    c = rng.normal(size=(*colour, 4, 6, 16)) * np.repeat([1, 0.5, 0.2, 0.01], [1, 3, 5, 7])
    energy = np.add.reduceat(c**2, np.arange(4) ** 2, axis=-1).reshape(-1, 4, 6, 4)
    slices = shading.Slices(c.astype(np.float32), isotropic=False)
    shares = np.sin(2 * theta)[:, None, None]
    for worst, energies in ((False, np.sum(shares * energy, axis=(1, 2))), (True, energy.reshape(-1, 4))):
        left = np.max(np.sqrt(1 - np.cumsum(energies, axis=-1) / np.sum(energies, axis=-1, keepdims=True)), axis=0)
        assert slices.needed_degree(1.001 * left[0], worst=worst) == 0
        assert (
            slices.needed_degree(0.999 * left[0], worst=worst)
            == slices.needed_degree(1.001 * left[1], worst=worst)
            == 1
        )


@pytest.mark.slow
def test_degree_is_the_same_from_table_and_matrix():
    table, matrix = both_of("sphere", SINGLE)
    energy = np.asarray(table.energies(), float)
    theta = (np.arange(16) + 0.5) * np.pi / 32
    left = lambda e: np.sqrt(1 - np.cumsum(e, axis=-1) / np.sum(e, axis=-1, keepdims=True))
    tolerances = left(np.sin(2 * theta) @ energy), np.max(left(energy), axis=0)
    assert tolerances[1][3] > 1.1 * tolerances[0][3]
    for worst, tolerance in zip((False, True), tolerances, strict=True):
        for degree in (1, 3, 4):
            found = [s.needed_degree(1.02 * tolerance[degree], worst=worst) for s in (table, matrix.slices())]
            assert found == [degree] * 2, tolerance


def test_errors_name_the_argument(as_user, rng):
    brdf = models.Lambertian(0.5)
    with pytest.raises(ValueError, match="`brdf` must be a models.AbstractBrdf; got int"):
        shading.project_brdf(1, 2)
    with pytest.raises(ValueError, match="`view_degree` must be >= 0; got -1"):
        shading.project_brdf(brdf, 2, view_degree=-1)
    with pytest.raises(ValueError, match="`domain` must be 'sphere' or 'upper'; got 'both'"):
        shading.project_brdf(brdf, 2, domain="both")
    matrix = shading.BrdfMatrix((jnp.ones((N, 1)),), jnp.zeros(()), DEGREE, 0, False)
    light, normals, views, _ = scene(rng, 2, np.float32)
    sky, surface = models.DistantLight(light), shading.Surface(normals, views)
    with pytest.raises(
        ValueError,
        match="`material` must come from shading.prepare, tabulate_brdf, .* or be a Quadrature; got int",
    ):
        shading.shade(1, sky, surface)
    with pytest.raises(
        ValueError, match=r"`coefficients` must have \(degree \+ 1\)\*\*2 coefficients on its last axis"
    ):
        shading.shade(matrix, models.DistantLight(light[:, :5]), surface)
    with pytest.raises(ValueError, match=r"batch axes do not broadcast: .*`tangents` \[2\]"):
        shading.shade(matrix, sky, shading.Surface(normals, np.zeros((3, 3), np.float32), tangents=views))
    upper = shading.BrdfMatrix(matrix.blocks, jnp.zeros(()), DEGREE, 0, True, "upper")
    with pytest.raises(
        ValueError, match="`material` is a BrdfMatrix that was fitted above the horizon only: .* pass its `slices"
    ):
        shading.shade(upper, sky, surface)
    with pytest.raises(ValueError, match=r"`surface` needs `tangents` \[\.\.\., 3\]: this material is anisotropic"):
        shading.shade(matrix, sky, surface)
    with pytest.raises(ValueError, match="`basis` must be a decomposition.RotatedZonalBasis of degree 3"):
        matrix.slices().weights(decomposition.RotatedZonalBasis(decomposition.optimized_directions(2), 2))
    with pytest.raises(ValueError, match="`tolerance` must be finite and > 0; got 0"):
        matrix.slices().needed_degree(0)
    with pytest.raises(ValueError, match="call needed_degree outside jit"):
        jax.jit(lambda m: m.slices().needed_degree(0.1))(matrix)
    with pytest.raises(ValueError, match="the slices hold NaN or infinity"):
        shading.Slices(np.full((4, 4), np.nan, np.float32)).needed_degree(0.1)
    with pytest.raises(Exception, match="The quadrature does not resolve this material"):
        shading.project_brdf(models.Ggx(0.02), 1, view_degree=0, quadrature=4)


def test_degenerate_views_and_normals(rng):
    matrix = matrix_of("isotropic", SINGLE)
    light, normals, views, _ = scene(rng, 3, np.float32)
    normals[0], views[1] = 0, np.nan
    got = np.asarray(shading.shade(matrix, models.DistantLight(light), shading.Surface(normals, views)))
    assert np.all(np.isnan(got[:2])) and np.all(np.isfinite(got[2]))
    empty = shading.shade(matrix, models.DistantLight(light), shading.Surface(normals[:0], views[:0]))
    assert empty.shape == (0, 3)
