"""What every BRDF promises: horizon, reciprocity, shapes, dtypes, precision, derivatives, and compilation."""

import math

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import models
from tests.models.materials import BRDFS, SHARP, array, evaluate, hemisphere, pairs, slopes, spherical

ALL = {**BRDFS, **SHARP}
# float32 against float64 at the same directions: values, and derivatives by kind, relative to the largest in the row,
# where both cosines are above 0.01; then derivatives down to the horizon. Limits are 2 to 4 times what is measured.
PRECISION = {
    "lambertian": (1e-7, 3e-7, 2e-7),
    "phong": (8e-7, 5e-6, 3e-6),
    "ggx": (2e-6, 5e-5, 5e-6),  # where the derivative in alpha crosses 0: up to 3.4e-5 over twelve seeds
    "ggx_anisotropic": (2e-6, 2e-5, 3e-6),
    "ggx_gold": (2e-6, 1e-5, 4e-6),
    "ggx_glass": (4e-6, 1e-5, 6e-6),
    "cook_torrance": (3e-6, 7e-6, 3e-6),
    "cook_torrance_direct": (2e-6, 6e-6, 3e-6),
    "abc": (3e-6, 6e-6, 3e-6),
    "sgd": (3e-5, 0.1),  # its G1 is the small difference of larger numbers there, with a kink where it reaches 0
    "phong_5000": (2e-5, 6e-6, 6e-7),
    "ggx_0.02": (2e-6, 1e-5, 5e-6),
    "ggx_anisotropic_0.02_1": (2e-6, 2e-5, 3e-6),
    "cook_torrance_0.02": (3e-6, 5e-6, 3e-6),
    "ggx_1": (2e-6, 6e-5, 3e-6),
    "cook_torrance_1": (1e-6, 3e-5, 2e-6),
}


def to64(model):
    return jax.tree.map(lambda a: a.astype(jnp.float64), model)


@pytest.fixture(params=ALL)
def name(request):
    return request.param


ROWS = 400  # in every test, so that compiled code is shared


def rows(*directions, dtype):
    """The directions, repeated to ROWS rows."""
    return array(np.resize(np.stack(directions), (ROWS, 3)), dtype)


def everything(brdf, wi, wo, dtype):
    """Value, its sum times the cosine, and all derivatives of that as one table [ROWS, n], as NumPy arrays."""
    value, cosined, derivatives = slopes(brdf, array(wi, dtype), array(wo, dtype))
    assert value.dtype == cosined.dtype == dtype
    tables = [np.asarray(d).reshape(len(wi), -1) for d in jax.tree.leaves(derivatives)]
    return np.asarray(value).reshape(len(wi), -1), np.asarray(cosined), np.concatenate(tables, axis=1)


def test_value_is_zero_below_the_horizon_and_on_it(name):
    brdf = ALL[name]()
    up, low, level = np.array([0.6, 0.0, 0.8]), np.array([0.6, 0.0, -0.8]), np.array([1.0, 0.0, 0.0])
    wi = rows(low, up, low, level, up, level, dtype=np.float32)
    wo = rows(up, low, low, up, level, -level, dtype=np.float32)
    assert all(np.all(x == 0) for x in everything(brdf, wi, wo, np.float32))
    mirror = rows(up * [-1, 1, 1], dtype=np.float32)
    value, cosined, _ = everything(brdf, mirror, rows(up, dtype=np.float32), np.float32)
    assert np.all(value > 0) and np.all(cosined > 0)


def test_value_is_positive_reciprocal_and_isotropic_where_it_says_so(name, rng, x64):
    brdf = to64(ALL[name]())
    wi, wo = pairs(rng, ROWS, 1e-3)
    there, back = (everything(brdf, *w, np.float64)[0] for w in ((wi, wo), (wo, wi)))
    assert np.all(there >= 0)
    np.testing.assert_allclose(there, back, rtol=1e-9, atol=1e-300)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    same = np.allclose(there, everything(brdf, wi @ turn.T, wo @ turn.T, np.float64)[0], rtol=1e-8)
    assert same == brdf.isotropic


def test_value_cosine_is_the_value_times_the_cosine_of_wi(name, rng):
    wi, wo = (a.astype(np.float32) for a in pairs(rng, ROWS))
    value, cosined, _ = everything(ALL[name](), wi, wo, np.float32)
    np.testing.assert_allclose(cosined, value.sum(axis=1) * wi[:, 2], rtol=2e-6)


