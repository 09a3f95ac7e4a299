"""Measured isotropic materials: a table over Rusinkiewicz's half and difference angles, and its interpolation.

Follows the layout of the MERL database (Matusik et al. 2003, *A Data-Driven Reflectance Model*; angles of Rusinkiewicz
1998, *A New Change of Variables for Efficient BRDF Representation*). The published lookup code takes the nearest bin;
here the table is interpolated, so that it has derivatives, and missing bins never enter as negative numbers.
"""

import os
import warnings
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from shisd import io
from shisd._numerics import safe_sqrt
from shisd._typing import Array, ArrayLike, DTypeLike, Float, Scalar, Vector
from shisd.io.internal import merl_above_horizon
from shisd.models._brdf import AbstractBrdf, above_horizon, parameter

SHAPE = (90, 90, 180, 3)
_NONE = 5000  # bins, more than there are


class MeasuredBrdf(AbstractBrdf):
    """A tabulated isotropic BRDF, f[theta_h, theta_d, phi_d, colour] in 1/sr, interpolated linearly.

    Bin (i, j, k) has its centre at theta_h = pi/2 ((i + 1/2) / 90)^2, theta_d = pi/2 (j + 1/2) / 90 and
    phi_d = pi (k + 1/2) / 180. Between centres the value is linear in sqrt(theta_h), theta_d and phi_d; phi_d is
    periodic with period pi, which makes the material reciprocal. Beyond the last centres the value is constant. Before
    the first ones, theta_h < 0.003 or theta_d < 0.5 degrees, it goes with the square of the angle to its mean over
    phi_d, which has no meaning at the pole itself; so wi = wo, and a half vector at the normal, are ordinary points.

    Arguments: `table` [90, 90, 180, 3]; `from_merl` reads a file. Negative values are interpolated as they are, and one
    that is not finite gives NaN in the cells around it. Colour is always (3,).
    Derivatives: in the table and both directions, finite everywhere; those in the directions jump between bins.
    Accuracy: that of linear interpolation; a file of GGX at alpha = 0.3 comes back within 1 % where wi.z, wo.z > 0.3
    and 3 % where wi.z, wo.z > 0.05 (tests). Energy: as measured.
    """

    table: Float[Array, "90 90 180 3"] = eqx.field(converter=parameter("table", (SHAPE,)))
    isotropic: ClassVar[bool] = True

    @classmethod
    def from_merl(
        cls,
        path: str | os.PathLike[str],
        *,
        dtype: DTypeLike = np.float32,
        negative: Literal["fill", "refuse"] = "fill",
    ) -> "MeasuredBrdf":
        """The material in a file of the MERL database.

        The file holds three int32 (90, 90, 180) and three planes of float64, 34,992,012 bytes in all; size and header
        are checked before the values are read. Planes are scaled by (1, 1.15, 1.66) / 1500 to 1/sr and stored in
        `dtype`.

        Bins whose centre is below the horizon have no measurement, and neither have negative or non-finite values above
        it, or ones beyond any material (`shisd.io.read_merl`, which warns). `negative="fill"` gives both the nearest
        valid value of their channel along theta_d or phi_d, and warns with the count of those above the horizon;
        `negative="refuse"` raises ValueError if there are any above the horizon. Other errors: FileNotFoundError, and
        ValueError for a file that is not of this format, holds no valid value, or values that `dtype` does not hold.
        """
        if negative not in ("fill", "refuse"):
            raise ValueError(f'`negative` must be "fill" or "refuse"; got {negative!r}.')
        if jax.dtypes.canonicalize_dtype(dtype) != np.dtype(dtype):
            raise ValueError(f"`dtype` {np.dtype(dtype)} needs jax_enable_x64.")
        values = io.read_merl(path)
        valid = np.isfinite(values) & (values >= 0)
        missing = int(np.sum(~valid & merl_above_horizon()[..., None]))
        found = f"{os.fspath(path)}: {missing} of {values.size} values are above the horizon but negative or not finite"
        if missing and negative == "refuse":
            raise ValueError(f'{found}. Pass negative="fill" to take the nearest valid ones.')
        filled = fill_nearest(values, valid)
        if filled is None:
            raise ValueError(f"{os.fspath(path)}: a colour plane holds no valid value.")
        if missing:
            warnings.warn(f"{found}; filled with the nearest valid ones.", UserWarning, stacklevel=2)
        with np.errstate(over="ignore"):
            filled = filled.astype(dtype)
        if not np.isfinite(filled).all():
            raise ValueError(f"{os.fspath(path)}: `dtype` {np.dtype(dtype)} does not hold its values; pass float32.")
        return cls(jnp.asarray(filled))

    def value(self, wi: ArrayLike, wo: ArrayLike) -> Float[Array, "3"]:
        wi, wo, above, elsewhere = above_horizon(wi, wo)
        theta_h, theta_d, phi_d = half_difference_angles(wi, wo)
        dtype = wi.dtype

        # theta_h: cell [i, i + 1] at fraction u; the square root is taken only beyond the first centre
        first_h = np.pi / 2 / SHAPE[0] ** 2 / 4
        x = SHAPE[0] * jnp.sqrt(jnp.maximum(theta_h, first_h) / (np.pi / 2)) - 0.5
        i, u = _cell(x, SHAPE[0])
        inside_h = jnp.minimum(theta_h / first_h, 1) ** 2  # 0 at the pole, 1 from the first centre on

        first_d = np.pi / 2 / SHAPE[1] / 2
        j, v = _cell(jnp.maximum(theta_d, first_d) * (SHAPE[1] / (np.pi / 2)) - 0.5, SHAPE[1])
        inside_d = jnp.minimum(theta_d / first_d, 1) ** 2

        z = phi_d * (SHAPE[2] / np.pi) - 0.5
        k = jnp.floor(z)
        w = z - k
        k = jnp.stack([k, k + 1]).astype(int) % SHAPE[2]

        corners = self.table[i[:, None, None], j[None, :, None], k[None, None, :]].astype(dtype)
        along_phi = jnp.einsum("hdpc,p->hdc", corners, jnp.stack([1 - w, w]))
        # the poles: means over phi_d, which do not depend on the directions and are computed once under vmap
        pole_h = jnp.mean(self.table[0], axis=1).astype(dtype)[j]  # [d, colour]
        pole_d = jnp.mean(self.table[:, 0], axis=1).astype(dtype)[i]  # [h, colour]
        inside = jnp.einsum("hdc,h,d->c", along_phi, jnp.stack([1 - u, u]), jnp.stack([1 - v, v]))
        at_h = jnp.stack([1 - v, v]) @ pole_h
        at_d = jnp.stack([1 - u, u]) @ pole_d
        at_both = jnp.mean(self.table[0, 0], axis=0).astype(dtype)
        at_h, at_d = at_both + inside_d * (at_h - at_both), at_both + inside_h * (at_d - at_both)
        value = (
            inside_h * inside_d * inside
            + (1 - inside_h) * inside_d * at_h
            + inside_h * (1 - inside_d) * at_d
            + (1 - inside_h) * (1 - inside_d) * at_both
        )
        return jnp.where(above, value, elsewhere)

    @property
    def lobe_width(self) -> Scalar:
        """From the first theta_h where the mean over colours and theta_d <= 20 degrees is below half its maximum."""
        profile = jnp.mean(self.table[:, :20, ::30], axis=(1, 2, 3))
        below = profile < jnp.max(profile) / 2
        first = jnp.where(jnp.any(below), jnp.argmax(below), SHAPE[0])
        width = np.pi * ((first.astype(profile.dtype) + 0.5) / SHAPE[0]) ** 2  # 2 theta_h
        return jax.lax.stop_gradient(jnp.minimum(width, 1))


