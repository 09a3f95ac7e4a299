"""Stage 4: the parts of a scene: reflection and light.

Local frames have the normal at +z; directions are unit vectors that point away from the surface. A BRDF's `value` is in
1/sr without the cosine, its `value_cosine` with it.
"""

from shisd.models._brdf import AbstractBrdf as AbstractBrdf
from shisd.models._brdf import CookTorrance as CookTorrance
from shisd.models._brdf import Ggx as Ggx
from shisd.models._brdf import Lambertian as Lambertian
from shisd.models._brdf import Phong as Phong
from shisd.models._environment import Environment as Environment
from shisd.models._measured import MeasuredBrdf as MeasuredBrdf
from shisd.models._microfacet_fits import AbcMicrofacet as AbcMicrofacet
from shisd.models._microfacet_fits import SgdMicrofacet as SgdMicrofacet
from shisd.models._projected import ProjectedBrdf as ProjectedBrdf
from shisd.models._visibility import Visibility as Visibility
from shisd.models._visibility import cap_visibility as cap_visibility
from shisd.models.lights._distant import DistantLight as DistantLight
from shisd.models.lights._distant import ZonalLight as ZonalLight
from shisd.models.lights._occluded import Occluded as Occluded
from shisd.models.lights._polygon import PolygonLight as PolygonLight
from shisd.models.lights._portal import PortalLight as PortalLight
from shisd.models.lights._sphere import SphereLight as SphereLight
