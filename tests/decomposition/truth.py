"""ISD15 Eq. 7 and 10 from SciPy, independent of the package."""

import numpy as np
from scipy.special import sph_harm_y


def sh(z, degree):
    """Real spherical harmonics at unit vectors z [N, 3]: [N, (L+1)^2]."""
    theta, phi = np.arctan2(np.hypot(z[:, 0], z[:, 1]), z[:, 2]), np.arctan2(z[:, 1], z[:, 0])
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            y = sph_harm_y(l, abs(m), theta, phi)
            columns.append(y.real if m == 0 else np.sqrt(2) * (y.real if m > 0 else y.imag))
    return np.stack(columns, axis=-1)


def matrices(z, degree):
    """M_l of every band: a list of [2l+1, K]."""
    z = np.asarray(z, dtype=np.float64)
    y = sh(z / np.linalg.norm(z, axis=1, keepdims=True), degree)
    return [np.sqrt(4 * np.pi / (2 * l + 1)) * y[:, l * l : (l + 1) ** 2].T for l in range(degree + 1)]


def conditions(z, degree, nested=False):
    return np.array([np.linalg.cond(m[:, : 2 * l + 1] if nested else m) for l, m in enumerate(matrices(z, degree))])
