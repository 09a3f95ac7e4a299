"""Files: read what others write, refuse what is broken, never overwrite unasked."""

import struct
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from shisd import io, models


def write_exr(path, image, compression="ZIP_COMPRESSION"):
    import OpenEXR

    name = {(2, 1): "Y", (3, 3): "RGB", (3, 4): "RGBA"}[image.ndim, image.shape[-1] if image.ndim == 3 else 1]
    header = {"compression": getattr(OpenEXR, compression), "type": OpenEXR.scanlineimage}
    target = path.with_suffix(".exr.tmp.exr")
    OpenEXR.File(header, {name: image}).write(str(target))
    target.rename(path)


def rgbe(image):
    """Shared exponents by definition: E with 2^(E - 129) <= max < 2^(E - 128), mantissas value 2^(136 - E)."""
    brightest = np.max(image, axis=-1)
    exponent = np.where(brightest > 0, np.floor(np.log2(np.maximum(brightest, 1e-38))) + 129, 0)
    mantissa = np.floor(image * np.exp2(136 - exponent)[..., None])
    return np.concatenate([mantissa, exponent[..., None]], axis=-1).astype(np.uint8)


def write_rgbe(path, image, header=b"FORMAT=32-bit_rle_rgbe\n", coded=True):
    """A Radiance file; coded rows use one run for every stretch of equal bytes and literals otherwise."""
    pixels = rgbe(image)
    height, width = pixels.shape[:2]
    body = bytearray()
    for row in pixels:
        if not coded:
            body += row.tobytes()
            continue
        body += bytes([2, 2, width >> 8, width & 255])
        for channel in row.T:
            at = 0
            while at < width:
                run = 1
                while at + run < width and run < 127 and channel[at + run] == channel[at]:
                    run += 1
                body += bytes([128 + run, channel[at]] if run > 1 else [1, channel[at]])
                at += run
    path.write_bytes(b"#?RADIANCE\n# made by a test\n" + header + b"\n-Y %d +X %d\n" % (height, width) + bytes(body))


BYTE_BY_BYTE = (
    b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\nEXPOSURE= 0.25\n\n-Y 2 +X 8\n"
    # row 0: red a run of 8 x 128; green 3 literals 1 2 3 and a run of 5 x 0; blue a run of 8 x 255; exponent 8 x 136
    b"\x02\x02\x00\x08" b"\x88\x80" b"\x03\x01\x02\x03\x85\x00" b"\x88\xff" b"\x88\x88"
    # row 1: red 8 literals; green, blue zero; exponents: zero (black whatever the mantissa), then 129 for 7
    b"\x02\x02\x00\x08" b"\x08\x00\x01\x02\x03\x04\x05\x06\x07" b"\x88\x00" b"\x88\x00" b"\x01\x00\x87\x81"
)  # fmt: skip


def test_radiance_file_written_byte_by_byte(tmp_path):
    """Value = mantissa 2^(exponent - 136) / exposure; the exposures of the file multiply to 0.5."""
    path = tmp_path / "hand.hdr"
    path.write_bytes(BYTE_BY_BYTE)
    image = io.read_image(path)
    assert image.shape == (2, 8, 3) and image.dtype == np.float32
    np.testing.assert_array_equal(image[0, :, 0], 256)
    np.testing.assert_array_equal(image[0, :, 1], [2, 4, 6, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(image[0, :, 2], 510)
    np.testing.assert_array_equal(image[1, :, 0], np.array([0, 1, 2, 3, 4, 5, 6, 7]) / 64)
    np.testing.assert_array_equal(image[1, :, 1:], 0)


@pytest.mark.parametrize("coded", [True, False])
@pytest.mark.parametrize("width", [8, 300])
def test_radiance_rows_plain_and_coded(tmp_path, rng, coded, width):
    image = np.exp(rng.uniform(-9, 9, (5, width, 1))) * rng.uniform(0.5, 1, (5, width, 3))
    image[2, 1:-1] = image[2, 1]  # long runs
    image[3] = 0
    write_rgbe(tmp_path / "a.hdr", image, coded=coded)
    np.testing.assert_allclose(io.read_image(tmp_path / "a.hdr"), image, rtol=0.02)


def test_narrow_radiance_rows_are_never_coded(tmp_path, rng):
    image = rng.uniform(0.5, 1, (3, 4, 3))
    write_rgbe(tmp_path / "a.hdr", image, coded=False)
    np.testing.assert_allclose(io.read_image(tmp_path / "a.hdr"), image, rtol=0.01)


def test_every_truncation_of_a_radiance_file_is_refused(tmp_path):
    path = tmp_path / "cut.hdr"
    for length in range(2, len(BYTE_BY_BYTE)):
        path.write_bytes(BYTE_BY_BYTE[:length])
        with pytest.raises(ValueError, match=r"cut.hdr: "):
            io.read_image(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"rle_rgbe", b"rle_xyze", "Radiance format '32-bit_rle_xyze'; only 32-bit_rle_rgbe is read"),
        (b"-Y 2 +X 8", b"+X 8 -Y 2", "needs a resolution line '-Y height \\+X width'; got '?b?'\\+X 8"),
        (b"-Y 2 +X 8", b"-Y 2 +X 99999999999", "truncated: 2 rows of 99999999999 need"),
        (b"-Y 2 +X 8", b"-Y 0 +X 8", "empty image"),
        (b"-Y 2 +X 8", b"-Y two +X 8", "needs a resolution line"),
        (b"EXPOSURE=2", b"EXPOSURE=x", "EXPOSURE is not a number"),
        (b"EXPOSURE=2", b"EXPOSURE=0", "EXPOSURE must be positive; got 0"),
        (b"\x88\x80\x03", b"\x89\x80\x03", "truncated or damaged in row 0 of 2"),
        (b"\x88\x80\x03", b"\x00\x80\x03", "truncated or damaged in row 0 of 2"),
        (b"\x02\x02\x00\x08\x08", b"\x02\x02\x00\x09\x08", "truncated or damaged: row 1 of 2 has no start"),
    ],
)
def test_damaged_radiance_files_are_refused(tmp_path, old, new, message):
    assert BYTE_BY_BYTE.count(old) == 1
    path = tmp_path / "bad.hdr"
    path.write_bytes(BYTE_BY_BYTE.replace(old, new))
    with pytest.raises(ValueError, match="bad.hdr: " + message):
        io.read_image(path)


