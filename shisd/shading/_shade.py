"""The one verb: radiance from any material under any lights, by the path of each kind of light."""

from collections.abc import Sequence

import jax
import numpy as np
from typing_extensions import TypeAliasType

from shisd._typing import Array, Float
from shisd.models import DistantLight, Environment, Occluded, PolygonLight, PortalLight, SphereLight, ZonalLight
from shisd.shading._material import Material, as_material
from shisd.shading._matrix import BrdfMatrix
from shisd.shading._quadrature import Quadrature
from shisd.shading._surface import Surface, check_surface
from shisd.shading._tiles import Form, as_type, floating_type, sum_parts
from shisd.shading.paths import _distant, _occluded, _polygon, _sphere, _zonal
from shisd.shading.paths._path import Path
from shisd.shading.slices._slices import Slices
from shisd.shading.slices._transformed import TransformedSlices

Light = TypeAliasType("Light", DistantLight | ZonalLight | Occluded | PolygonLight | PortalLight | SphereLight)
PATHS: dict[type, Path] = {
    DistantLight: _distant.PATH,
    ZonalLight: _zonal.PATH,
    Occluded: _occluded.PATH,
    PolygonLight: _polygon.PATH,
    PortalLight: _polygon.PATH,
    SphereLight: _sphere.PATH,
}


def shade(
    material: Material | Slices | TransformedSlices | Quadrature | BrdfMatrix,
    lights: Light | Sequence[Light],
    surface: Surface,
) -> Float[Array, "*batch_colour"]:
    """Radiance that leaves surface points towards the viewer, from one light or the sum of several of any kinds.

    Arguments: `material` from `prepare`, or `Slices`, a `Quadrature` or a `BrdfMatrix` of one's own; `lights`, one or a
    sequence of `models.DistantLight`, `ZonalLight`, `Occluded`, `SphereLight`, `PolygonLight`, `PortalLight`;
    `surface`, with `positions` where a light is local and `tangents` where the material is anisotropic. Colours of
    material and lights: as many, or none of one. Returns [..., *colour] in W/(m2 sr), or the lights' unit.
    What lies below the horizon of a point adds nothing. A view that is not above the horizon gives 0; a light seen from
    behind adds 0, with gradient 0. A NaN anywhere, a zero normal or view, a ball of no size, and a tangent along the
    normal give NaN, with NaN gradients. Nothing casts shadows but `Occluded`.
    The path is chosen by the classes of material and lights, while tracing:

    - `DistantLight` (ISD15 Eq. 20-22): exact for the tabulated slice, to 1e-5 of the largest radiance in float32 and
      1e-12 in float64; what only one of light and material has in its bands adds nothing. About L^3 products for each
      point, for any number of lights, which are added first. A `BrdfMatrix` (CSH18 section 5.1) costs (Lv + 1)^2
      numbers per coefficient of anisotropic materials instead of (V + 4) (2 L + 6): a third of the time at degree 8,
      Lv = 16, V = 32.
    - `ZonalLight` (ISD15 Eq. 23, 24): the same, for (L+1)^2 harmonics for each point and light: nothing is rotated.
    - `Occluded` (ISD15 Eq. 25): the product of three expansions, exact with all bands of the light up to the sum of the
      degrees of visibility and material. A product with a matrix [(L+1)^2, (Lv+1)^2] for each point and colour.
    - `SphereLight` (ISD15 Eq. 34): to 1e-5 and 1e-12. (L+1)^2 harmonics for each point and light. The cosine's edge is
      resolved as far as the material's degree does. A point inside a ball has its surface all around. Of a material
      with `lamps` (below), as polygons of 12 corners and of their solid angle: 2e-4, 4e-4 and 2e-3 of the RMS for GGX
      of alpha 0.5, 0.25 and 0.1 under five balls, near ones and ones across the horizon among them.
    - `PolygonLight` (CSH18 Eq. 12): cut off at the horizon exactly; 3e-5 and 1e-12. Against quadrature of the material
      itself, at degree 20: relative RMSE below 3e-5 for Lambertian, 1e-4 for GGX of alpha 0.5. Moments at L+1 axes,
      2L+1 for anisotropic materials, for each point, light and colour of the material; half as many edges again where
      the horizon cuts a light in any of 256 points that follow each other, nothing where it is dark in all.
      Of a material whose `lamps` are slices beyond maps (`transform_brdf`): these, as exactly. Whose `lamps` are a
      `Quadrature`: Gauss points on what is above the horizon, also of portals and polygons with a profile.
    - `PortalLight`, and polygons with a profile (CSH18 Eq. 13, 14): moments to the sum of both degrees at twice as many
      axes, and for each colour a product with a matrix [(L+1)^2, (Le+L+1)^2].

    Lights of one kind and of equal shapes are one piece of compiled code, whatever their number. A batch is filled up
    to one of few sizes, by at most an eighth (powers of two up to 64), so that a new number of points seldom compiles
    anything. Memory: one tile of at most 4096 points, and the result, also for gradients. Batches that are sharded over
    devices stay there, and nothing is sent.
    Derivatives: in every floating field of material, lights and surface, both modes, any order, also where a normal
    lies along an axis of the world; where a view or a ball lies along the normal, the first; of polygons the first. The
    cut at the horizon is a discontinuity of the view, with no gradient. At the surface of a ball those in its position
    and radius go to infinity.
    """
    check_surface(surface)
    ready, known = as_material(material), _known(lights)
    groups: dict[Path, list[Light]] = {}
    for light in known:
        groups.setdefault(PATHS[type(light)], []).append(light)
    forms = [path.form(ready, type(group[0]).__name__) for path, group in groups.items()]
    points = [_points(surface, path, form) for path, form in zip(groups, forms, strict=True)]
    colours = {"material": forms[0].colour} | {f"light {i}": x.colour for i, x in enumerate(known)}
    try:
        np.broadcast_shapes(*colours.values(), *(form.colour for form in forms))
    except ValueError as error:
        named = " and ".join(f"`{name}` {list(c)}" for name, c in colours.items())
        raise ValueError(f"colours of {named} do not broadcast.") from error
    dtype = floating_type((forms, known, points))
    parts = []
    for (path, group), form, own in zip(groups.items(), as_type(forms, dtype), as_type(points, dtype), strict=True):
        colour = np.broadcast_shapes(form.colour, *(light.colour for light in group))
        parts.append((path.radiance(form, as_type(group, dtype), own, surface), colour))
    return sum_parts(parts)


