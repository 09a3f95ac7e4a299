"""The pictures that `examples/fit_material.py` and `examples/fit_light.py` fit: rendered by Mitsuba 3, path traced.

    python -m tests.bench.make_pictures examples/data

Mitsuba shares no formula with this library: it samples paths, and its GGX, its map and its rectangle are its own. What
differs in convention is converted here: its maps have +y up, their first and last rows at the poles, and turn the other
way. A pixel is the mean over its square. The surface frame of its sphere has x along (-y, x, 0), as the fit assumes.

Each file holds the picture, what is known to the fit (camera, and the lamp's outline about its own centre), how the
picture was made, and under names that begin with `truth_` what the fit has to find.
"""

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
from tqdm import tqdm

from shisd import harmonics, models
from shisd.io.internal import write_atomically

DATA = Path(__file__).resolve().parents[2] / "examples" / "data"
SEED = 20150801
CAMERA = {"eye": 4.2 * np.array([np.cos(5.0), np.sin(5.0), 0.15]), "target": np.zeros(3), "degrees": 32.0}
MATERIAL = {"alpha": np.array([0.45, 0.18]), "albedo": np.array([0.5, 0.25, 0.12]), "specular": np.array(0.4)}
CLAY = {"alpha": np.array(0.35), "albedo": np.array(0.45), "specular": np.array(0.4)}
LAMP = {"position": np.array([1.1, -1.3, 1.9]), "emission": np.array([9.0, 6.5, 3.5])}
LAMP_SIZE, LAMP_TURN = (1.2, 0.8), 0.4  # it faces straight down, turned about the vertical by so many radians


def sky_light() -> np.ndarray:
    """SH coefficients [3, 16] of distant light: random, and positive everywhere."""
    c = np.random.default_rng(SEED).normal(size=(3, 16)) * np.array([0.0] + 3 * [0.35] + 5 * [0.2] + 7 * [0.12])
    c = 0.6 * c + 0.4 * c.mean(axis=0)  # colours that differ, but not wildly
    c[:, 0] = np.array([1.5, 1.8, 2.3])
    return c


def lamp_outline() -> np.ndarray:
    """Corners [4, 3] of the lamp about its centre, counter-clockwise seen from below."""
    x, y = 0.5 * np.array([[-1, 1, 1, -1], [1, 1, -1, -1]]) * np.reshape(LAMP_SIZE, (2, 1))
    cos, sin = np.cos(LAMP_TURN), np.sin(LAMP_TURN)
    return np.stack([cos * x - sin * y, sin * x + cos * y, 0 * x], axis=1)


def environment(mi, radiance, height: int) -> dict:
    """Mitsuba's map of a function of direction [..., 3]: rows from pole to pole, columns clockwise, centred."""
    theta = np.pi * np.arange(height + 1)[:, None] / height
    phi = -2 * np.pi * (np.arange(2 * height)[None] + 0.5) / (2 * height)
    w = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi
    texels = np.array(radiance(np.stack(w, axis=-1).astype(np.float32)), np.float32, order="C")
    to_world = np.zeros((4, 4))
    to_world[[0, 1, 2, 3], [2, 0, 1, 3]] = -1, -1, 1, 1  # its -z, -x, +y are our +x, +y, +z
    return {"type": "envmap", "bitmap": mi.Bitmap(texels), "to_world": mi.ScalarTransform4f(to_world)}


def material(mi, alpha: np.ndarray, albedo: np.ndarray, specular: np.ndarray) -> dict:
    """Lambertian + specular GGX without Fresnel, as a blend of the two, ordered by name. `alpha` is a scalar or [2]."""
    colour = lambda value: {"type": "rgb", "value": np.broadcast_to(value, 3).tolist()}
    u, v = np.broadcast_to(alpha, 2)
    ggx = {
        "type": "roughconductor",
        "material": "none",
        "distribution": "ggx",
        "alpha_u": float(u),
        "alpha_v": float(v),
    }
    matt = {"type": "diffuse", "reflectance": colour(albedo / (1 - specular))}
    return {"type": "blendbsdf", "weight": float(specular), "bsdf_0": matt, "bsdf_1": ggx}


