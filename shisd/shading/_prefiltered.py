"""Distant light filtered beforehand for one material: radiance from one lookup in maps of few channels.

About an axis s near its centre, a slice has coefficients c_lm(theta_o), m >= 0 (it is even in the azimuth). They are of
low rank: with few terms r for each order m, c_lm(theta_o) = sum over r of b_mr(l) a_mr(theta_o). By Eq. 22 the radiance
is then a sum over these channels,

    sum over (m, r) of a_mr(theta_o) (cos(m psi) U_mr(s) + sin(m psi) V_mr(s)),

where U + iV = sum over l of b_mr(l) times the light's coefficients of degree l and order m in a frame (theta, phi, s):
functions of the direction s alone, tabulated once. For m = 0 they are what ISD15 Eq. 22 looks up, the light filtered
with a zonal function; one such channel is a split sum (OCCT). The rank is chosen by the mean square error over
orientations, the sum over bands of |c_l|^2 |e_l|^2 / (2l+1), so channels go where both slices and light have energy.

Around a pole of a map the frame (theta, phi) turns quickly. Hence two charts, with poles on the z and the x axis; each
is used, and kept, within an eighth of a turn of its equator only.

notation: s = the normal, or the direction mirrored at it; t = sin(theta_o) times the unit vector at s that points to
the viewer's side (s = normal) or to the normal (s = mirror direction); psi = the angle from the frame's theta to t.
"""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import _checks
from shisd._module import Module
from shisd._numerics import arctan2, normalize, safe_sqrt
from shisd._sharding import by_device
from shisd._typing import Array, Float, Scalar
from shisd.harmonics.internal import bands, by_band, quarter_mirror, swap_matrices
from shisd.models import DistantLight, Environment
from shisd.shading import _views
from shisd.shading._material import Material, as_material, slices_everywhere
from shisd.shading._surface import Surface, check_surface
from shisd.shading._tiles import as_type, finite_mark, finite_or_nan, in_tiles, shade_points
from shisd.shading.slices._slices import Slices

_TILE, _NUMBERS_AT_ONCE = 1 << 14, 1 << 21  # pixels, and values of all channels for them, at a time
DARK = 1e-12  # of the brightest colour's mean square: what is below is rounding
_ROWS_PER_BAND = 3  # texels from pole to pole for each band: cubic splines are then good to 1e-3 of the highest one


class Prefiltered(Module):
    """A material under one distant light, as `prefilter` makes it: `channels` terms, predicted relative `error`.

    `truncation` predicts what is left out beyond the degree, which `error` knows nothing of: in the same measure,
    relative to radiance of all degrees, if bands of material and light go on as their last ones fall off. It is 1 where
    these do not fall, and below degree 3, where nothing can be said.
    `maps` [texels, M * colours], splines of U and V over two charts, and `profiles` [V+4, M * colours], those of a over
    the elevation of the view; `order` [M] of the maps, negative for V; `reduce` and `expand` [M, L+1], from the bands
    of a slice to a and back; `mirror`, whether s is the mirror direction. M is padded, with zeros, so that most
    materials share compiled code.
    """

    profiles: Float[Array, "elevations a"]
    maps: Float[Array, "texels b"]
    order: Array
    reduce: Float[Array, "maps l"]
    expand: Float[Array, "maps l"]
    mirror: Array
    channels: Array
    error: Scalar
    truncation: Scalar
    highest: int = eqx.field(static=True)  # order
    colours: tuple[tuple[int, ...], tuple[int, ...]] = eqx.field(static=True)  # of the material and of the light

    @property
    def degree(self) -> int:
        return self.expand.shape[1] - 1

    def radiance(self, surface: Surface) -> Float[Array, "*batch_colour"]:
        """Radiance [..., *colour] that leaves surface points towards the viewer, as `shade` gives it.

        Derivatives: in normals, views and tables, both modes; twice continuous in directions, where the chart changes
        up to the error of the splines.
        Accuracy: that of `prefilter`, and 1e-3 of the highest bands, whatever the degree.
        Cost: 16 texels of all channels; nothing depends on the degree.
        """
        check_surface(surface)
        points = surface.points("normals", "views")
        dtype = jnp.result_type(self.maps, points["normals"], points["views"])
        return by_device(shade_points, as_type(points, dtype), _shade, as_type(self, dtype))


