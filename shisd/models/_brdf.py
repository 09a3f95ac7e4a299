"""BRDFs: the contract, and the models that are written from first principles.

Follows Walter et al. 2007 (GGX, called W07), Heitz 2014 (Smith masking, anisotropy, called H14) and OCCT sections 3 and
4. It differs from them in one habit: masking is always written already divided by its cosine, for example
G1(o) / cos_o = 2 / (cos_o + sqrt(cos_o^2 + alpha^2 sin_o^2)), so that nothing is 0/0 at the horizon, and
1 - cos^2 of the half vector is h_x^2 + h_y^2, so that narrow lobes keep their digits in float32.
"""

import abc
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, TypeVar, final

import equinox as eqx
import jax
import jax.numpy as jnp

from shisd import _checks
from shisd._module import Module
from shisd._numerics import dot, safe_sqrt
from shisd._typing import Array, ArrayLike, DTypeLike, Float, Scalar, Vector

Colour = Float[Array, "..."]  # () or (3,); the parameters of one model may mix both
Parameter = ArrayLike | Sequence[float]
Pytree = TypeVar("Pytree")
SMOOTHEST = 1e-6  # roughness below it is taken as it: with the half vector's rounding nothing narrower is resolved


class AbstractBrdf(Module):
    """Reflection at one point, in its local frame: +z is the normal, both directions point away from the surface.

    A BRDF takes one pair of unit vectors [3]; use `jax.vmap` for more. Its result has the shape `colour`: () when every
    parameter is a scalar, (3,) when one of them has shape [3]. The dtype of the result is that of the directions.

    Bad values: a direction or parameter that is not finite, or a parameter below the least value that its model states
    (a negative roughness or exponent, say), gives NaN, also below the horizon, and NaN derivatives.

    Derivatives: in both directions and every parameter; finite everywhere, and zero below the horizon. Directions are
    taken as unit vectors, not normalised, so only derivatives along the sphere mean something. `value` jumps at the
    horizon, wi.z = 0 or wo.z = 0; `value_cosine` is continuous at wi.z = 0 where `value` is bounded.
    """

    isotropic: eqx.AbstractVar[bool]  # static: whether turning wi and wo together about the normal changes nothing
    least: ClassVar[Mapping[str, float]] = {}  # of the parameters that have a least value

    @abc.abstractmethod
    def value(self, wi: ArrayLike, wo: ArrayLike) -> Colour:
        """f(wi, wo) in 1/sr, without cosine; zero when wi.z <= 0 or wo.z <= 0."""

    @property
    @abc.abstractmethod
    def lobe_width(self) -> Scalar:
        """Rough half width at half maximum of the narrowest feature, in radians of wi around the mirror direction.

        A hint for grading quadrature, at most 1, whose gradient is stopped. No result depends on its exact value.
        """

    @final
    def value_cosine(self, wi: ArrayLike, wo: ArrayLike) -> Colour:
        """f(wi, wo) max(wi.z, 0) in 1/sr: the function that is expanded in harmonics (ISD15 Eq. 21)."""
        value = self.value(wi, wo)
        cosine = jnp.maximum(_checks.real_array("wi", wi)[2], 0)
        return value * cosine.astype(value.dtype)


def parameter(name: str, shapes: tuple[tuple[int, ...], ...]) -> Callable[[Parameter], Array]:
    """A converter for a model's field: a floating array, never a Python number, of one of the given shapes."""

    def convert(value: Parameter) -> Array:
        array = _checks.real_array(name, jnp.asarray(value) if isinstance(value, list | tuple) else value)  # type: ignore[arg-type]
        if array.shape not in shapes:
            allowed = " or ".join("a scalar" if not s else f"of shape {list(s)}" for s in shapes)
            raise ValueError(f"`{name}` must be {allowed}; got shape {list(array.shape)}. Use jax.vmap for batches.")
        return jax.lax.convert_element_type(array, array.dtype)  # drops the weak type that a Python number leaves

    return convert


def scalar(name: str) -> Callable[[Parameter], Array]:
    return parameter(name, ((),))


def colour(name: str) -> Callable[[Parameter], Array]:
    return parameter(name, ((), (3,)))


