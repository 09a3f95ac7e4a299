"""Errors where formulas fail: every case of tests/hard_cases.py, in both precisions, beside what others do there.

Truth is in extended precision or in mpmath and shares no formula with the package: harmonics by their recurrence,
polygons by area quadrature, materials by their textbook formulas, derivatives by differences of sixth order.
"""

import functools
import importlib.util
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import sphericart
from scipy.special import sph_harm_y_all

from shisd import decomposition, domains, harmonics, io, models, reference, shading
from tests import hard_cases, truth
from tests.bench import polygons
from tests.hard_cases import padded, unit

FLOATS = (np.float32, np.float64)
AXES_DEGREE, POLYGON_DEGREE, SHADING_DEGREE = 8, 16, 8


def bench_stability():
    """Errors where formulas fail, of ours and of others, relative to the natural size; NaN and refusals by name.

    Natural size: the largest value of the band (harmonics), the RMS of the expansion (axes), the solid angle
    (polygons), the radiance (shading; its RMS over eight points for lights) or the value itself (materials, over the
    width of the lobe for their derivatives). Derivatives otherwise: the largest of those tried in an argument, or the
    radiance per rad and unit of length if that is larger; along the sphere where an argument is a direction; where an
    outline touches the horizon, on the side on which it is cut off; in the plane of a light, as from behind it.
    Polygons: degree 16; axes and shading: degree 8, GGX of alpha 0.5. Shading by polygons and the lights are compared
    with quadrature of the same expansion, the rows from roughness to radiance and the measured bins with the material
    itself; Monte Carlo (256 samples) always with the material itself.
    """
    groups = (harmonics_rows, axes_rows, polygon_rows, shading_rows, roughness_rows, material_rows, light_rows)
    return [row for group in groups for row in group()]


def row(case: str, what: str, ours: list, peer: str = "-", theirs: list | None = None) -> dict:
    theirs = theirs or ["-", "-"]
    return {
        "case": case, "what": what, "ours float32": ours[0], "ours float64": ours[1],
        "peer": peer, "peer float32": theirs[0], "peer float64": theirs[1],
    }  # fmt: skip


def beside_monte_carlo(results: dict[str, list]) -> list[dict]:
    """Two rows for every case, whose (value, gradient, estimate) are there for both precisions."""
    rows = []
    for name, both in results.items():
        value, gradient, estimate = zip(*both, strict=True)
        rows += [row(name, "value", value, "Monte Carlo", estimate), row(name, "gradient", gradient)]
    return rows


def cell(error) -> float | str:
    return error if isinstance(error, str) else float(error) if np.isfinite(error) else "NaN"


def attempt(function: Callable, *arguments):
    """What it returns, or that there is a message instead."""
    try:
        return function(*arguments)
    except (ValueError, RuntimeError):
        return "refused"


def several(cells: list) -> str:
    """Cells of several peers as one."""
    return " / ".join(x if isinstance(x, str) else f"{x:.0e}" for x in cells)


def precisions(function: Callable) -> list:
    """function(dtype) in float32 and in float64."""
    results = []
    for dtype in FLOATS:
        with jax.enable_x64(dtype == np.float64):
            results.append(function(dtype))
    return results


def largest(got, expected) -> float:
    """The largest error, relative to the largest expected value; absolute where that is zero."""
    got, expected = np.asarray(got, float), np.asarray(expected, float)
    return np.max(np.abs(got - expected)) / (np.max(np.abs(expected)) or 1.0)


# ---- harmonics


def harmonics_rows():
    rows = []
    for case, (directions, degree) in hard_cases.HARMONICS.items():
        peers = {"sphericart": sphericart_basis, "SciPy": scipy_basis}
        if degree <= 8 and importlib.util.find_spec("e3nn_jax"):
            peers["e3nn-jax"] = e3nn_basis
        methods = [our_basis, *peers.values()]
        errors = precisions(functools.partial(basis_errors, directions, degree, methods))
        for i, what in enumerate(("value", "gradient")):
            ours = [cell(e[0][i]) for e in errors]
            theirs = [several([cell(x[i]) for x in e[1:]]) for e in errors]
            rows.append(row(case, what, ours, " / ".join(peers), theirs))
    return rows


