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

radiance = eqx.filter_jit(lambda environment, w, texels="cells": environment.radiance(w, texels=texels))
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


@pytest.mark.parametrize("height", [4, 7])
def test_power_of_a_texel_is_the_same_everywhere(x64, height):
    """Row by row: `coefficients`, and the integral of `radiance` by Gauss-Legendre rules in every cell of the row."""
    texels = np.zeros((height, 2 * height, height))
    texels[np.arange(height), 2, np.arange(height)] = 1000  # one map of each row, as colours
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    exact = 1000 * (edges[:-1] - edges[1:]) * np.pi / height
    maps = [Environment(np.ascontiguousarray(texels[..., k])) for k in range(height)]
    np.testing.assert_allclose(1000 * np.asarray(maps[0].solid_angles()), exact, rtol=1e-14)
    x, w = np.polynomial.legendre.leggauss(8)
    theta = np.pi * (np.arange(height)[:, None] + 0.5 + x / 2) / height
    phi = np.pi * (np.arange(2 * height)[:, None] + 0.5 + x / 2) / height
    weights = np.outer((w * np.sin(theta)).ravel(), np.tile(w, 2 * height)) * (np.pi / height / 2) ** 2
    directions = spherical(theta.reshape(-1, 1), phi.reshape(1, -1))
    for environment, power in zip(maps, exact, strict=True):
        assert float(environment.coefficients(3)[0]) * np.sqrt(4 * np.pi) == pytest.approx(power, rel=1e-14)
        assert np.sum(weights * np.asarray(radiance(environment, directions))) == pytest.approx(power, rel=1e-13)


def test_samples_have_their_own_rule(x64, rng):
    """A map of y_1^0 and 1, as values at texel centres, is projected and looked up as that."""
    environment = Environment.from_function(lambda w: 2 + w[:, 2], 32)
    exact = np.sqrt(4 * np.pi) * np.array([2, 0, 1 / np.sqrt(3), 0])
    np.testing.assert_allclose(environment.coefficients(1, texels="samples"), exact, atol=1e-13)
    w = np.array([[0.6, 0.0, 0.8], [0.1, 0.2, -0.5]])
    z = w[:, 2] / np.linalg.norm(w, axis=1)
    np.testing.assert_allclose(radiance(environment, w, "samples"), 2 + z, atol=2e-3)


@pytest.mark.parametrize("colour", [(3,)])
def test_radiance_at_a_texel_centre_is_the_texel(colour, dtype, rng):
    texels = rng.uniform(0, 5, (6, 12, *colour)).astype(dtype)
    environment = Environment(texels)
    for kind in ("cells", "samples"):
        got = radiance(environment, environment.directions(), kind)
        assert got.dtype == dtype
        np.testing.assert_allclose(got, texels, rtol=0, atol=3e-5 if dtype == np.float32 else 1e-13)


def test_radiance_is_bilinear_wraps_and_continues_across_the_poles(x64, rng):
    """Against a scalar lookup in a map extended by hand: one column on each side, one row over each pole."""
    texels = rng.uniform(0, 5, (6, 12))
    rows = np.concatenate([np.roll(texels[:1], 6, axis=1), texels, np.roll(texels[-1:], 6, axis=1)])
    extended = np.concatenate([rows[:, -1:], rows, rows[:, :1]], axis=1)
    environment = Environment(texels)
    z = rng.uniform(-1, 1, 300)
    z[:40] = np.sign(z[:40]) * (1 - 10.0 ** -rng.uniform(2, 12, 40))
    theta, phi = np.arccos(z), rng.uniform(0, 2 * np.pi, 300)
    got = radiance(environment, 3 * spherical(theta, phi), "samples")  # any length
    for value, t, p in zip(got, theta, phi, strict=True):
        y, x = t / np.pi * 6 + 0.5, p / (2 * np.pi) * 12 + 0.5
        j, i = int(y), int(x)
        v, u = y - j, x - i
        cell = extended[j : j + 2, i : i + 2]
        assert float(value) == pytest.approx(np.array([1 - v, v]) @ cell @ np.array([1 - u, u]), rel=1e-6, abs=1e-6)
    poles = np.array([[1e-9, 0, 1], [-1e-9, 0, 1], [1e-9, 0, -1], [-1e-9, 0, -1.0]])
    pole = np.asarray(radiance(environment, poles, "samples"))
    np.testing.assert_allclose(pole[::2], pole[1::2], rtol=1e-6)  # no seam along a great circle


