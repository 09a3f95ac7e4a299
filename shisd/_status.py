"""How a computation ended, in one vocabulary for all stages."""

from typing import TypeVar

import equinox as eqx
from jax.core import Tracer

from shisd import _checks

Result = TypeVar("Result")


class Status(eqx.Enumeration):
    """How a computation ended. `shisd.Status[status]` is a sentence that says what to try.

    Results that may fall short of what was asked are named tuples: the value, its `error` or the like, and `status`.
    Functions that give them take `throw`: whether a status other than `ok` is an error, a ValueError at once or, under
    jit, one at run time; with `throw=False` the best that was found comes back, and the caller reads the status.
    """

    ok = "The result is as good as was asked for."
    step_limit = (
        "All steps were used up; the best result so far is kept. Raise `max_steps`, `tolerance` or `ridge`, lower the "
        "degree, or give other starts."
    )
    coincident = (
        "Two lobes are as good as one, from the start or by the fit: the result is that of fewer, or they cancel. "
        "Opposite axes of zonal lobes are one. Use fewer, a `ridge`, or more `starts`."
    )
    degenerate = (
        "A lobe has become narrower than the samples are apart, or has no value at them, and means nothing. Use fewer "
        "lobes, more samples, a `ridge`, or more `starts`."
    )
    uncovered = (
        "Samples leave out parts of the hemisphere that this degree resolves; the ridge decides there. Lower `degree`, "
        "raise `ridge`, or add samples."
    )
    ill_conditioned = (
        "The axes do not resolve this degree with these kernels: the matrix is singular to working precision. Take "
        "decomposition.optimized_directions or separate_directions, more axes, or a `ridge` above 0."
    )
    mean_below_floor = (
        "No window lifts an expansion above its own mean, which is not above `floor`. Lower `floor`, or check that the "
        "function is positive and its coefficients are finite."
    )
    tolerance_not_met = "The `tolerance` is not met at the highest degree. Raise `max_degree` or `tolerance`."


def settled(result: Result, status: Status, throw: bool) -> Result:
    """`result`; if `throw`, an error instead where `status` is not ok."""
    if not throw:
        return result
    bad = status != Status.ok
    if isinstance(bad, Tracer):
        return _checks.held(result, lambda one: status.error_if(one, bad))
    if bad:
        raise ValueError(Status[status])
    return result