def basis_errors(directions, degree, methods, dtype):
    if degree > 100 and dtype == np.float32:  # its compilation would take longer than that of all others
        return [["-", "-"]] * len(methods)
    d = np.resize(directions, (12, 3)).astype(dtype)  # one shape for all
    with np.errstate(all="ignore"):
        expected = truth.harmonics(d, degree)
        length = np.sqrt(np.sum(d.astype(np.longdouble) ** 2, axis=1))[:, None, None]
    errors = []
    for method in methods:
        with np.errstate(all="ignore"):
            values, slopes = method(d, degree)
            got = values, np.asarray(slopes, np.longdouble) * length
            errors.append([band_error(g, e) for g, e in zip(got, expected, strict=True)])
    return errors


def band_error(got, expected):
    """Relative to the largest value of each band."""
    errors = []
    for l in range(int(np.sqrt(expected.shape[1]))):
        band = slice(l * l, (l + 1) ** 2)
        errors.append(
            np.max(np.abs(np.asarray(got, float) - expected)[:, band]) / (np.max(abs(expected[:, band])) or 1)
        )
    return np.max(errors)


@functools.partial(jax.jit, static_argnums=1)
def our_basis(d, degree):
    push = lambda step: jax.jvp(lambda x: harmonics.sh_basis(x, degree), (d,), (jnp.broadcast_to(step, d.shape),))
    return jax.vmap(push, out_axes=(None, -1))(jnp.eye(3, dtype=d.dtype))


def unsigned(degree):
    """From the basis without the sign (-1)^m to ours."""
    return np.concatenate([(-1.0) ** np.arange(-l, l + 1) for l in range(degree + 1)])


def sphericart_basis(d, degree):
    values, slopes = sphericart.SphericalHarmonics(degree).compute_with_gradients(d)
    return values * unsigned(degree), np.moveaxis(slopes, 1, 2) * unsigned(degree)[:, None]


def scipy_basis(d, degree):
    """In the precision of `d`, with the derivatives in both angles that SciPy offers."""
    length = np.sqrt(np.sum(d.astype(np.longdouble) ** 2, axis=1))[:, None, None]
    d = d / np.max(np.abs(d), axis=1, keepdims=True)
    d = d / np.sqrt(np.sum(d * d, axis=1, keepdims=True))
    theta, phi = np.arctan2(np.hypot(d[:, 0], d[:, 1]), d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    l = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    m = (np.arange(len(l)) - l * l - l)[:, None]
    y, dy = (x[l, np.abs(m[:, 0])] for x in sph_harm_y_all(degree, degree, theta, phi, diff_n=1))
    real = lambda y: np.where(m == 0, y.real, np.sqrt(d.dtype.type(2)) * np.where(m > 0, y.real, y.imag)).T
    south = np.stack([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)], axis=-1)
    east = np.stack([-np.sin(phi), np.cos(phi), 0 * phi], axis=-1)
    by_theta, by_phi = real(dy[..., 0]), real(dy[..., 1]) / np.sin(theta)[:, None]
    return real(y), (by_theta[..., None] * south[:, None] + by_phi[..., None] * east[:, None]) / length


def e3nn_basis(d, degree):
    """Its polar axis is the second."""
    import e3nn_jax

    irreps = e3nn_jax.Irreps.spherical_harmonics(degree)
    basis = lambda x: e3nn_jax.spherical_harmonics(irreps, x, True, normalization="integral").array
    x = jnp.asarray(d[:, [1, 2, 0]])
    slopes = jax.vmap(jax.jacfwd(basis))(x)
    return np.asarray(basis(x)) * unsigned(degree), np.asarray(slopes)[..., [2, 0, 1]] * unsigned(degree)[:, None]


# ---- axes


