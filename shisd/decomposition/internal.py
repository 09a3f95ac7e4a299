"""What later stages take from inside the decomposition: Gaussians, the degree of stored axes, fits beyond maps."""

from shisd.decomposition._directions import TABLE_DEGREE as TABLE_DEGREE
from shisd.decomposition._kernels import gaussian_zonal as gaussian_zonal
from shisd.decomposition._stretch import moments_starts as moments_starts
from shisd.decomposition._stretch import stretch as stretch
from shisd.decomposition._transformed import Setting as Setting
from shisd.decomposition._transformed import project_beyond as project_beyond
from shisd.decomposition._transformed import search as search
