"""Where clear apertures end the pupil: rays launched until they meet an aperture's edge.

Every aperture, the stop's rim among them, is a circle: a ray passes if its hit h on that surface
has |h| <= R. Rays are launched, not aimed: a trace tells how the hits move with the point on the
stop; on this model, every aperture ends a half-line on the stop at the root of a quadratic; the
next ray is launched there. So each ray of the boundary takes a few steps of Newton's method.

Vectors are arrays with their 2 components first, and B rays a colour last.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..lens.lens import Lens
from ..numerics import safe_divide, safe_sqrt
from ..rays.snell import apart, shoot
from ..rays.status import Status
from ..rays.system import System, dot
from ..rays.trace import on_all_surfaces

_ZOOMS = 10  # rounds of the search for the middle


class Rays(NamedTuple):
    """Launched rays, and how they move with their points on the stop.

    launch: (2, W, B), mm. point: (2, W, B) in units of the stop's semi-diameter. hits: (2, S + 1,
    W, B), mm. aims, moves: (2, ...), derivatives of `launch` and `hits` by `point`.
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
    pair: (2, W, B), the surfaces whose apertures meet in a corner; equal for none.
    """

    centre: Array
    toward: Array
    pair: Array


class Reached(NamedTuple):
    """Rays and their goals. surface: (W, B), that ends the half-line. settled: (W, B), whether the
    goal is met; else the ray is the last one before others fail."""

    rays: Rays
    goal: Goal
    surface: Array
    settled: Array


def moved(rates: Array, change: Array) -> Array:
    """How far something moves with the point on the stop; `rates` (2, ..., W, B)."""
    x, y = change.reshape(2, *[1] * (rates.ndim - 3), *change.shape[1:])
    return rates[0] * x + rates[1] * y


def inverse(matrix: Array) -> Array:
    """Of matrices (2, 2, W, B); 0 for those that have none."""
    (p, q), (r, s) = matrix
    return safe_divide(jnp.array([[s, -q], [-r, p]]), (p * s - q * r)[None, None])


def picked(values: Array, surface: Array) -> Array:
    """Of `values` (..., S + 1, W, B) those on a few surfaces (N, W, B)."""
    index = surface.reshape(*[1] * (values.ndim - 3), *surface.shape)
    return jnp.take_along_axis(values, index, axis=-3)


def units(like: Array) -> Array:
    """The vectors (1, 0) and (0, 1), (2, 2, W, B)."""
    return jnp.broadcast_to(jnp.eye(2, dtype=like.dtype)[..., None, None], (2, *like.shape))


def launched(lens: Lens, system: System, launch: Array) -> Rays:
    """Rays launched at points (2, W, B), mm on the vertex plane of the first row, and traced."""

    def trace(launch):
        found = shoot(system, tuple(launch))
        hits, status = on_all_surfaces(lens, system, *apart(system, found.hits), found.fate)
        return jnp.stack(hits), status

    def along(unit):
        (hits, status), (columns, _) = jax.jvp(trace, (launch,), (unit,))
        return hits, columns, status

    hits, columns, status = jax.vmap(along, out_axes=(None, 0, None))(units(launch))
    radius = lens.semi_diameter[lens.stop]
    aims = inverse(columns[:, :, lens.stop] / radius)
    moves = jnp.stack([moved(columns, a) for a in aims])
    return Rays(launch, hits[:, lens.stop] / radius, hits, aims, moves, status == Status.OK)


def gaps(lens: Lens, hits: Array, pair: Array) -> Array:
    """(2, W, B): |h|^2 / R^2 - 1 of the apertures of two surfaces; 0 on their edges."""
    hit = picked(hits, pair)
    return dot(hit, hit) / lens.semi_diameter[pair] ** 2 - 1


def rates(lens: Lens, rays: Rays, pair: Array) -> Array:
    """Derivatives (2, 2, W, B) of `gaps` by the point on the stop."""
    hit, moves = picked(rays.hits, pair), picked(rays.moves, pair)
    return jnp.stack([2 * dot(hit, m) / lens.semi_diameter[pair] ** 2 for m in moves])


def ends(lens: Lens, rays: Rays, goal: Goal) -> Array:
    """Where each aperture ends a half-line, (S + 1, W, B) in units of the stop's semi-diameter,
    if hits move in proportion to it; inf for one that never does."""
    scale = 1 / lens.semi_diameter[None, :, None, None]
    base = scale * (rays.hits + moved(rays.moves, goal.centre - rays.point))
    rate = scale * moved(rays.moves, goal.toward)
    square, linear, constant = dot(rate, rate), dot(base, rate), dot(base, base) - 1
    root = safe_sqrt(linear**2 - square * constant)
    out = linear > 0  # of the two ways to write a root, the one that does not subtract
    above = jnp.where(out, -constant, root - linear)
    return jnp.where(square > 0, safe_divide(above, jnp.where(out, linear + root, square)), jnp.inf)


def ahead(lens: Lens, rays: Rays, goal: Goal) -> tuple[Array, Array]:
    """How far (2, W, B) it is to the goal, and the surface (W, B) that ends the half-line."""
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


def search(lens: Lens, system: System, start: Rays, goal: Goal, steps: Array) -> Reached:
    """Newton's method from rays, to which it goes back half the way where one fails."""
    tiny = float(jnp.finfo(start.launch.dtype).eps) ** 0.5

    def step(state):
        count, rays, launch, done, _, _, _ = state
        new = launched(lens, system, launch)
        rays = jax.tree.map(lambda a, b: jnp.where(new.good & ~done, a, b), new, rays)
        change, surface = ahead(lens, rays, goal)
        back = rays.launch - launch
        settled = rays.good & (dot(change, change) <= tiny**2)
        lost = ~new.good & (dot(back, back) <= tiny**2 * (1 + dot(launch, launch)))
        onward = rays.launch + moved(rays.aims, change)
        launch = jnp.where(new.good[None], onward, launch + back / 2)
        return count + 1, rays, launch, done | settled | lost, change, surface, settled

    change, surface = ahead(lens, start, goal)
    launch, no = start.launch + moved(start.aims, change), jnp.zeros(surface.shape, bool)
    state = (0, start, launch, no, change, surface, no)
    state = jax.lax.while_loop(lambda s: (s[0] < steps) & ~jnp.all(s[3]), step, state)
    _, rays, _, _, change, surface, settled = state
    # The last step, which is small, on the model: right to its square.
    return Reached(shifted(rays, jnp.where(settled[None], change, 0)), goal, surface, settled)


def outside(lens: Lens, rays: Rays, point: Array) -> Array:
    """How far points are outside of the apertures that rays model, (W, B) in units of the stop's
    semi-diameter; negative inside."""
    hits = rays.hits + moved(rays.moves, point - rays.point)
    far = safe_sqrt(dot(hits, hits)) - lens.semi_diameter[:, None, None]
    rate = safe_sqrt((dot(rays.moves[0], rays.moves[0]) + dot(rays.moves[1], rays.moves[1])) / 2)
    return jnp.max(jnp.where(rate > 0, safe_divide(far, rate), -jnp.inf), axis=0)


def middle(lens: Lens, rays: Rays, scouts: Array) -> Array:
    """The point (2, W, 1) deepest inside all apertures by the model of one ray a colour."""

    def zoom(_, state):
        best, span = state
        points = best + span * scouts[:, None]
        index = jnp.argmin(outside(lens, rays, points), axis=-1)
        return jnp.take_along_axis(points, index[None, :, None], axis=-1), 0.4 * span

    start = jnp.zeros_like(rays.point), jnp.ones((), scouts.dtype)
    return jax.lax.fori_loop(0, _ZOOMS, zoom, start)[0]