def axes_rows():
    """An expansion in the highest band, decomposed and evaluated: whatever the axes, it must come back."""
    rng = np.random.default_rng(2)
    band = slice(AXES_DEGREE**2, (AXES_DEGREE + 1) ** 2)
    c = np.zeros(band.stop)
    c[band] = rng.normal(size=2 * AXES_DEGREE + 1)
    w, mix = unit(rng.normal(size=(12, 3))), unit(rng.normal(size=12))
    expected = truth.scipy_basis(w, AXES_DEGREE) @ c

    def ours(z, c, w):
        basis = decomposition.RotatedZonalBasis(z, AXES_DEGREE)
        return basis.evaluate(basis.weights(c), w)

    def peer(solve, z, c, w):
        m = harmonics.sh_basis(z, AXES_DEGREE)[:, band].T * np.sqrt(4 * np.pi / (2 * AXES_DEGREE + 1)).item()
        return harmonics.sh_basis(w, AXES_DEGREE)[:, band] @ (m @ solve(m, c[band]))

    square = lambda m, c: jnp.concatenate(
        [jnp.linalg.solve(m[:, : len(c)], c), jnp.zeros(m.shape[1] - len(c), c.dtype)]
    )
    methods = [ours, functools.partial(peer, square), functools.partial(peer, lambda m, c: jnp.linalg.pinv(m) @ c)]
    results = {}
    for dtype in FLOATS:
        with jax.enable_x64(dtype == np.float64):
            arguments = [jnp.asarray(x, dtype) for x in (c, w, mix)]
            compiled = [jax.jit(jax.grad(functools.partial(weighted, f), has_aux=True)) for f in methods]
            for case, z in hard_cases.axis_sets(AXES_DEGREE).items():
                cells = [attempt(axes_errors, f, expected, jnp.asarray(z, dtype), *arguments) for f in compiled]
                for i, what in enumerate(("value", "gradient")):
                    of_each = [x if isinstance(x, str) else x[i] for x in cells]
                    results.setdefault((case, what), []).append((of_each[0], several(of_each[1:])))
    return [row(*name, [r[0] for r in both], "solve / pinv", [r[1] for r in both]) for name, both in results.items()]


def weighted(function, z, c, w, mix):
    values = function(z, c, w)
    return mix @ values, values


def axes_errors(function, expected, *arguments):
    """Of the values, and of derivatives in the axes, which should be 0."""
    slopes, values = function(*arguments)
    rms = np.sqrt(np.mean(expected**2))
    return cell(np.max(np.abs(np.asarray(values, float) - expected)) / rms), cell(np.max(np.abs(slopes)) / rms)


# ---- polygons


def polygon_rows():
    cases = {name: (v, hard_cases.axes_for(v, np.random.default_rng(1))) for name, v in hard_cases.POLYGONS.items()}
    beyond = hard_cases.BEYOND_A_HEMISPHERE
    cases["more than a hemisphere"] = beyond, hard_cases.axes_for(beyond, np.random.default_rng(1))
    cases |= {name: (v, np.tile(d, (9, 1))) for name, (v, d) in hard_cases.AXES_AT_POLYGONS.items()}
    errors = precisions(functools.partial(polygon_errors, cases))
    rows = []
    for name in cases:
        value, gradient = zip(*(e[name] for e in errors), strict=True)
        rows.append(
            row(name, "value", [x[0] for x in value], "cosine powers / plain recurrence", [x[1] for x in value])
        )
        rows.append(row(name, "gradient", [x[0] for x in gradient], "plain recurrence", [x[1] for x in gradient]))
    opposite = hard_cases.OPPOSITE_VERTICES
    refused = precisions(
        lambda dtype: attempt(lambda: domains.solid_angle(domains.SphericalPolygon(opposite.astype(dtype))))
    )
    return [*rows, row("an edge of exactly pi", "value", refused)]


