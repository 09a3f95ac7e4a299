"""Measure speed beside error and write the tables: python -m tests.bench.run [--output DIR] [--pages] [--only NAME].

Results go to DIR/bench.json and DIR/bench.md; --pages also puts the tables between the markers of
docs/benchmarks.md and figures into docs/figures/.
Allocator: outputs of tens of megabytes page-fault on every call with glibc's defaults, for every method alike; `make
bench` sets MALLOC_ARENA_MAX=1 MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=4000000000 MALLOC_TOP_PAD_=1000000000. XLA
flags: default.
"""

import argparse
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from shisd import decomposition, domains, models, reference, shading
from shisd.domains.moments import fold
from shisd.harmonics import _tables
from shisd.io.internal import write_atomically
from tests.bench import conditioning, equation_22, lobes, native, planning, polygons, stability
from tests.bench.timing import interleaved
from tests.truth import zonal_moments

POINTS = 10_000
PIXELS = 128 * 128


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def bench_equation_22(degrees=(4, 8, 16, 30)):
    """Eq. 22 at 128 x 128 pixels (degree 30: 64 x 32), RGB, GGX of alpha 0.3, float32; errors against exact slices."""
    rng = np.random.default_rng(0)
    normals = unit(rng.normal(size=(PIXELS, 3)))
    views = unit(rng.normal(size=(PIXELS, 3)))
    views *= np.sign(np.sum(normals * views, axis=1, keepdims=True))
    normals, views = jnp.asarray(normals, jnp.float32), jnp.asarray(views, jnp.float32)
    brdf = models.Ggx(0.3, 0.04)
    rows = []
    for degree in degrees:
        basis = decomposition.RotatedZonalBasis(decomposition.optimized_directions(degree), degree)
        material = shading.tabulate_brdf(brdf, degree)
        # a light whose band energies fall like 1/(l+1)^2, as those of measured environments do
        light = rng.normal(size=(3, (degree + 1) ** 2)) / (1 + _tables.bands(degree)) ** 1.5
        light = jnp.asarray(light, jnp.float32)
        candidates = equation_22.methods(material, basis, light)
        count = PIXELS if degree <= 16 else PIXELS // 8  # the literal form stacks pixels x (2L+1) x (L+1)^2 numbers
        truth = equation_22.exact_slices(brdf, light, normals[:64], views[:64])
        times = interleaved(candidates, normals[:count], views[:count])
        for name, method in candidates.items():
            error = np.asarray(method(normals[:count], views[:count])[:64]) - truth
            rows.append({
                "degree": degree,
                "method": name,
                "us/pixel": times[name].median / count * 1e6,
                "speed / literal": times["literal"].median / times[name].median,
                "relative RMSE": float(np.sqrt(np.mean(error**2) / np.mean(truth**2))),
                "max error / max": float(np.max(np.abs(error)) / np.max(np.abs(truth))),
                "first call s": times[name].first,
            })  # fmt: skip
        distant = models.DistantLight(light)
        shaded = lambda n, v, m=material, light=distant: shading.shade(m, light, shading.Surface(n, v))
        gradient = jax.jit(jax.grad(lambda n, v, f=shaded: jnp.sum(f(n, v)), (0, 1)))
        forward = candidates["rotated"]
        times = interleaved({"gradient": gradient, "forward": forward}, normals[:count], views[:count])
        rows[-1]["value and gradient / forward"] = times["gradient"].median / times["forward"].median
    return rows


def bench_memory(degree=30):
    """Peak memory of a process that shades 1024 x 768 pixels at degree 30, RGB."""
    command = [sys.executable, "-m", "tests.bench.run", "--memory-child", str(degree)]
    child = subprocess.run(command, capture_output=True, text=True, check=True)
    return [{"degree": degree, "pixels": 1024 * 768, **json.loads(child.stdout.splitlines()[-1])}]


