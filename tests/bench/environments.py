"""A sphere of 128 x 128 pixels lit by a map, four materials and three maps, seen from one side up to 80 degrees.

The reference is quadrature over every texel, each in four parts, in sixteen for alphas below 0.1, in float64
(`shisd.reference`): python -m tests.bench.environments --make. Its error is the difference to four times as many parts,
of a few pixels.

ours: slices by view, `shading.shade` with a `DistantLight`; maps filtered for the material, `shading.prefilter`; for
clay also its irradiance, ISD15 Eq. 13; what is planned (tests/bench/planned.py).
Monte Carlo, point lights: tests/bench/monte_carlo.py. SH rotation: tests/bench/sh_rotation.py, on the same slices.
Split sum: tests/bench/split_sum.py. Spherical Gaussians: tests/bench/lobes.py.
Gradients: value and derivatives in normals, views, and the light's coefficients, texels or filtered texels, of a sum
over all pixels and colours; with one map, one material and some settings, as their cost depends on no numbers.
`setup` leaves compiling out: tables of the material and of the map, projection, fits (stored, with their seconds). For
every degree of ours and of SH rotation it is that of the highest degree, whose table they share.

Left out, as they are far off or only slower: for alphas below 0.1, ours without filtering below degree 30, and
filtering at degree 30; for alphas below 0.25, SH rotation.

To add a family: a function of a Scene that returns its methods, listed in FAMILIES.
"""

import argparse
import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import decomposition, harmonics, models, reference, shading
from shisd.io.internal import write_atomically
from tests.bench import lobes, monte_carlo, planned, sh_rotation, split_sum
from tests.bench.harness import Method, Task
from tests.bench.timing import timed

SIDE, JUDGED = 128, 256
STORED = Path(__file__).parent / "data" / "references_environments.npz"
FITTED = STORED.with_name("gaussians_environments.npz")
COPPER = np.array([0.955, 0.638, 0.538])
MATERIALS = {
    "clay": models.Lambertian(np.full(3, 0.8)),
    **{f"GGX {alpha:g}": models.Ggx(alpha, COPPER) for alpha in (0.5, 0.25, 0.1, 0.05, 0.02)},
}
MAPS = ("interior", "studio", "sun")
DEGREES, VIEWS = (4, 8, 16, 30), 32
FILTERED = {"GGX 0.1": (30, 64, 128), "GGX 0.05": (128, 255), "GGX 0.02": (255,)}  # degrees; of the others 30
DIFFERENTIATED = {"degree 16", "tolerance 0.02", "16", "64 x 128 map", "3 lobes"}  # settings
PARTS = ("directions", "sharpness", "weights")  # of a table of Gaussians


@dataclass(frozen=True)
class Scene:
    material: str
    map: str
    quick: bool = False

    @property
    def brdf(self):
        return MATERIALS[self.material]

    @property
    def with_gradients(self):
        """Whether gradients are asked for: what they cost depends on neither map nor material."""
        return not self.quick and self.map == "interior" and self.material == "GGX 0.25"

    @property
    def glossy(self):
        return self.material != "clay"

    @property
    def alpha(self):
        """1 of what is not glossy."""
        return float(self.brdf.alpha) if self.glossy else 1.0

    def some(self, settings):
        """All settings, or the first two."""
        return settings[:2] if self.quick else settings


@functools.cache
def functions(forward, wrt=None, **static):
    """forward(parameters, normals, views), and with the derivatives in parameters[wrt], normals and views."""
    forward = functools.partial(forward, **static)

    def gradient(parameters, normals, views):
        total = lambda x, n, v: jnp.sum(forward({**parameters, wrt: x}, n, v))
        return jax.value_and_grad(total, argnums=(0, 1, 2))(parameters[wrt], normals, views)

    return forward, gradient if wrt else None


@functools.cache
def environment(name: str) -> models.Environment:
    if name != "sun":
        return lobes.load_map(name)
    return models.Environment.from_function(sun_and_sky, 256)


