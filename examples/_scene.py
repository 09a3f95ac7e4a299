"""What a picture needs besides shading: rooms, a camera, an object's visible points, a labelled sheet, and a folder."""

import argparse
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from shisd import models, plotting, shading

try:
    from tqdm import tqdm
except ImportError:  # programs run without bars
    tqdm = None

DATA = Path(__file__).resolve().parent / "data"
MAPS = {"interior": ("interior.hdr", 0.45, -0.363), "studio": ("studio.exr", 1.0, -0.451)}  # file, exposure, turns
AZIMUTH = 5.0  # of the camera, in radians
INK, PAPER = "#e8e6e3", "#17181b"
PROGRESS = None if tqdm is None else True  # for functions of shisd


def progress(items: Iterable, label: str, total: int | None = None) -> Iterable:
    """The items, behind a bar where tqdm is installed."""
    return items if tqdm is None else tqdm(items, label, total)


@dataclass
class View:
    """The pixels of a square picture: rays for all of them, and normals and views [N, 3] where the object is seen.

    Of meshes also the triangles [N] that are seen, and where in them [N, 3].
    """

    eye: np.ndarray  # [3]
    rays: np.ndarray  # [size, size, 3], unit, from the eye
    seen: np.ndarray  # [size, size], bool
    positions: np.ndarray
    normals: np.ndarray
    views: np.ndarray
    triangle: np.ndarray | None = None
    weights: np.ndarray | None = None

    def surface(self) -> shading.Surface:
        """All that is known of the seen points."""
        where = {"triangles": self.triangle, "barycentric": self.weights}
        return shading.Surface(self.normals, self.views, self.positions.astype(np.float32), **where)

    def picture(self, values: np.ndarray, background: np.ndarray | float = 0.0) -> np.ndarray:
        """[size, size, 3] from the values [N, 3] of the seen pixels."""
        image = np.broadcast_to(background, (*self.seen.shape, 3)).copy()
        image[self.seen] = values
        return image


def load_map(name: str) -> models.Environment:
    """A room at 512 x 256, flipped so that it is not mirrored, and turned about the vertical."""
    file, _, turn = MAPS[name]
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        texels = models.Environment.load(DATA / file).texels
    for warning in found:
        print(f"note: {Path(str(warning.message)).name}")
    step = texels.shape[0] // 256
    texels = texels.reshape(256, step, 512, step, 3).mean(axis=(1, 3))
    return models.Environment(np.roll(texels[:, ::-1], round(512 * turn), axis=1))


def gold_metallic_paint() -> models.SgdMicrofacet:
    """MERL's gold-metallic-paint as fitted by Bagher, Soler and Holzschuch 2012 (supplement, row of that name)."""
    return models.SgdMicrofacet(
        np.array([0.0178625, 0.00995704, 0.00335044]),
        np.array([0.17127, 0.120714, 0.115473]),
        np.array([0.127954, 0.127825, 0.109623]),
        np.array([0.781093, 0.795517, 0.661313]),
        np.array([1.00776e-12, 1.22243e-15, 6.18432e-13]),
        np.array([-1.0, -1.0, -0.334497]),
        np.array([5.90039, 5.83556, 7.14985]),
        np.array([2.7548, 2.7057, 2.94348]),
        np.array([9.46481e-08, 1.06951e-07, 1.10733e-07]),
        np.array([23.8811, 23.9059, 24.2972]),
        np.array([-0.303345, -0.293778, -0.267019]),
    )


