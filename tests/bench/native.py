"""Compile polygon_moments.cpp with the system's g++ and call it: what hand-written vector code reaches on one core."""

import ctypes
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_name("polygon_moments.cpp")
FLAGS = ["-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-ffp-contract=fast", "-shared", "-fPIC"]
SIDES = (3, 4, 5, 6, 8)


@functools.cache
def library(lanes: int = 8) -> ctypes.CDLL:
    """The compiled library for vectors of `lanes` floats; RuntimeError where there is no g++ or it fails."""
    compiler = shutil.which("g++")
    if compiler is None:
        raise RuntimeError(f"No g++ on the PATH to compile {SOURCE.name}. On Debian and Ubuntu: apt install g++")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "polygon_moments.so"
        command = [compiler, *FLAGS, f"-DLANES={lanes}", str(SOURCE), "-o", str(target)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"g++ could not compile {SOURCE.name}: {' '.join(command)}\n{done.stderr}")
        return ctypes.CDLL(str(target))


def polygon_moments(polygons, axes, weights, *, difference: bool = False, lanes: int = 8) -> np.ndarray:
    """Sum over l >= 1 and k of weights[l, k] times the integral of P_l(omega . axes[k]) over each polygon, float32 [P].

    `polygons` [P, S, 3]: unit vertices, the interior on the left of each edge, edges shorter than pi. `axes` [K, 3]:
    unit. `weights` [L+1, K], row 0 not used. `difference` takes the form that keeps its digits in small polygons, else
    the plain recurrence. `lanes`: polygons per vector, 8 for AVX2, 16 for AVX-512.
    """
    v, d, w = (np.ascontiguousarray(array, np.float32) for array in (polygons, axes, weights))
    if v.ndim != 3 or v.shape[1] not in SIDES or v.shape[2] != 3:
        raise ValueError(f"`polygons` must have shape [P, S, 3] with S one of {SIDES}; got {list(v.shape)}.")
    if d.ndim != 2 or d.shape[1] != 3:
        raise ValueError(f"`axes` must have shape [K, 3]; got {list(d.shape)}.")
    if w.ndim != 2 or w.shape[0] < 2 or w.shape[1] != len(d):
        raise ValueError(f"`weights` must have shape [L+1, {len(d)}] with L >= 1; got {list(w.shape)}.")
    out = np.empty(len(v), np.float32)
    compiled = library(lanes)
    function = compiled.polygon_moments_difference if difference else compiled.polygon_moments
    status = function(*(ctypes.c_void_p(a.ctypes.data) for a in (v, d, w, out)), *v.shape[:2], len(d), len(w) - 1)
    assert status == 0, status
    return out
