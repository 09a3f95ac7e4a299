"""What every public function does alike: precision, batches, transformations, forms of input, fields that act.

A function is one line in `CASES`; what has none is named in `WITHOUT` with the reason. Values are judged elsewhere.
"""

import dataclasses
import fnmatch
import functools
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import shisd.io
import shisd.plotting
import shisd.reference
from shisd import decomposition, domains, filtering, harmonics, models, reference, shading

ROOT = Path(__file__).resolve().parent.parent
N = 4  # rows of a batch
WITHOUT = {
    "io.*": "files and NumPy pictures",
    "plotting.*": "figures",
    "planning.*": "chooses on the host, from values",
    "filtering.denoise_merl": "a file or a NumPy table of one size, on the host",
    "filtering.*.*": "no method",
    "harmonics.sphere_rule": "takes no array",
    "decomposition.*_directions": "takes no array",
    "shading.Slices.needed_degree": "chooses on the host, from values",
    "*.size": "a number known while tracing",
    "*.degree": "a number known while tracing",
    "*.colour": "a shape",
    "*.slots": "a number known while tracing",
    "domains.HaarBasis.triangles": "a NumPy table",
    "domains.HaarBasis.areas": "a NumPy table",
    "domains.SphericalPolygon.loop": "for the package's own use",
    "domains.SphericalCap.versine": "a field in another form",
    "decomposition.*.zonal": "of a kernel: a table that `IsotropicBasis.zonal` makes",
    "decomposition.*Lobes.columns": "for `fit_lobes`",
    "decomposition.*Lobes.with_linear": "for `fit_lobes`",
    "decomposition.*Lobes.linear": "for `fit_lobes`",
    "models.*.lobe_width": "a hint; tests/models/test_contract.py",
    "models.AbstractBrdf.value": "abstract",
    "models.MeasuredBrdf.from_merl": "a file",
    "models.MeasuredBrdf.value": "a table of one size; tests/models/test_contract.py",
    "models.ProjectedBrdf.slice_coefficients": "part of `value`",
    "models.Environment.load": "a file",
    "models.Environment.from_function": "samples a function once, on the host",
    "models.Environment.directions": "takes no array",
    "models.Environment.solid_angles": "takes no array",
    "models.Visibility.save": "a file",
    "models.Visibility.load": "a file",
    "models.Visibility.from_mesh": "casts rays on the host",
    "models.PortalLight.two_sided": "known while tracing",
}


@dataclasses.dataclass(frozen=True)
class Case:
    """A public function with arguments: NumPy arrays, or objects that hold arrays.

    A name may have a second word, by which cases of one function differ.
    `batch` numbers those that have a leading axis of N rows; `native` says whether the function takes that axis itself
    or by `jax.vmap` alone. `heavy` cases compile for long: their numbers are compared among the slow tests. `idle`
    names the fields of the objects that rightly do not act on the result, "*" a function without derivatives.
    """

    name: str
    function: Callable
    arguments: Callable[[], tuple]
    batch: tuple[int, ...] = ()
    native: bool = True
    heavy: bool = False
    idle: tuple[str, ...] = ()

    @property
    def public(self) -> str:
        return self.name.split()[0]


RNG = np.random.default_rng(7)


def normal(*shape):
    return RNG.normal(size=shape).astype(np.float32)


def unit(*shape):
    d = RNG.normal(size=(*shape, 3))
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)


def above(normals, spread=0.5):
    d = normals + spread * unit(*normals.shape[:-1])
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)


