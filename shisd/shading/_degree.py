"""The degree that a material needs, from the energies of its bands."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from shisd._typing import Array, Float
from shisd.harmonics.internal import bands, of_order
from shisd.shading import _views
from shisd.shading._matrix import BrdfMatrix
from shisd.shading.slices._slices import Slices
from shisd.shading.slices._upper import RIDGE, hemisphere_blocks


def band_energies(material: Slices | BrdfMatrix) -> Float[Array, "*colour_views l"]:
    """Energies of the bands of a material's slices, the squared norm that each adds to the lower ones.

    Returns [*colour, V, L+1] for isotropic materials, [*colour, V, A, L+1] for anisotropic ones, in 1/sr: for the views
    of the slices, or of a matrix's `slices()`. Where they were fitted above the horizon, norms are those above it, of
    the best fit of each degree there.
    Derivatives: in the material.
    """
    _check_material(material)
    slices, degree = material if isinstance(material, Slices) else material.slices(), material.degree
    c = slices.coefficients
    if material.domain == "upper":
        c = c @ jnp.asarray(_successive(degree), c.dtype)
    member = bands(degree)[:, None] == np.arange(degree + 1)
    return jnp.square(c) @ jnp.asarray(member, c.dtype)


def material_degree(material: Slices | BrdfMatrix, tolerance: float, *, worst: bool = False) -> int:
    """The smallest degree whose slices differ from those given by at most `tolerance`, relative to their RMS.

    Arguments: `material`; static `tolerance`; the RMS is over the views of a sphere's picture, by colour, of which the
    worst counts; `worst=True` takes the worst view instead. The light is not asked: `planning` does that, and needs
    less where the light is smooth.
    The choice is made from values, not under jit. Slices end at the degree of the material, and what is beyond cannot
    be seen: where its last two bands are needed for the tolerance (odd ones vanish for a Lambertian), that is an error.
    """
    _check_material(material)
    if not tolerance > 0:
        raise ValueError(f"`tolerance` must be > 0; got {tolerance}.")
    try:
        energy = np.asarray(band_energies(material), float)
    except jax.errors.TracerArrayConversionError as error:
        raise ValueError("the degree is chosen from values: call material_degree outside jit and grad.") from error
    if not np.all(np.isfinite(energy)):
        raise ValueError("`material` must be finite; its slices hold NaN or infinity.")
    energy = energy.reshape(-1, *energy.shape[len(material.colour) :])  # [colour, V, (A,) l]
    if not worst:
        share = np.sin(2 * _views.elevations(energy.shape[1]))
        energy = np.einsum("v,cv...l->cl", share, energy)
    above = np.cumsum(energy[..., ::-1], axis=-1)[..., ::-1]  # of bands l and higher
    needed = np.any(above > tolerance**2 * above[..., :1], axis=tuple(range(above.ndim - 1)))
    found = int(np.count_nonzero(needed)) - 1
    if found > max(material.degree - 2, 0):
        raise ValueError(
            f"`material` of degree {material.degree} needs its last bands for `tolerance` {tolerance}, and may need "
            "more: pass one of a higher degree."
        )
    return max(found, 0)


def _check_material(material: object) -> None:
    if not isinstance(material, Slices | BrdfMatrix):
        name = type(material).__name__
        raise ValueError(f"`material` must come from shading.tabulate_brdf or shading.project_brdf; got {name}.")


@functools.cache
def _successive(degree: int) -> np.ndarray:
    """Transposed, from coefficients to those by functions orthonormal above the horizon, made of y_l^m by rising l."""
    table, blocks = np.zeros(((degree + 1) ** 2,) * 2), hemisphere_blocks(degree)
    for m in range(-degree, degree + 1):
        index = of_order(degree, m)
        table[np.ix_(index, index)] = np.linalg.cholesky(blocks[abs(m)] + RIDGE * np.eye(len(index)))
    return table
