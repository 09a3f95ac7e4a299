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


@pytest.mark.slow
def test_relight_writes_pictures_and_a_table(tmp_path):
    output = tmp_path / "relight"
    command = [ROOT / "examples/relight.py", "--output", output]
    small = ["--size", 32, "--samples", 512, "--degrees", 4, 12]
    done = python(*command, *small)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Errors fall with degree" in done.stdout
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
    assert done.returncode == 0, done.stdout + done.stderr
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