def test_derivatives_of_samples(x64, rng):
    texels = jnp.asarray(rng.uniform(0, 1, (4, 8, 3)))
    directions = jnp.asarray(spherical(np.array([0.1, 1.2, 3.1]), np.array([0.1, 3.0, 5.0])))
    f = jax.jit(lambda texels, directions: Environment(texels).radiance(directions, texels="samples"))
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


def test_coefficients_of_a_linear_function(x64, rng):
    """Any map at degree 1, from the integrals of x, y, z over each cell in closed form."""
    height = 6
    texels = rng.uniform(0, 2, (height, 2 * height, 3))
    theta, phi = (np.linspace(0, end, n + 1) for end, n in ((np.pi, height), (2 * np.pi, 2 * height)))
    step, across = np.pi / height, np.diff(theta / 2 - np.sin(2 * theta) / 4)  # of sin^2
    x, y = np.outer(across, np.diff(np.sin(phi))), np.outer(across, -np.diff(np.cos(phi)))
    z = np.outer(np.diff(np.sin(theta) ** 2) / 2, np.full(2 * height, step))
    one = np.outer(-np.diff(np.cos(theta)), np.full(2 * height, step))
    basis = np.stack([one, -np.sqrt(3) * y, np.sqrt(3) * z, -np.sqrt(3) * x]) / np.sqrt(4 * np.pi)
    got = Environment(texels).coefficients(1)
    np.testing.assert_allclose(got, np.einsum("nji,jic->cn", basis, texels), rtol=0, atol=3e-14)


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
    message = r"bad.exr: 2 NaN texels set to 0, 1 infinite texel set to 65504, 6 negative texels set to 0, of 128\.$"
    with pytest.warns(UserWarning, match=message):
        texels = np.asarray(Environment.load(tmp_path / "bad.exr").texels)
    expected = np.where(np.isnan(bad_map()) | (bad_map() < 0), 0, np.minimum(bad_map(), 65504))
    np.testing.assert_array_equal(texels, expected)


def test_an_infinite_sun_is_not_made_dimmer_than_what_is_finite(tmp_path):
    """A sun that half precision cannot hold: 65504 or more, not the brightest of the sky."""
    texels = GOOD.copy()
    texels[2, 5] = np.inf
    for brightest, light in ((3.0, 65504), (70000, 70000)):
        texels[3, 0] = brightest
        write_exr(tmp_path / "sun.exr", texels)
        with pytest.warns(UserWarning, match=f"sun.exr: 1 infinite texel set to {light:.6g}, of 128"):
            assert Environment.load(tmp_path / "sun.exr").texels[2, 5, 0] == light


def test_bad_texels_are_refused_on_request(tmp_path, as_user):
    write_exr(tmp_path / "bad.exr", bad_map())
    message = r"bad.exr: 2 NaN texels, 1 infinite texel, 6 negative texels of 128. Pass bad_texels=\"clamp\" to"
    with pytest.raises(ValueError, match=message):
        Environment.load(tmp_path / "bad.exr", bad_texels="refuse")
    write_exr(tmp_path / "none.exr", np.full((2, 4, 3), np.nan, np.float32))
    with pytest.raises(ValueError, match="none.exr: 8 NaN texels of 8: no finite value"):
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
        (np.full((4, 8, 3), 128, np.uint8), "`texels` must be linear radiance in float32 or float64; got dtype uint8"),
        (np.full((4, 8), 4e4, np.float16), "got dtype float16. Pass float32 or float64"),
        (np.ones((4, 8), np.longdouble), "`texels` must be an array of real numbers; got dtype float128. Pass float32"),
    ],
)
def test_wrong_texels_are_named(as_user, texels, message):
    with pytest.raises(ValueError, match=message):
        Environment(texels)


def turned_map(source, up, height=4):
    """Where a program shows each texel of a file [H, W, 3], from its own formulas, as loaded here."""
    j, i = np.mgrid[:height, : 2 * height]
    theta, u = np.pi * (j + 0.5) / height, (i + 0.5) / (2 * height)
    if source == "blender":  # u = (atan2(y, x) - pi) / -2 pi, v = 1 - acos(z) / pi
        return spherical(theta, np.pi - 2 * np.pi * u)
    # Mitsuba's u = atan2(x, -z) / 2 pi, v = acos(y) / pi; its emitter stands as it is or turned by 90 degrees about x
    x, y, z = np.sin(theta) * np.sin(2 * np.pi * u), np.cos(theta), -np.sin(theta) * np.cos(2 * np.pi * u)
    return np.stack([z, x, y] if up == "y" else [x, -z, y], axis=-1)


