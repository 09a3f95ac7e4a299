"""The examples run as a user runs them, in a process of their own, without the settings of the tests."""

import csv
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def python(*arguments, cwd=ROOT):
    environment = {**os.environ, "PYTHONWARNINGS": "default", "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=cwd, env=environment, capture_output=True, text=True, timeout=1200
    )


def verdict(done, output):
    """The last line: the name of what was reached, its number, the seconds, and where to look."""
    assert done.returncode == 0, done.stdout + done.stderr
    last = done.stdout.splitlines()[-1]
    assert re.fullmatch(rf"[A-Z][a-z]+ .*(within|agree) .*\d.*, in [\d.]+ s; see {re.escape(str(output))}/\.", last), (
        last
    )
    return last


def test_a_mesh_of_any_unit_fills_the_picture(tmp_path, monkeypatch):
    """In its own unit, and in one a thousand times smaller, far from the origin."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import _scene

    shape = trimesh.load_mesh(_scene.DATA / "bunny.ply")
    shape.apply_scale(1e3)
    shape.apply_translation([5e3, -2e3, 7e3])
    shape.export(tmp_path / "large.ply")
    views = [_scene.mesh(path, 48, _scene.AZIMUTH) for path in (_scene.DATA / "bunny.ply", tmp_path / "large.ply")]
    differ = sum(views[0].seen.ravel() != views[1].seen.ravel())
    assert differ < 0.01 * views[0].seen.sum()
    for view in views:
        assert max(x.max() for x in abs(view.positions)) < 1
        extents = [index.max() - index.min() for index in view.seen.nonzero()]
        assert max(extents) > 0.7 * 48
        assert not (view.seen[0].any() or view.seen[-1].any() or view.seen[:, 0].any() or view.seen[:, -1].any())


@pytest.mark.slow
def test_relight_writes_pictures_and_a_table(tmp_path):
    output = tmp_path / "relight"
    command = [ROOT / "examples/relight.py", "--output", output]
    small = ["--size", 32, "--samples", 512, "--degrees", 4, 12]
    done = python(*command, *small)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Errors fall with degree" in done.stdout
    assert verdict(done, output).startswith("Radiance within")
    with (output / "relight.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * 2 * 2
    assert all(0 < float(row["sphere error"]) < 2 for row in rows)
    assert (output / "relight.md").read_text() in done.stdout
    pictures = sorted(path.name for path in output.glob("*.png"))
    assert "rabbit_interior.png" in pictures and "sphere_studio_copper_degree12.png" in pictures
    assert len(pictures) == 2 * 2 * (4 * 2 + 1) + 1

    before = {path.name: path.stat().st_mtime_ns for path in output.iterdir()}
    refused = python(*command, *small)
    assert refused.returncode != 0 and "exists" in refused.stderr
    assert before == {path.name: path.stat().st_mtime_ns for path in output.iterdir()}


def test_relight_leaves_foreign_folders_alone(tmp_path):
    (tmp_path / "letter.txt").write_text("keep me")
    refused = python(ROOT / "examples/relight.py", "--output", tmp_path, "--overwrite")
    assert refused.returncode != 0 and "left alone" in refused.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


@pytest.mark.slow
def test_area_lights_writes_pictures_and_a_table(tmp_path):
    output = tmp_path / "area_lights"
    command = [ROOT / "examples/area_lights.py", "--output", output, "--size", 24, "--nodes", 12]
    done = python(*command)
    assert verdict(done, output).startswith("Radiance within")
    assert (output / "area_lights.md").read_text() in done.stdout
    assert {path.stem for path in output.glob("*.png")} == {
        "area_lights",
        "square",
        "triangle",
        "star",
        "window",
        "all",
    }
    refused = python(*command)
    assert refused.returncode != 0 and "exists" in refused.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, options",
    [
        ("visibility", ["--size", 40, "--samples", 256, "--rays", 512]),
        ("mirror", ["--size", 32]),
        ("denoise", ["--size", 32]),
    ],
)
def test_applications_write_a_picture_and_a_table(name, options, tmp_path):
    output = tmp_path / name
    command = [ROOT / f"examples/{name}.py", "--output", output]
    done = python(*command, *options)
    verdict(done, output)
    assert (output / f"{name}.md").read_text() in done.stdout
    assert [path.name for path in output.glob("*.png")] == [f"{name}.png"]
    refused = python(*command)
    assert refused.returncode != 0 and "exists" in refused.stderr


@pytest.mark.slow
def test_many_devices_agree_with_one(tmp_path):
    """Simulated devices, and two processes that are started by the example."""
    output = tmp_path / "many_devices"
    command = [ROOT / "examples/many_devices.py", "--output", output]
    done = python(*command, "--degree", 4, "--pixels", 512, "--devices", 2)
    assert verdict(done, output).startswith("Radiance and gradients")
    assert (output / "many_devices.md").read_text() in done.stdout and "agree with one device" in done.stdout
    assert "2 processes" in done.stdout and "2 simulated devices" in done.stdout
    refused = python(*command)
    assert refused.returncode != 0 and "exists" in refused.stderr
    refused = python(*command[:1], "--devices", 2, 3)
    assert refused.returncode != 0 and "divisible" in refused.stderr


def fitted(output):
    with next(output.glob("*.csv")).open() as file:
        return {row["parameter"]: row for row in csv.DictReader(file)}


@pytest.mark.slow
def test_fit_material_finds_the_material(tmp_path):
    output = tmp_path / "fit_material"
    command = [ROOT / "examples/fit_material.py", "--output", output]
    done = python(*command, "--size", 48, "--degree", 16, "--noisy", 1)
    assert verdict(done, output).startswith("Material within")
    assert (output / "fit_material.md").read_text() in done.stdout and (output / "fit_material.png").exists()
    rows = fitted(output)
    assert {"roughness", "anisotropy", "albedo, blue", "specular"} < set(rows)
    for row in rows.values():
        assert abs(float(row["found"]) / float(row["truth"]) - 1) < 0.02, row
        assert float(row["noisy 0"]) < 2, row
    assert re.search(r"takes [\d.]+ times the forward pass", done.stdout)
    refused = python(*command)
    assert refused.returncode != 0 and "exists" in refused.stderr


@pytest.mark.slow
def test_fit_light_finds_the_lamp(tmp_path):
    output = tmp_path / "fit_light"
    done = python(ROOT / "examples/fit_light.py", "--output", output, "--size", 24, "--noisy", 0)
    assert verdict(done, output).startswith("Lamp within")
    assert (output / "fit_light.md").read_text() in done.stdout and (output / "fit_light.png").exists()
    rows = fitted(output)
    move = [float(rows[axis]["found"]) - float(rows[axis]["truth"]) for axis in "xyz"]
    assert sum(x * x for x in move) ** 0.5 < 0.01 * float(rows["distance"]["truth"]), rows
    for name in ("lamp, red", "lamp, blue", "sky, red", "sky, blue"):
        assert float(rows[name]["error %"]) < 2, rows[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["material", "light"])
def test_the_stored_pictures_are_those_of_mitsuba(name):
    """Rendered again, small and with few samples: the same within its noise, also in the mean, which has less."""
    pytest.importorskip("mitsuba")
    code = f"""
