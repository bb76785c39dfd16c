"""Operand kinds: the values of a lens that a merit function compares with targets and limits.

Lengths are in mm, angles in radians. A kind has one value for each combination of the names in
brackets, and an operand may select some of them: fields, wavelengths, distances, surfaces.
"Wavelength: middle" means the middle wavelength, unless wavelengths are named.

residuals for a merit function, whose squares are summed; they take no target and no limits
    spot: distance of each ray from the centroid of all wavelengths, times the root of its weight.
        The squares of a field add up to the mean square radius of its spot, mm^2. Clipped rays have
        no weight, so that clipping the worst rays lowers the merit. With vignetting=False, for this
        and the following kinds up to centroid, clipped rays count as if they passed
    spot_of_colours: the same from the centroid of the ray's own wavelength
    spot_chief: the same from the chief ray of the middle wavelength
    path_difference: optical path of each ray less the mean of its wavelength, waves, times the root
        of its weight. The squares add up to the mean square wavefront error

spots and wavefronts [distance, field]
    rms_spot: root of the sum of the squares of spot, mm
    rms_wavefront: root of the sum of the squares of path_difference, waves
    centroid: y of the centroid of all wavelengths on the sensor, mm
    throughput: unvignetted fraction of the light through the stop. It has derivatives with the
        rules Soft and Clipped; with Gauss it changes in steps, ray by ray
    relative_illumination: from projected solid angles, relative to the first field; at the middle
        wavelength

diffraction; the best value is 1, so use target=1; see waves.py
    mtf [distance, field, tangential or sagittal]: modulus of the transfer function of all
        wavelengths at the frequency `at` on the sensor, cycles/mm
    strehl [distance, field, wavelength]: irradiance of the image of a point over that without
        aberrations
    encircled_energy [distance, field]: fraction of the light of all wavelengths within a circle of
        the radius `at`, mm, about the centroid. Spot and circle must be narrower than
        64 wavelengths / numerical aperture, about 140 um at f/2

chief rays, through the centre of the stop
    distortion [distance, field, wavelength: middle]: (real - paraxial image height) / paraxial
        image height; 0 on the axis. `drt_jax.distortion` compares with the chief rays near the
        axis on the sensor, which differs by a factor where the sensor is out of focus
    lateral_colour [distance, field, all wavelengths except the first]: y on the sensor less that of
        the first wavelength, mm; and the same in x, if the pupil rule covers the whole disc
    chief_ray_angle [distance, field, wavelength]: angle with the normal at the sensor's vertex, at
        least 0

    numerical_aperture [distance, field, wavelength: middle]: index times the sine of the angle
        between the chief ray and rays through the rim of the stop, root mean square, at the sensor

first order
    focal_length, effective_focal_length, back_focal_distance [wavelength: middle]: mm. The focal
        length is that in image space, n' / power, the effective one that in air, 1 / power
    entrance_pupil [wavelength: middle]: diameter, mm
    f_number [distance, wavelength: middle]: working f-number
    magnification [distance, wavelength: middle]: image height / object height
    total_track: first vertex to sensor, mm
    length: first vertex to last vertex, mm
    back_distance: last vertex to sensor, mm

thicknesses between active surfaces, and in front of the sensor; the surface is that in front
    glass_centre, air_centre [surface]: thickness along the light on the axis, mm
    glass_edge, air_edge [surface, zone]: thickness at 0.5, 0.7, 0.85 and 1 times a beam radius
        along y, mm: the larger radius of the two surfaces in glass, the smaller one in air; see
        `beam_radius`
    incidence_angle [surface]: largest angle of incidence of all rays

model glasses; the surface is that where the glass begins
    glass_map [surface]: distance of (nd, vd) outside of the convex hull of the catalogue, in units
        of nd, where 100 of vd count as one; negative inside, 0 for real glasses. high=0 keeps model
        glasses inside
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..image.chief import arrival_angle, outwards
from ..image.spot import deviations, normalised
from ..image.wavefront import path_differences
from ..lens.glasses import glass_map_distance
from ..lens.lens import Lens
from ..lens.paraxial import FirstOrder, first_order, image_height
from ..lens.scene import Scene, over_points
from ..numerics import matmul, safe_sqrt
from .field_rays import (
    EXTRAS,
    FieldRays,
    beam_radius,
    incidence_cosines,
    relative_illumination,
)
from .media import back_distance, between, gaps, model_glasses
from .waves import encircled_energy, mtf, strehl

# A function of a lens and its rays, and of `Operand.at`, that returns the values of an operand.
Function = Callable[..., Array]


class OperandKind(NamedTuple):
    """Kind of an operand.

    function: values, of any shape, from a lens and the rays that `Operand` selects.
    names: names by which an operand may select values.
    places: function of a lens, the surfaces that have a value; None if values do not belong to
        surfaces.
    traced: True if the function needs rays.
    squared: for residuals whose squares are summed, the kind that is the root of the sum; else
        empty.
    per_mm: penalty for each millimetre of miss of a failed ray, in the unit of the operand.
    order: axes of the values, see `axes`; () for the usual ones.
    rows: function of a lens, the surfaces that the function returns; None for `places`.
    at: the name of `Operand.at`, if the function takes it; else empty.
    """

    function: Function
    names: tuple[str, ...]
    places: Callable[[Lens], list[int]] | None = None
    traced: bool = True
    squared: str = ""
    per_mm: float = 1.0
    order: tuple[str, ...] = ()
    rows: Callable[[Lens], list[int]] | None = None
    at: str = ""

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes of the values in their order.

        They are "xy", "distances" and "fields" (together one axis), "wavelengths", "middle"
        (wavelengths; the middle one if none is named), "later" (all wavelengths except the first),
        "surfaces", "zones", "sections" (tangential, sagittal) and "rays".
        """
        ours = [name for name in ("distances", "fields", "surfaces") if name in self.names]
        return self.order or (*ours, *["middle"] * ("wavelengths" in self.names))

    @property
    def of_spots(self) -> bool:
        """True for spots and wavefronts, to which `Operand.vignetting` applies."""
        return self.squared != "" or self.function in (_rms_spot, _rms_wavefront, _centroid)

    @property
    def of_waves(self) -> bool:
        """True for kinds of diffraction, which have the best value 1 and need polynomials of the
        pupil.
        """
        return self.function in (mtf, strehl, encircled_energy)

    @property
    def of_all_views(self) -> bool:
        """True if the values of all fields must be computed before some are selected."""
        return self.function is relative_illumination


