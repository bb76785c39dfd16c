"""The search for the boundary of a clipped pupil, in stages, without derivatives.

1. Rays over the whole stop. 2. For wavelengths without any ray, a ray from a fan. 3. All rays to a
point deep inside the open area. 4. Rays to the ends of even spokes about that point. 5. Rays to the
corners, where the nearest edge changes from one even spoke to the next. 6 and later: rays to the
ends of the spokes of the rule, whose azimuths are Gauss nodes between corners.

Vectors are arrays with their 2 components on the first axis and the B rays of a wavelength on the
last.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import run_if
from ..rays.aim import beam_size, nearest_start, no_fan, paraxial_launch, trace_fan
from ..rays.system import System, system_of
from . import boundary
from .boundary import EdgeRays, Rays, Target
from .radial import Frame, RadialRule, changes

# Largest number of steps of a search, and of the search for corners.
_STEPS, _CORNER_STEPS = np.int32(48), np.int32(16)
# How near rays that only start other searches must come to their targets, in units of the
# semi-diameter of the stop.
_ROUGHLY = 1e-3
# Largest distance of a corner outside of the other edges, in units of the semi-diameter of the
# stop; farther outside it is no corner of the open area.
_CORNER_MARGIN = 0.01


class _Setting(NamedTuple):
    """What all stages of the search need.

    lens, system: the lens and its traced system.
    radial: static description of the spokes.
    used: (G,), int32, number of spokes of each order.
    """

    lens: Lens
    system: System
    radial: RadialRule
    used: Array


class _State(NamedTuple):
    """State of the search between its stages.

    frame: polar coordinates about the point deepest inside.
    passes: (W, 1), bool, whether light passes that point.
    even: rays at the ends of the even spokes.
    corners: rays at C corners.
    latest: result of the last stage, `radial.batch` rays.
    ends: rays at the ends of the spokes of the rule. Each of the last stages writes one batch of
        them. Before, the first batch holds results of other stages, which are overwritten.
    """

    frame: Frame
    passes: Array
    even: Rays
    corners: EdgeRays
    latest: EdgeRays
    ends: EdgeRays


# A search: start rays, their targets, the largest number of steps, and how near to its target a ray
# must come.
_Task = tuple[Rays, Target, Any, Any]


def _near(rays: Rays, roughly: bool = False) -> Array:
    """How near rays must come to their targets: `roughly` if they only start other searches,
    else within rounding, see `boundary.search`."""
    kind = rays.point.dtype
    return jnp.asarray(_ROUGHLY if roughly else jnp.finfo(kind).eps ** 0.5, kind)


def target_of(rays: Rays, centre: Array, toward: Any = 0, pair: Any = 0) -> Target:
    """A target for each ray: the point `centre`, the end of the half-line from there along
    `toward`, or the corner of the edges `pair`."""
    full = lambda a, kind: jnp.broadcast_to(jnp.asarray(a, kind), rays.point.shape)  # noqa: E731
    kind = rays.point.dtype
    return Target(full(centre, kind), full(toward, kind), full(pair, jnp.int32))


def _start(setting: _Setting, state: _State, _: Array) -> tuple[_State, _Task]:
    """Stage 1: rays over the whole stop, launched where paraxial optics has them."""
    rays, radius = state.latest.rays, setting.lens.semi_diameter[setting.lens.stop]
    pattern = jnp.asarray(setting.radial.start_points(), radius.dtype)
    points = jnp.zeros_like(rays.point) + radius * pattern[:, None]
    launch = jnp.stack(paraxial_launch(setting.system, tuple(points), 4 * radius))
    rays = rays._replace(launch=launch)
    return state, (rays, target_of(rays, rays.point), np.int32(1), _near(rays, True))


def _rescue(setting: _Setting, state: _State, _: Array) -> tuple[_State, _Task]:
    """Stage 2: for a wavelength of which no ray arrives, the ray of a fan that crosses the stop
    nearest to its centre."""
    system, rays = setting.system, state.latest.rays
    lost = ~jnp.any(rays.good, axis=-1)
    zero = jnp.zeros_like(rays.point[0])
    rim = zero, zero + setting.lens.semi_diameter[setting.lens.stop]

    def with_fan(launch):
        fan = trace_fan(system, no_fan(system, len(lost)), tuple(launch), beam_size(system, rim)[1])
        best = nearest_start(fan, tuple(jnp.zeros_like(launch[:, :, :1])))
        return jnp.where(lost[None, :, None], jnp.stack(best), launch)

    rays = rays._replace(launch=run_if(jnp.any(lost), with_fan, rays.launch))
    return state, (
        rays,
        target_of(rays, rays.point),
        jnp.any(lost).astype(jnp.int32),
        _near(rays, True),
    )


def _middle(setting: _Setting, state: _State, _: Array) -> tuple[_State, _Task]:
    """Stage 3: all rays to the point deepest inside, which the linear model of the best ray
    gives."""
    tried = state.latest.rays
    far = jnp.where(tried.good, boundary.outside(tried, tried.point), jnp.inf)
    best = jnp.argmin(far, axis=-1)[:, None]
    pattern = jnp.asarray(setting.radial.start_points(), far.dtype)
    centre = boundary.middle(tried.at(best), pattern)
    rays = tried.at(jnp.broadcast_to(best, far.shape))
    return state, (rays, target_of(rays, centre), _STEPS, _near(rays, True))


def _ends(setting: _Setting, state: _State, _: Array) -> tuple[_State, _Task]:
    """Stage 4: rays to the ends of the even spokes about that point."""
    rays, _, settled = state.latest
    ray = jax.tree.map(lambda a: a[..., :1], rays)
    passes = settled[:, :1] & (boundary.outside(ray, ray.point) < 0)
    frame = Frame(ray.point, boundary.stretch(ray))
    target = target_of(rays, frame.centre, frame.toward(setting.radial.even[None]))
    near = _near(rays, setting.radial.symmetry != "rotational")  # for it this is the last stage
    return state._replace(frame=frame, passes=passes), (rays, target, _STEPS, near)


def _corners(setting: _Setting, state: _State, _: Array) -> tuple[_State, _Task]:
    """Stage 5: the first C rays to the corners, where the nearest edge changes."""
    radial, frame, even = setting.radial, state.frame, state.latest.rays
    line = target_of(even, frame.centre, frame.toward(radial.even[None]))
    distance = boundary.edge_distance(even, line)
    place, pair = changes(distance, radial.symmetry == "none", radial.corners)
    more = (0, radial.batch - radial.corners)
    place, pair = jnp.pad(place, ((0, 0), more)), jnp.pad(pair, ((0, 0), (0, 0), more))
    rays = even.at(jnp.round(place).astype(jnp.int32))
    angle = place * (radial.range / (radial.batch - 1)) - np.pi / 2
    line = target_of(rays, frame.centre, frame.toward(angle))
    rays = boundary.extrapolated(rays, boundary.newton_step(rays, line)[0])
    target = target_of(rays, frame.centre, pair=pair)
    return state._replace(even=even), (rays, target, _CORNER_STEPS, _near(rays))


def _nodes(setting: _Setting, state: _State, part: Array) -> tuple[_State, _Task]:
    """Stage 6 and later: one batch of rays to the ends of the spokes of the rule, which lie
    between the corners."""
    radial = setting.radial
    rays, pair, settled = jax.tree.map(lambda a: a[..., : radial.corners], state.latest)
    inside = boundary.outside(rays, rays.point) < _CORNER_MARGIN
    latest = EdgeRays(rays, pair, settled & inside & (pair[0] != pair[1]))
    corners = jax.tree.map(lambda a, b: jnp.where(part == 0, a, b), latest, state.corners)
    angle, _ = radial.nodes(state.frame, setting.used, corners.rays.point, corners.settled)
    angle = jax.lax.dynamic_slice_in_dim(angle, part * radial.batch, radial.batch, axis=-1)
    start = state.even.at(radial.nearest(angle))
    target = target_of(start, state.frame.centre, state.frame.toward(angle))
    return state._replace(corners=corners), (start, target, _STEPS, _near(start))


def _initial(setting: _Setting, crossing: bool) -> _State:
    """The state before the first stage: zeros of the right shapes."""
    lens, waves, kind = setting.lens, setting.system.index.shape[1], setting.system.index.dtype
    edges = lens.count + 1 + crossing * len(lens.active) + boundary.aperture_edges(lens)
    zeros = functools.partial(jnp.zeros, dtype=kind)

    def none(count):
        point, no = zeros((2, waves, count)), jnp.zeros((waves, count), bool)
        q, rates = zeros((2, edges, waves, count)), zeros((2, 2, waves, count))
        rays = Rays(point, point, q, rates, jnp.stack([q, q]), no)
        return EdgeRays(rays, point.astype(jnp.int32), no)

    one, latest, ends = none(1), none(setting.radial.batch), none(setting.radial.count)
    corners = none(setting.radial.corners)
    frame = Frame(one.rays.point, one.rays.d_launch)
    return _State(frame, one.settled, latest.rays, corners, latest, ends)


class Plan(NamedTuple):
    """The boundary, without derivatives.

    frame, passes: as in `_State`.
    edge: K = C + B rays, first at C corners, then at the ends of B spokes. Derivatives exist where
        they are settled.
    used: (G,), int32, number of spokes with weight of each order.
    """

    frame: Frame
    passes: Array
    edge: EdgeRays
    used: Array

    def spokes(self, radial: RadialRule, corner: Array) -> tuple[Array, Array]:
        """Directions (2, W, B) of the spokes between corners (2, W, C), and their weights
        (W, B)."""
        exists = self.edge.settled[:, : corner.shape[-1]]
        angle, share = radial.nodes(self.frame, self.used, corner, exists)
        return self.frame.toward(angle), share


def plan(lens: Lens, scene: Scene, radial: RadialRule, used: Array, crossing: bool) -> Plan:
    """Finds the boundary of the pupil in stages.

    lens, scene: without derivatives.
    radial: static description of the spokes.
    used: (G,), int32, number of spokes of each order.
    crossing: whether points where neighbouring surfaces cross belong to the boundary.

    One loop runs all stages, so that the trace, which is slow to compile, appears once in the
    program.
    """
    setting = _Setting(lens, system_of(lens, scene), radial, used)
    trace = functools.partial(boundary.trace, lens, setting.system, crossing)
    stages = [_start, _rescue, _middle, _ends, _corners, _nodes]
    count = 4 if radial.symmetry == "rotational" else 6  # one radius has no corners
    tasks = [functools.partial(stage, setting) for stage in stages[:count]]
    parts, last = radial.count // radial.batch, np.int32(count - 1)

    def run(stage, state):
        part = jnp.maximum(stage - last, 0)
        state, task = jax.lax.switch(jnp.minimum(stage, last), tasks, state, part)
        latest = boundary.search(trace, *task)
        into = functools.partial(jax.lax.dynamic_update_slice_in_dim, axis=-1)
        ends = jax.tree.map(lambda a, b: into(a, b, part * radial.batch), state.ends, latest)
        return state._replace(latest=latest, ends=ends)

    state = jax.lax.fori_loop(0, count - 1 + parts, run, _initial(setting, crossing))
    join = lambda a, b: jnp.concatenate([a, b], axis=-1)  # noqa: E731
    edge = jax.tree.map(join, state.corners, state.ends)
    edge = edge._replace(settled=edge.settled & state.passes)
    return Plan(state.frame, state.passes, edge, used)