def _known(lights: Light | Sequence[Light]) -> list[Light]:
    """One light or several, as a list."""
    several = list(lights) if isinstance(lights, Sequence) else [lights]
    if not several:
        raise ValueError("`lights` is empty: pass at least one light.")
    for i, light in enumerate(several):
        if type(light) not in PATHS:
            which = f"`lights` [{i}]" if isinstance(lights, Sequence) else "`lights`"
            names = ", ".join(kind.__name__ for kind in PATHS)
            raise ValueError(f"{which} must be one of models.{names}; got {type(light).__name__}.{_hint(light)}")
    return several


def _hint(light: object) -> str:
    if isinstance(light, Environment):
        return " Pass `light(degree)` of the map."
    return " SH coefficients go into models.DistantLight." if isinstance(light, np.ndarray | jax.Array) else ""


def _points(surface: Surface, path: Path, form: Form) -> dict[str, Array]:
    """The arrays of the surface that a path uses."""
    names = ["normals", "views"]
    if path.local:
        if surface.positions is None:
            raise ValueError("`surface` needs `positions` [..., 3]: a light is local.")
        names.append("positions")
    if not form.isotropic:
        if surface.tangents is None:
            raise ValueError("`surface` needs `tangents` [..., 3]: this material is anisotropic.")
        names.append("tangents")
    return surface.points(*names)
