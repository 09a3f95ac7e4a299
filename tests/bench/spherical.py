"""Spherical harmonics against other libraries: basis, expansion at points, projection of a map, rotation, product.

    python -m tests.bench.spherical     writes the stored references: SciPy's harmonics and exact quadrature

No result is converted inside a measured call. The harmonics of sphericart, without the Condon-Shortley phase, are ours
in a frame turned by pi about z, and those of e3nn, with the pole at +y, ours in another turned frame: they are given
turned directions and rotations instead, and coefficients stay as they are. ducc0's complex coefficients are converted
before the call; after it, only those that are judged. XLA, sphericart and ducc0 may use every core, except that loops
over many small transforms of ducc0 run on one thread, which is faster.

Settings that are missing: e3nn-jax and spexial beyond degree 8, and gradients of e3nn's basis and expansions and of
`rotate` at degree 30, which take long to compile; SciPy beyond degree 16, which takes seconds for a call; s2fft for all
but one map, since its sampling ties the degree to the number of rows, so that it computes degree 255 of any map with
512. Peers that are not installed are left out: `notes` names them.
"""

import functools
import importlib.util
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y_all

from shisd import harmonics
from shisd.harmonics._rotation import rotate_many
from shisd.io.internal import write_atomically
from tests.bench.harness import Method, Task
from tests.truth import scipy_basis

STORED = Path(__file__).resolve().parent / "data" / "references_spherical.npz"
PEERS = {  # by module
    "sphericart": "sphericart",
    "sphericart.jax": "sphericart-jax (2.0.4 needs jax below 0.10.2)",
    "ducc0": "ducc0",
    "e3nn_jax": "e3nn-jax",
    "s2fft": "s2fft",
    "spexial": "spexial",
}
POINTS, HEIGHT, ROTATIONS, EXPANSIONS, PRODUCTS = 10_000, 512, 1000, 1024, 64
POINTS_JUDGED, ROTATIONS_JUDGED, EXPANSIONS_JUDGED, PRODUCTS_JUDGED = 200, 4, 8, 2
ROTATION_DEGREES, BATCH_DEGREES = (8, 30), (8,)
SMALL = 8  # the highest degree of e3nn-jax, spexial and the dense tensor of triple products
DIFFERENTIATED = 30  # the highest degree of gradients: at 64, sphericart's table of derivatives takes 1 GB in float64
S2FFT_DEGREE = HEIGHT // 2 - 1
HALF_TURN = np.diag([-1, -1, 1]).astype(np.float32)  # sphericart's harmonics at HALF_TURN w are ours at w
E3NN_TURN = np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]], np.float32)  # and so are e3nn's at E3NN_TURN w
E3NN_SCALE = np.float32(np.sqrt(4 * np.pi))  # its values of an expansion are so many times the sum
CORES = os.cpu_count() or 1


@functools.cache
def installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def notes() -> list[str]:
    """What the report has to say beside the rows."""
    missing = [name for module, name in PEERS.items() if not installed(module)]
    return [f"Not installed, so not measured: {', '.join(missing)}."] if missing else []


def tasks(quick: bool) -> list[Task]:
    """A task for every job and degree; quick ones leave out e3nn-jax, spexial and s2fft, whose first calls are long."""
    jobs = {
        basis: (8, 30, 64),
        expansion: (8, 30, 64),
        projection: (64,),
        rotation: ROTATION_DEGREES,
        batch_rotation: BATCH_DEGREES,
        product: (8, 30),
    }
    if quick:
        jobs = {basis: (8,), expansion: (30,), projection: (64,), product: (8,)}
    return [job(degree, quick) for job, degrees in jobs.items() for degree in degrees]


# ---- methods: the parameters are all arguments, of which the last is the cotangent of the result


def compiled(family: str, setting: str, function, *arguments, gradient: bool = True, ours: bool = False) -> Method:
    """A JAX function of the arguments but the last; its gradient is the value and the pull-back of the last."""
    value, pull = _value_and_pull(function)
    return Method(family, setting, value, arguments, pull if gradient else None, ours=ours)


