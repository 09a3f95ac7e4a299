"""Input on which formulas fail, one list for every test: directions, axes, polygons, scenes, materials, lights.

Every case that has a name here is a row of tests/bench/stability.py.
"""

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


# ---- harmonics: directions [N, 3] of any length, and the degree

_NEAR = ring(np.arange(6) + 0.2, 1e-4)
_AROUND = unit(np.random.default_rng(7).normal(size=(6, 3)))
HARMONICS = {
    "both poles": (np.array([[0.0, 0, 1], [0, 0, -1]]), 32),
    "1e-4 rad from the poles": (np.concatenate([_NEAR, -_NEAR]), 32),
    "1e-4 rad from the poles, degree 8": (np.concatenate([_NEAR, -_NEAR]), 8),
    "degree 100": (np.concatenate([_AROUND, _NEAR]), 100),
    "degree 200": (np.concatenate([_AROUND, _NEAR]), 200),
    "vectors of length 1e-30": (1e-30 * _AROUND, 16),
    "zero vector": (np.zeros((1, 3)), 16),
}


# ---- sets of axes


def axis_sets(degree):
    """Sets of axes by name; the last two can be resolved, in exact arithmetic and up to rounding."""
    count, spread = 2 * degree + 1, np.random.default_rng(3).normal(size=(2 * degree + 3, 3))
    spread, turn = unit(spread), 2 * np.pi * np.arange(count) / count
    circle = lambda z: np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z + 0 * turn], 1)
    close = unit(spread[:1] + 1e-4 * spread[1:2])
    return {
        "two equal axes": np.concatenate([spread[:1], spread[: count - 1]]),
        "two opposite axes": np.concatenate([-spread[:1], spread[: count - 1]]),
        "all axes in a plane": circle(0.0),
        "2L+1 axes on a circle": circle(0.6),
        "two axes 1e-4 rad apart": np.concatenate([close, spread[: count - 1]]),
        "two equal axes, enough others": np.concatenate([spread[:1], spread]),
    }


# ---- polygons beyond those above


BEYOND_A_HEMISPHERE = ring(np.arange(8) * np.pi / 4, 1.9, (1, -1, 0.3))
OPPOSITE_VERTICES = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, -1]])[[0, 2, 3]]  # an edge of exactly pi
_FLAT = unit([[1, 0.2, 0], [0.3, 1, 0], [0.1, 0.3, 1]])  # its first edge is in the plane z = 0
AXES_AT_POLYGONS = {
    "vertex at the axis": (_QUAD, _QUAD[0]),
    "vertex opposite to the axis": (_QUAD, -_QUAD[0]),
    "axis in the plane of an edge": (_FLAT, unit([-0.4, 1, 0])),
    "axis on an edge": (_FLAT, unit([1, 1, 0])),
    "axis normal to an edge": (_FLAT, np.array([0.0, 0, 1])),
}


def _near_half_turn(gap):
    return unit([[1, 0, 0], [-np.cos(gap), np.sin(gap), 0], [0, 0.3, 1]]) @ _TURN


def _corner(legs):
    return unit([[0, 0, 1], [legs, 0, 1], [0, legs, 1]]) @ _TURN


_TURN = ring([0, np.pi / 2], np.pi / 2, (1, 2, 3))
_TURN = np.concatenate([_TURN, np.cross(_TURN[:1], _TURN[1:])])  # a rotation
HALF_TURNS = {f"edge {gap:.0e} rad short of pi": _near_half_turn(gap) for gap in 10.0 ** -np.arange(1, 7)}
TINY = {f"solid angle {legs**2 / 2:.0e}": _corner(legs) for legs in (2e-3, 2e-4, 2e-5, 2e-6)}


# ---- shading by a polygon: points of the light, and position, normal and view of the surface


