"""The MERL reader and the interpolation, against a file written independently and against the models it came from."""

import math
import os
import struct

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import io, models
from shisd.models import _measured
from tests.models.materials import GOLD_PAINT, evaluate, hemisphere, pairs, spherical

SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0


@eqx.filter_jit
def slopes(brdf, wi, wo):
    """The sum over colours of `brdf.value_cosine` at rows of directions, and its derivatives in both."""
    f = lambda wi, wo: jnp.sum(brdf.value_cosine(wi, wo))
    return jax.vmap(jax.value_and_grad(f, argnums=(0, 1)))(wi, wo)


def in_batches(function, brdf, wi, wo, dtype=np.float32, size=500):
    """A function of rows of directions in batches of one size, the last filled up: one compilation serves all tests."""
    parts = []
    for at in range(0, len(wi), size):
        rows = [np.resize(np.asarray(w[at : at + size], dtype), (size, 3)) for w in (wi, wo)]
        parts.append(function(brdf, *rows))
    return jax.tree.map(lambda *x: np.concatenate(x)[: len(wi)], *parts)


def reference_angles(wi, wo):
    """Rusinkiewicz's angles by rotations, as he wrote them: turn h to the pole about z, then about y."""
    h = (wi + wo) / np.linalg.norm(wi + wo)
    theta_h, phi_h = math.acos(h[2]), math.atan2(h[1], h[0])
    c, s = math.cos(-phi_h), math.sin(-phi_h)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c, s = math.cos(-theta_h), math.sin(-theta_h)
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    d = about_y @ about_z @ wi
    return theta_h, math.acos(d[2]), math.atan2(d[1], d[0])


def write_reference(path, f):
    """A MERL file by definition: f(theta_h, theta_d, phi_d) in 1/sr at bin centres, -1 below the horizon."""
    th = ((np.arange(90) + 0.5) / 90) ** 2 * np.pi / 2
    td = (np.arange(90) + 0.5) / 90 * np.pi / 2
    pd = (np.arange(180) + 0.5) / 180 * np.pi
    th, td, pd = np.meshgrid(th, td, pd, indexing="ij")
    raw = f(th, td, pd) / SCALE
    tilt = np.sin(th) * np.sin(td) * np.cos(pd)
    raw[np.cos(th) * np.cos(td) <= np.abs(tilt)] = -1
    with open(path, "wb") as file:
        np.array([90, 90, 180], "<i4").tofile(file)
        for colour in range(3):
            raw[..., colour].astype("<f8").tofile(file)
    return raw


def smooth(th, td, pd):
    """Smooth in what the table resolves, constant over phi_d at both poles, of period pi in phi_d."""
    base = np.exp(-3 * th) * (1 + 0.3 * np.sin(td) ** 2 * np.sin(th) * np.cos(2 * pd)) + 0.1
    return base[..., None] * np.array([0.2, 0.5, 1.0])


@pytest.fixture(scope="module")
def smooth_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("merl") / "smooth.binary"
    write_reference(path, smooth)
    return path


@pytest.fixture(scope="module")
def smooth_brdf(smooth_file):
    return models.MeasuredBrdf.from_merl(smooth_file)


def test_angles_are_those_of_rusinkiewicz(rng, x64):
    wi, wo = pairs(rng, 300, 1e-3)
    got = np.stack(jax.jit(jax.vmap(_measured.half_difference_angles))(wi, wo), axis=-1)
    expected = np.array([reference_angles(i, o) for i, o in zip(wi, wo, strict=True)])
    np.testing.assert_allclose(got[:, :2], expected[:, :2], atol=1e-7)
    turns = (got[:, 2] - expected[:, 2]) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-7)


def test_a_file_written_by_definition_is_read_in_1_over_sr(smooth_brdf, rng):
    assert smooth_brdf.table.shape == (90, 90, 180, 3) and smooth_brdf.table.dtype == np.float32
    assert smooth_brdf.isotropic
    wi, wo = pairs(rng, 2000, 0.1)
    got = in_batches(evaluate, smooth_brdf, wi, wo)
    angles = np.array([reference_angles(i, o) for i, o in zip(wi, wo, strict=True)])
    np.testing.assert_allclose(got, smooth(*angles.T), rtol=4e-3)


