"""Find the roughness, anisotropy and colour of a material from one picture of a sphere under a known map.

The picture is Mitsuba's (`examples/data/material.npz`): a brushed gloss on a matt colour, lit by a photographed studio.
From six parameters to the loss everything is differentiable: BRDF -> slices by view, in spherical harmonics -> picture
-> loss. The fit starts from a rough, grey, isotropic material, first with slices of degree 8, which is quick, and from
there with --degree. It never sees the truth, which is stored for comparison.
Writes a picture and a table to --output.

    python examples/fit_material.py --output output/fit_material
"""

import time
import warnings
from collections.abc import Callable
from pathlib import Path

import _fit
import _scene
import jax
import jax.numpy as jnp
import numpy as np

from shisd import models, shading

NAMES = "alpha along x", "alpha along y", "albedo, red", "albedo, green", "albedo, blue", "specular"
START = 0.7, 0.7, 0.2, 0.2, 0.2, 0.1
COARSE = 8
# How many views are enough: to 16 elevations and 40 quadrature nodes, the answer moves by 0.2 % at most; to degree 24,
# by 0.3 % (degree 16: by 0.6 % the other way). A slice seen from another azimuth is turned, so its band m goes
# round m times: azimuths 2 degree + 4 resolve that; 32 at degree 20 make the picture's error larger by half.
VIEWS, QUADRATURE = 12, 24


def material(logarithms: jax.Array) -> _fit.Coated:
    """From unconstrained parameters [6], in the order of NAMES, to positive ones."""
    p = jnp.exp(logarithms)
    return _fit.Coated(p[:2], p[2:5], p[5])


def chain(picture: _fit.Picture, environment: models.Environment, degree: int) -> Callable:
    """The picture [N, 3] of the pixels that are used, as a function of the parameters [6]."""
    light = environment.light(degree)
    normals, views = (jnp.asarray(a, jnp.float32) for a in (picture.points, picture.views))
    tangents = jnp.stack([-normals[..., 1], normals[..., 0], jnp.zeros_like(normals[..., 0])], axis=-1)
    surface = shading.Surface(normals, views, tangents=tangents)
    options = {"elevations": VIEWS, "azimuths": 2 * degree + 4, "quadrature": QUADRATURE}

    def image(parameters: jax.Array) -> jax.Array:
        # The quadrature's own estimate is of the worst slice, next to the horizon, which no pixel shows: not asked for.
        slices = shading.tabulate_brdf(material(parameters), degree, **options, throw=False)
        return shading.shade(slices, light, surface).mean(axis=1)

    return image


def cost(loss: Callable, parameters: jax.Array) -> str:
    """Seconds to compile the gradient of the whole chain, and its run time against the loss alone."""
    compiled, seconds = {}, {"loss": np.inf, "gradient": np.inf}
    for name, function in (("loss", loss), ("gradient", jax.value_and_grad(loss))):
        start = time.perf_counter()
        compiled[name] = jax.jit(function).lower(parameters).compile()
        seconds["compile"] = time.perf_counter() - start
    for name in 3 * ["loss", "gradient"]:  # by turns: what else the machine does then meets both
        start = time.perf_counter()
        jax.block_until_ready(compiled[name](parameters))
        seconds[name] = min(seconds[name], time.perf_counter() - start)
    return (
        f"One gradient of the whole chain takes {seconds['gradient'] / seconds['loss']:.1f} times the forward pass "
        f"({seconds['loss']:.2g} s) and {seconds['compile']:.0f} s to compile."
    )


