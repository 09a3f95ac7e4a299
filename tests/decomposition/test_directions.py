"""Sets of axes: shapes, spread, determinism, the shipped table and the optimiser."""

import importlib.util
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import decomposition
from shisd.decomposition._directions import conditioning_loss, low_discrepancy_directions, random_directions
from tests import truth
from tests.marks import FLOAT64_FIRST

SETS = {
    "fibonacci": decomposition.fibonacci_directions,
    "low_discrepancy": low_discrepancy_directions,
    "random": lambda count: random_directions(count, jax.random.key(7)),
}


def smallest_angle(z):
    """Between axes, so z and -z count as equal."""
    cosines = np.abs(np.asarray(z, np.float64) @ np.asarray(z, np.float64).T)
    return np.arccos(np.clip(cosines - 2 * np.eye(len(z)), -1, 1).max())


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("count", [1, 2, 9, 61])
def test_sets_are_unit_axes_of_the_upper_hemisphere(name, count, dtype):
    z = SETS[name](count)
    assert z.shape == (count, 3) and z.dtype == dtype
    assert np.all(np.asarray(z)[:, 2] >= 0)
    np.testing.assert_allclose(np.linalg.norm(np.asarray(z), axis=1), 1, atol=4 * np.finfo(dtype).eps)
    np.testing.assert_array_equal(z, SETS[name](count))


@pytest.mark.parametrize("name", ["fibonacci", "low_discrepancy"])
def test_spread_sets_keep_a_distance(name):
    for count in (5, 17, 61):
        assert smallest_angle(SETS[name](count)) > 0.2 * np.sqrt(2 * np.pi / count)


def test_mean_square_of_every_coordinate_is_a_third():
    for make, tolerance in ((SETS["fibonacci"], 2e-3), (SETS["low_discrepancy"], 1e-2), (SETS["random"], 3e-2)):
        np.testing.assert_allclose(np.mean(np.asarray(make(1000)) ** 2, axis=0), 1 / 3, atol=tolerance)


def test_longer_low_discrepancy_sets_begin_with_shorter_ones():
    z = low_discrepancy_directions(40)
    np.testing.assert_array_equal(z[:13], low_discrepancy_directions(13))


def test_separate_directions_differ_between_levels_and_spread_over_the_sphere(dtype):
    z = np.asarray(decomposition.separate_directions(6))
    assert z.shape == (7, 13, 3) and z.dtype == dtype
    np.testing.assert_allclose(np.linalg.norm(z, axis=-1), 1, atol=4 * np.finfo(dtype).eps)
    assert smallest_angle(z.reshape(-1, 3)) > 1e-3
    np.testing.assert_allclose(z.mean(axis=(0, 1)), 0, atol=0.05)


def test_the_dtype_can_be_chosen(x64):
    for z in (
        decomposition.fibonacci_directions(5, dtype=jnp.float32),
        low_discrepancy_directions(5, dtype=jnp.float32),
        random_directions(5, jax.random.key(0), dtype=jnp.float32),
        decomposition.optimized_directions(2, dtype=jnp.float32),
    ):
        assert z.dtype == jnp.float32 and z.shape == (5, 3)


def fibonacci_points(count):
    """The usual spiral over the whole sphere."""
    i = np.arange(count)
    z, phi = 1 - (2 * i + 1) / count, i * np.pi * (np.sqrt(5) - 1)
    return np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)


@pytest.mark.parametrize("degree", range(1, 21))
def test_fibonacci_points_are_singular_in_odd_bands_and_fibonacci_axes_are_not(degree):
    # 2L+1 points map to themselves under the half-turn about the middle point, so they give L+1 symmetric sums of
    # lobes; band L has L+1 symmetric functions if L is even, but only L if L is odd.
    points = fibonacci_points(2 * degree + 1)
    middle = points[degree]
    half_turn = 2 * np.outer(middle, middle) - np.eye(3)
    np.testing.assert_allclose(points @ half_turn, points[::-1], atol=1e-12)
    singular = truth.conditions(points, degree)[degree] > 1e12
    assert singular == (degree % 2 == 1)
    assert truth.conditions(decomposition.fibonacci_directions(2 * degree + 1), degree).max() < 240


# --- the shipped table ------------------------------------------------------------------------------------------------


TABLE = Path(decomposition.__file__).parent / "data" / "optimized_directions.npz"
RECORDED = dict(np.load(TABLE))