def test_derivatives_are_those_of_differences(name, rng, x64):
    """In wi and wo in any direction, off the sphere too, and in all parameters at once, of order 4 in float64."""
    brdf = to64(ALL[name]())
    count = ROWS // 4
    wi, wo = pairs(rng, count, 0.2)
    leaves, tree = jax.tree.flatten(brdf)
    factors = [rng.uniform(0.5, 1, leaf.shape) for leaf in leaves]
    turned = lambda t: jax.tree.unflatten(tree, [a * (1 + t * f) for a, f in zip(leaves, factors, strict=True)])
    moves = rng.standard_normal((2, count, 3))
    moves /= np.linalg.norm(moves, axis=-1, keepdims=True)
    fourfold = [np.tile(w, (4, 1)) for w in (wi, wo)]
    value, _, slope = (x[:count] for x in everything(brdf, *fourfold, np.float64))

    steps = 2e-4 * min(float(brdf.lobe_width), 0.1) * np.array([-2, -1, 1, 2])
    along = (steps[:, None, None] * moves[:, None]).reshape(2, ROWS, 3)
    values = [
        np.stack([everything(turned(t), *fourfold, np.float64)[1][:count] for t in steps]),
        everything(brdf, fourfold[0] + along[0], fourfold[1], np.float64)[1].reshape(4, count),
        everything(brdf, fourfold[0], fourfold[1] + along[1], np.float64)[1].reshape(4, count),
    ]
    parameters = np.concatenate([np.ravel(a * f) for a, f in zip(leaves, factors, strict=True)])
    got = [
        slope[:, :-6] @ parameters,
        np.sum(slope[:, -6:-3] * moves[0], axis=1),
        np.sum(slope[:, -3:] * moves[1], axis=1),
    ]
    for derivative, four, where in zip(got, values, ("parameters", "wi", "wo"), strict=True):
        expected = np.tensordot([1, -8, 8, -1], four, axes=1) / (12 * steps[2])
        scale = np.abs(expected) + np.abs(value).sum(axis=1) / min(float(brdf.lobe_width), 0.1)
        limit = {"cook_torrance_0.02": 3e-9, "phong_5000": 3e-10}.get(name, 4e-11)
        assert np.all(np.abs(derivative - expected) <= limit * scale), (where, derivative - expected)


@pytest.mark.parametrize("kind", BRDFS)
def test_what_is_not_a_number_stays_so(kind, rng):
    """In any direction or parameter, above and below the horizon; so do parameters below their least value."""
    brdf = BRDFS[kind]()
    wi, wo = (a.astype(np.float32) for a in pairs(rng, ROWS))
    wi[::3, 2] *= -1
    wo[::5, 2] *= -1
    leaves, tree = jax.tree.flatten(brdf)

    def spoil(number, place, value):
        bad = np.array(leaves[number])
        bad.reshape(-1)[place] = value
        return jax.tree.unflatten(tree, [*leaves[:number], jnp.asarray(bad), *leaves[number + 1 :]])

    bad = [spoil(n, place, np.nan) for n, leaf in enumerate(leaves) for place in range(leaf.size)]
    names = [name for name, value in vars(brdf).items() if isinstance(value, jax.Array)]
    bad += [spoil(names.index(name), 0, least - 0.01) for name, least in brdf.least.items() if name in names]
    for model in bad:
        assert all(np.isnan(x).all() for x in everything(model, wi, wo, np.float32)), model
    spoiled = np.stack([wi, wo])
    spoiled[rng.integers(0, 2, ROWS), np.arange(ROWS), rng.integers(0, 3, ROWS)] = np.nan
    assert all(np.isnan(x).all() for x in everything(brdf, *spoiled, np.float32))
    assert all(np.isfinite(x).all() for x in everything(brdf, wi, wo, np.float32))


def shape(f, *arguments):
    """Shape and dtype of the result, without computing it."""
    return jax.eval_shape(lambda *a: f(*a), *arguments)


def test_colour_is_the_last_axis_only_when_a_parameter_has_one():
    up = jnp.array([0, 0, 1.0])
    for name, make in ALL.items():
        brdf = make()
        expected = (3,) if any(leaf.shape == (3,) for leaf in jax.tree.leaves(brdf)) else ()
        assert shape(brdf.value, up, up).shape == shape(brdf.value_cosine, up, up).shape == expected, name
    assert shape(models.Ggx([0.2, 0.3]).value, up, up).shape == ()
    assert shape(models.Ggx(0.2, eta=[1.0, 2.0, 3.0], k=1.0).value, up, up).shape == (3,)


