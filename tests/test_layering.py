"""Imports point to earlier stages only, the reference uses nothing that it judges, JAX and Equinox are used in public.

Of an earlier stage, later ones take what is public or in its `internal.py`, and all that is there is taken by one.
Every imported name of every module is read, those of the files beside the stages and of tests/truth/ too, and what is
read off a module.
"""

import ast
import re
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
    "reference": {"models", "domains"},  # their classes only
}
FOR_TYPES = {"io": {"models"}}  # under `if TYPE_CHECKING:` alone
FORBIDDEN = ("jax._src", "equinox.internal", "equinox._")


def exported(path: Path) -> set[str]:
    """The names that a file of re-exports gives."""
    imports = [n for n in ast.parse(path.read_text()).body if isinstance(n, ast.ImportFrom)]
    return {a.asname or a.name for n in imports for a in n.names}


STAGES = [name for name in MAY_IMPORT if (PACKAGE / name).is_dir()]
PUBLIC = {name: exported(PACKAGE / name / "__init__.py") for name in STAGES}
INTERNAL = {path.parent.name: exported(path) for path in FILES if path.name == "internal.py"}


def imported(tree: ast.AST) -> list[tuple[str, str]]:
    """The words that imports bind, each with what it stands for in full: a.b.c of `from a.b import c`."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names += [(a.asname or a.name, f"{'.' * node.level}{node.module or ''}.{a.name}") for a in node.names]
        elif isinstance(node, ast.Import):
            names += [(a.asname or a.name, a.name) for a in node.names]
    return names


def read(tree: ast.AST) -> list[str]:
    """Every a.b.c in a file, in its greatest length."""
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    inner = {id(node.value) for node in nodes}
    words = [ast.unparse(node) for node in nodes if id(node) not in inner]
    return [text for text in words if re.fullmatch(r"[A-Za-z_][\w.]*", text)]


def taken(place: str, source: str) -> list[tuple[str, set[str]]]:
    """All that the file at `place` imports, or reads off what it imports, each with the stages open to it for types."""
    tree = ast.parse(source)
    for_types = [n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test).endswith("TYPE_CHECKING")]
    own = place.split("/")[0].removesuffix(".py")
    names, bound = [], {}
    for nodes, types in (([n for n in tree.body if n not in for_types], set()), (for_types, FOR_TYPES.get(own, set()))):
        for word, name in imported(ast.Module(nodes, [])):
            names.append((name, types))
            bound[word] = name, types
    for text in read(tree):
        words = [w for w in bound if text.startswith(f"{w}.")]
        names += [(bound[w][0] + text.removeprefix(w), bound[w][1]) for w in words]
    return names


def fault(own: str, name: str, types: set[str]) -> str | None:
    """Why the stage or file `own` may not take a name, or None."""
    package, *parts = name.split(".")
    if package == "":
        return "imports are absolute"
    if name.startswith(FORBIDDEN):
        return "not public"
    if package != "shisd" or own == "__init__":
        return None
    if not parts:
        return "the whole package"
    stage, *inside = parts
    if stage.startswith("_"):
        return None
    if stage == own:
        return "files of a stage import each other" if inside[:1] == ["internal"] else None
    if own.startswith("_"):
        return "helpers import helpers only"
    if stage not in MAY_IMPORT[own] | types:
        return f"{own} may not import {stage}"
    public = not inside or inside[0] in PUBLIC[stage]
    if own == "reference" and not (inside and public and inside[0][0].isupper()):
        return "the reference imports public classes only"
    if not public and not (inside[0] == "internal" and set(inside[1:2]) <= INTERNAL.get(stage, set())):
        return f"neither public in {stage} nor in its internal.py"
    return None


def faults(place: str, source: str) -> list[str]:
    """What the file at `place` in the package takes and may not, and why."""
    own = place.split("/")[0].removesuffix(".py")
    return [f"{name}: {why}" for name, types in taken(place, source) if (why := fault(own, name, types))]


def unused(stage: str, names: set[str], sources: dict[str, str]) -> set[str]:
    """Those of the names in the stage's `internal.py` that no file of another stage takes from there."""
    others = [taken(place, source) for place, source in sources.items() if place.split("/")[0] != stage]
    return names - {
        name.split(".")[3] for some in others for name, _ in some if name.startswith(f"shisd.{stage}.internal.")
    }


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_what_a_module_imports(path):
    assert faults(path.relative_to(PACKAGE).as_posix(), path.read_text()) == []


