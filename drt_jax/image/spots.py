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
from collections.abc import Callable
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
from ..numerics import batched, known_values, safe_divide, safe_sqrt
from ..pupil.clipped import Clipped
from ..pupil.patterns import hexapolar
from ..pupil.rules import Gauss, PupilRule, planned, symmetry_of
from ..rays.known import Known, known_rays, tiles, trace_tile, wide
from ..rays.solve import solve, solve_aimed
from ..rays.status import Status, reaches_sensor
from ..rays.system import Vector, determinant, divide
from ..rays.trace import trace_bundle
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
        another reason than an aperture (see `Status`), and so do not count in any number above:
        they miss a surface, are totally reflected, or would have to step back where surfaces cross.
        Programs that let rays step back count those, and report larger spots.

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
    light = _light(lens, scene, sampling, "object")
    found = _spots(lens, scene, light, scene.reference(reference))
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
        level = _collimated(lens, jax.tree.map(lambda a: a[0], light), scene.wavelengths)
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
            "inside jax.jit or jax.vmap the rays cannot follow from what is clipped: make the rule "
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


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Light:
    """Rays and light of object points (...).

    hit: (..., W, Q, 2), mm. Along Q: mirror images of the rays of the rule (if it is bilateral),
        the rays of the rule, the chief ray, and those on the rim.
    weight: (..., W, Q); 0 for chief ray and rim.
    arrives: (..., W, Q), bool.
    chief: (..., W, 2), mm, hit of the chief ray.
    chief_whole: (..., W), bool, False where the chief ray fails.
    throughput, solid_angle, left_out: (..., W), as in `Spots`.
    """

    hit: Array
    weight: Array
    arrives: Array
    chief: Array
    chief_whole: Array
    throughput: Array
    solid_angle: Array
    left_out: Array


def _collimated(lens: Lens, light: _Light, wavelengths: Array) -> Array:
    """Whether the image of an object point is farther away than `_FAR` times the exit pupil, (W,).
    There the light has no cone, and the hits show the width of the beam: the solid angle is
    below pi var (kappa / _FAR)^2, var the variance of the hits, 1 / kappa the distance of the
    exit pupil."""
    hit, weight = light.hit, light.weight
    share = normalised(weight)[..., None]
    square = jnp.sum(share * (hit - jnp.sum(share * hit, axis=1, keepdims=True)) ** 2, axis=(1, 2))
    kappa = reference_curvature(lens, jnp.clip(wavelengths, *lens.dispersion.range))
    return light.solid_angle < np.pi * square * (kappa / _FAR) ** 2


def _light(lens: Lens, scene: Scene, sampling: float | PupilRule | None, point: Point) -> _Light:
    """The light of all points of a scene that fits the lens."""
    require_one_of("point", point, get_args(Point))
    rule = rule_for(lens, scene, sampling)
    return _traced(lens, scene, rule, point == "sensor", known_rays(lens, scene, rule, _aim))


@functools.partial(jit, wanted=LARGE, static_argnames="fixed")
def _traced(lens: Lens, scene: Scene, rule: PupilRule, fixed: bool, known: Known) -> _Light:
    """`_light`, compiled. fixed: True for the cone at a point of the sensor, False for that of an
    object point."""
    return over_points(lambda *one: _of_point(lens, rule, fixed, *one), scene, known)


