"""OpenEXR pictures: which of a file's parts and layers is the picture, read with the package OpenEXR."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from shisd.io._files import optional

_SHORT = {"red": "r", "green": "g", "blue": "b", "alpha": "a"}
_SMALL = 1 << 28  # bytes; larger pictures must be plausible for the size of their file
_RATIO = 1100  # the most that a compression unfolds, nearly


@dataclass(frozen=True)
class _Layer:
    """Channels of one part whose names begin alike: by their last word in short, as "r" for "diffuse.R"."""

    name: str
    plain: bool
    part: int
    channels: dict[str, Any]

    @property
    def picture(self) -> tuple[str, ...]:
        """The channels that make it a colour or a grey picture."""
        if {"r", "g", "b"} <= self.channels.keys():
            return "r", "g", "b"
        others = tuple(name for name in self.channels if name != "a")
        return others if len(others) == 1 else ()


def read(path: Path, layer: str | None) -> np.ndarray:
    openexr = optional("OpenEXR", "the package OpenEXR")
    try:
        return _read(openexr, path, layer)
    except (IndexError, KeyError, UnicodeDecodeError) as error:  # the package goes on without what it could not read
        raise ValueError(f"{path}: truncated or damaged: {error!r}. Get or save it again.") from error


def _read(openexr: Any, path: Path, layer: str | None) -> np.ndarray:
    with _opened(openexr, path, header_only=True) as file:
        chosen = _choose(path, file, layer)
        _check(path, file, chosen)
    with _opened(openexr, path, header_only=False) as file:
        part = {part.part_index: part for part in file.parts}[chosen.part]
        names = [chosen.channels[short].name for short in chosen.picture]
        planes = [part.channels[name].pixels for name in names]
        if any(plane.ndim != 2 or plane.shape != planes[0].shape for plane in planes):
            raise ValueError(f"{path}: damaged: its channels are not those of its header. Get or save it again.")
        if any(plane.dtype.kind != "f" for plane in planes):
            raise ValueError(f"{path}: {', '.join(names)} hold integers, which are no radiance; name another `layer`.")
        image = np.empty((*planes[0].shape, len(planes)), np.float32)
        for i, plane in enumerate(planes):
            image[..., i] = plane
    return image if len(planes) == 3 else image[..., 0]


def _opened(openexr: Any, path: Path, *, header_only: bool) -> Any:
    try:
        return openexr.File(str(path), separate_channels=True, header_only=header_only)
    except Exception as error:  # the package raises several kinds
        raise ValueError(
            f"{path}: not a readable OpenEXR file, or truncated: {error}. Get or save it again."
        ) from error


def _choose(path: Path, file: Any, name: str | None) -> _Layer:
    layers = []
    for index, part in enumerate(file.parts):
        if part.header["type"].name.startswith("deep"):
            continue
        groups: dict[str, dict[str, Any]] = {}
        for channel in part.header["channels"]:
            prefix, _, last = str(channel.name).rpartition(".")
            short = last.lower()
            groups.setdefault(prefix, {})[_SHORT.get(short, short)] = channel
        layers += [_Layer(prefix or part.name(), not prefix, index, found) for prefix, found in groups.items()]
    if not layers:
        raise ValueError(f"{path}: a deep file, of several samples in a pixel; flatten it first.")
    pictures = [layer for layer in layers if layer.picture]
    if name is not None:
        named = [layer for layer in pictures if layer.name == name]
        if len(named) == 1:
            return named[0]
        count = f"{len(named)} times" if named else "not"
        raise ValueError(f"{path}: the layer {name!r} is there {count}; its pictures are {_names(pictures)}.")
    colours = [layer for layer in pictures if len(layer.picture) == 3]
    for found in ([layer for layer in colours if layer.plain], colours, pictures):
        if len(found) == 1:
            return found[0]
        if found:
            raise ValueError(f"{path}: holds several pictures; pass `layer`, one of {_names(found)}.")
    every = sorted(channel.name for layer in layers for channel in layer.channels.values())
    raise ValueError(f"{path}: needs the channels R, G, B, or a single one; it has {every}.")


def _names(layers: list[_Layer]) -> str:
    return ", ".join(repr(layer.name) for layer in layers) or "none"


def _check(path: Path, file: Any, chosen: _Layer) -> None:
    """Refuse what is no whole picture, and sizes that such a file cannot hold."""
    header = file.parts[chosen.part].header
    channels = [chosen.channels[short] for short in chosen.picture]
    if any((channel.xSampling, channel.ySampling) != (1, 1) for channel in channels):
        names = ", ".join(channel.name for channel in channels)
        raise ValueError(f"{path}: {names} have fewer samples than pixels; save it as R, G, B at full size.")
    if not all(np.array_equal(a, b) for a, b in zip(header["dataWindow"], header["displayWindow"], strict=True)):
        raise ValueError(f"{path}: cropped: its data window is not its display window; save it without crop.")
    if not 0.999 < header["pixelAspectRatio"] < 1.001:
        found = f"{path}: its pixels are {header['pixelAspectRatio']:.4g} times as wide as high"
        warnings.warn(f"{found}; they are read as stored.", UserWarning, stacklevel=4)
    needed, size = 0, path.stat().st_size
    for part in file.parts:
        low, high = (np.asarray(corner, dtype=object) for corner in part.header["dataWindow"])
        needed += 2 * len(part.header["channels"]) * int(np.prod(high - low + 1))
    if needed > max(_SMALL, _RATIO * size):
        raise ValueError(f"{path}: its {size} bytes cannot hold what its header promises. The file is damaged.")


def writer(image: np.ndarray) -> Callable[[IO[bytes]], object]:
    """What writes an image [H, W] or [H, W, 3] as it is: Y, or R, G, B."""
    openexr = optional("OpenEXR", "the package OpenEXR")
    pixels = np.ascontiguousarray(image, np.float16 if image.dtype == np.float16 else np.float32)
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    return openexr.File(header, {"Y" if pixels.ndim == 2 else "RGB": pixels}).write
