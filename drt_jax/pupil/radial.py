"""Radial quadrature inside a boundary, along spokes: half-lines from a centre to the boundary.

Vectors are arrays with their 2 components first, and B rays a wavelength last.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import safe_divide
from .boundary import displace, inverse, picked
from .rules import Symmetry

# `CORNERS`: most corners of a boundary without polygons. `_PARTS`: parts into which each interval
# between two even spokes is divided to find them. The nodes of a panel between corners are
# proportional to its width in units of pi, plus `_EXTRA`.
CORNERS, _PARTS, _EXTRA = 8, 32, 0.15


@functools.cache
def _taps() -> np.ndarray:
    """Weights (6, _PARTS + 1) for interpolation between the middle two of 6 even samples."""
    t, knots = np.linspace(0, 1, _PARTS + 1), np.arange(-2, 4)
    rows = [(knot, np.delete(knots, k)[:, None]) for k, knot in enumerate(knots)]
    return np.array([np.prod((t - others) / (knot - others), axis=0) for knot, others in rows])


def changes(distance: Array, closed: bool, most: int) -> tuple[Array, Array]:
    """Corners of a boundary, where the nearest edge along even spokes changes: positions (W, C) in
    intervals between spokes, and both edges (2, W, C), equal where there is no corner.

    distance: (E, W, B), `edge_distance` along even spokes.
    closed: True if the first spoke is also the last; False if the pupil is mirrored at both.
    most: C, number of places for corners.
    """
    last = distance.shape[-1] - 1
    index = np.arange(last)[:, None] + np.arange(-2, 4)
    index = index % last if closed else last - abs(last - abs(index))
    # Clip distances at 4 times the longest spoke; no spoke is longer than 2.
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
    """Gauss nodes on [0, 1] and weights, (2, most + 1, most): row n has n nodes, then zeros."""
    table = np.zeros((2, most + 1, most))
    for n in range(1, most + 1):
        nodes, weights = np.polynomial.legendre.leggauss(n)
        table[:, n, :n] = (1 + nodes) / 2, weights / 2
    return table


class Frame(NamedTuple):
    """Polar coordinates about a centre, stretched to about the shape of the pupil.

    centre: (2, W, 1), in units of the semi-diameter of the stop.
    shape: (2, 2, W, 1), matrices of the stretching.
    """

    centre: Array
    shape: Array

    def toward(self, angle: Array | np.ndarray) -> Array:
        """Directions (2, W, B) of spokes at azimuths (W, B), radians from the x axis."""
        angle = jnp.asarray(angle, self.shape.dtype)
        return displace(self.shape, jnp.stack([jnp.cos(angle), jnp.sin(angle)]))

    def unstretched(self, point: Array) -> Array:
        """Positions of points (2, W, C) relative to the centre without the stretching."""
        return displace(inverse(self.shape), point - self.centre)


@dataclasses.dataclass(frozen=True)
class RadialRule:
    """Spokes and their weights.

    symmetry: part of the pupil that is traced.
    most: (G,), largest number of spokes of each order.
    wanted: number of places for corners, of which there are `corners`.
    """

    symmetry: Symmetry
    most: tuple[int, ...]
    wanted: int = CORNERS

    @property
    def corners(self) -> int:
        """C, number of places for corners: no more than rays that are searched for at once."""
        return 0 if self.symmetry == "rotational" else min(self.wanted, self.together)

    @property
    def together(self) -> int:
        """Number of rays that are searched for at once, and of even spokes."""
        return {"rotational": sum(self.most), "bilateral": 33, "none": 65}[self.symmetry]

    @property
    def count(self) -> int:
        """B, number of spokes: those of all orders, filled up to a multiple of `together`."""
        return -(-sum(self.most) // self.together) * self.together

    @property
    def range(self) -> float:
        """The range of azimuths, radians from -pi/2."""
        return 2 * np.pi if self.symmetry == "none" else np.pi

    @property
    def even(self) -> np.ndarray:
        """Azimuths (`together`,) of even spokes, with both ends; that of "rotational" is +y."""
        axial = self.symmetry == "rotational"
        return np.linspace(-np.pi / 2 + axial * np.pi, self.range - np.pi / 2, self.together)

    def nearest(self, angle: Array) -> Array:
        """Index of the even spoke that is nearest to an azimuth, int32."""
        index = jnp.round((angle + np.pi / 2) * ((self.together - 1) / self.range))
        return jnp.clip(index.astype(jnp.int32), 0, self.together - 1)

    def scouts(self) -> np.ndarray:
        """Points (2, `together`) over the whole stop and a little beyond its rim; its centre for
        "rotational"."""
        k = np.arange(self.together) + 0.5
        if self.symmetry == "none":
            angle = np.pi * (1 + 5**0.5) * k
            return 1.2 * np.sqrt(k / k.size) * np.stack([np.cos(angle), np.sin(angle)])
        side = 1.2 * (self.symmetry == "bilateral")
        return np.stack([0 * k, side * (2 * k / k.size - 1)])

    def nodes(self, frame: Frame, used: Array, corner: Array, exists: Array) -> tuple[Array, Array]:
        """Azimuths (W, B) and weights (W, B), the sum of each order 1: Gauss nodes between corners,
        more in a wider panel. Spokes of no order have no weight.

        frame: the polar coordinates.
        used: (G,), int32, number of nodes of each order.
        corner: (2, W, C), corners.
        exists: (W, C), bool, corners that exist.
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
    """Gauss nodes (W, most) in panels between `ends` (W, C + 2), and weights. used: (), int32,
    number of nodes with weight."""
    width = jnp.diff(ends, axis=-1)
    need = jax.lax.stop_gradient(jnp.where(width > 0, width / np.pi + _EXTRA, 0))
    need = jnp.cumsum(need, axis=-1)
    last = jnp.round(used.astype(need.dtype) * need / need[:, -1:]).astype(jnp.int32)
    slot = jnp.arange(most, dtype=jnp.int32)[None]
    panel = jnp.sum(slot[..., None] >= last[:, None], axis=-1, dtype=jnp.int32)
    # Slots behind the last panel have no nodes and no weight.
    last = jnp.pad(last, ((0, 0), (1, 1)))
    begin, end = (jnp.take_along_axis(last, panel + k, axis=-1) for k in (0, 1))
    table = jnp.asarray(gauss(most), width.dtype)
    node, weight = table[:, jnp.maximum(end - begin, 0), slot - begin]
    panel = jnp.minimum(panel, width.shape[-1] - 1)
    start, wide = (jnp.take_along_axis(a, panel, axis=-1) for a in (ends, width))
    return start + wide * node, wide * weight
