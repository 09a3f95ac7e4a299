"""Mother kernels: their zonal coefficients against adaptive quadrature of their own formulas, in both precisions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.special import eval_legendre

from shisd import decomposition
from shisd.decomposition import _kernels

DEGREE = 20
WIDTHS = np.linspace(0.3, 40, DEGREE + 1)
ANGLES = np.linspace(3.1, 0.05, DEGREE + 1)

# profiles written out once more, with where they live in t = 1 - x
KERNELS = {
    "Legendre": (decomposition.LegendreKernel, lambda x, l: np.sqrt((2 * l + 1) / 4 / np.pi) * eval_legendre(l, x)),
    "Gaussian": (decomposition.GaussianKernel, lambda x, l: np.exp(-(1 - x) * l * l)),
    "Gaussian, widths": (lambda: decomposition.GaussianKernel(WIDTHS), lambda x, l: np.exp(-(1 - x) * WIDTHS[l])),
    "Gauss-Legendre": (
        decomposition.GaussLegendreKernel,
        lambda x, l: np.exp(-(1 - x) * l * l) * eval_legendre(l, x),
    ),
    "Phong": (decomposition.PhongKernel, lambda x, l: np.where(x > 0, x, 0) ** (4 * l) if l else np.ones_like(x)),
    "Phong, exponents": (lambda: decomposition.PhongKernel(WIDTHS), lambda x, l: np.where(x > 0, x, 0) ** WIDTHS[l]),
    "discs": (
        decomposition.CapKernel,
        lambda x, l: np.where(x >= np.cos(min(np.pi, 2.405 / (l + 0.5))), 1.0, 0.0),
    ),
    "discs, angles": (lambda: decomposition.CapKernel(ANGLES), lambda x, l: np.where(x >= np.cos(ANGLES[l]), 1.0, 0.0)),
    "function": (
        lambda: decomposition.FunctionKernel(lambda x, l: 1 / (1.1 + l / 20 - x)),
        lambda x, l: 1 / (1.1 + l / 20 - x),
    ),
}
JUMPS = {
    "discs": lambda l: np.cos(min(np.pi, 2.405 / (l + 0.5))),
    "discs, angles": lambda l: np.cos(ANGLES[l]),
    "Phong": lambda l: 0.0,
    "Phong, exponents": lambda l: 0.0,
}


def integrals(profile, l, jump):
    """<phi_l, y_n^0> for all n by adaptive quadrature."""
    norms = np.sqrt((2 * np.arange(DEGREE + 1) + 1) / (4 * np.pi))
    integrand = lambda x: 2 * np.pi * profile(np.float64(x), l) * norms * eval_legendre(np.arange(DEGREE + 1), x)
    points = sorted({-1.0, 1.0, float(jump), 1 - 8 / max(l * l, 8)})
    return sum(
        quad_vec(integrand, a, b, epsabs=1e-13, epsrel=1e-13)[0] for a, b in zip(points, points[1:], strict=False)
    )


zonal_of = eqx.filter_jit(lambda kernel, dtype: kernel.zonal(DEGREE, dtype=dtype))


@pytest.mark.parametrize("name", KERNELS)
def test_zonal_coefficients_are_integrals_of_the_profile(name, dtype):
    make, profile = KERNELS[name]
    beta = np.asarray(zonal_of(make(), dtype))
    assert beta.shape == (DEGREE + 1, DEGREE + 1) and beta.dtype == dtype
    limit = {"float64": 2e-12, "float32": 2e-6 if name == "function" else 6e-7}[dtype.name]
    for l in (0, 1, 2, 7, 20):
        expected = integrals(profile, l, JUMPS.get(name, lambda l: 0.0)(l))
        np.testing.assert_allclose(beta[l], expected, atol=limit * np.abs(expected).max())


@pytest.mark.parametrize("name", KERNELS)
def test_values_are_the_profile(name, x64, rng):
    make, profile = KERNELS[name]
    kernel, x = make(), rng.uniform(-1, 1, (3, 50))
    for l in (0, 1, 7):
        np.testing.assert_allclose(kernel(x, l), profile(x, l), rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("sharpness", [0.0, 1e-3, 3.0, 400.0, 1e5])
def test_gaussians_of_every_width_against_40_digits(sharpness, dtype):
    degree = 64
    got = np.asarray(_kernels.gaussian_zonal(jnp.asarray(sharpness, dtype), degree))
    with mpmath.workdps(40):
        k = mpmath.mpf(float(np.asarray(sharpness, dtype)))
        bessel = lambda n: (
            2 * mpmath.sqrt(mpmath.pi / (2 * k)) * mpmath.exp(-k) * mpmath.besseli(n + mpmath.mpf(1) / 2, k)
        )
        integral = [float(bessel(n)) if k else 2.0 * (n == 0) for n in range(degree + 1)]
    expected = 2 * np.pi * np.sqrt((2 * np.arange(degree + 1) + 1) / (4 * np.pi)) * integral
    np.testing.assert_allclose(got, expected, atol={"float64": 4e-14, "float32": 1e-6}[dtype.name] * expected.max())


WIDE = {
    "Gaussian": decomposition.GaussianKernel,
    "Gauss-Legendre": decomposition.GaussLegendreKernel,
    "Phong": decomposition.PhongKernel,
    "discs": decomposition.CapKernel,
}


@pytest.mark.parametrize("name", WIDE)
def test_derivatives_in_the_widths_match_finite_differences(name, x64):
    widths = np.linspace(2.9, 0.4, 5) if name == "discs" else np.array([0.0, 0.5, 3.0, 20.0, 900.0])
    if name == "Phong":
        widths[0] = 0.1  # an exponent of 0 is another kernel
    zonal = jax.jit(lambda w: WIDE[name](w).zonal(4))
    jacobian = jax.jit(jax.jacfwd(zonal))(jnp.asarray(widths))
    for l in range(5):
        h = 1e-5 * max(widths[l], 1) * np.eye(5)[l]
        if widths[l] == 0:  # one-sided, second order
            difference = (-3 * zonal(widths) + 4 * zonal(widths + h) - zonal(widths + 2 * h)) / (2 * h[l])
        else:
            difference = (zonal(widths + h) - zonal(widths - h)) / (2 * h[l])
        np.testing.assert_allclose(jacobian[:, :, l], difference, atol=2e-8 * np.abs(zonal(widths)).max())


def test_a_function_is_differentiable_in_what_it_closes_over(x64):
    def total(k):
        kernel = decomposition.FunctionKernel(jax.tree_util.Partial(lambda k, x, l: jnp.exp(-k * (l + 1) * (1 - x)), k))
        return jnp.sum(kernel.zonal(3) ** 2)

    exact = lambda k: jnp.sum(decomposition.GaussianKernel(k * np.arange(1.0, 5.0)).zonal(3) ** 2)
    slope = jax.jit(lambda k: (jax.grad(total)(k), jax.grad(exact)(k)))(1.3)
    np.testing.assert_allclose(*slope, rtol=1e-11)


@pytest.mark.parametrize("name", WIDE)
def test_nan_stays(name):
    values = np.asarray(WIDE[name]()(np.array([np.nan, 0.5], np.float32), 0))
    np.testing.assert_array_equal(np.isnan(values), [True, False])


# --- bad input --------------------------------------------------------------------------------------------------------


def test_bad_widths_are_refused(as_user):
    with pytest.raises(ValueError, match=r"`sharpness` must have shape \[levels\].*got \[\]"):
        decomposition.GaussianKernel(3.0)
    with pytest.raises(ValueError, match="widths for 3 levels; degree 4 needs 5"):
        decomposition.GaussianKernel(np.ones(3)).zonal(4)
    with pytest.raises(ValueError, match="widths for 3 levels; degree 4 needs 5"):
        decomposition.PhongKernel(np.ones(3))(np.ones(2), 4)
    for bad in (-1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="widths of the kernel must be finite and not negative"):
            decomposition.PhongKernel(np.array([1.0, bad])).zonal(1)
    for bad in (0.0, 3.15):
        with pytest.raises(ValueError, match="`angles` must be above 0 and at most pi"):
            decomposition.CapKernel(np.array([1.0, bad])).zonal(1)


def test_functions_that_quadrature_cannot_resolve_are_refused(as_user):
    with pytest.raises(ValueError, match="does not resolve `function`"):
        decomposition.FunctionKernel(lambda x, l: jnp.where(x > 0.999, 1.0, 0.0)).zonal(2)
    with pytest.raises(ValueError, match="does not resolve `function`"):
        decomposition.FunctionKernel(lambda x, l: x * jnp.nan).zonal(2)
    with pytest.raises(ValueError, match=r"`function` must map x \[.*\] to as many values; got \[2\]"):
        decomposition.FunctionKernel(lambda x, l: jnp.ones(2)).zonal(2)
