"""Gaussian optics: the y-u trace, focal length, pupils, image; third-order aberrations.

A paraxial ray is its height y in mm and its slope u = dy/dz, at each surface. After an odd
number of mirrors, the index and the distances are negative. Tilts and decentres are left out,
and a surface without an axis is taken in its (y, z) section. Source of the formulae: Welford,
Aberrations of Optical Systems (1986), ch. 3, 6, 8, 10.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from .lens import Lens
from ..numerics import safe_divide
from .surface import ROTATIONAL, vertex_curvature

__all__ = [
    "FirstOrder",
    "Pupil",
    "ThirdOrder",
    "back_focal_distance",
    "entrance_pupil",
    "exit_pupil",
    "f_number",
    "first_order",
    "focal_length",
    "front_focal_distance",
    "image_distance",
    "image_height",
    "lateral_magnification",
    "numerical_aperture",
    "third_order",
    "trace_yu",
]


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

    def step(ray, surface):
        height, slope = ray
        gap, curvature, before, after = surface
        height = height + gap * slope
        slope = (before * slope - height * curvature * (after - before)) / after
        return (height, slope), (height, slope)

    gaps = jnp.concatenate([jnp.zeros_like(curvature.ravel()[:1]), gaps])
    shape = jnp.broadcast_shapes(height.shape, slope.shape, curvature.shape[1:], index.shape[1:])
    ray = jnp.broadcast_to(height, shape), jnp.broadcast_to(slope, shape)
    # A loop over the surfaces, not unrolled: these arrays are tiny, compiling them is what costs.
    return jax.lax.scan(step, ray, (gaps, curvature, index[:-1], index[1:]))[1]


class _Paraxial(NamedTuple):
    """What paraxial rays see: curvature (S,), gaps (S - 1,), and index (S + 1, W), negative
    after an odd number of mirrors; static, the index of the stop."""

    curvature: Array
    gaps: Array
    index: Array
    stop: int


def _paraxial(lens: Lens, wavelengths: ArrayLike) -> _Paraxial:
    index = lens.index(wavelengths)
    index = index * jnp.asarray(lens.senses[:, None], index.dtype)
    curvature = vertex_curvature(lens.shape, lens.forms, 1)[0]
    return _Paraxial(curvature, lens.thickness, index, lens.stop)


def _trace(system: _Paraxial, height: ArrayLike, slope: ArrayLike) -> tuple[Array, Array]:
    """Heights and slopes (S, W) of the ray of the given height and slope at the first vertex."""
    one = jnp.ones_like(system.index[0])
    return trace_yu(system.curvature, system.gaps, system.index, one * height, one * slope)


def _vergence(lens: Lens, distance: ArrayLike) -> Array:
    return 1 / jnp.asarray(distance, lens.curvature.dtype)


def _chief_ray(system: _Paraxial, front: bool) -> tuple[Array, Array]:
    """Height and slope (W,) of a ray through the centre of the stop, where n u = 1 there.

    `front`: at the first vertex, before it; else at the last vertex, behind it.
    """
    curvature, gaps, index, stop = system
    if front:  # backwards: the same lens seen from behind
        curvature, gaps, index = -curvature[::-1], gaps[::-1], index[::-1]
        stop = len(curvature) - 1 - stop
    slope = 1 / index[stop + 1]
    height = jnp.zeros_like(slope)
    if stop + 1 < len(curvature):
        height, slope = trace_yu(
            curvature[stop + 1 :], gaps[stop + 1 :], index[stop + 1 :], gaps[stop] * slope, slope
        )
        height, slope = height[-1], slope[-1]
    return (-height, slope) if front else (height, slope)


def chief_ray_at_image(lens: Lens, wavelengths: ArrayLike) -> tuple[Array, Array]:
    """Height (W,) in mm and slope (W,), at the last vertex and behind it, of a ray through the
    centre of the stop; of the size that makes n u = 1 at the stop. `wavelengths` in um."""
    return _chief_ray(_paraxial(lens, wavelengths), front=False)


def _pupil(lens: Lens, system: _Paraxial, front: bool) -> Pupil:
    height, slope = _chief_ray(system, front)
    # n u times the size of the pupil is the same in all media (Lagrange).
    bend = jnp.abs(system.index[0 if front else -1] * slope)
    size = jnp.broadcast_to(lens.semi_diameter[lens.stop], slope.shape)
    return Pupil(_quotient(-height, slope), _quotient(size, bend))


def entrance_pupil(lens: Lens, wavelengths: ArrayLike) -> Pupil:
    """The stop as seen from the object; position from the first vertex. `wavelengths` in um."""
    return _pupil(lens, _paraxial(lens, wavelengths), front=True)


def exit_pupil(lens: Lens, wavelengths: ArrayLike) -> Pupil:
    """The stop as seen from the image; position from the last vertex. `wavelengths` in um."""
    return _pupil(lens, _paraxial(lens, wavelengths), front=False)


def _marginal_ray(lens: Lens, system: _Paraxial, distance: ArrayLike) -> tuple[Array, ...]:
    """Heights on the surfaces, slopes before and slopes behind them (S, W) of the ray from the
    axial object point through the rim of the stop."""
    vergence = _vergence(lens, distance)
    height, slope = _trace(system, 1.0, vergence)
    before = jnp.concatenate([jnp.ones_like(slope[:1]) * vergence, slope[:-1]])
    scale = safe_divide(lens.semi_diameter[lens.stop], height[lens.stop])
    return height * scale, before * scale, slope * scale


def _petzval(system: _Paraxial) -> Array:
    """Parts (S, W) of the Petzval sum, 1/mm."""
    index = system.index
    return -system.curvature[:, None] * (1 / index[1:] - 1 / index[:-1])


def first_order(lens: Lens, distance: ArrayLike, wavelengths: ArrayLike) -> FirstOrder:
    """First-order data for an object at `distance` mm, inf allowed; `wavelengths` (W,) in um.

    See `FirstOrder`; focal length, focal distances and pupils do not depend on the distance.
    """
    system = _paraxial(lens, wavelengths)
    index, vergence = system.index, _vergence(lens, distance)
    y, u = (a[-1] for a in _trace(system, 1.0, 0.0))
    _, tilted = _trace(system, 0.0, 1.0)
    axial_y, axial_u = (a[-1] for a in _trace(system, 1.0, vergence))
    marginal = _marginal_ray(lens, system, distance)[2][-1]
    one = jnp.ones_like(u)
    return FirstOrder(
        focal_length=_quotient(-one, u),
        back_focal_distance=_quotient(-y, u),
        front_focal_distance=_quotient(tilted[-1], u),
        image_distance=lens.vertices[-1] + _quotient(-axial_y, axial_u),
        f_number=_quotient(one, 2 * jnp.abs(marginal)),
        numerical_aperture=jnp.abs(index[-1] * marginal),
        magnification=_quotient(index[0] * vergence, index[-1] * axial_u),
        entrance_pupil=_pupil(lens, system, front=True),
        exit_pupil=_pupil(lens, system, front=False),
        petzval_radius=_quotient(-one, index[-1] * jnp.sum(_petzval(system), axis=0)),
    )


def focal_length(lens: Lens, wavelengths: ArrayLike) -> Array:
    """Effective focal length (W,), mm; inf for an afocal lens. `wavelengths` (W,) in um.

    From the rear principal plane to the focus, along z: in water longer by its index than in
    air, and negative for a concave mirror, whose focus lies before it.
    """
    _, slope = _trace(_paraxial(lens, wavelengths), 1.0, 0.0)
    return _quotient(-jnp.ones_like(slope[-1]), slope[-1])


def back_focal_distance(lens: Lens, wavelengths: ArrayLike) -> Array:
    """Last vertex to the image of an infinitely far object (W,), mm; inf for an afocal lens.
    `wavelengths` (W,) in um."""
    height, slope = _trace(_paraxial(lens, wavelengths), 1.0, 0.0)
    return _quotient(-height[-1], slope[-1])


def front_focal_distance(lens: Lens, wavelengths: ArrayLike) -> Array:
    """First vertex to the front focus (W,), mm, negative where it lies before the lens; inf
    for an afocal lens. `wavelengths` (W,) in um."""
    return first_order(lens, jnp.inf, wavelengths).front_focal_distance


def image_distance(lens: Lens, distance: ArrayLike, wavelengths: ArrayLike) -> Array:
    """First vertex to the paraxial image of an axial object at `distance` mm (W,), mm; inf
    where that lies at infinity. `wavelengths` (W,) in um."""
    return first_order(lens, distance, wavelengths).image_distance


def numerical_aperture(lens: Lens, distance: ArrayLike, wavelengths: ArrayLike) -> Array:
    """Paraxial n u of the marginal ray at the image (W,), positive; 0 for an image at infinity.

    `distance` from the object to the first vertex in mm, inf allowed; `wavelengths` (W,), um.
    """
    return first_order(lens, distance, wavelengths).numerical_aperture


def f_number(lens: Lens, wavelengths: ArrayLike, distance: ArrayLike = jnp.inf) -> Array:
    """1 / (2 u) of the marginal ray at the image (W,); inf for an image at infinity.

    For an infinitely far object, focal length over diameter of the entrance pupil; else the
    working f-number. `wavelengths` (W,) in um, `distance` in mm.
    """
    return first_order(lens, distance, wavelengths).f_number


def lateral_magnification(lens: Lens, distance: ArrayLike, wavelengths: ArrayLike) -> Array:
    """Image height over object height (W,), negative where the image is upside down.

    `distance` from the object to the first vertex in mm; inf gives 0. `wavelengths` (W,), um.
    """
    return first_order(lens, distance, wavelengths).magnification


def image_height(
    lens: Lens, field: ArrayLike, distance: ArrayLike, wavelengths: ArrayLike
) -> Array:
    """Paraxial image height (..., W), mm, of the fields `field` (...), radians.

    As everywhere, light of a positive angle travels upwards, and the object lies below the
    axis (`field_of_height` gives the angle of an object point). `distance` in mm, inf allowed;
    `wavelengths` (W,) in um. inf for an image at infinity.
    """
    system = _paraxial(lens, wavelengths)
    _, slope = _trace(system, 1.0, _vergence(lens, distance))
    tangent = jnp.tan(jnp.asarray(field, lens.curvature.dtype))[..., None]
    return _quotient(-tangent * system.index[0], system.index[-1] * slope[-1])


def _fourth_order(lens: Lens, vertex: Array) -> Array:
    """Coefficient (S,) of r^4 in the sag, beyond the sphere of curvature `vertex` (S,), mm^-3."""
    c, k = lens.curvature, lens.conic
    columns = [3 if form == "odd_asphere" else 1 for form in lens.forms]
    count = lens.coefficients.shape[1]
    fourth = jnp.stack(
        [
            lens.coefficients[i, j] if j < count else jnp.zeros_like(c[i])
            for i, j in enumerate(columns)
        ]
    )
    return fourth + ((1 + k) * c**3 - vertex**3) / 8


def third_order(
    lens: Lens, field: ArrayLike, distance: ArrayLike, wavelengths: ArrayLike
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
    system = _paraxial(lens, wavelengths)
    n, vergence = system.index, _vergence(lens, distance)
    y, u, behind = _marginal_ray(lens, system, distance)
    chief = _chief_ray(system, front=True)
    # Scaled to the field, the slope of the line from the object point to the first vertex.
    tangent = jnp.tan(jnp.asarray(field, vergence.dtype))
    scale = safe_divide(tangent, chief[1] - vergence * chief[0])
    chief_y, chief_u = _trace(system, chief[0] * scale, chief[1] * scale)
    chief_before = jnp.concatenate([(chief[1] * scale)[None], chief_u[:-1]])

    c = system.curvature[:, None]
    incidence, chief_incidence = n[:-1] * (y * c + u), n[:-1] * (chief_y * c + chief_before)
    invariant = n[0] * (chief_before[0] * y[0] - u[0] * chief_y[0])
    bend = y * (behind / n[1:] - u / n[:-1])
    petzval = _petzval(system)
    figure = 8 * _fourth_order(lens, system.curvature)[:, None] * (n[1:] - n[:-1])
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
    colours = jnp.atleast_1d(jnp.asarray(wavelengths, n.dtype))
    spread = n[:, jnp.argmin(colours)] - n[:, jnp.argmax(colours)]
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