def sun_and_sky(w):
    """A sun of radiance 3e4 and radius 2 degrees with a soft edge, 45 degrees high, over a sky and a dark ground."""
    toward = np.array([np.cos(4.1), np.sin(4.1), 1.0]) / np.sqrt(2)
    angle = jnp.degrees(jnp.arccos(jnp.clip(w @ jnp.asarray(toward, w.dtype), -1, 1)))
    disc = 3e4 * jax.nn.sigmoid((2 - angle) / 0.2)
    mix = lambda low, high, t: (1 - t) * np.asarray(low, w.dtype) + t * np.asarray(high, w.dtype)
    z = w[:, 2:]
    sky = mix([0.75, 0.8, 0.85], [0.25, 0.4, 0.7], jnp.sqrt(jnp.maximum(z, 0)))
    ground = np.array([[0.2, 0.17, 0.14]], w.dtype)
    return jnp.where(z > 0, sky, ground) + disc[:, None] * jnp.asarray([[1.0, 0.93, 0.82]], w.dtype)


@functools.cache
def pixels():
    """Normals and views [SIDE^2, 3] of the sphere in a fixed random order, so that the first ones are everywhere."""
    order = np.random.default_rng(0).permutation(SIDE**2)
    return tuple(a[order] for a in lobes.sphere_points(SIDE, SIDE))


# --- ours


@functools.cache
def coefficients(name: str):
    """The map's coefficients to the highest degree that anything needs, and seconds."""
    return timed(lambda: environment(name).coefficients(255), "coefficients")


@functools.cache
def tables(material: str):
    """Slices by degree, and the seconds of the highest one's table."""
    brdf, most = MATERIALS[material], DEGREES[-1]
    kind = type(brdf).__name__
    table, seconds = timed(lambda: shading.tabulate_brdf(brdf, most, elevations=VIEWS, quadrature=64), kind)
    return {degree: table.cut(degree) for degree in (2, *DEGREES)}, seconds


def shade(parameters, normals, views):
    light = models.DistantLight(parameters["light"])
    return shading.shade(parameters["material"], light, shading.Surface(normals, views))


def shade_diffuse(parameters, normals, views):
    irradiance = harmonics.convolve(parameters["light"], parameters["zonal"])
    return jnp.stack([harmonics.evaluate(colour, normals) for colour in irradiance], axis=-1)


def shisd(scene: Scene) -> list[Method]:
    by_degree, seconds = tables(scene.material)
    light, projection = coefficients(scene.map)
    own = {"setup": seconds + projection, "ours": True}
    methods = []
    degrees = scene.some(DEGREES) if scene.alpha > 0.08 else DEGREES[-1:]
    for degree in degrees if scene.glossy else (2, *degrees):
        parameters = {"material": by_degree[degree], "light": light[:, : (degree + 1) ** 2]}
        forward, gradient = functions(shade, "light")
        methods.append(Method("shisd", f"degree {degree}", forward, parameters, gradient, **own))
    if not scene.glossy:
        for degree in (2, 4, 8):
            zonal = by_degree[degree].at(jnp.asarray([0.0, 0.0, 1.0], jnp.float32))
            zonal = zonal[:, np.arange(degree + 1) * np.arange(1, degree + 2)]
            parameters = {"light": light[:, : (degree + 1) ** 2], "zonal": zonal}
            forward, gradient = functions(shade_diffuse, "light")
            methods.append(Method("shisd, irradiance", f"degree {degree}", forward, parameters, gradient, **own))
    return methods


@functools.cache
def sharp_table(material: str, degree: int):
    """Slices of a higher degree, and seconds."""
    brdf = MATERIALS[material]
    return timed(lambda: shading.tabulate_brdf(brdf, degree, quadrature=64 + degree), f"{type(brdf).__name__} {degree}")


def filtered_radiance(parameters, normals, views):
    filtered = eqx.tree_at(lambda x: x.maps, parameters["filtered"], parameters["maps"])
    return filtered.radiance(shading.Surface(normals, views))


def prefiltered(scene: Scene) -> list[Method]:
    methods = []
    for degree in (30,) if scene.quick else FILTERED.get(scene.material, (30,)):
        material, seconds = sharp_table(scene.material, degree)
        light = models.DistantLight(coefficients(scene.map)[0][:, : (degree + 1) ** 2])
        tolerances = (0.1, 0.05, 0.02, 0.005) if degree == 30 else (0.01,)
        for tolerance in scene.some(tolerances if scene.glossy else (0.01,)):
            make = functools.partial(shading.prefilter, material, light, tolerance=tolerance)
            make()  # compiles, for every number of channels again
            filtered, filtering = timed(make, "prefilter")
            parameters = {"filtered": filtered, "maps": filtered.maps}
            forward, gradient = functions(filtered_radiance, "maps")
            setting = f"tolerance {tolerance:g}"
            own = {"setup": seconds + filtering, "ours": True}
            methods.append(Method(f"shisd, filtered {degree}", setting, forward, parameters, gradient, **own))
    return methods


