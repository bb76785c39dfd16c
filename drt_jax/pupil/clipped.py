"""Quadrature fitted to the part of the pupil that apertures and obscurations leave.

A rule on the whole stop whose clipped rays drop out one by one converges like a sum of pixels.
Here the boundary is found: in polar coordinates about a point inside, the distance to it is
smooth but for the corners where one edge takes over from another. Gauss rules between the corners
and along the radii converge as on an open stop; also in a narrow slit, as its coordinates are
stretched until it is about as wide as long.

Vectors are arrays with their 2 components first, and B rays a wavelength last.
"""

import dataclasses
import functools
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import run_if, safe_divide
from ..rays.aim import beam_size, nearest_start, no_fan, paraxial_launch, trace_fan
from ..rays.status import Status
from ..rays.system import System, Vector, determinant, dot, system_of
from ..rays.trace import Bundle
from . import boundary
from .boundary import EdgeRays, Rays, Target, displace
from .radial import CORNERS, Frame, RadialRule, changes, gauss
from .rules import PupilRule, Symmetry, check_rule

__all__ = ["Clipped"]

# Steps of one search at most, and of that for corners.
_STEPS, _CORNER_STEPS = np.int32(48), np.int32(16)
# How far outside of other edges a corner may be, in units of the stop's semi-diameter.
_BESIDE = 0.01


class _Given(NamedTuple):
    """What all stages of the search are given. used: (), how many spokes count."""

    lens: Lens
    system: System
    radial: RadialRule
    used: Array


class _State(NamedTuple):
    """What the search knows before each of its stages.

    frame: about the point deepest inside. passes: (W, 1), whether light passes there. even: rays at
    the ends of even spokes. corners: C of them. latest: what the stage before has found.
    """

    frame: Frame
    passes: Array
    even: Rays
    corners: EdgeRays
    latest: EdgeRays


# Rays to start from, B a wavelength, their targets, and how many steps at most.
_Task = tuple[Rays, Target, Any]


def _target(rays: Rays, centre: Array, toward: Any = 0, pair: Any = 0) -> Target:
    """A target of each ray: `centre` itself, the end of the half-line `toward`, or a corner."""
    full = lambda a, kind: jnp.broadcast_to(jnp.asarray(a, kind), rays.point.shape)  # noqa: E731
    kind = rays.point.dtype
    return Target(full(centre, kind), full(toward, kind), full(pair, jnp.int32))


def _scouts(given: _Given, state: _State) -> tuple[_State, _Task]:
    """First, rays all over the stop, from where paraxial optics puts them."""
    rays, radius = state.latest.rays, given.lens.semi_diameter[given.lens.stop]
    pattern = jnp.asarray(given.radial.scouts(), radius.dtype)
    points = jnp.zeros_like(rays.point) + radius * pattern[:, None]
    launch = jnp.stack(paraxial_launch(given.system, tuple(points), 4 * radius))
    rays = rays._replace(launch=launch)
    return state, (rays, _target(rays, rays.point), np.int32(1))


def _rescue(given: _Given, state: _State) -> tuple[_State, _Task]:
    """Where no scout of a wavelength arrived, the ray of a fan that crosses the stop nearest to its
    centre."""
    system, rays = given.system, state.latest.rays
    dark = ~jnp.any(rays.good, axis=-1)
    zero = jnp.zeros_like(rays.point[0])
    rim = zero, zero + given.lens.semi_diameter[given.lens.stop]

    def sought(launch):
        fan = trace_fan(system, no_fan(system, len(dark)), tuple(launch), beam_size(system, rim)[1])
        best = nearest_start(fan, tuple(jnp.zeros_like(launch[:, :, :1])))
        return jnp.where(dark[None, :, None], jnp.stack(best), launch)

    rays = rays._replace(launch=run_if(jnp.any(dark), sought, rays.launch))
    return state, (rays, _target(rays, rays.point), jnp.any(dark).astype(jnp.int32))


