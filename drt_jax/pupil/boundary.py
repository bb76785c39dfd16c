"""The boundary of a clipped pupil: rays that meet the edge of an aperture, without derivatives.

Every edge, the rim of the stop included, is a quadric: a ray passes if |q| <= 1, where q is its hit
on that surface, relative to the centre of the edge, in units of its half widths. A rectangle is two
edges, each with one component of q; a side of a polygon is one edge with a component of q across
the side. Where two neighbouring surfaces cross, the length of a ray from one to the next is 0; with
`crossing`, this is an edge too.

Rays are launched from the first vertex plane and not aimed at a stop point. The trace yields the
derivative of q by the stop point, also for rays outside of all edges, where rays may step back to a
surface. In this linear model q = q_0 + q_p (p - p_0), an edge along the half-line p = centre + s
toward is the quadratic equation |q|^2 = 1 in s. The next ray is launched at its root: Newton's
method, which needs a few steps.

The search has stages. 1. Rays over the whole stop. 2. For wavelengths without any ray, a ray from a
fan. 3. All rays to a point deep inside the open area. 4. Rays to the ends of even spokes about that
point. 5. Rays to the corners, where the nearest edge changes from one even spoke to the next. 6 and
later: rays to the ends of the spokes of the rule, whose azimuths are Gauss nodes between corners.

Vectors are arrays with their 2 components on the first axis and the B rays of a wavelength on the
last.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import eager_values, einsum, run_if, safe_divide, safe_sqrt
from ..rays.aim import beam_size, nearest_start, no_fan, paraxial_launch, trace_fan
from ..rays.snell import shoot, shoot_anyway, split_stop
from ..rays.status import Status
from ..rays.system import System, dot, system_of
from ..rays.trace import on_all_surfaces
from .radial import Frame, RadialRule, changes, displace, inverse, picked

_ZOOMS, _DESCENTS = 10, 8  # refinements of the grid and Newton steps in `middle`
# With `crossing`, a path between two surfaces passes from 0 to twice this length, in units of the
# length of the lens.
_LONGEST = 100.0

# Largest number of steps of a search, and of the search for corners.
_STEPS, _CORNER_STEPS = np.int32(48), np.int32(16)
# How near rays that only start other searches must come to their targets, in units of the
# semi-diameter of the stop.
_ROUGHLY = 1e-3
# Largest distance of a corner outside of the other edges, in units of the semi-diameter of the
# stop; farther outside it is no corner of the open area.
_CORNER_MARGIN = 0.01

# A function from launches (2, W, B) to ((stop points, q), good), see `Rays`.
Trace = Callable[[Array], tuple[tuple[Array, Array], Array]]


class Rays(NamedTuple):
    """Traced rays, each with its linear model in the stop point.

    launch: (2, W, B), mm, on the vertex plane of the first row.
    point: (2, W, B), crossing of the stop in units of its semi-diameter.
    q: (2, E, W, B), normalised hits on the E edges.
    d_launch: (2, 2, W, B), derivatives of `launch` by `point` (first axis), mm.
    d_q: (2, 2, E, W, B), derivatives of `q` by `point` (first axis).
    good: (W, B), bool, True for rays that reach the sensor.
    """

    launch: Array
    point: Array
    q: Array
    d_launch: Array
    d_q: Array
    good: Array

    def at(self, index: Array) -> "Rays":
        """The rays at indices (W, B) of the last axis."""

        def take(a):
            return jnp.take_along_axis(a, index.reshape(*[1] * (a.ndim - 2), *index.shape), axis=-1)

        return jax.tree.map(take, self)


class Target(NamedTuple):
    """Where each ray shall go: the end of a half-line at the boundary, or a corner.

    centre: (2, W, B), start of the half-line.
    toward: (2, W, B), direction of the half-line; 0 if the target is `centre` itself.
    pair: (2, W, B), int32, the two edges that meet in a corner; equal for a half-line.
    """

    centre: Array
    toward: Array
    pair: Array


class EdgeRays(NamedTuple):
    """Rays that a search has brought to the boundary.

    rays: the rays.
    pair: (2, W, B), int32, the edges that they meet; equal for a half-line.
    settled: (W, B), bool, True for rays that meet their target. For the others `rays` holds the
        last ray that did not fail.
    """

    rays: Rays
    pair: Array
    settled: Array


def aperture_edges(lens: Lens) -> int:
    """Number of edges of `lens.apertures`, that is, without the circles of the semi-diameters."""
    extra = lens.apertures
    count = {} if extra is None else {"rectangle": 2, "polygon": extra.most}
    return sum(count.get(kind, 1) for kind in (() if extra is None else extra.kinds))


def trace(
    lens: Lens, system: System, crossing: bool, launch: Array
) -> tuple[tuple[Array, Array], Array]:
    """The function that `Trace` describes, for a lens.

    lens, system: the lens and its traced system.
    crossing: whether the lengths between surfaces are edges.
    launch: (2, W, B), mm.

    The edges are, in this order, the S + 1 circles of the semi-diameters; with `crossing` the
    lengths behind each of the L active surfaces; and all other apertures. An obscuration counts as
    a clear aperture.
    """
    if crossing:
        hits, ways, status = shoot_anyway(system, tuple(launch))
    else:
        hits, status, _ = shoot(system, tuple(launch))
    both, good = on_all_surfaces(lens, system, *split_stop(system, hits), status == Status.OK)
    hit = jnp.stack(both)
    q = [hit / lens.semi_diameter[None, :, None, None]]
    if crossing:
        span = jnp.sum(abs(lens.thickness)) + abs(lens.sensor) + lens.semi_diameter[lens.stop]
        q.append(jnp.stack([ways / (_LONGEST * span) - 1, 0 * ways]))
    if lens.apertures is not None:
        matrix, centre, own = lens.apertures.edges()
        q.append(einsum("eij,jewb->iewb", matrix, hit[:, own] - centre.T[..., None, None]))
    return (hit[:, lens.stop] / lens.semi_diameter[lens.stop], jnp.concatenate(q, axis=1)), good


def launched(trace: Trace, launch: Array) -> Rays:
    """Traces rays and their linear models.

    trace: the trace function.
    launch: (2, W, B), mm.

    Two JVPs give the derivatives of stop points and q by the launch. The inverse of the first is
    `d_launch`; the second times this inverse is `d_q`.
    """

    def along(unit):
        (point, q), columns, good = jax.jvp(trace, (launch,), (unit,), has_aux=True)
        return point, q, good, columns

    units = jnp.broadcast_to(jnp.eye(2, dtype=launch.dtype)[..., None, None], (2, *launch.shape))
    point, q, good, columns = jax.vmap(along, out_axes=(None, None, None, 0))(units)
    d_launch = inverse(columns[0])
    d_q = jnp.stack([displace(columns[1], d) for d in d_launch])
    return Rays(launch, point, q, d_launch, d_q, good)


def extrapolated(rays: Rays, change: Array) -> Rays:
    """The linear models of rays evaluated at stop points that are changed by `change` (2, W, B)."""
    return rays._replace(
        launch=rays.launch + displace(rays.d_launch, change),
        point=rays.point + change,
        q=rays.q + displace(rays.d_q, change),
    )


def corner_step(rays: Rays, pair: Array) -> Array:
    """Newton step (2, W, B) of the stop points to the corner of two edges, where
    |q_a|^2 = |q_b|^2 = 1.

    rays: rays with their linear models.
    pair: (2, W, B), edges a and b.
    """
    q, d_q = picked(rays.q, pair), picked(rays.d_q, pair)
    rates = jnp.stack([2 * dot(q, rate) for rate in d_q])
    return -displace(inverse(rates), dot(q, q) - 1)


def edge_distance(rays: Rays, target: Target) -> Array:
    """Distance to each edge along the half-line of a target, by the linear models of rays.

    Returns s (E, W, B), in units of `target.toward`; inf for an edge that does not depend on the
    stop point. With q = base + s rate, |q|^2 = 1 is square s^2 + 2 linear s + constant = 0. Its
    larger root is (root - linear) / square = -constant / (linear + root),
    root = sqrt(linear^2 - square constant).
    """
    base = rays.q + displace(rays.d_q, target.centre - rays.point)
    rate = displace(rays.d_q, target.toward)
    square, linear, constant = dot(rate, rate), dot(base, rate), dot(base, base) - 1
    root = safe_sqrt(linear**2 - square * constant)
    out = linear > 0  # take the form of the root without cancellation
    above = jnp.where(out, -constant, root - linear)
    return jnp.where(square > 0, safe_divide(above, jnp.where(out, linear + root, square)), jnp.inf)


def newton_step(rays: Rays, target: Target) -> tuple[Array, Array]:
    """Newton step (2, W, B) of the stop points to their targets, and the edges (2, W, B) there,
    by the linear models."""
    far = edge_distance(rays, target)
    length = jnp.where(dot(target.toward, target.toward) > 0, jnp.min(far, axis=0), 0)
    line = target.centre + length[None] * target.toward - rays.point
    corner = corner_step(rays, target.pair)
    is_corner = target.pair[:1] != target.pair[1:]
    edge = jnp.argmin(far, axis=0).astype(jnp.int32)
    return jnp.where(is_corner, corner, line), jnp.where(is_corner, target.pair, edge[None])


def search(trace: Trace, start: Rays, target: Target, steps: Array, within: Array) -> EdgeRays:
    """Newton's method from start rays to their targets. After a failed ray, the next one is
    launched halfway to the last ray that did not fail.

    trace: the trace function.
    start: rays with their linear models.
    target: their targets.
    steps: (), int32, largest number of steps.
    within: (), a ray meets its target if the next step is at most this, in units of the
        semi-diameter of the stop. The ray then takes that step by its linear model, which leaves an
        error of about the square of the step.
    """
    tiny = float(jnp.finfo(start.launch.dtype).eps) ** 0.5

    def step(state):
        count, rays, launch, done, *_ = state
        new = launched(trace, launch)
        rays = jax.tree.map(lambda a, b: jnp.where(new.good & ~done, a, b), new, rays)
        change, pair = newton_step(rays, target)
        back = rays.launch - launch
        settled = rays.good & (dot(change, change) <= within**2)
        lost = ~new.good & (dot(back, back) <= tiny**2 * (1 + dot(launch, launch)))
        onward = rays.launch + displace(rays.d_launch, change)
        launch = jnp.where(new.good[None], onward, launch + back / 2)
        return count + 1, rays, launch, done | settled | lost, change, pair, settled

    change, pair = newton_step(start, target)
    launch, no = extrapolated(start, change).launch, jnp.zeros(start.good.shape, bool)
    state = (0, start, launch, no, change, pair, no)
    state = jax.lax.while_loop(lambda s: (s[0] < steps) & ~jnp.all(s[3]), step, state)
    _, rays, _, _, change, pair, settled = state
    return EdgeRays(extrapolated(rays, jnp.where(settled[None], change, 0)), pair, settled)


def outside(rays: Rays, point: Array) -> Array:
    """Signed distance (W, B) of points from the open area, by the linear models of rays, in
    units of the semi-diameter of the stop: the largest (|q| - 1) / |dq/dp| of all edges, with
    the RMS of the derivatives by x and y as |dq/dp|. Negative inside of all edges."""
    q = rays.q + displace(rays.d_q, point - rays.point)
    x, y = rays.d_q
    far, rate = safe_sqrt(dot(q, q)) - 1, safe_sqrt((dot(x, x) + dot(y, y)) / 2)
    return jnp.max(jnp.where(rate > 0, safe_divide(far, rate), -jnp.inf), axis=0)


def barrier(rays: Rays, point: Array) -> tuple[Array, Array]:
    """Derivatives of the logarithmic barrier -sum log(1 - |q_e|^2) over the edges e, which is
    infinite on the boundary.

    rays: rays with their linear models.
    point: (2, W, B), where the derivatives are taken.

    Returns the first derivatives (2, W, B) and the second derivatives (2, 2, W, B). With
    slope_i = 2 q.q_i / (1 - |q|^2) the second ones are the sum of 2 q_i.q_j / (1 - |q|^2) + slope_i
    slope_j.
    """
    q, rates = rays.q + displace(rays.d_q, point - rays.point), rays.d_q
    room = jnp.maximum(1 - dot(q, q), jnp.finfo(q.dtype).eps)
    slope = jnp.stack([2 * dot(q, rate) / room for rate in rates])
    square = jnp.stack([jnp.stack([2 * dot(a, b) / room for b in rates]) for a in rates])
    return jnp.sum(slope, axis=1), jnp.sum(square + slope[:, None] * slope[None], axis=2)


def stretch(rays: Rays) -> Array:
    """Symmetric matrices (2, 2, W, B) that stretch a circle to about the shape of the open area
    around rays; the unit matrix for a circle.

    The shape is the square root of the inverse of the barrier's second derivatives H, scaled. For a
    2 x 2 matrix A = 2 H^-1 / trace(H^-1) it is sqrt(A) = (A + d I) / sqrt(trace(A) + 2 d),
    d = sqrt(det A).
    """
    (xx, xy), (_, yy) = barrier(rays, rays.point)[1]
    # A of the docstring, with the trace 2.
    square = safe_divide(2 * jnp.array([[yy, -xy], [-xy, xx]]), (xx + yy)[None, None])
    size = safe_sqrt(square[0, 0] * square[1, 1] - square[0, 1] ** 2)[None, None]
    return (square + size * jnp.eye(2, dtype=size.dtype)[..., None, None]) / jnp.sqrt(2 + 2 * size)


def middle(rays: Rays, pattern: Array) -> Array:
    """A point (2, W, 1) far from all edges, by the linear model of one ray for each wavelength.

    rays: one ray for each wavelength.
    pattern: (2, B), points to try.

    First the point of the pattern that is deepest inside, with the pattern shrunk around it
    `_ZOOMS` times; then damped Newton steps H^-1 g / (1 + sqrt(g.H^-1 g)) to the minimum of the
    barrier.
    """

    def zoom(_, state):
        best, span = state
        points = best + span * pattern[:, None]
        index = jnp.argmin(outside(rays, points), axis=-1)
        return jnp.take_along_axis(points, index[None, :, None], axis=-1), 0.4 * span

    def lower(_, point):
        slope, bend = barrier(rays, point)
        step = displace(inverse(bend), slope)
        return point - step / (1 + safe_sqrt(dot(slope, step)))[None]

    start = jnp.zeros_like(rays.point), jnp.ones((), pattern.dtype)
    deepest = jax.lax.fori_loop(0, _ZOOMS, zoom, start)[0]
    return jax.lax.fori_loop(0, _DESCENTS, lower, deepest)


class _Setting(NamedTuple):
    """What all stages of the search need.

    lens, system: the lens and its traced system.
    radial: static description of the spokes.
    angles: azimuths (W, B) of the spokes of the rule, as a function of the frame and the corners.
    """

    lens: Lens
    system: System
    radial: RadialRule
    angles: Callable[[Frame, EdgeRays], Array]


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
    else within rounding, see `search`."""
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
    steps = jnp.any(lost).astype(jnp.int32)
    return state, (rays, target_of(rays, rays.point), steps, _near(rays, True))


