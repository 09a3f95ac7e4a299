"""Files: environment maps (OpenEXR, Radiance), MERL materials, and PNG images.

Reading never trusts a file: sizes are checked against what the header promises before anything is allocated, and an
error names the path and the reason. Writing never replaces a file unless told to. OpenEXR and Pillow are imported where
they are needed: `pip install shisd[io]`.
"""

import functools
import os
import struct
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

if TYPE_CHECKING:
    from shisd.models._brdf import AbstractBrdf

StrPath = str | os.PathLike[str]

MERL_BINS = (90, 90, 180)
MERL_SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0
_MERL_BYTES = 12 + 3 * 8 * 90 * 90 * 180


def read_image(path: StrPath) -> np.ndarray:
    """A linear high-dynamic-range image: float32 [H, W] or [H, W, 3], rows from the top.

    The format is told from the content: OpenEXR (any compression; first part; channels R, G, B, or one channel of any
    name; alpha dropped) or Radiance RGBE (plain or run-length coded, rows from the top). Values are as stored: no
    chromaticities are applied, NaN and negative ones are kept; Radiance's EXPOSURE lines are divided out.
    Errors: FileNotFoundError; ValueError naming path and reason for a foreign, truncated or unsupported file;
    ImportError for OpenEXR files without the package OpenEXR.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file.")
    with path.open("rb") as file:
        magic = file.read(4)
    if magic == b"\x76\x2f\x31\x01":
        return _read_exr(path)
    if magic[:2] == b"#?":
        return _read_rgbe(path)
    raise ValueError(f"{path}: neither an OpenEXR nor a Radiance file; it starts with {magic!r}.")


def write_image(path: StrPath, image: np.ndarray, *, overwrite: bool = False) -> None:
    """A PNG of 8 bits per channel from display values in [0, 1], [H, W] or [H, W, 3]; see `tonemap`.

    Errors: FileExistsError unless `overwrite=True`; ValueError for another suffix, another shape, or values that are
    not in [0, 1]; ImportError without Pillow.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"{path}: images are written as .png; got suffix {path.suffix!r}.")
    pixels = np.asarray(image)
    if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[-1] == 3)) or pixels.size == 0:
        raise ValueError(f"`image` must have shape [H, W] or [H, W, 3]; got {list(pixels.shape)}.")
    if not np.all((pixels >= 0) & (pixels <= 1)):
        raise ValueError("`image` must hold display values in [0, 1]; pass it through shisd.io.tonemap first.")
    pillow = optional("PIL.Image", "the package Pillow")
    picture = pillow.fromarray(np.round(255 * pixels).astype(np.uint8))
    with _create(path, overwrite) as file:
        picture.save(file, format="PNG")


def tonemap(image: np.ndarray, *, exposure: float = 1.0) -> np.ndarray:
    """Display values in [0, 1]: linear values times `exposure`, cut to [0, 1], then the sRGB curve (IEC 61966-2-1)."""
    linear = np.clip(np.asarray(image) * exposure, 0, 1)
    curve = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve)


