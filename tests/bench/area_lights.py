"""Radiance from a quad light by other methods than ours, for vector lanes: pixels are the lanes, samples a loop.

Every kernel takes its parameters and a `Scene`: a tile of pixels, each in its own frame, whose z axis is the normal and
whose x axis lies below the view. What is below the horizon counts zero, and so does a light seen from behind. Vectors
are tuples of components, so that one fused loop makes a sample and weighs it. The material has the formula of
models.Ggx.

Samples are a lattice of best P_2 among Korobov's, shifted for every pixel by the R_2 sequence (Cranley and Patterson
1976) and folded by a tent (Hickernell 2002), which for smooth integrands is far ahead of independent numbers.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import legendre

from shisd._numerics import dot
from shisd.domains._integrate import loop_coefficients, zonal_inverse
from shisd.domains._polygon import clip, loop_solid_angle, on_sphere
from shisd.harmonics import _tables, sh_basis
from shisd.shading import _views
from shisd.shading.slices._slices import lookup_table
from tests.bench import sh_rotation
from tests.bench.polygons import line_coefficients

Vector = tuple  # three components


class Scene(NamedTuple):
    """Corners, at any distance, counter-clockwise seen from the pixel's outside; the view is (sine, 0, cosine)."""

    corners: list  # four vectors of [p]
    sine: jax.Array
    cosine: jax.Array
    shift: tuple  # two numbers in [0, 1) for every pixel
    frame: tuple  # its three axes in world space


def shade(kernel: Callable, size: int, parameters, quad, positions, normals, views) -> jax.Array:
    """`kernel(parameters, scene)` for all points [N, 3], `size` at a time: [N]. N is a multiple of `size`."""
    rows = (positions, normals, views)
    rows = [jnp.moveaxis(x.reshape(-1, size, 3), 2, 1) for x in rows]
    index = jnp.arange(len(positions), dtype=jnp.uint32).reshape(-1, size)
    corners = quad[::-1]

    def tile(row):
        position, normal, view, index = row
        z, view = tuple(normal), tuple(view)
        cosine = dot(z, view)
        x, sine = unit_and_length(minus(view, scale(cosine, z)))
        frame = x, cross(z, x), z
        local = [tuple(dot(axis, minus(tuple(c), tuple(position))) for axis in frame) for c in corners]
        local, sine, cosine, frame = jax.lax.optimization_barrier((local, sine, cosine, frame))
        return kernel(parameters, Scene(local, sine, cosine, _shifts(index, position.dtype), frame))

    return jax.lax.map(jax.checkpoint(tile), (*rows, index)).reshape(-1)


def _shifts(index, dtype) -> tuple:
    """The R_2 sequence in fixed point."""
    return tuple((index * np.uint32(step)).astype(dtype) * 2.0**-32 for step in (3242174889, 2447445414))


# ---- vectors


def cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def plus(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scale(s, a: Vector) -> Vector:
    return s * a[0], s * a[1], s * a[2]


def unit_and_length(a: Vector) -> tuple[Vector, jax.Array]:
    """The zero vector stays what it is."""
    length2 = dot(a, a)
    some = length2 > 0
    over = jax.lax.rsqrt(jnp.where(some, length2, 1))
    return scale(over, a), jnp.where(some, length2 * over, 0)


def unit(a: Vector) -> Vector:
    return unit_and_length(a)[0]


def where(condition, a: Vector, b: Vector) -> Vector:
    return tuple(jnp.where(condition, x, y) for x, y in zip(a, b, strict=True))


# ---- materials: f cos, the density of their samples, samples


class Microfacet(NamedTuple):
    alpha: jax.Array
    f0: jax.Array

    def _parts(self, w: Vector, sine, cosine):
        """D, F and 1 / (1 + Lambda) over the cosine, of w and of the view."""
        a2 = self.alpha * self.alpha
        x, y, z = w[0] + sine, w[1], w[2] + cosine
        tangent2, z2 = x * x + y * y, z * z
        length2 = tangent2 + z2
        d = a2 * (length2 / (tangent2 + a2 * z2)) ** 2 / np.pi
        grazing = 1 - jnp.sqrt(length2) / 2
        grazing2 = grazing * grazing
        f = self.f0 + (1 - self.f0) * grazing2 * grazing2 * grazing
        masking = lambda sine2, cosine: 2 / (cosine + jnp.sqrt(cosine * cosine + a2 * sine2))
        return d, f, masking(w[0] * w[0] + w[1] * w[1], w[2]), masking(sine * sine, cosine)

    def cosine_value(self, w: Vector, sine, cosine):
        up = jnp.maximum(w[2], 0)
        d, f, g_w, g_o = self._parts((w[0], w[1], up), sine, cosine)
        return d * f * g_w * g_o * up / 4

    def density(self, w: Vector, sine, cosine):
        d, _, _, g_o = self._parts(w, sine, cosine)
        return d * g_o / 4

    def sample(self, u, v, sine, cosine) -> Vector:
        """Visible normals as spherical caps (Dupuy and Benyoub 2023)."""
        (x, _, z), _ = unit_and_length((self.alpha * sine, jnp.zeros_like(sine), cosine))
        height = (1 - u) * (1 + z) - z
        cap = _polar(height, jnp.sqrt(jnp.maximum(1 - height * height, 0)), v)
        half = unit((self.alpha * (cap[0] + x), self.alpha * cap[1], jnp.maximum(cap[2] + z, 0)))
        along = 2 * (sine * half[0] + cosine * half[2])
        return along * half[0] - sine, along * half[1], along * half[2] - cosine

    def weight(self, w: Vector, sine, cosine):
        _, f, g_w, _ = self._parts(w, sine, cosine)
        return f * g_w * w[2]


def _polar(cosine, sine, v) -> Vector:
    angle = 2 * np.pi * v
    return sine * jnp.cos(angle), sine * jnp.sin(angle), cosine


# ---- sums over samples


@functools.cache
def lattice(count: int) -> np.ndarray:
    """Korobov's points [count, 2] (i/N, i g/N mod 1) with the g of least P_2."""
    i = np.arange(count)
    bernoulli = lambda x: 1 + 2 * np.pi**2 * (x * x - x + 1 / 6)
    points = lambda g: np.stack([i / count, i * g % count / count], axis=1)
    return min((points(g) for g in range(1, count)), key=lambda x: np.sum(np.prod(bernoulli(x), axis=1)))


def _sum(term: Callable, rows: np.ndarray, scene: Scene) -> jax.Array:
    """Sum of term(*row) over rows [S, n]: pixels are the lanes, samples the loop, 5 to 10 times faster than [S, p]."""
    step = jax.checkpoint(lambda total, row: (total + term(*row), None))
    return jax.lax.scan(step, jnp.zeros_like(scene.sine), jnp.asarray(rows, scene.sine.dtype))[0]


def _mean(term: Callable, count: int, scene: Scene) -> jax.Array:
    """Mean of term(u, v) over the lattice, shifted and folded."""
    shifted = lambda u, v: term(_fold(u + scene.shift[0]), _fold(v + scene.shift[1]))
    return _sum(shifted, lattice(count), scene) * (1 / count)


def _fold(x):
    """The tent of the fraction."""
    return 1 - jnp.abs(2 * (x - jnp.floor(x)) - 1)


def gauss_points(side: int, material, scene: Scene):
    """Gauss-Legendre points on the quad, side x side: not Monte Carlo."""
    x, weight = legendre.leggauss(side)
    u, v = (g.reshape(-1) / 2 + 0.5 for g in np.meshgrid(x, x))

    def term(u, v, weight):
        w, solid_angle = patch(u, v, scene.corners)
        return material.cosine_value(w, scene.sine, scene.cosine) * solid_angle * weight

    return _sum(term, np.stack([u, v, np.outer(weight, weight).reshape(-1) / 4], axis=1), scene)


def patch(u, v, corners: list) -> tuple[Vector, jax.Array]:
    """Unit directions to points of the bilinear patch, and solid angles per unit of (u, v)."""
    a, b, c, d = corners
    skew, along_u = minus(plus(a, c), plus(b, d)), minus(b, a)
    along_v = plus(minus(d, a), scale(u, skew))
    position = plus(plus(a, scale(u, along_u)), scale(v, along_v))
    over = jax.lax.rsqrt(dot(position, position))
    volume = dot(position, cross(plus(along_u, scale(v, skew)), along_v))
    return scale(over, position), jnp.maximum(volume, 0) * over * over * over


class _Triangle(NamedTuple):
    b: Vector
    w: Vector  # from the fan's apex towards c
    cosine_ab: jax.Array
    cosine_bw: jax.Array
    volume: jax.Array
    area: jax.Array


class Fan(NamedTuple):
    """Two spherical triangles with a common vertex."""

    a: Vector
    first: _Triangle
    second: _Triangle

    @property
    def solid_angle(self) -> jax.Array:
        return self.first.area + self.second.area


def fan(corners: list) -> Fan:
    a, *rest = (unit(x) for x in corners)

    def triangle(b, c):
        to_b, to_c = minus(b, a), minus(c, a)
        w = unit(minus(to_c, scale(dot(to_c, a), a)))
        normal, ab = cross(a, to_b), dot(a, b)
        area = 2 * jnp.arctan2(dot(to_c, normal), 1 + ab + dot(b, c) + dot(c, a))
        return _Triangle(b, w, ab, dot(b, w), dot(w, normal), jnp.maximum(area, 0))

    return Fan(a, triangle(*rest[:2]), triangle(*rest[1:]))


def fan_direction(u, v, fan: Fan) -> Vector:
    """Directions uniform in solid angle (Arvo 1995), as `polygons.monte_carlo_solid_angle` has them."""
    target = u * fan.solid_angle
    is_first = target < fan.first.area
    b, w, ab, bw, volume, area = jax.tree.map(lambda x, y: jnp.where(is_first, x, y), fan.first, fan.second)
    half = jnp.clip(target - jnp.where(is_first, 0, fan.first.area), 0, area) / 2
    sine, cosine = jnp.sin(half), jnp.cos(half)
    below = volume * cosine - bw * sine
    t = sine * (1 + ab) / jnp.where(below == 0, 1, below)
    moved = scale(1 / (1 + t * t), plus(scale(1 - t * t, fan.a), scale(2 * t, w)))
    chord = minus(moved, b)
    versine = v * dot(chord, chord) / 2
    side = unit(minus(moved, scale(dot(moved, b), b)))
    return plus(scale(1 - versine, b), scale(_root(versine * (2 - versine)), side))


def _root(x):
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), 0)


