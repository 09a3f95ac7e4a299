"""Polygon lights, portals and projections of lights: ours beside sampling, quadrature and other closed forms.

Scenes, float32, 16,384 points: a floor with slightly varied normals, views to 80 degrees from them, below a panel
("floor"), beside a screen that stands on it, from 0.1 of its height on ("wall"), or below a tilted lamp of side 0.3 at
height 2 ("small"); each for five alphas.

Families (kernels and their sources: `area_lights`): ours, `shade` with a `PolygonLight` or `PortalLight` and slices
fitted above the horizon, slices beyond maps of directions, or the model at points; what is planned of them
(tests/bench/planned.py); Gauss points on the light, written
for this material and scene; Monte Carlo by solid angle, by the material, by both, all with shifted lattices; linearly
transformed cosines; 1 and 3 spherical Gaussians for each elevation, integrated over the light by Xu et al.'s rule; the
light's harmonics, turned to the local frame; axial moments. Points and samples of a portal look the distant light up in
a table, bilinearly, which costs 3e-4 of their accuracy; the triple product cuts the window at the slices' degree.
Derivatives are measured in the full run, in one polygon task, as their cost depends on no numbers: of ours, points and
samples of the light and transformed cosines; for projections of ours and of points. Those of points and samples are of
the sum as it stands, without what happens where the light crosses the horizon, and by JAX's reverse mode, which XLA
recomputes in many places: derivatives written by hand would be faster. Samples of the material have none, since what is
lit or not jumps; of the other routes and of portals they are not measured.

Left out, as they say nothing new: SH rotation and axial moments for alphas below 0.25, where slices of degree 12 leave
6 % and more; ours of degrees below 20 for alphas below 0.1; 3 Gaussians for all alphas but 0.25.

References: `reference.shade_polygon_quadrature` in float64 for the first 256 points, summed over parts of the light
that are graded about the mirror direction and the point's foot, and for projections SciPy's harmonics on a rule for
spherical triangles; errors are the differences to coarser rules.

    python -m tests.bench.local_lights --make     writes tests/bench/data/references_local_lights.npz
    python -m tests.bench.local_lights [--quick]  prints every row
"""

import functools
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import harmonics, models, reference, shading
from shisd.io.internal import write_atomically
from tests.bench import area_lights, lobes, planned, polygons
from tests.bench.harness import Method, Task, run
from tests.truth import scipy_basis, triangle_rule

FILE = Path(__file__).parent / "data" / "references_local_lights.npz"
COUNT, JUDGED = 16384, 256
TILE, SMALL = 4096, 256  # pixels at a time: of loops over samples; of long formulas and of derivatives
PROJECTIONS, PROJECTIONS_JUDGED = 2048, 32
LIGHT_DEGREE = 12
ALPHA = {f"GGX {alpha:g}": alpha for alpha in (0.5, 0.25, 0.1, 0.05, 0.02)}
NODES, STEPS = 8, 3.0 ** -np.arange(6)  # of references: in every cell; from where a light is cut
QUADS = {  # counter-clockwise seen from where they shine
    "floor": np.array([[-0.5, -0.5, 1.0], [-0.5, 0.5, 1.2], [0.5, 0.5, 1.2], [0.5, -0.5, 1.0]], np.float32),
    "wall": np.array([[1, 0, 0], [-1, 0, 0], [-1, 0, 1], [1, 0, 1]], np.float32),
    "small": np.array([[-0.15, -0.13, 2.0], [-0.15, 0.13, 2.15], [0.15, 0.13, 2.15], [0.15, -0.13, 2.0]], np.float32),
}
AREAS = {"floor": ([-2, -2], [2, 2]), "wall": ([-1.5, 0.1], [1.5, 2]), "small": ([-2, -2], [2, 2])}
TITLES = {"floor": "floor below a panel", "wall": "floor beside a screen", "small": "floor below a small lamp"}


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def points(scene: str) -> tuple[np.ndarray, ...]:
    """Positions, normals and views [N, 3]."""
    rng = np.random.default_rng(0)
    low, high = (np.array([*x, 0.0]) for x in AREAS[scene])
    positions = rng.uniform(low, high, (COUNT, 3))
    normals = unit([0, 0, 1] + 0.15 * rng.normal(size=(COUNT, 3)))
    cosine, azimuth = rng.uniform(np.cos(lobes.STEEPEST), 1, (COUNT, 1)), rng.uniform(0, 2 * np.pi, (COUNT, 1))
    x = unit(np.cross(normals, [0.3, 0.5, -0.7]))
    side = np.cos(azimuth) * x + np.sin(azimuth) * np.cross(normals, x)
    views = cosine * normals + np.sqrt(1 - cosine**2) * side
    return tuple(a.astype(np.float32) for a in (positions, normals, views))


