"""Haar wavelets on the sphere: piecewise constant, on nested spherical triangles.

The octants are split at the middles of their edges, again and again; every cell is bounded by great arcs, so that a
polygon's share of it is a polygon too. The parts of a cell are not equal in area. With s_i the coefficient of the
normalised indicator of part i, of area a_i, and u_i = sqrt(a_i / sum a), that of the whole is u . s; the reflection
that takes u to (1, 0, 0, 0) completes it to an orthonormal basis, which for equal areas is the usual one, with entries
+-1/2 (nested triangles: Schroeder and Sweldens 1995).
"""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._module import Module
from shisd._numerics import dot, normalize
from shisd._sharding import by_device
from shisd._typing import Array, ArrayLike, Float
from shisd.domains._polygon import SphericalPolygon, clip, loop_solid_angle, on_sphere
from shisd.domains.moments import Loop


class HaarBasis(Module):
    """Orthonormal Haar wavelets on the octants, split `levels` times (static, from 0): `size` = 8 * 4^levels functions.

    Coefficients [size]: those of the eight octants' normalised indicators first, then three wavelets for every cell,
    from coarse to fine. `triangles` [size, 3, 3] and `areas` [size] in sr are the finest cells, the parts of one cell
    next to each other.
    """

    levels: int = eqx.field(static=True)

    def __init__(self, levels: int):
        self.levels = _checks.integer("levels", levels)

    @property
    def size(self) -> int:
        return 8 * 4**self.levels

    @property
    def triangles(self) -> np.ndarray:
        return _cells(self.levels)

    @property
    def areas(self) -> np.ndarray:
        return _areas(self.triangles)

    def coefficients(self, integrals: ArrayLike) -> Float[Array, "*batch n"]:
        """Coefficients of a function from its integrals over the finest cells, [..., size].

        Derivatives: linear. Cost: 16/3 products for every cell.
        """
        s = self._sized("integrals", integrals)
        s *= jnp.asarray(1 / np.sqrt(self.areas), s.dtype).reshape((1,) * (s.ndim - 1) + (-1,))
        details = []
        for level in reversed(range(self.levels)):
            s = s.reshape(*s.shape[:-1], s.shape[-1] // 4, 4)
            parts = jnp.einsum("...pc,pdc->...pd", s, _reflections(level, s.dtype))
            s = parts[..., 0]
            details.append(parts[..., 1:].reshape(*s.shape[:-1], 3 * s.shape[-1]))
        return jnp.concatenate([s, *reversed(details)], axis=-1)

    def values(self, coefficients: ArrayLike) -> Float[Array, "*batch n"]:
        """Values of an expansion in the finest cells, [..., size]."""
        c = self._sized("coefficients", coefficients)
        s, used = c[..., :8], 8
        for level in range(self.levels):
            cells = 8 * 4**level
            details = c[..., used : used + 3 * cells].reshape(*c.shape[:-1], cells, 3)
            parts = jnp.concatenate([s[..., None], details], axis=-1)
            parts = jnp.einsum("...pc,pdc->...pd", parts, _reflections(level, c.dtype))
            s, used = parts.reshape(*c.shape[:-1], 4 * cells), used + 3 * cells
        return s * jnp.asarray(1 / np.sqrt(self.areas), s.dtype).reshape((1,) * (s.ndim - 1) + (-1,))

    def evaluate(self, coefficients: ArrayLike, directions: ArrayLike) -> Float[Array, "*batch"]:
        """Values of one expansion [size] at directions [..., 3] of any length but zero, which gives NaN.

        On a common edge of cells it is the value of one of them.
        """
        c, d = self._sized("coefficients", coefficients), _checks.vectors("directions", directions)
        if c.ndim != 1:
            raise ValueError(f"`coefficients` must be one expansion [{self.size}]; got {list(c.shape)}. Use jax.vmap.")
        return by_device(_evaluate, {"directions": d}, self, c)

    def _values_at(self, c: Float[Array, " n"], w: Float[Array, "p 3"]) -> Float[Array, " p"]:
        below = (w < 0).astype(jnp.int32)
        cell = 4 * below[:, 2] + 2 * below[:, 1] + below[:, 0]
        for level in range(self.levels):
            inner = jnp.asarray(_cells(level + 1).reshape(-1, 4, 3, 3)[:, 0], w.dtype)[cell]
            out = jnp.einsum("psi,pi->ps", jnp.cross(inner, jnp.roll(inner, -1, 1)), w) < 0
            cell = 4 * cell + jnp.where(jnp.any(out, axis=1), 1 + jnp.argmax(out, axis=1).astype(jnp.int32), 0)
        values = self.values(c)[cell]
        no_direction = jnp.isnan(normalize(w)).any(axis=1)
        return values * jnp.where(no_direction, np.nan, jnp.ones_like(values))

    def project(self, polygon: SphericalPolygon) -> Float[Array, " n"]:
        """Coefficients of the indicator of a polygon that fits in a hemisphere, signed by its winding; exact.

        Derivatives: in the vertices; where an edge of the polygon lies on one of a cell, those of one side.
        Cost: three clips and a solid angle for every finest cell.
        """
        if not isinstance(polygon, SphericalPolygon):
            raise ValueError(f"`polygon` must be a domains.SphericalPolygon; got {type(polygon).__name__}.")
        return _project(self, polygon)

    def _sized(self, name: str, value: ArrayLike) -> Array:
        x = _checks.real_array(name, value)
        if x.ndim == 0 or x.shape[-1] != self.size:
            raise ValueError(f"`{name}` must have shape [..., {self.size}]; got {list(x.shape)}.")
        return x


@eqx.filter_jit
def _evaluate(batch: dict[str, Array], basis: HaarBasis, c: Float[Array, " n"]) -> Float[Array, "*batch"]:
    d = batch["directions"]
    return basis._values_at(c, d.reshape(-1, 3)).reshape(d.shape[:-1])


@eqx.filter_jit
def _project(basis: HaarBasis, polygon: SphericalPolygon) -> Float[Array, " n"]:
    return basis.coefficients(loop_solid_angle(clip_to_cells(polygon.loop(), basis.levels), 2 * np.pi))


def clip_to_cells(v: Loop, levels: int) -> Float[Array, "3 t q"]:
    """The parts of loops [x y z, slot, p] in every finest cell, [x y z, slot, p * cells], cells last."""
    triangles = _cells(levels)
    normals = np.cross(triangles, np.roll(triangles, -1, axis=1))
    count = len(triangles)
    v = jnp.broadcast_to(v[..., None], (*v.shape, count)).reshape(*v.shape[:2], -1)
    for n in np.moveaxis(normals, (1, 2), (0, 1)):
        side = jnp.asarray(np.tile(n, v.shape[2] // count), v.dtype)[:, None]
        v = on_sphere(clip(v, dot(v, side)))
    return v


@functools.cache
def _cells(level: int) -> np.ndarray:
    """Corners [8 * 4^level, 3, 3], counter-clockwise: the inner part of a cell first, then that at each corner.

    The inner part's corner i is opposite to the cell's: its edge from i + 1 to i + 2 cuts off the corner i.
    """
    if level == 0:
        signs = np.array([[(-1.0) ** (i >> k & 1) for k in range(3)] for i in range(8)])
        corners = signs[:, :, None] * np.eye(3)
        odd = np.prod(signs, axis=1) < 0
        corners[odd] = corners[odd][:, ::-1]
        return corners
    a = _cells(level - 1)
    middle = np.roll(a, -1, axis=1) + np.roll(a, -2, axis=1)  # opposite to each corner
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    corner = [np.stack([a[:, i], middle[:, i - 1], middle[:, i - 2]], axis=1) for i in range(3)]
    # out of the edge from inner corner s to s + 1 lies the corner s + 2 of the cell
    return np.stack([middle, corner[2], corner[0], corner[1]], axis=1).reshape(-1, 3, 3)


def _areas(triangles: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(triangles, 1, 0)
    volume = np.sum(a * np.cross(b, c), axis=-1)
    return 2 * np.arctan2(volume, 1 + np.sum(a * b + b * c + c * a, axis=-1))


@functools.cache
def _reflections(level: int, dtype: np.dtype) -> np.ndarray:
    """For each cell of a level the symmetric matrix [4, 4] between its parts and itself with its wavelets."""
    areas = _areas(_cells(level + 1)).reshape(-1, 4)
    u = np.sqrt(areas / areas.sum(axis=1, keepdims=True))
    v = u - np.eye(4)[0]
    return (np.eye(4) - 2 * v[:, :, None] * v[:, None] / np.sum(v * v, axis=1)[:, None, None]).astype(dtype)
