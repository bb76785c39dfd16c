"""Quadrature fitted to the part of the pupil that clear apertures leave.

A rule on the whole stop whose clipped rays drop out one by one converges like a sum of pixels.
Here the boundary is found: in polar coordinates about a point inside, the distance to it is
smooth but for the corners where one aperture takes over from another. Gauss rules between the
corners and along the radii converge as on an open stop.

Every aperture, the stop's rim among them, is a circle: a ray passes if its hit h on that surface
has |h| <= R. Rays are launched, not aimed: a trace with its derivatives tells how the hits move
with the point on the stop, on this model every aperture ends a straight line on the stop at a
root of a quadratic, and the next ray is launched there: Newton's method, one trace a step.
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

# Corners that have a panel of their own; half-lines on half a pupil along which they are sought,
# at least, and what each gap between them is divided into.
_CORNERS, _SPOKES, _PARTS = 8, 33, 16
# A panel gets spokes by its width in half turns, and this.
_EXTRA = 0.15
# Rounds of the search for the middle; steps of the search for each of the stages, see `_STAGES`.
_ZOOMS, _STEPS = 10, (1, 48, 48, 16, 48)


class _Rays(NamedTuple):
    """Launched rays, and how they move with their points on the stop.

    launch: 2 arrays (W, B), mm. point: 2 arrays (W, B) in units of the stop's semi-diameter.
    hits: 2 arrays (S + 1, W, B), mm. aims, moves: derivatives of `launch` and `hits` by the two
    components of `point`. good: (W, B), whether they reach the sensor.
    """

    launch: Vector
    point: Vector
    hits: Vector
    aims: tuple[Vector, Vector]
    moves: tuple[Vector, Vector]
    good: Array

    def at(self, index: Array) -> "_Rays":
        """Those at `index` (W, any number)."""

        def take(a):
            return jnp.take_along_axis(a, index.reshape(*[1] * (a.ndim - 2), *index.shape), axis=-1)

        return jax.tree.map(take, self)


class _Goal(NamedTuple):
    """Where rays are to go: to the end of a half-line, or to a corner.

    centre, toward: 2 arrays (W, B), start and direction of the half-line; 0: to the centre itself.
    pair: (2, W, B), the surfaces whose apertures meet in a corner; equal for none.
    """

    centre: Vector
    toward: Vector
    pair: Array


class _Found(NamedTuple):
    """Rays at their goals. surface: (W, B), that ends the half-line. settled: (W, B), whether the
    goal is met; else the ray is the last one before others fail."""

    rays: _Rays
    goal: _Goal
    surface: Array
    settled: Array


def _plus(vector: Vector, rates: tuple[Vector, Vector], change: Vector) -> Vector:
    """A vector that moves with the point on the stop, after a change of that."""
    x, y = (c.reshape(*[1] * (vector[0].ndim - c.ndim), *c.shape) for c in change)
    return tuple(v + a * x + b * y for v, a, b in zip(vector, *rates, strict=True))


def _minus(a: Vector, b: Vector) -> Vector:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def _chosen(condition: Array, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _solved(rows: Any, values: Vector) -> Vector:
    """x with rows x = values, 2 x 2; 0 where that has no answer."""
    ((p, q), (r, s)), (f, g) = rows, values
    determinant = p * s - q * r
    return safe_divide(s * f - q * g, determinant), safe_divide(p * g - r * f, determinant)


def _units(like: Vector) -> Vector:
    one, none = jnp.ones_like(like[0]), jnp.zeros_like(like[0])
    return jnp.stack([one, none]), jnp.stack([none, one])


def _launched(lens: Lens, system: System, launch: Vector) -> _Rays:
    def trace(launch):
        found = shoot(system, launch)
        hits, crossing = apart(system, found.hits)
        return _whole(lens, system, hits, crossing, found.fate)

    def along(unit):
        (hits, status), (columns, _) = jax.jvp(trace, (launch,), (unit,))
        return hits, columns, status

    hits, columns, status = jax.vmap(along, out_axes=(None, 0, None))(_units(launch))
    radius = lens.semi_diameter[lens.stop]
    rows = tuple((c[0, lens.stop] / radius, c[1, lens.stop] / radius) for c in columns)
    one, none = jnp.ones_like(launch[0]), jnp.zeros_like(launch[0])
    aims = _solved(rows, (one, none)), _solved(rows, (none, one))
    moves: Any = tuple(tuple(c[0] * x[None] + c[1] * y[None] for c in columns) for x, y in aims)
    return _Rays(
        launch, tuple(h[lens.stop] / radius for h in hits), hits, aims, moves, status == Status.OK
    )


def _picked(values: Array, surface: Array) -> Array:
    """Of `values` (S + 1, W, B) those on `surface` (W, B)."""
    return jnp.take_along_axis(values, surface[None], axis=0)[0]


def _gaps(lens: Lens, hits: Vector, moves: Any, pair: Array) -> list[tuple[Array, Vector]]:
    """|h|^2 / R^2 - 1 of two apertures, (W, B), and its derivatives by the point on the stop."""
    gaps = []
    for surface in pair:
        square = lens.semi_diameter[surface] ** 2
        hit = tuple(_picked(h, surface) for h in hits)
        rates = (tuple(_picked(m, surface) for m in move) for move in moves)
        gaps.append((dot(hit, hit) / square - 1, tuple(2 * dot(hit, a) / square for a in rates)))
    return gaps


def _ends(lens: Lens, rays: _Rays, goal: _Goal) -> Array:
    """Where each aperture ends a half-line, (S + 1, W, B) in units of the stop's semi-diameter,
    hits moving in proportion to it; inf for one that never does."""
    scale = 1 / lens.semi_diameter[:, None, None]
    base = tuple(scale * a for a in _plus(rays.hits, rays.moves, _minus(goal.centre, rays.point)))
    u, v = (a[None] for a in goal.toward)
    rate = tuple(scale * (a * u + b * v) for a, b in zip(*rays.moves, strict=True))
    square, linear, constant = dot(rate, rate), dot(base, rate), dot(base, base) - 1
    root = safe_sqrt(linear**2 - square * constant)
    out = linear > 0  # of the two ways to write a root, the one that does not subtract
    above = jnp.where(out, -constant, root - linear)
    return jnp.where(square > 0, safe_divide(above, jnp.where(out, linear + root, square)), jnp.inf)


def _next(lens: Lens, rays: _Rays, goal: _Goal) -> tuple[Vector, Array]:
    """The point to go to, and the surface (W, B) that ends a half-line."""
    ends = _ends(lens, rays, goal)
    length = jnp.where(dot(goal.toward, goal.toward) > 0, jnp.min(ends, axis=0), 0)
    (f, row), (g, other) = _gaps(lens, rays.hits, rays.moves, goal.pair)
    corner = _minus(rays.point, _solved((row, other), (f, g)))
    end = tuple(c + length * u for c, u in zip(goal.centre, goal.toward, strict=True))
    point = _chosen(goal.pair[0] != goal.pair[1], corner, end)
    return point, jnp.argmin(ends, axis=0).astype(jnp.int32)


def _search(
    lens: Lens, system: System, start: _Rays, launch: Vector, goal: _Goal, steps: Array
) -> _Found:
    """Newton's method from `launch`; `start` are the rays to go back to where one fails."""
    tiny = float(jnp.finfo(launch[0].dtype).eps) ** 0.5

    def step(state):
        count, rays, launch, done, _, _, _ = state
        new = _launched(lens, system, launch)
        rays = _chosen(new.good & ~done, new, rays)
        point, surface = _next(lens, rays, goal)
        change, gap = _minus(point, rays.point), _minus(launch, rays.launch)
        settled = rays.good & (dot(change, change) <= tiny**2)
        lost = ~new.good & (dot(gap, gap) <= tiny**2 * (1 + dot(launch, launch)))
        half = tuple((a + b) / 2 for a, b in zip(launch, rays.launch, strict=True))
        launch = _chosen(new.good, _plus(rays.launch, rays.aims, change), half)
        return count + 1, rays, launch, done | settled | lost, change, surface, settled

    no = jnp.zeros(launch[0].shape, bool)
    state = (0, start, launch, no, start.point, no.astype(jnp.int32), no)
    state = jax.lax.while_loop(lambda s: (s[0] < steps) & ~jnp.all(s[3]), step, state)
    _, rays, _, _, change, surface, settled = state
    # The last step, which is small, on the model: right to its square.
    change = tuple(jnp.where(settled, a, 0) for a in change)
    rays = rays._replace(
        launch=_plus(rays.launch, rays.aims, change),
        point=tuple(a + b for a, b in zip(rays.point, change, strict=True)),
        hits=_plus(rays.hits, rays.moves, change),
    )
    return _Found(rays, goal, surface, settled)


