"""Shade the same pixels on one device, on several simulated ones and on several processes, and compare.

Pixels with random normals and views, one copper material, the light of a photographed room: radiance, and the gradient
of a loss in the light's coefficients and in every normal. All runs must agree with one device, or the program ends with
an error. Then every device gets as many pixels as one had alone, and the table says what that costs (weak scaling).

    python examples/many_devices.py --output output/many_devices
    python examples/many_devices.py --sizes

`docs/guides/many_devices.md` explains what to write, and what limits it at thousands of devices.
"""

import argparse
import functools
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import _scene
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from shisd import models, shading

CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
TOLERANCE = {"radiance": 1e-6, "light": 1e-5, "normals": 1e-5}  # rounding, relative to the largest
REPEATS = 5


def tabulate(degree: int) -> shading.Slices:
    copper = models.CookTorrance(roughness=0.45, metallic=1.0, albedo=np.array([0.95, 0.64, 0.54]))
    return shading.tabulate_brdf(copper, degree)


def make_scene(path: Path, degree: int, pixels: int) -> None:
    light = models.Environment.load(_scene.DATA / "interior.hdr").coefficients(degree)
    rng = np.random.default_rng(0)
    normals, views = (_scene.unit(rng.normal(size=(pixels, 3))) for _ in range(2))
    views *= np.sign(np.sum(normals * views, axis=1, keepdims=True))
    slices = np.asarray(tabulate(degree).coefficients)
    np.savez(path, light=light, slices=slices, normals=normals.astype(np.float32), views=views.astype(np.float32))


def radiance(material, light, normals, views):
    return shading.shade(material, models.DistantLight(light), shading.Surface(normals, views))


def loss(light, normals, material, views):
    return jnp.sum(radiance(material, light, normals, views) ** 2)


def worker(folder: Path, process: int) -> None:
    """One process of a run: shades its devices' pixels, and stores them and the times."""
    job = json.loads((folder / "job.json").read_text())
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, job["cores"][process])
    jax.config.update("jax_num_cpu_devices", job["devices"])
    if job["processes"] > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"localhost:{job['port']}", job["processes"], process)

    scene = np.load(folder.parent / "scene.npz")
    material, light = shading.Slices(scene["slices"]), jnp.asarray(scene["light"])

    mesh = jax.make_mesh((len(jax.devices()),), ("points",), axis_types=(AxisType.Explicit,))
    sharding = NamedSharding(mesh, PartitionSpec("points"))

    def shard(name: str, count: int) -> jax.Array:  # each process hands over the pixels of its own devices
        return jax.make_array_from_callback((count, 3), sharding, lambda index: scene[name][:count][index])

    @functools.cache
    def results(count: int):
        normals, views = shard("normals", count), shard("views", count)
        forward = jax.jit(radiance).lower(material, light, normals, views).compile()
        backward = jax.jit(jax.grad(loss, (0, 1))).lower(light, normals, material, views).compile()
        return lambda: forward(material, light, normals, views), lambda: backward(light, normals, material, views)

    start = time.perf_counter()
    forward, backward = results(len(scene["normals"]))
    compiling = time.perf_counter() - start
    values = {"radiance": forward(), **dict(zip(("light", "normals"), backward(), strict=True))}
    for name, array in values.items():
        for part in array.addressable_shards:
            if part.replica_id == 0:
                np.save(folder / f"{name}_{part.index[0].start or 0:09d}.npy", np.asarray(part.data))

    times = {"compile s": compiling}
    for name, run in zip(("forward", "gradient"), results(job["pixels"] * len(jax.devices())), strict=True):
        jax.block_until_ready(run())
        laps = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            jax.block_until_ready(run())
            laps.append(time.perf_counter() - start)
        times[name] = min(laps)
    (folder / f"times_{process}.json").write_text(json.dumps(times))


def launch(folder: Path, processes: int, devices: int, cores: list[list[int]], pixels: int) -> tuple[dict, dict]:
    """Results and times of `processes` processes of `devices` devices each, run by this program itself."""
    folder.mkdir()
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    job = {"processes": processes, "devices": devices, "cores": cores, "pixels": pixels, "port": port}
    (folder / "job.json").write_text(json.dumps(job))
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    logs = [(folder / f"log_{i}.txt").open("w") for i in range(processes)]
    command = [sys.executable, __file__, "--worker", str(folder)]
    started = [
        subprocess.Popen([*command, str(i)], env=environment, stdout=log, stderr=log) for i, log in enumerate(logs)
    ]
    try:
        while any(p.poll() is None for p in started) and not any(p.poll() for p in started):
            time.sleep(0.05)
        failed = [i for i, p in enumerate(started) if p.poll()]
    finally:
        for p in started:  # one that failed would leave the others waiting for it
            p.kill()
            p.wait()
        for log in logs:
            log.close()
    if failed:
        raise SystemExit(f"Process {failed[0]} of {processes} failed:\n{(folder / f'log_{failed[0]}.txt').read_text()}")
    parts = {name: sorted(folder.glob(f"{name}_*.npy")) for name in TOLERANCE}
    values = {name: np.concatenate([np.load(path) for path in paths]) for name, paths in parts.items()}
    times = [json.loads((folder / f"times_{i}.json").read_text()) for i in range(processes)]
    return values, {name: max(t[name] for t in times) for name in times[0]}


