"""The README and the pages of docs/: their code is code and runs, links lead somewhere, and Sphinx builds them."""

import ast
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(p for p in DOCS.rglob("*.md") if "notebooks" not in p.parts)]
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)


def name(path):
    return path.relative_to(ROOT).as_posix()


def program(path):
    """All blocks of Python of a page, one after the other."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", path.read_text(), re.DOTALL | re.MULTILINE))


PROGRAMS = [path for path in PAGES if program(path)]  # the first is the README, which test_examples runs


def anchors(path):
    """Of a page's headings, as GitHub and Sphinx make them."""
    titles = re.findall(r"^#+ (.*)", FENCE.sub("", path.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def missing(path):
    """Links of a page to files that are not there, or to headings that are not in them."""
    text = re.sub(r"`[^`\n]+`", "", FENCE.sub("", path.read_text()))  # code has brackets too
    wrong = []
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", link):
            continue
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        if not target.exists() or (anchor and anchor not in anchors(target)):
            wrong.append(link)
    return wrong


@pytest.mark.parametrize("path", PROGRAMS, ids=name)
def test_code_is_python(path):
    ast.parse(program(path), name(path))


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_links_lead_somewhere(path):
    assert missing(path) == []


def test_a_link_that_leads_nowhere_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# One thing\n[a](page.md#one-thing) [b](#other) [c](none.md) ![d](none.png) [e](https://none.org)\n"
    )
    assert missing(page) == ["#other", "none.md", "none.png"]


def test_the_readme_is_one_page():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


def test_generated_tables_stand_between_markers():
    marks = re.findall(r"<!-- (/?table)(?::(\w+))? -->", (DOCS / "benchmarks.md").read_text())
    assert [kind for kind, _ in marks] == ["table", "/table"] * (len(marks) // 2)
    names = [name for kind, name in marks if kind == "table"]
    assert len(set(names)) == len(names) >= 16


@pytest.mark.slow
@pytest.mark.parametrize("path", PROGRAMS[1:], ids=name)
def test_code_runs(path, tmp_path):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", program(path)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_sphinx_builds_the_pages_without_a_warning(tmp_path):
    for package in ("sphinx", "myst_nb", "furo"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed: pip install shisd[docs]")
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "sphinx",
            "-q",
            "-W",
            "--keep-going",
            "-d",
            tmp_path / "doctrees",
            DOCS,
            tmp_path / "html",
        ],
        cwd=ROOT,
        env={**os.environ, "DOCS_FAST": "1"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    shading = (tmp_path / "html/api/shading.html").read_text()
    assert 'id="shisd.shading.shade"' in shading and "jaxlib" not in shading
