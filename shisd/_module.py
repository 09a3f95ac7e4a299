"""The base of the package's objects: a module of Equinox that shows its numbers when it is printed."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

_FEW = 4  # numbers of an array that are shown; of larger ones, type and shape are


class Module(eqx.Module):
    """An `equinox.Module` whose `repr` has the values of scalars and short vectors."""

    def __repr__(self) -> str:
        return eqx.tree_pformat(jax.tree.map(_shown, self))


class _Text:
    def __init__(self, text: str):
        self._text = text

    def __repr__(self) -> str:
        return self._text


def _shown(leaf: object) -> object:
    if isinstance(leaf, jax.Array | np.ndarray) and leaf.size <= _FEW and not isinstance(leaf, Tracer):
        return _Text(_numbers(np.asarray(leaf)))
    return leaf


def _numbers(array: Any) -> str:
    return f"[{', '.join(map(_numbers, array))}]" if array.ndim else str(array[()])
