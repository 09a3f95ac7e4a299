"""Light that is hidden in part, against quadrature of the three expansions, triple products, and rays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from shisd import harmonics, models, shading
from shisd.shading import _views
from tests.hard_cases import unit
from tests.marks import FLOAT32_FIRST
from tests.shading.lobes import random_lobes
from tests.truth import scipy_basis

LOBES, LIGHT, SEEN = 5, 7, 4  # degrees
NODE = 3  # the elevation at which views look, whose slice the table holds as it is
VIEW = np.array([np.sin(_views.elevations(8)[NODE]), 0, np.cos(_views.elevations(8)[NODE])])


def scene(rng, dtype, count=5, vertices=6):
    """A light, visibility on a few triangles, and points on them, each in a frame of its own."""
    e = rng.normal(size=(3, (LIGHT + 1) ** 2))
    triangles = rng.integers(0, vertices, size=(4, 3))
    seen = models.Visibility(rng.normal(size=(vertices, (SEEN + 1) ** 2)).astype(dtype), triangles)
    triangle, weights = rng.integers(0, 4, size=count), rng.dirichlet(np.ones(3), size=count)
    frames = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    frames *= np.linalg.det(frames)[:, None, None]
    return e.astype(dtype), seen, triangle, weights.astype(dtype), frames


def quadrature(c, e, v, frame):
    """The integral of the slice c, in its frame, times light times visibility, by a rule that is exact for it."""
    x, w = np.polynomial.legendre.leggauss(12)
    phi = 2 * np.pi * np.arange(24) / 24
    sine = np.sqrt(1 - x * x)
    points = np.stack([np.outer(sine, np.cos(phi)), np.outer(sine, np.sin(phi)), np.outer(x, np.ones(24))], axis=-1)
    points, area = points.reshape(-1, 3), np.repeat(w, 24) * 2 * np.pi / 24
    v, e = scipy_basis(points, SEEN) @ v, scipy_basis(points, LIGHT) @ e.T
    return (area * v * (scipy_basis(points @ frame, LOBES) @ c)) @ e


@FLOAT32_FIRST
def test_it_is_the_integral_of_the_three_expansions(dtype, rng):
    lobes = random_lobes(LOBES, dtype)
    e, seen, triangle, weights, frames = scene(rng, dtype)
    normals, views = frames[:, :, 2].astype(dtype), (frames @ VIEW).astype(dtype)
    got = shading.shade_environment_visibility(lobes, e, seen, normals, views, triangle=triangle, weights=weights)
    c, v = np.asarray(lobes.coefficients()[NODE], float), np.asarray(seen.coefficients, float)
    between = np.einsum("pc,pcn->pn", weights, v[np.asarray(seen.triangles)[triangle]])
    expected = np.stack([quadrature(c, e.astype(float), *x) for x in zip(between, frames, strict=True)])
    assert got.dtype == dtype and got.shape == (5, 3)
    tolerance = (1e-5 if dtype == np.float32 else 1e-12) * np.max(np.abs(expected))
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)
    each = shading.shade_environment_visibility(lobes, e, seen.at(triangle, weights), normals, views)
    np.testing.assert_allclose(each, expected, rtol=0, atol=tolerance)
    one = shading.shade_environment_visibility(lobes, e[0], seen.at(triangle, weights)[1], normals, views)
    np.testing.assert_allclose(one[1], expected[1, 0], rtol=0, atol=tolerance)


@pytest.mark.slow
def test_the_triple_product_and_the_shader_of_the_paper_agree(x64, rng):
    lobes = random_lobes(LOBES, np.float64)
    e, seen, triangle, weights, frames = scene(rng, np.float64, count=2)
    normals, views = frames[:, :, 2], frames @ VIEW
    got = shading.shade_environment_visibility(lobes, e, seen, normals, views, triangle=triangle, weights=weights)
    v = seen.at(triangle, weights)
    product = harmonics.multiply(e[None], v[:, None], LOBES)
    for i in range(2):
        direct = shading.shade_environment(lobes, product[i], normals[i], views[i])
        np.testing.assert_allclose(got[i], direct, rtol=1e-11)
    # appendix A: rho = slice in the world, s = gamma rho, radiance = sum of s pi_l (v * y_l^0)(z_k)
    gamma = shading.visibility_gamma(e, lobes.basis, LOBES)
    rho = harmonics.rotate(lobes.coefficients()[NODE], frames[0])
    s = jnp.einsum("cnlk,n->clk", gamma, rho)
    l = np.arange(LOBES + 1)
    kept = jnp.zeros((LOBES + 1) ** 2).at[: (SEEN + 1) ** 2].set(v[0])
    y, band = scipy_basis(lobes.basis.directions, LOBES), lambda k: slice(k * k, (k + 1) ** 2)
    seen_along = np.stack([np.sqrt(4 * np.pi / (2 * k + 1)) * y[:, band(k)] @ np.asarray(kept[band(k)]) for k in l])
    np.testing.assert_allclose(got[0], jnp.einsum("clk,lk->c", s, seen_along), rtol=1e-10)


@pytest.mark.slow
@FLOAT32_FIRST
def test_without_occlusion_it_is_the_environment(dtype, rng):
    lobes = random_lobes(LOBES, dtype, (3,))
    e, _, _, _, frames = scene(rng, dtype)
    normals, views = frames[:, :, 2].astype(dtype), (frames @ VIEW).astype(dtype)
    everything = models.cap_visibility(np.array([0, 0, 1], dtype), dtype.type(0), 2)
    got = shading.shade_environment_visibility(lobes, e, everything, normals, views)
    expected = shading.shade_environment(lobes, e, normals, views)
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(got, expected, rtol=0, atol=scale * (1e-5 if dtype == np.float32 else 1e-12))


def test_caps_are_integrals_over_what_they_leave(dtype):
    axes, angles = unit([[0, 0, 2.0], [1, -1, 0.3], [0.2, 3, 1]]), np.array([1e-3, 0.7, 3.0])
    got = models.cap_visibility((3 * axes).astype(dtype), angles.astype(dtype), 8)
    x, w = np.polynomial.legendre.leggauss(24)
    for axis, angle, row in zip(axes, angles, got, strict=True):
        z = np.cos(angle) + (x - 1) * (1 + np.cos(angle)) / 2
        p = np.polynomial.legendre.legvander(z, 8).T @ w * (1 + np.cos(angle)) / 2 * 2 * np.pi
        l = np.repeat(np.arange(9), 2 * np.arange(9) + 1)
        np.testing.assert_allclose(row, p[l] * scipy_basis(axis, 8), atol=3e-6 if dtype == np.float32 else 1e-13)


@pytest.mark.slow
def test_derivatives(x64, rng):
    lobes = random_lobes(LOBES, np.float64)
    e, seen, triangle, weights, frames = scene(rng, np.float64, count=3)
    normals, views = frames[:, :, 2], frames @ VIEW
    views[0] = normals[0]

    def radiance(light, coefficients, weights, normals, views):
        v = models.Visibility(coefficients, seen.triangles)
        return shading.shade_environment_visibility(lobes, light, v, normals, views, triangle=triangle, weights=weights)

    arguments = tuple(jnp.asarray(a) for a in (e, seen.coefficients, weights, normals, views))
    check_grads(jax.jit(radiance), arguments, order=1, atol=1e-5, rtol=1e-5, eps=1e-5)


# ---- meshes


def plate_and_wall():
    """A square on the ground and a wall at its side y = 1, both large: half of the sky is hidden at the wall's foot."""
    vertices = np.array([[-50.0, -50, 0], [50, -50, 0], [50, 1, 0], [-50, 1, 0], [-50, 1, 50], [50, 1, 50], [0, 0, 0]])
    return vertices, np.array([[0, 1, 6], [1, 2, 6], [2, 3, 6], [3, 0, 6], [2, 5, 3], [5, 4, 3]])


