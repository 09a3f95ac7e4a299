"""Files: read what others write, refuse what is broken, never overwrite unasked or halfway."""

import argparse
import os
import re
import struct
import sys
import threading
import tracemalloc
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from shisd import io, models
from shisd.io.internal import merl_above_horizon, read_npz, write_atomically


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


PIXEL = np.array([[128, 64, 32, 129]], np.uint8)  # 1, 1/2, 1/4
FORMAT = b"FORMAT=32-bit_rle_rgbe\n"


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        (b"#?RADIANCE\n" + FORMAT, 1),
        (b"#?RGBE\n" + FORMAT, 1),  # OpenCV
        (b"#?RADIANCE\nEXPOSURE=0\nSOFTWARE=FreeImage 3.18.0\n" + FORMAT, 1),
        (b"#?RADIANCE\n# Created with Blender\nEXPOSURE=         1.0000000000000\n" + FORMAT, 1),
        (b"#?RADIANCE\n# Made with Adobe Photoshop\nGAMMA=1\nPRIMARIES=0 0 0 0 0 0 0 0\n" + FORMAT, 1),
        (b"#?RADIANCE\npfilt -e 4\nEXPOSURE=4\nCOLORCORR= 2 1 .5\nEXPOSURE=5e-1\nCOLORCORR=1 1 4\n", [0.25, 0.5, 0.25]),
        (b"#?RADIANCE\nrpict\n\tEXPOSURE=4\n EXPOSURE=4\n\tFORMAT=ascii\nEXPOSURE=2\n" + FORMAT, 0.5),
        (b"#?RADIANCE\r\nEXPOSURE=2\r\nFORMAT= 32-bit_rle_rgbe\r\n", 0.5),
        (b"#?RADIANCE\n" + 400 * b"VIEW=" + b"\nPIXASPECT=1.0\n" + FORMAT, 1),
    ],
)
def test_headers_of_radiance_and_other_programs(tmp_path, header, factor):
    """Exposures and corrections multiply, indented lines are those of other pictures, an exposure of 0 is none."""
    end = b"\r\n" if b"\r" in header else b"\n"
    path = tmp_path / "a.hdr"
    path.write_bytes(header + end + b"-Y 2 +X 9" + end + np.tile(PIXEL, (18, 1)).tobytes())
    np.testing.assert_array_equal(io.read_image(path), np.broadcast_to([1, 0.5, 0.25] * np.array(factor), (2, 9, 3)))


def new_code(pixels):
    """A row in the new code: every channel as literals of up to 128, but for the last, a run for every byte."""
    width, body = len(pixels), bytearray([2, 2, len(pixels) >> 8, len(pixels) & 255])
    for channel in pixels.T[:3]:
        for at in range(0, width, 128):
            body += bytes([min(128, width - at)]) + channel[at : at + 128].tobytes()
    for byte in pixels[:, 3]:
        body += bytes([129, byte])
    return bytes(body)


