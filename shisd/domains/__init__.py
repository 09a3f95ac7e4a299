"""Stage 3: regions of the sphere and exact integrals over them.

A polygon is positive when counter-clockwise seen from outside the sphere, the interior on the left of each edge;
reversed winding changes the sign of every integral. Integrals are in sr times the unit of the integrand.
"""

from shisd.domains._haar import HaarBasis as HaarBasis
from shisd.domains._integrate import axial_moments as axial_moments
from shisd.domains._integrate import integrate as integrate
from shisd.domains._integrate import polygon_coefficients as polygon_coefficients
from shisd.domains._integrate import zonal_moments as zonal_moments
from shisd.domains._polygon import SphericalPolygon as SphericalPolygon
from shisd.domains._polygon import clip_to_hemisphere as clip_to_hemisphere
from shisd.domains._polygon import polygon_from_points as polygon_from_points
from shisd.domains._polygon import solid_angle as solid_angle
from shisd.domains._region import SphericalCap as SphericalCap
from shisd.domains._region import hemisphere as hemisphere
