"""Few fitted lobes against the linear projection, ISD15 section 7.2: slices, shaded spheres, and what each costs.

projection: the cosine-weighted slices on harmonics of some degree, `shading.shade` with a `DistantLight`.
Gaussians: J spherical Gaussians for each view elevation, each started from its neighbour's; the maps are filtered
beforehand with Gaussians of a ladder of sharpness and looked up trilinearly, as Wang et al. 2009 do.
profiles: J fitted axes for each elevation, each with a free zonal profile; the maps are filtered beforehand with every
zonal harmonic and looked up bilinearly (ISD15 Eq. 22, middle line).
sparse: the J best axes of 200 for each elevation, weights likewise; pictures blend those of the two elevations nearest.
Tables of Gaussians and profiles are interpolated linearly in elevation: axes, logarithms of sharpness, weights.

The reference is quadrature over every texel of the map (`shisd.reference`), the maps 256 x 512; parts of half a texel
change it by 1e-4 to 1e-3 of its RMS, and by 3e-3 for the narrowest material.
"""

import functools
import time
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import decomposition, harmonics, models, reference, shading
from shisd._numerics import normalize
from shisd.decomposition._fit import lobe_starts
from shisd.decomposition._kernels import gaussian_zonal
from shisd.io.internal import write_atomically
from shisd.shading import _tiles, _views
from shisd.shading.slices import _tabulate
from tests.bench.equation_22 import local_frames
from tests.bench.monte_carlo import arccos, arctan2
from tests.bench.timing import interleaved, timed
from tests.models.materials import GOLD_PAINT, NICKEL

STEEPEST = np.radians(80)  # views of pictures and of slices that are judged
DEGREES = (4, 8, 16, 30)
PROFILES = {1: 30, 3: 16}  # axes with profiles of a degree
VIEWS = 32  # elevations of every table
DATA = Path(__file__).resolve().parents[2] / "examples" / "data"
MAPS = {"interior": "interior.hdr", "studio": "studio.exr"}
LADDER = 2.0 ** (np.arange(-2, 27) / 2)

# Rows of the supplements of Bagher et al. 2012 (SGD) and Low et al. 2012 (ABC), beside those of tests/models.
GOLD = {
    "diffuse": [0.147708, 0.0806975, 0.033172],
    "specular": [0.160592, 0.217282, 0.236425],
    "alpha": [0.122506, 0.108069, 0.12187],
    "p": [0.795078, 0.637578, 0.936117],
    "f0": [9.16095e-12, 1.81225e-12, 0.0024589],
    "f1": [-0.596835, -0.331147, -0.140729],
    "normalization": [5.98176, 7.35539, 5.29722],
    "masking": [2.64832, 3.04253, 2.3013],
    "c": [9.3111e-08, 8.80143e-08, 9.65288e-08],
    "k": [24.3593, 24.4037, 25.3623],
    "shift": [-0.284195, -0.277297, -0.245352],
}
ABC = {  # diffuse, a, b, c, ior
    "color-changing-paint3": (
        [0.007087, 0.004775, 0.003475], [35.495728, 34.895355, 33.48082], 2193.942139, 1.442522, 1.918318
    ),
    "red-plastic": ([0.268, 0.044432, 0.010675], [1.081538, 1.045352, 1.037089], 34.117554, 1.529797, 1.66645),
    "pvc": ([0.030285, 0.033992, 0.038152], [40.608692, 39.046635, 37.916531], 2901.928223, 1.203405, 1.407985),
}  # fmt: skip


def materials():
    numbers = lambda row: {name: np.asarray(value) for name, value in row.items()}
    abc = {name: models.AbcMicrofacet(*(np.asarray(x) for x in row)) for name, row in ABC.items()}
    return {
        "gold-paint": models.SgdMicrofacet(**numbers(GOLD)),
        "gold-metallic-paint": models.SgdMicrofacet(**numbers(GOLD_PAINT)),
        "red-plastic": abc["red-plastic"],
        "nickel": models.AbcMicrofacet(**numbers(NICKEL)),
        "pvc": abc["pvc"],
        "color-changing-paint3": abc["color-changing-paint3"],
        "GGX 0.2": models.Ggx(0.2, np.array([0.95, 0.64, 0.54])),
        "Phong 40": models.Phong(np.array([0.3, 0.4, 0.5]), 40.0, 0.2),
    }


