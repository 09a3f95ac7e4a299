"""What is given out: the wheel holds the package and runs by itself, also with the oldest versions that are allowed.

The slow tests need a network: each makes virtual environments of its own.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import shisd

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NO_NETWORK = re.compile("connection broken|connection error|name resolution|network is unreachable", re.IGNORECASE)

# Printed by first_steps.py with jax 0.10.2; jax 0.7.2 differs by 1e-7, or by 4e-7 of a number.
FIRST_STEPS = {
    "distant": [0.48728594, -0.03713518],
    "near": [0.03036916, 0.02133958],
    "gradient": 0.26917627,
    "integral": 0.17872725,
    "dering": 0.28154054,
    "visibility": [2.4774070, -0.11229625, 0.0, -1.2766467],
    "image": 76.962891,
}


def run(*command, cwd: Path) -> str:
    """What a program prints that sees nothing of this repository."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, env=environment, capture_output=True, text=True, timeout=900
    )
    if done.returncode != 0 and NO_NETWORK.search(done.stdout + done.stderr):
        pytest.skip(f"no network for {' '.join(map(str, command[1:4]))}")
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def fresh_python(folder: Path, *packages: str | Path) -> Path:
    """The interpreter of a new environment that has the packages alone."""
    venv.create(folder, with_pip=True)
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    run(python, "-m", "pip", "install", "--quiet", "--retries=2", "--only-binary=:all:", *packages, cwd=folder)
    return python


def first(specifiers: SpecifierSet) -> str:
    (bound,) = specifiers
    assert bound.operator == ">=", f"{bound} is not a lower bound"
    return bound.version


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path]:
    """The source distribution, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("built")
    run(fresh_python(folder / "builder", "build"), "-m", "build", ROOT, "--outdir", folder, cwd=folder)
    (source,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return source, wheel


def test_the_citation_agrees_with_the_project():
    cited = dict(re.findall(r"^([\w-]+): (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE))
    assert (cited["title"], cited["license"]) == (PROJECT["name"], PROJECT["license"])
    assert cited["version"] == shisd.__version__


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_nothing_else(built):
    source, wheel = built
    package = {path for path in (ROOT / "shisd").rglob("*") if path.is_file() and path.parent.name != "__pycache__"}
    names = {path.relative_to(ROOT).as_posix() for path in package}
    assert {"shisd/py.typed", "shisd/decomposition/data/optimized_directions.npz", "shisd/plotting.py"} <= names
    with zipfile.ZipFile(wheel) as files:
        (about,) = {name.split("/")[0] for name in files.namelist()} - {"shisd"}
        assert {name for name in files.namelist() if not name.startswith(about)} == names
        assert all(files.read(name) == (ROOT / name).read_bytes() for name in names)
        assert about == f"shisd-{shisd.__version__}.dist-info"
        assert f"{about}/licenses/LICENSE" in files.namelist()
        assert f"\nLicense-Expression: {PROJECT['license']}\n" in files.read(f"{about}/METADATA").decode()
    with tarfile.open(source) as files:
        held = {name.partition("/")[2] for name in files.getnames()}
    assert names | {"README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "pyproject.toml"} <= held


@pytest.mark.slow
def test_the_demo_runs_from_the_wheel(built, tmp_path):
    python = fresh_python(tmp_path / "user", f"{built[1]}[demo]")
    examples = shutil.copytree(ROOT / "examples", tmp_path / "examples")
    assert (tmp_path / "user") in Path(run(python, "-c", "import shisd; print(shisd.__file__)", cwd=tmp_path)).parents
    smallest = ["--size", 16, "--samples", 16, "--degrees", 2]
    printed = run(python, examples / "relight.py", "--output", "relight", *smallest, cwd=tmp_path)
    assert (tmp_path / "relight" / "relight.md").read_text() in printed
    assert (tmp_path / "relight" / "gallery.png").stat().st_size > 0


@pytest.mark.slow
@pytest.mark.skipif(
    first(SpecifierSet(PROJECT["requires-python"])) != f"{sys.version_info.major}.{sys.version_info.minor}",
    reason="the oldest packages go with the oldest Python",
)
def test_the_oldest_versions_allowed_give_the_same_numbers(built, tmp_path):
    extras = ["io", "plot", "mesh"]
    required = PROJECT["dependencies"] + [line for extra in extras for line in PROJECT["optional-dependencies"][extra]]
    oldest = [f"{package.name}=={first(package.specifier)}" for package in map(Requirement, required)]
    python = fresh_python(tmp_path / "oldest", f"{built[1]}[{','.join(extras)}]", *oldest)
    numbers = json.loads(run(python, shutil.copy(ROOT / "tests" / "first_steps.py", tmp_path), tmp_path, cwd=tmp_path))
    assert numbers.keys() == FIRST_STEPS.keys()
    for name, value in FIRST_STEPS.items():
        np.testing.assert_allclose(numbers[name], value, rtol=1e-6, atol=5e-7, err_msg=name)
