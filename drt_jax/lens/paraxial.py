"""Gaussian optics: the y-u trace, focal length, pupils, image.

A paraxial ray is its height y in mm and its slope u = dy/dz, at each surface. After an odd
number of mirrors, the index and the distances are negative. Tilts and decentres are left out,
and a surface or a phase without an axis is taken in its (y, z) section. Source of the formulae:
Welford, Aberrations of Optical Systems (1986), ch. 3, 6, 8, 10.

ValueError for wavelengths, distances and fields as of `scene_of`. Inside a trace, where values are
not known, the results for a wavelength outside the range of a glass, and for a distance that is
not above 0, and heights for a field of 90 degrees and more, are inf.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import Numbers, safe_divide
from .lens import Lens
from .scene import ahead, distance_array, field_array, in_front, vergence_of
from .surface import vertex_curvature


class Pupil(NamedTuple):
    """An image of the stop; inf where the lens is telecentric.

    position: (W,) in mm along z, of the entrance pupil from the first vertex, of the exit pupil
        from the last.
    semi_diameter: (W,) in mm.
    """

    position: Array
    semi_diameter: Array


class FirstOrder(NamedTuple):
    """What a design program lists first.

    focal_length: (W,) in mm, in image space, as `focal_length`.
    back_focal_distance: (W,) in mm, as `back_focal_distance`.
    front_focal_distance: (W,) in mm, as `front_focal_distance`.
    image_distance: (W,) in mm, as `image_distance`.
    f_number: (W,), as `f_number`.
    numerical_aperture: (W,), as `numerical_aperture`.
    magnification: (W,), as `lateral_magnification`.
    entrance_pupil: the stop as seen from the object.
    exit_pupil: the stop as seen from the image.
    petzval_radius: (W,) in mm, of the surface on which a flat object is imaged without
        astigmatism; inf for none.
    effective_focal_length: (W,) in mm, in air, as `effective_focal_length`.
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
    """The quotient; inf, with derivative 0, where the denominator is 0."""
    return jnp.where(denominator == 0, jnp.inf, safe_divide(numerator, denominator))


def trace_yu(
    power: Array, gaps: Array, index: Array, height: Array, slope: Array
) -> tuple[Array, Array]:
    """Paraxial trace: heights on the S surfaces and slopes behind them, both (S, ...).

    power: (S, ...) in 1/mm.
    gaps: (S - 1,) in mm, of any sign.
    index: (S + 1, ...) of the media, negative after an odd number of mirrors.
    height: (...) in mm at the first vertex.
    slope: (...) before it.
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
    # A loop over the surfaces, not unrolled: these arrays are tiny, compiling them is what costs.
    return jax.lax.scan(step, ray, (gaps, power, index[:-1], index[1:]))[1]


@dataclasses.dataclass(frozen=True)
class ParaxialSystem:
    """What paraxial rays see of a lens.

    curvature: (S,) in 1/mm.
    power: (S, W) in 1/mm, of a surface and its phase.
    gaps: (S - 1,) in mm.
    index: (S + 1, W), negative after an odd number of mirrors.
    aperture: (), the semi-diameter of the stop in mm.
    known: (W,), bool, whether all media have an index.
    stop: its index.
    """

    curvature: Array
    power: Array
    gaps: Array
    index: Array
    aperture: Array
    known: Array
    stop: int

    def masked(self, results: Any, good: Array | bool = True) -> Any:
        """Results (..., W); inf where an index is not known, or what came in is not `good`, bool
        of a shape that broadcasts."""

        def masked(found):
            sure = (jnp.broadcast_to(a, found.shape) for a in (self.known, good))
            return jnp.where(jnp.logical_and(*sure), found, jnp.inf)

        return jax.tree.map(masked, results)


class ParaxialRay(NamedTuple):
    """A paraxial ray: height in mm on each surface, slope before and behind it, each (S, W)."""

    height: Array
    before: Array
    behind: Array


def paraxial_system(lens: Lens, wavelengths: Numbers) -> ParaxialSystem:
    """What paraxial rays of `wavelengths` (W,), um, see of a lens."""
    lens.check()
    waves = lens.checked_wavelengths(wavelengths)
    index = lens.index(jnp.clip(waves, *lens.dispersion.range))
    index = index * jnp.asarray(lens.senses[:, None], index.dtype)
    curvature = vertex_curvature(lens.shape, lens.forms, 1)[0][:-1]
    power = curvature[:, None] * jnp.diff(index, axis=0)
    if lens.phase is not None:
        turned = vertex_curvature(lens.phase.shape, lens.phase.forms, 1)[0]
        wave = 1e-3 * lens.phase.order[:, None] * waves[None]
        power = power.at[np.array(lens.phase.surfaces)].add(-wave * turned[:, None])
    aperture = lens.semi_diameter[lens.stop]
    known = lens.dispersion.knows(waves)
    return ParaxialSystem(curvature, power, lens.thickness, index, aperture, known, lens.stop)


def trace_ray(system: ParaxialSystem, height: Array | float, slope: Array | float) -> ParaxialRay:
    """The ray of the given height (mm) and slope, () or (W,), at the first vertex, before it."""
    one = jnp.ones_like(system.index[0])
    start = one * height, one * slope
    heights, behind = trace_yu(system.power, system.gaps, system.index, *start)
    return ParaxialRay(heights, jnp.concatenate([start[1][None], behind[:-1]]), behind)


def chief_ray(system: ParaxialSystem, front: bool) -> tuple[Array, Array]:
    """Height and slope (W,) of a ray through the centre of the stop, where n u = 1 there.

    `front`: at the first vertex, before it; else at the last vertex, behind it.
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