@functools.cache
def _value_and_pull(function):
    def pull(arguments):
        value, back = jax.vjp(function, *arguments[:-1])
        return value, back(arguments[-1])

    return lambda arguments: function(*arguments[:-1]), pull


def in_double(family: str, setting: str, function, *arguments, ours: bool = False) -> Method:
    """A JAX function of all the arguments, compiled in float64."""
    with jax.enable_x64(True):
        arguments = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), arguments)
    return Method(family, setting, _in_double(function), arguments, host=True, ours=ours)


@functools.cache
def _in_double(function):
    value = jax.jit(function)

    def call(arguments):
        with jax.enable_x64(True):
            return jax.block_until_ready(value(*arguments))

    return call


def on_host(family: str, setting: str, value, *arguments, gradient=None) -> Method:
    """A NumPy function of the arguments but the last, and one of all that also returns derivatives."""
    pull = None if gradient is None else lambda arguments: gradient(*arguments)
    return Method(family, setting, lambda arguments: value(*arguments[:-1]), arguments, pull, host=True)


# ---- inputs, float32 unless they say otherwise, and seeded


def ducc_in_both(value, c: np.ndarray, turns: np.ndarray, w: np.ndarray) -> list[Method]:
    """ducc0's rotation of real coefficients in both precisions."""
    precisions = {"float32": np.complex64, "float64": np.complex128}
    return [on_host("ducc0", name, value, to_complex(c).astype(dtype), turns, w) for name, dtype in precisions.items()]


