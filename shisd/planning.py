"""Model only what a scene needs: for each material and light, the smallest degree and the cheapest path.

Radiance is the product of a material's slice with the light as it stands in the local frame. What a path leaves out is
such a product too, of what it drops of the slice, s, with what it drops of the light, t: above degree L of both for the
general path; all that is not zonal for the paths that take the light, or the slice, as zonal. Averaged over all
rotations between the two, the products of different harmonics vanish, so that

    mean square of the error = sum_l |s_l|^2 |t_l|^2 / (2l+1),      error <= sum_l |s_l| |t_l|,

|s_l| the Euclidean norm of band l. So a plan is made from band energies alone, without a picture.

notation: rho_l = slice; e_l = distant light; p_l = a local light, as a point sees it; L = degree of a path.
"""

import abc
import functools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._module import Module
from shisd._progress import Progress, reporting
from shisd._typing import Array, ArrayLike, Float
from shisd.decomposition.internal import TABLE_DEGREE
from shisd.harmonics import convolve, evaluate, multiply, sphere_rule
from shisd.harmonics.internal import host_basis, zonal_norms
from shisd.models import AbstractBrdf, Environment, PolygonLight, PortalLight
from shisd.shading import (
    Slices,
    project_light,
    shade_environment,
    shade_polygon,
    shade_portal,
    shade_zonal,
    tabulate_brdf,
)
from shisd.shading.internal import RIDGE, fit_above, hemisphere_blocks, incident_radiance, project_slice

Light = Environment | PolygonLight | PortalLight | ArrayLike
_ELEVATIONS = 12  # of the views whose slices are judged: Gauss nodes
_DARK = 1e-6  # of the brightest colour's radiance: a colour below it is rounding
_AZIMUTHS = 6  # of these views, for anisotropic materials


class Scene(Module):
    """What is to be shaded: every material under the sum of all lights, without occlusion.

    Arguments: `materials` and `lights` by name; a light is a `models.Environment`, SH coefficients [n] or [colour, n]
    of distant light, a `models.PolygonLight` or a `models.PortalLight`; `points`
    [N, 3], representative positions of surfaces, which judge the local lights. A dozen will do: each costs a
    projection.
    """

    materials: dict[str, AbstractBrdf]
    lights: dict[str, Light]
    points: Float[Array, "n 3"] | None

    def __init__(self, materials: dict[str, AbstractBrdf], lights: dict[str, Light], points: ArrayLike | None = None):
        if not materials or not lights:
            raise ValueError(
                f"a scene needs at least one of `materials` and of `lights`; got {len(materials)} and {len(lights)}."
            )
        for name, brdf in materials.items():
            if not isinstance(brdf, AbstractBrdf):
                raise ValueError(f"`materials`[{name!r}] must be a models.AbstractBrdf; got {type(brdf).__name__}.")
        for name, light in lights.items():
            if isinstance(light, PolygonLight | PortalLight):
                if points is None:
                    raise ValueError(f"`lights`[{name!r}] is local; pass `points` [N, 3] that see it.")
            elif not isinstance(light, Environment):
                _checks.expansion(f"lights[{name!r}]", light)
        self.materials, self.lights = dict(materials), dict(lights)
        self.points = None if points is None else _checks.vectors("points", points).reshape(-1, 3)
        if self.points is not None and len(self.points) == 0:
            raise ValueError("`points` must hold at least one position.")


class Entry(NamedTuple):
    """The decision for one material and one light. Errors are relative to the RMS radiance of this pair, of the colour
    for which they are largest.
    """

    material: str
    light: str
    path: str
    degree: int
    error: float  # predicted RMS
    bound: float  # on the RMS whatever way materials and lights are turned, from the same bands
    cost: float  # multiply-adds per pixel; 0 for a light that joins another
    joined: str  # the light that it is added to before the path is taken, or ""
    met: bool


