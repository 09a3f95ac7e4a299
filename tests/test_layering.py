"""Imports point to earlier stages only, the reference uses nothing that it judges, JAX and Equinox are used in public.

Every imported name of every module is read, those of the files beside the stages too, and those of tests/truth/.
"""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "shisd"
FILES = sorted(PACKAGE.rglob("*.py"))

# What each stage, and each file beside the stages, may import of the package. Private files beside the stages (_checks,
# _numerics, ...) are open to all and import nothing but each other.
MAY_IMPORT = {
    "harmonics": set(),
    "decomposition": {"harmonics"},
    "domains": {"harmonics", "decomposition"},
    "io": set(),
    "models": {"harmonics", "decomposition", "domains", "io"},
    "shading": {"harmonics", "decomposition", "domains", "models"},
    "planning": {"harmonics", "decomposition", "domains", "models", "shading"},
    "filtering": {"harmonics", "decomposition", "models", "io"},
    "plotting": {"harmonics", "models"},
    "reference": {"models", "domains"},  # classes only
}
FOR_TYPES = {"io": {"models"}}  # under `if TYPE_CHECKING:` alone
FORBIDDEN = ("jax._src", "equinox.internal", "equinox._")


def imported(tree: ast.AST) -> list[str]:
    """Every imported name in full: a.b.c of `from a.b import c`."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names += [f"{'.' * node.level}{node.module or ''}.{a.name}" for a in node.names]
        elif isinstance(node, ast.Import):
            names += [a.name for a in node.names]
    return names


def fault(own: str, name: str, types: set[str]) -> str | None:
    """Why the stage or file `own` may not import a name, or None."""
    package, *parts = name.split(".")
    if package == "":
        return "imports are absolute"
    if name.startswith(FORBIDDEN):
        return "not public"
    if package != "shisd" or own == "__init__":
        return None
    if not parts:
        return "the whole package"
    stage = parts[0]
    if stage.startswith("_") or stage == own or stage in types:
        return None
    if own.startswith("_"):
        return "helpers import helpers only"
    if stage not in MAY_IMPORT[own]:
        return f"{own} may not import {stage}"
    if own == "reference" and not (len(parts) == 2 and parts[1][0].isupper()):
        return "the reference imports public classes only"
    return None


def faults(place: str, source: str) -> list[str]:
    """What the file at `place` in the package imports and may not, and why."""
    own = place.split("/")[0].removesuffix(".py")
    body = ast.parse(source).body
    for_types = [n for n in body if isinstance(n, ast.If) and ast.unparse(n.test).endswith("TYPE_CHECKING")]
    parts = [([n for n in body if n not in for_types], set()), (for_types, FOR_TYPES.get(own, set()))]
    names = [(name, types) for nodes, types in parts for name in imported(ast.Module(nodes, []))]
    return [f"{name}: {why}" for name, types in names if (why := fault(own, name, types))]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_what_a_module_imports(path):
    assert faults(path.relative_to(PACKAGE).as_posix(), path.read_text()) == []


@pytest.mark.parametrize(
    ("place", "source"),
    [
        ("harmonics/_sh.py", "from shisd import filtering"),
        ("harmonics/_sh.py", "from shisd.plotting import plot_expansion"),
        ("harmonics/_sh.py", "import shisd.io"),
        ("harmonics/_sh.py", "import shisd"),
        ("harmonics/_sh.py", "from shisd import *"),
        ("harmonics/_sh.py", "def f():\n    from shisd.domains._polygon import clip"),
        ("domains/_haar.py", "from shisd.models import Ggx"),
        ("models/_brdf.py", "from shisd.shading._lobes import Lobes"),
        ("shading/_lobes.py", "from shisd import planning as p"),
        ("shading/_lobes.py", "import jax, shisd.reference"),
        ("filtering.py", "from shisd.shading import Lobes"),
        ("io.py", "from shisd.models import AbstractBrdf"),
        ("_numerics.py", "from shisd.harmonics import sh_basis"),
        ("reference.py", "from shisd.harmonics import sh_basis"),
        ("reference.py", "from shisd.domains import solid_angle"),
        ("reference.py", "from shisd.domains._moments import Loop"),
        ("reference.py", "from shisd import domains"),
        ("reference.py", "from shisd import shading"),
        ("planning.py", "from .shading import Lobes"),
        ("planning.py", "from jax import _src"),
        ("planning.py", "import jax._src.core as c"),
        ("planning.py", "from equinox import internal as eqxi"),
        ("planning.py", "from equinox._module import Module"),
    ],
)
def test_what_no_module_may_import(place, source):
    assert len(faults(place, source)) == 1, faults(place, source)


@pytest.mark.parametrize(
    ("place", "source"),
    [
        ("harmonics/_sh.py", "import jax\nfrom shisd import _checks\nfrom shisd.harmonics import _tables"),
        ("shading/_lobes.py", "from shisd.models._brdf import Ggx\nfrom shisd import harmonics"),
        ("io.py", "if TYPE_CHECKING:\n    from shisd.models import AbstractBrdf"),
        ("reference.py", "from shisd.models import Ggx\nfrom shisd.domains import SphericalPolygon"),
        ("__init__.py", "from shisd import planning"),
    ],
)
def test_what_a_module_may_import(place, source):
    assert faults(place, source) == []


def test_truth_imports_nothing_that_it_judges():
    paths = sorted((PACKAGE.parent / "tests" / "truth").rglob("*.py"))
    names = [(path.name, name) for path in paths for name in imported(ast.parse(path.read_text()))]
    others = [x for x in names if x[1].split(".")[0] in ("", "shisd", "tests") and not x[1].startswith("tests.truth.")]
    assert names and others == []
