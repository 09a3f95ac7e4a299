import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.special import eval_legendre, lpmv, sph_harm_y

from shisd import harmonics

NAMES = ("shisd", "sphericart", "unsigned", "e3nn", "scipy")
TOLERANCE = {"float32": 3e-6, "float64": 1e-13}

# e3nn-jax 0.20, spherical_harmonics("0e + 1o + 2e + 3o", normalization="integral"), at two directions.
E3NN_DIRECTIONS = [
    [0.188817119236923, -0.198390327376604, 0.961763678606379],
    [0.160214162977164, -0.818128926665578, 0.552264865200164],
]
E3NN_VALUES = [
    [0.282094791773878, 0.092256518749434, -0.096934012293451, 0.469920149224069, 0.198404005917306,
     -0.040926307119229, -0.278151338441984, -0.208463278360764, 0.485822127994703, 0.305188125987107,
     -0.104140570073641, -0.069315162245403, 0.207534193138436, -0.353065472525757, -0.255003890318852,
     0.464219781177552],
    [0.282094791773878, 0.078281042473066, -0.399739848629241, 0.269838000372528, 0.096669398703735,
     -0.143206704584092, 0.317916218574032, -0.493639450678066, 0.152589631194281, 0.084070471686677,
     -0.209247262773723, 0.17183574842344, -0.105841989127488, 0.592324952277574, -0.33029027885969,
     0.074293143258097],
]  # fmt: skip


def directions(rng, count: int = 20) -> np.ndarray:
    w = rng.normal(size=(count, 3))
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def e3nn_polynomials(w: np.ndarray) -> np.ndarray:
    """e3nn's harmonics up to degree 2."""
    x, y, z = w.T
    one, three = np.sqrt(1 / (4 * np.pi)), np.sqrt(3 / (4 * np.pi))
    five = np.sqrt(15 / (4 * np.pi))
    second = [five * x * z, five * x * y, np.sqrt(5 / (16 * np.pi)) * (3 * y * y - 1), five * y * z]
    return np.stack([one + 0 * x, three * x, three * y, three * z, *second, five / 2 * (z * z - x * x)], axis=-1)


def test_e3nn_as_its_polynomials(dtype, rng):
    c, w = rng.normal(size=9), directions(rng)
    exact = e3nn_polynomials(w) @ np.asarray(harmonics.convert(jnp.asarray(c, dtype), "shisd", "e3nn"), np.float64)
    got = harmonics.evaluate(jnp.asarray(c, dtype), jnp.asarray(w, dtype))
    np.testing.assert_allclose(got, exact, atol=TOLERANCE[dtype.name])


def test_e3nn_as_it_printed(x64, rng):
    c = rng.normal(size=16)
    np.testing.assert_allclose(e3nn_polynomials(np.array(E3NN_DIRECTIONS)), np.array(E3NN_VALUES)[:, :9], atol=1e-13)
    there = np.array(E3NN_VALUES) @ np.asarray(harmonics.convert(jnp.asarray(c), "shisd", "e3nn"))
    np.testing.assert_allclose(harmonics.evaluate(jnp.asarray(c), jnp.asarray(E3NN_DIRECTIONS)), there, atol=1e-13)


@pytest.mark.parametrize("degree", (5, pytest.param(30, marks=pytest.mark.slow)))
def test_e3nn_is_the_basis_with_permuted_axes(x64, rng, degree):
    """y_e3nn(x, y, z) = y_unsigned(z, x, y)."""
    c, w = rng.normal(size=(degree + 1) ** 2), directions(rng)
    unsigned = harmonics.convert(harmonics.convert(jnp.asarray(c), "shisd", "e3nn"), "unsigned", "shisd")
    there = harmonics.evaluate(unsigned, jnp.asarray(w[:, [2, 0, 1]]))
    np.testing.assert_allclose(harmonics.evaluate(jnp.asarray(c), jnp.asarray(w)), there, atol=1e-12)