def test_bin_centres_are_met_exactly(smooth_file, smooth_brdf, rng):
    """The value at the centre of a bin is the number in the file."""
    i, j, k = rng.integers(0, [[60], [30], [180]], (3, 200))
    th = np.pi / 2 * ((i + 0.5) / 90) ** 2
    td, pd = np.pi / 2 * (j + 0.5) / 90, np.pi * (k + 0.5) / 180
    d = spherical(td, pd)
    x, y, z = d.T
    c, s = np.cos(th), np.sin(th)
    wi = np.stack([c * x + s * z, y, c * z - s * x], axis=-1)
    h = spherical(th, 0.0)
    wo = 2 * z[:, None] * h - wi
    got = in_batches(evaluate, smooth_brdf, wi, wo)
    planes = np.fromfile(smooth_file, "<f8", offset=12).reshape(3, 90, 90, 180)
    expected = planes[:, i, j, k].T * SCALE
    np.testing.assert_allclose(got, expected, rtol=2e-4)
    np.testing.assert_allclose(io.read_merl(smooth_file)[i, j, k], expected, rtol=1e-12)


def test_measured_materials_keep_the_contract(smooth_brdf, rng):
    wi, wo = (w.astype(np.float32) for w in pairs(rng, 500))
    there, back = (evaluate(smooth_brdf, *pair) for pair in ((wi, wo), (wo, wi)))
    assert there.shape == (500, 3) and there.dtype == np.float32 and np.all(there > 0)
    np.testing.assert_allclose(there, back, rtol=2e-4)
    down = np.array([1, 1, -1], np.float32)
    for below in (evaluate(smooth_brdf, down * wi, wo), evaluate(smooth_brdf, wi, down * wo)):
        np.testing.assert_array_equal(below, 0)
    assert 0 < float(smooth_brdf.lobe_width) <= 1
    with jax.enable_x64(True):
        double = evaluate(smooth_brdf, wi.astype(float), wo.astype(float))
        assert double.dtype == np.float64
    np.testing.assert_allclose(there, double, rtol=2e-4)


def test_the_azimuth_wraps():
    """phi_d just below pi and just above 0 are neighbours, and phi_d + pi is phi_d: a table of 1 + 0.3 sin(2 phi_d)."""
    h, theta_d = spherical(0.5, 0.0), 0.4
    c, s = math.cos(0.5), math.sin(0.5)

    def pair(phi_d):
        x, y, z = spherical(theta_d, phi_d)
        wi = np.array([c * x + s * z, y, c * z - s * x])
        return wi, 2 * z * h - wi

    centres = np.pi * (np.arange(180) + 0.5) / 180
    table = np.broadcast_to(1 + 0.3 * np.sin(2 * centres)[:, None], (90, 90, 180, 3)).astype(np.float32)
    angles = np.array([-1e-4, 1e-4, 0.7, np.pi - 1e-4, np.pi + 1e-4, np.pi + 0.7, 2 * np.pi - 1e-4])
    value = in_batches(evaluate, models.MeasuredBrdf(table), *zip(*map(pair, angles), strict=True))
    expected = 1 + 0.3 * np.sin(2 * angles)
    np.testing.assert_allclose(value, np.broadcast_to(expected[:, None], value.shape), atol=1e-4)  # 5e-5 by the bins


def test_poles_are_ordinary_points(rng, x64):
    """With a table of noise, the value at wi = wo and at h = n is the limit from every side, the derivative zero."""
    noisy = models.MeasuredBrdf(rng.uniform(0.5, 1.5, (90, 90, 180, 3)))
    normal = np.array([0, 0, 1.0])
    slant = spherical(0.6, 1.0)
    for wi, wo in ((slant, slant), (slant * [-1, -1, 1], slant), (normal, normal)):
        around = np.concatenate([[np.zeros(3)], 1e-7 * rng.standard_normal((20, 3))])
        values, slope = in_batches(slopes, noisy, wi + around, wo + 0 * around, float)
        # at both poles the mean over phi_d, and no jump around it
        np.testing.assert_allclose(values, np.broadcast_to(values[0], values.shape), atol=6e-4)
        assert all(np.isfinite(s[0]).all() for s in slope)
    value = in_batches(slopes, noisy, normal[None], normal[None], float)[0]
    np.testing.assert_allclose(value, np.sum(np.mean(noisy.table[0, 0], axis=0)), rtol=1e-12)