def run(degree: int, pixels: int, devices: list[int], processes: int) -> list[dict]:
    one = CORES[:1]
    runs = {"1 process, 1 core": (1, 1, [one])}
    if len(CORES) >= processes:
        runs[f"{processes} processes, 1 core each"] = (processes, 1, [[core] for core in CORES[:processes]])
    else:
        runs[f"{processes} processes, sharing {len(CORES)} cores"] = (processes, 1, [CORES] * processes)
    for count in devices:
        runs[f"1 process, {count} simulated devices, {len(CORES)} cores"] = (1, count, [CORES])
    rows, first = [], {}
    with tempfile.TemporaryDirectory() as folder:
        most = max(processes, *devices)
        make_scene(Path(folder) / "scene.npz", degree, pixels * most)
        for i, (name, (count, each, cores)) in enumerate(_scene.progress(runs.items(), "runs", len(runs))):
            values, times = launch(Path(folder) / f"run_{i}", count, each, cores, pixels)
            first = first or {"values": values, **times}
            row = {"run": name, "devices": count * each, "pixels": pixels * count * each}
            row["bound"] = min(1.0, len(set(sum(cores, []))) / (count * each))
            for kind in ("forward", "gradient"):
                row[kind], row[f"{kind} efficiency"] = times[kind], first[kind] / times[kind]
            for kind, exact in first["values"].items():
                row[f"{kind} difference"] = float(np.max(np.abs(values[kind] - exact)) / np.max(np.abs(exact)))
            row["compile s"] = times["compile s"]
            rows.append(row)
    return rows


def percent(fraction: float) -> str:
    return f"{100 * fraction:.0f} %"


def table(rows: list[dict], degree: int, pixels: int) -> str:
    lines = [
        "| run | devices | pixels | forward ms | efficiency | gradient ms | efficiency | at best "
        "| difference: radiance | light's gradient | normals' gradient |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        times = (x for k in ("forward", "gradient") for x in (f"{1e3 * r[k]:.3g}", percent(r[f"{k} efficiency"])))
        differences = (f"{r[f'{name} difference']:.1g}" for name in TOLERANCE)
        cells = r["run"], r["devices"], r["pixels"], *times, percent(r["bound"]), *differences
        lines.append(f"| {' | '.join(map(str, cells))} |")
    lines += [
        "",
        f"Degree {degree}, RGB, float32; {pixels} pixels per device. Efficiency: the time of one device on one core",
        f"over that of the run; `at best`: cores over devices. Best of {REPEATS}; the slowest process counts.",
        "Differences to one device, over the largest value, for one batch that all runs share. The devices of one",
        "process are simulated: they share its threads.",
        f"{len(CORES)} cores, jax {jax.__version__}, CPU; gloo between processes.",
    ]
    return "\n".join(lines)


def sizes() -> str:
    """What every device holds and what a step of a fit sends, from the shapes of what the package makes."""
    lines = [
        "| degree | slices of a material | its look-up table | light | all-reduce, light | light and material |",
        "|---|---|---|---|---|---|",
    ]
    show = lambda count: f"{count / 1000:.3g} kB" if count < 1e6 else f"{count / 1e6:.3g} MB"
    for degree in (8, 16, 30):
        coefficients = eqx.filter_eval_shape(tabulate, degree).coefficients
        slices, light = 4 * coefficients.size, 4 * 3 * (degree + 1) ** 2  # float32
        look_up = light * (coefficients.shape[-2] + 4)  # splines over the views have 4 more coefficients
        cells = slices, look_up, light, light, light + slices
        lines.append(f"| {degree} | {' | '.join(map(show, cells))} |")
    return "\n".join(lines)


def check(rows: list[dict]) -> None:
    for row in rows:
        for name, tolerance in TOLERANCE.items():
            difference = row[f"{name} difference"]
            if not difference <= tolerance:
                raise SystemExit(f"{row['run']}: {name} differs by {difference:.2g} from one device")


def main(arguments: list[str] | None = None) -> None:
    parser = _scene.output_parser(__doc__, "many_devices")
    parser.add_argument("--degree", type=int, default=16)
    parser.add_argument("--pixels", type=int, default=16384, help="pixels of each device")
    parser.add_argument("--devices", type=int, nargs="+", default=[2, 4], help="simulated devices of one process")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--sizes", action="store_true", help="only print what is copied and sent, and end")
    parser.add_argument("--worker", nargs=2, metavar=("FOLDER", "PROCESS"), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.worker:
        return worker(Path(options.worker[0]), int(options.worker[1]))
    if options.sizes:
        return print(sizes())
    if min(options.pixels, options.processes, *options.devices) < 1:
        parser.error("--pixels, --devices and --processes must be at least 1.")
    counts = {1, options.processes, *options.devices}
    if any(max(counts) % count for count in counts):
        parser.error(f"the largest number of devices must be divisible by all: {sorted(counts)}.")
    _scene.prepare_output(options.output, options.overwrite, "many_devices", parser)
    start = time.perf_counter()
    rows = run(options.degree, options.pixels, options.devices, options.processes)
    text = table(rows, options.degree, options.pixels)
    _scene.save(options.output / "many_devices.md", text + "\n")
    print(text)
    check(rows)
    worst = max(row[f"{name} difference"] for row in rows for name in TOLERANCE)
    reached = f"Radiance and gradients of all {len(rows)} runs agree with one device to {worst:.1g}"
    _scene.verdict(reached, start, options.output)


if __name__ == "__main__":
    main()