def test_rows_of_all_codes_in_one_file(tmp_path, rng):
    """Flat, old and new ones; an old repeat behind another counts 256 times as much; narrow rows are never new."""
    width = 700
    random = rng.integers(128, 256, (4, width, 4), dtype=np.uint8)
    repeats = [[[1, 1, 1, 39], [1, 1, 1, 1]], [[1, 1, 1, 142], [1, 1, 1, 1]]]  # 39 + 256 and 142 + 256
    old = np.concatenate([random[2, :5], repeats[0], random[2, 300:302], repeats[1]])
    unfolded = np.concatenate([random[2, :5], np.tile(random[2, 4], (295, 1)), random[2, 300:302]])
    random[2] = np.concatenate([unfolded, np.tile(random[2, 301], (398, 1))])
    rows = [random[0].tobytes(), new_code(random[1]), old.astype(np.uint8).tobytes(), new_code(random[3])]
    path = tmp_path / "a.hdr"
    path.write_bytes(b"#?RADIANCE\n\n-Y 4 +X 700\n" + b"".join(rows))
    expected = random[..., :3] * np.exp2(random[..., 3:] - 136.0)
    np.testing.assert_array_equal(io.read_image(path), expected.astype(np.float32))
    path.write_bytes(b"#?RADIANCE\n\n-Y 2 +X 4\n" + random[0, :5].tobytes() + bytes([1, 1, 1, 3]))
    expected = expected[0, [[0, 1, 2, 3], [4, 4, 4, 4]]].astype(np.float32)
    np.testing.assert_array_equal(io.read_image(path), expected)
    one, repeat = [9, 9, 9, 9], [1, 1, 1]
    for row in ([[*repeat, 4]], [one, [*repeat, 4]], [one, [*repeat, 2]], [one, *[[*repeat, 9]] * 6]):
        path.write_bytes(b"#?RADIANCE\n\n-Y 1 +X 4\n" + bytes(sum(row, [])))
        with pytest.raises(ValueError, match="a.hdr: (truncated|1 rows of 4 need)"):
            io.read_image(path)


SIGNS = [(y, x) for y in "-+" for x in "-+"]


@pytest.mark.parametrize("line", [f"{y}Y 2 {x}X 3" for y, x in SIGNS] + [f"{x}X 3 {y}Y 2" for y, x in SIGNS])
def test_orientations(tmp_path, line):
    """The first axis is the slower one; +Y goes up and -X to the left. Pixels are told apart by their exponents."""
    stored = {}
    words = line.split()
    for i in range(int(words[1])):
        for j in range(int(words[3])):
            place = {words[0][1]: i if words[0] in "-Y +X" else int(words[1]) - 1 - i}
            place[words[2][1]] = j if words[2] in "-Y +X" else int(words[3]) - 1 - j
            stored[i, j] = (place["Y"], place["X"])
    body = b"".join(bytes([128, 128, 128, 129 + 3 * y + x]) for y, x in stored.values())
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\n\n" + line.encode() + b"\n" + body)
    np.testing.assert_array_equal(io.read_image(tmp_path / "a.hdr")[..., 0], [[1, 2, 4], [8, 16, 32]])


def test_every_truncation_of_a_radiance_file_is_refused(tmp_path):
    path = tmp_path / "cut.hdr"
    for length in range(2, len(BYTE_BY_BYTE)):
        path.write_bytes(BYTE_BY_BYTE[:length])
        with pytest.raises(ValueError, match=r"cut.hdr: "):
            io.read_image(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"rle_rgbe", b"rle_xyze", "Radiance format '32-bit_rle_xyze'; only .* is read: convert it with ra_xyze -r"),
        (b"-Y 2 +X 8", b"-Y 2 +X 99999999999", "rows of 99999999999 pixels; at most 1048576"),
        (b"-Y 2 +X 8", b"-Y 99999999999 +X 8", "truncated: 99999999999 rows of 8 need"),
        (b"-Y 2 +X 8", b"-Y 2 +X " + 5000 * b"9", "needs a resolution line"),
        (b"-Y 2 +X 8", b"-Y 1 +X 8", "bytes are left after 1 rows of 8: its size is wrong"),
        (b"-Y 2 +X 8", b"-Y 2 -Y 8", "needs a resolution line like '-Y height \\+X width'; got '-Y 2 -Y 8'"),
        (b"-Y 2 +X 8", b"-Y 0 +X 8", "empty image"),
        (b"-Y 2 +X 8", b"-Y two +X 8", "needs a resolution line"),
        *((b"EXPOSURE=2", b"EXPOSURE=" + x, "EXPOSURE is not a number") for x in (b"x", b"1_0", b"nan", b"", b"2 2")),
        (b"EXPOSURE=2", b"COLORCORR=1 2", "COLORCORR is not three numbers"),
        (b"EXPOSURE=2", b"COLORCORR=1 2 0", "COLORCORR must be positive and from 1e-30 to 1e30; got 1 2 0"),
        *((b"EXPOSURE=2", b"EXPOSURE=" + x, "EXPOSURE must be positive and from") for x in (b"-1", b"1e-40", b"1e999")),
        (b"EXPOSURE=2", b"EXPOSURE=1e25\nEXPOSURE=1e25", "EXPOSURE and COLORCORR multiply to 2.5e\\+49"),
        (b"\x88\x80\x03", b"\x89\x80\x03", "truncated or damaged in row 0 of 2"),
        (b"\x88\x80\x03", b"\x00\x80\x03", "truncated or damaged in row 0 of 2"),
        (b"\x02\x02\x00\x08\x08", b"\x02\x02\x00\x09\x08", "damaged: row 1 of 2 is of 9 pixels"),
    ],
)
def test_damaged_radiance_files_are_refused(tmp_path, old, new, message):
    assert BYTE_BY_BYTE.count(old) == 1
    path = tmp_path / "bad.hdr"
    path.write_bytes(BYTE_BY_BYTE.replace(old, new))
    with pytest.raises(ValueError, match="bad.hdr: " + message):
        io.read_image(path)


