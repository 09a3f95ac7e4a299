"""Figures: lobes on the sphere, environment maps, false-colour errors. Needs matplotlib: `pip install shisd[plot]`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from shisd import _checks, harmonics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from shisd.models import Environment

POSITIVE, NEGATIVE = "#e8a33d", "#3d6fb6"


def plot_sphere_function(
    function: Callable[[Any], Any] | Any, *, axes: Axes | None = None, resolution: int = 48, label_axes: bool = True
) -> Axes:
    """Draw a function on the sphere as a surface of radius |f|, amber where f > 0 and blue where f < 0.

    `function` maps unit directions [N, 3] to [N]; or it is an array of SH coefficients [(L+1)^2]. The surface is scaled
    to a largest radius of 1; thin lines are the x, y, z axes. `axes` must have projection="3d"; by default new ones.
    """
    import matplotlib.pyplot as plt
    from matplotlib.colors import to_rgb

    if axes is None:
        axes = plt.figure().add_subplot(projection="3d")
    theta = np.linspace(0, np.pi, resolution + 1)
    phi = np.linspace(0, 2 * np.pi, 2 * resolution + 1)
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None]
    w = np.stack(np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), cosine), axis=-1)
    dtype = jnp.result_type(float) if callable(function) else jnp.asarray(function).dtype
    directions = jnp.asarray(w.reshape(-1, 3), dtype)
    values = function(directions) if callable(function) else harmonics.evaluate(function, directions)
    values = np.asarray(values, float).reshape(w.shape[:2])
    radius = np.abs(values) / max(np.max(np.abs(values)), 1e-30)
    surface = w * radius[..., None]
    normal = np.cross(np.gradient(surface, axis=0), np.gradient(surface, axis=1))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    normal[0], normal[-1] = normal[1], normal[-2]  # the poles, where rows shrink to a point
    light = 0.72 + 0.28 * (normal @ (np.array([0.3, -0.6, 0.75]) / 1.006))
    colours = np.where(values[..., None] < 0, to_rgb(NEGATIVE), to_rgb(POSITIVE)) * light[..., None]
    style: dict[str, Any] = {"rstride": 1, "cstride": 1, "linewidth": 0, "antialiased": False, "shade": False}
    axes.plot_surface(*np.moveaxis(surface, -1, 0), facecolors=colours, **style)  # type: ignore[attr-defined]
    for end, name in zip(np.eye(3) * 1.2, "xyz", strict=True):
        axes.plot(*zip(-end, end, strict=True), color="0.6", linewidth=0.6, zorder=0)
        if label_axes:
            axes.text(*(1.12 * end), name, color="0.35", fontsize=9, ha="center")  # type: ignore[call-arg]
    limits = (-0.75, 0.75)
    axes.set(xlim=limits, ylim=limits, zlim=limits)
    axes.set_box_aspect((1, 1, 1))  # type: ignore[arg-type]
    axes.set_axis_off()
    return axes


def plot_basis(degree: int, *, size: float = 1.5) -> Figure:
    """Draw every basis function up to `degree`: one row per degree l, from m = -l on the left to m = l on the right."""
    import matplotlib.pyplot as plt

    degree = _checks.degree(degree)
    figure = plt.figure(figsize=(size * (2 * degree + 1), size * (degree + 1)))
    grid = figure.add_gridspec(degree + 1, 2 * degree + 1, wspace=0, hspace=0, left=0, right=1, bottom=0, top=1)
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            axes = figure.add_subplot(grid[l, degree + m], projection="3d")
            one = jnp.zeros((degree + 1) ** 2).at[l * (l + 1) + m].set(1.0)
            plot_sphere_function(one, axes=axes, resolution=24, label_axes=l == 0)
            axes.text2D(0.02, 0.8, f"$y_{{{l}}}^{{{m}}}$", transform=axes.transAxes)  # type: ignore[attr-defined]
    return figure


def show_map(environment: Environment, *, axes: Axes | None = None, exposure: float = 1.0) -> Axes:
    """Show an environment map as it is stored, with its angles: theta down from the zenith, phi from +x towards +y."""
    import matplotlib.pyplot as plt

    if axes is None:
        axes = plt.subplots(figsize=(8, 4))[1]
    texels = np.asarray(environment.texels, float)
    shown = np.clip(exposure * texels, 0, 1) ** (1 / 2.2)
    axes.imshow(shown, extent=(0, 360, 180, 0), cmap="gray", interpolation="nearest", aspect="auto")
    axes.set(xlabel="phi (degrees, 0 = +x, 90 = +y)", ylabel="theta (degrees, 0 = +z)")
    axes.set_xticks(range(0, 361, 45))
    axes.set_yticks(range(0, 181, 45))
    axes.set_box_aspect(0.5)
    return axes


def false_colour(error: Any, *, limits: tuple[float, float] = (1e-3, 1.0), colormap: str = "inferno") -> np.ndarray:
    """Colours [..., 3] in [0, 1] of the size of an error, on a logarithmic scale between two `limits`; NaN is grey.

    Errors at or below the lower limit have the first colour of the map, at or above the upper limit the last.
    """
    from matplotlib import colormaps

    low, high = limits
    if not 0 < low < high:
        raise ValueError(f"`limits` must be two increasing positive numbers; got {limits}.")
    size = np.abs(np.asarray(error, float))
    position = (np.log(np.maximum(size, low)) - math.log(low)) / (math.log(high) - math.log(low))
    colours = colormaps[colormap](np.clip(np.nan_to_num(position), 0, 1))[..., :3]
    return np.where(np.isnan(size)[..., None], 0.5, colours)
