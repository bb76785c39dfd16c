"""Quadrature fitted to the open part of a clipped pupil.

A rule on the whole stop whose clipped rays drop out one by one converges like a sum of pixels.
`Clipped` finds the boundary. In polar coordinates about a point inside, the distance to the
boundary is smooth between the corners where the nearest edge changes. Gauss rules between corners
and along the radii converge as on an open stop. In a narrow slit the coordinates are stretched
until the slit is about as wide as long.

Vectors are arrays with 2 components on the first axis and B rays per wavelength on the last.
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

# Most steps of a search, and of the search for corners.
_STEPS, _CORNER_STEPS = np.int32(48), np.int32(16)
# Largest distance of a corner outside of other edges, in units of the semi-diameter of the stop.
_BESIDE = 0.01


class _Given(NamedTuple):
    """Arguments of all stages of the search. used: (), int32, number of spokes with weight."""

    lens: Lens
    system: System
    radial: RadialRule
    used: Array


class _State(NamedTuple):
    """State of the search between its stages.

    frame: polar coordinates about the point deepest inside.
    passes: (W, 1), bool, whether light passes that point.
    even: rays at the ends of even spokes.
    corners: rays at C corners.
    latest: result of the last stage.
    """

    frame: Frame
    passes: Array
    even: Rays
    corners: EdgeRays
    latest: EdgeRays


# Start rays, B per wavelength, their targets, and the largest number of steps.
_Task = tuple[Rays, Target, Any]


def _target(rays: Rays, centre: Array, toward: Any = 0, pair: Any = 0) -> Target:
    """Target of each ray: the `centre`, the end of the half-line `toward`, or the corner `pair`."""
    full = lambda a, kind: jnp.broadcast_to(jnp.asarray(a, kind), rays.point.shape)  # noqa: E731
    kind = rays.point.dtype
    return Target(full(centre, kind), full(toward, kind), full(pair, jnp.int32))


def _scouts(given: _Given, state: _State) -> tuple[_State, _Task]:
    """Stage 1: rays over the whole stop, from their paraxial launches."""
    rays, radius = state.latest.rays, given.lens.semi_diameter[given.lens.stop]
    pattern = jnp.asarray(given.radial.scouts(), radius.dtype)
    points = jnp.zeros_like(rays.point) + radius * pattern[:, None]
    launch = jnp.stack(paraxial_launch(given.system, tuple(points), 4 * radius))
    rays = rays._replace(launch=launch)
    return state, (rays, _target(rays, rays.point), np.int32(1))


def _rescue(given: _Given, state: _State) -> tuple[_State, _Task]:
    """Stage 2: for a wavelength without a ray that arrives, the ray of a fan that crosses the stop
    nearest to its centre."""
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
    """Stage 3: all rays to the point deepest inside, by the linear model of the best ray."""
    scouts = state.latest.rays
    far = jnp.where(scouts.good, boundary.outside(scouts, scouts.point), jnp.inf)
    best = jnp.argmin(far, axis=-1)[:, None]
    pattern = jnp.asarray(given.radial.scouts(), far.dtype)
    centre = boundary.middle(scouts.at(best), pattern)
    rays = scouts.at(jnp.broadcast_to(best, far.shape))
    return state, (rays, _target(rays, centre), _STEPS)


def _ends(given: _Given, state: _State) -> tuple[_State, _Task]:
    """Stage 4: rays to the ends of even spokes about that point."""
    rays, _, settled = state.latest
    ray = jax.tree.map(lambda a: a[..., :1], rays)
    passes = settled[:, :1] & (boundary.outside(ray, ray.point) < 0)
    frame = Frame(ray.point, boundary.stretch(ray))
    target = _target(rays, frame.centre, frame.toward(given.radial.even[None]))
    return state._replace(frame=frame, passes=passes), (rays, target, _STEPS)


def _corners(given: _Given, state: _State) -> tuple[_State, _Task]:
    """Stage 5: the first `CORNERS` rays to the corners, where the nearest edge changes."""
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
    """Stage 6: rays to the ends of the spokes of the rule, which lie between the corners."""
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
    """The boundary, without derivatives.

    frame, passes: as in `_State`.
    edge: K = C + B rays, at C corners and at the ends of B spokes; derivatives exist where settled.
    used: (), int32, number of spokes with weight.
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
    """Finds the boundary of the pupil in stages. One loop runs all stages, so that the trace, which
    takes long to compile, stands once in the program."""
    given = _Given(lens, system_of(lens, scene), radial, used)
    trace = functools.partial(boundary.trace, lens, given.system, crossing)
    stages = [_scouts, _rescue, _middle, _ends, _corners, _nodes]
    count = 4 if radial.symmetry == "rotational" else 6  # one radius has no corners
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
    """Stop points and launches (2, W, K) of the rays of a plan, with derivatives by the lens and
    the scene in every mode."""
    return plan.edge.rays.point, plan.edge.rays.launch