def brdf(name: str):
    return models.Ggx(ALPHA[name], 0.04)


def lanes(name: str):
    """The same for `area_lights`."""
    return area_lights.Microfacet(jnp.float32(ALPHA[name]), jnp.float32(0.04))


# ---- what is run


def lit_by_polygon(parameters, quad, positions, normals, views):
    return shading.shade(parameters, models.PolygonLight(quad), shading.Surface(normals, views, positions))


def lit_by_plan(plan, quad, positions, normals, views):
    """The plan holds the light."""
    return plan.shade(planned.NAME, shading.Surface(normals, views, positions))


def lit_through_portal(parameters, quad, positions, normals, views):
    material, portal = parameters
    moved = eqx.tree_at(lambda p: p.points, portal, quad)
    return shading.shade(material, moved, shading.Surface(normals, views, positions))


@functools.cache
def shaded(kernel, *static, size: int = TILE):
    return functools.partial(area_lights.shade, functools.partial(kernel, *static) if static else kernel, size)


@functools.cache
def through(kernel, count: int):
    return shaded(area_lights.portal, kernel, count)


@functools.cache
def radiance_gradient(forward):
    """The sum of radiance, and its gradient in the outline, positions and views."""

    def total(quad, positions, views, parameters, normals):
        return jnp.sum(forward(parameters, quad, positions, normals, views))

    gradient = jax.value_and_grad(total, (0, 1, 2))
    return lambda parameters, quad, positions, normals, views: gradient(quad, positions, views, parameters, normals)


@functools.cache
def project_light(degree: int):
    return lambda weights, quad, positions: shading.project_light(models.PolygonLight(quad), positions, degree)


@functools.cache
def projected(kernel, *static, size: int = 128):
    return functools.partial(area_lights.project, functools.partial(kernel, *static), size)


@functools.cache
def projection_gradient(forward):
    """A weighted sum of coefficients, and its gradient in the outline and positions; the weights are the parameters."""
    total = lambda quad, positions, weights: jnp.sum(forward(weights, quad, positions) * weights[None])
    gradient = jax.value_and_grad(total, (0, 1))
    return lambda weights, quad, positions: gradient(quad, positions, weights)


# ---- what is made once for a scene


