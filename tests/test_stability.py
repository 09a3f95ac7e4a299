"""Every hard case, in both precisions: within its limit, or refused where it should be."""

import jax
import numpy as np
import pytest

from shisd import harmonics
from tests import truth
from tests.bench.stability import bench_stability
from tests.hard_cases import POLYGONS, unit

# float32, float64: four times what was measured, and a few roundings at least; 0, NaN and refusals are meant exactly
LIMITS = {
    "both poles": {"value": (5e-07, 2e-14), "gradient": (5e-07, 2e-14)},
    "1e-4 rad from the poles": {"value": (6e-07, 2e-14), "gradient": (1e-06, 2e-14)},
    "1e-4 rad from the poles, degree 8": {"value": (5e-07, 1e-14), "gradient": (6e-07, 2e-14)},
    "degree 100": {"value": (3e-06, 3e-13), "gradient": (4e-06, 3e-13)},
    "degree 200": {"value": ("-", 3e-12), "gradient": ("-", 3e-12)},
    "vectors of length 1e-30": {"value": (4e-06, 1e-14), "gradient": (3e-06, 1e-14)},
    "zero vector": {"value": ("NaN", "NaN"), "gradient": ("NaN", "NaN")},
    "two equal axes": {"value": ("refused", "refused"), "gradient": ("refused", "refused")},
    "two opposite axes": {"value": ("refused", "refused"), "gradient": ("refused", "refused")},
    "all axes in a plane": {"value": ("refused", "refused"), "gradient": ("refused", "refused")},
    "2L+1 axes on a circle": {"value": (2e-04, 2e-13), "gradient": (4e-03, 1e-11)},
    "two axes 1e-4 rad apart": {"value": ("refused", 3e-10), "gradient": ("refused", 4e-07)},
    "two equal axes, enough others": {"value": (3e-05, 8e-14), "gradient": (3e-04, 3e-13)},
    "coincident vertices": {"value": (1e-06, 2e-15), "gradient": (5e-06, 8e-15)},
    "collinear vertices": {"value": (8e-07, 3e-15), "gradient": (6e-06, 2e-14)},
    "edge near pi": {"value": (5e-07, 6e-15), "gradient": (2e-06, 1e-13)},
    "sliver": {"value": (5e-03, 1e-11), "gradient": (7e-03, 2e-11)},
    "solid angle 1e-8": {"value": (1e-06, 2e-14), "gradient": (1e-05, 7e-12)},
    "one degree square": {"value": (2e-06, 2e-14), "gradient": (2e-05, 3e-14)},
    "non-convex": {"value": (3e-06, 2e-15), "gradient": (7e-06, 1e-14)},
    "clockwise": {"value": (9e-07, 3e-15), "gradient": (5e-06, 3e-14)},
    "near a hemisphere": {"value": (5e-07, 3e-15), "gradient": (1e-06, 8e-15)},
    "more than a hemisphere": {"value": (5e-07, 1e-15), "gradient": (2e-05, 3e-14)},
    "vertex at the axis": {"value": (1e-06, 2e-15), "gradient": (3e-06, 1e-14)},
    "vertex opposite to the axis": {"value": (1e-06, 2e-15), "gradient": (2e-04, 3e-13)},
    "axis in the plane of an edge": {"value": (5e-07, 3e-15), "gradient": (4e-06, 2e-14)},
    "axis on an edge": {"value": (5e-07, 3e-15), "gradient": (1e-06, 4e-15)},
    "axis normal to an edge": {"value": (5e-07, 3e-15), "gradient": (5e-06, 1e-14)},
    "an edge of exactly pi": {"value": ("refused", "refused")},
    "light straddling the horizon": {"value": (2e-05, 4e-15), "gradient": (6e-04, 2e-11)},
    "light with an edge on the horizon": {"value": (6e-06, 4e-15), "gradient": (1e-03, 2e-11)},
    "light with a corner on the horizon": {"value": (4e-05, 2e-14), "gradient": (5e-04, 2e-11)},
    "light wholly below the horizon": {"value": (0, 0), "gradient": (0, 0)},
    "point in the light's plane": {"value": (0, 0), "gradient": (0, 0)},
    "point 1e-4 away from the light": {"value": (9e-07, 4e-15), "gradient": (2e-04, 2e-09)},
    "clockwise light, seen from behind": {"value": (0, 0), "gradient": (0, 0)},
    "non-convex light": {"value": (6e-06, 5e-15), "gradient": (6e-04, 6e-12)},
    "view 89.9 degrees from the normal, light beside the lobe": {"value": (5e-04, 5e-13), "gradient": (6e-02, 3e-10)},
    # by luck of the tables' rounding: for alpha 0.42 to 0.6 the next two are off by 4e-5 to 6e-3 in float32
    "view at the normal, polygon": {"value": (3e-06, 7e-15), "gradient": (2e-03, 2e-08)},
    "view at a normal off the axes": {"value": (1e-05, 3e-15), "gradient": (4e-03, 2e-07)},
    # in float32 2.6e-7 with SSE4.2, 6.2e-7 with AVX, 7.3e-7 with AVX2, on another machine 3e-8
    "roughness 0.02 to radiance": {"value": (2e-06, 2e-07), "gradient": (6e-05, 2e-05)},
    "roughness 1 to radiance": {"value": (5e-07, 2e-14), "gradient": (4e-05, 3e-07)},
    "view 89.9 degrees from the normal, environment": {"value": (2e-04, 2e-04), "gradient": (4e-03, 4e-03)},
    "view at the normal, environment": {"value": (5e-07, 8e-09), "gradient": (2e-05, 2e-08)},
    "roughness 0.02, in the lobe": {"value": (2e-06, 1e-14), "gradient": (4e-06, 3e-14)},
    "roughness 0.02, far from the lobe": {"value": (2e-06, 1e-15), "gradient": (2e-06, 2e-15)},
    "roughness 0.02 squared, in the lobe": {"value": (3e-05, 6e-13), "gradient": (7e-05, 2e-12)},
    "roughness 1": {"value": (1e-06, 1e-15), "gradient": (2e-06, 1e-15)},
    "view 89.9 degrees from the normal": {"value": (1e-06, 2e-15), "gradient": (2e-06, 2e-15)},
    "view 89.9 degrees from the normal, roughness 0.02": {"value": (5e-07, 1e-15), "gradient": (1e-06, 2e-15)},
    "view and light at the normal": {"value": (5e-07, 0), "gradient": (5e-07, 1e-15)},
    "measured bins negative or below the horizon": {"value": (9e-03, 9e-03), "gradient": (2e-01, 2e-01)},
    "measured bins negative or below the horizon, refused on request": {"value": ("refused", "refused")},
    "sun of 3e4 over a sky of 0.5": {"value": (3e-06, 5e-14), "gradient": (1e-05, 2e-11)},
    "all black": {"value": (0, 0), "gradient": (5e-07, 1e-15)},
    "one texel": {"value": (6e-06, 2e-14), "gradient": (9e-05, 2e-10)},
    "one texel at the zenith": {"value": (2e-06, 3e-14), "gradient": (4e-05, 9e-11)},
    "NaN and infinite texels, from a file": {"value": (2e-06, 5e-14), "gradient": (9e-05, 3e-11)},
    "NaN and infinite texels, refused on request": {"value": ("refused", "refused")},
    "NaN and infinite texels, as they are": {"value": ("NaN", "NaN"), "gradient": ("NaN", "NaN")},
}