@pytest.mark.parametrize("name", ("sphericart", "unsigned"))
def test_sphericart(dtype, rng, name):
    sphericart = pytest.importorskip("sphericart")
    c, w = rng.normal(size=49), directions(rng)
    values = sphericart.SphericalHarmonics(6).compute(w)
    got = values @ np.asarray(harmonics.convert(jnp.asarray(c, dtype), "shisd", name), np.float64)
    with jax.enable_x64(True):
        exact = harmonics.evaluate(jnp.asarray(np.asarray(jnp.asarray(c, dtype), np.float64)), jnp.asarray(w))
    np.testing.assert_allclose(got, exact, atol=TOLERANCE[dtype.name])


def test_scipy(dtype, rng):
    c, w = rng.normal(size=36), directions(rng)
    complex_c = harmonics.convert(jnp.asarray(c, dtype), "shisd", "scipy")
    assert complex_c.dtype == (np.complex64 if dtype == np.float32 else np.complex128)
    theta, phi = np.arccos(w[:, 2]), np.arctan2(w[:, 1], w[:, 0])
    got = sum(
        complex(complex_c[l * l + l + m]) * sph_harm_y(l, m, theta, phi) for l in range(6) for m in range(-l, l + 1)
    )
    assert np.abs(got.imag).max() < TOLERANCE[dtype.name]
    with jax.enable_x64(True):
        exact = harmonics.evaluate(jnp.asarray(c), jnp.asarray(w))
    np.testing.assert_allclose(got.real, exact, atol=TOLERANCE[dtype.name])


def test_the_real_part_is_kept_of_complex_functions(x64, rng):
    c = rng.normal(size=16) + 1j * rng.normal(size=16)
    w = directions(rng)
    theta, phi = np.arccos(w[:, 2]), np.arctan2(w[:, 1], w[:, 0])
    values = sum(c[l * l + l + m] * sph_harm_y(l, m, theta, phi) for l in range(4) for m in range(-l, l + 1))
    got = harmonics.evaluate(harmonics.convert(jnp.asarray(c), "scipy", "shisd"), jnp.asarray(w))
    np.testing.assert_allclose(got, values.real, atol=1e-13)


def test_degree_one_is_what_the_documentation_says():
    shisd = jnp.asarray([0.0, 1, 2, 3])  # -y, z, -x
    np.testing.assert_allclose(harmonics.convert(shisd, "shisd", "unsigned"), [0, -1, 2, -3])  # y, z, x
    np.testing.assert_allclose(harmonics.convert(shisd, "shisd", "e3nn"), [0, -3, -1, 2], atol=1e-6)  # x, y, z


@pytest.mark.parametrize("source", NAMES)
@pytest.mark.parametrize("target", NAMES)
def test_round_trips(dtype, rng, source, target):
    c = harmonics.convert(jnp.asarray(rng.normal(size=(2, 49)), dtype), "shisd", source)
    there = harmonics.convert(c, source, target)
    assert there.shape == c.shape
    assert jnp.finfo(there.dtype).dtype == dtype
    assert jnp.iscomplexobj(there) == (target == "scipy")
    back = harmonics.convert(there, target, source)
    assert back.dtype == c.dtype
    np.testing.assert_allclose(back, c, atol=20 * float(jnp.finfo(dtype).eps))
    np.testing.assert_allclose(jnp.linalg.norm(there), jnp.linalg.norm(c), rtol=1e-5)


def splatting_sum(c: np.ndarray, w: np.ndarray) -> np.ndarray:
    """3D Gaussian splatting's colour before its 0.5 is added, to degree 3, with its constants."""
    x, y, z = w.T
    xx, yy, zz = x * x, y * y, z * z
    second = [1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396]
    third = [-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154]
    third += [-0.4570457994644658, 1.445305721320277, -0.5900435899266435]
    seconds = [x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy]
    thirds = [y * (3 * xx - yy), x * y * z, y * (4 * zz - xx - yy), z * (2 * zz - 3 * xx - 3 * yy)]
    thirds += [x * (4 * zz - xx - yy), z * (xx - yy), x * (xx - 3 * yy)]
    first = 0.4886025119029199 * (-y * c[1] + z * c[2] - x * c[3])
    bands = np.stack(seconds, axis=-1) * second @ c[4:9] + np.stack(thirds, axis=-1) * third @ c[9:16]
    return 0.28209479177387814 * c[0] + first + bands


