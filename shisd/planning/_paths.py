"""The ways from a material and a light to radiance: what each leaves out, its cost, and the call."""

import abc
import functools
import math
from collections.abc import Iterable
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from shisd._module import Module
from shisd._numerics import normalize, tangents
from shisd._sharding import by_device
from shisd._typing import Array, Float
from shisd.decomposition import fibonacci_directions
from shisd.harmonics import convolve, evaluate
from shisd.models import DistantLight, PolygonLight, PortalLight, ZonalLight
from shisd.planning._bands import OUTSIDE, Distant, Local, Material, predict, worst
from shisd.shading import Prefiltered, Quadrature, Slices, Surface, prefilter, shade
from shisd.shading.internal import as_type, best_channels, finite_mark, finite_or_nan, maps_of, shade_points

_ORDERS = (1, 2, 3, 4, 6, 8, 12, 16)
_EXACT = (24, 48)  # orders that others are compared with: the first that the one before comes near
_NEAR = 1e-3  # relative
_MAPPED = (4, 8)  # degrees beyond maps
_FACING = 1024  # normals


class Path(Module):
    """One way from a material and a light to radiance: where it serves, what it leaves out, its cost, and the call.

    A new path is one more class in `PATHS`.
    """

    name: ClassVar[str]
    takes: ClassVar[type]

    @staticmethod
    def degrees(most: int) -> Iterable[int]:
        """Those to try, from the cheapest."""
        return range(most + 1)

    @classmethod
    @abc.abstractmethod
    def errors(cls, material: Material, light: Any, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """RMS of what the path is off, a bound on it, and the RMS radiance, for each colour [C]."""

    @staticmethod
    @abc.abstractmethod
    def cost(material: Material, light: Any, degree: int) -> float:
        """Nanoseconds per pixel: a model of what two cores took (docs/benchmarks.md), to rank paths by."""

    @classmethod
    @abc.abstractmethod
    def make(cls, material: Material, slices: Any, lights: list, degree: int) -> "Path":
        """The path, ready to be called; `slices`, of this degree or a higher one, if it is `Expanded`."""

    @abc.abstractmethod
    def shade(self, surface: Surface) -> Array:
        """Radiance [..., *colour]."""


class Expanded(Path):
    """A path of slices, whose error is what it leaves out of the bands of material and light."""

    @staticmethod
    @abc.abstractmethod
    def left_out(material: Material, light: Any, degree: int) -> tuple[np.ndarray, np.ndarray]:
        """Band norms of slices [C, V, l] and lights [C, P, l] whose product is what the path leaves out."""

    @classmethod
    def errors(cls, material, light, degree):
        error, bound = predict(*cls.left_out(material, light, degree), material.shares)
        return error, bound, predict(material.norms, light.norms, material.shares)[0]


class Irradiance(Expanded):
    """Slices that are zonal about the normal and the same from all sides, of matt materials: the light convolved."""

    name = "irradiance"
    takes = DistantLight
    coefficients: Float[Array, "*colour n"]

    @staticmethod
    def left_out(material, light, degree):
        low = np.arange(material.degree + 1) <= degree
        return np.where(low, material.uneven, material.norms), light.norms

    @staticmethod
    def cost(material, light, degree):
        return 45.0 + 0.014 * max(material.colours, light.colours) * (degree + 1) * (2 * degree + 1)

    @classmethod
    def make(cls, material, slices, lights, degree):
        kernel = material.mean_zonal[:, : degree + 1]
        kernel, e = jnp.asarray(kernel, float), _sum(lights, degree)
        c = convolve(e, kernel if material.coloured or e.ndim == 2 else kernel[0])
        return cls(c)

    def shade(self, surface):
        points, c = surface.points("normals", "views"), self.coefficients
        dtype = jnp.result_type(c, points["normals"], points["views"])
        return by_device(shade_points, as_type(points, dtype), _irradiance, c.astype(dtype))


class Zonal(Expanded):
    """Distant light that is symmetric about an axis: nothing is rotated."""

    name = "zonal light"
    takes = DistantLight
    slices: Slices
    light: ZonalLight

    @staticmethod
    def left_out(material, light, degree):
        low = np.arange(material.degree + 1) <= degree
        return material.norms, np.where(low, light.off_axis, light.norms)

    @staticmethod
    def cost(material, light, degree):
        colours, n = max(material.colours, light.colours), (degree + 1) ** 2
        products = colours**2 * n * (2 * (degree + 1) + colours)
        return 100 * colours + 0.03 * _lookup(material, degree) + 0.025 * products + _azimuth_cost(material, degree)

    @classmethod
    def make(cls, material, slices, lights, degree):
        (light,) = lights
        z = jnp.asarray(light.zonal[:, : degree + 1], float)
        return cls(slices.cut(degree), ZonalLight(jnp.asarray(light.axis, float), z if light.coloured else z[0]))

    def shade(self, surface):
        return shade(self.slices, self.light, surface)


class Table(Expanded):
    """Any distant light, turned to the frame of every pixel and multiplied with the slice of its view."""

    name = "table"
    takes = DistantLight
    slices: Slices
    light: DistantLight

    @staticmethod
    def left_out(material, light, degree):
        return np.where(np.arange(material.degree + 1) <= degree, 0, material.norms), light.norms

    @staticmethod
    def cost(material, light, degree):
        series = (degree + 1) ** 3  # of one angle, which all pixels share
        exchange = _bands_squared(degree) / 4
        colours = max(material.colours, light.colours)
        products = _lookup(material, degree) + series * (colours + material.isotropic) + material.colours * exchange
        turning = _azimuth_cost(material, degree) + (0 if material.isotropic else 4000)
        return material.colours**0.65 * (110 + 0.21 * products**0.8) + turning

    @classmethod
    def make(cls, material, slices, lights, degree):
        return cls(slices.cut(degree), DistantLight(_sum(lights, degree)))

    def shade(self, surface):
        return shade(self.slices, self.light, surface)


class Filtered(Expanded):
    """Distant light filtered for the material beforehand.

    What the bands up to `degree` leave out and what the channels do are of unlike kind: their squares add up, to 25/16
    of the first with channels to 3/4 of it.
    """

    name = "filtered"
    takes = DistantLight
    filtered: Prefiltered

    left_out = Table.left_out

    @classmethod
    def errors(cls, material, light, degree):
        if not material.isotropic:
            nothing = np.zeros(max(material.colours, light.colours))
            return nothing + np.inf, nothing + np.inf, nothing + 1
        error, bound, radiance = super().errors(material, light, degree)
        return 5 / 4 * error, 5 / 4 * bound, radiance

    @classmethod
    def cost(cls, material, light, degree):
        n = (degree + 1) ** 2
        c, e = material.coefficients[..., :n], light.coefficients[:, :n]
        orders = best_channels(c, e, material.theta, material.shares, cls.tolerance(material, [light], degree))[1]
        return 65 + 1.9 * max(material.colours, light.colours) * maps_of(orders)

    @classmethod
    def tolerance(cls, material, lights, degree) -> float:
        """Of the channels."""
        errors = [worst(error, radiance) for error, _, radiance in (cls.errors(material, x, degree) for x in lights)]
        return max(3 / 5 * max(errors), 1e-3)

    @classmethod
    def make(cls, material, slices, lights, degree):
        light = DistantLight(_sum(lights, degree))
        return cls(prefilter(slices.cut(degree), light, tolerance=cls.tolerance(material, lights, degree)))

    def shade(self, surface):
        return self.filtered.radiance(surface)


class AboveHorizon(Expanded):
    """A local light above the horizon, where alone the slices are fitted."""

    slices: Slices
    light: Any

    @staticmethod
    def left_out(material, light, degree):
        return material.misfit(degree), light.norms

    @classmethod
    def make(cls, material, slices, lights, degree):
        return cls(slices.cut(degree).above_horizon(), lights[0].light)

    def shade(self, surface):
        return shade(self.slices, self.light, surface)


class Polygon(AboveHorizon):
    """A polygon light."""

    name = "polygon"
    takes = PolygonLight

    @staticmethod
    def cost(material, light, degree):
        if light.light_degree:
            return _product_cost(material, light, degree)
        axes, rows = _axes_and_rows(material, degree)
        points = len(light.light.points)
        moments = 12 * points * (degree + 1) * axes
        products = _lookup(material, degree) + material.colours * (moments + rows * axes)
        return 50 + 85 * points * material.colours**0.55 + 0.06 * products + _azimuth_cost(material, degree)


class Portal(AboveHorizon):
    """Distant light through a window."""

    name = "portal"
    takes = PortalLight

    @staticmethod
    def cost(material, light, degree):
        return _product_cost(material, light, degree)


class Sampled(Path):
    """A path under a local light whose error is what some points of surfaces show."""

    light: Any
    material: Any

    @staticmethod
    @abc.abstractmethod
    def form(material: Material, degree: int) -> Any:
        """What stands for the material in `shade`."""

    @classmethod
    def errors(cls, material, light, degree):
        surface, exact, doubt = _samples(material, light)
        off = _radiance(cls.form(material, degree), light, surface) - exact
        return _rms(off) + doubt, np.max(np.abs(off), axis=0), _rms(exact)

    @classmethod
    def make(cls, material, slices, lights, degree):
        return cls(light=lights[0].light, material=cls.form(material, degree))

    def shade(self, surface):
        return shade(self.material, self.light, surface)


class Points(Sampled):
    """A polygon light by Gauss points on it, `degree` x `degree` for a quadrilateral."""

    name = "points"
    takes = PolygonLight

    @staticmethod
    def degrees(most):
        return _ORDERS

    @staticmethod
    def form(material, degree):
        return Quadrature(as_type(material.brdf, float), degree)

    @staticmethod
    def cost(material, light, degree):
        quads = len(light.light.points) // 2  # one more where the horizon cuts
        through = light.colours * (light.light_degree + 1) * (2 * light.light_degree + 1) if light.light_degree else 0
        evaluation = material.evaluation if through == 0 else OUTSIDE * material.evaluation + 0.1 * through
        return 80 + 30 * quads + quads * degree**2 * (1 + evaluation)


class PortalPoints(Points):
    """A window by Gauss points on it."""

    takes = PortalLight


class Maps(Sampled):
    """A polygon that shines alike in all directions, and expansions beyond maps of directions, isotropic ones."""

    name = "maps"
    takes = PolygonLight

    @staticmethod
    def serves(material: Material, light: Local) -> bool:
        return material.isotropic and light.kind is PolygonLight and not light.light_degree

    @staticmethod
    def degrees(most):
        return tuple(d for d in _MAPPED if d <= most)

    @staticmethod
    def form(material, degree):
        return material.beyond_maps(degree)

    @staticmethod
    def cost(material, light, degree):
        if not Maps.serves(material, light):
            return np.inf
        return Polygon.cost(material, light, degree) + 0.8 * Polygon.cost(material, light, 2)


PATHS: tuple[type[Path], ...] = (Irradiance, Zonal, Table, Filtered, Polygon, Portal, Points, PortalPoints, Maps)


@functools.lru_cache(maxsize=1)  # the orders of one pair follow each other
def _samples(material: Material, light: Local) -> tuple[Surface, np.ndarray, np.ndarray]:
    """Points of surfaces, those of the scene or facing all ways, seen as in a sphere's picture.

    And the radiance [N, C], and its RMS error [C] where that is not small.
    """
    if light.normals is None:
        axes = np.asarray(fibonacci_directions(_FACING // 2), float)
        normals = np.concatenate([axes, -axes])[None]  # [P or 1, N, 3]
    else:
        count = max(16, 16 * _FACING // len(light.normals))
        normals = np.repeat(light.normals[:, None], count, axis=1)
    count = len(light.points), normals.shape[1]  # every view is another one
    steps = np.array([0.7548776662466927, 0.5698402909980532])[:, None, None, None]
    u, v = np.modf(steps * (np.arange(math.prod(count)).reshape(*count, 1) + 0.5))[0]
    sine, turn = np.sqrt(u), 2 * np.pi * v  # of the angle between normal and view: cos^2 is even
    across, upon = (np.moveaxis(np.asarray(x), 0, -1) for x in tangents(jnp.moveaxis(normals, -1, 0)))
    views = np.sqrt(1 - u) * normals + sine * (np.cos(turn) * across + np.sin(turn) * upon)
    facing, seen, along = (jnp.asarray(a, float) for a in (normals, views, across))
    surface = Surface(facing, seen, jnp.asarray(light.points, float)[:, None], along)
    return surface, *_trusted(material, light, surface)


def _trusted(material: Material, light: Local, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Radiance by as many points as their number no longer matters, or of lobes too narrow for that beyond maps.

    There the lower degree shows the error of its own, which the higher has in the proportion of their fits.
    """
    by_points = lambda order: _radiance(Points.form(material, order), light, surface)
    radiance = by_points(_ORDERS[-1])
    for order in _EXACT:
        coarse, radiance = radiance, by_points(order)
        doubt, found = _rms(radiance - coarse), _rms(radiance)
        missed = found < 0.5 * predict(material.norms, light.norms, material.shares)[0]  # a lobe between points
        if np.all((doubt <= _NEAR * np.max(found)) & ~missed):
            return radiance, 0 * doubt
    if np.any(missed) or not Maps.serves(material, light):
        return radiance, np.where(missed, np.inf, doubt)
    low, high = (material.beyond_maps(degree) for degree in _MAPPED)
    coarse, radiance = (_radiance(form, light, surface) for form in (low, high))
    return radiance, _rms(radiance - coarse) * float(jnp.linalg.norm(high.errors) / jnp.linalg.norm(low.errors))


def _radiance(form: Any, light: Local, surface: Surface) -> np.ndarray:
    """Values [N, C]."""
    values = np.asarray(shade(form, as_type(light.light, float), surface), float)
    return values.reshape(values.shape[0] * values.shape[1], -1)


def _rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, axis=0))


def _irradiance(points: dict[str, Float[Array, "p 3"]], c: Float[Array, "*colour n"]) -> Float[Array, " p *colour"]:
    normals, views = points["normals"], points["views"]
    values = evaluate(c.reshape(-1, 1, c.shape[-1]), normals).T.reshape(-1, *c.shape[:-1])
    own = normalize(normals), normalize(views)  # NaN of what has no direction
    below = jnp.sum(own[0] * own[1], axis=-1) <= 0
    return finite_or_nan(jnp.where(below.reshape(-1, *(1,) * (values.ndim - 1)), 0, values), own, finite_mark(c))


def _sum(lights: list[Distant], degree: int) -> Float[Array, "*colour n"]:
    """Coefficients of distant lights together, cut at a degree."""
    parts = [light.coefficients[:, : (degree + 1) ** 2] for light in lights]
    total = functools.reduce(np.add, parts)
    return jnp.asarray(total if any(light.coloured for light in lights) else total[0], float)


def _lookup(material: Material, degree: int) -> float:
    """Multiply-adds, of elevations."""
    return float(material.colours * (material.elevations + 4) * _axes_and_rows(material, degree)[1])


def _azimuth_cost(material: Material, degree: int) -> float:
    """Of slices that turn with the view in their own way."""
    return 0.0 if material.isotropic else material.colours**0.65 * (700 + 230 * degree)


def _axes_and_rows(material: Material, degree: int) -> tuple[int, int]:
    """Axes that span the slices, and their coefficients; those of isotropic materials are even across a plane."""
    return (degree + 1, (degree + 1) * (degree + 2) // 2) if material.isotropic else (2 * degree + 1, (degree + 1) ** 2)


def _product_cost(material: Material, light: Local, degree: int) -> float:
    """Of lights whose radiance depends on direction: moments, their coefficients, the matrix, and the rotation."""
    total = light.light_degree + degree
    moments = 12 * len(light.light.points) * (total + 1) * (2 * total + 1) + (2 * total + 1) * (total + 1) ** 2
    matrix = (total + 1) ** 2 * (degree + 1) ** 2
    products = _lookup(material, degree) + moments + light.colours * (matrix + 2 * _bands_squared(degree))
    return 300 + 1.6 * products**0.82 + _azimuth_cost(material, degree)


def _bands_squared(degree: int) -> float:
    return (degree + 1) * (2 * degree + 1) * (2 * degree + 3) / 3
