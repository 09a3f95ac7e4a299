import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.special import sph_harm_y

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


@pytest.mark.slow
def test_gradients_jit_and_vmap(x64, rng):
    c = jnp.asarray(rng.normal(size=(2, 16)))
    for target in ("unsigned", "e3nn"):
        f = lambda c, target=target: harmonics.convert(c, "shisd", target)
        check_grads(jax.jit(f), (c,), order=1, modes=("fwd", "rev"))
        np.testing.assert_allclose(jax.vmap(f)(c), f(c), atol=1e-15)
    through = jax.jit(lambda c: harmonics.convert(harmonics.convert(c, "e3nn", "scipy"), "scipy", "e3nn"))
    check_grads(through, (c,), order=1, modes=("fwd", "rev"))


def test_errors_name_the_argument(as_user):
    c = np.ones(4, np.float32)
    for source, target, name in (("mitsuba", "shisd", "source"), ("shisd", "E3NN", "target")):
        with pytest.raises(ValueError, match=f"`{name}` must be one of 'shisd', 'sphericart'"):
            harmonics.convert(c, source, target)
    with pytest.raises(ValueError, match="`coefficients` must be complex"):
        harmonics.convert(c, "scipy", "shisd")
    with pytest.raises(ValueError, match="`coefficients`"):
        harmonics.convert(c[:3], "shisd", "scipy")
    with pytest.raises(ValueError, match="`coefficients`"):
        harmonics.convert(c.astype(np.complex64), "shisd", "scipy")