@pytest.mark.parametrize("parameters", ["float32", "float64"])
@pytest.mark.parametrize("directions", ["float32", "float64"])
def test_output_dtype_is_that_of_the_directions(parameters, directions, x64):
    for name, make in ALL.items():
        brdf = jax.tree.map(lambda a: a.astype(parameters), make())
        up = jnp.array([0, 0, 1], directions)
        assert shape(brdf.value, up, up).dtype == directions, name
        assert shape(brdf.value_cosine, up, up).dtype == directions, name
    one, two = jnp.array([0, 0, 1], "float32"), jnp.array([0, 0, 1], "float64")
    assert shape(models.Ggx(0.3).value_cosine, one, two).dtype == np.float64


def test_a_mirror_is_dark_beside_its_direction(rng, dtype):
    """Roughness 0: what is left of Ggx from 1 degree on, of CookTorrance its diffuse part, and no derivative in it."""
    wi, wo = np.array([0, 0, 1.0]), np.array([0.6, 0, 0.8])
    half_cosine = 0.9**0.5  # of half the angle between them, whose cosine is 0.8
    fresnel = 0.04 + 0.96 * (1 - half_cosine) ** 5
    cast = lambda brdf: jax.tree.map(lambda a: a.astype(dtype), brdf)
    brdf = cast(models.CookTorrance(0.0, 0.0, [0.5, 0.5, 0.5]))
    value, _, slope = everything(brdf, rows(wi, dtype=dtype), rows(wo, dtype=dtype), dtype)
    np.testing.assert_allclose(value, (1 - fresnel) * 0.5 / np.pi, rtol=1e-6 if dtype == np.float32 else 1e-10)
    assert np.all(slope[:, 0] == 0)
    beside = hemisphere(rng, ROWS)
    beside = beside[np.arccos(np.clip(beside @ (wo * [-1, -1, 1]), -1, 1)) > np.radians(1)]
    for brdf in (cast(models.Ggx(0.0, [1.0, 1.0, 1.0])), cast(models.Ggx([0.0, 0.0]))):
        value, _, slope = everything(brdf, np.resize(beside, (ROWS, 3)), rows(wo, dtype=dtype), dtype)
        assert 0 <= value.min() and value.max() <= 2e-5 and np.all(slope[:, : brdf.alpha.size] == 0), value.max()
        value, _, slope = everything(brdf, rows(wo * [-1, 1, 1], dtype=dtype), rows(wo, dtype=dtype), dtype)
        assert np.isfinite(slope).all() and value.min() > 1e9


def test_measured_and_projected_materials_keep_what_is_not_a_number(rng):
    wi, wo = (a.astype(np.float32) for a in pairs(rng, 6, 0.1))
    wi[0, 1] = wo[1, 2] = wi[2, 2] = np.nan
    wo[2, 2] *= -1
    slope = eqx.filter_jit(jax.vmap(jax.value_and_grad(lambda brdf, *w: jnp.sum(brdf.value(*w)), (1, 2)), (None, 0, 0)))
    table = np.ones((90, 90, 180, 3), np.float32)
    for brdf in (models.MeasuredBrdf(table), models.ProjectedBrdf(np.ones((2, 2, 2), np.float32), isotropic=True)):
        for result in jax.tree.leaves(slope(brdf, wi, wo)):
            assert np.isnan(result[:3]).all() and np.isfinite(result[3:]).all()
    table[5:60, :, :, 1] = np.nan  # half angles of 0.6 to 40 degrees
    angles = np.radians([10, 20, 30, 60, 70, 80])
    value, _ = slope(models.MeasuredBrdf(table), *[spherical(angles, 0.1 * side).astype(np.float32) for side in (0, 1)])
    np.testing.assert_array_equal(np.isnan(value), angles < 0.6)


def worst(got, expected):
    """The largest error of a row, relative to the largest number in it, or to 1e-3."""
    return np.max(np.abs(got - expected).max(axis=1) / np.maximum(np.abs(expected).max(axis=1), 1e-3))