@pytest.mark.parametrize(("source", "up"), [("blender", None), ("mitsuba", None), ("mitsuba", "y"), ("mitsuba", "z")])
def test_maps_are_turned_as_their_program_shows_them(tmp_path, rng, source, up):
    texels = rng.uniform(1, 2, (4, 8, 3)).astype(np.float32)
    write_exr(tmp_path / "map.exr", texels)
    environment = Environment.load(tmp_path / "map.exr", source=source, up=up)
    shown = turned_map(source, up or ("y" if source == "mitsuba" else "z")).astype(np.float32)
    np.testing.assert_array_equal(radiance(environment, shown), texels)


@pytest.mark.slow
@pytest.mark.parametrize("up", ["y", "z"])
def test_mitsuba_shows_the_same(tmp_path, rng, up):
    """What its emitter returns where no interpolation is needed in phi; rows differ by up to half a texel of theta."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    height = 16
    wave = np.cos(np.pi * np.arange(2 * height) / height + 0.4)  # so smooth in theta that half a texel is small
    texels = np.repeat((2 + wave)[None, :, None], 3, axis=2) * np.linspace(1, 2, height)[:, None, None]
    write_exr(tmp_path / "map.exr", texels.astype(np.float32))
    environment = Environment.load(tmp_path / "map.exr", source="mitsuba", up=up)
    turn = mi.ScalarTransform4f() if up == "y" else mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    emitter = mi.load_dict({"type": "envmap", "filename": str(tmp_path / "map.exr"), "to_world": turn})
    mi.load_dict({"type": "scene", "emitter": emitter})
    w = np.asarray(environment.directions(), float)
    ours = np.asarray(environment.texels)
    for j, i in ((0, 0), (3, 5), (8, 31), (12, 17), (15, 9)):
        x, y, z = w[j, i]
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f(*((-y, -z, -x) if up == "y" else (-x, -y, -z)))
        theirs = np.array(emitter.eval(si))
        row = np.clip((j + 0.5) * (height - 1) / height, 0, height - 1)  # theirs, counted from pole to pole
        np.testing.assert_allclose(theirs, ours[j, i] * (1 + row / (height - 1)) / (1 + j / (height - 1)), rtol=2e-3)


# ---- four maps of one bright texel in every program: near both poles and edges, and inside

BRIGHT = [(0, 0), (2, 7), (5, 12), (7, 15)]
HEIGHT = 8
TO_OURS = {"z": lambda x, y, z: (x, y, z), "y": lambda x, y, z: (z, x, y)}  # where +z here is up in the program
TURNED = lambda x, y, z: (x, -z, y)  # a scene with +z up, for which the map is turned by 90 degrees about x


def cycles(x, y, z):
    """direction_to_equirectangular_range, range (-2 pi, pi, -pi, pi): v from below."""
    return (np.arctan2(y, x) - np.pi) / (-2 * np.pi), (np.arccos(z) - np.pi) / -np.pi


def three_js(x, y, z):
    """equirectUv of ShaderChunk/common.glsl.js, for textures with flipY: v from below."""
    return np.arctan2(z, x) / (2 * np.pi) + 0.5, np.arcsin(y) / np.pi + 0.5


def filament(x, y, z):
    """toRectilinear of CubemapUtils::equirectangularToCubemap at what mirrorCubemap reads; its v is from above."""
    u, v = (np.arctan2(-x, z) / np.pi + 1) / 2, (1 - np.arcsin(y) * 2 / np.pi) / 2
    return u, 1 - v


PROGRAMS = {
    ("blender", None): (cycles, TO_OURS["z"]),
    ("three.js", None): (three_js, TO_OURS["y"]),
    ("three.js", "z"): (three_js, TURNED),
    ("filament", None): (filament, TO_OURS["y"]),
    ("filament", "z"): (filament, TURNED),
}


def bright(tmp_path, texel, **options):
    """The map of one bright texel as it is in a file, and as it is loaded."""
    texels = np.zeros((HEIGHT, 2 * HEIGHT, 3), np.float32)
    texels[texel] = 1
    write_exr(tmp_path / "bright.exr", texels)
    return texels, Environment.load(tmp_path / "bright.exr", **options)


@pytest.mark.parametrize("texel", BRIGHT)
@pytest.mark.parametrize(("source", "up"), PROGRAMS)
def test_a_texel_is_where_its_program_looks_it_up(tmp_path, rng, source, up, texel):
    texels, environment = bright(tmp_path, texel, source=source, up=up)
    to_uv, to_ours = PROGRAMS[source, up]
    w = np.moveaxis(spherical(np.arccos(rng.uniform(-1, 1, 4000)), rng.uniform(0, 2 * np.pi, 4000)), -1, 0)
    u, v = to_uv(*w)
    column, row = (np.clip((a * n).astype(int), 0, n - 1) for a, n in ((u, 2 * HEIGHT), (1 - v, HEIGHT)))
    shown = texels[row, column]
    inside = np.all([np.abs(a * n - np.round(a * n)) > 1e-4 for a, n in ((u, 2 * HEIGHT), (v, HEIGHT))], axis=0)
    got = np.asarray(radiance(environment, np.stack(to_ours(*w), axis=-1).astype(np.float32)))
    assert np.sum(shown[inside]) > 0
    np.testing.assert_array_equal(got[inside], shown[inside])


@pytest.mark.parametrize("texel", BRIGHT)
def test_a_texel_is_where_radiance_traces_it(tmp_path, texel):
    """view360stereo.cal as it stands: rows $1 from above and columns $2 of both eyes' halves, the upper one here."""
    texels, environment = bright(tmp_path, texel, source="radiance")
    XD = YD = 2 * HEIGHT
    first, second = np.mgrid[:HEIGHT, :XD]
    px, py = (XD - 1) / 2 - second, YD - 0.5 - first
    frac = lambda x: x - np.floor(x)
    altitude, azimuth = (frac(py / (YD / 2)) - 0.5) * np.pi, 2 * np.pi / XD * px
    direction = [np.cos(azimuth) * np.cos(altitude), np.sin(azimuth) * np.cos(altitude), np.sin(altitude)]
    np.testing.assert_array_equal(radiance(environment, np.stack(direction, axis=-1).astype(np.float32)), texels)