def load_map(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the notes on texels that were clamped
        texels = models.Environment.load(DATA / MAPS[name]).texels
    step = texels.shape[0] // 256
    return models.Environment(texels.reshape(256, step, 512, step, 3).mean(axis=(1, 3)))


def sphere_points(rows, columns):
    """Normals and views [rows * columns, 3] of a sphere seen from far away, equally spread in the picture."""
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    radius, angle = np.sin(STEEPEST) * np.sqrt((i.ravel() + 0.5) / rows), 2 * np.pi * (j.ravel() + 0.5) / columns
    view = np.array([np.cos(5.0), np.sin(5.0), 0.0])
    side, up = np.array([-view[1], view[0], 0.0]), np.array([0.0, 0.0, 1.0])
    normals = (radius * np.cos(angle))[:, None] * side + (radius * np.sin(angle))[:, None] * up
    normals += np.sqrt(1 - radius**2)[:, None] * view
    return jnp.asarray(normals, jnp.float32), jnp.asarray(np.broadcast_to(view, normals.shape), jnp.float32)


# --- slices and fits --------------------------------------------------------------------------------------------------


def slice_samples(brdf, theta, nodes=20):
    """Directions, colours [3, N] and solid angles of the slice of one elevation: graded nodes above, few below."""
    view = jnp.stack([jnp.sin(theta), jnp.zeros_like(theta), jnp.cos(theta)])
    w, area = _tabulate.slice_nodes(view, jnp.asarray(brdf.lobe_width, view.dtype), nodes, half=False)
    with jax.ensure_compile_time_eval():
        below, area_below = harmonics.sphere_rule(60, dtype=view.dtype)
        low = np.asarray(below[:, 2]) < 0
    w, area = jnp.concatenate([w, below[low]]), jnp.concatenate([area, area_below[low]])
    return w, jax.vmap(lambda wi: brdf.value_cosine(wi, view))(w).T, area


@eqx.filter_jit
def fit_table(brdf, count, degree=None):
    """Fits for all elevations, from the normal to the horizon, with a leading axis: Gaussians, or profiles of a degree.

    Each starts from the last one, turned with the mirror direction. The ridges are the best of 0, 1e-4, 1e-3, 1e-2.
    """
    theta = jnp.asarray(_views.elevations(VIEWS), jnp.float32)
    step = np.pi / 2 / VIEWS
    turn = jnp.asarray([[np.cos(step), 0, -np.sin(step)], [0, 1, 0], [np.sin(step), 0, np.cos(step)]], jnp.float32)
    first = slice_samples(brdf, theta[0])
    ridge = 1e-2 if degree is None else 1e-3
    starts = lobe_starts(*first, count, starts=4)
    if degree is not None:  # axes a little off the peaks, never twice one
        z = normalize(starts[0].directions)
        z = z + 0.05 * jnp.asarray(np.random.default_rng(0).normal(size=z.shape), z.dtype)
        starts = decomposition.ZonalLobes(z, jnp.zeros((3, degree + 1, count), z.dtype))
    start = decomposition.fit_lobes(starts, *first, ridge=ridge, throw=False).lobes

    def fit(lobes, theta):
        lobes = eqx.tree_at(lambda x: x.directions, lobes, lobes.directions @ turn.T)
        samples = slice_samples(brdf, theta)
        lobes = decomposition.fit_lobes(lobes, *samples, max_steps=128, tolerance=1e-4, ridge=ridge, throw=False).lobes
        return lobes, lobes

    _, rest = jax.lax.scan(fit, start, theta[1:])
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, rest)


def neighbours(theta):
    """The elevation below in the table, and the fraction of the way to the next."""
    position = jnp.clip(theta * (VIEWS / (np.pi / 2)) - 0.5, 0, VIEWS - 1)
    lower = jnp.clip(position.astype(int), 0, VIEWS - 2)
    return lower, position - lower.astype(theta.dtype)


def interpolated(table, theta):
    """Lobes of one elevation from a table of them."""
    lower, t = neighbours(theta)
    mix = lambda x: (1 - t) * x[lower] + t * x[lower + 1]
    z, weights = normalize(mix(table.directions)), mix(table.weights)
    if isinstance(table, decomposition.GaussianLobes):
        return decomposition.GaussianLobes(z, jnp.exp(mix(jnp.log(table.sharpness))), weights)
    return decomposition.ZonalLobes(z, weights)


def blended(table, theta):
    """Both neighbours' zonal lobes, their weights shared out."""
    lower, t = neighbours(theta)
    z = jnp.concatenate([table.directions[lower], table.directions[lower + 1]])
    weights = jnp.concatenate([(1 - t) * table.weights[lower], t * table.weights[lower + 1]], axis=-1)
    return decomposition.ZonalLobes(z, weights)