W, UP = unit(N), np.broadcast_to(np.array([0, 0, 1], np.float32), (N, 3))
NORMALS, POSITIONS = above(UP, 0.3), normal(N, 3) * np.float32(0.1)
VIEWS, TANGENTS = above(NORMALS), unit(N)
BARYCENTRIC = np.abs(W) / np.abs(W).sum(1, keepdims=True)
WI, WO = above(UP), above(UP)
TRIANGLES = np.stack([above(UP[:3], 0.9)[[0, 1, 2]] for _ in range(N)])
TRIANGLES = np.stack([t if np.linalg.det(t) > 0 else t[::-1] for t in TRIANGLES])
PANEL = np.array([[0.5, -0.5, 2], [-0.5, -0.5, 2], [-0.5, 0.5, 2], [0.5, 0.5, 2]], np.float32)
MAP = np.abs(normal(6, 12, 3)) + np.float32(0.1)
TURN = np.linalg.qr(RNG.normal(size=(N, 3, 3)))[0]
TURN = (TURN * np.sign(np.linalg.det(TURN))[:, None, None]).astype(np.float32)
SAMPLES = unit(60)
AREAS = np.full(60, 4 * np.pi / 60, np.float32)
HEIGHTS = np.exp(4 * (SAMPLES @ np.array([[0, 0.6], [0, 0], [1, 0.8]], np.float32) - 1)).sum(1).astype(np.float32)
basis = lambda: decomposition.RotatedZonalBasis(decomposition.optimized_directions(2), 2)
kernels = lambda: decomposition.IsotropicBasis(
    decomposition.GaussianKernel(np.array([1, 2, 4], np.float32)), decomposition.separate_directions(2), 2
)
gaussians = lambda: decomposition.GaussianLobes(W[:2], np.array([2, 5], np.float32), normal(3, 2))
beyond = lambda: decomposition.TransformedExpansion(np.eye(3, dtype=np.float32) + 0.2 * normal(3, 3), normal(3, 9))
stretched = lambda: shading.TransformedSlices(0.2 * normal(4, 5), normal(3, 4, 4), normal(3, 4, 9))
stack = lambda objects: jax.tree.map(lambda *leaves: np.stack(leaves), *objects)
polygons = lambda: stack([domains.SphericalPolygon(t) for t in TRIANGLES])
panel = lambda: models.PolygonLight(PANEL, np.ones(3, np.float32))
lantern = lambda: models.PolygonLight(PANEL, np.ones(3, np.float32), profile=normal(4), two_sided=True)
portal = lambda: models.PortalLight(PANEL, normal(3, 9))
ball = lambda: models.SphereLight(np.array([0, 0.5, 2], np.float32), 0.5, np.ones(3, np.float32))
blocks = lambda: shading.BrdfMatrix(
    tuple(jnp.asarray(normal(3, 3 - m, 3 - m)) for m in range(3)), jnp.zeros((), np.float32), 2, 2, True
)
visibility = lambda: models.Visibility(normal(3, 9), np.array([[0, 1, 2]]))
footprint = lambda: shading.Footprint(W, normal(N, 3, 2) * np.float32(0.1))
environment = lambda: models.Environment(MAP)
distant = lambda: models.DistantLight(normal(3, 9))
zonal = lambda: models.ZonalLight(W[0], normal(3, 3))
anisotropic = lambda: shading.Slices(normal(3, 4, 3, 9), isotropic=False)
material = lambda: shading.Material(slices(), slices("upper"))
seen = lambda *more, **options: shading.Surface(NORMALS, VIEWS, *more, **options)
placed = lambda: seen(POSITIONS)
rotated = lambda: decomposition.ZonalLobes(W[:2], normal(3, 3, 2))


def slices(domain="sphere"):
    return shading.Slices(normal(3, 4, 9), domain=domain)


@functools.cache
def prefiltered():
    return shading.prefilter(slices(), distant())