def shade_by_plan(plan, normals, views):
    return plan.shade(planned.NAME, shading.Surface(normals, views))


def choices(scene: Scene) -> list[Method]:
    return planned.methods(shade_by_plan, scene.brdf, environment(scene.map))


# --- others


@functools.cache
def samplers(name: str):
    texels = np.asarray(environment(name).texels)
    tables, seconds = timed(lambda: monte_carlo.light_tables(texels), "samplers")
    return {**tables, "shifts": monte_carlo.shifts(SIDE**2)}, seconds


def numbers(scene: Scene) -> dict:
    brdf = scene.brdf
    return {"alpha": brdf.alpha, "f0": brdf.f0} if scene.glossy else {"albedo": brdf.albedo}


def estimators(scene: Scene) -> list[Method]:
    tables, seconds = samplers(scene.map)
    parameters = {**tables, **numbers(scene)}
    methods = []
    for family, light, material in (("light", 1, 0), ("BRDF", 0, 1), ("MIS", 0.5, 0.5)):
        for count in scene.some((4, 16, 64, 256)):
            forward, gradient = functions(
                monte_carlo.radiance, "texels", of_light=int(light * count), of_material=int(material * count),
                glossy=scene.glossy,
            )  # fmt: skip
            gradient = gradient if family == "MIS" and count in (16, 64) else None
            methods.append(Method(f"Monte Carlo, {family}", f"{count}", forward, parameters, gradient, seconds))
    return methods


def fixed_lights(scene: Scene) -> list[Method]:
    tables, seconds = samplers(scene.map)
    forward, gradient = functions(monte_carlo.point_lights, "lights", glossy=scene.glossy)
    return [
        Method("point lights", f"{count}", forward,
               {"lights": monte_carlo.lights_of_map(tables, count), **numbers(scene)}, gradient, seconds)
        for count in scene.some((16, 64, 256, 1024))
    ]  # fmt: skip


@functools.cache
def slices(material: str):
    """Coefficients of all slices [V, 3, n] of every degree, twice as dense: they are interpolated linearly."""
    by_degree, seconds = tables(material)
    theta = (np.arange(2 * VIEWS) + 0.5) * (np.pi / 4 / VIEWS)
    local = jnp.asarray(np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1), jnp.float32)
    return {degree: _slices(by_degree[degree], local) for degree in DEGREES[:-1]}, seconds


@eqx.filter_jit
def _slices(table, local):
    return jax.vmap(table.at)(local)


def rotations(scene: Scene) -> list[Method]:
    if scene.alpha < 0.2:
        return []
    by_degree, seconds = slices(scene.material)
    light, projection = coefficients(scene.map)
    methods = []
    for turned in ("light", "lobe"):
        forward, gradient = functions(sh_rotation.radiance, "light", turned=turned)
        for degree in scene.some(DEGREES[:-1]):
            parameters = {"slices": by_degree[degree], "light": light[:, : (degree + 1) ** 2]}
            methods.append(
                Method(f"SH rotation of the {turned}", f"degree {degree}", forward, parameters,
                       gradient if turned == "light" else None, seconds + projection)
            )  # fmt: skip
    return methods


@functools.cache
def albedo(material: str):
    brdf = MATERIALS[material]
    if material == "clay":
        return brdf.albedo[None], 0.0
    scale, seconds = timed(lambda: split_sum.ggx_scale(float(brdf.alpha), COPPER), "scale")
    return jnp.asarray(scale, jnp.float32), seconds


def split_sums(scene: Scene) -> list[Method]:
    light, projection = coefficients(scene.map)
    scale, seconds = albedo(scene.material)
    kernel = split_sum.ggx_kernel(float(scene.brdf.alpha)) if scene.glossy else split_sum.cosine_kernel
    forward, gradient = functions(split_sum.radiance, "texels", glossy=scene.glossy)
    methods = []
    for height in scene.some((64, 128)):
        texels, filtering = timed(lambda height=height: split_sum.filtered(light, kernel, height), f"filtered {height}")
        parameters = {"texels": texels, "scale": scale}
        setup = projection + seconds + filtering
        methods.append(Method("split sum", f"{height} x {2 * height} map", forward, parameters, gradient, setup))
    return methods