def projected_values(slices, theta, w):
    c = slices.at(jnp.stack([jnp.sin(theta), jnp.zeros_like(theta), jnp.cos(theta)]))
    return jnp.stack([harmonics.evaluate(colour, w) for colour in c])


def interpolated_values(table, theta, w):
    return interpolated(table, theta).evaluate(w)


def blended_values(table, theta, w):
    return blended(table, theta).evaluate(w)


@eqx.filter_jit
def slice_error(brdf, values, table):
    """RMS over elevations between the table's of a slice's relative L2 error, weighed as on a sphere's picture."""
    theta = jnp.asarray(np.arange(1, VIEWS) * (np.pi / 2 / VIEWS), jnp.float32)

    def one(theta):
        w, y, area = slice_samples(brdf, theta, 24)
        return jnp.sum((values(table, theta, w) - y) ** 2 * area[None]) / jnp.sum(y * y * area[None])

    share = jnp.where(theta < STEEPEST, jnp.sin(2 * theta), 0)
    return jnp.sqrt(jnp.sum(jax.lax.map(one, theta) * share) / jnp.sum(share))


# --- shading ----------------------------------------------------------------------------------------------------------


def rotated(frames, z):
    return jnp.einsum("pij,pkj->pki", frames, z)


def angles(w):
    """theta and phi [..] of directions, to 1e-5: the polynomials are vectorised, XLA's own arc functions are not."""
    return kept(arccos(jnp.clip(w[..., 2], -1, 1))), kept(arctan2(w[..., 1], w[..., 0]))


def kept(x):
    """x > -4 by way of its logarithm: cheap arithmetic XLA repeats on a CPU for every look-up that needs it."""
    return jnp.exp(jnp.log(x + 4)) - 4