BRDFS = {
    "Lambertian": lambda: models.Lambertian(normal(3)),
    "Phong": lambda: models.Phong(normal(3), 4.0, 0.2),
    "Ggx": lambda: models.Ggx(0.3, normal(3)),
    "CookTorrance": lambda: models.CookTorrance(0.4, 0.3, normal(3)),
    "AbcMicrofacet": lambda: models.AbcMicrofacet(0.1, 1.0, 20.0, 1.5, 1.4),
    "SgdMicrofacet": lambda: models.SgdMicrofacet(0.1, 0.2, 0.13, 0.8, 0.04, -0.5, 6.0, 2.7, 1e-2, 3.0, -0.3),
    "ProjectedBrdf": lambda: models.ProjectedBrdf(normal(3, 3, 3), isotropic=True),
}
SURFACE = (POSITIONS, NORMALS, VIEWS)
CASES = [
    Case("harmonics.sh_basis", lambda w: harmonics.sh_basis(w, 2), lambda: (W,), (0,)),
    Case("harmonics.legendre", lambda x: harmonics.legendre(x, 2), lambda: (W[:, 0],), (0,)),
    Case("harmonics.zonal_basis", lambda x: harmonics.zonal_basis(x, 2), lambda: (W[:, 0],), (0,)),
    Case("harmonics.evaluate", harmonics.evaluate, lambda: (normal(9), W), (1,)),
    Case(
        "harmonics.project",
        lambda a: harmonics.project(lambda w: a * w[..., 2].astype(a.dtype) ** 2, 2),
        lambda: (W[:, 0],),
        (0,),
        False,
    ),
    Case("harmonics.project_map", lambda t: harmonics.project_map(t, 2), lambda: (np.stack([MAP] * N),), (0,), False),
    Case("harmonics.synthesize_map", lambda c: harmonics.synthesize_map(c, 6), lambda: (normal(N, 3, 9),), (0,), False),
    Case("harmonics.rotate", harmonics.rotate, lambda: (normal(N, 9), TURN[0]), (0,)),
    Case("harmonics.multiply", lambda a, b: harmonics.multiply(a, b, 2), lambda: (normal(N, 9), normal(N, 9)), (0, 1)),
    Case("harmonics.product_matrix", lambda c: harmonics.product_matrix(c, 2), lambda: (normal(N, 9),), (0,), False),
    Case("harmonics.convolve", harmonics.convolve, lambda: (normal(N, 9), normal(3)), (0,)),
    Case("harmonics.convert", lambda c: harmonics.convert(c, "e3nn", "unsigned"), lambda: (normal(N, 9),), (0,)),
    Case("harmonics.apply_window", harmonics.apply_window, lambda: (normal(N, 9), normal(3)), (0,)),
    Case("harmonics.hann_window", lambda w: harmonics.hann_window(2, w), lambda: (3 + np.abs(W[:, 0]),), (0,), False),
    Case(
        "harmonics.laplacian_window",
        lambda s: harmonics.laplacian_window(2, s),
        lambda: (np.abs(W[:, 0]),),
        (0,),
        False,
    ),
    Case(
        "harmonics.dering",
        lambda c: harmonics.dering(c).coefficients,
        lambda: (normal(N, 9) + 3 * np.eye(9)[0],),
        (0,),
        heavy=True,
    ),
    Case(
        "decomposition.RotatedZonalBasis.weights",
        lambda b, c: b.weights(c),
        lambda: (basis(), normal(N, 9)),
        (1,),
    ),
    Case(
        "decomposition.RotatedZonalBasis.coefficients",
        lambda b, w: b.coefficients(w),
        lambda: (basis(), normal(N, 3, 5)),
        (1,),
    ),
    Case(
        "decomposition.RotatedZonalBasis.evaluate",
        lambda b, c, w: b.evaluate(c, w),
        lambda: (basis(), normal(3, 5), W),
        (2,),
    ),
    Case(
        "decomposition.RotatedZonalBasis.condition_numbers",
        lambda b: b.condition_numbers(),
        lambda: (basis(),),
        idle=("*",),  # of axes that are optimal several eigenvalues are one; elsewhere in test_basis
    ),
    Case("decomposition.IsotropicBasis.zonal", lambda b: b.zonal(), lambda: (kernels(),), idle=("directions",)),
    Case("decomposition.IsotropicBasis.matrix", lambda b: b.matrix(), lambda: (kernels(),)),
    Case(
        "decomposition.IsotropicBasis.weights",
        lambda b, c: b.weights(c),
        lambda: (kernels(), normal(N, 9)),
        (1,),
    ),
    Case(
        "decomposition.IsotropicBasis.solve",
        lambda b, c: [(x := b.solve(c, ridge=0.1)).weights, x.error],  # the condition is one for all
        lambda: (kernels(), normal(N, 9)),
        (1,),
    ),
    Case(
        "decomposition.IsotropicBasis.coefficients",
        lambda b, w: b.coefficients(w),
        lambda: (kernels(), normal(N, 3, 5)),
        (1,),
    ),
    Case(
        "decomposition.IsotropicBasis.evaluate",
        lambda b, c, w: b.evaluate(c, w),
        lambda: (kernels(), normal(3, 5), W),
        (2,),
    ),
    Case("decomposition.IsotropicBasis.condition_number", lambda b: b.condition_number(), lambda: (kernels(),)),
    Case(
        "decomposition.IsotropicBasis.filter",
        lambda b, c, s, r: b.filter(c, s, r),
        lambda: (kernels(), normal(3, 5), normal(3, 9), TURN),
        (3,),
    ),
    Case(
        "decomposition.IsotropicBasis.prefilter",
        lambda b, s: b.prefilter(s, 6),
        lambda: (kernels(), normal(3, 9)),
        idle=("directions",),
    ),
    Case(
        "decomposition.IsotropicBasis.filter_maps",
        lambda b, c, m, r: b.filter_maps(c, m, r),
        lambda: (kernels(), normal(3, 5), normal(3, 6, 12, 3), TURN),
        (3,),
        idle=("sharpness",),
    ),
    Case("decomposition.GaussianLobes.coefficients", lambda l: l.coefficients(2), lambda: (gaussians(),)),
    Case("decomposition.ZonalLobes.coefficients", lambda l: l.coefficients(2), lambda: (rotated(),)),
    Case("decomposition.GaussianLobes.evaluate", lambda l, w: l.evaluate(w), lambda: (gaussians(), W)),
    Case("decomposition.ZonalLobes.evaluate", lambda l, w: l.evaluate(w), lambda: (rotated(), W)),
    Case(
        "decomposition.optimize_directions",
        lambda d: decomposition.optimize_directions(d, 2, max_steps=2),
        lambda: (unit(6),),
        heavy=True,
    ),
    Case(
        "decomposition.fit_lobes",
        lambda s, w, y, a: decomposition.fit_lobes(s, w, y, a, max_steps=3, throw=False).lobes,
        lambda: (gaussians(), SAMPLES, HEIGHTS, AREAS),
        heavy=True,
        idle=("*",),
    ),
    Case(
        "decomposition.TransformedExpansion.directions",
        lambda f, w: f.directions(w),
        lambda: (beyond(), W),
        (1,),
        idle=("coefficients",),
    ),
    Case("decomposition.TransformedExpansion.evaluate", lambda f, w: f.evaluate(w), lambda: (beyond(), W)),
    Case(
        "decomposition.fit_transformed",
        lambda w, y, a: decomposition.fit_transformed(w, y, a, 1, start=np.eye(3), max_steps=0).expansion,
        lambda: (SAMPLES, HEIGHTS, AREAS),
        heavy=True,
    ),
    Case(
        "decomposition.sparse_weights",
        lambda b, c: decomposition.sparse_weights(b, c, 5)[0],  # of fewer axes some are alike
        lambda: (basis(), normal(N, 9)),
        (1,),
        heavy=True,
    ),
    Case(
        "domains.zonal_moments",
        lambda p, a: domains.zonal_moments(p, a, 2),
        lambda: (polygons(), W),
        (0,),
        False,
        heavy=True,
    ),
    Case(
        "domains.axial_moments",
        lambda p, a: domains.axial_moments(p, a, 2),
        lambda: (polygons(), W),
        (0,),
        False,
        heavy=True,
    ),
    Case(
        "domains.polygon_coefficients",
        lambda p: domains.polygon_coefficients(p, 2),
        lambda: (polygons(),),
        (0,),
        False,
        heavy=True,
    ),
    Case(
        "domains.integrate",
        lambda c, p: domains.integrate(c, p),
        lambda: (normal(N, 9), domains.SphericalPolygon(TRIANGLES[0])),
        (0,),
        heavy=True,
    ),
    Case("domains.solid_angle", domains.solid_angle, lambda: (polygons(),), (0,), False),
    Case("domains.clip_to_hemisphere", domains.clip_to_hemisphere, lambda: (polygons(), WI[0]), (0,), False),
    Case("domains.polygon_from_points", domains.polygon_from_points, lambda: (PANEL, POSITIONS), (1,), False),
    Case("domains.hemisphere", domains.hemisphere, lambda: (W,), (0,), False),
    Case(
        "domains.HaarBasis.coefficients", lambda x: domains.HaarBasis(1).coefficients(x), lambda: (normal(N, 32),), (0,)
    ),
    Case("domains.HaarBasis.values", lambda x: domains.HaarBasis(1).values(x), lambda: (normal(N, 32),), (0,)),
    Case(
        "domains.HaarBasis.evaluate",
        lambda c, w: domains.HaarBasis(1).evaluate(c, w),
        lambda: (normal(32), W),
        (1,),
    ),
    Case(
        "domains.HaarBasis.project",
        lambda p: domains.HaarBasis(0).project(p),
        lambda: (polygons(),),
        (0,),
        False,
        heavy=True,
    ),
    *(
        Case(f"models.{name}.value", lambda b, i, o: b.value(i, o), lambda make=make: (make(), WI, WO), (1, 2), False)
        for name, make in BRDFS.items()
    ),
    Case(
        "models.AbstractBrdf.value_cosine",
        lambda b, i, o: b.value_cosine(i, o),
        lambda: (BRDFS["Ggx"](), WI, WO),
        (1, 2),
        False,
    ),
    Case(
        "models.ProjectedBrdf.full_coefficients", lambda b: b.full_coefficients(), lambda: (BRDFS["ProjectedBrdf"](),)
    ),
    Case("models.Environment.coefficients", lambda e: e.coefficients(2), lambda: (environment(),)),
    Case("models.Environment.light", lambda e: e.light(2), lambda: (environment(),)),
    Case("models.Environment.radiance", lambda e, w: e.radiance(w), lambda: (environment(), W), (1,)),
    Case("models.DistantLight.rotated", lambda l, r: l.rotated(r), lambda: (distant(), TURN), (1,), False),
    Case("models.ZonalLight.distant", lambda l: l.distant(), lambda: (zonal(),)),
    Case("models.PolygonLight.incident", lambda l: l.incident(), lambda: (lantern(),), idle=("points",)),
    Case("models.PortalLight.incident", lambda l: l.incident(), lambda: (portal(),), idle=("points",)),
    Case(
        "models.PolygonLight.outline",
        lambda l, x: l.outline(x),
        lambda: (panel(), POSITIONS),
        (1,),
        False,
        idle=("emission",),
    ),
    Case(
        "models.PortalLight.outline",
        lambda l, x: l.outline(x),
        lambda: (portal(), POSITIONS),
        (1,),
        False,
        idle=("coefficients",),
    ),
    Case(
        "models.SphereLight.zonal_coefficients",
        lambda s, d: s.zonal_coefficients(d, 2),
        lambda: (ball(), 2 + W[:, 0]),
        (1,),
        idle=("center",),
    ),
    Case("models.Visibility.openness", lambda v: v.openness, lambda: (visibility(),), idle=("noise",)),
    Case(
        "models.Visibility.at",
        lambda v, t, w: v.at(t, w),
        lambda: (visibility(), np.zeros(N, np.int32), np.abs(W)),
        (1, 2),
        idle=("noise",),
    ),
    Case("models.cap_visibility", lambda a, t: models.cap_visibility(a, t, 2), lambda: (W, np.abs(W[:, 0])), (0, 1)),
    Case(
        "shading.Slices.weights",
        lambda s, b: s.weights(b),
        lambda: (slices(), basis()),
        idle=("error",),
    ),
    Case(
        "shading.Slices.from_weights",
        lambda b, w: shading.Slices.from_weights(b, w),
        lambda: (basis(), normal(3, 4, 3, 5)),
    ),
    Case(
        "shading.Slices.at",
        lambda s, v: s.at(v),
        lambda: (slices(), WO),
        (1,),
        False,
        idle=("error",),
    ),
    Case("shading.Slices.cut", lambda s: s.cut(1).coefficients, lambda: (slices(),), idle=("error",)),
    Case(
        "shading.Slices.above_horizon",
        lambda s: s.above_horizon().coefficients,
        lambda: (slices(),),
        idle=("error",),
    ),
    Case("shading.BrdfMatrix.matrix", lambda m: m.matrix(), lambda: (blocks(),), idle=("error",)),
    Case(
        "shading.BrdfMatrix.at",
        lambda m, v: m.at(v),
        lambda: (blocks(), WO),
        (1,),
        False,
        idle=("error",),
    ),
    Case(
        "shading.BrdfMatrix.slices",
        lambda m: m.slices(elevations=4).coefficients,
        lambda: (blocks(),),
        idle=("error",),
    ),
    Case(
        "shading.Footprint.from_derivatives",
        shading.Footprint.from_derivatives,
        lambda: (NORMALS, POSITIONS, PANEL[0], normal(N, 3, 2), normal(N, 3, 2)),
        (0, 1, 3, 4),
    ),
    Case(
        "shading.footprint",
        lambda n, x, e: shading.footprint(n, x, e, np.ones((2, 2), bool)),
        lambda: (NORMALS.reshape(2, 2, 3), POSITIONS.reshape(2, 2, 3), PANEL[0]),
    ),
    Case("shading.Slices.energies", lambda s: s.energies(), lambda: (slices(),), idle=("error",)),
    Case(
        "shading.tabulate_brdf",
        lambda f: shading.tabulate_brdf(f, 2, elevations=4, quadrature=48, throw=False),
        lambda: (BRDFS["Phong"](),),
        heavy=True,
    ),
    Case("shading.TransformedSlices.at", lambda s, v: s.at(v), lambda: (stretched(), UP[0]), idle=("errors",)),
    Case(
        "shading.transform_brdf",
        lambda f: shading.transform_brdf(f, 1, elevations=4, quadrature=8),
        lambda: (BRDFS["Phong"](),),
        heavy=True,
        idle=("*",),  # searches end near minima, which is not near enough for differences
    ),
    Case(
        "shading.project_brdf",
        lambda f: shading.project_brdf(f, 2, quadrature=48, throw=False).blocks,
        lambda: (BRDFS["Phong"](),),
        heavy=True,
        idle=("*",),  # the nodes follow the material, without a derivative: differences see them move
    ),
    Case(
        "shading.prepare",
        lambda f: shading.prepare(f, 2, local_degree=1, elevations=4, quadrature=48, throw=False),
        lambda: (BRDFS["Phong"](),),
        heavy=True,
    ),
    Case(
        "shading.Surface.points",
        lambda n, o, x, t, b, m, i: shading.Surface(n, o, x, t, mask=m, triangles=i, barycentric=b).points(
            "normals", "views", "positions", "tangents", "triangles", "barycentric"
        ),
        lambda: (NORMALS, VIEWS, POSITIONS, TANGENTS, BARYCENTRIC, np.arange(N) != 1, np.arange(N)),
        (0, 1, 2, 3, 4, 5, 6),
    ),
    Case(
        "shading.shade DistantLight",
        shading.shade,
        lambda: (slices(), distant(), seen()),
        (2,),
        heavy=True,
        idle=("error",),
    ),
    Case(
        "shading.shade tangents",
        shading.shade,
        lambda: (anisotropic(), distant(), seen(None, TANGENTS)),
        (2,),
        heavy=True,
        idle=("error",),
    ),
    Case(
        "shading.shade BrdfMatrix",
        shading.shade,
        lambda: (blocks(), distant(), seen()),
        (2,),
        heavy=True,
        idle=("error",),
    ),
    Case(
        "shading.shade ZonalLight",
        shading.shade,
        lambda: (slices(), zonal(), seen()),
        (2,),
        heavy=True,
        idle=("error",),
    ),
    Case(
        "shading.shade Occluded",
        lambda m, l, v, s: shading.shade(m, models.Occluded(l, v), s),
        lambda: (slices(), distant(), normal(N, 9), seen()),
        (2, 3),
        heavy=True,
        idle=("error",),
    ),
    Case(
        "shading.shade Visibility",
        shading.shade,
        lambda: (
            slices(),
            models.Occluded(zonal(), visibility()),
            seen(triangles=np.zeros(N, np.int32), barycentric=BARYCENTRIC),
        ),
        (2,),
        heavy=True,
        idle=("error", "noise"),
    ),
    Case(
        "shading.shade SphereLight",
        shading.shade,
        lambda: (slices(), ball(), placed()),
        (2,),
        heavy=True,
        idle=("error",),
    ),
    Case(
        "shading.shade PolygonLight",
        shading.shade,
        lambda: (slices("upper"), panel(), placed()),
        (2,),
        heavy=True,
        idle=("error",),
    ),
    Case(
        "shading.shade PortalLight",
        shading.shade,
        lambda: (slices("upper"), portal(), placed()),
        (2,),
        heavy=True,
        idle=("error",),
    ),
    Case(
        "shading.shade Quadrature",
        shading.shade,
        lambda: (shading.Quadrature(models.Ggx(np.float32(0.4), np.float32([0.3, 0.6, 1])), 16), portal(), placed()),
        (2,),
        heavy=True,
    ),
    Case(
        "shading.shade TransformedSlices",
        shading.shade,
        lambda: (stretched(), [panel(), ball()], placed()),
        (2,),
        heavy=True,
        idle=("errors",),
    ),
    Case(
        "shading.shade several",
        shading.shade,
        lambda: (material(), [distant(), ball(), panel(), distant()], seen(POSITIONS, mask=np.arange(N) != 1)),
        (2,),
        heavy=True,
        idle=("error",),
    ),
    Case(
        "shading.visibility_gamma",
        lambda l, b: shading.visibility_gamma(l, b, 2),
        lambda: (distant(), basis()),
        heavy=True,
    ),
    Case(
        "shading.project_light",
        lambda l, x: shading.project_light(l, x, 2),
        lambda: (panel(), POSITIONS),
        (1,),
        heavy=True,
    ),
    Case(
        "shading.prefilter",
        lambda m, l, like: shading.prefilter(m, l, like=like),
        lambda: (slices(), distant(), prefiltered()),
        heavy=True,
        idle=("*",),  # the channels of `like` are those of values; elsewhere in test_prefiltered
    ),
    Case(
        "shading.Prefiltered.radiance",
        lambda p, s: p.radiance(s),
        lambda: (prefiltered(), seen()),
        (1,),
        heavy=True,
        idle=("reduce", "expand", "error", "truncation"),
    ),
    Case("shading.reflect DistantLight", shading.reflect, lambda: (footprint(), distant()), (0,), heavy=True),
    Case(
        "shading.reflect MirrorMaps",
        shading.reflect,
        lambda: (footprint(), shading.MirrorMaps.from_texels(MAP, levels=3, degree=2)),
        (0,),
        heavy=True,
    ),
    Case(
        "shading.MirrorMaps.from_texels",
        lambda t: shading.MirrorMaps.from_texels(t, levels=3, degree=2),
        lambda: (MAP,),
        heavy=True,
    ),
    Case(
        "filtering.fit_brdf",
        lambda i, o, y: filtering.fit_brdf(i, o, y, 1, isotropic=True, ridge=1e-2).brdf,
        lambda: (above(np.tile(UP, (10, 1)), 0.9), above(np.tile(UP, (10, 1)), 0.9), np.abs(normal(40, 3))),
        heavy=True,
    ),
    Case(
        "filtering.smooth_brdf", filtering.smooth_brdf, lambda: (BRDFS["ProjectedBrdf"](), np.float32(30)), heavy=True
    ),
    Case(
        "reference.shade_environment",
        lambda f, e, n, o: reference.shade_environment(f, e, n, o, key=jax.random.key(0), samples=16),
        lambda: (BRDFS["Phong"](), environment(), NORMALS, VIEWS),
        heavy=True,
        idle=("*",),  # no derivative passes through where samples lie
    ),
    Case(
        "reference.shade_environment_quadrature",
        reference.shade_environment_quadrature,
        lambda: (BRDFS["Phong"](), environment(), NORMALS, VIEWS),
        heavy=True,
    ),
    Case(
        "reference.shade_polygon",
        lambda f, p, x, n, o: reference.shade_polygon(
            f, p, lambda w: jnp.ones_like(w[..., 0]), x, n, o, key=jax.random.key(0), samples=16
        ),
        lambda: (BRDFS["Phong"](), PANEL, *SURFACE),
        heavy=True,
    ),
    Case(
        "reference.shade_polygon_quadrature",
        lambda f, p, x, n, o: reference.shade_polygon_quadrature(
            f, p, lambda w: jnp.ones_like(w[..., 0]), x, n, o, nodes=4
        ),
        lambda: (BRDFS["Phong"](), PANEL, *SURFACE),
        heavy=True,
    ),
]
BY_NAME = {case.name: case for case in CASES}
BATCHED = [case for case in CASES if case.batch]
light_first = lambda cases, stage="": [
    pytest.param(case, id=case.name, marks=[] if case.name.startswith(stage) and not case.heavy else [pytest.mark.slow])
    for case in cases
]