@pytest.mark.parametrize("texel", BRIGHT)
@pytest.mark.parametrize("up", ["y", "z"])
def test_a_texel_is_where_mitsuba_is_brightest(tmp_path, up, texel):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    _, environment = bright(tmp_path, texel, source="mitsuba", up=up)
    turn = mi.ScalarTransform4f() if up == "y" else mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    emitter = mi.load_dict({"type": "envmap", "filename": str(tmp_path / "bright.exr"), "to_world": turn})
    mi.load_dict({"type": "scene", "emitter": emitter})
    theirs = []
    for x, y, z in np.asarray(environment.directions(), float).reshape(-1, 3):
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f(*((-y, -z, -x) if up == "y" else (-x, -y, -z)))
        theirs.append(emitter.eval(si)[0])
    assert np.argmax(theirs) == np.argmax(environment.texels[..., 0]) and max(theirs) > 0.5


def test_sources_that_are_not_known_are_refused(tmp_path, as_user):
    write_exr(tmp_path / "odd.exr", np.ones((3, 6, 3), np.float32))
    known = "'shisd', 'blender', 'radiance', 'mitsuba', 'filament', 'three.js'"
    for options, message in (
        ({"source": "maya"}, f"`source` must be one of {known}; got 'maya'"),
        ({"source": "blender", "up": "y"}, "`up` must be 'z' for source='blender'; got 'y'"),
        ({"source": "mitsuba", "up": "x"}, "`up` must be 'y' or 'z' for source='mitsuba'; got 'x'"),
        ({"source": "mitsuba", "up": "z"}, "odd.exr: a height that is even is needed to turn the map; it is 3"),
        ({"source": "three.js"}, "odd.exr: a height that is even is needed to turn the map; it is 3"),
    ):
        with pytest.raises(ValueError, match=message):
            Environment.load(tmp_path / "odd.exr", **options)


def test_wrong_arguments_are_named(as_user):
    environment = Environment(np.zeros((2, 4), np.float32))
    with pytest.raises(ValueError, match=r"`directions` must have shape \[..., 3\]; got \[4\]"):
        environment.radiance(np.zeros(4, np.float32))
    with pytest.raises(ValueError, match="`height` must be >= 1; got 0"):
        Environment.from_function(lambda w: w[:, 0], 0)
    with pytest.raises(ValueError, match=r"`function` must map \[32, 3\] to \[N\] or \[N, 3\]; got \[\]"):
        Environment.from_function(lambda w: jnp.sum(w), 4)
