"""Quadrature fitted to the part of the pupil that clear apertures leave.

A rule on the whole stop whose clipped rays drop out one by one converges like a sum of pixels.
Here the boundary is found: in polar coordinates about a point inside, the distance to it is
smooth but for the corners where one aperture takes over from another. Gauss rules between the
corners and along the radii converge as on an open stop.

Every aperture, the stop's rim among them, is a circle: a ray passes if its hit h on that surface
has |h| <= R. Rays are launched, not aimed: a trace tells how the hits move with the point on the
stop; on this model, every aperture ends a half-line on the stop at the root of a quadratic; the
next ray is launched there. So each ray of the boundary takes a few steps of Newton's method.

Vectors are arrays with their 2 components first, and B rays a colour last.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import safe_divide, safe_sqrt
from ..rays.aim import paraxial_launch
from ..rays.fermat import arrival
from ..rays.snell import apart, shoot
from ..rays.solve import Found, reattach
from ..rays.status import Status
from ..rays.system import System, Vector, dot, system_of
from ..rays.trace import _whole
from .rules import PupilRule, Symmetry, check_order

__all__ = ["Clipped"]

# Corners that have a panel of their own, and what each gap between two of the even half-lines on
# which they are sought is divided into. A panel gets nodes by its width in half turns and `_EXTRA`.
_CORNERS, _PARTS, _EXTRA = 8, 32, 0.15
# Steps of each stage of the search, and rounds of that for the middle.
_STEPS, _ZOOMS = (1, 48, 48, 16, 48), 10


class _Rays(NamedTuple):
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

    def at(self, index: Array) -> "_Rays":
        """Those at `index` (W, B)."""

        def take(a):
            return jnp.take_along_axis(a, index.reshape(*[1] * (a.ndim - 2), *index.shape), axis=-1)

        return jax.tree.map(take, self)


class _Goal(NamedTuple):
    """Where rays are to go: to the end of a half-line, or to a corner.

    centre, toward: (2, W, B), start and direction of the half-line; 0: to the centre itself.
    pair: (2, W, B), the surfaces whose apertures meet in a corner; equal for none.
    """

    centre: Array
    toward: Array
    pair: Array


class _Found(NamedTuple):
    """Rays and their goals. surface: (W, B), that ends the half-line. settled: (W, B), whether the
    goal is met; else the ray is the last one before others fail."""

    rays: _Rays
    goal: _Goal
    surface: Array
    settled: Array


def _moved(rates: Array, change: Array) -> Array:
    """How far something moves with the point on the stop; `rates` (2, ..., W, B)."""
    x, y = change.reshape(2, *[1] * (rates.ndim - 3), *change.shape[1:])
    return rates[0] * x + rates[1] * y


def _inverse(matrix: Array) -> Array:
    """Of matrices (2, 2, W, B); 0 for those that have none."""
    (p, q), (r, s) = matrix
    return safe_divide(jnp.array([[s, -q], [-r, p]]), (p * s - q * r)[None, None])


def _picked(values: Array, surface: Array) -> Array:
    """Of `values` (..., S + 1, W, B) those on a few surfaces (N, W, B)."""
    index = surface.reshape(*[1] * (values.ndim - 3), *surface.shape)
    return jnp.take_along_axis(values, index, axis=-3)


def _units(like: Array) -> Array:
    """The vectors (1, 0) and (0, 1), (2, 2, W, B)."""
    return jnp.broadcast_to(jnp.eye(2, dtype=like.dtype)[..., None, None], (2, *like.shape))


def _launched(lens: Lens, system: System, launch: Array) -> _Rays:
    def trace(launch):
        found = shoot(system, tuple(launch))
        hits, status = _whole(lens, system, *apart(system, found.hits), found.fate)
        return jnp.stack(hits), status

    def along(unit):
        (hits, status), (columns, _) = jax.jvp(trace, (launch,), (unit,))
        return hits, columns, status

    hits, columns, status = jax.vmap(along, out_axes=(None, 0, None))(_units(launch))
    radius = lens.semi_diameter[lens.stop]
    aims = _inverse(columns[:, :, lens.stop] / radius)
    moves = jnp.stack([_moved(columns, a) for a in aims])
    return _Rays(launch, hits[:, lens.stop] / radius, hits, aims, moves, status == Status.OK)


def _gaps(lens: Lens, hits: Array, pair: Array) -> Array:
    """(2, W, B): |h|^2 / R^2 - 1 of the apertures of two surfaces; 0 on their edges."""
    hit = _picked(hits, pair)
    return dot(hit, hit) / lens.semi_diameter[pair] ** 2 - 1


def _rates(lens: Lens, rays: _Rays, pair: Array) -> Array:
    """Derivatives (2, 2, W, B) of `_gaps` by the point on the stop."""
    hit, moves = _picked(rays.hits, pair), _picked(rays.moves, pair)
    return jnp.stack([2 * dot(hit, m) / lens.semi_diameter[pair] ** 2 for m in moves])


def _ends(lens: Lens, rays: _Rays, goal: _Goal) -> Array:
    """Where each aperture ends a half-line, (S + 1, W, B) in units of the stop's semi-diameter,
    if hits move in proportion to it; inf for one that never does."""
    scale = 1 / lens.semi_diameter[None, :, None, None]
    base = scale * (rays.hits + _moved(rays.moves, goal.centre - rays.point))
    rate = scale * _moved(rays.moves, goal.toward)
    square, linear, constant = dot(rate, rate), dot(base, rate), dot(base, base) - 1
    root = safe_sqrt(linear**2 - square * constant)
    out = linear > 0  # of the two ways to write a root, the one that does not subtract
    above = jnp.where(out, -constant, root - linear)
    return jnp.where(square > 0, safe_divide(above, jnp.where(out, linear + root, square)), jnp.inf)


def _ahead(lens: Lens, rays: _Rays, goal: _Goal) -> tuple[Array, Array]:
    """How far (2, W, B) it is to the goal, and the surface (W, B) that ends the half-line."""
    ends = _ends(lens, rays, goal)
    length = jnp.where(dot(goal.toward, goal.toward) > 0, jnp.min(ends, axis=0), 0)
    inverse = _inverse(_rates(lens, rays, goal.pair))
    corner = -_moved(inverse, _gaps(lens, rays.hits, goal.pair))
    line = goal.centre + length[None] * goal.toward - rays.point
    change = jnp.where(goal.pair[:1] != goal.pair[1:], corner, line)
    return change, jnp.argmin(ends, axis=0).astype(jnp.int32)


def _shifted(rays: _Rays, change: Array) -> _Rays:
    """Rays through points (2, W, B) farther, by their model."""
    return rays._replace(
        launch=rays.launch + _moved(rays.aims, change),
        point=rays.point + change,
        hits=rays.hits + _moved(rays.moves, change),
    )


def _search(lens: Lens, system: System, start: _Rays, goal: _Goal, steps: Array) -> _Found:
    """Newton's method from rays, to which it goes back half the way where one fails."""
    tiny = float(jnp.finfo(start.launch.dtype).eps) ** 0.5

    def step(state):
        count, rays, launch, done, _, _, _ = state
        new = _launched(lens, system, launch)
        rays = jax.tree.map(lambda a, b: jnp.where(new.good & ~done, a, b), new, rays)
        change, surface = _ahead(lens, rays, goal)
        back = rays.launch - launch
        settled = rays.good & (dot(change, change) <= tiny**2)
        lost = ~new.good & (dot(back, back) <= tiny**2 * (1 + dot(launch, launch)))
        ahead = rays.launch + _moved(rays.aims, change)
        launch = jnp.where(new.good[None], ahead, launch + back / 2)
        return count + 1, rays, launch, done | settled | lost, change, surface, settled

    change, surface = _ahead(lens, start, goal)
    launch, no = start.launch + _moved(start.aims, change), jnp.zeros(surface.shape, bool)
    state = (0, start, launch, no, change, surface, no)
    state = jax.lax.while_loop(lambda s: (s[0] < steps) & ~jnp.all(s[3]), step, state)
    _, rays, _, _, change, surface, settled = state
    # The last step, which is small, on the model: right to its square.
    return _Found(_shifted(rays, jnp.where(settled[None], change, 0)), goal, surface, settled)


