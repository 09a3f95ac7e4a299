"""Mutants of the harmonics and of maps: what the tests named have to catch."""

from tests.mutants import Mutant

_SH, _TRANSFORM, _ROTATION = (f"shisd/harmonics/_{name}.py" for name in ("sh", "transform", "rotation"))
_ENVIRONMENT, _REFERENCE = "shisd/models/_environment.py", "shisd/reference/_monte_carlo.py"
_OF_SH, _OF_TRANSFORM, _OF_ROTATION = (f"tests/harmonics/test_{name}.py" for name in ("sh", "transform", "rotation"))
_OF_ENVIRONMENT = "tests/models/test_environment.py"

MUTANTS = [
    Mutant(
        "projection too large by 0.2 %",
        _TRANSFORM,
        old="        table *= 2 * np.pi / columns\n",
        new="        table *= 1.002 * 2 * np.pi / columns\n",
        test=f"{_OF_ENVIRONMENT}::test_coefficients_of_a_linear_function",
    ),
    Mutant(
        "cells weighted by their middles",
        _TRANSFORM,
        old="np.pi / rows * np.sinc(n / (2 * rows)) / 2",
        new="np.pi / rows * np.ones(n.shape) / 2",
        test=f"{_OF_TRANSFORM}::test_every_texel_keeps_its_power",
    ),
    Mutant(
        "cells without width in azimuth",
        _TRANSFORM,
        old="(np.sinc(m / columns) if cells else 1)",
        new="1",
        test=f"{_OF_TRANSFORM}::test_cells_are_integrated_exactly_in_every_band",
    ),
    Mutant(
        "samples weighted by the rule of cells",
        _TRANSFORM,
        old='"cells" if texels == "cells" else "fejer"',
        new='"cells"',
        test=f"{_OF_TRANSFORM}::test_projection_of_samples_of_a_band_limited_map_is_exact",
    ),
    Mutant(
        "synthesis with the rows of the south as they are",
        _TRANSFORM,
        old="(even - odd)[:, : rows // 2][:, ::-1]",
        new="(even + odd)[:, : rows // 2][:, ::-1]",
        test=f"{_OF_TRANSFORM}::test_synthesis_is_the_expansion_at_the_texel_centres",
    ),
    Mutant(
        "lookup half a texel off",
        _TRANSFORM,
        old="_split(phi * (width / (2 * np.pi)))\n",
        new="_split(phi * (width / (2 * np.pi)) + 0.5)\n",
        test=f"{_OF_TRANSFORM}::test_lookup_of_cells_is_the_texel_there",
    ),
    Mutant(
        "a direction that is not a number has a texel",
        _TRANSFORM,
        old=" + 0 * (u + v)[..., None]  # NaN of NaN",
        new="",
        test=f"{_OF_TRANSFORM}::test_lookup_along_no_direction_is_not_a_number",
    ),
    Mutant(
        "project takes the first rule",
        _TRANSFORM,
        old="        if not change > tolerance:  # also where it is NaN\n            return fine\n",
        new="        return coarse\n",
        test=f"{_OF_TRANSFORM}::test_what_does_not_converge_is_refused_with_its_numbers",
    ),
    Mutant(
        "basis with the phase of odd orders turned",
        "shisd/harmonics/_tables.py",
        old="    s = -np.sqrt((2 * l[:, 0] + 1) / np.maximum(2 * l[:, 0], 1))\n",
        new="    s = np.sqrt((2 * l[:, 0] + 1) / np.maximum(2 * l[:, 0], 1))\n",
        test=f"{_OF_SH}::test_the_first_band_states_the_convention",
    ),
    Mutant(
        "gradient of the basis left out",
        _SH,
        old="        dy += (rate[:, None] @ ones) * slope\n",
        new="        dy += 0 * (rate[:, None] @ ones) * slope\n",
        test=f"{_OF_SH}::test_gradients_against_those_of_the_recurrence",
    ),
    Mutant(
        "gradient of expansions in directions reversed",
        _SH,
        old="        dvalues += jnp.sum(slopes * du.T[:, None, :], axis=0)\n",
        new="        dvalues -= jnp.sum(slopes * du.T[:, None, :], axis=0)\n",
        test=f"{_OF_SH}::test_gradients_against_those_of_the_recurrence",
    ),
    Mutant(
        "Horner's rule with the sine terms added",
        _SH,
        old="x * sin_phi + y * cos_phi - wave[:, 1]",
        new="x * sin_phi + y * cos_phi + wave[:, 1]",
        test=f"{_OF_SH}::test_expansions_against_the_basis",
    ),
    Mutant(
        "rotation that does nothing",
        _ROTATION,
        old="    return rotate_many(flat, r[None], degree)[..., 0].T.reshape(c.shape)\n",
        new="    return c\n",
        test=f"{_OF_ROTATION}::test_rotated_function",
    ),
    Mutant(
        "matrices a little off are taken as they are",
        _ROTATION,
        old="        r = 1.5 * r - 0.5 * r @ (r.T @ r)\n",
        new="        r = r + 0\n",
        test=f"{_OF_ROTATION}::test_matrices_a_little_off_are_taken_as_the_nearest_rotation",
    ),
    Mutant(
        "rotation by the inverse",
        _ROTATION,
        old="    return rotate_many(flat, r[None], degree)[..., 0].T.reshape(c.shape)\n",
        new="    return rotate_many(flat, r.T[None], degree)[..., 0].T.reshape(c.shape)\n",
        test=f"{_OF_ROTATION}::test_rotated_function",
    ),
    Mutant(
        "products on a grid that is too coarse",
        "shisd/harmonics/_products.py",
        old="    rows, columns = _grid(top + kept)\n",
        new="    rows, columns = _grid(top)\n",
        test="tests/harmonics/test_products.py::test_product_is_exact",
    ),
    Mutant(
        "matrix of a product without the norm of its rows",
        "shisd/harmonics/_products.py",
        old="    areas = weights * (2 * np.pi / columns)\n",
        new="    areas = weights * (2 * np.pi / (columns + 1))\n",
        test="tests/harmonics/test_products.py::test_matrix_is_symmetric_and_multiplies",
    ),
    Mutant(
        "the window of Hann as a cosine",
        "shisd/harmonics/_windows.py",
        old="(1 + jnp.cos(jnp.pi * ratio)) / 2",
        new="jnp.cos(jnp.pi * ratio / 2)",
        test="tests/harmonics/test_windows.py::test_window_values",
    ),
    Mutant(
        "windows of any width",
        "shisd/harmonics/_windows.py",
        old='_checks.require(w, w > 0, "`width` must be > 0.")',
        new="w",
        test="tests/harmonics/test_windows.py::test_widths_and_strengths_that_are_none_are_refused",
    ),
    Mutant(
        "deringing that stops early",
        "shisd/harmonics/_windows.py",
        old="    strength = jnp.where(active, jnp.exp(root), 0)\n",
        new="    strength = jnp.where(active, 0.99 * jnp.exp(root), 0)\n",
        test="tests/harmonics/test_windows.py::test_dering_takes_each_expansion_by_itself",
    ),
    Mutant(
        "maps of other programs mirrored",
        _ENVIRONMENT,
        old="np.roll(texels[:, ::-1], round(turn * width), axis=1)",
        new="np.roll(texels, round(turn * width), axis=1)",
        test=f"{_OF_ENVIRONMENT}::test_maps_are_turned_as_their_program_shows_them",
    ),
    Mutant(
        "an infinite sun as bright as the sky",
        _ENVIRONMENT,
        old="    largest = max(float(np.max(texels, where=finite, initial=0)), 65504)\n",
        new="    largest = float(np.max(texels, where=finite, initial=0))\n",
        test=f"{_OF_ENVIRONMENT}::test_an_infinite_sun_is_not_made_dimmer_than_what_is_finite",
    ),
    Mutant(
        "radiance between texels",
        _ENVIRONMENT,
        old="harmonics.sample_map(self.texels, directions, texels=texels)",
        new='harmonics.sample_map(self.texels, directions, texels="samples")',
        test=f"{_OF_ENVIRONMENT}::test_power_of_a_texel_is_the_same_everywhere",
    ),
    Mutant(
        "the reference samples the upper half of each texel",
        _REFERENCE,
        old="step * (row.astype(u.dtype) + down)",
        new="step * (row.astype(u.dtype) + 0.5 * down)",
        test="tests/test_reference.py::test_power_of_single_texels",
    ),
]
