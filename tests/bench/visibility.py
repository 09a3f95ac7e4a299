"""A mesh that hides the light from itself: error and cost of band-limited visibility, beside ray casting.

The rabbit of the examples, GGX of alpha 0.4 and clay under two maps. The truth is `reference.shade_environment` with
rays to the mesh at every pixel; its noise is taken off. `predicted` is what the bands of visibility that are left out
would add, from energies alone, if visibility and the product of light and slice were turned at random to each other:

    mean square = sum over l > L of |v_l|^2 |(E rho)_l|^2 / (2l+1), up to degree 24.

Error: RMSE over the RMS of the picture with occlusion.
"""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from examples import _scene
from shisd import harmonics, models, reference, shading
from shisd.harmonics import _tables
from shisd.harmonics._rotation import rotate_many
from shisd.shading._frames import frame
from shisd.shading.slices._slices import lookup_table, slice_values
from tests.bench.timing import interleaved

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
MATERIALS = {"clay": models.Lambertian(0.7), "GGX 0.4": models.Ggx(0.4, 0.5)}
OF_SLICES, DEGREES, FINE = 16, (2, 4, 8, 12), 24


def rabbit(size: int):
    """The mesh, a view of it, where its pixels' rays start, and the function that casts them."""
    file = EXAMPLES / "data" / "bunny.ply"
    shape, view = _scene.load_mesh(file), _scene.mesh(file, size, 5)
    off = 1e-4 * np.linalg.norm(np.ptp(shape.vertices, axis=0))
    starts = (view.positions + off * shape.face_normals[view.triangle]).astype(np.float32)
    return shape, view, starts, lambda p, w: ~shape.ray.intersects_any(p, w)


def environment(file: str) -> models.Environment:
    texels = models.Environment.load(EXAMPLES / "data" / file).texels
    step = texels.shape[0] // 128
    return models.Environment(texels.reshape(128, step, 256, step, 3).mean(axis=(1, 3))[:, ::-1])


def energies(c: np.ndarray) -> np.ndarray:
    """Mean energy of every band over all axes but the last."""
    degree = int(np.sqrt(c.shape[-1])) - 1
    return np.bincount(_tables.bands(degree), np.mean(c.reshape(-1, c.shape[-1]) ** 2, axis=0))


def predicted(material, e, fine, view, degree: int) -> float:
    """RMS error of leaving out the bands of visibility above `degree`, averaged over colours."""
    some = np.linspace(0, len(view.normals) - 1, 200).astype(int)
    frames = frame(jnp.asarray(view.normals[some]))
    local = jnp.einsum("pij,pi->pj", frames, view.views[some])
    slices = slice_values(lookup_table(material), local, material)
    slices = rotate_many(slices[:, None], frames, OF_SLICES)[:, 0].T
    products = harmonics.multiply(e[None], slices[:, None], FINE)
    product = energies(np.asarray(products))
    seen = energies(np.asarray(fine.at(view.triangle[some], view.weights[some])))
    l = np.arange(FINE + 1)
    return float(np.sqrt(np.sum((seen * product / (2 * l + 1))[degree + 1 :])))


def tables(quick: bool) -> dict[str, list[dict]]:
    """Title and rows of the table."""
    shape, view, starts, visible = rabbit(48 if quick else 80)
    see = lambda degree: models.Visibility.from_mesh(shape.vertices, shape.faces, degree, rays=2048)
    fine, seen = see(FINE), {degree: see(degree) for degree in (DEGREES[1:3] if quick else DEGREES)}
    surface = lambda: shading.Surface(view.normals, view.views, triangles=view.triangle, barycentric=view.weights)
    shaded = lambda material, light: shading.shade(material, light, surface())
    rows = []
    for map_name, file in (("interior", "interior.hdr"), ("studio", "studio.exr"))[: 1 if quick else 2]:
        light = environment(file)
        for name, brdf in MATERIALS.items():
            material = shading.tabulate_brdf(brdf, OF_SLICES)
            trace = lambda samples, seed, brdf=brdf, light=light: reference.shade_environment(
                brdf, light, view.normals, view.views, key=jax.random.key(seed), samples=samples, positions=starts,
                visible=visible,
            )  # fmt: skip
            truth = trace(256 if quick else 1024, 0)
            noise2 = float(np.mean(np.asarray(truth.standard_error, float) ** 2))
            rms = float(np.sqrt(np.mean(np.asarray(truth.value, float) ** 2)))
            distant = {degree: light.light(degree + OF_SLICES) for degree in (0, *seen, FINE)}
            hidden = {degree: models.Occluded(distant[degree], v) for degree, v in seen.items()}
            methods = {
                ("no occlusion", ""): functools.partial(shaded, material, distant[0]),
                **{
                    ("visibility", f"degree {degree}"): functools.partial(shaded, material, own)
                    for degree, own in hidden.items()
                },
                ("ray casting", "64 rays"): lambda trace=trace: trace(64, 1).value,
            }
            times = interleaved(methods, seconds=0.2)
            for (method, setting), function in methods.items():
                excess = np.mean((np.asarray(function(), float) - np.asarray(truth.value, float)) ** 2) - noise2
                expected = method.startswith("visibility") and predicted(
                    material, distant[FINE].coefficients, fine, view, int(setting.split()[1])
                )
                rows.append({
                    "map": map_name,
                    "material": name,
                    "method": f"{method} {setting}".strip(),
                    "error": float(np.sqrt(max(excess, 0))) / rms,
                    "predicted": expected / rms if expected else None,
                    "us/pixel": times[method, setting].best / len(view.normals) * 1e6,
                })  # fmt: skip
    return {"A rabbit that shadows itself": rows}