def _outside(lens: Lens, rays: _Rays, point: Array) -> Array:
    """How far points are outside of the apertures that rays model, (W, B) in units of the stop's
    semi-diameter; negative inside."""
    hits = rays.hits + _moved(rays.moves, point - rays.point)
    far = safe_sqrt(dot(hits, hits)) - lens.semi_diameter[:, None, None]
    rate = safe_sqrt((dot(rays.moves[0], rays.moves[0]) + dot(rays.moves[1], rays.moves[1])) / 2)
    return jnp.max(jnp.where(rate > 0, safe_divide(far, rate), -jnp.inf), axis=0)


def _middle(lens: Lens, rays: _Rays, scouts: Array) -> Array:
    """The point (2, W, 1) deepest inside all apertures by the model of one ray a colour."""

    def zoom(_, state):
        best, span = state
        points = best + span * scouts[:, None]
        index = jnp.argmin(_outside(lens, rays, points), axis=-1)
        return jnp.take_along_axis(points, index[None, :, None], axis=-1), 0.4 * span

    start = jnp.zeros_like(rays.point), jnp.ones((), scouts.dtype)
    return jax.lax.fori_loop(0, _ZOOMS, zoom, start)[0]


@functools.cache
def _taps() -> np.ndarray:
    """Weights (6, _PARTS + 1) that interpolate between the two middle ones of 6 even values."""
    t, knots = np.linspace(0, 1, _PARTS + 1), np.arange(-2, 4)
    rows = [(knot, np.delete(knots, k)[:, None]) for k, knot in enumerate(knots)]
    return np.array([np.prod((t - others) / (knot - others), axis=0) for knot, others in rows])


