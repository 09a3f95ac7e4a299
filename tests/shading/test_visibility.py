"""Light that is hidden in part, against quadrature of the three expansions, triple products, and rays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import decomposition, harmonics, models, shading
from shisd.models import _visibility
from shisd.shading import _views
from tests.hard_cases import unit
from tests.marks import FLOAT32_FIRST
from tests.shading.slices import random_slices
from tests.truth import scipy_basis

SLICES, LIGHT, SEEN = 5, 7, 4  # degrees
NODE = 3  # the elevation at which views look, whose slice the table holds as it is
VIEW = np.array([np.sin(_views.elevations(8)[NODE]), 0, np.cos(_views.elevations(8)[NODE])])


def scene(rng, dtype, count=5, vertices=6):
    """A light, visibility on a few triangles, and points on them, each in a frame of its own."""
    e = rng.normal(size=(3, (LIGHT + 1) ** 2))
    corners = rng.integers(0, vertices, size=(4, 3))
    seen = models.Visibility(rng.normal(size=(vertices, (SEEN + 1) ** 2)).astype(dtype), corners)
    triangles, barycentric = rng.integers(0, 4, size=count), rng.dirichlet(np.ones(3), size=count)
    frames = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    frames *= np.linalg.det(frames)[:, None, None]
    return e.astype(dtype), seen, {"triangles": triangles, "barycentric": barycentric.astype(dtype)}, frames


def shade(slices, e, seen, normals, views, **at):
    """Radiance from distant light that is seen in part."""
    return shading.shade(slices, models.Occluded(models.DistantLight(e), seen), shading.Surface(normals, views, **at))


def quadrature(c, e, v, frame):
    """The integral of the slice c, in its frame, times light times visibility, by a rule that is exact for it."""
    x, w = np.polynomial.legendre.leggauss(12)
    phi = 2 * np.pi * np.arange(24) / 24
    sine = np.sqrt(1 - x * x)
    points = np.stack([np.outer(sine, np.cos(phi)), np.outer(sine, np.sin(phi)), np.outer(x, np.ones(24))], axis=-1)
    points, area = points.reshape(-1, 3), np.repeat(w, 24) * 2 * np.pi / 24
    v, e = scipy_basis(points, SEEN) @ v, scipy_basis(points, LIGHT) @ e.T
    return (area * v * (scipy_basis(points @ frame, SLICES) @ c)) @ e


@FLOAT32_FIRST
def test_it_is_the_integral_of_the_three_expansions(dtype, rng):
    slices = random_slices(SLICES, dtype)
    e, seen, at, frames = scene(rng, dtype)
    normals, views = frames[:, :, 2].astype(dtype), (frames @ VIEW).astype(dtype)
    got = shade(slices, e, seen, normals, views, **at)
    c, v = np.asarray(slices.coefficients[NODE], float), np.asarray(seen.coefficients, float)
    between = np.einsum("pc,pcn->pn", at["barycentric"], v[np.asarray(seen.triangles)[at["triangles"]]])
    expected = np.stack([quadrature(c, e.astype(float), *x) for x in zip(between, frames, strict=True)])
    assert got.dtype == dtype and got.shape == (5, 3)
    tolerance = (1e-5 if dtype == np.float32 else 1e-12) * np.max(np.abs(expected))
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)
    points = models.Visibility(seen.at(**at), np.zeros((0, 3), int))
    each = shade(slices, e, points, normals, views)
    np.testing.assert_allclose(each, expected, rtol=0, atol=tolerance)
    one = shade(slices, e[0], seen.at(**at)[1], normals, views)
    np.testing.assert_allclose(one[1], expected[1, 0], rtol=0, atol=tolerance)


@pytest.mark.slow
def test_the_triple_product_and_the_shader_of_the_paper_agree(x64, rng):
    slices = random_slices(SLICES, np.float64)
    e, seen, at, frames = scene(rng, np.float64, count=2)
    normals, views = frames[:, :, 2], frames @ VIEW
    got = shade(slices, e, seen, normals, views, **at)
    v = seen.at(**at)
    product = harmonics.multiply(e[None], v[:, None], SLICES)
    for i in range(2):
        direct = shading.shade(slices, models.DistantLight(product[i]), shading.Surface(normals[i], views[i]))
        np.testing.assert_allclose(got[i], direct, rtol=1e-11)
    # appendix A: rho = slice in the world, s = gamma rho, radiance = sum of s pi_l (v * y_l^0)(z_k)
    basis = decomposition.RotatedZonalBasis(decomposition.optimized_directions(SLICES), SLICES)
    gamma = shading.visibility_gamma(models.DistantLight(e), basis, SLICES)
    rho = harmonics.rotate(slices.coefficients[NODE], frames[0])
    s = jnp.einsum("cnlk,n->clk", gamma, rho)
    l = np.arange(SLICES + 1)
    kept = jnp.zeros((SLICES + 1) ** 2).at[: (SEEN + 1) ** 2].set(v[0])
    y, band = scipy_basis(np.asarray(basis.directions), SLICES), lambda k: slice(k * k, (k + 1) ** 2)
    seen_along = np.stack([np.sqrt(4 * np.pi / (2 * k + 1)) * y[:, band(k)] @ np.asarray(kept[band(k)]) for k in l])
    np.testing.assert_allclose(got[0], jnp.einsum("clk,lk->c", s, seen_along), rtol=1e-10)


def test_the_background_lies_on_no_triangle(rng):
    """What a mask leaves out, and a triangle that many points share."""
    slices, (e, seen, at, frames) = random_slices(SLICES, np.dtype("float32")), scene(rng, np.float32)
    normals, views = frames[:, :, 2].astype(np.float32), (frames @ VIEW).astype(np.float32)
    there, one = np.array([True, False, True, True, False]), np.full(5, 2)
    shared = np.asarray(shade(slices, e, seen, normals, views, triangles=one, barycentric=at["barycentric"]))
    for triangles in (np.where(there, 2, -1), np.where(there, 2, 4)):
        got = shade(slices, e, seen, normals, views, mask=there, triangles=triangles, barycentric=at["barycentric"])
        np.testing.assert_array_equal(got, np.where(there[:, None], shared, 0))
    got = shade(slices, e, seen, normals, views, triangles=2, barycentric=at["barycentric"])
    np.testing.assert_array_equal(got, shared)


@FLOAT32_FIRST
def test_nothing_hidden_is_the_environment_and_everything_is_dark(dtype, rng):
    slices = random_slices(SLICES, dtype)
    e, _, _, frames = scene(rng, dtype)
    normals, views = frames[:, :, 2].astype(dtype), (frames @ VIEW).astype(dtype)
    caps = np.asarray(models.cap_visibility(np.array([0, 0, 1], dtype), np.array([0, np.pi], dtype), SEEN))
    expected = np.asarray(shading.shade(slices, models.DistantLight(e), shading.Surface(normals, views)))
    tolerance = (1e-5 if dtype == np.float32 else 1e-12) * np.max(np.abs(expected))
    for v, right in zip(caps, (expected, 0 * expected), strict=True):
        for each in (v, np.tile(v, (5, 1))):  # of all points, and a row for every point: two ways
            got = shade(slices, e, each, normals, views)
            np.testing.assert_allclose(got, right, rtol=0, atol=tolerance)


def test_caps_are_integrals_over_what_they_leave(dtype):
    axes, angles = unit([[0, 0, 2.0], [1, -1, 0.3], [0.2, 3, 1]]), np.array([1e-3, 0.7, 3.0])
    got = jax.jit(models.cap_visibility, static_argnums=2)((3 * axes).astype(dtype), angles.astype(dtype), 8)
    x, w = np.polynomial.legendre.leggauss(24)
    for axis, angle, row in zip(axes, angles, got, strict=True):
        z = np.cos(angle) + (x - 1) * (1 + np.cos(angle)) / 2
        p = np.polynomial.legendre.legvander(z, 8).T @ w * (1 + np.cos(angle)) / 2 * 2 * np.pi
        l = np.repeat(np.arange(9), 2 * np.arange(9) + 1)
        np.testing.assert_allclose(row, p[l] * scipy_basis(axis, 8), atol=3e-6 if dtype == np.float32 else 1e-13)


@pytest.mark.slow
def test_derivatives(x64, rng):
    slices = random_slices(SLICES, np.float64)
    e, seen, at, frames = scene(rng, np.float64, count=3)
    normals, views = frames[:, :, 2], frames @ VIEW
    views[0] = normals[0]

    def radiance(light, coefficients, barycentric, normals, views):
        v = models.Visibility(coefficients, seen.triangles)
        return shade(slices, light, v, normals, views, triangles=at["triangles"], barycentric=barycentric)

    arguments = tuple(jnp.asarray(a) for a in (e, seen.coefficients, at["barycentric"], normals, views))
    check_grads(jax.jit(radiance), arguments, order=1, atol=1e-5, rtol=1e-5, eps=1e-5)


# ---- meshes

SKY, RAYS = 3, 512  # the degree and the rays of all of them: what is compiled once serves all


def plate_and_wall():
    """A square on the ground and a wall at its side y = 1, both large: half of the sky is hidden at the wall's foot."""
    vertices = np.array([[-50.0, -50, 0], [50, -50, 0], [50, 1, 0], [-50, 1, 0], [-50, 1, 50], [50, 1, 50], [0, 0, 0]])
    return vertices, np.array([[0, 1, 6], [1, 2, 6], [2, 3, 6], [3, 0, 6], [2, 5, 3], [5, 4, 3]])


