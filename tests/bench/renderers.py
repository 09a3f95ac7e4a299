"""Whole pictures against Mitsuba 3, direct light only: a glossy sphere under a map, a glossy floor under a lamp.

    python -m tests.bench.renderers     renders the stored references with Mitsuba's LLVM variant, in some minutes

Both see the same scene: GGX of alpha 0.3 without Fresnel and with separable Smith masking (Mitsuba's `roughconductor`
of material "none", ours with f0 = 1); a map of 1024 x 2048 texels made of `examples/data/interior.hdr`; a rectangle
that emits on one side. What differs in convention is converted by `make_pictures`. A pixel of Mitsuba is the mean over
its square by its stratified sampler, the direct light by one sample of the light and one of the material, weighted
against each other; ours is the radiance along one ray through its centre. Both trace rays: ours meet the sphere or the
plane within the measured function, and all 128 x 128 of them are shaded, also those that miss.

Judged are pixels that lie wholly on the surface and, on the sphere, face the camera by a cosine of 0.25 or more: at the
edge, a pixel's mean and its centre are different things. Every fourth one either way has a reference: Mitsuba's own
mean of very many samples, whose error is the spread of its passes. Setup: for ours, slices and coefficients of the map,
with compiling; for Mitsuba, loading the scene. Mitsuba's first call is short where its cache on disk has the kernel.
"""

import functools
import importlib.util
import os
import re
import subprocess
import sys
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from shisd import models, shading
from shisd.io.internal import write_atomically
from tests.bench import make_pictures
from tests.bench.harness import Method, Task

DATA = Path(__file__).resolve().parents[2] / "examples" / "data"
STORED = Path(__file__).resolve().parent / "data" / "references_renderers.npz"
SIZE, MAP_HEIGHT, LEAST_FACING, STEP = 128, 1024, 0.25, 4
ALPHA, EMISSION = 0.3, np.array([9.0, 6.5, 3.5])
LAMP = np.array([[-0.7, 1.3, 1.3], [-0.7, 2.3, 1.3], [0.7, 2.3, 1.3], [0.7, 1.3, 1.3]])  # seen from below
SPHERE_CAMERA = {"eye": 4.2 * np.array([np.cos(5.0), np.sin(5.0), 0.15]), "target": np.zeros(3), "degrees": 32.0}
FLOOR_CAMERA = {"eye": np.array([0.0, -3.0, 2.2]), "target": np.array([0.0, 0.3, 0.0]), "degrees": 40.0}
TITLES = {
    "sphere": "GGX 0.3 sphere under a map",
    "floor": "GGX 0.3 floor under a lamp",
}
DEGREES = (8, 30)
SAMPLES = {"scalar_rgb": (4, 16), "llvm_ad_rgb": (4, 16, 64, 256)}
PASSES, PASS_SAMPLES = 48, 4096  # of the reference; Mitsuba's stratified sampler takes no other number near it


@functools.cache
def variants() -> tuple[str, ...]:
    """The variants of Mitsuba that run here."""
    if importlib.util.find_spec("mitsuba") is None:
        return ()
    return ("scalar_rgb", "llvm_ad_rgb") if find_llvm() else ("scalar_rgb",)


def find_llvm() -> bool:
    """Point Mitsuba to the newest libLLVM with which it renders the sphere, in another process: old ones abort it."""
    probe = "from tests.bench.renderers import render; render('sphere', 'llvm_ad_rgb', 1)"
    libraries = {p.resolve() for p in Path("/usr/lib").glob("**/libLLVM*.so*")}
    version = lambda path: int("".join(re.findall(r"\d+", path.name)[:1]) or 0)
    for library in sorted(libraries, key=version, reverse=True):
        environment = os.environ | {"DRJIT_LIBLLVM_PATH": os.environ.get("DRJIT_LIBLLVM_PATH", str(library))}
        child = subprocess.run([sys.executable, "-c", probe], env=environment, capture_output=True)
        if child.returncode == 0:
            os.environ.update(environment)
            return True
    return False


def notes() -> list[str]:
    """Which variants ran."""
    missing = [variant for variant in SAMPLES if variant not in variants()]
    if not missing:
        return []
    return [f"Mitsuba's {' and '.join(missing)} did not run, so not measured (llvm_ad_rgb needs libLLVM 16 or newer)."]


def tasks(quick: bool) -> list[Task]:
    """A task for each picture; none when quick."""
    return [] if quick else [picture(name) for name in TITLES]


def picture(name: str) -> Task:
    with np.load(STORED) as stored:
        reference, error = stored[name].astype(float), float(stored[f"{name} noise"])
    order = np.concatenate([judged(name), np.setdiff1d(np.arange(SIZE * SIZE), judged(name))])
    rays = jnp.asarray(rays_of(name).reshape(-1, 3)[order], jnp.float32)
    methods = [ours(name, degree, rays) for degree in DEGREES]
    for variant in variants():
        methods += [mitsuba_method(name, variant, samples, order) for samples in SAMPLES[variant]]
    return Task(name, TITLES[name], "pixel", (), reference, error, methods, count=SIZE * SIZE)


