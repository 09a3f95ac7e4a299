"""Materials as slices: cosine-weighted, by view, integrated over all directions of light (ISD15 Eq. 21).

The slices are integrated in polar coordinates about the mirror direction, graded to the width of the lobe, up to the
horizon exactly: a fixed number of nodes serves every roughness, and the cut of max(cos, 0) costs no accuracy.

notation: wo = view at elevation theta_o; r = its mirror direction; w = cos(psi) r + sin(psi) (cos(chi) a + sin(chi) b),
a = the unit vector at r that points up, b = horizontal; w is above the horizon for psi < psi_max(chi).
"""

import math
from collections.abc import Callable
from typing import Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from shisd import _checks
from shisd._numerics import safe_sqrt
from shisd._progress import Progress, reporting
from shisd._typing import Array, ArrayLike, DTypeLike, Float, Scalar
from shisd.decomposition import RotatedZonalBasis
from shisd.harmonics.internal import RayTables, ray_tables, ray_waves, sums_about, turned_from_axis
from shisd.models import AbstractBrdf
from shisd.shading import _views
from shisd.shading.slices._slices import Slices, check_domain
from shisd.shading.slices._upper import RIDGE, hemisphere_modes, unit_gauss

Pytree = TypeVar("Pytree")
_NODES_AT_ONCE = 2048  # of one ray for each of several views: more leave the cache
Norms = tuple[float | None, ...]  # in which errors are judged: on the sphere (None), or of fits above the horizon


def tabulate_brdf(
    brdf: AbstractBrdf,
    degree: int | RotatedZonalBasis,
    *,
    elevations: int = 64,
    azimuths: int | None = None,
    quadrature: int | None = None,
    domain: Literal["sphere", "upper"] = "sphere",
    ridge: float = RIDGE,
    tolerance: float = 1e-3,
    throw: bool = True,
    progress: Progress = None,
) -> Slices:
    """A material's cosine-weighted view slices, projected on spherical harmonics (ISD15 Eq. 21).

    Arguments: `brdf`. Static: `degree`, or a basis of that degree; `elevations` of the table's views, at least 4;
    `azimuths`, even, for anisotropic materials only, by default 2 degree + 4 and at least 32: a slice turns with the
    view, so its order m goes round m times, and fewer azimuths alias without notice; `quadrature`, nodes from the
    mirror direction to the horizon (and half as many in each eighth of a turn about it).
    `quadrature` None takes 32 + degree nodes, and 3/2 and 9/4 as many where that is not enough: where `Slices.error` is
    above `tolerance`. If no rule, or the one given, is enough, it is a ValueError; `throw=False` leaves that to the
    caller. While JAX traces, as under jit and grad, nothing can be chosen: 32 + degree nodes are taken unless
    `quadrature` says otherwise, and it is an error at run time where they are not enough. The error is estimated from
    what the last quarter of the nodes changes in the slices, a, and the quarter before, b: as 2 a min(1, a / b), of the
    worst colour, a and b RMS over the views of a sphere's picture relative to the slices.
    `domain` "upper" fits the slices above the horizon only, for integrals over lights that are cut off there
    (`PolygonLight`): the kink of the cosine is no longer expanded, and errors are up to 100 times smaller. `ridge`
    limits what the fit may do below the horizon: rounding grows like 1/sqrt(ridge), measured 1e-5 in float32 at the
    default. `progress`: None, True for a bar of tqdm, or a function of (done, total) elevations, told for every rule
    that is tried; not while JAX traces. The result has the dtype of the material's parameters.
    Derivatives: in every parameter of the material, both modes. The nodes follow `brdf.lobe_width`, through which no
    derivative passes.
    Accuracy: `error` was 0.7 to 3 times the true error (GGX of alpha 0.1 at degree 3, tables in MERL's format at degree
    16), or larger, where convergence is fast. At 32 + degree nodes the true one is, at degree 30, in float32, 2e-7 for
    GGX of alpha 0.05, 1e-6, 1e-6 and 7e-5 for dielectric CookTorrance of roughness 0.35, 0.2 and 0.1; 4e-4 or less for
    tables in MERL's format at degree 16.
    Cost: 3.9 elevations x quadrature^2 evaluations of an isotropic material, each with 4 (L+1) products. 64 elevations
    of GGX at degree 256, RGB, took 20 s of one core and 1.9 GB in float32, and as long again to compile and make tables
    the first time.
    """
    degree = degree.degree if isinstance(degree, RotatedZonalBasis) else _checks.degree(degree)
    check_domain(domain)
    ridge = _checks.number("ridge", ridge, positive=True)
    norms = (ridge,) if domain == "upper" else (None,)
    slices = table(brdf, degree, norms, elevations, azimuths, quadrature, tolerance, throw, progress)
    return slices.above_horizon(ridge=ridge) if domain == "upper" else slices