def _changes(ends: Array, disc: bool) -> tuple[Array, Array]:
    """Where one aperture takes over from another, from their `ends` (S + 1, W, B) of even spokes:
    places (W, C) in gaps between spokes, and the two surfaces (2, W, C), equal for no corner."""
    last = ends.shape[-1] - 1
    index = np.arange(last)[:, None] + np.arange(-2, 4)
    index = index % last if disc else last - abs(last - abs(index))
    # Beyond 4 it ends nothing.
    ends = jnp.clip(ends, 0, 4)[..., index] @ jnp.asarray(_taps(), ends.dtype)
    ends = jnp.stack([ends[..., :-1], ends[..., 1:]]).reshape(2, *ends.shape[:2], -1)
    first = jnp.argmin(ends, axis=1).astype(jnp.int32)
    find = functools.partial(jnp.nonzero, size=_CORNERS, fill_value=0)
    place = jax.vmap(lambda change: find(change)[0])(first[0] != first[1])
    pair = jnp.take_along_axis(first, place[None], axis=-1)
    near = _picked(jnp.take_along_axis(ends, place[None, None], axis=-1), pair)
    start, end = near[:, 1] - near[:, 0]  # by how far the second aperture is beyond the first
    part = jnp.clip(safe_divide(start, start - end), 0, 1)
    return (place.astype(part.dtype) + part) / _PARTS, pair


@functools.cache
def _gauss(most: int) -> np.ndarray:
    """Gauss nodes on [0, 1] and weights, (2, most + 1, most): in row n those of n, then zeros."""
    table = np.zeros((2, most + 1, most))
    for n in range(1, most + 1):
        nodes, weights = np.polynomial.legendre.leggauss(n)
        table[:, n, :n] = (1 + nodes) / 2, weights / 2
    return table


def _unit(angle: Array) -> Array:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


