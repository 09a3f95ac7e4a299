"""Benchmarks and examples name what is in the package: they run too seldom to find out otherwise."""

import ast
import pkgutil
from pathlib import Path

import pytest

from tests.test_layering import imported, read

ROOT = Path(__file__).resolve().parents[2]
FILES = [*sorted((ROOT / "tests" / "bench").glob("*.py")), *sorted((ROOT / "examples").glob("*.py"))]


def wrong(source: str) -> list[str]:
    """Names of the package that a file imports, or reads off what it imports, and that are not there."""
    tree = ast.parse(source)
    bound = {word: name for word, name in imported(tree) if name.split(".")[0] == "shisd"}
    words = [(word, text) for text in read(tree) if (word := text.split(".")[0]) in bound]
    return [name for name in (*bound.values(), *(bound[w] + t[len(w) :] for w, t in words)) if not there(name)]


def there(name: str) -> bool:
    """Whether a.b.c can be read, or is a field, which only instances have."""
    try:
        pkgutil.resolve_name(name)
    except AttributeError:
        owner, _, last = name.rpartition(".")
        return there(owner) and last in getattr(pkgutil.resolve_name(owner), "__annotations__", {})
    return True


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_names_are_there(path):
    assert wrong(path.read_text()) == []


def test_a_name_that_has_gone_is_found():
    source = "from shisd import shading\nfrom shisd.models import Gone\nshading.shade\nshading.shade_polygon(1)\n"
    assert wrong(source) == ["shisd.models.Gone", "shisd.shading.shade_polygon"]