@functools.cache
def stored(name: str) -> tuple:
    """The arguments of a case, in float32."""
    return jax.tree.map(np.asarray, BY_NAME[name].arguments())


def floating(a) -> bool:
    return np.issubdtype(getattr(a, "dtype", type(a)), np.floating)


def arguments(case: Case, dtype=np.float32, rows: int | None = None) -> tuple:
    """In one precision, and with so many rows."""
    cut = lambda i: lambda a: a[:rows] if i in case.batch and rows is not None else a
    cast = lambda a: jnp.asarray(a, dtype) if floating(a) else jnp.asarray(a)
    return tuple(jax.tree.map(lambda a, i=i: cast(cut(i)(a)), arg) for i, arg in enumerate(stored(case.name)))


def one_row(case: Case, inputs: tuple) -> tuple:
    """The last row of a batch."""
    last = lambda a: np.asarray(a)[-1]
    return tuple(jax.tree.map(last, x) if i in case.batch else x for i, x in enumerate(inputs))


def over_rows(case: Case) -> Callable:
    """The function of a batch, by `jax.vmap`."""
    return jax.vmap(case.function, [0 if i in case.batch else None for i in range(len(stored(case.name)))])


def of_batch(case: Case) -> Callable:
    return case.function if case.native or not case.batch else over_rows(case)


