"""Relight a sphere and a rabbit with two photographed rooms, and measure what that costs and how wrong it is.

Four materials, one of them read from a MERL file, are turned into sums of rotated zonal harmonics of degree 4, 8, 16
and 30 and shaded under each map (ISD15 Eq. 22). Every picture is compared with Monte Carlo integration of the same
scene, whose own error is known and taken off. Writes pictures, false-colour errors and a table to --output.

    python examples/relight.py --output output/relight
"""

import csv
import itertools
import tempfile
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from io import StringIO
from pathlib import Path

import _scene
import jax
import numpy as np
from tqdm import tqdm

from shisd import io, models, plotting, reference, shading

DATA = Path(__file__).resolve().parent / "data"
DEGREES = (4, 8, 16, 30)
MAPS = {"interior": ("interior.hdr", 0.45, -0.363), "studio": ("studio.exr", 1.0, -0.451)}  # file, exposure, turns
AZIMUTH = 5.0  # of the camera, in radians
WORST, BEST = 1.0, 1e-3  # relative errors at the ends of the false-colour scale


def gold_metallic_paint() -> models.SgdMicrofacet:
    """MERL's gold-metallic-paint as fitted by Bagher, Soler and Holzschuch 2012 (supplement, row of that name)."""
    return models.SgdMicrofacet(
        np.array([0.0178625, 0.00995704, 0.00335044]),
        np.array([0.17127, 0.120714, 0.115473]),
        np.array([0.127954, 0.127825, 0.109623]),
        np.array([0.781093, 0.795517, 0.661313]),
        np.array([1.00776e-12, 1.22243e-15, 6.18432e-13]),
        np.array([-1.0, -1.0, -0.334497]),
        np.array([5.90039, 5.83556, 7.14985]),
        np.array([2.7548, 2.7057, 2.94348]),
        np.array([9.46481e-08, 1.06951e-07, 1.10733e-07]),
        np.array([23.8811, 23.9059, 24.2972]),
        np.array([-0.303345, -0.293778, -0.267019]),
    )


def through_a_merl_file(brdf: models.AbstractBrdf) -> models.MeasuredBrdf:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "material.binary"
        io.write_merl(path, brdf)
        return models.MeasuredBrdf.from_merl(path)


def materials() -> dict[str, models.AbstractBrdf]:
    return {
        "clay": models.Lambertian(np.array([0.75, 0.6, 0.5])),
        "red plastic": models.CookTorrance(roughness=0.5, metallic=0.0, albedo=np.array([0.6, 0.06, 0.05])),
        "copper": models.CookTorrance(roughness=0.45, metallic=1.0, albedo=np.array([0.95, 0.64, 0.54])),
        "gold paint (measured)": through_a_merl_file(gold_metallic_paint()),
    }


def load_map(name: str) -> models.Environment:
    """A map of the examples at 512 x 256, flipped so that the room is not mirrored, and turned about the vertical."""
    file, _, turn = MAPS[name]
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        texels = models.Environment.load(DATA / file).texels
    for warning in found:
        print(f"note: {Path(str(warning.message)).name}")
    step = texels.shape[0] // 256
    texels = texels.reshape(256, step, 512, step, 3).mean(axis=(1, 3))
    return models.Environment(np.roll(texels[:, ::-1], round(512 * turn), axis=1))


def compare(image: np.ndarray, truth: np.ndarray, bar: np.ndarray) -> tuple[float, float]:
    """Relative RMSE against an estimate, its noise taken off, and that noise, both over the RMS of the truth."""
    scale, noise2 = np.mean(truth**2), np.mean(bar**2)
    excess = np.mean((image - truth) ** 2) - noise2
    doubt = np.sqrt(2 / len(truth)) * noise2  # one deviation of the excess when there is no error at all
    return float(np.sqrt(max(excess, doubt) / scale)), float(np.sqrt(noise2 / scale))


def best_time(function: Callable, *arguments) -> float:
    """The better of two wall times, in seconds."""
    times = []
    for _ in range(2):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return min(times)