def bilinear(height, theta, phi):
    """Flat indices [.., 4] into a map with a row beyond each pole and a column beyond its end, and weights."""
    h = height.astype(theta.dtype)
    v = theta * (h / np.pi) + 0.5
    u = (phi * (h / np.pi) - 0.5) % (2 * h)
    j, i = jnp.clip(v.astype(int), 0, height), jnp.clip(u.astype(int), 0, 2 * height - 1)
    v, u = v - j.astype(theta.dtype), u - i.astype(theta.dtype)
    first = j * (2 * height + 1) + i
    index = jnp.stack([first, first + 1, first + 2 * height + 1, first + 2 * height + 2], axis=-1)
    return index, jnp.stack([(1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u], axis=-1)


def padded(maps, height):
    """[H, 2H, k] -> [(H+2) (2H+1), k]."""
    maps = jnp.concatenate([jnp.roll(maps[:1], height, 1), maps, jnp.roll(maps[-1:], height, 1)])
    return jnp.concatenate([maps, maps[:, :1]], axis=1).reshape(-1, maps.shape[-1])


def gaussian_pyramid(environment):
    """The map filtered with unit Gaussians of the ladder, each as fine as it needs: texels, first texels, heights."""
    c = environment.coefficients(255)
    heights = np.clip(2 ** np.ceil(np.log2(12 * np.sqrt(LADDER))), 32, 256).astype(np.int32)
    parts = []
    for height in np.unique(heights):
        own = jnp.asarray(LADDER[heights == height], c.dtype)
        zonal = gaussian_zonal(own, int(height) - 1)
        zonal = zonal / zonal[:, :1] / jnp.asarray(np.sqrt(2 * np.arange(height) + 1), c.dtype)[None]
        band = np.repeat(np.arange(height), 2 * np.arange(height) + 1)
        maps = harmonics.synthesize_map(
            (zonal[:, None, band] * c[None, :, : height**2]).reshape(-1, height**2), int(height)
        )
        maps = maps.reshape(*maps.shape[:2], len(own), 3)
        parts += [padded(maps[:, :, i], int(height)) for i in range(len(own))]
    sizes = [len(p) for p in parts]
    texels = jnp.pad(jnp.concatenate(parts), ((0, 0), (0, 1)))  # rows of 16 bytes
    return texels, np.cumsum([0, *sizes[:-1]]).astype(np.int32), heights


@eqx.filter_jit
def shade_gaussians(table, pyramid, normals, views):
    """Radiance [P, 3]. Inside a tile pixels stand last: they are vector lanes."""
    texels, firsts, heights = pyramid
    firsts, heights = jnp.asarray(firsts), jnp.asarray(heights)
    count = table.sharpness.shape[1]
    parts = [jnp.swapaxes(table.directions, 1, 2), jnp.log(table.sharpness)[:, None], table.weights]
    rows_of_table = jnp.concatenate(parts, axis=1).reshape(VIEWS, -1)

    def tile(rows):
        frames, theta = local_frames(rows["normals"], rows["views"])
        lower, t = neighbours(theta)
        mixed = (1 - t)[:, None] * rows_of_table[lower] + t[:, None] * rows_of_table[lower + 1]
        mixed = mixed.T.reshape(-1, count, len(theta))
        z, log_sharpness, weights = mixed[:3], mixed[3], mixed[4:]
        z = z * jax.lax.rsqrt(z[0] ** 2 + z[1] ** 2 + z[2] ** 2)[None]
        theta, phi = angles(jnp.einsum("pij,jkp->kpi", frames, z))
        sharpness = jnp.exp(log_sharpness)
        integral = -2 * np.pi * jnp.expm1(-2 * sharpness) / sharpness
        level = jnp.clip(2 / np.log(2) * log_sharpness + 2, 0, len(LADDER) - 1.001)
        lower = level.astype(int)
        t = level - lower.astype(level.dtype)
        total = 0.0
        for k, share in ((lower, 1 - t), (lower + 1, t)):
            index, weight = bilinear(heights[k], theta, phi)
            index, weight = firsts[k][..., None] + index, (share * integral)[..., None] * weight
            for corner in range(4):
                total += weight[..., corner, None] * texels.at[index[..., corner]].get(mode="promise_in_bounds")
        return jnp.einsum("ckp,kpc->pc", weights, total[..., :3])

    return _tiles.in_tiles(tile, {"normals": normals, "views": views}, 4096)


def band_table(environment, degree, height=128):
    """The map filtered with every zonal harmonic up to a degree: texels [.., (L+1) * 3]."""
    c = environment.coefficients(degree)
    band = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    scale = np.sqrt(4 * np.pi / (2 * np.arange(degree + 1) + 1))
    split = c[None] * jnp.asarray((band == np.arange(degree + 1)[:, None]) * scale[:, None], c.dtype)[:, None]
    maps = harmonics.synthesize_map(split.reshape(-1, split.shape[-1]), height)
    return padded(maps, height)


@eqx.filter_jit
def shade_profiles(table, texels, normals, views, at, height=128):
    def tile(rows):
        frames, theta = local_frames(rows["normals"], rows["views"])
        lobes = jax.vmap(lambda t: at(table, t))(theta)
        index, weight = bilinear(jnp.asarray(height), *angles(rotated(frames, lobes.directions)))
        value = jnp.einsum("pkq,pkqx->pkx", weight, texels[index])
        value = value.reshape(*value.shape[:2], -1, 3)
        return jnp.einsum("pclk,pklc->pc", lobes.weights, value)

    return _tiles.in_tiles(tile, {"normals": normals, "views": views}, 256)


# --- the comparison ---------------------------------------------------------------------------------------------------


@eqx.filter_jit
def sparse_table(brdf, degree, count):
    """The best `count` of 200 axes for each elevation, and their profiles."""
    basis = decomposition.RotatedZonalBasis(decomposition.fibonacci_directions(200, dtype=jnp.float32), degree)

    def choose(theta):
        view = jnp.stack([jnp.sin(theta), jnp.zeros_like(theta), jnp.cos(theta)])
        c = _tabulate.project_slices(brdf, view[None], degree, 48)[0][0]
        weights, axes = decomposition.sparse_weights(basis, c, count)
        return decomposition.ZonalLobes(basis.directions[axes], weights[..., axes])

    return jax.lax.map(choose, jnp.asarray(_views.elevations(VIEWS), jnp.float32))


def methods(brdf):
    """name -> (table, seconds to make it, how to take its values, how to shade with it under a light)."""
    made = {}
    most = DEGREES[-1]
    exact, seconds = timed(lambda: shading.tabulate_brdf(brdf, most, elevations=VIEWS, quadrature=64, throw=False))
    shade = lambda slices, light, n, v: shading.shade(
        slices, models.DistantLight(light["coefficients"][:, : (slices.degree + 1) ** 2]), shading.Surface(n, v)
    )
    for degree in DEGREES:
        slices = exact.cut(degree)
        made[f"projection, degree {degree}"] = slices, seconds, projected_values, shade
    shade = lambda table, light, n, v: shade_gaussians(table, light["pyramid"], n, v)
    for count in (1, 3, 7):
        table, seconds = timed(lambda count=count: fit_table(brdf, count))
        made[f"{count} Gaussian{'s' * (count > 1)}"] = table, seconds, interpolated_values, shade
    profiles = lambda table, light, n, v, at: shade_profiles(
        table, light["bands"][table.weights.shape[-2] - 1], n, v, at
    )
    shade = functools.partial(profiles, at=interpolated)
    for count, degree in PROFILES.items():
        table, seconds = timed(lambda count=count, degree=degree: fit_table(brdf, count, degree))
        name = f"{count} {'axis' if count == 1 else 'axes'}, profiles to degree {degree}"
        made[name] = table, seconds, interpolated_values, shade
    count, degree = list(PROFILES.items())[-1]
    table, seconds = timed(lambda: sparse_table(brdf, degree, count))
    shade = functools.partial(profiles, at=blended)
    made[f"{count} sparse axes, degree {degree}"] = table, seconds, blended_values, shade
    return made


def compare():
    """Few fitted lobes against the projection: relative errors of slices / of a sphere in the room `interior`, float32.

    Times: medians over the materials. Slices: RMS over view elevations to 80 degrees. Pictures: RMSE over RMS, against
    quadrature over every texel.
    """
    lights = {}
    for name in MAPS:
        environment = load_map(name)
        lights[name] = {
            "environment": environment,
            "coefficients": environment.coefficients(DEGREES[-1]),
            "pyramid": gaussian_pyramid(environment),
            "bands": {degree: band_table(environment, degree) for degree in set(PROFILES.values())},
        }
    few, many = sphere_points(16, 16), sphere_points(128, 128)
    rows = []
    for material, brdf in materials().items():
        begun = time.perf_counter()
        truth = {
            name: np.asarray(reference.shade_environment_quadrature(brdf, light["environment"], *few, supersampling=1))
            for name, light in lights.items()
        }
        made = methods(brdf)
        shades = {
            method: lambda n, v, table=table, shade=shade: shade(table, lights["interior"], n, v)
            for method, (table, _, _, shade) in made.items()
        }
        times = interleaved(shades, *many, seconds=0.2)
        for method, (table, seconds, values, shade) in made.items():
            row = {"material": material, "method": method, "slice error": float(slice_error(brdf, values, table))}
            for name, light in lights.items():
                difference = np.asarray(shade(table, light, *few)) - truth[name]
                row[f"{name}: error"] = float(np.sqrt(np.mean(difference**2) / np.mean(truth[name] ** 2)))
            row |= {
                "fit s": seconds,
                "us/pixel": times[method].median / len(many[0]) * 1e6,
                "first call s": times[method].first,
            }
            rows.append(row)
        print(f"{material}: {time.perf_counter() - begun:.0f} s", flush=True)
    return rows


def summary(rows):
    """One row for each method: times, and both errors for each material."""
    table = {}
    for name in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == name]
        median = lambda key, own=own: float(np.median([row[key] for row in own]))
        table[name] = {"method": name, "us/pixel": median("us/pixel"), "fit s": median("fit s")}
        for row in own:
            table[name][row["material"]] = f"{row['slice error']:.2g} / {row['interior: error']:.2g}"
    return list(table.values())