@pytest.mark.parametrize(
    "degree", [pytest.param(l, marks=() if l < 33 and l % 4 == 0 else pytest.mark.slow) for l in range(65)]
)
def test_table_is_as_well_conditioned_as_documented(degree, x64):
    z = np.asarray(decomposition.optimized_directions(degree))
    assert z.shape == (2 * degree + 1, 3) and np.all(z[:, 2] >= 0)
    np.testing.assert_allclose(np.linalg.norm(z, axis=1), 1, atol=1e-15)
    assert degree == 0 or smallest_angle(z) > 0.25 * np.sqrt(2 * np.pi / len(z))
    matrices = truth.band_matrices(z, degree)
    conditions = np.array([np.linalg.cond(m) for m in matrices])
    prefixes = np.array([np.linalg.cond(m[:, : 2 * l + 1]) for l, m in enumerate(matrices)])
    known = {4: (2.3, 5.71), 8: (2.95, 5.9), 12: (4.4, 29.2), 20: (6.5, 150.2), 32: (8.9, 130), 64: (15.1, 376)}
    shared, nested = known.get(degree, (1.9 + 0.24 * degree, np.inf))
    assert conditions.max() <= shared and prefixes.max() <= nested
    np.testing.assert_allclose(RECORDED["conditions"][degree], conditions.max(), rtol=1e-9)
    np.testing.assert_allclose(RECORDED["nested_conditions"][degree], prefixes.max(), rtol=1e-9)


def test_table_is_small():
    assert TABLE.stat().st_size < 110_000
    assert RECORDED["directions"].shape == (65**2, 3) and RECORDED["directions"].dtype == np.float64


@pytest.mark.parametrize("degree", [1, 4, pytest.param(8, marks=pytest.mark.slow)])
def test_no_set_beats_the_lower_bounds(degree, x64):
    bound = truth.condition_bound(degree, 2 * degree + 1)
    assert bound > 1.6 or degree == 1
    for z in (
        decomposition.optimized_directions(degree),
        decomposition.optimize_directions(decomposition.fibonacci_directions(2 * degree + 1), degree, bands=(degree,)),
    ):
        assert truth.conditions(z, degree)[degree] >= bound - 1e-9


@pytest.mark.parametrize(
    "degree", [0, 1, 8, pytest.param(20, marks=pytest.mark.slow), pytest.param(32, marks=pytest.mark.slow)]
)
def test_the_package_finds_the_same_conditions(degree, dtype):
    z = decomposition.optimized_directions(degree)
    assert z.dtype == dtype
    conditions = eqx.filter_jit(decomposition.RotatedZonalBasis.condition_numbers)
    ours = conditions(decomposition.RotatedZonalBasis(z, degree))
    np.testing.assert_allclose(ours, truth.conditions(z, degree), rtol=1e3 * np.finfo(dtype).eps)


# --- the optimiser ----------------------------------------------------------------------------------------------------


def independent_loss(z, degree, power, nested=False, bands=None):
    total, matrices = 0.0, truth.band_matrices(z, degree)
    for l in bands or range(degree + 1):
        m = matrices[l][:, : 2 * l + 1] if nested else matrices[l]
        mu = np.linalg.svd(m, compute_uv=False) ** 2 * (2 * l + 1) / m.shape[1]
        total += np.sum(mu**power) * np.sum(mu**-power)
    return np.log(total) / (2 * power)


@pytest.mark.parametrize("degree, count", [(0, 1), (1, 3), (3, 7), (3, 10), (6, 13)])
def test_loss_agrees_with_singular_values_and_bounds_the_condition(degree, count, x64):
    z = low_discrepancy_directions(count)
    loss_of = jax.jit(lambda power: conditioning_loss(z, degree, power=power))
    for power in (1.0, 3.0, 8.0):
        loss = float(loss_of(power))
        np.testing.assert_allclose(loss, independent_loss(z, degree, power), rtol=1e-10, atol=1e-12)
        excess = loss - np.log(truth.conditions(z, degree).max())
        assert -1e-12 <= excess <= np.log((2 * degree + 1) * np.sqrt(degree + 1)) / power


@pytest.mark.parametrize("nested, bands", [(True, None), (False, (4,)), (True, (2, 3))])
def test_loss_of_prefixes_and_of_some_bands(nested, bands, x64, rng):
    z = low_discrepancy_directions(9)
    loss = jax.jit(jax.value_and_grad(lambda z: conditioning_loss(z, 4, power=3.0, nested=nested, bands=bands)))
    value, gradient = loss(z)
    independent = lambda z: independent_loss(z, 4, 3.0, nested, bands)
    np.testing.assert_allclose(value, independent(z), rtol=1e-10)
    step = 1e-5 * rng.standard_normal(z.shape)
    difference = (independent(z + step) - independent(z - step)) / 2
    np.testing.assert_allclose(np.sum(gradient * step), difference, rtol=1e-6)


