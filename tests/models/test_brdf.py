"""Each model against formulas written again in another form, and against the energy that it may reflect."""

import cmath
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import models
from shisd.models import _brdf
from tests.models.materials import GOLD_PAINT, NICKEL, evaluate, hemisphere_rule, pairs, spherical


def cosines(wi, wo):
    """cos of theta_i, theta_o, theta_h, theta_d, by the half vector."""
    h = (wi + wo) / np.linalg.norm(wi + wo)
    return wi[2], wo[2], h[2], float(wi @ h)


def agree(brdf, expected, rng, rtol):
    """`brdf` equals the scalar NumPy function of (wi, wo) at random pairs, in float64."""
    wi, wo = pairs(rng, 200, 1e-3)
    got = np.asarray(evaluate(brdf, wi, wo))
    np.testing.assert_allclose(got, [expected(i, o) for i, o in zip(wi, wo, strict=True)], rtol=rtol)


# energy


def albedo(brdf, wo):
    directions, weights = hemisphere_rule()
    values = np.asarray(evaluate(brdf, directions, np.broadcast_to(wo, directions.shape)))
    return np.tensordot(weights * directions[:, 2], values, axes=1)


VIEWS = [spherical(angle, 0.3) for angle in (0.0, 0.6, 1.2, 1.45, 1.55)]


def test_lambertian_reflects_exactly_its_albedo(x64):
    for wo in VIEWS:
        np.testing.assert_allclose(albedo(models.Lambertian([0.2, 0.5, 1.0]), wo), [0.2, 0.5, 1.0], rtol=1e-9)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 10.0, 200.0])
def test_phong_reflects_its_specular_share_at_the_normal_and_less_elsewhere(exponent, x64):
    brdf = models.Phong(0.7, exponent, 0.3)
    np.testing.assert_allclose(albedo(brdf, VIEWS[0]), 1.0, rtol=1e-6)
    shares = [albedo(brdf, wo) for wo in VIEWS]
    assert np.all(np.diff(shares) < 1e-9) and shares[-1] > 0.3


@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0, [0.1, 0.6]])
def test_ggx_never_reflects_more_than_it_receives(alpha, x64):
    shares = [albedo(models.Ggx(alpha), wo) for wo in VIEWS]
    assert np.all(np.array(shares) <= 1 + 1e-6), shares
    if np.max(alpha) < 0.2:
        assert shares[0] > 0.98  # a smooth mirror loses nothing
    gold = albedo(models.Ggx(alpha, eta=[0.14, 0.43, 1.38], k=[3.697, 2.455, 1.914]), VIEWS[1])
    assert np.all(gold < shares[1]) and gold[0] > gold[1] > gold[2]


@pytest.mark.parametrize("alpha", [(0.05, 0.05), (0.4, 0.4), (1.0, 1.0), (0.1, 0.7)])
def test_ggx_facets_cover_their_ground_and_what_a_view_sees(alpha, x64):
    """Integral of D h.z dh = 1, and G1(o) times the integral of D max(o.h, 0) dh = o.z (H14 Eq. 4 and 14)."""
    directions, weights = hemisphere_rule(polar=600, azimuth=128)
    alpha = [jnp.asarray(a) for a in alpha]
    d = np.asarray(jax.vmap(lambda h: _brdf.ggx_distribution(h, *alpha))(jnp.asarray(directions)))
    np.testing.assert_allclose(np.sum(weights * d * directions[:, 2]), 1, rtol=1e-6)
    for wo in VIEWS[:4]:
        seen = np.sum(weights * d * np.maximum(directions @ wo, 0))
        g1_over_cosine = float(_brdf.smith_over_cosine(jnp.asarray(wo), *alpha))
        np.testing.assert_allclose(g1_over_cosine * seen, 1, rtol=2e-3)


# formulas


