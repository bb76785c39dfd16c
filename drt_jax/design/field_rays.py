"""The rays of a lens from all fields of a problem, traced once for all operands."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..image.spot import deviations, normalised
from ..image.spots import cones
from ..inputs import require
from ..lens.forms import FORMS
from ..lens.lens import Lens
from ..lens.scene import Scene, over_points
from ..numerics import safe_divide, safe_sqrt
from ..pupil.clipped import Clipped
from ..pupil.rules import PupilRule, Symmetry
from ..rays import fermat
from ..rays.find import Found
from ..rays.known import Known
from ..rays.solve import Solver
from ..rays.status import Status
from ..rays.system import Vector, dot, system_of
from ..rays.trace import Bundle, trace_bundle

# The first rays of every view: the chief ray, and the rays through the top, bottom and side of the
# rim of the stop. They have no weight.
_EXTRA = np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 1.0, -1.0, 0.0]])
EXTRAS = _EXTRA.shape[1]
# The fields of `FieldRays` that a trace fills in.
_TRACED = "bundle", "points", "stop_weights", "weights", "throughput"


def symmetry_by_structure(lens: Lens, axial: bool = False) -> Symmetry:
    """Symmetry of the pupil for fields along y, from the structure of a lens alone.

    The numbers of the lens may be unknown, as in `jit`.

    axial: True for the axial field alone.
    """
    moves = (lens.decentre, lens.tilt, lens.elements, lens.apertures)
    forms = (*lens.forms, *(() if lens.phase is None else lens.phase.forms))
    kinds = {FORMS[form].symmetry for form in forms}
    if any(a is not None for a in moves) or "none" in kinds:
        return "none"
    return "rotational" if axial and kinds == {"rotational"} else "bilateral"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class FieldRays:
    """The rays of V views: all fields at the first distance, then all fields at the next distance.

    Each view has W wavelengths of Q rays. The first ray is the chief ray, and the next three pass
    through the rim of the stop; these four have no weight. The fields from `bundle` on are None
    before rays are traced.

    scene: fields (V, 2) and distances (V,) of the views, wavelengths, and their weights, with the
        sum 1.
    rule: the pupil rule of all views.
    bundle: the rays, with a first axis (V,) in every array.
    points: D arrays (V, W, Q), stop points in units of the semi-diameter of the stop.
    stop_weights: (V, W, Q), weights of the light through the stop, with the sum 1.
    weights: (V, W, Q), weights of the light that is not clipped, with the sum 1 if there is any; 0
        for clipped rays. A failed ray keeps its weight.
    throughput: (V, W), fraction of the light through the stop that is not clipped.

    Static:
    fields, distances: numbers of fields and of distances.
    """

    scene: Scene
    rule: PupilRule
    fields: int = dataclasses.field(metadata={"static": True})
    distances: int = dataclasses.field(metadata={"static": True})
    bundle: Bundle = None  # type: ignore[assignment]
    points: Vector = None  # type: ignore[assignment]
    stop_weights: Array = None  # type: ignore[assignment]
    weights: Array = None  # type: ignore[assignment]
    throughput: Array = None  # type: ignore[assignment]

    @property
    def symmetry(self) -> Symmetry:
        """Part of the pupil that is traced, see `symmetry_of`."""
        return self.rule.symmetry

    @property
    def arrives(self) -> Array:
        """Mask (V, W, Q) of the rays that meet the sensor, clipped or not."""
        return self.bundle.arrives

    @property
    def sensor_hits(self) -> Array:
        """Hits on the sensor, (D, V, W, Q), mm, y last; 0 for failed rays."""
        return jnp.stack(self.bundle.sensor)

    def views(self, fields: Sequence[int], distances: Sequence[int]) -> np.ndarray:
        """Numbers of the views of given fields and distances, which are counted from 0; () for
        all.
        """
        distances = distances or range(self.distances)
        return np.array(
            [d * self.fields + f for d in distances for f in fields or range(self.fields)]
        )

    def select(
        self, fields: Sequence[int], distances: Sequence[int], wavelengths: Sequence[int]
    ) -> "FieldRays":
        """The rays of given fields, distances and wavelengths.

        fields, distances, wavelengths: numbers, counted from 0; () for all. The weights of the
            selected wavelengths are normalised to the sum 1.
        """
        if not (fields or distances or wavelengths):
            return self
        views, scene = self.views(fields, distances), self.scene
        waves = np.array(wavelengths or range(len(scene.wavelengths)))

        def selected(tree: Any) -> Any:
            """Selects from arrays (V, W) and (V, ..., W, Q)."""
            return jax.tree.map(lambda a: a[views][..., *[waves, slice(None)][: a.ndim - 1]], tree)

        shares, traced = scene.spectrum[waves], dict[str, Any]()
        colours = scene.wavelengths[waves], shares / jnp.sum(shares)
        if self.bundle is not None:
            traced = {name: selected(getattr(self, name)) for name in _TRACED}
        return dataclasses.replace(
            self,
            scene=Scene(scene.field[views], scene.distance[views], *colours),
            fields=len(fields) or self.fields,
            distances=len(distances) or self.distances,
            **traced,
        )

    @property
    def light(self) -> Array:
        """Light (V, W, Q - 4) of the rays that have weight and meet the sensor. Its sum over the
        rays of a wavelength is the weight of that wavelength, as in `psf_moments`.
        """
        arriving = jnp.where(self.arrives, self.weights, 0)[..., EXTRAS:]
        return normalised(arriving) * self.scene.spectrum[None, :, None]

    def spread(self, values: Vector, axes: tuple[int, ...] = (-2, -1)) -> tuple[Array, Vector]:
        """Deviations of hits or slopes from their means, times the roots of `light`, and the means.

        values: D arrays (V, W, Q).
        axes: axes of the means: (-2, -1) for all wavelengths together, (-1,) for each.

        Returns deviations (D, V, W, Q - 4), and means, D arrays with length 1 along `axes`.
        """
        light, own = self.light, tuple(a[..., EXTRAS:] for a in values)
        parts, means = deviations(own, normalised(light, axes), self.symmetry, axes)
        return jnp.stack(parts) * safe_sqrt(light)[None], means

    def unvignetted(self) -> "FieldRays":
        """The rays with the weights that they have if only the stop clips."""
        clipped = self.bundle.status == Status.CLIPPED
        status = jnp.where(clipped, Status.OK, self.bundle.status)
        bundle = self.bundle._replace(status=status)
        return dataclasses.replace(self, bundle=bundle, weights=self.stop_weights)


def trace_views(lens: Lens, views: FieldRays, solver: Solver) -> FieldRays:
    """Traces the rays of all views together.

    lens: the lens.
    views: views without rays. ValueError for the rule `Clipped` if the lens has obscurations.
    solver: a ray solver.
    """
    extra, rule = lens.apertures, views.rule
    blocked = extra is not None and any(extra.blocks) and isinstance(rule, Clipped)
    what = "rule: Clipped gives negative weights for obscurations, which have no residuals"
    require(not blocked, f"{what}; use Gauss or Soft")

    def one(scene: Scene) -> tuple[Bundle, Vector, Array, Array, Array]:
        points, weights = _points(rule, lens, scene)
        bundle = trace_bundle(lens, scene, points, solver)
        light = weights * jnp.where(bundle.arrives, rule.transmission(lens, bundle), 1)
        return bundle, points, weights, normalised(light), jnp.sum(light, axis=-1)

    found = over_points(one, views.scene)
    traced: dict[str, Any] = dict(zip(_TRACED, found, strict=True))
    return dataclasses.replace(views, **traced)


def _points(rule: PupilRule, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
    """Stop points and weights of a rule, with the four extra rays in front.

    Returns the points, D arrays (W, Q) in units of the semi-diameter of the stop, and the weights
    (W, Q), 0 for the extra rays.
    """
    points, weights = rule.points(lens, scene)
    waves = scene.wavelengths.shape[0]
    extra = jnp.asarray(_EXTRA[2 - len(points) :], weights.dtype)
    weights = jnp.broadcast_to(weights, (waves, weights.shape[-1]))
    rows = zip(extra, points, strict=True)
    wide = ((jnp.broadcast_to(a, (waves, a.shape[-1])) for a in pair) for pair in rows)
    joined = tuple(jnp.concatenate([*pair], axis=-1) for pair in wide)
    return joined, jnp.pad(weights, ((0, 0), (EXTRAS, 0)))


def beam_radius(lens: Lens, rays: FieldRays) -> Array:
    """Radius of the beam footprint on each surface (S,), mm.

    It is the semi-diameter or, if that is inf, the largest distance of a ray from the axis.
    """
    squares = sum((h**2 for h in rays.bundle.hits), jnp.zeros(()))
    radius = safe_sqrt(jnp.max(jnp.where(rays.arrives[:, None], squares, 0), axis=(0, 2, 3)))
    semi = lens.semi_diameter
    return jnp.where(jnp.isfinite(semi), semi, radius)[:-1]


def incidence_cosines(lens: Lens, rays: FieldRays) -> Array:
    """Cosines (V, L, W, Q) of the angles of incidence on the L active surfaces; 1 for failed
    rays.
    """
    rows = np.array([*lens.active, lens.count])

    def one(scene: Scene, bundle: Bundle) -> Array:
        system = system_of(lens, scene, len(bundle.hits))
        path = fermat.geometry(tuple(h[rows] for h in bundle.hits), system)
        normal = *(-s for s in path.slope), jnp.ones_like(path.slope[0])
        cosine = jnp.abs(dot(normal, path.before)) / jnp.sqrt(dot(normal, normal))
        return jnp.where(bundle.arrives[None], cosine, 1)[:-1]

    return over_points(one, rays.scene, rays.bundle)


def relative_illumination(lens: Lens, rays: FieldRays) -> Array:
    """Relative illumination (V,) at the middle wavelength, for a uniform Lambertian object.

    It is the sum over rays that are not clipped of weight times projected solid angle at a point of
    the sensor (Slater), see `image.spots.cones`, divided by that of the first field at the same
    distance.
    """
    one = rays.select((), (), (rays.scene.reference(None),))
    rows = np.array([*lens.active, lens.count])

    def area(scene: Scene, bundle: Bundle, points: Vector) -> Array:
        """|dl / dp|, (1, Q), of the rays of a view, which are not searched for again, except behind
        an afocal lens, whose bundle does not know where they meet the sensor."""
        hits = jax.lax.stop_gradient(tuple(h[rows] for h in bundle.hits))
        arrival = fermat.arrival(hits, system_of(lens, scene, len(hits)))
        status = jnp.where(bundle.arrives, jnp.int32(Status.OK), bundle.status)
        found = Found(hits, arrival, status, jnp.int32(0))
        return cones(lens, scene, points, Known(None if lens.afocal else found), fixed=True)[1]

    light = jnp.where(one.arrives, one.weights * one.throughput[..., None], 0)
    if len(one.points) == 2:  # else on the axis alone
        light = light * over_points(area, one.scene, one.bundle, one.points)
    total = jnp.sum(light, axis=(1, 2)).reshape(rays.distances, rays.fields)
    return jnp.ravel(safe_divide(total, jnp.broadcast_to(total[:, :1], total.shape)))