@functools.cache
def pyramid(name: str):
    return timed(lambda: lobes.gaussian_pyramid(environment(name)), "pyramid")


@functools.cache
def fit(material: str, count: int):
    """The stored fit and its seconds."""
    stored = np.load(FITTED)
    *parts, seconds = (stored[f"{material}, {count}: {name}"] for name in (*PARTS, "seconds"))
    return jax.vmap(decomposition.GaussianLobes)(*(jnp.asarray(part) for part in parts)), float(seconds)


def stored_arrays(path: Path, chosen) -> dict:
    """What is there, unless all materials are made again."""
    return {} if set(chosen) == set(MATERIALS) else dict(np.load(path))


def make_fits(chosen):
    arrays = stored_arrays(FITTED, chosen)
    for material in chosen:
        brdf = MATERIALS[material]
        for count in (1, 3, 7):
            kind, name = f"{type(brdf).__name__}, {count} Gaussians", f"{material}, {count}"
            table, seconds = timed(lambda brdf=brdf, count=count: lobes.fit_table(brdf, count), kind)
            arrays |= {f"{name}: {part}": getattr(table, part) for part in PARTS} | {f"{name}: seconds": seconds}
            print(f"{name} Gaussians: {seconds:.2f} s", flush=True)
    write_atomically(FITTED, lambda file: np.savez_compressed(file, **arrays), overwrite=True)


def shade_gaussians(parameters, normals, views):
    levels = (parameters["texels"], parameters["firsts"], parameters["heights"])
    return lobes.shade_gaussians(parameters["table"], levels, normals, views)


def gaussians(scene: Scene) -> list[Method]:
    (texels, firsts, heights), filtering = pyramid(scene.map)
    forward, gradient = functions(shade_gaussians, "texels")
    methods = []
    for count in scene.some((1, 3, 7)):
        table, seconds = fit(scene.material, count)
        parameters = {"table": table, "texels": texels, "firsts": firsts, "heights": heights}
        setting = f"{count} lobe" + "s" * (count > 1)
        methods.append(Method("spherical Gaussians", setting, forward, parameters, gradient, seconds + filtering))
    return methods


FAMILIES = (shisd, prefiltered, choices, estimators, fixed_lights, rotations, split_sums, gaussians)


def tasks(quick: bool) -> Iterator[Task]:
    """One after another, as maps and tables of all scenes together take gigabytes."""
    stored = np.load(STORED)
    for material in ("GGX 0.25",) if quick else MATERIALS:
        for name in ("interior",) if quick else MAPS:
            scene, title = Scene(material, name, quick), f"{material}, {name}"
            methods = [method for family in FAMILIES for method in family(scene)]
            differentiated = DIFFERENTIATED if scene.with_gradients else ()
            methods = [m if m.setting in differentiated else replace(m, gradient=None) for m in methods]
            yield Task(
                f"environment: {title}", title, "pixel", pixels(), stored[title], float(stored[f"{title}: error"]),
                methods, count=SIDE**2,
            )  # fmt: skip


# --- references


def make_references(chosen):
    arrays = stored_arrays(STORED, chosen)
    normals, views = (np.asarray(a[:JUDGED], float) for a in pixels())
    for name in MAPS:
        texels = np.asarray(environment(name).texels, float)
        for material in chosen:
            parts = 4 if float(MATERIALS[material].lobe_width) < 0.08 else 2
            with jax.enable_x64(True):
                brdf = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), MATERIALS[material])
                shade = functools.partial(reference.shade_environment_quadrature, brdf, models.Environment(texels))
                values = np.asarray(shade(normals, views, supersampling=parts))
                finer = np.asarray(shade(normals[:16], views[:16], supersampling=2 * parts))
            error = np.sqrt(np.mean((values[:16] - finer) ** 2) / np.mean(finer**2))
            arrays[f"{material}, {name}"], arrays[f"{material}, {name}: error"] = values, error
            print(f"{material}, {name}: RMS {np.sqrt(np.mean(values**2)):.4g}, error {error:.1e}", flush=True)
    write_atomically(STORED, lambda file: np.savez_compressed(file, **arrays), overwrite=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--make", action="store_true", required=True, help="make the stored references and fits again")
    parser.add_argument("--only", choices=MATERIALS, action="append", help="of these materials; the others stay")
    chosen = parser.parse_args().only or list(MATERIALS)
    make_fits(chosen)
    make_references(chosen)
