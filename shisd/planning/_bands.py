"""What is known of a material and a light: norms of the bands of its slices, and of what points receive."""

import functools
import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._lanes import inner_programs, kernel_takes
from shisd.harmonics import multiply, sphere_rule
from shisd.harmonics.internal import host_basis, of_order, zonal_norms
from shisd.models import AbstractBrdf, DistantLight, Environment, PolygonLight, PortalLight
from shisd.planning._scene import Light
from shisd.shading import TransformedSlices, project_light, transform_brdf
from shisd.shading.internal import RIDGE, as_type, hemisphere_blocks, project_slices

_ELEVATIONS = 12  # of the views whose slices are judged: Gauss nodes
_AZIMUTHS = 6  # of these views, for anisotropic materials


@dataclass(frozen=True, eq=False)
class Material:
    """Slices of a material from some sides."""

    coefficients: np.ndarray  # [C, V, n], C = 1 without colour
    theta: np.ndarray  # [V], elevations
    shares: np.ndarray  # [V], how much of the picture of a sphere is seen so; their sum is 1
    coloured: bool
    isotropic: bool
    elevations: int  # of the tables to be made
    brdf: AbstractBrdf  # itself, which points on lights are evaluated with
    mapped: dict[int, TransformedSlices] = field(default_factory=dict)  # by degree, what `beyond_maps` has made

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
        return np.einsum("v,cvl->cl", self.shares, self.coefficients[..., of_order(self.degree, 0)])

    @functools.cached_property
    def uneven(self) -> np.ndarray:
        """Norms [C, V, l] of what slices have beside `mean_zonal`."""
        c = self.coefficients.copy()
        c[..., of_order(self.degree, 0)] -= self.mean_zonal[:, None]
        return _norms(c)

    @functools.cached_property
    def evaluation(self) -> float:
        """Nanoseconds that one value of the model takes in one kernel, by its operations; more where it takes none."""
        direction = jax.ShapeDtypeStruct((3,), np.float32)
        inside = kernel_takes(self.brdf.value_cosine, direction, direction)
        value = jax.make_jaxpr(self.brdf.value_cosine)(direction, direction)
        return (1.0 if inside else OUTSIDE) * _nanoseconds(value.jaxpr)

    def beyond_maps(self, degree: int) -> TransformedSlices:
        """Expansions beyond maps of directions, made when first asked for."""
        if degree not in self.mapped:
            self.mapped[degree] = transform_brdf(as_type(self.brdf, float), degree, elevations=self.elevations)
        return self.mapped[degree]

    def misfit(self, degree: int) -> np.ndarray:
        """Norms [C, V, l] of what a fit above the horizon leaves there: r = b - H_(:L) (H_LL + ridge)^-1 b_L."""
        square = np.zeros_like(self.norms)
        for m in range(0 if self.isotropic else -self.degree, self.degree + 1):  # sines vanish, seen from azimuth 0
            l = np.arange(abs(m), self.degree + 1)
            b, h = self.coefficients[..., of_order(self.degree, m)], hemisphere_blocks(self.degree)[abs(m)]
            k = max(degree + 1 - abs(m), 0)
            solution = np.linalg.solve(h[:k, :k] + RIDGE * np.eye(k), h[:k])
            square[..., l] += (b - b[..., :k] @ solution) ** 2
        return np.sqrt(square)


OUTSIDE = 2.5  # times as long without the kernel
_LONG = {"exp", "exp2", "expm1", "log", "log1p", "pow", "sin", "cos", "tan", "atan2", "gather"}


def _nanoseconds(jaxpr: Any) -> float:
    """On one value: vector code takes 0.02 for an operation, what stands for a table or a series 3."""
    total = 0.0
    for equation in jaxpr.eqns:
        inner = inner_programs(equation)
        size = max((math.prod(out.aval.shape) for out in equation.outvars), default=1)
        own = (3.0 if equation.primitive.name in _LONG else 0.02) * size
        total += sum(map(_nanoseconds, inner)) if inner else own
    return total


@dataclass(frozen=True, eq=False)
class Distant:
    """Coefficients of distant light and its best axis of symmetry."""

    coefficients: np.ndarray  # [C, n]
    coloured: bool
    kind: ClassVar[type] = DistantLight

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
class Local:
    """A local light and the norms [C, P, l] of the light that points receive."""

    light: PolygonLight | PortalLight
    norms: np.ndarray
    light_degree: int
    points: np.ndarray  # [P, 3]
    normals: np.ndarray | None  # [P, 3], unit vectors, of surfaces that do not face all ways

    @property
    def kind(self) -> type:
        return type(self.light)

    @property
    def colours(self) -> int:
        return len(self.norms)


