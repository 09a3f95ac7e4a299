"""A noisy measurement with holes, before and after: a sphere in gold paint, and in the same from a bad MERL file.

The file has 10 % log-normal noise and half of its bins missing. Read as it is, holes take their nearest neighbour;
`filtering.denoise_merl` fits a smooth table with the same energy (in the spirit of ISD15 section 6.3).

    python examples/denoise.py --output output/denoise
"""

import time
import warnings
from pathlib import Path

import _scene
import jax
import numpy as np

from shisd import filtering, io, models

EXPOSURE = 1.0
LIMITS = 1e-3, 1.0  # relative errors at the ends of the false-colour scale
LIGHTS = (((0.2, -1.0, 0.6), 3.0), ((1.0, -0.4, 0.1), 2.0), ((-0.6, -0.5, -0.3), 1.0))  # towards them, and their power


def spoil(table: np.ndarray, noise: float, holes: float, seed: int) -> np.ndarray:
    """A MERL table with log-normal noise, and with a share of its bins missing."""
    rng = np.random.default_rng(seed)
    noisy = np.where(table < 0, table, table * np.exp(noise * rng.standard_normal(table.shape)))
    noisy[rng.random(table.shape[:3]) < holes] = -1
    return noisy


def lit(brdf: models.AbstractBrdf, view: _scene.View) -> jax.Array:
    """Radiance [N, 3] of the seen pixels under lights that are points: nothing hides what the table holds."""
    across = _scene.unit(np.cross(view.normals, [0.3, 0.5, 0.8]))
    frames = np.stack([across, np.cross(view.normals, across), view.normals], axis=1).astype(np.float32)
    local = np.einsum("nij,nj->ni", frames, view.views)
    value = jax.jit(jax.vmap(brdf.value_cosine))
    return sum(power * value(frames @ _scene.unit(np.float32(w)), local) for w, power in LIGHTS)


def run(output: Path, size: int, noise: float, holes: float, seed: int) -> list[dict]:
    clean, spoiled = output / "clean.binary", output / "spoiled.binary"
    io.write_merl(clean, _scene.gold_metallic_paint(), overwrite=True)
    truth = io.read_merl(clean)
    io.write_merl(spoiled, spoil(truth, noise, holes, seed), overwrite=True)
    with warnings.catch_warnings(record=True):  # it says how many bins are missing
        warnings.simplefilter("always")
        materials = {"as read": models.MeasuredBrdf.from_merl(spoiled)}
    materials["denoised"] = filtering.denoise_merl(spoiled, progress=_scene.PROGRESS).brdf
    materials["clean"] = models.MeasuredBrdf.from_merl(clean)

    view = _scene.sphere(size, _scene.AZIMUTH)
    images = {name: np.asarray(lit(brdf, view)) for name, brdf in materials.items()}
    above, bad = truth >= 0, ("as read", "denoised")  # missing bins are negative: those below the horizon
    rms = lambda x: np.sqrt(np.mean(np.square(x)))
    rows = []
    for name in bad:
        table = np.asarray(materials[name].table, float)
        picture = rms(images[name] - images["clean"]) / rms(images["clean"])
        rows.append({"material": name, "table": rms((table - truth)[above]) / rms(truth[above]), "picture": picture})

    mean = np.linalg.norm(images["clean"], axis=1).mean()
    wrong = (_scene.false_colour(images[name] - images["clean"], mean, LIMITS) for name in bad)
    panels = [io.tonemap(view.picture(image), exposure=EXPOSURE) for image in images.values()]
    panels += [view.picture(error) for error in wrong]
    columns = [*images, *(f"error {name}" for name in bad)]
    notes = {(0, 3 + k): f"{100 * row['picture']:.2g} %" for k, row in enumerate(rows)}
    _scene.sheet(output / "denoise.png", columns, [("gold paint", panels)], limits=LIMITS, notes=notes)
    return rows


def table(rows: list[dict]) -> str:
    lines = ["| material | error of the table % | error of the picture % |", "|---|---|---|"]
    lines += [f"| {r['material']} | {100 * r['table']:.2g} | {100 * r['picture']:.2g} |" for r in rows]
    lines += ["", "RMSE over RMS, of the bins above the horizon and of the sphere's pixels. The picture: as read,"]
    lines.append("denoised, clean, and the errors of the first two.")
    return "\n".join(lines)


def main() -> None:
    parser = _scene.output_parser(__doc__, "denoise")
    parser.add_argument("--size", type=int, default=192, help="pixels on a side of each picture")
    parser.add_argument("--noise", type=float, default=0.1, help="standard deviation of the logarithm")
    parser.add_argument("--holes", type=float, default=0.5, help="share of the bins that are missing")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    _scene.prepare_output(options.output, options.overwrite, "denoise", parser)
    start = time.perf_counter()
    rows = run(options.output, options.size, options.noise, options.holes, options.seed)
    _scene.save(options.output / "denoise.md", table(rows) + "\n")
    print(table(rows))
    if rows[1]["table"] > rows[0]["table"] / 3:
        raise SystemExit("The denoised table should be at least three times nearer to the clean one.")
    table_error, picture_error = (100 * rows[1][name] for name in ("table", "picture"))
    reached = f"Table within {table_error:.2g} % of the clean one, the picture within {picture_error:.2g} %"
    _scene.verdict(
        f"{reached} ({100 * rows[0]['table']:.2g} and {100 * rows[0]['picture']:.2g} % as read)", start, options.output
    )


if __name__ == "__main__":
    main()