def three_js_sum(c: np.ndarray, w: np.ndarray) -> np.ndarray:
    """`getAt` of three.js, with its constants of six digits."""
    x, y, z = w.T
    first = 0.488603 * (c[1] * y + c[2] * z + c[3] * x)
    mixed = 1.092548 * (c[4] * x * y + c[5] * y * z + c[7] * x * z)
    return 0.282095 * c[0] + first + mixed + 0.315392 * c[6] * (3 * z * z - 1) + 0.546274 * c[8] * (x * x - y * y)


def filament_sum(c: np.ndarray, n: np.ndarray) -> np.ndarray:
    """filament's shader, before it cuts off what is negative."""
    x, y, z = n.T
    first = c[0] + c[1] * y + c[2] * z + c[3] * x
    return first + c[4] * x * y + c[5] * y * z + c[6] * (3 * z * z - 1) + c[7] * x * z + c[8] * (x * x - y * y)


def ambix_gains(w: np.ndarray, degree: int) -> np.ndarray:
    """What an encoder of ambiX multiplies a source along `w` by: ACN, SN3D, no Condon-Shortley phase."""
    azimuth, columns = np.arctan2(w[:, 1], w[:, 0]), []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            norm = math.sqrt((1 if m == 0 else 2) * math.factorial(l - abs(m)) / math.factorial(l + abs(m)))
            wave = np.cos(m * azimuth) if m >= 0 else np.sin(-m * azimuth)
            columns.append(norm * (-1) ** m * lpmv(abs(m), l, w[:, 2]) * wave)
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize(
    ("name", "degree", "program", "limits"),
    [
        ("3dgs", 3, splatting_sum, {"float32": 1e-6, "float64": 4e-15}),
        ("three.js", 2, three_js_sum, {"float32": 4e-6, "float64": 4e-6}),
    ],
)
def test_sums_of_other_programs(dtype, rng, name, degree, program, limits):
    c, w = rng.normal(size=(degree + 1) ** 2), directions(rng)
    got = harmonics.evaluate(harmonics.convert(jnp.asarray(c, dtype), name, "shisd"), jnp.asarray(w, dtype))
    np.testing.assert_allclose(got, program(c, w), atol=limits[dtype.name])


def test_ambisonic_channels_hold_their_sources(dtype, rng):
    """By the addition theorem: a source is the sum over l of (2l+1)/4pi P_l."""
    degree, sources, w = 4, directions(rng, 3), directions(rng)
    strengths = rng.normal(size=3)
    np.testing.assert_allclose(ambix_gains(sources, 1)[:, 1:], sources[:, [1, 2, 0]], atol=1e-15)
    channels = strengths @ ambix_gains(sources, degree)
    exact = sum((2 * l + 1) / (4 * np.pi) * eval_legendre(l, w @ sources.T) @ strengths for l in range(degree + 1))
    c = harmonics.convert(jnp.asarray(channels, dtype), "ambix", "shisd")
    limit = {"float32": 2e-6, "float64": 1e-14}[dtype.name]
    np.testing.assert_allclose(harmonics.evaluate(c, jnp.asarray(w, dtype)), exact, atol=limit)


def test_filament_is_irradiance(x64, rng):
    """Against quadrature of max(cos, 0) radiance / pi in the frame of each normal, exact for radiance of degree 2."""
    c, normals = rng.normal(size=9), directions(rng, 5)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    cosine, phi = np.meshgrid((nodes + 1) / 2, 2 * np.pi * np.arange(8) / 8, indexing="ij")
    local = np.stack([np.sqrt(1 - cosine**2) * np.cos(phi), np.sqrt(1 - cosine**2) * np.sin(phi), cosine], axis=-1)
    # Columns: two tangents, then the normal.
    frames = np.stack([np.linalg.svd(n[None])[2].T[:, [1, 2, 0]] * [1, 1, 0] + np.outer(n, [0, 0, 1]) for n in normals])
    radiance = harmonics.evaluate(jnp.asarray(c), jnp.asarray(np.einsum("nij,abj->nabi", frames, local)))
    exact = np.einsum("nab,ab,a->n", radiance, cosine / np.pi, weights / 2 * 2 * np.pi / 8)
    got = filament_sum(np.asarray(harmonics.convert(jnp.asarray(c), "shisd", "filament")), normals)
    np.testing.assert_allclose(got, exact, atol=1e-15)


