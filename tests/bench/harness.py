"""Speed against error of several methods for one task: the same inputs, one process, methods in turn.

A task has inputs, a reference for some of its items, and methods. Every method is compiled by the harness itself, so
that the first call and the memory are measured alike; methods that are no JAX functions say so with `host`.
"""

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from shisd.io.internal import write_atomically
from tests.bench import timing
from tests.bench.timing import interleaved

LEVELS = (0.1, 0.03, 0.01, 0.003, 0.001)  # errors at which families are compared
HISTOGRAM = np.array([0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, np.inf])  # of |error| over the RMS of the reference


@dataclass(frozen=True)
class Method:
    """One setting of one family of methods, e.g. ("Monte Carlo", "64 samples").

    forward(parameters, *inputs) returns [items, ...]; gradient(parameters, *inputs) anything that holds the derivatives
    that the task asks for. Both are pure functions, compiled once for all methods with the same functions and shapes.
    `setup`: seconds spent once for a scene (tables, fits, filtered maps).
    """

    family: str
    setting: str
    forward: Callable
    parameters: Any
    gradient: Callable | None = None
    setup: float | None = None
    host: bool = False
    ours: bool = False


@dataclass(frozen=True)
class Task:
    """`reference` [judged, ...] holds the first items' values, `reference_error` its RMS error over its RMS."""

    name: str
    title: str
    item: str
    inputs: tuple
    reference: np.ndarray
    reference_error: float
    methods: list[Method]
    count: int = field(kw_only=True)


@dataclass(frozen=True)
class _Compiled:
    call: Callable
    first: float  # s: tracing, compiling and the first run
    megabytes: float  # temporaries and results


def run(task: Task, seconds: float = 0.25) -> list[dict]:
    """A row for every method: error, times, first call, memory. About `seconds` of calls for each, at least three."""
    forward, gradient = {}, {}
    for i, m in enumerate(task.methods):
        arguments = (m.parameters, *task.inputs)
        forward[i] = _compile(m.forward, arguments, m.host)
        if m.gradient is not None:
            gradient[i] = _compile(m.gradient, arguments, m.host)
    calls = {
        ("forward", i): functools.partial(c.call, task.methods[i].parameters, *task.inputs) for i, c in forward.items()
    }
    calls |= {
        ("gradient", i): functools.partial(c.call, task.methods[i].parameters, *task.inputs)
        for i, c in gradient.items()
    }
    times = {name: t.median for name, t in interleaved(calls, seconds=seconds).items()}
    scale = 1e6 / task.count
    rows = []
    for i, m in enumerate(task.methods):
        values = np.asarray(calls["forward", i]())
        rows.append({
            "task": task.name,
            "family": m.family,
            "setting": m.setting,
            "ours": m.ours,
            f"us/{task.item}": times["forward", i] * scale,
            "with gradient": times["gradient", i] * scale if i in gradient else None,
            **errors(values[: len(task.reference)], task.reference),
            "reference error": task.reference_error,
            "first call s": forward[i].first,
            "first gradient s": gradient[i].first if i in gradient else None,
            "setup s": m.setup,
            "MB": forward[i].megabytes,
            "dtype": str(values.dtype),
        })  # fmt: skip
    return rows


def errors(values: np.ndarray, reference: np.ndarray) -> dict:
    """Relative RMSE, largest error over the largest value, and the histogram of |error| over the RMS."""
    difference = np.abs(np.asarray(values, float) - reference)
    rms = np.sqrt(np.mean(reference.astype(float) ** 2))
    return {
        "relative RMSE": float(np.sqrt(np.mean(difference**2)) / rms),
        "max error / max": float(np.max(difference) / np.max(np.abs(reference))),
        "histogram": np.histogram(difference / rms, HISTOGRAM)[0].tolist(),
    }


def front(rows: list[dict], item: str) -> list[dict]:
    """The rows that no other is both faster and nearer than, from the fastest to the nearest."""
    best, kept = np.inf, []
    for row in sorted(rows, key=lambda r: (r[f"us/{item}"], r["relative RMSE"])):
        if row["relative RMSE"] < best:
            best = row["relative RMSE"]
            kept.append(row)
    return kept


def lead(rows: list[dict], item: str, worst: float = 0.1) -> list[dict]:
    """For every other family, how many times longer it takes than ours for the same error, where it is nearest to us.

    Of its settings whose error lies between `worst` and the least of ours; below 1 it is ahead.
    """
    ours, floor = [r for r in rows if r["ours"]], min(r["relative RMSE"] for r in rows if r["ours"])
    table = []
    for family in dict.fromkeys(r["family"] for r in rows if not r["ours"]):
        compared = [r for r in rows if r["family"] == family and floor <= r["relative RMSE"] <= worst]
        ratios = [
            r[f"us/{item}"] / min(o[f"us/{item}"] for o in ours if o["relative RMSE"] <= r["relative RMSE"])
            for r in compared
        ]
        least = int(np.argmin(ratios)) if ratios else None
        table.append({
            "family": family,
            "settings compared": len(ratios),
            "time / ours, least": None if least is None else ratios[least],
            "at": None if least is None else compared[least]["setting"],
            "its error": None if least is None else compared[least]["relative RMSE"],
        })  # fmt: skip
    return table


