"""Spokes, the half-lines from a centre to the boundary: where they lie, and their quadrature.

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

# Corners that have a panel of their own, and what each gap between two of the even spokes on which
# they are sought is divided into. A panel gets nodes by its width in half turns and `_EXTRA`.
CORNERS, _PARTS, _EXTRA = 8, 32, 0.15


@functools.cache
def _taps() -> np.ndarray:
    """Weights (6, _PARTS + 1) that interpolate between the two middle ones of 6 even values."""
    t, knots = np.linspace(0, 1, _PARTS + 1), np.arange(-2, 4)
    rows = [(knot, np.delete(knots, k)[:, None]) for k, knot in enumerate(knots)]
    return np.array([np.prod((t - others) / (knot - others), axis=0) for knot, others in rows])


def changes(distance: Array, closed: bool) -> tuple[Array, Array]:
    """Where one edge takes over from another along even spokes, from `edge_distance` (E, W, B) of
    them: places (W, C) in gaps between spokes, and the two edges (2, W, C), equal for no corner.

    closed: whether the first spoke is the last; else the pupil is mirrored at both.
    """
    last = distance.shape[-1] - 1
    index = np.arange(last)[:, None] + np.arange(-2, 4)
    index = index % last if closed else last - abs(last - abs(index))
    # An edge beyond 4 times the longest spoke ends nothing; a spoke is no longer than 2.
    far = 4 * jnp.minimum(jnp.max(jnp.min(distance, axis=0), axis=-1), 2)
    distance = jnp.clip(distance, 0, far[None, :, None])[..., index]
    distance = distance @ jnp.asarray(_taps(), distance.dtype)
    ends = jnp.stack([distance[..., :-1], distance[..., 1:]])
    ends = ends.reshape(2, *distance.shape[:2], -1)
    first = jnp.argmin(ends, axis=1).astype(jnp.int32)
    find = functools.partial(jnp.nonzero, size=CORNERS, fill_value=0)
    place = jax.vmap(lambda change: find(change)[0])(first[0] != first[1])
    pair = jnp.take_along_axis(first, place[None], axis=-1)
    near = picked(jnp.take_along_axis(ends, place[None, None], axis=-1), pair)
    start, end = near[:, 1] - near[:, 0]  # by how far the second edge is beyond the first
    part = jnp.clip(safe_divide(start, start - end), 0, 1)
    return (place.astype(part.dtype) + part) / _PARTS, pair


@functools.cache
def gauss(most: int) -> np.ndarray:
    """Gauss nodes on [0, 1] and weights, (2, most + 1, most): in row n those of n, then zeros."""
    table = np.zeros((2, most + 1, most))
    for n in range(1, most + 1):
        nodes, weights = np.polynomial.legendre.leggauss(n)
        table[:, n, :n] = (1 + nodes) / 2, weights / 2
    return table


class Frame(NamedTuple):
    """Polar coordinates about a centre (2, W, 1), stretched by matrices `shape` (2, 2, W, 1) to
    about the shape of the pupil."""

    centre: Array
    shape: Array

    def toward(self, angle: Array | np.ndarray) -> Array:
        """Directions (2, W, B) of spokes at azimuths (W, B), radians from the x axis."""
        return displace(self.shape, jnp.stack([jnp.cos(angle), jnp.sin(angle)]))

    def unstretched(self, point: Array) -> Array:
        """Where points (2, W, C) lie about the centre without the stretching."""
        return displace(inverse(self.shape), point - self.centre)


@dataclasses.dataclass(frozen=True)
class RadialRule:
    """Spokes and their weights: there are places for `count` of them, B."""

    symmetry: Symmetry
    count: int

    @property
    def range(self) -> float:
        """The range of azimuths, radians from -pi/2."""
        return 2 * np.pi if self.symmetry == "none" else np.pi

    @property
    def even(self) -> np.ndarray:
        """Azimuths (B,) of even spokes, ends included; the meridian's is y > 0."""
        axial = self.symmetry == "rotational"
        return np.linspace(-np.pi / 2 + axial * np.pi, self.range - np.pi / 2, self.count)

    def nearest(self, angle: Array) -> Array:
        """Which of the even spokes is nearest to an azimuth."""
        index = jnp.round((angle + np.pi / 2) * ((self.count - 1) / self.range))
        return jnp.clip(index.astype(jnp.int32), 0, self.count - 1)

    def scouts(self) -> np.ndarray:
        """Points (2, B) all over the stop, and a little beyond its rim."""
        k = np.arange(self.count) + 0.5
        if self.symmetry == "none":
            angle = np.pi * (1 + 5**0.5) * k
            return 1.2 * np.sqrt(k / self.count) * np.stack([np.cos(angle), np.sin(angle)])
        return np.stack([0 * k, 1.2 * (2 * k / self.count - 1)])

    def nodes(self, frame: Frame, used: Array, corner: Array, exists: Array) -> tuple[Array, Array]:
        """Azimuths (W, B) and their weights, which add up to 1: `used` Gauss nodes between the
        corners (2, W, C) that exist (W, C); more in a wide gap."""
        low, full = -np.pi / 2, self.range
        if self.symmetry == "rotational":
            one = jnp.ones((len(exists), 1), corner.dtype)
            return one * (np.pi / 2), one
        x, y = jnp.where(exists[None], frame.unstretched(corner), 1)
        angle = jnp.where(exists, (jnp.arctan2(y, x) - low) % (2 * np.pi), full)
        angle = jnp.sort(jnp.clip(angle, 0, full), axis=-1)
        ends = jnp.pad(angle, ((0, 0), (1, 1)), constant_values=((0, 0), (0, full)))
        width = jnp.diff(ends, axis=-1)
        need = jax.lax.stop_gradient(jnp.where(width > 0, width / np.pi + _EXTRA, 0))
        need = jnp.cumsum(need, axis=-1)
        last = jnp.round(used.astype(need.dtype) * need / need[:, -1:]).astype(jnp.int32)
        slot = jnp.arange(self.count, dtype=jnp.int32)[None]
        panel = jnp.sum(slot[..., None] >= last[:, None], axis=-1, dtype=jnp.int32)
        # Behind the last panel there are no nodes, and no weight.
        last = jnp.pad(last, ((0, 0), (1, 1)))
        begin, end = (jnp.take_along_axis(last, panel + k, axis=-1) for k in (0, 1))
        table = jnp.asarray(gauss(self.count), width.dtype)
        node, weight = table[:, jnp.maximum(end - begin, 0), slot - begin]
        panel = jnp.minimum(panel, width.shape[-1] - 1)
        start, wide = (jnp.take_along_axis(a, panel, axis=-1) for a in (ends, width))
        return low + start + wide * node, wide * weight / full