def _middle(setting: _Setting, state: _State, _: Array) -> tuple[_State, _Task]:
    """Stage 3: all rays to the point deepest inside, which the linear model of the best ray
    gives."""
    tried = state.latest.rays
    far = jnp.where(tried.good, outside(tried, tried.point), jnp.inf)
    best = jnp.argmin(far, axis=-1)[:, None]
    pattern = jnp.asarray(setting.radial.start_points(), far.dtype)
    centre = middle(tried.at(best), pattern)
    rays = tried.at(jnp.broadcast_to(best, far.shape))
    return state, (rays, target_of(rays, centre), _STEPS, _near(rays, True))


def _ends(setting: _Setting, state: _State, _: Array) -> tuple[_State, _Task]:
    """Stage 4: rays to the ends of the even spokes about that point."""
    rays, _, settled = state.latest
    ray = jax.tree.map(lambda a: a[..., :1], rays)
    passes = settled[:, :1] & (outside(ray, ray.point) < 0)
    frame = Frame(ray.point, stretch(ray))
    target = target_of(rays, frame.centre, frame.toward(setting.radial.even[None]))
    near = _near(rays, setting.radial.symmetry != "rotational")  # for it this is the last stage
    return state._replace(frame=frame, passes=passes), (rays, target, _STEPS, near)


