"""Noise taken out of measured materials: log-normal noise of 10 %, half of the bins missing, and what is left of it.

RMSE is over all bins of the MERL table above the horizon and all colours, each bin alike, against the clean table; that
of the input is over its valid bins. Albedos are hemispherical-directional, by quadrature at five elevations up to 75
degrees. Beside `denoise_merl` stands ISD15's own way, a band-limited expansion in both directions (`fit_brdf`) of
40,000 valid bins: what its degree does to lobes is larger than the noise.

`picture` shades spheres with the clean, the noisy and the denoised material.
"""

import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from shisd import decomposition, filtering, io, models, shading
from shisd.models._measured import fill_nearest
from tests.models.materials import GOLD_PAINT, NICKEL, array, evaluate, hemisphere_rule, pairs, spherical

NOISE, HOLES, SAMPLES = 0.1, 0.5, 40000
ELEVATIONS = np.radians([0, 20, 40, 60, 75])
MATERIALS = {
    "plastic, roughness 0.5": lambda: models.CookTorrance(0.5, 0.0, [0.6, 0.06, 0.05]),
    "GGX, alpha 0.3": lambda: models.Ggx(0.3, [0.9, 0.5, 0.2]),
    "GGX, alpha 0.1": lambda: models.Ggx(0.1, [0.9, 0.5, 0.2]),
    "gold paint, SGD": lambda: models.SgdMicrofacet(**GOLD_PAINT),
    "nickel, ABC": lambda: models.AbcMicrofacet(**NICKEL),
}


def clean_table(brdf: models.AbstractBrdf) -> np.ndarray:
    """As in a file: -1 below the horizon."""
    return np.where(io.merl_above_horizon()[..., None], io._tabulate_merl(brdf), -1)


def spoil(table: np.ndarray, seed: int = 0, *, noise: float = NOISE, holes: float = HOLES) -> np.ndarray:
    """The table with log-normal noise in each value and a share of the bins missing."""
    rng = np.random.default_rng(seed)
    noisy = np.where(table < 0, table, table * np.exp(noise * rng.standard_normal(table.shape)))
    return np.where(rng.random(table.shape[:3])[..., None] < holes, -1, noisy)


def measured(table: np.ndarray) -> models.MeasuredBrdf:
    """The table as it is, holes filled with the nearest value."""
    filled = fill_nearest(table, table >= 0)
    return models.MeasuredBrdf(jnp.asarray(filled, np.float32))


def albedos(brdf: models.AbstractBrdf) -> np.ndarray:
    """Hemispherical-directional albedo, [elevations, 3]."""
    wi, weight = (array(a, np.float32) for a in hemisphere_rule(120, 160))
    views = [jnp.broadcast_to(array(spherical(e, 0.3), np.float32), wi.shape) for e in ELEVATIONS]
    return np.stack([(weight * wi[:, 2]) @ evaluate(brdf, wi, view) for view in views])


def reciprocity(brdf: models.AbstractBrdf) -> float:
    """Largest |f(wi, wo) - f(wo, wi)| over the largest value, float64."""
    with jax.enable_x64(True):
        double = jax.tree.map(lambda a: a.astype(jnp.float64), brdf)
        wi, wo = pairs(np.random.default_rng(1), 2000, 1e-3)
        there, back = (np.asarray(evaluate(double, *pair)) for pair in ((wi, wo), (wo, wi)))
        return float(np.max(np.abs(there - back)) / np.max(there))


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def fit_bins(noisy: np.ndarray, degree: int) -> filtering.BrdfFit:
    """ISD15's projection of bins drawn with the share of the energy that they stand for."""
    energy = np.where(np.all(noisy >= 0, axis=-1), filtering._bin_energy(), 0).ravel()
    wi, wo = (w.reshape(-1, 3) for w in io._merl_directions())
    some = np.random.default_rng(2).choice(energy.size, SAMPLES, p=energy / energy.sum())
    values = noisy.reshape(-1, 3)[some].astype(np.float32)
    return filtering.fit_brdf(wi[some], wo[some], values, degree, isotropic=True, ridge=1e-7)


