"""Marks that several files of tests share."""

import pytest


def _first(dtype: str, other: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("dtype", [dtype, pytest.param(other, marks=pytest.mark.slow)], indirect=True)


# in one precision by default, in the other among the slow tests: for what compiles for many seconds in each
FLOAT32_FIRST, FLOAT64_FIRST = _first("float32", "float64"), _first("float64", "float32")
