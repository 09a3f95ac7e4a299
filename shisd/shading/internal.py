"""What planning takes from inside shading: slices before they are tables, batches of points, sums of radiance."""

from shisd.shading._prefiltered import best_channels as best_channels
from shisd.shading._prefiltered import maps_of as maps_of
from shisd.shading._surface import check_surface as check_surface
from shisd.shading._tiles import as_type as as_type
from shisd.shading._tiles import finite_mark as finite_mark
from shisd.shading._tiles import finite_or_nan as finite_or_nan
from shisd.shading._tiles import shade_points as shade_points
from shisd.shading._tiles import sum_parts as sum_parts
from shisd.shading.slices._tabulate import project_slices as project_slices
from shisd.shading.slices._upper import RIDGE as RIDGE
from shisd.shading.slices._upper import hemisphere_blocks as hemisphere_blocks
