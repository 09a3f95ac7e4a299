"""A rabbit that shadows itself under two photographed rooms: band-limited visibility, beside none and ray casting.

Rays from every vertex, cast once, give the visibility of the room as spherical harmonic coefficients. Pixels
interpolate them and integrate light times visibility times material (ISD15 Eq. 25). The last column casts rays at every
pixel.

    python examples/visibility.py --output output/visibility
"""

from pathlib import Path

import _scene
import jax
import numpy as np
from relight import DATA, MAPS, load_map
from tqdm import tqdm

from shisd import io, models, reference, shading

AZIMUTH, DEGREE, SEEN = 5.0, 16, (4, 12)
PLASTIC = models.CookTorrance(roughness=0.6, metallic=0.0, albedo=np.array([0.6, 0.3, 0.2]))


def run(output: Path, size: int, samples: int, rays: int, seed: int) -> list[dict]:
    shape, view = _scene.load_mesh(DATA / "bunny.ply"), _scene.mesh(DATA / "bunny.ply", size, AZIMUTH)
    where = {"triangle": view.triangle, "weights": view.weights}
    off = 1e-4 * np.linalg.norm(np.ptp(shape.vertices, axis=0))  # rays start off the surface
    starts = (view.positions + off * shape.face_normals[view.triangle]).astype(np.float32)
    visible = lambda p, w: ~shape.ray.intersects_any(p, w)

    material = shading.tabulate_brdf(PLASTIC, DEGREE)
    make = lambda degree: models.Visibility.from_mesh(shape.vertices, shape.faces, degree, rays=rays, seed=seed)
    seen = {degree: make(degree) for degree in tqdm(SEEN, "visibility")}

    rows, gallery = [], []
    for name in tqdm(MAPS, "maps"):
        environment, exposure = load_map(name), MAPS[name][1]
        light = environment.coefficients(DEGREE + max(SEEN))
        images = {
            "no occlusion": shading.shade(
                material, models.DistantLight(light), shading.Surface(view.normals, view.views)
            )
        }
        for degree, v in seen.items():
            images[f"degree {degree}"] = shading.shade_environment_visibility(
                material, light, v, view.normals, view.views, **where
            )
        truth = reference.shade_environment(
            PLASTIC, environment, view.normals, view.views,
            key=jax.random.key(seed), samples=samples, positions=starts, visible=visible,
        )  # fmt: skip
        images["rays"], noise2 = truth.value, np.mean(np.asarray(truth.standard_error, float) ** 2)
        background = np.asarray(environment.radiance(view.rays.astype(np.float32), texels="samples"))
        gallery.append(np.concatenate([
            io.tonemap(view.picture(np.asarray(image), background), exposure=exposure) for image in images.values()
        ], axis=1))  # fmt: skip
        scale = np.mean(np.asarray(truth.value, float) ** 2)
        for method, image in images.items():
            if method != "rays":
                excess = np.mean((np.asarray(image, float) - np.asarray(truth.value, float)) ** 2) - noise2
                row = {"map": name, "method": method, "error": np.sqrt(max(excess, 0) / scale)}
                rows.append({**row, "noise": np.sqrt(noise2 / scale)})
    io.write_image(output / "visibility.png", np.concatenate(gallery, axis=0), overwrite=True)
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
    rows = run(options.output, options.size, options.samples, options.rays, options.seed)
    _scene.save(options.output / "visibility.md", table(rows) + "\n")
    print(table(rows))
    check(rows)


if __name__ == "__main__":
    main()
