"""Spots over the field, and how much light arrives there: throughput and relative illumination.

One trace of a pupil rule gives all of these: the hits of its rays on the sensor, the light that
they represent, and the area of their directions. In a uniform, Lambertian scene the irradiance at a
point of the sensor is proportional to the area, in direction cosines, of the cone of light that
reaches it. That is the integral over the stop of the determinant |dl / dp| of directions l by stop
points p.

All functions take a `Scene` and return arrays whose first axes (...) are its points. Without a
rule, one rule for all points is found; inside `jax.jit` and `jax.vmap` a rule is required.
Differentiable in every mode where the rule is.

Sources: Rimmer, Relative illumination calculations, Proc. SPIE 655, 99 (1986), which OpticStudio
follows; Slater, Remote Sensing (1980), for the cone at a point of the sensor.
"""

import dataclasses
import functools
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require_one_of
from ..lens.lens import Lens
from ..lens.order import may_cross
from ..lens.scene import Scene, checked_scene, over_points
from ..numerics import known_values, safe_divide, safe_sqrt
from ..pupil.clipped import Clipped
from ..pupil.patterns import hexapolar
from ..pupil.rules import Gauss, PupilRule, planned, symmetry_of
from ..rays.known import Known, known_rays, tiles, trace_tile, wide
from ..rays.solve import Solver, solve, solve_aimed
from ..rays.status import Status
from ..rays.system import Vector, determinant, divide
from ..rays.trace import Bundle, trace_bundle
from .converged import converged_rule
from .rounding import check_dtype, hit_rounding
from .spot import normalised
from .wavefront import reference_curvature

Point = Literal["object", "sensor"]
# Nodes along a radius of rules that are made here.
_ORDER = 12
# Number of rays on the rim of the stop, which have no weight; and of azimuths to which rays on one
# radius are rotated.
_RIM, _AZIMUTHS = 48, 24
# Hexapolar rings of the rays that test whether light fills the stop.
_RINGS = 6
# An image farther away than this many times the distance of the exit pupil counts as at infinity.
_FAR = 1e3
# Error of a spot from rounding, relative to its size, up to which no warning is given.
_ROUGH = 0.02
# Radius of the first zero of the Airy pattern: this times wavelength / NA; wavelength in um, radius
# in mm.
_AIRY = 0.60983494563325225e-3


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Spots:
    """Spots in W wavelengths, of Q rays each.

    points: (..., W, Q, 2), mm, x and y on the sensor; inf for rays that do not arrive.
    weights: (..., W, Q), the light that each ray represents; their sum is the throughput times the
        weight of the wavelength. Rays on the rim of the stop have weight 0.
    centroid: (..., 2), mm, of all wavelengths.
    chief: (..., 2), mm, the chief ray of the reference wavelength.
    rms, rms_chief: (...), mm, root mean square distance of the light from the centroid and from the
        chief ray.
    radius, radius_chief: (...), mm, largest distance of a ray from either ("geometric").
    airy_radius: (...), mm, 0.61 wavelength / NA for the reference wavelength, where pi NA^2 is its
        solid angle; for a round pupil the first zero of the diffraction pattern.
    throughput, solid_angle: (..., W), as of `vignetting` and `solid_angle`.
    left_out: (..., W), fraction of 175 rays, evenly over the stop and on its rim, that fail for
        another reason than an aperture (see `Status`), and so are not part of any number above:
        they miss a surface, are totally reflected, or would have to travel backwards where surfaces
        cross. Programs that trace such rays backwards include them, and report larger spots.

    Lengths are inf where no light arrives; those from the chief ray also where it fails.
    """

    points: Array
    weights: Array
    centroid: Array
    chief: Array
    rms: Array
    rms_chief: Array
    radius: Array
    radius_chief: Array
    airy_radius: Array
    throughput: Array
    solid_angle: Array
    left_out: Array


def spot_diagram(
    lens: Lens,
    scene: Scene,
    sampling: float | PupilRule | None = None,
    reference: int | None = None,
) -> Spots:
    """Spots of all points on the sensor, see `Spots`.

    lens, scene: the lens, and object points with their wavelengths.
    sampling: a pupil rule; for a picture of the spot a `Pattern` such as that of `pupil.hexapolar`.
        A tolerance: the rule that keeps the relative error of the RMS spot size within it. None:
        12 Gauss nodes along a radius, fitted to the open part of the pupil.
    reference: index of the reference wavelength; None: the middle one, W // 2.

    Warns, outside of a trace, where float32 rounds more than 2 % of a spot. ValueError as of
    `lens.scene.checked_scene`; without a rule inside a trace.
    """
    scene = checked_scene(lens, scene)
    found = _light(lens, scene, sampling, "object", reference)
    known = known_values((lens, found.rms))
    if known is not None:
        wrong = hit_rounding(known[0]) / max(np.min(np.asarray(known[1])), np.finfo(float).tiny)
        check_dtype(known[0], "spots", wrong, _ROUGH, " of their size")
    return found