Seen = Distant | Local
_DARK = 1e-6  # of the brightest colour's radiance: a colour below it is rounding


def known_material(brdf: AbstractBrdf, degree: int, elevations: int) -> Material:
    """Slices to a degree, seen from Gauss nodes in elevation; `elevations` as in `Material`.

    Apart from the table that a plan makes: one for both, of 64 elevations to this degree, would take 5 times as long
    (GGX 0.3, RGB, degree 60 beside a table of degree 16: 7.0 s against 0.84 s and 0.54 s, compiled).
    """
    nodes, weights = np.polynomial.legendre.leggauss(_ELEVATIONS)
    azimuths = np.arange(1 if brdf.isotropic else _AZIMUTHS) / _AZIMUTHS
    theta, phi = (x.ravel() for x in np.meshgrid((nodes + 1) * np.pi / 4, 2 * np.pi * azimuths, indexing="ij"))
    local = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    c = np.asarray(project_slices(brdf, jnp.asarray(local, float), degree, 32 + degree)[0], float)  # [V, *colour, n]
    shares = np.repeat(weights, len(azimuths)) * np.sin(2 * theta)
    coefficients = np.moveaxis(c.reshape(len(theta), -1, c.shape[-1]), 0, 1)
    return Material(coefficients, theta, shares / np.sum(shares), c.ndim == 3, brdf.isotropic, elevations, brdf)


def known_light(name: str, light: Light, points: Any, degree: int, normals: Any = None) -> Seen:
    """A light to a degree, local ones as `points` [P, 3] see them."""
    if isinstance(light, PolygonLight | PortalLight):
        incident = light.incident()  # as a product, without the matrix that shading needs
        light_degree = _checks.degree_of(incident.shape[-1])
        outline = PolygonLight(light.points, two_sided=light.two_sided)
        seen = project_light(outline, points, degree + light_degree)
        received = multiply(seen[None], incident.reshape(-1, 1, incident.shape[-1]), degree)
        found = Local(light, _norms(np.asarray(received, float)), light_degree, np.asarray(points), normals)
    else:
        if isinstance(light, Environment):
            light = light.light(min(degree, light.texels.shape[0] - 1))
        e = np.asarray(light.coefficients, float)[..., : (degree + 1) ** 2]
        c = np.zeros((*e.shape[:-1], (degree + 1) ** 2))
        c[..., : e.shape[-1]] = e
        found = Distant(c.reshape(-1, c.shape[-1]), c.ndim == 2)
    if not np.all(np.isfinite(found.norms)):
        raise ValueError(f"`lights`[{name!r}] must be finite everywhere; Environment.load clamps what is not.")
    return found


def _norms(coefficients: np.ndarray) -> np.ndarray:
    """Norms [..., l] of the bands."""
    starts = np.arange(_checks.degree_of(coefficients.shape[-1]) + 1) ** 2
    return np.sqrt(np.add.reduceat(coefficients**2, starts, axis=-1))


def predict(slices: np.ndarray, lights: np.ndarray, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """RMS of the product of slices and lights, and a bound on it, from norms of their bands [C, V, l] and [C, P, l].

    One for each colour [C]. The RMS is over views by their `shares` [V], points, and all rotations between slices and
    lights; the bound holds for the worst of the rotations.
    """
    energy = np.einsum("v,cvl->cl", shares, slices**2) * np.mean(lights**2, axis=1)
    worst = slices @ np.swapaxes(lights, 1, 2)  # [C, V, P]
    square = np.sum(energy / (2 * np.arange(slices.shape[-1]) + 1), axis=-1)
    return np.sqrt(square), np.sqrt(np.mean(np.einsum("v,cvp->cp", shares, worst**2), axis=1))


def worst(error: np.ndarray, radiance: np.ndarray) -> float:
    """The largest of errors relative to the radiance [C]; what is dark beside other colours has none."""
    dark = radiance <= _DARK * np.max(radiance)
    return float(np.max(np.where(dark, 0, error / np.where(dark, 1, radiance))))