def test_what_is_no_ordinary_file_or_of_no_plausible_size(tmp_path):
    """Refused before anything is read: pipes would wait for ever, and a sparse file of 4 GB would fill the memory."""
    os.mkfifo(tmp_path / "pipe")
    os.mkdir(tmp_path / "folder")
    for read in (io.read_image, io.read_merl, lambda path: models.Visibility.load(path)):
        for name, message in (("pipe", "a pipe or device"), ("folder", "a folder; name a file in it")):
            (tmp_path / name).rename(tmp_path / f"{name}.npz")
            with pytest.raises(ValueError, match=f"{name}.npz: {message}"):
                read(tmp_path / f"{name}.npz")
            (tmp_path / f"{name}.npz").rename(tmp_path / name)
    path = tmp_path / "sparse.hdr"
    path.write_bytes(BYTE_BY_BYTE)
    os.truncate(path, 1 << 32)
    with pytest.raises(ValueError, match="sparse.hdr: 2 rows of 8 need 136 bytes at most; got 4294967"):
        io.read_image(path)
    path.write_bytes(b"#?RADIANCE\n\n-Y 1000000 +X 1000000\n" + bytes(1 << 20))  # 12 TB by old repeats
    with pytest.raises(ValueError, match="sparse.hdr: truncated: 1000000 rows of 1000000 need"):
        io.read_image(path)
    path.write_bytes(b"#?RADIANCE\nEXPOSURE=1e-9\n\n-Y 1 +X 1\n" + bytes([128, 0, 0, 250]))
    with pytest.raises(ValueError, match="sparse.hdr: divided by its EXPOSURE .* are beyond float32"):
        io.read_image(path)
    path.write_bytes(b"#?RADIANCE\n" + bytes(1 << 21))
    with pytest.raises(ValueError, match="its Radiance header does not end"):
        io.read_image(path)


def test_memory_beside_a_large_picture(tmp_path):
    """A file that unfolds to 190 times its size is read some rows at a time; all at once would take 100 MB."""
    height, width = 60, 32767
    run = b"".join(bytes([128 + min(127, width - at), 130]) for at in range(0, width, 127))
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\n\n-Y 60 +X 32767\n" + height * (b"\x02\x02\x7f\xff" + 4 * run))
    tracemalloc.start()
    image = io.read_image(tmp_path / "a.hdr")
    peak = tracemalloc.get_traced_memory()[1] - image.nbytes
    tracemalloc.stop()
    assert image.shape == (height, width, 3) and np.all(image == np.float32(130 * 2.0**-6))
    assert peak < 20e6, f"{peak / 1e6:.1f} MB"  # 8 MB measured