def equal_error(rows: list[dict]) -> list[dict]:
    """What Mitsuba takes for our error, from the rows of one picture.

    Its error falls by the power of samples that joins the last two settings of the variant with the most samples, for
    both draw alike, the reference's own error taken out; its seconds are linear in samples.
    """
    count = lambda row: int(row["setting"].split()[0])
    picture_of = lambda row: row["us/pixel"] * SIZE**2 / 1e6
    theirs = [r for r in rows if not r["ours"]]
    if not theirs:
        return []
    longest = max(theirs, key=count)
    fewer, more = sorted((r for r in theirs if r["family"] == longest["family"]), key=count)[-2:]
    errors = [np.sqrt(r["relative RMSE"] ** 2 - r["reference error"] ** 2) for r in (fewer, more)]
    power = np.log(errors[1] / errors[0]) / np.log(count(more) / count(fewer))
    table = []
    for family in dict.fromkeys(r["family"] for r in theirs):
        own = [r for r in theirs if r["family"] == family]
        slope, start = np.polyfit([count(r) for r in own], [picture_of(r) for r in own], 1)
        for row in (r for r in rows if r["ours"]):
            needed = max(count(more) * (row["relative RMSE"] / errors[1]) ** (1 / power), 1)
            seconds = float(max(start, 0) + slope * needed)
            table.append({
                "picture": TITLES[row["task"]],
                "ours": row["setting"],
                "relative RMSE": row["relative RMSE"],
                "s/picture": picture_of(row),
                "renderer": family,
                "its samples for that error": round(needed),
                "its s/picture": seconds,
                "time / ours": seconds / picture_of(row),
            })  # fmt: skip
    return table


# ---- pixels


def rays_of(name: str, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Unit rays [rows, columns, 3] through the pixels' centres, or so many pixels to the right of them and below."""
    camera = SPHERE_CAMERA if name == "sphere" else FLOOR_CAMERA
    unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)
    forward = unit(camera["target"] - camera["eye"])
    right = unit(np.cross(forward, [0.0, 0.0, 1.0]))
    x, y = (np.tan(np.radians(camera["degrees"]) / 2) * (2 * (np.arange(SIZE) + 0.5 + s) / SIZE - 1) for s in shift)
    return unit(forward + x[None, :, None] * right - y[:, None, None] * np.cross(right, forward))