def test_old_radiance_run_lengths_are_refused(tmp_path):
    path = tmp_path / "old.hdr"
    body = bytes([9, 9, 9, 128, 1, 1, 1, 3]) + bytes(24)
    path.write_bytes(b"#?RADIANCE\n\n-Y 2 +X 4\n" + body)
    with pytest.raises(ValueError, match="old.hdr: uses Radiance's old run-length code"):
        io.read_image(path)


@pytest.mark.parametrize("compression", ["NO_COMPRESSION", "ZIP_COMPRESSION", "PIZ_COMPRESSION"])
def test_exr_is_read_as_stored(tmp_path, rng, compression):
    image = rng.standard_normal((6, 9, 3)).astype(np.float32)
    image[0, 0, 0] = np.nan
    write_exr(tmp_path / "a.exr", image, compression)
    np.testing.assert_array_equal(io.read_image(tmp_path / "a.exr"), image)
    write_exr(tmp_path / "h.exr", image.astype(np.float16))
    got = io.read_image(tmp_path / "h.exr")
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, image.astype(np.float16).astype(np.float32))


def test_truncated_and_foreign_files_are_refused(tmp_path, rng):
    write_exr(tmp_path / "a.exr", rng.random((40, 80, 3)).astype(np.float32))
    content = (tmp_path / "a.exr").read_bytes()
    for share in (0.01, 0.3, 0.9):
        (tmp_path / "cut.exr").write_bytes(content[: int(share * len(content))])
        with pytest.raises(ValueError, match="cut.exr: not a readable OpenEXR file, or truncated"):
            io.read_image(tmp_path / "cut.exr")
    for name, content in (("empty.exr", b""), ("picture.hdr", b"\x89PNG\r\n\x1a\n" + bytes(50))):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=f"{name}: neither an OpenEXR nor a Radiance file; it starts with"):
            io.read_image(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="none.exr: no such file"):
        io.read_image(tmp_path / "none.exr")


def test_unusual_exr_channels(tmp_path, rng):
    import OpenEXR

    plane = rng.random((4, 8)).astype(np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"luminance": plane, "A": plane}).write(str(tmp_path / "one.exr"))
    np.testing.assert_array_equal(io.read_image(tmp_path / "one.exr"), plane)
    OpenEXR.File(header, {"R": plane, "G": plane}).write(str(tmp_path / "two.exr"))
    with pytest.raises(ValueError, match=r"two.exr: needs the channels R, G, B, or a single one; it has \['G', 'R'\]"):
        io.read_image(tmp_path / "two.exr")
    window = (np.array([0, 0], np.int32), np.array([15, 7], np.int32))
    OpenEXR.File({**header, "displayWindow": window}, {"Y": plane}).write(str(tmp_path / "crop.exr"))
    with pytest.raises(ValueError, match="crop.exr: cropped"):
        io.read_image(tmp_path / "crop.exr")


