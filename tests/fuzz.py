"""Reads many damaged files of one kind in a process of its own, and writes down how each ended.

    python -m tests.fuzz KIND FOLDER FIRST COUNT

Every file is one of a few good ones, changed at random by a seed of its own. A line is written before and after each,
so that the one which ends the process is known; a file that takes longer than 20 s ends it too.
"""

import io as stream
import resource
import signal
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from shisd import io, models

LONGEST = 20  # s
MORE = 200 * 2**20  # bytes that reading may take beside its result
WORDS = [b"0", b"-1", b"2", b"65535", b"99999999", b"1e-40", b"1e39", b"nan", b"", b"\n", b"\r\n", b"=", b"\x02\x02"]


def pictures() -> tuple[np.ndarray, np.ndarray]:
    image = np.exp(np.random.default_rng(1).uniform(-3, 3, (8, 16, 3))).astype(np.float32)
    image[3] = image[3, 0]
    flat = np.full((64, 128, 3), 0.5, np.float32)
    flat[10:20, 30:90] = 2
    return image, flat


def radiance_files(folder: Path) -> list[bytes]:
    """Flat rows, old repeats, runs and literals, all mixed."""
    image, _ = pictures()
    io.write_image(folder / "a.hdr", image)
    flat = (folder / "a.hdr").read_bytes()
    start, pixels = flat[: -4 * 128], np.frombuffer(flat[-4 * 128 :], np.uint8).reshape(8, 16, 4)
    start = start.replace(b"FORMAT", b"# made for a test\nEXPOSURE=2\nCOLORCORR= 1 1 1\nPIXASPECT=1\nFORMAT")
    old = lambda row: row[0].tobytes() + bytes([1, 1, 1, 15])
    runs = lambda row: bytes([2, 2, 0, 16]) + b"".join(bytes([144, byte]) for byte in row[0])
    literals = lambda row: bytes([2, 2, 0, 16]) + b"".join(b"\x10" + channel.tobytes() for channel in row.T)
    plain = lambda row: row.tobytes()
    kinds = ([plain], [old], [runs], [literals], [plain, old, runs, literals])
    return [start + b"".join(kind[i % len(kind)](row) for i, row in enumerate(pixels)) for kind in kinds]