UP = np.tile([0.0, 0, 1], (7, 1))  # normals of its vertices
OPEN = 1 - np.arctan(50 * 50 / np.sqrt(50**2 + 50**2 + 1)) / np.pi  # at its last one: without two quarters of the wall


def ball(count=6):
    """A closed mesh: rings of a unit sphere, with its poles."""
    theta, phi = np.pi * np.arange(1, count) / count, 2 * np.pi * np.arange(2 * count) / (2 * count)
    rings = np.stack([np.outer(np.sin(theta), np.cos(phi)), np.outer(np.sin(theta), np.sin(phi)),
                      np.outer(np.cos(theta), np.ones_like(phi))], axis=-1).reshape(-1, 3)  # fmt: skip
    points = np.concatenate([rings, [[0, 0, 1.0], [0, 0, -1]]])
    n, faces = 2 * count, []
    for j in range(n):
        k = (j + 1) % n
        faces.append([len(rings), j, k])
        faces.append([len(rings) + 1, len(rings) - n + k, len(rings) - n + j])
        for i in range(count - 2):
            faces += [[i * n + j, i * n + n + j, i * n + n + k], [i * n + j, i * n + n + k, i * n + k]]
    return points, np.array(faces)


def cast(vertices, triangles, **options):
    return models.Visibility.from_mesh(vertices, triangles, SKY, rays=RAYS, **options)


