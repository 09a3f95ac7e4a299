"""What tests judge by: NumPy, SciPy and mpmath, no formula of the package and nothing else of the tests."""

from tests.truth._axes import band_matrices as band_matrices
from tests.truth._axes import condition_bound as condition_bound
from tests.truth._axes import conditions as conditions
from tests.truth._derivatives import derivative as derivative
from tests.truth._harmonics import harmonics as harmonics
from tests.truth._harmonics import scipy_basis as scipy_basis
from tests.truth._materials import ggx_cosine as ggx_cosine
from tests.truth._materials import ggx_to_fifty_digits as ggx_to_fifty_digits
from tests.truth._materials import nearest_bin as nearest_bin
from tests.truth._polygons import edge_coefficients as edge_coefficients
from tests.truth._polygons import edge_moments as edge_moments
from tests.truth._polygons import moment_slopes as moment_slopes
from tests.truth._polygons import part_above as part_above
from tests.truth._polygons import solid_angle as solid_angle
from tests.truth._polygons import triangle_rule as triangle_rule
from tests.truth._polygons import zonal_moments as zonal_moments
from tests.truth._shading import environment_radiance as environment_radiance
from tests.truth._shading import ggx_radiance as ggx_radiance
from tests.truth._shading import map_coefficients as map_coefficients
from tests.truth._shading import outline_above as outline_above
from tests.truth._shading import polygon_radiance as polygon_radiance
from tests.truth._shading import polygon_slopes as polygon_slopes
from tests.truth._vectors import frame_of as frame_of
from tests.truth._vectors import tangential as tangential