def polygon_errors(cases, dtype):
    weights = np.cos(np.arange(9 * (POLYGON_DEGREE + 1))).reshape(9, -1)
    ours = lambda v, d: domains.zonal_moments(domains.SphericalPolygon(v), d, POLYGON_DEGREE)
    loss = lambda f: lambda v, d: (jnp.sum(f(v, d) * jnp.asarray(weights, dtype)), f(v, d))
    compiled = lambda f: jax.jit(jax.vmap(jax.grad(loss(f), (0, 1), has_aux=True)))
    v = np.stack([padded(v) for v, _ in cases.values()]).astype(dtype)
    d = np.stack([d for _, d in cases.values()]).astype(dtype)
    wide = np.array([name == "more than a hemisphere" for name in cases])
    slopes, got = (jax.tree.map(np.array, x) for x in compiled(ours)(v, d))
    got[wide, :, 0] = domains.solid_angle(
        domains.SphericalPolygon(v[wide][0], largest=4 * np.pi)
    )  # `largest` is static
    plain_slopes, plain = (jax.tree.map(np.array, x) for x in compiled(plain_moments)(v, d))
    powers = np.stack([
        polygons.zonal_from_axial(polygons.axial_moments(p[None], axes, POLYGON_DEGREE, dtype))[0]
        for p, axes in zip(v, d, strict=True)
    ])  # fmt: skip
    for moments in (powers, plain):
        moments[wide, :, 0] += np.where(moments[wide, :, 0] < 0, 4 * np.pi, 0)
    errors = {}
    for i, (name, (vertices, _)) in enumerate(cases.items()):
        p = v[i, : len(vertices)]
        exact = truth.zonal_moments(p[::-1] if wide[i] else p, d[i], POLYGON_DEGREE, 33)
        exact = 4 * np.pi * np.eye(POLYGON_DEGREE + 1)[0] - exact if wide[i] else exact
        value = lambda x, exact=exact: cell(np.max(np.abs(np.asarray(x, float) - exact)) / abs(exact[0, 0]))
        along = truth.moment_slopes(p, d[i], weights, np.sqrt(abs(exact[0, 0])))
        # padding repeats the first vertex, which moves with it
        along = [(argument, move if argument else padded(move), slope) for argument, move, slope in along]
        gradient = lambda x, along=along: cell(slope_error(x, along))
        take = lambda x, i=i: [np.asarray(a[i], float) for a in x]
        with np.errstate(all="ignore"):
            errors[name] = (
                (value(got[i]), several([value(powers[i]), value(plain[i])])),
                (gradient(take(slopes)), gradient(take(plain_slopes))),
            )
    return errors


def slope_error(gradients, tries, size=0.0):
    """The largest error over the arguments, relative to each one's largest derivative or to `size`, if that is larger.

    tries: (argument, motion, derivative).
    """
    errors = []
    for argument in {t[0] for t in tries}:
        pairs = [(np.sum(gradients[argument] * move), slope) for a, move, slope in tries if a == argument]
        got, expected = np.array(pairs, float).T
        errors.append(np.max(np.abs(got - expected)) / (max(np.max(np.abs(expected)), size) or 1.0))
    return np.max(errors)


def plain_moments(v, axes):
    """The recurrence along edges as it stands, in Legendre polynomials, without differences; a fan for l = 0."""
    b = jnp.roll(v, -1, axis=0)
    cross = jnp.cross(v, b)
    sine = jnp.linalg.norm(cross, axis=1)
    normal = jnp.where(sine[:, None] > 0, cross / sine[:, None], 0)
    angle = jnp.arctan2(sine, jnp.sum(v * b, axis=1))[:, None]
    u0, u1, g, s0 = v @ axes.T, b @ axes.T, normal @ axes.T, jnp.cross(normal, v) @ axes.T
    s1 = s0 * jnp.cos(angle) - u0 * jnp.sin(angle)
    first, middle, last = v[:1], v[1:-1], v[2:]
    volume = jnp.sum(first * jnp.cross(middle[: len(last)], last), axis=1)
    along = 1 + jnp.sum(first * middle[: len(last)] + middle[: len(last)] * last + last * first, axis=1)

    def step(state, l):
        p0, q0, p1, q1, e0, e1, d0, d1 = state  # P_l and P_{l-1} at the ends, E_{l-1}, E_l, D_{l-1}, D_l
        moment = jnp.sum(g * d1, axis=0) / (l * (l + 1))
        c = (s0 * p0 - s1 * p1 - g * g * d1 + l * e0) / (l + 1)
        p0, q0, p1, q1 = (
            ((2 * l + 1) * u0 * p0 - l * q0) / (l + 1), p0, ((2 * l + 1) * u1 * p1 - l * q1) / (l + 1), p1
        )  # fmt: skip
        return (p0, q0, p1, q1, e1, ((2 * l + 1) * c - l * e0) / (l + 1), d1, d0 + (2 * l + 1) * e1), moment

    one, zero, angle = jnp.ones_like(u0), jnp.zeros_like(u0), jnp.broadcast_to(angle, u0.shape)
    start = (u0, one, u1, one, angle, s0 - s1, zero, angle)
    _, rest = jax.lax.scan(step, start, jnp.arange(1, POLYGON_DEGREE + 1, dtype=v.dtype))
    moments = jnp.broadcast_to(2 * jnp.sum(jnp.arctan2(volume, along)), (1, len(axes)))
    return jnp.concatenate([moments, rest]).T


# ---- shading by polygons