def half_difference_angles(wi: Vector, wo: Vector) -> tuple[Scalar, Scalar, Scalar]:
    """theta_h, theta_d in [0, pi/2] and phi_d in [-pi, pi], without inverse cosines.

    With s = wi + wo and v = wi - wo, h = s / |s| and v.h = 0, so tan(theta_d) = |v| / |s|, and turning h to the pole
    about z and y leaves phi_d = atan2(h_x v_y - h_y v_x, -v_z). Derivatives are zero where an angle has none: theta_h
    and phi_d where h is the normal, theta_d and phi_d where wi = wo.
    """
    s, v = wi + wo, wi - wo
    theta_h = jnp.arctan2(_length(s[:2]), s[2])
    theta_d = jnp.arctan2(_length(v), _length(s))
    y, x = (s[0] * v[1] - s[1] * v[0]) / _length(s), -v[2]
    defined = x * x + y * y > 0
    phi_d = jnp.arctan2(jnp.where(defined, y, 0), jnp.where(defined, x, 1))
    return theta_h, theta_d, phi_d


def _length(vector: Array) -> Scalar:
    return safe_sqrt(jnp.sum(vector * vector))


def _cell(position: Scalar, count: int) -> tuple[Array, Scalar]:
    """The two bins around a position in units of bins, and the fraction between them; constant beyond the ends."""
    position = jnp.clip(position, 0, count - 1)
    lower = jnp.minimum(jnp.floor(position), count - 2)
    return jnp.stack([lower, lower + 1]).astype(int), position - lower


