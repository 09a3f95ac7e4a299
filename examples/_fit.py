"""What fitting a picture needs besides shading: the picture's file, its pixels on a sphere, and Levenberg-Marquardt."""

import csv
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import _scene
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from shisd import io, models

# Pixels whose surface is seen at a flatter angle are left out: over these, four rays no longer make the mean.
LEAST_FACING = 0.25
COLOURS = "#f2b134", "#ed553b", "#6fa8dc", "#8fd18f", "#c792ea", "#e8e6e3"


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
        inside, point = _scene.sphere_hits(eye, rays)
        used &= inside & (np.sum(-rays * point, axis=-1) > LEAST_FACING)
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
        solver = optx.LevenbergMarquardt(rtol, atol)
        # By default steps grow only where the linear model is right to 1 %, which takes twice as many here.
        trust = optx.ClassicalTrustRegion(high_cutoff=0.75, high_constant=8.0)
        self.solver = eqx.tree_at(lambda s: s.search, solver, trust)
        self.step, self.initial = eqx.filter_jit(self.solver.step), None

    def __call__(self, start: np.ndarray, data: jax.Array, *, steps: int, label: str) -> Fit:
        """The fit from one start. The best iterate is kept, also when `steps` run out: then this says what to try."""
        y = jnp.asarray(start, data.dtype)
        if self.initial is None:  # one for all fits: a second one would have `step` compiled again
            shape = jax.eval_shape(self.residuals, y, data)[0]
            self.initial = self.solver.init(self.residuals, y, data, {}, shape, None, frozenset())
        state = eqx.tree_at(lambda s: s.y_eval, self.initial, y)
        losses, path, converged = [], [], False
        for _ in _scene.progress(range(steps), label):
            y, state, _ = self.step(self.residuals, y, data, {}, state, frozenset())
            losses.append(float(jnp.mean(state.f_info.residual**2)))
            path.append(np.asarray(y, float))
            # Near the optimum rounding decides whether the next step is accepted: one too small to matter ends it.
            ahead = np.asarray(state.y_eval, float) - path[-1]
            converged = np.all(np.abs(ahead) < self.solver.atol + self.solver.rtol * np.abs(path[-1]))
            if converged:
                break
        if not converged:
            print(f"{label}: {steps} steps were not enough; the best so far is kept. Try more --steps.")
        return Fit(path[-1], np.array(losses), np.array(path), bool(converged))


def with_noise(values: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Gaussian noise in every pixel and colour, whose deviation is a share of the RMS of all values."""
    noise = np.random.default_rng(seed).normal(size=values.shape)
    return values + share * np.sqrt(np.mean(values**2)) * noise


@dataclass
class Row:
    """One line of the table: a parameter, and the errors of its fits to a clean picture and to noisy ones."""

    parameter: str
    truth: float
    found: float
    error: float  # in per cent
    noisy: list[float]  # the same of each noisy picture


def table(rows: Sequence[Row]) -> str:
    lines = ["| parameter | truth | found | error % | error %, 1 % noise |", "|---|---|---|---|---|"]
    for r in rows:
        noisy = f"{np.sqrt(np.mean(np.square(r.noisy))):.2g}" if r.noisy else ""
        lines.append(f"| {r.parameter} | {r.truth:.4g} | {r.found:.4g} | {r.error:.2g} | {noisy} |")
    return "\n".join(lines)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    text = StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(["parameter", "truth", "found", "error %", *(f"noisy {k}" for k in range(len(rows[0].noisy)))])
    writer.writerows([r.parameter, r.truth, r.found, r.error, *r.noisy] for r in rows)
    _scene.save(path, text.getvalue())


def sheet(
    path: Path,
    picture: Picture,
    fitted: np.ndarray,
    exposure: float,
    curves: dict[str, np.ndarray],
    limits: tuple[float, float],
) -> None:
    """Target, fit, their difference, and the error of each parameter in per cent by step."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    ink, paper = _scene.INK, _scene.PAPER
    mean = np.linalg.norm(picture.values, axis=1).mean()
    false = np.nan_to_num(picture.show(_scene.false_colour(fitted - picture.values, mean, limits)))
    target, fit = (io.tonemap(np.nan_to_num(a), exposure=exposure) for a in (picture.image, picture.show(fitted)))
    style = {"text.color": ink, "font.size": 9, "axes.edgecolor": ink, "axes.labelcolor": ink, "axes.facecolor": paper}
    with pyplot.rc_context(style | {"xtick.color": ink, "ytick.color": ink}):
        figure = pyplot.figure(figsize=(11.6, 2.9), facecolor=paper)
        titles = "picture (Mitsuba 3)", "fit", "difference / mean radiance"
        for k, (image, title) in enumerate(zip((target, fit, false), titles, strict=True)):
            axes = figure.add_axes((0.009 + 0.206 * k, 0.085, 0.201, 0.82))
            axes.set_axis_off()
            axes.set_title(title)
            axes.imshow(image, interpolation="nearest")
        _scene.colour_scale(figure, (0.441, 0.075, 0.16, 0.025), limits)
        axes = figure.add_axes((0.672, 0.17, 0.222, 0.72))
        for (name, values), colour in zip(curves.items(), COLOURS, strict=False):
            axes.semilogy(np.arange(len(values)), values, label=name, color=colour, linewidth=1.3)
        axes.set_title("error % by step")
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.grid(color=ink, alpha=0.15, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=7.5, loc="center left", bbox_to_anchor=(1, 0.5), labelcolor=ink)
        _scene.save(path, lambda file: figure.savefig(file, format="png", dpi=120, facecolor=paper))
        pyplot.close(figure)
