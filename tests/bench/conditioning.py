"""How well conditioned decompositions are: sets of axes, objectives for them, and mother kernels (ISD15 Fig. 13)."""

import functools
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from shisd import decomposition, harmonics, models
from shisd._numerics import normalize
from shisd.decomposition._directions import conditioning_loss, low_discrepancy_directions, random_directions
from shisd.io.internal import write_atomically
from tests import truth
from tests.bench.make_directions import band_matrix, worst_condition

KERNELS = {
    "Legendre": decomposition.LegendreKernel(),
    "Gauss-Legendre": decomposition.GaussLegendreKernel(),
    "Gaussian": decomposition.GaussianKernel(),
    "Phong": decomposition.PhongKernel(),
    "discs": decomposition.CapKernel(),
}
LAYOUTS = {  # directions, whether level l has 2l+1 of them
    "shared, 2l+1": (decomposition.optimized_directions, True),
    "shared, all": (decomposition.optimized_directions, False),
    "separate, 2l+1": (decomposition.separate_directions, True),
    "separate, all": (decomposition.separate_directions, False),
}


def bench_directions(degrees=(4, 8, 12, 20, 32, 64)):
    """Worst band's condition number of 2L+1 shared axes, lower bounds, and optimising a random start in float64."""
    rows = []
    with jax.enable_x64(True):
        for degree in degrees:
            count = 2 * degree + 1
            table = np.asarray(decomposition.optimized_directions(degree))
            row = {
                "degree": degree,
                "table": worst_condition(table, degree),
                "table, prefixes": worst_condition(table, degree, nested=True),
                "no set is below": truth.condition_bound(degree, count),
                "Fibonacci": worst_condition(np.asarray(decomposition.fibonacci_directions(count)), degree),
                "low discrepancy": worst_condition(np.asarray(low_discrepancy_directions(count)), degree),
            }
            if degree <= 20:
                start = random_directions(count, jax.random.key(1))
                began = time.perf_counter()
                found = np.asarray(decomposition.optimize_directions(start, degree))
                row["random"] = worst_condition(np.asarray(start), degree)
                row["after optimising"] = worst_condition(found, degree)
                row["s, compiling included"] = time.perf_counter() - began
                mirrored = np.asarray(decomposition.optimize_directions(start, degree, mirror="y"))
                row["mirrored"] = worst_condition(mirrored, degree)
                alone = np.asarray(decomposition.optimize_directions(start, degree, bands=(degree,)))
                row["for band L alone"] = np.linalg.cond(band_matrix(alone, degree))
            rows.append(row)
    return rows


