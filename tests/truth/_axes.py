"""Sets of axes: ISD15 Eq. 10 from SciPy's harmonics, condition numbers, and a bound on them."""

import numpy as np
from numpy.polynomial import legendre as series
from scipy.optimize import linprog

from tests.truth._harmonics import scipy_basis


def band_matrices(z, degree):
    """M_l of every band: a list of [2l+1, K]."""
    z = np.asarray(z, dtype=np.float64)
    y = scipy_basis(z / np.linalg.norm(z, axis=1, keepdims=True), degree)
    return [np.sqrt(4 * np.pi / (2 * l + 1)) * y[:, l * l : (l + 1) ** 2].T for l in range(degree + 1)]


def conditions(z, degree, nested=False):
    """Condition number of every band [L+1]; nested: of its first 2l+1 axes."""
    bands = band_matrices(z, degree)
    return np.array([np.linalg.cond(m[:, : 2 * l + 1] if nested else m) for l, m in enumerate(bands)])


def condition_bound(l: int, count: int) -> float:
    """No `count` axes condition band l better than this.

    With G = P_l(z_i . z_j) of trace K, the variance of the 2l+1 nonzero eigenvalues, v in units of their squared mean,
    follows from E = sum over i != j of P_l(z_i . z_j)^2, and a ratio cond^2 of extremes allows at most
    v = (cond - 1/cond)^2 / 4. E is bounded from below by linear programming (Delsarte; Yudin 1992): for any even
    f = sum f_n P_n <= P_l^2 with f_n >= 0 for n > 0, all pairs, i = j too, have sum f(z_i . z_j) >= K^2 f_0, so
    E >= K^2 f_0 - K f(1).
    """
    top = max(4 * l, 8) + 8
    n = np.arange(0, top + 1, 2)
    values = lambda x: series.legvander(x, top)[:, n]
    square = lambda x: series.legval(x, np.eye(l + 1)[l]) ** 2
    x = np.cos(np.linspace(0, np.pi / 2, 2000))
    bounds = [(None, None)] + [(0, None)] * (len(n) - 1)
    found = linprog(1 - count * (n == 0), A_ub=values(x), b_ub=square(x), bounds=bounds, method="highs")
    fine = np.cos(np.linspace(0, np.pi / 2, 40_000))  # f is lowered where it exceeds P_l^2 between the points above
    excess = max(np.max(values(fine) @ found.x - square(fine)), 0)
    energy = -count * found.fun - count * (count - 1) * excess
    variance = max((count + energy) * (2 * l + 1) / count**2 - 1, 0)
    return np.sqrt(variance) + np.sqrt(1 + variance)
