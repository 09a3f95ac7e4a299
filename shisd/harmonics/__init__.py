"""Stage 1: real spherical and zonal harmonics.

Conventions: real orthonormal basis with the Condon-Shortley phase, index l*(l+1)+m on the last axis, pole +z, so
y_1 = (-sqrt(3/4pi) y, sqrt(3/4pi) z, -sqrt(3/4pi) x). `degree` is the highest band, inclusive.
"""

from shisd.harmonics._sh import evaluate as evaluate
from shisd.harmonics._sh import sh_basis as sh_basis
from shisd.harmonics._zh import legendre as legendre
from shisd.harmonics._zh import zonal_basis as zonal_basis
