"""Haar wavelets on nested triangles: an orthonormal basis, and exact projections of polygons."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import domains
from shisd.domains import _haar
from tests import truth
from tests.hard_cases import POLYGONS, padded, random_polygon, unit


def test_orthonormal_and_complete(dtype, rng):
    """Functions of one cell each become orthonormal columns, and values come back."""
    basis = domains.HaarBasis(1)
    np.testing.assert_allclose(basis.areas.sum(), 4 * np.pi)
    units = np.diag(np.sqrt(basis.areas)).astype(dtype)  # integrals of the cells' normalised indicators
    columns = np.asarray(basis.coefficients(units), float)
    tolerance = {"float64": 1e-14, "float32": 1e-6}[dtype.name]
    np.testing.assert_allclose(columns @ columns.T, np.eye(basis.size), atol=tolerance)
    assert basis.coefficients(units).dtype == dtype
    values = rng.normal(size=(2, basis.size)).astype(dtype)
    got = basis.values(basis.coefficients(values * basis.areas.astype(dtype)))
    np.testing.assert_allclose(got, values, atol=20 * tolerance)


def test_wavelets_are_those_of_equal_parts_up_to_area():
    """The inner part of an octant is larger: the reflection is near the matrix of +-1/2."""
    usual = np.array([[1, 1, 1, 1], [1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]]) / 2
    np.testing.assert_allclose(
        _haar._reflections(5, np.dtype(float)), np.broadcast_to(usual, (8 * 4**5, 4, 4)), atol=0.02
    )


def test_a_direction_finds_its_cell(rng):
    basis = domains.HaarBasis(3)
    c = rng.normal(size=basis.size).astype(np.float32)
    mix = rng.dirichlet([1, 1, 1], basis.size)
    inside = unit(np.einsum("ns,nsi->ni", mix, basis.triangles)).astype(np.float32)
    np.testing.assert_array_equal(basis.evaluate(c, inside), basis.values(c))


@pytest.mark.parametrize("levels", [0, 2])
def test_polygons(levels, dtype):
    """Shares of every cell are non-negative, add up to the polygon, and none exceeds its cell."""
    basis = domains.HaarBasis(levels)
    tolerance = {"float64": 1e-13, "float32": 5e-6}[dtype.name]
    for name, vertices in POLYGONS.items():
        c = basis.project(domains.SphericalPolygon(padded(vertices).astype(dtype)))
        assert c.dtype == dtype
        shares = np.asarray(basis.values(c), float) * basis.areas
        near = tolerance * (30 if name == "edge near pi" else 1)  # whose plane one rounding turns by 3e-5 in float32
        whole = float(truth.triangle_rule(vertices, 24)[1].sum())
        assert np.all(np.sign(whole) * shares > -near), name
        assert np.all(np.sign(whole) * shares < basis.areas + near), name
        np.testing.assert_allclose(shares.sum(), whole, atol=10 * near, err_msg=name)


def test_the_share_of_a_cell_against_quadrature(x64, rng):
    """Nodes of a fine rule, sorted into cells: to the spacing of the nodes."""
    basis = domains.HaarBasis(1)
    v = random_polygon(rng, 5, 0.9)
    shares = np.asarray(basis.values(basis.project(domains.SphericalPolygon(v)))) * basis.areas
    w, area = truth.triangle_rule(v, 400)
    inside = lambda t: np.all(w.astype(float) @ np.cross(t, np.roll(t, -1, 0)).T >= 0, axis=1)
    expected = [float(area[inside(t)].sum()) for t in basis.triangles]
    np.testing.assert_allclose(shares, expected, atol=2e-4)


@pytest.mark.slow
def test_derivatives_add_up_to_those_of_the_solid_angle(x64, rng):
    basis, v = domains.HaarBasis(1), random_polygon(rng, 4, 0.6)
    total = lambda v: jnp.sum(basis.values(basis.project(domains.SphericalPolygon(v))) * jnp.asarray(basis.areas))
    whole = jax.grad(lambda v: domains.solid_angle(domains.SphericalPolygon(v)))(jnp.asarray(v))
    np.testing.assert_allclose(jax.grad(total)(jnp.asarray(v)), whole, atol=1e-12)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: domains.HaarBasis(-1), "`levels` must be >= 0"),
        (lambda: domains.HaarBasis(0).coefficients(np.ones(9, np.float32)), r"`integrals` must have shape \[..., 8\]"),
        (lambda: domains.HaarBasis(0).project("square"), "`polygon` must be"),
        (lambda: domains.HaarBasis(0).evaluate(np.ones((2, 8)), [0.0, 0.0, 1.0]), "one expansion"),
    ],
)
def test_bad_input_is_named(call, message, as_user):
    with pytest.raises(ValueError, match=message):
        call()