@dataclasses.dataclass(frozen=True)
class _Spokes:
    """Half-lines about a point: `count` places for them, B."""

    symmetry: Symmetry
    count: int

    @property
    def turn(self) -> float:
        """The azimuths there are, radians from -pi/2."""
        return 2 * np.pi if self.symmetry == "disc" else np.pi

    @property
    def even(self) -> np.ndarray:
        """Azimuths (B,) of even spokes, ends included; the meridian's is y > 0."""
        axial = self.symmetry == "meridian"
        return np.linspace(-np.pi / 2 + axial * np.pi, self.turn - np.pi / 2, self.count)

    def nearest(self, angle: Array) -> Array:
        """Which of the even spokes is nearest to an azimuth."""
        index = jnp.round((angle + np.pi / 2) * ((self.count - 1) / self.turn))
        return jnp.clip(index.astype(jnp.int32), 0, self.count - 1)

    def scouts(self) -> np.ndarray:
        """Points (2, B) all over the stop, and a little beyond its rim."""
        k = np.arange(self.count) + 0.5
        if self.symmetry == "disc":
            angle = np.pi * (1 + 5**0.5) * k
            return 1.2 * np.sqrt(k / self.count) * np.stack([np.cos(angle), np.sin(angle)])
        return np.stack([0 * k, 1.2 * (2 * k / self.count - 1)])

    def nodes(
        self, used: Array, centre: Array, corner: Array, exists: Array
    ) -> tuple[Array, Array]:
        """Azimuths (W, B) and their weights, which add up to 1: `used` Gauss nodes between the
        corners (2, W, C) that exist, about a centre (2, W, 1); more in a wide gap."""
        low, turn = -np.pi / 2, self.turn
        if self.symmetry == "meridian":
            return jnp.full_like(centre[0], np.pi / 2), jnp.ones_like(centre[0])
        x, y = jnp.where(exists[None], corner - centre, 1)
        angle = jnp.where(exists, (jnp.arctan2(y, x) - low) % (2 * np.pi), turn)
        angle = jnp.sort(jnp.clip(angle, 0, turn), axis=-1)
        ends = jnp.pad(angle, ((0, 0), (1, 1)), constant_values=((0, 0), (0, turn)))
        width = jnp.diff(ends, axis=-1)
        need = jax.lax.stop_gradient(jnp.where(width > 0, width / np.pi + _EXTRA, 0))
        need = jnp.cumsum(need, axis=-1)
        last = jnp.round(used.astype(need.dtype) * need / need[:, -1:]).astype(jnp.int32)
        slot = jnp.arange(self.count, dtype=jnp.int32)[None]
        panel = jnp.sum(slot[..., None] >= last[:, None], axis=-1, dtype=jnp.int32)
        # Behind the last panel there are no nodes, and no weight.
        last = jnp.pad(last, ((0, 0), (1, 1)))
        begin, end = (jnp.take_along_axis(last, panel + k, axis=-1) for k in (0, 1))
        table = jnp.asarray(_gauss(self.count), width.dtype)
        node, weight = table[:, jnp.maximum(end - begin, 0), slot - begin]
        panel = jnp.minimum(panel, width.shape[-1] - 1)
        start, wide = (jnp.take_along_axis(a, panel, axis=-1) for a in (ends, width))
        return low + start + wide * node, wide * weight / turn


def _stages(lens: Lens, system: System, spokes: _Spokes, used: Array) -> list:
    """The stages of the search: each takes what they found, the stages along a first axis, and
    tells the rays to start from and their goals."""
    like = jnp.zeros((2, system.index.shape[1], spokes.count), system.index.dtype)
    of = lambda found, stage: jax.tree.map(lambda a: a[stage], found)  # noqa: E731
    scouts = jnp.asarray(spokes.scouts(), like.dtype)

    def goal(centre, toward=None, pair=None):
        toward = like if toward is None else toward
        return _Goal(like + centre, toward, like.astype(jnp.int32) if pair is None else pair)

    def scout(found):  # all over the stop, to where paraxial optics puts them
        radius = lens.semi_diameter[lens.stop]
        launch = paraxial_launch(system, tuple(like + radius * scouts[:, None]), 4 * radius)
        return of(found.rays, 0)._replace(launch=jnp.stack(launch)), goal(like)

    def middle(found):  # all to the point deepest inside, by the model of the best scout
        rays = of(found.rays, 0)
        far = jnp.where(rays.good, _outside(lens, rays, rays.point), jnp.inf)
        best = jnp.argmin(far, axis=-1)[:, None]
        rays = rays.at(best)
        return rays.at(like[0].astype(jnp.int32)), goal(_middle(lens, rays, scouts))

    def ends(found):  # to the ends of even spokes
        rays = of(found.rays, 1)
        return rays, goal(rays.point, like + _unit(jnp.asarray(spokes.even, like.dtype))[:, None])

    def corners(found):  # to the corners, in the first places
        even = of(found, 2)
        place, pair = _changes(_ends(lens, even.rays, even.goal), spokes.symmetry == "disc")
        more = (0, spokes.count - _CORNERS)
        place, pair = jnp.pad(place, ((0, 0), more)), jnp.pad(pair, ((0, 0), (0, 0), more))
        rays = even.rays.at(jnp.round(place).astype(jnp.int32))
        angle = place * (spokes.turn / (spokes.count - 1)) - np.pi / 2
        line = _ahead(lens, rays, goal(even.goal.centre, _unit(angle)))[0]
        return _shifted(rays, line), goal(even.goal.centre, None, pair)

    def nodes(found):  # to the ends of the spokes of the rule
        rays, found = of(found.rays, 2), of(found, 3)
        corner, exists = found.rays.point[..., :_CORNERS], _exists(lens, found)[:, :_CORNERS]
        angle, _ = spokes.nodes(used, found.goal.centre[..., :1], corner, exists)
        return rays.at(spokes.nearest(angle)), goal(found.goal.centre, _unit(angle))

    return [scout, middle, ends, corners, nodes][: 3 if spokes.symmetry == "meridian" else 5]


