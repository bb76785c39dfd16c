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
from ..numerics import safe_divide, safe_sqrt
from ..pupil.clipped import Clipped
from ..pupil.rules import PupilRule, Symmetry
from ..rays import fermat
from ..rays.aim import beam_size, paraxial_launch
from ..rays.find import Found
from ..rays.snell import lack
from ..rays.solve import Solver, reattach
from ..rays.status import Status
from ..rays.system import Vector, determinant, divide, dot, system_of
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
    points: D arrays (V, W, Q), where they cross the stop, in units of its semi-diameter.
    light: (V, W, Q), what part of the light of a colour each ray stands for: of those that are
        clipped none, of those that fail as much as if they passed; adds up to 1, where there is
        any.
    passed: (V, W), the share of the light through the stop that is not clipped.
    """

    bundle: Bundle
    points: Vector
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
        extra = lens.apertures
        if extra is not None and any(extra.blocks) and isinstance(rule, Clipped):
            raise ValueError(
                "rule: Clipped subtracts the light inside of obscurations, which has no residuals; "
                "take Gauss or Soft"
            )
        self.lens, self.views, self.rule, self._solver = lens, views, rule, solver
        self.colour_weights, self.fields = colour_weights, fields
        self.distances = len(views.distance) // fields

    @functools.cached_property
    def rays(self) -> Rays:
        """The rays of all views, traced together."""

        def one(field: Array, distance: Array) -> tuple[Bundle, Vector, Array, Array]:
            scene = Scene(field, distance, self.views.wavelengths)
            points, weights = self._points(scene)
            bundle = trace_bundle(self.lens, scene, points, self._solver)
            failed = (bundle.status != Status.OK) & (bundle.status != Status.CLIPPED)
            light = weights * jnp.where(failed, 1, self.rule.transmission(self.lens, bundle))
            passed = jnp.sum(light, axis=-1)
            part = safe_divide(light, jnp.broadcast_to(passed[:, None], light.shape))
            return bundle, points, part, passed

        return Rays(*jax.vmap(one)(self.views.field, self.views.distance))

    @property
    def share(self) -> Array:
        """What part of the light of a view each ray stands for, (V, W, Q)."""
        return self.rays.light * self.colour_weights[None, :, None]

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
        whole = self.rays.whole[:, None]
        squares = sum((h**2 for h in self.rays.bundle.hits), jnp.zeros(()))
        reach = safe_sqrt(jnp.max(jnp.where(whole, squares, 0), axis=(0, 2, 3)))
        semi = self.lens.semi_diameter
        return jnp.where(jnp.isfinite(semi), semi, reach)[:-1]

    @functools.cached_property
    def failures(self) -> Array:
        """By how much each ray (V, W, Q) spoils a merit, as a residual: 0 for one that passes, else
        the root of the light it stands for times 1 and what it lacks, see `snell.lack`. A chief ray
        that fails stands for all light of its colour; where all light is clipped, inf."""
        chief = np.arange(self.rays.light.shape[-1]) == 0
        light = jnp.where(chief[None, None], self.colour_weights[None, :, None], self.share)
        failed = ~self.rays.whole & (light > 0)
        root = jnp.sqrt(jnp.where(failed, light, 1))
        dark = self.rays.passed[..., None] == 0
        return jnp.where(dark, jnp.inf, jnp.where(failed, root * (1 + self.lacks), 0))

    @functools.cached_property
    def lacks(self) -> Array:
        """By how much each ray fails (V, W, Q), see `snell.lack`: 0 for one that passes, else what
        its first guess lacks."""
        failed = ~self.rays.whole

        def of_view(field: Array, distance: Array, points: Vector) -> Array:
            scene = Scene(field, distance, self.views.wavelengths)
            system = system_of(self.lens, scene, len(points))
            radius = self.lens.semi_diameter[self.lens.stop]
            target = tuple(radius * p for p in points)
            launch = paraxial_launch(system, target, beam_size(system, target)[1])
            return lack(system, launch, target)

        def of_all(_: None) -> Array:
            return jax.vmap(of_view)(self.views.field, self.views.distance, self.rays.points)

        none = jnp.zeros_like(self.rays.light)
        found = jax.lax.cond(jnp.any(failed), of_all, lambda _: none, None)
        return jnp.where(failed, found, 0)

    @functools.cached_property
    def cosines(self) -> Array:
        """Cosines (V, L, W, Q) of the angles at which rays fall on the live surfaces; 1 for rays
        that fail."""
        rows = np.array([*self.lens.live, self.lens.count])

        def one(field: Array, distance: Array, hits: Vector, whole: Array) -> Array:
            scene = Scene(field, distance, self.views.wavelengths)
            system = system_of(self.lens, scene, len(hits))
            path = fermat.geometry(tuple(h[rows] for h in hits), system)
            normal = *(-s for s in path.slope), jnp.ones_like(path.slope[0])
            cosine = jnp.abs(dot(normal, path.before)) / jnp.sqrt(dot(normal, normal))
            return jnp.where(whole[None], cosine, 1)[:-1]

        rays = self.rays
        views = self.views.field, self.views.distance, rays.bundle.hits, rays.whole
        return jax.vmap(one)(*views)

    @functools.cached_property
    def illumination(self) -> Array:
        """Light on the sensor (V,) of the middle colour relative to that of the first field at the
        same distance, of an object that is everywhere as bright: the area of the directions from
        which it arrives at one point, each times its cosine with the axis of the sensor (Slater's
        projected solid angle). Clipped light counts for nothing."""
        lens, rays = self.lens, self.rays
        rows, middle = np.array([*lens.live, lens.count]), self.views.wavelengths.shape[0] // 2
        colour = slice(middle, middle + 1)

        def one(field: Array, distance: Array, bundle: Bundle, points: Vector) -> Array:
            """How far directions spread, (1, Q), by the derivatives of known rays."""
            scene = Scene(field, distance, self.views.wavelengths[colour])
            hits = jax.lax.stop_gradient(tuple(h[rows, colour] for h in bundle.hits))
            arrival = fermat.arrival(hits, system_of(lens, scene, len(hits)))
            status = jnp.where(bundle.status == Status.CLIPPED, Status.OK, bundle.status)[colour]
            known = functools.partial(
                reattach, Found(hits, arrival, status.astype(jnp.int32), bundle.steps)
            )

            def arriving(points: Vector, field: Array) -> tuple[Vector, Vector]:
                scene = Scene(field, distance, self.views.wavelengths[colour])
                bundle = trace_bundle(lens, scene, points, known)
                return tuple(h[-1] for h in bundle.hits), bundle.arrival[:-1]

            points = tuple(p[colour] for p in points)
            if len(points) == 1:  # on the axis, as the first field
                return jnp.ones_like(points[0])
            _, push = jax.linearize(arriving, points, field)
            zero, units = jax.tree.map(jnp.zeros_like, points), jnp.eye(2, dtype=field.dtype)
            by_field = [push(zero, unit) for unit in units]
            columns = []
            for k in range(2):  # by the stop point, the field going along so that the hit stays
                unit = tuple(jnp.full_like(p, float(j == k)) for j, p in enumerate(points))
                hit, line = push(unit, jnp.zeros_like(field))
                back = divide(tuple(zip(*(moved for moved, _ in by_field))), hit)
                turned = zip(line, *(swung for _, swung in by_field))
                columns.append([a - back[0] * b - back[1] * c for a, b, c in turned])
            return determinant(columns)

        areas = jax.vmap(one)(self.views.field, self.views.distance, rays.bundle, rays.points)
        light = rays.light[:, colour] * rays.passed[:, colour, None]
        light = jnp.where(rays.whole[:, colour], light, 0)
        total = jnp.sum(light * jnp.abs(areas), axis=(1, 2)).reshape(self.distances, self.fields)
        return jnp.ravel(safe_divide(total, jnp.broadcast_to(total[:, :1], total.shape)))
