"""Mutants of the visibility of meshes, figures, progress and printed names: what the tests named have to catch."""

from tests.mutants import Mutant

MODEL, PATH, PLOTS = "shisd/models/_visibility.py", "shisd/shading/paths/_occluded.py", "shisd/plotting.py"
TEST, DRAWN = "tests/shading/test_visibility.py::", "tests/test_plotting.py::"
MUTANTS = [
    Mutant(
        "rays hit nothing",
        MODEL,
        old="hidden = jnp.where(even[:, None], hidden.T, 0)",
        new="hidden = jnp.where(even[:, None], 0 * hidden.T, 0)",
        test=TEST + "test_rays_find_a_wall_with_the_noise_that_they_state",
    ),
    Mutant(
        "what is below the horizon is left out, not mirrored",
        MODEL,
        old="(4 * np.pi / len(local))",
        new="(2 * np.pi / len(local))",
        test=TEST + "test_closed_meshes_hide_their_inside_and_an_outer_one_the_inner",
    ),
    Mutant(
        "rays start at a share of the scene",
        MODEL,
        old="start = start + offset * (",
        new="start = start + 1e-4 + offset * (",
        test=TEST + "test_details_of_a_wide_scene_are_seen[1000000.0]",
    ),
    Mutant(
        "rays start on the surface",
        MODEL,
        old="start = start + offset * (",
        new="start = start + 0 * offset * (",
        test=TEST + "test_neither_place_nor_unit_matters[0.0-1.0]",
    ),
    Mutant(
        "the mesh is not centred",
        MODEL,
        old="middle = np.median(corner, axis=0)",
        new="middle = 0 * np.median(corner, axis=0)",
        test=TEST + "test_neither_place_nor_unit_matters[10000000.0-1.0]",
    ),
    Mutant(
        "points stay in the unit of the caller",
        MODEL,
        old='(_points("points", points) - middle) / size',
        new='(_points("points", points) - middle)',
        test=TEST + "test_points_need_not_be_on_the_mesh",
    ),
    Mutant(
        "one noise for all vertices",
        MODEL,
        old="noise = np.sqrt(np.sum((halves[0] - halves[1]) ** 2, axis=1) / (4 * np.pi)) / 2",
        new="noise = np.sqrt(np.mean(np.sum((halves[0] - halves[1]) ** 2, axis=1)) / (4 * np.pi)) / 2",
        test=TEST + "test_rays_find_a_wall_with_the_noise_that_they_state",
    ),
    Mutant(
        "noise of one half",
        MODEL,
        old="/ (4 * np.pi)) / 2",
        new="/ (4 * np.pi))",
        test=TEST + "test_rays_find_a_wall_with_the_noise_that_they_state",
    ),
    Mutant(
        "normals that cancel to rounding are taken",
        MODEL,
        old="> 1e-9 * areas",
        new="> 0 * areas",
        test=TEST + "test_open_meshes_triangles_without_area_and_triangles_given_twice",
    ),
    Mutant(
        "triangles that do not exist are others",
        MODEL,
        old="jnp.where(there, w, np.nan)",
        new="jnp.where(there | ~there, w, np.nan)",
        test=TEST + "test_triangles_that_do_not_exist_are_errors_or_nan",
    ),
    Mutant(
        "occlusion left out in shading",
        PATH,
        old='seen = at["visibility"] if v is None',
        new='seen = jnp.zeros_like(at["visibility"]).at[:, 0].set(np.sqrt(4 * np.pi)) if v is None',
        test=TEST + "test_nothing_hidden_is_the_environment_and_everything_is_dark",
    ),
    Mutant(
        "shading takes the first corner only",
        PATH,
        old='jnp.einsum("pc,pcn->pn", at["barycentric"], v[at["corners"]])',
        new='v[at["corners"][:, 0]]',
        test=TEST + "test_it_is_the_integral_of_the_three_expansions",
    ),
    Mutant(
        "signs of surfaces exchanged",
        PLOTS,
        old="np.where(values[..., None] < 0,",
        new="np.where(values[..., None] > 0,",
        test=DRAWN + "test_a_function_is_a_surface_of_its_size_in_the_colour_of_its_sign",
    ),
    Mutant(
        "maps upside down",
        PLOTS,
        old="extent=(0, 360, 180, 0)",
        new="extent=(0, 360, 0, 180)",
        test=DRAWN + "test_maps_are_shown_as_stored_with_their_angles",
    ),
    Mutant(
        "errors along a linear scale",
        PLOTS,
        old="(np.log(np.maximum(size, low)) - math.log(low)) / (math.log(high) - math.log(low))",
        new="(np.maximum(size, low) - low) / (high - low)",
        test=DRAWN + "test_colours_of_errors_run_along_the_logarithm_between_the_limits",
    ),
    Mutant(
        "progress forgets what was done",
        "shisd/_progress.py",
        old="done += count",
        new="done = count",
        test="tests/test_progress.py::test_functions_are_told_every_step_up_to_the_last",
    ),
    Mutant(
        "axes are kept where their loss is lower",
        "shisd/decomposition/_directions.py",
        old="jnp.where(after < before, found, free)",
        new="jnp.where(after < before, free, found)",
        test="tests/decomposition/test_directions.py::test_optimizer_improves_a_random_start_and_is_deterministic",
    ),
]
