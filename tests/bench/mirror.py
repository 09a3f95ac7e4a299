"""Mirrors under photographed rooms: footprints that are filtered at once against samples of every pixel.

A picture of a sphere and of a rabbit (with its interpolated normals), 96 x 96 pixels, of perfect mirrors. Every method
has the same Gaussian filter, of a standard deviation of half a pixel, cut at one and a half, over what the object
covers. Samples look the map up, on a grid of g x g rays for each pixel; all samples within the filter, also those of
the pixels around, are averaged. The reference has 16 x 16. Footprints are made of the normals and positions at the
centres of pixels, so of one ray each. Error: RMSE over RMS of linear RGB, nothing clamped, over all seen pixels and
over those whose neighbours are seen too; and the median over pixels of the relative error, which lamps do not rule.
Times leave ray casting out; "with the footprint" has it made from the images.

The light of a degree rings around lamps where footprints are narrow; "Hann" stands for light under that window.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from examples._scene import camera_rays, hits, load_mesh, sphere_hits, unit
from shisd import harmonics, models, shading
from shisd._numerics import normalize
from shisd.harmonics.internal import sample_map
from tests.bench.timing import interleaved

DATA = Path(__file__).parents[2] / "examples" / "data"
SIDE, WIDTH, REFERENCE = 96, 0.5, 16
MAPS = {"interior": "interior.hdr", "studio": "studio.exr"}
DEGREES = (16, 30, 60, 100)
_mesh_of = functools.cache(load_mesh)


@dataclass(frozen=True)
class Images:
    """Of a picture: where the object is [H, W], and its normals and positions [H, W, 3]; the camera's place."""

    seen: np.ndarray
    normals: np.ndarray
    positions: np.ndarray
    eye: np.ndarray


@functools.cache
def images(name: str, side: int) -> Images:
    """The object as rays through the centres of side x side pixels meet it."""
    eye = (4.2 if name == "sphere" else 3.8) * np.array([np.cos(0.7), np.sin(0.7), 0.2])
    rays = camera_rays(side, eye, np.zeros(3), np.radians(32 if name == "sphere" else 29))
    seen, normals, positions = (_sphere if name == "sphere" else _rabbit)(eye, rays.reshape(-1, 3))
    image = lambda a: a.astype(np.float32).reshape(side, side, 3)
    return Images(seen.reshape(side, side), image(normals), image(positions), eye.astype(np.float32))