def prefilter(
    material: Material | Slices,
    light: DistantLight | Environment,
    *,
    tolerance: float = 1e-2,
    like: Prefiltered | None = None,
) -> Prefiltered:
    """Filter distant light for one isotropic material, once for any number of pixels: see `Prefiltered.radiance`.

    Arguments: `material` as in `shade`, and a `models.DistantLight`, or a `models.Environment`, which is projected to
    the degree of the material; static `tolerance`, the error to aim at: that of
    radiance relative to its RMS over all orientations and over the views of a sphere, of the worst colour, against
    `shade`. As many channels are kept as that takes; `error` of the result is what is predicted for
    it, and tests find it right within a factor of 2 on photographed maps. `truncation` is what is lacking beyond the
    degree: with GGX of alpha 0.02 to 0.1 at degrees 64 and 128 on two such maps within a factor of 2 too, over all
    orientations and views. A picture may show others. Of 64 pixels seen from up to 80 degrees, what was lacking was
    1.9e-4 and not 2.8e-2 at alpha 0.1 and degree 128, as grazing views lack most, and 1.5 and not 0.1 at alpha 0.02 and
    degree 64, as none mirrored a lamp.
    Channels are chosen from values, so not under jit, grad or vmap. There pass `like`, an earlier result: its channels
    are used again and only the tables are made, a pure function of `material` and `light`, linear in each.
    `error` is then that of its channels for this material and this light, and nothing holds it below `tolerance`:
    channels chosen for GGX of alpha 0.4 at 1e-2 leave 2.3e-2 at alpha 0.3 and 0.15 at 0.8, at degree 6.
    Derivatives: with `like`, in both; those of channels that stay as they are. So a fit of the light is as good as its
    values, but the slope in a material's roughness lacks what would need other channels, and a fit by it may end beside
    the best one: fit materials by `shade`, whose derivatives are exact, and filter what was found. Read
    `error` wherever material or light have moved, and choose anew where it has grown.
    Cost: the maps hold 18 (L+1)^2 texels; each is a Fourier series, summed over rows, then over columns. At degree 255,
    with RGB light and 1e-2, GGX of alpha 0.02, 0.05 and 0.1 took 56, 128 and 152 maps of a photographed interior, 0.8,
    1.8 and 2.2 GB (up to 9 GB while they are made), and 17 to 21 s of one core.
    Source: ISD15 Eq. 22, whose zonal maps this extends to orders m > 0.
    """
    slices = slices_everywhere(as_material(material), "DistantLight")
    if not slices.isotropic:
        raise ValueError("`material` is anisotropic, which no map of one direction can hold; use shading.shade.")
    if isinstance(light, Environment):
        light = light.light(slices.degree)
    if not isinstance(light, DistantLight):
        raise ValueError(f"`light` must be a models.DistantLight or Environment; got {type(light).__name__}.")
    tolerance = _checks.number("tolerance", tolerance, positive=True)
    degree = min(light.degree, slices.degree)
    dtype = jnp.promote_types(slices.coefficients.dtype, light.coefficients.dtype)
    e = light.coefficients[..., : (degree + 1) ** 2].astype(dtype)
    c = slices.coefficients[..., : (degree + 1) ** 2].astype(dtype)
    c = c.reshape(-1, *c.shape[-2:])
    if like is None:
        try:
            values = np.asarray(c, float), np.asarray(e, float)
        except jax.errors.TracerArrayConversionError as error:
            raise ValueError(
                "channels are chosen from values: call prefilter once outside jit and grad, and pass that as `like`."
            ) from error
        for name, value in zip(("material", "light"), values, strict=True):
            if not np.all(np.isfinite(value)):
                raise ValueError(f"`{name}` must be finite; got NaN or infinity.")
        like = _choose(*values, tolerance)
    elif not isinstance(like, Prefiltered) or like.degree != degree:
        raise ValueError(f"`like` must come from shading.prefilter at degree {degree}.")
    like = jax.lax.stop_gradient(as_type(like, dtype))
    tables = _filter(c, e.reshape(-1, e.shape[-1]), like, jnp.asarray(_swaps(degree), dtype))
    return dataclasses.replace(like, **tables, colours=(slices.colour, e.shape[:-1]))


# ---- choice of channels, on the host


