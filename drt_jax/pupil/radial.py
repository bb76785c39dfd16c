"""Radial quadrature inside a boundary: along spokes, which are half-lines from a centre to the
boundary.

Vectors are arrays with their 2 components on the first axis and the B rays of a wavelength on the
last.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import safe_divide
from .rules import Symmetry

# CORNERS: largest number of corners of a boundary without polygons.
# _PARTS: number of parts into which each interval between two even spokes is divided to find
# corners.
# _EXTRA: the number of nodes in a panel between two corners is proportional to its width in units
# of pi, plus this.
CORNERS, _PARTS, _EXTRA = 8, 32, 0.15


def displace(rates: Array, change: Array) -> Array:
    """Change of a quantity by its linear model: rates[0] dx + rates[1] dy.

    rates: (2, ..., W, B), derivatives by a point.
    change: (2, W, B), change (dx, dy) of the point.
    """
    x, y = change.reshape(2, *[1] * (rates.ndim - 3), *change.shape[1:])
    return rates[0] * x + rates[1] * y


def inverse(matrix: Array) -> Array:
    """Inverses of matrices (2, 2, W, B); 0 for a singular matrix."""
    (p, q), (r, s) = matrix
    return safe_divide(jnp.array([[s, -q], [-r, p]]), (p * s - q * r)[None, None])


def picked(values: Array, edge: Array) -> Array:
    """Entries (..., N, W, B) of `values` (..., E, W, B) at the edges `edge` (N, W, B)."""
    index = edge.reshape(*[1] * (values.ndim - 3), *edge.shape)
    return jnp.take_along_axis(values, index, axis=-3)


@functools.cache
def _taps() -> np.ndarray:
    """Weights (6, _PARTS + 1) of the interpolation polynomial through 6 even samples, at
    `_PARTS` + 1 places between the middle two of them."""
    t, knots = np.linspace(0, 1, _PARTS + 1), np.arange(-2, 4)
    rows = [(knot, np.delete(knots, k)[:, None]) for k, knot in enumerate(knots)]
    return np.array([np.prod((t - others) / (knot - others), axis=0) for knot, others in rows])


def changes(distance: Array, closed: bool, most: int) -> tuple[Array, Array]:
    """Corners of a boundary: where the nearest edge along the even spokes changes.

    distance: (E, W, B), `edge_distance` along the even spokes.
    closed: True if the first spoke is also the last; False if the pupil is mirrored at both.
    most: C, number of places for corners.

    Returns positions (W, C), in intervals between spokes, and both edges (2, W, C), int32, which
    are equal where there is no corner. The distances are interpolated on a grid of `_PARTS` points
    in each interval. Where the nearest edge changes from a to b, the difference d_b - d_a falls
    from `start` >= 0 to `end` <= 0, and linear interpolation puts its zero at
    start / (start - end).
    """
    last = distance.shape[-1] - 1
    index = np.arange(last)[:, None] + np.arange(-2, 4)
    index = index % last if closed else last - abs(last - abs(index))
    # Clip distances at 4 times the longest spoke, so that far edges do not disturb the
    # interpolation. No spoke is longer than 2.
    far = 4 * jnp.minimum(jnp.max(jnp.min(distance, axis=0), axis=-1), 2)
    distance = jnp.clip(distance, 0, far[None, :, None])[..., index]
    distance = distance @ jnp.asarray(_taps(), distance.dtype)
    ends = jnp.stack([distance[..., :-1], distance[..., 1:]])
    ends = ends.reshape(2, *distance.shape[:2], -1)
    first = jnp.argmin(ends, axis=1).astype(jnp.int32)
    find = functools.partial(jnp.nonzero, size=most, fill_value=0)
    place = jax.vmap(lambda change: find(change)[0])(first[0] != first[1])
    pair = jnp.take_along_axis(first, place[None], axis=-1)
    near = picked(jnp.take_along_axis(ends, place[None, None], axis=-1), pair)
    start, end = near[:, 1] - near[:, 0]  # distance of the second edge beyond the first
    part = jnp.clip(safe_divide(start, start - end), 0, 1)
    return (place.astype(part.dtype) + part) / _PARTS, pair


@functools.cache
def gauss(most: int) -> np.ndarray:
    """Table (2, most + 1, most) of Gauss-Legendre nodes on [0, 1] and weights: row n has n
    nodes, then zeros."""
    table = np.zeros((2, most + 1, most))
    for n in range(1, most + 1):
        nodes, weights = np.polynomial.legendre.leggauss(n)
        table[:, n, :n] = (1 + nodes) / 2, weights / 2
    return table


class Frame(NamedTuple):
    """Polar coordinates about a centre, stretched to about the shape of the pupil: p = centre + r
    shape (cos a, sin a).

    centre: (2, W, 1), in units of the semi-diameter of the stop.
    shape: (2, 2, W, 1), symmetric matrices of the stretching.
    """

    centre: Array
    shape: Array

    def toward(self, angle: Array | np.ndarray) -> Array:
        """Directions (2, W, B), shape (cos a, sin a), of spokes at azimuths (W, B), radians from
        the x axis."""
        angle = jnp.asarray(angle, self.shape.dtype)
        return displace(self.shape, jnp.stack([jnp.cos(angle), jnp.sin(angle)]))

    def unstretched(self, point: Array) -> Array:
        """Positions (2, W, C) of points relative to the centre, with the stretching undone."""
        return displace(inverse(self.shape), point - self.centre)


@dataclasses.dataclass(frozen=True)
class RadialRule:
    """Static description of the spokes: how many, and over which azimuths.

    symmetry: part of the pupil that is traced.
    most: (G,), largest number of spokes of each order.
    max_corners: number of places for corners that is asked for; `corners` is the number that is
        used.
    """

    symmetry: Symmetry
    most: tuple[int, ...]
    max_corners: int = CORNERS

    @property
    def corners(self) -> int:
        """C, number of places for corners: at most one batch of rays."""
        return 0 if self.symmetry == "rotational" else min(self.max_corners, self.batch)

    @property
    def batch(self) -> int:
        """Number of rays that one stage of the search finds; also the number of even spokes."""
        return {"rotational": sum(self.most), "bilateral": 33, "none": 65}[self.symmetry]

    @property
    def count(self) -> int:
        """B, number of spokes: those of all orders, padded to a multiple of `batch`."""
        return -(-sum(self.most) // self.batch) * self.batch

    @property
    def parts(self) -> int:
        """Number of batches of spokes."""
        return self.count // self.batch

    @property
    def one_batch(self) -> "RadialRule":
        """The same description of one batch of spokes."""
        most = self.most if self.symmetry == "rotational" else (self.batch,)
        return dataclasses.replace(self, most=most)

    @property
    def range(self) -> float:
        """Range of the azimuths, radians, which begins at -pi/2."""
        return 2 * np.pi if self.symmetry == "none" else np.pi

    @property
    def even(self) -> np.ndarray:
        """Azimuths (`batch`,) of the even spokes, both ends of the range included, radians; for
        "rotational" all are pi/2 (+y)."""
        axial = self.symmetry == "rotational"
        return np.linspace(-np.pi / 2 + axial * np.pi, self.range - np.pi / 2, self.batch)

    def nearest(self, angle: Array) -> Array:
        """Index of the even spoke nearest to an azimuth, int32."""
        index = jnp.round((angle + np.pi / 2) * ((self.batch - 1) / self.range))
        return jnp.clip(index.astype(jnp.int32), 0, self.batch - 1)

    def start_points(self) -> np.ndarray:
        """Points (2, `batch`) of the first search stage, spread over the whole stop and to 1.2
        times its radius; its centre for "rotational"."""
        k = np.arange(self.batch) + 0.5
        if self.symmetry == "none":
            angle = np.pi * (1 + 5**0.5) * k
            return 1.2 * np.sqrt(k / k.size) * np.stack([np.cos(angle), np.sin(angle)])
        side = 1.2 * (self.symmetry == "bilateral")
        return np.stack([0 * k, side * (2 * k / k.size - 1)])

    def nodes(self, frame: Frame, used: Array, corner: Array, exists: Array) -> tuple[Array, Array]:
        """Spokes of the rule: Gauss nodes in azimuth in each panel between two corners, with more
        nodes in wider panels.

        frame: the polar coordinates.
        used: (G,), int32, number of nodes of each order.
        corner: (2, W, C), corners, in units of the semi-diameter of the stop.
        exists: (W, C), bool, False for unused places.

        Returns azimuths (W, B) and weights (W, B). The weights of each order sum to 1. Spokes that
        pad an order have weight 0.
        """
        low, full = -np.pi / 2, self.range
        if self.symmetry == "rotational":
            one = jnp.ones((len(exists), self.count), corner.dtype)
            return one * (np.pi / 2), one
        x, y = jnp.where(exists[None], frame.unstretched(corner), 1)
        angle = jnp.where(exists, (jnp.arctan2(y, x) - low) % (2 * np.pi), full)
        angle = jnp.sort(jnp.clip(angle, 0, full), axis=-1)
        ends = jnp.pad(angle, ((0, 0), (1, 1)), constant_values=((0, 0), (0, full)))
        parts = zip(*(_between(ends, n, most) for n, most in zip(used, self.most)))
        angle, weight = (jnp.concatenate(part, axis=1) for part in parts)
        more = ((0, 0), (0, self.count - angle.shape[1]))
        return low + jnp.pad(angle, more), jnp.pad(weight, more) / full


def _between(ends: Array, used: Array, most: int) -> tuple[Array, Array]:
    """Gauss nodes in the panels between angles.

    ends: (W, C + 2), angles in rising order, both ends of the range included.
    used: (), int32, number of nodes with weight.
    most: number of nodes including the padding.

    Returns nodes and weights (W, most). Each panel of width w > 0 gets a part of the `used` nodes
    in proportion to w / pi + `_EXTRA`.
    """
    width = jnp.diff(ends, axis=-1)
    need = jax.lax.stop_gradient(jnp.where(width > 0, width / np.pi + _EXTRA, 0))
    need = jnp.cumsum(need, axis=-1)
    last = jnp.round(used.astype(need.dtype) * need / need[:, -1:]).astype(jnp.int32)
    slot = jnp.arange(most, dtype=jnp.int32)[None]
    panel = jnp.sum(slot[..., None] >= last[:, None], axis=-1, dtype=jnp.int32)
    # Slots behind the last panel are padding: no nodes and no weight.
    last = jnp.pad(last, ((0, 0), (1, 1)))
    begin, end = (jnp.take_along_axis(last, panel + k, axis=-1) for k in (0, 1))
    table = jnp.asarray(gauss(most), width.dtype)
    node, weight = table[:, jnp.maximum(end - begin, 0), slot - begin]
    panel = jnp.minimum(panel, width.shape[-1] - 1)
    start, wide = (jnp.take_along_axis(a, panel, axis=-1) for a in (ends, width))
    return start + wide * node, wide * weight
