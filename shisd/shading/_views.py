"""Smooth interpolation over view directions: splines in elevation, Fourier series in azimuth.

A quantity f(theta, phi) that is smooth on the hemisphere of views has Fourier components f_k(theta) in azimuth with the
parity f_k(-theta) = (-1)^k f_k(theta), and f_k(theta) / sin(theta) is smooth for k > 0. Splines of these quotients,
with that parity built in, times sin(theta) cos(k phi) and sin(theta) sin(k phi), have a value and a gradient at theta
= 0 that do not depend on the azimuth chosen there. So a view along the normal is an ordinary view.

notation: elevation nodes theta_j = (j + 1/2) h, j = 0 ... V-1, h = (pi/2) / V; cubic B-splines B(theta/h - 1/2 - j)
with j = -2 ... V+1, so that every theta in [0, pi/2] sees four of them.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from shisd._numerics import angle_multiples, rows_of, safe_sqrt
from shisd._typing import Array, Float


def elevations(count: int) -> np.ndarray:
    """The nodes theta_j, in rad; no node lies on the normal or at the horizon."""
    return (np.arange(count) + 0.5) * (np.pi / 2 / count)


@functools.cache
def spline_matrices(count: int) -> np.ndarray:
    """Spline coefficients from values at the nodes, [2, V+4, V]: for functions even, then odd, about theta = 0.

    At the horizon the last coefficients continue the cubic of the last interval (not-a-knot).
    """
    matrices = []
    for sign in (1.0, -1.0):
        extend = np.zeros((count + 4, count))  # free coefficients a_0 ... a_{V-1} -> a_{-2} ... a_{V+1}
        extend[2:-2] = np.eye(count)
        extend[1], extend[0] = sign * extend[2], sign * extend[3]
        for row in (count + 2, count + 3):  # fourth difference zero
            extend[row] = 4 * extend[row - 1] - 6 * extend[row - 2] + 4 * extend[row - 3] - extend[row - 4]
        at_nodes = (extend[1:-3] + 4 * extend[2:-2] + extend[3:-1]) / 6
        matrices.append(extend @ np.linalg.inv(at_nodes))
    return np.stack(matrices)


def spline_table(
    values: Float[Array, "*batch orders v"], orders: np.ndarray | Array
) -> Float[Array, "*batch orders coefs"]:
    """Spline coefficients over the last axis of components of the given azimuthal `orders` k >= 0."""
    count = values.shape[-1]
    quotient = jnp.where(orders[:, None] > 0, jnp.asarray(1 / np.sin(elevations(count)), values.dtype)[None], 1)
    odd = (orders > 0) & (orders % 2 == 0)  # f_k / sin is odd for even k > 0
    even_matrix, odd_matrix = (jnp.asarray(m.T, values.dtype) for m in spline_matrices(count))
    scaled = values * quotient.reshape((1,) * (values.ndim - 2) + quotient.shape)
    return jnp.where(jnp.broadcast_to(odd[:, None], (*scaled.shape[:-1], 1)), scaled @ odd_matrix, scaled @ even_matrix)


def elevation(view: Float[Array, "p 3"]) -> Float[Array, " p"]:
    """The angle to the normal of local view directions; beyond the horizon that of the horizon."""
    return jnp.minimum(jnp.arctan2(_sine(view), view[:, 2]), np.pi / 2)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def spline_weights(theta: Float[Array, " p"], count: int) -> Float[Array, "coefs p"]:
    """The B-splines at elevations."""
    t = jnp.abs(_to_nodes(theta, count))
    return jnp.where(t < 1, (4 - 6 * t * t + 3 * t**3) / 6, jnp.maximum(2 - t, 0) ** 3 / 6)


@spline_weights.defjvp
def _spline_weights_jvp(count, primals, tangents):
    (theta,), (d_theta,) = primals, tangents
    t = _to_nodes(theta, count)
    size = jnp.abs(t)
    slope = jnp.where(size < 1, (1.5 * size - 2) * t, -0.5 * jnp.sign(t) * jnp.maximum(2 - size, 0) ** 2)
    return spline_weights(theta, count), slope * rows_of(d_theta, np.full(count + 4, count / (np.pi / 2)))


def _to_nodes(theta: Float[Array, " p"], count: int) -> Float[Array, "coefs p"]:
    """Elevations as numbers of intervals from each node."""
    j = jnp.arange(-2, count + 2, dtype=theta.dtype)
    return theta[None, :] * (count / (np.pi / 2)) - 0.5 - j[:, None]


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def azimuth_factors(view: Float[Array, "p 3"], count: int) -> tuple[Float[Array, "k p"], Float[Array, "k p"]]:
    """sin(theta) cos(k phi) and sin(theta) sin(k phi) for k = 1 ... count-1, after 1 and 0 for k = 0."""
    x, y = view[None, :, 0], view[None, :, 1]
    cos, sin = angle_multiples(*azimuth(view), max(count - 1, 1))
    real = jnp.concatenate([jnp.ones_like(x), x * cos - y * sin])  # (x, y) = sin(theta) (cos, sin)(phi)
    return real[:count], jnp.concatenate([jnp.zeros_like(x), x * sin + y * cos])[:count]


@azimuth_factors.defjvp
def _azimuth_factors_jvp(count, primals, tangents):
    (view,), (d_view,) = primals, tangents
    cos, sin = angle_multiples(*azimuth(view), max(count, 2))
    dx, dy = d_view[:, 0], d_view[:, 1]
    k = np.arange(count)
    along = rows_of(cos[1] * dx + sin[1] * dy, np.minimum(k, 1))  # d sin(theta)
    across = rows_of(cos[1] * dy - sin[1] * dx, k)  # sin(theta) k d phi
    cos, sin = cos[:count], sin[:count]
    return azimuth_factors(view, count), (cos * along - sin * across, sin * along + cos * across)


def azimuth(view: Float[Array, "p 3"]) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """cos(phi) and sin(phi), with phi = 0 at the normal."""
    sine = _sine(view)
    off = sine > 0
    safe = jnp.where(off, sine, 1)
    return jnp.where(off, view[:, 0] / safe, 1), view[:, 1] / safe


def _sine(view: Float[Array, "p 3"]) -> Float[Array, " p"]:
    return safe_sqrt(view[:, 0] ** 2 + view[:, 1] ** 2)