def test_rays_find_a_wall_with_the_noise_that_they_state():
    many = [cast(*plate_and_wall(), normals=UP, seed=s) for s in range(24)]
    c, stated = (np.stack([np.asarray(getattr(m, name)) for m in many]) for name in ("coefficients", "noise"))
    np.testing.assert_allclose(np.mean(c[:, 6, 0]) / np.sqrt(4 * np.pi), OPEN, atol=1e-3)
    assert stated.shape == (24, 7)
    np.testing.assert_array_equal(stated[:, 4:6], 0)  # on the wall's top nothing is hidden
    spread = np.sqrt(np.sum(np.var(c, axis=0, ddof=1), axis=-1) / (4 * np.pi))
    ratio = spread[[2, 3, 6]] / np.sqrt(np.mean(stated**2, axis=0))[[2, 3, 6]]
    assert np.all((ratio > 0.6) & (ratio < 1.6)), f"spread over what is stated: {ratio}"


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("far", [0.0, 1e3, 1e5, 1e7])
def test_neither_place_nor_unit_matters(far, scale):
    move = lambda points: (points + far * np.array([1, -0.6, 0.3])) * scale
    points, faces = ball()
    np.testing.assert_array_equal(cast(move(points), faces).openness, np.float32(1))
    inward = cast(move(points), faces, normals=-points)
    np.testing.assert_allclose(inward.openness, 0, atol=1e-6)
    vertices, triangles = plate_and_wall()
    got = cast(move(vertices), triangles, normals=UP)
    assert abs(float(got.openness[6]) - OPEN) < 0.02  # measured 0.016, three times the deviation of seeds
    np.testing.assert_allclose(got.coefficients, cast(vertices, triangles, normals=UP).coefficients, atol=1e-6)


