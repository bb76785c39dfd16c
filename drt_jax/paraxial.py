"""Gaussian optics: the y-u trace, focal length, pupils, image; third-order aberrations.

A paraxial ray is its height y in mm and its slope u = dy/dz, at each surface. After an odd
number of mirrors, the index and the distances are negative. Tilts and decentres are left out,
and a surface without an axis is taken in its (y, z) section. Source of the formulae: Welford,
Aberrations of Optical Systems (1986), ch. 3, 6, 8, 10.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from .lens import Lens
from .numerics import safe_divide
from .surface import ROTATIONAL, vertex_curvature

__all__ = ["FirstOrder", "Pupil", "ThirdOrder", "back_focal_distance", "entrance_pupil",
           "exit_pupil", "f_number", "first_order", "focal_length", "front_focal_distance",
           "image_distance", "image_height", "lateral_magnification", "numerical_aperture",
           "third_order", "trace_yu"]  # fmt: skip


class Pupil(NamedTuple):
    """An image of the stop: position (W,), mm along z, of the entrance pupil from the first
    vertex, of the exit pupil from the last; semi_diameter (W,), mm. Both are inf where the
    lens is telecentric."""

    position: Array
    semi_diameter: Array


class FirstOrder(NamedTuple):
    """What a design program lists first; each (W,) or a `Pupil`.

    focal_length, back_focal_distance, front_focal_distance, image_distance in mm; f_number;
    numerical_aperture and magnification of the image; entrance_pupil and exit_pupil;
    petzval_radius, mm: radius of the surface on which a flat object is imaged without
    astigmatism, inf for none.
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


class ThirdOrder(NamedTuple):
    """Third-order aberrations at the paraxial image, each (S, W), the parts of the surfaces.

    Transverse, in mm, of the ray through the rim of the stop from the edge of the field:
    spherical, tangential_coma, tangential_astigmatism and sagittal_astigmatism (of the
    tangential and of the sagittal image, from the paraxial image plane), petzval_blur,
    distortion; axial_colour and lateral_colour, the shortest wavelength against the longest.
    petzval_curvature in 1/mm. Signed as CODE V prints them: SA, TCO, TAS, SAS, PTB, DST, AX,
    LAT, PTZ.
    """

    spherical: Array
    tangential_coma: Array
    tangential_astigmatism: Array
    sagittal_astigmatism: Array
    petzval_blur: Array
    distortion: Array
    axial_colour: Array
    lateral_colour: Array
    petzval_curvature: Array

    @property
    def total(self) -> "ThirdOrder":
        """The sums over the surfaces, each (W,)."""
        return ThirdOrder(*(jnp.sum(part, axis=0) for part in self))


def _quotient(numerator: Array, denominator: Array) -> Array:
    """The quotient; inf, with derivative 0, where the denominator is 0."""
    return jnp.where(denominator == 0, jnp.inf, safe_divide(numerator, denominator))


def trace_yu(
    curvature: Array, gaps: Array, index: Array, height: Array, slope: Array
) -> tuple[Array, Array]:
    """Paraxial trace of one ray.

    `curvature` (S,) at the vertex, `gaps` (S - 1,), `index` (S + 1, ...), `height` and
    `slope` (...) at the first vertex, before it. Returns the heights on the S surfaces and
    the slopes behind them, both (S, ...).
    """
    heights, slopes = [], []
    for i in range(curvature.shape[0]):
        if i:
            height = height + gaps[i - 1] * slope
        slope = (index[i] * slope - height * curvature[i] * (index[i + 1] - index[i])) / index[
            i + 1
        ]
        heights.append(height)
        slopes.append(slope)
    return jnp.stack(heights), jnp.stack(slopes)


def _signed_index(lens: Lens, wavelengths: Array) -> Array:
    index = lens.index(wavelengths)
    return index * jnp.asarray(lens.senses[:, None], index.dtype)


def _curvature(lens: Lens) -> Array:
    return vertex_curvature(lens.shape, lens.forms, 1)[0]