def close(got, expected, limit=1e-5):
    """Trees of arrays that agree to `limit` of the largest number of each."""
    got, expected = jax.tree.leaves(got), jax.tree.leaves(expected)
    assert len(got) == len(expected)
    for a, b in zip(got, expected, strict=True):
        a, b = np.asarray(a), np.asarray(b)
        assert a.shape == b.shape and a.dtype == b.dtype, (a.shape, b.shape, a.dtype, b.dtype)
        if b.size and floating(b):
            assert np.max(np.abs(a - b)) <= limit * max(np.max(np.abs(b)), 1e-3), np.max(np.abs(a - b))


def public() -> list[str]:
    """Every public function of the package, and every public method and property of its public classes."""
    names = []
    stages = [harmonics, decomposition, domains, models, shading, filtering, shisd.planning]
    for stage in [*stages, shisd.io, shisd.plotting, reference]:
        for name, value in vars(stage).items():
            own = getattr(value, "__module__", "") or ""
            if name.startswith("_") or not callable(value) or not own.startswith(stage.__name__):
                continue
            place = f"{stage.__name__.removeprefix('shisd.')}.{name}"
            if not isinstance(value, type):
                names.append(place)
                continue
            if issubclass(value, tuple | eqx.Enumeration):
                continue
            fields = {field.name for field in dataclasses.fields(value)} if dataclasses.is_dataclass(value) else set()
            bases = [
                c for c in value.__mro__ if c.__module__.startswith("shisd") and vars(stage).get(c.__name__) is not c
            ]
            for method, inner in [item for c in (value, *bases) for item in vars(c).items()]:
                if not method.startswith("_") and method not in fields and hasattr(inner, "__get__"):
                    names.append(f"{place}.{method}")
    return names


