"""The choice: for each material and light the cheapest path at the smallest degree, as a table and as what shades."""

import functools
import math
import warnings
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._module import Module
from shisd._progress import Progress, reporting
from shisd._status import Status
from shisd._typing import Array, Float
from shisd.decomposition.internal import TABLE_DEGREE
from shisd.planning._bands import Material, Seen, known_light, known_material
from shisd.planning._paths import PATHS, Expanded, Filtered, Irradiance, Path, Sampled, Table
from shisd.planning._prediction import Choice, judge
from shisd.planning._scene import Scene
from shisd.shading import Surface, tabulate_brdf
from shisd.shading.internal import as_type, check_surface, sum_parts

_WORTH = 1.2  # times cheaper
Judge = Callable[[type[Path], Material, Seen, int], Choice]


class Entry(NamedTuple):
    """The decision for one material and one light. Errors are relative to the RMS radiance of this pair, of the colour
    for which they are largest, or of all colours together.
    """

    material: str
    light: str
    path: str
    degree: int  # or the order of points
    error: float  # predicted RMS
    bound: float  # on the RMS whatever way materials and lights are turned, from the same bands; of points, the worst
    cost: float  # nanoseconds per pixel, by a model that ranks paths; 0 for a light that joins another
    joined: str  # the light that it is added to before the path is taken, or ""
    met: bool


class Plan(Module):
    """Decisions, and all that is needed to shade by them: tables of the materials and lights cut to their degree.

    `str(plan)` is a table to read. `shade` is differentiable in everything but the materials and lights, which are
    tabulated here.
    """

    entries: tuple[Entry, ...] = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)
    paths: dict[str, tuple[Path, ...]]

    @property
    def status(self) -> Status:
        """The `shisd.Status`: ok, or `tolerance_not_met` by one of the entries."""
        return Status.ok if all(entry.met for entry in self.entries) else Status.tolerance_not_met

    def shade(self, material: str, surface: Surface) -> Float[Array, "*batch_colour"]:
        """Radiance that leaves surface points of one material towards the viewer, from all lights of the scene.

        Arguments: the name of the `material`; `surface` and what is returned as in `shading.shade`.
        Derivatives: in the surface, both modes. Cost: the sum of the entries.
        """
        if material not in self.paths:
            raise ValueError(f"`material` must be one of {', '.join(map(repr, self.paths))}; got {material!r}.")
        check_surface(surface)
        return _shade(self.paths[material], surface)

    def __str__(self) -> str:
        rows = [("material", "light", "path", "degree", "error %", "bound %", "ns per pixel", "")]
        for e in self.entries:
            cost = f"0, added to {e.joined}" if e.joined else f"{e.cost:.0f}"
            rows.append((
                e.material, e.light, e.path, str(e.degree), f"{100 * e.error:.2g}", f"{100 * e.bound:.2g}", cost,
                "" if e.met else "NOT MET: raise max_degree or tolerance",
            ))  # fmt: skip
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
        lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([
            f"Relative RMS error up to {100 * self.tolerance:.2g} %; nothing occludes, so no path looks up visibility.",
            *lines,
        ])  # fmt: skip