def _outside(lens: Lens, rays: _Rays, point: Vector) -> Array:
    """How far points are outside of the apertures that rays model, (W, B) in units of the stop's
    semi-diameter; negative inside."""
    hits = _plus(rays.hits, rays.moves, _minus(point, rays.point))
    far = safe_sqrt(dot(hits, hits)) - lens.semi_diameter[:, None, None]
    rate = safe_sqrt((dot(rays.moves[0], rays.moves[0]) + dot(rays.moves[1], rays.moves[1])) / 2)
    return jnp.max(jnp.where(rate > 0, safe_divide(far, rate), -jnp.inf), axis=0)


def _middle(lens: Lens, rays: _Rays, grid: np.ndarray) -> Vector:
    """The point deepest inside all apertures by the model of one ray, 2 arrays (W, 1)."""

    def zoom(_, state):
        best, span = state
        points = tuple(b + span * jnp.asarray(g, span.dtype)[None] for b, g in zip(best, grid))
        index = jnp.argmin(_outside(lens, rays, points), axis=-1)[:, None]
        return tuple(jnp.take_along_axis(p, index, axis=-1) for p in points), 0.4 * span

    zero = jnp.zeros_like(rays.point[0])
    return jax.lax.fori_loop(0, _ZOOMS, zoom, ((zero, zero), jnp.ones_like(zero)))[0]