def table(
    brdf: AbstractBrdf,
    degree: int,
    norms: Norms,
    elevations: int,
    azimuths: int | None,
    quadrature: int | None,
    tolerance: float,
    throw: bool,
    progress: Progress,
) -> Slices:
    """Slices on the sphere by the first rule whose error is within the tolerance in all `norms`."""
    if not isinstance(brdf, AbstractBrdf):
        raise ValueError(f"`brdf` must be a models.AbstractBrdf; got {type(brdf).__name__}.")
    elevations = _checks.integer("elevations", elevations, 4)
    azimuths = max(32, 2 * degree + 4) if azimuths is None else _checks.integer("azimuths", azimuths, 4)
    if azimuths % 2:
        raise ValueError(f"`azimuths` must be even; got {azimuths}.")
    tolerance = _checks.number("tolerance", tolerance, positive=True)
    theta, dtype = _views.elevations(elevations), jnp.result_type(brdf.lobe_width)
    made = lambda nodes: slices_at(theta, brdf, degree, dtype, azimuths, nodes, norms, progress)
    c, error = by_convergence(made, 32 + degree, quadrature, tolerance, throw)
    return Slices(c, error=error, isotropic=brdf.isotropic)


def by_convergence(
    made: Callable[[int], tuple[Pytree, Scalar]], first: int, quadrature: int | None, tolerance: float, throw: bool
) -> tuple[Pytree, Scalar]:
    """What `made` of a number of nodes gives, and its error: of the first rule that meets the tolerance.

    While JAX traces, of the first rule, with an error at run time where it does not.
    """
    rules = (first, 3 * first // 2, 9 * first // 4)
    if quadrature is not None:
        rules = (_checks.integer("quadrature", quadrature, 4),)
    nodes, *finer = rules
    while True:
        values, error = made(nodes)
        if isinstance(error, Tracer):
            return (_resolved(values, error, nodes, tolerance) if throw else values), error
        found = float(error)
        if found <= tolerance or not math.isfinite(found) or not finer:
            break
        nodes = finer.pop(0)
    if throw and not math.isfinite(found):
        raise ValueError("`brdf` must be finite; its slices hold NaN or infinity. Look at its parameters.")
    if throw and found > tolerance:
        raise ValueError(
            f"The quadrature does not resolve this material: by `quadrature` {nodes} its estimated error is "
            f"{found:.2g}, above `tolerance` {tolerance:.2g}. Pass `quadrature={3 * nodes // 2}`, a larger "
            "tolerance, or throw=False and read `error`."
        )
    return values, error


@eqx.filter_jit
def _resolved(values: Pytree, error: Scalar, nodes: int, tolerance: float) -> Pytree:
    message = (
        f"The quadrature does not resolve this material: by `quadrature` {nodes} its estimated error is above "
        f"`tolerance` {tolerance:.2g}, or the material is not finite. Under jit and grad no other rule can be tried: "
        f"pass `quadrature={3 * nodes // 2}`, a larger tolerance, or throw=False and read `error`."
    )
    return _checks.held(values, lambda one: eqx.error_if(one, ~(error <= tolerance), message))


def slices_at(
    theta: np.ndarray,
    brdf: AbstractBrdf,
    degree: int,
    dtype: DTypeLike,
    azimuths: int,
    quadrature: int,
    norms: Norms,
    progress: Progress = None,
) -> tuple[Float[Array, "*colour_views n"], Scalar]:
    """SH coefficients of the slices at elevations `theta` of the view, and the quadrature's error in the worst norm."""
    local = view_grid(theta, azimuths, brdf.isotropic).astype(dtype)
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(brdf))
    project = lambda views: project_slices(brdf, views, degree, quadrature, norms)
    if progress is None or traced:
        c, changes = project(local.reshape(-1, 3))
    else:
        parts = []
        with reporting(progress, len(local), f"views by {quadrature} nodes") as step:
            for row in local:
                parts.append(jax.block_until_ready(project(row)))
                step()
        c, changes = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    shares = np.sin(2 * theta) * np.abs(np.gradient(theta))  # of a sphere's picture
    return _as_table(c, changes, jnp.asarray(shares, dtype), brdf.isotropic)


def view_grid(theta: np.ndarray, azimuths: int, isotropic: bool) -> np.ndarray:
    """Local views [V, A, 3] at these elevations; A = 1 of isotropic materials."""
    phi = np.zeros(1) if isotropic else 2 * np.pi * np.arange(azimuths) / azimuths
    grid = np.meshgrid(theta, phi, indexing="ij")
    sine, cosine = np.sin(grid[0]), np.cos(grid[0])
    return np.stack([sine * np.cos(grid[1]), sine * np.sin(grid[1]), cosine], axis=-1)