def plan(
    scene: Scene,
    tolerance: float,
    *,
    max_degree: int = 30,
    margin: float = 1.5,
    elevations: int = 64,
    pooled: bool = False,
    throw: bool = True,
    progress: Progress = None,
) -> Plan:
    """For each material and light of a scene, the cheapest path and the smallest degree that meet a tolerance.

    Arguments: `tolerance` > 0, the relative RMS error: of the radiance from one light, over its RMS, both over normals
    in all directions and views as in the picture of a sphere; every colour has to meet it, or with `pooled` the sum of
    their squares, which a dim colour hardly changes. Static `max_degree` up to 64; `margin` >= 1, by which predictions
    are multiplied before they are compared: real scenes are not turned in all ways. `elevations` of the tables, as in
    `shading.tabulate_brdf`.
    Distant lights that take the same path are added up before it, so only the first of them costs anything, and others
    join where they meet the tolerance there.
    Distant light may be filtered beforehand (`shading.prefilter`, isotropic materials): half a second to two more for
    each such pair, and for each pixel 16 to 90 times less than by a table of degree 16 or 30 (GGX 0.25, RGB, channels
    to 1e-1 ... 1e-2). Channels have 3/5 of `error` then.
    Lamps and windows may take points on them (`shading.Quadrature`) in place of slices: `degree` of such an entry is
    the order, its error what 1024 normals at every point show, or 16,384 views of the scene's own normals, and `bound`
    the largest of them. They are compared with orders of 24 or 48, or where the lobe is too narrow for these with
    expansions of degree 8 beyond maps of directions (`shading.transform_brdf`, degree 4 or 8, isotropic materials),
    which lamps that shine alike in all directions may take too: some 10 s to make for each material that needs them.
    Where nothing meets the tolerance, it is a ValueError; with `throw=False` the entry has the best that `max_degree`
    can do and `met` False, the `status` is `tolerance_not_met`, and a UserWarning says so. `progress`: None, True for a
    bar of tqdm, or a function of (done, total) lights and materials.
    Accuracy: predictions are for bands up to max(32, 2 max_degree). Over all orientations, what six photographed maps
    gave for three materials at degrees 2 to 12 was 0.65 to 1.06 times the prediction, of the worst colour. One picture
    does not show all orientations: there it was 0.2 to 4.2 times, four of five between 0.35 and 1.85, more for cameras
    that see the sides with the edges of the light. Materials and lights in float32 show nothing below 1e-5.
    The cheapest is that by a model of times on a CPU (`Entry.cost`), which ranks paths and knows the operations of a
    material's own model, but no other machine.
    Not traced: it runs on the host and returns what is to be traced.
    Cost: every material is tabulated once, which compiles for each kind of material.
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"`scene` must be a planning.Scene; got {type(scene).__name__}.")
    max_degree = _checks.integer("max_degree", max_degree)
    elevations = _checks.integer("elevations", elevations, 4)
    if max_degree > TABLE_DEGREE:
        raise ValueError(f"`max_degree` must be <= {TABLE_DEGREE}; got {max_degree}.")
    tolerance, margin = _checks.number("tolerance", tolerance, positive=True), _checks.number("margin", margin)
    if margin < 1:
        raise ValueError(f"`margin` must be >= 1; got {margin}.")
    with reporting(progress, len(scene.lights) + len(scene.materials), "plan") as step:
        made = _plan(scene, tolerance, margin, max_degree, elevations, pooled, step)
    if made.status != Status.ok:
        failed = [f"{e.material} under {e.light} ({100 * e.error:.2g} %)" for e in made.entries if not e.met]
        message = (
            f"`tolerance` {tolerance} with `margin` {margin} is not met at degree {max_degree}: {', '.join(failed)}. "
            "Raise `max_degree` or `tolerance`."
        )
        if throw:
            raise ValueError(message)
        warnings.warn(message, UserWarning, stacklevel=2)
    return made


def _plan(
    scene: Scene,
    tolerance: float,
    margin: float,
    max_degree: int,
    elevations: int,
    pooled: bool,
    step: Callable[..., object],
) -> Plan:
    reference = max(32, 2 * max_degree)
    judged = functools.partial(judge, pooled=pooled)
    lights = {}
    for name, light in scene.lights.items():
        lights[name] = known_light(name, light, scene.points, reference, scene.normals)
        step()
    entries, paths = [], {}
    for name, brdf in scene.materials.items():
        material = known_material(brdf, reference, elevations)
        choices = {of: _choose(judged, material, light, tolerance / margin, max_degree) for of, light in lights.items()}
        choices, hosts = _join(judged, material, lights, choices, tolerance / margin)
        needed = [choice.degree for choice in choices.values() if issubclass(choice.path, Expanded)]
        slices = as_type(tabulate_brdf(brdf, max(needed), elevations=elevations), float) if needed else None
        for of, choice in choices.items():
            alone = hosts[of] == of
            cost, joined = (choice.cost, "") if alone else (0.0, hosts[of])
            met = choice.error <= tolerance / margin
            entries.append(
                Entry(name, of, choice.name, choice.degree, choice.error, choice.bound, cost, joined, met)
            )
        paths[name] = tuple(
            choice.path.make(material, slices, [lights[of] for of in choices if hosts[of] == host], choice.degree)
            for host, choice in choices.items()
            if hosts[host] == host
        )
        step()
    return Plan(tuple(entries), tolerance, paths)


def _choose(judged: Judge, material: Material, light: Seen, target: float, max_degree: int) -> Choice:
    """The cheapest path that meets the target, or else the one that comes closest."""
    found: list[Choice] = []
    for path in PATHS:
        if path.takes is light.kind:
            cheapest = min((choice.cost for choice in found if choice.error <= target), default=math.inf)
            found.extend(_first(judged, path, material, light, target, max_degree, cheapest))
    good = [choice for choice in found if choice.error <= target]
    return min(good, key=lambda c: c.cost) if good else min(found, key=lambda c: c.error)


def _first(
    judged: Judge, path: type[Path], material: Material, light: Seen, target: float, max_degree: int, cheapest: float
) -> list[Choice]:
    """A path at degrees up to the first that meets the target, or to the last.

    Samples cost seconds: few of their degrees are tried, and none that would gain little over another path.
    """
    degrees, found = list(path.degrees(max_degree)), []
    if issubclass(path, Sampled):
        degrees = [degree for degree in degrees if _WORTH * path.cost(material, light, degree) < cheapest]
    low, high = 0, len(degrees)
    while low < high:
        middle = (low + high - 1) // 2 if issubclass(path, Sampled) else low
        found.append(judged(path, material, light, degrees[middle]))
        low, high = (low, middle) if found[-1].error <= target else (middle + 1, high)
    return found


def _join(
    judged: Judge, material: Material, lights: dict[str, Seen], choices: dict[str, Choice], target: float
) -> tuple[dict[str, Choice], dict[str, str]]:
    """Distant lights in the paths of others, where they are good enough; and whose path, for each light."""
    hosts = {name: name for name in choices}
    free = list(choices)
    for path in (Table, Filtered, Irradiance):
        takers = [name for name in free if choices[name].path is path]
        if takers:
            host = max(takers, key=lambda name: choices[name].degree)
            for name in free:
                if lights[name].kind is path.takes:
                    joined = judged(path, material, lights[name], choices[host].degree)
                    if name in takers or joined.error <= target:
                        choices, hosts = choices | {name: joined}, hosts | {name: host}
            free = [name for name in free if hosts[name] != host]
    return choices, hosts


@eqx.filter_jit
def _shade(paths: tuple[Path, ...], surface: Surface) -> Float[Array, "*batch_colour"]:
    surface = _whole(surface)
    batch = surface.normals.ndim - 1
    return sum_parts((value, value.shape[batch:]) for value in (path.shade(surface) for path in paths))


def _whole(surface: Surface) -> Surface:
    """With all batch axes in every array, so that what some paths ignore counts for all."""
    names = ("normals", "views", "positions", "tangents")
    vectors = {name: a for name in names if (a := getattr(surface, name)) is not None}
    mask = surface.mask
    shape = np.broadcast_shapes(*(a.shape[:-1] for a in vectors.values()), () if mask is None else mask.shape)
    wide = {name: jnp.broadcast_to(a, (*shape, 3)) for name, a in vectors.items()}
    return Surface(**wide, mask=None if mask is None else jnp.broadcast_to(mask, shape))
