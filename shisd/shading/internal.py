"""What planning takes from inside shading: slices of materials before they are tables, and the light of polygons."""

from shisd.shading._polygon import incident_radiance as incident_radiance
from shisd.shading.slices._tabulate import project_slice as project_slice
from shisd.shading.slices._upper import RIDGE as RIDGE
from shisd.shading.slices._upper import fit_above as fit_above
from shisd.shading.slices._upper import hemisphere_blocks as hemisphere_blocks
