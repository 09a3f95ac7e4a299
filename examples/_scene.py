"""What a picture needs besides shading: a camera, an object's visible points, pixels in their places, and a folder."""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np


@dataclass
class View:
    """The pixels of a square picture: rays for all of them, and normals and views [N, 3] where the object is seen.

    Of meshes also the positions [N, 3], the triangles [N] that are seen, and where in them [N, 3].
    """

    rays: np.ndarray  # [size, size, 3], unit, from the camera
    seen: np.ndarray  # [size, size], bool
    normals: np.ndarray
    views: np.ndarray
    positions: np.ndarray | None = None
    triangle: np.ndarray | None = None
    weights: np.ndarray | None = None

    def picture(self, values: np.ndarray, background: np.ndarray | float = 0.0) -> np.ndarray:
        """[size, size, 3] from the values [N, 3] of the seen pixels."""
        image = np.broadcast_to(background, (*self.seen.shape, 3)).copy()
        image[self.seen] = values
        return image


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


def _view(rays: np.ndarray, seen: np.ndarray, normals: np.ndarray) -> View:
    """Interpolated normals may face away from the camera: bend those just enough that the camera sees them."""
    views = -rays[seen]
    facing = np.sum(normals * views, axis=1, keepdims=True)
    normals = unit(normals + np.maximum(0.05 - facing, 0) * views)
    return View(rays, seen, normals.astype(np.float32), views.astype(np.float32))


def sphere(size: int, azimuth: float) -> View:
    """The unit sphere at the origin."""
    eye = 4.2 * np.array([np.cos(azimuth), np.sin(azimuth), 0.15])
    rays = camera_rays(size, eye, np.zeros(3), np.radians(32))
    along = -rays @ eye
    inside = along**2 - eye @ eye + 1
    seen = inside > 0
    points = eye + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    return _view(rays, seen, points[seen])


def load_mesh(path: Path):
    """A mesh that was modelled with +y up, turned to +z up, its middle at the origin."""
    import trimesh

    shape = trimesh.load_mesh(path)
    shape.apply_transform([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    shape.apply_translation(-shape.bounds.mean(axis=0))
    return shape


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
    """A mesh as `load_mesh` turns it, with smooth normals."""
    eye = 4.4 * np.array([np.cos(azimuth), np.sin(azimuth), 0.25])
    rays = camera_rays(size, eye, np.zeros(3), np.radians(29))
    ray, points, face, weights, normals = hits(load_mesh(path), eye, rays.reshape(-1, 3))
    seen = np.zeros(size * size, bool)
    seen[ray] = True
    view = _view(rays, seen.reshape(size, size), normals)
    view.positions, view.triangle, view.weights = points, face, weights.astype(np.float32)
    return view
