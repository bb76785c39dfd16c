"""The boundary of a clipped pupil: rays that meet the edge of an aperture.

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

Vectors are arrays with their 2 components on the first axis and the B rays of a wavelength on the
last.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..lens.lens import Lens
from ..numerics import einsum, safe_divide, safe_sqrt
from ..rays.snell import shoot, shoot_anyway, split_stop
from ..rays.status import Status
from ..rays.system import System, dot
from ..rays.trace import on_all_surfaces

_ZOOMS, _STEPS = 10, 8  # refinements of the grid and Newton steps in `middle`
# With `crossing`, a path between two surfaces passes from 0 to twice this length, in units of the
# length of the lens.
_LONGEST = 100.0

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


def displace(rates: Array, change: Array) -> Array:
    """Change of a quantity by its linear model: rates[0] dx + rates[1] dy.

    rates: (2, ..., W, B), derivatives by a point.
    change: (2, W, B), change (dx, dy) of the point.
    """
    x, y = change.reshape(2, *[1] * (rates.ndim - 3), *change.shape[1:])
    return rates[0] * x + rates[1] * y


def inverse(matrix: Array) -> Array:
    """Inverses of matrices (2, 2, W, B); 0 for a singular matrix."""
    (p, q), (r, s) = matrix
    return safe_divide(jnp.array([[s, -q], [-r, p]]), (p * s - q * r)[None, None])


def picked(values: Array, edge: Array) -> Array:
    """Entries (..., N, W, B) of `values` (..., E, W, B) at the edges `edge` (N, W, B)."""
    index = edge.reshape(*[1] * (values.ndim - 3), *edge.shape)
    return jnp.take_along_axis(values, index, axis=-3)


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
    return jax.lax.fori_loop(0, _STEPS, lower, deepest)