def exr_files(folder: Path) -> list[bytes]:
    """Each compression, half and float, tiles, several parts, layers, deep samples."""
    import OpenEXR

    image, flat = pictures()
    files = []

    def keep(*parts: tuple[dict, dict, str]) -> None:
        made = [OpenEXR.Part({"type": OpenEXR.scanlineimage, **header}, dict(c), name) for header, c, name in parts]
        OpenEXR.File(made).write(str(folder / "a.exr"))
        files.append((folder / "a.exr").read_bytes())

    for name in ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"):
        for pixels in (image, flat.astype(np.float16)):
            keep(({"compression": getattr(OpenEXR, f"{name}_COMPRESSION")}, {"RGB": pixels}, ""))
    keep(({"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}, {"RGB": image}, ""))
    keep(({}, {"Z": image[..., 0]}, "depth"), ({}, {"RGB": image}, "rgb"))
    keep(({}, {f"View.Combined.{c}": image[..., i] for i, c in enumerate("RGB")} | {"Z": image[..., 0]}, ""))
    samples = np.empty((4, 8), object)
    for i in np.ndindex(4, 8):
        samples[i] = np.ones(2, np.float32)
    keep(({"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}, dict.fromkeys("RGB", samples), ""))
    return files


def visibility_files(folder: Path) -> list[bytes]:
    rng = np.random.default_rng(2)
    corners = np.array([[0, 1, 2], [2, 1, 3]])
    models.Visibility(rng.normal(size=(4, 16)).astype(np.float32), corners).save(folder / "a.npz")
    return [(folder / "a.npz").read_bytes()]


def merl_files(folder: Path) -> list[bytes]:
    table = np.random.default_rng(3).random((90, 90, 180, 3))
    io.write_merl(folder / "a.binary", table)
    return [(folder / "a.binary").read_bytes()]


def changed(content: bytes, rng: np.random.Generator) -> bytes:
    """One or two changes, three of ten in the first 400 bytes."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 3)):
        size = len(data)
        at = int(rng.integers(0, min(size, 400) if rng.random() < 0.3 else size)) if size else 0
        kind, length = rng.integers(8), int(rng.integers(1, 17))
        if kind == 0 and size:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            data[at : at + length] = rng.bytes(length)
        elif kind == 2:
            del data[at : at + length]
        elif kind == 3:
            data[at:at] = rng.bytes(length)
        elif kind == 4:
            data[at:at] = data[at : at + 20 * length]
        elif kind == 5:
            del data[at:]
        elif kind == 6:
            number = rng.choice([0, 1, -1, 2**31 - 1, -(2**31), 65535, 2**20, int(rng.integers(2**31))])
            data[at : at + 4] = int(number).to_bytes(4, rng.choice(["little", "big"]), signed=True)
        else:
            word = WORDS[rng.integers(len(WORDS))]
            data[at : at + len(word) * int(rng.integers(2))] = word
    return bytes(data)


def repacked(content: bytes, rng: np.random.Generator) -> bytes:
    """An archive whose members are changed, not itself: its check sums are right."""
    packed = stream.BytesIO()
    with zipfile.ZipFile(stream.BytesIO(content)) as old, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as new:
        spoiled = rng.choice(old.namelist())
        for name in old.namelist():
            new.writestr(name, changed(old.read(name), rng) if name == spoiled else old.read(name))
    return packed.getvalue()


def write_damaged(kind: str, path: Path, files: list[bytes], rng: np.random.Generator) -> int:
    """Writes one; which of the good ones it was made from. A MERL file is large: only its size or some bytes change."""
    which = int(rng.integers(len(files)))
    content = files[which]
    if kind == "merl":
        if not path.exists():
            path.write_bytes(content)
        with path.open("r+b") as file:
            if rng.random() < 0.03:  # values
                file.seek(int(rng.integers(12, len(content) - 400)))
                file.write(rng.bytes(int(rng.integers(1, 400))))
            elif rng.random() < 0.5:
                file.write(changed(content[:12], rng)[:12])
            else:
                file.truncate(max(0, len(content) + int(rng.integers(-40, 40)) * int(rng.choice([1, 1000]))))
        return which
    path.write_bytes(repacked(content, rng) if kind == "visibility" and rng.random() < 0.7 else changed(content, rng))
    return which


def restore(path: Path, content: bytes) -> None:
    with path.open("r+b") as file:
        file.write(content[:12])
        file.truncate(len(content))


READERS: dict[str, tuple[str, Callable, Callable]] = {
    "radiance": ("damaged.hdr", radiance_files, lambda path: [models.Environment.load(path).texels]),
    "exr": ("damaged.exr", exr_files, lambda path: [models.Environment.load(path).texels]),
    "visibility": (
        "damaged.npz",
        visibility_files,
        lambda path: [(v := models.Visibility.load(path)).coefficients, v.triangles, v.noise],
    ),
    "merl": ("damaged.binary", merl_files, lambda path: [io.read_merl(path)]),
}


def ended(read: Callable, path: Path, expected: list[np.ndarray] | None) -> tuple[str, int]:
    """How reading ended, and the bytes of the result."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            arrays = [np.asarray(array) for array in read(path)]
        except Exception as error:
            good = isinstance(error, ValueError) and str(path) in str(error)
            return ("refused" if good else f"WRONG ERROR {type(error).__name__}: {str(error)[:150]!r}"), 0
    size = sum(array.nbytes for array in arrays)
    foreign = [str(w.message) for w in caught if not (w.category is UserWarning and str(path) in str(w.message))]
    if foreign:
        return f"WRONG WARNING {foreign[0]!r}", size
    if not all(np.isfinite(array).all() for array in arrays):
        return "NOT FINITE", size
    if caught:
        return "warned", size
    same = expected is not None and all(np.array_equal(a, b) for a, b in zip(arrays, expected, strict=True))
    return ("same" if same else "another"), size


def main(kind: str, folder: Path, first: int, count: int) -> None:
    name, make, read = READERS[kind]
    path, log = folder / name, (folder / f"{kind}.log").open("a", buffering=1)
    files = make(folder)
    good = []
    for content in files:
        path.write_bytes(content)
        try:
            good.append([np.asarray(array) for array in read(path)])
        except ValueError:  # deep ones
            good.append(None)
    for number in range(first, first + count):
        which = write_damaged(kind, path, files, np.random.default_rng([20150801, number]))
        print(number, file=log)
        signal.alarm(LONGEST)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        how, size = ended(read, path, good[which])
        after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        signal.alarm(0)
        print("TOO MUCH MEMORY" if after - before > MORE + size else how, file=log)
        if kind == "merl":
            restore(path, files[0])
            if how in ("another", "warned"):
                path.write_bytes(files[0])


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
