"""Radiance under polygons and distant light, of expansions and of materials, with derivatives."""

import functools
import math

import numpy as np

from tests.truth._derivatives import derivative
from tests.truth._harmonics import harmonics, scipy_basis
from tests.truth._materials import ggx_cosine
from tests.truth._polygons import edge_coefficients, triangle_rule
from tests.truth._vectors import frame_of, tangential


def outline_above(points, position, frame):
    """Unit vertices of what is above the horizon, by plain clipping; None if nothing is, or from behind."""
    emits = np.sum(np.cross(points - points[:1], np.roll(points, -1, 0) - points[:1]), axis=0)
    if emits @ (position - points[0]) <= 0:
        return None
    local, kept = (points - position) @ frame.T, []
    for a, b in zip(local, np.roll(local, -1, axis=0), strict=True):
        kept += [a] if a[2] > 0 else []
        kept += [a + (b - a) * (a[2] / (a[2] - b[2]))] if (a[2] > 0) != (b[2] > 0) else []
    return np.stack([p / np.sqrt(p @ p) for p in kept]) if kept else None


def polygon_radiance(scene, slice_of, material):
    """Radiance of an expansion and of the material itself from a polygon of radiance 1, by area quadrature.

    scene: points, position, normal and view; slice_of(view in the frame): coefficients; material(wi [Q, 3], wo).
    """
    points, position, normal, view = (np.asarray(x, np.longdouble) for x in scene)
    frame = frame_of(normal)
    outline, wo = outline_above(points, position, frame), _local(frame, view)
    if outline is None:
        return 0.0, 0.0
    w, area = triangle_rule(outline, 32)
    c = np.asarray(slice_of(wo), float)
    return -area @ (harmonics(w, _degree_of(c))[0] @ c), -area @ material(w.astype(float), wo)


def polygon_slopes(scene, slice_of, *, step=1e-4, touching=False):
    """Derivatives of an expansion's radiance along random motions: (argument of the scene, motion, derivative).

    touching: of an outline whose points at z = 0 are on the horizon, on the side on which it is cut off.
    """
    points, position, normal, view = (np.asarray(x, np.longdouble) for x in scene)
    coefficients = lambda frame, view: np.asarray(slice_of(_local(frame, view)), float)
    frame = frame_of(normal)
    c = coefficients(frame, view)

    def integrals(points, position, normal):
        outline = outline_above(points, position, frame_of(normal))
        return np.zeros(len(c), np.longdouble) if outline is None else -edge_coefficients(outline, _degree_of(c))

    slope = functools.partial(derivative, forward=touching)
    rng, tries = np.random.default_rng(6), []
    b = integrals(points, position, normal)
    for _ in range(2):
        move = rng.normal(size=points.shape)
        lower = touching & (points[:, 2] == 0)
        move[lower, 2] = -np.abs(move[lower, 2])
        tries.append((0, move, slope(lambda t, m=move: integrals(points + t * m, position, normal) @ c, step)))
        move = rng.normal(size=3)
        move[2] = np.abs(move[2]) if touching else move[2]
        tries.append((1, move, slope(lambda t, m=move: integrals(points, position + t * m, normal) @ c, step)))
        move = tangential(rng, normal)
        if touching:
            move = 0.3 * move - np.sum(points[lower], axis=0).astype(float)
        turned = lambda t, m=move: frame_of(normal + t * m)
        # the slice is known in float64 only: its part takes a longer step
        change = slope(lambda t, m=move: integrals(points, position, normal + t * m) @ c, step)
        change += derivative(lambda t, turned=turned: b @ coefficients(turned(t), view), 1e-4)
        tries.append((2, move, change))
        move = tangential(rng, view)
        tries.append((3, move, derivative(lambda t, m=move: b @ coefficients(frame, view + t * m), 1e-4)))
    return tries


def ggx_radiance(alpha, normal, view, light):
    """Radiance of `ggx_cosine` under light(w), by a product rule over the hemisphere, and its derivatives.

    Derivatives in alpha, normal and view (arguments 0, 1, 2): (argument, motion, derivative).
    """
    count = 600 if alpha < 0.1 else 200
    x, weights = np.polynomial.legendre.leggauss(count)
    z, phi = (x + 1) / 2, (np.arange(2 * count) + 0.5) * np.pi / count
    sine = np.sqrt(1 - z * z)[:, None]
    wi = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.broadcast_to(z[:, None], (count, len(phi)))], axis=-1)
    wi, area = wi.reshape(-1, 3), np.repeat(weights / 2 * np.pi / count, len(phi))

    def radiance(alpha, normal, view):
        frame = frame_of(normal).astype(float)
        wo = _local(frame, view)
        return np.sum(area * ggx_cosine(wi, wo, alpha) * light(wi @ frame))

    rng, step = np.random.default_rng(8), 0.01 * min(alpha, 0.1)
    tries = [(0, 1.0, derivative(lambda t: radiance(alpha + t, normal, view), step))]
    for argument in (1, 2):
        move = tangential(rng, (normal, view)[argument - 1])
        moved = (
            (lambda t, m=move: radiance(alpha, normal + t * m, view)) if argument == 1
            else (lambda t, m=move: radiance(alpha, normal, view + t * m))
        )  # fmt: skip
        tries.append((argument, move, derivative(moved, min(step, 5e-4))))
    return radiance(alpha, normal, view), tries


def map_coefficients(texels, degree):
    """Coefficients of a map that is constant on each texel, by a Gauss rule in each."""
    height, width = texels.shape
    x, weights = np.polynomial.legendre.leggauss(8)
    theta, phi = (np.pi / height * (np.arange(n)[:, None] + (x + 1) / 2).reshape(-1) for n in (height, width))
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None]
    w = np.stack(np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), cosine), axis=-1)
    area = np.outer(np.tile(weights, height) * np.sin(theta), np.tile(weights, width)) * (np.pi / height / 2) ** 2
    values = np.repeat(np.repeat(texels, 8, axis=0), 8, axis=1)
    return (values * area).reshape(-1) @ scipy_basis(w.reshape(-1, 3), degree)


def environment_radiance(slice_of, e, normals, views):
    """Radiance [P] of slices, slice_of(views in their frames [P, 3]), under light `e`, by an exact product rule."""
    degree = _degree_of(e)
    x, weights = np.polynomial.legendre.leggauss(degree + 2)
    phi = 2 * np.pi * np.arange(2 * degree + 2) / (2 * degree + 2)
    sine, cosine = np.sqrt(1 - x * x)[:, None], x[:, None]
    w = np.stack(np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), cosine), axis=-1).reshape(-1, 3)
    area = np.repeat(weights * 2 * np.pi / len(phi), len(phi))
    frames = np.stack([frame_of(n) for n in normals]).astype(float)
    slices = np.asarray(slice_of(np.einsum("pij,pj->pi", frames, np.asarray(views, float))))
    lobe = slices @ scipy_basis(w, degree).T
    light = scipy_basis(np.einsum("qi,pij->pqj", w, frames), degree) @ e
    return np.sum(area * lobe * light, axis=1)


def _local(frame, view):
    return (frame @ view / np.sqrt(view @ view)).astype(float)


def _degree_of(c):
    return math.isqrt(len(c)) - 1
