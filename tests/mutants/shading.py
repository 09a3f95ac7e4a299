"""Mutants of shading by lights and distant light: what the tests named have to catch."""

from tests.mutants import Mutant

POLYGON, SURFACE = "tests/shading/test_polygon.py::", "tests/shading/test_surface.py::"
MIRROR, SHADE = "tests/shading/test_mirror.py::", "tests/shading/test_shade.py::"
POINTS = "tests/shading/test_quadrature.py::"
LIGHTS, BEYOND = "tests/models/test_lights.py::", "tests/shading/test_transformed.py::"
OUTLINE, DISTANT = "shisd/models/lights/_outline.py", "shisd/models/lights/_distant.py"
SLICES = "shisd/shading/slices/_slices.py"
SIDES = LIGHTS + "test_outlines_are_positive_where_they_are_lit_and_nothing_behind"
MIXED = SHADE + "test_lights_of_mixed_kinds_add_up[colour0-float32]"
SLICE = POLYGON + "test_values_and_gradients_of_the_slice[float32]"

MUTANTS = [
    Mutant(
        "outline gradients of radiance are zero", "shisd/shading/_incidence.py",
        old="return jax.jvp(lambda v: _fold(rows, v, degree, spare), (v,), (by,))[1]",
        new="return 0 * jax.jvp(lambda v: _fold(rows, v, degree, spare), (v,), (by,))[1]", test=SLICE,
    ),
    Mutant(
        "outline gradients of integrals are zero", "shisd/domains/moments/_fold.py",
        old="change -= sum_first(speed * weight)", new="change -= 0 * sum_first(speed * weight)", test=SLICE,
    ),
    Mutant(
        "gradients keep a tile of every light", "shisd/shading/_tiles.py",
        old="add = jax.checkpoint(lambda x, light: (x + radiance(light), None), prevent_cse=False)",
        new="add = lambda x, light: (x + radiance(light), None)",
        test=POLYGON + "test_gradients_keep_no_tile_of_each_light",
    ),
    Mutant(
        "the plane of incidence does not turn with the view", "shisd/shading/_incidence.py",
        old="dv += turn * jnp.where(steep, 0, 1 / jnp.where(steep, 1, sine))[None, None]", new="dv += 0 * turn",
        test=SLICE,
    ),
    Mutant(
        "slices do not change with the elevation of the view", "shisd/shading/_incidence.py",
        old="* (view[:, 2] * along - jnp.sin(theta) * dz)", new="* (0 * along)", test=SLICE,
    ),
    Mutant(
        "frames do not turn with the normal", "shisd/shading/_frames.py",
        old="return r, jnp.cross(jnp.cross(normal, dn)[:, :, None], r, axis=1)", new="return r, 0 * r", test=SLICE,
    ),
    Mutant(
        "no base under lobes", "shisd/shading/_transformed_integrals.py",
        old="lobe[0] * wide + under[0] * plain", new="lobe[0] * wide + 0 * under[0] * plain",
        test=BEYOND + "test_integrals_are_exact[True-float64]",
    ),
    Mutant(
        "no change across the plane at the normal", "shisd/shading/_transformed_integrals.py",
        old="change += _at_normal(tables, v, steep", new="change += 0 * _at_normal(tables, v, steep",
        test=BEYOND + "test_derivatives_in_everything[True]",
    ),
    Mutant(
        "a map of the opposite form", "shisd/decomposition/_stretch.py",
        old="float(f) / 2 * s[m]", new="float(f) / -2 * s[m]",
        test="tests/decomposition/test_transformed.py::test_a_map_is_the_exponential_of_half_its_form[float64-3.0-True]",
    ),
    Mutant(
        "fits whose maps stay as samples change", "shisd/decomposition/_transformed.py",
        old="place(-jnp.linalg.solve(curvature, change))", new="place(0 * jnp.linalg.solve(curvature, change))",
        test="tests/decomposition/test_transformed.py::test_derivatives_of_a_fit",
    ),
    Mutant(
        "no clip at the horizon", "shisd/shading/paths/_cut.py",
        old="whole, lambda: in_lanes(clip, (outline, above)))", new="whole, whole)", test=SLICE,
    ),
    Mutant(
        "what an edge sweeps as if it did not turn", "shisd/shading/_quadrature.py",
        old="(totals[0] + (1 - t) * value, totals[1] + t * value)",
        new="(totals[0] + value / 2, totals[1] + value / 2)",
        test="tests/shading/test_quadrature.py::test_derivatives_in_everything",
    ),
    Mutant(
        "points for windows are not looked for beside maps", "shisd/shading/_material.py",
        old="isinstance(self.lamps, Quadrature) else self.local", new="isinstance(self.lamps, Quadrature) else None",
        test="tests/shading/test_quadrature.py::test_windows_take_it_beside_maps_for_lamps",
    ),
    Mutant(
        "patches are flat", "shisd/shading/_quadrature.py",
        old="d - a, (a - b) - (d - c))", new="d - a, 0 * a)",
        test=POINTS + "test_radiance_of_the_model[six corners]",
    ),
    Mutant(
        "fans leave out their last corner", "shisd/shading/_quadrature.py",
        old="np.minimum(first + 2, slots - 1)", new="first + 1",
        test=POINTS + "test_radiance_of_the_model[six corners]",
    ),
    Mutant(
        "arcs that sweep half of their solid angle", "shisd/domains/_polygon.py",
        old="return 2 * cross(v, jnp.where(", new="return cross(v, jnp.where(",
        test="tests/domains/test_polygon.py",
    ),
    Mutant(
        "what is looked up beyond maps stays as views rise", "shisd/shading/_transformed_integrals.py",
        old="change += _of_rows(lobes_rise", new="change += 0 * _of_rows(lobes_rise",
        test="tests/shading/test_transformed.py",
    ),
    Mutant(
        "maps that stay as views rise", "shisd/shading/_transformed_integrals.py",
        old="ds += s_rises * d_theta[None]", new="ds += 0 * s_rises * d_theta[None]",
        test="tests/shading/test_transformed.py",
    ),
    Mutant(
        "a lobe between points is none", "shisd/planning/_paths.py",
        old="np.max(found)) & ~missed)", new="np.max(found)))",
        test="tests/test_planning.py::test_points_are_chosen_where_they_are_cheapest",
    ),
    Mutant(
        "loops of one point stay one", "shisd/domains/moments/_fold.py",
        old="np.broadcast_shapes(weights.shape[-1:], points.shape[-1:])", new="points.shape[-1:]",
        test="tests/test_lanes.py::test_a_batch_of_one_array_of_one_point[fold]",
    ),
    Mutant(
        "balls are polygons within them", "shisd/shading/paths/_sphere.py",
        old="versed = jnp.sin(part * t) / (math.sin(part) * jnp.cos(part * (1 - t)))", new="versed = t",
        test=POINTS + "test_balls_are_polygons_of_their_solid_angle",
    ),
    Mutant(
        "a light's plane from absolute coordinates", OUTLINE,
        old="edges = light.points - light.points[:1]", new="edges = light.points",
        test=POLYGON + "test_far_from_the_origin[4e+06]",
    ),
    Mutant(
        "lights are seen from behind", OUTLINE,
        old="jnp.minimum(side, 0)", new="jnp.maximum(side, 0)", test=POLYGON + "test_several_lights",
    ),
    Mutant(
        "only the first light of a kind", "shisd/shading/_tiles.py",
        old="if len(jax.tree.leaves(stack)[0]) == 1:", new="if len(jax.tree.leaves(stack)[0]) >= 1:",
        test=POLYGON + "test_several_lights",
    ),
    Mutant(
        "no gradient through a portal's light", "shisd/shading/paths/_polygon.py",
        old="else product_matrices(incident,", new="else product_matrices(jax.lax.stop_gradient(incident),",
        test=POLYGON + "test_a_portal_is_the_light_behind_it",
    ),
    Mutant(
        "projected lights have no emission", "shisd/shading/_project_light.py",
        old="(incident * Y_00)[..., None]", new="jnp.ones_like(incident)[..., None]",
        test=POLYGON + "test_projected_light",
    ),
    Mutant(
        "NaN is dark", "shisd/shading/_tiles.py",
        old="jnp.where(jnp.isfinite(mark), 0, jnp.nan) * mark", new="jnp.zeros_like(mark)",
        test=SURFACE + "test_nan_stays_nan[polygon]",
    ),
    Mutant(
        "masked points are shaded first", "shisd/shading/_tiles.py",
        old="jnp.where(mask, a, jax.lax.stop_gradient(other[name])[None])", new="a",
        test=SURFACE + "test_masks[environment]",
    ),
    Mutant(
        "a view on the horizon sees", "shisd/shading/_tiles.py",
        old="seen = (local[:, 2] > 0)", new="seen = (local[:, 2] >= 0)",
        test=SURFACE + "test_a_view_on_the_horizon_sees_nothing[environment]",
    ),
    Mutant(
        "rounding noise is a tangent", "shisd/shading/_frames.py",
        old="_PARALLEL = 100 ", new="_PARALLEL = 0.01 ", test=SURFACE + "test_a_tangent_along_the_normal_is_no_frame",
    ),
    Mutant(
        "every number of points is a size", "shisd/shading/_tiles.py",
        old="else octave // 16", new="else 1", test=SURFACE + "test_a_new_number_of_points_compiles_nothing_heavy",
    ),
    Mutant(
        "light turned the wrong way", "shisd/shading/paths/_distant.py",
        old="to_local = jnp.swapaxes(frame, 1, 2)", new="to_local = frame",
        test="tests/shading/test_environment.py::test_radiance_is_equation_22[diffuse-float32]",
    ),
    Mutant(
        "norms of zonal light", "shisd/shading/paths/_zonal.py",
        old="z = (z / jnp.broadcast_to(", new="z = (z * jnp.broadcast_to(",
        test="tests/shading/test_zonal.py::test_eq_24",
    ),
    Mutant(
        "near balls are as far ones", "shisd/models/lights/_sphere.py",
        old="sine2 / (1 + jnp.sqrt(1 - sine2))", new="sine2 / 2",
        test="tests/shading/test_sphere.py::test_zonal_coefficients_are_integrals_over_the_cap[float32]",
    ),
    Mutant(
        "round footprints too wide", "shisd/shading/_mirror.py",
        old="jnp.exp(-half * variance[None])", new="jnp.exp(-1.1 * half * variance[None])",
        test=MIRROR + "test_filters_against_quadrature[float32-False]",
    ),
    Mutant(
        "footprints do not lie askew", "shisd/shading/_mirror.py",
        old="2 * cos * sin @ xy[None]", new="cos * sin @ xy[None]",
        test=MIRROR + "test_filters_against_quadrature[float32-True]",
    ),
    Mutant(
        "footprints do not see the view change", "shisd/shading/_footprint.py",
        old="dx = distance[..., None] * (d_ray - ray[..., None] * slope)", new="dx = distance[..., None] * d_ray",
        test=MIRROR + "test_footprints_from_images_are_derivatives_of_the_mirror_direction[sphere-float64]",
    ),
    Mutant(
        "which hemisphere a close lamp is, by rounding", "shisd/shading/_project_light.py",
        old="angle = loop_solid_angle(v, 2 * np.pi, towards(light, relative))",
        new="angle = loop_solid_angle(v, 2 * np.pi)",
        test="tests/shading/test_polygon.py::test_projected_light_close_to_a_lamp",
    ),
    Mutant(
        "lights of two sides have one", OUTLINE,
        old="return side if light.two_sided else jnp.minimum(side, 0)", new="return jnp.minimum(side, 0)",
        test=SIDES + "[float32-two-sided-square]",
    ),
    Mutant(
        "the other side of a light takes light away", OUTLINE,
        old="return side if light.two_sided", new="return -jnp.abs(side) if light.two_sided",
        test=LIGHTS + "test_a_white_surface_is_lit_exactly_where_the_outline_is_above_its_horizon[two-sided]",
    ),
    Mutant(
        "outlines run the way that they do seen from outside", OUTLINE,
        old="jnp.where(side < 0, points[::-1],", new="jnp.where(side < 0, points,",
        test=SIDES + "[float32-one-sided-square]",
    ),
    Mutant(
        "outlines from the other side run the wrong way", OUTLINE,
        old="jnp.where(side > 0, points, dark)", new="jnp.where(side > 0, points[::-1], dark)",
        test=SIDES + "[float32-two-sided-square]",
    ),
    Mutant(
        "outlines are seen from dark sides", OUTLINE,
        old="jnp.where(side > 0, points, dark)", new="points", test=SIDES + "[float32-portal-square]",
    ),
    Mutant(
        "only the first kind of light", "shisd/shading/_shade.py",
        old="return sum_parts(parts)", new="return sum_parts(parts[:1])", test=MIXED,
    ),
    Mutant(
        "only the first distant light", "shisd/shading/paths/_distant.py",
        old="size, colour) for light in lights))", new="size, colour) for light in lights[:1]))", test=MIXED,
    ),
    Mutant(
        "only the first light that is hidden in part", "shisd/shading/paths/_occluded.py",
        old="colour(light)) for light in lights)", new="colour(light)) for light in lights[:1])", test=MIXED,
    ),
    Mutant(
        "distant lights up to the lowest of their degrees", "shisd/shading/paths/_distant.py",
        old="min(degree, max(light.degree", new="min(degree, min(light.degree", test=MIXED,
    ),
    Mutant(
        "distant lights of few bands put among high ones", "shisd/shading/_tiles.py",
        old="(0, size - c.shape[-1])]", new="(size - c.shape[-1], 0)]", test=MIXED,
    ),
    Mutant(
        "norms of zonal light as distant light", DISTANT,
        old="jnp.asarray(1 / zonal_norms(self.degree),", new="jnp.asarray(zonal_norms(self.degree),",
        test=LIGHTS + "test_a_zonal_light_is_a_sum_of_legendre_polynomials[float32-colour0]",
    ),
    Mutant(
        "distant light turned back", DISTANT,
        old="rotate(self.coefficients, rotation)", new="rotate(self.coefficients, jnp.asarray(rotation).T)",
        test=LIGHTS + "test_a_turned_light_comes_from_turned_directions[float32-colour0]",
    ),
    Mutant(
        "surfaces without their mask", "shisd/shading/_surface.py",
        old="for name in names} | masks(self.mask)", new="for name in names}", test=SURFACE + "test_masks[environment]",
    ),
    Mutant(
        "slices that are cut keep their bands", SLICES,
        old='self._with(self.coefficients[..., : (degree + 1) ** 2], "sphere")',
        new='self._with(self.coefficients, "sphere")',
        test=SHADE + "test_a_prepared_material_has_the_slices_of_tabulate_brdf[isotropic]",
    ),
    Mutant(
        "slices for local light of the wrong degree", "shisd/shading/_material.py",
        old="slices.cut(local_degree).above_horizon()", new="slices.cut(degree).above_horizon()",
        test=SHADE + "test_a_prepared_material_has_the_slices_of_tabulate_brdf[isotropic]",
    ),
    Mutant(
        "slices above the horizon are not fitted", SLICES,
        old='self._with(fit_above(self.coefficients, ridge), "upper")', new='self._with(self.coefficients, "upper")',
        test="tests/shading/test_tables.py::test_above_the_horizon_a_cosine_is_of_degree_one",
    ),
]  # fmt: skip
