"""Radiance's pictures (G. Ward, *Real Pixels*, Graphics Gems II; the reference manual's "Picture File Format").

A row is flat, four bytes a pixel; or coded in the old way, where a pixel 1, 1, 1, n repeats the last one n times, and a
second one next to it n * 256 times; or in the new way, where it starts with 2, 2 and the row's length, and each channel
is runs (128 + n, byte) and literals (n, n bytes). Rows of one file may differ.
"""

import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

_HEADER_BYTES = 1 << 20
_WIDEST = 1 << 20
_SMALL = 1 << 24  # pixels; larger pictures must be plausible for the size of their file
_RESOLUTION = re.compile(r"([-+])([XY])[ \t]+(\d{1,18})[ \t]+([-+])([XY])[ \t]+(\d{1,18})\s*")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def read(path: Path) -> np.ndarray:
    size = path.stat().st_size
    with path.open("rb") as file:
        divisor = _variables(path, file)
        signs, count, width = _resolution(path, file)
        _check_size(path, size - file.tell(), count, width)
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.ldexp(1.0, np.arange(256) - 136)[:, None] / divisor
            values[0] = 0
            image = np.empty((count, width, 3), np.float32)
            rows = _rows(path, file, count, width)
            step = max(1, (1 << 18) // width)
            for first in range(0, count, step):
                block = np.stack([next(rows) for _ in range(min(step, count - first))])
                image[first : first + step] = block[..., :3] * values[block[..., 3]]
                if not np.isfinite(image[first : first + step]).all():
                    raise ValueError(f"{path}: divided by its EXPOSURE and COLORCORR, values are beyond float32.")
            next(rows, None)  # nothing may be left
    if signs["major"] == "X":
        image = image.swapaxes(0, 1)
    return image[:: 1 if signs["Y"] == "-" else -1, :: 1 if signs["X"] == "+" else -1]


def _variables(path: Path, file: IO[bytes]) -> np.ndarray:
    """What the three channels have been multiplied with; the file is then after the lines that say so.

    Indented lines are those of the pictures that this one was made from.
    """
    products = {"EXPOSURE": np.ones(1), "COLORCORR": np.ones(3), "PIXASPECT": np.ones(1)}
    while line := _line(path, file):
        key, _, value = line.partition("=")
        value = value.strip()
        if key == "FORMAT" and value != "32-bit_rle_rgbe":
            advice = "convert it with ra_xyze -r" if value == "32-bit_rle_xyze" else "save it as RGBE or OpenEXR"
            raise ValueError(f"{path}: Radiance format {value[:40]!r}; only 32-bit_rle_rgbe is read: {advice}.")
        if key in products:
            words, size = value.split(), len(products[key])
            numbers = np.array([float(word) for word in words if _NUMBER.fullmatch(word)])
            if not len(numbers) == len(words) == size:
                what = "a number" if size == 1 else "three numbers"
                raise ValueError(f"{path}: {key} is not {what}: {value[:40]!r}. Correct that line of the header.")
            if key == "EXPOSURE" and numbers[0] == 0:  # some programs write this where they know none
                continue
            if not np.all((1e-30 < numbers) & (numbers < 1e30)):
                found = f"{key} must be positive and from 1e-30 to 1e30; got {value[:40]}"
                raise ValueError(f"{path}: {found}. Correct that line of the header.")
            products[key] = np.clip(products[key] * numbers, 1e-100, 1e100)
    if not np.isclose(products["PIXASPECT"], 1, rtol=1e-3):
        found = f"{path}: its pixels are {products['PIXASPECT'][0]:.4g} times as high as wide"
        warnings.warn(f"{found}; they are read as stored.", UserWarning, stacklevel=4)
    divisor = products["EXPOSURE"] * products["COLORCORR"]
    if not np.all((1e-30 < divisor) & (divisor < 1e30)):
        raise ValueError(f"{path}: EXPOSURE and COLORCORR multiply to {divisor.max():.2g}. Correct them in the header.")
    return divisor


def _line(path: Path, file: IO[bytes]) -> str:
    line = file.readline(_HEADER_BYTES)
    if not line.endswith(b"\n") or file.tell() > _HEADER_BYTES:
        raise ValueError(f"{path}: truncated or damaged: its Radiance header does not end.")
    return line.decode("latin-1").rstrip("\r\n")


def _resolution(path: Path, file: IO[bytes]) -> tuple[dict[str, str], int, int]:
    """The signs of both axes and which one is major; number and length of the rows."""
    line = _line(path, file)
    match = _RESOLUTION.fullmatch(line)
    if not match or match[2] == match[5]:
        raise ValueError(f"{path}: needs a resolution line like '-Y height +X width'; got {line[:40]!r}.")
    count, width = int(match[3]), int(match[6])
    if count == 0 or width == 0:
        raise ValueError(f"{path}: empty image: {count} rows of {width}.")
    if width > _WIDEST:
        raise ValueError(f"{path}: rows of {width} pixels; at most {_WIDEST} are read. The file may be damaged.")
    return {match[2]: match[1], match[5]: match[4], "major": match[2]}, count, width


def _may_be_coded(width: int) -> bool:
    return 8 <= width <= 32767


def _check_size(path: Path, size: int, count: int, width: int) -> None:
    least = count * min(4 * width, 8)  # a pixel and one that repeats it
    if count * width > _SMALL:
        least = max(least, count * width // 16)  # the new code needs 8 bytes for 127 pixels
    most = count * (4 + 8 * width if _may_be_coded(width) else 4 * width)
    if size < least:
        raise ValueError(f"{path}: truncated: {count} rows of {width} need {least} bytes or more; got {size}.")
    if size > most:
        raise ValueError(
            f"{path}: {count} rows of {width} need {most} bytes at most; got {size}. Its size is wrong, or it holds "
            "several pictures: take them apart with ra_rgbe."
        )


def _rows(path: Path, file: IO[bytes], count: int, width: int) -> Iterator[np.ndarray]:
    """The pixels uint8 [width, 4] of each row, from a few rows' bytes at a time."""
    longest = 4 + 8 * width
    data, at = b"", 0
    for row in range(count):
        if len(data) - at < longest:
            data, at = data[at:] + file.read(max(longest, 1 << 20)), 0
        start = data[at : at + 4]
        new = _may_be_coded(width) and start[:2] == b"\x02\x02" and len(start) == 4 and start[2] < 128
        if new and start[2:] != width.to_bytes(2, "big"):
            raise ValueError(f"{path}: damaged: row {row} of {count} is of {start[2] << 8 | start[3]} pixels.")
        pixels, at = _new_row(data, at + 4, width) if new else _old_row(data, at, width)
        if pixels is None:
            raise ValueError(f"{path}: truncated or damaged in row {row} of {count}. Get or save it again.")
        yield pixels
    if at < len(data) or file.read(1):
        raise ValueError(
            f"{path}: bytes are left after {count} rows of {width}: its size is wrong, or it holds several pictures: "
            "take them apart with ra_rgbe."
        )


def _new_row(data: bytes, at: int, width: int) -> tuple[np.ndarray | None, int]:
    """One row whose channels are coded one after another, and where the next starts; None where it is damaged."""
    lengths, sources, steps = [], [], []  # of each run and literal; a literal's source moves on
    done, stop, size = 0, width, len(data)
    while done < 4 * width:
        code = data[at] if at < size else 0
        run = code > 128
        length = code - 128 if run else code
        after = at + 2 if run else at + 1 + length
        if length == 0 or done + length > stop or after > size:
            return None, at
        lengths.append(length)
        sources.append(at + 1 - (0 if run else done))
        steps.append(not run)
        at, done = after, done + length
        if done == stop:
            stop += width
    index = np.repeat(sources, lengths) + np.repeat(steps, lengths) * np.arange(4 * width)
    return np.frombuffer(data, np.uint8)[index].reshape(4, width).T, at


def _old_row(data: bytes, at: int, width: int) -> tuple[np.ndarray | None, int]:
    """One row of pixels, some of which may say how often to repeat the last one."""
    pixels = np.frombuffer(data, np.uint8, 4 * min(width, (len(data) - at) // 4), at).reshape(-1, 4)
    repeats = np.all(pixels[:, :3] == 1, axis=1)
    if not repeats.any():
        return (pixels if len(pixels) == width else None), at + 4 * width
    position = np.arange(len(pixels))
    repeated = np.maximum.accumulate(np.where(repeats, -1, position))
    place = np.minimum(position - repeated - 1, 4)  # of one among several next to each other; 4 is beyond any row
    lengths = np.where(repeats, pixels[:, 3].astype(np.int64) << 8 * place, 1)
    ends = np.cumsum(lengths)
    last = int(np.searchsorted(ends, width))
    if repeats[0] or last == len(ends) or ends[last] != width:
        return None, at
    used = slice(0, last + 1)
    return np.repeat(pixels[repeated[used]], lengths[used], axis=0), at + 4 * (last + 1)


def writer(image: np.ndarray) -> Callable[[IO[bytes]], object]:
    """What writes an image [H, W] or [H, W, 3] as flat rows.

    The largest mantissa of a pixel is at least 128, so that none is taken for a code.
    """
    colours = np.broadcast_to(image[..., None], (*image.shape, 3)) if image.ndim == 2 else image
    if not np.all((colours >= 0) & (colours < 1.7e38)):
        raise ValueError("`image` must hold values from 0 to 1.7e38 for .hdr; write .exr for others.")
    height, width = colours.shape[:2]

    def write(file: IO[bytes]) -> None:
        file.write(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width))
        for row in colours:
            file.write(_shared_exponents(row.astype(np.float64)).tobytes())

    return write


def _shared_exponents(colours: np.ndarray) -> np.ndarray:
    """Values are mantissa * 2^(exponent - 136), where the largest of a pixel has a mantissa from 128 to 255."""
    largest = colours.max(axis=-1)
    exponent = np.frexp(largest)[1]
    exponent += np.round(np.ldexp(largest, 8 - exponent)) == 256
    exponent = np.where((largest == 0) | (exponent < -127), -128, exponent)  # black, or too dark
    mantissas = np.where(exponent[..., None] > -128, np.round(np.ldexp(colours, 8 - exponent[..., None])), 0)
    return np.concatenate([mantissas, exponent[..., None] + 128], axis=-1).astype(np.uint8)
