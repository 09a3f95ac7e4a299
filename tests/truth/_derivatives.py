"""Derivatives by differences."""

import numpy as np

_CENTRAL = {-3: -1 / 60, -2: 3 / 20, -1: -3 / 4, 1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
_FORWARD = {0: -49 / 20, 1: 6, 2: -15 / 2, 3: 20 / 3, 4: -15 / 4, 5: 6 / 5, 6: -1 / 6}


def derivative(function, step, *, forward=False):
    """The derivative of function(t) at 0, in extended precision: differences of sixth order, central or forward."""
    rule = _FORWARD if forward else _CENTRAL
    return sum(np.longdouble(weight) * function(k * step) for k, weight in rule.items()) / np.longdouble(step)
