"""Antialiasing of pupil edges: the fraction of each cell of a grid that light fills, and the
centroid of that part.

An edge is taken as a straight line within a cell. The value of a cell is the integrand at the
centroid of its light, times the filled area. With this, a sum over cells has an error of the third
order in the side of a cell, also where edges cut cells.
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
    """Filled fraction and centroid of the light in each cell of a grid of rays.

    lens: the lens with its apertures.
    beam: traced rays; cells far from them count as dark.
    stop: (2, W, N, N), crossings of the stop by the rays at the middles of the cells, in units of
        its semi-diameter.
    hits: (2 S + 2, W, N, N), mm, their hits on all surfaces; used for a clipped beam only.
    places: (2, W, Q), positions of the beam's rays in the plane of the grid: stop points or
        direction cosines.
    axes: centre and step of the grid, (2, W) each.

    Returns the fraction (W, N, N), and the centroid of the light relative to the middle of the
    cell, (2, W, N, N), x and y in units of the sides of a cell.
    """
    least = _edge(1 - safe_sqrt(stop[0] ** 2 + stop[1] ** 2))
    if beam.clipped:
        least = _nearest_edge(lens, least, hits.reshape(2, -1, *stop.shape[1:]))
    inside, middle = _clipped_square(least)
    return jnp.where(beam.near(places, *axes, stop.shape[-1]), inside, 0), middle


def _nearest_edge(lens: Lens, rim: "_Edge", hits: Array) -> "_Edge":
    """For each cell, the edge that blocks most of it.

    rim: the edge of the stop.
    hits: (2, S + 1, W, N, N), mm, on all surfaces, whose edges are compared with the rim.
    """
    x, y = hits
    edges = clearance(lens, (x, y))

    def closer(found: _Edge, depth: Array) -> tuple[_Edge, None]:
        """One step of the scan over edges: replaces the edge where the new one, with the
        clearance `depth`, blocks more of a cell. `lax.cond` skips edges that cut no cell, which
        are most of them."""
        new = _edge(jnp.where(jnp.isfinite(depth), depth, 1))
        new_depth, least = jax.lax.stop_gradient((_relative_depth(new), _relative_depth(found)))
        cuts = (new_depth < jnp.minimum(least, 0.5)) & (least > -0.5)
        pick = lambda new, old: jax.tree.map(lambda a, b: jnp.where(cuts, a, b), new, old)  # noqa: E731
        return jax.lax.cond(jnp.any(cuts), pick, lambda _, old: old, new, found), None

    return jax.lax.scan(closer, rim, edges)[0]


class _Edge(NamedTuple):
    """An edge as a linear function in each cell (W, N, N).

    depth: signed distance of the middle of the cell inside of the edge, in any unit.
    down, across: change of the depth over one cell along y and along x.
    """

    depth: Array
    down: Array
    across: Array


def _edge(depth: Array) -> _Edge:
    """The linear functions of an edge from its depth (W, N, N) on the grid, by finite
    differences."""
    down, across = jnp.gradient(depth, axis=(-2, -1))
    return _Edge(depth, down, across)


def _relative_depth(edge: _Edge) -> Array:
    """Depth / (|down| + |across|): 0.5 for a cell that just lies inside of the edge, -0.5 for
    one that just lies outside."""
    change = jnp.abs(edge.down) + jnp.abs(edge.across)
    return jnp.where(change > 0, safe_divide(edge.depth, change), jnp.sign(edge.depth) * jnp.inf)


def _clipped_square(edge: _Edge) -> tuple[Array, Array]:
    """Area and centroid of the part of a unit square that lies inside of an edge, (W, N, N) and
    (2, W, N, N).

    In the cell the depth is t + a u + b v, with a >= b >= 0 the changes along the steeper axis u
    and the other axis v, and u, v from -1/2 to 1/2. For |t| <= (a - b) / 2 the edge crosses two
    opposite sides: the area is 1/2 + t / a, the first moments are
    1/8 - ((t / a)^2 + (b / a)^2 / 12) / 2 along u and (b / a) / 12 along v. Otherwise the edge cuts
    off a triangle with the legs l / a and l / b, l = (a + b) / 2 - |t|, and the area l^2 / (2 a b).
    The moment of the light about the middle of the cell is area x (1/2 - leg / 3) along each axis,
    whether the triangle is the light or what is cut off.
    """
    down, across = jnp.abs(edge.down), jnp.abs(edge.across)
    a, b = jnp.maximum(down, across), jnp.minimum(down, across)
    # Area: linear in t while the edge crosses opposite sides, a parabola where it cuts off a
    # corner.
    whole, flat = (a + b) / 2, (a - b) / 2
    t = jnp.clip(edge.depth, -whole, whole)
    at_corner, left = jnp.abs(t) > flat, whole - jnp.abs(t)
    legs = safe_divide(left, a), safe_divide(left, b)
    corner = legs[0] * legs[1] / 2
    linear = 0.5 + safe_divide(t, a)
    part = jnp.where(at_corner, jnp.where(t > 0, 1 - corner, corner), linear)
    # First moments along the steeper and the other axis, see above.
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
