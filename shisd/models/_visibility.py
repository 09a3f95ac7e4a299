"""Visibility of the distant light from the points of a mesh, as spherical harmonic coefficients at its vertices.

Rays go out above the tangent plane of every vertex only. What v is below it has no effect on a surface's radiance, so
there v continues as its own mirror image: it stays continuous, half the rays do, and where nothing occludes v is 1 with
no error of the band limit. With b = 1 - v, in a frame whose z axis is the normal, the coefficients are

    b_l^m = 2 sum over rays of (2 pi / N) b(w) y_l^m(w) where l + m is even, else 0,

turned to the frame of the mesh, where they can be interpolated over its triangles (ISD15 section 6.1 and appendix A).

notation: V vertices, F triangles, N rays; v = 1 where light from afar arrives, 0 where the mesh stops it.
"""

import functools
import math
import os
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from shisd import _checks, io
from shisd._typing import Array, Float, Scalar
from shisd.domains._region import cap_coefficients
from shisd.harmonics import _tables
from shisd.harmonics._rotation import rotate_many
from shisd.harmonics._sh import weighted_sums

_RAYS_AT_ONCE = 1 << 20


class Visibility(eqx.Module):
    """Band-limited visibility at the vertices of a mesh, interpolated linearly over its triangles.

    Fields: `coefficients` [V, (L+1)^2] in the frame of the mesh; `triangles` [F, 3], the vertices of each; `noise`, one
    standard deviation of the error of v(w) that is left by the finite number of rays, RMS over directions and vertices.
    The coefficients may be replaced, optimised, or filtered (`harmonics.apply_window` lessens their ringing).
    """

    coefficients: Float[Array, "v n"]
    triangles: Array
    noise: Scalar

    def __init__(self, coefficients: ArrayLike, triangles: ArrayLike, noise: ArrayLike = 0.0):
        c, _ = _checks.coefficients("coefficients", coefficients)
        if c.ndim != 2:
            raise ValueError(f"`coefficients` must have shape [V, (degree + 1)**2]; got {list(c.shape)}.")
        corners = jnp.asarray(triangles)
        if corners.ndim != 2 or corners.shape[1] != 3 or not jnp.issubdtype(corners.dtype, jnp.integer):
            raise ValueError(
                f"`triangles` must be integers [F, 3]; got {corners.dtype} of shape {list(corners.shape)}."
            )
        self.coefficients, self.triangles = c, corners.astype(np.int32)
        self.noise = _checks.real_array("noise", noise).astype(c.dtype)

    @property
    def degree(self) -> int:
        return _checks.degree_of(self.coefficients.shape[-1])

    @property
    def openness(self) -> Float[Array, " v"]:
        """The share of the directions above each vertex from which light arrives (1 - ambient occlusion, unweighted).

        It is 0 at vertices inside the mesh, as a mesh that intersects itself has.
        """
        return self.coefficients[:, 0] / math.sqrt(4 * np.pi)

    def at(self, triangle: ArrayLike, weights: ArrayLike) -> Float[Array, "*batch n"]:
        """Coefficients at points of the surface: `triangle` [...], its index; barycentric `weights` [..., 3]."""
        corners, weights = surface_corners(self, triangle, weights)
        return jnp.einsum("...c,...cn->...n", weights, self.coefficients[corners])

    @classmethod
    def from_mesh(
        cls,
        vertices: ArrayLike,
        triangles: ArrayLike,
        degree: int,
        *,
        normals: ArrayLike | None = None,
        rays: int = 2048,
        offset: float = 1e-4,
        seed: int = 0,
    ) -> "Visibility":
        """Visibility at every vertex by ray casting, self-occlusion of one mesh. Needs trimesh and embreex.

        Arguments: `vertices` [V, 3]; `triangles` [F, 3], outside counter-clockwise; static `degree`. `normals` [V, 3],
        by default those of the triangles around each vertex, weighted by area. `rays` for each vertex, one at random
        in every cell of a grid, twice: the difference of both halves is the `noise`. Rays start off the vertex by
        `offset` of the mesh's diagonal, along the normal.
        Meshes may be open (each vertex looks to the side of its normal) or intersect themselves: a vertex that is
        inside sees nothing. Triangles of no area are never hit.
        Errors: ValueError for wrong shapes, indices that do not exist, vertices that are not finite, and vertices
        without a normal (of no triangle, or only of triangles without area), with their number; ImportError without
        the packages.
        Not differentiable: for gradients see the derivative of `shade_environment_visibility` in the coefficients.
        Cost: V x rays rays.
        """
        degree, rays = _checks.degree(degree), _checks.integer("rays", rays, minimum=2)
        points, corners = _mesh(vertices, triangles)
        n = _normals(points, corners) if normals is None else np.asarray(normals, float)
        if n.shape != points.shape:
            raise ValueError(f"`normals` must have the shape of `vertices`, {list(points.shape)}; got {list(n.shape)}.")
        length = np.linalg.norm(n, axis=1)
        if bad := int(np.sum(~(length > 0) | ~np.isfinite(length))):
            raise ValueError(
                f"{bad} of {len(n)} vertices have no normal: they belong to no triangle with an area. Remove them, or "
                "pass `normals`."
            )
        rays_of = io.optional("trimesh.ray.ray_pyembree", "the packages trimesh and embreex", "mesh")
        trimesh = io.optional("trimesh", "the package trimesh", "mesh")
        blocked = rays_of.RayMeshIntersector(trimesh.Trimesh(points, corners, process=False)).intersects_any
        start = points + offset * np.linalg.norm(np.ptp(points, axis=0)) * n / length[:, None]
        frames = _frames(n / length[:, None], np.random.default_rng(seed))
        local = _stratified(rays // 2, len(points), seed)
        halves = [_project(start, frames, w, blocked, degree) for w in local]
        c = jnp.asarray((halves[0] + halves[1]) / 2, float)
        noise = np.sqrt(np.mean(np.sum((halves[0] - halves[1]) ** 2, axis=1)) / (4 * np.pi)) / 2
        return cls(c, corners, noise)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write all fields as an .npz file. FileExistsError unless `overwrite=True`."""
        path = _npz(path)
        if path.exists() and not overwrite:
            raise FileExistsError(f"{path} exists; pass overwrite=True to replace it.")
        np.savez_compressed(path, coefficients=self.coefficients, triangles=self.triangles, noise=self.noise)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Visibility":
        """What `save` wrote. FileNotFoundError, or ValueError for a file that holds something else."""
        path = _npz(path)
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such file.")
        try:
            with np.load(path) as file:
                return cls(*(file[name] for name in ("coefficients", "triangles", "noise")))
        except Exception as error:
            raise ValueError(f"{path}: not a file that Visibility.save wrote: {error}") from error


def cap_visibility(axes: ArrayLike, angles: ArrayLike, degree: int) -> Float[Array, "*batch n"]:
    """Coefficients of the visibility past one round occluder: 0 within an angle of an axis, 1 elsewhere.

    A ball of radius r at distance d covers the cap of angle arcsin(r / d); a ground without relief one of pi/2 about
    the direction downwards, a horizon that is lifted by e one of pi/2 + e.
    Arguments: `axes` [..., 3], of any length but zero; `angles` [...] in rad, from 0 to pi; static `degree`. Returns
    [..., (degree + 1)^2]. Several occluders: their `harmonics.multiply`, or the sum of their complements where they do
    not overlap. Derivatives: in both. Accuracy: 1e-13 in float64, 1e-6 in float32, for every angle.
    """
    a, angle, degree = _checks.vectors("axes", axes), _checks.real_array("angles", angles), _checks.degree(degree)
    dtype = jnp.promote_types(a.dtype, angle.dtype)
    try:
        shape = np.broadcast_shapes(a.shape[:-1], angle.shape)
    except ValueError as error:
        raise ValueError(f"`axes` {list(a.shape)} and `angles` {list(angle.shape)} do not broadcast.") from error
    a, angle = jnp.broadcast_to(a, (*shape, 3)).astype(dtype), jnp.broadcast_to(angle, shape).astype(dtype)
    return (-cap_coefficients(2 * jnp.sin(angle / 2) ** 2, a, degree)).at[..., 0].add(math.sqrt(4 * np.pi))


def surface_corners(visibility: Visibility, triangle: ArrayLike, weights: ArrayLike) -> tuple[Array, Array]:
    """Vertices and weights [..., 3] of points of the surface."""
    index, w = jnp.asarray(triangle), _checks.vectors("weights", weights)
    if not jnp.issubdtype(index.dtype, jnp.integer) or index.shape != w.shape[:-1]:
        raise ValueError(
            f"`triangle` must be integers of the batch shape of `weights` {list(w.shape)}; got {index.dtype} of shape "
            f"{list(index.shape)}."
        )
    return visibility.triangles[index], w.astype(visibility.coefficients.dtype)


# ---- on the host


def _mesh(vertices: ArrayLike, triangles: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    points, corners = np.asarray(vertices, float), np.asarray(triangles)
    if points.ndim != 2 or points.shape[1:] != (3,) or len(points) == 0:
        raise ValueError(f"`vertices` must have shape [V, 3]; got {list(points.shape)}.")
    if corners.ndim != 2 or corners.shape[1:] != (3,) or len(corners) == 0 or corners.dtype.kind not in "iu":
        raise ValueError(f"`triangles` must be integers [F, 3]; got {corners.dtype} of shape {list(corners.shape)}.")
    if not np.all(np.isfinite(points)):
        raise ValueError(f"{int(np.sum(~np.isfinite(points).all(axis=1)))} of `vertices` are not finite.")
    if corners.min() < 0 or corners.max() >= len(points):
        raise ValueError(f"`triangles` name vertices {corners.min()} to {corners.max()}; there are {len(points)}.")
    return points, corners


def _normals(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(points[corners], 1, 0)
    normals = np.zeros_like(points)
    for corner in corners.T:
        np.add.at(normals, corner, np.cross(b - a, c - a))
    return normals


def _frames(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rotations [V, 3, 3] that take z to the normals, turned about them at random."""
    x = rng.normal(size=normals.shape)
    x -= np.sum(x * normals, axis=1, keepdims=True) * normals
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(normals, x), normals], axis=-1)


