"""Damaged files: refused by name, or read as something finite, in bounded time and memory."""

import collections
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def outcomes(kind, folder, count):
    """How the reading of `count` files of a kind ended, each in one word or an account of what is wrong."""
    log, ends = folder / f"{kind}.log", []
    log.touch()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    while len(ends) < count:
        command = [sys.executable, "-m", "tests.fuzz", kind, str(folder), str(len(ends)), str(count - len(ends))]
        with (folder / f"{kind}.txt").open("w") as output:
            done = subprocess.run(command, cwd=ROOT, env=environment, stdout=output, stderr=output)
        lines = log.read_text().splitlines()
        assert lines and int(lines[-2 + len(lines) % 2]) >= len(ends), (folder / f"{kind}.txt").read_text()[-2000:]
        if done.returncode != 0:
            log.write_text("\n".join([*lines, f"PROCESS ENDED BY {done.returncode}"]) + "\n")
        ends = log.read_text().splitlines()[1::2]
    return ends


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "count"), [("radiance", 4000), ("exr", 3500), ("visibility", 1500), ("merl", 1500)])
def test_damaged_files_do_no_harm(kind, count, tmp_path):
    ends = outcomes(kind, tmp_path, count)
    counts = dict(collections.Counter(ends))
    print(f"{kind}: {counts}")
    assert len(ends) == count
    assert counts.keys() <= {"same", "another", "warned", "refused"}, counts
    assert counts["refused"] > count / 5 and counts.keys() & {"same", "another"}