def _choose(c: np.ndarray, e: np.ndarray, tolerance: float) -> Prefiltered:
    """The channels, and the centre with which they are fewest; no tables yet."""
    degree, views = _checks.degree_of(c.shape[-1]), c.shape[1]
    e = e.reshape(-1, e.shape[-1])
    mirror, m, reduce, expand = best_channels(c, e, _views.elevations(views), _shares(views), tolerance)
    turning = np.flatnonzero(m > 0)  # these have a V
    order, reduce, expand = (np.concatenate([x, y[turning]]) for x, y in ((m, -m), (reduce, reduce), (expand, expand)))
    pad = lambda x: np.pad(x, ((0, -len(x) % 8), *[(0, 0)] * (x.ndim - 1)))
    table = lambda x: jnp.asarray(pad(x), float)
    highest, none = min(-(-int(m.max()) // 4) * 4, degree), jnp.zeros((0, 0))
    return Prefiltered(
        profiles=none,
        maps=none,
        order=jnp.asarray(pad(order), jnp.int32),
        reduce=table(reduce),
        expand=table(expand),
        mirror=jnp.asarray(mirror),
        channels=jnp.asarray(len(m), jnp.int32),
        error=jnp.zeros(()),
        truncation=jnp.ones(()),
        highest=highest,
        colours=((), ()),
    )


def best_channels(
    c: Float[np.ndarray, "s v n"],
    e: Float[np.ndarray, "s2 n"],
    theta: Float[np.ndarray, " v"],
    shares: Float[np.ndarray, " v"],
    tolerance: float,
) -> tuple[bool, np.ndarray, np.ndarray, np.ndarray]:
    """Whether slices at elevations `theta` are centred about the mirror direction, which takes fewer maps or not.

    And orders, `reduce` and `expand` of the channels.
    """
    degree = _checks.degree_of(c.shape[-1])
    l = np.arange(degree + 1)
    energy = np.add.reduceat(e * e, l**2, axis=1) / (2 * l + 1)
    swaps, slices = jnp.asarray(_swaps(degree), float), jnp.asarray(c, float)
    found = []
    for mirror in (False, True):
        centred = np.asarray(_centred(slices, jnp.asarray(theta, float), jnp.asarray(mirror), swaps), float)
        orders, *rest = _channels(centred[:, degree:], energy, shares, tolerance)
        found.append((mirror, orders, *rest))
    return min(found, key=lambda x: maps_of(x[1]))


def maps_of(orders: np.ndarray) -> int:
    """Of channels of these orders: U, and V but for order 0."""
    return len(orders) + int(np.count_nonzero(orders))


def _channels(
    c: np.ndarray, energy: np.ndarray, shares: np.ndarray, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orders of the channels, `reduce` and `expand`; c [l, m, s, V], energy [s2, l].

    The leading singular vectors over bands of all orders together, by the mean of the colours, until all meet the
    tolerance.
    """
    degree = len(c) - 1
    colours = np.broadcast_shapes(c.shape[2:3], energy.shape[:1])
    rest = np.broadcast_to(c, (*c.shape[:2], *colours, c.shape[3])).copy()
    energy = np.broadcast_to(energy, (*colours, degree + 1))
    square = lambda rows: np.einsum("lsv,sl,v->s", rows**2, energy, shares)
    left = np.stack([square(rest[:, order]) for order in range(degree + 1)])  # [m, s]
    total = np.sum(left, axis=0)
    lit = total > DARK * np.max(total)
    inverse = np.where(lit, 1 / np.where(lit, total, 1), 0)
    weight = np.sqrt(np.mean(energy * inverse[:, None], axis=0))
    used, weight_or_1 = weight > 0, np.where(weight > 0, weight, 1)
    vectors, values, orders = [], [], []
    for order in range(degree + 1):
        rows = (rest[order:, order] * np.sqrt(shares)).reshape(degree + 1 - order, -1) * weight[order:, None]
        squares, u = np.linalg.eigh(rows @ rows.T)  # singular values: LAPACK's own may not converge at degree 255
        vectors.append(np.pad(u.T, ((0, 0), (order, 0))))
        values.append(squares)
        orders.append(np.full(len(values[-1]), order))
    vectors, values, orders = (np.concatenate(x) for x in (vectors, values, orders))
    reduce, expand = vectors * weight, np.where(used, vectors / weight_or_1, 0)
    kept = []
    for k in np.argsort(-values, kind="stable"):
        if kept and np.max(np.sum(left, axis=0) * inverse) <= tolerance**2:
            break
        rows = rest[:, orders[k]]
        rows -= expand[k][:, None, None] * np.tensordot(reduce[k], rows, 1)
        left[orders[k]] = square(rows)
        kept.append(k)
    return orders[kept], reduce[kept], expand[kept]


def _shares(views: int) -> np.ndarray:
    """How much of the picture of a sphere is seen from each elevation."""
    share = np.sin(2 * _views.elevations(views))
    return share / np.sum(share)


@eqx.filter_jit
def _centred(
    c: Float[Array, "s v n"], theta: Float[Array, " v"], mirror: bool | Array, swaps: Float[Array, "l m m"]
) -> Float[Array, "l m s v"]:
    """Coefficients of slices in frames whose z axis is the centre, and whose x axis points to the normal's side."""
    degree = len(swaps) - 1
    order = np.arange(-degree, degree + 1)[:, None, None]
    angle = jnp.where(mirror, jnp.asarray(order, c.dtype) * theta[None, None], 0)  # [m, 1, v]
    x = jnp.einsum("lkm,svlm->lksv", swaps, by_band(c, degree))
    x = jnp.cos(angle)[None] * x + jnp.sin(angle)[None] * x[:, ::-1]  # Ry(theta) is J Z(-theta) J
    return jnp.einsum("lmk,lksv->lmsv", swaps, x)


@functools.cache
def _swaps(degree: int) -> np.ndarray:
    """J_l of all bands [l, m, k], zero where |m| or |k| > l."""
    inner = [slice(degree - l, degree + l + 1) for l in range(degree + 1)]
    swaps = np.zeros((degree + 1, 2 * degree + 1, 2 * degree + 1))
    for l, j in enumerate(swap_matrices(degree)):
        swaps[l, inner[l], inner[l]] = j
    return swaps


# ---- tables


@eqx.filter_jit
def _filter(
    c: Float[Array, "s v n"], e: Float[Array, "s2 n"], like: Prefiltered, swaps: Float[Array, "l m m"]
) -> dict[str, Array]:
    """`profiles`, `maps`, `error` and `truncation` of `Prefiltered`."""
    m = jnp.abs(like.order)
    theta = jnp.asarray(_views.elevations(c.shape[1]), c.dtype)
    centred = _centred(c, theta, like.mirror, swaps)
    a = jnp.einsum("al,lasv->sav", like.reduce, centred[:, like.degree + m])
    profiles = jnp.moveaxis(_views.spline_table(a, m), -1, 0).swapaxes(1, 2)  # [V+4, maps, s]
    error, truncation = _errors(centred[:, like.degree :], a, e, like)
    e = by_band(e, like.degree)
    charts = jnp.stack([e, _about_x(e, swaps)])
    maps = jax.lax.map(lambda e: _chart(_series(e, like.order, like.expand, swaps)), charts)
    return {
        "profiles": profiles.reshape(len(profiles), -1),
        "maps": maps.reshape(-1, maps.shape[-1]),
        "error": jax.lax.stop_gradient(error),
        "truncation": jax.lax.stop_gradient(truncation),
    }


def _errors(
    c: Float[Array, "l m s v"], a: Float[Array, "s a v"], e: Float[Array, "s2 n"], like: Prefiltered
) -> tuple[Scalar, Scalar]:
    """What the channels, and what bands beyond the degree leave out: RMS over orientations and views, relative."""
    degree = like.degree
    orders = np.arange(degree + 1, dtype=np.int32)  # V, of order -m, is the same channel
    member = jnp.asarray(like.order[:, None] == orders[None], c.dtype)
    made = jnp.einsum("am,al,sav->lmsv", member, like.expand, a)
    largest = jnp.maximum(jnp.max(jnp.abs(e)), jnp.finfo(e.dtype).tiny)
    means = np.equal.outer(bands(degree), np.arange(degree + 1)) / (2 * np.arange(degree + 1) + 1)
    energy = (e / largest) ** 2 @ jnp.asarray(means, e.dtype)
    shares = jnp.asarray(_shares(c.shape[-1]), c.dtype)
    slices = lambda x: jnp.einsum("lmsv,v->sl", x * x, shares)
    radiance = lambda x: jnp.broadcast_to(slices(x), shape) * jnp.broadcast_to(energy, shape)  # squares [colours, l]
    shape = jnp.broadcast_shapes((c.shape[2], degree + 1), energy.shape)
    squares = radiance(c)
    whole = jnp.sum(squares, axis=1)
    dark = whole <= DARK * jnp.max(whole)
    parts = jnp.where(dark[:, None], 0, squares / jnp.where(dark, 1, whole)[:, None])
    left = jnp.sum(jnp.where(dark[:, None], 0, radiance(c - made)), axis=1) / jnp.where(dark, 1, whole)
    return safe_sqrt(jnp.max(left)), safe_sqrt(jnp.max(_beyond(parts)))


def _beyond(parts: Float[Array, "colours l"]) -> Float[Array, " colours"]:
    """The share of bands to come, if windows of a quarter of those known, l = 0 ... L, fall like the last two.

    Their sum is then exact where squares fall exponentially, as those of sharp lobes, and 0.4 of it where as 1/l^3.
    """
    window = max(parts.shape[1] // 4, 2)
    if parts.shape[1] < 2 * window:
        return jnp.ones(len(parts), parts.dtype)
    before, last = (jnp.sum(x, axis=1) for x in (parts[:, -2 * window : -window], parts[:, -window:]))
    beyond = last * last  # over 1 - last / before, times before
    return jnp.where(last > 0, beyond / (beyond + jnp.maximum(before - last, 0)), 0)


def _about_x(e: Float[Array, "s l m"], swaps: Float[Array, "l m m"]) -> Float[Array, "s l m"]:
    """Light in the chart whose pole is x and whose axes are (y, z, x): x and y exchanged, then y and z."""
    mirror = jnp.asarray(quarter_mirror(len(swaps) - 1), e.dtype)  # of the highest band: it holds all others
    return jnp.einsum("lkm,slm->slk", swaps, e @ mirror)


def _series(
    e: Float[Array, "s l m"], order: Array, expand: Float[Array, "maps l"], swaps: Float[Array, "l m m"]
) -> Float[Array, "theta phi b"]:
    """All maps, colours last, as Fourier series in theta and phi: cosines of 0 ... L, then sines.

    The frame (theta, phi, s) turns the light's bands by Ry(-theta) Rz(-phi), J Z(theta) J Z(-phi) on coefficients, and
    the entries of Z(g) are cosines and sines of k g: these series are exact, as Risbo's of Wigner's d (1996). The
    bands stand in one padded array, which compiles in a moment; `_rotation.swapped_series` has one product for each.
    """
    degree = len(swaps) - 1

    def halves(x: Array) -> tuple[Array, Array]:
        return x[..., degree:], x[..., degree::-1].at[..., 0].set(0)  # order 0 counts once

    (plus, minus), (j_plus, j_minus) = halves(e[..., None, :]), halves(swaps[None])  # [s, l, k, c]: c in phi
    turned = jnp.concatenate([j_plus * plus + j_minus * minus, j_plus * minus - j_minus * plus], axis=-1)
    turned = jnp.moveaxis(turned, 2, -1)  # [s, l, c, k]: k in theta
    turned = jnp.concatenate(halves(turned), axis=1)
    plus, minus = halves(swaps[:, degree + order] * expand.T[..., None])  # [l, maps, k]
    rows = jnp.stack([jnp.concatenate([plus, minus]), jnp.concatenate([minus, -plus])])
    series = jnp.einsum("wlak,slck->wkcas", rows, turned)
    return series.reshape(2 * degree + 2, 2 * degree + 2, -1)


def _grid(degree: int) -> tuple[int, int, int]:
    """Rows from pole to pole, and the first and the number of those that a chart keeps."""
    rows = 4 * -(-_ROWS_PER_BAND * (degree + 1) // 4)
    return rows, rows // 4 - 2, rows // 2 + 5


def _chart(series: Float[Array, "theta phi b"]) -> Float[Array, "texels b"]:
    """Spline coefficients of periodic series over the belt of one chart."""
    degree = len(series) // 2 - 1
    rows, first, kept = _grid(degree)
    k = np.arange(degree + 1)
    through = 3 / (2 + np.cos(k * np.pi / rows))  # splines through the nodes

    def waves(node: np.ndarray) -> Array:
        angle = np.pi * (node[:, None] + 0.5) / rows * k
        return jnp.asarray(np.concatenate([np.cos(angle) * through, np.sin(angle) * through], axis=1), series.dtype)

    belt = jnp.tensordot(waves(first + np.arange(kept)), series, 1)
    return jnp.einsum("pc,tcb->tpb", waves(np.arange(-2, 2 * rows + 2)), belt).reshape(-1, belt.shape[-1])


# ---- lookups


@eqx.filter_jit
def _shade(points: dict[str, Float[Array, "p 3"]], lobes: Prefiltered) -> Float[Array, " p *colour"]:
    material, light = (int(np.prod(c)) for c in lobes.colours)
    rows, first, kept = _grid(lobes.degree)
    width, count = 2 * rows + 4, len(lobes.order)
    shared = finite_mark(lobes.maps, lobes.profiles)
    # indexed copies and jnp.sum would be slow: both are products
    k = np.arange(lobes.highest + 1, dtype=np.int32)[:, None]
    choose = jnp.concatenate([k == lobes.order[None], -k == lobes.order[None]]).astype(lobes.maps.dtype)
    sums = jnp.tile(jnp.eye(max(material, light), dtype=lobes.maps.dtype), (count, 1))

    def shade(tile: dict[str, Array]) -> Float[Array, " p *colour"]:
        n, v = normalize(tile["normals"]), normalize(tile["views"])
        cosine = jnp.sum(n * v, axis=1)
        across = v - cosine[:, None] * n
        reflected = cosine[:, None] * n - across
        s = jnp.where(lobes.mirror, reflected, n)
        t = jnp.where(lobes.mirror, n - cosine[:, None] * reflected, across)
        polar = s[:, 2] ** 2 > 0.5
        s, t = (jnp.where(polar[:, None], jnp.roll(x, -1, axis=1), x) for x in (s, t))
        rho = jnp.sqrt(s[:, 0] ** 2 + s[:, 1] ** 2)
        c, d = s[:, 0] / rho, s[:, 1] / rho
        along = s[:, 2] * (t[:, 0] * c + t[:, 1] * d) - rho * t[:, 2]
        cos, sin = _views.azimuth_factors(
            jnp.stack([along, t[:, 1] * c - t[:, 0] * d, cosine], axis=1), lobes.highest + 1
        )
        row, weight = _cubic(arctan2(rho, s[:, 2]) * (rows / np.pi) - 0.5)
        column, weight_2 = _cubic((arctan2(s[:, 1], s[:, 0]) % (2 * np.pi)) * (rows / np.pi) - 0.5)
        corner = (jnp.clip(row - 1 - first, 0, kept - 4) + jnp.where(polar, kept, 0)) * width + jnp.clip(
            column + 1, 0, width - 4
        )
        looked = _lookup(
            lobes.maps, corner, [(i * width + j, a * b) for i, a in enumerate(weight) for j, b in enumerate(weight_2)]
        )
        elevation, weight = _cubic(
            arctan2(safe_sqrt(1 - cosine * cosine), cosine) * ((lobes.profiles.shape[0] - 4) * 2 / np.pi) - 0.5
        )
        elevation = jnp.clip(elevation + 1, 0, lobes.profiles.shape[0] - 4)
        a = _lookup(lobes.profiles, elevation, list(enumerate(weight))).reshape(-1, count, material)
        waves = jnp.concatenate([cos, sin]).T @ choose
        terms = waves[..., None] * a * looked.reshape(-1, count, light)
        total = terms.reshape(-1, count * terms.shape[-1]) @ sums
        total = finite_or_nan(jnp.where((cosine > 0)[:, None], total, 0), [n, v], shared)
        return total.reshape(-1, *np.broadcast_shapes(*lobes.colours))

    return in_tiles(shade, points, min(_TILE, max(1, _NUMBERS_AT_ONCE // lobes.maps.shape[1])))


def _cubic(x: Float[Array, " p"]) -> tuple[Array, list[Array]]:
    """The node below, and the weights of cubic B-splines at it, one before and two after."""
    below = jnp.floor(x)
    t = x - below
    u = 1 - t
    weights = [u**3 / 6, (4 - 6 * t**2 + 3 * t**3) / 6, (4 - 6 * u**2 + 3 * u**3) / 6, t**3 / 6]
    return below.astype(jnp.int32), weights


def _lookup(table: Float[Array, "rows n"], row: Array, taps: list[tuple[int, Array]]) -> Float[Array, "p n"]:
    """Weighted sums of rows: whole rows are fetched, which is one pass over contiguous numbers."""
    fetch = lambda offset: table.at[row + offset].get(mode="promise_in_bounds")
    return functools.reduce(jnp.add, [w[:, None] * fetch(offset) for offset, w in taps])