def run(output: Path, size: int | None, degree: int, steps: int, noisy: int) -> tuple[list[_fit.Row], str]:
    picture = _fit.load(_scene.DATA / "material.npz", size)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of three texels below zero
        environment = models.Environment.load(_scene.DATA / "studio.exr")
    scale = np.sqrt(np.mean(picture.values**2))
    images = {d: chain(picture, environment, d) for d in (COARSE, degree)}
    solvers = {}
    for d, image in images.items():
        residuals = lambda parameters, values, image=image: ((image(parameters) - values) / scale).ravel()
        solvers[d] = _fit.LeastSquares(residuals, rtol=3e-4, atol=3e-4)
    report = cost(lambda p: jnp.mean((images[degree](p) - picture.values) ** 2), jnp.log(jnp.array(START)))

    def fit(values: np.ndarray, label: str) -> tuple[np.ndarray, np.ndarray]:
        data = jnp.asarray(values, jnp.float32)
        coarse = solvers[COARSE](np.log(START), data, steps=steps, label=f"{label}, degree {COARSE}")
        fine = solvers[degree](coarse.parameters, data, steps=steps, label=f"{label}, degree {degree}")
        return np.exp(fine.parameters), np.exp(np.concatenate([coarse.path, fine.path]))

    found, path = fit(picture.values, "picture")
    others = [fit(_fit.with_noise(picture.values, 0.01, seed), f"noise {seed}")[0] for seed in range(noisy)]

    truth = np.concatenate([np.ravel(picture.truth[name]) for name in ("alpha", "albedo", "specular")])
    derive = lambda p: np.concatenate([[np.sqrt(p[0] * p[1]), p[0] / p[1]], p])
    names = ["roughness", "anisotropy", *NAMES]
    error = lambda p: 100 * np.abs(derive(p) / derive(truth) - 1)
    columns = zip(names, derive(truth), derive(found), error(found), strict=True)
    rows = [_fit.Row(*row, [error(p)[k] for p in others]) for k, row in enumerate(columns)]
    curves = dict(zip(names, np.array([error(p) for p in path]).T, strict=True))
    curves = {name.replace("albedo, ", ""): curves[name] for name in ("roughness", "anisotropy", *NAMES[2:])}
    fitted = np.asarray(images[degree](jnp.log(jnp.asarray(found, jnp.float32))))
    _fit.sheet(
        output / "fit_material.png", picture, fitted, 0.9 / np.percentile(picture.values, 99), curves, (1e-3, 1e-1)
    )
    return rows, report


def table(rows: list[_fit.Row], degree: int) -> str:
    return "\n".join(
        [
            _fit.table(rows),
            "",
            f"Degree {degree}. Roughness is sqrt(alpha_x alpha_y), anisotropy alpha_x / alpha_y. Last column: noise of",
            f"1 % of the picture's RMS added to every pixel; RMS of {len(rows[0].noisy)} seeds.",
        ]
    )


def main(arguments: list[str] | None = None) -> None:
    parser = _scene.output_parser(__doc__, "fit_material")
    parser.add_argument("--size", type=int, help="width of the picture in pixels, a divisor of that stored")
    parser.add_argument("--degree", type=int, default=20, help="of the slices; the error falls with it")
    parser.add_argument("--steps", type=int, default=30, help="most steps of one fit at one degree")
    parser.add_argument("--noisy", type=int, default=2, help="fits to pictures with noise")
    options = parser.parse_args(arguments)
    _scene.prepare_output(options.output, options.overwrite, "fit_material", parser)
    start = time.perf_counter()
    rows, report = run(options.output, options.size, options.degree, options.steps, options.noisy)
    _fit.write_csv(options.output / "fit_material.csv", rows)
    text = table(rows, options.degree)
    _scene.save(options.output / "fit_material.md", text + "\n")
    print(text)
    for row in rows:
        assert row.error < 2, f"{row.parameter}: {row.error:.2g} % from the truth"
    print(f"\n{report}")
    worst = max(rows, key=lambda row: row.error)
    reached = (
        f"Material within {worst.error:.2g} % of the truth ({worst.parameter}, the worst of {len(rows)} parameters)"
    )
    _scene.verdict(reached, start, options.output)


if __name__ == "__main__":
    main()