def shading_rows():
    scenes = {name: [np.float32(x) for x in scene] for name, scene in hard_cases.SHADING.items()}
    results = {}
    brdf = models.Ggx(0.5, 0.04)
    with jax.enable_x64(True):
        exact_slice = eqx.filter_jit(tabulated(brdf, np.float64, domain="upper").at)
        slice_of = lambda view: exact_slice(jnp.asarray(view))
        expected = {name: polygon_truth(name, scene, slice_of) for name, scene in scenes.items()}
    for dtype in FLOATS:
        with jax.enable_x64(dtype == np.float64):
            material = tabulated(brdf, dtype, domain="upper")
            shade = lambda points, positions, normals, views, material=material: shading.shade(
                material, models.PolygonLight(points), shading.Surface(normals, views, positions)
            )
            stacked = [jnp.asarray(np.stack(x), dtype) for x in zip(*scenes.values(), strict=True)]
            got, slopes = jax.jit(jax.vmap(jax.value_and_grad(shade, (0, 1, 2, 3))))(*stacked)
            slopes = [np.asarray(s, float) for s in slopes]
            for i, name in enumerate(scenes):
                points, *surface = (x[i] for x in stacked)
                estimate = reference.shade_polygon(
                    brdf, points, 1.0, *(x[None] for x in surface), key=jax.random.key(0), samples=256
                ).value[0]
                value, of_material, tries = expected[name]
                results.setdefault(name, []).append((
                    cell(largest(got[i], value)),
                    cell(slope_error([s[i] for s in slopes], tries, float(value))),
                    several([cell(largest(estimate, of_material))]),
                ))  # fmt: skip
    return beside_monte_carlo(results)


def tabulated(brdf, dtype, **options):
    brdf = jax.tree.map(lambda x: jnp.asarray(x, dtype), brdf)
    return shading.tabulate_brdf(brdf, SHADING_DEGREE, **options)


def polygon_truth(name, scene, slice_of):
    """Radiance of the expansion and of the material, and derivatives of the former, with motions."""
    value, of_material = truth.polygon_radiance(scene, slice_of, lambda wi, wo: truth.ggx_cosine(wi, wo, 0.5))
    if "plane" in name:  # dark on one side: its derivatives
        return value, of_material, [(i, np.ones_like(x), 0.0) for i, x in enumerate(scene)]
    step = 1e-7 if "1e-4" in name else 1e-4
    return value, of_material, truth.polygon_slopes(scene, slice_of, step=step, touching="on the horizon" in name)


# ---- shading by an environment


def roughness_rows():
    """The whole chain from roughness to radiance, against quadrature of the material."""
    bands = np.array([1, 0.9, 0.7, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05])
    pole, normal = unit([-0.4, 0.3, 0.7]), unit([0.1, -0.2, 1.0])
    l = np.repeat(np.arange(9), 2 * np.arange(9) + 1)
    e = bands[l] * 4 * np.pi / (2 * l + 1) * truth.scipy_basis(pole, SHADING_DEGREE)
    light = lambda w: np.polynomial.legendre.legval(w @ pole, bands)
    node = (28 + 0.5) * np.pi / 128
    seen = lambda theta: truth.frame_of(normal).T.astype(float) @ [np.sin(theta), 0.0, np.cos(theta)]
    cases = {
        "roughness 0.02 to radiance": (0.02, seen(node)),
        "roughness 1 to radiance": (1.0, seen(node)),
        "view 89.9 degrees from the normal, environment": (0.5, seen(np.radians(89.9))),
        "view at the normal, environment": (0.5, normal),
    }
    results = {name: [] for name in cases}
    exact = {name: truth.ggx_radiance(alpha, normal, view, light) for name, (alpha, view) in cases.items()}
    for dtype in FLOATS:
        with jax.enable_x64(dtype == np.float64):

            @jax.jit
            @functools.partial(jax.value_and_grad, argnums=(0, 1, 2))
            def radiance(alpha, normal, view, e):
                slices = tabulated(models.Ggx(alpha, 0.04), e.dtype)
                return shading.shade(slices, models.DistantLight(e), shading.Surface(normal, view))

            distant = models.Environment.from_function(lambda w: jnp.asarray(light(np.asarray(w, float)), w.dtype), 256)
            for name, (alpha, view) in cases.items():
                arguments = [jnp.asarray(x, dtype) for x in (alpha, normal, view, e)]
                value, tries = exact[name]
                surface = [x[None] for x in arguments[1:3]]
                brdf = models.Ggx(arguments[0], 0.04)
                estimate = reference.shade_environment(brdf, distant, *surface, key=jax.random.key(1), samples=256)
                got, slopes = radiance(*arguments)
                results[name].append((
                    cell(largest(got, value)),
                    cell(slope_error([np.asarray(s, float) for s in slopes], tries, value)),
                    several([cell(largest(estimate.value[0], value))]),
                ))  # fmt: skip
    return beside_monte_carlo(results)