def test_float32_follows_float64(name, rng):
    brdf = ALL[name]()
    wi, wo = (a.astype(np.float32) for a in pairs(rng, ROWS, 0.01))
    single, _, slope = everything(brdf, wi, wo, np.float32)
    with jax.enable_x64(True):
        double, _, expected = everything(to64(brdf), wi, wo, np.float64)
    error = np.max(np.abs(single - double) / np.maximum(double, 1e-30))
    kinds = [slice(None, -6), slice(-6, -3), slice(-3, None)]
    wrong = max(worst(slope[:, kind], expected[:, kind]) for kind in kinds)
    assert error <= PRECISION[name][0] and wrong <= PRECISION[name][1], (error, wrong)


def hard_pairs(width):
    """Pairs at which formulas break: as named in the design's list of hard cases."""
    normal, level = np.array([0, 0, 1.0]), math.radians(89.9)
    slant, aside = spherical(0.9, 0.4), spherical(0.9, 0.4 + math.pi)
    off = spherical(0.9 + 0.4 * width, 0.4 + math.pi)
    return {
        "both at the normal": (normal, normal),
        "equal": (slant, slant),
        "mirror": (aside, slant),
        "beside the mirror": (off, slant),
        "view at the normal": (spherical(0.5 * width, 0.3), normal),
        "light at the normal": (normal, spherical(0.5 * width, 0.3)),
        "grazing view": (spherical(1.2, 2.0), spherical(level, 0.4)),
        "grazing light": (spherical(level, 0.4), spherical(1.2, 2.0)),
        "both grazing, mirror": (spherical(level - 0.3 * width, 0.4 + math.pi), spherical(level, 0.4)),
        "both grazing, equal": (spherical(level, 0.4), spherical(level, 0.4)),
        "both grazing, across": (spherical(level, 0.4), spherical(level - 0.002, 1.9)),
    }


def moved(t, brdf, wi, wo, tangents):
    """Sum over colours, with wi and wo moved along the sphere by t[:4], the parameters scaled by 1 + t[4:]."""

    def move(w, along, tangent):
        there = w + along @ tangent
        return there / jnp.sqrt(jnp.sum(there * there))

    leaves, tree = jax.tree.flatten(brdf)
    model = jax.tree.unflatten(tree, [a * (1 + t[4 + n]) for n, a in enumerate(leaves)])
    return jnp.sum(model.value_cosine(move(wi, t[:2], tangents[0]), move(wo, t[2:4], tangents[1])))


@eqx.filter_jit
def moved_and_slope(t, brdf, wi, wo, tangents):
    return jax.vmap(jax.value_and_grad(moved), in_axes=(None, None, 0, 0, 0))(t, brdf, wi, wo, tangents)


@eqx.filter_jit
def moved_around(t, brdf, wi, wo, tangents):
    steps = jax.vmap(moved, in_axes=(0, None, None, None, None))
    return jax.vmap(steps, in_axes=(0, None, 0, 0, 0))(t, brdf, wi, wo, tangents)


@pytest.mark.slow
def test_derivatives_are_right_where_formulas_break(name, x64):
    """Along the sphere, in wi, wo and every parameter, against differences of order 4.

    ABC has a kink of G where both directions are equally grazing: only finiteness is asked there.
    """
    brdf = to64(ALL[name]())
    width = float(brdf.lobe_width)
    cases = hard_pairs(width)
    size = 4 + len(jax.tree.leaves(brdf))
    lowest = np.array([min(wi[2], wo[2]) for wi, wo in cases.values()])
    step = np.full((len(cases), size), 1e-5)
    step[:, :4] = 1e-2 * min(width, 0.02) * np.minimum(1, 3 * lowest)[:, None]  # features shrink at the horizon

    wi, wo = (np.stack(side) for side in zip(*cases.values(), strict=True))
    tangents = np.stack([np.stack([np.linalg.svd(w[None])[2][1:] for w in pair]) for pair in zip(wi, wo, strict=True)])
    value, slope = (np.asarray(x) for x in moved_and_slope(np.zeros(size), brdf, wi, wo, tangents))
    assert np.isfinite(value).all() and np.isfinite(slope).all()
    moves = np.array([-2, -1, 1, 2])[:, None, None] * np.eye(size)  # [4, size, size]
    moves = (moves * step[:, None, None, :]).reshape(len(cases), -1, size)
    values = np.asarray(moved_around(moves, brdf, wi, wo, tangents)).reshape(len(cases), 4, size)
    expected = np.einsum("s,cst->ct", [1, -8, 8, -1], values) / (12 * step)
    for n, case in enumerate(cases):
        if (name, case) == ("abc", "both grazing, equal"):
            continue
        bend = 2e-6 * max(value[n] / min(width, 1), np.max(np.abs(expected[n, :4])))  # what the differences resolve
        np.testing.assert_allclose(slope[n, :4], expected[n, :4], rtol=1e-5, atol=bend, err_msg=case)
        np.testing.assert_allclose(slope[n, 4:], expected[n, 4:], rtol=1e-5, atol=1e-6 * value[n], err_msg=case)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["phong", "ggx_anisotropic", "cook_torrance"])