def ball(count=12):
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


def test_rays_find_a_wall_with_the_noise_that_they_state():
    vertices, triangles = plate_and_wall()
    up = np.tile([0.0, 0, 1], (7, 1))
    many = [models.Visibility.from_mesh(vertices, triangles, 6, normals=up, rays=512, seed=s) for s in range(12)]
    c = np.stack([np.asarray(m.coefficients) for m in many])
    hidden = np.arctan2(50, 1) / np.pi  # a wedge from the ground to the plane through the wall's top
    np.testing.assert_allclose(np.mean(c[:, 6, 0]) / np.sqrt(4 * np.pi), 1 - hidden, atol=0.01)
    spread = np.sqrt(np.mean(np.sum(np.var(c, axis=0, ddof=1), axis=-1)) / (4 * np.pi))
    stated = np.sqrt(np.mean([float(m.noise) ** 2 for m in many]))
    assert 0.7 < spread / stated < 1.4, f"spread {spread}, stated {stated}"


def test_convex_meshes_hide_nothing_and_insides_everything():
    points, faces = ball()
    outside = models.Visibility.from_mesh(points, faces, 4, rays=128)
    np.testing.assert_array_equal(np.asarray(outside.coefficients[:, 1:]), 0)
    np.testing.assert_allclose(outside.openness, 1, rtol=1e-6)
    assert outside.noise == 0
    both = np.concatenate([points, 0.5 * points])  # a ball within a ball: no ray leaves
    inside = models.Visibility.from_mesh(both, np.concatenate([faces, faces + len(points)]), 4, rays=128)
    np.testing.assert_allclose(inside.openness, [1.0] * len(points) + [0.0] * len(points), atol=1e-6)


