"""Slices beyond maps of directions, by view: what sharp materials are under lights that are cut off at the horizon.

For every view a linear map widens the lobe before it is expanded (`decomposition._transformed`), fitted above the
horizon. A map is an expansion of degree 2 (`decomposition._stretch`), so maps are interpolated over views as slices
are, and turn with them. They are searched at few elevations, from the horizon to the normal, each from the one before;
at the nodes of the table they are interpolated, and the expansions beyond them are the best there are.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._methods import method
from shisd._numerics import normalize
from shisd._typing import Array, ArrayLike, Float, Scalar
from shisd.decomposition import TransformedExpansion
from shisd.decomposition.internal import Setting, moments_starts, project_beyond, search, stretch
from shisd.models import AbstractBrdf
from shisd.shading import _views
from shisd.shading.slices._slices import Slices, Tabulated, lookup_table, slice_values
from shisd.shading.slices._tabulate import slice_nodes, view_grid

BASE = 2  # degree of the plain harmonics under lobes


class TransformedSlices(Tabulated):
    """Cosine-weighted slices as expansions of low degree beyond maps of directions, above the horizon, by view.

    Arguments: `maps` [V, 5], `coefficients` [*colour, V, (L+1)^2] beyond them and `base` [*colour, V, 9] of plain
    harmonics, or [V, A, 5], [*colour, V, A, (L+1)^2] and [*colour, V, A, 9] of anisotropic materials (static
    `isotropic` False). A map is the band of degree 2 of the logarithm of its metric A^T A. Views are those of `Slices`
    after z is multiplied by 1/3, so that they stand close near the horizon. `errors` [*colour, V] or [*colour, V, A]:
    of each fit, RMS above the horizon, relative to the brightest colour.
    """

    maps: Float[Array, "*views 5"]
    coefficients: Float[Array, "*colour_views n"]
    base: Float[Array, "*colour_views 9"]
    errors: Float[Array, "*colour_views"]
    isotropic: bool = eqx.field(static=True)

    def __init__(
        self,
        maps: ArrayLike,
        coefficients: ArrayLike,
        base: ArrayLike,
        errors: ArrayLike = 0.0,
        *,
        isotropic: bool = True,
    ):
        c, b = (_checks.coefficients(n, x)[0] for n, x in (("coefficients", coefficients), ("base", base)))
        m, views = _checks.real_array("maps", maps), 1 if isotropic else 2
        if m.ndim != views + 1 or m.shape[-1] != 5 or c.ndim not in (views + 1, views + 2):
            form = "V" if isotropic else "V, A"
            raise ValueError(
                f"`maps` must have shape [{form}, 5] and `coefficients` [*colour, {form}, n]; got {list(m.shape)} and "
                f"{list(c.shape)}."
            )
        if c.shape[-views - 1 : -1] != m.shape[:-1]:
            raise ValueError(f"`maps` {list(m.shape)} and `coefficients` {list(c.shape)} are of other views.")
        if b.shape != (*c.shape[:-1], (BASE + 1) ** 2):
            raise ValueError(f"`base` must have shape {[*c.shape[:-1], (BASE + 1) ** 2]}; got {list(b.shape)}.")
        self.maps, self.coefficients, self.base = m.astype(c.dtype), c, b.astype(c.dtype)
        self.isotropic = bool(isotropic)
        self.errors = jnp.broadcast_to(jnp.asarray(errors, c.dtype), c.shape[:-1])

    @method
    def at(self, view: ArrayLike) -> TransformedExpansion:
        """The slice seen from the local direction `view` [3], interpolated, in the local frame.

        Derivatives: in the view and all fields, also at the normal.
        """
        view = _checks.vectors("view", view).astype(self.coefficients.dtype)
        view = dense_views(view[None])
        look_up = lambda slices: slice_values(lookup_table(slices), view, slices)[..., 0]
        maps, expansions, base = parts_of(self)
        return TransformedExpansion(stretch(look_up(maps)[-5:]), look_up(expansions), look_up(base))


def parts_of(slices: TransformedSlices) -> tuple[Slices, Slices, Slices]:
    """Maps, expansions beyond them, and bases, as slices to look up."""
    made = lambda c: Slices(c, isotropic=slices.isotropic, domain="upper")
    return as_slices(slices.maps, slices.isotropic), made(slices.coefficients), made(slices.base)


def dense_views(views: Float[Array, "p 3"]) -> Float[Array, "p 3"]:
    """Where the tables are looked up: views that stand three times as close at the horizon, where lobes change most."""
    return normalize(views * jnp.asarray([1, 1, _DENSER], views.dtype)[None])


def as_slices(maps: Float[Array, "*views 5"], isotropic: bool) -> Slices:
    """Maps as expansions of degree 2, which have one band."""
    lower = jnp.zeros((*maps.shape[:-1], 4), maps.dtype)
    return Slices(jnp.concatenate([lower, maps], axis=-1), isotropic=isotropic)


def transform_brdf(
    brdf: AbstractBrdf,
    degree: int,
    *,
    elevations: int = 64,
    azimuths: int | None = None,
    quadrature: int = 32,
    ridge: float = 1e-5,
) -> TransformedSlices:
    """A material's cosine-weighted slices above the horizon, each beyond the map that makes it smoothest.

    For polygons that shine alike in all directions: `shade` takes the result as it is, or with the other slices of a
    material as `Material(distant, local, lamps)`, which `prepare(..., lamp_degree=)` makes.
    Arguments: `brdf`. Static: `degree`, of which 4 or 8 are enough for any sharpness; `elevations`, at least 4, and
    `azimuths`, for anisotropic materials only, by default 2 degree + 4 and at least 16; `quadrature`, nodes from the
    mirror direction to the horizon. `ridge` limits coefficients that nothing above the horizon shows; it grows towards
    grazing views. The result has the dtype of the material's parameters; `errors` says how near each view is.
    Derivatives: in every parameter of the material, first ones, both modes; of alpha to 3e-3 (the searches end near
    their minima, not at them).
    Accuracy: between the nodes of the table, over the norm of the slice, GGX of alpha 0.02 to 0.5 in float32, at degree
    4 at most 9e-3 for views to 60 degrees, 3e-2 at 75, 7e-2 at 85 and 0.2 at 89.9; at degree 8 1.4e-3, 6e-3, 2.4e-2 and
    0.16. Plain slices of degree 16 have 4e-2, 0.2 and 0.3 for alpha 0.25.
    Cost: 2 to 5 s on two cores for isotropic materials, after 12 s of compilation; anisotropic ones some minutes.
    """
    if not isinstance(brdf, AbstractBrdf):
        raise ValueError(f"`brdf` must be a models.AbstractBrdf; got {type(brdf).__name__}.")
    degree, elevations = _checks.degree(degree), _checks.integer("elevations", elevations, 4)
    azimuths = max(16, 2 * degree + 4) if azimuths is None else _checks.integer("azimuths", azimuths, 4)
    quadrature = _checks.integer("quadrature", quadrature, 4)
    setting = Setting(degree, BASE, brdf.isotropic, 32, 1e-4)
    ridge = _checks.number("ridge", ridge, positive=True)
    return _transformed(brdf, elevations, azimuths, quadrature, ridge, setting)


_SEARCHED = 16  # elevations, or azimuths
_DENSER = 3.0
_GRAZING = 0.1


@eqx.filter_jit
def _transformed(
    brdf: AbstractBrdf, elevations: int, azimuths: int, quadrature: int, ridge: float, setting: Setting
) -> TransformedSlices:
    dtype = jnp.result_type(brdf.lobe_width)
    width = jnp.asarray(jax.lax.stop_gradient(brdf.lobe_width), dtype)

    def samples(view: Float[Array, "3"]) -> tuple[Array, Array, Array, Scalar]:
        w, areas = slice_nodes(view, width, quadrature, half=brdf.isotropic)
        values = jax.vmap(lambda wi: brdf.value_cosine(wi, view))(w)
        firm = ridge * (1 + _GRAZING / view[2] ** 2)  # half of a grazing lobe is below the horizon, and not seen
        return w, jnp.moveaxis(values, 0, -1), areas, firm

    def from_horizon(views: Float[Array, "v 3"]) -> Float[Array, "v 5"]:
        def step(before: Array, view: Array) -> tuple[Array, Array]:
            s, _ = search(before[None], *samples(view), setting)
            return s, s

        first = moments_starts(*samples(views[-1])[:3], setting.even)[1]
        return jax.lax.scan(step, first, views, reverse=True)[1]

    at = _grid(_SEARCHED, _SEARCHED, brdf.isotropic, dtype)
    searched = jax.lax.map(from_horizon, jnp.moveaxis(at, 1, 0))  # [A, V, 5]
    few = as_slices(searched[0] if brdf.isotropic else jnp.moveaxis(searched, 0, 1), brdf.isotropic)
    views = _grid(elevations, azimuths, brdf.isotropic, dtype)
    maps = slice_values(lookup_table(few), dense_views(views.reshape(-1, 3)), few)[-5:].T  # [V A, 5]
    project = jax.checkpoint(lambda x: project_beyond(x[0], *samples(x[1]), setting))
    c, base, errors = jax.lax.map(project, (maps, views.reshape(-1, 3)))
    grid = (elevations,) if brdf.isotropic else (elevations, azimuths)

    def colour_first(x: Array, last: int) -> Array:
        x = x.reshape(*grid, *x.shape[1:])
        end = x.ndim - last
        return jnp.moveaxis(x, range(len(grid)), range(end - len(grid), end))

    tables = (colour_first(c, 1), colour_first(base, 1), colour_first(errors, 0))
    return TransformedSlices(maps.reshape(*grid, 5), *tables, isotropic=brdf.isotropic)


def _grid(elevations: int, azimuths: int, isotropic: bool, dtype: jnp.dtype) -> Float[Array, "v a 3"]:
    """Local view directions at the nodes of tables."""
    views = view_grid(_views.elevations(elevations), azimuths, isotropic) / [1, 1, _DENSER]
    return jnp.asarray(views / np.linalg.norm(views, axis=-1, keepdims=True), dtype)
