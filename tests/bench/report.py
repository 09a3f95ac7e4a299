"""Speed against error, every method on the same inputs: python -m tests.bench.report [--quick] [--pages].

Writes DIR/report.json with every row, DIR/report.md with tables, and a figure for each group of tasks to DIR/figures;
--pages also puts both into docs/, the short tables between the markers of docs/benchmarks.md, some rows into README.md,
and an entry at the end of docs/history.json. `make report` sets the allocator.
"""

import argparse
import inspect
import json
import os
import time
from pathlib import Path

import jax
import numpy as np

from shisd.io.internal import write_atomically
from tests.bench import (
    applications,
    environments,
    harness,
    history,
    local_lights,
    planned,
    renderers,
    roofline,
    spherical,
)
from tests.bench.run import DOCS, README, paste, table

GROUPS = {  # name: (title, tasks)
    "environments": ("A sphere under a map", environments.tasks),
    "local_lights": ("Polygon lights, windows and projected lights", local_lights.tasks),
    "spherical": ("Spherical harmonics", spherical.tasks),
    "renderers": ("Whole pictures", renderers.tasks),
}
TABLES = {"roofline": roofline.tables, "applications": applications.tables}
HEADLINES = {  # of README: (task, family) of the tables to what they are called there
    ("GGX 0.5, interior", "Monte Carlo, MIS"): (
        "GGX 0.5 under a room", "Monte Carlo with multiple importance sampling"
    ),
    ("GGX 0.25, studio", "SH rotation of the light"): ("GGX 0.25 under a studio", "SH rotation of the light"),
    ("GGX 0.25, sun", "point lights"): ("GGX 0.25 under a sun", "point lights"),
    ("GGX 0.1, interior", "spherical Gaussians"): ("GGX 0.1 under a room", "spherical Gaussians"),
    ("GGX 0.3 sphere under a map", "Mitsuba 3 scalar_rgb"): ("a sphere of GGX 0.3 under a map", "Mitsuba 3, scalar"),
    ("GGX 0.5, floor below a panel", "Gauss points"): (
        "GGX 0.5, floor below a panel", "Gauss points, written for the scene"
    ),
    ("GGX 0.1, floor below a panel", "linearly transformed cosines"): (
        "GGX 0.1, floor below a panel", "linearly transformed cosines"
    ),
    ("A quad on harmonics of degree 30", "Monte Carlo, solid angle"): (
        "a quad on harmonics of degree 30", "Monte Carlo over its solid angle"
    ),
    ("Basis, degree 8", "sphericart"): ("basis of degree 8", "sphericart (C++)"),
    ("1,000 rotations of an RGB expansion, degree 8", "e3nn-jax"): (
        "1,000 rotations of an RGB expansion, degree 8", "e3nn-jax"
    ),
}  # fmt: skip
PLANNED = ("environments", "local_lights")  # groups whose pixels are planned for
AHEAD = """Where others are ahead at equal error: the time of the cheapest other whose error is at most that of the
column, over the time of our cheapest, then over that of the cheapest plan (`planning.plan`); in brackets the other.
Errors are those measured. Below 1, bold, it is ahead; "-": none of ours, or no plan, is as near; "ours only": none of
the others is; "-" alone: nothing is."""
APART = ("applications",)  # only when named: `make applications`, and with a file of its own


def summary(panels: dict[str, list[dict]], item: str) -> list[dict]:
    """A row for every method: medians of its times over the tasks, then its error in each."""
    methods = dict.fromkeys((r["family"], r["setting"]) for rows in panels.values() for r in rows)
    lines = []
    for family, setting in methods:
        own = {
            title: r for title, rows in panels.items() for r in rows if (r["family"], r["setting"]) == (family, setting)
        }
        middle = lambda key, own=own: (
            float(np.median(x)) if (x := [r[key] for r in own.values() if r[key] is not None]) else None
        )
        lines.append({
            "method": f"{family}, {setting}",
            f"us/{item}": middle(f"us/{item}"),
            "with gradient": middle("with gradient"),
            "first call s": middle("first call s"),
            "setup s": middle("setup s"),
            "MB": middle("MB"),
            **{title: own[title]["relative RMSE"] if title in own else None for title in panels},
        })  # fmt: skip
    return lines


def leads(panels: dict[str, list[dict]], item: str) -> list[dict]:
    """For every task and family, the least ratio of its time to ours at its error, below 10 %; below 1 it is ahead."""
    lines = []
    for title, rows in panels.items():
        line = {"task": title}
        for row in harness.lead(rows, item):
            ratio = row["time / ours, least"]
            line[row["family"]] = "-" if ratio is None else f"{ratio:.2g} at {row['its error']:.1g}"
        lines.append(line)
    return lines


def ahead(panels: dict[str, list[dict]], item: str) -> list[dict]:
    """A row for every task, a column for every level of error: see `harness.at_levels`."""
    return [{"task": title, **harness.at_levels(rows, item, planned.FAMILY)} for title, rows in panels.items()]


