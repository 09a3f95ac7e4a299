"""What the harmonics are used for beyond lit surfaces: each application with its error and its cost, beside others."""

import time

from tests.bench import balls, brdf_matrix, denoise, mirror, visibility

NOTE = (
    "Error: RMSE over the RMS of the reference (rays, Gauss points, 16 x 16 samples, the slice of each view); for "
    "measurements, RMSE over that of the noisy table. Degree 16 for shadows, 8 for BRDF matrices."
)


def tables(quick: bool) -> dict[str, list[dict]]:
    """Titles and rows of the tables."""
    found, start = {}, time.perf_counter()
    for module in (visibility, balls, mirror, denoise, brdf_matrix):
        found |= module.tables(quick)
        print(f"{module.__name__}: {time.perf_counter() - start:.0f} s", flush=True)
    return found


def summary(found: dict[str, list[dict]]) -> list[dict]:
    """The rows that say most, in the same columns for all applications."""
    lines = []

    def add(application: str, case: str, method: str, error: float, cost: float, unit: str) -> None:
        lines.append(
            {"application": application, "case": case, "method": method, "error": error, "cost": f"{cost:.2g} {unit}"}
        )

    for title, rows in found.items():
        for r in rows:
            method = r.get("method", "")
            if title.startswith("A rabbit") and r["material"] == "GGX 0.4" and not method.endswith(("degree 2", "12")):
                add("shadows", f"rabbit, {r['map']}", method, r["error"], r["us/pixel"], "us/pixel")
            if title.startswith("Balls") and r["material"] == "GGX 0.25":
                add("balls of light", r["light"], method, r["error"], r["us/point"], "us/point")
            if title.startswith("Mirror") and method in ("2 x 2 samples", "round, degree 100, Hann", "filtered maps"):
                cost = r["with the footprint"]
                add("mirrors", title.removeprefix("Mirror: "), method, r["relative RMSE"], cost, "us/pixel")
            if title.startswith("Denoised") and method == "denoise_merl":
                add("measurements", r["material"], method, r["RMSE out"] / r["RMSE in"], r["s"], "s/table")
            if title.startswith("Tables over") and r.get("us/pixel") and r["degree"] == 8:
                if r["representation"] in ("table, 64 views", "matrix, view degree 16"):
                    method = f"{r['representation']}, {r['numbers stored']} numbers"
                    add("BRDF matrices", r["material"], method, r["error, view's side"], r["us/pixel"], "us/pixel")
    return lines
