"""Two representations of how a slice depends on the view: tables of elevations, and doubly projected matrices.

Errors are relative RMSEs over views, by solid angle, of functions on the sphere: that of the light's side is what the
slices lack above their degree, the same in both representations; that of the view's side is what interpolating or
expanding adds. Both against the material itself. Times are of `shade` on random normals and views under a
`DistantLight` of three colours, interleaved; of isotropic materials one stands for all.
"""

import functools
from collections.abc import Callable, Hashable

import jax
import jax.numpy as jnp
import numpy as np

from shisd import models, shading
from shisd.shading.slices._tabulate import project_slices
from tests.bench.timing import interleaved

COUNT = 16384
MATERIALS = {
    "Lambertian": models.Lambertian(0.7),
    "GGX 0.5": models.Ggx(0.5, 0.04),
    "GGX 0.25": models.Ggx(0.25, 0.04),
    "GGX 0.25 x 0.5": models.Ggx([0.25, 0.5], 0.04),  # at degree 8 only: its tables take long
}
TIMED = ("GGX 0.25", "GGX 0.25 x 0.5")
TABLES, MATRICES = (16, 64), (8, 16, 24, 32)


def slices(brdf: models.AbstractBrdf, degree: int, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slices [v, n] of the material, and its squared norms [v], from quadrature at each view."""
    nodes, weights = np.polynomial.legendre.leggauss(128)
    polar, area = np.pi / 4 * (nodes + 1), np.repeat(weights, 256) * (np.pi / 4) * (2 * np.pi / 256)
    polar, phi = (a.ravel() for a in np.meshgrid(polar, 2 * np.pi * (np.arange(256) + 0.5) / 256, indexing="ij"))
    w = np.stack([np.sin(polar) * np.cos(phi), np.sin(polar) * np.sin(phi), np.cos(polar)], axis=-1)
    area = jnp.asarray(area * np.sin(polar), jnp.float32)
    w = jnp.asarray(w, jnp.float32)

    def one(view):
        values = jax.vmap(lambda wi: brdf.value_cosine(wi, view))(w)
        return project_slices(brdf, view[None], degree, 48 + degree)[0][0], jnp.sum(values**2 * area)

    views = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=-1)
    c, squares = jax.jit(lambda v: jax.lax.map(one, v))(jnp.asarray(views, jnp.float32))
    return np.asarray(c, float), np.asarray(squares, float)


def tables(quick: bool) -> dict[str, list[dict]]:
    """Title and rows of the table; nothing when quick."""
    if quick:
        return {}
    rng = np.random.default_rng(0)
    normals, views, tangents = rng.normal(size=(3, COUNT, 3))
    views *= np.sign(np.sum(normals * views, axis=1, keepdims=True))
    normals, views, tangents = (jnp.asarray(a, jnp.float32) for a in (normals, views, tangents))
    nodes, weights = np.polynomial.legendre.leggauss(50)
    theta, share = np.arccos((nodes + 1) / 2), weights / 2
    local = jnp.asarray(np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=-1), jnp.float32)
    rows = []
    for degree in (8, 16):
        light = models.DistantLight(jnp.asarray(rng.normal(size=(3, (degree + 1) ** 2)), jnp.float32))
        shaded = lambda m, v, light=light: shading.shade(m, light, shading.Surface(normals, v, tangents=tangents))
        for name, brdf in MATERIALS.items():
            if degree > 8 and not brdf.isotropic:
                continue
            c, squares = slices(brdf, degree, theta)
            total = share @ squares
            beyond = float(np.sqrt(max(1 - share @ np.sum(c**2, axis=1) / total, 0)))
            times = []
            made = {f"table, {v} views": shading.tabulate_brdf(brdf, degree, elevations=v) for v in TABLES}
            made |= {f"matrix, view degree {v}": shading.project_brdf(brdf, degree, view_degree=v) for v in MATRICES}
            if name in TIMED:
                shade: dict[Hashable, Callable] = {key: functools.partial(shaded, m) for key, m in made.items()}
                slope: dict[Hashable, Callable] = {
                    key: jax.jit(jax.grad(lambda v, f=f: jnp.sum(f(v) ** 2))) for key, f in shade.items()
                }
                times = [interleaved(f, views, seconds=0.3) for f in (shade, slope)]
            for key, m in made.items():
                got = np.asarray(jax.jit(jax.vmap(m.at))(local), float)
                arrays = m.blocks if isinstance(m, shading.BrdfMatrix) else [m.coefficients]
                row = {
                    "material": name,
                    "degree": degree,
                    "representation": key,
                    "error, light's side": beyond,
                    "error, view's side": float(np.sqrt(share @ np.sum((got - c) ** 2, axis=1) / total)),
                    "numbers stored": sum(a.size for a in arrays),
                }
                if name in TIMED:
                    for kind, t in zip(("", " with gradient"), times, strict=True):
                        row[f"us/pixel{kind}"], row[f"first call{kind}, s"] = t[key].best / COUNT * 1e6, t[key].first
                rows.append(row)
    return {"Tables over views and doubly projected matrices, materials of one colour, float32.": rows}