def error_picture(view: _scene.View, image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    error = np.linalg.norm(image - truth, axis=1) / np.linalg.norm(truth, axis=1).mean()
    return view.picture(plotting.false_colour(error, limits=(BEST, WORST)))


def run(output: Path, size: int, samples: int, seed: int, degrees: tuple[int, ...]) -> list[dict]:
    environments = {name: load_map(name) for name in MAPS}
    brdfs = materials()
    shapes = {"sphere": _scene.sphere(size, AZIMUTH), "rabbit": _scene.mesh(DATA / "bunny.ply", size, AZIMUTH)}
    normals = np.concatenate([view.normals for view in shapes.values()])  # all pixels of both objects at once
    views = np.concatenate([view.views for view in shapes.values()])
    split = np.cumsum([0, *(len(view.normals) for view in shapes.values())])
    part = {shape: slice(*ends) for shape, ends in zip(shapes, zip(split[:-1], split[1:], strict=True), strict=True)}

    jobs = [(material, light) for material in brdfs for light in environments]
    keys = dict(zip(jobs, jax.random.split(jax.random.key(seed), len(jobs)), strict=True))

    def integrate(job):
        brdf, environment = brdfs[job[0]], environments[job[1]]
        estimate = reference.shade_environment(brdf, environment, normals, views, key=keys[job], samples=samples)
        return np.asarray(estimate.value, float), np.asarray(estimate.standard_error, float)

    with ThreadPoolExecutor(2) as pool:
        truths = dict(zip(jobs, tqdm(pool.map(integrate, jobs), "Monte Carlo", len(jobs)), strict=True))

    # One table per material serves every degree: light without high bands does not see those of the slices.
    slices = {name: shading.tabulate_brdf(brdf, max(degrees)) for name, brdf in tqdm(brdfs.items(), "slices")}
    cases = list(itertools.product(brdfs, environments, degrees))

    def shade(case):
        material, light, degree = case
        return shading.shade(
            slices[material], models.DistantLight(coefficients[light, degree]), shading.Surface(normals, views)
        )

    coefficients = {(name, d): environments[name].coefficients(d) for name in environments for d in degrees}
    images, rows = {}, []
    for case in tqdm(cases, "shading"):
        images[case] = np.asarray(shade(case), float)  # the first of each degree compiles
        material, light, degree = case
        row = {"material": material, "map": light, "degree": degree}
        for shape, pixels in part.items():
            truth, bar = (a[pixels] for a in truths[material, light])
            row[f"{shape} error"], row[f"{shape} noise"] = compare(images[case][pixels], truth, bar)
        rows.append({**row, "us/pixel": 1e6 * best_time(shade, case) / len(normals)})

    gallery = []  # every object, room and material at the highest degree
    for shape, light in tqdm(list(itertools.product(shapes, environments)), "pictures"):
        view, exposure = shapes[shape], MAPS[light][1]
        background = np.asarray(environments[light].radiance(view.rays.astype(np.float32), texels="samples"))
        show = lambda values, v=view, b=background, e=exposure: io.tonemap(v.picture(values, b), exposure=e)
        panels = {}
        for material in brdfs:
            truth, bar = (a[part[shape]] for a in truths[material, light])
            panels[material] = [(show(truth), error_picture(view, truth + bar, truth))]
            for degree in degrees:
                image = images[material, light, degree][part[shape]]
                panels[material].append((show(image), error_picture(view, image, truth)))
                name = f"{shape}_{light}_{material.split(' (')[0].replace(' ', '-')}_degree{degree:02d}.png"
                io.write_image(output / name, np.concatenate(panels[material][-1], axis=1), overwrite=True)
        errors = {}
        for material in brdfs:
            series = [r for r in rows if (r["material"], r["map"]) == (material, light)]
            errors[material] = [series[0][f"{shape} noise"], *(r[f"{shape} error"] for r in series)]
        contact_sheet(output / f"{shape}_{light}.png", f"{shape}, {light}", panels, degrees, errors)
        gallery.append(np.concatenate([images[-1][0] for images in panels.values()], axis=1))
    io.write_image(output / "gallery.png", np.concatenate(gallery, axis=0), overwrite=True)
    return rows


def contact_sheet(path: Path, title: str, panels: dict, degrees: tuple[int, ...], errors: dict) -> None:
    """All materials and degrees of one object in one room: pictures above, their errors below."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import patheffects, pyplot

    columns = len(degrees) + 1
    ink, paper = "#e8e6e3", "#17181b"
    halo = [patheffects.withStroke(linewidth=2.5, foreground="black")]
    with pyplot.rc_context({"text.color": ink, "font.size": 9, "axes.edgecolor": ink}):
        height = 1 + 1.62 * 2 * len(panels)
        figsize = (1.62 * columns + 0.4, height)
        figure, grid = pyplot.subplots(2 * len(panels), columns, figsize=figsize, facecolor=paper)
        margins = {"left": 0.06, "right": 0.99, "top": 1 - 0.75 / height, "bottom": 0.45 / height}
        figure.subplots_adjust(**margins, wspace=0.03, hspace=0.03)
        for axes in grid.flat:
            axes.set_axis_off()
        for i, (material, images) in enumerate(panels.items()):
            side = grid[2 * i, 0]
            side.text(-0.06, 0.5, material, rotation=90, ha="right", va="center", transform=side.transAxes)
            for k, (image, error) in enumerate(images):
                grid[2 * i, k].imshow(image, interpolation="nearest")
                below = grid[2 * i + 1, k]
                below.imshow(error, interpolation="nearest")
                text = f"{'' if k else 'noise '}{100 * errors[material][k]:.2g} %"
                below.text(0.97, 0.04, text, ha="right", transform=below.transAxes, path_effects=halo)
        for k, name in enumerate(["Monte Carlo", *(f"degree {d}" for d in degrees)]):
            grid[0, k].set_title(name, color=ink, fontsize=10)
        figure.suptitle(title, x=0.06, ha="left", y=1 - 0.18 / height, fontsize=13)
        scale = figure.add_axes((0.62, 0.22 / height, 0.3, 0.1 / height))
        ramp = np.geomspace(BEST, WORST, 256)[None]
        scale.imshow(plotting.false_colour(ramp, limits=(BEST, WORST)), aspect="auto", extent=(-3, 0, 0, 1))
        scale.set_yticks([])
        scale.set_xticks([-3, -2, -1, 0], ["0.1 %", "1 %", "10 %", "100 %"], color=ink, fontsize=7)
        scale.tick_params(length=0, pad=1)
        figure.text(0.595, 0.2 / height, "error / mean radiance", ha="right", fontsize=8)
        _scene.save(path, lambda file: figure.savefig(file, format="png", dpi=110, facecolor=paper))
        pyplot.close(figure)


def percent(error: float, noise: float) -> str:
    """An error in per cent; `~` when the Monte Carlo noise is more than a third of what was measured."""
    return ("~" if noise > np.hypot(error, noise) / 3 else "") + f"{100 * error:.2g}"


def table(rows: list[dict]) -> str:
    lines = [
        "| material | map | degree | sphere, error % | rabbit, error % | noise % | us per pixel |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        errors = [percent(r[f"{shape} error"], r[f"{shape} noise"]) for shape in ("sphere", "rabbit")]
        noise = max(r["sphere noise"], r["rabbit noise"])
        cells = r["material"], r["map"], r["degree"], *errors, f"{100 * noise:.2g}", f"{r['us/pixel']:.2g}"
        lines.append(f"| {' | '.join(map(str, cells))} |")
    lines.append("")
    lines.append("Error: RMSE over the RMS of the picture, Monte Carlo noise taken off. `~`: that noise is more than a")
    lines.append("third of the difference, so the figure is rough. Times: this machine, all of a picture in one call.")
    return "\n".join(lines)


def check(rows: list[dict]) -> None:
    """Errors fall with degree for every material, map and object, unless they are below what the noise can resolve."""
    for material, light in {(r["material"], r["map"]) for r in rows}:
        series = [r for r in rows if (r["material"], r["map"]) == (material, light)]
        for shape in ("sphere", "rabbit"):
            errors = [(r["degree"], r[f"{shape} error"]) for r in series]
            noise = series[0][f"{shape} noise"]
            for (d0, e0), (d1, e1) in zip(errors, errors[1:], strict=False):
                assert e1 < max(e0, 0.7 * noise), f"{material}, {light}, {shape}: degree {d0} {e0:.2g}, {d1} {e1:.2g}"


def main(arguments: list[str] | None = None) -> None:
    parser = _scene.output_parser(__doc__, "relight")
    parser.add_argument("--size", type=int, default=128, help="width of the sphere's picture in pixels")
    parser.add_argument("--samples", type=int, default=1024, help="Monte Carlo samples per pixel of the reference")
    parser.add_argument("--degrees", type=int, nargs="+", default=list(DEGREES))
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    _scene.prepare_output(options.output, options.overwrite, "relight", parser)
    start = time.perf_counter()
    rows = run(options.output, options.size, options.samples, options.seed, tuple(sorted(options.degrees)))
    text = StringIO(newline="")
    writer = csv.DictWriter(text, rows[0])
    writer.writeheader()
    writer.writerows(rows)
    _scene.save(options.output / "relight.csv", text.getvalue())
    _scene.save(options.output / "relight.md", table(rows) + "\n")
    print(table(rows))
    check(rows)
    worst = max(max(r["sphere error"], r["rabbit error"]) for r in rows if r["degree"] == max(options.degrees))
    print(
        f"\nErrors fall with degree for every material and map; at degree {max(options.degrees)} the worst is "
        f"{100 * worst:.2g} %. {time.perf_counter() - start:.0f} s, pictures in {options.output}/."
    )


if __name__ == "__main__":
    main()