# ---- materials


def material_rows():
    rows = []
    for name, (alpha, wi, wo) in hard_cases.MATERIALS.items():
        errors = precisions(functools.partial(material_errors, alpha, wi, wo))
        for i, what in enumerate(("value", "gradient")):
            rows.append(row(name, what, [e[0][i] for e in errors], "textbook", [several([e[1][i]]) for e in errors]))
    return rows + measured_rows()


def material_errors(alpha, wi, wo, dtype):
    arguments = [jnp.asarray(x, dtype) for x in (alpha, wi, wo)]
    exact, *slopes = truth.ggx_to_fifty_digits(*(np.asarray(x, float) for x in arguments))
    errors = []
    for run in (_our_material, _textbook):
        value, gradient = run(*arguments)
        gradient = [np.array(g, float) for g in gradient]
        for i in (1, 2):  # along the sphere
            u = np.asarray(arguments[i], float)
            gradient[i] -= (gradient[i] @ u) * u
        # what a lobe of this width can change by
        scale = max(abs(exact) / float(alpha), *(np.max(np.abs(s)) for s in slopes))
        wrong = max(np.max(np.abs(g - s)) / scale for g, s in zip(gradient, slopes, strict=True))
        errors.append((cell(abs(float(value) - exact) / abs(exact)), cell(wrong)))
    return errors


_our_material = jax.jit(
    jax.value_and_grad(lambda alpha, wi, wo: models.Ggx(alpha, 0.04).value_cosine(wi, wo), (0, 1, 2))
)
_textbook = jax.jit(
    jax.value_and_grad(lambda alpha, wi, wo: truth.ggx_cosine(wi, wo, alpha, jnp).astype(wi.dtype), (0, 1, 2))
)


def measured_rows():
    """A file of GGX with a fifth of the bins negative, and those below the horizon, against GGX itself."""
    rng, alpha = np.random.default_rng(9), 0.3
    directions = rng.normal(size=(2, 200, 3)) * [1, 1, 0.5] + [0, 0, 1.2]
    wi, wo = unit(np.abs(directions) * [1, 1, 1])
    wi[:, :2] *= rng.choice([-1, 1], (200, 2))
    exact = truth.ggx_cosine(wi, wo, alpha)
    move = np.stack([truth.tangential(rng, w) for w in wi])
    slopes = truth.derivative(lambda t: truth.ggx_cosine(unit(wi + t * move), wo, alpha), 1e-3)
    rms = lambda got, expected: np.sqrt(np.mean((np.asarray(got, float) - expected) ** 2) / np.mean(expected**2))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "holes.binary"
        io.write_merl(path, models.Ggx(alpha, 0.04))
        planes = np.fromfile(path, "<f8", offset=12).reshape(3, -1)
        planes[:, rng.random(planes.shape[1]) < 0.2] = -0.3
        with path.open("r+b") as file:
            file.seek(12)
            planes.tofile(file)

        def errors(dtype):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                brdf = models.MeasuredBrdf.from_merl(path, dtype=dtype)
            f = lambda wi, wo: brdf.value_cosine(wi, wo)[0]
            value, gradient = jax.jit(jax.vmap(jax.value_and_grad(f)))(*(jnp.asarray(w, dtype) for w in (wi, wo)))
            published = truth.nearest_bin(planes[0].reshape(90, 90, 180) / 1500, wi, wo) * wi[:, 2]
            return (
                cell(rms(value, exact)),
                cell(rms(np.sum(np.asarray(gradient, float) * move, axis=1), slopes)),
                several([cell(rms(published, exact))]),
                attempt(functools.partial(models.MeasuredBrdf.from_merl, path, negative="refuse")),
            )

        value, gradient, published, refused = zip(*precisions(errors), strict=True)
    name = "measured bins negative or below the horizon"
    return [
        row(name, "value", value, "nearest bin", published),
        row(name, "gradient", gradient),
        row(f"{name}, refused on request", "value", refused),
    ]