@functools.cache
def _taps() -> np.ndarray:
    """Weights (6, _PARTS + 1) that interpolate between the two middle ones of 6 even values."""
    t, knots = np.linspace(0, 1, _PARTS + 1), np.arange(-2, 4)
    rows = [(knot, np.delete(knots, k)[:, None]) for k, knot in enumerate(knots)]
    return np.array([np.prod((t - others) / (knot - others), axis=0) for knot, others in rows])


def _changes(ends: Array, half: bool) -> tuple[Array, Array]:
    """Where one aperture takes over from another, from their `ends` (S + 1, W, B) of even spokes:
    places (W, C) in gaps between spokes, and the two surfaces (2, W, C), equal where there is no
    corner."""
    waves, spokes = ends.shape[1:]
    index = np.arange(spokes - half)[:, None] + np.arange(-2, 4)
    index = (spokes - 1) - abs((spokes - 1) - abs(index)) if half else index % spokes
    # Beyond 4 it ends nothing.
    ends = jnp.clip(ends, 0, 4)[..., index] @ jnp.asarray(_taps(), ends.dtype)
    first = jnp.argmin(ends, axis=0).astype(jnp.int32)
    sides = [slice(None, -1), slice(1, None)]
    before, after = (first[..., s].reshape(waves, -1) for s in sides)
    find = functools.partial(jnp.nonzero, size=min(_CORNERS, before.shape[1]), fill_value=0)
    place = jax.vmap(lambda change: find(change)[0])(before != after)
    pair = jnp.stack([jnp.take_along_axis(a, place, axis=-1) for a in (before, after)])

    def excess(side):  # by how far the aperture behind is beyond the one before
        own = ends[..., side].reshape(len(ends), waves, -1)
        own = jnp.take_along_axis(own, place[None], axis=-1)
        return _picked(own, pair[1]) - _picked(own, pair[0])

    start, end = map(excess, sides)
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


def _unit(angle: Array) -> Vector:
    return jnp.cos(angle), jnp.sin(angle)