@pytest.mark.parametrize("wide", [1e2, 1e4, 1e6])
def test_details_of_a_wide_scene_are_seen(wide):
    """The plate and the wall on a ground that is so many times as wide; a start far off it would look over the wall."""
    vertices, triangles = plate_and_wall()
    ground = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 50 * wide - [0, 0, 1]
    more = np.concatenate([triangles, [[7, 8, 9], [7, 9, 10]]])
    got = cast(np.concatenate([vertices, ground]), more, normals=np.tile(UP[:1], (11, 1)))
    assert abs(float(got.openness[6]) - OPEN) < 0.02


def test_closed_meshes_hide_their_inside_and_an_outer_one_the_inner():
    points, faces = ball(4)
    outside = cast(points, faces)
    np.testing.assert_array_equal(np.asarray(outside.coefficients[:, 1:]), 0)
    np.testing.assert_array_equal(outside.noise, 0)
    both = np.concatenate([points, 0.5 * points])
    inside = cast(both, np.concatenate([faces, faces + len(points)]))
    np.testing.assert_allclose(inside.openness, [1.0] * len(points) + [0.0] * len(points), atol=1e-6)


def test_open_meshes_triangles_without_area_and_triangles_given_twice():
    vertices, triangles = plate_and_wall()
    plate = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    np.testing.assert_array_equal(cast(vertices[[0, 1, 2, 3, 6]], plate).openness, np.float32(1))
    seen = np.asarray(cast(vertices, triangles, normals=UP).coefficients)
    for more in ([[0, 0, 1], [2, 3, 3]], triangles, triangles[:, ::-1]):
        also = cast(vertices, np.concatenate([triangles, more]), normals=UP)
        np.testing.assert_allclose(also.coefficients, seen, atol=1e-6)
    with pytest.raises(ValueError, match="7 of 7 vertices have no normal: .* with both windings. Remove them, or pass"):
        cast(vertices, np.concatenate([triangles, triangles[:, ::-1]]))
    turned = vertices @ np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]  # sums that rounding leaves
    with pytest.raises(ValueError, match="7 of 7 vertices have no normal"):
        cast(turned, np.concatenate([triangles, triangles[:, ::-1]]))