def test_filament_factors_are_those_of_its_table():
    """1/pi A_l^m C_l of IndirectLight.h, which takes coefficients with the Condon-Shortley phase."""
    table = [0.282095, -0.325735, 0.325735, -0.325735, 0.273137, -0.273137, 0.078848, -0.273137, 0.136569]
    np.testing.assert_allclose(harmonics.convert(np.ones(9, np.float32), "shisd", "filament"), table, atol=1e-6)


def test_up_of_three_js_is_brought_to_ours(x64, rng):
    c, w = rng.normal(size=9), directions(rng)
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_array_equal(turn @ [0, 1, 0], [0, 0, 1])
    turned = harmonics.rotate(harmonics.convert(jnp.asarray(c), "three.js", "shisd"), jnp.asarray(turn))
    np.testing.assert_allclose(harmonics.evaluate(turned, jnp.asarray(w @ turn.T)), three_js_sum(c, w), atol=3e-6)


@pytest.mark.parametrize("name", ("3dgs", "ambix", "three.js", "filament"))
def test_round_trips_of_low_degree(dtype, rng, name):
    c = jnp.asarray(rng.normal(size=(2, 9)), dtype)
    for other in ("shisd", "e3nn", "scipy", "filament"):
        there = harmonics.convert(c, name, other)
        back = harmonics.convert(there, other, name)
        assert there.shape == c.shape
        assert back.dtype == dtype
        np.testing.assert_allclose(back, c, atol=20 * float(jnp.finfo(dtype).eps))
    low = harmonics.convert(c[:, :4], "shisd", name)
    np.testing.assert_array_equal(low, harmonics.convert(c, "shisd", name)[:, :4])


@pytest.mark.slow
def test_gradients_jit_and_vmap(x64, rng):
    c = jnp.asarray(rng.normal(size=(2, 16)))
    for target in ("unsigned", "e3nn", "ambix"):
        f = lambda c, target=target: harmonics.convert(c, "shisd", target)
        check_grads(jax.jit(f), (c,), order=1, modes=("fwd", "rev"))
        np.testing.assert_allclose(jax.vmap(f)(c), f(c), atol=1e-15)
    through = jax.jit(lambda c: harmonics.convert(harmonics.convert(c, "e3nn", "scipy"), "scipy", "e3nn"))
    check_grads(through, (c,), order=1, modes=("fwd", "rev"))


def test_errors_name_the_argument(as_user):
    c = np.ones(4, np.float32)
    for source, target, name in (("mitsuba", "shisd", "source"), ("shisd", "E3NN", "target")):
        with pytest.raises(ValueError, match=f"`{name}` must be one of 'shisd', .*, 'filament'; got"):
            harmonics.convert(c, source, target)
    with pytest.raises(ValueError, match="`coefficients` must be complex"):
        harmonics.convert(c, "scipy", "shisd")
    with pytest.raises(ValueError, match="`coefficients`"):
        harmonics.convert(c[:3], "shisd", "scipy")
    with pytest.raises(ValueError, match="`coefficients`"):
        harmonics.convert(c.astype(np.complex64), "shisd", "scipy")
    for name, highest in (("3dgs", 3), ("three.js", 2), ("filament", 2)):
        high = np.ones((highest + 2) ** 2, np.float32)
        message = f"degree {highest + 1}, and '{name}' ends at degree {highest}; pass the first {(highest + 1) ** 2}"
        for source, target in ((name, "shisd"), ("ambix", name)):
            with pytest.raises(ValueError, match=message):
                harmonics.convert(high, source, target)
        with pytest.raises(ValueError, match=message):
            harmonics.convert(high.astype(np.complex64), "scipy", name)