def bench_objectives(degree=12, starts=6):
    """Candidate objectives at degree 12, from the same six random starts in float64: worst condition found, time."""

    def minimise(loss, z, steps):
        solver = optx.BFGS(rtol=1e-8, atol=1e-8)
        return normalize(optx.minimise(loss, solver, z, max_steps=steps, throw=False).value)

    def log_det(z, _):
        z = normalize(z)
        y = harmonics.sh_basis(z, degree)
        bands = [y[:, l * l : (l + 1) ** 2] for l in range(degree + 1)]
        return -sum(jnp.linalg.slogdet(m.T @ m)[1] for m in bands)

    power = lambda p: lambda z, _: conditioning_loss(z, degree, power=p)
    candidates = {
        "-log det of all bands": [log_det],
        "mean times mean inverse (p = 1)": [power(1.0)],
        "p = 8": [power(8.0)],
        "p = 1, 3, 8": [power(1.0), power(3.0), power(8.0)],
        "-log det, then p = 8": [log_det, power(8.0)],
    }
    rows = []
    with jax.enable_x64(True):
        initial = [random_directions(2 * degree + 1, jax.random.key(i)) for i in range(starts)]
        for name, losses in candidates.items():
            stages = [eqx.filter_jit(functools.partial(minimise, loss, steps=768 // len(losses))) for loss in losses]
            run = lambda z, stages=stages: functools.reduce(lambda z, stage: stage(z), stages, z)
            jax.block_until_ready(run(initial[0]))
            began = time.perf_counter()
            found = [worst_condition(np.asarray(run(z)), degree) for z in initial]
            rows.append({
                "objective": name,
                "best": min(found),
                "median": float(np.median(found)),
                "worst": max(found),
                "s per start": (time.perf_counter() - began) / starts,
            })  # fmt: skip
    return rows


def bench_kernels(degrees=(4, 8, 12, 16, 20)):
    """Condition number of M, (L+1)^2 rows, for mother kernels of unit norm (ISD15 Fig. 13).

    Axes: optimised ones that levels share, or separate ones; 2l+1 of them at level l, M square as in the paper, or all
    2L+1 and weights of least norm.
    """
    rows = []
    with jax.enable_x64(True):
        for degree in degrees:
            for name, kernel in KERNELS.items():
                row = {"degree": degree, "kernel": name}
                for layout, (make, nested) in LAYOUTS.items():
                    basis = decomposition.IsotropicBasis(kernel, make(degree), degree, nested=nested)
                    row[layout] = float(np.linalg.cond(np.asarray(_matrix(basis)).reshape((degree + 1) ** 2, -1)))
                rows.append(row)
            jax.clear_caches()
    return rows


def bench_kernel_pictures(degrees=(8, 16)):
    """Error of a picture shaded with these kernels, float64 and float32: what the condition number does to it.

    GGX of alpha 0.3 seen at 45 degrees from 200 sides, under the interior, by ISD15 Eq. 6; against sums in float64 with
    SciPy's harmonics, relative to the RMS. Refused: singular to working precision.
    """
    rows = []
    for degree in degrees:
        scene = picture(degree)
        for name, kernel in KERNELS.items():
            row = {"degree": degree, "kernel": name}
            for layout, (make, nested) in LAYOUTS.items():
                errors = []
                for dtype in (np.float64, np.float32):
                    with jax.enable_x64(dtype == np.float64):
                        errors.append(picture_error(kernel, make(degree), nested, scene, dtype))
                row[layout] = ", ".join(e if isinstance(e, str) else f"{e:.0e}" for e in errors)
            rows.append(row)
            jax.clear_caches()
    return rows


_matrix = eqx.filter_jit(decomposition.IsotropicBasis.matrix)


def kernels_figure(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(LAYOUTS), figsize=(11, 3.1), sharey=True)
    for panel, layout in zip(panels, LAYOUTS, strict=True):
        for name in KERNELS:
            chosen = [r for r in rows if r["kernel"] == name]
            panel.semilogy(
                [r["degree"] for r in chosen], [min(r[layout], 1e17) for r in chosen], "o-", ms=3, label=name
            )
        panel.axhline(1 / np.finfo(np.float32).eps, color="grey", lw=0.8, ls=":")
        panel.axhline(1 / np.finfo(np.float64).eps, color="grey", lw=0.8, ls=":")
        panel.set(title=f"axes {layout}", xlabel="degree L", ylim=(1, 3e17))
    panels[0].set_ylabel("condition number of M")
    panels[0].text(4, 1.5e7, "1/eps, float32", fontsize=7, color="grey")
    panels[0].text(4, 7e15, "1/eps, float64", fontsize=7, color="grey", va="bottom")
    panels[-1].legend(fontsize=7, loc="upper left")
    figure.tight_layout()
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=110), overwrite=True)
    pyplot.close(figure)


def picture(degree):
    """A slice, a light, rotations, and the radiance."""
    rng = np.random.default_rng(5)
    rotations = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]
    rotations *= np.linalg.det(rotations)[:, None, None]
    texels = np.asarray(models.Environment.load("examples/data/interior.hdr").texels, float).mean(axis=-1)
    brdf, view = models.Ggx(0.3), np.sqrt([0.5, 0, 0.5])
    with jax.enable_x64(True):
        slice_of = jax.vmap(lambda w: brdf.value_cosine(w, jnp.asarray(view)))
        c = np.asarray(harmonics.project(slice_of, degree, quadrature_degree=200))
        light = np.asarray(harmonics.project_map(texels, degree))
        w, area = (np.asarray(x) for x in harmonics.sphere_rule(2 * degree))
    values = (truth.scipy_basis(w, degree) @ c) * area
    return c, light, rotations, np.array([values @ (truth.scipy_basis(w @ r.T, degree) @ light) for r in rotations])


def picture_error(kernel, directions, nested, scene, dtype):
    c, light, rotations, truth = scene
    z = jnp.asarray(directions, dtype)
    basis = decomposition.IsotropicBasis(kernel, z, z.shape[-2] // 2, nested=nested)
    try:
        weights = basis.weights(c.astype(dtype))
        got = np.asarray(basis.filter(weights, light.astype(dtype), rotations.astype(dtype)), float)
    except RuntimeError:
        return "refused"
    return float(np.sqrt(np.mean((got - truth) ** 2) / np.mean(truth**2)))
