"""Environment maps: geometry, lookup, projection, and files that are not what they should be."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd.models import Environment
from tests.models.materials import array, spherical
from tests.test_io import write_exr, write_rgbe

radiance = eqx.filter_jit(lambda environment, directions: environment.radiance(directions))
GOOD = np.random.default_rng(7).uniform(0.1, 2, (8, 16, 3)).astype(np.float32)


def test_first_texel_touches_the_zenith_and_the_x_axis(dtype):
    directions = np.asarray(Environment(array(np.zeros((4, 8)), dtype)).directions())
    assert directions.shape == (4, 8, 3) and directions.dtype == dtype
    for j, i in ((0, 0), (1, 3), (3, 7)):
        expected = spherical(np.pi * (j + 0.5) / 4, 2 * np.pi * (i + 0.5) / 8)
        np.testing.assert_allclose(directions[j, i], expected, atol=1e-6)


@pytest.mark.parametrize("height", [1, 2, 7, 64])
def test_solid_angles_are_exact(height, dtype):
    environment = Environment(array(np.ones((height, 2 * height)), dtype))
    angles = np.asarray(environment.solid_angles(), np.float64)
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    tolerance = 1e-12 if dtype == np.float64 else 1e-6
    np.testing.assert_allclose(angles, (edges[:-1] - edges[1:]) * np.pi / height, rtol=tolerance)
    assert np.sum(angles) * 2 * height == pytest.approx(4 * np.pi, rel=tolerance)


@pytest.mark.parametrize("colour", [(), (3,)])
def test_radiance_at_a_texel_centre_is_the_texel(colour, dtype, rng):
    texels = rng.uniform(0, 5, (6, 12, *colour))
    environment = Environment(array(texels, dtype))
    got = radiance(environment, environment.directions())
    assert got.dtype == dtype
    np.testing.assert_allclose(got, texels, rtol=1e-5, atol=1e-5)
    one = radiance(environment, array([0, 0, 1.0], dtype))
    assert one.shape == colour and np.isfinite(one).all()


def test_radiance_is_bilinear_wraps_and_continues_across_the_poles(x64, rng):
    """Against a scalar lookup in a map extended by hand: one column on each side, one row over each pole."""
    texels = rng.uniform(0, 5, (6, 12))
    rows = np.concatenate([np.roll(texels[:1], 6, axis=1), texels, np.roll(texels[-1:], 6, axis=1)])
    extended = np.concatenate([rows[:, -1:], rows, rows[:, :1]], axis=1)
    environment = Environment(texels)
    z = rng.uniform(-1, 1, 300)
    z[:40] = np.sign(z[:40]) * (1 - 10.0 ** -rng.uniform(2, 12, 40))
    theta, phi = np.arccos(z), rng.uniform(0, 2 * np.pi, 300)
    got = radiance(environment, 3 * spherical(theta, phi))  # any length
    for value, t, p in zip(got, theta, phi, strict=True):
        y, x = t / np.pi * 6 + 0.5, p / (2 * np.pi) * 12 + 0.5
        j, i = int(y), int(x)
        v, u = y - j, x - i
        cell = extended[j : j + 2, i : i + 2]
        assert float(value) == pytest.approx(np.array([1 - v, v]) @ cell @ np.array([1 - u, u]), rel=1e-6, abs=1e-6)
    pole = np.asarray(radiance(environment, np.array([[1e-9, 0, 1], [-1e-9, 0, 1], [1e-9, 0, -1], [-1e-9, 0, -1.0]])))
    np.testing.assert_allclose(pole[::2], pole[1::2], rtol=1e-6)  # no seam along a great circle


def test_radiance_of_constant_and_one_texel_maps(dtype):
    directions = array(np.concatenate([np.eye(3), -np.eye(3), spherical(np.ones(5), np.arange(5.0))]), dtype)
    np.testing.assert_allclose(radiance(Environment(array(np.full((5, 10), 2.0), dtype)), directions), 2, rtol=1e-6)
    np.testing.assert_array_equal(radiance(Environment(array(np.zeros((5, 10)), dtype)), directions), 0)
    single = np.zeros((5, 10))
    single[2, 3] = 3e4
    environment = Environment(array(single, dtype))
    assert float(radiance(environment, environment.directions()[2, 3])) == pytest.approx(3e4, rel=1e-4)
    assert float(radiance(environment, -environment.directions()[2, 3])) == 0


def test_derivatives(x64, rng):
    texels = jnp.asarray(rng.uniform(0, 1, (4, 8, 3)))
    directions = jnp.asarray(spherical(np.array([0.1, 1.2, 3.1]), np.array([0.1, 3.0, 5.0])))
    f = jax.jit(lambda texels, directions: Environment(texels).radiance(directions))
    check_grads(f, (texels, directions), order=1, modes=("fwd", "rev"), rtol=1e-5, eps=1e-6)
    for pole in ([0, 0, 1.0], [0, 0, -1.0]):
        assert np.isfinite(jax.jacrev(lambda d: f(texels, d))(jnp.array(pole))).all()
    weights = jax.jacrev(lambda texels: f(texels, directions)[:, 0])(texels)[..., 0]
    np.testing.assert_allclose(jnp.sum(weights, axis=(1, 2)), 1, rtol=1e-12)


def test_from_function_samples_the_texel_centres(dtype):
    environment = Environment.from_function(lambda w: w[:, 2] + 2, 8)
    assert environment.texels.shape == (8, 16) and environment.texels.dtype == dtype
    np.testing.assert_allclose(environment.texels, environment.directions()[..., 2] + 2, rtol=1e-6)
    coloured = Environment.from_function(lambda w: jnp.abs(w), 4)
    assert coloured.texels.shape == (4, 8, 3)


def test_coefficients_of_a_linear_function(x64):
    """f = 2 + z + 3x: sqrt(4 pi) (2, 0, 1/sqrt 3, -3/sqrt 3), up to the texels of the map."""
    environment = Environment.from_function(lambda w: 2 + w[:, 2] + 3 * w[:, 0], 64)
    got = np.asarray(environment.coefficients(2))
    expected = np.zeros(9)
    expected[:4] = np.sqrt(4 * np.pi) * np.array([2, 0, 1 / np.sqrt(3), -3 / np.sqrt(3)])
    np.testing.assert_allclose(got, expected, atol=2e-2)
    assert Environment(jnp.ones((4, 8, 3))).coefficients(3).shape == (3, 16)


@pytest.mark.parametrize("write", [write_exr, write_rgbe], ids=["exr", "hdr"])
def test_load_keeps_rows_columns_and_colours(write, tmp_path):
    path = tmp_path / "sky.map"
    write(path, GOOD)
    environment = Environment.load(path)
    assert environment.texels.dtype == np.float32
    np.testing.assert_allclose(environment.texels, GOOD, rtol=0 if write is write_exr else 0.02, atol=0.01)
    np.testing.assert_array_equal(Environment.load(str(path), bad_texels="refuse").texels, environment.texels)


def test_load_drops_alpha_and_keeps_one_channel_scalar(tmp_path):
    write_exr(tmp_path / "a.exr", np.concatenate([GOOD, np.full((8, 16, 1), 0.5, np.float32)], axis=-1))
    np.testing.assert_array_equal(Environment.load(tmp_path / "a.exr").texels, GOOD)
    write_exr(tmp_path / "y.exr", GOOD[..., 0])
    assert Environment.load(tmp_path / "y.exr").texels.shape == (8, 16)


def bad_map():
    texels = GOOD.copy()
    texels[0, :2, 1] = np.nan
    texels[1, 0, 0], texels[1, 1, 0] = np.inf, -np.inf
    texels[2, :5] = -0.25
    texels[3, 3, 2] = 777
    return texels


def test_bad_texels_are_counted_and_clamped(tmp_path):
    write_exr(tmp_path / "bad.exr", bad_map())
    message = r"bad.exr: 2 NaN, 2 infinite, 5 negative texels of 128 set to 0, 777 and 0"
    with pytest.warns(UserWarning, match=message):
        texels = np.asarray(Environment.load(tmp_path / "bad.exr").texels)
    expected = np.where(np.isnan(bad_map()) | (bad_map() < 0), 0, np.minimum(bad_map(), 777))
    np.testing.assert_array_equal(texels, expected)


def test_bad_texels_are_refused_on_request(tmp_path, as_user):
    write_exr(tmp_path / "bad.exr", bad_map())
    with pytest.raises(ValueError, match=r"bad.exr: 2 NaN, 2 infinite, 5 negative texels of 128. Pass bad_texels"):
        Environment.load(tmp_path / "bad.exr", bad_texels="refuse")
    write_exr(tmp_path / "none.exr", np.full((2, 4, 3), np.nan, np.float32))
    with pytest.raises(ValueError, match="none.exr: 8 NaN, .* no finite value"):
        Environment.load(tmp_path / "none.exr")
    with pytest.raises(ValueError, match='`bad_texels` must be "clamp" or "refuse"; got'):
        Environment.load(tmp_path / "bad.exr", bad_texels="ignore")


def test_wrong_maps_are_refused(tmp_path, as_user):
    write_exr(tmp_path / "square.exr", GOOD[:, :8])
    with pytest.raises(ValueError, match="square.exr: an environment is twice as wide as high; this is 8 x 8"):
        Environment.load(tmp_path / "square.exr")
    with pytest.raises(FileNotFoundError, match="missing.exr: no such file"):
        Environment.load(tmp_path / "missing.exr")
    write_exr(tmp_path / "good.exr", GOOD)
    with pytest.raises(ValueError, match="`dtype` float64 needs jax_enable_x64"):
        Environment.load(tmp_path / "good.exr", dtype=np.float64)


@pytest.mark.parametrize(
    ("texels", "message"),
    [
        (np.zeros((4, 9)), r"`texels` must be twice as wide as high: .*; got \[4, 9\]"),
        (np.zeros((4, 8, 4)), r"`texels` must have shape \[H, 2H\] or \[H, 2H, 3\]; got \[4, 8, 4\]"),
        (np.zeros((0, 0)), r"got \[0, 0\]"),
        (np.zeros(8), r"got \[8\]. Use jax.vmap"),
        (np.zeros((4, 8), complex), "`texels` must hold real numbers; got dtype complex"),
    ],
)
def test_wrong_texels_are_named(as_user, texels, message):
    with pytest.raises(ValueError, match=message):
        Environment(texels)


def test_wrong_arguments_are_named(as_user):
    environment = Environment(np.zeros((2, 4), np.float32))
    with pytest.raises(ValueError, match=r"`directions` must have shape \[..., 3\]; got \[4\]"):
        environment.radiance(np.zeros(4, np.float32))
    with pytest.raises(ValueError, match="`height` must be >= 1; got 0"):
        Environment.from_function(lambda w: w[:, 0], 0)
    with pytest.raises(ValueError, match=r"`function` must map \[32, 3\] to \[N\] or \[N, 3\]; got \[\]"):
        Environment.from_function(lambda w: jnp.sum(w), 4)
