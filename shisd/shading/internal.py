"""What planning takes from inside shading: slices of materials before they are tables, and the light of polygons."""

from shisd.shading._lobes import RIDGE as RIDGE
from shisd.shading._lobes import fit_above as fit_above
from shisd.shading._lobes import hemisphere_blocks as hemisphere_blocks
from shisd.shading._lobes import project_slice as project_slice
from shisd.shading._polygon import incident_radiance as incident_radiance