def headlines(found: dict[tuple[str, str], str]) -> list[dict]:
    """README's rows, from cells "ratio at error" by task and family; below 1 the other is ahead, and bold."""
    lines = []
    for key, (task, beside) in HEADLINES.items():
        ratio, error = found.get(key, "- at -").split(" at ")
        bold = f"**{ratio}**" if ratio != "-" and float(ratio) < 1 else ratio
        lines.append({"task": task, "beside": beside, "its time / ours": bold, "at relative error": error})
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("output/report"))
    parser.add_argument("--quick", action="store_true", help="few tasks and settings: a check, in two minutes")
    parser.add_argument("--only", choices=[*GROUPS, *TABLES], action="append")
    parser.add_argument("--pages", action="store_true", help="put tables and figures into docs/")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    wanted = arguments.only or [name for name in (*GROUPS, *TABLES) if name not in APART]
    allocator = "tuned" if os.environ.get("MALLOC_MMAP_MAX_") == "0" else "default"
    note = f"{os.cpu_count()} cores, jax {jax.__version__}, default XLA flags, {allocator} allocator."
    whole = note + " Few tasks and settings." if arguments.quick else note
    results, sections, start = {"machine": whole, "rows": []}, {}, time.perf_counter()

    def keep(name: str, short: str, long: str) -> None:
        sections[name] = short, long
        print(f"{long}\n\n[{time.perf_counter() - start:.0f} s]\n", flush=True)

    cells: dict[tuple[str, str], str] = {}
    folders = [arguments.output, *([DOCS] if arguments.pages else [])]
    for folder in folders:
        (folder / "figures").mkdir(parents=True, exist_ok=True)
    for name, (title, make) in GROUPS.items():
        if name not in wanted:
            continue
        panels: dict[str, dict[str, list[dict]]] = {}
        for task in make(arguments.quick):
            harness.make_room()
            rows = harness.run(task, seconds=0.05 if arguments.quick else 0.1)
            panels.setdefault(task.item, {})[task.title] = rows
            results["rows"] += rows
            print(f"{task.title}: {len(rows)} methods, {time.perf_counter() - start:.0f} s", flush=True)
        if not panels:
            continue
        short, long = [], [f"## {title}"]
        for item, of_item in panels.items():
            file = f"{name}.png" if len(panels) == 1 else f"{name}_{item}.png"
            for folder in folders:
                harness.draw(of_item, item, folder / "figures" / file)
            lead = "Time over ours at equal error, where that is least, and that error; errors from 10 % to our least."
            shown = f"![{title}: relative error against us per {item}](figures/{file})\n\n{lead}"
            led = leads(of_item, item)
            cells |= {(line["task"], family): cell for line in led for family, cell in line.items() if " at " in cell}
            both = [shown, table(led)]
            if name in PLANNED and item == "pixel":
                both += [AHEAD, table(ahead(of_item, item))]
            short, long = [*short, *both], [*long, *both]
            long.append("Every method: medians of its costs, and its relative RMSE in each task.")
            long.append(table(summary(of_item, item)))
        if name == "renderers":
            equal = [line for rows in panels["pixel"].values() for line in renderers.equal_error(rows)]
            for line in equal[::-1]:  # the first of a picture stays
                cell = f"{line['time / ours']:.2g} at {line['relative RMSE']:.1g}"
                cells[line["picture"], line["renderer"]] = cell
            short = [f"{inspect.cleandoc(renderers.__doc__ or '')}", table(equal)]
            long += ["What the renderer takes for our error:", table(equal)]
        notes = {"spherical": spherical.notes, "renderers": renderers.notes}.get(name, list)()
        keep(name, "\n\n".join([*short, *notes, note]), "\n\n".join([*long, *notes]))
    for name, make in TABLES.items():
        if name in wanted and (made := make(arguments.quick)):
            results[name] = made
            text = "\n\n".join(f"{title}\n\n{table(rows)}" for title, rows in made.items())
            short = f"{applications.NOTE}\n\n{table(applications.summary(made))}" if name in APART else text
            keep(name, f"{short}\n\n{note}", text)
    report = "\n\n".join(["# Speed against error", note, *(long for _, long in sections.values())]) + "\n"
    write_atomically(arguments.output / "report.json", json.dumps(results, indent=1), overwrite=True)
    for folder in folders[:1] if arguments.only else folders:  # a part does not replace the whole
        write_atomically(folder / "report.md", report, overwrite=True)
    for name, (short, long) in sections.items() if arguments.pages else ():
        if name in APART:
            text = f"# {name.capitalize()}\n\n{note}\n\n{long}\n"
            write_atomically(DOCS / f"{name}.md", text, overwrite=True)
        if f"<!-- table:{name} -->" in (DOCS / "benchmarks.md").read_text():
            paste(name, short)
    if arguments.pages and not (arguments.only or arguments.quick):
        paste("headlines", table(headlines(cells)), README)
        history.remember(results)
    print(f"{arguments.output}/report.md and report.json: {time.perf_counter() - start:.0f} s in all")


if __name__ == "__main__":
    main()
