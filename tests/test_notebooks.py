"""Every notebook runs from first cell to last, leaves no file, is stored without outputs, and its TeX is TeX."""

import json
import re
from pathlib import Path

import jax
import matplotlib
import pytest
from matplotlib.mathtext import MathTextParser

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def cells(path, kind="code"):
    return [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == kind]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path, monkeypatch, as_user):
    matplotlib.use("Agg")
    from matplotlib import pyplot

    monkeypatch.chdir(path.parent)
    variables, files = {"__name__": "__main__"}, sorted(path.parent.iterdir())
    try:
        for number, cell in enumerate(cells(path), 1):
            with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):  # as readers have them
                exec(compile("".join(cell["source"]), f"{path.name}, code cell {number}", "exec"), variables)
            for figure in map(pyplot.figure, pyplot.get_fignums()):
                figure.canvas.draw()  # mistakes in text and layout appear only here
            pyplot.close("all")
    finally:
        pyplot.close("all")
    assert sorted(path.parent.iterdir()) == files


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_is_stored_without_outputs(path):
    for cell in cells(path):
        assert cell["outputs"] == [] and cell["execution_count"] is None, "clear the outputs before committing"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_its_formulas_are_tex(path):
    parser = MathTextParser("path")
    for cell in cells(path, "markdown"):
        for formula in re.findall(r"\$[^$]+\$", "".join(cell["source"])):
            assert "\\\\" not in formula, f"doubled backslash in {formula}"
            parser.parse(formula.replace("\n", " "))  # an error names what it cannot read


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 2