def normal(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def directions() -> np.ndarray:
    d = np.random.default_rng(0).normal(size=(POINTS, 3))
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def rotations(count: int) -> np.ndarray:
    """In float64: rounded to float32 they are no rotations to more than its precision."""
    return Rotation.random(count, random_state=np.random.RandomState(0)).as_matrix()


def size(degree: int) -> int:
    return (degree + 1) ** 2


def orders(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """l and m >= 0 in ducc0's order."""
    m, l = np.triu_indices(degree + 1)
    return l, m


def to_complex(c: np.ndarray) -> np.ndarray:
    """Coefficients [..., n] of Y_l^m, m >= 0, as ducc0 keeps them."""
    l, m = orders(int(np.sqrt(c.shape[-1])) - 1)
    plus, minus = c[..., l * l + l + m], c[..., l * l + l - m]
    return np.where(m == 0, plus, (plus - 1j * minus) / np.sqrt(2))


def to_real(alm: np.ndarray, degree: int) -> np.ndarray:
    l, m = orders(degree)
    c = np.empty((*alm.shape[:-1], size(degree)), alm.real.dtype)
    c[..., l * l + l - m] = -np.sqrt(2) * alm.imag
    c[..., l * l + l + m] = np.where(m == 0, 1, np.sqrt(2)) * alm.real
    return c


@functools.cache
def judged_basis(degree: int) -> tuple[np.ndarray, float]:
    """SciPy's values at the first directions, and their relative error by the addition theorem."""
    y = scipy_basis(directions()[:POINTS_JUDGED], degree)
    l = np.arange(degree + 1)
    ones = np.add.reduceat(y**2, l * l, axis=1) * 4 * np.pi / (2 * l + 1)
    return y, float(np.sqrt(np.mean((ones - 1) ** 2)) / 2)


def polar(theta: np.ndarray, degree: int) -> np.ndarray:
    """SciPy's polar factors of the real harmonics [l, m, rows], 0 <= m <= l."""
    p = sph_harm_y_all(degree, degree, theta, 0.0).real[:, : degree + 1]
    return p * np.where(np.arange(degree + 1) == 0, 1, np.sqrt(2))[:, None]


def azimuthal(phi: np.ndarray, degree: int) -> np.ndarray:
    """cos and sin(m phi) [2, m, columns]."""
    m_phi = np.outer(np.arange(degree + 1), phi)
    return np.stack([np.cos(m_phi), np.sin(m_phi)])


def synthesis(c: np.ndarray, theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Values of an expansion at rows and columns, in float64 by SciPy."""
    degree = int(np.sqrt(c.size)) - 1
    l, m = np.arange(degree + 1)[:, None], np.arange(degree + 1)
    inside = m <= l
    both = np.stack([c[np.where(inside, l * l + l + s * m, 0)] * inside for s in (1, -1)])  # [2, l, m]
    return np.einsum("slm,lmj,smi->ji", both, polar(theta, degree), azimuthal(phi, degree), optimize=True)


def analysis(values: np.ndarray, theta: np.ndarray, areas: np.ndarray, phi: np.ndarray, degree: int) -> np.ndarray:
    """Coefficients by quadrature, of values [rows, columns] and weights of the rows."""
    both = np.einsum(
        "ji,j,lmj,smi->slm", values, areas, polar(theta, degree), azimuthal(phi, degree), optimize=True
    )  # fmt: skip
    l, m = np.tril_indices(degree + 1)
    c = np.empty(size(degree))
    c[l * l + l - m] = both[1, l, m]
    c[l * l + l + m] = both[0, l, m]
    return c


def gauss_rule(degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, their weights and columns of the product rule that is exact to `degree`."""
    x, weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    return np.arccos(x), weights * 2 * np.pi / (degree + 1), 2 * np.pi * np.arange(degree + 1) / (degree + 1)


def difference(fine: np.ndarray, coarse: np.ndarray) -> float:
    return float(np.sqrt(np.mean((fine - coarse) ** 2) / np.mean(fine**2)))


# ---- basis


def basis(degree: int, quick: bool) -> Task:
    """All harmonics at 10,000 directions; the gradient is in the directions."""
    d, w = directions(), normal(1, POINTS, size(degree))
    reference, error = judged_basis(degree)
    small, differentiated = degree <= SMALL and not quick, degree <= DIFFERENTIATED
    methods = [
        compiled("shisd", "float32", _basis(degree), d, w, gradient=differentiated, ours=True),
        in_double("shisd", "float64", _basis(degree), d, ours=True),
    ]
    if installed("sphericart"):
        value, gradient = _sphericart_basis(degree)
        for dtype in (np.float32, np.float64):
            turned = np.ascontiguousarray((d @ HALF_TURN).astype(dtype))
            pull = gradient if differentiated and dtype == np.float32 else None
            methods.append(on_host("sphericart", dtype.__name__, value, turned, w, gradient=pull))
    if installed("sphericart.jax"):
        value = _sphericart_jax(degree)
        methods.append(compiled("sphericart-jax", "float32", value, d @ HALF_TURN, w, gradient=differentiated))
    if installed("e3nn_jax") and small:
        methods.append(compiled("e3nn-jax", "float32", _e3nn_basis(degree), d @ E3NN_TURN.T, w, gradient=False))
    if installed("spexial") and small:
        methods.append(compiled("spexial", "float32", _spexial_basis(degree), d, w))
    if degree <= 16 and not quick:
        methods.append(on_host("SciPy, the reference", "float64", _scipy_basis(degree), d.astype(float), w))
    title = f"Basis, degree {degree}"
    return Task(f"basis {degree}", title, "direction", (), reference, error, methods, count=POINTS)


@functools.cache
def _basis(degree: int):
    return lambda d: harmonics.sh_basis(d, degree)


@functools.cache
def _sphericart_basis(degree: int):
    import sphericart

    calculator = sphericart.SphericalHarmonics(degree)

    def gradient(d, w):
        y, dy = calculator.compute_with_gradients(d)
        return y, np.matmul(dy, w[:, :, None])

    return calculator.compute, gradient


@functools.cache
def _sphericart_jax(degree: int):
    import sphericart.jax

    return lambda d: sphericart.jax.spherical_harmonics(d, degree)


@functools.cache
def _e3nn_basis(degree: int):
    import e3nn_jax

    harmonics_of = functools.partial(
        e3nn_jax.spherical_harmonics, list(range(degree + 1)), normalize=False, normalization="integral"
    )
    return lambda d: harmonics_of(input=e3nn_jax.IrrepsArray("1o", d)).array


@functools.cache
def _spexial_terms(degree: int):
    """Every real harmonic as its own array: the form that spexial's documentation recommends."""
    import spexial

    def terms(d):
        y = spexial.sph_harm_y_cart_all_terms(degree, degree, d)
        root = np.sqrt(2).astype(d.dtype)
        for l in range(degree + 1):
            yield from (root * y[l][-m].imag for m in range(-l, 0))
            yield y[l][0].real
            yield from (root * y[l][m].real for m in range(1, l + 1))

    return terms


@functools.cache
def _spexial_basis(degree: int):
    terms = _spexial_terms(degree)
    return lambda d: jnp.stack(list(terms(d)), axis=-1)


@functools.cache
def _scipy_basis(degree: int):
    """By its recurrence over all degrees and orders, several times faster than by pairs."""

    def value(d):
        x, y, z = d.T
        y = sph_harm_y_all(degree, degree, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x))
        columns = []
        for l in range(degree + 1):
            columns += [np.sqrt(2) * y[l, -m].imag for m in range(-l, 0)]
            columns += [y[l, 0].real, *(np.sqrt(2) * y[l, m].real for m in range(1, l + 1))]
        return np.stack(columns, axis=-1)

    return value


# ---- expansion at points


def expansion(degree: int, quick: bool) -> Task:
    """One expansion at 10,000 directions; the gradient is in coefficients and directions."""
    c, d, w = normal(2, size(degree)), directions(), normal(3, POINTS)
    y, error = judged_basis(degree)
    reference = y @ c.astype(float)
    small, differentiated = degree <= SMALL and not quick, degree <= DIFFERENTIATED
    methods = [
        compiled("shisd", "float32", _expansion, c, d, w, gradient=differentiated, ours=True),
        in_double("shisd", "float64", _expansion, c, d, ours=True),
    ]
    if installed("sphericart"):
        value, gradient = _sphericart_expansion(degree)
        for dtype in (np.float32, np.float64):
            turned = np.ascontiguousarray((d @ HALF_TURN).astype(dtype))
            arguments = c.astype(dtype), turned, w.astype(dtype)
            methods.append(
                on_host("sphericart", dtype.__name__, value, *arguments, gradient=gradient if differentiated else None)
            )
    if installed("sphericart.jax"):
        methods.append(
            compiled(
                "sphericart-jax",
                "float32",
                _sphericart_jax_expansion(degree),
                c,
                d @ HALF_TURN,
                w,
                gradient=differentiated,
            )
        )
    if installed("ducc0"):
        value, gradient = _ducc_expansion(degree)
        x, y, z = d.T.astype(float)
        place = np.stack([np.arctan2(np.hypot(x, y), z), np.arctan2(y, x) % (2 * np.pi)], axis=-1)
        for dtype in (np.float32, np.float64):
            arguments = to_complex(c).astype(np.result_type(dtype, np.complex64))[None], place, w.astype(dtype)
            methods.append(
                on_host("ducc0", dtype.__name__, value, *arguments, gradient=gradient if differentiated else None)
            )
    if installed("e3nn_jax") and small:
        value = _e3nn_expansion(degree)
        methods.append(compiled("e3nn-jax", "float32", value, c / E3NN_SCALE, d @ E3NN_TURN.T, w, gradient=False))
    if installed("spexial") and small:
        methods.append(compiled("spexial", "float32", _spexial_expansion(degree), c, d, w))
    title = f"Expansion at points, degree {degree}"
    return Task(f"expansion {degree}", title, "direction", (), reference, error, methods, count=POINTS)


def _expansion(c, d):
    return harmonics.evaluate(c, d)


@functools.cache
def _sphericart_expansion(degree: int):
    import sphericart

    calculator = sphericart.SphericalHarmonics(degree)

    def gradient(c, d, w):
        y, dy = calculator.compute_with_gradients(d)
        return y @ c, w @ y, w[:, None] * (dy @ c)

    return lambda c, d: calculator.compute(d) @ c, gradient


@functools.cache
def _sphericart_jax_expansion(degree: int):
    basis = _sphericart_jax(degree)
    return lambda c, d: basis(d) @ c


@functools.cache
def _ducc_expansion(degree: int):
    """By its non-uniform Fourier transform; derivatives are in the two angles."""
    import ducc0

    options = {"lmax": degree, "nthreads": CORES}
    accuracy = lambda array: 1.1e-6 if array.dtype in (np.float32, np.complex64) else 1e-12

    def value(alm, place):
        return ducc0.sht.synthesis_general(alm=alm, spin=0, loc=place, epsilon=accuracy(alm), **options)[0]

    def gradient(alm, place, w):
        slopes = ducc0.sht.synthesis_general(
            alm=alm, spin=1, loc=place, epsilon=accuracy(alm), mode="DERIV1", **options
        )
        adjoint = ducc0.sht.adjoint_synthesis_general(map=w[None], spin=0, loc=place, epsilon=accuracy(w), **options)
        return value(alm, place), adjoint, slopes * w

    return value, gradient


@functools.cache
def _e3nn_expansion(degree: int):
    import e3nn_jax

    irreps = e3nn_jax.s2_irreps(degree, 1, -1)

    def value(c, d):
        return e3nn_jax.to_s2point(e3nn_jax.IrrepsArray(irreps, c), e3nn_jax.IrrepsArray("1o", d)).array[:, 0]

    return value


@functools.cache
def _spexial_expansion(degree: int):
    terms = _spexial_terms(degree)
    return lambda c, d: sum(c[i] * y for i, y in enumerate(terms(d)))


# ---- projection of a map


def projection(degree: int, quick: bool) -> Task:
    """Coefficients of a map of 512 x 1024 texels, the values of a known expansion; the gradient is in the texels."""
    c = normal(4, size(degree)).astype(float)
    theta, phi = np.pi * (np.arange(HEIGHT) + 0.5) / HEIGHT, np.pi * (np.arange(2 * HEIGHT) + 0.5) / HEIGHT
    texels, w = synthesis(c, theta, phi), normal(5, size(degree))
    methods = [
        compiled("shisd", "float32", _projection(degree), texels.astype(np.float32), w, ours=True),
        in_double("shisd", "float64", _projection(degree), texels, ours=True),
    ]
    if installed("ducc0"):
        value, gradient = _ducc_projection(degree)
        for dtype in (np.float32, np.float64):
            arguments = texels.astype(dtype), to_complex(w).astype(np.result_type(dtype, np.complex64))
            methods.append(on_host("ducc0", dtype.__name__, value, *arguments, gradient=gradient))
    if installed("s2fft") and degree == 64 and not quick:
        columns = 2 * np.pi * np.arange(2 * S2FFT_DEGREE + 1) / (2 * S2FFT_DEGREE + 1)
        own = synthesis(c, theta, columns)  # 512 x 511 texels
        methods.append(on_host("s2fft", "float64", _s2fft_projection(degree), own, w))
    title = f"Projection of a 512 x 1024 map, degree {degree}"
    return Task(f"projection {degree}", title, "map", (), c, 0.0, methods, count=1)


@functools.cache
def _projection(degree: int):
    return lambda image: harmonics.project_map(image, degree, texels="samples")


@functools.cache
def _ducc_projection(degree: int):
    import ducc0

    options = {"lmax": degree, "spin": 0, "geometry": "F1", "phi0": np.pi / (2 * HEIGHT), "nthreads": CORES}

    def value(texels):
        return to_real(ducc0.sht.analysis_2d(map=texels[None], **options)[0], degree)

    def gradient(texels, alm):
        back = ducc0.sht.adjoint_analysis_2d(alm=alm[None], ntheta=HEIGHT, nphi=2 * HEIGHT, **options)
        return value(texels), back

    return value, gradient


@functools.cache
def _s2fft_projection(degree: int):
    import s2fft

    with jax.enable_x64(True):
        tables = s2fft.generate_precomputes_jax(S2FFT_DEGREE + 1, 0, "dh", forward=True)
    l, m = orders(degree)

    def value(texels):
        with jax.enable_x64(True):
            alm = s2fft.forward_jax(
                jnp.asarray(texels), S2FFT_DEGREE + 1, sampling="dh", reality=True, precomps=tables
            )  # fmt: skip
        return to_real(np.asarray(alm)[l, S2FFT_DEGREE + m], degree)

    return value


# ---- rotation


def rotation(degree: int, quick: bool) -> Task:
    """One RGB expansion turned by each of 1,000 rotations; the gradient is in coefficients and rotations."""
    c, r, w = normal(6, 3, size(degree)), rotations(ROTATIONS), normal(7, ROTATIONS, 3, size(degree))
    single = r.astype(np.float32)
    methods = [
        compiled("shisd", "rotate, float32", _rotations, c, single, w, gradient=degree <= 16 and not quick, ours=True),
        compiled("shisd", "rotate_many, float32", _rotate_many(degree), c, single, w, gradient=degree <= 16, ours=True),
        in_double("shisd", "rotate_many, float64", _rotate_many(degree), c, r, ours=True),
    ]
    if installed("ducc0"):
        methods += ducc_in_both(_ducc_rotations(degree), c, zyz(r), w)
    if installed("e3nn_jax") and degree <= SMALL and not quick:
        turned = E3NN_TURN @ single @ E3NN_TURN.T
        methods.append(compiled("e3nn-jax", "float32", _e3nn_rotations(degree), c, turned, w))
    reference, error = judged("rotation", degree)
    title = f"1,000 rotations of an RGB expansion, degree {degree}"
    return Task(f"rotation {degree}", title, "rotation", (), reference, error, methods, count=ROTATIONS)


def batch_rotation(degree: int, quick: bool) -> Task:
    """1,024 expansions turned by one rotation; the gradient is in coefficients and the rotation."""
    c, r, w = normal(8, EXPANSIONS, size(degree)), rotations(1)[0], normal(9, EXPANSIONS, size(degree))
    single = r.astype(np.float32)
    methods = [
        compiled("shisd", "rotate, float32", _rotation, c, single, w, ours=True),
        compiled("shisd", "rotate_many, float32", _rotate_each(degree), c, single, w, ours=True),
        in_double("shisd", "rotate_many, float64", _rotate_each(degree), c, r, ours=True),
    ]
    if installed("ducc0"):
        methods += ducc_in_both(_ducc_rotation(degree), c, zyz(r[None]), w)
    if installed("e3nn_jax") and degree <= SMALL and not quick:
        methods.append(compiled("e3nn-jax", "float32", _e3nn_rotation(degree), c, E3NN_TURN @ single @ E3NN_TURN.T, w))
    reference, error = judged("batch", degree)
    title = f"One rotation of 1,024 expansions, degree {degree}"
    return Task(f"batch rotation {degree}", title, "expansion", (), reference, error, methods, count=EXPANSIONS)


def judged(name: str, degree: int) -> tuple[np.ndarray, float]:
    with np.load(STORED) as stored:
        return stored[f"{name}_{degree}"], float(stored[f"{name}_{degree}_error"])


def rotated(c: np.ndarray, r: np.ndarray, degree: int, rule: int) -> np.ndarray:
    """Coefficients of f(R^T w) by quadrature with SciPy's harmonics."""
    theta, areas, phi = gauss_rule(rule)
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None]
    w = np.stack(np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), cosine), axis=-1)
    values = scipy_basis(w @ r, degree) @ c.T.astype(float)
    return np.stack([analysis(v, theta, areas, phi, degree) for v in np.moveaxis(values, -1, 0)])