def _sphere(eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    seen, points = sphere_hits(eye, rays)
    return seen, points, points


def _rabbit(eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    seen, normals, positions = np.zeros(len(rays), bool), np.zeros_like(rays), np.zeros_like(rays)
    ray, positions_seen, *_, normals_seen = hits(_mesh_of(DATA / "bunny.ply"), eye, rays)
    seen[ray], positions[ray], normals[ray] = True, positions_seen, normals_seen
    return seen, normals, positions


@functools.cache
def environment(name: str) -> models.Environment:
    return models.Environment.load(DATA / MAPS[name])


@functools.cache
def _filter_matrix(samples: int) -> np.ndarray:
    """Gaussian weights [SIDE, SIDE * samples] of the samples of a row for its pixels."""
    at = (np.arange(SIDE * samples) + 0.5) / samples - (np.arange(SIDE)[:, None] + 0.5)
    return np.where(np.abs(at) <= 1.5, np.exp(-(at**2) / (2 * WIDTH**2)), 0).astype(np.float32)


def sampled(name: str, room: str, samples: int, filtered: bool = True) -> tuple[Callable, tuple]:
    """A function of normals, positions and eye, which averages samples over the object's part of each filter."""
    of = images(name, SIDE * samples)
    texels = environment(room).texels
    row, column = np.nonzero(of.seen)
    matrix = jnp.asarray(_filter_matrix(samples))
    coverage = jnp.maximum(matrix @ jnp.asarray(of.seen, jnp.float32) @ matrix.T, 1e-6)[..., None]

    @jax.jit
    def picture(normals, positions, eye):
        views = normalize(eye[None] - positions)
        directions = 2 * jnp.sum(views * normals, axis=1, keepdims=True) * normals - views
        looked = sample_map(texels, directions, texels="samples")
        light = jnp.zeros((*of.seen.shape, 3)).at[row, column].set(looked)
        if not filtered:
            return light
        return jnp.einsum("is,stc,jt->ijc", matrix, light, matrix, optimize=True) / coverage

    return picture, (of.normals[of.seen], of.positions[of.seen], of.eye)


def reflected(name: str, shade: Callable) -> tuple[Callable, Callable]:
    """Radiance of the seen pixels from `shade(footprint)`: with the footprint made before, and with it made."""
    of = images(name, SIDE)
    seen = np.nonzero(of.seen)
    arguments = tuple(jnp.asarray(a) for a in (of.normals, of.positions, of.eye, of.seen))
    chosen = jax.jit(lambda footprint: jax.tree.map(lambda a: a[seen], footprint))
    make = lambda: chosen(shading.footprint(*arguments, filter_width=WIDTH))
    footprint = make()
    return lambda: shade(footprint), lambda: shade(make())


@functools.cache
def light(room: str, degree: int, windowed: bool = False):
    e = environment(room).coefficients(degree)
    return harmonics.apply_window(e, harmonics.hann_window(degree)) if windowed else e


def methods(name: str, room: str, degrees: tuple[int, ...] = DEGREES) -> dict[str, tuple[Callable, Callable]]:
    """Radiance [N, 3] of the seen pixels by method: a call, and the same with the footprint."""
    of, found = images(name, SIDE), {}
    seen = np.nonzero(of.seen)

    def add(title, samples, filtered=True):
        picture, arguments = sampled(name, room, samples, filtered)
        arguments = tuple(jnp.asarray(a) for a in arguments)
        found[title] = (lambda: picture(*arguments)[seen],) * 2

    add("1 sample, no filter", 1, filtered=False)
    add("1 sample", 1)
    for samples in (2, 4):
        add(f"{samples} x {samples} samples", samples)
    for degree in degrees:
        for windowed, of_light in ((False, f"degree {degree}"), (True, f"degree {degree}, Hann")):
            distant = models.DistantLight(light(room, degree, windowed))
            shade = functools.partial(shading.reflect, light=distant)
            found[f"round, {of_light}"] = reflected(name, shade)
            if degree <= 60:
                found[f"as it is, {of_light}"] = reflected(name, functools.partial(shade, anisotropic=True))
    maps = shading.MirrorMaps.from_texels(environment(room).texels)
    found["filtered maps"] = reflected(name, functools.partial(shading.reflect, light=maps))
    return found


def reference(name: str, room: str) -> np.ndarray:
    picture, arguments = sampled(name, room, REFERENCE)
    return np.asarray(picture(*arguments))[images(name, SIDE).seen]


def tables(quick: bool) -> dict[str, list[dict]]:
    """Title and rows of a table for each object and map; one when quick."""
    made = {}
    for name in ("sphere",) if quick else ("sphere", "rabbit"):
        for room in ("interior",) if quick else MAPS:
            made[f"Mirror: {name} under {room}"] = _rows(name, room, quick)
    if not quick:
        made["Cost of a round footprint against one evaluation of the harmonics, three colours."] = _costs()
    return made


def _rows(name: str, room: str, quick: bool) -> list[dict]:
    found, truth = methods(name, room, DEGREES[:1] if quick else DEGREES), reference(name, room)
    seen = images(name, SIDE).seen
    padded = np.pad(seen, 1)
    inner = np.all([padded[1 + j : 1 + j + SIDE, 1 + i : 1 + i + SIDE] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    rmse = lambda values, where: float(np.sqrt(np.mean((values - truth)[where] ** 2) / np.mean(truth[where] ** 2)))
    norm = lambda values: np.linalg.norm(values, axis=1)
    calls = {(title, i): call for title, pair in found.items() for i, call in enumerate(pair)}
    times = interleaved(calls, seconds=0.05 if quick else 0.2)
    rows = []
    for title, (call, _) in found.items():
        values, us = np.asarray(call()), lambda i, title=title: times[title, i].best / np.sum(seen) * 1e6
        rows.append({
            "method": title,
            "relative RMSE": rmse(values, slice(None)),
            "without the rim": rmse(values, inner[seen]),
            "median": float(np.median(norm(values - truth) / norm(truth))),
            "us/pixel": us(0),
            "with the footprint": us(1),
        })  # fmt: skip
    return rows


def _costs() -> list[dict]:
    """At random directions and widths, in one process."""
    rng = np.random.default_rng(0)
    directions = jnp.asarray(unit(rng.normal(size=(8192, 3))), jnp.float32)
    axes = jnp.asarray(rng.uniform(0, 0.1, (8192, 1, 1)) * np.ones((1, 3, 2)), jnp.float32)
    footprint, rows = shading.Footprint(directions, axes), []
    for degree in DEGREES:
        e = light("interior", degree)
        distant = models.DistantLight(e)
        calls = {
            "reflect": lambda distant=distant: shading.reflect(footprint, distant),
            "sh_basis and sum": jax.jit(lambda e=e, degree=degree: harmonics.sh_basis(directions, degree) @ e.T),
            "evaluate": lambda e=e: harmonics.evaluate(e[:, None], directions),
            "anisotropic": lambda distant=distant: shading.reflect(footprint, distant, anisotropic=True),
        }
        times = {name: t.best / 8192 * 1e6 for name, t in interleaved(calls, seconds=0.5).items()}
        rows.append({
            "degree": degree,
            **{f"{name}, us": t for name, t in times.items()},
            "over sh_basis": times["reflect"] / times["sh_basis and sum"],
            "over evaluate": times["reflect"] / times["evaluate"],
        })  # fmt: skip
    return rows