@dataclasses.dataclass(frozen=True)
class _Spokes:
    """Half-lines about a centre: B places for them, of which `used` count (may be traced)."""

    symmetry: Symmetry
    count: int
    used: Any

    @property
    def low(self) -> float:
        """The first azimuth, radians."""
        return np.pi / 2 if self.symmetry == "meridian" else -np.pi / 2

    @property
    def turn(self) -> float:
        """The azimuths there are, radians."""
        return 2 * np.pi if self.symmetry == "disc" else np.pi

    @property
    def gap(self) -> float:
        """Between even spokes: on half a pupil, the first and the last lie on the axis."""
        return self.turn / max(self.count - (self.symmetry != "disc"), 1)

    def scouts(self) -> tuple[np.ndarray, np.ndarray]:
        """Points (2, B) on the stop from which the middle is sought, and offsets (2, G) to try."""
        if self.symmetry == "meridian":
            return np.zeros((2, 1)), np.zeros((2, 1))
        side = np.linspace(-1, 1, 9)
        if self.symmetry == "half":
            line = np.linspace(-1.2, 1.2, self.count)
            return np.stack([0 * line, line]), np.stack([0 * side, side])
        k = np.arange(self.count) + 0.5
        radius, angle = 1.2 * np.sqrt(k / self.count), np.pi * (1 + 5**0.5) * k
        grid = np.stack(np.meshgrid(side, side)).reshape(2, -1)
        return radius * np.stack([np.cos(angle), np.sin(angle)]), grid

    def nearest(self, angle: Array) -> Array:
        """The even spoke that is nearest to an azimuth."""
        index = jnp.round((angle - self.low) / self.gap).astype(jnp.int32)
        if self.symmetry == "disc":
            return index % self.count
        return jnp.clip(index, 0, self.count - 1)

    def nodes(self, centre: Vector, corner: Vector, exists: Array) -> tuple[Array, Array]:
        """Azimuths (W, B) and their weights, which add up to 1: Gauss nodes between the corners, 2
        arrays (W, C), that exist; more in a wide gap."""
        low = jnp.full_like(centre[0], self.low)
        if self.symmetry == "meridian":
            return low, jnp.ones_like(low)
        x, y = (jnp.where(exists, a, 1) for a in _minus(corner, centre))
        angle, disc = jnp.arctan2(y, x), self.symmetry == "disc"
        angle = low + (angle - low) % self.turn if disc else jnp.clip(angle, low, low + self.turn)
        angle = jnp.sort(jnp.where(exists, angle, jnp.inf), axis=-1)
        first = jnp.where(disc & jnp.any(exists, -1, keepdims=True), angle[:, :1], low)
        ends = jnp.concatenate([first, angle, first + self.turn], axis=-1)
        ends = jnp.minimum(ends, first + self.turn)
        width = ends[:, 1:] - ends[:, :-1]
        need = jax.lax.stop_gradient(jnp.where(width > 0, width / np.pi + _EXTRA, 0))
        total = jnp.cumsum(need, axis=-1)
        last = jnp.round(self.used * total / total[:, -1:]).astype(jnp.int32)
        slot = jnp.arange(self.count, dtype=jnp.int32)
        panel = jnp.sum(slot[None, :, None] >= last[:, None], axis=-1, dtype=jnp.int32)
        # Behind the last panel there are no nodes, and no weight.
        last = jnp.pad(last, ((0, 0), (1, 1)))
        begin, end = (jnp.take_along_axis(last, panel + k, axis=-1) for k in (0, 1))
        table = jnp.asarray(_gauss(self.count), width.dtype)
        node, weight = table[:, jnp.maximum(end - begin, 0), slot[None] - begin]
        panel = jnp.minimum(panel, width.shape[-1] - 1)
        start, wide = (jnp.take_along_axis(a, panel, axis=-1) for a in (ends, width))
        return start + wide * node, wide * weight / self.turn


