"""What the harmonics are used for beyond lit surfaces: each application with its error and its cost, beside others."""

from tests.bench import balls, brdf_matrix, denoise, mirror, visibility


def tables(quick: bool) -> dict[str, list[dict]]:
    """Titles and rows of the tables."""
    found = {}
    for module in (visibility, balls, mirror, denoise, brdf_matrix):
        found |= module.tables(quick)
    return found