def test_pixels_that_are_not_square_are_mentioned(tmp_path):
    import OpenEXR

    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\nPIXASPECT=2\nPIXASPECT=.6\n\n-Y 1 +X 1\n" + PIXEL.tobytes())
    OpenEXR.File({"pixelAspectRatio": 2.0}, {"Y": np.ones((1, 2), np.float32)}).write(str(tmp_path / "a.exr"))
    with pytest.warns(UserWarning, match="a.hdr: its pixels are 1.2 times as high as wide; they are read as stored"):
        io.read_image(tmp_path / "a.hdr")
    with pytest.warns(UserWarning, match="a.exr: its pixels are 2 times as wide as high; they are read as stored"):
        io.read_image(tmp_path / "a.exr")


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
        with pytest.raises(ValueError, match="cut.exr: (not a readable OpenEXR file|truncated)"):
            io.read_image(tmp_path / "cut.exr")
    for name, content in (("empty.exr", b""), ("picture.hdr", b"\x89PNG\r\n\x1a\n" + bytes(50))):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=f"{name}: neither an OpenEXR nor a Radiance file; it starts with"):
            io.read_image(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="none.exr: no such file"):
        io.read_image(tmp_path / "none.exr")


def write_parts(path, *parts):
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File([OpenEXR.Part(dict(header), dict(channels), name) for name, channels in parts]).write(str(path))


def colour(prefix, value, names=("R", "G", "B"), dtype=np.float32):
    return {prefix + name: np.full((2, 4), value + i, dtype) for i, name in enumerate(names)}


DEPTH = {"Z": np.full((2, 4), 7, np.float32)}
VIEWS = {**colour("ViewLayer.Combined.", 3), **colour("ViewLayer.Depth.", 9, ("Z",))}
TWO = {**colour("diffuse.", 5, ("red", "green", "blue", "alpha")), **colour("specular.", 6), **DEPTH}


@pytest.mark.parametrize(
    ("parts", "layer", "first"),
    [
        ([("depth", DEPTH), ("rgb", colour("", 1))], None, 1),
        ([("depth", DEPTH), ("rgb", colour("", 1))], "depth", 7),
        ([("left", colour("", 1)), ("right", colour("", 2))], "right", 2),
        ([("", VIEWS)], None, 3),
        ([("", VIEWS)], "ViewLayer.Depth", 9),
        ([("beauty", colour("ViewLayer.Combined.", 3)), ("depth", DEPTH)], "ViewLayer.Combined", 3),
        ([("", TWO)], "diffuse", 5),
        ([("", TWO)], "specular", 6),
        ([("", {**TWO, **colour("", 4, ("R", "G", "B", "A"))})], None, 4),
        ([("", {"luminance": DEPTH["Z"], "A": DEPTH["Z"]})], None, 7),
        ([("a", colour("", 1)), ("b", DEPTH), ("c", TWO)], None, 1),
        ([("", {**colour("", 8), **colour("id.", 1, ("X",), np.uint32)})], None, 8),
    ],
)
def test_the_picture_among_layers_and_parts(tmp_path, parts, layer, first):
    write_parts(tmp_path / "a.exr", *parts)
    image = io.read_image(tmp_path / "a.exr", layer=layer)
    expected = first + np.arange(3) if image.ndim == 3 else first
    np.testing.assert_array_equal(image, np.broadcast_to(expected, (2, 4, *np.shape(expected))))
    assert image.dtype == np.float32 and image.ndim == (2 if first in (7, 9) else 3)


