"""Gaussian optics: the y-u trace, focal length, pupils, image.

A paraxial ray has a height y (mm) and a slope u = dy/dz at each surface. From surface to surface y'
= y + d u, and at a surface of power P the slope follows from n' u' = n u - y P. Behind an odd
number of mirrors, index and distances are negative. Tilts and decentres are neglected. For a
surface or phase without rotational symmetry, the (y, z) section counts. Source of the formulas:
Welford, Aberrations of Optical Systems (1986), ch. 3, 6, 8, 10.

ValueError as in `checked_scene`. Inside a trace, where values are not known, results are inf for a
wavelength outside the range of a glass, for a distance within 1e-6 mm of 0 and for a field of 90
degrees or more.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import Numbers, program, safe_divide, still
from .glass import refractive_index
from .lens import Lens
from .scene import ahead, away_from_vertex, distance_array, known_angles, vergence_of
from .surface import vertex_curvature

# Largest rounding error of the last slope, in units of eps times the sum of the absolute values of
# its terms.
_ROUNDING = 16


class Pupil(NamedTuple):
    """An image of the stop; inf for a telecentric lens.

    position: (W,), mm, along z: of the entrance pupil from the first vertex, of the exit pupil from
        the last vertex.
    semi_diameter: (W,), mm.
    """

    position: Array
    semi_diameter: Array


class FirstOrder(NamedTuple):
    """First-order data of W wavelengths, (W,) each; lengths in mm.

    focal_length: n' / power, see the function `focal_length`; inf for an afocal lens.
    back_focal_distance: from the last vertex to the rear focus; inf for an afocal lens.
    front_focal_distance: from the first vertex to the front focus, negative for a focus in front of
        the lens; inf for an afocal lens.
    image_distance: from the first vertex to the paraxial image; inf for an image at infinity.
    f_number: 1 / (2 u) of the marginal ray at the image. For an object at infinity it is the focal
        length over the diameter of the entrance pupil, else the working f-number; inf for an image
        at infinity.
    numerical_aperture: n u of the marginal ray at the image, positive; 0 for an image at infinity.
    magnification: image height / object height, negative for an inverted image; 0 for an object at
        infinity.
    entrance_pupil: the stop as seen from the object.
    exit_pupil: the stop as seen from the image.
    petzval_radius: radius of the image of a flat object without astigmatism; inf for a flat image.
    effective_focal_length: 1 / power, in air: the EFL of design programs for any medium of the
        image, positive for lenses and mirrors that converge light; inf for an afocal lens.
    """

    focal_length: Array
    back_focal_distance: Array
    front_focal_distance: Array
    image_distance: Array
    f_number: Array
    numerical_aperture: Array
    magnification: Array
    entrance_pupil: Pupil
    exit_pupil: Pupil
    petzval_radius: Array
    effective_focal_length: Array


def _quotient(numerator: Array, denominator: Array) -> Array:
    """Quotient; inf, with derivative 0, where the denominator is 0."""
    return jnp.where(denominator == 0, jnp.inf, safe_divide(numerator, denominator))


def trace_yu(
    power: Array, gaps: Array, index: Array, height: Array, slope: Array
) -> tuple[Array, Array]:
    """Paraxial trace: heights on the S surfaces and slopes behind them, both (S, ...).

    power: (S, ...), 1/mm.
    gaps: (S - 1,), of any sign, mm.
    index: (S + 1, ...), of the media, negative behind an odd number of mirrors.
    height: (...), at the first vertex, mm.
    slope: (...), in front of the first surface.
    """
    shape = jnp.broadcast_shapes(height.shape, slope.shape, power.shape[1:], index.shape[1:])

    def wide(rows):
        return rows.reshape(len(rows), *(1,) * (len(shape) + 1 - rows.ndim), *rows.shape[1:])

    def step(ray, surface):
        height, slope = ray
        gap, power, before, after = surface
        height = height + gap * slope
        slope = (before * slope - height * power) / after
        return (height, slope), (height, slope)

    gaps = jnp.concatenate([jnp.zeros_like(gaps, shape=1), gaps])
    power, index = wide(power), wide(index)
    ray = jnp.broadcast_to(height, shape), jnp.broadcast_to(slope, shape)
    # The loop over the surfaces is not unrolled: arrays are tiny, and compilation takes most time.
    return jax.lax.scan(step, ray, (gaps, power, index[:-1], index[1:]))[1]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ParaxialSystem:
    """A lens for paraxial rays.

    curvature: (S,), 1/mm.
    power: (S, W), of each surface and its phase, 1/mm.
    gaps: (S - 1,), mm.
    index: (S + 1, W), negative behind an odd number of mirrors.
    aperture: (), semi-diameter of the stop, mm.
    known: (W,), bool, True if all media have an index.
    stop: index of the stop surface.
    """

    curvature: Array
    power: Array
    gaps: Array
    index: Array
    aperture: Array
    known: Array
    stop: int = dataclasses.field(metadata={"static": True})

    def masked(self, results: Any, good: Array | bool = True) -> Any:
        """Results with inf where an index is not known or the input is invalid.

        results: arrays (..., W).
        good: bool, of a shape that broadcasts, True for valid input.
        """

        def masked(found):
            valid = (jnp.broadcast_to(a, found.shape) for a in (self.known, good))
            return jnp.where(jnp.logical_and(*valid), found, jnp.inf)

        return jax.tree.map(masked, results)


class ParaxialRay(NamedTuple):
    """A paraxial ray: height on each surface, mm, and slopes in front of it and behind it, each (S,
    W).
    """

    height: Array
    before: Array
    behind: Array


def paraxial_system(lens: Lens, wavelengths: Numbers) -> ParaxialSystem:
    """The lens for paraxial rays. wavelengths: (W,), um."""
    lens.check()
    return _system(lens, lens.checked_wavelengths(wavelengths))


@program
def _system(lens: Lens, waves: Array) -> ParaxialSystem:
    """`paraxial_system` of checked numbers."""
    index = refractive_index(lens.dispersion, jnp.clip(waves, *lens.dispersion.range))
    index = index * jnp.asarray(lens.senses[:, None], index.dtype)
    curvature = vertex_curvature(lens.shape, lens.forms, 1)[0][:-1]
    power = curvature[:, None] * jnp.diff(index, axis=0)
    if lens.phase is not None:
        bend = vertex_curvature(lens.phase.shape, lens.phase.forms, 1)[0]
        wave = 1e-3 * lens.phase.order[:, None] * waves[None]
        power = power.at[np.array(lens.phase.surfaces)].add(-wave * bend[:, None])
    aperture = lens.semi_diameter[lens.stop]
    known = lens.dispersion.knows(waves)
    return ParaxialSystem(curvature, power, lens.thickness, index, aperture, known, lens.stop)


@program
def trace_ray(system: ParaxialSystem, height: Array | float, slope: Array | float) -> ParaxialRay:
    """Traces the paraxial ray of a height (mm) and slope, () or (W,), in front of the first vertex.

    A slope behind the lens that is only rounding error, as for an afocal lens, is set to 0.
    """
    one = jnp.ones_like(system.index[0])
    start = one * height, one * slope
    heights, behind = trace_yu(system.power, system.gaps, system.index, *start)
    before = jnp.concatenate([start[1][None], behind[:-1]])
    # The last n u is a sum of n u in front of the lens and height times power of each surface. Add
    # up the absolute values of these terms.
    sizes = jnp.abs(jnp.concatenate([start[0][None], heights[:-1]]))
    sizes = sizes.at[1:].add(jnp.abs(system.gaps[:, None] * before[1:]))
    terms = jnp.abs(system.index[0] * start[1]) + jnp.sum(sizes * jnp.abs(system.power), axis=0)
    least = _ROUNDING * jnp.finfo(terms.dtype).eps * terms
    # Remove the value but keep the derivative, because a solve may start from an afocal lens.
    error = jnp.where(jnp.abs(system.index[-1] * behind[-1]) >= least, 0, still(behind[-1]))
    return ParaxialRay(heights, before, behind.at[-1].add(-error))


@functools.partial(program, static_argnames="front")
def chief_ray(system: ParaxialSystem, front: bool) -> tuple[Array, Array]:
    """Height (W,), mm, and slope (W,) of the ray through the centre of the stop with n u = 1 there.

    front: True for the ray in front of the first vertex, False for the ray behind the last vertex.
    """
    power, gaps, index, stop = system.power, system.gaps, system.index, system.stop
    if front:  # backwards: the same lens seen from behind
        power, gaps, index = power[::-1], gaps[::-1], index[::-1]
        stop = len(power) - 1 - stop
    slope = 1 / index[stop + 1]
    height = jnp.zeros_like(slope)
    if stop + 1 < len(power):
        behind = slice(stop + 1, None)
        heights, slopes = trace_yu(
            power[behind], gaps[behind], index[behind], gaps[stop] * slope, slope
        )
        height, slope = heights[-1], slopes[-1]
    return (-height, slope) if front else (height, slope)


@functools.partial(program, static_argnames="front")
def _pupil(system: ParaxialSystem, front: bool) -> Pupil:
    """The entrance pupil (`front`) or the exit pupil."""
    height, slope = chief_ray(system, front)
    # n u times the semi-diameter of the pupil is the Lagrange invariant: that of the stop.
    bend = jnp.abs(system.index[0 if front else -1] * slope)
    return system.masked(Pupil(_quotient(-height, slope), _quotient(system.aperture, bend)))


def entrance_pupil(lens: Lens, wavelengths: Numbers) -> Pupil:
    """The entrance pupil: the stop as seen from the object.

    lens: the lens.
    wavelengths: (W,), um.
    """
    return _pupil(paraxial_system(lens, wavelengths), front=True)


@program
def marginal_ray(system: ParaxialSystem, vergence: Array) -> ParaxialRay:
    """The ray from the axial object point through the rim of the stop.

    vergence: (), 1 / distance, 1/mm.
    """
    ray = trace_ray(system, 1.0, vergence)
    factor = safe_divide(system.aperture, ray.height[system.stop])
    return ParaxialRay(*(part * factor[None] for part in ray))


def petzval_parts(system: ParaxialSystem) -> Array:
    """Contributions (S, W) of the surfaces to the Petzval sum, 1/mm."""
    index = system.index
    return -system.curvature[:, None] * (1 / index[1:] - 1 / index[:-1])


def first_order(lens: Lens, distance: Numbers, wavelengths: Numbers) -> FirstOrder:
    """First-order data. Focal length, focal distances and pupils do not depend on the distance.

    lens: the lens.
    distance: from the object to the first vertex, mm; may be inf.
    wavelengths: (W,), um.
    """
    system = paraxial_system(lens, wavelengths)
    return _first_order(system, distance_array(distance, lens.curvature.dtype))


@program
def _first_order(system: ParaxialSystem, far: Array) -> FirstOrder:
    """`first_order` of an object at the distance `far`, mm."""
    vergence, index = vergence_of(far), system.index
    level, slanted = trace_ray(system, 1.0, 0.0), trace_ray(system, 0.0, 1.0)
    axial = trace_ray(system, 1.0, vergence)
    u, axial_u = level.behind[-1], axial.behind[-1]
    marginal = marginal_ray(system, vergence).behind[-1]
    one = jnp.ones_like(u)
    found = FirstOrder(
        focal_length=_quotient(-one, u),
        back_focal_distance=_quotient(-level.height[-1], u),
        front_focal_distance=_quotient(slanted.behind[-1], u),
        image_distance=jnp.sum(system.gaps) + _quotient(-axial.height[-1], axial_u),
        f_number=_quotient(one, 2 * jnp.abs(marginal)),
        numerical_aperture=jnp.abs(index[-1] * marginal),
        magnification=_quotient(index[0] * vergence, index[-1] * axial_u),
        entrance_pupil=_pupil(system, front=True),
        exit_pupil=_pupil(system, front=False),
        petzval_radius=_quotient(-one, index[-1] * jnp.sum(petzval_parts(system), axis=0)),
        effective_focal_length=_quotient(-one, index[-1] * u),
    )
    return system.masked(found, away_from_vertex(far))


def focal_length(lens: Lens, wavelengths: Numbers) -> Array:
    """Focal length in image space (W,), n' / power, mm; inf for an afocal lens.

    It is the distance along z from the rear principal plane to the focus. It is longer than
    `FirstOrder.effective_focal_length` by the index if the image lies in water, and negative for
    a concave mirror.

    lens: the lens.
    wavelengths: (W,), um.
    """
    return _focal_length(paraxial_system(lens, wavelengths))


@program
def _focal_length(system: ParaxialSystem) -> Array:
    """`focal_length` of a paraxial system."""
    slope = trace_ray(system, 1.0, 0.0).behind[-1]
    return system.masked(_quotient(-jnp.ones_like(slope), slope))


def image_height(lens: Lens, field: Numbers, distance: Numbers, wavelengths: Numbers) -> Array:
    """Paraxial image height (..., W), mm; inf for an image at infinity.

    lens: the lens.
    field: (...), radians. Light of a positive angle travels upwards, from an object below the axis,
        see `Scene.heights`.
    distance: from the object to the first vertex, mm; may be inf.
    wavelengths: (W,), um.
    """
    system = paraxial_system(lens, wavelengths)
    far = distance_array(distance, lens.curvature.dtype)
    slope = trace_ray(system, 1.0, vergence_of(far)).behind[-1]
    angle = jnp.asarray(known_angles("field", field), lens.curvature.dtype)[..., None]
    forwards = ahead(angle)
    tangent = jnp.tan(jnp.where(forwards, angle, 0))
    fields = tuple(range(tangent.ndim - 1))
    front, bend = (jnp.expand_dims(a, fields) for a in (system.index[0], system.index[-1] * slope))
    return system.masked(_quotient(-tangent * front, bend), forwards & away_from_vertex(far))