@pytest.mark.parametrize("alpha", [0.02, 0.3, 1.0])
def test_ggx_is_heitz_microfacet_formula(alpha, rng, x64):
    """Scalar, with tangents and the Lambda of H14 Eq. 72 and 60: another form than ours."""

    def lam(w):
        return (-1 + math.sqrt(1 + alpha**2 * (1 / w[2] ** 2 - 1))) / 2

    def expected(wi, wo):
        i, o, h, d = cosines(wi, wo)
        tan2 = 1 / h**2 - 1
        ndf = 1 / (math.pi * alpha**2 * h**4 * (1 + tan2 / alpha**2) ** 2)
        fresnel = 0.04 + 0.96 * (1 - d) ** 5
        return fresnel * ndf / (1 + lam(wi)) / (1 + lam(wo)) / (4 * i * o)

    agree(models.Ggx(jnp.asarray(alpha), 0.04), expected, rng, 1e-8 if alpha > 0.1 else 1e-6)


def test_anisotropic_ggx_is_heitz_formula(rng, x64):
    """H14 Eq. 85 and 86: slopes over (alpha_x, alpha_y), and alpha_o of the view's azimuth."""
    ax, ay = 0.15, 0.6

    def lam(w):
        phi = math.atan2(w[1], w[0])
        a = math.sqrt((ax * math.cos(phi)) ** 2 + (ay * math.sin(phi)) ** 2)
        return (-1 + math.sqrt(1 + (a * math.tan(math.acos(w[2]))) ** 2)) / 2

    def expected(wi, wo):
        i, o, _, _ = cosines(wi, wo)
        h = (wi + wo) / np.linalg.norm(wi + wo)
        slope = (h[0] / h[2] / ax) ** 2 + (h[1] / h[2] / ay) ** 2
        return 1 / (math.pi * ax * ay * h[2] ** 4 * (1 + slope) ** 2) / (1 + lam(wi)) / (1 + lam(wo)) / (4 * i * o)

    agree(models.Ggx(jnp.array([ax, ay])), expected, rng, 1e-8)


def test_anisotropic_ggx_with_equal_roughness_is_isotropic(rng, x64):
    wi, wo = pairs(rng, 200)
    one, two = models.Ggx(0.3, 0.5), models.Ggx([0.3, 0.3], 0.5)
    assert one.isotropic and not two.isotropic
    np.testing.assert_allclose(evaluate(one, wi, wo), evaluate(two, wi, wo), rtol=1e-12)


def test_anisotropy_stretches_along_the_rougher_axis():
    wi = spherical(0.5, np.array([0, math.pi / 2])).astype(np.float32)
    along_x, along_y = evaluate(models.Ggx([0.1, 0.5]), wi, np.array([[0, 0, 1]] * 2, np.float32))
    assert along_y > 5 * along_x


METALS = {  # n and k: Johnson and Christy 1972 (Au, Cu), Rakic 1995 (Al)
    "Au 659.5 nm": (0.14, 3.697),
    "Au 548.6 nm": (0.43, 2.455),
    "Au 450.9 nm": (1.38, 1.914),
    "Cu 616.8 nm": (0.30, 3.205),
    "Al 619.9 nm": (1.366, 7.4052),
    "glass": (1.5, 0.0),
    "glass to air": (1 / 1.5, 0.0),
    "mirror": (0.05, 4.0),
}
COSINES = [1.0, 0.999999, 0.9, 0.5, 0.1, 1e-3, 1e-8]
ANGLES = [(metal, cosine) for metal in METALS for cosine in COSINES]


def fresnel(dtype):
    """conductor_fresnel over all metals and angles, its derivatives in cosine, n and k, and what went in."""
    table = np.array([(cosine, *METALS[metal]) for metal, cosine in ANGLES]).astype(dtype)
    f = jax.jit(jax.vmap(jax.value_and_grad(_brdf.conductor_fresnel, argnums=(0, 1, 2))))
    value, slopes = f(*(jnp.asarray(column) for column in table.T))
    return np.asarray(value), np.stack(slopes, axis=-1), table