def above_horizon(
    wi: ArrayLike, wo: ArrayLike, model: AbstractBrdf | None = None
) -> tuple[Vector, Vector, Array, Array]:
    """Checked directions of one dtype, whether both are above the horizon, and the value where they are not.

    Where they are not, both are replaced by the normal: the formula that follows stays finite, and so does its
    derivative, and the caller selects the value elsewhere. That is 0, or NaN with NaN derivatives in everything if a
    direction or a parameter of `model` is bad.
    """
    wi, wo = _checks.real_array("wi", wi), _checks.real_array("wo", wo)
    for name, direction in (("wi", wi), ("wo", wo)):
        if direction.shape != (3,):
            shape = list(direction.shape)
            raise ValueError(f"`{name}` must have shape [3]; got {shape}. Use jax.vmap for batches.")
    dtype = max(wi.dtype, wo.dtype, key=lambda d: d.itemsize)
    wi, wo = wi.astype(dtype), wo.astype(dtype)
    fields = jax.tree.leaves(model)
    bounded = [(getattr(model, name), least) for name, least in getattr(model, "least", {}).items()]
    good = [jnp.isfinite(x) for direction in (wi, wo) for x in direction] + [jnp.all(jnp.isfinite(a)) for a in fields]
    good += [jnp.all(a >= b) for a, b in bounded if a is not None]
    good = functools.reduce(jnp.logical_and, good)
    tiny = jnp.finfo(dtype).tiny  # times it nothing overflows, and NaN is NaN
    marks = [x for direction in (wi, wo) for x in direction] + [jnp.sum(a.astype(dtype) * tiny) for a in fields]
    elsewhere = jnp.where(good, 0, jnp.nan).astype(dtype) * functools.reduce(jnp.add, marks)
    above = (wi[2] > 0) & (wo[2] > 0) & good
    # component by component, here and below: `Ggx` at 16,384 points takes 12 ns each so, 54 as vectors (jax 0.10.2)
    here = lambda d: jnp.stack([jnp.where(above, x, n).astype(dtype) for x, n in zip(d, (0, 0, 1), strict=True)])
    return here(wi), here(wo), above, elsewhere


def cast(model: Pytree, dtype: DTypeLike) -> Pytree:
    """The same model with every array in `dtype`."""
    return jax.tree.map(lambda array: array.astype(dtype), model)


def half_vector(wi: Vector, wo: Vector) -> tuple[Vector, Scalar]:
    """The unit half vector h, and cos(theta_d) = wi.h = wo.h = |wi + wo| / 2."""
    total = wi[0] + wo[0], wi[1] + wo[1], wi[2] + wo[2]
    scale = jax.lax.stop_gradient(functools.reduce(jnp.maximum, map(jnp.abs, total)))
    x, y, z = (t / scale for t in total)
    length = jnp.sqrt(x * x + y * y + z * z)
    half = x / length, y / length, z / length
    return jnp.stack(half), dot(total, half) / 2


def schlick_fresnel(cosine: Scalar, f0: Colour) -> Colour:
    """Schlick 1994, Eq. 15: reflectance at an angle from that at normal incidence."""
    return f0 + (1 - f0) * (1 - cosine) ** 5


def conductor_fresnel(cosine: Scalar, eta: Colour, k: Colour) -> Colour:
    """Unpolarised reflectance for the complex index eta + i k relative to the outside; k = 0 is a dielectric.

    With a + i b = sqrt((eta + i k)^2 - sin^2), the Fresnel coefficients are r_s = (cos - a - i b) / (cos + a + i b) and
    r_p = r_s (a + i b - sin^2 / cos) / (a + i b + sin^2 / cos). Whichever of a, b would cancel is taken from
    a b = eta k.
    """
    cosine2 = cosine * cosine
    sine2 = 1 - cosine2
    real, product = eta * eta - k * k - sine2, eta * k
    floor = (
        jnp.finfo(cosine.dtype).eps ** 2
    )  # of sums that vanish only at a limit of the angle, for eta = 1 or 0, k = 0
    size2 = real * real + 4 * product * product
    size = safe_sqrt(size2)  # a^2 + b^2
    larger = jnp.maximum((size + jnp.abs(real)) / 2, floor)  # the larger of a^2 and b^2
    a2 = jnp.where(real >= 0, larger, product * product / larger)
    a = safe_sqrt(a2)  # a = 0: total reflection, derivative zero
    s, d = jnp.maximum(size + cosine2, floor), 2 * a * cosine
    r_s = (s - d) / (s + d)
    s, d = jnp.maximum(cosine2 * size + sine2 * sine2, floor), d * sine2
    return r_s * (1 + (s - d) / (s + d)) / 2


def ggx_distribution(half: Vector, alpha_x: Scalar, alpha_y: Scalar) -> Scalar:
    """D(h) in 1/sr, with projected area one: integral of D(h) h.z dh = 1 (W07 Eq. 33, H14 Eq. 85)."""
    x, y, z = half[0] / alpha_x, half[1] / alpha_y, half[2]
    return 1 / (math.pi * alpha_x * alpha_y * (x * x + y * y + z * z) ** 2)