def vignetting(lens: Lens, scene: Scene, sampling: float | PupilRule | None = None) -> Array:
    """Unvignetted fraction: the fraction of the light through the stop that reaches the sensor.

    lens, scene, sampling: as in `spot_diagram`.

    Returns (..., W), from 0 to 1. Errors as of `spot_diagram`.
    """
    return _light(lens, checked_scene(lens, scene), sampling, "object").throughput


def relative_illumination(
    lens: Lens, scene: Scene, sampling: float | PupilRule | None = None, point: Point = "object"
) -> Array:
    """Irradiance on the sensor relative to that of the field 0, for a uniform, Lambertian scene:
    the ratio of the areas of the cones of light in direction cosines.

    lens, scene, sampling: as in `spot_diagram`.
    point: "object": the cone of light from one object point, as OpticStudio and CODE V compute it;
        "sensor": the cone at one point of the sensor, which is what a pixel collects. Both agree as
        far as the rays from an object point meet in one point.

    Returns (..., W); 0 where no light arrives. OpticStudio's analysis divides by the brightest
    field of its scan, `r / r.max()`; its operand RELI divides by the axis. Errors as of
    `spot_diagram`. ValueError also for points at several distances, and where the light of an
    object point on the axis arrives collimated, without a cone; inside a trace the ratio is then 0.
    An afocal lens has a cone, the area of its beams.
    """
    scene = checked_scene(lens, scene)
    light = _light(lens, scene.with_axis(), sampling, point)
    area = light.solid_angle
    if point == "object":
        level = _collimated(lens, light.rms[0], area[0], scene.wavelengths)
        known = known_values(level)
        if known is not None and bool(jnp.any(known)):
            raise ValueError(
                "point: light of one object point arrives collimated, without a cone: take "
                "point='sensor', or afocal: true for a lens whose image lies at infinity"
            )
        area = jnp.where(level[None], 0, area)
    found = safe_divide(area[1:], jnp.broadcast_to(area[:1], area[1:].shape))
    return found.reshape(*scene.shape, -1)


def solid_angle(
    lens: Lens, scene: Scene, sampling: float | PupilRule | None = None, point: Point = "object"
) -> Array:
    """Area of the cone of light in direction cosines on the sensor: irradiance over radiance.

    lens, scene, sampling, point: as in `relative_illumination`.

    Returns (..., W); for a round cone about the normal it is pi sin^2 of its half angle; 0 where no
    light arrives. Errors as of `spot_diagram`.
    """
    return _light(lens, checked_scene(lens, scene), sampling, point).solid_angle


def rule_for(
    lens: Lens, scene: Scene, sampling: float | PupilRule | None, order: int = _ORDER
) -> PupilRule:
    """The pupil rule of a sampling, see `spot_diagram`; of an order for None."""
    if sampling is None:
        return light_rule(lens, scene, order)
    return sampling if isinstance(sampling, PupilRule) else converged_rule(lens, scene, sampling)


def light_rule(lens: Lens, scene: Scene, order: int = _ORDER) -> Gauss | Clipped:
    """A pupil rule for the light of all points: a Gauss rule on the stop if light fills it for all
    of them, else one that is fitted to the open part of the pupil.

    lens, scene: as in `spot_diagram`; known numbers.
    order: of the rule.

    ValueError inside a trace.
    """
    known = known_values((lens, scene))
    if known is None:
        raise ValueError(
            "inside jax.jit or jax.vmap the rule cannot depend on what is clipped: make the rule "
            "outside and pass it on, sampling=drt_jax.converge(drt_jax.spot_diagram, lens, scene), "
            "or name one, such as sampling=drt_jax.Gauss(12, 'bilateral')"
        )
    with jax.core.eval_context():
        lens, scene = known
        scene = checked_scene(lens, scene)
        symmetry = symmetry_of(lens, scene.field)
        full = _fills(lens, scene)
    if full and not (lens.apertures is not None and any(lens.apertures.blocks)):
        return Gauss(order, symmetry)
    return Clipped(order, symmetry, crossing=may_cross(lens))