def read_merl(path: StrPath) -> np.ndarray:
    """The table of a MERL material: float64 [90, 90, 180, 3] over theta_h, theta_d, phi_d and colour, in 1/sr.

    Missing values stay negative. The bins are those of `shisd.models.MeasuredBrdf`, the planes are scaled by
    (1, 1.15, 1.66) / 1500. Errors: FileNotFoundError; ValueError for a file of another size than 34,992,012 bytes or
    with other dimensions than (90, 90, 180), before the values are read.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file.")
    size = path.stat().st_size
    if size != _MERL_BYTES:
        raise ValueError(f"{path}: a MERL material has {_MERL_BYTES:,} bytes; this file has {size:,}.")
    with path.open("rb") as file:
        dimensions = struct.unpack("<3i", file.read(12))
        if dimensions != MERL_BINS:
            raise ValueError(f"{path}: a MERL material starts with the bin counts {MERL_BINS}; got {dimensions}.")
        planes = np.fromfile(file, "<f8").reshape(3, *MERL_BINS)
    return np.moveaxis(planes.astype(np.float64), 0, -1) * MERL_SCALE


def write_merl(path: StrPath, brdf: "AbstractBrdf | np.ndarray | jax.Array", *, overwrite: bool = False) -> None:
    """Write an isotropic BRDF, or a table [90, 90, 180, 3] in 1/sr, as a MERL material.

    A BRDF is evaluated at the bin centres, in the default precision of JAX; a scalar one fills three equal planes. Bins
    whose centre is below the horizon, and negative values, are written as -1: missing. Errors: FileExistsError unless
    `overwrite=True`; ValueError for an anisotropic BRDF, a table of another shape, or values that are not finite.
    """
    path = Path(path)
    if path.exists() and not overwrite:  # before the work, and again when the file is made
        raise FileExistsError(f"{path} exists; pass overwrite=True to replace it.")
    if hasattr(brdf, "value"):
        table = _tabulate_merl(brdf)  # type: ignore[arg-type]
    else:
        table = np.asarray(brdf, np.float64)
        if table.shape != (*MERL_BINS, 3):
            raise ValueError(f"`brdf` must be a BRDF or a table [90, 90, 180, 3]; got shape {list(table.shape)}.")
    if not np.isfinite(table).all():
        raise ValueError(f"`brdf` has {np.sum(~np.isfinite(table))} values that are not finite.")
    missing = (table < 0) | ~merl_above_horizon()[..., None]
    planes = np.moveaxis(np.where(missing, -1.0, table / MERL_SCALE), -1, 0)
    with _create(path, overwrite) as file:
        file.write(struct.pack("<3i", *MERL_BINS))
        file.write(np.ascontiguousarray(planes, "<f8").tobytes())


@functools.cache
def _merl_directions() -> tuple[np.ndarray, np.ndarray]:
    """wi and wo [90, 90, 180, 3] at the bin centres, float32, with the half vector in the x-z plane."""
    theta_h, theta_d, phi_d = np.meshgrid(
        np.pi / 2 * ((np.arange(90) + 0.5) / 90) ** 2,
        np.pi / 2 * (np.arange(90) + 0.5) / 90,
        np.pi * (np.arange(180) + 0.5) / 180,
        indexing="ij",
        sparse=True,
    )
    x, y, z = np.sin(theta_d) * np.cos(phi_d), np.sin(theta_d) * np.sin(phi_d), np.cos(theta_d)
    cos_h, sin_h = np.cos(theta_h), np.sin(theta_h)
    along_x, along_z = np.broadcast_arrays(sin_h * z, cos_h * z)  # of the mean of wi and wo
    across = np.stack(np.broadcast_arrays(cos_h * x, y, -sin_h * x), axis=-1)
    mean = np.stack([along_x, np.zeros_like(along_x), along_z], axis=-1)
    mean, across = np.broadcast_arrays(mean, across)
    return (mean + across), (mean - across)


def merl_above_horizon() -> np.ndarray:
    """Whether wi and wo are both above the horizon at each bin's centre: bool [90, 90, 180]."""
    wi, wo = _merl_directions()
    return (wi[..., 2] > 0) & (wo[..., 2] > 0)


def _tabulate_merl(brdf: "AbstractBrdf") -> np.ndarray:
    if not brdf.isotropic:
        raise ValueError("`brdf` is anisotropic; a MERL material has no azimuth of the half vector.")
    values = jax.jit(jax.vmap(jax.vmap(brdf.value)))
    slices = [np.asarray(values(jnp.asarray(wi), jnp.asarray(wo))) for wi, wo in zip(*_merl_directions(), strict=True)]
    table = np.stack(slices).astype(np.float64)
    return np.broadcast_to(table if table.ndim == 4 else table[..., None], (*MERL_BINS, 3))


def _create(path: Path, overwrite: bool):
    try:
        return path.open("wb" if overwrite else "xb")
    except FileExistsError as error:
        raise FileExistsError(f"{path} exists; pass overwrite=True to replace it.") from error


def optional(module: str, package: str, extra: str = "io") -> ModuleType:
    """A module of an optional package, or an error that says what to install."""
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"This needs {package}: pip install shisd[{extra}].") from error


