"""Noisy and sparse measurements of BRDFs made smooth: coefficients by regularised least squares, filters, MERL tables.

Follows ISD15 section 6.3 (Eq. 30-32) for coefficients; tables are smoothed on their own angles.
"""

from shisd.filtering._brdf import fit_brdf as fit_brdf
from shisd.filtering._brdf import smooth_brdf as smooth_brdf
from shisd.filtering._merl import denoise_merl as denoise_merl