@functools.cache
def judged(name: str) -> np.ndarray:
    """Indices of the pixels with a reference."""
    good = np.zeros((SIZE, SIZE), bool)
    good[STEP // 2 :: STEP, STEP // 2 :: STEP] = True
    for shift in ((-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)):
        _, normals, views, hit = (
            np.asarray(x) for x in meet(name, rays_of(name, shift).reshape(-1, 3).astype(np.float32))
        )
        good &= (hit & (np.sum(normals * views, axis=-1) > LEAST_FACING * (name == "sphere"))).reshape(SIZE, SIZE)
    return np.flatnonzero(good)


def meet(name: str, rays):
    """Points, normals, views and whether the rays [N, 3] meet the unit sphere, or the plane z = 0."""
    camera = SPHERE_CAMERA if name == "sphere" else FLOOR_CAMERA
    eye = jnp.asarray(camera["eye"], rays.dtype)
    along = -rays @ eye
    if name == "sphere":
        inside = along**2 - eye @ eye + 1
        points = eye + (along - jnp.sqrt(jnp.maximum(inside, 0)))[:, None] * rays
        return points, points, -rays, inside > 0
    points = eye - (eye[2] / rays[:, 2])[:, None] * rays
    return points, jnp.broadcast_to(jnp.asarray([0, 0, 1], rays.dtype), points.shape), -rays, rays[:, 2] < 0


# ---- ours


@functools.cache
def room() -> models.Environment:
    """The map, bilinear in its texels, on four times as many rows: Mitsuba's grid, half a texel off, sees the same."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of texels that are no radiance
        texels = models.Environment.load(DATA / "interior.hdr")
    return models.Environment.from_function(lambda w: texels.radiance(w, texels="samples"), MAP_HEIGHT)


def ours(name: str, degree: int, rays) -> Method:
    domain = "sphere" if name == "sphere" else "upper"
    start = time.perf_counter()
    material = shading.tabulate_brdf(models.Ggx(ALPHA), degree, domain=domain)
    light = room().light(degree) if name == "sphere" else models.PolygonLight(LAMP, EMISSION)
    jax.block_until_ready((material, light))
    setup = time.perf_counter() - start
    shade = _shade_sphere if name == "sphere" else _shade_floor
    parameters = material, light, rays
    gradient = _gradient(shade) if (name, degree) == ("sphere", DEGREES[0]) else None  # others take long to compile
    return Method("shisd", f"degree {degree}", shade, parameters, gradient, setup, ours=True)


def _shade_sphere(parameters):
    material, light, rays = parameters
    _, normals, views, hit = meet("sphere", rays)
    normals = jnp.where(hit[:, None], normals, views)
    return jnp.where(hit[:, None], shading.shade(material, light, shading.Surface(normals, views)), 0)


def _shade_floor(parameters):
    material, light, rays = parameters
    points, normals, views, _ = meet("floor", rays)
    return shading.shade(material, light, shading.Surface(normals, views, points))


@functools.cache
def _gradient(shade):
    """Of the mean of squares, in the slices of the material, the light and the rays."""
    return lambda parameters: jax.value_and_grad(lambda p: jnp.mean(shade(p) ** 2))(parameters)


# ---- Mitsuba


def scene(mi, name: str) -> dict:
    camera = SPHERE_CAMERA if name == "sphere" else FLOOR_CAMERA
    sensor = {
        "type": "perspective",
        "fov": camera["degrees"],
        "to_world": mi.ScalarTransform4f().look_at(camera["eye"], camera["target"], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
        "sampler": {"type": "multijitter"},
    }
    whole = {"type": "scene", "sensor": sensor, "integrator": {"type": "direct"}}
    bsdf = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": ALPHA}
    if name == "sphere":
        seen = functools.partial(room().radiance, texels="samples")
        sky = make_pictures.environment(mi, seen, MAP_HEIGHT)
        return whole | {"sky": sky, "ball": {"type": "sphere", "bsdf": bsdf}}
    to_world = np.eye(4)
    to_world[:3, 0], to_world[:3, 1] = (LAMP[1] - LAMP[0]) / 2, (LAMP[3] - LAMP[0]) / 2
    to_world[:3, 2], to_world[:3, 3] = [0, 0, -1], LAMP.mean(axis=0)
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": EMISSION.tolist()}}
    lamp = {"type": "rectangle", "to_world": mi.ScalarTransform4f(to_world), "emitter": emitter}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([50, 50, 1]), "bsdf": bsdf}
    return whole | {"lamp": lamp, "floor": floor}


@functools.cache
def load(name: str, variant: str):
    """The scene, and the seconds that loading takes without the making of the map."""
    import mitsuba as mi

    mi.set_variant(variant)
    description = scene(mi, name)
    start = time.perf_counter()
    return mi.load_dict(description), time.perf_counter() - start


def render(name: str, variant: str, samples: int, seed: int = 0) -> np.ndarray:
    import mitsuba as mi

    mi.set_variant(variant)
    return np.array(mi.render(load(name, variant)[0], spp=samples, seed=seed)).reshape(-1, 3)


def mitsuba_method(name: str, variant: str, samples: int, order: np.ndarray) -> Method:
    """A picture by so many samples of a pixel, with another seed for every call."""
    family = "Mitsuba 3 llvm" if variant == "llvm_ad_rgb" else f"Mitsuba 3 {variant}"
    forward = lambda parameters: render(name, variant, samples)[order]
    return Method(family, f"{samples} samples", forward, (), setup=load(name, variant)[1], host=True)


def means(name: str, samples: int, seed: int) -> np.ndarray:
    """Means [N, 3] of the judged pixels by so many stratified samples, with the LLVM variant."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    whole, _ = load(name, "llvm_ad_rgb")
    pixels = judged(name).astype(np.uint32)
    sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
    sampler.set_samples_per_wavefront(samples)  # stratified within every pixel, as when it renders whole pictures
    sampler.seed(seed, len(pixels) * samples)
    pixel = dr.repeat(mi.UInt32(pixels), samples)
    place = (mi.Point2f(pixel % SIZE, pixel // SIZE) + sampler.next_2d()) / SIZE
    ray, weight = whole.sensors()[0].sample_ray_differential(0.0, 0.0, place, mi.Point2f(0.5))
    colour, _, _ = whole.integrator().sample(whole, sampler, ray)
    return np.array(weight * colour, dtype=float).reshape(3, len(pixels), samples).mean(axis=2).T


def main() -> None:
    if "llvm_ad_rgb" not in variants():
        raise SystemExit("Mitsuba's LLVM variant does not run here: install libLLVM 16 or newer.")
    stored = {}
    for name in TITLES:
        passes = np.stack([means(name, PASS_SAMPLES, 1000 + k) for k in tqdm(range(PASSES), name)])
        mean = passes.mean(axis=0)
        noise = np.sqrt(np.mean(passes.var(axis=0, ddof=1)) / PASSES / np.mean(mean**2))
        stored |= {name: mean.astype(np.float32), f"{name} noise": noise}
        print(f"{name}: {len(mean)} pixels, {PASSES * PASS_SAMPLES} samples each, noise {noise:.2g}", flush=True)
    STORED.parent.mkdir(exist_ok=True)
    write_atomically(STORED, lambda file: np.savez_compressed(file, **stored), overwrite=True)
    print(f"{STORED.name}: {STORED.stat().st_size} bytes")


if __name__ == "__main__":
    main()