def _corners(setting: _Setting, state: _State, _: Array) -> tuple[_State, _Task]:
    """Stage 5: the first C rays to the corners, where the nearest edge changes."""
    radial, frame, even = setting.radial, state.frame, state.latest.rays
    line = target_of(even, frame.centre, frame.toward(radial.even[None]))
    distance = edge_distance(even, line)
    place, pair = changes(distance, radial.symmetry == "none", radial.corners)
    more = (0, radial.batch - radial.corners)
    place, pair = jnp.pad(place, ((0, 0), more)), jnp.pad(pair, ((0, 0), (0, 0), more))
    rays = even.at(jnp.round(place).astype(jnp.int32))
    angle = place * (radial.range / (radial.batch - 1)) - np.pi / 2
    line = target_of(rays, frame.centre, frame.toward(angle))
    rays = extrapolated(rays, newton_step(rays, line)[0])
    target = target_of(rays, frame.centre, pair=pair)
    return state._replace(even=even), (rays, target, _CORNER_STEPS, _near(rays))


def _nodes(setting: _Setting, state: _State, part: Array) -> tuple[_State, _Task]:
    """Stage 6 and later: one batch of rays to the ends of the spokes of the rule, which lie
    between the corners."""
    radial, latest = setting.radial, _corners_of(setting.radial, state.latest)
    corners = jax.tree.map(lambda a, b: jnp.where(part == 0, a, b), latest, state.corners)
    angle = setting.angles(state.frame, corners)
    angle = jax.lax.dynamic_slice_in_dim(angle, part * radial.batch, radial.batch, axis=-1)
    start = state.even.at(radial.nearest(angle))
    target = target_of(start, state.frame.centre, state.frame.toward(angle))
    return state._replace(corners=corners), (start, target, _STEPS, _near(start))