def test_missing_packages_are_named(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr", np.ones((2, 4, 3), np.float32))
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(ImportError, match=r"OpenEXR: pip install shisd\[io\]"):
        io.read_image(tmp_path / "a.exr")
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(ImportError, match=r"Pillow: pip install shisd\[io\]"):
        io.write_image(tmp_path / "a.png", np.ones((2, 4)))
    assert not (tmp_path / "a.png").exists()


def test_png_round_trip_and_overwriting(tmp_path, rng):
    import PIL.Image

    path = tmp_path / "a.png"
    image = rng.random((5, 7, 3))
    io.write_image(path, image)
    with PIL.Image.open(path) as picture:
        np.testing.assert_allclose(np.asarray(picture) / 255, image, atol=0.5 / 255 + 1e-9)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="a.png exists; pass overwrite=True"):
        io.write_image(path, np.zeros((2, 2)))
    assert path.read_bytes() == before
    io.write_image(path, np.zeros((2, 2)), overwrite=True)
    with PIL.Image.open(path) as picture:
        assert picture.size == (2, 2) and picture.mode == "L"


@pytest.mark.parametrize(
    ("image", "name", "message"),
    [
        (np.zeros((2, 2)), "a.jpg", "a.jpg: images are written as .png; got suffix '.jpg'"),
        (np.zeros((2, 2, 4)), "a.png", r"`image` must have shape \[H, W\] or \[H, W, 3\]; got \[2, 2, 4\]"),
        (np.full((2, 2), 1.5), "a.png", r"display values in \[0, 1\]; pass it through shisd.io.tonemap"),
        (np.full((2, 2), np.nan), "a.png", r"display values in \[0, 1\]"),
    ],
)
def test_wrong_images_are_refused(tmp_path, as_user, image, name, message):
    with pytest.raises(ValueError, match=message):
        io.write_image(tmp_path / name, image)
    assert not (tmp_path / name).exists()


def test_tonemap_is_the_srgb_curve():
    linear = np.array([-1, 0, 0.001, 0.0031308, 0.18, 0.5, 1, 7])
    expected = [0, 0, 0.01292, 0.04045, 0.46136, 0.73536, 1, 1]  # IEC 61966-2-1
    np.testing.assert_allclose(io.tonemap(linear), expected, atol=2e-5)
    np.testing.assert_allclose(io.tonemap(linear, exposure=0.5)[-1:], 1)
    np.testing.assert_allclose(io.tonemap(np.array(0.36), exposure=0.5), 0.46136, atol=2e-5)


def test_merl_files_are_written_by_the_book(tmp_path, rng):
    """Layout, scales and missing bins of a table; the numbers come back; nothing is overwritten unasked."""
    table = rng.random((90, 90, 180, 3))
    table[3, 4, 5, 1] = -7
    path = tmp_path / "a.binary"
    io.write_merl(path, table)
    content = path.read_bytes()
    assert len(content) == 34_992_012 and struct.unpack("<3i", content[:12]) == (90, 90, 180)
    scale = [1 / 1500, 1.15 / 1500, 1.66 / 1500]
    for h, d, p, c in ((0, 0, 0, 0), (3, 4, 5, 2), (40, 20, 170, 1)):
        offset = 12 + 8 * (p + 180 * (d + 90 * (h + 90 * c)))
        assert struct.unpack_from("<d", content, offset)[0] * scale[c] == pytest.approx(table[h, d, p, c])
    got = io.read_merl(path)
    above = io.merl_above_horizon()
    assert np.all(got[~above] < 0) and got[3, 4, 5, 1] < 0
    above[3, 4, 5] = False
    np.testing.assert_allclose(got[above], table[above], rtol=1e-14)
    with pytest.raises(FileExistsError, match="a.binary exists; pass overwrite=True"):
        io.write_merl(path, table)
    assert path.read_bytes() == content
    io.write_merl(path, 2 * np.abs(table), overwrite=True)
    assert path.read_bytes() != content


def test_a_scalar_brdf_fills_three_equal_planes(tmp_path):
    io.write_merl(tmp_path / "grey.binary", models.Lambertian(0.5))
    table = io.read_merl(tmp_path / "grey.binary")
    np.testing.assert_allclose(table[io.merl_above_horizon()], 0.5 / np.pi, rtol=1e-6)
    assert 0.5 < np.mean(io.merl_above_horizon()) < 0.9


def test_what_a_merl_file_cannot_hold_is_refused(tmp_path, as_user):
    path = tmp_path / "a.binary"
    with pytest.raises(ValueError, match="`brdf` is anisotropic"):
        io.write_merl(path, models.Ggx([0.1, 0.2]))
    with pytest.raises(ValueError, match=r"a table \[90, 90, 180, 3\]; got shape \[90, 90\]"):
        io.write_merl(path, jnp.zeros((90, 90)))
    table = np.zeros((90, 90, 180, 3))
    table[0, 0, 0] = np.inf
    with pytest.raises(ValueError, match="`brdf` has 3 values that are not finite"):
        io.write_merl(path, table)
    assert not path.exists()