def zyz(r: np.ndarray) -> np.ndarray:
    """Angles [..., 3] about z, the fixed y and the fixed z, in the order in which they are applied."""
    return Rotation.from_matrix(r).as_euler("zyz")


def _rotation(c, r):
    return harmonics.rotate(c, r)


def _rotations(c, r):
    return jax.vmap(lambda r: harmonics.rotate(c, r))(r)


@functools.cache
def _rotate_many(degree: int):
    return lambda c, r: jnp.moveaxis(rotate_many(c, r, degree), -1, 0).swapaxes(1, 2)


@functools.cache
def _rotate_each(degree: int):
    """`rotate_many` told that expansions are its own of each rotation, of which there is one."""
    return lambda c, r: rotate_many(c.T[..., None], r[None], degree)[..., 0].T


@functools.cache
def _ducc_rotations(degree: int):
    import ducc0

    def value(alm, angles):
        turned = [ducc0.sht.rotate_alm(alm, degree, *a, nthreads=1) for a in angles]
        return to_real(np.stack(turned[:ROTATIONS_JUDGED]), degree)

    return value


@functools.cache
def _ducc_rotation(degree: int):
    import ducc0

    def value(alm, angles):
        turned = ducc0.sht.rotate_alm(alm, degree, *angles[0], nthreads=CORES)
        return to_real(turned[:EXPANSIONS_JUDGED], degree)

    return value


