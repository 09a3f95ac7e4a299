"""What one meets at the prompt: names after `import shisd`, signatures in help texts, printed objects."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import shisd
from shisd import decomposition, domains, filtering, harmonics, models, planning, reference, shading

STAGES = (harmonics, decomposition, domains, models, shading, filtering, planning, reference)
PUBLIC = {f"{s.__name__}.{name}": thing for s in STAGES for name, thing in vars(s).items() if name[0] != "_"}
PUBLIC = {name: x for name, x in PUBLIC.items() if callable(x) and getattr(x, "__module__", "").startswith("shisd")}


def printed(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_everything_is_there_after_import_and_optional_packages_are_not_loaded():
    optional = ["matplotlib", "trimesh", "embreex", "OpenEXR", "PIL", "tqdm", "scipy.optimize"]
    code = f"import sys, shisd; shisd.plotting.show_map, shisd.reference.shade_polygon, shisd.io.read_image\n" \
           f"print([name for name in {optional} if name in sys.modules])"  # fmt: skip
    assert printed(code) == "[]"


def test_what_only_some_programs_need_is_imported_when_used():
    later = ["shisd.plotting", "shisd.reference"]
    code = f"""
import sys, shisd
loaded = lambda: [name for name in {[*later, "matplotlib"]} if name in sys.modules]
print(loaded(), {{"plotting", "reference", "shading"}} <= set(dir(shisd)), loaded())
from shisd import plotting
print(shisd.plotting is plotting is sys.modules["shisd.plotting"], loaded())
print(shisd.reference is sys.modules["shisd.reference"], loaded())
"""
    assert printed(code).splitlines() == ["[] True []", f"True {later[:1]}", f"True {later}"]


def test_a_name_that_is_not_there_is_named_with_its_module():
    with pytest.raises(AttributeError, match="module 'shisd' has no attribute 'plots'"):
        shisd.plots  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'plots' from 'shisd'"):
        from shisd import plots  # noqa: F401


def test_arrays_have_one_name_in_signatures():
    shown = str(inspect.signature(models.Visibility.from_mesh))
    assert shown.startswith("(vertices: ArrayLike, triangles: ArrayLike, degree: int, *, points: Optional[ArrayLike]")
    assert shown.endswith("progress: Progress = None) -> 'Visibility'")
    for name, thing in PUBLIC.items():
        assert "numpy.bool" not in str(inspect.signature(thing)), name


def test_objects_show_their_numbers():
    seen = models.Visibility(np.ones((6, 4), np.float32), np.array([[0, 1, 2]]), 0.5)
    assert repr(seen) == "Visibility(coefficients=f32[6,4], triangles=[[0, 1, 2]], noise=f32[6])"
    assert repr(models.CookTorrance(0.25, 1.0, np.array([0.9, 0.5, 0.25], np.float32))).startswith(
        "CookTorrance(roughness=0.25, metallic=1.0, albedo=[0.9, 0.5, 0.25]"
    )
    inside = jax.jit(lambda s: print(repr(s), file=sys.stderr) or s.noise)
    assert inside(seen).shape == (6,)


def test_a_good_status_says_so():
    assert re.fullmatch(r"shisd\.[\w.]+<[A-Z].+\.>", repr(shisd.Status.ok))


MOST = 105


def names_of(module) -> list[str]:
    """What the `__init__.py` of a package gives anew, or a file defines."""
    tree = ast.parse(inspect.getsource(module))
    if hasattr(module, "__path__"):
        return [a.asname or a.name for n in tree.body if isinstance(n, ast.ImportFrom) for a in n.names]
    own = [n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    return [name for name in own if name[0] != "_"]


def test_there_are_few_enough_names_to_learn():
    folder = Path(shisd.__file__).parent
    places = sorted({p.stem for p in folder.glob("*.py")} | {p.parent.name for p in folder.glob("*/__init__.py")})
    given = {s: names_of(importlib.import_module(f"shisd.{s}")) for s in places if s[0] != "_"}
    given["shisd"] = ["Status"]
    total = sum(len(names) for names in given.values())
    listed = "\n".join(f"{stage} {len(names)}: {', '.join(names)}" for stage, names in given.items())
    assert total <= MOST, f"{total} names, more than {MOST}:\n{listed}"


def test_what_stages_give_is_only_what_they_list():
    for stage in (*STAGES, shisd.io):
        public = {name for name in vars(stage) if name[0] != "_"}
        inner = {path.stem for path in Path(stage.__file__).parent.iterdir()}
        assert public - inner - set(names_of(stage)) <= {"jaxtyping"}, stage.__name__  # put there by checks of tests
