"""Stage 5: radiance, from materials made ready, lights and surface points.

Directions are in world space and point away from the surface; image colour is the last axis.
"""

from shisd.shading._footprint import Footprint as Footprint
from shisd.shading._footprint import footprint as footprint
from shisd.shading._material import Material as Material
from shisd.shading._material import prepare as prepare
from shisd.shading._matrix import BrdfMatrix as BrdfMatrix
from shisd.shading._matrix import project_brdf as project_brdf
from shisd.shading._mirror import MirrorMaps as MirrorMaps
from shisd.shading._mirror import reflect as reflect
from shisd.shading._prefiltered import Prefiltered as Prefiltered
from shisd.shading._prefiltered import prefilter as prefilter
from shisd.shading._project_light import project_light as project_light
from shisd.shading._quadrature import Quadrature as Quadrature
from shisd.shading._shade import shade as shade
from shisd.shading._surface import Surface as Surface
from shisd.shading.paths._occluded import visibility_gamma as visibility_gamma
from shisd.shading.slices._slices import Slices as Slices
from shisd.shading.slices._tabulate import tabulate_brdf as tabulate_brdf
from shisd.shading.slices._transformed import TransformedSlices as TransformedSlices
from shisd.shading.slices._transformed import transform_brdf as transform_brdf