def figure(rows, path):
    """Error of the shaded sphere against time, one panel for each material."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = list(dict.fromkeys(row["material"] for row in rows))
    kinds = {  # label -> which methods, and their line
        "RZH projection, degree 4 to 30": (lambda m: m.startswith("projection"), "o-", "C0"),
        "1, 3, 7 Gaussians": (lambda m: "Gaussian" in m, "s-", "C1"),
        "1 fitted axis, profile to degree 30": (lambda m: m.startswith("1 axis"), "^", "C2"),
        "3 fitted axes, profiles to degree 16": (lambda m: m.startswith("3 axes"), "v", "C2"),
        "3 sparse axes, degree 16": (lambda m: "sparse" in m, "D", "C3"),
    }
    figure, panels = pyplot.subplots(2, 4, figsize=(11, 5.6), sharex=True, sharey=True, constrained_layout=True)
    for name, axes in zip(names, panels.flat, strict=False):
        for label, (belongs, style, colour) in kinds.items():
            own = [row for row in rows if row["material"] == name and belongs(row["method"])]
            us, error = [r["us/pixel"] for r in own], [r["interior: error"] for r in own]
            axes.loglog(us, error, style, color=colour, label=label, markersize=5)
        axes.set_title(name, fontsize=10)
        axes.grid(alpha=0.3, which="both", linewidth=0.5)
    for axes in panels[1]:
        axes.set_xlabel("us per pixel")
    for axes in panels[:, 0]:
        axes.set_ylabel("relative error of the picture")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=110), overwrite=True)
    pyplot.close(figure)
