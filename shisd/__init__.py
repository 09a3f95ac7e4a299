"""Spherical kernels as weighted sums of rotated zonal harmonics, differentiable from material and light to radiance."""

from shisd import harmonics as harmonics

__version__ = "0.1.0"
