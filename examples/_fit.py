"""What fitting a picture needs besides shading: the picture's file, its pixels on a sphere, and Levenberg-Marquardt."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import _scene
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from tqdm import tqdm

from shisd import models

# Pixels whose surface is seen at a flatter angle are left out: over these, four rays no longer make the mean.
LEAST_FACING = 0.25


class Coated(models.AbstractBrdf):
    """A matt material under a gloss: f = albedo / pi + specular GGX, without Fresnel."""

    matt: models.Lambertian
    gloss: models.Ggx
    specular: jax.Array

    def __init__(self, alpha: jax.Array, albedo: jax.Array, specular: jax.Array):
        self.matt, self.gloss, self.specular = models.Lambertian(albedo), models.Ggx(alpha), jnp.asarray(specular)

    @property
    def isotropic(self) -> bool:
        return self.gloss.isotropic

    def value(self, wi, wo):
        return self.matt.value(wi, wo) + self.specular.astype(wi.dtype) * self.gloss.value(wi, wo)

    @property
    def lobe_width(self):
        return self.gloss.lobe_width


@dataclass
class Picture:
    """A picture of the unit sphere, and where its pixels meet the sphere."""

    name: str
    image: np.ndarray  # [size, size, 3], linear RGB
    known: dict[str, np.ndarray]  # what a fit may use
    truth: dict[str, np.ndarray]  # what it may not
    used: np.ndarray  # [size, size], bool
    points: np.ndarray  # [N, 4, 3], on the sphere, so also the normals, of the N pixels that are used
    views: np.ndarray  # [N, 4, 3], unit, towards the camera

    @property
    def values(self) -> np.ndarray:
        return self.image[self.used]

    def show(self, values: np.ndarray) -> np.ndarray:
        """[size, size, 3] with values [N, 3] in the pixels that are used, NaN elsewhere."""
        image = np.full((*self.used.shape, 3), np.nan)
        image[self.used] = values
        return image


def load(path: Path, size: int | None = None) -> Picture:
    """A picture of `tests/bench/make_pictures.py`, made smaller by whole factors on demand.

    A pixel is the mean over its square, which the four points of a Gauss rule give up to the fourth order of its size.
    """
    with np.load(path) as file:
        held = {key: file[key] for key in file.files}
    image = held.pop("picture").astype(float)
    step = len(image) // (size or len(image))
    image = image.reshape(len(image) // step, step, -1, step, 3).mean(axis=(1, 3))
    truth = {key.removeprefix("truth_"): held.pop(key) for key in list(held) if key.startswith("truth_")}
    eye, camera = held["eye"], (held["eye"], held["target"], np.radians(float(held["degrees"])))
    points, views, used = [], [], np.ones(image.shape[:2], bool)
    gauss = 0.5 / np.sqrt(3)
    inner, outer = ([*itertools.product((-a, a), repeat=2)] for a in (gauss, 0.5))
    for shift in [*inner, *outer]:
        rays = _scene.camera_rays(len(image), *camera, shift)
        along = -rays @ eye
        inside = along**2 - eye @ eye + 1
        point = eye + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
        used &= (inside > 0) & (np.sum(-rays * point, axis=-1) > LEAST_FACING)
        if shift in inner:
            points.append(point)
            views.append(-rays)
    on_sphere = (np.stack(a, axis=2)[used] for a in (points, views))
    return Picture(path.stem, image, held, truth, used, *on_sphere)


@dataclass
class Fit:
    """The best parameters [P], the loss [steps] and parameters [steps, P] on the way there, and how it ended."""

    parameters: np.ndarray
    losses: np.ndarray
    path: np.ndarray
    converged: bool


class LeastSquares:
    """Levenberg-Marquardt on `residuals(parameters, data)`, compiled once for all starts and data of one shape."""

    def __init__(self, residuals: Callable[[jax.Array, jax.Array], jax.Array], *, rtol: float, atol: float):
        self.residuals = lambda parameters, data: (residuals(parameters, data), None)
        self.solver = optx.LevenbergMarquardt(rtol, atol)
        self.constant = {"options": {}, "tags": frozenset()}
        self.step = eqx.filter_jit(self.solver.step)

    def __call__(self, start: np.ndarray, data: jax.Array, *, steps: int, label: str) -> Fit:
        """The fit from one start. The best iterate is kept, also when `steps` run out: then this says what to try."""
        y = jnp.asarray(start, data.dtype)
        shape = jax.ShapeDtypeStruct(jax.eval_shape(self.residuals, y, data)[0].shape, data.dtype)
        state = self.solver.init(self.residuals, y, data, {}, shape, None, frozenset())
        losses, path, converged = [], [], False
        with tqdm(total=steps, desc=label) as bar:
            for _ in range(steps):
                y, state, _ = self.step(self.residuals, y, data, {}, state, frozenset())
                losses.append(float(jnp.mean(state.f_info.residual**2)))
                path.append(np.asarray(y, float))
                bar.set_postfix_str(f"loss {losses[-1]:.3g}")
                bar.update()
                converged, _ = self.solver.terminate(self.residuals, y, data, {}, state, frozenset())
                if converged:
                    break
        if not converged:
            print(f"{label}: {steps} steps were not enough; the best so far is kept. Try more --steps.")
        return Fit(path[-1], np.array(losses), np.array(path), bool(converged))


def with_noise(values: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Gaussian noise in every pixel and colour, whose deviation is a share of the RMS of all values."""
    noise = np.random.default_rng(seed).normal(size=values.shape)
    return values + share * np.sqrt(np.mean(values**2)) * noise


def table(rows: Sequence[tuple[str, float, float, float, float]], scales: Sequence[float], noisy: str) -> str:
    pass
