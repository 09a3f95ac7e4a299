"""What later stages take from inside the decomposition: zonal coefficients of Gaussians, the degree of stored axes."""

from shisd.decomposition._directions import TABLE_DEGREE as TABLE_DEGREE
from shisd.decomposition._kernels import gaussian_zonal as gaussian_zonal
