"""What every reader and writer does: open ordinary files only, replace a file by a complete one, and name the path."""

import importlib
import math
import os
import secrets
import shutil
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import IO

import numpy as np

StrPath = str | os.PathLike[str]

_DEFLATE_RATIO = 1032  # the most that deflate unfolds


def ordinary(path: StrPath) -> Path:
    """The path of a file that can be read to its end: no folder, no pipe, no device."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file.")
    if path.is_dir():
        raise ValueError(f"{path}: a folder; name a file in it.")
    if not path.is_file():
        raise ValueError(f"{path}: a pipe or device; copy what it gives to a file.")
    return path


def write_atomically(path: StrPath, content: str | Callable[[IO[bytes]], object], *, overwrite: bool = False) -> None:
    """Write a file that is there completely or not at all.

    `content` is the text, or a function that gets a binary file to write to: a new one beside `path`, which takes its
    place once it is on the disk. What stood at `path` is whole until then, and stays so when the function raises or the
    program is stopped. Without `overwrite` one of several writers succeeds. A link is replaced, never written through.
    Errors: FileExistsError unless `overwrite=True`; ValueError where `path` is a folder, pipe or device; OSError with
    `path` for what the system refuses; those of the function.
    """
    path = Path(path)
    refuse_existing(path, overwrite)
    if os.path.lexists(path) and not (path.is_symlink() or path.is_file()):
        raise ValueError(f"{path}: a folder, pipe or device; name a file.")
    beside = path.with_name(f".{secrets.token_hex(8)}.part")
    try:
        with beside.open("xb") as file:
            file.write(content.encode()) if isinstance(content, str) else content(file)
            file.flush()
            os.fsync(file.fileno())
        if not overwrite:
            _claim(beside, path)
        else:
            if path.is_file():
                shutil.copymode(path, beside)
            os.replace(beside, path)
    except FileExistsError as error:
        raise FileExistsError(f"{path} exists; pass overwrite=True to replace it.") from error
    except OSError as error:
        raise type(error)(error.errno, f"could not be written: {error.strerror or error}", str(path)) from error
    finally:
        beside.unlink(missing_ok=True)


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Before the work; `write_atomically` looks again when the file takes its place."""
    if os.path.lexists(path) and not overwrite:
        raise FileExistsError(f"{path} exists; pass overwrite=True to replace it.")


def _claim(beside: Path, path: Path) -> None:
    """Move a file to a path where there is none: FileExistsError where there is."""
    try:
        os.link(beside, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without links: an empty file holds the place
        path.open("xb").close()
        os.replace(beside, path)


def read_npz(path: Path, names: Iterable[str]) -> list[np.ndarray]:
    """Arrays of an .npz file. What an array's header promises is compared with the file before it is allocated."""
    arrays = []
    with zipfile.ZipFile(path) as archive:
        for name in names:
            info = archive.getinfo(f"{name}.npy")
            if info.file_size > _DEFLATE_RATIO * info.compress_size:
                raise ValueError(f"{name} is {info.file_size} bytes from {info.compress_size}, more than can be.")
            with archive.open(info) as member:
                version = np.lib.format.read_magic(member)
                if version not in ((1, 0), (2, 0)):
                    raise ValueError(f"{name} has the format {version}; (1, 0) and (2, 0) are read.")
                formats = np.lib.format
                header = formats.read_array_header_1_0 if version == (1, 0) else formats.read_array_header_2_0
                shape, column_major, dtype = header(member)
                size = math.prod(shape) * dtype.itemsize
                if dtype.hasobject or size != info.file_size - member.tell():
                    raise ValueError(f"{name} is not of the size that its header promises, {dtype} {list(shape)}.")
                array = np.frombuffer(member.read(), dtype).reshape(shape, order="F" if column_major else "C")
            arrays.append(array)
    return arrays


def optional(module: str, package: str, extra: str = "io") -> ModuleType:
    """A module of an optional package, or an error that says what to install."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"This needs {package}: pip install shisd[{extra}].") from error
