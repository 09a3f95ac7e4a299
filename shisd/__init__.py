"""Spherical kernels as weighted sums of rotated zonal harmonics, differentiable from material and light to radiance."""

from importlib import import_module
from typing import TYPE_CHECKING

from shisd import decomposition as decomposition
from shisd import domains as domains
from shisd import filtering as filtering
from shisd import harmonics as harmonics
from shisd import io as io
from shisd import models as models
from shisd import planning as planning
from shisd import shading as shading
from shisd._status import Status as Status

if TYPE_CHECKING:
    from shisd import plotting as plotting
    from shisd import reference as reference
else:
    _WHEN_USED = ("plotting", "reference")

    def __getattr__(name):
        """Imports what a program that only shades does not need, when it is first used (PEP 562)."""
        if name in _WHEN_USED:
            return import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return sorted({*globals(), *_WHEN_USED})


__version__ = "0.1.0"