@pytest.mark.parametrize("stage", INTERNAL)
def test_what_stands_in_internal(stage):
    """Private names of the stage under their own names, each of use to a later stage."""
    sources = {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in FILES}
    assert unused(stage, INTERNAL[stage], sources) == set()
    assert INTERNAL[stage] & PUBLIC[stage] == set()
    _, *lines = ast.parse(sources[f"{stage}/internal.py"]).body  # after the docstring
    for line in lines:
        assert isinstance(line, ast.ImportFrom) and f"{line.module}".startswith(f"shisd.{stage}."), ast.unparse(line)
        assert all(a.asname == a.name and a.name[0] != "_" for a in line.names), ast.unparse(line)


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
        ("models/_brdf.py", "from shisd.shading.slices._slices import Slices"),
        ("shading/paths/_zonal.py", "from shisd import planning as p"),
        ("shading/paths/_zonal.py", "import jax, shisd.reference"),
        ("filtering.py", "from shisd.shading import Slices"),
        ("io.py", "from shisd.models import AbstractBrdf"),
        ("_numerics.py", "from shisd.harmonics import sh_basis"),
        ("reference/_polygon.py", "from shisd.harmonics import sh_basis"),
        ("reference/_polygon.py", "from shisd.domains import solid_angle"),
        ("reference/_polygon.py", "from shisd.domains.moments import Loop"),
        ("reference/_polygon.py", "from shisd.domains.internal import Loop"),
        ("reference/_polygon.py", "from shisd import domains"),
        ("reference/_polygon.py", "from shisd import shading"),
        ("reference/_polygon.py", "from shisd.reference.internal import cumulative"),
        ("reference/__init__.py", "from shisd.harmonics import sh_basis as sh_basis"),
        ("shading/paths/_zonal.py", "from shisd.models._brdf import Ggx"),
        ("shading/paths/_zonal.py", "from shisd.harmonics import _tables"),
        ("shading/paths/_zonal.py", "import shisd.harmonics._tables"),
        ("shading/paths/_zonal.py", "from shisd.harmonics._tables import bands"),
        ("shading/paths/_zonal.py", "from shisd.harmonics import bands"),
        ("shading/paths/_zonal.py", "from shisd.domains.moments import fold"),
        ("shading/paths/_zonal.py", "from shisd.harmonics import *"),
        ("shading/paths/_zonal.py", "from shisd.harmonics.internal import polar_series"),
        ("shading/paths/_zonal.py", "from shisd.harmonics.internal import sh_basis"),
        ("shading/paths/_zonal.py", "from shisd.harmonics.internal import *"),
        ("shading/paths/_zonal.py", "from shisd.shading.internal import RIDGE"),
        ("shading/paths/_zonal.py", "from shisd import harmonics\nl = harmonics._tables.bands(3)[0].item()"),
        ("shading/paths/_zonal.py", "from shisd import harmonics as h\nl = h.internal.polar_series(3)"),
        ("shading/paths/_zonal.py", "import shisd.harmonics\nl = shisd.harmonics._tables.bands(3)"),
        ("shading/paths/_zonal.py", "from shisd.harmonics import internal\nl = internal.polar_series(3)"),
        ("harmonics/_sh.py", "from shisd.domains.internal import clip"),
        ("planning/_paths.py", "from shisd.shading.slices._upper import RIDGE"),
        ("io.py", "if TYPE_CHECKING:\n    from shisd.models._brdf import AbstractBrdf"),
        ("planning/_paths.py", "from .shading import Slices"),
        ("planning/_paths.py", "from jax import _src"),
        ("planning/_paths.py", "import jax._src.core as c"),
        ("planning/_paths.py", "from equinox import internal as eqxi"),
        ("planning/_paths.py", "from equinox._module import Module"),
        ("planning/_paths.py", "import equinox as eqx\nloop = eqx.internal.while_loop"),
    ],
)
def test_what_no_module_may_import(place, source):
    assert len(faults(place, source)) == 1, faults(place, source)


@pytest.mark.parametrize(
    ("place", "source"),
    [
        ("harmonics/_sh.py", "import jax\nfrom shisd import _checks\nfrom shisd.harmonics import _tables"),
        ("harmonics/_sh.py", "from shisd.harmonics._tables import bands"),
        (
            "shading/paths/_zonal.py",
            "from shisd.models import Ggx\nfrom shisd import harmonics\nharmonics.sh_basis(x, 3).shape",
        ),
        (
            "shading/paths/_zonal.py",
            "from shisd.harmonics.internal import bands\nfrom shisd.models import Ggx\nGgx.value",
        ),
        ("shading/paths/_zonal.py", "from shisd.harmonics import internal as h\nh.bands(3)\nself.internal.bands"),
        ("io.py", "if TYPE_CHECKING:\n    from shisd.models import AbstractBrdf"),
        (
            "reference/_polygon.py",
            "from shisd.models import Ggx\nfrom shisd.domains import SphericalPolygon\nGgx.value",
        ),
        ("reference/_polygon.py", "from shisd import _checks\nfrom shisd.reference._monte_carlo import cumulative"),
        ("planning/_paths.py", "from shisd.planning._bands import Local\nfrom shisd.shading.internal import RIDGE"),
        ("__init__.py", "from shisd import planning"),
    ],
)
def test_what_a_module_may_import(place, source):
    assert faults(place, source) == []


def test_truth_imports_nothing_that_it_judges():
    paths = sorted((PACKAGE.parent / "tests" / "truth").rglob("*.py"))
    names = [(path.name, name) for path in paths for _, name in imported(ast.parse(path.read_text()))]
    others = [x for x in names if x[1].split(".")[0] in ("", "shisd", "tests") and not x[1].startswith("tests.truth.")]
    assert names and others == []


def test_what_no_later_stage_takes_is_found():
    sources = {
        "harmonics/_sh.py": "from shisd.harmonics.internal import own",
        "shading/_mirror.py": "from shisd.harmonics.internal import bands\nfrom shisd.domains.internal import other",
        "planning/_paths.py": "from shisd.harmonics import internal as h\nh.orders(3)",
    }
    assert unused("harmonics", {"bands", "orders", "own", "other"}, sources) == {"own", "other"}