class Plan(Module):
    """Decisions, and all that is needed to shade by them: tables of the materials and lights cut to their degree.

    `str(plan)` is a table to read. `shade` is differentiable in everything but the materials and lights, which are
    tabulated here.
    """

    entries: tuple[Entry, ...] = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)
    paths: dict[str, tuple["Path", ...]]

    @property
    def met(self) -> bool:
        return all(entry.met for entry in self.entries)

    def shade(
        self,
        material: str,
        positions: ArrayLike | None,
        normals: ArrayLike,
        views: ArrayLike,
        tangents: ArrayLike | None = None,
    ) -> Float[Array, "*batch_colour"]:
        """Radiance that leaves surface points of one material towards the viewer, from all lights of the scene.

        Arguments: the name of the `material`; the others and what is returned as in `shading.shade_polygon`;
        `positions` may be None where no light is local.
        Derivatives: in positions, normals, views and tangents, both modes. Cost: the sum of the entries.
        """
        if material not in self.paths:
            raise ValueError(f"`material` must be one of {', '.join(map(repr, self.paths))}; got {material!r}.")
        paths = self.paths[material]
        if positions is None and any(path.takes is not Environment for path in paths):
            raise ValueError("`positions` [..., 3] are needed: a light of the scene is local.")
        vectors = {"positions": positions, "normals": normals, "views": views, "tangents": tangents}
        vectors = {name: _checks.vectors(name, value) for name, value in vectors.items() if value is not None}
        try:
            shape = np.broadcast_shapes(*(a.shape for a in vectors.values()))
        except ValueError as error:
            shapes = {name: list(a.shape) for name, a in vectors.items()}
            raise ValueError(f"batch axes {shapes} do not broadcast.") from error
        return _shade(paths, {name: jnp.broadcast_to(a, shape) for name, a in vectors.items()})

    def __str__(self) -> str:
        rows = [("material", "light", "path", "degree", "error %", "bound %", "multiply-adds per pixel", "")]
        for e in self.entries:
            cost = f"0, added to {e.joined}" if e.joined else f"{e.cost:.0f}"
            rows.append((
                e.material, e.light, e.path, str(e.degree), f"{100 * e.error:.2g}", f"{100 * e.bound:.2g}", cost,
                "" if e.met else "NOT MET: raise max_degree or tolerance",
            ))  # fmt: skip
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
        lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([
            f"Relative RMS error up to {100 * self.tolerance:.2g} %; nothing occludes, so no path looks up visibility.",
            *lines,
        ])  # fmt: skip


class Path(Module):
    """One way from a material and a light to radiance: where it serves, what it leaves out, its cost, and the call.

    A new path is one more class in `PATHS`.
    """

    name: ClassVar[str]
    takes: ClassVar[type]

    @staticmethod
    @abc.abstractmethod
    def left_out(material: "_Material", light: Any, degree: int) -> tuple[np.ndarray, np.ndarray]:
        """Band norms of slices [C, V, l] and lights [C, P, l] whose product is what the path leaves out."""

    @staticmethod
    @abc.abstractmethod
    def cost(material: "_Material", light: Any, degree: int) -> float:
        """Multiply-adds per pixel: a model, of the products that grow with the degree."""

    @classmethod
    @abc.abstractmethod
    def make(cls, material: "_Material", tables: "_Tables", lights: list, degree: int) -> "Path":
        """The path, ready to be called."""

    @abc.abstractmethod
    def shade(self, positions: Any, normals: Array, views: Array, tangents: Array | None) -> Array:
        """Radiance [..., *colour]; `positions` are None where no light is local."""


class Irradiance(Path):
    """Slices that are zonal about the normal and the same from all sides, of matt materials: the light convolved."""

    name = "irradiance"
    takes = Environment
    coefficients: Float[Array, "*colour n"]

    @staticmethod
    def left_out(material, light, degree):
        low = np.arange(material.degree + 1) <= degree
        return np.where(low, material.uneven, material.norms), light.norms

    @staticmethod
    def cost(material, light, degree):
        return float(max(material.colours, light.colours) * (degree + 1) * (2 * degree + 1))

    @classmethod
    def make(cls, material, tables, lights, degree):
        kernel = material.mean_zonal[:, : degree + 1]
        kernel, e = jnp.asarray(kernel, float), _sum(lights, degree)
        c = convolve(e, kernel if material.coloured or e.ndim == 2 else kernel[0])
        return cls(c)

    def shade(self, positions, normals, views, tangents):
        c = self.coefficients.reshape(-1, 1, self.coefficients.shape[-1])
        values = evaluate(c, normals.reshape(-1, 3)).T.reshape(*normals.shape[:-1], *self.coefficients.shape[:-1])
        below = jnp.sum(normals * views, axis=-1) < 0
        return jnp.where(below.reshape(*below.shape, *(1,) * (values.ndim - below.ndim)), 0, values)


