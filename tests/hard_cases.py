"""Polygons and axes on which formulas for spherical polygons fail, one list for every test."""

import numpy as np

SLOTS = 8


def unit(x):
    x = np.asarray(x, float)
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def ring(angles, radii, axis=(0.0, 0.0, 1.0)):
    """Vertices at polar angles `radii` and azimuths `angles` about an axis."""
    z = unit(axis)
    x = unit(np.cross(z, [0.3, -0.5, 0.8]))
    y = np.cross(z, x)
    angles, radii = np.asarray(angles, float)[:, None], np.broadcast_to(radii, len(angles))[:, None]
    return np.cos(radii) * z + np.sin(radii) * (np.cos(angles) * x + np.sin(angles) * y)


def random_polygon(rng, count, size):
    """A star-shaped polygon of the given angular radius, away from slivers."""
    angles = (np.arange(count) + rng.uniform(-0.3, 0.3, count)) * (2 * np.pi / count)
    return ring(angles, size * rng.uniform(0.6, 1.0, count), rng.normal(size=3))


_QUAD = ring([0.2, 1.7, 3.3, 4.9], 0.7, (1, 2, -1))
_STAR = ring(np.arange(8) * np.pi / 4 + 0.1, [0.9, 0.3] * 4, (0.4, -1, 0.6))

POLYGONS = {
    "coincident vertices": np.concatenate([_QUAD[:2], _QUAD[1:2], _QUAD[1:]]),
    "collinear vertices": np.concatenate([_QUAD[:1], unit(_QUAD[:1] + 0.7 * _QUAD[1:2]), _QUAD[1:]]),
    "edge near pi": unit([[1, 0.002, 0], [0, 1, 0.9], [-1, 0.002, 0.001], [0.1, 0.6, -0.5]]),
    "sliver": ring([0, 1e-4, np.pi], [0.5, 0.5, 0.5], (1, 1, 1)),
    "solid angle 1e-8": ring([0.1, 2.2, 4.3], 8.8e-5, (-1, 2, 3)),
    "one degree square": ring([0.3, 1.9, 3.4, 5.0], 0.0175, (2, 1, 0.2)),
    "non-convex": _STAR,
    "clockwise": _QUAD[::-1],
    "near a hemisphere": ring(np.arange(8) * np.pi / 4, 1.5, (1, -1, 0.3)),
}


def padded(vertices):
    """`vertices` in SLOTS slots, so that one compiled function serves all."""
    assert len(vertices) <= SLOTS
    fill = np.repeat(vertices[:1], SLOTS - len(vertices), axis=0)
    return np.concatenate([vertices, fill])


def axes_for(vertices, rng):
    """Axes at random, at a vertex and opposite to one, in an edge's plane and normal to it, and inside."""
    a, b = vertices[0], vertices[1]
    return unit(np.concatenate([
        rng.normal(size=(4, 3)),
        [a, -a, unit(a + 0.3 * b), np.cross(a, b) if np.linalg.norm(np.cross(a, b)) else a, unit(vertices.sum(axis=0))],
    ]))  # fmt: skip
