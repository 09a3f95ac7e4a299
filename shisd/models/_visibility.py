"""Visibility of the distant light from the points of a mesh, as spherical harmonic coefficients at its vertices.

Rays go out above the tangent plane of every vertex only. What v is below it has no effect on a surface's radiance, so
there v continues as its own mirror image: it stays continuous, half the rays do, and where nothing occludes v is 1 with
no error of the band limit. With b = 1 - v, in a frame whose z axis is the normal, the coefficients are

    b_l^m = 2 sum over rays of (2 pi / N) b(w) y_l^m(w) where l + m is even, else 0,

turned to the frame of the mesh, where they can be interpolated over its triangles (ISD15 section 6.1 and appendix A).

Embree works in float32, so what it is given lies about the median of the vertices, in units of the mesh, and rays start
off the surface by a few units in the last place of the coordinates and of the triangles there: the size of the scene
does not matter, and neither do its place and unit.

notation: V vertices, or points; F triangles, N rays; v = 1 where light from afar arrives, 0 where the mesh stops it.
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

from shisd import _checks
from shisd._module import Module
from shisd._progress import Progress, reporting
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Float
from shisd.domains.internal import cap_coefficients
from shisd.harmonics.internal import bands, orders, rotate_many, weighted_sums
from shisd.io.internal import optional, ordinary, read_npz, write_atomically

_RAYS_AT_ONCE = 1 << 20


class Visibility(Module):
    """Band-limited visibility at the vertices of a mesh, interpolated linearly over its triangles, or at single points.

    Fields: `coefficients` [V, (L+1)^2] in the frame of the mesh; `triangles` [F, 3], the vertices of each, F = 0 for
    points without a surface; `noise` [V], or one for all, by default 0: one standard deviation of the error of v(w)
    that is left by the finite number of rays, RMS over directions. ValueError for corners that do not exist and for
    numbers that are not finite; under `jit`, where values are unknown, results are NaN there.
    The coefficients may be replaced, optimised, or filtered (`harmonics.apply_window` lessens their ringing).
    """

    coefficients: Float[Array, "v n"]
    triangles: Array
    noise: Float[Array, " v"]

    def __init__(self, coefficients: ArrayLike, triangles: ArrayLike, noise: ArrayLike = 0.0):
        c, _ = _checks.coefficients("coefficients", coefficients)
        if c.ndim != 2:
            raise ValueError(f"`coefficients` must have shape [V, (degree + 1)**2]; got {list(c.shape)}.")
        corners = _integers("triangles", triangles)
        if corners.ndim != 2 or corners.shape[1] != 3:
            raise ValueError(f"`triangles` must be integers [F, 3]; got shape {list(corners.shape)}.")
        _check_range("triangles", corners, len(c), "vertices")
        deviation = _checks.real_array("noise", noise).astype(c.dtype)
        if deviation.shape not in ((), c.shape[:1]):
            raise ValueError(f"`noise` must be one number or [V] = [{len(c)}]; got shape {list(deviation.shape)}.")
        for name, value in {"coefficients": c, "noise": deviation}.items():
            known = _known(value)
            if known is not None and not np.all(np.isfinite(known)):
                raise ValueError(f"`{name}` must be finite; {int(np.sum(~np.isfinite(known)))} of its numbers are not.")
        self.coefficients, self.triangles = c, jnp.asarray(corners.astype(np.int32))
        self.noise = jnp.broadcast_to(deviation, c.shape[:1])

    @property
    def degree(self) -> int:
        return _checks.degree_of(self.coefficients.shape[-1])

    @property
    def openness(self) -> Float[Array, " v"]:
        """The share of the directions above each vertex from which light arrives (1 - ambient occlusion, unweighted).

        It is 0 at vertices inside the mesh, as a mesh that intersects itself has.
        """
        return self.coefficients[:, 0] / math.sqrt(4 * np.pi)

    def at(self, triangles: ArrayLike, barycentric: ArrayLike) -> Float[Array, "*batch n"]:
        """Coefficients at points of the surface: the index of each one's triangle [...], and `barycentric` [..., 3].

        ValueError for triangles that do not exist, NaN under `jit`.
        """
        corners, weights = surface_corners(self, triangles, barycentric)
        return by_device(_interpolated, {"corners": corners, "weights": weights}, self.coefficients)

    @classmethod
    def from_mesh(
        cls,
        vertices: ArrayLike,
        triangles: ArrayLike,
        degree: int,
        *,
        points: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        rays: int = 2048,
        offset: float = 4e-6,
        seed: int = 0,
        progress: Progress = None,
    ) -> "Visibility":
        """Visibility at every vertex, or at other points, by casting rays at one mesh. Needs embreex.

        Arguments: `vertices` [V, 3]; `triangles` [F, 3], outside counter-clockwise; static `degree`. `normals` [V, 3],
        by default those of the triangles around each vertex, weighted by area. `points` [P, 3] with their `normals`
        [P, 3]: on the mesh or off it, as on a ground that is not part of it; the result has a row for each of them and
        no triangles. `rays` for each vertex, one at random in every cell of a grid, twice: the difference of both
        halves is the `noise`. Rays start off the vertex along the normal by `offset` times its distance to the median
        of the vertices plus the longest edge at it; off points, the longest edge of the mesh. The default is 64 times
        what rounding needs. `progress`: None, True for a bar of tqdm, or a function of rows that are done and in all.
        Meshes may be open (each vertex looks to the side of its normal) or intersect themselves: a vertex that is
        inside sees nothing. Triangles of no area are never hit; both sides of all others stop light. Triangles that
        coincide do no harm; but where each is there with both windings no side is outside: pass `normals`.
        Errors: ValueError for wrong shapes, indices that do not exist, vertices that are not finite, and vertices
        without a normal (of no triangle, only of triangles without area, or of triangles that cancel), with their
        number; ImportError without the package.
        Accuracy: `noise`, wherever the mesh is and whatever its unit, as far as its coordinates are exact.
        Not differentiable: for gradients see the derivative of `shading.shade` in the coefficients.
        Cost: V x rays rays.
        """
        degree, rays = _checks.degree(degree), _checks.integer("rays", rays, minimum=2)
        if not (np.ndim(offset) == 0 and 0 <= offset < np.inf):
            raise ValueError(f"`offset` must be a number >= 0; got {offset!r}.")
        corner, corners = _mesh(vertices, triangles)
        middle = np.median(corner, axis=0)
        size = np.max(np.abs(corner - middle)) or 1.0
        corner = (corner - middle) / size
        edges = np.max(np.linalg.norm(corner[corners] - corner[np.roll(corners, 1, axis=1)], axis=2), axis=1)
        if points is None:
            start, longest = corner, np.zeros(len(corner))
            np.maximum.at(longest, corners, edges[:, None])
        elif normals is None:
            raise ValueError("`points` need their `normals` [P, 3].")
        else:
            start, longest = (_points("points", points) - middle) / size, np.max(edges)
        n = _normals(corner, corners) if normals is None else np.asarray(normals, float)
        if n.shape != start.shape:
            whose = "vertices" if points is None else "points"
            raise ValueError(f"`normals` must have the shape of `{whose}`, {list(start.shape)}; got {list(n.shape)}.")
        length = np.linalg.norm(n, axis=1, keepdims=True)
        if bad := int(np.sum(~(length > 0) | ~np.isfinite(length))):
            raise ValueError(
                f"{bad} of {len(n)} `normals` have no direction."
                if normals is not None
                else f"{bad} of {len(n)} vertices have no normal: they belong to no triangle with an area, or to "
                "triangles that cancel, as where each is there with both windings. Remove them, or pass `normals`."
            )
        n = n / length
        start = start + offset * (np.linalg.norm(start, axis=1, keepdims=True) + np.reshape(longest, (-1, 1))) * n
        blocked, frames = _scene(corner, corners), _frames(n, np.random.default_rng(seed))
        with reporting(progress, 2 * len(start), "visibility") as step:
            halves = [_project(start, frames, w, blocked, degree, step) for w in _stratified(rays // 2, len(n), seed)]
        c = jnp.asarray((halves[0] + halves[1]) / 2, float)
        noise = np.sqrt(np.sum((halves[0] - halves[1]) ** 2, axis=1) / (4 * np.pi)) / 2
        return cls(c, corners if points is None else corners[:0], noise)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write all fields as an .npz file, which is there completely or not at all.

        Errors: FileExistsError unless `overwrite=True`; ValueError for another suffix than .npz.
        """
        write = lambda file: np.savez_compressed(
            file, coefficients=self.coefficients, triangles=self.triangles, noise=self.noise
        )
        write_atomically(_npz(path), write, overwrite=overwrite)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Visibility":
        """What `save` wrote. FileNotFoundError, or ValueError for a file that holds something else."""
        path = ordinary(_npz(path))
        try:
            return cls(*read_npz(path, ("coefficients", "triangles", "noise")))
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