# ---- distant light


def light_rows():
    rng = np.random.default_rng(11)
    normals = unit(rng.normal(size=(8, 3)))
    views = unit(normals + 0.6 * unit(rng.normal(size=(8, 3))))
    mix = rng.normal(size=8)
    motion = [rng.normal(size=(16, 32)), truth.tangential(rng, normals), truth.tangential(rng, views)]
    brdf = models.Ggx(0.5, 0.04)
    clean = np.nan_to_num(hard_cases.BAD_TEXELS, nan=0.0, posinf=65504.0)  # of half precision the largest
    maps = hard_cases.LIGHTS | {"NaN and infinite texels, from a file": clean}
    with jax.enable_x64(True):
        slice_of = jax.jit(jax.vmap(tabulated(brdf, np.float64).at))
        local, exact = functools.partial(truth.environment_radiance, slice_of), {}
        for name, texels in maps.items():
            e = truth.map_coefficients(texels, SHADING_DEGREE)
            along = [
                mix @ local(truth.map_coefficients(motion[0], SHADING_DEGREE), normals, views),
                truth.derivative(lambda t, e=e: mix @ local(e, normals + t * motion[1], views), 1e-4),
                truth.derivative(lambda t, e=e: mix @ local(e, normals, views + t * motion[2]), 1e-4),
            ]
            quadrature = reference.shade_environment_quadrature(
                brdf, models.Environment(texels), normals, views, supersampling=8
            )
            exact[name] = local(e, normals, views), along, np.asarray(quadrature)
    results = {name: [] for name in maps}
    for dtype in FLOATS:
        with jax.enable_x64(dtype == np.float64), tempfile.TemporaryDirectory() as folder:
            material, weights = tabulated(brdf, dtype), jnp.asarray(mix, dtype)

            @jax.jit
            @functools.partial(jax.grad, argnums=(0, 1, 2), has_aux=True)
            def shade(texels, normals, views, material=material, weights=weights):
                light = models.Environment(texels).coefficients(SHADING_DEGREE)
                radiance = shading.shade(material, models.DistantLight(light), shading.Surface(normals, views))
                return weights @ radiance, radiance

            surface = [jnp.asarray(x, dtype) for x in (normals, views)]
            for name, texels in maps.items():
                texels = jnp.asarray(texels, dtype)
                if "file" in name:
                    path = Path(folder) / "bad.exr"
                    write_exr(path, hard_cases.BAD_TEXELS)
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore", UserWarning)
                        texels = models.Environment.load(path, dtype=dtype).texels[..., 0]
                    refused = attempt(functools.partial(models.Environment.load, path, bad_texels="refuse"))
                    results.setdefault("NaN and infinite texels, refused on request", []).append((refused, None, "-"))
                slopes, got = shade(texels, *surface)
                value, along, by_quadrature = exact[name]
                size = np.sqrt(np.mean(value**2)) or 1.0
                estimate = reference.shade_environment(
                    brdf, models.Environment(texels), *surface, key=jax.random.key(2), samples=256
                ).value
                moved = [np.sum(np.asarray(s, float) * m) for s, m in zip(slopes, motion, strict=True)]
                wrong = [abs(m - a) / max(abs(a), size) for m, a in zip(moved, along, strict=True)]
                scale = np.sqrt(np.mean(by_quadrature**2)) or 1.0
                results[name].append((
                    cell(np.max(np.abs(np.asarray(got, float) - value)) / size),
                    cell(np.max(wrong)),
                    several([cell(np.max(np.abs(np.asarray(estimate, float) - by_quadrature)) / scale)]),
                ))  # fmt: skip
            slopes, got = shade(jnp.asarray(hard_cases.BAD_TEXELS, dtype), *surface)
            results.setdefault("NaN and infinite texels, as they are", []).append(
                (cell(np.max(np.asarray(got))), cell(np.max(np.asarray(slopes[1]))), "-")
            )
    rows = []
    for name, both in results.items():
        value, gradient, estimate = zip(*both, strict=True)
        rows.append(row(name, "value", value, "-" if estimate[0] == "-" else "Monte Carlo", estimate))
        if gradient[0] is not None:
            rows.append(row(name, "gradient", gradient))
    return rows


def write_exr(path, texels):
    import OpenEXR

    channels = {name: texels.astype(np.float32) for name in "RGB"}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
