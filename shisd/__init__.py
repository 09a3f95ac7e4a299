"""Spherical kernels as weighted sums of rotated zonal harmonics, differentiable from material and light to radiance."""

from shisd import decomposition as decomposition
from shisd import domains as domains
from shisd import filtering as filtering
from shisd import harmonics as harmonics
from shisd import io as io
from shisd import models as models
from shisd import planning as planning
from shisd import plotting as plotting
from shisd import reference as reference
from shisd import shading as shading

__version__ = "0.1.0"