def _middle(given: _Given, state: _State) -> tuple[_State, _Task]:
    """All rays to the point deepest inside, by the model of the best scout."""
    scouts = state.latest.rays
    far = jnp.where(scouts.good, boundary.outside(scouts, scouts.point), jnp.inf)
    best = jnp.argmin(far, axis=-1)[:, None]
    pattern = jnp.asarray(given.radial.scouts(), far.dtype)
    centre = boundary.middle(scouts.at(best), pattern)
    rays = scouts.at(jnp.broadcast_to(best, far.shape))
    return state, (rays, _target(rays, centre), _STEPS)


def _ends(given: _Given, state: _State) -> tuple[_State, _Task]:
    """To the ends of even spokes about that point."""
    rays, _, settled = state.latest
    ray = jax.tree.map(lambda a: a[..., :1], rays)
    passes = settled[:, :1] & (boundary.outside(ray, ray.point) < 0)
    frame = Frame(ray.point, boundary.stretch(ray))
    target = _target(rays, frame.centre, frame.toward(given.radial.even[None]))
    return state._replace(frame=frame, passes=passes), (rays, target, _STEPS)


def _corners(given: _Given, state: _State) -> tuple[_State, _Task]:
    """To the corners, in the first places: where one edge takes over from another."""
    radial, frame, even = given.radial, state.frame, state.latest.rays
    line = _target(even, frame.centre, frame.toward(radial.even[None]))
    distance = boundary.edge_distance(even, line)
    place, pair = changes(distance, radial.symmetry == "none")
    more = (0, radial.count - CORNERS)
    place, pair = jnp.pad(place, ((0, 0), more)), jnp.pad(pair, ((0, 0), (0, 0), more))
    rays = even.at(jnp.round(place).astype(jnp.int32))
    angle = place * (radial.range / (radial.count - 1)) - np.pi / 2
    line = _target(rays, frame.centre, frame.toward(angle))
    rays = boundary.extrapolated(rays, boundary.newton_step(rays, line)[0])
    target = _target(rays, frame.centre, pair=pair)
    return state._replace(even=even), (rays, target, _CORNER_STEPS)


def _nodes(given: _Given, state: _State) -> tuple[_State, _Task]:
    """To the ends of the spokes of the rule, which lie between the corners."""
    rays, pair, settled = jax.tree.map(lambda a: a[..., :CORNERS], state.latest)
    beside = boundary.outside(rays, rays.point) < _BESIDE
    exists = settled & beside & (pair[0] != pair[1])
    angle, _ = given.radial.nodes(state.frame, given.used, rays.point, exists)
    start = state.even.at(given.radial.nearest(angle))
    target = _target(start, state.frame.centre, state.frame.toward(angle))
    return state._replace(corners=EdgeRays(rays, pair, exists)), (start, target, _STEPS)


def _nothing(given: _Given, crossing: bool) -> _State:
    """The state before the first stage."""
    lens, waves, kind = given.lens, given.system.index.shape[1], given.system.index.dtype
    edges = lens.count + 1 + crossing * len(lens.active) + boundary.aperture_edges(lens)
    zeros = functools.partial(jnp.zeros, dtype=kind)

    def none(count):
        point, no = zeros((2, waves, count)), jnp.zeros((waves, count), bool)
        q, rates = zeros((2, edges, waves, count)), zeros((2, 2, waves, count))
        rays = Rays(point, point, q, rates, jnp.stack([q, q]), no)
        return EdgeRays(rays, point.astype(jnp.int32), no)

    one, latest = none(1), none(given.radial.count)
    corners = none(0 if given.radial.symmetry == "rotational" else CORNERS)
    frame = Frame(one.rays.point, one.rays.d_launch)
    return _State(frame, one.settled, latest.rays, corners, latest)


