"""Stage 5: radiance, from materials as slices and light as coefficients.

Directions are in world space and point away from the surface; image colour is the last axis.
"""

from shisd.shading._degree import band_energies as band_energies
from shisd.shading._degree import material_degree as material_degree
from shisd.shading._environment import shade_environment as shade_environment
from shisd.shading._footprint import MirrorFootprint as MirrorFootprint
from shisd.shading._footprint import mirror_footprint as mirror_footprint
from shisd.shading._matrix import BrdfMatrix as BrdfMatrix
from shisd.shading._matrix import project_brdf as project_brdf
from shisd.shading._matrix import shade_matrix as shade_matrix
from shisd.shading._mirror import MirrorMaps as MirrorMaps
from shisd.shading._mirror import prefilter_mirror as prefilter_mirror
from shisd.shading._mirror import shade_mirror as shade_mirror
from shisd.shading._mirror import shade_prefiltered_mirror as shade_prefiltered_mirror
from shisd.shading._polygon import project_light as project_light
from shisd.shading._polygon import shade_polygon as shade_polygon
from shisd.shading._polygon import shade_portal as shade_portal
from shisd.shading._prefiltered import PrefilteredLobes as PrefilteredLobes
from shisd.shading._prefiltered import prefilter as prefilter
from shisd.shading._prefiltered import shade_prefiltered as shade_prefiltered
from shisd.shading._sphere import shade_sphere as shade_sphere
from shisd.shading._visibility import shade_environment_visibility as shade_environment_visibility
from shisd.shading._visibility import visibility_gamma as visibility_gamma
from shisd.shading._zonal import shade_zonal as shade_zonal
from shisd.shading.slices._slices import Slices as Slices
from shisd.shading.slices._tabulate import tabulate_brdf as tabulate_brdf
