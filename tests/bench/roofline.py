"""How far the fast paths are from what this machine can do: counted work over measured speeds of its kinds.

Three speeds, float32, all cores: products of matrices, at the best of the shapes that the paths use; elementwise
arithmetic in registers (a long polynomial of a short array); copies of large arrays. The bound of a path is the time
that its products, its arithmetic and the bytes that it must read and write take at these speeds, one after the other,
with nothing counted for frames, splines, clipping, square roots or loops. Beside `sh_basis` stands sphericart, C++ with
a recurrence instead of products: the bound there is that of `sh_basis`.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from shisd import harmonics, models, shading
from shisd.domains._integrate import incidence_inverse
from shisd.harmonics import _pairing
from tests.bench import local_lights
from tests.bench.spherical import installed
from tests.bench.timing import interleaved

COUNT, VIEWS = 16384, 64
KINDS = ("products", "operations", "bytes")
COLUMNS = VIEWS + 4  # of the spline in the elevation of the view


def speeds() -> dict[str, float]:
    """Products and operations in 1e9/s, bytes in GB/s."""
    rng = np.random.default_rng(0)
    array = lambda *shape: jnp.asarray(rng.normal(size=shape), jnp.float32)
    long, big = array(1 << 14), array(1 << 25)
    steps, repeats = 512, 16

    def polynomial(x):
        """Two chains at a time, as operations wait for each other."""
        y, z = x, x
        for _ in range(steps // 2):
            y, z = 0.5 * y + x, 0.25 * z + x
        return y + z

    work = {
        ("operations", ""): (2 * steps * repeats * long.size,
                             lambda: jax.lax.fori_loop(0, repeats, lambda _, x: polynomial(x), long)),
        ("bytes", ""): (2 * big.nbytes, lambda: big + 1),
    }  # fmt: skip
    for tiles, m, k, n in ((16, 208, COLUMNS, 1024), (16, 1024, COLUMNS, 1024), (1, COUNT, 62, 961)):
        pairs = array(tiles, m, k), array(tiles, k, n)
        product = lambda pairs=pairs: jax.lax.map(lambda x: x[0] @ x[1], pairs)
        work["products", f"{m} {k} {n}"] = tiles * m * k * n, product
    times = interleaved({name: jax.jit(f) for name, (_, f) in work.items()}, seconds=0.5)
    speed = {name: amount / times[name].best / 1e9 for name, (amount, _) in work.items()}
    return {kind: max(s for (own, _), s in speed.items() if own == kind) for kind in KINDS}


def environment_work(degree: int, colours: int) -> dict[str, float]:
    """Of `shade` with a `DistantLight` for a pixel: spline, view azimuth, exchange of axes, series of the light."""
    rows = len(_pairing.rows(degree)[0])
    exchange = sum(m.size for block in _pairing._blocks(degree) for m in block.swap)
    series = sum(m.size for m in _pairing.turned_series(jnp.zeros((3, (degree + 1) ** 2)), degree))
    return {"products": colours * (rows * COLUMNS + exchange) + 2 * rows * (degree + 1) + series}


def polygon_work(degree: int, edges: int) -> dict[str, float]:
    """Of `shade` with a `PolygonLight` for a pixel: spline, weights of the axes, and the recurrences along edges."""
    rows = (degree + 1) * (degree + 2) // 2
    weights = sum(m.size for m in incidence_inverse(degree, np.dtype("float32"))[1])
    steps = (degree + 1) * (degree - 1)
    return {"products": rows * COLUMNS + weights, "operations": steps * (18 * edges + 7)}


def basis_work(degree: int) -> dict[str, float]:
    """Of `sh_basis` for a direction: the polar series, the azimuth's waves by order, and what is read and written."""
    waves, size = 2 * (degree + 1), (degree + 1) ** 2
    return {"products": waves * (size + 2 * degree + 1), "bytes": 4.0 * (size + 3)}


def sphericart_of(degree: int, directions: np.ndarray) -> Callable:
    import sphericart

    peer = sphericart.SphericalHarmonics(degree)
    return lambda: peer.compute(directions)


def tables(quick: bool) -> dict[str, list[dict]]:
    """Title and rows of the table; nothing when quick."""
    if quick:
        return {}
    peak = speeds()
    rows = []
    positions, normals, views = local_lights.points("wall")
    facing = np.sum(normals * views, axis=1, keepdims=True)
    views = np.where(facing > 0, views, views - 2 * facing * normals)
    lamp = models.PolygonLight(local_lights.QUADS["wall"])
    local = lambda m: shading.shade(m, lamp, shading.Surface(normals, views, positions))
    for degree in (8, 16, 30):
        e = np.random.default_rng(1).normal(size=(3, (degree + 1) ** 2))
        light = models.DistantLight(jnp.asarray(e, jnp.float32))
        fitted = shading.tabulate_brdf(models.Ggx(0.25, 0.04), degree, elevations=VIEWS, domain="upper")
        one = shading.tabulate_brdf(models.Ggx(0.25, 0.04), degree, elevations=VIEWS)
        rgb = shading.tabulate_brdf(models.Ggx(0.25, np.array([0.9, 0.6, 0.3])), degree, elevations=VIEWS)
        distant = lambda m, light=light: shading.shade(m, light, shading.Surface(normals, views))
        functions = {
            "shade, DistantLight, one colour": (functools.partial(distant, one), environment_work(degree, 1)),
            "shade, DistantLight, RGB material": (functools.partial(distant, rgb), environment_work(degree, 3)),
            "shade, PolygonLight, all lamps cut by the horizon": (
                functools.partial(local, fitted),
                polygon_work(degree, 6),
            ),
            "sh_basis": (
                functools.partial(harmonics.sh_basis, normals, degree),
                basis_work(degree),
            ),
        }  # fmt: skip
        if installed("sphericart"):
            functions["sphericart, C++"] = (sphericart_of(degree, normals), basis_work(degree))
        times = interleaved({name: f for name, (f, _) in functions.items()}, seconds=0.5)
        for name, (_, work) in functions.items():
            us = times[name].best / COUNT * 1e6
            bound = sum(amount / peak[kind] for kind, amount in work.items()) * 1e-3
            rows.append({
                "path": name,
                "degree": degree,
                **{f"{kind} per pixel": f"{work[kind]:,.0f}" if kind in work else "" for kind in peak},
                "us/pixel": us,
                "bound, us": bound,
                "time over bound": us / bound,
            })  # fmt: skip
    measured = ", ".join(f"{value:.0f} G{kind}/s" for kind, value in peak.items())
    return {f"Fast paths against bounds from the speeds of this machine: {measured}.": rows}
