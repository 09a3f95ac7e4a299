"""Moments of spherical polygons: integrals of P_l(w . d) and of (w . d)^n, exact in one pass along the edges.

`_edges` has the great arcs a -> b of length theta, `_recurrence` the derivation and the integrals, `_derivatives` these
with their gradients, `_fold` weighted sums of them.

layout: polygons are v[x y z, vertex, p], points p last as vector lanes; axes d[k, x y z]. What belongs to edges is
[e, p] or [x y z, e, p]; to one edge [p] or [x y z, p], or, for all axes at once, [e, 1, p] or [x y z, e, 1, p].
notation: an edge a -> b has the length theta and the inward normal n; c is the reference vertex; u = w . d.
"""

from shisd.domains.moments._derivatives import moments as moments
from shisd.domains.moments._edges import Loop as Loop
from shisd.domains.moments._edges import sides as sides
from shisd.domains.moments._fold import fold as fold
from shisd.domains.moments._recurrence import powers as powers