def smith_over_cosine(direction: Vector, alpha_x: Scalar, alpha_y: Scalar) -> Scalar:
    """G1(w) / w.z = 2 / (w.z + sqrt(w.z^2 + (alpha_x w.x)^2 + (alpha_y w.y)^2)): W07 Eq. 34, H14 Eq. 86."""
    x, y, z = direction
    return 2 / (z + jnp.sqrt(z * z + (alpha_x * x) ** 2 + (alpha_y * y) ** 2))


class Lambertian(AbstractBrdf):
    """f = albedo / pi. The albedo is exactly the share of energy that is reflected; energy is conserved up to 1.

    Arguments: `albedo`, scalar or [3], dimensionless. Derivatives: constant in the directions above the horizon.
    """

    albedo: Colour = eqx.field(converter=colour("albedo"))
    isotropic: ClassVar[bool] = True

    def value(self, wi: ArrayLike, wo: ArrayLike) -> Colour:
        wi, wo, above, elsewhere = above_horizon(wi, wo, self)
        return jnp.where(above, cast(self, wi.dtype).albedo / math.pi, elsewhere)

    @property
    def lobe_width(self) -> Scalar:
        return jnp.ones((), self.albedo.dtype)


class Phong(AbstractBrdf):
    """Phong's lobe about the mirror direction, normalised in energy, and an optional diffuse part.

    f = diffuse / pi + specular (n + 2) / (2 pi) max(r.wi, 0)^n, with r the reflection of wo at the normal.

    Energy: the lobe reflects exactly `specular` when wo is the normal, and less at every other angle because part of it
    falls below the horizon. So specular + diffuse <= 1 keeps the whole below 1. Reciprocal.
    Arguments: `specular`, scalar or [3]; `exponent` n >= 0, scalar; `diffuse`, scalar or [3].
    Derivatives: everywhere; for n < 1 the lobe has a vertical tangent where r.wi = 0, and zero is returned there.
    Accuracy: float32 follows float64 to 3e-5 of the value up to n = 5000 (tests).
    Source: Lafortune and Willems 1994, Eq. 5 and 9.
    """

    specular: Colour = eqx.field(converter=colour("specular"))
    exponent: Scalar = eqx.field(converter=scalar("exponent"))
    diffuse: Colour = eqx.field(converter=colour("diffuse"), default=0.0)  # type: ignore[assignment]
    isotropic: ClassVar[bool] = True
    least: ClassVar = {"exponent": 0.0}

    def value(self, wi: ArrayLike, wo: ArrayLike) -> Colour:
        wi, wo, above, elsewhere = above_horizon(wi, wo, self)
        p = cast(self, wi.dtype)
        x, y, z = wi[0] + wo[0], wi[1] + wo[1], wi[2] - wo[2]  # from the mirror direction r to wi
        versine = (x * x + y * y + z * z) / 2  # 1 - r.wi
        inside = versine < 1
        power = jnp.where(inside, jnp.exp(p.exponent * jnp.log1p(-jnp.where(inside, versine, 0))), 0)
        lobe = p.specular * ((p.exponent + 2) / (2 * math.pi) * power)
        return jnp.where(above, p.diffuse / math.pi + lobe, elsewhere)

    @property
    def lobe_width(self) -> Scalar:
        return jax.lax.stop_gradient(1 / jnp.sqrt(1 + self.exponent))


