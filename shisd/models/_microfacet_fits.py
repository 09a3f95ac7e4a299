"""Two microfacet models whose published parameters fit the measured MERL materials.

ABC: Low, Kronander, Ynnerman, Unger 2012, *BRDF Models for Accurate and Efficient Rendering of Glossy Surfaces*.
SGD: Bagher, Soler, Holzschuch 2012, *Accurate fitting of measured reflectances using a Shifted Gamma micro-facet
Distribution*. Both are written here so that powers and exponentials neither overflow in float32 nor spoil a gradient.
"""

import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd._numerics import safe_sqrt
from shisd._typing import Array, ArrayLike, Scalar, Vector
from shisd.models._brdf import AbstractBrdf, Colour, above_horizon, cast, colour, half_vector

TINY = float(np.finfo(np.float32).tiny)  # the least positive number, where a parameter has to be positive


def dielectric_fresnel(cosine: Scalar, ior: Colour) -> Colour:
    """Unpolarised reflectance of a dielectric of real index `ior` > 1 relative to the outside."""
    g2 = ior * ior - 1 + cosine * cosine
    tiny = jnp.finfo(cosine.dtype).tiny
    g = jnp.sqrt(jnp.maximum(g2, tiny))  # below zero is total reflection, at ior < 1: both terms are then 1
    r_s = (g - cosine) / (g + cosine)
    r_p = (ior * ior * cosine - g) / (ior * ior * cosine + g)
    return (r_s * r_s + r_p * r_p) / 2


class AbcMicrofacet(AbstractBrdf):
    """The ABC model: microfacets whose distribution falls like an inverse power.

    f = diffuse / pi + a (1 + b (1 - cos theta_h))^-c F(cos theta_d) G / (pi cos_i cos_o), F the unpolarised Fresnel
    reflectance for the real index `ior`, G = min(1, 2 cos_h cos_i / cos_d, 2 cos_h cos_o / cos_d).

    Arguments: `diffuse`, `a`, `b` >= 0, `c` >= 0 and `ior` >= 0, each scalar or [3]. Energy: as fitted; the model has
    no bound of its own. Reciprocal.
    Derivatives: everywhere above the horizon; G has kinks where its branches meet. `value` grows like 1 / cos only when
    both directions are grazing and opposite.
    Accuracy: float32 follows float64 to 3e-6 of the value for the published nickel (tests).
    Source: Low et al. 2012, Eq. 13 and 14, with the parameters of their supplement.
    """

    diffuse: Colour = eqx.field(converter=colour("diffuse"))
    a: Colour = eqx.field(converter=colour("a"))
    b: Colour = eqx.field(converter=colour("b"))
    c: Colour = eqx.field(converter=colour("c"))
    ior: Colour = eqx.field(converter=colour("ior"))
    isotropic: ClassVar[bool] = True
    least: ClassVar = {"b": 0.0, "c": 0.0, "ior": 0.0}

    def value(self, wi: ArrayLike, wo: ArrayLike) -> Colour:
        wi, wo, above, elsewhere = above_horizon(wi, wo, self)
        p = cast(self, wi.dtype)
        half, cos_d = half_vector(wi, wo)
        versine = (half[0] ** 2 + half[1] ** 2) / (1 + half[2])  # 1 - cos theta_h
        distribution = p.a * jnp.exp(-p.c * jnp.log1p(p.b * versine))
        # G / (cos_i cos_o) with 2 cos_h cos_d = cos_i + cos_o put in: nothing divides by a cosine alone.
        cos_i, cos_o = wi[2], wo[2]
        valley = cos_d**2 * jnp.maximum(cos_i, cos_o) / (cos_i + cos_o)
        shadowing = 1 / jnp.maximum(jnp.maximum(cos_i * cos_o, valley), jnp.finfo(cos_i.dtype).tiny)
        specular = distribution * dielectric_fresnel(cos_d, p.ior) * (shadowing / math.pi)
        return jnp.where(above, p.diffuse / math.pi + specular, elsewhere)

    @property
    def lobe_width(self) -> Scalar:
        half_maximum = 2 ** (1 / self.c) - 1  # of b (1 - cos theta_h)
        width = 2 * jnp.sqrt(2 * half_maximum / self.b)
        return jax.lax.stop_gradient(jnp.minimum(jnp.min(width), 1))