def _exists(lens: Lens, found: _Found) -> Array:
    """Whether rays (W, B) lie in corners of the boundary, or near it."""
    inside = _outside(lens, found.rays, found.rays.point) < 0.01
    return found.settled & inside & (found.goal.pair[0] != found.goal.pair[1])


def _find(lens: Lens, system: System, spokes: _Spokes, used: Array) -> _Found:
    """What the stages find, one after the other, along a first axis."""
    stages = _stages(lens, system, spokes, used)

    def several(shape, dtype=system.index.dtype):
        return jnp.zeros((len(stages), *shape, system.index.shape[1], spokes.count), dtype)

    point, rates, rows = several((2,)), several((2, 2)), lens.count + 1
    hits, moves, no = several((2, rows)), several((2, 2, rows)), several((), bool)
    goal = _Goal(point, point, several((2,), jnp.int32))
    rays = _Rays(point, point, hits, rates, moves, no)

    def run(stage, found):
        start, goal = jax.lax.switch(stage, stages, found)
        new = _search(lens, system, start, goal, jnp.array(_STEPS, jnp.int32)[stage])
        return jax.tree.map(lambda a, b: a.at[stage].set(b), found, new)

    start = _Found(rays, goal, several((), jnp.int32), no)
    return jax.lax.fori_loop(0, len(stages), run, start)


class _Plan(NamedTuple):
    """The boundary without derivatives: C corners and B spokes, K = C + B rays.

    centre: (2, W, 1). point: (2, W, K) in units of the stop's semi-diameter. hits: 2 arrays (R, W,
    K) on the rows of a system, mm. pair: (2, W, K), the apertures that end a ray, for a spoke both
    the same. rates: (2, 2, W, K), see `_rates`. follows: (W, K), whether a ray follows the lens.
    passes: (W, 1), whether light passes. used: (), how many spokes count.
    """

    centre: Array
    point: Array
    hits: Vector
    pair: Array
    rates: Array
    follows: Array
    passes: Array
    used: Array


def _plan(lens: Lens, scene: Scene, spokes: _Spokes, used: Array) -> _Plan:
    found = _find(lens, system_of(lens, scene), spokes, used)
    middle, nodes = (jax.tree.map(lambda a: a[k], found) for k in (1, -1))
    passes = middle.settled & (_outside(lens, middle.rays, middle.rays.point) < 0)
    rays, pair, follows = nodes.rays, jnp.stack([nodes.surface] * 2), nodes.settled
    if spokes.symmetry != "meridian":
        corners = jax.tree.map(lambda a: a[3, ..., :_CORNERS], found)
        join = lambda a, b: jnp.concatenate([a, b], axis=-1)  # noqa: E731
        rays, pair = jax.tree.map(join, corners.rays, rays), join(corners.goal.pair, pair)
        follows = join(_exists(lens, corners), follows)
    follows = follows & passes[:, :1]
    hits = jnp.where(follows, rays.hits[:, np.array([*lens.live, lens.count])], 0)
    centre, rates = middle.rays.point[..., :1], _rates(lens, rays, pair)
    return _Plan(centre, rays.point, tuple(hits), pair, rates, follows, passes[:, :1], used)


def _followed(plan: _Plan, lens: Lens, scene: Scene, point: Array) -> Array:
    """`_gaps` of the rays of a plan through points (2, W, K)."""
    system = system_of(lens, scene)
    target = tuple(lens.semi_diameter[lens.stop] * point)
    status = jnp.where(plan.follows, Status.OK, Status.MISSED).astype(jnp.int32)
    known = Found(plan.hits, arrival(plan.hits, system), status, jnp.int32(0))
    hits = reattach(known, system, target).hits
    return _gaps(lens, jnp.stack(_whole(lens, system, hits, target, status)[0]), plan.pair)


