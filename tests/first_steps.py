"""A program that uses each stage and each optional package, and prints numbers: `python first_steps.py FOLDER`.

It needs nothing of the tests, so it runs wherever the package is installed.
"""

import json
import sys
from pathlib import Path

import jax
import matplotlib
import numpy as np
import trimesh

from shisd import domains, harmonics, io, models, plotting, shading

DEGREE = 4
NORMALS = np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8]], np.float32)
VIEWS = np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0]], np.float32)
LAMP = np.array([[1.0, -0.5, 1.0], [1.0, 0.5, 1.0], [0.0, 0.0, 2.0]], np.float32)
LIGHT = np.linspace(1, -1, (DEGREE + 1) ** 2, dtype=np.float32)


def radiance(roughness):
    """What two points send back of distant light and of a lamp, and their sum."""
    slices = shading.tabulate_brdf(models.Ggx(roughness), DEGREE)
    lamp = models.PolygonLight(LAMP, two_sided=True)
    distant = shading.shade(slices, models.DistantLight(LIGHT), shading.Surface(NORMALS, VIEWS))
    near = shading.shade(slices, lamp, shading.Surface(NORMALS, VIEWS, np.zeros_like(NORMALS)))
    return (distant + near).sum(), {"distant": distant, "near": near}


def main(folder: Path) -> None:
    (_, numbers), gradient = jax.value_and_grad(radiance, has_aux=True)(np.float32(0.5))
    numbers["gradient"] = gradient
    polygon = domains.polygon_from_points(LAMP, np.zeros(3, np.float32))
    numbers["integral"] = domains.integrate(LIGHT, polygon)
    numbers["dering"] = harmonics.dering(LIGHT).strength

    box, up = trimesh.creation.box(), np.array([[0.0, 0.0, 1.0]])
    place = {"points": np.array([[0.8, 0.1, -0.5]]), "normals": up}  # on the ground beside the box
    numbers["visibility"] = models.Visibility.from_mesh(box.vertices, box.faces, 1, **place, rays=512).coefficients[0]
    image = np.geomspace(1e-3, 1e3, 4 * 8 * 3).reshape(4, 8, 3).astype(np.float32)
    io.write_image(folder / "image.exr", image)
    numbers["image"] = io.read_image(folder / "image.exr").mean()
    io.write_image(folder / "image.png", io.tonemap(image))
    matplotlib.use("Agg")
    plotting.show_map(models.Environment(image)).figure.savefig(folder / "map.png")
    print(json.dumps({name: np.asarray(value, float).tolist() for name, value in numbers.items()}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