class _Plan(NamedTuple):
    """The boundary without derivatives. edge: K = C + B rays, at C corners and at the ends of B
    spokes, settled where they follow the lens. used: (), how many spokes count. Else see `_State`.
    """

    frame: Frame
    passes: Array
    edge: EdgeRays
    used: Array

    def spokes(self, radial: RadialRule, corner: Array) -> tuple[Array, Array]:
        """Directions (2, W, B) of the spokes between corners (2, W, C), and weights (W, B)."""
        exists = self.edge.settled[:, : corner.shape[-1]]
        angle, share = radial.nodes(self.frame, self.used, corner, exists)
        return self.frame.toward(angle), share


def _plan(lens: Lens, scene: Scene, radial: RadialRule, used: Array, crossing: bool) -> _Plan:
    """The boundary of the pupil, searched in stages, each from what those before it found.

    One loop runs them all, so that a program holds the trace, which takes long to compile, once.
    """
    given = _Given(lens, system_of(lens, scene), radial, used)
    trace = functools.partial(boundary.trace, lens, given.system, crossing)
    stages = [_scouts, _rescue, _middle, _ends, _corners, _nodes]
    count = 4 if radial.symmetry == "rotational" else 6  # on the meridian there are no corners
    tasks = [functools.partial(stage, given) for stage in stages[:count]]

    def run(stage, state):
        state, task = jax.lax.switch(stage, tasks, state)
        return state._replace(latest=boundary.search(trace, *task))

    state = jax.lax.fori_loop(0, count, run, _nothing(given, crossing))
    join = lambda a, b: jnp.concatenate([a, b], axis=-1)  # noqa: E731
    edge = jax.tree.map(join, state.corners, state.latest)
    edge = edge._replace(settled=edge.settled & state.passes)
    return _Plan(state.frame, state.passes, edge, used)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _follow(
    radial: RadialRule, crossing: bool, lens: Lens, scene: Scene, plan: _Plan
) -> tuple[Array, Array]:
    """Points of the rays of a plan, and where they are launched, with their derivatives by the lens
    and the scene, in every mode."""
    return plan.edge.rays.point, plan.edge.rays.launch


@_follow.defjvp
def _follow_jvp(radial: RadialRule, crossing: bool, primals: Any, tangents: Any) -> tuple[Any, Any]:
    lens, scene, plan = primals
    _, pair, follows = plan.edge
    # Through the function itself, so that the points carry derivatives of their own.
    point, launch = _follow(radial, crossing, lens, scene, plan)

    def trace(lens, scene, launch):
        return boundary.trace(lens, system_of(lens, scene), crossing, launch)

    rays = boundary.launched(functools.partial(trace, lens, scene), launch)
    corners, ends = (slice(None, -radial.count), slice(-radial.count, None))

    def step(lens, scene):  # of Newton's method, by the models of these rays
        (crossed, q), _ = trace(lens, scene, launch)
        moved = rays._replace(point=crossed, q=q)
        # A corner stays on both edges.
        corner = (crossed + boundary.corner_step(moved, pair))[..., corners]
        corner = jnp.where(follows[:, corners], corner, point[..., corners])
        # A spoke turns with the corners, and ends on its edge.
        toward, _ = plan.spokes(radial, corner)
        moved = jax.tree.map(lambda a: a[..., ends], moved)
        distance = boundary.edge_distance(moved, _target(moved, plan.frame.centre, toward))
        length = boundary.picked(distance, pair[:1, :, ends])[0]
        known = jax.lax.stop_gradient(_along(point[..., ends] - plan.frame.centre, toward))
        length = jnp.where(follows[:, ends], length, known)
        new = jnp.concatenate([corner, plan.frame.centre + length[None] * toward], axis=-1)
        return new, jnp.where(follows, displace(rays.d_launch, new - crossed), 0)

    return (point, launch), jax.jvp(step, (lens, scene), tangents[:2])[1]