def test_derivatives_are_right_inside_bins(smooth_brdf, rng, x64):
    double = models.MeasuredBrdf(np.asarray(smooth_brdf.table, float))
    wi, wo = hemisphere(rng, 20, 0.2), hemisphere(rng, 20, 0.2)
    steps = 1e-6 * np.eye(3)[:, None]
    moved = [(wi, wo)]
    moved += [(wi + s * e, wo) for e in steps for s in (1, -1)] + [(wi, wo + s * e) for e in steps for s in (1, -1)]
    values, slope = in_batches(slopes, double, *map(np.concatenate, zip(*moved, strict=True)), float)
    differences = values.reshape(13, 20)[1:].reshape(2, 3, 2, 20)
    expected = (differences[:, :, 0] - differences[:, :, 1]) / 2e-6
    got = np.stack([s[:20].T for s in slope])
    right = np.abs(got - expected) <= 1e-5 * (1 + np.abs(expected))
    assert np.mean(right) > 0.95  # a difference now and then straddles two bins


def test_table_is_differentiable_and_weights_sum_to_one(smooth_brdf):
    wi, wo = (spherical(*a).astype(np.float32) for a in ((0.5, 0.3), (0.8, 2.0)))
    slope = jax.jit(jax.grad(lambda table: jnp.sum(models.MeasuredBrdf(table).value(wi, wo))))(smooth_brdf.table)
    slope = np.asarray(slope)
    np.testing.assert_allclose(np.sum(slope, axis=(0, 1, 2)), 1, rtol=1e-5)
    assert np.all(slope >= 0) and np.sum(slope > 0) == 8 * 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "make"),
    [("ggx", lambda: models.Ggx(0.3, [0.2, 0.5, 0.9])), ("sgd", lambda: models.SgdMicrofacet(**GOLD_PAINT))],
)
def test_round_trip_through_a_file(kind, make, tmp_path, rng):
    path, brdf = tmp_path / "material.binary", make()
    io.write_merl(path, brdf)
    assert path.stat().st_size == 34_992_012
    measured = models.MeasuredBrdf.from_merl(path)
    for least, bound in ((0.3, 0.01), (0.05, 0.03)):
        wi, wo = pairs(rng, 2000, least)
        got, expected = in_batches(evaluate, measured, wi, wo), in_batches(evaluate, brdf, wi, wo)
        error = np.max(np.abs(got - expected) / expected)
        assert error <= bound, (kind, least, error)
    width = float(measured.lobe_width)
    assert 0.5 < width / float(brdf.lobe_width) < 2, (width, float(brdf.lobe_width))


@pytest.mark.slow
def test_holes_are_filled_counted_and_refused_on_request(smooth_file, smooth_brdf, tmp_path, rng):
    planes = np.fromfile(smooth_file, "<f8", offset=12).reshape(3, 90, 90, 180)
    holes = (rng.random(planes.shape[1:]) < 0.2) & (planes[0] >= 0)
    planes[:, holes] = -0.3
    planes[1, 10, 10, 10] = np.nan
    count = 3 * int(holes.sum()) + (0 if holes[10, 10, 10] else 1)
    path = tmp_path / "holes.binary"
    with path.open("wb") as file:
        np.array([90, 90, 180], "<i4").tofile(file)
        planes.tofile(file)
    with pytest.warns(
        UserWarning, match=rf"holes.binary: {count} of 4374000 values are above the horizon but negative"
    ):
        filled = models.MeasuredBrdf.from_merl(path)
    assert np.all(np.asarray(filled.table) > 0)
    wi, wo = pairs(rng, 1000, 0.1)
    got, expected = in_batches(evaluate, filled, wi, wo), in_batches(evaluate, smooth_brdf, wi, wo)
    np.testing.assert_allclose(got, expected, rtol=0.06)
    with pytest.raises(ValueError, match=rf"{count} of 4374000 values .* Pass negative=\"fill\""):
        models.MeasuredBrdf.from_merl(path, negative="refuse")


def test_nearest_valid_bins_fill_the_others():
    """Along theta_d or phi_d, whichever is nearer; phi_d wraps; an empty slice takes the next theta_h."""
    values = np.arange(2 * 4 * 6 * 1, dtype=float).reshape(2, 4, 6, 1)
    valid = np.zeros(values.shape, bool)
    valid[0, 0, 0] = valid[0, 3, 5] = True
    filled = _measured.fill_nearest(values, valid)
    assert filled is not None
    first, last = values[0, 0, 0, 0], values[0, 3, 5, 0]
    np.testing.assert_array_equal(filled[0, 0, :, 0], first)
    np.testing.assert_array_equal(filled[0, 3, :, 0], last)
    assert filled[0, 1, 0, 0] == first and filled[0, 2, 5, 0] == last
    np.testing.assert_array_equal(filled[1], filled[0])
    assert _measured.fill_nearest(values, np.zeros_like(valid)) is None


