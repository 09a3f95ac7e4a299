"""Mutants of the materials: what the tests named have to catch."""

from tests.mutants import Mutant

MUTANTS = [
    Mutant(
        "GGX without its norm",
        "shisd/models/_brdf.py",
        old="return 1 / (math.pi * alpha_x * alpha_y * (x * x + y * y + z * z) ** 2)",
        new="return 1 / (math.pi * alpha_x * (x * x + y * y + z * z) ** 2)",
        test="tests/models/test_brdf.py::test_cook_torrance_at_one_pair_worked_by_hand",
    ),
]
