"""Light a room by a square, a triangle, a star and a window onto a photographed scene, and measure error and cost.

The floor is varnished wood, the walls are matt. Lamps are integrated exactly over their outlines (CSH18 Eq. 12): on
the walls as slices of degree 8, on the floor, too sharp for plain slices, as slices beyond maps of directions. The
scene outside is spherical harmonics of degree 12. The walls see it through the window exactly (Eq. 13), the floor at
Gauss points, where its sharp lobe would need more bands. All is compared with a converged reference: Gauss quadrature
of the material over the part of each light above the horizon, at more points. What the finite degree of the scene
outside costs is measured at a few pixels, against the map itself. Writes pictures and a table to --output.

    python examples/area_lights.py --output output/area_lights
"""

import functools
import time
from collections.abc import Callable
from pathlib import Path

import _scene
import jax
import numpy as np

from shisd import harmonics, io, models, reference, shading

BOX = np.array([[-3.0, 0.0, 0.0], [3.0, 6.0, 3.0]])
EYE, TARGET = np.array([0.4, 0.25, 1.55]), np.array([-0.15, 4.0, 0.75])
DEGREE, ORDER = 8, 16  # of slices, and of points on the window as the floor sees it
LIMITS = 1e-6, 1e-1  # relative errors at the ends of the false-colour scale


def outline(centre: tuple, normal: tuple, plane: np.ndarray) -> np.ndarray:
    """World points [S, 3] of an outline [S, 2] about a centre, counter-clockwise seen from the side of the normal."""
    n = _scene.unit(np.array(normal, float))
    right = _scene.unit(np.cross([0.0, 0.0, 1.0] if abs(n[2]) < 0.9 else [0.0, 1.0, 0.0], n))
    return centre + plane[:, :1] * right + plane[:, 1:] * np.cross(n, right)


def star(points: int, outer: float, inner: float) -> np.ndarray:
    angle = np.pi / points * np.arange(2 * points) + np.pi / 2
    return np.where(np.arange(2 * points)[:, None] % 2, inner, outer) * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def square(width: float, height: float) -> np.ndarray:
    return np.array([[-width, -height], [width, -height], [width, height], [-width, height]]) / 2


def lights() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Outlines, and radiance in linear RGB."""
    return {
        "square": (outline((-0.9, 4.1, 2.3), (0.2, -0.3, -1), square(1.1, 0.8)), np.array([9.0, 8.0, 6.5])),
        "triangle": (
            outline((0.35, 5.2, 0.9), (-0.1, -1, -0.25), 0.55 * star(3, 1, 0.5)[::2]),
            np.array([2.0, 7.0, 16.0]),
        ),
        "star": (outline((1.7, 4.3, 1.35), (-1, -0.9, -0.35), star(5, 0.8, 0.32)), np.array([11.0, 2.2, 1.0])),
    }


def window() -> np.ndarray:
    return outline((-3.0, 3.9, 1.45), (1, 0, 0), square(1.9, 1.3))


def room(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [N, 3] where rays from inside leave the box, its normals there, and whether they are of the floor."""
    with np.errstate(divide="ignore"):
        along = np.where(rays > 0, BOX[1] - EYE, BOX[0] - EYE) / rays
    axis = np.argmin(along, axis=1)
    ray = np.arange(len(rays))
    normals = np.zeros_like(rays)
    normals[ray, axis] = -np.sign(rays[ray, axis])
    return EYE + along[ray, axis][:, None] * rays, normals, normals[:, 2] > 0