def _stratified(count: int, vertices: int, seed: int) -> list[np.ndarray]:
    """Two sets of directions above the horizon [N, 3], one in each cell of equal solid angle of a grid."""
    rows = max(1, round(np.sqrt(count / 2)))
    columns = -(-count // rows)
    rng, sets = np.random.default_rng([seed, vertices]), []
    for _ in range(2):
        u, v = rng.uniform(size=(2, rows, columns))
        z = (np.arange(rows)[:, None] + u) / rows
        phi = 2 * np.pi * (np.arange(columns) + v) / columns
        sine = np.sqrt(1 - z * z)
        sets.append(np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=-1).reshape(-1, 3))
    return sets


def _project(start: np.ndarray, frames: np.ndarray, local: np.ndarray, blocked: Callable, degree: int) -> np.ndarray:
    """Coefficients [V, n] of v from rays along the same local directions for every vertex."""
    at_once = max(1, _RAYS_AT_ONCE // len(local))
    rows = []
    for first in range(0, len(start), at_once):
        own = slice(first, first + at_once)
        rays = np.einsum("vij,nj->vni", frames[own], local)
        hits = blocked(np.repeat(start[own], len(local), axis=0), rays.reshape(-1, 3)).reshape(rays.shape[:2])
        arrays = (jnp.asarray(x, float) for x in (local, frames[own]))
        rows.append(np.asarray(_of_hits(jnp.asarray(hits), *arrays, degree)))
    return np.concatenate(rows)


@functools.partial(jax.jit, static_argnames="degree")
def _of_hits(hits: Array, local: Float[Array, "r 3"], frames: Float[Array, "v 3 3"], degree: int) -> Array:
    hidden = weighted_sums(hits.T.astype(local.dtype) * (4 * np.pi / len(local)), local, degree)
    even = (_tables.bands(degree) + _tables.orders(degree)) % 2 == 0
    hidden = jnp.where(even[:, None], hidden.T, 0)  # n, V
    return (-rotate_many(hidden[:, None], frames, degree)[:, 0].T).at[:, 0].add(math.sqrt(4 * np.pi))


def _npz(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"{path}: visibility is stored as .npz; got suffix {path.suffix!r}.")
    return path
