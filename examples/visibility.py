"""A rabbit that shadows itself under two photographed rooms: band-limited visibility, beside none and ray casting.

Rays from every vertex, cast once, give the visibility of the room as spherical harmonic coefficients. Pixels
interpolate them and integrate light times visibility times material (ISD15 Eq. 25). The last column casts rays at every
pixel. Below each picture is its error.

    python examples/visibility.py --output output/visibility
"""

import time
from pathlib import Path

import _scene
import jax
import numpy as np

from shisd import io, models, reference, shading

DEGREE, SEEN = 16, (4, 12)
LIMITS = 1e-3, 1.0  # relative errors at the ends of the false-colour scale
PLASTIC = models.CookTorrance(roughness=0.6, metallic=0.0, albedo=np.array([0.6, 0.3, 0.2]))


def run(output: Path, size: int, samples: int, rays: int, seed: int) -> list[dict]:
    rabbit = _scene.DATA / "bunny.ply"
    shape, view = _scene.load_mesh(rabbit), _scene.mesh(rabbit, size, _scene.AZIMUTH)
    starts = (view.positions + 2e-4 * shape.face_normals[view.triangle]).astype(
        np.float32
    )  # rays start off the surface
    visible = lambda p, w: ~shape.ray.intersects_any(p, w)

    slices, surface = shading.tabulate_brdf(PLASTIC, DEGREE), view.surface()
    make = lambda degree: models.Visibility.from_mesh(
        shape.vertices, shape.faces, degree, rays=rays, seed=seed, progress=_scene.PROGRESS
    )
    seen = {degree: make(degree) for degree in SEEN}

    rows, lines, notes = [], [], {}
    for name in _scene.progress(_scene.MAPS, "maps"):
        environment, exposure = _scene.load_map(name), _scene.MAPS[name][1]
        light = environment.light(DEGREE + max(SEEN))
        images = {"no occlusion": shading.shade(slices, light, surface)}
        for degree, v in seen.items():
            images[f"visibility of degree {degree}"] = shading.shade(slices, models.Occluded(light, v), surface)
        truth = reference.shade_environment(
            PLASTIC, environment, view.normals, view.views,
            key=jax.random.key(seed), samples=samples, positions=starts, visible=visible,
        )  # fmt: skip
        exact, bar = (np.asarray(a, float) for a in (truth.value, truth.standard_error))
        images = {method: np.asarray(image, float) for method, image in images.items()} | {"rays": exact}
        noise2, scale = np.mean(bar**2), np.mean(exact**2)
        background = np.asarray(environment.radiance(view.rays.astype(np.float32), texels="samples"))
        shown = [io.tonemap(view.picture(image, background), exposure=exposure) for image in images.values()]
        mean = np.linalg.norm(exact, axis=1).mean()
        errors = [image - exact if method != "rays" else bar for method, image in images.items()]
        wrong = [view.picture(_scene.false_colour(error, mean, LIMITS)) for error in errors]
        for k, method in enumerate(images):
            noise = np.sqrt(noise2 / scale)
            if method != "rays":
                error = np.sqrt(max(np.mean(errors[k] ** 2) - noise2, 0) / scale)
                rows.append({"map": name, "method": method, "error": error, "noise": noise})
            notes[len(lines) + 1, k] = f"noise {100 * noise:.2g} %" if method == "rays" else f"{100 * error:.2g} %"
        lines += [(name, shown), ("error", wrong)]
    columns = ["no occlusion", *(f"visibility of degree {d}" for d in SEEN), f"{samples} rays at every pixel"]
    _scene.sheet(output / "visibility.png", columns, lines, limits=LIMITS, notes=notes)
    return rows


def table(rows: list[dict]) -> str:
    lines = ["| map | method | error % | noise of the rays % |", "|---|---|---|---|"]
    for r in rows:
        lines.append(f"| {r['map']} | {r['method']} | {100 * r['error']:.2g} | {100 * r['noise']:.2g} |")
    lines += ["", "Error: RMSE over the RMS of the picture with rays at every pixel, whose noise is taken off."]
    return "\n".join(lines)


def check(rows: list[dict]) -> None:
    """Occlusion by a higher band limit is nearer to the rays, and both nearer than none."""
    for name in {r["map"] for r in rows}:
        errors = [r["error"] for r in rows if r["map"] == name]
        if sorted(errors, reverse=True) != errors:
            raise SystemExit(f"{name}: errors do not fall with the degree of visibility: {errors}")


def main() -> None:
    parser = _scene.output_parser(__doc__, "visibility")
    parser.add_argument("--size", type=int, default=320, help="pixels on a side")
    parser.add_argument("--samples", type=int, default=512, help="rays at every pixel of the reference")
    parser.add_argument("--rays", type=int, default=4096, help="rays at every vertex")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    _scene.prepare_output(options.output, options.overwrite, "visibility", parser)
    start = time.perf_counter()
    rows = run(options.output, options.size, options.samples, options.rays, options.seed)
    _scene.save(options.output / "visibility.md", table(rows) + "\n")
    print(table(rows))
    check(rows)
    worst = max(r["error"] for r in rows if r["method"].endswith(f" {SEEN[-1]}"))
    none = max(r["error"] for r in rows if r["method"] == "no occlusion")
    reached = (
        f"Radiance within {100 * worst:.2g} % of rays by visibility of degree {SEEN[-1]} ({100 * none:.2g} % without)"
    )
    _scene.verdict(reached, start, options.output)


if __name__ == "__main__":
    main()
