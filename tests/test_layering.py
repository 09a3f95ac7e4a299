"""Imports point to earlier stages only, and only public JAX and Equinox are used."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "shisd"
STAGES = ["harmonics", "decomposition", "domains", "models", "shading"]
FILES = sorted(PACKAGE.rglob("*.py"))


def stage(name: str) -> int:
    return STAGES.index(name) if name in STAGES else -1


def imported(path: Path) -> list[str]:
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names += [node.module or "", *(f"{node.module}.{a.name}" for a in node.names)]
        elif isinstance(node, ast.Import):
            names += [a.name for a in node.names]
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_to_earlier_stages(path):
    own = stage(path.relative_to(PACKAGE).parts[0].removesuffix(".py"))
    for name in imported(path):
        parts = name.split(".")
        if parts[0] == "shisd" and len(parts) > 1 and own >= 0:
            assert stage(parts[1]) <= own, f"{path.name} imports {name} from a later stage"
            assert parts[1] not in {"reference", "planning"}, f"{path.name} imports {name}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_only_public_interfaces_are_used(path):
    for name in imported(path):
        assert not name.startswith(("jax._src", "equinox.internal", "equinox._")), f"{path.name} imports {name}"
