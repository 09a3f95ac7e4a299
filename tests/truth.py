"""Truth from independent libraries, which no code under test takes part in."""

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
