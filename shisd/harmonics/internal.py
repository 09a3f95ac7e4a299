"""What later stages take from inside harmonics: tables made on the host, sums without a basis, pairs of expansions."""

from shisd.harmonics._layout import bands as bands
from shisd.harmonics._layout import by_band as by_band
from shisd.harmonics._layout import of_order as of_order
from shisd.harmonics._layout import orders as orders
from shisd.harmonics._layout import place as place
from shisd.harmonics._pairing import Each as Each
from shisd.harmonics._pairing import pair_many as pair_many
from shisd.harmonics._pairing import rows as rows
from shisd.harmonics._pairing import turned_series as turned_series
from shisd.harmonics._products import product_matrices as product_matrices
from shisd.harmonics._quadrature import gauss_rows as gauss_rows
from shisd.harmonics._rotation import rotate_many as rotate_many
from shisd.harmonics._sh import angles_of as angles_of
from shisd.harmonics._sh import basis_at as basis_at
from shisd.harmonics._sh import weighted_sums as weighted_sums
from shisd.harmonics._tables import associated_legendre as associated_legendre
from shisd.harmonics._tables import gradient_gather as gradient_gather
from shisd.harmonics._tables import host_basis as host_basis
from shisd.harmonics._tables import quarter_mirror as quarter_mirror
from shisd.harmonics._tables import swap_matrices as swap_matrices
from shisd.harmonics._tables import zonal_norms as zonal_norms
from shisd.harmonics._transform import sample_map as sample_map
from shisd.harmonics._transform import series_table as series_table
from shisd.harmonics._zh import legendre_of_versine as legendre_of_versine
