"""What later stages take from inside domains: outlines and their clipping, integrals of many loops and caps at once."""

from shisd.domains._haar import clip_to_cells as clip_to_cells
from shisd.domains._integrate import fold_expansion as fold_expansion
from shisd.domains._integrate import incidence_inverse as incidence_inverse
from shisd.domains._integrate import loop_coefficients as loop_coefficients
from shisd.domains._integrate import zonal_inverse as zonal_inverse
from shisd.domains._polygon import clip as clip
from shisd.domains._polygon import loop_solid_angle as loop_solid_angle
from shisd.domains._polygon import on_sphere as on_sphere
from shisd.domains._region import cap_coefficients as cap_coefficients
from shisd.domains._region import cap_integrals as cap_integrals
from shisd.domains.moments import Loop as Loop