@functools.cache
def _e3nn_rotation(degree: int):
    import e3nn_jax

    irreps = e3nn_jax.s2_irreps(degree, 1, -1)
    return lambda c, r: e3nn_jax.IrrepsArray(irreps, c).transform_by_matrix(r).array


@functools.cache
def _e3nn_rotations(degree: int):
    one = _e3nn_rotation(degree)
    return lambda c, r: jax.vmap(lambda r: one(c, r))(r)


# ---- product


def product(degree: int, quick: bool) -> Task:
    """64 exact products of two expansions of one degree, to twice the degree; the gradient is in both factors."""
    a, b = normal(10, PRODUCTS, size(degree)), normal(11, PRODUCTS, size(degree))
    w = normal(12, PRODUCTS, size(2 * degree))
    exact = lambda rule: np.stack(
        [_exact_product(a[i].astype(float), b[i].astype(float), degree, rule) for i in range(PRODUCTS_JUDGED)]
    )
    reference = exact(4 * degree)
    small = degree <= SMALL and not quick
    methods = [
        compiled("shisd", "multiply, float32", _product(degree), a, b, w, ours=True),
        in_double("shisd", "multiply, float64", _product(degree), a, b, ours=True),
    ]
    if small:
        methods.append(compiled("shisd", "product_matrix, float32", _product_by_matrix(degree), a, b, w, ours=True))
    if installed("ducc0"):
        value, gradient = _ducc_product(degree)
        for dtype in (np.complex64, np.complex128):
            factors = [to_complex(x).astype(dtype) for x in (a, b, w)]
            name = "float32" if dtype == np.complex64 else "float64"
            methods.append(on_host("ducc0", name, value, *factors, gradient=gradient))
    if degree <= SMALL:
        methods.append(compiled("dense triple products", "float32", _gaunt_product, a, b, gaunt(degree), w))
    if installed("e3nn_jax") and small:
        methods.append(compiled("e3nn-jax", "float32", _e3nn_product(degree), a / E3NN_SCALE, b, w))
    title = f"Exact product, degree {degree}"
    error = difference(exact(4 * degree + 6), reference)
    return Task(f"product {degree}", title, "product", (), reference, error, methods, count=PRODUCTS)