def test_first_and_second_derivatives_are_right_in_both_modes(kind, x64):
    """In wi, wo and every parameter, against differences of the value and of the gradient."""
    leaves, tree = jax.tree.flatten(to64(BRDFS[kind]()))
    generic = map(jnp.asarray, (spherical(0.5, 0.3), spherical(0.7, 2.9)))
    start, unravel = jax.flatten_util.ravel_pytree((leaves, *generic))

    @jax.jit
    def f(flat):
        leaves, wi, wo = unravel(flat)
        return jnp.sum(jax.tree.unflatten(tree, leaves).value_cosine(wi, wo))

    gradient = jax.jit(jax.grad(f))
    check_grads(f, (start,), order=1, modes=("fwd", "rev"), rtol=1e-4, eps=1e-6)
    steps = np.diag(np.where(start == 0, 1e-5, 1e-4 * np.abs(start)))
    expected = (
        np.stack([gradient(start + s) - gradient(start - s) for s in steps]) / (2 * np.sum(steps, axis=1))[:, None]
    )
    got = jax.jit(jax.jacfwd(gradient))(start)
    scale = np.sqrt(np.outer(np.max(np.abs(expected), 0), np.max(np.abs(expected), 0)))
    assert np.all(np.abs(got - expected) <= 1e-5 * scale + 1e-9), np.max(np.abs(got - expected) / (scale + 1e-12))


def test_float32_derivatives_follow_float64_down_to_the_horizon(name, rng):
    brdf = ALL[name]()
    z = 10.0 ** -rng.uniform(0, 12, ROWS)
    phi = rng.uniform(0, 2 * np.pi, (2, ROWS))
    grazing = np.stack([np.sqrt(1 - z * z) * np.cos(phi[0]), np.sqrt(1 - z * z) * np.sin(phi[0]), z], -1)
    other = np.where(rng.random((ROWS, 1)) < 0.5, hemisphere(rng, ROWS, 0.05), spherical(np.pi / 4, phi[1]))
    for wi, wo in ((grazing, other), (other, grazing)):
        wi, wo = wi.astype(np.float32), wo.astype(np.float32)
        _, _, slope = everything(brdf, wi, wo, np.float32)
        with jax.enable_x64(True):
            _, _, expected = everything(to64(brdf), wi, wo, np.float64)
        assert np.isfinite(slope).all()
        if name != "sgd":
            assert worst(slope, expected) <= PRECISION[name][2], worst(slope, expected)


@pytest.mark.parametrize("kind", ["ggx", "ggx_anisotropic", "ggx_gold", "cook_torrance", "abc", "phong", "ggx_0.02"])
def test_grazing_values_reach_their_limit(kind, dtype):
    """The value at cosines 1e-4 and 1e-6 goes to that at 1e-12: nothing is 0/0."""
    brdf = jax.tree.map(lambda a: a.astype(dtype), ALL[kind]())
    fixed = rows(spherical(0.8, 2.5), dtype=dtype)
    z = np.array([1e-4, 1e-6, 1e-12, 1e-30])
    near = rows(*np.stack([np.sqrt(1 - z * z), 0 * z, z], axis=-1), dtype=dtype)
    for values in (everything(brdf, near, fixed, dtype)[0], everything(brdf, fixed, near, dtype)[0]):
        np.testing.assert_allclose(values[1], values[3], rtol=1e-3)
        np.testing.assert_allclose(values[2], values[3], rtol=1e-5)
        np.testing.assert_allclose(values[0], values[3], rtol=3e-2)


