"""Benchmarks and examples name what is in the package: they run too seldom to find out otherwise."""

import ast
import importlib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = [*sorted((ROOT / "tests" / "bench").glob("*.py")), *sorted((ROOT / "examples").glob("*.py"))]


def wrong(source: str) -> list[str]:
    """Names of the package that a file imports, or reads off what it imports, and that are not there."""
    tree, bound, missing = ast.parse(source), {}, []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "shisd":
            module = importlib.import_module(node.module or "")
            for alias in node.names:
                if hasattr(module, alias.name):
                    bound[alias.asname or alias.name] = getattr(module, alias.name)
                else:
                    missing.append(f"{node.module}.{alias.name}")
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            thing = bound.get(node.value.id)
            if isinstance(thing, ModuleType | type) and not hasattr(thing, node.attr):
                annotated = getattr(thing, "__annotations__", {})
                missing += [] if node.attr in annotated else [ast.unparse(node)]
    return missing


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_names_are_there(path):
    assert wrong(path.read_text()) == []


def test_a_name_that_has_gone_is_found():
    source = "from shisd import shading\nfrom shisd.models import Gone\nshading.shade\nshading.shade_polygon(1)\n"
    assert wrong(source) == ["shisd.models.Gone", "shading.shade_polygon"]
