"""Every mutant of `tests/mutants/` is caught by the test that it names.

The package and its tests are copied once. Each mutant is written into the copy, its test runs there in a process of its
own, and the file is put back. These processes are forks of one that has imported what takes long and none of the
package. The test has to fail: an error while it is collected, a crash, or a run without end catches nothing.
"""

import importlib
import multiprocessing
import os
import pkgutil
import shutil
import sys
from pathlib import Path

import pytest

from tests import mutants

ROOT = Path(__file__).resolve().parent.parent
COPIED = ["shisd", "tests", "examples", "pyproject.toml", "README.md"]
SHARED = ["jax", "equinox", "optimistix", "jaxtyping", "beartype", "scipy.special", "pytest"]  # imported once
LONGEST = 300.0  # s
ENDED = 10  # added to pytest's exit status: a process that breaks before pytest ends has another one

AREAS = [importlib.import_module(f"tests.mutants.{found.name}") for found in pkgutil.iter_modules(mutants.__path__)]
MUTANTS = [mutant for area in AREAS for mutant in area.MUTANTS]


def run(folder: Path, test: str, report: Path) -> None:
    """Runs one test of the copy in this process, which ends with pytest's exit status."""
    for name in [name for name in sys.modules if name.split(".")[0] in ("shisd", "tests")]:
        del sys.modules[name]
    sys.path.insert(0, str(folder))
    sys.dont_write_bytecode = False
    os.chdir(folder)
    with report.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    import jax

    jax.config.update("jax_disable_most_optimizations", True)
    jax.config.update("jax_compilation_cache_dir", str(folder / "compiled"))  # most of a test is as without the mutant
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    os._exit(ENDED + pytest.main(["-x", "-q", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:xdist", test]))


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The folder with the copy, and what starts processes."""
    folder = tmp_path_factory.mktemp("mutants")
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name)
        else:
            shutil.copy2(ROOT / name, folder)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(SHARED)
    return folder, context


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(MUTANTS)), ids=lambda n: MUTANTS[n].name)
def test_a_mutant_is_caught(number, copy):
    folder, context = copy
    mutant = MUTANTS[number]
    path, report = folder / mutant.path, folder / "report"
    before = path.read_text()
    assert before.count(mutant.old) == 1, f"{mutant.path} has to hold {mutant.old!r} once"
    path.write_text(before.replace(mutant.old, mutant.new))
    os.utime(path, (number, number))  # s; a time of its own, by which Python knows that what it compiled is older
    try:
        process = context.Process(target=run, args=(folder, mutant.test, report))
        process.start()
        process.join(LONGEST)
        process.kill()
        process.join()
    finally:
        shutil.copy2(ROOT / mutant.path, path)
    end = "\n".join(report.read_text().splitlines()[-15:])
    failed = process.exitcode == ENDED + pytest.ExitCode.TESTS_FAILED
    assert failed, f"{mutant.test} ended with {process.exitcode} where it should fail:\n{end}"


def test_mutants_have_names_of_their_own_and_change_what_is_there():
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)
    for mutant in MUTANTS:
        assert mutant.old != mutant.new
        assert (ROOT / mutant.path).read_text().count(mutant.old) == 1, f"{mutant.path} has to hold {mutant.old!r} once"
        assert (ROOT / mutant.test.split("::")[0]).exists(), mutant.test
