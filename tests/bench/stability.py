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

import jax
import jax.numpy as jnp
import mpmath
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
    (polygons), the radiance or value itself (shading and materials), the RMS radiance (lights). Derivatives: relative
    to the largest of those tried, in every argument; along the sphere where an argument is a direction; where an
    outline touches the horizon, on the side on which it is cut off. Polygons: degree 16; axes and shading: degree 8.
    Shading by polygons is compared with quadrature of the same expansion, by an environment with the material itself;
    Monte Carlo (256 samples) with the material itself everywhere.
    """
    groups = (harmonics_rows, axes_rows, polygon_rows, shading_rows, roughness_rows, material_rows, light_rows)
    return [row for group in groups for row in group()]


def row(case: str, what: str, ours: list, peer: str = "-", theirs: list | None = None) -> dict:
    theirs = theirs or ["-", "-"]
    return {
        "case": case, "what": what, "ours float32": ours[0], "ours float64": ours[1],
        "peer": peer, "peer float32": theirs[0], "peer float64": theirs[1],
    }  # fmt: skip


def cell(error) -> float | str:
    return float(error) if np.isfinite(error) else "NaN"


def attempt(error: Callable) -> float | str:
    """An error, or that there is a message instead."""
    try:
        return cell(error())
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
        errors = precisions(functools.partial(basis_errors, directions, degree, [our_basis, *peers.values()]))
        for i, what in enumerate(("value", "gradient")):
            ours = [cell(e[0][i]) for e in errors]
            theirs = [several([cell(x[i]) for x in e[1:]]) for e in errors]
            rows.append(row(case, what, ours, " / ".join(peers), theirs))
    return rows


def basis_errors(directions, degree, methods, dtype):
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
        errors.append(np.max(np.abs(np.asarray(got, float) - expected)[:, band]) / (np.max(abs(expected[:, band])) or 1))
    return np.max(errors)


@functools.partial(jax.jit, static_argnums=1)
def our_basis(d, degree):
    values = harmonics.sh_basis(d, degree)
    push = lambda step: jax.jvp(lambda x: harmonics.sh_basis(x, degree), (d,), (jnp.broadcast_to(step, d.shape),))[1]
    return values, jnp.moveaxis(jax.vmap(push)(jnp.eye(3, dtype=d.dtype)), 0, -1)


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
    rms = np.sqrt(np.mean(expected**2))

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
            arguments = [jnp.asarray(x, dtype) for x in (c, w)]
            values = [jax.jit(f) for f in methods]
            slopes = [jax.jit(jax.grad(lambda z, c, w, f=f: jnp.asarray(mix, dtype) @ f(z, c, w))) for f in methods]
            for case, z in hard_cases.axis_sets(AXES_DEGREE).items():
                z = jnp.asarray(z, dtype)
                value = lambda f, z=z: np.max(np.abs(np.asarray(f(z, *arguments), float) - expected)) / rms
                slope = lambda f, z=z: np.max(np.abs(np.asarray(f(z, *arguments), float))) / rms  # 0 is right
                for what, functions, error in (("value", values, value), ("gradient", slopes, slope)):
                    cells = [attempt(lambda f=f, error=error: error(f)) for f in functions]
                    results.setdefault((case, what), []).append((cells[0], several(cells[1:])))
    return [
        row(*name, [r[0] for r in both], "solve / pinv", [r[1] for r in both]) for name, both in results.items()
    ]


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
        rows.append(row(name, "value", [x[0] for x in value], "cosine powers / plain recurrence", [x[1] for x in value]))
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
    got[wide, :, 0] = domains.solid_angle(domains.SphericalPolygon(v[wide][0], largest=4 * np.pi))  # `largest` is static
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
        along = polygon_derivatives(p, d[i], weights, np.sqrt(abs(exact[0, 0])))
        gradient = lambda x, along=along: cell(slope_error(x, along))
        take = lambda x, i=i: [np.asarray(a[i], float) for a in x]
        with np.errstate(all="ignore"):
            errors[name] = (
                (value(got[i]), several([value(powers[i]), value(plain[i])])),
                (gradient(take(slopes)), gradient(take(plain_slopes))),
            )
    return errors


def polygon_derivatives(vertices, axes, weights, size):
    """Of the weighted sum of moments, along two motions of the vertices and two of the axes."""
    l = np.arange(POLYGON_DEGREE + 1)
    bands = np.repeat(l, 2 * l + 1)
    scale = weights * 4 * np.pi / (2 * l + 1)

    def total(integrals, y):
        return np.sum((y * integrals) @ (bands[:, None] == l) * scale)

    v, d = np.asarray(vertices, np.longdouble), np.asarray(axes, np.longdouble)
    y, integrals = truth.harmonics(d, POLYGON_DEGREE)[0], truth.edge_coefficients(v, POLYGON_DEGREE)
    rng, step, tries = np.random.default_rng(4), 1e-4 * min(1.0, float(size)), []
    for _ in range(2):
        move = tangential(rng, v)
        moved = lambda t, move=move: total(truth.edge_coefficients(v + t * move, POLYGON_DEGREE), y)
        # padding repeats the first vertex, which moves with it
        tries.append((0, padded(move), truth.derivative(moved, step)))
        move = tangential(rng, d)
        turned = lambda t, move=move: total(integrals, truth.harmonics(d + t * move, POLYGON_DEGREE)[0])
        tries.append((1, move, truth.derivative(turned, 1e-4)))
    return tries


def tangential(rng, directions):
    """Random motions along the sphere."""
    u = np.asarray(directions, float)
    u = u / np.linalg.norm(u, axis=-1, keepdims=True)
    move = rng.normal(size=u.shape)
    return move - np.sum(move * u, axis=-1, keepdims=True) * u


def slope_error(gradients, tries):
    """The largest relative error over the arguments; tries: (argument, motion, derivative)."""
    errors = []
    for argument in {t[0] for t in tries}:
        pairs = [(np.sum(gradients[argument] * move), slope) for a, move, slope in tries if a == argument]
        errors.append(largest(*zip(*pairs, strict=True)))
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