@pytest.mark.parametrize(
    ("parts", "layer", "message"),
    [
        ([("left", colour("", 1)), ("right", colour("", 2))], None, "pictures; pass `layer`, one of 'left', 'right'"),
        ([("", TWO)], None, "pass `layer`, one of 'diffuse', 'specular'"),
        ([("", TWO)], "metal", "the layer 'metal' is there not; its pictures are '', 'diffuse', 'specular'"),
        ([("", colour("", 1, "RG"))], None, r"needs the channels R, G, B, or a single one; it has \['G', 'R'\]"),
        ([("", colour("", 1, dtype=np.uint32))], None, "R, G, B hold integers, which are no radiance"),
    ],
)
def test_layers_that_cannot_be_told_are_asked_for(tmp_path, parts, layer, message):
    write_parts(tmp_path / "a.exr", *parts)
    with pytest.raises(ValueError, match="a.exr: .*" + message):
        io.read_image(tmp_path / "a.exr", layer=layer)


def test_exr_files_that_are_no_whole_picture(tmp_path, rng):
    import OpenEXR

    plane = rng.random((4, 8)).astype(np.float32)
    window = (np.array([0, 0], np.int32), np.array([15, 7], np.int32))
    OpenEXR.File({"displayWindow": window}, {"Y": plane}).write(str(tmp_path / "crop.exr"))
    with pytest.raises(ValueError, match="crop.exr: cropped"):
        io.read_image(tmp_path / "crop.exr")
    samples = np.empty((2, 2), object)
    for i in np.ndindex(2, 2):
        samples[i] = np.ones(2, np.float32)
    deep = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    OpenEXR.File(deep, {"R": samples, "G": samples, "B": samples}).write(str(tmp_path / "deep.exr"))
    with pytest.raises(ValueError, match="deep.exr: a deep file, of several samples in a pixel; flatten it first"):
        io.read_image(tmp_path / "deep.exr")
    write_exr(tmp_path / "half.exr", np.zeros((4, 8, 3), np.float32))
    content = (tmp_path / "half.exr").read_bytes()
    entry = struct.pack("<iBBBBii", 2, 0, 0, 0, 0, 1, 1)  # float, linear, every pixel
    assert content.count(entry) == 3
    (tmp_path / "half.exr").write_bytes(content.replace(entry, entry[:-8] + struct.pack("<ii", 2, 2), 1))
    with pytest.raises(ValueError, match="half.exr: R, G, B have fewer samples than pixels"):
        io.read_image(tmp_path / "half.exr")
    (tmp_path / "a.hdr").write_bytes(BYTE_BY_BYTE)
    with pytest.raises(ValueError, match="a.hdr: a Radiance file has no layers"):
        io.read_image(tmp_path / "a.hdr", layer="diffuse")


