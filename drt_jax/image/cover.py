"""The part of each cell of a grid of rays that light fills, and the middle of that part.

An edge is straight in a cell. With the middle a sum over cells is right to the third order of their
side also where edges cut them: the value of a cell is that at the middle of its light.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..lens.clearance import clearance
from ..lens.lens import Lens
from ..numerics import safe_divide, safe_sqrt
from .beam import Beam


def cover(
    lens: Lens, beam: Beam, stop: Array, hits: Array, places: Array, axes: tuple[Array, Array]
) -> tuple[Array, Array]:
    """The part of each cell of a grid of rays that light fills, (W, N, N), and how far the middle
    of the light lies from the middle of the cell, (2, W, N, N) along x and y, in sides of a cell.

    stop: (2, W, N, N), where the rays of the grid cross the stop, in its semi-diameters.
    hits: (2 S + 2, W, N, N), where they meet all surfaces, mm, of a clipped beam.
    places: (2, W, Q), of the beam's rays in the plane of the grid, its points or directions.
    axes: the middle and the step of the grid, (2, W) each.
    """
    least = _edge(1 - safe_sqrt(stop[0] ** 2 + stop[1] ** 2))
    if beam.clipped:
        least = _clipped(lens, least, hits.reshape(2, -1, *stop.shape[1:]))
    inside, middle = _filled(least)
    return jnp.where(beam.near(places, *axes, stop.shape[-1]), inside, 0), middle


def _clipped(lens: Lens, rim: "_Edge", hits: Array) -> "_Edge":
    """Of each cell the edge that leaves the least of it, of the rim of the stop and the edges of
    all surfaces, on which rays hit (2, S + 1, W, N, N)."""
    x, y = hits
    edges = clearance(lens, (x, y))

    def nearest(found: _Edge, depth: Array) -> tuple[_Edge, None]:
        """The one or the other; most edges cut no light."""
        new = _edge(jnp.where(jnp.isfinite(depth), depth, 1))
        deep, least = jax.lax.stop_gradient((_cells_deep(new), _cells_deep(found)))
        cuts = (deep < jnp.minimum(least, 0.5)) & (least > -0.5)
        pick = lambda new, old: jax.tree.map(lambda a, b: jnp.where(cuts, a, b), new, old)  # noqa: E731
        return jax.lax.cond(jnp.any(cuts), pick, lambda _, old: old, new, found), None

    return jax.lax.scan(nearest, rim, edges)[0]


class _Edge(NamedTuple):
    """How deep the middles of cells (W, N, N) lie inside of an edge, in any unit, and how much that
    changes over a cell, down and across."""

    depth: Array
    down: Array
    across: Array


def _edge(depth: Array) -> _Edge:
    down, across = jnp.gradient(depth, axis=(-2, -1))
    return _Edge(depth, down, across)


def _cells_deep(edge: _Edge) -> Array:
    """The depth over the sum of the changes: 0.5 for a cell that lies just inside, -0.5 outside."""
    change = jnp.abs(edge.down) + jnp.abs(edge.across)
    return jnp.where(change > 0, safe_divide(edge.depth, change), jnp.sign(edge.depth) * jnp.inf)


def _filled(edge: _Edge) -> tuple[Array, Array]:
    """The part of each cell, (W, N, N), inside of an edge, and its middle (2, W, N, N)."""
    down, across = jnp.abs(edge.down), jnp.abs(edge.across)
    a, b = jnp.maximum(down, across), jnp.minimum(down, across)
    # A unit square cut across by a line: its area is linear in between, a parabola at corners.
    whole, flat = (a + b) / 2, (a - b) / 2
    t = jnp.clip(edge.depth, -whole, whole)
    at_corner, left = jnp.abs(t) > flat, whole - jnp.abs(t)
    legs = safe_divide(left, a), safe_divide(left, b)
    corner = legs[0] * legs[1] / 2
    linear = 0.5 + safe_divide(t, a)
    part = jnp.where(at_corner, jnp.where(t > 0, 1 - corner, corner), linear)
    # Its first moments along the steeper and the other axis are those of what is cut off.
    slant = safe_divide(b, a)
    steep = 1 / 8 - (safe_divide(t, a) ** 2 + slant**2 / 12) / 2
    pairs = zip(legs, (steep, slant / 12))
    moments = (jnp.where(at_corner, corner * (0.5 - leg / 3), level) for leg, level in pairs)
    crossed = jnp.abs(edge.depth) < whole
    steep, slant = (jnp.where(crossed, safe_divide(m, part), 0) for m in moments)
    x = jnp.sign(edge.across) * jnp.where(across >= down, steep, slant)
    y = jnp.sign(edge.down) * jnp.where(across >= down, slant, steep)
    inside = (edge.depth > 0).astype(t.dtype)
    return jnp.where(crossed, part, inside), jnp.stack([x, y])