def by_solid_angle(count: int, material, scene: Scene):
    """Directions uniform in solid angle. No clipping."""
    light = fan(scene.corners)
    value = lambda u, v: material.cosine_value(fan_direction(u, v, light), scene.sine, scene.cosine)
    return light.solid_angle * _mean(value, count, scene)


def by_brdf(count: int, material, scene: Scene):
    """Directions by the material: visible normals, or the cosine."""
    hits = _hits(scene.corners)

    def term(u, v):
        w = material.sample(u, v, scene.sine, scene.cosine)
        return jnp.where(hits(w), material.weight(w, scene.sine, scene.cosine), 0)

    return _mean(term, count, scene)


def by_both(count: int, material, scene: Scene):
    """Half of the samples each way, weighted by the balance heuristic (Veach and Guibas 1995)."""
    light, hits = fan(scene.corners), _hits(scene.corners)
    density = 1 / jnp.maximum(light.solid_angle, 1e-30)
    of = lambda function, w: function(w, scene.sine, scene.cosine)
    value = lambda w: of(material.cosine_value, w) / (density + of(material.density, w))

    def term(u, v):
        w = material.sample(u, v, scene.sine, scene.cosine)
        return value(fan_direction(u, v, light)) + jnp.where(hits(w), value(w), 0)

    return _mean(term, count // 2, scene)


def _hits(corners: list) -> Callable:
    normals = [cross(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    return lambda w: functools.reduce(jnp.logical_and, (dot(w, n) > 0 for n in normals), w[2] > 0)


# ---- closed forms over edges


def clipped_edges(corners: list) -> list:
    """The five edges (start, end) of the part of a convex quad above z = 0, with edges of no length below."""
    leave = enter = (jnp.zeros_like(corners[0][2]),) * 3
    parts = []
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        above, above_next = a[2] > 0, b[2] > 0
        crosses = above != above_next
        part = a[2] / jnp.where(crosses, a[2] - b[2], 1)
        at = a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), jnp.zeros_like(part)
        leave = where(crosses & above, at, leave)
        enter = where(crosses & above_next, at, enter)
        parts.append((a, b, above, above_next, crosses, at))
    edges = []
    for a, b, above, above_next, crosses, at in parts:
        outside = where(crosses, at, leave)
        edges.append((where(above, a, outside), where(above_next, b, outside)))
    return jax.lax.optimization_barrier([*edges, (leave, enter)])  # else XLA makes the clipping again for every use


def form_factor(corners: list):
    """Integral of max(z, 0) / pi over the directions to a convex quad: Lambert's sum over clipped edges."""
    total = 0.0
    for a, b in clipped_edges(corners):
        normal, length = unit_and_length(cross(a, minus(b, a)))
        total += jnp.where(length > 0, jnp.arctan2(length, jnp.where(length > 0, dot(a, b), 1)), 0) * normal[2]
    return jnp.maximum(total, 0) / (2 * np.pi)


def transformed_cosines(table, scene: Scene):
    """Heitz, Dupuy, Hill and Neubelt 2016, clipped exactly; table: `polygons.LtcTable`."""
    rows = jnp.concatenate([table.inverse, table.amplitude[:, None]], axis=1)
    m0, m1, m2, m3, amplitude = _between(rows, jnp.arctan2(scene.sine, scene.cosine) / table.step)
    moved = [(m0 * x + m1 * z, y, m2 * x + m3 * z) for x, y, z in scene.corners]
    return amplitude * form_factor(moved)


def _between(rows, position):
    """A table's rows [V, n], interpolated linearly: [n, p]."""
    lower = jnp.clip(position.astype(jnp.int32), 0, len(rows) - 2)
    t = jnp.clip(position - lower.astype(position.dtype), 0, 1)
    return ((1 - t)[:, None] * rows[lower] + t[:, None] * rows[lower + 1]).T


def gaussians(nodes: int, rows, scene: Scene):
    """Spherical Gaussians, rows [V, 5 J] of axes, logarithms of sharpness and weights at V evenly spaced elevations.

    A lobe's integral over the clipped light is one over azimuths about its axis, edge by edge, since its integral
    over polar angles is closed (Xu et al. 2014): Gauss-Legendre in the azimuth, `nodes` for each edge.
    """
    position = jnp.arctan2(scene.sine, scene.cosine) * (len(rows) / (np.pi / 2)) - 0.5
    numbers = _between(rows, position)
    at = list(zip(*legendre.leggauss(nodes), strict=True))
    edges = [(a, b, unit(cross(a, minus(b, a)))) for a, b in clipped_edges(scene.corners)]
    total = 0.0
    for x, y, z, log_sharpness, weight in numbers.reshape(-1, 5, numbers.shape[1]):
        axis, sharpness = unit((x, y, z)), jnp.exp(log_sharpness)
        lobe = 0.0
        for a, b, normal in edges:
            out = unit(minus(a, scale(dot(a, axis), axis)))
            turn, across = dot(normal, axis), cross(axis, out)
            some = (turn != 0) & (dot(out, out) > 0)
            angle = jnp.where(some, jnp.arctan2(dot(across, b), jnp.where(some, dot(out, b), 1)), 0)
            turn = jnp.where(some, turn, 1)
            for node, share in at:
                azimuth = float(node + 1) / 2 * angle
                slope = -dot(normal, out) * jnp.cos(azimuth) - dot(normal, across) * jnp.sin(azimuth)
                cosine = jnp.sign(turn) * slope * jax.lax.rsqrt(slope * slope + turn * turn)
                lobe -= float(share) / 2 * angle * jnp.expm1(sharpness * (cosine - 1))
        total += weight / sharpness * lobe
    return jnp.where(_faces(scene.corners), total, 0)


def _faces(corners: list):
    a, b, _, d = corners
    return dot(a, cross(minus(b, a), minus(d, a))) > 0


# ---- spherical harmonics: a light's coefficients turned to the local frame; axial moments


class Slices(NamedTuple):
    """What `lookup_table` makes of a material's slices: splines in elevation of the coefficients with m >= 0."""

    table: jax.Array

    def coefficients(self, degree: int, scene: Scene) -> jax.Array:
        view = jnp.stack([scene.sine, jnp.zeros_like(scene.sine), scene.cosine], axis=1)
        order = _tables.orders(degree)[_even(degree)]
        c = self.table @ _views.spline_weights(_views.elevation(view), self.table.shape[1] - 4)
        return jnp.where(jnp.asarray(order > 0)[:, None], scene.sine * c, c)


def slices(material) -> Slices:
    return Slices(lookup_table(material)[_even(material.degree)])


@functools.cache
def _even(degree: int) -> np.ndarray:
    """What a slice seen in the plane y = 0 has: m >= 0."""
    return np.flatnonzero(_tables.orders(degree) >= 0)


def turned_harmonics(degree: int, material: Slices, scene: Scene):
    """The clipped light's coefficients in world space, turned to the local frame, times the slice's.

    As transfer by spherical harmonics does it (Wang and Ramamoorthi 2018; CSH18): exact for the slice, like ours.
    """
    seen = turn(_world_coefficients(degree, scene), scene.frame, degree)
    return jnp.sum(material.coefficients(degree, scene) * seen[_even(degree)], axis=0)


def triple_products(degree: int, parameters, scene: Scene):
    """A portal: the window's coefficients times the distant light, both cut at `degree`, turned, times the slice's.

    Ng et al. 2004 with the product matrix of the light made beforehand. parameters: `Slices`, matrix [n, n].
    """
    material, product = parameters
    seen = turn(product @ _world_coefficients(degree, scene), scene.frame, degree)
    return jnp.sum(material.coefficients(degree, scene) * seen[_even(degree)], axis=0)


def _world_coefficients(degree: int, scene: Scene) -> jax.Array:
    local = jnp.stack([jnp.stack(c) for c in scene.corners], axis=1)
    v = on_sphere(clip(local, local[2]))
    world = jnp.einsum("jip,jsp->isp", jnp.stack([jnp.stack(axis) for axis in scene.frame]), v)
    sign = jnp.where(_faces(scene.corners) & (jnp.max(local[2], axis=0) > 0), 1, 0)
    return sign.astype(v.dtype) * loop_coefficients(world, loop_solid_angle(world, 2 * np.pi), degree)


def turn(c: jax.Array, frame: tuple, degree: int) -> jax.Array:
    """World to local coefficients [n, p], frame = (x, y, z) in world space."""
    return sh_rotation.rotated(c[:, None], jnp.stack([jnp.stack(axis) for axis in frame]), degree)[:, 0]


def axial(degree: int, material: Slices, scene: Scene):
    """CSH18: moments of cosine powers at 2L+1 axes, from them zonal moments, harmonics, and the product with the slice.

    The best axes we know; powers of the cosine, as published, so that digits vanish with the degree.
    """
    edges = [(unit(a), unit(b)) for a, b in clipped_edges(scene.corners)]
    value = jnp.sum(material.coefficients(degree, scene) * axial_coefficients(edges, degree, _even(degree)), axis=0)
    return jnp.where(_faces(scene.corners), value, 0)


def axial_coefficients(edges: list, degree: int, rows: np.ndarray) -> jax.Array:
    """Integrals of the basis [rows, p] over outlines given by their edges, as `polygons.axial_moments` has it."""
    axes, inverse = zonal_inverse(degree, np.float32)
    d = tuple(jnp.asarray(x[:, None]) for x in axes.T)
    area = [solid_angle(edges)[None] * jnp.ones_like(d[0])] + [0.0] * degree
    for a, b in edges:
        normal, sine = unit_and_length(cross(a, minus(b, a)))
        cosine = jnp.where(sine > 0, dot(a, b), 1)
        theta = jnp.where(sine > 0, jnp.arctan2(sine, cosine), 0)
        u0, u1, g, slope0 = (dot(tuple(x[None] for x in y), d) for y in (a, b, normal, cross(normal, a)))
        slope1 = slope0 * cosine - u0 * sine
        along = [theta[None] * jnp.ones_like(u0), slope0 - slope1]
        power0, power1, outside = u0, u1, 1 - g * g
        for n in range(2, degree):
            ends = power1 * slope1 - power0 * slope0
            along.append(((n - 1) * outside * along[n - 2] - ends) * (1 / n))
            power0, power1 = power0 * u0, power1 * u1
        area = [area[0], *(area[n] + g * along[n - 1] for n in range(1, degree + 1))]
    for n in range(1, degree + 1):
        area[n] = (area[n] + ((n - 1) * area[n - 2] if n > 1 else 0)) * (1 / (n + 1))
    result = []
    for l in range(degree + 1):
        powers = legendre.leg2poly(np.eye(degree + 1)[l])
        zonal = sum(float(powers[n]) * area[n] for n in range(l % 2, l + 1, 2))
        own = rows[(rows >= l * l) & (rows < (l + 1) ** 2)] - l * l
        result.append(jnp.asarray(inverse[l][own]) @ zonal)
    return jnp.concatenate(result)


def solid_angle(edges: list) -> jax.Array:
    apex = edges[0][0]
    angle = lambda a, b: jnp.arctan2(dot(apex, cross(a, minus(b, a))), 1 + dot(apex, a) + dot(a, b) + dot(b, apex))
    return 2 * sum(angle(a, b) for a, b in edges[1:])


# ---- portals


class Lit(NamedTuple):
    """A material times the radiance that comes from afar, looked up by the direction in world space."""

    material: Microfacet
    texels: jax.Array
    frame: tuple

    def cosine_value(self, w: Vector, sine, cosine):
        x, y, z = self.frame
        world = plus(plus(scale(w[0], x), scale(w[1], y)), scale(w[2], z))
        return self.material.cosine_value(w, sine, cosine) * lookup(self.texels, world)


def portal(kernel: Callable, count: int, parameters, scene: Scene):
    material, texels = parameters
    return kernel(count, Lit(material, texels, scene.frame), scene)


def octahedron(size: int) -> np.ndarray:
    """Directions [size^2, 3] of a grid, the corners of its cells, over the unfolded octahedron."""
    u, v = np.meshgrid(*[np.linspace(-1, 1, size)] * 2, indexing="ij")
    z = 1 - np.abs(u) - np.abs(v)
    fold = np.maximum(-z, 0)
    d = np.stack([u - np.where(u > 0, 1, -1) * fold, v - np.where(v > 0, 1, -1) * fold, z], axis=-1).reshape(-1, 3)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def lookup(texels: jax.Array, w: Vector) -> jax.Array:
    """Bilinear, texels [size^2] at `octahedron(size)`."""
    size = int(np.sqrt(len(texels)))
    over = 1 / (jnp.abs(w[0]) + jnp.abs(w[1]) + jnp.abs(w[2]))
    u, v = w[0] * over, w[1] * over
    sign = lambda x: jnp.where(x > 0, 1, -1).astype(x.dtype)
    below = w[2] < 0
    u, v = jnp.where(below, (1 - jnp.abs(v)) * sign(u), u), jnp.where(below, (1 - jnp.abs(u)) * sign(v), v)
    u, v = (u + 1) * ((size - 1) / 2), (v + 1) * ((size - 1) / 2)
    i, j = (jnp.clip(x.astype(jnp.int32), 0, size - 2) for x in (u, v))
    s, t = u - i.astype(u.dtype), v - j.astype(v.dtype)
    at = i * size + j
    mix = lambda at: (1 - t) * texels[at] + t * texels[at + 1]
    return (1 - s) * mix(at) + s * mix(at + size)


# ---- projection on harmonics


def project(kernel: Callable, size: int, parameters, quad, positions) -> jax.Array:
    """`kernel(corners, shift)` [size, n] for all positions [N, 3], `size` at a time; corners as in a `Scene`."""
    index = jnp.arange(len(positions), dtype=jnp.uint32).reshape(-1, size)

    def tile(row):
        position, index = row
        corners = [tuple(c[i] - position[:, i] for i in range(3)) for c in quad[::-1]]
        return kernel(corners, _shifts(index, position.dtype))

    values = jax.lax.map(jax.checkpoint(tile), (positions.reshape(-1, size, 3), index))
    return values.reshape(-1, values.shape[-1])


def project_points(degree: int, count: int, gauss: bool, corners: list, shift: tuple) -> jax.Array:
    """Harmonics at points on the light: Gauss-Legendre, count = side^2, or a lattice uniform in solid angle."""
    if gauss:
        x, weight = legendre.leggauss(int(np.sqrt(count)))
        u, v = (g.reshape(-1, 1) / 2 + 0.5 for g in np.meshgrid(x, x))
        weight = jnp.asarray(np.outer(weight, weight).reshape(-1, 1) / 4, shift[0].dtype)
        w, weight_of = patch(*(jnp.asarray(x, shift[0].dtype) for x in (u, v)), corners)
        weight = weight * weight_of
    else:
        u, v = (_fold(jnp.asarray(x[:, None], s.dtype) + s) for x, s in zip(lattice(count).T, shift, strict=True))
        light = fan(corners)
        w, weight = fan_direction(u, v, light), light.solid_angle / count * jnp.ones_like(u)
    y = sh_basis(jnp.stack(w, axis=-1), degree)
    return jnp.einsum("sp,spn->pn", weight, y)


def project_lines(degree: int, corners: list, shift: tuple) -> jax.Array:
    """`polygons.line_coefficients`, and the solid angle for l = 0."""
    v = [unit(c) for c in corners]
    c = line_coefficients(jnp.stack([jnp.stack(x) for x in v], axis=1), degree)
    angle = solid_angle(list(zip(v, v[1:] + v[:1], strict=True)))
    return c.at[:, 0].set(angle * np.sqrt(1 / (4 * np.pi)))


def project_axial(degree: int, corners: list, shift: tuple) -> jax.Array:
    v = [unit(c) for c in corners]
    return axial_coefficients(list(zip(v, v[1:] + v[:1], strict=True)), degree, np.arange((degree + 1) ** 2)).T
