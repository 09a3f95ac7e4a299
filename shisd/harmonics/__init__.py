"""Stage 1: real spherical and zonal harmonics.

Conventions: real orthonormal basis with the Condon-Shortley phase, index l*(l+1)+m on the last axis, pole +z, so
y_1 = (-sqrt(3/4pi) y, sqrt(3/4pi) z, -sqrt(3/4pi) x). `degree` is the highest band, inclusive.
"""

from shisd.harmonics._conventions import convert as convert
from shisd.harmonics._products import convolve as convolve
from shisd.harmonics._products import multiply as multiply
from shisd.harmonics._products import product_matrix as product_matrix
from shisd.harmonics._quadrature import sphere_rule as sphere_rule
from shisd.harmonics._rotation import rotate as rotate
from shisd.harmonics._sh import evaluate as evaluate
from shisd.harmonics._sh import sh_basis as sh_basis
from shisd.harmonics._transform import project as project
from shisd.harmonics._transform import project_map as project_map
from shisd.harmonics._transform import synthesize_map as synthesize_map
from shisd.harmonics._windows import apply_window as apply_window
from shisd.harmonics._windows import dering as dering
from shisd.harmonics._windows import hann_window as hann_window
from shisd.harmonics._windows import laplacian_window as laplacian_window
from shisd.harmonics._zh import legendre as legendre
from shisd.harmonics._zh import zonal_basis as zonal_basis