@dataclasses.dataclass(frozen=True)
class _Boundary:
    """The search for the boundary. A stage takes what is found so far, a first axis for the stages,
    and tells the rays from which to start, where to launch the first, and their goals."""

    lens: Lens
    system: System
    spokes: _Spokes

    def find(self) -> _Found:
        """What the stages find, one after the other."""
        stages = [self.scout, self.middle, self.ends, self.corners, self.nodes]
        stages = stages[: 3 if self.spokes.symmetry == "meridian" else 5]

        def run(stage, found):
            start, launch, goal = jax.lax.switch(stage, stages, found)
            new = _search(self.lens, self.system, start, launch, goal, jnp.asarray(_STEPS)[stage])
            return jax.tree.map(lambda a, b: a.at[stage].set(b), found, new)

        def several(shape, dtype=self.system.index.dtype):
            waves, count = self.system.index.shape[1], self.spokes.count
            return jnp.zeros((len(stages), *shape, waves, count), dtype)

        point, hits = (several(()),) * 2, (several((self.lens.count + 1,)),) * 2
        no, none = several((), bool), several((), jnp.int32)
        rays = _Rays(point, point, hits, (point,) * 2, (hits,) * 2, no)
        found = _Found(rays, _Goal(point, point, jnp.stack([none, none], 1)), none, no)
        return jax.lax.fori_loop(0, len(stages), run, found)

    def _goal(self, like, centre, toward=None, pair=None) -> _Goal:
        zero = jnp.zeros_like(like[0])
        toward = (zero, zero) if toward is None else toward
        pair = jnp.zeros((2, *zero.shape), jnp.int32) if pair is None else pair
        return _Goal(tuple(zero + c for c in centre), toward, pair)

    def _onward(self, rays: _Rays, goal: _Goal) -> tuple:
        point, _ = _next(self.lens, rays, goal)
        return rays, _plus(rays.launch, rays.aims, _minus(point, rays.point)), goal

    def scout(self, found: _Found) -> tuple:
        """Rays all over the stop, to where paraxial optics puts them."""
        rays = jax.tree.map(lambda a: a[0], found.rays)
        radius = self.lens.semi_diameter[self.lens.stop]
        points = (jnp.asarray(s, radius.dtype)[None] * radius for s in self.spokes.scouts()[0])
        target = tuple(p + zero for p, zero in zip(points, rays.point, strict=True))
        launch = paraxial_launch(self.system, target, 4 * radius)
        return rays, launch, self._goal(rays.point, rays.point)

    def middle(self, found: _Found) -> tuple:
        """All to the point deepest inside, by the model of the best scout."""
        rays = jax.tree.map(lambda a: a[0], found.rays)
        far = jnp.where(rays.good, _outside(self.lens, rays, rays.point), jnp.inf)
        best = jnp.argmin(far, axis=-1)[:, None]
        centre = _middle(self.lens, rays.at(best), self.spokes.scouts()[1])
        rays = rays.at(jnp.broadcast_to(best, far.shape))
        return self._onward(rays, self._goal(rays.point, centre))

    def ends(self, found: _Found) -> tuple:
        """To the ends of even spokes."""
        rays = jax.tree.map(lambda a: a[1], found.rays)
        even = self.spokes.low + self.spokes.gap * np.arange(self.spokes.count)
        angle = jnp.broadcast_to(jnp.asarray(even, rays.point[0].dtype), rays.good.shape)
        return self._onward(rays, self._goal(rays.point, rays.point, _unit(angle)))

    def corners(self, found: _Found) -> tuple:
        """To the corners, the first of the rays."""
        spokes = jax.tree.map(lambda a: a[2], found)
        ends = _ends(self.lens, spokes.rays, spokes.goal)
        place, pair = _changes(ends, self.spokes.symmetry == "half")
        more = (0, self.spokes.count - place.shape[-1])
        place, pair = jnp.pad(place, ((0, 0), more)), jnp.pad(pair, ((0, 0), (0, 0), more))
        rays = spokes.rays.at(self.spokes.nearest(self.spokes.low + self.spokes.gap * place))
        return self._onward(rays, self._goal(rays.point, spokes.goal.centre, None, pair))

    def nodes(self, found: _Found) -> tuple:
        """To the ends of the spokes of the rule."""
        corners, rays = (
            jax.tree.map(lambda a: a[3], found),
            jax.tree.map(lambda a: a[2], found.rays),
        )
        centre = tuple(a[:, :1] for a in corners.goal.centre)
        there = tuple(a[:, :_CORNERS] for a in corners.rays.point)
        angle, _ = self.spokes.nodes(centre, there, _exists(self.lens, corners)[:, :_CORNERS])
        rays = rays.at(self.spokes.nearest(angle))
        return self._onward(rays, self._goal(rays.point, centre, _unit(angle)))


