"""Model only what a scene needs: for each material and light, the smallest degree and the cheapest path.

Radiance is the product of a material's slice with the light as it stands in the local frame. What a path leaves out is
such a product too, of what it drops of the slice, s, with what it drops of the light, t: above degree L of both for the
general path; all that is not zonal for the paths that take the light, or the slice, as zonal. Averaged over all
rotations between the two, the products of different harmonics vanish, so that

    mean square of the error = sum_l |s_l|^2 |t_l|^2 / (2l+1),      error <= sum_l |s_l| |t_l|,

|s_l| the Euclidean norm of band l. So a plan is made from band energies alone, without a picture.

notation: rho_l = slice; e_l = distant light; p_l = a local light, as a point sees it; L = degree of a path.
"""

from shisd.planning._choice import Entry as Entry
from shisd.planning._choice import Plan as Plan
from shisd.planning._choice import plan as plan
from shisd.planning._scene import Scene as Scene