def test_maps_are_written_as_they_are(tmp_path, rng):
    """OpenEXR: the bits. Radiance: within half a step of the mantissas, as this test decodes them."""
    image = np.exp(rng.uniform(-9, 9, (5, 6, 3)))
    image[0, 0], image[0, 1], image[0, 2] = 0, [1e-44, 0, 0], [255.6, 1, 0.4]
    io.write_image(tmp_path / "a.hdr", image)
    content = (tmp_path / "a.hdr").read_bytes()
    assert content.startswith(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 5 +X 6\n")
    stored = np.frombuffer(content[-4 * 30 :], np.uint8).reshape(5, 6, 4)
    assert np.all(stored[image.max(-1) > 1e-9, :3].max(-1) >= 128) and np.all(stored[0, :2] == 0)
    decoded = stored[..., :3] * np.exp2(stored[..., 3:] - 136.0) * (stored[..., 3:] > 0)
    error = np.max(np.abs(decoded - image) / np.maximum(image.max(-1, keepdims=True), 1e-9))
    assert error <= 1 / 255.5, error  # the worst is half a step where the largest is just rounded up to 256: 0.003912
    np.testing.assert_array_equal(io.read_image(tmp_path / "a.hdr"), decoded)
    io.write_image(tmp_path / "grey.hdr", image[..., 1])
    assert io.read_image(tmp_path / "grey.hdr").shape == (5, 6, 3)
    for stored in (image.astype(np.float32), -image.astype(np.float16), image[..., 0].astype(">f4")):
        io.write_image(tmp_path / "a.exr", stored, overwrite=True)
        np.testing.assert_array_equal(io.read_image(tmp_path / "a.exr"), stored)


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
        (np.zeros((2, 2)), "a.jpg", "a.jpg: images are written as .png, .exr or .hdr; got suffix '.jpg'"),
        (np.zeros((2, 2, 4)), "a.png", r"`image` must have shape \[H, W\] or \[H, W, 3\]; got \[2, 2, 4\]"),
        (np.full((2, 2), 1.5), "a.png", r"display values in \[0, 1\]; pass it through shisd.io.tonemap"),
        (np.full((2, 2), np.nan), "a.png", r"display values in \[0, 1\]"),
        (np.full((2, 2), -0.1), "a.hdr", "values from 0 to 1.7e38 for .hdr; write .exr for others"),
        (np.full((2, 2), np.inf), "a.hdr", "values from 0 to 1.7e38 for .hdr"),
        (np.full((2, 2), 1j), "a.exr", "`image` must hold real numbers; got complex128"),
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
    """Layout, scales and missing bins of a table; the numbers come back."""
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
    above = merl_above_horizon()
    assert np.all(got[~above] < 0) and got[3, 4, 5, 1] < 0
    above[3, 4, 5] = False
    np.testing.assert_allclose(got[above], table[above], rtol=1e-14)


def test_a_scalar_brdf_fills_three_equal_planes(tmp_path):
    io.write_merl(tmp_path / "grey.binary", models.Lambertian(0.5))
    table = io.read_merl(tmp_path / "grey.binary")
    np.testing.assert_allclose(table[merl_above_horizon()], 0.5 / np.pi, rtol=1e-6)
    assert 0.5 < np.mean(merl_above_horizon()) < 0.9


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


WRITERS = {
    "a.png": lambda path, **k: io.write_image(path, np.zeros((2, 4)), **k),
    "a.exr": lambda path, **k: io.write_image(path, np.zeros((2, 4)), **k),
    "a.hdr": lambda path, **k: io.write_image(path, np.zeros((2, 4)), **k),
    "a.binary": lambda path, **k: io.write_merl(path, np.zeros((90, 90, 180, 3)), **k),
    "a.npz": lambda path, **k: models.Visibility(np.zeros((3, 4), np.float32), np.array([[0, 1, 2]])).save(path, **k),
}


@pytest.mark.parametrize("name", WRITERS)
def test_no_writer_leaves_half_a_file(tmp_path, monkeypatch, name):
    """When the disk is full at the end, the old file is whole, nothing else is there, and the error names the path."""

    def full(descriptor):
        raise OSError(28, "No space left on device")

    path = tmp_path / name
    path.write_bytes(b"old")
    with pytest.raises(FileExistsError, match=f"{name} exists; pass overwrite=True"):
        WRITERS[name](path)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=f"No space left on device.*{name}"):
        WRITERS[name](path, overwrite=True)
    assert [each.name for each in tmp_path.iterdir()] == [name] and path.read_bytes() == b"old"


