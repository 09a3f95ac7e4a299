"""Stage 2: isotropic spherical decomposition (ISD15), coefficients <-> weights of rotated kernels.

Conventions: axes are unit vectors; weights [..., L+1, K] multiply y_l^0(w . z_k), for which z and -z are one axis, or
the mother kernels phi_l(w . z_k) of an `IsotropicBasis`. Few lobes with axes of their own: `fit_lobes`.
"""

from shisd.decomposition._basis import RotatedZonalBasis as RotatedZonalBasis
from shisd.decomposition._directions import fibonacci_directions as fibonacci_directions
from shisd.decomposition._directions import optimize_directions as optimize_directions
from shisd.decomposition._directions import optimized_directions as optimized_directions
from shisd.decomposition._directions import separate_directions as separate_directions
from shisd.decomposition._fit import fit_lobes as fit_lobes
from shisd.decomposition._isotropic import IsotropicBasis as IsotropicBasis
from shisd.decomposition._kernels import CapKernel as CapKernel
from shisd.decomposition._kernels import FunctionKernel as FunctionKernel
from shisd.decomposition._kernels import GaussianKernel as GaussianKernel
from shisd.decomposition._kernels import GaussLegendreKernel as GaussLegendreKernel
from shisd.decomposition._kernels import LegendreKernel as LegendreKernel
from shisd.decomposition._kernels import PhongKernel as PhongKernel
from shisd.decomposition._mixtures import GaussianLobes as GaussianLobes
from shisd.decomposition._mixtures import ZonalLobes as ZonalLobes
from shisd.decomposition._sparse import sparse_weights as sparse_weights
from shisd.decomposition._transformed import TransformedExpansion as TransformedExpansion
from shisd.decomposition._transformed import fit_transformed as fit_transformed
