"""Noise taken out of measured materials: log-normal noise of 10 %, half of the bins missing, and what is left of it.

RMSE is over all bins of the MERL table above the horizon and all colours, each bin alike, against the clean table; that
of the input is over its valid bins. Albedos are hemispherical-directional, by quadrature at five elevations up to 75
degrees. Beside `denoise_merl` stands ISD15's own way, a band-limited expansion in both directions (`fit_brdf`) of
40,000 valid bins: what its degree does to lobes is larger than the noise.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

from shisd import filtering, models
from shisd.filtering._brdf import BrdfFit
from shisd.filtering._merl import _bin_energy
from shisd.io._merl import tabulate_merl
from shisd.io.internal import merl_above_horizon, merl_directions
from shisd.models._measured import fill_nearest
from tests.models.materials import GOLD_PAINT, NICKEL, albedos, evaluate, pairs, spoiled

NOISE, HOLES, SAMPLES = 0.1, 0.5, 40000
ELEVATIONS, RULE = np.radians([0, 20, 40, 60, 75]), (120, 160)
MATERIALS = {
    "plastic, roughness 0.5": lambda: models.CookTorrance(0.5, 0.0, [0.6, 0.06, 0.05]),
    "GGX, alpha 0.3": lambda: models.Ggx(0.3, [0.9, 0.5, 0.2]),
    "GGX, alpha 0.1": lambda: models.Ggx(0.1, [0.9, 0.5, 0.2]),
    "gold paint, SGD": lambda: models.SgdMicrofacet(**GOLD_PAINT),
    "nickel, ABC": lambda: models.AbcMicrofacet(**NICKEL),
}


def clean_table(brdf: models.AbstractBrdf) -> np.ndarray:
    """As in a file: -1 below the horizon."""
    return np.where(merl_above_horizon()[..., None], tabulate_merl(brdf), -1)


def measured(table: np.ndarray) -> models.MeasuredBrdf:
    """The table as it is, holes filled with the nearest value."""
    filled = fill_nearest(table, table >= 0)
    return models.MeasuredBrdf(jnp.asarray(filled, np.float32))


def reciprocity(brdf: models.AbstractBrdf) -> float:
    """Largest |f(wi, wo) - f(wo, wi)| over the largest value, float64."""
    with jax.enable_x64(True):
        double = jax.tree.map(lambda a: a.astype(jnp.float64), brdf)
        wi, wo = pairs(np.random.default_rng(1), 2000, 1e-3)
        there, back = (np.asarray(evaluate(double, *pair)) for pair in ((wi, wo), (wo, wi)))
        return float(np.max(np.abs(there - back)) / np.max(there))


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def fit_bins(noisy: np.ndarray, degree: int) -> BrdfFit:
    """ISD15's projection of bins drawn with the share of the energy that they stand for."""
    energy = np.where(np.all(noisy >= 0, axis=-1), _bin_energy(), 0).ravel()
    wi, wo = (w.reshape(-1, 3) for w in merl_directions())
    some = np.random.default_rng(2).choice(energy.size, SAMPLES, p=energy / energy.sum())
    values = noisy.reshape(-1, 3)[some].astype(np.float32)
    return filtering.fit_brdf(wi[some], wo[some], values, degree, isotropic=True, ridge=1e-7, throw=False)


def at_bins(brdf: models.AbstractBrdf) -> np.ndarray:
    """Values at the centres of the bins above the horizon."""
    return tabulate_merl(brdf)[merl_above_horizon()]


def compare(name: str, clean: np.ndarray, *, degree: int | None = 12) -> list[dict]:
    """Rows of one material, from its clean table: denoised, and projected to `degree`."""
    above = merl_above_horizon()
    noisy = spoiled(clean, np.random.default_rng(0), NOISE, HOLES)
    before = rms((noisy - clean)[np.all(noisy >= 0, axis=-1)])
    reference = albedos(measured(clean), ELEVATIONS, RULE)

    def row(method: str, brdf: models.AbstractBrdf, values: np.ndarray, seconds: float, setting: str) -> dict:
        after = rms(values - clean[above])
        found = albedos(brdf, ELEVATIONS, RULE)
        return {
            "material": name,
            "method": method,
            "RMSE in": before,
            "RMSE out": after,
            "in / out": before / after,
            "albedo change, worst": float(np.max(np.abs(found / reference - 1))),
            "mean": float(np.max(np.abs(np.mean(found, axis=0) / np.mean(reference, axis=0) - 1))),
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