def _fills(lens: Lens, scene: Scene) -> bool:
    """Whether all rays over the stop and on its rim arrive, from all points."""
    points = wide(scene, _extra_points().T.astype(lens.curvature.dtype))
    (tile,) = tiles(points)

    def arrives(point: Scene) -> bool:
        """Rays that no aperture clips are searched for if aiming fails."""
        for solver in (solve_aimed, solve):
            status = np.asarray(trace_tile(lens, point, (*tile,), solver)[0].status)
            if np.all(status == Status.OK):
                return True
            if np.any(status == Status.CLIPPED):
                return False
        return False

    return all(map(arrives, scene.each()))


def _extra_points() -> np.ndarray:
    """Stop points of rays without weight, (B, 2): the chief ray, the rim, and evenly over the
    whole stop."""
    angle = 2 * np.pi * (np.arange(_RIM) + 0.25) / _RIM
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([np.zeros((1, 2)), rim, _even()])


def _even() -> np.ndarray:
    """Stop points evenly over the whole stop."""
    return hexapolar(_RINGS)[0]


def _collimated(lens: Lens, rms: Array, cone: Array, wavelengths: Array) -> Array:
    """Whether the image of an object point is farther away than `_FAR` times the exit pupil, (W,).
    There the light has no cone, and the RMS radius (), mm, shows the width of the beam: the solid
    angle (W,) is below pi (rms kappa / _FAR)^2, 1 / kappa the distance of the exit pupil."""
    kappa = reference_curvature(lens, jnp.clip(wavelengths, *lens.dispersion.range))
    wide = jnp.where(jnp.isfinite(rms), rms, 0)  # inf without light
    return cone < np.pi * (wide * kappa / _FAR) ** 2


def _light(
    lens: Lens, scene: Scene, sampling: float | PupilRule | None, point: Point,
    reference: int | None = None
) -> Spots:  # fmt: skip
    """The spots of all points of a scene that fits the lens; their solid angles are those of
    `point`."""
    require_one_of("point", point, get_args(Point))
    middle = np.int32(scene.reference(reference))
    rule = rule_for(lens, scene, sampling)
    known = known_rays(lens, scene, rule, _aim)
    return _traced(lens, scene, rule, middle, point == "sensor", known)


@functools.partial(jit, wanted=LARGE, static_argnames="fixed")
def _traced(
    lens: Lens, scene: Scene, rule: PupilRule, middle: Array, fixed: bool, known: Known
) -> Spots:
    """`_light`, compiled. fixed: True for the cone at a point of the sensor, False for that of an
    object point."""
    return over_points(lambda *one: _of_point(lens, rule, middle, fixed, *one), scene, known)


def _of_point(
    lens: Lens, rule: PupilRule, middle: Array, fixed: bool, scene: Scene, known: Known
) -> Spots:
    """The spots of one object point. middle: (), index of the reference wavelength.

    Their rays are, along Q: mirror images of the rays of the rule (if it is bilateral), the rays of
    the rule, the chief ray, and those on the rim.
    """
    points, weights = _whole_rule(scene, *rule.points(lens, scene, known.plan))
    count = weights.shape[-1]
    bundle, area = cones(lens, scene, points, known, fixed)
    weight = weights * rule.transmission(lens, bundle)[:, :count]
    throughput, cone = jnp.sum(weight, -1), jnp.sum(weight * (np.pi * area[:, :count]), -1)
    failed = ~bundle.arrives[:, 1 - len(_extra_points()) :]
    hit, arrives = jnp.stack(bundle.sensor, axis=-1), bundle.status == Status.OK
    chief, whole = hit[middle, count], bundle.arrives[middle, count]
    hit, arrives = (a[:, : -len(_even())] for a in (hit, arrives))
    weight = jnp.pad(weight, ((0, 0), (0, 1 + _RIM)))
    if rule.symmetry == "bilateral":  # add the mirror images of the rays of the rule
        images = hit[:, :count] * jnp.array([[[-1, 1]]], weight.dtype), arrives[:, :count]
        hit, arrives = (jnp.concatenate(pair, axis=1) for pair in zip(images, (hit, arrives)))
        weight = jnp.concatenate([weight[:, :count], weight], axis=1) / 2
    weight = weight * (scene.spectrum / jnp.sum(scene.spectrum))[:, None]
    share = normalised(weight, (0, 1))
    centroid = jnp.sum(share[..., None] * hit, axis=(0, 1))
    good = jnp.sum(weight) > 0

    def spread(centre: Array, good: Array) -> tuple[Array, Array]:
        """RMS and largest distance from `centre`; inf where not `good`."""
        square = jnp.sum((hit - centre[None, None]) ** 2, axis=-1)
        mean = safe_sqrt(jnp.sum(share * square))
        largest = safe_sqrt(jnp.max(jnp.where(arrives, square, 0)))
        return jnp.where(good, mean, jnp.inf), jnp.where(good, largest, jnp.inf)

    (rms, radius), (rms_chief, radius_chief) = spread(centroid, good), spread(chief, good & whole)
    aperture = safe_sqrt(cone[middle] / np.pi)
    colour = scene.wavelengths[middle] / lens.index(scene.wavelengths)[-1, middle]
    airy = jnp.where(aperture > 0, safe_divide(_AIRY * colour, aperture), jnp.inf)
    return Spots(
        jnp.where(arrives[..., None], hit, jnp.inf),
        weight,
        jnp.where(good, centroid, jnp.inf),
        jnp.where(whole, chief, jnp.inf),
        rms,
        rms_chief,
        radius,
        radius_chief,
        airy,
        throughput,
        cone,
        jnp.mean(failed.astype(cone.dtype), axis=-1),
    )