def _exact_product(a: np.ndarray, b: np.ndarray, degree: int, rule: int) -> np.ndarray:
    theta, areas, phi = gauss_rule(rule)
    return analysis(synthesis(a, theta, phi) * synthesis(b, theta, phi), theta, areas, phi, 2 * degree)


@functools.cache
def _product(degree: int):
    return lambda a, b: harmonics.multiply(a, b, 2 * degree)


@functools.cache
def _product_by_matrix(degree: int):
    matrix = functools.partial(harmonics.product_matrix, degree=2 * degree, input_degree=degree)
    return lambda a, b: jax.vmap(lambda a, b: matrix(a) @ b)(a, b)


@functools.cache
def _ducc_product(degree: int):
    """On the grid of Gauss and Legendre that is just fine enough, as ours."""
    import ducc0

    def on_grid(alm, degree, rule):
        return ducc0.sht.synthesis_2d(
            alm=alm[None], spin=0, lmax=degree, ntheta=rule // 2 + 1, nphi=rule + 1, geometry="GL"
        )

    def products(a, b, kept):
        """All of them, as complex coefficients up to a degree."""
        degrees = [int(np.sqrt(2 * x.shape[-1])) - 1 for x in (a, b)]
        rule = sum(degrees) + kept
        values = (on_grid(x, degrees[0], rule) * on_grid(y, degrees[1], rule) for x, y in zip(a, b, strict=True))
        return [ducc0.sht.analysis_2d(map=v, spin=0, lmax=kept, geometry="GL")[0] for v in values]

    def value(a, b):
        return to_real(np.stack(products(a, b, 2 * degree)[:PRODUCTS_JUDGED]), 2 * degree)

    return value, lambda a, b, w: (value(a, b), products(w, b, degree), products(w, a, degree))