def test_every_public_function_has_a_line_or_a_reason():
    known = {case.public for case in CASES}
    missing = [name for name in public() if name not in known and not any(fnmatch.fnmatch(name, p) for p in WITHOUT)]
    assert missing == []
    assert known <= set(public()) and len(BY_NAME) == len(CASES)


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_precision_and_shapes_are_those_of_the_arguments(case):
    """Traced, not computed, with float64 at hand; for no rows too."""
    f = of_batch(case)

    def shapes(dtype, rows=None):
        result = jax.tree.leaves(jax.eval_shape(f, *arguments(case, dtype, rows)))
        wrong = [a for a in result if jnp.issubdtype(a.dtype, jnp.inexact) and a.dtype != dtype]
        assert wrong == []
        return [a.shape for a in result]

    with jax.enable_x64(True):
        plain = shapes(np.float32)
        assert case.heavy or plain == shapes(np.float64)
        if case.batch and case.native:
            assert shapes(np.float32, 0) == [(0, *s[1:]) if s and s[0] == N else s for s in plain]


@pytest.mark.parametrize("case", light_first(CASES, "harmonics."))
def test_transformations_change_nothing(case):
    """jit, vmap, lax.map, a loop, and the function as it is called."""
    inputs = arguments(case)
    f = of_batch(case)

    @jax.jit
    def ways(*inputs):
        results = {"jit": f(*inputs)}
        if case.batch:
            rows = [inputs[i] for i in case.batch]

            def one(rows):
                chosen = dict(zip(case.batch, rows, strict=True))
                return case.function(*(chosen.get(i, x) for i, x in enumerate(inputs)))

            results["map"] = jax.lax.map(one, rows)
            if case.native:
                results["vmap"] = over_rows(case)(*inputs)
        return results

    results = ways(*inputs)
    plain = jax.tree.map(np.asarray, f(*inputs) if case.native else results["jit"])
    if case.batch:
        last = jax.tree.map(lambda a: a[-1] if a.ndim and len(a) == N else a, plain)
        close(case.function(*jax.tree.map(jnp.asarray, one_row(case, inputs))), last)
    for result in results.values():
        close(result, plain)


