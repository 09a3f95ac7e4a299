"""MERL materials: the binary files of Matusik et al. 2003, *A Data-Driven Reflectance Model*."""

import functools
import struct
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from shisd.io._files import StrPath, ordinary, refuse_existing, write_atomically

if TYPE_CHECKING:
    from shisd.models import AbstractBrdf

MERL_BINS = (90, 90, 180)
MERL_SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0
_BEYOND = 1e15  # 1/sr; a mirror of alpha 1e-4 reaches 1e7
_MERL_BYTES = 12 + 3 * 8 * 90 * 90 * 180


def read_merl(path: StrPath) -> np.ndarray:
    """The table of a MERL material: float64 [90, 90, 180, 3] over theta_h, theta_d, phi_d and colour, in 1/sr.

    Missing values are negative. The bins are those of `shisd.models.MeasuredBrdf`, the planes are scaled by
    (1, 1.15, 1.66) / 1500. Values that are not finite, or beyond 1e15 where no material is, become missing, and a
    UserWarning counts the latter and the infinite ones. Errors: FileNotFoundError; ValueError for a file of another
    size than 34,992,012 bytes or with other dimensions than (90, 90, 180), before the values are read, and for one
    where more than 1 % of the values are beyond 1e15: it is damaged, or of another byte order.
    """
    path = ordinary(path)
    size = path.stat().st_size
    if size != _MERL_BYTES:
        raise ValueError(f"{path}: a MERL material has {_MERL_BYTES:,} bytes; this file has {size:,}.")
    with path.open("rb") as file:
        start = file.read(12)
        dimensions = struct.unpack("<3i", start) if len(start) == 12 else ()
        if dimensions != MERL_BINS:
            swapped = start == struct.pack(">3i", *MERL_BINS)
            advice = " It is big-endian: swap the bytes of its integers and doubles." if swapped else ""
            raise ValueError(f"{path}: a MERL file starts with the bin counts {MERL_BINS}; got {dimensions}.{advice}")
        planes = np.fromfile(file, "<f8")
    if planes.size != 3 * np.prod(MERL_BINS):
        raise ValueError(f"{path}: changed while it was read.")
    with np.errstate(invalid="ignore"):
        table = np.moveaxis(planes.astype(np.float64, copy=False).reshape(3, *MERL_BINS), 0, -1) * MERL_SCALE
    beyond = np.abs(table) > _BEYOND
    if count := int(np.sum(beyond)):
        found = f"{path}: {count} of {table.size} values are infinite or beyond {_BEYOND:g} / sr"
        if count > 0.01 * table.size:
            raise ValueError(f"{found}: damaged or big-endian. Get it again, or swap the bytes.")
        warnings.warn(f"{found}; they count as missing.", UserWarning, stacklevel=2)
    table[beyond | np.isnan(table)] = -1
    return table


def write_merl(path: StrPath, brdf: "AbstractBrdf | np.ndarray | jax.Array", *, overwrite: bool = False) -> None:
    """Write an isotropic BRDF, or a table [90, 90, 180, 3] in 1/sr, as a MERL material.

    A BRDF is evaluated at the bin centres, in the default precision of JAX; a scalar one fills three equal planes. Bins
    whose centre is below the horizon, and negative values, are written as -1: missing. Errors: FileExistsError unless
    `overwrite=True`; ValueError for an anisotropic BRDF, a table of another shape, or values that are not finite or
    beyond 1e15.
    """
    path = Path(path)
    refuse_existing(path, overwrite)
    if hasattr(brdf, "value"):
        table = tabulate_merl(brdf)  # type: ignore[arg-type]
    else:
        table = np.asarray(brdf, np.float64)
        if table.shape != (*MERL_BINS, 3):
            raise ValueError(f"`brdf` must be a BRDF or a table [90, 90, 180, 3]; got shape {list(table.shape)}.")
    if wrong := int(np.sum(~(np.abs(table) <= _BEYOND))):
        raise ValueError(f"`brdf` has {wrong} values that are not finite or beyond {_BEYOND:g}.")
    missing = (table < 0) | ~merl_above_horizon()[..., None]
    planes = np.moveaxis(np.where(missing, -1.0, table / MERL_SCALE), -1, 0)
    content = np.ascontiguousarray(planes, "<f8")
    write_atomically(
        path, lambda file: (file.write(struct.pack("<3i", *MERL_BINS)), file.write(content.data)), overwrite=overwrite
    )


@functools.cache
def merl_directions() -> tuple[np.ndarray, np.ndarray]:
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
    wi, wo = merl_directions()
    return (wi[..., 2] > 0) & (wo[..., 2] > 0)


def tabulate_merl(brdf: "AbstractBrdf") -> np.ndarray:
    """The values of an isotropic BRDF at the bin centres: float64 [90, 90, 180, 3]."""
    if not brdf.isotropic:
        raise ValueError("`brdf` is anisotropic; a MERL material has no azimuth of the half vector.")
    values = jax.jit(jax.vmap(jax.vmap(brdf.value)))
    slices = [np.asarray(values(jnp.asarray(wi), jnp.asarray(wo))) for wi, wo in zip(*merl_directions(), strict=True)]
    table = np.stack(slices).astype(np.float64)
    return np.broadcast_to(table if table.ndim == 4 else table[..., None], (*MERL_BINS, 3))
