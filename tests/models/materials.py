"""One material of each kind, shared by the tests of the contract, and directions to try them on.

The fitted rows are facts published in the supplements of Low et al. 2012 (nickel) and Bagher et al. 2012 (gold metallic
paint); gold's n and k at 659.5, 548.6 and 450.9 nm are those of Johnson and Christy 1972.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import models

GOLD = {"eta": [0.14, 0.43, 1.38], "k": [3.697, 2.455, 1.914]}
NICKEL = {
    "diffuse": [0.006227, 0.006663, 0.007587],
    "a": [36.614742, 32.745403, 28.906111],
    "b": 705.733887,
    "c": 1.945258,
    "ior": 5.441883,
}
GOLD_PAINT = {
    "diffuse": [0.0178625, 0.00995704, 0.00335044],
    "specular": [0.17127, 0.120714, 0.115473],
    "alpha": [0.127954, 0.127825, 0.109623],
    "p": [0.781093, 0.795517, 0.661313],
    "f0": [1.00776e-12, 1.22243e-15, 6.18432e-13],
    "f1": [-1.0, -1.0, -0.334497],
    "normalization": [5.90039, 5.83556, 7.14985],
    "masking": [2.7548, 2.7057, 2.94348],
    "c": [9.46481e-08, 1.06951e-07, 1.10733e-07],
    "k": [23.8811, 23.9059, 24.2972],
    "shift": [-0.303345, -0.293778, -0.267019],
}
BRDFS = {
    "lambertian": lambda: models.Lambertian([0.2, 0.5, 0.8]),
    "phong": lambda: models.Phong([0.3, 0.4, 0.5], 40.0, 0.2),
    "ggx": lambda: models.Ggx(0.3, [0.9, 0.5, 0.2]),
    "ggx_anisotropic": lambda: models.Ggx([0.2, 0.5], 0.8),
    "ggx_gold": lambda: models.Ggx(0.15, **GOLD),
    "ggx_glass": lambda: models.Ggx(0.2, eta=1.5, k=0.0),
    "cook_torrance": lambda: models.CookTorrance(0.4, 0.3, [0.8, 0.4, 0.1]),
    "cook_torrance_direct": lambda: models.CookTorrance(0.6, 0.0, 0.5, 1.8, direct=True),
    "abc": lambda: models.AbcMicrofacet(**NICKEL),
    "sgd": lambda: models.SgdMicrofacet(**{**GOLD_PAINT, "f0": 0.04}),
}
SHARP = {  # of the same structure as above, so that compiled code is shared
    "phong_5000": lambda: models.Phong([0.3, 0.4, 0.5], 5000.0, 0.0),
    "ggx_0.02": lambda: models.Ggx(0.02, [0.9, 0.5, 0.2]),
    "ggx_anisotropic_0.02_1": lambda: models.Ggx([0.02, 1.0], 0.9),
    "cook_torrance_0.02": lambda: models.CookTorrance(0.02, 1.0, [0.9, 0.5, 0.2]),
    "ggx_1": lambda: models.Ggx(1.0, [0.9, 0.5, 0.2]),
    "cook_torrance_1": lambda: models.CookTorrance(1.0, 0.0, [0.9, 0.5, 0.2]),
}


def spherical(theta, phi):
    """Directions [..., 3] of polar and azimuth angles in radians."""
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def hemisphere(rng, count, least=0.0):
    """Uniform directions with z > least."""
    z = rng.uniform(least, 1, count)
    phi = rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)


def hemisphere_rule(polar=200, azimuth=400):
    """Directions [N, 3] and weights [N] in sr: Gauss and Legendre in the angle theta, equal steps in phi."""
    x, w = np.polynomial.legendre.leggauss(polar)
    theta = np.pi / 4 * (x + 1)
    phi = 2 * np.pi * (np.arange(azimuth) + 0.5) / azimuth
    directions = spherical(theta[:, None], phi[None, :]).reshape(-1, 3)
    weights = np.repeat(w * np.pi / 4 * np.sin(theta) * 2 * np.pi / azimuth, azimuth)
    return directions, weights


def pairs(rng, count, least=0.0):
    """Directions wi, wo [N, 3]: half of them independent, half of them near each other's mirror direction."""
    wi, wo = hemisphere(rng, count, least), hemisphere(rng, count, least)
    near = wo * [-1, -1, 1] + 0.05 * rng.standard_normal((count, 3))
    near /= np.linalg.norm(near, axis=-1, keepdims=True)
    take = (np.arange(count) % 2 == 1) & (near[:, 2] > least)
    return np.where(take[:, None], near, wi), wo


@eqx.filter_jit
def evaluate(brdf, wi, wo):
    """`brdf.value` at rows of directions; compiled once for all parameters of one model."""
    return jax.vmap(brdf.value)(wi, wo)


@eqx.filter_jit
def slopes(brdf, wi, wo):
    """`brdf.value` at rows of directions, the sum over colours of `brdf.value_cosine`, and its derivatives: in the list
    of parameters, in wi and in wo.
    """
    leaves, tree = jax.tree.flatten(brdf)

    def f(leaves, wi, wo):
        model = jax.tree.unflatten(tree, leaves)
        return jnp.sum(model.value_cosine(wi, wo)), model.value(wi, wo)

    both = jax.vmap(jax.value_and_grad(f, argnums=(0, 1, 2), has_aux=True), in_axes=(None, 0, 0))
    (cosined, value), derivatives = both(leaves, wi, wo)
    return value, cosined, derivatives


def array(values, dtype):
    return jnp.asarray(np.asarray(values), dtype)


def spoiled(table, rng, noise=0.1, holes=0.5):
    """A MERL table with log-normal noise in each value, and with a share of the bins missing in all colours."""
    noisy = np.where(table < 0, table, table * np.exp(noise * rng.standard_normal(table.shape)))
    return np.where(rng.random(table.shape[:3])[..., None] < holes, -1.0, noisy)


def albedos(brdf, elevations, rule):
    """Hemispherical-directional albedo [elevations, *colour] by `hemisphere_rule(*rule)`, float32."""
    wi, weight = (array(a, np.float32) for a in hemisphere_rule(*rule))
    views = [jnp.broadcast_to(array(spherical(e, 0.3), np.float32), wi.shape) for e in elevations]
    return np.stack([(weight * wi[:, 2]) @ evaluate(brdf, wi, view) for view in views])