def _aim(lens: Lens, scene: Scene, rule: PupilRule) -> tuple[Vector, Any]:
    """Stop points of `_whole_rule` and the plan of a rule."""
    *given, plan = planned(lens, scene, rule)
    return _whole_rule(scene, *given)[0], plan


@jax.jit
def _whole_rule(scene: Scene, points: Vector, weights: Array) -> tuple[Vector, Array]:
    """Points of a rule, followed by those of `_extra_points`, 2 arrays (W, Q + B), and weights
    (W, Q). Points on one radius are repeated at rotated azimuths."""
    waves = scene.wavelengths.shape[0]
    wide = lambda a: jnp.broadcast_to(a, (waves, a.shape[-1]))  # noqa: E731
    weights = wide(weights)
    if len(points) == 1:
        angle = 2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
        turned = jnp.asarray(np.stack([np.cos(angle), np.sin(angle)]), weights.dtype)
        points = tuple(jnp.outer(wide(points[0]), t).reshape(waves, -1) for t in turned)
        weights = jnp.repeat(weights, _AZIMUTHS, axis=-1) / _AZIMUTHS
    rows = zip(points, _extra_points().T, strict=True)
    joined = ((wide(p), wide(jnp.asarray(e, weights.dtype)[None])) for p, e in rows)
    return tuple(jnp.concatenate(pair, axis=-1) for pair in joined), weights


def cones(
    lens: Lens, scene: Scene, points: Vector, solver: Solver, fixed: bool
) -> tuple[Bundle, Array]:
    """Rays of an object point, and |dl / dp| (W, Q), the area of their transverse direction cosines
    l at the sensor for each area of the stop, whose points are p.

    lens, scene, solver: as in `trace_bundle`.
    points: stop points, 2 arrays (Q,) or (W, Q).
    fixed: False for a fixed object point: the determinant of l_p. True for a fixed point of the
        sensor: there the field changes with p by df = -h_f^-1 h_p dp, so it is the determinant of
        l_p - l_f h_f^-1 h_p.
    """

    def arriving(points: Vector, field: Array) -> tuple[tuple[Vector, Vector], Bundle]:
        bundle = trace_bundle(lens, scene.at(field), points, solver)
        return (bundle.sensor, bundle.arrival[:-1]), bundle

    field = scene.field
    _, jvp, bundle = jax.linearize(arriving, points, field, has_aux=True)
    zero, units = jax.tree.map(jnp.zeros_like, points), jnp.eye(2, dtype=field.dtype)
    sides = [tuple(jnp.full_like(p, float(j == k)) for j, p in enumerate(points)) for k in range(2)]
    columns = []
    for side in sides:
        hit, line = jvp(side, jnp.zeros_like(field))
        if fixed:
            (hit_x, line_x), (hit_y, line_y) = (jvp(zero, unit) for unit in units)
            back = divide(tuple(zip(hit_x, hit_y)), hit)
            line = [a - back[0] * b - back[1] * c for a, b, c in zip(line, line_x, line_y)]
        columns.append(line)
    return bundle, jnp.abs(determinant(columns))