def surface_corners(visibility: Visibility, triangles: ArrayLike, barycentric: ArrayLike) -> tuple[Array, Array]:
    """Vertices and weights [..., 3] of points of the surface; weights are NaN where one of them does not exist."""
    index, w = _integers("triangles", triangles), _checks.vectors("barycentric", barycentric)
    if index.shape != w.shape[:-1]:
        raise ValueError(
            f"`triangles` must be integers of the batch shape of `barycentric` {list(w.shape)}; got shape "
            f"{list(index.shape)}."
        )
    count, corners_of = len(visibility.coefficients), visibility.triangles
    if len(corners_of) == 0:
        raise ValueError("`visibility` has no triangles: it is that of points, whose rows are its `coefficients`.")
    _check_range("triangles", index, len(corners_of), "triangles")
    batch = {"index": jnp.asarray(index.astype(np.int32))[..., None], "weights": w}
    corners, w = by_device(_corners, batch, corners_of, count)
    return corners, w.astype(visibility.coefficients.dtype)


@eqx.filter_jit
def _corners(batch: dict[str, Array], triangles: Array, count: int) -> tuple[Array, Array]:
    index, w = batch["index"], batch["weights"]
    corners = triangles[index[..., 0]]
    there = (index >= 0) & (index < len(triangles)) & (corners >= 0) & (corners < count)
    return corners, jnp.where(there, w, np.nan)


