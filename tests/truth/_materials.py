"""Materials by their textbook formulas and tables by their published lookup."""

import mpmath
import numpy as np


def ggx_cosine(wi, wo, alpha, xp=np):
    """GGX of f0 = 0.04 times the cosine, as textbooks have it (Walter et al. 2007, Eq. 20, 33, 34); wi [..., 3]."""
    half = wi + wo
    half = half / xp.sqrt(xp.sum(half * half, axis=-1, keepdims=True))
    cos_h, cos_i, cos_o = half[..., 2], wi[..., 2], wo[..., 2]
    d = alpha**2 / (np.pi * (cos_h**2 * (alpha**2 - 1) + 1) ** 2)
    g1 = lambda cosine: 2 / (1 + xp.sqrt(1 + alpha**2 * (1 - cosine**2) / cosine**2))
    fresnel = 0.04 + 0.96 * (1 - xp.sum(half * wo, axis=-1)) ** 5
    return xp.where((cos_i > 0) & (cos_o > 0), d * fresnel * g1(cos_i) * g1(cos_o) / (4 * cos_o), 0)


def ggx_to_fifty_digits(alpha, wi, wo):
    """`ggx_cosine` in fifty digits: value, and derivatives in alpha and along the sphere in wi and wo."""
    with mpmath.workdps(50):
        vector = lambda x: mpmath.matrix([mpmath.mpf(float(v)) for v in x])
        unit = lambda x: x / mpmath.norm(x)

        def value(alpha, wi, wo):
            wi, wo = unit(wi), unit(wo)
            half = unit(wi + wo)
            d = alpha**2 / (mpmath.pi * (half[2] ** 2 * (alpha**2 - 1) + 1) ** 2)
            g1 = lambda c: 2 / (1 + mpmath.sqrt(1 + alpha**2 * (1 - c**2) / c**2))
            cosine = sum(half[i] * wo[i] for i in range(3))
            fresnel = mpmath.mpf("0.04") + mpmath.mpf("0.96") * (1 - cosine) ** 5
            return d * fresnel * g1(wi[2]) * g1(wo[2]) / (4 * wo[2])

        a, wi, wo, h = mpmath.mpf(float(alpha)), vector(wi), vector(wo), mpmath.mpf("1e-15")
        slope = lambda f: float((f(h) - f(-h)) / (2 * h))
        steps = [vector(s) for s in np.eye(3)]
        return (
            float(value(a, wi, wo)),
            slope(lambda t: value(a + t, wi, wo)),
            np.array([slope(lambda t, s=s: value(a, wi + t * s, wo)) for s in steps]),
            np.array([slope(lambda t, s=s: value(a, wi, wo + t * s)) for s in steps]),
        )


def nearest_bin(plane, wi, wo):
    """The table's bins as they are, at half and difference angles (Rusinkiewicz 1998), as published with the data."""
    half = wi + wo
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    theta_h, phi_h = np.arccos(np.clip(half[:, 2], -1, 1)), np.arctan2(half[:, 1], half[:, 0])
    cos, sin = np.cos(phi_h), np.sin(phi_h)
    x, y, z = cos * wi[:, 0] + sin * wi[:, 1], cos * wi[:, 1] - sin * wi[:, 0], wi[:, 2]
    x, z = np.cos(theta_h) * x - np.sin(theta_h) * z, np.sin(theta_h) * x + np.cos(theta_h) * z
    theta_d, phi_d = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x) % np.pi
    at = (90 * np.sqrt(theta_h / (np.pi / 2)), 90 * theta_d / (np.pi / 2), 180 * phi_d / np.pi)
    return plane[tuple(np.clip(i.astype(int), 0, n - 1) for i, n in zip(at, plane.shape, strict=True))]