def _of_point(lens: Lens, rule: PupilRule, fixed: bool, scene: Scene, known: Known) -> _Light:
    """The light of one object point."""
    points, weights = _whole_rule(scene, *rule.points(lens, scene, known.plan))
    count = weights.shape[-1]

    def arriving(points: Vector, field: Array) -> tuple[tuple[Vector, Vector], tuple]:
        """Hits and transverse direction cosines at the sensor, which are differentiated; status
        and transmission."""
        bundle = trace_bundle(lens, scene.at(field), points, known)
        whole = reaches_sensor(bundle.status)
        hit = tuple(jnp.where(whole, h[-1], 0) for h in bundle.hits)
        line = tuple(jnp.where(whole, a, 0) for a in bundle.arrival[:-1])
        return (hit, line), (bundle.status, rule.transmission(lens, bundle))

    ends = jax.linearize(arriving, points, scene.field, has_aux=True)
    (hit, _), jvp, (status, passes) = ends
    area = np.pi * jnp.abs(direction_determinant(jvp, points, scene.field, fixed))[:, :count]
    weight = weights * passes[:, :count]
    throughput, cone = jnp.sum(weight, axis=-1), jnp.sum(weight * area, axis=-1)
    arrives = status == Status.OK
    failed = ~reaches_sensor(status)
    left_out = jnp.mean(failed[:, 1 - len(_extra_points()) :].astype(weight.dtype), axis=-1)
    traced = slice(0, -len(_even()))
    parts = [jnp.stack(hit, axis=-1)[:, traced], arrives[:, traced]]
    weight = jnp.pad(weight, ((0, 0), (0, 1 + _RIM)))
    if rule.symmetry == "bilateral":  # add the mirror images of the rays of the rule
        images = parts[0][:, :count] * jnp.array([[[-1, 1]]], weight.dtype), arrives[:, :count]
        parts = [jnp.concatenate(pair, axis=1) for pair in zip(images, parts)]
        weight = jnp.concatenate([weight[:, :count], weight], axis=1) / 2
    hits, arrives = parts
    chief = status[:, count]
    whole = reaches_sensor(chief)
    chief_hit = jnp.stack([h[:, count] for h in hit], axis=-1)
    return _Light(hits, weight, arrives, chief_hit, whole, throughput, cone, left_out)


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


def direction_determinant(jvp: Callable, points: Vector, field: Array, fixed: bool) -> Array:
    """Determinants dl / dp (W, Q) of the directions by the stop points.

    jvp: derivatives (h, l) of hits and directions, as a function of tangents of points and field.
    points: stop points, 2 arrays (W, Q).
    field: (2,).
    fixed: False for a fixed object point: the determinant of l_p. True for a fixed point of the
        sensor: there the field changes with p by df = -h_f^-1 h_p dp, so it is the determinant of
        l_p - l_f h_f^-1 h_p.
    """
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
    return determinant(columns)


@functools.partial(jax.jit, static_argnames="middle")
def _spots(lens: Lens, scene: Scene, light: _Light, middle: int) -> Spots:
    """`Spots` of the light of the points of a scene. middle: index of the reference wavelength."""
    spectrum, colour = scene.spectrum, scene.wavelengths[middle]
    spectrum, wavelength = spectrum / jnp.sum(spectrum), colour / lens.index(colour)[-1, 0]
    one = lambda light: _spot(light, spectrum, wavelength, middle)  # noqa: E731
    return batched(one, light.throughput.ndim - 1)(light)


def _spot(light: _Light, spectrum: Array, wavelength: Array, middle: int) -> Spots:
    """`_spots` of one object point.

    spectrum: weights of the wavelengths, of the sum 1. wavelength: the reference wavelength in the
        medium of the sensor, um.
    """
    weight = light.weight * spectrum[:, None]
    hit = light.hit
    lit = jnp.sum(weight)
    share = safe_divide(weight, jnp.broadcast_to(lit, weight.shape))
    centroid = jnp.sum(share[..., None] * hit, axis=(0, 1))
    chief = light.chief[middle]
    good = lit > 0
    whole = good & light.chief_whole[middle]

    def spread(centre: Array, good: Array) -> tuple[Array, Array]:
        """RMS and largest distance from `centre`; inf where not `good`."""
        square = jnp.sum((hit - centre[None, None]) ** 2, axis=-1)
        mean = safe_sqrt(jnp.sum(share * square))
        largest = safe_sqrt(jnp.max(jnp.where(light.arrives, square, 0)))
        return jnp.where(good, mean, jnp.inf), jnp.where(good, largest, jnp.inf)

    (rms, radius), (rms_chief, radius_chief) = spread(centroid, good), spread(chief, whole)
    cone = light.solid_angle[middle]
    aperture = safe_sqrt(cone / np.pi)
    airy = jnp.where(aperture > 0, safe_divide(_AIRY * wavelength, aperture), jnp.inf)
    return Spots(
        jnp.where(light.arrives[..., None], hit, jnp.inf),
        weight,
        jnp.where(good, centroid, jnp.inf),
        jnp.where(light.chief_whole[middle], chief, jnp.inf),
        rms,
        rms_chief,
        radius,
        radius_chief,
        airy,
        light.throughput,
        light.solid_angle,
        light.left_out,
    )