def memory_child(degree):
    rng = np.random.default_rng(0)
    status = Path("/proc/self/status")  # not getrusage: its peak starts from that of the parent process
    peak = lambda: int(status.read_text().split("VmHWM:")[1].split()[0]) / 2**20
    normals = unit(rng.normal(size=(1024 * 768, 3))).astype(np.float32)
    material = shading.tabulate_brdf(models.Ggx(0.3), degree)
    light = models.DistantLight(rng.normal(size=(3, (degree + 1) ** 2)).astype(np.float32))
    before = peak()
    jax.block_until_ready(shading.shade(material, light, shading.Surface(normals, normals)))
    print(json.dumps({"peak GiB, whole process": peak(), "before shading": before}))


def folded(axes, w):
    """The library's weighted sum of moments, of tiles [T, 3, S, p] of polygons; `w` [L+1, K] as for the C++."""
    degree = len(w) - 1
    l = np.maximum(np.arange(degree + 1), 1)
    scaled = jnp.asarray((w / (l * (l + 1))[:, None]).T[..., None], jnp.float32)
    tile = jax.checkpoint(lambda v: fold(scaled, jnp.asarray(axes), v, degree))
    return lambda v: jax.lax.map(tile, v).reshape(-1)


def bench_polygons(degrees=(8, 20)):
    """Integrals of 2L+1 weighted lobes over 16,384 quads of 0.5 rad, float32, against C++ on one thread (AVX2)."""
    rng = np.random.default_rng(0)
    quads = polygons.spherical_polygons(rng, PIXELS, 4, 0.5).astype(np.float32)
    tiles = jnp.asarray(quads.reshape(-1, 8192, 4, 3).transpose(0, 3, 2, 1))
    rows = []
    for degree in degrees:
        axes = unit(rng.normal(size=(2 * degree + 1, 3))).astype(np.float32)
        w = rng.normal(size=(degree + 1, len(axes))).astype(np.float32)
        w[0] = 0
        summed = folded(axes, w)
        ours = jax.jit(summed)
        gradient = jax.jit(jax.value_and_grad(lambda v, summed=summed: jnp.sum(summed(v))))
        times = interleaved(
            {
                "ours": ours,
                "gradient": gradient,
                "plain": lambda v, axes=axes, w=w: native.polygon_moments(quads, axes, w),
                "same": lambda v, axes=axes, w=w: native.polygon_moments(quads, axes, w, difference=True),
            },
            tiles,
        )
        truth = np.array([np.sum(w * zonal_moments(q, axes, degree, 30).T) for q in quads[:64]])
        error = lambda got, truth=truth: float(np.max(np.abs(np.asarray(got)[:64] - truth)) / np.max(np.abs(truth)))
        rows.append({
            "degree": degree,
            "us/quad": times["ours"].median / PIXELS * 1e6,
            "speed / C++, same recurrence": times["same"].median / times["ours"].median,
            "speed / C++, plain recurrence": times["plain"].median / times["ours"].median,
            "value and gradient / forward": times["gradient"].median / times["ours"].median,
            "max error / max": error(ours(tiles)),
            "C++, plain: error": error(native.polygon_moments(quads, axes, w)),
            "first call s": times["ours"].first,
        })  # fmt: skip
    return rows


def bench_polygon_degree(degrees=(8, 12, 16, 24, 32, 48, 64)):
    """Cost of one integral over a triangle against the number of coefficients (L+1)^2, float32; 2L+1 lobes."""
    rng = np.random.default_rng(0)
    tiles = jnp.asarray(
        polygons.spherical_polygons(rng, PIXELS, 3, 0.5).reshape(-1, 8192, 3, 3).transpose(0, 3, 2, 1), jnp.float32
    )
    functions = {}
    for degree in degrees:
        axes = unit(rng.normal(size=(2 * degree + 1, 3))).astype(np.float32)
        functions[degree] = jax.jit(folded(axes, rng.normal(size=(degree + 1, len(axes)))))
    times = interleaved(functions, tiles)
    cost = {degree: times[degree].median / PIXELS * 1e6 for degree in degrees}
    return [
        {
            "degree": degree,
            "coefficients": (degree + 1) ** 2,
            "us/triangle": us,
            "ns per coefficient": 1e3 * us / (degree + 1) ** 2,
            "first call s": times[degree].first,
        }
        for degree, us in cost.items()
    ]


