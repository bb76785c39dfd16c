"""Quadrature fitted to the open part of a clipped pupil.

A rule on the whole stop whose clipped rays drop out one by one converges only like a count of
pixels, because the integrand jumps at the boundary. `Clipped` finds the boundary. In polar
coordinates about a point inside, the distance to the boundary is a smooth function of the azimuth
between the corners where the nearest edge changes. So Gauss rules between the corners and along the
radii converge as fast as on an open stop. In a narrow slit the coordinates are stretched until the
slit is about as wide as long.

Vectors are arrays with their 2 components on the first axis and the B rays of a wavelength on the
last.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import Numbers, brief, eager_values, safe_divide
from ..rays.system import Vector, determinant, dot, system_of
from ..rays.trace import Bundle
from . import boundary
from .radial import CORNERS, RadialRule, displace, gauss, picked
from .rules import PupilRule, Symmetry, check_rule

__all__ = ["Clipped", "ClippedGroup"]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _attach(
    radial: RadialRule, crossing: bool, lens: Lens, scene: Scene, plan: boundary.Plan
) -> tuple[Array, Array]:
    """Stop points and launches (2, W, K) of the rays of a plan, with derivatives by the lens and
    the scene in every mode."""
    return plan.edge.rays.point, plan.edge.rays.launch


@_attach.defjvp
def _attach_jvp(radial: RadialRule, crossing: bool, primals: Any, tangents: Any) -> tuple[Any, Any]:
    """Implicit derivatives of the boundary rays.

    A ray on the boundary is a root F(launch; lens, scene) = 0: it stays on its edge (|q| = 1) and
    on its spoke, or on both edges of a corner. At a root, one Newton step launch - F_launch^-1 F
    has the value 0 and, at a fixed launch, the derivative -F_launch^-1 dF by lens and scene, which
    is the implicit one. So one step is differentiated; the derivative of the slopes is multiplied
    by F = 0 and is left out.
    """
    lens, scene, plan = primals
    _, pair, settled = plan.edge
    # Call the function itself, so that point and launch have derivatives here too: for higher
    # orders.
    point, launch = _attach(radial, crossing, lens, scene, plan)

    def trace(lens, scene, launch):
        return boundary.trace(lens, system_of(lens, scene), crossing, launch)

    rays = boundary.launched(functools.partial(trace, lens, scene), launch)
    corners, ends = (slice(None, -radial.count), slice(-radial.count, None))

    def step(lens, scene):  # one Newton step with the slopes of `rays`
        (crossed, q), _ = trace(lens, scene, launch)
        # Zero tangents for rays that did not settle: their slopes may be inf, and in reverse mode 0
        # times inf is NaN.
        crossed = jnp.where(settled, crossed, jax.lax.stop_gradient(rays.point))
        q = jnp.where(settled, q, jax.lax.stop_gradient(rays.q))
        updated = rays._replace(point=crossed, q=q)
        # A corner stays on both of its edges.
        corner = (crossed + boundary.corner_step(updated, pair))[..., corners]
        corner = jnp.where(settled[:, corners], corner, point[..., corners])
        # A spoke turns with the corners, between which it is a Gauss node, and its end stays on its
        # edge.
        toward, _ = plan.spokes(radial, corner)
        updated = jax.tree.map(lambda a: a[..., ends], updated)
        target = boundary.target_of(updated, plan.frame.centre, toward)
        length = picked(boundary.edge_distance(updated, target), pair[:1, :, ends])[0]
        known = jax.lax.stop_gradient(_along(point[..., ends] - plan.frame.centre, toward))
        length = jnp.where(settled[:, ends], length, known)
        new = jnp.concatenate([corner, plan.frame.centre + length[None] * toward], axis=-1)
        return new, jnp.where(settled, displace(rays.d_launch, new - crossed), 0)

    return (point, launch), jax.jvp(step, (lens, scene), tangents[:2])[1]


def _along(line: Array, toward: Array) -> Array:
    """Length (W, B) of the projection of `line` on `toward`, in units of `toward`."""
    return safe_divide(dot(toward, line), dot(toward, toward))


class Fitted(PupilRule):
    """Base class of rules whose weights contain the clipping."""

    def transmission(self, lens: Lens, bundle: Bundle) -> Array:
        """1 (W, Q) for every ray that exists, clipped or not; 0 for rays that fail."""
        return bundle.arrives.astype(bundle.path.dtype)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Clipped(Fitted):
    """Gauss rule fitted to the open part of the pupil: Gauss nodes in azimuth between the corners
    of the boundary, and along the radii to it.

    order: number of nodes along a radius.
    symmetry: see `symmetry_of`.
    size: order whose number of rays is used; rays of weight 0 pad a lower order, so that several
        orders share a compiled program. 0 for `order`.
    crossing: True if points where neighbouring surfaces cross also belong to the boundary; False
        takes half the time.

    Each obscuration doubles the number of rays, because the light inside of it is subtracted.
    """

    order: int
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})
    size: int = dataclasses.field(metadata={"static": True}, default=0)
    crossing: bool = dataclasses.field(metadata={"static": True}, default=True)

    def __post_init__(self) -> None:
        if not self.size:
            check_rule(self.order, self.symmetry)
            object.__setattr__(self, "size", self.order)

    def plan(self, lens: Lens, scene: Scene) -> boundary.Plan:
        """The boundary of the pupil."""
        return self._group.plan(lens, scene)

    def points(self, lens: Lens, scene: Scene, plan: Any = None) -> tuple[Vector, Array]:
        """Points and weights, both differentiable in the lens."""
        return self._group.points(lens, scene, plan)

    @property
    def _group(self) -> "ClippedGroup":
        """The group of this rule alone."""
        return ClippedGroup([self.order], 0, (self.size,), self.symmetry, self.crossing)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ClippedGroup(Fitted):
    """Rules `Clipped` of several orders, whose points one search finds.

    orders: (G,), int32.
    chosen: (), int32, index of the order whose points have weight; -1 for all of them.
    sizes: `Clipped.size` of each order.
    symmetry, crossing: as in `Clipped`.
    """

    orders: Numbers
    chosen: Numbers
    sizes: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})
    crossing: bool = dataclasses.field(metadata={"static": True})
    __repr__ = brief

    def plan(self, lens: Lens, scene: Scene) -> boundary.Plan:
        """The boundary of the pupil, or of each of its T parts on a first axis (T,)."""
        lens, scene = jax.lax.stop_gradient((lens, scene))
        used = jnp.asarray(
            _spokes(lens, self.symmetry, jnp.asarray(self.orders, jnp.int32)), jnp.int32
        )

        def found(own: Lens) -> boundary.Plan:
            return boundary.plan(own, scene, self.radial(own), used, self.crossing)

        return jax.lax.stop_gradient(_of_parts(found, lens))

    def points(self, lens: Lens, scene: Scene, plan: Any = None) -> tuple[Vector, Array]:
        """Points of all orders and their weights, which are 0 for orders that are not chosen."""
        plan = self.plan(lens, scene) if plan is None else plan
        parts = [(*points, weights) for points, weights in _open(self, lens, scene, plan)]
        *points, weights = (jnp.concatenate(arrays, axis=-1) for arrays in zip(*parts))
        return tuple(points), jnp.where(self.own(lens)[None], weights, 0)

    def radial(self, lens: Lens) -> RadialRule:
        """Static description of the spokes of all orders."""
        most = tuple(_most(lens, self.symmetry, size) for size in self.sizes)
        extra = lens.apertures
        sides = 0 if extra is None else extra.most * extra.kinds.count("polygon")
        return RadialRule(self.symmetry, most, CORNERS + 2 * sides)

    def own(self, lens: Lens) -> Any:
        """Mask (Q,), bool, of the rays of the chosen order; a NumPy array if `chosen` is known."""
        sets = 1 if lens.apertures is None else len(lens.apertures.terms()[0])
        counts = [sets * n * _most(lens, self.symmetry, n) for n in self.sizes]
        order, chosen = np.repeat(np.arange(len(counts), dtype=np.int32), counts), self.chosen
        return (order == chosen) | (chosen < 0)  # type: ignore[operator]


def _spokes(lens: Lens, symmetry: Symmetry, order: Any) -> Any:
    """Number of spokes of an order. Each edge can add corners, and the narrow panels between
    corners need spokes too."""
    part = {"rotational": 0, "bilateral": 1, "none": 2}[symmetry]
    return part * (2 * order + 6 + 2 * boundary.aperture_edges(lens))


def _most(lens: Lens, symmetry: Symmetry, size: int) -> int:
    """Largest number of spokes of an order up to `size`."""
    return max(_spokes(lens, symmetry, size), 1)


def _parted(lens: Lens) -> bool:
    """Whether the open area is a sum of parts, see `_open`."""
    extra = lens.apertures
    return extra is not None and bool(extra.most or any(extra.blocks))


def _of_parts(function: Callable, lens: Lens, *others: Any, axis: int = 0) -> Any:
    """A function of the lens with the apertures of each of the T parts of the open area. Its
    results get the axis of the parts.

    others: further arguments of the function, with the parts on their first axis.

    Known parts are evaluated one by one, so that they share a program.
    """
    extra = lens.apertures
    if extra is None or not _parted(lens):
        return function(lens, *others)

    def part(shapes: Array, corners: Array, *others: Any) -> Any:
        own = dataclasses.replace(lens, apertures=extra.part(shapes, corners))
        return function(own, *others)

    parts = *map(jnp.asarray, extra.terms()[1:]), *others
    if eager_values((lens, others)) is None:
        return jax.vmap(part, out_axes=axis)(*parts)
    each = [part(*jax.tree.map(lambda a: a[k], parts)) for k in range(len(parts[0]))]
    return jax.tree.map(lambda *a: jnp.stack(a, axis), *each)


def _open(
    group: ClippedGroup, lens: Lens, scene: Scene, plan: boundary.Plan
) -> list[tuple[Vector, Array]]:
    """Points and weights of each of G orders, for the open area of the pupil.

    The open area is a sum, with signs, of areas inside of convex apertures: the `terms` of the
    apertures, which subtract obscurations and add the convex pieces of polygons.
    """

    def inside(own: Lens, plan: boundary.Plan) -> list[tuple[Vector, Array]]:
        return _inside(group, own, scene, plan)

    found = _of_parts(inside, lens, plan, axis=1)
    if lens.apertures is None or not _parted(lens):
        return found
    sign = lens.apertures.terms()[0]

    def total(points, weight):  # from (W, T, Q)
        weight = weight * jnp.asarray(sign, weight.dtype)[None, :, None]
        points, weight = jax.tree.map(lambda a: a.reshape(len(a), -1), (points, weight))
        # A total within rounding counts as no light.
        least = float(jnp.finfo(weight.dtype).eps) ** 0.5
        positive = jnp.sum(weight, axis=-1, keepdims=True) > least
        return points, jnp.where(positive, weight, 0)

    return [total(*one) for one in found]


def _inside(
    group: ClippedGroup, lens: Lens, scene: Scene, plan: boundary.Plan
) -> list[tuple[Vector, Array]]:
    """Points and weights of each of G orders, for the area that is inside of all apertures and also
    inside of all obscurations.

    With p = centre + r L(a) M e(a), e(a) = (cos a, sin a), L the length of the spoke and M the
    stretching, the mean over the disc is the integral of det(M) L^2 r dr da / pi: weight = share
    L^2 det(M) 2 r w_r for a spoke with the weight `share` in azimuth and a radial node r with the
    weight w_r.
    """
    orders, sizes, radial = jnp.asarray(group.orders, jnp.int32), group.sizes, group.radial(lens)
    point, _ = _attach(radial, group.crossing, lens, scene, plan)
    corner, end = point[..., : -radial.count], point[..., -radial.count :]
    toward, share = plan.spokes(radial, corner)
    length = _along(end - plan.frame.centre, toward)
    area = jnp.where(plan.passes, share * length**2 * determinant(plan.frame.shape), 0)
    axial, centre, found = group.symmetry == "rotational", plan.frame.centre[..., None], []
    most = [_most(lens, group.symmetry, size) for size in sizes]
    stops = np.cumsum(most)  # the spokes behind the last stop are padding
    for k, (start, stop) in enumerate(zip(stops - most, stops)):
        node, weight = jnp.asarray(gauss(sizes[k]), length.dtype)[:, orders[k]]
        # For "rotational" the variable is r^2, as in the rule without clipping.
        node, weight = (jnp.sqrt(node), weight) if axial else (node, 2 * node * weight)
        node, weight = node[None, None], weight[None, None]
        radius = length[:, start:stop, None] * node
        points = centre + radius[None] * toward[..., start:stop, None]
        points, weight = points.reshape(2, len(length), -1), area[:, start:stop, None] * weight
        found.append((tuple(points[1:] if axial else points), weight.reshape(len(length), -1)))
    return found