def chief_ray_at_image(lens: Lens, wavelengths: Numbers) -> tuple[Array, Array]:
    """Height (W,) in mm and slope (W,), at the last vertex and behind it, of a ray through the
    centre of the stop; of the size that makes n u = 1 at the stop. `wavelengths` in um."""
    return chief_ray(paraxial_system(lens, wavelengths), front=False)


def _pupil(system: ParaxialSystem, front: bool) -> Pupil:
    height, slope = chief_ray(system, front)
    # n u times the size of the pupil is the same in all media (Lagrange).
    bend = jnp.abs(system.index[0 if front else -1] * slope)
    return system.masked(Pupil(_quotient(-height, slope), _quotient(system.aperture, bend)))


def entrance_pupil(lens: Lens, wavelengths: Numbers) -> Pupil:
    """The stop as seen from the object; position from the first vertex. `wavelengths` in um."""
    return _pupil(paraxial_system(lens, wavelengths), front=True)


def exit_pupil(lens: Lens, wavelengths: Numbers) -> Pupil:
    """The stop as seen from the image; position from the last vertex. `wavelengths` in um."""
    return _pupil(paraxial_system(lens, wavelengths), front=False)


def marginal_ray(system: ParaxialSystem, vergence: Array) -> ParaxialRay:
    """The ray from the axial object point at 1 / `vergence` () mm through the rim of the stop."""
    ray = trace_ray(system, 1.0, vergence)
    factor = safe_divide(system.aperture, ray.height[system.stop])
    return ParaxialRay(*(part * factor[None] for part in ray))


def petzval_parts(system: ParaxialSystem) -> Array:
    """Parts (S, W) of the Petzval sum, 1/mm."""
    index = system.index
    return -system.curvature[:, None] * (1 / index[1:] - 1 / index[:-1])


def first_order(lens: Lens, distance: Numbers, wavelengths: Numbers) -> FirstOrder:
    """First-order data, see `FirstOrder`.

    Focal length, focal distances and pupils do not depend on the distance.

    distance: from the object to the first vertex in mm, inf allowed.
    wavelengths: (W,) in um.
    """
    system = paraxial_system(lens, wavelengths)
    far = distance_array(distance, lens.curvature.dtype)
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
    return system.masked(found, in_front(far))