def _integers(name: str, value: ArrayLike) -> np.ndarray | Array:
    """Integers as they came: in NumPy where values are known, before JAX may shorten them."""
    array = _known(value)
    array = jnp.asarray(value) if array is None else array
    if not jnp.issubdtype(array.dtype, jnp.integer):
        raise ValueError(f"`{name}` must be integers; got {array.dtype} of shape {list(array.shape)}.")
    return array


@jax.jit
def _interpolated(batch: dict[str, Array], coefficients: Float[Array, "v n"]) -> Float[Array, "*batch n"]:
    return jnp.einsum("...c,...cn->...n", batch["weights"], coefficients[batch["corners"]])


def _known(value: ArrayLike) -> np.ndarray | None:
    """The values on the host, or None while tracing."""
    try:
        return np.asarray(value)
    except jax.errors.TracerArrayConversionError:
        return None


def _check_range(name: str, index: np.ndarray | Array, count: int, of: str) -> None:
    if isinstance(index, np.ndarray) and index.size and (index.min() < 0 or index.max() >= count):
        raise ValueError(f"`{name}` must be in 0 to {count - 1}, for {count} {of}; got {index.min()} to {index.max()}.")


# ---- on the host


def _mesh(vertices: ArrayLike, triangles: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    points, corners = _points("vertices", vertices), np.asarray(triangles)
    if corners.ndim != 2 or corners.shape[1:] != (3,) or len(corners) == 0 or corners.dtype.kind not in "iu":
        raise ValueError(f"`triangles` must be integers [F, 3]; got {corners.dtype} of shape {list(corners.shape)}.")
    _check_range("triangles", corners, len(points), "vertices")
    return points, corners


def _points(name: str, value: ArrayLike) -> np.ndarray:
    points = np.asarray(value, float)
    if points.ndim != 2 or points.shape[1:] != (3,) or len(points) == 0:
        raise ValueError(f"`{name}` must have shape [{name[0].upper()}, 3]; got {list(points.shape)}.")
    if bad := int(np.sum(~np.isfinite(points).all(axis=1))):
        raise ValueError(f"{bad} of `{name}` are not finite.")
    return points


def _scene(points: np.ndarray, corners: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Whether rays from starts [N, 3] along directions [N, 3] hit a triangle; in float32, without gaps at edges."""
    scenes = optional("embreex.rtcore_scene", "the package embreex", "mesh")
    meshes = optional("embreex.mesh_construction", "the package embreex", "mesh")
    scene = scenes.EmbreeScene(robust=True)
    meshes.TriangleMesh(scene=scene, vertices=points.astype(np.float32), indices=corners.astype(np.int32))
    return lambda starts, directions: scene.run(starts.astype(np.float32), directions.astype(np.float32)) != -1


def _normals(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Sums of the triangles around each vertex, weighted by area; zero where they cancel to rounding."""
    a, b, c = np.moveaxis(points[corners], 1, 0)
    normal = np.cross(b - a, c - a)
    normals, areas = np.zeros_like(points), np.zeros((len(points), 1))
    for corner in corners.T:
        np.add.at(normals, corner, normal)
        np.add.at(areas, corner, np.linalg.norm(normal, axis=1, keepdims=True))
    return np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 1e-9 * areas, normals, 0)


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


def _project(
    start: np.ndarray, frames: np.ndarray, local: np.ndarray, blocked: Callable, degree: int, step: Callable
) -> np.ndarray:
    """Coefficients [V, n] of v from rays along the same local directions for every vertex."""
    at_once = 1 << max(0, (_RAYS_AT_ONCE // len(local)).bit_length() - 1)
    rows = []
    for first in range(0, len(start), at_once):
        own = frames[first : first + at_once]
        rays = np.einsum("vij,nj->vni", own, local).reshape(-1, 3)
        hits = blocked(np.repeat(start[first : first + at_once], len(local), axis=0), rays).reshape(len(own), -1)
        more = max(64, 1 << (len(own) - 1).bit_length()) - len(own)  # few sizes are compiled
        hits, turns = np.pad(hits, ((0, more), (0, 0))), np.pad(own, ((0, more), (0, 0), (0, 0)))
        arrays = (jnp.asarray(x, float) for x in (local, turns))
        rows.append(np.asarray(_of_hits(jnp.asarray(hits), *arrays, degree))[: len(own)])
        step(len(own))
    return np.concatenate(rows)


@functools.partial(jax.jit, static_argnames="degree")
def _of_hits(hits: Array, local: Float[Array, "r 3"], frames: Float[Array, "v 3 3"], degree: int) -> Array:
    hidden = weighted_sums(hits.T.astype(local.dtype) * (4 * np.pi / len(local)), local, degree)
    even = (bands(degree) + orders(degree)) % 2 == 0
    hidden = jnp.where(even[:, None], hidden.T, 0)  # n, V
    return (-rotate_many(hidden[:, None], frames, degree)[:, 0].T).at[:, 0].add(math.sqrt(4 * np.pi))


def _npz(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    if path.suffix != ".npz":
        raise ValueError(f"{path}: visibility is stored as .npz; got suffix {path.suffix!r}.")
    return path