def amplitudes(cosine, eta, k):
    """Textbook reflectance from Snell's law with a complex refracted cosine."""
    index = complex(eta, k)
    refracted = cmath.sqrt(1 - (1 - cosine**2) / index**2)
    r_s = (cosine - index * refracted) / (cosine + index * refracted)
    r_p = (index * cosine - refracted) / (index * cosine + refracted)
    return (abs(r_s) ** 2 + abs(r_p) ** 2) / 2


def test_conductor_fresnel_is_the_complex_formula(dtype):
    value, _, table = fresnel(dtype)
    assert value.dtype == dtype
    for got, row, angle in zip(value, table.astype(np.float64), ANGLES, strict=True):
        assert got == pytest.approx(amplitudes(*row), rel=1e-10 if dtype == np.float64 else 3e-6), angle


def test_normal_reflectance_is_the_published_one(x64):
    value, _, _ = fresnel(np.float64)
    normal = {metal: v for v, (metal, cosine) in zip(value, ANGLES, strict=True) if cosine == 1}
    for metal, (n, k) in METALS.items():
        assert normal[metal] == pytest.approx(((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2), rel=1e-12)
    assert normal["glass"] == pytest.approx(0.04) and normal["glass to air"] == pytest.approx(0.04)
    assert normal["Al 619.9 nm"] == pytest.approx(0.9095, abs=1e-4)


def test_conductor_fresnel_has_right_derivatives(x64):
    _, slopes, table = fresnel(np.float64)
    for got, row, angle in zip(slopes, table, ANGLES, strict=True):
        if row[0] in (1.0, 1e-8):  # the oracle's domain ends here
            assert np.isfinite(got).all()
            continue
        for n in range(3):
            step = 1e-7 * np.eye(3)[n]
            expected = (amplitudes(*(row + step)) - amplitudes(*(row - step))) / 2e-7
            assert got[n] == pytest.approx(expected, rel=1e-4, abs=1e-4), angle


def test_conductor_fresnel_is_finite_where_it_has_a_kink(dtype):
    """Nothing to reflect from, total reflection, the critical angle, and no metal at all."""
    cases = [(1, 1, 0), (0, 1, 0), (0.3, 0.5, 0), (0.75**0.5, 0.5, 0), (0.5, 0, 0), (0, 1.5, 0), (0, 0.2, 3), (1, 0, 0)]
    f = jax.jit(jax.vmap(jax.value_and_grad(_brdf.conductor_fresnel, argnums=(0, 1, 2))))
    value, slopes = f(*(jnp.asarray(column, dtype) for column in np.array(cases).T))
    single = dtype == np.float32
    np.testing.assert_allclose(value, [0, 1, 1, 1, 1, 1, 1, 1], atol=4e-6 if single else 1e-14)
    assert np.isfinite(slopes).all()
    grazing = [-2 * (1 + 1.5**2) / math.sqrt(1.5**2 - 1), (amplitudes(1e-8, 0.2, 3) - 1) / 1e-8]
    np.testing.assert_allclose(slopes[0][5:7], grazing, rtol=1e-6)
    assert np.all(np.asarray(slopes)[:, [0, 2, 4]] == 0)


@pytest.mark.parametrize("direct", [False, True])
@pytest.mark.parametrize(("r", "m"), [(0.02, 1.0), (0.3, 0.0), (0.7, 0.4), (1.0, 0.0)])
def test_cook_torrance_is_the_text_of_occt(r, m, direct, rng, x64):
    c, ior = 0.6, 1.45

    def expected(wi, wo):
        cos_l, cos_v, cos_h, cos_vh = cosines(wi, wo)
        alpha = r * r
        d = alpha**2 / (math.pi * (cos_h**2 * (alpha**2 - 1) + 1) ** 2)
        k = (r + 1) ** 2 / 8 if direct else alpha / 2
        g = cos_l * cos_v / ((cos_l * (1 - k) + k) * (cos_v * (1 - k) + k))
        f0 = ((1 - ior) / (1 + ior)) ** 2 * (1 - m) + c * m
        f = f0 + (1 - f0) * (1 - cos_vh) ** 5
        return d * g * f / (4 * cos_l * cos_v) + (1 - f) * (1 - m) * c / math.pi

    # the text's 1 - cos^2 loses digits against a narrow lobe; ours does not
    agree(models.CookTorrance(r, m, c, ior, direct=direct), expected, rng, 1e-8 if r > 0.1 else 1e-4)


def test_cook_torrance_at_one_pair_worked_by_hand(x64):
    """wi = wo = n: D = 1 / (pi alpha^2), G = 1, F = F0 = 0.04 for ior 1.5: f = 0.04 / (4 pi 0.0625) + 0.96 c / pi."""
    normal = np.array([[0, 0, 1.0]])
    got = evaluate(models.CookTorrance(0.5, 0.0, [0.1, 0.5, 1.0]), jnp.asarray(normal), jnp.asarray(normal))
    np.testing.assert_allclose(got[0], (0.16 + 0.96 * np.array([0.1, 0.5, 1.0])) / math.pi, rtol=1e-12)


@pytest.mark.parametrize("colour", range(3))
def test_abc_is_the_published_formula(colour, rng, x64):
    """Low et al. 2012 for nickel; Fresnel in the form of Cook and Torrance 1981, Eq. 9."""
    row = {name: np.broadcast_to(value, 3)[colour] for name, value in NICKEL.items()}

    def expected(wi, wo):
        i, o, h, d = cosines(wi, wo)
        g = math.sqrt(row["ior"] ** 2 - 1 + d * d)
        fresnel = ((g - d) / (g + d)) ** 2 / 2 * (1 + ((d * (g + d) - 1) / (d * (g - d) + 1)) ** 2)
        shadowing = min(1.0, 2 * h * i / d, 2 * h * o / d)
        s = row["a"] / (1 + row["b"] * (1 - h)) ** row["c"]
        return row["diffuse"] / math.pi + s * fresnel * shadowing / (math.pi * i * o)

    agree(models.AbcMicrofacet(**row), expected, rng, 1e-8)


@pytest.mark.parametrize("colour", range(3))
def test_sgd_is_the_published_formula(colour, rng, x64):
    """Bagher et al. 2012 for gold metallic paint."""
    row = {name: value[colour] for name, value in GOLD_PAINT.items()}

    def g1(cosine):
        beyond = max(0.0, math.acos(cosine) - row["shift"])
        return min(1.0, max(0.0, 1 + row["masking"] * (1 - math.exp(row["c"] * beyond ** row["k"]))))

    def expected(wi, wo):
        i, o, h, d = cosines(wi, wo)
        x = row["alpha"] + math.tan(math.acos(h)) ** 2 / row["alpha"]
        ndf = row["normalization"] * math.exp(-x) / (math.pi * x ** row["p"] * h**4)
        fresnel = row["f0"] - d * row["f1"] + (1 - d) ** 5 * (1 - row["f0"])
        return row["diffuse"] / math.pi + row["specular"] * fresnel * ndf * g1(i) * g1(o) / (math.pi * i * o)

    agree(models.SgdMicrofacet(**row), expected, rng, 1e-7)


def test_sgd_of_extreme_published_rows_stays_finite(rng):
    """The largest c (1e38), k (856) and lambda (1.5e7), and the smallest alpha (1.6e-5) of the table, all at once."""
    brdf = models.SgdMicrofacet(0.1, 0.1, 1.6e-5, 0.5, 0.04, -0.96, 6e4, 1.5e7, 1e38, 856.0, 0.3)
    wi, wo = (a.astype(np.float32) for a in pairs(rng, 500, 1e-4))
    leaves, tree = jax.tree.flatten(brdf)
    f = lambda leaves, wi, wo: jax.tree.unflatten(tree, leaves).value(wi, wo)
    both = jax.jit(jax.vmap(jax.value_and_grad(f, argnums=(0, 1, 2)), in_axes=(None, 0, 0)))
    value, slopes = both(leaves, jnp.asarray(wi), jnp.asarray(wo))
    assert np.isfinite(value).all() and np.all(value >= 0.1 / np.pi * (1 - 1e-6))  # its diffuse part
    assert all(np.isfinite(s).all() for s in jax.tree.leaves(slopes))