_LIGHT = [[-0.5, -0.5, 1.0], [-0.5, 0.5, 1.25], [0.5, 0.5, 1.25], [0.5, -0.5, 1.0]]  # emits downwards
_LIGHT_NEAR = [[-0.5, -0.5, 1e-4], [-0.5, 0.5, 1e-4], [0.5, 0.5, 1e-4], [0.5, -0.5, 1e-4]]
_DENTED = [[-0.5, -0.5, 1.0], [0, -0.25, 1.0], [-0.5, 0.5, 1.0], [0.5, -0.5, 1.0]]
_UP, _ORIGIN, _ASIDE = [0.0, 0, 1], [0.0, 0, 0], [0.375, -0.25, 0.625]
_WALL = [[1, -0.5, 0.25], [1, -0.5, 1], [1, 0.75, 0.75], [1, 0.75, 0.5]]  # faces the origin
_SCENE = _ORIGIN, _UP, _ASIDE
_GRAZING = [np.sin(np.radians(89.9)), 0.0, np.cos(np.radians(89.9))]
SHADING = {
    "light straddling the horizon": ([[1, -0.5, -0.75], [1, -0.5, 0.75], [1, 0.5, 1], [1, 0.75, -0.5]], *_SCENE),
    "light with an edge on the horizon": ([[1, -0.5, 0], [1.25, -0.5, 0.75], [1.125, 0.5, 1], [1, 0.5, 0]], *_SCENE),
    "light with a corner on the horizon": ([[1, 0, 0], [1.25, -0.5, 0.75], [1.125, 0.25, 1], [1, 0.5, 0.25]], *_SCENE),
    "light wholly below the horizon": ([[1, -0.5, -0.75], [1, -0.5, -0.25], [1, 0.5, -0.25], [1, 0.5, -0.5]], *_SCENE),
    "point in the light's plane": ([[1, 0, 0.25], [2, 0, 0.25], [2, 0, 1], [1, 0, 1.5]], *_SCENE),
    "point 1e-4 away from the light": (_LIGHT_NEAR, *_SCENE),
    "clockwise light, seen from behind": (_LIGHT[::-1], *_SCENE),
    "non-convex light": (_DENTED, *_SCENE),
    "view 89.9 degrees from the normal, light beside the lobe": (_WALL, _ORIGIN, _UP, _GRAZING),
    "view at the normal, polygon": (_WALL, _ORIGIN, _UP, _UP),
    "view at a normal off the axes": (_WALL, _ORIGIN, [-0.25, 0.125, 1.0], [-0.25, 0.125, 1.0]),
}


# ---- materials: alpha of GGX (0.02^2 is what a metallic-roughness material of roughness 0.02 has), and directions


def _polar(degrees, azimuth=0.0):
    theta = np.radians(degrees)
    return np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])


MATERIALS = {  # alpha, wi, wo
    "roughness 0.02, in the lobe": (0.02, _polar(41.0, np.pi + 0.01), _polar(40.0)),
    "roughness 0.02, far from the lobe": (0.02, _polar(20.0, 1.0), _polar(40.0)),
    "roughness 0.02 squared, in the lobe": (0.0004, _polar(40.02, np.pi + 3e-4), _polar(40.0)),
    "roughness 1": (1.0, _polar(20.0, 1.0), _polar(40.0)),
    "view 89.9 degrees from the normal": (0.5, _polar(70.0, 2.0), _polar(89.9)),
    "view 89.9 degrees from the normal, roughness 0.02": (0.02, _polar(89.0, 3.12), _polar(89.9)),
    "view and light at the normal": (0.3, _polar(0.0), _polar(0.0)),
}


# ---- distant light: texels [H, 2H]


def _texels(sky, **points):
    texels = np.full((16, 32), sky)
    for at, value in points.values():
        texels[at] = value
    return texels


LIGHTS = {
    "sun of 3e4 over a sky of 0.5": _texels(0.5, sun=((4, 9), 3e4)),
    "all black": _texels(0.0),
    "one texel": _texels(0.0, spot=((7, 20), 1.0)),
    "one texel at the zenith": _texels(0.0, spot=((0, 3), 1.0)),
}
BAD_TEXELS = _texels(0.5, nan=((2, 3), np.nan), infinite=((5, 6), np.inf), bright=((8, 1), 20.0))
