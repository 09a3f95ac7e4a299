"""Haar wavelets on nested triangles: an orthonormal basis, and exact projections of polygons."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shisd import domains
from shisd.domains import _haar
from tests import truth
from tests.hard_cases import POLYGONS, padded, random_polygon, unit
from tests.marks import FLOAT64_FIRST


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


@FLOAT64_FIRST
@pytest.mark.parametrize("name", POLYGONS)
def test_the_share_of_every_cell(name, dtype):
    """Against solid angles of what is left when edges are cut one after another, in extended precision."""
    basis, vertices = domains.HaarBasis(1), POLYGONS[name].astype(dtype)
    c = basis.project(domains.SphericalPolygon(padded(vertices)))
    assert c.dtype == dtype
    shares = np.asarray(basis.values(c), float) * basis.areas
    left = [truth.part_above(vertices, *np.cross(t, np.roll(t, -1, axis=0))) for t in basis.triangles]
    expected = np.array([float(truth.solid_angle(v)) if len(v) else 0.0 for v in left])
    tolerance = {"float64": 1e-14, "float32": 3e-6}[dtype.name]
    tolerance *= 30 if name == "edge near pi" else 1  # whose plane one rounding turns by 3e-5 in float32
    np.testing.assert_allclose(shares, expected, atol=tolerance)
    assert np.abs(expected).sum() > 0


def test_no_direction_has_no_value():
    basis = domains.HaarBasis(1)
    d = np.array([[0, 0, 1], [np.nan, 0, 1], [0, 0, 0], [0, 0, np.inf], [0, -1e-30, 0]], np.float32)
    got = basis.evaluate(np.arange(1, 33, dtype=np.float32), d)
    np.testing.assert_array_equal(np.isnan(got), [False, True, True, True, False])


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