def _trace(
    lens: Lens, wavelengths: Array, slope: ArrayLike, height: ArrayLike = 1.0
) -> tuple[Array, Array]:
    """Heights and slopes of the ray of the given height and slope at the first vertex."""
    index = _signed_index(lens, wavelengths)
    one = jnp.ones_like(index[0])
    return trace_yu(_curvature(lens), lens.thickness, index, one * height, one * slope)


def _parallel_ray(lens: Lens, wavelengths: Array) -> tuple[Array, Array]:
    height, slope = _trace(lens, wavelengths, 0.0)
    return height[-1], slope[-1]


def chief_ray(lens: Lens, wavelengths: Array, front: bool) -> tuple[Array, Array]:
    """Height and slope (W,) of a ray through the centre of the stop, where n u = 1 there.

    `front`: at the first vertex, before it; else at the last vertex, behind it.
    """
    index, stop = _signed_index(lens, wavelengths), lens.stop
    curvature, gaps = _curvature(lens), lens.thickness
    if front:  # backwards: the same lens seen from behind
        curvature, gaps, index = -curvature[::-1], gaps[::-1], index[::-1]
        stop = len(lens.forms) - 1 - stop
    slope = 1 / index[stop + 1]
    height = jnp.zeros_like(slope)
    if stop + 1 < len(lens.forms):
        height, slope = trace_yu(
            curvature[stop + 1 :], gaps[stop + 1 :], index[stop + 1 :], gaps[stop] * slope, slope
        )
        height, slope = height[-1], slope[-1]
    return (-height, slope) if front else (height, slope)


def _pupil(lens: Lens, wavelengths: Array, front: bool) -> Pupil:
    height, slope = chief_ray(lens, wavelengths, front)
    # n u times the size of the pupil is the same in all media (Lagrange).
    index = lens.index(wavelengths)[0 if front else -1]
    size = lens.semi_diameter[lens.stop] * jnp.ones_like(slope)
    return Pupil(_quotient(-height, slope), _quotient(size, jnp.abs(index * slope)))


def entrance_pupil(lens: Lens, wavelengths: Array) -> Pupil:
    """The stop as seen from the object; position from the first vertex. `wavelengths` in um."""
    return _pupil(lens, wavelengths, front=True)


def exit_pupil(lens: Lens, wavelengths: Array) -> Pupil:
    """The stop as seen from the image; position from the last vertex. `wavelengths` in um."""
    return _pupil(lens, wavelengths, front=False)


def focal_length(lens: Lens, wavelengths: Array) -> Array:
    """Effective focal length (W,), mm; inf for an afocal lens. `wavelengths` (W,) in um.

    From the rear principal plane to the focus, along z: in water longer by its index than in
    air, and negative for a concave mirror, whose focus lies before it.
    """
    _, slope = _parallel_ray(lens, wavelengths)
    return _quotient(-jnp.ones_like(slope), slope)


def back_focal_distance(lens: Lens, wavelengths: Array) -> Array:
    """Last vertex to the image of an infinitely far object (W,), mm; inf for an afocal lens.
    `wavelengths` (W,) in um."""
    height, slope = _parallel_ray(lens, wavelengths)
    return _quotient(-height, slope)


def front_focal_distance(lens: Lens, wavelengths: Array) -> Array:
    """First vertex to the front focus (W,), mm, negative where it lies before the lens; inf
    for an afocal lens. `wavelengths` (W,) in um."""
    _, slope = _parallel_ray(lens, wavelengths)
    _, tilted = _trace(lens, wavelengths, 1.0, 0.0)
    return _quotient(tilted[-1], slope)


def image_distance(lens: Lens, distance: ArrayLike, wavelengths: Array) -> Array:
    """First vertex to the paraxial image of an axial object at `distance` mm (W,), mm; inf
    where that lies at infinity. `wavelengths` (W,) in um."""
    height, slope = _axial_ray(lens, distance, wavelengths)
    return lens.vertices[-1] + _quotient(-height[-1], slope[-1])


def _axial_ray(lens: Lens, distance: ArrayLike, wavelengths: Array) -> tuple[Array, Array]:
    """Heights and slopes of the ray of height 1 from an axial object at `distance` mm."""
    return _trace(lens, wavelengths, 1 / jnp.asarray(distance, lens.curvature.dtype))


