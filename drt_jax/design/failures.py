"""Residuals of failed rays. They are finite and decrease towards lenses that pass the ray."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene, over_points
from ..numerics import safe_divide, safe_sqrt
from ..rays.aim import beam_size, paraxial_launch
from ..rays.meet import quadratic
from ..rays.snell import Meeting, Row, meetings, rows_met, split_stop
from ..rays.status import Status
from ..rays.system import System, Vector, dot
from ..rays.trace import aims
from .field_rays import FieldRays


def failures(lens: Lens, rays: FieldRays) -> Array:
    """Failure residuals (V, W, Q): 0 if the ray arrives, otherwise sqrt(weight) (1 + shortfall).

    A chief ray has the weight of all light of its wavelength. If all light of a wavelength is
    clipped, its residuals are inf.
    """
    share = rays.scene.spectrum[None, :, None]
    light = rays.weights * share
    chief = np.arange(light.shape[-1]) == 0
    light = jnp.where(chief[None, None], share, light)
    failed = ~rays.arrives & (light > 0)
    root = jnp.sqrt(jnp.where(failed, light, 1))
    dark = rays.throughput[..., None] == 0

    def of_view(scene: Scene, points: Vector) -> Array:
        """Shortfall (W, Q) of the paraxial launch of each ray."""
        system, target = aims(lens, scene, points)
        launch = paraxial_launch(system, target, beam_size(system, target)[1])
        return shortfall(system, launch, target)

    def of_all(_: None) -> Array:
        return over_points(of_view, rays.scene, rays.points)

    none = jnp.zeros_like(rays.weights)
    found = jax.lax.cond(jnp.any(~rays.arrives), of_all, lambda _: none, None)
    short = jnp.where(~rays.arrives, found, 0)
    return jnp.where(dark, jnp.inf, jnp.where(failed, root * (1 + short), 0))


def shortfall(system: System, launch: Vector, target: Vector) -> Array:
    """Penalty (W, Q) of a failed ray.

    It is the fraction of rows that the ray does not reach, plus log(1 + the distance by which it
    misses the first of them). For a ray that reaches the sensor, the second term is log(1 +
    distance from its stop point), in units of the largest distance of a stop point from the axis.

    launch: D arrays (W, Q), launch points as in `snell.shoot`, mm.
    target: D arrays (W, Q), stop points, mm.
    """
    met, rows = meetings(system, launch, smooth=True), rows_met(system)
    failed = met.status != Status.OK
    first = failed & ~jnp.concatenate([jnp.zeros_like(failed[:1]), failed[:-1]])
    _, crossing = split_stop(system, met.hit)
    miss = tuple(a - b for a, b in zip(crossing, target, strict=True))
    stop_miss = safe_divide(safe_sqrt(dot(miss, miss)), jnp.sqrt(jnp.max(dot(target, target))))
    missed = jnp.sum(jnp.where(first, _missed(met, rows), 0), axis=0)
    part = jnp.mean(failed.astype(missed.dtype), axis=0)
    return part + jnp.log1p(jnp.where(failed[-1], missed, stop_miss))


def _missed(met: Meeting, rows: Row) -> Array:
    """Measure (R, W, Q) of how far rays miss each row, meet it from behind, or exceed the limit of
    total internal reflection there.

    For a ray that misses a conic, it is minus the discriminant of the quadratic equation of the
    intersection, b^2 - a e < 0, see `meet.reach`.
    """
    first, active, bends = (a[:, None, None] for a in (rows.first, rows.active, rows.bends))
    back = jnp.where(first, 0, jnp.maximum(-met.length, 0)) + jnp.maximum(-met.front, 0)
    back = jnp.where(active, back, 0) + jnp.where(bends, jnp.maximum(-met.through, 0), 0)
    # The measure of missing a conic. The second term makes it continuous, at grazing incidence,
    # with the measure of total internal reflection.
    square, linear, constant = quadratic(met.point, met.direction, rows.surface.wide)
    conic = jnp.maximum(square * constant - linear**2, 0)
    conic = conic + jnp.where(bends, jnp.maximum(rows.ratio**2 - 1, 0), 0)
    return jnp.where(met.crosses, back, conic)
