"""Where clear apertures end the pupil: rays launched until they meet an aperture's edge.

Every edge, the stop's rim among them, is a quadric: a ray passes if its hit h on that surface has
|q| <= 1, where q = scale (h - centre) along x and y; a rectangle is two edges, each with one scale
of 0. Where neighbouring surfaces cross, the way from one to the other is 0: an edge too, if asked
for, of a way between 0 and more than there is. Rays are launched, not aimed: a trace tells how the
hits move with the point on the stop, also beyond all edges, where they step back to a surface; on
this model, every edge ends a half-line on the stop at the root of a quadratic; the next ray is
launched there. So each ray of the boundary takes a few steps of Newton's method.

Vectors are arrays with their 2 components first, and B rays a colour last.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..numerics import run_if, safe_divide, safe_sqrt
from ..rays.aim import beam_size, nearest_start, no_fan, trace_fan
from ..rays.snell import shoot, shoot_anyway, split_stop
from ..rays.status import Status
from ..rays.system import System, dot
from ..rays.trace import on_all_surfaces

_ZOOMS, _STEPS = 10, 8  # of the search for the middle: rounds, and steps of Newton's method
# A last step as short as this, in units of the stop's semi-diameter, is right to its square.
_NEAR = 1e-6
# No ray is longer between two surfaces than so many times the lens.
_LONGEST = 100.0


class Rays(NamedTuple):
    """Launched rays, and how they move with their points on the stop.

    launch: (2, W, B), mm. point: (2, W, B) in units of the stop's semi-diameter. hits: (2, H, W,
    B), mm, see `traced`. aims, moves: (2, ...), derivatives of `launch` and `hits` by `point`.
    good: (W, B), whether they reach the sensor.
    """

    launch: Array
    point: Array
    hits: Array
    aims: Array
    moves: Array
    good: Array

    def at(self, index: Array) -> "Rays":
        """Those at `index` (W, B)."""

        def take(a):
            return jnp.take_along_axis(a, index.reshape(*[1] * (a.ndim - 2), *index.shape), axis=-1)

        return jax.tree.map(take, self)


class Goal(NamedTuple):
    """Where rays are to go: to the end of a half-line, or to a corner.

    centre, toward: (2, W, B), start and direction of the half-line; 0: to the centre itself.
    pair: (2, W, B), the edges that meet in a corner; equal for none.
    """

    centre: Array
    toward: Array
    pair: Array


class Reached(NamedTuple):
    """Rays and their goals. edge: (W, B), that ends the half-line. settled: (W, B), whether the
    goal is met; else the ray is the last one before others fail."""

    rays: Rays
    goal: Goal
    edge: Array
    settled: Array


class Edges(NamedTuple):
    """The E edges of a lens, obscurations taken for clear apertures.

    scale: (2, E, 1, 1) in 1/mm. centre: (2, E, 1, 1) in mm. rows: (E,), of the hits, known.
    """

    scale: Array
    centre: Array
    rows: np.ndarray

    def moves(self, moves: Array) -> Array:
        """How q moves, (..., 2, E, W, B), with hits (..., 2, H, W, B)."""
        moves = moves[..., self.rows, :, :]
        return self.scale.reshape(*[1] * (moves.ndim - 4), *self.scale.shape) * moves

    def at(self, hits: Array) -> Array:
        """q (2, E, W, B) of hits (2, H, W, B)."""
        return self.moves(hits) - self.scale * self.centre


def edges_of(lens: Lens, hits: Array) -> Edges:
    """Those of the S + 1 semi-diameters, of the ways from live surface to live surface and to the
    sensor, if the hits (..., H, W, B) have them, and behind them of all other apertures."""
    scale, extra = jnp.stack([1 / lens.semi_diameter] * 2), lens.apertures
    span = jnp.sum(abs(lens.thickness)) + abs(lens.sensor) + lens.semi_diameter[lens.stop]
    longest = jnp.broadcast_to(_LONGEST * span, (1, hits.shape[-3] - lens.count - 1))
    centre = jnp.pad(longest, ((0, 1), (lens.count + 1, 0)))
    scale = jnp.concatenate([scale, jnp.pad(1 / longest, ((0, 1), (0, 0)))], axis=1)
    rows = np.arange(centre.shape[1])
    if extra is None:
        return Edges(scale[..., None, None], centre[..., None, None], rows)
    axes = [np.eye(2) if kind == "rectangle" else np.ones((1, 2)) for kind in extra.kinds]
    own = np.repeat(np.arange(len(axes)), [len(rows) for rows in axes])
    scales = jnp.asarray(np.concatenate(axes), scale.dtype) / extra.sizes[own]
    at = jnp.zeros_like(scales) if extra.centre is None else extra.centre[own]
    scale, centre = (
        jnp.concatenate([a, b.T], axis=1)[..., None, None]
        for a, b in ((scale, scales), (centre, at))
    )
    return Edges(scale, centre, np.append(rows, np.array(extra.surfaces)[own]))


def moved(rates: Array, change: Array) -> Array:
    """How far something moves with the point on the stop; `rates` (2, ..., W, B)."""
    x, y = change.reshape(2, *[1] * (rates.ndim - 3), *change.shape[1:])
    return rates[0] * x + rates[1] * y


def inverse(matrix: Array) -> Array:
    """Of matrices (2, 2, W, B); 0 for those that have none."""
    (p, q), (r, s) = matrix
    return safe_divide(jnp.array([[s, -q], [-r, p]]), (p * s - q * r)[None, None])


def picked(values: Array, edge: Array) -> Array:
    """Of `values` (..., E, W, B) those of a few edges (N, W, B)."""
    index = edge.reshape(*[1] * (values.ndim - 3), *edge.shape)
    return jnp.take_along_axis(values, index, axis=-3)


def units(like: Array) -> Array:
    """The vectors (1, 0) and (0, 1), (2, 2, W, B)."""
    return jnp.broadcast_to(jnp.eye(2, dtype=like.dtype)[..., None, None], (2, *like.shape))


def traced(lens: Lens, system: System, launch: Array, crossing: bool) -> tuple[Array, Array]:
    """Hits (2, H, W, B), mm, and whether rays reach the sensor, (W, B): on the S surfaces and the
    sensor, and for crossing surfaces behind these as x, with y = 0, the ways to each live surface
    from the one before it and to the sensor, which may be below 0, H = S + 1 + L. Launched as of
    `launched`."""
    if not crossing:
        plain = shoot(system, tuple(launch))
        good = plain.status == Status.OK
        both, good = on_all_surfaces(lens, system, *split_stop(system, plain.hits), good)
        return jnp.stack(both), good
    hits, ways, status = shoot_anyway(system, tuple(launch))
    (x, y), good = on_all_surfaces(lens, system, *split_stop(system, hits), status == Status.OK)
    found = jnp.concatenate([x, ways]), jnp.concatenate([y, 0 * ways])
    return jnp.stack(found), good


def launched(lens: Lens, system: System, launch: Array, crossing: bool) -> Rays:
    """Rays launched at points (2, W, B), mm on the vertex plane of the first row, and traced."""

    def along(unit):
        trace = lambda launch: traced(lens, system, launch, crossing)  # noqa: E731
        hits, columns, good = jax.jvp(trace, (launch,), (unit,), has_aux=True)
        return hits, columns, good

    hits, columns, good = jax.vmap(along, out_axes=(None, 0, None))(units(launch))
    radius = lens.semi_diameter[lens.stop]
    aims = inverse(columns[:, :, lens.stop] / radius)
    moves = jnp.stack([moved(columns, a) for a in aims])
    return Rays(launch, hits[:, lens.stop] / radius, hits, aims, moves, good)


def arriving(system: System, launch: Array, radius: Array) -> Array:
    """Launches (2, W, B) in mm; for a colour of which no ray reaches the sensor, that of the ray of
    a fan which crosses the stop, of `radius` mm, nearest to its centre."""
    dark = jnp.all(shoot(system, tuple(launch)).status != Status.OK, axis=-1)
    rim = (jnp.zeros_like(launch[0]), jnp.full_like(launch[0], radius))

    def sought(launch):
        width = beam_size(system, rim)[1]
        fan = trace_fan(system, no_fan(system, len(dark)), tuple(launch), width)
        best = nearest_start(fan, tuple(jnp.zeros_like(launch[:, :, :1])))
        return jnp.where(dark[None, :, None], jnp.stack(best), launch)

    return run_if(jnp.any(dark), sought, launch)


def gaps(lens: Lens, hits: Array, pair: Array) -> Array:
    """(2, W, B): |q|^2 - 1 of two edges; 0 on them."""
    q = picked(edges_of(lens, hits).at(hits), pair)
    return dot(q, q) - 1


def rates(lens: Lens, rays: Rays, pair: Array) -> Array:
    """Derivatives (2, 2, W, B) of `gaps` by the point on the stop."""
    edges = edges_of(lens, rays.hits)
    q, moves = picked(edges.at(rays.hits), pair), picked(edges.moves(rays.moves), pair)
    return jnp.stack([2 * dot(q, m) for m in moves])


def ends(lens: Lens, rays: Rays, goal: Goal) -> Array:
    """Where each edge ends a half-line, (E, W, B) in units of `goal.toward`, if hits move in
    proportion to it; inf for one that never does."""
    edges = edges_of(lens, rays.hits)
    base = edges.at(rays.hits + moved(rays.moves, goal.centre - rays.point))
    rate = edges.moves(moved(rays.moves, goal.toward))
    square, linear, constant = dot(rate, rate), dot(base, rate), dot(base, base) - 1
    root = safe_sqrt(linear**2 - square * constant)
    out = linear > 0  # of the two ways to write a root, the one that does not subtract
    above = jnp.where(out, -constant, root - linear)
    return jnp.where(square > 0, safe_divide(above, jnp.where(out, linear + root, square)), jnp.inf)


def ahead(lens: Lens, rays: Rays, goal: Goal) -> tuple[Array, Array]:
    """How far (2, W, B) it is to the goal, and the edge (W, B) that ends the half-line."""
    far = ends(lens, rays, goal)
    length = jnp.where(dot(goal.toward, goal.toward) > 0, jnp.min(far, axis=0), 0)
    back = inverse(rates(lens, rays, goal.pair))
    corner = -moved(back, gaps(lens, rays.hits, goal.pair))
    line = goal.centre + length[None] * goal.toward - rays.point
    change = jnp.where(goal.pair[:1] != goal.pair[1:], corner, line)
    return change, jnp.argmin(far, axis=0).astype(jnp.int32)


def shifted(rays: Rays, change: Array) -> Rays:
    """Rays through points (2, W, B) farther, by their model."""
    return rays._replace(
        launch=rays.launch + moved(rays.aims, change),
        point=rays.point + change,
        hits=rays.hits + moved(rays.moves, change),
    )


def search(
    lens: Lens, system: System, start: Rays, goal: Goal, steps: Array, exact: Array
) -> Reached:
    """Newton's method from rays, to which it goes back half the way where one fails.

    steps: at most. exact: whether the derivatives must be those of the last ray, too, which takes
    one step more."""
    tiny = float(jnp.finfo(start.launch.dtype).eps) ** 0.5
    near = max(tiny, _NEAR)

    def step(state):
        count, rays, launch, done, _, _, before = state
        new = launched(lens, system, launch, rays.hits.shape[1] > lens.count + 1)
        rays = jax.tree.map(lambda a, b: jnp.where(new.good & ~done, a, b), new, rays)
        change, edge = ahead(lens, rays, goal)
        back = rays.launch - launch
        settled = rays.good & (dot(change, change) <= near**2)
        lost = ~new.good & (dot(back, back) <= tiny**2 * (1 + dot(launch, launch)))
        onward = rays.launch + moved(rays.aims, change)
        launch = jnp.where(new.good[None], onward, launch + back / 2)
        done = done | (settled & (before | ~exact)) | lost
        return count + 1, rays, launch, done, change, edge, settled

    change, edge = ahead(lens, start, goal)
    launch, no = start.launch + moved(start.aims, change), jnp.zeros(edge.shape, bool)
    state = (0, start, launch, no, change, edge, no)
    state = jax.lax.while_loop(lambda s: (s[0] < steps) & ~jnp.all(s[3]), step, state)
    _, rays, _, _, change, edge, settled = state
    # The last step, which is short, on the model.
    return Reached(shifted(rays, jnp.where(settled[None], change, 0)), goal, edge, settled)


def outside(lens: Lens, rays: Rays, point: Array) -> Array:
    """How far points are outside of the edges that rays model, (W, B) in units of the stop's
    semi-diameter; negative inside."""
    edges = edges_of(lens, rays.hits)
    q = edges.at(rays.hits + moved(rays.moves, point - rays.point))
    x, y = edges.moves(rays.moves)
    far, rate = safe_sqrt(dot(q, q)) - 1, safe_sqrt((dot(x, x) + dot(y, y)) / 2)
    return jnp.max(jnp.where(rate > 0, safe_divide(far, rate), -jnp.inf), axis=0)


def barrier(lens: Lens, rays: Rays, point: Array) -> tuple[Array, Array]:
    """First (2, W, B) and second derivatives (2, 2, W, B), at points, of the sum over the edges
    that rays model of -log(1 - |q|^2), which rises to infinity towards the boundary."""
    edges = edges_of(lens, rays.hits)
    q = edges.at(rays.hits + moved(rays.moves, point - rays.point))
    moves = edges.moves(rays.moves)
    room = jnp.maximum(1 - dot(q, q), jnp.finfo(q.dtype).eps)
    slope = [2 * dot(q, m) / room for m in moves]
    bend = [
        [jnp.sum(2 * dot(moves[i], moves[j]) / room + slope[i] * slope[j], axis=0) for j in (0, 1)]
        for i in (0, 1)
    ]
    return jnp.sum(jnp.stack(slope), axis=1), jnp.array(bend)


def stretch(lens: Lens, rays: Rays) -> Array:
    """Symmetric matrices (2, 2, W, B) that stretch a circle to about the shape of what the edges
    leave around rays: 1 for a circle."""
    (xx, xy), (_, yy) = barrier(lens, rays, rays.point)[1]
    # The inverse with the trace 2, and its root.
    square = safe_divide(2 * jnp.array([[yy, -xy], [-xy, xx]]), (xx + yy)[None, None])
    size = safe_sqrt(square[0, 0] * square[1, 1] - square[0, 1] ** 2)
    size = size[None, None]
    return (square + size * jnp.eye(2, dtype=size.dtype)[..., None, None]) / jnp.sqrt(2 + 2 * size)


def middle(lens: Lens, rays: Rays, scouts: Array) -> Array:
    """A point (2, W, 1) far from all edges by the model of one ray a colour: at first the deepest
    of many, then the lowest of the barrier."""

    def zoom(_, state):
        best, span = state
        points = best + span * scouts[:, None]
        index = jnp.argmin(outside(lens, rays, points), axis=-1)
        return jnp.take_along_axis(points, index[None, :, None], axis=-1), 0.4 * span

    def lower(_, point):
        slope, bend = barrier(lens, rays, point)
        step = moved(inverse(bend), slope)
        return point - step / (1 + safe_sqrt(dot(slope, step)))[None]

    start = jnp.zeros_like(rays.point), jnp.ones((), scouts.dtype)
    deepest = jax.lax.fori_loop(0, _ZOOMS, zoom, start)[0]
    return jax.lax.fori_loop(0, _STEPS, lower, deepest)
