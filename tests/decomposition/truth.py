"""ISD15 Eq. 7 and 10 from SciPy, independent of the package."""

import numpy as np

from tests.truth import scipy_basis as sh


def matrices(z, degree):
    """M_l of every band: a list of [2l+1, K]."""
    z = np.asarray(z, dtype=np.float64)
    y = sh(z / np.linalg.norm(z, axis=1, keepdims=True), degree)
    return [np.sqrt(4 * np.pi / (2 * l + 1)) * y[:, l * l : (l + 1) ** 2].T for l in range(degree + 1)]


def conditions(z, degree, nested=False):
    return np.array([np.linalg.cond(m[:, : 2 * l + 1] if nested else m) for l, m in enumerate(matrices(z, degree))])
