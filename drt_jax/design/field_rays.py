"""The rays of a lens from all fields of a problem, traced once: what operands are computed from."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.forms import FORMS
from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import safe_divide, safe_sqrt
from ..pupil.clipped import Clipped
from ..pupil.rules import PupilRule, Symmetry
from ..rays import fermat
from ..rays.find import Found
from ..rays.solve import Solver, reattach
from ..rays.status import Status
from ..rays.system import Vector, determinant, divide, dot, system_of
from ..rays.trace import Bundle, aims, bundle_of, trace_bundle

# The first rays of every view: the chief ray, then those through the top, the bottom and the side
# of the stop. They carry no light.
_EXTRA = np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 1.0, -1.0, 0.0]])
EXTRAS = _EXTRA.shape[1]


def symmetry_by_structure(lens: Lens, axial: bool = False) -> Symmetry:
    """How much of the pupil must be traced for fields along y, or for the axis alone, whatever the
    numbers of the lens are; known inside a trace, too."""
    moves = (lens.decentre, lens.tilt, lens.elements, lens.apertures)
    forms = (*lens.forms, *(() if lens.phase is None else lens.phase.forms))
    kinds = {FORMS[form].symmetry for form in forms}
    if any(a is not None for a in moves) or "none" in kinds:
        return "none"
    return "rotational" if axial and kinds == {"rotational"} else "bilateral"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class FieldRays:
    """Rays of V views, each of W wavelengths: all fields at the first distance, then all at the
    next. Of Q rays of each the first is the chief ray, the next three run through the rim of the
    stop; these four carry no light. What stands from `bundle` on is None where nothing is traced.

    field: (V, 2), radians. distance: (V,), mm. wavelengths: (W,), um.
    wavelength_weights: (W,), of their light, adding up to 1.
    bundle: arrays with a first axis (V,).
    points: D arrays (V, W, Q), where rays cross the stop, in units of its semi-diameter.
    stop_weights: (V, W, Q), what part of the light through the stop each ray stands for.
    weights: (V, W, Q), the same of the light that arrives: 0 for rays that are clipped, for those
        that fail as much as if they passed; adds up to 1, where there is any.
    throughput: (V, W), what part of the light through the stop is not clipped.

    Static:
    fields, distances: how many. symmetry: what part of the pupil the rays stand for.
    """

    field: Array
    distance: Array
    wavelengths: Array
    wavelength_weights: Array
    fields: int = dataclasses.field(metadata={"static": True})
    distances: int = dataclasses.field(metadata={"static": True})
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})
    bundle: Bundle = None  # type: ignore[assignment]
    points: Vector = None  # type: ignore[assignment]
    stop_weights: Array = None  # type: ignore[assignment]
    weights: Array = None  # type: ignore[assignment]
    throughput: Array = None  # type: ignore[assignment]

    @property
    def arrives(self) -> Array:
        """Rays that meet the sensor, also those that are clipped, (V, W, Q) bool."""
        return (self.bundle.status == Status.OK) | (self.bundle.status == Status.CLIPPED)

    @property
    def sensor_hits(self) -> Array:
        """Where rays meet the sensor, (D, V, W, Q), mm, y last; 0 for rays that fail."""
        return jnp.stack([h[:, -1] for h in self.bundle.hits])

    def views(self, fields: Sequence[int], distances: Sequence[int]) -> np.ndarray:
        """The numbers of the views of some fields and distances, counted from 0; empty: all."""
        distances = distances or range(self.distances)
        return np.array(
            [d * self.fields + f for d in distances for f in fields or range(self.fields)]
        )

    def select(
        self, fields: Sequence[int], distances: Sequence[int], wavelengths: Sequence[int]
    ) -> "FieldRays":
        """The rays of some fields, distances and wavelengths, counted from 0; empty: all."""
        if not (fields or distances or wavelengths):
            return self
        views = self.views(fields, distances)
        waves = np.array(wavelengths or range(len(self.wavelengths)))

        def some(tree: Any) -> Any:
            """Of arrays (V, W) and (V, ..., W, Q)."""
            return jax.tree.map(lambda a: a[views][..., *[waves, slice(None)][: a.ndim - 1]], tree)

        shares = self.wavelength_weights[waves]
        found = dataclasses.replace(
            self,
            field=self.field[views],
            distance=self.distance[views],
            wavelengths=self.wavelengths[waves],
            wavelength_weights=shares / jnp.sum(shares),
            fields=len(fields) or self.fields,
            distances=len(distances) or self.distances,
        )
        if self.bundle is None:
            return found
        bundle = some(self.bundle._replace(steps=self.throughput))
        return dataclasses.replace(
            found,
            bundle=bundle._replace(steps=self.bundle.steps[views]),
            points=some(self.points),
            stop_weights=some(self.stop_weights),
            weights=some(self.weights),
            throughput=some(self.throughput),
        )

    def unvignetted(self) -> "FieldRays":
        """The rays as if no clear aperture but the stop clipped any."""
        clipped = self.bundle.status == Status.CLIPPED
        status = jnp.where(clipped, Status.OK, self.bundle.status)
        bundle = self.bundle._replace(status=status)
        return dataclasses.replace(self, bundle=bundle, weights=self.stop_weights)


def trace_views(lens: Lens, views: FieldRays, rule: PupilRule, solver: Solver) -> FieldRays:
    """The views with their rays, traced together; rule: of the pupil."""
    extra = lens.apertures
    if extra is not None and any(extra.blocks) and isinstance(rule, Clipped):
        raise ValueError(
            "rule: Clipped subtracts the light inside of obscurations, which has no residuals; "
            "take Gauss or Soft"
        )

    def one(field: Array, distance: Array) -> tuple[Bundle, Vector, Array, Array, Array]:
        scene = Scene(field, distance, views.wavelengths)
        points, weights = _points(rule, lens, scene)
        bundle = trace_bundle(lens, scene, points, solver)
        failed = (bundle.status != Status.OK) & (bundle.status != Status.CLIPPED)
        light = weights * jnp.where(failed, 1, rule.transmission(lens, bundle))
        throughput = jnp.sum(light, axis=-1)
        part = safe_divide(light, jnp.broadcast_to(throughput[:, None], light.shape))
        return bundle, points, weights, part, throughput

    bundle, points, stop_weights, weights, throughput = jax.vmap(one)(views.field, views.distance)
    return dataclasses.replace(
        views,
        bundle=bundle,
        points=points,
        stop_weights=stop_weights,
        weights=weights,
        throughput=throughput,
    )


def _points(rule: PupilRule, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
    """Where rays cross the stop, D arrays (W, Q) in units of its semi-diameter, and their weights
    (W, Q): 0 for the extra ones, which come first."""
    points, weights = rule.points(lens, scene)
    waves = scene.wavelengths.shape[0]
    extra = jnp.asarray(_EXTRA[2 - len(points) :], weights.dtype)
    weights = jnp.broadcast_to(weights, (waves, weights.shape[-1]))
    rows = zip(extra, points, strict=True)
    wide = ((jnp.broadcast_to(a, (waves, a.shape[-1])) for a in pair) for pair in rows)
    joined = tuple(jnp.concatenate([*pair], axis=-1) for pair in wide)
    return joined, jnp.pad(weights, ((0, 0), (EXTRAS, 0)))


def beam_radius(lens: Lens, rays: FieldRays) -> Array:
    """How far from the axis the light meets each surface (S,), mm: its semi-diameter or, where that
    is inf, as far as the rays go."""
    squares = sum((h**2 for h in rays.bundle.hits), jnp.zeros(()))
    reach = safe_sqrt(jnp.max(jnp.where(rays.arrives[:, None], squares, 0), axis=(0, 2, 3)))
    semi = lens.semi_diameter
    return jnp.where(jnp.isfinite(semi), semi, reach)[:-1]


def incidence_cosines(lens: Lens, rays: FieldRays) -> Array:
    """Cosines (V, L, W, Q) of the angles at which rays fall on the L surfaces that bend light; 1
    for rays that fail."""
    rows = np.array([*lens.active, lens.count])

    def one(field: Array, distance: Array, hits: Vector, arrives: Array) -> Array:
        scene = Scene(field, distance, rays.wavelengths)
        system = system_of(lens, scene, len(hits))
        path = fermat.geometry(tuple(h[rows] for h in hits), system)
        normal = *(-s for s in path.slope), jnp.ones_like(path.slope[0])
        cosine = jnp.abs(dot(normal, path.before)) / jnp.sqrt(dot(normal, normal))
        return jnp.where(arrives[None], cosine, 1)[:-1]

    return jax.vmap(one)(rays.field, rays.distance, rays.bundle.hits, rays.arrives)


def relative_illumination(lens: Lens, rays: FieldRays) -> Array:
    """Light on the sensor (V,) of the middle wavelength relative to that of the first field at the
    same distance, of an object that is everywhere as bright: the sum over rays of weight x solid
    angle, projected on the sensor (Slater), see `_solid_angles`. Clipped light counts for nothing.
    """
    middle = len(rays.wavelengths) // 2
    one = slice(middle, middle + 1)
    scene = rays.field, rays.distance, rays.bundle, rays.points
    angles = jax.vmap(lambda *view: _solid_angles(lens, rays.wavelengths[one], one, *view))(*scene)
    light = rays.weights[:, one] * rays.throughput[:, one, None]
    light = jnp.where(rays.arrives[:, one], light, 0)
    total = jnp.sum(light * jnp.abs(angles), axis=(1, 2)).reshape(rays.distances, rays.fields)
    return jnp.ravel(safe_divide(total, jnp.broadcast_to(total[:, :1], total.shape)))


def _solid_angles(
    lens: Lens, wavelength: Array, one: slice, field: Array, distance: Array, bundle: Bundle,
    points: Vector
) -> Array:  # fmt: skip
    """|dl / dp| (1, Q): the area of direction cosines l at one point of the sensor by the area of
    the stop. With hit h and direction l as functions of the stop point p and the field f, h stays
    where df = -(dh/df)^-1 (dh/dp) dp; so dl / dp = l_p - l_f h_f^-1 h_p."""
    rows = np.array([*lens.active, lens.count])
    scene = Scene(field, distance, wavelength)
    hits = jax.lax.stop_gradient(tuple(h[rows, one] for h in bundle.hits))
    arrival = fermat.arrival(hits, system_of(lens, scene, len(hits)))
    status = jnp.where(bundle.status == Status.CLIPPED, Status.OK, bundle.status)[one]
    found = Found(hits, arrival, status.astype(jnp.int32), bundle.steps)

    def arriving(points: Vector, field: Array) -> tuple[Vector, Vector]:
        scene = Scene(field, distance, wavelength)
        system, target = aims(lens, scene, points)
        bundle = bundle_of(lens, scene, system, target, reattach(found, system, target))
        return tuple(h[-1] for h in bundle.hits), bundle.arrival[:-1]

    points = tuple(p[one] for p in points)
    if len(points) == 1:  # on the axis, as the first field
        return jnp.ones_like(points[0])
    _, push = jax.linearize(arriving, points, field)
    zero, units = jax.tree.map(jnp.zeros_like, points), jnp.eye(2, dtype=field.dtype)
    (hit_x, line_x), (hit_y, line_y) = (push(zero, unit) for unit in units)
    columns = []
    for k in range(2):
        unit = tuple(jnp.full_like(p, float(j == k)) for j, p in enumerate(points))
        hit, line = push(unit, jnp.zeros_like(field))
        back = divide(tuple(zip(hit_x, hit_y)), hit)
        parts = zip(line, line_x, line_y)
        columns.append([a - back[0] * b - back[1] * c for a, b, c in parts])
    return determinant(columns)