def focal_length(lens: Lens, wavelengths: Numbers) -> Array:
    """Focal length in image space (W,), n' over power, mm; inf for an afocal lens. `wavelengths`
    (W,) in um. From the rear principal plane to the focus, along z: in water longer by its index
    than `effective_focal_length`, and negative for a concave mirror, whose focus lies before it."""
    system = paraxial_system(lens, wavelengths)
    slope = trace_ray(system, 1.0, 0.0).behind[-1]
    return system.masked(_quotient(-jnp.ones_like(slope), slope))


def effective_focal_length(lens: Lens, wavelengths: Numbers) -> Array:
    """Effective focal length in air (W,), 1 over power, mm, whatever the medium of the image; inf
    for an afocal lens. `wavelengths` (W,) in um. The EFL of design programs; positive for lenses
    and mirrors that converge."""
    return first_order(lens, jnp.inf, wavelengths).effective_focal_length


def back_focal_distance(lens: Lens, wavelengths: Numbers) -> Array:
    """Last vertex to the image of an infinitely far object (W,), mm; inf for an afocal lens.
    `wavelengths` (W,) in um."""
    system = paraxial_system(lens, wavelengths)
    ray = trace_ray(system, 1.0, 0.0)
    return system.masked(_quotient(-ray.height[-1], ray.behind[-1]))


def front_focal_distance(lens: Lens, wavelengths: Numbers) -> Array:
    """First vertex to the front focus (W,), mm, negative where it lies before the lens; inf
    for an afocal lens. `wavelengths` (W,) in um."""
    return first_order(lens, jnp.inf, wavelengths).front_focal_distance


def image_distance(lens: Lens, distance: Numbers, wavelengths: Numbers) -> Array:
    """First vertex to the paraxial image of an axial object at `distance` mm (W,), mm; inf
    where that lies at infinity. `wavelengths` (W,) in um."""
    return first_order(lens, distance, wavelengths).image_distance


def numerical_aperture(lens: Lens, distance: Numbers, wavelengths: Numbers) -> Array:
    """Paraxial n u of the marginal ray at the image (W,), positive; 0 for an image at infinity.
    `distance` from the object to the first vertex in mm, inf allowed; `wavelengths` (W,), um."""
    return first_order(lens, distance, wavelengths).numerical_aperture


def f_number(lens: Lens, distance: Numbers, wavelengths: Numbers) -> Array:
    """1 / (2 u) of the marginal ray at the image (W,); inf for an image at infinity. For an
    infinitely far object, focal length over diameter of the entrance pupil; else the working
    f-number. `distance` from the object to the first vertex in mm; `wavelengths` (W,), um."""
    return first_order(lens, distance, wavelengths).f_number


def lateral_magnification(lens: Lens, distance: Numbers, wavelengths: Numbers) -> Array:
    """Image height over object height (W,), negative where the image is upside down.
    `distance` from the object to the first vertex in mm; inf gives 0. `wavelengths` (W,), um."""
    return first_order(lens, distance, wavelengths).magnification


def image_height(lens: Lens, field: Numbers, distance: Numbers, wavelengths: Numbers) -> Array:
    """Paraxial image height (..., W), mm, of the fields `field` (...), radians.

    As everywhere, light of a positive angle travels upwards, and the object lies below the
    axis (`field_of_height` gives the angle of an object point). `distance` in mm, inf allowed;
    `wavelengths` (W,) in um. inf for an image at infinity.
    """
    system = paraxial_system(lens, wavelengths)
    far = distance_array(distance, lens.curvature.dtype)
    slope = trace_ray(system, 1.0, vergence_of(far)).behind[-1]
    angle = field_array(field, lens.curvature.dtype)[..., None]
    forwards = ahead(angle)
    tangent = jnp.tan(jnp.where(forwards, angle, 0))
    fields = tuple(range(tangent.ndim - 1))
    front, bend = (jnp.expand_dims(a, fields) for a in (system.index[0], system.index[-1] * slope))
    return system.masked(_quotient(-tangent * front, bend), forwards & in_front(far))