def _spot(lens: Lens, rays: FieldRays, axes: tuple[int, ...] = (-2, -1)) -> Array:
    """Residuals of "spot", or with the axes (-1,) of "spot_of_colours", (D, V, W, Q), mm."""
    return rays.spread(rays.bundle.sensor, axes)[0]


def _spot_chief(lens: Lens, rays: FieldRays) -> Array:
    """Residuals of "spot_chief", (D, V, W, Q), mm."""
    hits = rays.sensor_hits
    chief = hits[..., hits.shape[-2] // 2, None, :1]
    return (hits[..., EXTRAS:] - chief) * safe_sqrt(rays.light)[None]


def _rms_spot(lens: Lens, rays: FieldRays) -> Array:
    """RMS radii of the spots (V,), mm."""
    return safe_sqrt(jnp.sum(_spot(lens, rays) ** 2, axis=(0, 2, 3)))


def _centroid(lens: Lens, rays: FieldRays) -> Array:
    """y of the centroids (V,), mm."""
    return rays.spread(rays.bundle.sensor)[1][-1][:, 0, 0]


def _path_difference(lens: Lens, rays: FieldRays) -> Array:
    """Residuals of "path_difference", (V, W, Q), waves."""
    of_view = lambda bundle: path_differences(lens, rays.scene.wavelengths, bundle, None)[0]  # noqa: E731
    waves = jax.vmap(of_view)(rays.bundle)[..., EXTRAS:]
    (apart,), _ = deviations((waves,), normalised(rays.light), "none")
    return apart * safe_sqrt(rays.light)


def _rms_wavefront(lens: Lens, rays: FieldRays) -> Array:
    """RMS wavefront errors (V,), waves."""
    return safe_sqrt(jnp.sum(_path_difference(lens, rays) ** 2, axis=(1, 2)))


def _at_distances(name: str) -> OperandKind:
    """The kind of a field of `FirstOrder` that depends on distance and wavelength, (Z, W)."""

    def values(lens: Lens, rays: FieldRays) -> Array:
        far, waves = rays.scene.distance[:: rays.fields], rays.scene.wavelengths
        return jax.vmap(lambda distance: getattr(first_order(lens, distance, waves), name))(far)

    return OperandKind(values, ("wavelengths", "distances"), traced=False)


def _lens_alone(get: Callable[[FirstOrder], Array]) -> OperandKind:
    """The kind of a first-order value that depends on wavelength alone, (W,)."""

    def values(lens: Lens, rays: FieldRays) -> Array:
        return get(first_order(lens, jnp.inf, rays.scene.wavelengths))

    return OperandKind(values, ("wavelengths",), traced=False)


def _distortion(lens: Lens, rays: FieldRays) -> Array:
    """(Real - paraxial image height) / paraxial image height, (V, W), see `outwards`."""

    def ideal_of(scene: Scene) -> Array:
        return image_height(lens, scene.field, scene.distance, scene.wavelengths).T

    real = jnp.stack(rays.bundle.sensor, axis=-1)[..., 0, :]
    ideal = over_points(ideal_of, rays.scene)
    return outwards(real, ideal[..., -real.shape[-1] :])


def _lateral_colour(lens: Lens, rays: FieldRays) -> Array:
    """Chief rays on the sensor less that of the first wavelength, (D, V, W - 1), mm."""
    points = rays.sensor_hits[..., 0]
    points = points if rays.symmetry == "none" else points[-1:]
    return points[..., 1:] - points[..., :1]


def _numerical_aperture(lens: Lens, rays: FieldRays) -> Array:
    """Index times RMS sine of the angles between the chief ray and rays through the rim, (V, W).

    For unit vectors with the distance d, the sine of their angle satisfies sin^2 = d^2 (1 - d^2 /
    4).
    """
    lines = jnp.stack(rays.bundle.arrival)[..., :EXTRAS]
    square = jnp.sum((lines[..., 1:] - lines[..., :1]) ** 2, axis=0)
    sines = square * (1 - square / 4)
    top, bottom, side = jnp.moveaxis(sines, -1, 0)
    side = side if len(lines) == 3 else top  # one radius represents all azimuths
    index = lens.index(rays.scene.wavelengths)[-1]
    return index[None] * safe_sqrt((top + bottom + 2 * side) / 4)


def _gap(glass: bool, edge: bool) -> OperandKind:
    """The kind of thicknesses in glass or air, on the axis or towards the rim."""

    def values(lens: Lens, rays: FieldRays) -> Array:
        radius = beam_radius(lens, rays) if edge else jnp.zeros_like(lens.semi_diameter[:-1])
        return gaps(lens, radius, glass)[int(edge)]

    def places(lens: Lens) -> list[int]:
        return [front for front, _ in between(lens, glass)]

    order = ("surfaces", "zones") if edge else ("surfaces",)
    return OperandKind(values, ("surfaces",), places, traced=edge, order=order)


def _incidence(lens: Lens, rays: FieldRays) -> Array:
    """Largest angle of incidence on each active surface (L,), radians."""
    least = jnp.min(incidence_cosines(lens, rays), axis=(0, 2, 3))
    return jnp.arctan2(safe_sqrt((1 - least) * (1 + least)), least)


def _glass_map(lens: Lens, rays: FieldRays) -> Array:
    """Values of "glass_map" for all surfaces (S,); 0 for real glasses, whose nd in the model is 1
    to rounding.

    `Operand.placed` selects the surfaces where a model glass begins.
    """
    model = lens.dispersion.model
    assert model is not None, "Operand.check refuses it"
    return jnp.where(model[1:, 0] > 1.001, glass_map_distance(model[1:]), 0)


_RAYS = ("fields", "wavelengths", "distances")
_VIEWS = ("distances", "fields")
_EACH = (*_VIEWS, "wavelengths")
_OF_RAYS = (*_EACH, "rays")
_WAVES_PER_MM = 200.0  # path difference for each mm of miss, for green light at f/5
OPERANDS: dict[str, OperandKind] = {
    "spot": OperandKind(_spot, _RAYS, squared="rms_spot", order=_OF_RAYS),
    "spot_of_colours": OperandKind(
        partial(_spot, axes=(-1,)), _RAYS, squared="rms_spot", order=_OF_RAYS
    ),
    "spot_chief": OperandKind(_spot_chief, _RAYS, squared="rms_spot", order=_OF_RAYS),
    "rms_spot": OperandKind(_rms_spot, _RAYS, order=_VIEWS),
    "centroid": OperandKind(_centroid, _RAYS, order=_VIEWS),
    "path_difference": OperandKind(
        _path_difference, _RAYS, None, True, "rms_wavefront", _WAVES_PER_MM, _OF_RAYS
    ),
    "rms_wavefront": OperandKind(_rms_wavefront, _RAYS, per_mm=_WAVES_PER_MM, order=_VIEWS),
    "focal_length": _lens_alone(lambda a: a.focal_length),
    "effective_focal_length": _lens_alone(lambda a: a.effective_focal_length),
    "back_focal_distance": _lens_alone(lambda a: a.back_focal_distance),
    "entrance_pupil": _lens_alone(lambda a: 2 * a.entrance_pupil.semi_diameter),
    "f_number": _at_distances("f_number"),
    "magnification": _at_distances("magnification"),
    "total_track": OperandKind(lambda lens, rays: lens.sensor, (), traced=False),
    "length": OperandKind(lambda lens, rays: jnp.sum(lens.thickness), (), traced=False),
    "back_distance": OperandKind(
        lambda lens, rays: float(lens.senses[-1]) * back_distance(lens), (), traced=False
    ),
    "distortion": OperandKind(_distortion, _RAYS),
    "lateral_colour": OperandKind(_lateral_colour, _RAYS, order=("xy", *_VIEWS, "later")),
    "chief_ray_angle": OperandKind(
        lambda lens, rays: arrival_angle(lens, rays.bundle)[..., 0], _RAYS, order=_EACH
    ),
    "numerical_aperture": OperandKind(_numerical_aperture, _RAYS),
    "relative_illumination": OperandKind(relative_illumination, ("fields", "distances")),
    "throughput": OperandKind(
        lambda lens, rays: matmul(rays.throughput, rays.scene.spectrum), _RAYS, order=_VIEWS
    ),
    "mtf": OperandKind(mtf, _RAYS, order=(*_VIEWS, "sections"), at="frequency"),
    "strehl": OperandKind(strehl, _RAYS, order=_EACH),
    "encircled_energy": OperandKind(encircled_energy, _RAYS, order=_VIEWS, at="radius"),
    "glass_centre": _gap(True, False),
    "glass_edge": _gap(True, True),
    "air_centre": _gap(False, False),
    "air_edge": _gap(False, True),
    "glass_map": OperandKind(
        _glass_map, ("surfaces",), model_glasses, False, rows=lambda lens: [*range(lens.count)]
    ),
    "incidence_angle": OperandKind(
        _incidence, (*_RAYS, "surfaces"), lambda lens: [*lens.active], order=("surfaces",)
    ),
}


def kind_of(kind: str | Function) -> OperandKind:
    """The kind of an operand, by its name or function. A user's function may select rays."""
    return OPERANDS[kind] if isinstance(kind, str) else OperandKind(kind, _RAYS, order=("value",))