def covers(points: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Which rays from the eye go through a flat outline: those that it winds around."""
    edges = points[1:] - points[:1]
    normal = np.cross(edges[:-1], edges[1:]).sum(axis=0)
    along = ((points[0] - EYE) @ normal) / (rays @ normal)
    a = points - (EYE + along[:, None] * rays)[:, None]
    b = np.roll(a, -1, axis=1)
    turn = np.arctan2(np.cross(a, b) @ _scene.unit(normal), np.sum(a * b, axis=-1)).sum(axis=1)
    return (along > 0) & (np.abs(turn) > np.pi)


def relative(image: np.ndarray, truth: np.ndarray) -> float:
    """RMSE over the RMS of the truth."""
    return float(np.sqrt(np.mean((image - truth) ** 2) / np.mean(truth**2)))


def timed(function: Callable, *arguments) -> tuple[np.ndarray, float]:
    """The result, and the seconds of a second call, after compiling."""
    jax.block_until_ready(function(*arguments))
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return np.asarray(result, float), time.perf_counter() - start


def path_of(part: str, light: str) -> str:
    """How a light is integrated, for the table."""
    if part == "walls":
        return f"degree {DEGREE}"
    return f"{ORDER} x {ORDER} points" if light == "window" else f"maps, degree {DEGREE}"


def run(output: Path, size: int, nodes: int) -> list[dict]:
    rays = _scene.camera_rays(size, EYE, TARGET, np.radians(72))[size // 6 : -size // 6 or None]
    shape, flat = rays.shape[:2], rays.reshape(-1, 3)
    positions, normals, floor = room(flat)
    parts = {"floor": floor, "walls": ~floor}
    wood = models.CookTorrance(roughness=0.1**0.5, metallic=0.0, albedo=np.array([0.34, 0.17, 0.07]))
    plaster = models.Lambertian(np.array([0.7, 0.7, 0.68]))
    brdfs = {"floor": wood, "walls": plaster}
    outside = _scene.load_map("interior")
    outside = models.Environment(np.roll(outside.texels, 240, axis=1))  # bright panes towards the window
    coefficients = np.asarray(outside.coefficients(12))
    expansion = lambda w: harmonics.evaluate(coefficients, w[:, None])

    ready = {
        "floor": shading.Material(local=shading.Quadrature(wood, ORDER), lamps=shading.transform_brdf(wood, DEGREE)),
        "walls": shading.tabulate_brdf(plaster, DEGREE, domain="upper"),
    }
    shade = lambda part, light, p, n, v: shading.shade(ready[part], light, shading.Surface(n, v, p))

    images, truths, rows = {}, {}, []
    names = [*lights(), "window"]
    for name in _scene.progress(names, "lights"):
        image, truth = np.zeros((len(flat), 3)), np.zeros((len(flat), 3))
        for part, mask in parts.items():
            points = [a[mask].astype(np.float32) for a in (positions, normals, -flat)]
            if name == "window":
                corners, emission = window(), expansion
                light = models.PortalLight(corners.astype(np.float32), coefficients)
            else:
                corners, emission = lights()[name]
                light = models.PolygonLight(corners.astype(np.float32), emission.astype(np.float32))
            judge = functools.partial(reference.shade_polygon_quadrature, brdfs[part], corners)
            image[mask], seconds = timed(functools.partial(shade, part, light), *points)
            start = time.perf_counter()
            truth[mask] = judge(emission, *points, nodes=nodes)
            reference_seconds = time.perf_counter() - start
            row = {"light": name, "surface": part, "path": path_of(part, name)}
            row["error"] = relative(image[mask], truth[mask])
            row["us/pixel"], row["reference us/pixel"] = (1e6 * t / mask.sum() for t in (seconds, reference_seconds))
            if name == "window":
                some = np.random.default_rng(0).choice(mask.sum(), 128)
                exact = np.asarray(judge(outside.radiance, *(a[some] for a in points), nodes=8 * nodes))
                row["error to the map"] = relative(image[mask][some], exact)
            rows.append(row)
        images[name], truths[name] = image, truth
    images["all"], truths["all"] = (sum(x[name] for name in names) for x in (images, truths))

    emitters = {
        name: (covers(points, flat), emission / emission.max()) for name, (points, emission) in lights().items()
    }
    emitters["window"] = covers(window(), flat), np.asarray(outside.radiance(flat.astype(np.float32), texels="samples"))
    show = lambda values, name: picture(values, {k: v for k, v in emitters.items() if name in (k, "all")}, shape)
    panels = {}
    for name in [*names, "all"]:
        mean = np.linalg.norm(truths[name], axis=1).mean()
        false = _scene.false_colour(images[name] - truths[name], mean, LIMITS).reshape(*shape, 3)
        panels[name] = show(images[name], name), show(truths[name], name), false
        io.write_image(output / f"{name}.png", np.concatenate(panels[name], axis=1), overwrite=True)
    columns = "shaded", "reference", "difference"
    lines = [(name, list(images)) for name, images in panels.items()]
    _scene.sheet(output / "area_lights.png", columns, lines, limits=LIMITS)
    return rows


def picture(values: np.ndarray, emitters: dict, shape: tuple[int, int]) -> np.ndarray:
    image = values.copy()
    for covered, emission in emitters.values():
        image[covered] = np.broadcast_to(emission, image.shape)[covered]
    return io.tonemap(image.reshape(*shape, 3), exposure=1.2)


def table(rows: list[dict], nodes: int) -> str:
    lines = [
        "| light | surface | path | error | us per pixel | reference, us per pixel |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        times = f"{r['us/pixel']:.2g} | {r['reference us/pixel']:.2g}"
        lines.append(f"| {r['light']} | {r['surface']} | {r['path']} | {r['error']:.1e} | {times} |")
    to_map = " and ".join(f"{r['error to the map']:.2g} ({r['surface']})" for r in rows if "error to the map" in r)
    lines.append("")
    lines.append("Error: RMSE over the RMS of the picture of that light on that surface, RGB, float32. Reference:")
    lines.append(f"{nodes} x {nodes} Gauss nodes on each triangle of a light, compiling included. The window is judged")
    lines.append(f"with the scene outside at degree 12; against the map itself its error is {to_map}.")
    return "\n".join(lines)


def check(rows: list[dict]) -> None:
    for r in rows:
        bound = 1e-2 if r["surface"] == "floor" else 2e-4
        assert r["error"] < bound, f"{r['light']} on the {r['surface']}: error {r['error']:.2g}"


def main(arguments: list[str] | None = None) -> None:
    parser = _scene.output_parser(__doc__, "area_lights")
    parser.add_argument("--size", type=int, default=192, help="width of a picture in pixels")
    parser.add_argument("--nodes", type=int, default=20, help="Gauss nodes along each side of a triangle")
    options = parser.parse_args(arguments)
    _scene.prepare_output(options.output, options.overwrite, "area_lights", parser)
    start = time.perf_counter()
    rows = run(options.output, options.size, options.nodes)
    text = table(rows, options.nodes)
    _scene.save(options.output / "area_lights.md", text + "\n")
    print(text)
    check(rows)
    worst = {part: max(r["error"] for r in rows if r["surface"] == part) for part in ("floor", "walls")}
    reached = f"Radiance within {worst['floor']:.1e} of quadrature on the floor and {worst['walls']:.1e} on the walls"
    _scene.verdict(reached, start, options.output)


if __name__ == "__main__":
    main()
