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
# float32 against float64 at the same directions, relative to the value, where both cosines are above 0.01
PRECISION = {"sgd": 3e-5, "phong_5000": 3e-5}


def to64(model):
    return jax.tree.map(lambda a: a.astype(jnp.float64), model)


@pytest.fixture(params=ALL)
def name(request):
    return request.param


ROWS = 400  # in every test, so that compiled code is shared


def rows(*directions, dtype):
    """The directions, repeated to ROWS rows."""
    return array(np.resize(np.stack(directions), (ROWS, 3)), dtype)


def test_value_is_zero_below_the_horizon(name):
    brdf = ALL[name]()
    up, low, level = np.array([0.6, 0.0, 0.8]), np.array([0.6, 0.0, -0.8]), np.array([1.0, 0.0, 0.0])
    wi = rows(low, up, low, level, up, level, dtype=np.float32)
    wo = rows(up, low, low, up, level, -level, dtype=np.float32)
    assert all(np.all(np.asarray(x) == 0) for x in jax.tree.leaves((evaluate(brdf, wi, wo), slopes(brdf, wi, wo))))
    mirror = rows(up * [-1, 1, 1], dtype=np.float32)
    assert np.all(np.asarray(evaluate(brdf, mirror, rows(up, dtype=np.float32))) > 0)


def test_value_is_positive_reciprocal_and_isotropic_where_it_says_so(name, rng, x64):
    brdf = to64(ALL[name]())
    wi, wo = pairs(rng, ROWS, 1e-3)
    there, back = np.asarray(evaluate(brdf, wi, wo)), np.asarray(evaluate(brdf, wo, wi))
    assert np.all(there >= 0)
    np.testing.assert_allclose(there, back, rtol=1e-9, atol=1e-300)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    same = np.allclose(there, evaluate(brdf, wi @ turn.T, wo @ turn.T), rtol=1e-8)
    assert same == brdf.isotropic


def test_value_cosine_is_the_value_times_the_cosine_of_wi(name, rng):
    brdf = ALL[name]()
    wi, wo = (array(a, np.float32) for a in pairs(rng, ROWS))
    value = np.asarray(evaluate(brdf, wi, wo)).reshape(ROWS, -1).sum(axis=1)
    np.testing.assert_allclose(slopes(brdf, wi, wo)[0], value * np.asarray(wi)[:, 2], rtol=2e-6)


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


def test_float32_follows_float64(name, rng):
    brdf = ALL[name]()
    wi, wo = (a.astype(np.float32) for a in pairs(rng, ROWS, 0.01))
    single = np.asarray(evaluate(brdf, wi, wo))
    assert single.dtype == np.float32
    with jax.enable_x64(True):
        double = np.asarray(evaluate(to64(brdf), wi.astype(np.float64), wo.astype(np.float64)))
    error = np.max(np.abs(single - double) / np.maximum(double, 1e-30))
    assert error <= PRECISION.get(name, 3e-6), error


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


def test_float32_derivatives_are_finite_down_to_the_horizon(name, rng):
    brdf = ALL[name]()
    z = 10.0 ** -rng.uniform(0, 12, ROWS)
    phi = rng.uniform(0, 2 * np.pi, (2, ROWS))
    grazing = np.stack([np.sqrt(1 - z * z) * np.cos(phi[0]), np.sqrt(1 - z * z) * np.sin(phi[0]), z], -1)
    other = np.where(rng.random((ROWS, 1)) < 0.5, hemisphere(rng, ROWS, 0.05), spherical(np.pi / 4, phi[1]))
    for wi, wo in ((grazing, other), (other, grazing)):
        result = slopes(brdf, array(wi, np.float32), array(wo, np.float32))
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(result))


@pytest.mark.parametrize("kind", ["ggx", "ggx_anisotropic", "ggx_gold", "cook_torrance", "abc", "phong", "ggx_0.02"])
def test_grazing_values_reach_their_limit(kind, dtype):
    """The value at cosines 1e-4 and 1e-6 goes to that at 1e-12: nothing is 0/0."""
    brdf = ALL[kind]()
    fixed = rows(spherical(0.8, 2.5), dtype=dtype)
    z = np.array([1e-4, 1e-6, 1e-12, 1e-30])
    near = rows(*np.stack([np.sqrt(1 - z * z), 0 * z, z], axis=-1), dtype=dtype)
    for values in (evaluate(brdf, near, fixed), evaluate(brdf, fixed, near)):
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
    got = eqx.filter_vmap(lambda brdf, i, o: brdf.value(i, o))(batch, wi, wo)
    one = [evaluate(models.Ggx(a), wi, wo)[n] for n, a in enumerate(alphas)]
    np.testing.assert_allclose(got, np.stack(one), rtol=1e-5)
    jitted = eqx.filter_jit(models.Ggx(0.4).value)(wi[0], wo[0])
    np.testing.assert_allclose(jitted, evaluate(models.Ggx(0.4), wi, wo)[0], rtol=1e-6)


def test_lobe_width_is_near_the_half_width_of_the_lobe_and_has_no_gradient(name, x64):
    brdf = to64(ALL[name]())
    width = brdf.lobe_width
    assert width.shape == () and 0 < float(width) <= 1
    if float(width) < 0.3:  # seen from the normal, over wi in the plane where the lobe is narrowest
        wi = rows(*spherical(np.array([0.0, float(width), 1.2]), 0.0), dtype=np.float64)
        values = np.asarray(evaluate(brdf, wi, rows(np.array([0, 0, 1.0]), dtype=np.float64)))
        peak, beside, floor = values[:3].reshape(3, -1).sum(axis=1)
        share = (beside - floor) / (peak - floor)
        assert 0.2 < share < 0.8, share
    leaves, tree = jax.tree.flatten(brdf)
    slope = jax.grad(lambda leaves: jax.tree.unflatten(tree, leaves).lobe_width)(leaves)
    assert all(np.all(np.asarray(s) == 0) for s in slope)
