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
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import Numbers, brief, safe_divide
from ..rays.status import Status
from ..rays.system import Vector, determinant, dot, system_of
from ..rays.trace import Bundle
from . import boundary
from .boundary import displace
from .radial import CORNERS, RadialRule, gauss
from .rules import PupilRule, Symmetry, check_rule
from .stages import Plan, plan as find_boundary, target_of

__all__ = ["Clipped", "ClippedGroup"]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _follow(
    radial: RadialRule, crossing: bool, lens: Lens, scene: Scene, plan: Plan
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
        # What does not exist does not move: its slopes may be infinite, and in reverse mode 0 times
        # inf is no number.
        crossed = jnp.where(follows, crossed, jax.lax.stop_gradient(rays.point))
        q = jnp.where(follows, q, jax.lax.stop_gradient(rays.q))
        moved = rays._replace(point=crossed, q=q)
        # A corner stays on both edges.
        corner = (crossed + boundary.corner_step(moved, pair))[..., corners]
        corner = jnp.where(follows[:, corners], corner, point[..., corners])
        # A spoke rotates with the corners, and ends on its edge.
        toward, _ = plan.spokes(radial, corner)
        moved = jax.tree.map(lambda a: a[..., ends], moved)
        distance = boundary.edge_distance(moved, target_of(moved, plan.frame.centre, toward))
        length = boundary.picked(distance, pair[:1, :, ends])[0]
        known = jax.lax.stop_gradient(_along(point[..., ends] - plan.frame.centre, toward))
        length = jnp.where(follows[:, ends], length, known)
        new = jnp.concatenate([corner, plan.frame.centre + length[None] * toward], axis=-1)
        return new, jnp.where(follows, displace(rays.d_launch, new - crossed), 0)

    return (point, launch), jax.jvp(step, (lens, scene), tangents[:2])[1]


def _along(line: Array, toward: Array) -> Array:
    """Length (W, B) of a line in units of `toward`."""
    return safe_divide(dot(toward, line), dot(toward, toward))


class Fitted(PupilRule):
    """A rule whose weights contain the clipping."""

    def transmission(self, lens: Lens, bundle: Bundle) -> Array:
        """1 for all rays (W, Q) that exist."""
        whole = (bundle.status == Status.OK) | (bundle.status == Status.CLIPPED)
        return whole.astype(bundle.path.dtype)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Clipped(Fitted):
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
        """Points and weights, differentiable by the lens."""
        orders = jnp.asarray([self.order], jnp.int32)
        return _open(lens, scene, orders, (self.size,), self.symmetry, self.crossing)[0]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ClippedGroup(Fitted):
    """Rules `Clipped` of several orders, whose points one search finds.

    orders: (G,), int32.
    chosen: (), int32, number of the order whose points have weight; -1 for all of them.
    sizes: `Clipped.size` of each order.
    symmetry, crossing: as in `Clipped`.
    """

    orders: Numbers
    chosen: Numbers
    sizes: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})
    crossing: bool = dataclasses.field(metadata={"static": True})
    __repr__ = brief

    def points(self, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
        """Points of all orders, and their weights, 0 for orders that are not chosen."""
        orders = jnp.asarray(self.orders, jnp.int32)
        parts = _open(lens, scene, orders, self.sizes, self.symmetry, self.crossing)
        (*points, weights) = (
            jnp.concatenate(arrays, axis=-1) for arrays in zip(*((*p, w) for p, w in parts))
        )
        return tuple(points), jnp.where(self.own(lens)[None], weights, 0)

    def own(self, lens: Lens) -> Any:
        """Rays of the chosen order, (Q,), bool; NumPy if `chosen` is known."""
        sets = 1 if lens.apertures is None else len(lens.apertures.terms()[0])
        counts = [sets * n * _most(lens, self.symmetry, n) for n in self.sizes]
        order, chosen = np.repeat(np.arange(len(counts), dtype=np.int32), counts), self.chosen
        return (order == chosen) | (chosen < 0)  # type: ignore[operator]


def _spokes(lens: Lens, symmetry: Symmetry, order: Any) -> Any:
    """Number of spokes of an order. Edges make corners; narrow panels between them need spokes
    too."""
    part = {"rotational": 0, "bilateral": 1, "none": 2}[symmetry]
    return part * (2 * order + 6 + 2 * boundary.aperture_edges(lens))


def _most(lens: Lens, symmetry: Symmetry, size: int) -> int:
    """Largest number of spokes of an order up to `size`."""
    return max(_spokes(lens, symmetry, size), 1)


def _open(
    lens: Lens,
    scene: Scene,
    orders: Array,
    sizes: tuple[int, ...],
    symmetry: Symmetry,
    crossing: bool,
) -> list[tuple[Vector, Array]]:
    """Points and weights of each of G orders: those of the `terms` of the apertures."""
    given, extra = (scene, orders, sizes, symmetry, crossing), lens.apertures
    if extra is None or not (extra.most or any(extra.blocks)):
        return _inside(lens, *given)
    sign, *terms = extra.terms()

    def part(shapes, corners):
        return _inside(dataclasses.replace(lens, apertures=extra.part(shapes, corners)), *given)

    def total(points, weight):  # from (W, T, Q)
        weight = weight * jnp.asarray(sign, weight.dtype)[None, :, None]
        points, weight = jax.tree.map(lambda a: a.reshape(len(a), -1), (points, weight))
        # A total within rounding counts as no light.
        least = float(jnp.finfo(weight.dtype).eps) ** 0.5
        lit = jnp.sum(weight, axis=-1, keepdims=True) > least
        return points, jnp.where(lit, weight, 0)

    return [total(*one) for one in jax.vmap(part, out_axes=1)(*map(jnp.asarray, terms))]


def _inside(
    lens: Lens,
    scene: Scene,
    orders: Array,
    sizes: tuple[int, ...],
    symmetry: Symmetry,
    crossing: bool,
) -> list[tuple[Vector, Array]]:
    """Points and weights of the light inside of all apertures and obscurations, as in `_open`."""
    most = tuple(_most(lens, symmetry, size) for size in sizes)
    extra = lens.apertures
    sides = 0 if extra is None else extra.most * extra.kinds.count("polygon")
    radial = RadialRule(symmetry, most, CORNERS + 2 * sides)
    used = jnp.asarray(_spokes(lens, symmetry, orders), jnp.int32)
    plan = find_boundary(*jax.lax.stop_gradient((lens, scene)), radial, used, crossing)
    plan = jax.lax.stop_gradient(plan)
    point, _ = _follow(radial, crossing, lens, scene, plan)
    corner, end = point[..., : -radial.count], point[..., -radial.count :]
    toward, share = plan.spokes(radial, corner)
    length = _along(end - plan.frame.centre, toward)
    area = jnp.where(plan.passes, share * length**2 * determinant(plan.frame.shape), 0)
    axial, centre, found = symmetry == "rotational", plan.frame.centre[..., None], []
    stops = np.cumsum(most)  # the spokes behind the last stop only fill up the search
    for k, (start, stop) in enumerate(zip(stops - most, stops)):
        node, weight = jnp.asarray(gauss(sizes[k]), length.dtype)[:, orders[k]]
        # For "rotational" r^2 is the variable, as without clipping.
        node, weight = (jnp.sqrt(node), weight) if axial else (node, 2 * node * weight)
        node, weight = node[None, None], weight[None, None]
        radius = length[:, start:stop, None] * node
        points = centre + radius[None] * toward[..., start:stop, None]
        points, weight = points.reshape(2, len(length), -1), area[:, start:stop, None] * weight
        found.append((tuple(points[1:] if axial else points), weight.reshape(len(length), -1)))
    return found