@pytest.mark.parametrize("case", light_first([case for case in BATCHED if case.native], "harmonics."))
def test_single_and_empty_batches(case):
    f = case.function
    plain = jax.tree.map(np.asarray, f(*arguments(case)))
    for rows in (1, 0):
        first = jax.tree.map(lambda a, rows=rows: a[:rows] if a.ndim and a.shape[0] == N else a, plain)
        close(f(*arguments(case, rows=rows)), first)


@pytest.mark.parametrize("case", light_first(CASES))
def test_forms_of_arrays_change_nothing(case, as_user):
    """Lists, NumPy arrays with strides, of the other byte order, and read-only."""
    f = case.function
    inputs = stored(case.name) if case.native else one_row(case, stored(case.name))
    objects = lambda a: jax.tree.map(jnp.asarray, a)
    plain = f(*objects(inputs))
    forms = {
        "list": lambda a: a.tolist(),
        "strides": lambda a: np.repeat(a, 2, axis=-1)[..., ::2] if a.ndim else a,
        "columns first": lambda a: np.asarray(a, order="F"),
        "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")),
    }
    for name, form in forms.items():
        try:
            result = f(*(form(a) if isinstance(a, np.ndarray) and floating(a) else objects(a) for a in inputs))
        except Exception as error:
            raise AssertionError(name) from error
        close(result, plain)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_every_field_acts_and_has_a_gradient(case, x64):
    """The derivative in every floating field of an object, replaced as by `eqx.tree_at`, against a difference."""
    paths, tree = jax.tree_util.tree_flatten_with_path(arguments(case, np.float64))
    fields = [n for n, (path, leaf) in enumerate(paths) if len(path) > 1 and floating(leaf)]
    if not fields or case.idle == ("*",):
        pytest.skip("no object among the arguments, or no derivatives")
    names = [next(key.name for key in paths[n][0][::-1] if hasattr(key, "name")) for n in fields]
    leaves = [np.asarray(leaf) for _, leaf in paths]
    moves = [np.sin(1 + np.arange(leaves[n].size)).reshape(leaves[n].shape) * np.maximum(np.abs(leaves[n]), 0.1)
             for n in fields]  # fmt: skip

    def total(t):
        new = [jnp.asarray(leaf) for leaf in leaves]
        for i, (n, move) in enumerate(zip(fields, moves, strict=True)):
            new[n] = new[n] + t[i] * move
        results = [a for a in jax.tree.leaves(of_batch(case)(*jax.tree.unflatten(tree, new))) if floating(a)]
        return sum(jnp.sum(a * np.cos(np.arange(a.size)).reshape(a.shape)) for a in results)

    both = jax.jit(jax.value_and_grad(total))
    slopes = both(np.zeros(len(fields)))[1]
    for i, (name, step) in enumerate(zip(names, 1e-5 * np.eye(len(fields)), strict=True)):
        expected = float(both(step)[0] - both(-step)[0]) / 2e-5
        if name in case.idle:
            assert slopes[i] == expected == 0, name
        else:
            assert abs(expected) > 1e-6, f"{name} does not act"
            assert float(slopes[i]) == pytest.approx(expected, rel=1e-4, abs=1e-6), name


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in BATCHED if case.native], ids=lambda c: c.name)
def test_sharded_batches_are_as_others(case):
    if jax.device_count() < 2:
        pytest.skip("one device; the next test starts this one with two")
    mesh = jax.make_mesh((2,), ("rows",), axis_types=(jax.sharding.AxisType.Explicit,))
    place = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("rows"))
    inputs = arguments(case)
    split = [jax.device_put(x, place) if i in case.batch else x for i, x in enumerate(inputs)]
    close(jax.jit(case.function)(*split), jax.jit(case.function)(*inputs))


@pytest.mark.slow
def test_sharded_batches_on_two_devices():
    environment = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", __file__]
    command += ["-m", "slow", "-k", "sharded_batches_are_as_others"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0 and "skipped" not in done.stdout, done.stdout + done.stderr