def _along(line: Array, toward: Array) -> Array:
    """How many `toward` long a line is, (W, B)."""
    return safe_divide(dot(toward, line), dot(toward, toward))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Clipped(PupilRule):
    """Gauss rules between the corners of the boundary and along the radii to it.

    Each obscuration doubles the rays: what lies inside of it is subtracted, by rays of its own.

    order: nodes along a radius.
    symmetry: see `symmetry_of`.
    size: the order up to which weightless rays fill up, so that orders share a compiled program.
    crossing: whether light may end where neighbouring surfaces cross, too; without, a search takes
        half the time.
    """

    order: int
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})
    size: int = dataclasses.field(metadata={"static": True}, default=0)
    crossing: bool = dataclasses.field(metadata={"static": True}, default=True)

    def __post_init__(self) -> None:
        if not self.size:
            check_rule(self.order, self.symmetry)
            object.__setattr__(self, "size", self.order)

    def points(self, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
        """Points and weights, which follow the lens.

        Light passes where it passes all clear apertures and is inside of no obscuration: by
        inclusion and exclusion, the sum of parts of the pupil that are each inside of some
        obscurations, with the weights negative for an odd number of them.
        """
        extra = lens.apertures
        if extra is None or not any(extra.blocks):
            return self._inside(lens, scene)
        inside = np.array(list(itertools.product(*([True, False][: 1 + b] for b in extra.blocks))))
        odd = np.sum(inside & np.array(extra.blocks), axis=1) % 2

        def part(inside):
            half = jnp.where(inside[:, None], extra.half, jnp.inf)
            apertures = dataclasses.replace(extra, half=half)
            return self._inside(dataclasses.replace(lens, apertures=apertures), scene)

        points, weight = jax.vmap(part, out_axes=1)(jnp.asarray(inside))
        weight = weight * jnp.asarray(1 - 2 * odd, weight.dtype)[None, :, None]
        points, weight = jax.tree.map(lambda a: a.reshape(len(a), -1), (points, weight))
        # What rounding leaves of no light is none.
        least = float(jnp.finfo(weight.dtype).eps) ** 0.5
        lit = jnp.sum(weight, axis=-1, keepdims=True) > least
        return points, jnp.where(lit, weight, 0)

    def transmission(self, lens: Lens, bundle: Bundle) -> Array:
        """1 for all rays (W, Q) that exist: the weights know the edges."""
        whole = (bundle.status == Status.OK) | (bundle.status == Status.CLIPPED)
        return whole.astype(bundle.path.dtype)

    def _inside(self, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
        """Points and weights of what is inside of all apertures and obscurations."""
        axial = self.symmetry == "rotational"
        part = {"rotational": 0, "bilateral": 1, "none": 2}[self.symmetry]
        # Apertures of all shapes make corners; the narrow panels between them need spokes too.
        edges = boundary.aperture_edges(lens)
        used, most = (part * (2 * n + 6 + 2 * edges) for n in (self.order, self.size))
        radial = RadialRule(self.symmetry, max(most, 32 * part) + 1)
        given = *jax.lax.stop_gradient((lens, scene)), radial, jnp.asarray(used, jnp.int32)
        plan = jax.lax.stop_gradient(_plan(*given, self.crossing))
        point, _ = _follow(radial, self.crossing, lens, scene, plan)
        corner, end = point[..., : -radial.count], point[..., -radial.count :]
        toward, share = plan.spokes(radial, corner)
        # The nodes have the first places; the others are of the search alone.
        toward, share, end = (a[..., : max(most, 1)] for a in (toward, share, end))
        length = _along(end - plan.frame.centre, toward)
        node, weight = jnp.asarray(gauss(self.size), length.dtype)[:, self.order, None, None]
        # On the axis r^2 is the variable, as without clipping.
        node, weight = (jnp.sqrt(node), weight) if axial else (node, 2 * node * weight)
        size = determinant(plan.frame.shape)
        weight = jnp.where(plan.passes, share * length**2 * size, 0)[..., None] * weight
        points = plan.frame.centre[..., None] + (length[..., None] * node)[None] * toward[..., None]
        points = points.reshape(2, len(length), -1)
        return tuple(points[1:] if axial else points), weight.reshape(len(length), -1)