def _marginal_ray(lens: Lens, distance: ArrayLike, wavelengths: Array) -> tuple[Array, ...]:
    """Heights on the surfaces, slopes before and slopes behind them (S, W) of the ray from the
    axial object point through the rim of the stop."""
    vergence = 1 / jnp.asarray(distance, lens.curvature.dtype)
    height, slope = _axial_ray(lens, distance, wavelengths)
    before = jnp.concatenate([jnp.ones_like(slope[:1]) * vergence, slope[:-1]])
    scale = safe_divide(lens.semi_diameter[lens.stop], height[lens.stop])
    return height * scale, before * scale, slope * scale


def numerical_aperture(lens: Lens, distance: ArrayLike, wavelengths: Array) -> Array:
    """Paraxial n u of the marginal ray at the image (W,), positive; 0 for an image at infinity.

    `distance` from the object to the first vertex in mm, inf allowed; `wavelengths` (W,), um.
    """
    slope = _marginal_ray(lens, distance, wavelengths)[2][-1]
    return jnp.abs(lens.index(wavelengths)[-1] * slope)


def f_number(lens: Lens, wavelengths: Array, distance: ArrayLike = jnp.inf) -> Array:
    """1 / (2 u) of the marginal ray at the image (W,); inf for an image at infinity.

    For an infinitely far object, focal length over diameter of the entrance pupil; else the
    working f-number. `wavelengths` (W,) in um, `distance` in mm.
    """
    slope = _marginal_ray(lens, distance, wavelengths)[2][-1]
    return _quotient(jnp.ones_like(slope), 2 * jnp.abs(slope))


def lateral_magnification(lens: Lens, distance: ArrayLike, wavelengths: Array) -> Array:
    """Image height over object height (W,), negative where the image is upside down.

    `distance` from the object to the first vertex in mm; inf gives 0. `wavelengths` (W,), um.
    """
    index = _signed_index(lens, wavelengths)
    _, slope = _axial_ray(lens, distance, wavelengths)
    vergence = 1 / jnp.asarray(distance, lens.curvature.dtype)
    return _quotient(index[0] * vergence, index[-1] * slope[-1])


def image_height(
    lens: Lens, field: ArrayLike, distance: ArrayLike, wavelengths: Array
) -> Array:
    """Paraxial image height (..., W), mm, of the fields `field` (...), radians.

    As everywhere, light of a positive angle travels upwards, and the object lies below the
    axis (`field_of_height` gives the angle of an object point). `distance` in mm, inf allowed;
    `wavelengths` (W,) in um. inf for an image at infinity.
    """
    index = _signed_index(lens, wavelengths)
    _, slope = _axial_ray(lens, distance, wavelengths)
    tangent = jnp.tan(jnp.asarray(field, lens.curvature.dtype))[..., None]
    return _quotient(-tangent * index[0], index[-1] * slope[-1])


def _petzval(lens: Lens, index: Array) -> Array:
    """Parts (S, W) of the Petzval sum, 1/mm."""
    return -_curvature(lens)[:, None] * (1 / index[1:] - 1 / index[:-1])


def first_order(lens: Lens, distance: ArrayLike, wavelengths: Array) -> FirstOrder:
    """First-order data for an object at `distance` mm, inf allowed; `wavelengths` (W,) in um.

    See `FirstOrder`; focal length, focal distances and pupils do not depend on the distance.
    """
    index = _signed_index(lens, wavelengths)
    petzval = -index[-1] * jnp.sum(_petzval(lens, index), axis=0)
    return FirstOrder(
        focal_length(lens, wavelengths),
        back_focal_distance(lens, wavelengths),
        front_focal_distance(lens, wavelengths),
        image_distance(lens, distance, wavelengths),
        f_number(lens, wavelengths, distance),
        numerical_aperture(lens, distance, wavelengths),
        lateral_magnification(lens, distance, wavelengths),
        entrance_pupil(lens, wavelengths),
        exit_pupil(lens, wavelengths),
        _quotient(jnp.ones_like(petzval), petzval),
    )