def test_gradient_of_the_loss_near_singular_sets(x64, rng):
    # two axes 1e-3 apart: one eigenvalue near zero, the condition number 1e3 and more
    z = np.array(decomposition.optimized_directions(4))
    z[1] = z[0] + 1e-3 * np.array([0.3, -0.8, 0.5])
    loss = jax.jit(jax.value_and_grad(lambda z: conditioning_loss(z, 4)))
    value, gradient = loss(jnp.asarray(z))
    assert value > np.log(900)
    for _ in range(3):
        step = 1e-7 * rng.standard_normal(z.shape)
        difference = independent_loss(z + step, 4, 8.0) - independent_loss(z - step, 4, 8.0)
        np.testing.assert_allclose(np.sum(gradient * step), difference / 2, rtol=1e-5)


def test_gradient_of_the_loss_matches_finite_differences(x64, rng):
    z = decomposition.fibonacci_directions(9)
    gradient = jax.jit(lambda z: jax.grad(conditioning_loss)(z, 4))(z)
    for _ in range(4):
        step = 1e-5 * rng.standard_normal(z.shape)
        difference = independent_loss(z + step, 4, 8.0) - independent_loss(z - step, 4, 8.0)
        np.testing.assert_allclose(np.sum(gradient * step), difference / 2, rtol=1e-6)
    loss = jax.jit(lambda z: conditioning_loss(z, 4))
    check_grads(loss, (z,), order=1, modes=("fwd", "rev"), atol=1e-3, rtol=1e-3)


def test_gradient_of_the_loss_is_right_where_eigenvalues_meet(x64):
    # the axes of a cube's faces: band 1 has three equal eigenvalues and is best possible, so the gradient is zero
    z = jnp.eye(3)
    loss = jax.jit(jax.value_and_grad(lambda z: conditioning_loss(z, 1, power=3.0)))
    value, gradient = loss(z)
    np.testing.assert_allclose(value, np.log(1 + 9) / 6, rtol=1e-12)
    np.testing.assert_allclose(gradient, np.zeros((3, 3)), atol=1e-12)


@FLOAT64_FIRST
def test_optimizer_improves_a_random_start_and_is_deterministic(dtype):
    start = random_directions(9, jax.random.key(3))
    found = decomposition.optimize_directions(start, 4)
    assert found.shape == (9, 3) and found.dtype == dtype
    np.testing.assert_allclose(np.linalg.norm(np.asarray(found), axis=1), 1, atol=4 * np.finfo(dtype).eps)
    before, after = (truth.conditions(z, 4).max() for z in (start, found))
    assert after < 3.5 < before
    np.testing.assert_array_equal(found, decomposition.optimize_directions(start, 4))


def test_the_best_of_several_starts_is_kept(x64):
    starts = [random_directions(9, jax.random.key(i)) for i in (3, 5)]
    singular = jnp.asarray(np.repeat(np.eye(3), 3, axis=0))
    told = []
    stacked = jnp.stack([singular, *starts])
    together = decomposition.optimize_directions(stacked, 4, progress=lambda *now: told.append(now))
    assert told == [(i + 1, 9) for i in range(9)]  # three powers for each start
    best = min(float(conditioning_loss(decomposition.optimize_directions(z, 4), 4)) for z in starts)
    np.testing.assert_allclose(conditioning_loss(together, 4), best, rtol=1e-6)


@pytest.mark.parametrize(
    "plane", [pytest.param("x", marks=pytest.mark.slow), "y", pytest.param("z", marks=pytest.mark.slow)]
)
def test_mirrored_sets_stay_mirrored(plane, x64):
    found = np.asarray(decomposition.optimize_directions(decomposition.fibonacci_directions(9), 4, mirror=plane))
    axis = "xyz".index(plane)
    image = found * np.where(np.arange(3) == axis, -1, 1)
    assert found[0, axis] == 0
    np.testing.assert_allclose(found[2::2], image[1::2], atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-15)
    assert truth.conditions(found, 4).max() < 3.2
    if plane == "y":  # a function that is even in y, as slices of isotropic materials are, has weights in pairs
        even = np.concatenate([np.arange(-l, l + 1) >= 0 for l in range(5)]) * np.cos(np.arange(25.0))
        weights = np.asarray(decomposition.RotatedZonalBasis(found, 4).weights(even))
        np.testing.assert_allclose(weights[:, 2::2], weights[:, 1::2], atol=1e-13)


def test_prefixes_and_single_bands_can_be_optimised(x64):
    start = decomposition.fibonacci_directions(9)
    nested = decomposition.optimize_directions(start, 4, nested=True)
    assert truth.conditions(nested, 4, nested=True).max() < 3.6 < truth.conditions(start, 4, nested=True).max()
    alone = decomposition.optimize_directions(start, 4, bands=(4,))
    assert truth.conditions(alone, 4)[4] < 2.4


