"""Real harmonics: those of SciPy, and the recurrence in degree with its derivatives in extended precision."""

import numpy as np
from scipy.special import sph_harm_y


def scipy_basis(directions, degree):
    """SciPy's complex harmonics, whose phase is Condon-Shortley's, as real ones: ISD15 Eq. 7."""
    d = np.asarray(directions, float)
    theta, phi = np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2]), np.arctan2(d[..., 1], d[..., 0])
    l = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    m = np.concatenate([np.arange(-k, k + 1) for k in range(degree + 1)])
    y = sph_harm_y(l, np.abs(m), theta[..., None], phi[..., None])
    return np.where(m == 0, y.real, np.sqrt(2) * np.where(m > 0, y.real, y.imag))


def harmonics(directions, degree):
    """Real harmonics [N, n] of unit vectors along `directions`, and their derivatives along the sphere [N, n, 3].

    The normalised recurrence in degree (ISD15s Eq. 3-5) and its derivative, Cartesian, in extended precision: y_l^m is
    a polynomial in z times the real or imaginary part of (x + i y)^m, so poles are ordinary points.
    """
    u = np.asarray(directions, np.longdouble)
    u = u / np.max(np.abs(u), axis=-1, keepdims=True)
    u = u / np.sqrt(np.sum(u * u, axis=-1, keepdims=True))
    x, y, z = u.T
    m = np.arange(degree + 1)
    power = [np.ones_like(x), np.zeros_like(x)]
    cos, sin = [power[0]], [power[1]]
    for _ in range(degree):
        power = [power[0] * x - power[1] * y, power[0] * y + power[1] * x]
        cos.append(power[0])
        sin.append(power[1])
    cos, sin = np.stack(cos), np.stack(sin)  # [m, N]
    less = lambda wave: m[:, None] * np.concatenate([0 * wave[:1], wave[:-1]])  # m (x + i y)^(m-1)
    q = np.zeros((3, degree + 1, len(x)), np.longdouble)  # degrees l-2, l-1, l
    dq = np.zeros_like(q)
    values = np.zeros(((degree + 1) ** 2, len(x)), np.longdouble)
    slopes = np.zeros((3, *values.shape), np.longdouble)
    for l in range(degree + 1):
        k = m[:l].astype(np.longdouble)[:, None]
        q, dq = np.roll(q, -1, axis=0), np.roll(dq, -1, axis=0)
        a, b = np.sqrt((4 * l * l - 1) / (l * l - k * k)), np.sqrt(((l - 1) ** 2 - k * k) / abs(4 * (l - 1) ** 2 - 1))
        q[2, :l] = a * (z * q[1, :l] - b * q[0, :l])
        dq[2, :l] = a * (q[1, :l] + z * dq[1, :l] - b * dq[0, :l])
        one = np.longdouble(1)
        q[2, l] = -np.sqrt((2 * l + one) / (2 * l)) * q[1, l - 1] if l else 1 / np.sqrt(4 * np.arctan2(one, 0) * 2)
        dq[2, l] = 0
        scale = np.where(np.arange(l + 1) > 0, np.sqrt(2 * one), one)[:, None]
        for sign, wave, wave_x, wave_y in ((1, cos, less(cos), -less(sin)), (-1, sin, less(sin), less(cos))):
            at = l * l + l + sign * m[: l + 1]
            at, take = (at, slice(0, l + 1)) if sign > 0 else (at[1:], slice(1, l + 1))
            p, dp = scale[take] * q[2, take], scale[take] * dq[2, take]
            values[at] = p * wave[take]
            slopes[:, at] = p * wave_x[take], p * wave_y[take], dp * wave[take]
    slopes = np.moveaxis(slopes, 0, -1)
    slopes = slopes - np.sum(slopes * u, axis=-1, keepdims=True) * u
    return values.T, np.swapaxes(slopes, 0, 1)