def test_below_the_horizon_bins_never_leak(smooth_brdf, rng):
    """Right at the horizon the interpolation takes filled bins: positive and near the nearest measured ones."""
    assert np.all(np.asarray(smooth_brdf.table) > 0)
    z = 10.0 ** -rng.uniform(1, 6, 500)
    phi = rng.uniform(0, 2 * np.pi, 500)
    wi = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
    wo = hemisphere(rng, 500, 0.05)
    got = in_batches(evaluate, smooth_brdf, wi, wo)
    expected = smooth(*np.array([reference_angles(i, o) for i, o in zip(wi, wo, strict=True)]).T)
    np.testing.assert_allclose(got, expected, rtol=0.05)


def test_float64_tables_need_x64(smooth_file, as_user):
    with pytest.raises(ValueError, match="`dtype` float64 needs jax_enable_x64"):
        models.MeasuredBrdf.from_merl(smooth_file, dtype=np.float64)


BINS = struct.pack("<3i", 90, 90, 180)


@pytest.mark.parametrize(
    ("start", "size", "message"),
    [
        (b"", 0, "a MERL material has 34,992,012 bytes; this file has 0"),
        (BINS, 1012, "this file has 1,012"),
        (b"PNG!", 34_992_012, r"starts with the bin counts \(90, 90, 180\); got \(558321232, 0, 0\)"),
        (struct.pack("<3i", 90, 180, 90), 34_992_012, r"got \(90, 180, 90\)"),
        (struct.pack(">3i", 90, 90, 180), 34_992_012, "It is big-endian: swap the bytes of its integers and doubles"),
    ],
    ids=["empty", "truncated", "foreign", "other bins", "big-endian"],
)
def test_foreign_and_truncated_files_are_refused(tmp_path, as_user, start, size, message):
    path = tmp_path / "bad.binary"
    path.write_bytes(start)
    os.truncate(path, size)
    with pytest.raises(ValueError, match="bad.binary.*" + message):
        models.MeasuredBrdf.from_merl(path)


def test_values_that_no_material_has(smooth_file, tmp_path, as_user):
    """A few become missing, with a warning; many are refused, as those of the other byte order are."""
    path = tmp_path / "bad.binary"
    content = bytearray(smooth_file.read_bytes())
    at = lambda h, d, p, c: 12 + 8 * (p + 180 * (d + 90 * (h + 90 * c)))
    struct.pack_into("<d", content, at(20, 30, 40, 1), 1e42)
    struct.pack_into("<d", content, at(20, 30, 41, 1), np.inf)
    struct.pack_into("<d", content, at(20, 30, 42, 1), np.nan)
    path.write_bytes(content)
    with pytest.warns(UserWarning, match="bad.binary: 2 of 4374000 values are infinite or beyond 1e.15 / sr"):
        table = io.read_merl(path)
    assert np.all(table[20, 30, 40:43, 1] < 0) and np.all(table[20, 30, 43, 1] > 0) and np.isfinite(table).all()
    swapped = np.frombuffer(smooth_file.read_bytes(), ">f8", offset=12)
    with path.open("wb") as file:
        file.write(BINS)
        swapped.astype("<f8").tofile(file)
    with pytest.raises(ValueError, match=r"bad.binary: \d+ of 4374000 values .* damaged or big-endian"):
        models.MeasuredBrdf.from_merl(path)
    with path.open("wb") as file:
        file.write(BINS)
        np.full(4_374_000, np.nan).tofile(file)
    with pytest.raises(ValueError, match="bad.binary: a colour plane holds no valid value"):
        models.MeasuredBrdf.from_merl(path)


def test_wrong_arguments_are_named(tmp_path, as_user):
    with pytest.raises(FileNotFoundError, match="none.binary: no such file"):
        models.MeasuredBrdf.from_merl(tmp_path / "none.binary")
    with pytest.raises(ValueError, match='`negative` must be "fill" or "refuse"; got'):
        models.MeasuredBrdf.from_merl(tmp_path / "none.binary", negative="zero")
    with pytest.raises(ValueError, match=r"`table` must be of shape \[90, 90, 180, 3\]; got shape \[90, 90, 180\]"):
        models.MeasuredBrdf(np.ones((90, 90, 180), np.float32))
