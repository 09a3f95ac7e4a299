"""Make shisd/decomposition/data/optimized_directions.npz: 2L+1 shared axes for each degree L = 0 ... 64.

    python tests/bench/make_directions.py [--overwrite] [--output FILE] [--degrees 0 1 2] [--effort 1.0]

For each degree: every start (Fibonacci, Halton, then seeded random axes) is optimised with the default powers, the two
best go on with higher powers, and the best of those is kept. Above degree 32 the Fibonacci start alone is, without
more. With --overwrite, a degree of the old table is replaced only if its condition number falls. The shipped table took
--effort 1 up to degree 17, 0.25 up to degree 24 and 0 above: an hour and a half on one busy core.

The file holds `directions` [65^2, 3], rows L^2 ... (L+1)^2 - 1 for degree L, and the worst band's condition number,
computed with SciPy and NumPy alone: `conditions` [65] where all axes serve every band, `nested_conditions` [65] where
only the first 2l+1 do. Within a degree the rows are ordered such that the first 2l+1 are
a good choice for band l alone: from the last to the first, the axis is dropped that takes least of the determinant.
"""

import argparse
import time
from pathlib import Path

import jax
import numpy as np
from scipy.special import sph_harm_y

from shisd import decomposition
from shisd.decomposition._directions import low_discrepancy_directions, random_directions
from shisd.io.internal import write_atomically

OUTPUT = Path(decomposition.__file__).parent / "data" / "optimized_directions.npz"
TOP = 64
MANY_STARTS = 32
POLISH = (20.0, 60.0)


def band_matrix(z: np.ndarray, l: int) -> np.ndarray:
    """M_l of ISD15 Eq. 10, up to signs of rows, without the package: [2l+1, K]."""
    m = np.arange(l + 1)[:, None]
    y = sph_harm_y(l, m, np.arccos(np.clip(z[:, 2], -1, 1)), np.arctan2(z[:, 1], z[:, 0]))
    rows = np.concatenate([y.real[:1], np.sqrt(2) * y.real[1:], np.sqrt(2) * y.imag[1:]])
    return np.sqrt(4 * np.pi / (2 * l + 1)) * rows


def worst_condition(z: np.ndarray, degree: int, *, nested: bool = False) -> float:
    return max(np.linalg.cond(band_matrix(z[: 2 * l + 1] if nested else z, l)) for l in range(degree + 1))


def starts(degree: int, effort: float):
    count = 2 * degree + 1
    numbers = {4: 150, 8: 60, 12: 30, 16: 16, 20: 8, 24: 6, 28: 5, TOP: 4}
    number = next(n for top, n in numbers.items() if degree <= top)
    yield decomposition.fibonacci_directions(count)
    yield low_discrepancy_directions(count)
    for i in range(round(effort * number)):
        yield random_directions(count, jax.random.fold_in(jax.random.key(degree), i))


def best_axes(degree: int, effort: float) -> np.ndarray:
    if degree > MANY_STARTS:
        return np.asarray(decomposition.optimize_directions(next(starts(degree, effort)), degree))
    found = [np.asarray(decomposition.optimize_directions(z, degree)) for z in starts(degree, effort)]
    found = sorted(found, key=lambda z: worst_condition(z, degree))[:2]
    found += [np.asarray(decomposition.optimize_directions(z, degree, powers=POLISH, max_steps=512)) for z in found]
    return min(found, key=lambda z: worst_condition(z, degree))


def ordered(z: np.ndarray) -> np.ndarray:
    """Rows of `z` such that prefixes serve the lower bands."""
    kept, dropped = list(range(len(z))), []
    for l in range(len(z) // 2 - 1, -1, -1):
        for _ in range(2):
            m = band_matrix(z[kept], l)
            leverage = np.sum(m * np.linalg.lstsq(m @ m.T, m, rcond=None)[0], axis=0)
            dropped.append(kept.pop(int(np.argmin(leverage))))
    return z[kept + dropped[::-1]]


def upper(z: np.ndarray) -> np.ndarray:
    z = np.where(z[:, 2:] < 0, -z, z)
    return z / np.linalg.norm(z, axis=1, keepdims=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, default=OUTPUT)
    parser.add_argument("--overwrite", action="store_true")
    parser.add_argument("--degrees", type=int, nargs="*", default=range(TOP + 1))
    parser.add_argument("--effort", type=float, default=1.0, help="scales the number of random starts")
    options = parser.parse_args()
    if options.output.exists() and not options.overwrite:
        raise SystemExit(f"{options.output} exists; pass --overwrite to improve it.")

    table, conditions, nested = np.zeros(((TOP + 1) ** 2, 3)), np.full(TOP + 1, np.inf), np.full(TOP + 1, np.inf)
    if options.output.exists():
        with np.load(options.output) as old:
            table, conditions, nested = old["directions"], old["conditions"], old["nested_conditions"]
    options.output.parent.mkdir(exist_ok=True)
    for degree in options.degrees:
        began, rows = time.perf_counter(), slice(degree**2, (degree + 1) ** 2)
        z = ordered(upper(best_axes(degree, options.effort))) if degree else np.array([[0.0, 0.0, 1.0]])
        condition = worst_condition(z, degree)
        seconds = time.perf_counter() - began
        print(f"{degree:3d}  {condition:8.4f}  (before: {conditions[degree]:.4f})  {seconds:6.1f} s", flush=True)
        if condition < conditions[degree]:
            table[rows], conditions[degree], nested[degree] = z, condition, worst_condition(z, degree, nested=True)
        found = {"directions": table, "conditions": conditions, "nested_conditions": nested}
        write = lambda file, found=found: np.savez_compressed(file, **found)
        write_atomically(options.output, write, overwrite=True)
        jax.clear_caches()


if __name__ == "__main__":
    with jax.enable_x64(True):
        main()