class Zonal(Path):
    """Distant light that is symmetric about an axis: nothing is rotated."""

    name = "zonal light"
    takes = Environment
    slices: Slices
    axis: Float[Array, "3"]
    coefficients: Float[Array, "*colour l"]

    @staticmethod
    def left_out(material, light, degree):
        low = np.arange(material.degree + 1) <= degree
        return material.norms, np.where(low, light.off_axis, light.norms)

    @staticmethod
    def cost(material, light, degree):
        n = (degree + 1) ** 2
        return _lookup_cost(material, degree) + n * (2 * (degree + 1) + max(material.colours, light.colours))

    @classmethod
    def make(cls, material, tables, lights, degree):
        (light,) = lights
        z = jnp.asarray(light.zonal[:, : degree + 1], float)
        return cls(tables.slices(degree), jnp.asarray(light.axis, float), z if light.coloured else z[0])

    def shade(self, positions, normals, views, tangents):
        return shade_zonal(self.slices, self.axis, self.coefficients, normals, views, tangents)


class Table(Path):
    """Any distant light, turned to the frame of every pixel and multiplied with the slice of its view."""

    name = "table"
    takes = Environment
    slices: Slices
    coefficients: Float[Array, "*colour n"]

    @staticmethod
    def left_out(material, light, degree):
        return np.where(np.arange(material.degree + 1) <= degree, 0, material.norms), light.norms

    @staticmethod
    def cost(material, light, degree):
        series = (degree + 1) ** 3  # of one angle, which all pixels share
        exchange = _bands_squared(degree) / 4
        colours = max(material.colours, light.colours)
        return _lookup_cost(material, degree) + series * (colours + material.isotropic) + material.colours * exchange

    @classmethod
    def make(cls, material, tables, lights, degree):
        return cls(tables.slices(degree), _sum(lights, degree))

    def shade(self, positions, normals, views, tangents):
        return shade_environment(self.slices, self.coefficients, normals, views, tangents)


class Polygon(Path):
    """A polygon light above the horizon, where alone the slices are fitted."""

    name = "polygon"
    takes = PolygonLight
    slices: Slices
    light: PolygonLight

    @staticmethod
    def left_out(material, light, degree):
        return material.misfit(degree), light.norms

    @staticmethod
    def cost(material, light, degree):
        if light.light_degree:
            return _product_cost(material, light, degree)
        axes, rows = _axes_and_rows(material, degree)
        moments = 12 * len(light.light.points) * (degree + 1) * axes
        weights = rows * axes
        return _lookup_cost(material, degree) + material.colours * (moments + weights)

    @classmethod
    def make(cls, material, tables, lights, degree):
        return cls(tables.slices(degree, above=True), lights[0].light)

    def shade(self, positions, normals, views, tangents):
        return shade_polygon(self.slices, self.light, positions, normals, views, tangents)


class Portal(Path):
    """Distant light through a window, above the horizon, where alone the slices are fitted."""

    name = "portal"
    takes = PortalLight
    slices: Slices
    light: PortalLight

    @staticmethod
    def left_out(material, light, degree):
        return material.misfit(degree), light.norms

    @staticmethod
    def cost(material, light, degree):
        return _product_cost(material, light, degree)

    @classmethod
    def make(cls, material, tables, lights, degree):
        portal = lights[0].light
        return cls(tables.slices(degree, above=True), portal)

    def shade(self, positions, normals, views, tangents):
        return shade_portal(self.slices, self.light, positions, normals, views, tangents)


PATHS: tuple[type[Path], ...] = (Irradiance, Zonal, Table, Polygon, Portal)


