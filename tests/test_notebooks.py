"""Every notebook runs from its first cell to its last, and is stored without outputs."""

import json
from pathlib import Path

import jax
import matplotlib
import pytest

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def cells(path):
    return [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path, monkeypatch, as_user):
    matplotlib.use("Agg")
    from matplotlib import pyplot

    monkeypatch.chdir(path.parent)
    variables = {"__name__": "__main__"}
    try:
        for number, cell in enumerate(cells(path), 1):
            with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # as readers have them
                exec(compile("".join(cell["source"]), f"{path.name}, code cell {number}", "exec"), variables)
            for figure in map(pyplot.figure, pyplot.get_fignums()):
                figure.canvas.draw()  # mistakes in text and layout appear only here
            pyplot.close("all")
    finally:
        pyplot.close("all")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_is_stored_without_outputs(path):
    for cell in cells(path):
        assert cell["outputs"] == [] and cell["execution_count"] is None, "clear the outputs before committing"


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 2