def timed(function, *arguments):
    """The result, and the seconds it took: compiling included where it is the first of its kind."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - start


@functools.cache
def fitted_slices(name: str, degree: int):
    return timed(functools.partial(shading.tabulate_brdf, domain="upper"), brdf(name), degree)


@functools.cache
def transformed_slices(name: str, degree: int):
    return timed(shading.transform_brdf, brdf(name), degree)


@functools.cache
def fitted_cosines(name: str):
    table, seconds = timed(polygons.fit_ltc, brdf(name), 64)
    return jax.tree.map(lambda x: x.astype(jnp.float32), table), seconds


@functools.cache
def fitted_gaussians(name: str, count: int):
    table, seconds = timed(lobes.fit_table, brdf(name), count)
    rows = [table.directions, jnp.log(table.sharpness)[..., None], table.weights[..., None]]
    return jnp.concatenate(rows, axis=-1).reshape(lobes.VIEWS, -1), seconds


# ---- tasks


def polygon_task(scene: str, name: str, stored, quick: bool) -> Task:
    half = slice(None, None, 2) if quick else slice(None)
    with_gradients = not quick and (scene, name) == ("floor", "GGX 0.5")
    methods, material, where = [], lanes(name), points(scene)
    narrow = ALPHA[name] < 0.1

    def add(family, setting, forward, parameters, differentiated=None, **more):
        gradient = radiance_gradient(differentiated) if with_gradients and differentiated is not None else None
        methods.append(Method(family, setting, forward, parameters, gradient, **more))

    for degree in (20,) if narrow else (4, 12) if quick else (4, 6, 8, 12, 20):
        table, seconds = fitted_slices(name, degree)
        differentiated = lit_by_polygon if degree == 8 else None  # compiling a derivative takes 10 s
        add("shisd", f"degree {degree}", lit_by_polygon, table, differentiated, setup=seconds, ours=True)
    for degree in (4, 8) if quick else (2, 4, 8):
        table, seconds = transformed_slices(name, degree)
        differentiated = lit_by_polygon if degree == 8 else None
        setting = f"degree {degree}"
        add("shisd, beyond maps", setting, lit_by_polygon, table, differentiated, setup=seconds, ours=True)
    for order in (2, 4, 8, 16)[half]:
        differentiated = lit_by_polygon if order == 4 else None
        model = shading.Quadrature(brdf(name), order)
        add("shisd, points", f"{order} x {order}", lit_by_polygon, model, differentiated, ours=True)
    methods += planned.methods(lit_by_plan, brdf(name), models.PolygonLight(QUADS[scene]), where[0], where[1])
    for family, kernel, differentiable in (
        ("Gauss points", area_lights.gauss_points, True),
        ("Monte Carlo, solid angle", area_lights.by_solid_angle, True),
        ("Monte Carlo, BRDF", area_lights.by_brdf, False),
        ("Monte Carlo, MIS", area_lights.by_both, False),
    ):
        gauss = family == "Gauss points"
        for side in (4, 8, 16, 32) if gauss and narrow else (2, 4, 8, 16)[half]:
            count, setting = (side, f"{side} x {side}") if gauss else (side * side, f"{side * side} samples")
            small = shaded(kernel, count, size=SMALL) if differentiable and side == 4 else None
            add(family, setting, shaded(kernel, count), material, small)
    table, seconds = fitted_cosines(name)
    kernel = shaded(area_lights.transformed_cosines, size=SMALL)
    add("linearly transformed cosines", "64 views", kernel, table, kernel, setup=seconds)
    for count in () if quick else (1, 3) if name == "GGX 0.25" else (1,):
        table, seconds = fitted_gaussians(name, count)
        kernel = shaded(area_lights.gaussians, 4, size=SMALL)
        add("spherical Gaussians", f"{count} for a view", kernel, table, setup=seconds)
    for degree in () if ALPHA[name] < 0.25 else (4,) if quick else (4, 8, 12):
        table, seconds = fitted_slices(name, degree)
        for family, kernel in (("SH rotation", area_lights.turned_harmonics), ("axial moments", area_lights.axial)):
            kernel = shaded(kernel, degree, size=128)
            add(family, f"degree {degree}", kernel, area_lights.slices(table), setup=seconds)
    return Task(
        f"polygon-lit {scene}, {name}",
        f"{name}, {TITLES[scene]}",
        "pixel",
        (QUADS[scene], *where),
        stored[f"{scene} {name}"],
        float(stored[f"{scene} {name} error"]),
        methods,
        count=COUNT,
    )


def portal_task(name: str, stored) -> Task:
    coefficients, methods = stored["portal light"], []
    for degree in (4, 12):
        table, seconds = fitted_slices(name, degree)
        light, more = timed(models.PortalLight, QUADS["floor"], coefficients)
        parameters = table, light
        own = Method("shisd", f"degree {degree}", lit_through_portal, parameters, setup=seconds + more, ours=True)
        product, more = timed(functools.partial(harmonics.product_matrix, input_degree=degree), coefficients, degree)
        parameters, kernel = (area_lights.slices(table), product), shaded(area_lights.triple_products, degree, size=128)
        methods += [own, Method("SH triple product", f"degree {degree}", kernel, parameters, setup=seconds + more)]
    for order in (2, 4, 8):
        parameters = shading.Quadrature(brdf(name), order), light
        methods.append(Method("shisd, points", f"{order} x {order}", lit_through_portal, parameters, ours=True))
    lookup = functools.partial(harmonics.evaluate, coefficients)
    texels, seconds = timed(lookup, area_lights.octahedron(513).astype(np.float32))
    for family, kernel, counts in (
        ("Gauss points", area_lights.gauss_points, (2, 4, 8, 16)),
        ("Monte Carlo, solid angle", area_lights.by_solid_angle, (4, 16, 64, 256)),
    ):
        for count in counts:
            setting = f"{count} x {count}" if family == "Gauss points" else f"{count} samples"
            kernel_of = through(kernel, count)
            methods.append(Method(family, setting, kernel_of, (lanes(name), texels), setup=seconds))
    return Task(
        f"portal, {name}",
        f"{name}, a window onto light of degree {LIGHT_DEGREE}",
        "pixel",
        (QUADS["floor"], *points("floor")),
        stored[f"portal {name}"],
        float(stored[f"portal {name} error"]),
        methods,
        count=COUNT,
    )


def projection_task(degree: int, stored, quick: bool) -> Task:
    """At one degree: what each method reaches for the same coefficients."""
    half = slice(None, None, 2) if quick else slice(None)
    size = (degree + 1) ** 2
    weights = jnp.asarray(np.random.default_rng(1).normal(size=size) / degree, jnp.float32)
    gradient = (lambda forward: None) if quick else projection_gradient
    forward = project_light(degree)
    methods = [Method("shisd", f"degree {degree}", forward, weights, gradient(forward), ours=True)]
    for family, gauss in (("Gauss points", True), ("Monte Carlo, solid angle", False)):
        for count in (16, 64, 256)[half]:
            setting = f"{int(count**0.5)} x {int(count**0.5)}" if gauss else f"{count} samples"
            kernel = projected(area_lights.project_points, degree, count, gauss, size=max(16, 2048 // count))
            differentiated = gradient(kernel) if gauss and count < 64 else None
            methods.append(Method(family, setting, kernel, weights, differentiated))
    kernel = projected(area_lights.project_lines, degree)
    methods.append(Method("line quadrature", f"degree {degree}", kernel, weights))
    if degree <= 16:
        kernel = projected(area_lights.project_axial, degree)
        methods.append(Method("axial moments", f"degree {degree}", kernel, weights))
    return Task(
        f"projection of a light, degree {degree}",
        f"A quad on harmonics of degree {degree}",
        "integral",
        (QUADS["floor"], points("floor")[0][:PROJECTIONS]),
        stored["projection"][:, :size],
        float(stored["projection error"]),
        methods,
        count=PROJECTIONS,
    )


def tasks(quick: bool) -> Iterator[Task]:
    """One after another, so that programs may be forgotten in between."""
    stored = np.load(FILE)
    for scene in ("floor",) if quick else QUADS:
        for name in ("GGX 0.5",) if quick else ALPHA:
            yield polygon_task(scene, name, stored, quick)
    if not quick:
        yield portal_task("GGX 0.5", stored)
    for degree in (8,) if quick else (8, 30):
        yield projection_task(degree, stored, quick)


# ---- references


def distant_light() -> np.ndarray:
    """Luminance of the room `interior` at degree 12, its panes seen through the window, mean 1."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the notes on texels that were clamped
        c = np.asarray(lobes.load_map("interior").coefficients(LIGHT_DEGREE), float)
    c = np.array([0.2126, 0.7152, 0.0722]) @ c
    return (c / (c[0] / np.sqrt(4 * np.pi))).astype(np.float32)