def cheapest(rows: list[dict], item: str, error: float) -> dict | None:
    """The fastest row with this error at most."""
    good = [r for r in rows if r["relative RMSE"] <= error]
    return min(good, key=lambda r: r[f"us/{item}"]) if good else None


def at_levels(rows: list[dict], item: str, planned: str) -> dict[str, str]:
    """For every level of error, the time of the cheapest other over our cheapest, and over the cheapest `planned`.

    Of rows whose error is the level at most; `planned` is a family of ours. Below 1 the other is ahead: bold.
    """
    ours = [r for r in rows if r["ours"]]
    cells = {}
    for level in LEVELS:
        other = cheapest([r for r in rows if not r["ours"]], item, level)
        own = [cheapest(x, item, level) for x in (ours, [r for r in ours if r["family"] == planned])]
        if other is None:
            cells[f"{100 * level:g} %"] = "-" if own[0] is None else "ours only"
            continue
        ratios = [None if r is None else other[f"us/{item}"] / r[f"us/{item}"] for r in own]
        show = lambda x: "-" if x is None else f"**{x:.2g}**" if x < 1 else f"{x:.2g}"
        cells[f"{100 * level:g} %"] = f"{show(ratios[0])}, {show(ratios[1])} ({other['family']})"
    return cells


def draw(panels: dict[str, list[dict]], item: str, path: Path, columns: int = 3) -> None:
    """Error against time, both logarithmic, a panel for every title; a line joins the settings of a family."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    columns = min(columns, len(panels))
    rows_of_panels = -(-len(panels) // columns)
    figure, axes = pyplot.subplots(
        rows_of_panels,
        columns,
        figsize=(4.6 * columns, 3.1 * rows_of_panels + 1.2),
        squeeze=False,
        layout="constrained",
    )
    families = list(dict.fromkeys(r["family"] for rows in panels.values() for r in rows))
    others = iter(pyplot.get_cmap("tab10")(np.arange(10)))
    ours = {r["family"] for rows in panels.values() for r in rows if r["ours"]}
    reds = iter(["#c00000", "#ff7f50", "#800040", "#e6a000", "#ff0090", "#8b4513", "#b8860b", "#600000"])
    style = {f: next(reds) if f in ours else next(others) for f in families}
    for axis, (title, rows) in zip(axes.flat, panels.items(), strict=False):
        for family in families:
            own = [r for r in rows if r["family"] == family]
            x, y = [r[f"us/{item}"] for r in own], [r["relative RMSE"] for r in own]
            axis.loglog(x, y, "o-" if family in ours else "s--", ms=4, lw=1.6 if family in ours else 0.9,
                        color=style[family], label=family)  # fmt: skip
        edge = front(rows, item)
        axis.step([r[f"us/{item}"] for r in edge], [r["relative RMSE"] for r in edge], where="post", color="0.6", lw=5,
                  alpha=0.4, zorder=0, label="front")  # fmt: skip
        if rows[0]["reference error"] > 0:
            axis.axhline(rows[0]["reference error"], color="k", lw=0.7, ls=":", label="error of the reference")
        axis.set_title(title, fontsize=9)
        low, high = axis.get_xlim()
        axis.xaxis.set_minor_locator(ticker.LogLocator(subs=(2, 5)))
        if high > 20 * low:  # labels between powers of ten would overlap
            axis.xaxis.set_minor_formatter(ticker.NullFormatter())
        axis.grid(True, which="major", alpha=0.3)
    for axis in axes.flat[len(panels) :]:
        axis.set_axis_off()
    for axis in axes[-1]:
        axis.set_xlabel(f"us per {item}")
    for axis in axes[:, 0]:
        axis.set_ylabel("relative RMSE")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2 * columns - (columns > 1), fontsize=7)
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=110), overwrite=True)
    pyplot.close(figure)


# ---- compiling and timing

_compiled: dict = {}


def make_room(most: int = 30000) -> None:
    """Forget compiled programs if the process holds more than `most` memory maps (Linux).

    A program takes some 20 to 100, and where the system's 65,530 are used up, compiling fails for lack of memory.
    """
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > most:
        _compiled.clear()
        timing.forget()
        jax.clear_caches()


def _compile(function: Callable, arguments: tuple, host: bool) -> _Compiled:
    leaves, structure = jax.tree.flatten(arguments)
    key = (function, structure, tuple((np.shape(x), str(getattr(x, "dtype", type(x)))) for x in leaves))
    if key not in _compiled:
        start = time.perf_counter()
        if host:
            call, megabytes = function, _peak_megabytes(lambda: function(*arguments))
        else:
            call = jax.jit(function).lower(*arguments).compile()
            jax.block_until_ready(call(*arguments))
            memory = call.memory_analysis()
            megabytes = (memory.temp_size_in_bytes + memory.output_size_in_bytes) / 2**20
        _compiled[key] = _Compiled(call, time.perf_counter() - start, megabytes)
    return _compiled[key]


def _peak_megabytes(call: Callable) -> float:
    """How far the memory of the process grows during a call (Linux)."""
    status = Path("/proc/self/status")
    read = lambda name: int(status.read_text().split(f"{name}:")[1].split()[0]) / 2**10
    Path("/proc/self/clear_refs").write_text("5")  # sets the peak back to the present size
    before = read("VmRSS")
    jax.block_until_ready(call())
    return read("VmHWM") - before