def test_points_need_not_be_on_the_mesh():
    vertices, triangles = plate_and_wall()
    y = np.array([0.9, 0.0, -1.0, -9.0])
    points = np.stack([0 * y, y, 0 * y], axis=-1)
    for faces in (triangles, triangles[4:]):  # on the plate, and over nothing
        got = cast(vertices, faces, points=points, normals=UP[:4])
        width, far = 50, 1 - y
        hidden = np.arctan(width * 50 / (far * np.sqrt(width**2 + 50**2 + far**2))) / np.pi
        np.testing.assert_allclose(got.openness, 1 - hidden, atol=0.02)
        assert got.coefficients.shape == (4, 16) and got.noise.shape == (4,) and got.triangles.shape == (0, 3)
    with pytest.raises(ValueError, match="`visibility` has no triangles: it is that of points"):
        got.at(0, np.ones(3) / 3)
    with pytest.raises(ValueError, match=r"`points` need their `normals` \[P, 3\]"):
        cast(vertices, triangles, points=points)
    with pytest.raises(ValueError, match=r"`normals` must have the shape of `points`, \[4, 3\]; got \[7, 3\]"):
        cast(vertices, triangles, points=points, normals=UP)
    with pytest.raises(ValueError, match="1 of `points` are not finite"):
        cast(vertices, triangles, points=np.where(y[:, None] > 0.5, np.nan, points), normals=UP[:4])