def _fourth_order(lens: Lens) -> Array:
    """Coefficient (S,) of r^4 in the sag, beyond the sphere of the vertex curvature, mm^-3."""
    c, k = lens.curvature, lens.conic
    columns = [3 if form == "odd_asphere" else 1 for form in lens.forms]
    count = lens.coefficients.shape[1]
    fourth = jnp.stack(
        [
            lens.coefficients[i, j] if j < count else jnp.zeros_like(c[i])
            for i, j in enumerate(columns)
        ]
    )
    return fourth + ((1 + k) * c**3 - _curvature(lens) ** 3) / 8


def third_order(
    lens: Lens, field: ArrayLike, distance: ArrayLike, wavelengths: Array
) -> ThirdOrder:
    """Third-order aberrations of each surface, see `ThirdOrder`; `.total` sums them up.

    `field` () in radians, the edge of the field; `distance` from the object to the first
    vertex in mm, inf allowed; `wavelengths` (W,) in um. Colour is zero for one wavelength.
    Conics and the r^2 and r^4 terms of aspheres count; odd powers of r have no place in this
    theory and are left out. ValueError for a surface without rotational symmetry. Transverse
    aberrations are 0 for an image at infinity.
    """
    if not ROTATIONAL.issuperset(lens.forms):
        others = sorted(set(lens.forms) - ROTATIONAL)
        raise ValueError(f"third order: no theory for surfaces of the form {', '.join(others)}")
    n = _signed_index(lens, wavelengths)
    y, u, behind = _marginal_ray(lens, distance, wavelengths)
    vergence = 1 / jnp.asarray(distance, lens.curvature.dtype)
    chief = chief_ray(lens, wavelengths, front=True)
    # Scaled to the field, the slope of the line from the object point to the first vertex.
    tangent = jnp.tan(jnp.asarray(field, vergence.dtype))
    scale = safe_divide(tangent, chief[1] - vergence * chief[0])
    chief_y, chief_u = _trace(lens, wavelengths, chief[1] * scale, chief[0] * scale)
    chief_before = jnp.concatenate([(chief[1] * scale)[None], chief_u[:-1]])

    c = _curvature(lens)[:, None]
    incidence, chief_incidence = n[:-1] * (y * c + u), n[:-1] * (chief_y * c + chief_before)
    invariant = n[0] * (chief_before[0] * y[0] - u[0] * chief_y[0])
    bend = y * (behind / n[1:] - u / n[:-1])
    petzval = _petzval(lens, n)
    figure = 8 * _fourth_order(lens)[:, None] * (n[1:] - n[:-1])
    s1 = -(incidence**2) * bend + figure * y**4
    s2 = -incidence * chief_incidence * bend + figure * y**3 * chief_y
    s3 = -(chief_incidence**2) * bend + figure * y**2 * chief_y**2
    s4 = invariant**2 * petzval
    # Welford's quotient of the chief and the marginal incidence, written without it.
    step = 1 / n[1:] ** 2 - 1 / n[:-1] ** 2
    change = 1 / n[1:] - 1 / n[:-1]
    s5 = -(chief_incidence**3) * y * step + chief_y * chief_incidence * c * change * (
        2 * y * chief_incidence - chief_y * incidence
    )
    s5 = s5 + figure * y * chief_y**3
    spread = n[:, jnp.argmin(wavelengths)] - n[:, jnp.argmax(wavelengths)]
    spread = spread[:, None] / n
    colour = y * (spread[1:] - spread[:-1])
    half = safe_divide(jnp.ones_like(n[-1]), 2 * n[-1] * behind[-1])
    return ThirdOrder(
        spherical=half * s1,
        tangential_coma=3 * half * s2,
        tangential_astigmatism=half * (3 * s3 + s4),
        sagittal_astigmatism=half * (s3 + s4),
        petzval_blur=half * s4,
        distortion=half * s5,
        axial_colour=2 * half * incidence * colour,
        lateral_colour=2 * half * chief_incidence * colour,
        petzval_curvature=-n[-1] * petzval,
    )
