"""Pictures: which format a file has, and what is written for which suffix."""

from pathlib import Path

import numpy as np

from shisd.io import _exr, _radiance
from shisd.io._files import StrPath, optional, ordinary, refuse_existing, write_atomically


def read_image(path: StrPath, *, layer: str | None = None) -> np.ndarray:
    """A linear high-dynamic-range image: float32 [H, W] or [H, W, 3], rows from the top.

    The format is told from the content. OpenEXR: any compression, scan lines or tiles, several parts and named layers.
    The layer without a name that holds R, G, B is the picture, else the only layer with R, G, B, else the only one of a
    single channel; alpha is dropped. Where there are several, `layer` names one: what stands before the last dot of its
    channels, or the name of its part. Radiance RGBE: flat rows, both run-length codes, mixed, in all eight
    orientations; EXPOSURE and COLORCORR are divided out, all that there are, an EXPOSURE of 0 counts as none.

    Values are as stored: no chromaticities are applied, NaN, infinity and negative ones are kept. A UserWarning tells
    of pixels that are not square. Radiance mantissas count as written, without the half step that Radiance itself adds.
    Errors: FileNotFoundError; ValueError naming path, reason and what to do for a foreign, truncated, damaged or
    unsupported file (deep, cropped, subsampled, integer, XYZ), for bytes that are left over, and for a layer that is
    not there; ImportError for OpenEXR files without the package OpenEXR. Memory beside the image: a few MB and some
    rows for Radiance, all channels of the file for OpenEXR.
    """
    path = ordinary(path)
    with path.open("rb") as file:
        magic = file.read(4)
    if magic == b"\x76\x2f\x31\x01":
        return _exr.read(path, layer)
    if magic[:2] == b"#?":
        if layer is not None:
            raise ValueError(f"{path}: a Radiance file has no layers; leave `layer` out.")
        return _radiance.read(path)
    raise ValueError(f"{path}: neither an OpenEXR nor a Radiance file; it starts with {magic!r}.")


def write_image(path: StrPath, image: np.ndarray, *, overwrite: bool = False) -> None:
    """An image [H, W] or [H, W, 3], rows from the top, in the format of the suffix.

    .png: 8 bits per channel of display values in [0, 1]; see `tonemap`. .exr: linear values as they are, float16 for
    float16, else float32. .hdr: linear values of at least 0, three channels of 8 bits with a common exponent, rounded
    by at most 0.4 % of the pixel's largest. The file is there completely or not at all.
    Errors: FileExistsError unless `overwrite=True`; ValueError for another suffix, another shape, or values that the
    format cannot hold; ImportError without Pillow or OpenEXR.
    """
    path, pixels = Path(path), np.asarray(image)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".exr", ".hdr"):
        raise ValueError(f"{path}: images are written as .png, .exr or .hdr; got suffix {path.suffix!r}.")
    if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[-1] == 3)) or pixels.size == 0:
        raise ValueError(f"`image` must have shape [H, W] or [H, W, 3]; got {list(pixels.shape)}.")
    if pixels.dtype.kind not in "fiub":
        raise ValueError(f"`image` must hold real numbers; got {pixels.dtype}.")
    refuse_existing(path, overwrite)
    if suffix == ".png":
        if not np.all((pixels >= 0) & (pixels <= 1)):
            raise ValueError("`image` must hold display values in [0, 1]; pass it through shisd.io.tonemap first.")
        picture = optional("PIL.Image", "the package Pillow").fromarray(np.round(255 * pixels).astype(np.uint8))
        write = lambda file: picture.save(file, format="PNG")
    elif suffix == ".exr":
        write = _exr.writer(pixels)
    else:
        write = _radiance.writer(pixels)
    write_atomically(path, write, overwrite=overwrite)


def tonemap(image: np.ndarray, *, exposure: float = 1.0) -> np.ndarray:
    """Display values in [0, 1]: linear values times `exposure`, cut to [0, 1], then the sRGB curve (IEC 61966-2-1)."""
    linear = np.clip(np.asarray(image) * exposure, 0, 1)
    curve = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve)