def scene(mi, name: str, size: int) -> dict:
    up = [0, 0, 1]
    sensor = {
        "type": "perspective",
        "fov": CAMERA["degrees"],
        "to_world": mi.ScalarTransform4f().look_at(CAMERA["eye"], CAMERA["target"], up),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
        "sampler": {"type": "multijitter"},
    }
    whole = {"type": "scene", "sensor": sensor, "integrator": {"type": "path", "max_depth": 2}}
    if name == "material":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of texels that are no radiance
            room = models.Environment.load(DATA / "studio.exr")
        seen = lambda w: room.radiance(w, texels="samples")
        whole["sky"] = environment(mi, seen, 2048)  # the map's texels, bilinear, four times as fine
        return whole | {"ball": {"type": "sphere", "bsdf": material(mi, **MATERIAL)}}
    coefficients = sky_light()[:, None, None].astype(np.float32)
    radiance = lambda w: np.moveaxis(np.asarray(harmonics.evaluate(coefficients, w)), 0, -1)
    whole["sky"] = environment(mi, radiance, 512)
    corners = lamp_outline() + LAMP["position"]
    to_world = np.eye(4)
    to_world[:3, 0], to_world[:3, 1] = (corners[1] - corners[0]) / 2, (corners[3] - corners[0]) / 2
    to_world[:3, 2], to_world[:3, 3] = [0, 0, -1], LAMP["position"]
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": LAMP["emission"].tolist()}}
    whole["lamp"] = {"type": "rectangle", "to_world": mi.ScalarTransform4f(to_world), "emitter": emitter}
    return whole | {"ball": {"type": "sphere", "bsdf": material(mi, **CLAY)}}


def render(name: str, size: int, samples: int, passes: int, variant: str = "scalar_rgb") -> tuple[np.ndarray, float]:
    """The mean picture [size, size, 3] of some passes of so many samples, and its noise: RMS over the RMS."""
    import mitsuba as mi

    mi.set_variant(variant)
    loaded = mi.load_dict(scene(mi, name, size))
    pictures = []
    for k in tqdm(range(passes), name):
        pictures.append(np.array(mi.render(loaded, spp=samples, seed=SEED + k), dtype=float))
    picture = np.mean(pictures, axis=0)
    noise2 = np.var(pictures, axis=0, ddof=1).mean() / passes
    return picture, float(np.sqrt(noise2 / np.mean(picture**2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="folder for material.npz and light.npz")
    parser.add_argument("--only", choices=["material", "light"], action="append")
    parser.add_argument("--size", type=int, default=96, help="width of a picture in pixels")
    parser.add_argument("--samples", type=int, default=4096, help="samples per pixel and pass")
    parser.add_argument("--passes", type=int, default=16, help="independent passes, whose spread measures the noise")
    parser.add_argument("--variant", default="scalar_rgb", help="of Mitsuba")
    parser.add_argument("--overwrite", action="store_true", help="replace files that exist")
    options = parser.parse_args()
    for name in options.only or ["material", "light"]:
        path = options.output / f"{name}.npz"
        if path.exists() and not options.overwrite:
            parser.error(f"{path} exists. Name another folder, or replace it with --overwrite.")
        import mitsuba

        start = time.perf_counter()
        picture, noise = render(name, options.size, options.samples, options.passes, options.variant)
        truth = MATERIAL if name == "material" else {**LAMP, "light": sky_light()}
        known = {} if name == "material" else {"outline": lamp_outline(), **CLAY}
        made = {
            "samples": options.samples * options.passes,
            "seed": SEED,
            "noise": noise,
            "mitsuba": mitsuba.__version__,
        }
        held = {"picture": picture.astype(np.float32), **CAMERA, **known, **made}
        held |= {f"truth_{key}": value for key, value in truth.items()}
        write_atomically(path, lambda file, held=held: np.savez_compressed(file, **held), overwrite=options.overwrite)
        print(f"{path}: noise {100 * noise:.2g} %, {path.stat().st_size} bytes, {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
