"""Quadrature fitted to the part of the pupil that clear apertures leave.

A rule on the whole stop whose clipped rays drop out one by one converges like a sum of pixels.
Here the boundary is found: in polar coordinates about a point inside, the distance to it is
smooth but for the corners where one aperture takes over from another. Gauss rules between the
corners and along the radii converge as on an open stop.

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
from ..numerics import safe_divide
from ..rays.aim import paraxial_launch
from ..rays.fermat import arrival
from ..rays.find import Found
from ..rays.solve import reattach
from ..rays.status import Status
from ..rays.system import System, Vector, dot, system_of
from ..rays.trace import on_all_surfaces
from . import boundary
from .rules import PupilRule, Symmetry, check_order

__all__ = ["Clipped"]

# Corners that have a panel of their own, and what each gap between two of the even half-lines on
# which they are sought is divided into. A panel gets nodes by its width in half turns and `_EXTRA`.
_CORNERS, _PARTS, _EXTRA = 8, 32, 0.15
# Steps of each stage of the search.
_STEPS = 1, 48, 48, 16, 48


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
    near = boundary.picked(jnp.take_along_axis(ends, place[None, None], axis=-1), pair)
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
        pair = like.astype(jnp.int32) if pair is None else pair
        return boundary.Goal(like + centre, toward, pair)

    def scout(found):  # all over the stop, to where paraxial optics puts them
        radius = lens.semi_diameter[lens.stop]
        launch = paraxial_launch(system, tuple(like + radius * scouts[:, None]), 4 * radius)
        return of(found.rays, 0)._replace(launch=jnp.stack(launch)), goal(like)

    def middle(found):  # all to the point deepest inside, by the model of the best scout
        rays = of(found.rays, 0)
        far = jnp.where(rays.good, boundary.outside(lens, rays, rays.point), jnp.inf)
        best = jnp.argmin(far, axis=-1)[:, None]
        rays = rays.at(best)
        return rays.at(like[0].astype(jnp.int32)), goal(boundary.middle(lens, rays, scouts))

    def ends(found):  # to the ends of even spokes
        rays = of(found.rays, 1)
        return rays, goal(rays.point, like + _unit(jnp.asarray(spokes.even, like.dtype))[:, None])

    def corners(found):  # to the corners, in the first places
        even = of(found, 2)
        place, pair = _changes(boundary.ends(lens, even.rays, even.goal), spokes.symmetry == "disc")
        more = (0, spokes.count - _CORNERS)
        place, pair = jnp.pad(place, ((0, 0), more)), jnp.pad(pair, ((0, 0), (0, 0), more))
        rays = even.rays.at(jnp.round(place).astype(jnp.int32))
        angle = place * (spokes.turn / (spokes.count - 1)) - np.pi / 2
        line = boundary.ahead(lens, rays, goal(even.goal.centre, _unit(angle)))[0]
        return boundary.shifted(rays, line), goal(even.goal.centre, None, pair)

    def nodes(found):  # to the ends of the spokes of the rule
        rays, found = of(found.rays, 2), of(found, 3)
        corner, exists = found.rays.point[..., :_CORNERS], _exists(lens, found)[:, :_CORNERS]
        angle, _ = spokes.nodes(used, found.goal.centre[..., :1], corner, exists)
        return rays.at(spokes.nearest(angle)), goal(found.goal.centre, _unit(angle))

    return [scout, middle, ends, corners, nodes][: 3 if spokes.symmetry == "meridian" else 5]


def _exists(lens: Lens, found: boundary.Reached) -> Array:
    """Whether rays (W, B) lie in corners of the boundary, or near it."""
    inside = boundary.outside(lens, found.rays, found.rays.point) < 0.01
    return found.settled & inside & (found.goal.pair[0] != found.goal.pair[1])


def _find(lens: Lens, system: System, spokes: _Spokes, used: Array) -> boundary.Reached:
    """What the stages find, one after the other, along a first axis."""
    stages = _stages(lens, system, spokes, used)

    def several(shape, dtype=system.index.dtype):
        return jnp.zeros((len(stages), *shape, system.index.shape[1], spokes.count), dtype)

    point, rates, rows = several((2,)), several((2, 2)), lens.count + 1
    hits, moves, no = several((2, rows)), several((2, 2, rows)), several((), bool)
    goal = boundary.Goal(point, point, several((2,), jnp.int32))
    rays = boundary.Rays(point, point, hits, rates, moves, no)

    def run(stage, found):
        start, goal = jax.lax.switch(stage, stages, found)
        new = boundary.search(lens, system, start, goal, jnp.array(_STEPS, jnp.int32)[stage])
        return jax.tree.map(lambda a, b: a.at[stage].set(b), found, new)

    start = boundary.Reached(rays, goal, several((), jnp.int32), no)
    return jax.lax.fori_loop(0, len(stages), run, start)


class _Plan(NamedTuple):
    """The boundary without derivatives: C corners and B spokes, K = C + B rays.

    centre: (2, W, 1). point: (2, W, K) in units of the stop's semi-diameter. hits: 2 arrays (R, W,
    K) on the rows of a system, mm. pair: (2, W, K), the apertures that end a ray, for a spoke both
    the same. rates: (2, 2, W, K), see `boundary.rates`. follows: (W, K), whether a ray follows the
    lens. passes: (W, 1), whether light passes. used: (), how many spokes count.
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
    passes = middle.settled & (boundary.outside(lens, middle.rays, middle.rays.point) < 0)
    rays, pair, follows = nodes.rays, jnp.stack([nodes.surface] * 2), nodes.settled
    if spokes.symmetry != "meridian":
        corners = jax.tree.map(lambda a: a[3, ..., :_CORNERS], found)
        join = lambda a, b: jnp.concatenate([a, b], axis=-1)  # noqa: E731
        rays, pair = jax.tree.map(join, corners.rays, rays), join(corners.goal.pair, pair)
        follows = join(_exists(lens, corners), follows)
    follows = follows & passes[:, :1]
    hits = jnp.where(follows, rays.hits[:, np.array([*lens.live, lens.count])], 0)
    centre, rates = middle.rays.point[..., :1], boundary.rates(lens, rays, pair)
    return _Plan(centre, rays.point, tuple(hits), pair, rates, follows, passes[:, :1], used)


def _followed(plan: _Plan, lens: Lens, scene: Scene, point: Array) -> Array:
    """`boundary.gaps` of the rays of a plan through points (2, W, K)."""
    system = system_of(lens, scene)
    target = tuple(lens.semi_diameter[lens.stop] * point)
    status = jnp.where(plan.follows, Status.OK, Status.MISSED).astype(jnp.int32)
    known = Found(plan.hits, arrival(plan.hits, system), status, jnp.int32(0))
    hits = reattach(known, system, target).hits
    return boundary.gaps(
        lens, jnp.stack(on_all_surfaces(lens, system, hits, target, status)[0]), plan.pair
    )


@jax.custom_jvp
def _known_rates(lens: Lens, scene: Scene, point: Array, plan: _Plan) -> Array:
    """Derivatives of `_followed` by the point: known numbers, only theirs cost anything."""
    return plan.rates


@_known_rates.defjvp
def _known_rates_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    def rates(lens, scene, point):
        gaps = functools.partial(_followed, primals[3], lens, scene)
        return jax.vmap(lambda unit: jax.jvp(gaps, (point,), (unit,))[1])(boundary.units(point))

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
    corner = -boundary.moved(boundary.inverse(rates[..., corners]), change[..., corners])
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