def relative(a, b) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)))


def cells_of(quad, positions, normals, views) -> np.ndarray:
    """Parts [N, cells, 4, 3] of a parallelogram, narrow where a point's mirror direction meets it, and below the point.

    Where the mirror direction misses it, that is where the half vector is nearest to the normal. Some have no area.
    """
    grid = np.linspace(0, 1, 201)
    u, v = (x.ravel() for x in np.meshgrid(grid, grid, indexing="ij"))
    at = lambda u, v: quad[0] + u[..., None] * (quad[1] - quad[0]) + v[..., None] * (quad[3] - quad[0])
    cells = []
    for position, normal, view in zip(positions, normals, views, strict=True):
        mirror = 2 * (normal @ view) * normal - view
        sides = np.stack([quad[1] - quad[0], quad[3] - quad[0], -mirror], axis=1)
        hit = np.linalg.solve(sides, position - quad[0])
        offset = at(u, v) - position
        if not (hit[2] > 0 and np.all((hit[:2] >= 0) & (hit[:2] <= 1))):
            best = np.argmax(unit(unit(offset) + view) @ normal)
            hit = np.array([u[best], v[best]])
        nearest = np.argmin(np.sum(offset**2, axis=1))
        cuts = [_cuts(hit[i], (u, v)[i][nearest]) for i in range(2)]
        a, b, c, d = (np.meshgrid(cuts[0][i], cuts[1][j], indexing="ij") for i, j in CORNERS)
        cells.append(np.stack([at(*x) for x in (a, b, c, d)], axis=2).reshape(-1, 4, 3))
    return np.stack(cells)