def fill_nearest(values: np.ndarray, valid: np.ndarray) -> np.ndarray | None:
    """The table with every invalid value replaced by the nearest valid one of its channel and theta_h along theta_d or
    phi_d; where a whole slice of theta_d and phi_d has none, by that of the nearest theta_h. None if a channel has
    none.
    """
    if not valid.any(axis=(0, 1, 2)).all():
        return None
    values, valid = values.copy(), valid.copy()
    while not valid.any(axis=(1, 2)).all() or not valid.all():
        before = valid.sum()
        d_value, d_distance = _nearest(values, valid, 1, periodic=False)
        p_value, p_distance = _nearest(values, valid, 2, periodic=True)
        nearest = np.where(p_distance <= d_distance, p_value, d_value)
        found = ~valid & (np.minimum(p_distance, d_distance) < _NONE)
        values[found], valid[found] = nearest[found], True
        if valid.sum() == before:  # only empty slices are left
            h_value, h_distance = _nearest(values, valid, 0, periodic=False)
            found = ~valid & (h_distance < _NONE)
            values[found], valid[found] = h_value[found], True
    return values


def _nearest(values: np.ndarray, valid: np.ndarray, axis: int, *, periodic: bool) -> tuple[np.ndarray, np.ndarray]:
    """The nearest valid value along an axis, and its distance in bins: beyond _NONE where there is none."""
    values, valid = np.moveaxis(values, axis, 0), np.moveaxis(valid, axis, 0)
    n = len(values)
    turns = 3 if periodic else 1
    position = np.arange(turns * n, dtype=np.int16).reshape(-1, *[1] * (values.ndim - 1))
    marked = np.concatenate([valid] * turns)
    before = np.maximum.accumulate(np.where(marked, position, np.int16(-2 * _NONE)), axis=0)
    after = np.minimum.accumulate(np.where(marked, position, np.int16(2 * _NONE))[::-1], axis=0)[::-1]
    middle = slice(n, 2 * n) if periodic else slice(0, n)
    position, before, after = position[middle], before[middle], after[middle]
    nearest = np.where(position - before <= after - position, before, after)
    found = np.take_along_axis(values, (nearest % n).astype(np.intp), 0)
    return np.moveaxis(found, 0, axis), np.moveaxis(np.abs(nearest - position), 0, axis)