def project_slices(
    brdf: AbstractBrdf, views: ArrayLike, degree: int, quadrature: int, norms: Norms = ()
) -> tuple[Float[Array, " v *colour_n"], Float[Array, "v 3 norms *colour"]]:
    """Slices for every view [v, 3], and squared norms of what two steps of the rule change, and of the slices."""
    views = jnp.asarray(views)
    return _project(brdf, views, degree, quadrature, norms, ray_tables(degree, views.dtype, brdf.isotropic))


# The tables are arguments of the compiled function, not constants in it.
@eqx.filter_jit
def _project(
    brdf: AbstractBrdf, views: Float[Array, "v 3"], degree: int, quadrature: int, norms: Norms, tables: RayTables
) -> tuple[Float[Array, " v *colour_n"], Float[Array, "v 3 norms *colour"]]:
    width = jnp.asarray(jax.lax.stop_gradient(brdf.lobe_width), views.dtype)
    fixed = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, brdf)
    coarse = (3 * quadrature // 4, quadrature // 2)
    rules = ((brdf, (quadrature,)), (fixed, coarse))[: 2 if norms else 1]
    colour = jax.eval_shape(brdf.value_cosine, views[0], views[0]).shape

    @jax.checkpoint
    def project(views: Float[Array, "b 3"]) -> tuple[Array, Array]:
        sums = [jax.vmap(lambda view, b=b, q=q: _ray_sums(b, view, width, degree, q))(views) for b, q in rules]
        x, y, cos, sin = _azimuth_and_elevation(views.T)
        phi = None if brdf.isotropic else (x, y)
        c = turned_from_axis(jnp.concatenate(sums, axis=-1), (cos, sin), phi, degree, tables)
        c = c.reshape(len(views), -1, *colour, c.shape[-1])
        if not norms:
            return c[:, 0], jnp.zeros((len(views), 3, 0, *colour), c.dtype)
        fine, less, least = jnp.moveaxis(c, 1, 0)
        still = jax.lax.stop_gradient(fine)
        seen = jnp.stack([less - least, still - less, still], axis=1)
        return fine, jnp.stack([jnp.sum(jnp.square(_scaled(seen, ridge)), axis=-1) for ridge in norms], axis=2)

    count = len(views)
    parts = -(-count * quadrature // _NODES_AT_ONCE)
    some = -(-count // parts)
    views = jnp.pad(views, ((0, some * parts - count), (0, 0)), mode="edge").reshape(parts, some, 3)
    return jax.tree.map(lambda x: x.reshape(parts * some, *x.shape[2:])[:count], jax.lax.map(project, views))


def _ray_sums(
    brdf: AbstractBrdf, view: Float[Array, "3"], width: Scalar, degree: int, rules: tuple[int, ...]
) -> Float[Array, "q h r k p rules_colours"]:
    """w -> value_cosine(w, view) integrated with waves about the mirror direction, by every rule.

    In one loop, as a model takes long to compile: shorter rays are filled up to the longest with nodes of no weight.
    """
    rays = [slice_rays(view, width, q, half=brdf.isotropic) for q in rules]
    pad = lambda x, **kw: jnp.pad(x, ((0, 0), (0, max(rules) - x.shape[1])), **kw)
    chi = jnp.concatenate([chi for chi, *_ in rays])
    psi = jnp.concatenate([pad(psi, mode="edge") for _, psi, *_ in rays])
    solid_angle = jnp.concatenate([pad(weight) for _, _, weight, _ in rays])
    frame = rays[0][3]

    @jax.checkpoint
    def along(ray: tuple[Scalar, Array, Array]) -> Float[Array, "waves colours"]:
        chi, psi, solid_angle = ray
        w = _directions(chi[None], psi[None], frame)[0]
        values = jax.vmap(lambda wi: brdf.value_cosine(wi, view))(w).reshape(len(w), -1)
        return ray_waves(jnp.cos(psi), jnp.sin(psi), degree) @ (values * solid_angle[:, None])

    sums, ends = jax.lax.map(along, (chi, psi, solid_angle)), np.cumsum([len(chi) for chi, *_ in rays])[:-1]
    return sums_about(sums, jnp.cos(chi), jnp.sin(chi), brdf.isotropic, ends)


def _scaled(c: Float[Array, "*batch n"], ridge: float | None) -> Float[Array, "*batch n"]:
    """Numbers whose squares sum to that of the norm on the sphere, or of the fit above the horizon."""
    if ridge is None:
        return c
    modes, shares = hemisphere_modes(_checks.degree_of(c.shape[-1]))
    return c @ jnp.asarray(modes * (np.sqrt(shares) / (shares + ridge))[None], c.dtype)


@eqx.filter_jit
def _as_table(
    c: Float[Array, " v *colour_n"],
    changes: Float[Array, "v 3 norms *colour"],
    shares: Float[Array, " elevations"],
    isotropic: bool,
) -> tuple[Float[Array, "*colour_views n"], Scalar]:
    views = (len(shares),) if isotropic else (len(shares), len(c) // len(shares))
    before, after, whole = jnp.tensordot(shares, changes.reshape(len(shares), -1, *changes.shape[1:]).sum(axis=1), 1)
    ratio = lambda a, b: jnp.where(a < b, a / jnp.where(a < b, b, 1), 1)  # at most 1; NaN of NaN
    square = after / jnp.where(whole > 0, whole, 1) * ratio(after, before)
    error = jnp.maximum(2 * safe_sqrt(jnp.max(square)), 32 * float(jnp.finfo(c.dtype).eps))  # at least the rounding
    c = jnp.moveaxis(c.reshape(*views, *c.shape[1:]), range(len(views)), range(-1 - len(views), -1))  # colour first
    return c, error


def slice_nodes(
    view: Float[Array, "3"], width: Scalar, quadrature: int, *, half: bool
) -> tuple[Float[Array, "nodes 3"], Float[Array, " nodes"]]:
    """Directions above the horizon and their solid angles, graded towards the mirror direction of `view`."""
    chi, psi, solid_angle, frame = slice_rays(view, width, quadrature, half=half)
    return _directions(chi, psi, frame).reshape(-1, 3), solid_angle.reshape(-1)


def slice_rays(
    view: Float[Array, "3"], width: Scalar, quadrature: int, *, half: bool
) -> tuple[Float[Array, " x"], Float[Array, "x y"], Float[Array, "x y"], Float[Array, "3 3"]]:
    """Nodes on rays from the mirror direction r of `view`: chi, psi, solid angles, and the rows a, b, r.

    psi = width sinh(s), which resolves the lobe and its tails alike. In chi, panels of an eighth of a turn are graded
    to the end near the plane of incidence, where lobes at grazing views are thin, or near the horizon's turning point,
    where psi_max changes over an angle cos(theta_o). `half`: of what is even in chi, one side for both.
    """
    x, y, cos_o, sin_o = _azimuth_and_elevation(view)
    frame = jnp.stack([x * cos_o, y * cos_o, sin_o, -y, x, jnp.zeros_like(x), -view[0], -view[1], cos_o]).reshape(3, 3)
    node, gauss = unit_gauss(quadrature // 2)
    node, gauss = jnp.asarray(node, view.dtype), jnp.asarray(gauss, view.dtype)
    scale = jnp.arcsinh(np.pi / 4 / cos_o)
    offset, rate = cos_o * jnp.sinh(node * scale), cos_o * scale * jnp.cosh(node * scale) * gauss
    ends = [k * np.pi / 2 for k in range(2 if half else 4)]
    chi = jnp.concatenate([p for end in ends for p in (end + offset, end + np.pi / 2 - offset)])
    d_chi = jnp.tile(rate, 2 * len(ends)) * (2 if half else 1)
    psi_max = jnp.arctan2(cos_o, -sin_o * jnp.cos(chi))
    node, gauss = (jnp.asarray(g[None, :], view.dtype) for g in unit_gauss(quadrature))
    s_max = jnp.arcsinh(psi_max / width)[:, None]
    psi = width * jnp.sinh(node * s_max)
    solid_angle = jnp.sin(psi) * width * jnp.cosh(node * s_max) * s_max * gauss * d_chi[:, None]
    return chi, psi, solid_angle, frame


def _azimuth_and_elevation(view: Array) -> tuple[Array, Array, Array, Array]:
    """Cosine and sine of a view's azimuth, then of its angle to the normal; components on the first axis."""
    sine = jnp.sqrt(view[0] ** 2 + view[1] ** 2)
    return view[0] / sine, view[1] / sine, view[2], sine


def _directions(chi: Float[Array, " x"], psi: Float[Array, "x y"], frame: Float[Array, "3 3"]) -> Float[Array, "x y 3"]:
    up, side, mirror = frame
    ring = jnp.cos(chi)[:, None] * up[None, :] + jnp.sin(chi)[:, None] * side[None, :]
    return jnp.cos(psi)[..., None] * mirror[None, None, :] + jnp.sin(psi)[..., None] * ring[:, None, :]
