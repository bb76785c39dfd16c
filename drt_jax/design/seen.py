"""What a design is judged by: the rays of a lens from all fields, traced once."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.forms import FORMS
from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import safe_divide
from ..pupil.rules import PupilRule, Symmetry
from ..rays.aim import beam_size, paraxial_launch
from ..rays.fermat import geometry
from ..rays.snell import lack
from ..rays.solve import Solver
from ..rays.status import Status
from ..rays.system import Vector, determinant, dot, system_of
from ..rays.trace import Bundle, trace_bundle


def symmetry_by_structure(lens: Lens, axial: bool = False) -> Symmetry:
    """How much of the pupil must be traced for fields along y, or for the axis alone, whatever the
    numbers of the lens are; known inside a trace, too."""
    moves = (lens.decentre, lens.tilt, lens.elements, lens.apertures)
    forms = (*lens.forms, *(() if lens.phase is None else lens.phase.forms))
    kinds = {FORMS[form].symmetry for form in forms}
    if any(a is not None for a in moves) or "none" in kinds:
        return "disc"
    return "meridian" if axial and kinds == {"rotation"} else "half"


@dataclasses.dataclass(frozen=True)
class Rays:
    """Rays of V views, each of W colours. The first ray of each is the chief ray, the next three
    run through the rim of the stop; they carry no light.

    bundle: arrays with a first axis (V,).
    light: (V, W, Q), what part of the light of a colour each ray stands for: of those that are
        clipped none, of those that fail as much as if they passed; adds up to 1, where there is any.
    passed: (V, W), the share of the light through the stop that is not clipped.
    """

    bundle: Bundle
    light: Array
    passed: Array

    @property
    def whole(self) -> Array:
        """Rays that meet the sensor, (V, W, Q)."""
        return (self.bundle.status == Status.OK) | (self.bundle.status == Status.CLIPPED)


# The chief ray, and rays through the top, the bottom and the side of the stop.
_EXTRA = np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 1.0, -1.0, 0.0]])
EXTRAS = _EXTRA.shape[1]


class Seen:
    """A lens as the operands see it; what none asks for is not computed.

    lens: in a trace. views: its fields (V, 2) in radians and distances (V,) in mm, all `fields` at
    the first of the `distances`, then at the next; with the colours (W,) of all. rule: of the
    pupil. solver: that finds its rays. colour_weights: (W,), adding up to 1.
    """

    def __init__(
        self,
        lens: Lens,
        views: Scene,
        rule: PupilRule,
        solver: Solver,
        colour_weights: Array,
        fields: int,
    ):
        self.lens, self.views, self.rule, self._solver = lens, views, rule, solver
        self.colour_weights, self.fields = colour_weights, fields
        self.distances = len(views.distance) // fields

    @functools.cached_property
    def rays(self) -> Rays:
        """The rays of all views, traced together."""

        def one(field: Array, distance: Array) -> tuple[Bundle, Array, Array]:
            scene = Scene(field, distance, self.views.wavelengths)
            points, weights = self._points(scene)
            bundle = trace_bundle(self.lens, scene, points, self._solver)
            failed = (bundle.status != Status.OK) & (bundle.status != Status.CLIPPED)
            light = weights * jnp.where(failed, 1, self.rule.transmission(self.lens, bundle))
            passed = jnp.sum(light, axis=-1)
            part = safe_divide(light, jnp.broadcast_to(passed[:, None], light.shape))
            return bundle, part, passed

        return Rays(*jax.vmap(one)(self.views.field, self.views.distance))

    def _points(self, scene: Scene) -> tuple[Vector, Array]:
        """Where rays cross the stop, D arrays (W, Q) in units of its semi-diameter, and their
        weights (W, Q): 0 for the extra ones, which come first."""
        points, weights = self.rule.points(self.lens, scene)
        waves = scene.wavelengths.shape[0]
        extra = jnp.asarray(_EXTRA[2 - len(points) :], weights.dtype)
        weights = jnp.broadcast_to(weights, (waves, weights.shape[-1]))
        rows = zip(extra, points, strict=True)
        wide = ((jnp.broadcast_to(a, (waves, a.shape[-1])) for a in pair) for pair in rows)
        joined = tuple(jnp.concatenate([*pair], axis=-1) for pair in wide)
        return joined, jnp.pad(weights, ((0, 0), (EXTRAS, 0)))

    @functools.cached_property
    def extents(self) -> Array:
        """How far from the axis the light meets each surface (S,), mm: its semi-diameter or, where
        that is inf, as far as the rays go."""
        hits = self.rays.bundle.hits
        whole = jnp.moveaxis(self.rays.whole[None], 0, 1)
        squares = sum(h**2 for h in hits)
        reach = jnp.sqrt(jnp.max(jnp.where(whole, squares, 0), axis=(0, 2, 3)) + 1e-30)
        semi = self.lens.semi_diameter
        return jnp.where(jnp.isfinite(semi), semi, reach)[:-1]

    @functools.cached_property
    def lacks(self) -> Array:
        """By how much each ray fails (V, W, Q): 0 for one that passes, see `snell.lack`."""
        failed = ~self.rays.whole

        def of_view(field: Array, distance: Array) -> Array:
            scene = Scene(field, distance, self.views.wavelengths)
            points, _ = self._points(scene)
            system = system_of(self.lens, scene, len(points))
            radius = self.lens.semi_diameter[self.lens.stop]
            target = tuple(radius * p for p in points)
            launch = paraxial_launch(system, target, beam_size(system, target)[1])
            # Light of another index for each colour, each traced by itself.
            return lack(system, launch)

        def of_all(_: None) -> Array:
            return jax.vmap(of_view)(self.views.field, self.views.distance)

        found = jax.lax.cond(jnp.any(failed), of_all, lambda _: jnp.zeros(failed.shape), None)
        return jnp.where(failed, found, 0)

    @functools.cached_property
    def cosines(self) -> Array:
        """Least cosine (L,) of the angles at which light falls on the live surfaces."""
        rows = np.array([*self.lens.live, self.lens.count])

        def one(field: Array, distance: Array, hits: Vector, whole: Array) -> Array:
            scene = Scene(field, distance, self.views.wavelengths)
            system = system_of(self.lens, scene, len(hits))
            path = geometry(tuple(h[rows] for h in hits), system)
            normal = *(-s for s in path.slope), jnp.ones_like(path.slope[0])
            cosine = jnp.abs(dot(normal, path.before)) / jnp.sqrt(dot(normal, normal))
            return jnp.min(jnp.where(whole, cosine, 1)[:-1], axis=(1, 2))

        rays = self.rays
        views = self.views.field, self.views.distance, rays.bundle.hits, rays.whole
        return jnp.min(jax.vmap(one)(*views), axis=0)

    @functools.cached_property
    def illumination(self) -> Array:
        """Light on the sensor (V,) of the middle colour relative to that of the first field: the
        area of the directions it arrives from, each times its cosine with the axis (Slater's
        projected solid angle; clipped light counts for nothing)."""
        middle = self.views.wavelengths.shape[0] // 2
        colour = self.views.wavelengths[middle : middle + 1]

        def one(field: Array, distance: Array) -> Array:
            scene = Scene(field, distance, colour)
            points, weights = self.rule.points(self.lens, scene)
            points = tuple(jnp.broadcast_to(p, (1, p.shape[-1])) for p in points)

            def directions(points: Vector) -> tuple[Vector, Bundle]:
                bundle = trace_bundle(self.lens, scene, points, self._solver)
                return bundle.arrival[:-1], bundle

            columns = []
            for k in range(len(points)):
                unit = tuple(jnp.full_like(p, float(k == j)) for j, p in enumerate(points))
                _, column, bundle = jax.jvp(directions, (points,), (unit,), has_aux=True)
                columns.append(column)
            area = columns[0][0] ** 2 if len(points) == 1 else determinant(columns)
            light = weights * self.rule.transmission(self.lens, bundle)
            return jnp.sum(light * jnp.abs(area))

        areas = jax.vmap(one)(self.views.field, self.views.distance)
        return safe_divide(areas, jnp.broadcast_to(areas[:1], areas.shape))
