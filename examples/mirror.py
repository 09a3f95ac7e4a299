"""Mirrors without jagged pixels: a sphere and a rabbit that reflect a room, filtered at once or by samples.

The images of normals and positions, one ray for each pixel, tell how mirror directions spread over a pixel. Light is
filtered with that Gaussian, by lookups in filtered maps or band by band (ISD15 Eq. 26-29), and compared with 16 x 16
rays for each pixel under the same pixel filter. The picture shows the middle of each.

    python examples/mirror.py --output output/mirror
"""

import time
from pathlib import Path

import _scene
import numpy as np

from shisd import harmonics, io, models, shading

FILTERED = "filtered maps"
DEGREE, WIDTH, SAMPLES, MANY = 100, 0.5, 2, 16  # width: standard deviation of the pixel's filter, in pixels


def look(name: str, size: int) -> _scene.View:
    """The object through size x size rays."""
    if name == "sphere":
        return _scene.sphere(size, _scene.AZIMUTH)
    return _scene.mesh(_scene.DATA / "bunny.ply", size, _scene.AZIMUTH)


def sampled(name: str, environment: models.Environment, size: int, samples: int) -> np.ndarray:
    """The picture [size, size, 3] from samples^2 rays for each pixel, averaged with the filter over what is seen."""
    view = look(name, size * samples)
    facing = np.sum(view.normals * view.views, axis=1, keepdims=True)
    light = view.picture(np.asarray(environment.radiance(2 * facing * view.normals - view.views, texels="samples")))
    at = (np.arange(size * samples) + 0.5) / samples - (np.arange(size)[:, None] + 0.5)
    weights = np.where(np.abs(at) <= 1.5, np.exp(-(at**2) / (2 * WIDTH**2)), 0)
    average = lambda image: np.einsum("is,st...,jt->ij...", weights, image, weights, optimize=True)
    return average(light) / np.maximum(average(view.seen.astype(float)), 1e-9)[..., None]


def run(output: Path, size: int) -> list[dict]:
    rows, lines, notes = [], [], {}
    rooms = {name: _scene.load_map(name) for name in _scene.MAPS}
    for name in _scene.progress(("sphere", "rabbit"), "objects"):
        view = look(name, size)
        normals, positions = view.picture(view.normals), view.picture(view.positions)
        footprint = shading.footprint(
            normals.astype(np.float32), positions.astype(np.float32), view.eye.astype(np.float32), view.seen
        )
        for room, environment in _scene.progress(rooms.items(), name, len(rooms)):
            maps = shading.MirrorMaps.from_texels(environment.texels)
            light = harmonics.apply_window(environment.coefficients(DEGREE), harmonics.hann_window(DEGREE))
            truth = sampled(name, environment, size, MANY)
            images = {
                "1 sample": environment.radiance(footprint.directions, texels="samples"),
                f"{SAMPLES} x {SAMPLES} samples": sampled(name, environment, size, SAMPLES),
                "round Gaussian": shading.reflect(footprint, models.DistantLight(light)),
                FILTERED: shading.reflect(footprint, maps),
                f"{MANY} x {MANY} samples": truth,
            }
            middle = slice(size // 4, size - size // 4)
            behind = np.asarray(environment.radiance(view.rays.astype(np.float32), texels="samples"))
            show = lambda image, e=_scene.MAPS[room][1], v=view.seen, b=behind, m=middle: io.tonemap(
                np.where(v[..., None], np.asarray(image), b)[m, m], exposure=e
            )
            lines.append((f"{name}, {room}", [show(image) for image in images.values()]))
            for k, (method, image) in enumerate(list(images.items())[:-1]):
                error = np.linalg.norm((np.asarray(image, float) - truth)[view.seen], axis=1)
                scale = np.linalg.norm(truth[view.seen], axis=1)
                row = {"object": name, "map": room, "method": method}
                row["rms"] = np.sqrt(np.mean(error**2) / np.mean(scale**2))
                rows.append({**row, "median": np.median(error / np.maximum(scale, 1e-6))})
                notes[len(lines) - 1, k] = f"median error {100 * rows[-1]['median']:.2g} %"
    _scene.sheet(output / "mirror.png", list(images), lines, notes=notes)
    return rows


def table(rows: list[dict]) -> str:
    lines = ["| object | map | method | RMSE % | median error % |", "|---|---|---|---|---|"]
    for r in rows:
        cells = r["object"], r["map"], r["method"], f"{100 * r['rms']:.2g}", f"{100 * r['median']:.2g}"
        lines.append(f"| {' | '.join(cells)} |")
    lines += ["", f"Against {MANY} x {MANY} rays for each pixel, linear RGB: RMSE over RMS, most of it at a few pixels"]
    lines.append(f"that see lamps, and the median over pixels. Round Gaussian: degree {DEGREE} with a Hann window.")
    return "\n".join(lines)


def main() -> None:
    parser = _scene.output_parser(__doc__, "mirror")
    parser.add_argument("--size", type=int, default=96, help="pixels on a side")
    options = parser.parse_args()
    _scene.prepare_output(options.output, options.overwrite, "mirror", parser)
    start = time.perf_counter()
    rows = run(options.output, options.size)
    _scene.save(options.output / "mirror.md", table(rows) + "\n")
    print(table(rows))
    median = {method: max(r["median"] for r in rows if r["method"] == method) for method in (FILTERED, "1 sample")}
    reached = f"Median error within {100 * median[FILTERED]:.2g} % of {MANY} x {MANY} rays by filtered maps"
    _scene.verdict(f"{reached} ({100 * median['1 sample']:.2g} % by one ray)", start, options.output)


if __name__ == "__main__":
    main()
