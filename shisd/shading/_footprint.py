"""Footprints of pixels on mirrors: mirror directions, and how they spread over a pixel's filter (ISD15 Eq. 26-27).

A pixel sees the light from the mirror directions r(p + d) over offsets d with a Gaussian weight. To first order r moves
by J d, so the footprint is a Gaussian of covariance C = s^2 J J^T on the tangent plane at r. Unlike in ISD15 Eq. 27, J
has the change of the view as well.

notation: n = normal, o = direction to the eye, x = position, p = (column, row); S = shape operator, dn = -S dx; s =
standard deviation of the pixel's filter.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._module import Module
from shisd._numerics import normalize
from shisd._typing import Array, ArrayLike, Float
from shisd.shading._frames import frame

_OFF_PLANE = 0.5  # sine of the angle to either tangent plane from which on a neighbour is on another surface
_RIDGE = 1e-5  # relative, of least squares: what no neighbour tells becomes 0
_NEIGHBOURS = np.array([(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1) if i or j])  # columns, rows


def _axes(name: str, value: ArrayLike) -> Array:
    axes = _checks.real_array(name, value)
    if axes.shape[-2:] != (3, 2):
        raise ValueError(f"`{name}` must have shape [..., 3, 2]; got {list(axes.shape)}.")
    return axes


class Footprint(Module):
    """Mirror directions of pixels, and how these spread over the pixel's filter, a Gaussian.

    `directions` [..., 3], unit; `axes` [..., 3, 2], the change of direction over one standard deviation of the filter
    along columns and rows, in rad, tangent to the sphere: axes axes^T is the covariance of directions.
    """

    directions: Float[Array, "*batch 3"] = eqx.field(converter=functools.partial(_checks.vectors, "directions"))
    axes: Float[Array, "*batch 3 2"] = eqx.field(converter=functools.partial(_axes, "axes"))

    @classmethod
    def from_derivatives(
        cls,
        normals: ArrayLike,
        positions: ArrayLike,
        eye: ArrayLike,
        normal_derivatives: ArrayLike,
        position_derivatives: ArrayLike,
        *,
        filter_width: ArrayLike = 0.5,
    ) -> "Footprint":
        """Footprints where normals and positions are known as functions of the pixel.

        Arguments: `normals` and `positions` [..., 3], normals of any length; `eye` [3]; their derivatives by column and
        row of the picture [..., 3, 2]; `filter_width`, standard deviation of the pixel's filter in pixels.
        Derivatives: in all of these, exact. A zero normal, or a position at the eye, gives NaN.
        """
        n, x = _checks.vectors("normals", normals), _checks.vectors("positions", positions)
        dn = _axes("normal_derivatives", normal_derivatives)
        dx = _axes("position_derivatives", position_derivatives)
        e, width = _eye(eye), _checks.scalar("filter_width", filter_width)
        try:
            shape = np.broadcast_shapes(n.shape, x.shape, dn.shape[:-1], dx.shape[:-1])
        except ValueError as error:
            shapes = ", ".join(str(list(a.shape)) for a in (n, x, dn, dx))
            raise ValueError(f"normals, positions and their derivatives do not broadcast: {shapes}.") from error
        dtype = jnp.result_type(n, x, dn, dx, e, width)
        n, x, e = (jnp.broadcast_to(a.astype(dtype), shape) for a in (n, x, e))
        dn, dx = (jnp.broadcast_to(a.astype(dtype), (*shape, 2)) for a in (dn, dx))
        return _footprint(n, x, e, dn, dx, width.astype(dtype))


def footprint(
    normals: ArrayLike, positions: ArrayLike, eye: ArrayLike, seen: ArrayLike, *, filter_width: ArrayLike = 0.5
) -> Footprint:
    """Footprints of the pixels of a picture of mirrors, from its images of normals and positions.

    The shape operator is fitted to the normals and positions of a pixel and its seen neighbours, as a symmetric matrix
    on the tangent plane. A neighbour that lies off either tangent plane by more than 30 degrees is on another surface
    and left out: with no neighbour left the mirror is flat. How positions change follows from the tangent plane and the
    rays of the seen neighbours, whatever surface they meet. What no neighbour tells is taken as 0: a pixel that is seen
    alone has no footprint.

    Arguments: `normals`, of any length, and `positions` [H, W, 3]; `eye` [3], in the positions' units; `seen` [H, W],
    bool: what the images hold elsewhere does not matter; `filter_width`, standard deviation of the pixel's filter in
    pixels. Unseen pixels get the direction -z and no footprint. A zero normal, a NaN and a surface seen exactly edge-on
    give NaN at this pixel, a position that is NaN also at its neighbours.
    Derivatives: in normals, positions, eye and width, both modes, also of flat mirrors. Which neighbours are left out
    is a discontinuity, with no gradient.
    Accuracy: second order in the size of a pixel inside a surface, first order at its border. What is linear in the
    offset is not exact: at a silhouette, and where normals turn unevenly within a pixel, footprints are too wide.
    Source: ISD15 Eq. 27, ISD15s section 5; the symmetric fit in closed form is R. A. Smith's for A X + X A = M (1966).
    """
    n, x = _checks.vectors("normals", normals), _checks.vectors("positions", positions)
    e, width, mask = _eye(eye), _checks.scalar("filter_width", filter_width), jnp.asarray(seen)
    if mask.dtype != bool or mask.ndim != 2 or n.shape != x.shape or mask.shape != n.shape[:-1]:
        raise ValueError(
            "`normals` and `positions` must have shape [H, W, 3] and `seen` [H, W], bool; got "
            f"{list(n.shape)}, {list(x.shape)} and {list(mask.shape)}, {mask.dtype}."
        )
    dtype = jnp.result_type(n, x, e, width)
    return _from_images(n.astype(dtype), x.astype(dtype), e.astype(dtype), mask, width.astype(dtype))


def _eye(eye: ArrayLike) -> Float[Array, "3"]:
    e = _checks.vectors("eye", eye)
    if e.ndim != 1:
        raise ValueError(f"`eye` must have shape [3]; got {list(e.shape)}.")
    return e


@jax.jit
def _footprint(n: Array, x: Array, eye: Array, dn: Array, dx: Array, width: Array) -> Footprint:
    def mirrored(n: Array, x: Array) -> Array:
        n, o = normalize(n), normalize(eye - x)
        return 2 * jnp.sum(n * o, axis=-1, keepdims=True) * n - o

    (r, by_column), (_, by_row) = (jax.jvp(mirrored, (n, x), (dn[..., i], dx[..., i])) for i in range(2))
    return Footprint(r, width * jnp.stack([by_column, by_row], axis=-1))


@jax.jit
def _from_images(
    n: Float[Array, "h w 3"], x: Float[Array, "h w 3"], eye: Float[Array, "3"], seen: Array, width: Array
) -> Footprint:
    away, eye = jnp.asarray([[[0, 0, 1]]], n.dtype), eye[None, None]
    n, x = (jnp.where(seen[..., None], a, b) for a, b in ((n, away), (x, eye + away)))
    n = normalize(n)
    distance = jnp.sqrt(jnp.sum((x - eye) ** 2, axis=-1, keepdims=True))
    ray = (x - eye) / distance
    near = seen[None] & _around(seen)
    only = lambda where, a: jnp.where(where[..., None], a, 0)
    images = jnp.concatenate([n, x, ray], axis=-1)
    around = _around(images)
    turn, step, tilt = jnp.split(around - images[None], 3, axis=-1)

    # rays by pixel; the matrix holds small integers
    p, weight = jnp.asarray(_NEIGHBOURS, n.dtype), near.astype(n.dtype)
    matrix = jnp.einsum("khw,ki,kj->hwij", weight, p, p)
    d_ray = jnp.einsum("khwc,ki->hwci", only(near, tilt), p) @ _ridge_inverse(matrix)
    slope = jnp.sum(n[..., None] * d_ray, axis=-2, keepdims=True) / jnp.sum(n * ray, axis=-1)[..., None, None]
    dx = distance[..., None] * (d_ray - ray[..., None] * slope)

    # shape operator
    off = lambda n: jnp.sum(n * step, axis=-1) ** 2
    same = near & (jnp.maximum(off(n[None]), off(around[..., :3])) <= _OFF_PLANE**2 * jnp.sum(step**2, axis=-1))
    tangents = frame(n.reshape(-1, 3))[..., :2].reshape(*n.shape, 2)
    step, turn = (jnp.einsum("khwc,hwci->khwi", only(same, a), tangents) for a in (step, turn))
    product = lambda a: jnp.einsum("khwi,khwj->hwij", a, step)
    s = _symmetric(product(step), -product(turn))
    dn = -tangents @ (s @ (jnp.swapaxes(tangents, -1, -2) @ dx))
    return _footprint(n, x, jnp.broadcast_to(eye, x.shape), dn, dx, width)


def _around(image: Array) -> Array:
    """Images shifted so that each pixel has its neighbours, in the order of `_NEIGHBOURS`; beyond the picture zeros."""
    h, w = image.shape[:2]
    padded = jnp.pad(image, ((1, 1), (1, 1), *[(0, 0)] * (image.ndim - 2)))
    return jnp.stack([padded[1 + j : 1 + j + h, 1 + i : 1 + i + w] for i, j in _NEIGHBOURS])


def _adjugate(a: Array) -> tuple[Array, Array, Array]:
    """Adjugate, determinant and trace of matrices [..., 2, 2]."""
    trace, det = a[..., :1, :1] + a[..., 1:, 1:], a[..., :1, :1] * a[..., 1:, 1:] - a[..., :1, 1:] * a[..., 1:, :1]
    return trace * jnp.broadcast_to(jnp.eye(2, dtype=a.dtype), a.shape) - a, det, trace


def _ridge_inverse(a: Array) -> Array:
    """(A + r)^-1 = (adj A + r) / (det A + r tr A + r^2): a determinant of integers is exact, also where it is 0."""
    adjugate, det, trace = _adjugate(a)
    return (adjugate + _ridge(a)) / (det + _RIDGE * trace + _RIDGE**2)


def _ridge(a: Array) -> Array:
    return jnp.broadcast_to(jnp.asarray(_RIDGE * np.eye(2), a.dtype), a.shape)


def _symmetric(g: Array, b: Array) -> Array:
    """The symmetric S of least sum |S a - b|^2: S G + G S = B + B^T with the sums G of a a^T and B of b a^T.

    In the plane, S = (det(G) M + adj(G) M adj(G)) / (2 tr(G) det(G)) for the right side M.
    """
    trace = g[..., :1, :1] + g[..., 1:, 1:]
    scale = jnp.where(trace > 0, trace, 1)
    m = (b + jnp.swapaxes(b, -1, -2)) / scale
    adjugate, det, trace = _adjugate(g / scale + _ridge(g))
    return (det * m + adjugate @ m @ adjugate) / (2 * trace * det)