def output_parser(text: str, name: str) -> argparse.ArgumentParser:
    """A parser that shows the text of a program, with the options that `prepare_output` is for."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("output") / name, help="folder for what is made")
    parser.add_argument("--overwrite", action="store_true", help="replace files in the output folder if it exists")
    return parser


def prepare_output(folder: Path, overwrite: bool, name: str, parser: argparse.ArgumentParser) -> None:
    """A folder with the mark of the program `name`, a hidden file that only this function makes.

    One that exists is taken only when asked, and only if it has the mark or is empty. Nothing is removed: what the
    program writes then replaces what is called alike.
    """
    mark = folder / f".made-by-{name}"
    if folder.exists():
        if not overwrite:
            parser.error(f"{folder} exists. Name another --output, or replace its files with --overwrite.")
        if not folder.is_dir() or not (mark.is_file() or not any(folder.iterdir())):
            parser.error(f"{folder} was not made by this program and is left alone. Name another --output.")
    folder.mkdir(parents=True, exist_ok=True)
    save(mark, f"Files here may be replaced by {name}.py --overwrite.\n")


def save(path: Path, content: str | Callable[[IO[bytes]], object]) -> None:
    """Put a text, or what a function writes to a binary file, in the place of what is there, whole or not at all."""
    beside = path.with_name(f".{path.name}.part")
    with beside.open("wb") as file:
        file.write(content.encode()) if isinstance(content, str) else content(file)
    beside.replace(path)


def verdict(reached: str, start: float, output: Path) -> None:
    """The last line of a program: what it reached, how long that took, and where to look."""
    print(f"\n{reached}, in {time.perf_counter() - start:.1f} s; see {output}/.")


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def camera_rays(
    size: int, eye: np.ndarray, target: np.ndarray, field_of_view: float, right_down: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """Unit rays [size, size, 3] of a perspective camera with +z up; rows from the top, one ray per pixel.

    Rays go through the centres, or through points to the right of them and below by so many pixels.
    """
    forward = unit(target - eye)
    right = unit(np.cross(forward, [0.0, 0.0, 1.0]))
    up = np.cross(right, forward)
    x, y = (np.tan(field_of_view / 2) * (2 * (np.arange(size) + 0.5 + shift) / size - 1) for shift in right_down)
    return unit(forward + x[None, :, None] * right - y[:, None, None] * up)


def _camera(size: int, azimuth: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """An eye that the unit sphere about the origin fills the picture of, but for a rim, and its rays."""
    eye = 4.2 * unit(np.array([np.cos(azimuth), np.sin(azimuth), height]))
    return eye, camera_rays(size, eye, np.zeros(3), np.radians(29))


def _view(
    eye: np.ndarray, rays: np.ndarray, seen: np.ndarray, positions: np.ndarray, normals: np.ndarray, **where
) -> View:
    """Interpolated normals may face away from the camera: bend those just enough that the camera sees them."""
    views = -rays[seen]
    facing = np.sum(normals * views, axis=1, keepdims=True)
    normals = unit(normals + np.maximum(0.05 - facing, 0) * views)
    return View(eye, rays, seen, positions, normals.astype(np.float32), views.astype(np.float32), **where)


def sphere_hits(eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether rays [..., 3] meet the unit sphere at the origin, and where: its points are its normals."""
    along = -rays @ eye
    inside = along**2 - eye @ eye + 1
    return inside > 0, eye + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays


def sphere(size: int, azimuth: float) -> View:
    """The unit sphere at the origin."""
    eye, rays = _camera(size, azimuth, 0.15)
    seen, points = sphere_hits(eye, rays)
    return _view(eye, rays, seen, points[seen], points[seen])