def test_an_open_mesh_and_triangles_without_area():
    vertices, triangles = plate_and_wall()
    plate = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    open_plate = models.Visibility.from_mesh(vertices[[0, 1, 2, 3, 6]], plate, 3)
    np.testing.assert_allclose(open_plate.openness, 1, rtol=1e-6)
    more = np.concatenate([triangles, [[0, 0, 1], [2, 3, 3]]])
    seen = [models.Visibility.from_mesh(vertices, t, 3, rays=64).coefficients for t in (triangles, more)]
    np.testing.assert_array_equal(*seen)


def test_files_come_back(tmp_path, rng):
    _, seen, *_ = scene(rng, np.float32)
    seen = models.Visibility(seen.coefficients, seen.triangles, 0.01)
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
        f"`triangles` name vertices 0 to {len(points)}": (points, np.append(faces, [[0, 1, len(points)]], axis=0)),
        f"1 of {len(lonely)} vertices have no normal": (lonely, faces),
    }.items():
        with pytest.raises(ValueError, match=match):
            make(*arguments, 3, rays=16)
    lobes = random_lobes(LOBES, np.float32)
    e, seen, triangle, weights, frames = scene(rng, np.float32)
    n = frames[:, :, 2].astype(np.float32)
    shade = lambda v, **at: shading.shade_environment_visibility(lobes, e, v, n, n, **at)
    with pytest.raises(ValueError, match=r"`triangle` \[...\] and `weights` \[..., 3\] are needed"):
        shade(seen)
    with pytest.raises(ValueError, match="belong to a models.Visibility"):
        shade(seen.coefficients[0], weights=weights)
    with pytest.raises(ValueError, match="`triangle` must be integers of the batch shape"):
        shade(seen, triangle=triangle.astype(float), weights=weights)
    with pytest.raises(ValueError, match=r"`visibility` must have \(degree \+ 1\)\*\*2 coefficients"):
        shade(np.ones(5))
    with pytest.raises(ValueError, match="do not broadcast"):
        shade(np.ones((4, 9), np.float32))
