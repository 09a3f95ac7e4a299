"""Slow, plainly right estimators with error bars, to judge the fast paths by.

They share no formula with them: no harmonics, no expansion, no closed form. Radiance is the integral over the upper
hemisphere of value_cosine(wi, wo) times the map's radiance, constant on each texel, taken two ways: by Monte Carlo with
multiple importance sampling (Veach 1995, balance heuristic) for whole pictures, and by a plain sum over texels for a
few pixels. Of polygons, the integral is over their area: by Monte Carlo, and by Gauss quadrature of what is above the
horizon.
"""

from shisd.reference._environment import shade_environment as shade_environment
from shisd.reference._environment import shade_environment_quadrature as shade_environment_quadrature
from shisd.reference._polygon import shade_polygon as shade_polygon
from shisd.reference._polygon import shade_polygon_quadrature as shade_polygon_quadrature