class SgdMicrofacet(AbstractBrdf):
    """The SGD model: microfacets with a shifted gamma distribution, fitted channel by channel.

    f = diffuse / pi + specular F D G1(theta_i) G1(theta_o) / (pi cos_i cos_o), with
    F = f0 - f1 cos_d + (1 - f0) (1 - cos_d)^5,
    D = kappa exp(-x) / (pi x^p cos_h^4), x = alpha + tan^2(theta_h) / alpha,
    G1(theta) = 1 + lambda (1 - exp(c max(theta - theta0, 0)^k)), kept within [0, 1]. F is kept above 0, which the
    published formula is not for three of the fabrics (by up to 0.07).

    Arguments: all scalar or [3], in the order of the published table; `shift` is its theta0, in radians, `masking` its
    lambda, `normalization` its kappa (K). alpha > 0, c > 0, k >= 0.
    Energy: as fitted. Reciprocal. Where G1 has not reached zero at 90 degrees, `value` grows like 1 / cos towards
    grazing angles, as published; `value_cosine` then stays bounded as wi.z -> 0 but not as wo.z -> 0.
    Derivatives: everywhere above the horizon; F and G1 have kinks where they meet 0, and G1 a conical point at the
    normal when theta0 < 0, where its gradient is returned as 0.
    Accuracy: float32 follows float64 to 3e-5 of the value where both cosines are above 0.01, for the published gold
    metallic paint (tests); nearer to grazing angles G1 is the small difference of larger numbers.
    Source: Bagher et al. 2012, Eq. 9 to 14, with the parameters of their supplement.
    """

    diffuse: Colour = eqx.field(converter=colour("diffuse"))
    specular: Colour = eqx.field(converter=colour("specular"))
    alpha: Colour = eqx.field(converter=colour("alpha"))
    p: Colour = eqx.field(converter=colour("p"))
    f0: Colour = eqx.field(converter=colour("f0"))
    f1: Colour = eqx.field(converter=colour("f1"))
    normalization: Colour = eqx.field(converter=colour("normalization"))
    masking: Colour = eqx.field(converter=colour("masking"))
    c: Colour = eqx.field(converter=colour("c"))
    k: Colour = eqx.field(converter=colour("k"))
    shift: Colour = eqx.field(converter=colour("shift"))
    isotropic: ClassVar[bool] = True
    least: ClassVar = {"alpha": TINY, "c": TINY, "k": 0.0}

    def value(self, wi: ArrayLike, wo: ArrayLike) -> Colour:
        wi, wo, above, elsewhere = above_horizon(wi, wo, self)
        s = cast(self, wi.dtype)
        half, cos_d = half_vector(wi, wo)
        cos2_h = jnp.maximum(half[2] ** 2, 1e-12)  # exp(-x) is zero long before
        x = s.alpha + (half[0] ** 2 + half[1] ** 2) / cos2_h / s.alpha
        d = s.normalization / math.pi * jnp.exp(-x - s.p * jnp.log(x) - 2 * jnp.log(cos2_h))
        f = jnp.maximum(s.f0 - s.f1 * cos_d + (1 - s.f0) * (1 - cos_d) ** 5, 0)
        g = s._masking(wi) / wi[2] * (s._masking(wo) / wo[2])
        return jnp.where(above, s.diffuse / math.pi + s.specular * f * d * g / math.pi, elsewhere)

    def _masking(self, direction: Vector) -> Array:
        """G1(theta), with c (theta - theta0)^k from its logarithm, kept below 60: exp(60) = 1e26, and G1 long zero."""
        sine2 = direction[0] ** 2 + direction[1] ** 2
        theta = jnp.arctan2(safe_sqrt(sine2), direction[2])
        beyond = theta > self.shift
        excess = jnp.where(beyond, theta - self.shift, 1)
        power = jnp.exp(jnp.minimum(jnp.log(self.c) + self.k * jnp.log(excess), math.log(60)))
        return jnp.clip(1 - self.masking * jnp.expm1(jnp.where(beyond, power, 0)), 0, 1)

    @property
    def lobe_width(self) -> Scalar:
        # log D falls from its peak like -tan^2 (1 + p / alpha) / alpha
        width = 2 * math.sqrt(math.log(2)) * self.alpha / jnp.sqrt(self.alpha + jnp.maximum(self.p, 0))
        return jax.lax.stop_gradient(jnp.minimum(jnp.min(width), 1))
