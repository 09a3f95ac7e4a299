import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.special import sph_harm_y

from shisd import harmonics

SIZES = [(1, 1, 0), (2, 3, 1), (12, 24, 5), (13, 25, 6), (13, 27, 6), (24, 25, 11), (40, 82, 19), (37, 270, 33)]
EPS = {"float32": 2e-6, "float64": 3e-14}


def basis(theta: np.ndarray, phi: np.ndarray, degree: int) -> np.ndarray:
    """Real harmonics from SciPy's complex ones."""
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            polar = sph_harm_y(l, abs(m), theta, np.zeros_like(theta)).real * (np.sqrt(2) if m else 1)
            columns.append(polar * (np.sin(-m * phi) if m < 0 else np.cos(m * phi)))
    return np.stack(columns, axis=-1)


def texel_centres(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    theta, phi = np.pi * (np.arange(height) + 0.5) / height, 2 * np.pi * (np.arange(width) + 0.5) / width
    return theta[:, None], phi[None, :]


@pytest.mark.parametrize(("height", "width", "degree"), [*SIZES, (3, 4, 6), (20, 30, 25), (9, 80, 35)])
def test_synthesis_is_the_expansion_at_the_texel_centres(dtype, rng, height, width, degree):
    c = rng.normal(size=(2, (degree + 1) ** 2))
    exact = basis(*texel_centres(height, width), degree) @ c.T
    got = harmonics.synthesize_map(jnp.asarray(c, dtype), height, width)
    assert got.dtype == dtype
    np.testing.assert_allclose(got, exact, rtol=0, atol=EPS[dtype.name] * np.abs(exact).max())


@pytest.mark.parametrize(("height", "width", "degree"), SIZES)
def test_projection_of_a_band_limited_map_is_exact(dtype, rng, height, width, degree):
    band = min(height - 1, width - degree - 1)
    c = rng.normal(size=((band + 1) ** 2, 3))
    texels = basis(*texel_centres(height, width), band) @ c
    got = harmonics.project_map(jnp.asarray(texels, dtype), degree)
    assert got.dtype == dtype
    exact = np.zeros((3, (degree + 1) ** 2))
    shared = (min(band, degree) + 1) ** 2
    exact[:, :shared] = c.T[:, :shared]
    np.testing.assert_allclose(got, exact, rtol=0, atol=EPS[dtype.name] * np.abs(c).max())


@pytest.mark.parametrize("colour", [(), (3,), (2, 3)])
def test_colour_axes_lead_the_coefficients_and_end_the_map(dtype, rng, colour):
    c = jnp.asarray(rng.normal(size=(*colour, 25)), dtype)
    texels = harmonics.synthesize_map(c, 12)
    assert texels.shape == (12, 24, *colour)
    np.testing.assert_allclose(harmonics.project_map(texels, 4), c, rtol=0, atol=2 * EPS[dtype.name])


def test_map_projection_agrees_with_ducc(x64, rng):
    ducc0 = pytest.importorskip("ducc0")
    height, width, degree = 96, 200, 40
    texels = np.asarray(harmonics.synthesize_map(jnp.asarray(rng.normal(size=41**2)), height, width))
    alm = ducc0.sht.experimental.analysis_2d(
        map=texels[None], spin=0, lmax=degree, mmax=degree, geometry="F1", phi0=np.pi / width
    )[0]
    got = np.asarray(harmonics.project_map(jnp.asarray(texels), degree))
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
    np.testing.assert_allclose(harmonics.project_map(texels, 64), c, rtol=0, atol=10 * EPS[dtype.name])


def test_row_zero_is_next_to_the_pole_and_azimuth_grows_from_x_to_y(dtype):
    l1 = np.sqrt(4 * np.pi / 3)
    top = jnp.zeros((8, 16), dtype).at[0].set(1)
    assert harmonics.project_map(top, 1)[2] > 0  # +z
    quarter = jnp.zeros((8, 16), dtype).at[:, :4].set(1)  # 0 < phi < pi/2
    c = harmonics.project_map(quarter, 1)
    assert c[1] < 0  # -y
    assert c[3] < 0  # -x
    constant = harmonics.project_map(jnp.ones((8, 16), dtype), 1)
    np.testing.assert_allclose(constant, [np.sqrt(4 * np.pi), 0, 0, 0], atol=EPS[dtype.name] * l1)


def test_a_texel_that_is_not_a_number_reaches_its_own_colour_only():
    texels = jnp.ones((8, 16, 2)).at[3, 4, 0].set(jnp.nan)
    c = harmonics.project_map(texels, 2)
    assert jnp.all(jnp.isnan(c[0]))
    assert jnp.all(jnp.isfinite(c[1]))


@pytest.mark.parametrize("degree", (0, 1, 2, 5, 9))
@pytest.mark.parametrize("colour", [(), (3,)])
def test_projection_of_a_band_limited_function_is_exact(dtype, rng, degree, colour):
    c = rng.normal(size=(*colour, (degree + 1) ** 2))

    def function(w):
        assert w.dtype == dtype
        z = np.asarray(w, np.float64)
        y = basis(np.arctan2(np.hypot(z[:, 0], z[:, 1]), z[:, 2]), np.arctan2(z[:, 1], z[:, 0]), degree)
        return jnp.asarray(y @ c.T, dtype)

    got = harmonics.project(function, degree)
    assert got.dtype == dtype
    np.testing.assert_allclose(got, c, rtol=0, atol=EPS[dtype.name] * max(1, degree))


def test_a_higher_quadrature_degree_resolves_a_cap(x64):
    """Indicator of the cap z > cos(a): c_l0 = sqrt(pi / (2l+1)) (P_(l-1) - P_(l+1))(cos a)."""
    cos, degree = 0.3, 4
    p = [1.0, cos]
    for l in range(2, degree + 2):
        p.append(((2 * l - 1) * cos * p[l - 1] - (l - 1) * p[l - 2]) / l)
    exact = [np.sqrt(np.pi) * (1 - cos)]
    exact += [np.sqrt(np.pi / (2 * l + 1)) * (p[l - 1] - p[l + 1]) for l in range(1, degree + 1)]
    l = np.arange(degree + 1)
    cap = lambda w: jnp.where(w[:, 2] > cos, 1.0, 0.0)
    errors = [
        np.abs(harmonics.project(cap, degree, quadrature_degree=q)[l * l + l] - np.array(exact)).max() for q in (8, 400)
    ]
    assert errors[1] < 0.01
    assert errors[1] < errors[0] / 5


@pytest.mark.parametrize(("height", "width", "degree"), [(7, 13, 4), (12, 24, 5)])
def test_transforms_are_linear_with_exact_gradients(x64, rng, height, width, degree):
    texels = jnp.asarray(rng.normal(size=(height, width, 2)))
    c = jnp.asarray(rng.normal(size=(2, (degree + 1) ** 2)))
    check_grads(jax.jit(lambda t: harmonics.project_map(t, degree)), (texels,), order=1, modes=("fwd", "rev"))
    check_grads(jax.jit(lambda c: harmonics.synthesize_map(c, height, width)), (c,), order=1, modes=("fwd", "rev"))


def test_gradient_through_the_fourier_transform(x64, rng):
    """Large enough for the path that transforms rows: <analysis t, c> = <t, its transpose c>."""
    t, c = jnp.asarray(rng.normal(size=(40, 300))), jnp.asarray(rng.normal(size=35**2))
    _, pullback = jax.vjp(lambda t: harmonics.project_map(t, 34), t)
    np.testing.assert_allclose(jnp.vdot(pullback(c)[0], t), jnp.vdot(c, harmonics.project_map(t, 34)), rtol=1e-12)
    _, pullback = jax.vjp(lambda c: harmonics.synthesize_map(c, 40, 300), c)
    np.testing.assert_allclose(
        jnp.vdot(pullback(t)[0], c), jnp.vdot(t, harmonics.synthesize_map(c, 40, 300)), rtol=1e-12
    )


def test_projection_is_differentiable_in_what_the_function_closes_over(x64):
    sharpness = jnp.asarray(2.0)
    f = jax.jit(lambda s: harmonics.project(lambda w: jnp.exp(s * (w[:, 2] - 1)), 3, quadrature_degree=20))
    check_grads(f, (sharpness,), order=1, modes=("fwd", "rev"))
    exact = np.sqrt(np.pi) * (1 - np.exp(-4.0)) / 2  # of exp(2 (z - 1)), l = 0
    np.testing.assert_allclose(f(sharpness)[0], exact, rtol=1e-12)


def test_jit_and_vmap_agree_with_the_plain_call(dtype, rng):
    texels = jnp.asarray(rng.normal(size=(3, 9, 19)), dtype)
    plain = jnp.stack([harmonics.project_map(t, 4) for t in texels])
    tolerance = EPS[dtype.name] * 10
    np.testing.assert_allclose(jax.vmap(lambda t: harmonics.project_map(t, 4))(texels), plain, atol=tolerance)
    np.testing.assert_allclose(jax.jit(lambda t: harmonics.project_map(t, 4))(texels[0]), plain[0], atol=tolerance)
    maps = jnp.stack([harmonics.synthesize_map(c, 9, 19) for c in plain])
    np.testing.assert_allclose(jax.vmap(lambda c: harmonics.synthesize_map(c, 9, 19))(plain), maps, atol=tolerance)


@pytest.mark.parametrize(
    ("shape", "degree", "largest"), [((8, 16), 8, 7), ((8, 16), 9, 7), ((40, 16), 8, 7), ((4, 9), 5, 3)]
)
def test_too_high_a_degree_says_what_the_map_supports(as_user, shape, degree, largest):
    with pytest.raises(ValueError, match=f"`degree` {degree} is too high .* pass {largest} or less"):
        harmonics.project_map(np.zeros(shape, np.float32), degree)
    harmonics.project_map(np.zeros(shape, np.float32), largest)


def test_errors_name_the_argument(as_user):
    with pytest.raises(ValueError, match="`texels`"):
        harmonics.project_map(np.zeros(5, np.float32), 0)
    with pytest.raises(ValueError, match="`texels`"):
        harmonics.project_map(np.zeros((0, 5), np.float32), 0)
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
