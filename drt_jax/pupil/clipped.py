"""Quadrature fitted to the part of the pupil that apertures and obscurations leave.

A rule on the whole stop whose clipped rays drop out one by one converges like a sum of pixels.
Here the boundary is found: in polar coordinates about a point inside, the distance to it is
smooth but for the corners where one edge takes over from another. Gauss rules between the corners
and along the radii converge as on an open stop; also in a narrow slit, as its coordinates are
stretched until it is about as wide as long.

Vectors are arrays with their 2 components first, and B rays a colour last.
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
from ..numerics import safe_divide
from ..rays.aim import paraxial_launch
from ..rays.status import Status
from ..rays.system import System, Vector, determinant, dot, system_of
from ..rays.trace import Bundle
from . import boundary
from .rules import PupilRule, Symmetry, check_rule
from .spokes import CORNERS, Spokes, changes, gauss, unit

__all__ = ["Clipped"]

# Steps of each stage of the search.
_STEPS = 1, 48, 48, 16, 48


def _stages(lens: Lens, system: System, spokes: Spokes, used: Array) -> list:
    """The stages of the search: each takes what they found, the stages along a first axis, and
    tells the rays to start from and their goals."""
    like = jnp.zeros((2, system.index.shape[1], spokes.count), system.index.dtype)
    of = lambda found, stage: jax.tree.map(lambda a: a[stage], found)  # noqa: E731
    scouts = jnp.asarray(spokes.scouts(), like.dtype)

    def goal(centre, toward=None, pair=None):
        toward = like if toward is None else toward
        pair = like.astype(jnp.int32) if pair is None else pair
        return boundary.Goal(like + centre, toward, pair)

    def shape(found):  # of what is left about the middle
        return boundary.stretch(lens, jax.tree.map(lambda a: a[1, ..., :1], found.rays))

    def scout(found):  # all over the stop, to where paraxial optics puts them
        radius = lens.semi_diameter[lens.stop]
        launch = paraxial_launch(system, tuple(like + radius * scouts[:, None]), 4 * radius)
        arriving = boundary.arriving(system, jnp.stack(launch), radius)
        return of(found.rays, 0)._replace(launch=arriving), goal(like)

    def middle(found):  # all to the point deepest inside, by the model of the best scout
        rays = of(found.rays, 0)
        far = jnp.where(rays.good, boundary.outside(lens, rays, rays.point), jnp.inf)
        best = jnp.argmin(far, axis=-1)[:, None]
        rays = rays.at(best)
        return rays.at(like[0].astype(jnp.int32)), goal(boundary.middle(lens, rays, scouts))

    def ends(found):  # to the ends of even spokes
        rays, toward = of(found.rays, 1), unit(jnp.asarray(spokes.even, like.dtype))[:, None]
        return rays, goal(rays.point, boundary.moved(shape(found), toward))

    def corners(found):  # to the corners, in the first places
        even = of(found, 2)
        place, pair = changes(boundary.ends(lens, even.rays, even.goal), spokes.symmetry == "none")
        more = (0, spokes.count - CORNERS)
        place, pair = jnp.pad(place, ((0, 0), more)), jnp.pad(pair, ((0, 0), (0, 0), more))
        rays = even.rays.at(jnp.round(place).astype(jnp.int32))
        angle = place * (spokes.turn / (spokes.count - 1)) - np.pi / 2
        toward = boundary.moved(shape(found), unit(angle))
        line = boundary.ahead(lens, rays, goal(even.goal.centre, toward))[0]
        return boundary.shifted(rays, line), goal(even.goal.centre, None, pair)

    def nodes(found):  # to the ends of the spokes of the rule
        own = shape(found)
        rays, found = of(found.rays, 2), of(found, 3)
        corner = (found.rays.point - found.goal.centre)[..., :CORNERS]
        corner = boundary.moved(boundary.inverse(own), corner)
        angle, _ = spokes.nodes(used, corner, _exists(lens, found)[:, :CORNERS])
        toward = boundary.moved(own, unit(angle))
        return rays.at(spokes.nearest(angle)), goal(found.goal.centre, toward)

    return [scout, middle, ends, corners, nodes][: 3 if spokes.symmetry == "rotational" else 5]


def _exists(lens: Lens, found: boundary.Reached) -> Array:
    """Whether rays (W, B) lie in corners of the boundary, or near it."""
    inside = boundary.outside(lens, found.rays, found.rays.point) < 0.01
    return found.settled & inside & (found.goal.pair[0] != found.goal.pair[1])


def _find(
    lens: Lens, system: System, spokes: Spokes, used: Array, crossing: bool
) -> boundary.Reached:
    """What the stages find, one after the other, along a first axis."""
    stages = _stages(lens, system, spokes, used)

    def several(shape, dtype=system.index.dtype):
        return jnp.zeros((len(stages), *shape, system.index.shape[1], spokes.count), dtype)

    point, rates, rows = (
        several((2,)),
        several((2, 2)),
        lens.count + 1 + crossing * len(lens.active),
    )
    hits, moves, no = several((2, rows)), several((2, 2, rows)), several((), bool)
    goal = boundary.Goal(point, point, several((2,), jnp.int32))
    rays = boundary.Rays(point, point, hits, rates, moves, no)

    def run(stage, found):
        start, goal = jax.lax.switch(stage, stages, found)
        steps, exact = jnp.array(_STEPS, jnp.int32)[stage], (stage == 3) | (stage == last)
        new = boundary.search(lens, system, start, goal, steps, exact)
        return jax.tree.map(lambda a, b: a.at[stage].set(b), found, new)

    last = len(stages) - 1  # with the corners, the rays that the rule is made of
    start = boundary.Reached(rays, goal, several((), jnp.int32), no)
    return jax.lax.fori_loop(0, len(stages), run, start)


class _Plan(NamedTuple):
    """The boundary without derivatives: C corners and B spokes, K = C + B rays.

    centre: (2, W, 1). shape: (2, 2, W, 1), see `boundary.stretch`. point: (2, W, K) in units of
    the stop's semi-diameter. launch: (2, W, K), mm, and aims: (2, 2, W, K), see `boundary.Rays`.
    pair: (2, W, K), the edges that end a ray, for a spoke both the same. rates: (2, 2, W, K), see
    `boundary.rates`.
    follows: (W, K), whether a ray follows the lens. passes: (W, 1), whether light passes. used: (),
    how many spokes count.
    """

    centre: Array
    shape: Array
    point: Array
    launch: Array
    aims: Array
    pair: Array
    rates: Array
    follows: Array
    passes: Array
    used: Array

    def nodes(self, spokes: Spokes, corner: Array) -> tuple[Array, Array]:
        """Directions (2, W, B) of the spokes between corners (2, W, C), and weights (W, B)."""
        own = boundary.moved(boundary.inverse(self.shape), corner - self.centre)
        angle, share = spokes.nodes(self.used, own, self.follows[:, : corner.shape[-1]])
        return boundary.moved(self.shape, unit(angle)), share


def _plan(lens: Lens, scene: Scene, spokes: Spokes, used: Array, crossing: bool) -> _Plan:
    found = _find(lens, system_of(lens, scene), spokes, used, crossing)
    middle, nodes = (jax.tree.map(lambda a: a[k], found) for k in (1, -1))
    passes = middle.settled & (boundary.outside(lens, middle.rays, middle.rays.point) < 0)
    rays, pair, follows = nodes.rays, jnp.stack([nodes.edge] * 2), nodes.settled
    if spokes.symmetry != "rotational":
        corners = jax.tree.map(lambda a: a[3, ..., :CORNERS], found)
        join = lambda a, b: jnp.concatenate([a, b], axis=-1)  # noqa: E731
        rays, pair = jax.tree.map(join, corners.rays, rays), join(corners.goal.pair, pair)
        follows = join(_exists(lens, corners), follows)
    follows = follows & passes[:, :1]
    first = jax.tree.map(lambda a: a[..., :1], middle.rays)
    centre, shape = first.point, boundary.stretch(lens, first)
    rates = boundary.rates(lens, rays, pair)
    known = rays.point, rays.launch, rays.aims, pair, rates
    return _Plan(centre, shape, *known, follows, passes[:, :1], used)


def _followed(
    crossing: bool, plan: _Plan, lens: Lens, scene: Scene, launch: Array
) -> tuple[Array, Array]:
    """Points (2, W, K) and `boundary.gaps` of the rays of a plan launched at (2, W, K)."""
    hits, _ = boundary.traced(lens, system_of(lens, scene), launch, crossing)
    point = hits[:, lens.stop] / lens.semi_diameter[lens.stop]
    return point, boundary.gaps(lens, hits, plan.pair)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _known_rates(
    crossing: bool, lens: Lens, scene: Scene, launch: Array, plan: _Plan
) -> tuple[Array, Array]:
    """Derivatives by the point, of the launch and of the gaps of `_followed`: known numbers, only
    theirs cost anything."""
    return plan.aims, plan.rates


@_known_rates.defjvp
def _known_rates_jvp(crossing: bool, primals: Any, tangents: Any) -> tuple[Any, Any]:
    def rates(lens, scene, launch):
        follow = functools.partial(_followed, crossing, primals[3], lens, scene)
        columns = jax.vmap(lambda unit: jax.jvp(follow, (launch,), (unit,))[1])
        points, gaps = columns(boundary.units(launch))
        aims = boundary.inverse(points)
        return aims, jnp.stack([boundary.moved(gaps, a) for a in aims])

    return jax.jvp(rates, primals[:3], tangents[:3])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _follow(
    spokes: Spokes, crossing: bool, lens: Lens, scene: Scene, plan: _Plan
) -> tuple[Array, Array]:
    """The points of a plan, and where their rays are launched, with their derivatives by the lens
    and the scene, in every mode."""
    return plan.point, plan.launch


@_follow.defjvp
def _follow_jvp(spokes: Spokes, crossing: bool, primals: Any, tangents: Any) -> tuple[Any, Any]:
    lens, scene, plan = primals
    # Through the function itself, so that the points carry derivatives of their own.
    point, launch = _follow(spokes, crossing, lens, scene, plan)
    aims, rates = _known_rates(crossing, lens, scene, launch, plan)
    held = lambda lens, scene: _followed(crossing, plan, lens, scene, launch)  # noqa: E731
    _, (slid, change) = jax.jvp(held, (lens, scene), tangents[:2])
    change = change - boundary.moved(rates, slid)  # of rays through fixed points
    corners, ends = (slice(None, -spokes.count), slice(-spokes.count, None))
    # A corner stays on both edges.
    corner = -boundary.moved(boundary.inverse(rates[..., corners]), change[..., corners])
    corner = jnp.where(plan.follows[:, corners], corner, 0)
    # A spoke turns with the corners, and ends on its edge.
    nodes = lambda corner: plan.nodes(spokes, corner)[0]  # noqa: E731
    toward, turned = jax.jvp(nodes, (point[..., corners],), (corner,))
    side = _along(point[..., ends] - plan.centre, toward)[None] * turned
    rate = rates[:, 0, :, ends]
    longer = -safe_divide(change[0, :, ends] + dot(rate, side), dot(rate, toward))
    longer = jnp.where(plan.follows[:, ends], longer, 0)
    moved = jnp.concatenate([corner, side + longer[None] * toward], axis=-1)
    return (point, launch), (moved, jnp.where(plan.follows, boundary.moved(aims, moved - slid), 0))


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
        kinds = () if lens.apertures is None else lens.apertures.kinds
        edges = sum(2 if kind == "rectangle" else 1 for kind in kinds)
        used, most = (part * (2 * n + 6 + 2 * edges) for n in (self.order, self.size))
        spokes = Spokes(self.symmetry, max(most, 32 * part) + 1)
        given = *jax.lax.stop_gradient((lens, scene)), spokes, jnp.asarray(used, jnp.int32)
        plan = jax.lax.stop_gradient(_plan(*given, self.crossing))
        point, _ = _follow(spokes, self.crossing, lens, scene, plan)
        corner, end = point[..., : -spokes.count], point[..., -spokes.count :]
        toward, share = plan.nodes(spokes, corner)
        # The nodes have the first places; the others are of the search alone.
        toward, share, end = (a[..., : max(most, 1)] for a in (toward, share, end))
        length = _along(end - plan.centre, toward)
        node, weight = jnp.asarray(gauss(self.size), length.dtype)[:, self.order, None, None]
        # On the axis r^2 is the variable, as without clipping.
        node, weight = (jnp.sqrt(node), weight) if axial else (node, 2 * node * weight)
        size = determinant(plan.shape)
        weight = jnp.where(plan.passes, share * length**2 * size, 0)[..., None] * weight
        points = plan.centre[..., None] + (length[..., None] * node)[None] * toward[..., None]
        points = points.reshape(2, len(length), -1)
        return tuple(points[1:] if axial else points), weight.reshape(len(length), -1)