def _corners_of(radial: RadialRule, latest: EdgeRays) -> EdgeRays:
    """The corners among the results of stage 5."""
    rays, pair, settled = jax.tree.map(lambda a: a[..., : radial.corners], latest)
    inside = outside(rays, rays.point) < _CORNER_MARGIN
    return EdgeRays(rays, pair, settled & inside & (pair[0] != pair[1]))


@functools.partial(jax.jit, static_argnums=(2, 3))
def _initial(lens: Lens, scene: Scene, radial: RadialRule, crossing: bool) -> _State:
    """The state before the first stage: zeros of the right shapes."""
    waves, kind = scene.wavelengths.shape[0], lens.curvature.dtype
    edges = lens.count + 1 + crossing * len(lens.active) + aperture_edges(lens)
    zeros = functools.partial(jnp.zeros, dtype=kind)

    def none(count):
        point, no = zeros((2, waves, count)), jnp.zeros((waves, count), bool)
        q, rates = zeros((2, edges, waves, count)), zeros((2, 2, waves, count))
        rays = Rays(point, point, q, rates, jnp.stack([q, q]), no)
        return EdgeRays(rays, point.astype(jnp.int32), no)

    one, latest, ends = none(1), none(radial.batch), none(radial.count)
    corners = none(radial.corners)
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
    """
    if eager_values((lens, scene, used)) is not None:
        return _known_plan(lens, scene, radial, used, crossing)

    def angles(frame: Frame, corners: EdgeRays) -> Array:
        return radial.nodes(frame, used, corners.rays.point, corners.settled)[0]

    setting = _Setting(lens, system_of(lens, scene), radial, angles)
    state, end = _initial(lens, scene, radial, crossing), _last(radial) + radial.parts
    return _plan_of(_run(setting, crossing, state, np.int32(0), end), used)


def _known_plan(lens: Lens, scene: Scene, radial: RadialRule, used: Array, crossing: bool) -> Plan:
    """`plan` of known numbers, by a program that all rules share: first all stages in front of
    the last, then the last one for each batch of spokes."""
    one, last = radial.one_batch, _last(radial)
    none = np.zeros((scene.wavelengths.size, one.count), lens.curvature.dtype)
    run = functools.partial(_known_stages, lens, scene, one, crossing)
    state = run(none, _initial(lens, scene, one, crossing), (np.int32(0), last))
    angle = np.asarray(_angles(radial, used, state.frame, state.latest))
    parts = [run(a, state, (last, last + 1)) for a in np.split(angle, radial.parts, axis=-1)]
    ends = jax.tree.map(lambda *a: np.concatenate(a, axis=-1), *(part.ends for part in parts))
    return _plan_of(parts[0]._replace(ends=ends), used)


@functools.partial(jit, wanted=LARGE, static_argnames=("radial", "crossing"))
def _known_stages(
    lens: Lens, scene: Scene, radial: RadialRule, crossing: bool, angle: Array, state: _State,
    span: tuple[Array, Array],
) -> _State:  # fmt: skip
    """`_run` with the azimuths (W, B) of one batch of spokes."""
    setting = _Setting(lens, system_of(lens, scene), radial, lambda *_: angle)
    return _run(setting, crossing, state, *span)


@functools.partial(jax.jit, static_argnums=0)
def _angles(radial: RadialRule, used: Array, frame: Frame, latest: EdgeRays) -> Array:
    """Azimuths (W, B) of the spokes of a rule, from the results of stage 5."""
    corners = _corners_of(radial, latest)
    return radial.nodes(frame, used, corners.rays.point, corners.settled)[0]


def _last(radial: RadialRule) -> np.int32:
    """Index of the last stage; one radius has no corners."""
    return np.int32(3 if radial.symmetry == "rotational" else 5)


def _run(setting: _Setting, crossing: bool, state: _State, begin: Any, end: Any) -> _State:
    """Runs the stages from `begin` to `end`; the last stage once for each batch of spokes.

    One loop runs all stages, so that the trace, which is slow to compile, appears once in the
    program.
    """
    radial = setting.radial
    to_edges = functools.partial(trace, setting.lens, setting.system, crossing)
    stages, last = [_start, _rescue, _middle, _ends, _corners, _nodes], _last(radial)
    tasks = [functools.partial(stage, setting) for stage in stages[: last + 1]]

    def run(stage, state):
        part = jnp.maximum(stage - last, 0)
        state, task = jax.lax.switch(jnp.minimum(stage, last), tasks, state, part)
        latest = search(to_edges, *task)
        into = functools.partial(jax.lax.dynamic_update_slice_in_dim, axis=-1)
        ends = jax.tree.map(lambda a, b: into(a, b, part * radial.batch), state.ends, latest)
        return state._replace(latest=latest, ends=ends)

    return jax.lax.fori_loop(begin, end, run, state)


@jax.jit
def _plan_of(state: _State, used: Array) -> Plan:
    """The plan of the last state."""
    join = lambda a, b: jnp.concatenate([a, b], axis=-1)  # noqa: E731
    edge = jax.tree.map(join, state.corners, state.ends)
    edge = edge._replace(settled=edge.settled & state.passes)
    return Plan(state.frame, state.passes, edge, used)