@pytest.mark.slow
def test_optimising_degree_20_from_a_random_start(x64):
    start = random_directions(41, jax.random.key(1))
    began = time.perf_counter()
    found = decomposition.optimize_directions(start, 20)
    print(f"degree 20 from a random start: {time.perf_counter() - began:.1f} s, compiling included")
    assert truth.conditions(found, 20).max() < 7.5 < truth.conditions(start, 20).max()


@pytest.mark.slow
def test_optimizer_takes_more_axes_than_needed(x64):
    start = decomposition.fibonacci_directions(14)
    found = decomposition.optimize_directions(start, 4, powers=(1.0, 8.0), max_steps=100)
    assert truth.conditions(found, 4).max() < 1.6 < truth.conditions(start, 4).max()


def test_optimizer_returns_a_singular_start_as_it_is(x64):
    start = np.array([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0], [0.0, 1.0, 0.0]])  # all in a plane
    found = decomposition.optimize_directions(start, 1, max_steps=20, throw=False)
    np.testing.assert_allclose(found, start, atol=1e-15)
    with pytest.raises(ValueError, match="optimized_directions"):
        decomposition.optimize_directions(start, 1, max_steps=20)


def test_powers_that_mean_nothing_are_refused(x64, as_user):
    z = np.eye(3)
    for bad in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="`powers` must be finite and > 0"):
            decomposition.optimize_directions(z, 1, powers=(1.0, bad))
    with pytest.raises(ValueError, match="`powers` must hold at least one"):
        decomposition.optimize_directions(z, 1, powers=())
    loss = jax.jit(lambda power: conditioning_loss(z, 1, power=power))
    assert all(np.isnan(loss(power)) for power in (0.0, -1.0, np.inf))


@pytest.mark.slow
def test_table_script_refuses_to_overwrite_and_makes_a_table(tmp_path, monkeypatch, x64):
    path = Path(__file__).parents[1] / "bench" / "make_directions.py"
    spec = importlib.util.spec_from_file_location("make_directions", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    monkeypatch.setattr("sys.argv", ["make_directions.py"])
    with pytest.raises(SystemExit, match="exists; pass --overwrite"):
        script.main()
    output = tmp_path / "table.npz"
    arguments = ["--output", str(output), "--degrees", "0", "1", "--effort", "0.02"]
    monkeypatch.setattr("sys.argv", ["make_directions.py", *arguments])
    script.main()
    with np.load(output) as data:
        np.testing.assert_allclose(data["conditions"][:2], 1, rtol=1e-6)


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [*SETS.values()], ids=[*SETS])
def test_bad_counts_are_refused(make, as_user):
    with pytest.raises(ValueError, match="`count` must be >= 1; got 0"):
        make(0)
    with pytest.raises(ValueError, match="`count` must be a Python integer"):
        make(2.5)


def test_the_table_says_what_to_use_beyond_its_end(as_user):
    with pytest.raises(ValueError, match=r"`degree` must be <= 64.*got 65.*fibonacci_directions\(131\)"):
        decomposition.optimized_directions(65)
    with pytest.raises(ValueError, match="`degree` must be >= 0; got -1"):
        decomposition.optimized_directions(-1)
    with pytest.raises(ValueError, match="`degree` must be a Python integer"):
        decomposition.optimized_directions(2.0)


@pytest.mark.parametrize("function", [decomposition.optimize_directions, conditioning_loss])
def test_optimizer_and_loss_refuse_bad_shapes(function, as_user):
    with pytest.raises(ValueError, match=r"at least 2\*degree \+ 1 = 9 axes for degree 4; got 8"):
        function(decomposition.fibonacci_directions(8), 4)
    with pytest.raises(ValueError, match=r"must have shape \[\.\.\., 3\]"):
        function(jnp.ones((5, 2)), 1)


def test_optimizer_and_loss_refuse_bad_options(as_user):
    z = decomposition.fibonacci_directions(9)
    with pytest.raises(ValueError, match=r"must have shape \[K, 3\]; got \[2, 5, 3\]"):
        conditioning_loss(jnp.ones((2, 5, 3)), 1)
    with pytest.raises(ValueError, match="`mirror` must be None, 'x', 'y' or 'z'; got 'w'"):
        decomposition.optimize_directions(z, 4, mirror="w")
    with pytest.raises(ValueError, match="`mirror` needs an odd number of axes.*got 10"):
        decomposition.optimize_directions(decomposition.fibonacci_directions(10), 4, mirror="x")
    with pytest.raises(ValueError, match=r"`bands` must hold at least one degree, none above 4; got \[5\]"):
        conditioning_loss(z, 4, bands=(5,))