@jax.custom_jvp
def _known_rates(lens: Lens, scene: Scene, point: Array, plan: _Plan) -> Array:
    """Derivatives of `_followed` by the point: known numbers, only theirs cost anything."""
    return plan.rates


@_known_rates.defjvp
def _known_rates_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    def rates(lens, scene, point):
        gaps = functools.partial(_followed, primals[3], lens, scene)
        return jax.vmap(lambda unit: jax.jvp(gaps, (point,), (unit,))[1])(_units(point))

    return jax.jvp(rates, primals[:3], tangents[:3])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _follow(spokes: _Spokes, lens: Lens, scene: Scene, plan: _Plan) -> Array:
    """The points of a plan with their derivatives by the lens and the scene, in every mode."""
    return plan.point


@_follow.defjvp
def _follow_jvp(spokes: _Spokes, primals: Any, tangents: Any) -> tuple[Array, Array]:
    lens, scene, plan = primals
    # Through the function itself, so that the points carry derivatives of their own.
    point = _follow(spokes, lens, scene, plan)
    rates = _known_rates(lens, scene, point, plan)
    gaps = lambda lens, scene: _followed(plan, lens, scene, point)  # noqa: E731
    _, change = jax.jvp(gaps, (lens, scene), tangents[:2])
    corners, ends = (slice(None, -spokes.count), slice(-spokes.count, None))
    # A corner stays on both apertures.
    corner = -_moved(_inverse(rates[..., corners]), change[..., corners])
    corner = jnp.where(plan.follows[:, corners], corner, 0)
    # A spoke turns with the corners, and ends on its aperture.
    nodes = lambda corner: spokes.nodes(plan.used, plan.centre, corner, plan.follows[:, corners])[0]  # noqa: E731
    angle, turned = jax.jvp(nodes, (point[..., corners],), (corner,))
    line, toward = point[..., ends] - plan.centre, _unit(angle)
    side = jnp.stack([-line[1] * turned, line[0] * turned])
    rate = rates[:, 0, :, ends]
    longer = -safe_divide(change[0, :, ends] + dot(rate, side), dot(rate, toward))
    longer = jnp.where(plan.follows[:, ends], longer, 0)
    return point, jnp.concatenate([corner, side + longer[None] * toward], axis=-1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Clipped(PupilRule):
    """Gauss rules between the corners of the boundary and along the radii to it.

    order: nodes along a radius.
    symmetry: see `symmetry_of`.
    size: the order up to which weightless rays fill up, so that orders share a compiled program.
    """

    order: int
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})
    size: int = dataclasses.field(metadata={"static": True}, default=0)

    def __post_init__(self) -> None:
        if not self.size:
            check_order(self.order)
            object.__setattr__(self, "size", self.order)

    def points(self, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
        """Points and weights, which follow the lens."""
        axial = self.symmetry == "meridian"
        part = {"meridian": 0, "half": 1, "disc": 2}[self.symmetry]
        used, most = (part * (2 * n + 6) for n in (self.order, self.size))
        spokes = _Spokes(self.symmetry, max(most, 32 * part) + 1)
        given = *jax.lax.stop_gradient((lens, scene)), spokes, jnp.asarray(used, jnp.int32)
        plan = jax.lax.stop_gradient(_plan(*given))
        point = _follow(spokes, lens, scene, plan)
        corner, end = point[..., : -spokes.count], point[..., -spokes.count :]
        follows = plan.follows[:, : -spokes.count]
        angle, share = spokes.nodes(plan.used, plan.centre, corner, follows)
        toward = _unit(angle)
        length = dot(toward, end - plan.centre)
        node, weight = jnp.asarray(_gauss(self.size), length.dtype)[:, self.order, None, None]
        # On the axis r^2 is the variable, as without clipping.
        node, weight = (jnp.sqrt(node), weight) if axial else (node, 2 * node * weight)
        weight = jnp.where(plan.passes, share * length**2, 0)[..., None] * weight
        points = plan.centre[..., None] + (length[..., None] * node)[None] * toward[..., None]
        points = points.reshape(2, len(length), -1)
        return tuple(points[1:] if axial else points), weight.reshape(len(length), -1)
