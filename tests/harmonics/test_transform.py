"""Projection, synthesis and lookup of maps against SciPy's harmonics and rules of quadrature made here."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jax.test_util import check_grads

from shisd import harmonics
from shisd.harmonics.internal import sample_map
from tests.models.materials import spherical
from tests.truth import scipy_basis

slow = lambda *values: pytest.param(*values, marks=pytest.mark.slow)
SIZES = [(1, 1, 0), (13, 27, 6), (12, 24, 5), (37, 270, 33)]  # odd, even, and by Fourier transform
MORE = [slow(*size) for size in ((2, 3, 1), (13, 25, 6), (24, 25, 11), (40, 82, 19))]
EPS = {"float32": 1e-6, "float64": 3e-14}


def basis_of_map(height: int, width: int, degree: int) -> np.ndarray:
    """SciPy's harmonics at the texel centres [H, W, n], which are products of those at phi = 0 and waves."""
    theta, phi = np.pi * (np.arange(height) + 0.5) / height, 2 * np.pi * (np.arange(width) + 0.5) / width
    m = np.concatenate([np.arange(-l, l + 1) for l in range(degree + 1)])
    l = np.sqrt(np.arange(m.size)).astype(int)
    mirrored = l * l + l + np.abs(m)
    waves = np.where(m < 0, np.sin(np.outer(phi, -m)), np.cos(np.outer(phi, m)))
    return scipy_basis(spherical(theta, 0.0), degree)[:, None, mirrored] * waves[None]


def solid_angles(height: int, width: int) -> np.ndarray:
    """Of a texel of each row: differences of cosines as products, exact next to the poles."""
    from_pole = np.minimum(np.arange(height), np.arange(height)[::-1]) + 0.5
    return 4 * np.pi / width * np.sin(np.pi * from_pole / height) * np.sin(np.pi / 2 / height)


@pytest.mark.parametrize(("height", "width", "degree"), [*SIZES, (3, 4, 6), *MORE, slow(20, 30, 25), slow(9, 80, 35)])
def test_synthesis_is_the_expansion_at_the_texel_centres(dtype, rng, height, width, degree):
    c = rng.normal(size=(2, (degree + 1) ** 2))
    exact = basis_of_map(height, width, degree) @ c.T
    got = harmonics.synthesize_map(c.astype(dtype), height, width)
    assert got.dtype == dtype
    np.testing.assert_allclose(got, exact, rtol=0, atol=EPS[dtype.name] * np.abs(exact).max())


@pytest.mark.parametrize(("height", "width", "degree"), [*SIZES, *MORE])
def test_projection_of_samples_of_a_band_limited_map_is_exact(dtype, rng, height, width, degree):
    band = min(height - 1, width - degree - 1)
    c = rng.normal(size=((band + 1) ** 2, 3))
    texels = basis_of_map(height, width, band) @ c
    got = harmonics.project_map(texels.astype(dtype), degree, texels="samples")
    assert got.dtype == dtype
    exact = np.zeros((3, (degree + 1) ** 2))
    shared = (min(band, degree) + 1) ** 2
    exact[:, :shared] = c.T[:, :shared]
    np.testing.assert_allclose(got, exact, rtol=0, atol=4 * EPS[dtype.name] * np.abs(c).max())


POWER = {"float32": 5e-7, "float64": 2e-14}