def load_mesh(path: Path):
    """A mesh that was modelled with +y up and in any unit, turned to +z up and scaled into the unit sphere."""
    import trimesh

    shape = trimesh.load_mesh(path)
    shape.apply_transform([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    centre, radius = bounding_sphere(shape.vertices)
    shape.apply_translation(-centre)
    shape.apply_scale(1 / radius)
    return shape


def bounding_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of a sphere around points [N, 3], less than 1 % larger than the smallest one.

    The centre moves towards the farthest point, by less and less (Badoiu and Clarkson 2003).
    """
    centre = points.mean(axis=0)
    for step in range(1, 400):
        centre = centre + (points[np.argmax(np.linalg.norm(points - centre, axis=1))] - centre) / (step + 1)
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def hits(shape, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of rays [N, 3] that meet a mesh: their indices, the points, the triangles, where in them, and smooth normals."""
    import trimesh

    points, ray, face = shape.ray.intersects_location(np.broadcast_to(eye, rays.shape), rays, multiple_hits=False)
    order = np.argsort(ray)
    points, ray, face = points[order], ray[order], face[order]
    weights = trimesh.triangles.points_to_barycentric(shape.triangles[face], points)
    normals = unit(np.einsum("nk,nkx->nx", weights, shape.vertex_normals[shape.faces[face]]))
    return ray, points, face, weights, normals


def mesh(path: Path, size: int, azimuth: float) -> View:
    """A mesh as `load_mesh` turns and scales it, with smooth normals."""
    eye, rays = _camera(size, azimuth, 0.25)
    ray, points, face, weights, normals = hits(load_mesh(path), eye, rays.reshape(-1, 3))
    seen = np.zeros(size * size, bool)
    seen[ray] = True
    return _view(
        eye, rays, seen.reshape(size, size), points, normals, triangle=face, weights=weights.astype(np.float32)
    )


def colour_scale(figure, box: tuple[float, float, float, float], limits: tuple[float, float]) -> None:
    """What false colours stand for, in a box (left, bottom, width, height) of a figure of matplotlib."""
    axes, ends = figure.add_axes(box), np.log10(limits)
    ramp = plotting.false_colour(np.geomspace(*limits, 256)[None], limits=limits)
    axes.imshow(ramp, aspect="auto", extent=(*ends, 0, 1))
    axes.set_yticks([])
    decades = np.arange(*np.round(ends).astype(int) + [0, 1])
    names = [f"{100 * 10.0**d:g} %" for d in decades] if len(decades) < 5 else [f"1e{d}" for d in decades]
    axes.set_xticks(decades, names, color=INK, fontsize=7)
    axes.tick_params(length=0, pad=2)


def sheet(
    path: Path,
    columns: Iterable[str],
    rows: list[tuple[str, list[np.ndarray]]],
    *,
    limits: tuple[float, float] | None = None,
    notes: dict[tuple[int, int], str] | None = None,
    title: str = "",
) -> None:
    """A grid of pictures of one shape, pixel by pixel, with titles of columns, labels of rows [(label, pictures)].

    `limits`: the ends of the false colours, errors over the mean radiance, for which a scale is drawn below. `notes`:
    texts in the corners of pictures, by row and column.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import patheffects, pyplot

    columns, dpi, gap = list(columns), 100, 4
    height, width = rows[0][1][0].shape[:2]
    zoom = max(1, round(190 / width))
    height, width = zoom * height, zoom * width
    left, top, bottom = 26, 28 + 26 * bool(title), 44 if limits else 8
    size = np.array([left + len(columns) * (width + gap) + gap, top + len(rows) * (height + gap) + bottom])
    halo = [patheffects.withStroke(linewidth=2.5, foreground="black")]
    with pyplot.rc_context({"text.color": INK, "font.size": 9, "axes.edgecolor": INK}):
        figure = pyplot.figure(figsize=size / dpi, dpi=dpi, facecolor=PAPER)
        at = lambda x, y: (x / size[0], 1 - y / size[1])  # of pixels from the left and the top
        figure.text(*at(left, 18), title, fontsize=13, va="center")
        for k, name in enumerate(columns):
            figure.text(*at(left + k * (width + gap) + width / 2, top - 14), name, ha="center", va="center")
        for i, (label, images) in enumerate(rows):
            y = top + (i + 1) * (height + gap) - gap
            figure.text(*at(12, y - height / 2), label, rotation=90, ha="center", va="center")
            for k, image in enumerate(images):
                axes = figure.add_axes((*at(left + k * (width + gap), y), width / size[0], height / size[1]))
                axes.set_axis_off()
                axes.imshow(image, interpolation="nearest", aspect="auto")
                if note := (notes or {}).get((i, k)):
                    axes.text(0.97, 0.04, note, ha="right", transform=axes.transAxes, path_effects=halo)
        if limits:
            colour_scale(figure, (*at(size[0] - 248, size[1] - 22), 220 / size[0], 10 / size[1]), limits)
            figure.text(*at(size[0] - 274, size[1] - 27), "error / mean radiance", ha="right", va="center", fontsize=8)
        save(path, lambda file: figure.savefig(file, format="png", dpi=dpi, facecolor=PAPER))
        pyplot.close(figure)


def false_colour(error: np.ndarray, mean: float, limits: tuple[float, float]) -> np.ndarray:
    """Colours [..., 3] of the norms of errors [..., 3] over a mean radiance."""
    return plotting.false_colour(np.linalg.norm(error, axis=-1) / mean, limits=limits)