def bench_moments(degrees=(4, 8, 12, 16, 20, 30, 40, 60, 100)):
    """Error over solid angle of the moments of P_l over 8 quads at 9 random axes: cosine powers, zonal moments."""
    rows = []
    for size in (0.5, 0.06):
        rng = np.random.default_rng(1)
        quads, axes = polygons.spherical_polygons(rng, 8, 4, size), unit(rng.normal(size=(9, 3)))
        for degree in degrees:
            row = {"size rad": size, "degree": degree}
            for dtype in (np.float32, np.float64):
                v, d = quads.astype(dtype), axes.astype(dtype)
                truth = np.stack([zonal_moments(q, d, degree, 20 + degree // 2) for q in v])
                scale = truth[:, :1, 0]
                with jax.enable_x64(dtype == np.float64):
                    moments = jax.vmap(
                        lambda q, d=d, l=degree: domains.zonal_moments(domains.SphericalPolygon(q), d, l)
                    )
                    ours = np.asarray(moments(jnp.asarray(v)))
                powers = polygons.zonal_from_axial(polygons.axial_moments(v, d, degree, dtype))
                error = lambda got, t=truth, s=scale: float(np.max(np.abs(got[..., -1] - t[..., -1]) / s))
                row |= {f"cosine powers, {dtype.__name__}": error(powers), f"zonal, {dtype.__name__}": error(ours)}
            rows.append(row)
    return rows


POLYGON_LIGHT = np.array([[-0.5, -0.5, 1.0], [-0.5, 0.5, 1.2], [0.5, 0.5, 1.2], [0.5, -0.5, 1.0]], np.float32)


def polygon_light_points(count):
    """Positions on a floor below the light, views from above, and normals, [count, 3] each."""
    rng = np.random.default_rng(0)
    position = (rng.uniform(-2, 2, (count, 3)) * [1, 1, 0]).astype(np.float32)
    view = unit(rng.normal(size=(count, 3)) * [1, 1, 0.5] + [0, 0, 1.2]).astype(np.float32)
    view[:, 2] = np.abs(view[:, 2])
    return position, view, np.broadcast_to(np.array([0, 0, 1], np.float32), view.shape)


def bench_ridge(ridges=(1e-2, 1e-4, 1e-6, 1e-8, 1e-10), degree=8, count=64):
    """Relative RMSE of slices fitted above the horizon against the ridge of the fit, at degree 8; the same light."""
    position, view, normal = polygon_light_points(count)
    quad = POLYGON_LIGHT.astype(float)
    rows = [{"ridge": ridge} for ridge in ridges]
    for name, make in {"Lambertian": lambda: models.Lambertian(0.8), "GGX 0.5": lambda: models.Ggx(0.5, 0.04)}.items():
        with jax.enable_x64(True):
            exact = [x.astype(float) for x in (position, normal, view)]
            truth = np.asarray(reference.shade_polygon_quadrature(make(), quad, 1.0, *exact, nodes=48))
        for dtype in (np.float32, np.float64):
            with jax.enable_x64(dtype == np.float64):
                surface = shading.Surface(*(x.astype(dtype) for x in (normal, view, position)))
                light = models.PolygonLight(quad.astype(dtype))
                for row in rows:
                    material = shading.tabulate_brdf(make(), degree, domain="upper", ridge=row["ridge"])
                    error = np.asarray(shading.shade(material, light, surface)) - truth
                    row[f"{name}, {dtype.__name__}"] = float(np.sqrt(np.mean(error**2) / np.mean(truth**2)))
    return rows


def cost_figure(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    n, us = np.array([r["coefficients"] for r in rows]), np.array([r["us/triangle"] for r in rows])
    figure, axes = pyplot.subplots(figsize=(5.5, 3.4))
    axes.loglog(n, us, "o-", label="measured")
    axes.loglog(n, us[-1] * n / n[-1], "k:", label="in proportion")
    for r in rows:
        axes.annotate(
            f"degree {r['degree']}",
            (r["coefficients"], r["us/triangle"]),
            (4, -11),
            textcoords="offset points",
            fontsize=7,
        )
    axes.set(xlabel="coefficients $(L+1)^2$", ylabel="us per triangle", title="Cost of one integral over a triangle")
    axes.legend()
    figure.tight_layout()
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=120), overwrite=True)
    pyplot.close(figure)


DOCS = Path("docs")
README = DOCS.parent / "README.md"
BENCHES = {
    "equation_22": bench_equation_22,
    "memory": bench_memory,
    "moments": bench_moments,
    "polygons": bench_polygons,
    "polygon_degree": bench_polygon_degree,
    "ridge": bench_ridge,
    "directions": conditioning.bench_directions,
    "objectives": conditioning.bench_objectives,
    "kernels": conditioning.bench_kernels,
    "kernel_pictures": conditioning.bench_kernel_pictures,
    "lobes": lobes.compare,
    "prediction": planning.bench_prediction,
    "tolerances": planning.bench_tolerances,
    "saving": planning.bench_saving,
    "stability": stability.bench_stability,
}
FIGURES = {
    "polygon_degree": ("polygon_cost.png", cost_figure),
    "kernels": ("conditioning.png", conditioning.kernels_figure),
    "lobes": ("lobes.png", lobes.figure),
}
PAGES = {  # markers, and the benchmarks whose tables stand between them
    "conditioning": ("directions", "objectives", "kernels", "kernel_pictures"),
    "lobes": ("lobes",),
    "planning": ("prediction", "tolerances", "saving"),
    "stability": ("stability",),
}
PAGES["bench"] = tuple(name for name in BENCHES if not any(name in names for names in PAGES.values()))


def table(rows):
    """A Markdown table; columns that only some rows have are left empty in the others."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    show = lambda x: (
        ""
        if x is None
        else f"{x:.2g}"
        if isinstance(x, float) and not 0.1 <= abs(x) < 1000
        else f"{x:.2f}"
        if isinstance(x, float)
        else str(x)
    )
    lines = [columns, ["---"] * len(columns), *([show(row.get(c)) for c in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def paste(name, text, page=DOCS / "benchmarks.md"):
    """Put a text between the markers of a name in a page."""
    start = f"<!-- table:{name} -->"
    before, rest = page.read_text().split(start)
    rest = rest.split("<!-- /table -->", 1)[1]
    write_atomically(page, f"{before}{start}\n{text}\n<!-- /table -->{rest}", overwrite=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("output/bench"))
    parser.add_argument("--only", choices=BENCHES, action="append")
    parser.add_argument("--pages", action="store_true", help="put the tables into docs/benchmarks.md")
    parser.add_argument("--paste", nargs=2, metavar=("NAME", "FILE"), help="put an example's table into that page")
    parser.add_argument("--memory-child", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.memory_child is not None:
        return memory_child(arguments.memory_child)
    if arguments.paste:
        return paste(arguments.paste[0], Path(arguments.paste[1]).read_text().rstrip())
    arguments.output.mkdir(parents=True, exist_ok=True)
    results, sections = {}, {}
    for name in arguments.only or BENCHES:
        results[name] = BENCHES[name]()
        shown = lobes.summary(results[name]) if name == "lobes" else results[name]
        sections[name] = f"{inspect.cleandoc(BENCHES[name].__doc__)}\n\n{table(shown)}"
        print(sections[name], "\n", flush=True)
        if name in FIGURES:
            file, draw = FIGURES[name]
            draw(results[name], arguments.output / file)
            if arguments.pages:
                draw(results[name], DOCS / "figures" / file)
    tuned = os.environ.get("MALLOC_MMAP_MAX_") == "0"
    allocator = "tuned" if tuned else "default"
    note = f"{os.cpu_count()} cores, jax {jax.__version__}, default XLA flags, {allocator} allocator."
    write_atomically(arguments.output / "bench.json", json.dumps(results, indent=1), overwrite=True)
    write_atomically(arguments.output / "bench.md", "\n\n".join([*sections.values(), note]) + "\n", overwrite=True)
    for marker, names in PAGES.items() if arguments.pages else ():
        if all(name in sections for name in names):
            paste(marker, "\n\n".join([*(sections[name] for name in names), note]))


if __name__ == "__main__":
    main()