@pytest.mark.parametrize("height", [8, 33, 256, slow(16), slow(32), slow(64), slow(128)])
def test_every_texel_keeps_its_power(dtype, height):
    """sqrt(4 pi) c_00 is linear in the texels: its derivative is the power of a texel of radiance 1, all at once."""
    width = 2 * height
    power = jax.jit(lambda image: harmonics.project_map(image, 2)[:, 0] * np.sqrt(4 * np.pi))
    image = np.zeros((height, width, 3), dtype)
    rows = np.array([0, 1, height // 2])
    image[rows, [3, width - 1, 5], np.arange(3)] = 7
    exact = solid_angles(height, width)
    np.testing.assert_allclose(power(image), 7 * exact[rows], rtol=POWER[dtype.name])
    each = jax.vjp(power, jnp.asarray(image))[1](jnp.ones(3, dtype))[0]
    np.testing.assert_allclose(each[..., 0], np.repeat(exact[:, None], width, 1), rtol=POWER[dtype.name])


@pytest.mark.parametrize(("height", "width", "degree"), [(5, 7, 9), (16, 300, 34), slow(8, 16, 30)])
def test_cells_are_integrated_exactly_in_every_band(dtype, height, width, degree):
    """Single texels against Gauss-Legendre rules inside them, also of degrees that the map would not support."""
    places = [(0, 0), (1, 3), (height // 2, 5), (height - 1, width - 1)]
    image, exact = np.zeros((height, width, 4)), []
    x, w = np.polynomial.legendre.leggauss(16)
    for k, (j, i) in enumerate(places):
        image[j, i, k] = 1
        theta, phi = np.pi * (j + 0.5 + x / 2) / height, 2 * np.pi * (i + 0.5 + x / 2) / width
        weights = np.outer(w * np.sin(theta) * np.pi / height / 2, w * np.pi / width)
        values = scipy_basis(spherical(theta[:, None], phi[None]), degree)
        exact.append(np.einsum("jin,ji->n", values, weights))
    got = np.asarray(harmonics.project_map(image.astype(dtype), degree))
    assert got.dtype == dtype
    scale = np.max(np.abs(exact), axis=1, keepdims=True)
    np.testing.assert_allclose(got / scale, exact / scale, rtol=0, atol={"float32": 5e-7, "float64": 4e-14}[dtype.name])


@pytest.mark.parametrize("colour", [(2, 3)])
def test_colour_axes_lead_the_coefficients_and_end_the_map(dtype, rng, colour):
    c = rng.normal(size=(*colour, 25)).astype(dtype)
    texels = harmonics.synthesize_map(c, 12)
    assert texels.shape == (12, 24, *colour)
    got = harmonics.project_map(texels, 4, texels="samples")
    np.testing.assert_allclose(got, c, rtol=0, atol=4 * EPS[dtype.name])


def test_map_projection_agrees_with_ducc(x64, rng):
    ducc0 = pytest.importorskip("ducc0")
    height, width, degree = 48, 100, 30
    texels = basis_of_map(height, width, degree) @ rng.normal(size=(degree + 1) ** 2)
    alm = ducc0.sht.experimental.analysis_2d(
        map=texels[None], spin=0, lmax=degree, mmax=degree, geometry="F1", phi0=np.pi / width
    )[0]
    got = np.asarray(harmonics.project_map(texels, degree, texels="samples"))
    scale = np.abs(alm).max()
    start = 0
    for m in range(degree + 1):
        l = np.arange(m, degree + 1)
        a = alm[start : start + l.size]
        start += l.size
        np.testing.assert_allclose(got[l * l + l + m], a.real * (np.sqrt(2) if m else 1), rtol=0, atol=1e-13 * scale)
        if m:
            np.testing.assert_allclose(got[l * l + l - m], -a.imag * np.sqrt(2), rtol=0, atol=1e-13 * scale)


@pytest.mark.slow
def test_a_large_map_at_degree_64(dtype, rng):
    c = rng.normal(size=65**2)
    texels = harmonics.synthesize_map(jnp.asarray(c, dtype), 512)
    got = harmonics.project_map(texels, 64, texels="samples")
    np.testing.assert_allclose(got, c, rtol=0, atol=10 * EPS[dtype.name])


def test_row_zero_is_next_to_the_pole_and_azimuth_grows_from_x_to_y(dtype):
    """Cells: z over row 0 integrates to pi sin^2(pi / 8); x and y over the first quarter of columns to pi / 2 each."""
    image = np.zeros((8, 16, 3), dtype)
    image[0, :, 0], image[:, :4, 1], image[..., 2] = 1, 1, 1
    c = np.asarray(harmonics.project_map(image, 1), np.float64)
    first = np.sqrt(3 / (4 * np.pi))
    exact = np.sqrt(4 * np.pi) * np.array([[np.sin(np.pi / 16) ** 2, 0, 0, 0], [1 / 4, 0, 0, 0], [1, 0, 0, 0]])
    exact[0, 2] = first * np.pi * np.sin(np.pi / 8) ** 2
    exact[1, [1, 3]] = -first * np.pi / 2
    np.testing.assert_allclose(c, exact, rtol=0, atol=EPS[dtype.name])


def test_a_texel_that_is_not_a_number_reaches_its_own_colour_only():
    texels = np.ones((8, 16, 2), np.float32)
    texels[3, 4, 0] = np.nan
    for kind in ("cells", "samples"):
        c = np.asarray(harmonics.project_map(texels, 2, texels=kind))
        assert np.all(np.isnan(c[0])) and np.all(np.isfinite(c[1]))


@pytest.mark.parametrize("degree", (0, 1, 5, slow(2), slow(9)))
def test_projection_of_a_band_limited_function_is_exact(dtype, rng, degree):
    """By the least rule that can do it, and by the one that is chosen."""
    c = rng.normal(size=(3, (degree + 1) ** 2))

    def function(w):
        assert w.dtype == dtype
        return (scipy_basis(w, degree) @ c.T).astype(dtype)

    for rule in (2 * degree, None):
        got = harmonics.project(function, degree, quadrature_degree=rule)
        assert got.dtype == dtype
        np.testing.assert_allclose(got, c, rtol=0, atol=3 * EPS[dtype.name] * max(1, degree))


def cosine_bands(degree):
    """Integrals of max(z, 0) y_l0: sqrt((2l+1) pi) times those of z P_l(z) over [0, 1] (polynomials, from NumPy)."""
    z = np.polynomial.Legendre([0, 1])
    bands = [(z * np.polynomial.Legendre.basis(l)).integ() for l in range(degree + 1)]
    return np.array([np.sqrt((2 * l + 1) * np.pi) * (f(1) - f(0)) for l, f in enumerate(bands)])


def test_the_rule_is_chosen_by_convergence():
    """max(cos, 0), about the pole and tilted, where no row meets the kink; the error is the one that is promised."""
    l = np.arange(5)
    mean = np.pi / np.sqrt(4 * np.pi)
    got = harmonics.project(lambda w: np.maximum(np.asarray(w)[:, 2], 0), 4)
    np.testing.assert_allclose(got[l * l + l], cosine_bands(4), atol=5e-4 * mean)
    tilt = np.array([0.6, 0.64, 0.48])
    got = harmonics.project(lambda w: np.maximum(np.asarray(w) @ tilt, 0).astype(np.float32), 4)
    norms = [np.linalg.norm(got[k * k : (k + 1) ** 2]) for k in l]
    np.testing.assert_allclose(norms, np.abs(cosine_bands(4)), atol=5e-4 * mean)


def test_what_does_not_converge_is_refused_with_its_numbers():
    step = lambda w: (np.asarray(w)[:, 2] > 0.3).astype(np.float32)
    message = r"from quadrature degree 1024 to 2048, .* change by \d.*e-03 of the mean, above `tolerance` 0.001"
    with pytest.raises(ValueError, match=message):
        harmonics.project(step, 2)
    loose = harmonics.project(step, 2, tolerance=0.03)
    np.testing.assert_allclose(loose[0], np.sqrt(np.pi) * 0.7, rtol=0.03)
    assert np.isnan(harmonics.project(lambda w: step(w) * np.float32(np.nan), 2)).all()


@pytest.mark.slow
def test_the_rule_under_jit_is_fixed_and_checked():
    smooth = jax.jit(lambda s: harmonics.project(lambda w: jnp.maximum(w[:, 2], s), 2))
    np.testing.assert_allclose(np.asarray(smooth(0.0))[[0, 2, 6]], cosine_bands(2), atol=1e-3)
    with pytest.raises(Exception, match="`project` has not converged to `tolerance` 0.001 at quadrature degree 256"):
        jax.jit(lambda s: harmonics.project(lambda w: jnp.where(w[:, 2] > s, 1.0, 0.0), 2))(0.3).block_until_ready()


def test_a_higher_quadrature_degree_resolves_a_cap():
    """Indicator of the cap z > cos(a): c_l0 = sqrt(pi / (2l+1)) (P_(l-1) - P_(l+1))(cos a)."""
    cos, degree = 0.3, 4
    p = [np.polynomial.Legendre.basis(l)(cos) for l in range(degree + 2)]
    exact = [np.sqrt(np.pi) * (1 - cos)]
    exact += [np.sqrt(np.pi / (2 * l + 1)) * (p[l - 1] - p[l + 1]) for l in range(1, degree + 1)]
    l = np.arange(degree + 1)
    cap = lambda w: (np.asarray(w)[:, 2] > cos).astype(np.float32)
    got = harmonics.project(cap, degree, quadrature_degree=400)
    np.testing.assert_allclose(got[l * l + l], exact, atol=0.006)  # half the weight of a row: 0.008 sqrt(pi) / 2


@pytest.mark.parametrize(("height", "width", "degree"), [(7, 13, 4), (40, 300, 34)])
def test_transforms_are_linear_with_exact_transposes(x64, rng, height, width, degree):
    """<A t, c> = <t, A^T c> with the values tested above; the larger size goes by the Fourier transform."""
    t, c = rng.normal(size=(height, width, 2)), rng.normal(size=(2, (degree + 1) ** 2))
    for verb, x, y in (
        (lambda t: harmonics.project_map(t, degree), t, c),
        (lambda t: harmonics.project_map(t, degree, texels="samples"), t, c),
        (lambda c: harmonics.synthesize_map(c, height, width), c, t),
    ):
        value, transpose = jax.vjp(verb, jnp.asarray(x))
        np.testing.assert_allclose(np.vdot(transpose(jnp.asarray(y))[0], x), np.vdot(y, value), rtol=1e-12)


def test_projection_is_differentiable_in_what_the_function_closes_over(x64):
    sharpness = jnp.asarray(2.0)
    f = jax.jit(lambda s: harmonics.project(lambda w: jnp.exp(s * (w[:, 2] - 1)), 3, quadrature_degree=20))
    check_grads(f, (sharpness,), order=1, modes=("fwd", "rev"))
    exact = np.sqrt(np.pi) * (1 - np.exp(-4.0)) / 2  # of exp(2 (z - 1)), l = 0
    np.testing.assert_allclose(f(sharpness)[0], exact, rtol=1e-12)


def test_jit_and_vmap_agree_with_the_plain_call(rng):
    texels = rng.normal(size=(3, 9, 19)).astype(np.float32)
    plain = np.stack([harmonics.project_map(t, 4) for t in texels])
    both = jax.jit(jax.vmap(lambda t: harmonics.project_map(t, 4)))
    np.testing.assert_allclose(both(texels), plain, atol=5e-7)
    maps = np.stack([harmonics.synthesize_map(c, 9, 19) for c in plain])
    np.testing.assert_allclose(jax.jit(jax.vmap(lambda c: harmonics.synthesize_map(c, 9, 19)))(plain), maps, atol=5e-7)


@pytest.mark.parametrize(
    ("shape", "degree", "largest"), [((8, 16), 8, 7), ((8, 16), 9, 7), ((40, 16), 8, 7), ((4, 9), 5, 3)]
)
def test_too_high_a_degree_says_what_samples_support(as_user, shape, degree, largest):
    with pytest.raises(ValueError, match=f"`degree` {degree} is too high for .* samples; pass {largest} or less"):
        harmonics.project_map(np.zeros(shape, np.float32), degree, texels="samples")


# ---- lookup

LENGTHS = np.array([[1e-30], [1], [1e30]])


def test_lookup_of_cells_is_the_texel_there(dtype, rng):
    """Anywhere inside a cell, at any length; the poles belong to their rows."""
    image = rng.normal(size=(6, 10, 2)).astype(dtype)
    j, i = np.divmod(rng.permutation(60), 10)
    u, v = rng.uniform(0.02, 0.98, (2, 60))
    w = spherical(np.pi * (j + v) / 6, 2 * np.pi * (i + u) / 10)
    got = sample_map(image, (w * LENGTHS[rng.integers(0, 3, 60)]).astype(dtype))
    assert got.dtype == dtype
    np.testing.assert_array_equal(got, image[j, i])
    poles = np.array([[0, 0, 1], [0, 0, -1]], dtype)
    np.testing.assert_array_equal(sample_map(image, poles), image[[0, -1], 0])


@pytest.mark.parametrize("kind", ["cells", "samples"])
def test_lookup_along_no_direction_is_not_a_number(kind):
    """Values and gradients, and of no other point."""
    image = np.ones((4, 8, 3), np.float32)
    bad = [[0, 0, 0], [np.nan, 0, 1], [0, 0, np.nan], [np.nan] * 3, [np.inf, 0, 1], [0, 0, 1], [1, 2, 3]]
    both = jax.jit(jax.vmap(jax.value_and_grad(lambda w: jnp.sum(sample_map(image, w, texels=kind)))))
    value, slope = (np.asarray(x) for x in both(np.array(bad, np.float32)))
    assert np.isnan(value[:5]).all() and np.isnan(slope[:5]).all()
    np.testing.assert_allclose(value[5:], 3, rtol=1e-6)
    np.testing.assert_allclose(slope[5:], 0, atol=1e-6)


def test_batches_may_be_sharded_or_empty():
    image, c = np.ones((4, 8), np.float32), np.arange(4, dtype=np.float32)
    ends = {
        (): (
            lambda w: sample_map(image, w),
            lambda w: sample_map(image, w, texels="samples"),
            lambda w: harmonics.evaluate(c, w),
        ),
        (4,): (
            lambda w: harmonics.sh_basis(w, 1),
            lambda w: harmonics.multiply(jnp.pad(w, ((0, 0), (0, 1))), c, 1),
            lambda w: harmonics.rotate(jnp.pad(w, ((0, 0), (0, 1))), np.eye(3, dtype=np.float32)),
        ),
    }
    every = jax.jit(lambda w: [verb(w) for verbs in ends.values() for verb in verbs])
    total = lambda w: jnp.stack([jnp.sum(x) for x in every(w)]).sum()
    whole = np.ones((2, 3), np.float32)
    mesh = jax.make_mesh((1,), ("points",), axis_types=(AxisType.Explicit,))
    for got, expected in zip(
        every(jax.device_put(whole, NamedSharding(mesh, PartitionSpec("points")))), every(whole), strict=True
    ):
        assert jax.typeof(got).sharding.spec[0] == "points"
        np.testing.assert_allclose(got, expected, rtol=1e-6)
    none = jnp.zeros((0, 3))
    assert [x.shape for x in every(none)] == [(0, *end) for end, verbs in ends.items() for _ in verbs]
    assert jax.grad(total)(none).shape == (0, 3)
    assert harmonics.sh_basis(np.zeros((0, 5, 3), np.float32), 0).shape == (0, 5, 1)
    assert harmonics.evaluate(np.zeros((0, 1, 4), np.float32), whole).shape == (0, 2)
    assert harmonics.project_map(np.zeros((4, 8, 0), np.float32), 1).shape == (0, 4)


def test_errors_name_the_argument(as_user):
    image = np.zeros((4, 8), np.float32)
    for verb in (lambda x: harmonics.project_map(x, 0), lambda x: sample_map(x, np.ones(3, np.float32))):
        for wrong in (image[0], image[:0]):
            with pytest.raises(ValueError, match=r"`image` must have shape \[H, W"):
                verb(wrong)
    with pytest.raises(ValueError, match='`texels` must be "cells" or "samples"; got \'pixels\''):
        harmonics.project_map(image, 0, texels="pixels")
    with pytest.raises(ValueError, match="`image` must have an even width"):
        sample_map(image[:, :7], np.ones(3, np.float32), texels="samples")
    with pytest.raises(ValueError, match="`coefficients`"):
        harmonics.synthesize_map(np.zeros(5, np.float32), 4)
    with pytest.raises(ValueError, match="`height`"):
        harmonics.synthesize_map(np.zeros(4, np.float32), 0)
    with pytest.raises(ValueError, match="`width`"):
        harmonics.synthesize_map(np.zeros(4, np.float32), 4, 0)
    with pytest.raises(ValueError, match="`quadrature_degree`"):
        harmonics.project(lambda w: w[:, 0], 4, quadrature_degree=7)
    with pytest.raises(ValueError, match="`function`"):
        harmonics.project(lambda w: w[:3, 0], 4)
    with pytest.raises(ValueError, match=r"function\(directions\)"):
        harmonics.project(lambda w: w[:, 0].astype(np.complex64), 4)
