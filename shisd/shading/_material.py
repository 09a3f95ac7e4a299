"""Materials made ready: a form of their slices for light from all around, and one for light above the horizon."""

from shisd import _checks
from shisd._module import Module
from shisd._progress import Progress
from shisd.models import AbstractBrdf
from shisd.shading._matrix import BrdfMatrix
from shisd.shading._quadrature import Quadrature
from shisd.shading.slices._slices import Slices
from shisd.shading.slices._tabulate import table
from shisd.shading.slices._transformed import TransformedSlices, transform_brdf
from shisd.shading.slices._upper import RIDGE

LampForm = Slices | TransformedSlices | Quadrature


class Material(Module):
    """A material as `shade` takes it.

    `distant`: slices that stand for it everywhere, or its matrix, for light from all around; `local`: slices for light
    that is cut off at the horizon, best fitted above it, or a `Quadrature` of the model; `lamps`, which take the place
    of both under balls and under polygons that shine alike in all directions: slices beyond maps of directions, or a
    `Quadrature`, which takes polygons with a profile and portals too. `None` where there is no such light.
    """

    distant: Slices | BrdfMatrix | None
    local: Slices | Quadrature | None
    lamps: TransformedSlices | Quadrature | None

    def __init__(
        self,
        distant: Slices | BrdfMatrix | None = None,
        local: Slices | Quadrature | None = None,
        lamps: TransformedSlices | Quadrature | None = None,
    ):
        if distant is None and local is None and lamps is None:
            raise ValueError("a material needs `distant`, `local` or `lamps` slices; got none.")
        if not isinstance(distant, Slices | BrdfMatrix | None):
            raise ValueError(f"`distant` must be shading.Slices or BrdfMatrix; got {type(distant).__name__}.")
        if distant is not None and distant.domain != "sphere":
            raise ValueError("`distant` was fitted above the horizon only; make it with domain='sphere'.")
        if not isinstance(local, Slices | Quadrature | None):
            raise ValueError(f"`local` must be shading.Slices or Quadrature; got {type(local).__name__}.")
        if not isinstance(lamps, TransformedSlices | Quadrature | None):
            raise ValueError(f"`lamps` must be shading.TransformedSlices or Quadrature; got {type(lamps).__name__}.")
        if local is not None and lamps is not None:
            if local.isotropic != lamps.isotropic:
                raise ValueError(
                    "`local` and `lamps` are of an isotropic and an anisotropic material: make both of one."
                )
            if local.colour != lamps.colour:
                raise ValueError(f"`local` {list(local.colour)} and `lamps` {list(lamps.colour)} are of other colours.")
        self.distant, self.local, self.lamps = distant, local, lamps


class LocalForms(Module):
    """What stands for a material above the horizon."""

    local: Slices | Quadrature | None
    lamps: TransformedSlices | Quadrature | None

    @property
    def isotropic(self) -> bool:
        return self.uniform.isotropic

    @property
    def colour(self) -> tuple[int, ...]:
        return self.uniform.colour

    @property
    def uniform(self) -> LampForm:
        """Those for light that is alike in all directions."""
        return self.local if self.lamps is None else self.lamps  # type: ignore[return-value]  # one is there

    @property
    def directional(self) -> Slices | Quadrature | None:
        """Those for light that depends on direction."""
        return self.lamps if isinstance(self.lamps, Quadrature) else self.local


def prepare(
    brdf: AbstractBrdf,
    degree: int,
    *,
    local_degree: int | None = None,
    lamp_degree: int | None = None,
    elevations: int = 64,
    azimuths: int | None = None,
    quadrature: int | None = None,
    tolerance: float = 1e-3,
    throw: bool = True,
    progress: Progress = None,
) -> Material:
    """A material made ready for every kind of light: slices by view for distant light, and fitted for local light.

    Arguments: `brdf`; static `degree` for distant light and balls, `local_degree` for polygons and portals, by default
    the same; `lamp_degree`, none unless given, that of expansions beyond maps of directions (`transform_brdf`) for
    polygons, of which 4 or 8 are enough for sharp materials; the others as in `tabulate_brdf`, which integrates the
    material once, to the higher degree.
    Derivatives: in every parameter of the material, both modes. The result has the dtype of these.
    Accuracy and cost: `tabulate_brdf`.
    """
    degree = _checks.degree(degree)
    local_degree = degree if local_degree is None else _checks.integer("local_degree", local_degree)
    most = max(degree, local_degree)
    slices = table(brdf, most, (None, RIDGE), elevations, azimuths, quadrature, tolerance, throw, progress)
    if lamp_degree is None:
        lamps = None
    else:
        lamps = transform_brdf(brdf, lamp_degree, elevations=elevations, azimuths=azimuths)
    return Material(slices.cut(degree), slices.cut(local_degree).above_horizon(), lamps)


def as_material(material: object) -> Material:
    """Slices and matrices as the materials that they stand for."""
    match material:
        case Material():
            return material
        case Slices(domain="sphere"):
            return Material(material, material)
        case Slices():
            return Material(None, material)
        case TransformedSlices() | Quadrature():
            return Material(None, None, material)
        case BrdfMatrix(domain="sphere"):
            return Material(material)
        case BrdfMatrix():
            raise ValueError(
                "`material` is a BrdfMatrix that was fitted above the horizon only: for polygons and portals pass its "
                "`slices()`, for other lights one with domain='sphere'."
            )
    hint = " Make it ready by shading.prepare." if isinstance(material, AbstractBrdf) else ""
    came = type(material).__name__
    raise ValueError(
        "`material` must come from shading.prepare, tabulate_brdf, transform_brdf or project_brdf, or be a Quadrature; "
        f"got {came}.{hint}"
    )


def slices_everywhere(material: Material, light: str) -> Slices:
    """The slices for a light from all around that takes no matrix."""
    form = distant_form(material, light)
    if isinstance(form, BrdfMatrix):
        raise ValueError(
            f"`material` is a BrdfMatrix, which goes with DistantLight only; for a {light} pass its `slices()`."
        )
    return form


def distant_form(material: Material, light: str) -> Slices | BrdfMatrix:
    if material.distant is None:
        raise ValueError(
            f"`material` was fitted above the horizon only, and a {light} shines on it from all around: pass "
            "shading.prepare(brdf, degree), or slices with domain='sphere'."
        )
    return material.distant


def local_forms(material: Material, light: str) -> LocalForms:
    if material.local is None and material.lamps is None:
        raise ValueError(
            f"`material` has no slices for a {light}: pass shading.prepare(brdf, degree), or `slices()` of a matrix."
        )
    return LocalForms(material.local, material.lamps)