import numpy as np
from tests.bench.make_pictures import DATA, render
picture, noise = render({name!r}, 24, 256, 8)
stored = np.load(DATA / "{name}.npz")["picture"].astype(float).reshape(24, 4, 24, 4, 3).mean(axis=(1, 3))
rms = np.sqrt(np.mean(stored**2))
print(np.sqrt(np.mean((picture - stored) ** 2)) / rms, noise, abs(np.mean(picture) / np.mean(stored) - 1))
"""
    done = python("-c", code)
    assert done.returncode == 0, done.stderr
    difference, noise, mean = map(float, done.stdout.split())
    assert noise < 0.01 and 0.5 * noise < difference < 1.5 * noise, (difference, noise)
    assert mean < 5 * noise / 24, (mean, noise)


def test_pictures_are_not_overwritten(tmp_path):
    (tmp_path / "light.npz").write_bytes(b"keep me")
    refused = python("-m", "tests.bench.make_pictures", tmp_path, "--only", "light")
    assert refused.returncode != 0 and "exists" in refused.stderr
    assert (tmp_path / "light.npz").read_bytes() == b"keep me"


@pytest.mark.slow
def test_the_code_of_the_readme_runs():
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert blocks
    code = "\n".join(blocks) + "\nassert radiance.shape == (2, 3) and float(radiance.min()) > 0\n"
    done = python("-c", code)
    assert done.returncode == 0, done.stderr


def test_the_data_of_the_examples_is_small_and_licensed():
    data = ROOT / "examples" / "data"
    assert sum(path.stat().st_size for path in data.iterdir()) < 2e6
    about = (data / "README.md").read_text()
    for path in data.iterdir():
        assert path.name == "README.md" or f"`{path.name}`" in about