CORNERS = [(slice(None, -1), slice(None, -1)), (slice(1, None), slice(None, -1)), (slice(1, None), slice(1, None)),
           (slice(None, -1), slice(1, None))]  # fmt: skip


def _cuts(*places: float) -> np.ndarray:
    """From 0 to 1, closer by thirds to each place."""
    parts = [p + np.concatenate([-STEPS, [0], STEPS]) for p in places]
    return np.sort(np.clip(np.concatenate([[0, 1], *parts]), 0, 1))


@eqx.filter_jit
def _sum_of_cells(brdf, radiance, cells, positions, normals, views, nodes: int):
    """The reference [N], over every part of the light."""

    def one(row):
        cells, *at = row
        rows = [x[None] for x in at]
        judge = lambda quad: reference.shade_polygon_quadrature(brdf, quad, radiance, *rows, nodes=nodes)
        return jnp.sum(jax.vmap(judge)(cells))

    return jax.lax.map(one, (cells, positions, normals, views))


def make() -> None:
    stored = {"portal light": distant_light()}

    def add(key, values, coarse):
        stored[key] = values.astype(np.float32)
        stored[f"{key} error"] = max(relative(coarse, values), 3e-8)  # of rounding to float32
        print(f"{key}: error of the reference {stored[f'{key} error']:.1e}", flush=True)

    with jax.enable_x64(True):
        light = jnp.asarray(stored["portal light"], float)
        expansion = lambda w: harmonics.evaluate(light, w)
        jobs = [(scene, name, 1.0, f"{scene} {name}") for scene in QUADS for name in ALPHA]
        jobs += [("floor", "GGX 0.5", expansion, "portal GGX 0.5")]
        for scene, name, radiance, key in jobs:
            rows = [x[:JUDGED].astype(float) for x in points(scene)]
            cells = cells_of(QUADS[scene].astype(float), *rows)
            values = [_sum_of_cells(brdf(name), radiance, cells, *rows, nodes) for nodes in (NODES, 3 * NODES // 4)]
            add(key, *(np.asarray(x) for x in values))
    seen = [unit(QUADS["floor"].astype(float) - p) for p in points("floor")[0][:PROJECTIONS_JUDGED]]

    def coefficients(nodes):
        rules = [triangle_rule(v[::-1], nodes) for v in seen]
        return np.stack([area.astype(float) @ scipy_basis(w.astype(float), 30) for w, area in rules])

    add("projection", coefficients(24), coefficients(18))
    FILE.parent.mkdir(exist_ok=True)
    write_atomically(FILE, lambda file: np.savez_compressed(file, **stored), overwrite=True)


def main() -> None:
    if "--make" in sys.argv:
        return make()
    for task in tasks("--quick" in sys.argv):
        start = time.perf_counter()
        rows = run(task)
        print(f"\n{task.name}: {time.perf_counter() - start:.0f} s, error of the reference {task.reference_error:.1e}")
        for r in rows:
            gradient = "" if r["with gradient"] is None else f"{r['with gradient']:9.3f}"
            setup = "" if r["setup s"] is None else f"{r['setup s']:.2f}"
            print(f"{r['family']:30s} {r['setting']:13s} {r[f'us/{task.item}']:9.3f} {gradient:9s} "
                  f"{r['relative RMSE']:.1e} {r['max error / max']:.1e} {r['first call s']:5.1f} "
                  f"{r['first gradient s'] or 0:5.1f} {r['MB']:7.1f} {setup}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
