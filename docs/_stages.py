"""The directive `stage`: what a stage of the package gives, from its docstrings, which are plain text."""

import ast
import importlib
import inspect
import re
import typing
from types import ModuleType
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import stringify_annotation

LABELS = "Accuracy|Arguments|Bad values|Cost|Derivatives|Energy|Errors|Memory|Returns|Source"


def public(module: ModuleType) -> list[str]:
    """Names that a package exports or a file defines, in their order."""
    if hasattr(module, "__path__"):
        imports = [n for n in ast.parse(inspect.getsource(module)).body if isinstance(n, ast.ImportFrom)]
        return [alias.asname or alias.name for n in imports for alias in n.names]
    own = lambda x: callable(x) and getattr(x, "__module__", None) == module.__name__
    return [name for name, x in vars(module).items() if name[0] != "_" and own(x)]


def as_rst(text: str) -> list[str]:
    """Lines of reStructuredText for a docstring: names between backquotes are code, and all else stands for itself."""
    lines: list[str] = []
    literal = item = False
    for line in text.splitlines():
        starts = not lines or not lines[-1]  # a paragraph
        if line.startswith("    ") and starts and not literal:
            lines += ["::", ""]
            literal = True
        literal = literal and (not line or line.startswith("    "))
        if literal:
            lines.append(line)
            continue
        ends = item and bool(line) and not line.startswith((" ", "- "))
        labelled = re.match(rf"({LABELS}):", line)
        if not starts and (ends or labelled or (line.startswith("- ") and not item)):
            lines.append("")
        item = bool(line) and not ends and (item or line.startswith("- "))
        pieces = re.split(r"(`[^`]+`)", line)
        line = "".join(f"`{p}`" if p[:1] == "`" else re.sub(r"([*|_\\])", r"\\\1", p) for p in pieces)
        lines.append(re.sub(rf"^({LABELS}):", r"**\1:**", line))
    return lines


def summary(text: str) -> str:
    """The first sentence."""
    return re.split(r"(?<!Eq)(?<!\.)\.\s(?=[A-Z])", " ".join(text.split("\n\n")[0].split()))[0].rstrip(".")


def value(thing: object) -> str:
    """What a tuple holds, or a type that has been given a name stands for; nothing for classes and functions."""
    if isinstance(thing, tuple):
        return ", ".join(getattr(x, "__name__", repr(x)) for x in thing)
    named = typing.get_origin(thing) is not None
    return re.sub(r"(\w+\.)+(?=\w)", "", stringify_annotation(thing)) if named else ""


class Stage(SphinxDirective):
    """`.. stage:: MODULE`: its docstring, a line for each public name, then each in full."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        module = importlib.import_module(self.arguments[0])
        names, entries = [], []
        for name in public(module):
            thing, path = getattr(module, name), f"{module.__name__}.{name}"
            if about := value(thing):
                entries += [f".. py:data:: {path}", f"   :value: {about}", ""]
            else:
                about = summary(inspect.getdoc(thing) or "")
                directive = "autoclass" if inspect.isclass(thing) else "autofunction"
                entries += [f".. {directive}:: {path}", *["   :members:"] * inspect.isclass(thing), ""]
            names.append(f"- :py:obj:`{name} <{path}>`: {' '.join(as_rst(about))}")
        text = [*as_rst(inspect.getdoc(module) or ""), "", *names, "", *entries]
        return self.parse_text_to_nodes("\n".join(text))


def plain_text(app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    lines[:] = [*as_rst("\n".join(lines)), ""]


def skip_fields(app: Sphinx, what: str, name: str, thing: object, skip: bool, options: object) -> bool | None:
    """Fields of named tuples, which have no docstring of their own."""
    return True if (getattr(thing, "__doc__", None) or "").startswith("Alias for field number") else None


def short_types(app: Sphinx, doctree: nodes.document) -> None:
    """`Array` as the code writes it, not as JAX stores it."""
    for description in doctree.findall(addnodes.desc):
        for text in list(description.findall(nodes.Text)):
            if "jaxlib._jax." in text:
                text.parent.replace(text, nodes.Text(re.sub(r"(jax\.)?jaxlib\._jax\.", "", text)))


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("stage", Stage)
    app.connect("autodoc-process-docstring", plain_text)
    app.connect("autodoc-skip-member", skip_fields)
    app.connect("doctree-read", short_types)
    return {"parallel_read_safe": True}