class Ggx(AbstractBrdf):
    """Single scattering from GGX microfacets with separable Smith masking.

    f = D(h) F(cos theta_d) G1(wi) G1(wo) / (4 cos_i cos_o).

    Energy: below 1 for F <= 1; what scatters between facets is lost (at alpha = 1 more than half, at grazing views).
    Reciprocal. Arguments: `alpha` >= 0, the slope roughness (not its root): a scalar, or [2] for (alpha_x, alpha_y)
    along the local x and y axes. Fresnel: by Schlick from `f0`, scalar or [3], by default 1; or of a conductor when
    `eta` >= 0 and `k` >= 0 are given, scalar or [3], relative to the outside medium (k = 0 is a dielectric).
    Below 1e-6 `alpha` is taken as 1e-6, with gradient 0: at alpha = 0, a mirror, 2e-5 is left from 1 degree beside it.
    Derivatives: everywhere above the horizon; with k = 0 and eta < 1, total reflection has a kink.
    Accuracy: float32 follows float64 to 3e-6 of the value at the same directions (tests, alpha 0.02 to 1); rounding
    the directions themselves to float32 moves a narrow lobe by about 1e-7 / alpha of its width.
    Source: Walter et al. 2007, Eq. 20, 33, 34; Heitz 2014, Eq. 85, 86, 98.
    """

    alpha: Float[Array, ""] | Float[Array, "2"]
    f0: Colour | None
    eta: Colour | None
    k: Colour | None
    isotropic: bool = eqx.field(static=True)
    least: ClassVar = {"alpha": 0.0, "eta": 0.0, "k": 0.0}

    def __init__(
        self,
        alpha: Parameter,
        f0: Parameter | None = None,
        *,
        eta: Parameter | None = None,
        k: Parameter | None = None,
    ):
        self.alpha = parameter("alpha", ((), (2,)))(alpha)
        self.isotropic = self.alpha.ndim == 0
        if (eta is None) != (k is None):
            raise ValueError("`eta` and `k` belong together; pass both (k = 0 for a dielectric), or `f0` alone.")
        if eta is not None and f0 is not None:
            raise ValueError("`f0` and `eta`, `k` are two Fresnel models; pass one of them.")
        self.f0 = None if eta is not None else colour("f0")(1.0 if f0 is None else f0)
        self.eta = None if eta is None else colour("eta")(eta)
        self.k = None if k is None else colour("k")(k)

    def value(self, wi: ArrayLike, wo: ArrayLike) -> Colour:
        wi, wo, above, elsewhere = above_horizon(wi, wo, self)
        p = cast(self, wi.dtype)
        alpha = jnp.maximum(p.alpha, SMOOTHEST)
        alphas = (alpha, alpha) if p.isotropic else (alpha[0], alpha[1])
        half, cos_d = half_vector(wi, wo)
        facets = ggx_distribution(half, *alphas) * smith_over_cosine(wi, *alphas) * smith_over_cosine(wo, *alphas) / 4
        if p.f0 is not None:
            fresnel = schlick_fresnel(cos_d, p.f0)
        else:
            fresnel = conductor_fresnel(cos_d, p.eta, p.k)  # type: ignore[arg-type]  # given together
        return jnp.where(above, facets * fresnel, elsewhere)

    @property
    def lobe_width(self) -> Scalar:
        return jax.lax.stop_gradient(jnp.clip(jnp.min(self.alpha), SMOOTHEST, 1))


class CookTorrance(AbstractBrdf):
    """The metallic-roughness material of OCCT, sections 3 and 4.

    f = D F G / (4 cos_l cos_v) + (1 - F) (1 - m) c / pi, with alpha = r^2, D of GGX, Schlick's F from
    F0 = ((1 - ior) / (1 + ior))^2 (1 - m) + c m, and G of Smith and Schlick with k = alpha / 2, which is meant for
    light from all around. `direct=True` takes k = (r + 1)^2 / 8 instead, which OCCT advises for point and directional
    lights.

    Energy: that of the published model, which may pass 1 by a little for rough dielectrics. Reciprocal.
    Arguments: `roughness` r in [0, 1] and `metallic` m in [0, 1], scalars; `albedo` c and `ior` >= 0, scalar or [3];
    static `direct`. Below 1e-6 alpha is taken as 1e-6, with gradient 0: at r = 0 the lobe is a mirror, and away from it
    the diffuse part is left.
    Derivatives: everywhere above the horizon. Accuracy: float32 follows float64 to 3e-6 of the value at the same
    directions (tests, roughness 0.02 to 1).
    """

    roughness: Scalar = eqx.field(converter=scalar("roughness"))
    metallic: Scalar = eqx.field(converter=scalar("metallic"))
    albedo: Colour = eqx.field(converter=colour("albedo"))
    ior: Colour = eqx.field(converter=colour("ior"), default=1.5)  # type: ignore[assignment]
    direct: bool = eqx.field(static=True, default=False, kw_only=True)
    isotropic: ClassVar[bool] = True
    least: ClassVar = {"roughness": 0.0, "ior": 0.0}

    def value(self, wi: ArrayLike, wo: ArrayLike) -> Colour:
        wi, wo, above, elsewhere = above_horizon(wi, wo, self)
        p = cast(self, wi.dtype)
        # notation of OCCT: r, m, c as in the docstring; l = wi, v = wo.
        r, m, c = p.roughness, p.metallic, p.albedo
        alpha = jnp.maximum(r * r, SMOOTHEST)
        k = (r + 1) ** 2 / 8 if p.direct else alpha / 2
        f0 = ((1 - p.ior) / (1 + p.ior)) ** 2 * (1 - m) + c * m
        half, cos_vh = half_vector(wi, wo)
        d = ggx_distribution(half, alpha, alpha)
        g = 1 / ((wi[2] * (1 - k) + k) * (wo[2] * (1 - k) + k))  # G / (cos_l cos_v)
        f = schlick_fresnel(cos_vh, f0)
        return jnp.where(above, d * g / 4 * f + (1 - f) * (1 - m) * c / math.pi, elsewhere)

    @property
    def lobe_width(self) -> Scalar:
        return jax.lax.stop_gradient(jnp.clip(self.roughness**2, SMOOTHEST, 1))