@_follow.defjvp
def _follow_jvp(radial: RadialRule, crossing: bool, primals: Any, tangents: Any) -> tuple[Any, Any]:
    lens, scene, plan = primals
    _, pair, follows = plan.edge
    # Call the function itself, so that the points have derivatives for higher orders.
    point, launch = _follow(radial, crossing, lens, scene, plan)

    def trace(lens, scene, launch):
        return boundary.trace(lens, system_of(lens, scene), crossing, launch)

    rays = boundary.launched(functools.partial(trace, lens, scene), launch)
    corners, ends = (slice(None, -radial.count), slice(-radial.count, None))

    def step(lens, scene):  # one Newton step, by the linear models of these rays
        (crossed, q), _ = trace(lens, scene, launch)
        moved = rays._replace(point=crossed, q=q)
        # A corner stays on both edges.
        corner = (crossed + boundary.corner_step(moved, pair))[..., corners]
        corner = jnp.where(follows[:, corners], corner, point[..., corners])
        # A spoke rotates with the corners, and ends on its edge.
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
    """Length (W, B) of a line in units of `toward`."""
    return safe_divide(dot(toward, line), dot(toward, toward))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Clipped(PupilRule):
    """Gauss rules between the corners of the boundary and along the radii to it. Each obscuration
    doubles the number of rays: the light inside of it is subtracted.

    order: nodes along a radius.
    symmetry: see `symmetry_of`.
    size: order up to which rays of weight 0 fill up, so that orders share a compiled program; 0 for
        `order`.
    crossing: True if the boundary also contains points where neighbouring surfaces cross; False
        takes half the time.
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
        """Points and weights, differentiable by the lens.

        Light passes inside of all clear apertures and outside of all obscurations. By inclusion and
        exclusion, this is a sum over sets of obscurations of the light inside of all of a set, with
        negative weights for an odd number.
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
        # A total within rounding counts as no light.
        least = float(jnp.finfo(weight.dtype).eps) ** 0.5
        lit = jnp.sum(weight, axis=-1, keepdims=True) > least
        return points, jnp.where(lit, weight, 0)

    def transmission(self, lens: Lens, bundle: Bundle) -> Array:
        """1 for all rays (W, Q) that exist: the weights contain the clipping."""
        whole = (bundle.status == Status.OK) | (bundle.status == Status.CLIPPED)
        return whole.astype(bundle.path.dtype)

    def _inside(self, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
        """Points and weights of the light inside of all apertures and obscurations."""
        axial = self.symmetry == "rotational"
        part = {"rotational": 0, "bilateral": 1, "none": 2}[self.symmetry]
        # Edges make corners; narrow panels between them need spokes too.
        edges = boundary.aperture_edges(lens)
        used, most = (part * (2 * n + 6 + 2 * edges) for n in (self.order, self.size))
        radial = RadialRule(self.symmetry, max(most, 32 * part) + 1)
        given = *jax.lax.stop_gradient((lens, scene)), radial, jnp.asarray(used, jnp.int32)
        plan = jax.lax.stop_gradient(_plan(*given, self.crossing))
        point, _ = _follow(radial, self.crossing, lens, scene, plan)
        corner, end = point[..., : -radial.count], point[..., -radial.count :]
        toward, share = plan.spokes(radial, corner)
        # The first spokes are nodes of the rule; the others serve the search alone.
        toward, share, end = (a[..., : max(most, 1)] for a in (toward, share, end))
        length = _along(end - plan.frame.centre, toward)
        node, weight = jnp.asarray(gauss(self.size), length.dtype)[:, self.order, None, None]
        # For "rotational" r^2 is the variable, as without clipping.
        node, weight = (jnp.sqrt(node), weight) if axial else (node, 2 * node * weight)
        size = determinant(plan.frame.shape)
        weight = jnp.where(plan.passes, share * length**2 * size, 0)[..., None] * weight
        points = plan.frame.centre[..., None] + (length[..., None] * node)[None] * toward[..., None]
        points = points.reshape(2, len(length), -1)
        return tuple(points[1:] if axial else points), weight.reshape(len(length), -1)