def plan(
    scene: Scene,
    tolerance: float,
    *,
    max_degree: int = 30,
    margin: float = 1.5,
    views: int = 64,
    throw: bool = False,
    progress: Progress = None,
) -> Plan:
    """For each material and light of a scene, the cheapest path and the smallest degree that meet a tolerance.

    Arguments: `tolerance` > 0, the relative RMS error: of the radiance from one light, over its RMS, both over normals
    in all directions and views as in the picture of a sphere; every colour has to meet it. Static `max_degree` up to
    64; `margin` >= 1, by which predictions are multiplied before they are compared: real scenes are not turned in all
    ways. `views`: elevations of the tables, as in `shading.tabulate_brdf`.
    Distant lights that take the same path are added up before it, so only the first of them costs anything, and others
    join where they meet the tolerance there.
    Where nothing meets the tolerance, the entry has the best that `max_degree` can do and `met` False, and a
    UserWarning says so; `throw=True` raises ValueError instead. `progress`: None, True for a bar of tqdm, or a function
    of (done, total) lights and materials.
    Accuracy: predictions are for bands up to max(32, 2 max_degree). Over all orientations, what six photographed maps
    gave for three materials at degrees 2 to 12 was 0.65 to 1.06 times the prediction, of the worst colour. One picture
    does not show all orientations: there it was 0.2 to 4.2 times, four of five between 0.35 and 1.85, more for cameras
    that see the sides with the edges of the light. Materials and lights in float32 show nothing below 1e-5.
    Not traced: it runs on the host and returns what is to be traced.
    Cost: every material is tabulated once, which compiles for each kind of material.
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a planning.Scene; got {type(scene).__name__}.")
    max_degree, views = _checks.integer("max_degree", max_degree), _checks.integer("views", views, 4)
    if max_degree > TABLE_DEGREE:
        raise ValueError(f"`max_degree` must be <= {TABLE_DEGREE}; got {max_degree}.")
    tolerance, margin = _checks.number("tolerance", tolerance, positive=True), _checks.number("margin", margin)
    if margin < 1:
        raise ValueError(f"`margin` must be >= 1; got {margin}.")
    with reporting(progress, len(scene.lights) + len(scene.materials), "plan") as step:
        made = _plan(scene, tolerance, margin, max_degree, views, step)
    if not made.met:
        failed = [f"{e.material} under {e.light} ({100 * e.error:.2g} %)" for e in made.entries if not e.met]
        message = (
            f"`tolerance` {tolerance} with `margin` {margin} is not met at degree {max_degree}: {', '.join(failed)}. "
            "Raise `max_degree` or `tolerance`."
        )
        if throw:
            raise ValueError(message)
        warnings.warn(message, UserWarning, stacklevel=2)
    return made


def _plan(
    scene: Scene, tolerance: float, margin: float, max_degree: int, views: int, step: Callable[..., object]
) -> Plan:
    reference = max(32, 2 * max_degree)
    lights = {}
    for name, light in scene.lights.items():
        lights[name] = _seen(name, light, scene.points, reference)
        step()
    entries, paths = [], {}
    for name, brdf in scene.materials.items():
        material = _material(brdf, reference, views)
        choices = {of: _choose(material, light, tolerance / margin, max_degree) for of, light in lights.items()}
        choices, hosts = _join(material, lights, choices, tolerance / margin)
        tables = _Tables(brdf, max(c.degree for c in choices.values()), views)
        for of, choice in choices.items():
            alone = hosts[of] == of
            cost, joined = (choice.cost, "") if alone else (0.0, hosts[of])
            met = choice.error <= tolerance / margin
            entries.append(
                Entry(name, of, choice.name(material), choice.degree, choice.error, choice.bound, cost, joined, met)
            )
        paths[name] = tuple(
            choice.path.make(material, tables, [lights[of] for of in choices if hosts[of] == host], choice.degree)
            for host, choice in choices.items()
            if hosts[host] == host
        )
        step()
    return Plan(tuple(entries), tolerance, paths)


# ---- What is known of a material and a light


@dataclass(frozen=True, eq=False)
class _Material:
    """Slices of a material from some sides."""

    coefficients: np.ndarray  # [C, V, n], C = 1 without colour
    shares: np.ndarray  # [V], how much of the picture of a sphere is seen so; their sum is 1
    coloured: bool
    isotropic: bool
    views: int  # elevations of the tables to be made

    @property
    def colours(self) -> int:
        return self.coefficients.shape[0]

    @property
    def degree(self) -> int:
        return _checks.degree_of(self.coefficients.shape[-1])

    @functools.cached_property
    def norms(self) -> np.ndarray:
        return _norms(self.coefficients)

    @functools.cached_property
    def mean_zonal(self) -> np.ndarray:
        """Coefficients [C, l] of y_l^0 in the mean slice."""
        l = np.arange(self.degree + 1)
        return np.einsum("v,cvl->cl", self.shares, self.coefficients[..., l * l + l])

    @functools.cached_property
    def uneven(self) -> np.ndarray:
        """Norms [C, V, l] of what slices have beside `mean_zonal`."""
        l, c = np.arange(self.degree + 1), self.coefficients.copy()
        c[..., l * l + l] -= self.mean_zonal[:, None]
        return _norms(c)

    def misfit(self, degree: int) -> np.ndarray:
        """Norms [C, V, l] of what a fit above the horizon leaves there: r = b - H_(:L) (H_LL + ridge)^-1 b_L."""
        square = np.zeros_like(self.norms)
        for m in range(0 if self.isotropic else -self.degree, self.degree + 1):  # sines vanish, seen from azimuth 0
            l = np.arange(abs(m), self.degree + 1)
            b, h = self.coefficients[..., l * l + l + m], hemisphere_blocks(self.degree)[abs(m)]
            k = max(degree + 1 - abs(m), 0)
            solution = np.linalg.solve(h[:k, :k] + RIDGE * np.eye(k), h[:k])
            square[..., l] += (b - b[..., :k] @ solution) ** 2
        return np.sqrt(square)


@dataclass(frozen=True, eq=False)
class _Distant:
    """Coefficients of distant light and its best axis of symmetry."""

    coefficients: np.ndarray  # [C, n]
    coloured: bool
    kind: ClassVar[type] = Environment

    @property
    def colours(self) -> int:
        return len(self.coefficients)

    @functools.cached_property
    def norms(self) -> np.ndarray:
        return _norms(self.coefficients)[:, None]

    @functools.cached_property
    def axis(self) -> np.ndarray:
        """Of the principal axes of its first and second moments, the one about which most of it is zonal."""
        w, area = (np.asarray(x, float) for x in sphere_rule(4))
        values = host_basis(w, 2) @ self.coefficients[:, :9].T * area[:, None]
        first, second = values.T @ w, np.einsum("pc,pi,pj->cij", values, w, w)
        moments = np.stack([first.T @ first, np.einsum("cij,cjk->ik", second, second)])
        axes = np.concatenate([*np.swapaxes(np.linalg.eigh(moments)[1], 1, 2), np.eye(3)[2:]])
        axes *= np.where(axes[:, 2] < 0, -1, 1)[:, None]
        l = np.arange(self.norms.shape[-1])
        response = [np.sum(self._about(axis) ** 2 / (2 * l + 1)) for axis in axes]
        return axes[np.argmax(response)]

    def _about(self, axis: np.ndarray) -> np.ndarray:
        """Coefficients [C, l] of y_l^0 about an axis."""
        degree = self.norms.shape[-1] - 1
        products = self.coefficients * host_basis(axis[None], degree)
        return np.add.reduceat(products, np.arange(degree + 1) ** 2, axis=-1) / zonal_norms(degree)

    @property
    def zonal(self) -> np.ndarray:
        return self._about(self.axis)

    @functools.cached_property
    def off_axis(self) -> np.ndarray:
        """Norms [C, 1, l] of what is not zonal about the axis."""
        degree = self.norms.shape[-1] - 1
        part = np.repeat(self.zonal / zonal_norms(degree), 2 * np.arange(degree + 1) + 1, axis=-1)
        return _norms(self.coefficients - part * host_basis(self.axis[None], degree))[:, None]


@dataclass(frozen=True, eq=False)
class _Local:
    """A local light and the norms [C, P, l] of the light that points receive."""

    light: PolygonLight | PortalLight
    norms: np.ndarray
    light_degree: int

    @property
    def kind(self) -> type:
        return type(self.light)

    @property
    def colours(self) -> int:
        return len(self.norms)


_Seen = _Distant | _Local


def _material(brdf: AbstractBrdf, degree: int, views: int) -> _Material:
    nodes, weights = np.polynomial.legendre.leggauss(_ELEVATIONS)
    azimuths = np.arange(1 if brdf.isotropic else _AZIMUTHS) / _AZIMUTHS
    theta, phi = (x.ravel() for x in np.meshgrid((nodes + 1) * np.pi / 4, 2 * np.pi * azimuths, indexing="ij"))
    local = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    c = np.asarray(_slices(brdf, jnp.asarray(local, float), degree), float)  # [V, *colour, n]
    shares = np.repeat(weights, len(azimuths)) * np.sin(2 * theta)
    coefficients = np.moveaxis(c.reshape(len(theta), -1, c.shape[-1]), 0, 1)
    return _Material(coefficients, shares / np.sum(shares), c.ndim == 3, brdf.isotropic, views)


@eqx.filter_jit
def _slices(brdf: AbstractBrdf, views: Float[Array, "v 3"], degree: int) -> Float[Array, " v *colour_n"]:
    width = jnp.asarray(brdf.lobe_width, views.dtype)
    return jax.lax.map(lambda view: project_slice(brdf, view, width, degree, 32 + degree), views)


def _seen(name: str, light: Light, points: Any, degree: int) -> _Seen:
    if isinstance(light, PolygonLight | PortalLight):
        incident = incident_radiance(light)  # as a product, without the matrix that shading needs
        light_degree = _checks.degree_of(incident.shape[-1])
        outline = PolygonLight(light.points, two_sided=light.two_sided)
        seen = project_light(outline, points, degree + light_degree)
        received = multiply(seen[None], incident.reshape(-1, 1, incident.shape[-1]), degree)
        found = _Local(light, _norms(np.asarray(received, float)), light_degree)
    else:
        if isinstance(light, Environment):
            light = light.coefficients(min(degree, light.texels.shape[0] - 1))
        e = np.asarray(light, float)[..., : (degree + 1) ** 2]
        c = np.zeros((*e.shape[:-1], (degree + 1) ** 2))
        c[..., : e.shape[-1]] = e
        found = _Distant(c.reshape(-1, c.shape[-1]), c.ndim == 2)
    if not np.all(np.isfinite(found.norms)):
        raise ValueError(f"`lights`[{name!r}] must be finite everywhere; Environment.load clamps what is not.")
    return found


def _norms(coefficients: np.ndarray) -> np.ndarray:
    """Norms [..., l] of the bands."""
    starts = np.arange(_checks.degree_of(coefficients.shape[-1]) + 1) ** 2
    return np.sqrt(np.add.reduceat(coefficients**2, starts, axis=-1))


# ---- What is chosen


class _Choice(NamedTuple):
    path: type[Path]
    degree: int
    error: float
    bound: float
    cost: float

    def name(self, material: _Material) -> str:
        if self.path is not Table:
            return self.path.name
        return f"{'isotropic' if material.isotropic else 'anisotropic'} {self.path.name}"


def _judge(path: type[Path], material: _Material, light: _Seen, degree: int) -> _Choice:
    error, bound = predict(*path.left_out(material, light, degree), material.shares)
    radiance = predict(material.norms, light.norms, material.shares)[0]
    dark = radiance <= _DARK * np.max(radiance)
    relative = lambda x: float(np.max(np.where(dark, 0, x / np.where(dark, 1, radiance))))
    return _Choice(path, degree, relative(error), relative(bound), path.cost(material, light, degree))


def predict(slices: np.ndarray, lights: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """RMS of the product of slices and lights, and a bound on it, from norms of their bands [C, V, l] and [C, P, l].

    One for each colour [C]. The RMS is over views by their `shares` [V], points, and all rotations between slices and
    lights; the bound holds for the worst of the rotations.
    """
    energy = np.einsum("v,cvl->cl", shares, slices**2) * np.mean(lights**2, axis=1)
    worst = slices @ np.swapaxes(lights, 1, 2)  # [C, V, P]
    square = np.sum(energy / (2 * np.arange(slices.shape[-1]) + 1), axis=-1)
    return np.sqrt(square), np.sqrt(np.mean(np.einsum("v,cvp->cp", shares, worst**2), axis=1))


def _choose(material: _Material, light: _Seen, target: float, max_degree: int) -> _Choice:
    found = []
    for path in PATHS:
        if path.takes is light.kind:
            tries = (_judge(path, material, light, degree) for degree in range(max_degree + 1))
            found.append(next((t for t in tries if t.error <= target), _judge(path, material, light, max_degree)))
    good = [choice for choice in found if choice.error <= target]
    return min(good, key=lambda c: c.cost) if good else min(found, key=lambda c: c.error)


def _join(
    material: _Material, lights: dict[str, _Seen], choices: dict[str, _Choice], target: float
) -> tuple[dict[str, _Choice], dict[str, str]]:
    """Distant lights in the paths of others, where they are good enough; and whose path, for each light."""
    hosts = {name: name for name in choices}
    free = list(choices)
    for path in (Table, Irradiance):
        takers = [name for name in free if choices[name].path is path]
        if takers:
            host = max(takers, key=lambda name: choices[name].degree)
            for name in free:
                if lights[name].kind is path.takes:
                    joined = _judge(path, material, lights[name], choices[host].degree)
                    if name in takers or joined.error <= target:
                        choices, hosts = choices | {name: joined}, hosts | {name: host}
            free = [name for name in free if hosts[name] != host]
    return choices, hosts


def _lookup_cost(material: _Material, degree: int) -> float:
    azimuths = 1 if material.isotropic else max(32, 2 * degree + 4) + 2  # cosines and sines
    return float(material.colours * (material.views + 4) * azimuths * _axes_and_rows(material, degree)[1])


def _axes_and_rows(material: _Material, degree: int) -> tuple[int, int]:
    """Axes that span the slices, and their coefficients; those of isotropic materials are even across a plane."""
    return (degree + 1, (degree + 1) * (degree + 2) // 2) if material.isotropic else (2 * degree + 1, (degree + 1) ** 2)


def _product_cost(material: _Material, light: _Local, degree: int) -> float:
    """Of lights whose radiance depends on direction: moments, their coefficients, the matrix, and the rotation."""
    total = light.light_degree + degree
    moments = 12 * len(light.light.points) * (total + 1) * (2 * total + 1) + (2 * total + 1) * (total + 1) ** 2
    matrix = (total + 1) ** 2 * (degree + 1) ** 2
    return _lookup_cost(material, degree) + moments + light.colours * (matrix + 2 * _bands_squared(degree))


def _bands_squared(degree: int) -> float:
    return (degree + 1) * (2 * degree + 1) * (2 * degree + 3) / 3


# ---- What is executed


class _Tables:
    """Slices of a material, tabulated once to some degree; those of lower degrees are cut from them."""

    def __init__(self, brdf: AbstractBrdf, degree: int, views: int):
        self._all = tabulate_brdf(brdf, degree, views=views)
        self._made: dict[tuple[int, bool], Slices] = {}

    def slices(self, degree: int, above: bool = False) -> Slices:
        if (degree, above) not in self._made:
            self._made[degree, above] = self._cut(degree, above)
        return self._made[degree, above]

    def _cut(self, degree: int, above: bool) -> Slices:
        every, domain = self._all, "upper" if above else "sphere"
        c = every.coefficients[..., : (degree + 1) ** 2]
        if above:
            c = fit_above(c, RIDGE)
        return Slices(c, quadrature_error=every.quadrature_error, isotropic=every.isotropic, domain=domain)


def _sum(lights: list[_Distant], degree: int) -> Float[Array, "*colour n"]:
    """Coefficients of distant lights together, cut at a degree."""
    parts = [light.coefficients[:, : (degree + 1) ** 2] for light in lights]
    total = functools.reduce(np.add, parts)
    return jnp.asarray(total if any(light.coloured for light in lights) else total[0], float)


@eqx.filter_jit
def _shade(paths: tuple[Path, ...], vectors: dict[str, Array]) -> Float[Array, "*batch_colour"]:
    everything: dict[str, Any] = {"positions": None, "tangents": None} | vectors
    values = [path.shade(**everything) for path in paths]
    most = max(value.ndim for value in values)
    return functools.reduce(jnp.add, (v.reshape(*v.shape, *(1,) * (most - v.ndim)) for v in values))