def _exists(lens: Lens, corners: _Found) -> Array:
    """Whether rays (W, B) lie in corners of the boundary."""
    eps = float(jnp.finfo(corners.rays.point[0].dtype).eps)
    rays, pair = corners.rays, corners.goal.pair
    inside = _outside(lens, rays, rays.point) < 100 * eps**0.5
    return corners.settled & inside & (pair[0] != pair[1])


class _Plan(NamedTuple):
    """The boundary without derivatives: C corners and B spokes, K = C + B rays.

    centre: 2 arrays (W, 1). point: 2 arrays (W, K) in units of the stop's semi-diameter. hits: 2
    arrays (R, W, K) on the rows of a system, mm. pair: (2, W, K), the apertures that end a ray,
    for a spoke both the same. rates: of the gaps of both by the two components of `point`, (2, 2,
    W, K). follows: (W, K), whether the ray follows the lens. passes: (W, 1), whether light does.
    """

    centre: Vector
    point: Vector
    hits: Vector
    pair: Array
    rates: Array
    follows: Array
    passes: Array

    @property
    def corners(self) -> int:
        """C."""
        return self.pair.shape[-1]


def _plan(lens: Lens, scene: Scene, spokes: _Spokes) -> _Plan:
    found = _Boundary(lens, system_of(lens, scene), spokes).find()
    middle, nodes = (jax.tree.map(lambda a: a[k], found) for k in (1, -1))
    centre = tuple(a[:, :1] for a in middle.rays.point)
    inside = _outside(lens, middle.rays, middle.rays.point) < 0
    passes = (middle.settled & inside)[:, :1]
    rays, pair, follows = nodes.rays, jnp.stack([nodes.surface] * 2), nodes.settled
    if spokes.symmetry != "meridian":
        corners = jax.tree.map(lambda a: a[3, ..., :_CORNERS], found)
        join = lambda a, b: jnp.concatenate([a, b], axis=-1)  # noqa: E731
        follows = join(_exists(lens, corners), follows)
        rays, pair = jax.tree.map(join, corners.rays, rays), join(corners.goal.pair, pair)
    follows = follows & passes
    rates = jnp.stack([jnp.stack(r) for _, r in _gaps(lens, rays.hits, rays.moves, pair)], 1)
    rows = np.array([*lens.live, lens.count])
    hits = tuple(jnp.where(follows, h[rows], 0) for h in rays.hits)
    return _Plan(centre, rays.point, hits, pair, rates, follows, passes)


def _excess(plan: _Plan, lens: Lens, scene: Scene, point: Vector) -> Array:
    """|h|^2 / R^2 - 1 of the apertures that end the rays, (2, W, K); `point` as in the plan."""
    target = tuple(lens.semi_diameter[lens.stop] * p for p in point)
    system = system_of(lens, scene)
    status = jnp.where(plan.follows, Status.OK, Status.MISSED).astype(jnp.int32)
    known = Found(plan.hits, arrival(plan.hits, system), status, jnp.int32(0))
    hits, _ = _whole(lens, system, reattach(known, system, target).hits, target, status)
    return jnp.stack([gap for gap, _ in _gaps(lens, hits, (), plan.pair)])


@jax.custom_jvp
def _rates(lens: Lens, scene: Scene, point: Vector, plan: _Plan) -> Array:
    """Derivatives of `_excess` by the two components of the point: known numbers, and only their
    own derivatives cost anything."""
    return plan.rates