@pytest.mark.parametrize("links", [True, False])
def test_one_of_several_writers_succeeds(tmp_path, monkeypatch, links):
    """Also where the file system has no links. All have finished writing before the first may take its place."""

    def refuse(*paths):
        raise PermissionError(1, "Operation not permitted")

    if not links:
        monkeypatch.setattr(os, "link", refuse)
    path, ready, results = tmp_path / "a.bin", threading.Barrier(8), []

    def write(i):
        def content(file):
            file.write(bytes([i]) * 1000)
            ready.wait()

        try:
            write_atomically(path, content)
            results.append(i)
        except FileExistsError as error:
            assert "a.bin exists; pass overwrite=True" in str(error)

    threads = [threading.Thread(target=write, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 1 and path.read_bytes() == bytes(results) * 1000
    assert list(tmp_path.iterdir()) == [path]


def test_links_folders_and_modes(tmp_path):
    """A link is never written through; what is no file is refused; a new file has the mode of the old one."""
    write = lambda file: file.write(b"new")
    path, target = tmp_path / "link", tmp_path / "target"
    path.symlink_to(target)
    with pytest.raises(FileExistsError, match="link exists; pass overwrite=True"):
        write_atomically(path, write)
    assert path.is_symlink() and not target.exists()
    write_atomically(path, write, overwrite=True)
    assert path.read_bytes() == b"new" and not path.is_symlink() and not target.exists()
    path.chmod(0o640)
    write_atomically(path, write, overwrite=True)
    assert path.stat().st_mode & 0o777 == 0o640
    (tmp_path / "folder").mkdir()
    with pytest.raises(ValueError, match="folder: a folder, pipe or device; name a file"):
        write_atomically(tmp_path / "folder", write, overwrite=True)
    with pytest.raises(FileNotFoundError, match=r"No such file or directory.*none/a.bin"):
        write_atomically(tmp_path / "none" / "a.bin", write)


def test_files_that_promise_more_than_they_hold(tmp_path):
    """Arrays of an .npz file are made only after their headers were compared with the file."""
    import io as stream
    import zipfile

    def npz(path, header):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {header}, }}".ljust(117) + "\n"
            archive.writestr("a.npy", b"\x93NUMPY\x01\x00v\x00" + text.encode() + bytes(16))

    npz(tmp_path / "a.npz", "(2, 2)")
    (array,) = read_npz(tmp_path / "a.npz", ["a"])
    np.testing.assert_array_equal(array, np.zeros((2, 2), np.float32))
    for shape in ("(1000000, 1000000)", "(2, 3)", "(2,)"):
        npz(tmp_path / "a.npz", shape)
        with pytest.raises(ValueError, match="a is not of the size that its header promises, float32"):
            read_npz(tmp_path / "a.npz", ["a"])
    pickled = stream.BytesIO()
    np.savez(pickled, a=np.array([{}], object))
    (tmp_path / "a.npz").write_bytes(pickled.getvalue())
    with pytest.raises(ValueError, match="a is not of the size"):
        read_npz(tmp_path / "a.npz", ["a"])


EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def test_no_example_takes_a_folder_that_it_did_not_make(tmp_path, monkeypatch, capsys):
    """Least of all that of the examples, whose results are called like the files that come with them."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import _scene

    names = [path.stem for path in EXAMPLES.glob("*.py") if "_scene.prepare_output(" in path.read_text()]
    assert len(names) >= 8
    for name in names:
        text = (EXAMPLES / f"{name}.py").read_text()
        assert re.findall(r"prepare_output\(options.output, options.overwrite, \"(.*)\", parser\)", text) == [name]
    assert not re.search("rmtree|unlink|os.remove|rmdir", "".join(path.read_text() for path in EXAMPLES.glob("*.py")))

    parser = argparse.ArgumentParser()
    folder = tmp_path / "folder"
    folder.mkdir()
    for path in EXAMPLES.iterdir():
        (folder / path.name).write_text("keep me")
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    for name in names:
        for overwrite, message in ((True, "left alone"), (False, "exists")):
            with pytest.raises(SystemExit):
                _scene.prepare_output(folder, overwrite, name, parser)
            assert message in capsys.readouterr().err
    assert before == {path: path.stat().st_mtime_ns for path in folder.iterdir()}

    own = tmp_path / "new" / "own"
    _scene.prepare_output(own, False, "relight", parser)
    (own / "letter.txt").write_text("keep me")
    _scene.prepare_output(own, True, "relight", parser)
    with pytest.raises(SystemExit):
        _scene.prepare_output(own, True, "denoise", parser)
    assert (own / "letter.txt").read_text() == "keep me"
