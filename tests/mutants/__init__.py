"""Mutants: small faults put into the package on purpose, and the test that has to catch each.

A module here holds those of one area in its list `MUTANTS`; `tests/test_mutants.py` tries them (`make mutants`).
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """One fault: in the file `path` the text `old`, which stands there once, becomes `new`, and `test` must fail."""

    name: str
    path: str
    old: str
    new: str
    test: str