@_rates.defjvp
def _rates_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    plan = primals[3]

    def rates(lens, scene, point):
        excess = functools.partial(_excess, plan, lens, scene)
        return jax.vmap(lambda unit: jax.jvp(excess, (point,), (unit,))[1])(_units(point))

    return jax.jvp(rates, primals[:3], tangents[:3])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _follow(spokes: _Spokes, lens: Lens, scene: Scene, plan: _Plan) -> Vector:
    """The points of a plan with their derivatives by the lens and the scene, in every mode."""
    return plan.point


@_follow.defjvp
def _follow_jvp(spokes: _Spokes, primals: Any, tangents: Any) -> tuple[Vector, Vector]:
    lens, scene, plan = primals
    # Through the function itself, so that the points carry derivatives of their own.
    point = _follow(spokes, lens, scene, plan)
    count = plan.point[0].shape[-1] - spokes.count
    first, others = slice(None, count), slice(count, None)
    rates = _rates(lens, scene, point, plan)
    excess = functools.partial(_excess, plan)
    _, change = jax.jvp(lambda a, b: excess(a, b, point), (lens, scene), tangents[:2])
    # A corner stays on both apertures.
    rows = tuple(tuple(rates[:, k, :, first]) for k in (0, 1))
    corner = _solved(rows, tuple(-change[..., first]))
    corner = tuple(jnp.where(plan.follows[:, first], a, 0) for a in corner)
    # A spoke turns with the corners, and stays on its aperture.
    ends = functools.partial(spokes.nodes, plan.centre)
    there = tuple(p[:, first] for p in point)
    nodes = lambda there: ends(there, plan.follows[:, first])[0]  # noqa: E731
    angle, turned = jax.jvp(nodes, (there,), (corner,))
    x, y = _unit(angle)
    u, v = (p[:, others] - c for p, c in zip(point, plan.centre, strict=True))
    side = -v * turned, u * turned
    p, q = rates[:, 0, :, others]
    longer = -safe_divide(change[0][:, others] + p * side[0] + q * side[1], p * x + q * y)
    longer = jnp.where(plan.follows[:, others], longer, 0)
    end = side[0] + longer * x, side[1] + longer * y
    return point, tuple(jnp.concatenate([a, b], -1) for a, b in zip(corner, end, strict=True))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Clipped(PupilRule):
    """Gauss rules between the corners of the boundary and along the radii to it.

    order: nodes along a radius.
    symmetry: see `symmetry_of`.
    """

    order: int = dataclasses.field(metadata={"static": True})
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})

    def __post_init__(self) -> None:
        check_order(self.order)

    def points(self, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
        """Points and weights, which follow the lens."""
        axial = self.symmetry == "meridian"
        used = {"meridian": 1, "half": 3 * (self.order + 2), "disc": 6 * (self.order + 2)}[
            self.symmetry
        ]
        least = {"meridian": 1, "half": _SPOKES, "disc": 2 * _SPOKES - 2}[self.symmetry]
        spokes = _Spokes(self.symmetry, max(used, least), used)
        plan = jax.lax.stop_gradient(_plan(*jax.lax.stop_gradient((lens, scene)), spokes))
        point = _follow(spokes, lens, scene, plan)
        count = point[0].shape[-1] - spokes.count
        corner = tuple(p[:, :count] for p in point)
        angle, weight = spokes.nodes(plan.centre, corner, plan.follows[:, :count])
        x, y = (a[..., None] for a in _unit(angle))
        u, v = (p[:, count:, None] - c[..., None] for p, c in zip(point, plan.centre, strict=True))
        length = x * u + y * v
        node, part = jnp.asarray(_gauss(self.order)[:, self.order], x.dtype)[:, None, None]
        # On the axis r^2 is the variable, as without clipping.
        node, part = (jnp.sqrt(node), part) if axial else (node, 2 * node * part)
        weight = jnp.where(plan.passes, weight, 0)[..., None] * length**2 * part
        points = (
            c[..., None] + length * node * a for c, a in zip(plan.centre, (x, y), strict=True)
        )
        flat = tuple(p.reshape(len(p), -1) for p in points)
        return (flat[1:] if axial else flat), weight.reshape(len(weight), -1)