@pytest.mark.parametrize(
    ("wi", "wo", "message"),
    [
        (np.zeros((5, 3)), np.zeros(3), r"`wi` must have shape \[3\]; got \[5, 3\]. Use jax.vmap for batches."),
        (np.zeros(3), np.zeros(2), r"`wo` must have shape \[3\]; got \[2\]"),
        (np.zeros(3), 1.0, r"`wo` must have shape \[3\]; got \[\]"),
        (np.zeros(3, complex), np.zeros(3), r"`wi` must hold real numbers; got dtype complex"),
        ("up", np.zeros(3), r"`wi` must be an array of real numbers; got str"),
    ],
)
def test_wrong_directions_are_named(as_user, wi, wo, message):
    for make in BRDFS.values():
        with pytest.raises(ValueError, match=message):
            make().value(wi, wo)
        with pytest.raises(ValueError, match=message):
            make().value_cosine(wi, wo)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: models.Lambertian([0.1, 0.2]), r"`albedo` must be a scalar or of shape \[3\]; got shape \[2\]"),
        (lambda: models.Lambertian("red"), "`albedo` must be an array of real numbers; got str"),
        (lambda: models.Lambertian(1j), "`albedo` must hold real numbers"),
        (lambda: models.Phong(0.5, [1.0, 2.0, 3.0]), "`exponent` must be a scalar; got shape"),
        (lambda: models.Ggx([0.1, 0.2, 0.3]), r"`alpha` must be a scalar or of shape \[2\]; got shape \[3\]"),
        (lambda: models.Ggx(0.1, eta=1.0), "`eta` and `k` belong together"),
        (lambda: models.Ggx(0.1, k=1.0), "`eta` and `k` belong together"),
        (lambda: models.Ggx(0.1, 0.5, eta=1.0, k=1.0), "`f0` and `eta`, `k` are two Fresnel models"),
        (lambda: models.CookTorrance([0.1, 0.2, 0.3], 0.0, 0.5), "`roughness` must be a scalar"),
        (lambda: models.AbcMicrofacet(0.1, 1.0, np.ones((2, 2)), 1.0, 1.5), "`b` must be a scalar or of shape"),
    ],
)
def test_wrong_parameters_are_named(as_user, make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_parameters_are_traced_arrays_and_new_values_do_not_compile_again(rng):
    wi, wo = (array(a, np.float32) for a in pairs(rng, 8))
    value = eqx.filter_jit(eqx.debug.assert_max_traces(lambda brdf: jax.vmap(brdf.value_cosine)(wi, wo), max_traces=1))
    results = [np.asarray(value(models.Ggx(alpha))) for alpha in (0.1, 0.2, np.float32(0.3), jnp.float32(0.4), 1)]
    assert len({r.tobytes() for r in results}) == 5
    for make in ALL.values():
        leaves = jax.tree.leaves(make())
        assert leaves and all(isinstance(leaf, jax.Array) and not leaf.weak_type for leaf in leaves)


def test_a_batch_of_materials_is_vmap(rng):
    wi, wo = (array(a, np.float32) for a in pairs(rng, 5))
    alphas = jnp.linspace(0.1, 0.9, 5)
    batch = eqx.filter_vmap(models.Ggx)(alphas)
    assert batch.isotropic
    got = eqx.filter_jit(eqx.filter_vmap(lambda brdf, i, o: brdf.value(i, o)))(batch, wi, wo)
    one = [evaluate(models.Ggx(a), wi, wo)[n] for n, a in enumerate(np.asarray(alphas))]
    np.testing.assert_allclose(got, np.stack(one), rtol=1e-5)
    jitted = eqx.filter_jit(models.Ggx(0.4).value)(wi[0], wo[0])
    np.testing.assert_allclose(jitted, evaluate(models.Ggx(0.4), wi, wo)[0], rtol=1e-6)


@eqx.filter_jit
def slope_of_width(brdf):
    leaves, tree = jax.tree.flatten(brdf)
    return jax.grad(lambda leaves: jax.tree.unflatten(tree, leaves).lobe_width)(leaves)


def test_lobe_width_is_near_the_half_width_of_the_lobe_and_has_no_gradient(name, x64):
    brdf = to64(ALL[name]())
    width = brdf.lobe_width
    assert width.shape == () and 0 < float(width) <= 1
    if float(width) < 0.3:  # seen from the normal, over wi in the plane where the lobe is narrowest
        wi = rows(*spherical(np.array([0.0, float(width), 1.2]), 0.0), dtype=np.float64)
        values, _, _ = everything(brdf, wi, rows(np.array([0, 0, 1.0]), dtype=np.float64), np.float64)
        peak, beside, floor = values[:3].sum(axis=1)
        share = (beside - floor) / (peak - floor)
        assert 0.2 < share < 0.8, share
    slope = jax.tree.leaves(slope_of_width(brdf))
    assert slope and all(np.all(np.asarray(s) == 0) for s in slope)