def at_bins(brdf: models.AbstractBrdf) -> np.ndarray:
    """Values at the centres of the bins above the horizon."""
    return io._tabulate_merl(brdf)[io.merl_above_horizon()]


def compare(name: str, clean: np.ndarray, *, degree: int | None = 12) -> list[dict]:
    """Rows of one material, from its clean table: denoised, and projected to `degree`."""
    above = io.merl_above_horizon()
    noisy = spoil(clean)
    before = rms((noisy - clean)[np.all(noisy >= 0, axis=-1)])
    reference = albedos(measured(clean))

    def row(method: str, brdf: models.AbstractBrdf, values: np.ndarray, seconds: float, setting: str) -> dict:
        after = rms(values - clean[above])
        change = albedos(brdf) / reference - 1
        return {
            "material": name,
            "method": method,
            "RMSE in": before,
            "RMSE out": after,
            "in / out": before / after,
            "albedo change, worst": float(np.max(np.abs(change))),
            "mean": float(np.max(np.abs(np.mean(albedos(brdf), axis=0) / np.mean(reference, axis=0) - 1))),
            "reciprocity": reciprocity(brdf),
            "setting": setting,
            "s": seconds,
        }  # fmt: skip

    start = time.perf_counter()
    result = filtering.denoise_merl(noisy)
    seconds = time.perf_counter() - start
    table = np.asarray(result.brdf.table)
    rows = [row("denoise_merl", result.brdf, table[above], seconds, f"smoothness {result.smoothness:g}")]
    if degree is not None:
        start = time.perf_counter()
        fit = jax.block_until_ready(fit_bins(noisy, degree))
        seconds = time.perf_counter() - start
        rows.append(row("fit_brdf", fit.brdf, at_bins(fit.brdf), seconds, f"degree {degree}"))
    return rows


def tables(quick: bool) -> dict[str, list[dict]]:
    """Title and rows of the table; one material, and no expansion, when quick."""
    names = ["GGX, alpha 0.3"] if quick else MATERIALS
    rows = [r for n in names for r in compare(n, clean_table(MATERIALS[n]()), degree=None if quick else 12)]
    return {f"Denoised: noise of {NOISE:.0%}, {HOLES:.0%} of the bins missing, table [90, 90, 180].": rows}


def picture(path: Path, brdf: models.AbstractBrdf, *, degree: int = 20, size: int = 160, noise: float = 0.5) -> None:
    """Spheres under the room of the examples: clean, noisy with holes, denoised. Writes a PNG.

    Noise of 10 % averages out over a lobe; the default here is 50 %, and 95 % of the bins missing.
    """
    environment = models.Environment.load(Path("examples/data/interior.hdr"))
    light = environment.coefficients(degree)
    basis = decomposition.RotatedZonalBasis(decomposition.optimized_directions(degree), degree)
    x, y = np.meshgrid(*[(np.arange(size) + 0.5) / size * 2 - 1] * 2)
    inside = x * x + y * y < 1
    normals = np.stack([x, np.sqrt(np.maximum(1 - x * x - y * y, 0)), -y], axis=-1)[inside].astype(np.float32)
    views = np.broadcast_to(np.array([0, 1, 0], np.float32), normals.shape)
    clean = clean_table(brdf)
    noisy = spoil(clean, noise=noise, holes=0.95)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trio = measured(clean), measured(noisy), filtering.denoise_merl(noisy).brdf
    images = []
    for material in trio:
        lobes = shading.tabulate_brdf(material, basis, throw=False)  # noise is not resolved by any quadrature
        image = np.zeros((size, size, 3))
        image[inside] = shading.shade_environment(lobes, light, normals, views)
        images.append(image)
    scale = 0.8 / np.quantile(images[0][inside], 0.98)
    io.write_image(path, io.tonemap(np.concatenate(images, axis=1), exposure=scale), overwrite=True)