@pytest.fixture(scope="module")
def rows():
    rows = bench_stability()
    named = {(r["case"], r["what"]): (r["ours float32"], r["ours float64"]) for r in rows}
    assert len(named) == len(rows)
    return named


@pytest.mark.slow
def test_every_case_has_a_limit(rows):
    assert set(rows) == {(case, what) for case, limits in LIMITS.items() for what in limits}
    assert set(POLYGONS) < set(LIMITS)


@pytest.mark.slow
@pytest.mark.parametrize("case, what", [(case, what) for case, limits in LIMITS.items() for what in limits])
def test_hard_case(case, what, rows):
    for got, limit in zip(rows[case, what], LIMITS[case][what], strict=True):
        within = got == limit if isinstance(got, str) or isinstance(limit, str) else got <= limit
        assert within, f"{got}, limit {limit}"


def test_truth_agrees_with_other_truth(rng):
    """The recurrence against SciPy, its derivatives against differences; lines along edges against areas."""
    d = unit(rng.normal(size=(20, 3))).astype(np.longdouble)
    values, slopes = truth.harmonics(d, 30)
    np.testing.assert_allclose(values.astype(float), truth.scipy_basis(d, 30), atol=1e-13)
    move = rng.normal(size=3)
    change = truth.derivative(lambda t: truth.harmonics(d + t * move, 30)[0], 1e-4)
    np.testing.assert_allclose((slopes @ move).astype(float), change.astype(float), atol=1e-12)
    vertices = POLYGONS["non-convex"]
    w, area = truth.triangle_rule(vertices, 40)
    by_area = (area @ truth.harmonics(w, 12)[0]).astype(float)
    np.testing.assert_allclose(truth.edge_coefficients(vertices, 12).astype(float), by_area, atol=1e-14)
    moments = truth.edge_moments(vertices, d, 12, 24).astype(float)
    np.testing.assert_allclose(moments, truth.zonal_moments(vertices, d, 12, 24), atol=1e-14)


def test_gradients_at_any_length(dtype):
    """1 / length^2 would overflow in float32."""
    d = np.array([0.3, -0.2, 0.5], dtype)
    slope = lambda x: np.asarray(jax.grad(lambda x: harmonics.sh_basis(x, 4)[10])(x), float)
    for length in (1e-30, 1e30):
        got = slope(d * dtype.type(length)) * length
        np.testing.assert_allclose(got, slope(d), rtol=1e-5 if dtype == np.float32 else 1e-12)
