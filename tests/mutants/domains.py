"""Mutants of the regions and their integrals: what the tests named have to catch."""

from tests.mutants import Mutant

_POLYGON, _MOMENTS = "shisd/domains/_polygon.py", "shisd/domains/moments"
_EDGES, _RECURRENCE = f"{_MOMENTS}/_edges.py", f"{_MOMENTS}/_recurrence.py"
_DERIVATIVES, _FOLD = f"{_MOMENTS}/_derivatives.py", f"{_MOMENTS}/_fold.py"
_CASE = "tests/domains/test_moments.py::test_values_and_derivatives"

MUTANTS = [
    Mutant(
        "no gradient of moments in the outline", _DERIVATIVES,
        old="return -jnp.sum(start[None] * a", new="return 0 * jnp.sum(start[None] * a",
        test=f"{_CASE}[non-convex]",
    ),
    Mutant(
        "no gradient of moments in the axes", _DERIVATIVES,
        old="(axes,), (d_axes,))\n    if", new="(axes,), (0 * d_axes,))\n    if",
        test=f"{_CASE}[non-convex]",
    ),
    Mutant(
        "no gradient of sums of moments in the outline", _FOLD,
        old="change -= sum_first(speed * weight)", new="change -= sum_first(0 * speed * weight)",
        test="tests/domains/test_moments.py::test_fold_agrees_with_moments",
    ),
    Mutant(
        "the last points in lanes twice", "shisd/_lanes.py",
        old="all, own, i * LANES, -1)", new="all, own, 0 * i * LANES, -1)",
        test="tests/test_lanes.py::test_any_number_of_points[one kernel-float32-129]",
    ),
    Mutant(
        "points that have no batch with the wrong ones of a batch", "shisd/_lanes.py",
        old="jnp.moveaxis(a, 0, -2) if has_batch else", new="jnp.moveaxis(a, 0, -1) if has_batch else",
        test="tests/test_lanes.py::test_batches_of_vmap_are_points[plain]",
    ),
    Mutant(
        "edges that the horizon adds are left out", _FOLD,
        old="used, edges, share = part\n", new="used, edges, share = part[0] & jnp.any(part[2] != 0), *part[1:]\n",
        test="tests/shading/test_polygon.py::test_hard_cases[float32-across the horizon, turning inwards]",
    ),
    Mutant(
        "lengths tilt the middle of an edge", _EDGES,
        old="return chord, middle - tilt[None] * chord", new="return chord, middle",
        test=f"{_CASE}[edge 1e-03 rad short of pi]",
    ),
    Mutant(
        "a sign that roundings choose", _RECURRENCE,
        old="dot(_leading(d), _leading(c)) < 0", new="dot(d, c) < 0",
        test="tests/domains/test_moments.py::test_right_angles_as_users_compile_them",
    ),
    Mutant(
        "an expansion beyond a map over the polygon as it is", "shisd/domains/_integrate.py",
        old="SphericalPolygon(f.directions(region.vertices), ", new="SphericalPolygon(region.vertices, ",
        test="tests/domains/test_integrate.py::test_expansions_beyond_maps[float32]",
    ),
    Mutant(
        "a sum of ends where they cancel", _RECURRENCE,
        old="dot(edge.middle, d), dot(edge.normal, d)", new="u0 + u1, dot(edge.normal, d)",
        test=f"{_CASE}[edge 1e-03 rad short of pi]",
    ),
    Mutant(
        "a difference of line integrals where it cancels", _DERIVATIVES,
        old=".eps) ** 0.25", new=".eps) * 0",
        test=f"{_CASE}[solid angle 2e-12]",
    ),
    Mutant(
        "an angle over its tangent from what it lacks to 1", _EDGES,
        old="return jnp.where(small, series, part - 1), part",
        new="tail = jnp.where(small, series, part - 1)\n    return tail, 1 + tail",
        test=f"{_CASE}[edge 1e-04 rad short of pi]",
    ),
    Mutant(
        "short edges are points", _EDGES,
        old="1e4 * jnp.finfo(t2.dtype).tiny", new="(64 * jnp.finfo(t2.dtype).eps) ** 2",
        test=f"{_CASE}[solid angle 2e-12]",
    ),
    Mutant(
        "cosine powers without the edge's plane", _RECURRENCE,
        old="(n - 1) * (1 - x.g2) * f0", new="(n - 1) * f0",
        test="tests/domains/test_moments.py::test_powers_against_quadrature_and_closed_values[float32]",
    ),
    Mutant(
        "a NumPy scalar in the constant", "shisd/domains/_integrate.py",
        old="solid_angle * math.sqrt(", new="solid_angle * np.sqrt(",
        test="tests/domains/test_polygon.py::test_float32_stays_float32_with_x64_on",
    ),
    Mutant(
        "reversed winding of points", _POLYGON,
        old="SphericalPolygon(normalize(relative), count", new="SphericalPolygon(normalize(relative)[::-1], count",
        test="tests/domains/test_polygon.py::test_polygons_from_points[float32]",
    ),
    Mutant(
        "coordinates of NumPy rounded before they are subtracted", _POLYGON,
        old="if isinstance(points, jax.Array) or", new="if True or",
        test="tests/domains/test_polygon.py::test_points_of_numpy_are_subtracted_as_they_are",
    ),
    Mutant(
        "a great circle by rounding", _POLYGON,
        old="else -rounding)", new="else rounding)",
        test="tests/domains/test_polygon.py::test_a_great_circle_is_a_hemisphere[float32-12]",
    ),
    Mutant(
        "a small polygon is the sphere", _POLYGON,
        old="turns = jnp.floor(jax.lax.stop_gradient(from_lowest) / (4 * np.pi))",
        new="turns = -jnp.floor((largest - jax.lax.stop_gradient(angle)) / (4 * np.pi))",
        test="tests/domains/test_polygon.py::test_small_and_nearly_whole[float32-solid angle 2e-08]",
    ),
    Mutant(
        "a traced count below 3", _POLYGON,
        old="jnp.where((n >= 3) & (n <= slots), vertices[..., last, :], jnp.nan)", new="vertices[last]",
        test="tests/domains/test_polygon.py::test_padding_and_traced_counts",
    ),
    Mutant(
        "the part below", _POLYGON,
        old="inside = height > 0", new="inside = height < 0",
        test="tests/domains/test_polygon.py::test_clipping_keeps_what_is_above[non-convex-float64]",
    ),
    Mutant(
        "edges cut in the middle", _POLYGON,
        old="part = height / jnp.where(crosses, height - height_next, 1)", new="part = 0.5 + 0 * height",
        test="tests/domains/test_polygon.py::test_clipping_keeps_what_is_above[non-convex-float64]",
    ),
    Mutant(
        "a cap of 4 rad", "shisd/domains/_region.py",
        old="bad = (self.angle < 0) | (self.angle > np.pi * (1 + 1e-6))", new="bad = self.angle < 0",
        test="tests/domains/test_integrate.py::test_what_is_no_angle_is_nan[4.0]",
    ),
    Mutant(
        "a cell for what is no direction", "shisd/domains/_haar.py",
        old="jnp.isnan(normalize(w)).any(axis=1)", new="jnp.zeros(len(w), bool)",
        test="tests/domains/test_haar.py::test_no_direction_has_no_value",
    ),
    Mutant(
        "cells cut on the wrong side", "shisd/domains/_haar.py",
        old="corners[odd] = corners[odd][:, ::-1]", new="corners[odd] = corners[odd][:, ::1]",
        test="tests/domains/test_haar.py::test_a_direction_finds_its_cell",
    ),
]  # fmt: skip