@functools.cache
def gaunt(degree: int) -> np.ndarray:
    """Integrals of y_i y_j y_k [n_i, n_j, n_k], k to twice the degree."""
    theta, areas, phi = gauss_rule(4 * degree)
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None]
    w = np.stack(np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), cosine), axis=-1)
    y = scipy_basis(w, 2 * degree).reshape(-1, size(2 * degree))
    low = y[:, : size(degree)]
    weighted = y * np.repeat(areas, phi.size)[:, None]
    return np.einsum("pi,pj,pk->ijk", low, low, weighted, optimize=True).astype(np.float32)


def _gaunt_product(a, b, tensor):
    """One matrix product with the outer products of the factors."""
    pairs = (a[:, :, None] * b[:, None, :]).reshape(len(a), -1)
    return pairs @ tensor.reshape(pairs.shape[1], -1)


@functools.cache
def _e3nn_product(degree: int):
    """On its Gauss-Legendre grid."""
    import e3nn_jax

    irreps, doubled = e3nn_jax.s2_irreps(degree, 1, -1), e3nn_jax.s2_irreps(2 * degree, 1, -1)
    grid = {"res_beta": 2 * degree + 1, "res_alpha": 4 * degree + 1, "quadrature": "gausslegendre"}

    def value(a, b):
        f, g = (e3nn_jax.to_s2grid(e3nn_jax.IrrepsArray(irreps, x), **grid) for x in (a, b))
        return e3nn_jax.from_s2grid(f.replace_values(f.grid_values * g.grid_values), doubled).array

    return value


def main() -> None:
    stored = {}
    jobs = {
        "rotation": (ROTATION_DEGREES, lambda l: normal(6, 3, size(l)), rotations(ROTATIONS)[:ROTATIONS_JUDGED]),
        "batch": (BATCH_DEGREES, lambda l: normal(8, EXPANSIONS, size(l))[:EXPANSIONS_JUDGED], rotations(1)),
    }
    for name, (degrees, coefficients, turns) in jobs.items():
        for degree in degrees:
            c = coefficients(degree)
            values, finer = (
                np.stack([rotated(c, r, degree, rule) for r in turns]) for rule in (2 * degree, 2 * degree + 6)
            )
            stored[f"{name}_{degree}"] = values if name == "rotation" else values[0]
            stored[f"{name}_{degree}_error"] = difference(finer, values)
            print(f"{name}, degree {degree}: error {stored[f'{name}_{degree}_error']:.1e}", flush=True)
    STORED.parent.mkdir(exist_ok=True)
    write_atomically(STORED, lambda file: np.savez_compressed(file, **stored), overwrite=True)
    print(f"{STORED.name}: {STORED.stat().st_size} bytes")


if __name__ == "__main__":
    main()