def test_progress_counts_every_row_of_both_halves(monkeypatch):
    told = []
    monkeypatch.setattr(_visibility, "_RAYS_AT_ONCE", 6 * RAYS // 2)  # four vertices at a time
    whole = cast(*plate_and_wall(), normals=UP, progress=lambda *now: told.append(now))
    assert told == [(4, 14), (7, 14), (11, 14), (14, 14)]
    monkeypatch.undo()
    np.testing.assert_allclose(whole.coefficients, cast(*plate_and_wall(), normals=UP).coefficients, atol=1e-6)


@pytest.mark.parametrize("triangles", [[[0, 1, 1000]], [[0, -1, 2]], [[0, 1, 2**40]], [[0, 1, 2], [1, 2, 4]]])
def test_corners_exist(triangles, tmp_path):
    with pytest.raises(ValueError, match="`triangles` must be in 0 to 3, for 4 vertices; got"):
        models.Visibility(np.ones((4, 9), np.float32), np.array(triangles))
    np.savez(tmp_path / "bad.npz", coefficients=np.ones((4, 9)), triangles=np.array(triangles), noise=0.0)
    with pytest.raises(ValueError, match=r"bad.npz.*`triangles` must be in 0 to 3"):
        models.Visibility.load(tmp_path / "bad.npz")


def test_numbers_are_finite_and_have_their_shapes():
    make = lambda c, noise: models.Visibility(c, np.array([[0, 1, 2]]), noise)
    c, ones = np.ones((4, 9), np.float32), np.ones(4, np.float32)
    missing = np.where(np.arange(36).reshape(4, 9) == 5, np.float32(np.nan), c)
    np.testing.assert_array_equal(make(c, ones).noise, ones)
    np.testing.assert_array_equal(make(c, 0.5).noise, 0.5 * ones)
    for match, arguments in {
        "`coefficients` must be finite; 1 of its numbers": (missing, ones),
        r"`noise` must be one number or \[V\] = \[4\]; got shape \[3\]": (c, ones[:3]),
        "`noise` must be finite; 4 of its numbers": (c, ones * np.inf),
    }.items():
        with pytest.raises(ValueError, match=match):
            make(*arguments)


def test_triangles_that_do_not_exist_are_errors_or_nan():
    c = np.arange(16, dtype=np.float32).reshape(4, 4)
    seen, w = models.Visibility(c, np.array([[0, 1, 2], [1, 2, 3]])), np.array([0.5, 0.25, 0.25], np.float32)
    for index in (7, -1, 2):
        with pytest.raises(ValueError, match=f"`triangles` must be in 0 to 1, for 2 triangles; got {index} to {index}"):
            seen.at(index, w)
    with pytest.raises(ValueError, match=r"`triangles` must be integers of the batch shape of `barycentric` \[3\]"):
        seen.at(np.array([0, 1]), w)
    at = np.asarray(jax.jit(jax.vmap(lambda i: seen.at(i, w)))(np.array([7, -1, 2, 1])))
    np.testing.assert_array_equal(np.isnan(at), np.array([[True], [True], [True], [False]]) & np.ones((4, 4), bool))
    np.testing.assert_array_equal(at[3], w @ c[1:])


def test_files_come_back(tmp_path, rng):
    _, seen, *_ = scene(rng, np.float32)
    seen = models.Visibility(seen.coefficients, seen.triangles, 0.01 * np.arange(6))
    path = tmp_path / "seen.npz"
    seen.save(path)
    back = models.Visibility.load(path)
    for a, b in zip(jax.tree.leaves(seen), jax.tree.leaves(back), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    with pytest.raises(FileExistsError, match="pass overwrite=True"):
        seen.save(path)
    with pytest.raises(FileNotFoundError, match="no such file"):
        models.Visibility.load(tmp_path / "other.npz")
    (tmp_path / "bad.npz").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="not a file that Visibility.save wrote"):
        models.Visibility.load(tmp_path / "bad.npz")
    with pytest.raises(ValueError, match="stored as .npz"):
        seen.save(tmp_path / "seen.bin")


def test_errors_name_the_argument(as_user, rng):
    points, faces = ball(4)
    make = models.Visibility.from_mesh
    lonely = np.concatenate([points, [[5.0, 5, 5]]])
    for match, arguments in {
        r"`vertices` must have shape \[V, 3\]; got": (points[:, :2], faces),
        r"`triangles` must be integers \[F, 3\]; got float64": (points, faces.astype(float)),
        "1 of `vertices` are not finite": (np.where(np.arange(len(points))[:, None] == 3, np.nan, points), faces),
        f"`triangles` must be in 0 to {len(points) - 1}": (points, np.append(faces, [[0, 1, len(points)]], axis=0)),
        f"1 of {len(lonely)} vertices have no normal": (lonely, faces),
    }.items():
        with pytest.raises(ValueError, match=match):
            make(*arguments, 3, rays=16)
    for offset in (-1.0, np.nan, np.inf, [0.1]):
        with pytest.raises(ValueError, match="`offset` must be a number >= 0"):
            make(points, faces, 3, offset=offset)
    slices = random_slices(SLICES, np.float32)
    e, seen, at, frames = scene(rng, np.float32)
    n = frames[:, :, 2].astype(np.float32)
    bad = lambda v, **changed: shade(slices, e, v, n, n, **changed)
    with pytest.raises(ValueError, match=r"`surface` needs `triangles` \[...\] and `barycentric` \[..., 3\]: .* mesh"):
        bad(seen)
    for name in at:
        with pytest.raises(ValueError, match="belong together: pass both or none"):
            bad(seen, **{name: at[name]})
    with pytest.raises(ValueError, match="`triangles` must be integers .*; got dtype float"):
        bad(seen, **at | {"triangles": at["triangles"].astype(np.float32)})
    with pytest.raises(ValueError, match=r"do not broadcast: .* `triangles` \[3\]"):
        bad(seen, **at | {"triangles": at["triangles"][:3]})
    with pytest.raises(ValueError, match="`triangles` must be in 0 to 3, for 4 triangles; got 7 to 7"):
        bad(seen, **at | {"triangles": 0 * at["triangles"] + 7})
    with pytest.raises(ValueError, match=r"`visibility` must have \(degree \+ 1\)\*\*2 coefficients"):
        bad(np.ones(5))
    with pytest.raises(ValueError, match="do not broadcast"):
        bad(np.ones((4, 9), np.float32))
    with pytest.raises(
        ValueError, match="`light` must be a models.DistantLight or ZonalLight, which alone can be occl"
    ):
        models.Occluded(models.SphereLight(np.ones(3), 0.5), seen)
    with pytest.raises(ValueError, match="`light` must be a models.DistantLight; got"):
        shading.visibility_gamma(e, decomposition.RotatedZonalBasis(decomposition.optimized_directions(2), 2), 2)