def _read_exr(path: Path) -> np.ndarray:
    openexr = optional("OpenEXR", "the package OpenEXR")
    try:
        with openexr.File(str(path), separate_channels=True) as file:
            header = dict(file.header())  # the file's own is emptied when it closes
            pixels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # the package raises several kinds
        raise ValueError(f"{path}: not a readable OpenEXR file, or truncated: {error}") from error
    if not all(np.array_equal(a, b) for a, b in zip(header["dataWindow"], header["displayWindow"], strict=True)):
        raise ValueError(f"{path}: cropped: its data window is not its display window.")
    colours = [name for name in pixels if name != "A"]
    if {"R", "G", "B"} <= pixels.keys():
        image = np.stack([pixels[name] for name in "RGB"], axis=-1)
    elif len(colours) == 1:
        image = pixels[colours[0]]
    else:
        raise ValueError(f"{path}: needs the channels R, G, B, or a single one; it has {sorted(pixels)}.")
    return image.astype(np.float32)


def _read_rgbe(path: Path) -> np.ndarray:
    """Radiance's format (G. Ward, *Real Pixels*, Graphics Gems II; the reference manual's "Picture File Format")."""
    data = path.read_bytes()
    end = data.find(b"\n\n")
    if end < 0:
        raise ValueError(f"{path}: truncated: the Radiance header does not end.")
    exposure = 1.0
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        key, _, value = line.partition("=")
        if key.strip() == "FORMAT" and value.strip() != "32-bit_rle_rgbe":
            raise ValueError(f"{path}: Radiance format {value.strip()!r}; only 32-bit_rle_rgbe is read.")
        if key.strip() == "EXPOSURE":
            try:
                exposure *= float(value)
            except ValueError:
                raise ValueError(f"{path}: EXPOSURE is not a number: {value!r}.") from None
    if not (0 < exposure < np.inf):
        raise ValueError(f"{path}: EXPOSURE must be positive; got {exposure}.")
    resolution_end = data.find(b"\n", end + 2)
    words = data[end + 2 : max(resolution_end, end + 2)].split()
    if len(words) != 4 or words[0] != b"-Y" or words[2] != b"+X" or not (words[1].isdigit() and words[3].isdigit()):
        raise ValueError(f"{path}: needs a resolution line '-Y height +X width'; got {b' '.join(words)[:40]!r}.")
    height, width = int(words[1]), int(words[3])
    if height == 0 or width == 0:
        raise ValueError(f"{path}: empty image: {height} rows of {width}.")
    body = data[resolution_end + 1 :]
    rows = _rgbe_rows(path, body, height, width)
    scale = np.ldexp(1.0, rows[..., 3].astype(np.int32) - 136) / exposure
    scale[rows[..., 3] == 0] = 0
    return (rows[..., :3] * scale[..., None]).astype(np.float32)


def _rgbe_rows(path: Path, body: bytes, height: int, width: int) -> np.ndarray:
    """The pixels uint8 [height, width, 4]. Each row is plain, or starts with 2, 2, width and codes each channel."""
    coded = 8 <= width <= 32767 and body[:3] == bytes([2, 2, width >> 8])
    least = height * (4 + 4 * 2 * -(-width // 127) if coded else 4 * width)
    if len(body) < least:
        raise ValueError(f"{path}: truncated: {height} rows of {width} need {least} bytes or more; got {len(body)}.")
    if not coded:
        rows = np.frombuffer(body, np.uint8, 4 * height * width).reshape(height, width, 4)
        if np.any(np.all(rows[..., :3] == 1, axis=-1)):
            raise ValueError(f"{path}: uses Radiance's old run-length code; convert it with ra_rgbe or as OpenEXR.")
        return rows
    planes = np.empty((height, 4 * width), np.uint8)
    start = bytes([2, 2, width >> 8, width & 255])
    at = 0
    for row in range(height):
        if body[at : at + 4] != start:
            raise ValueError(f"{path}: truncated or damaged: row {row} of {height} has no start.")
        at += 4
        for channel in range(4):
            done, stop = channel * width, (channel + 1) * width
            while done < stop:
                count = body[at] if at < len(body) else 0
                run = count > 128
                length = count - 128 if run else count
                if length == 0 or done + length > stop or at + 1 + (1 if run else length) > len(body):
                    raise ValueError(f"{path}: truncated or damaged in row {row} of {height}.")
                if run:
                    planes[row, done : done + length] = body[at + 1]
                    at += 2
                else:
                    planes[row, done : done + length] = np.frombuffer(body, np.uint8, length, at + 1)
                    at += 1 + length
                done += length
    return np.moveaxis(planes.reshape(height, 4, width), 1, -1)
