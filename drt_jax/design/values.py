"""Values of a lens: what operands take as residuals, compare with a target or keep within limits.

Lengths in mm, angles in radians. Each kind has one value for each of what stands in brackets; of
these an operand may name some: fields, wavelengths, distances, surfaces. "Middle": the middle
wavelength, unless wavelengths are named.

residuals to be squared, which take neither a target nor limits
    spot: each ray from the centroid of all wavelengths, times the root of the light it stands for:
        the squares of a field add up to the mean square radius of its spot, mm^2. Of the light that
        arrives, so that cutting the worst rays gains: vignetting=False, of this and all that
        follow up to centroid, counts rays that clear apertures clip as if they passed
    spot_of_colours: the same from the centroid of its own wavelength
    spot_chief: the same from where the chief ray of the middle wavelength falls
    path_difference: of each ray less the mean of its wavelength, waves, times the same root: the
        squares add up to the mean square wavefront error of the wavelengths

of spots and wavefronts [distance, field]
    rms_spot: mm, the root of what the squares of spot add up to
    rms_wavefront: waves, of path_difference
    centroid: y on the sensor, mm, of all wavelengths
    throughput: part of the light through the stop that clear apertures let pass; has derivatives
        with the rules Soft and Clipped, while Gauss drops rays one by one
    relative_illumination: by projected solid angles (with clipped light that of the middle
        wavelength), of that of the first field

of chief rays, through the middle of the stop
    distortion [distance, field, wavelength: middle]: how much farther out than where the paraxial
        image is, as a part of that; 0 on the axis
    lateral_colour [distance, field, wavelength but the first]: y on the sensor less that of the
        first wavelength, mm; x, too, where the pupil rule is one of the whole disc
    chief_ray_angle [distance, field, wavelength]: with the normal of the sensor's vertex, from 0

    numerical_aperture [distance, field, wavelength: middle]: index times sine of the angle between
        the chief ray and those through the rim of the stop, root of the mean square, at the sensor

of first order
    focal_length, effective_focal_length, back_focal_distance [wavelength: middle]: mm; the first in
        image space, n' over power, the second in air, 1 over power
    entrance_pupil [wavelength: middle]: its diameter, mm
    f_number, magnification [distance, wavelength: middle]: working f-number; image over object
        height
    total_track, length, back_distance: first vertex to sensor, to the last vertex, and from that to
        the sensor, mm

of gaps between neighbours that bend light, and before the sensor, by the surface in front of them
    glass_centre, air_centre [surface]: thickness along the light on the axis, mm
    glass_edge, air_edge [surface, zone]: at 0.5, 0.7, 0.85 and 1 of how far the light goes, in y;
        in glass up to the larger of both beam radii, in air the smaller; see `beam_radius`
    incidence_angle [surface]: the largest, of all rays, with the normal

of model glasses, by the surface where they begin
    glass_map [surface]: how far nd and vd lie outside of the convex hull of the catalogue, negative
        within, in units of nd, a vd of 100 being as far as an nd of 1; high=0 keeps them within
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..image.spot import deviations, normalised
from ..image.wavefront import path_differences
from ..lens.glasses import glass_map_distance
from ..lens.lens import Lens
from ..lens.paraxial import FirstOrder, first_order, image_height
from ..numerics import safe_divide, safe_sqrt
from .field_rays import (
    EXTRAS,
    FieldRays,
    beam_radius,
    incidence_cosines,
    relative_illumination,
)
from .gaps import between, gaps
from .kinds import back_distance, model_glasses

# What an operand is computed by: of a lens and its rays.
Function = Callable[[Lens, FieldRays], Array]


class OperandKind(NamedTuple):
    """What an operand of a name is.

    function: its values, of any shape, of a lens and its rays, as `Operand` selects them.
    names: what an operand of it may name. traced: whether it needs rays.
    places: the surfaces that have a value, None if it is none of surfaces; rows: those of the
    values, None: the same.
    squared: of residuals that only mean something as squares, the kind of their sum.
    per_mm: penalty per millimetre by which a failed ray misses, in the operand's unit.
    order: the axes of its values, see `axes`; of those of rays, the last ones.
    """

    function: Function
    names: tuple[str, ...]
    places: Callable[[Lens], list[int]] | None = None
    traced: bool = True
    squared: str = ""
    per_mm: float = 1.0
    order: tuple[str, ...] = ()
    rows: Callable[[Lens], list[int]] | None = None

    @property
    def axes(self) -> tuple[str, ...]:
        """What stands behind each other in its values: "xy", "distances", "fields" (these two as
        one axis), "wavelengths", "middle" (wavelengths, the middle one if none is named), "later"
        (all but the first), "surfaces", "zones", "rays"."""
        ours = [name for name in ("distances", "fields", "surfaces") if name in self.names]
        return self.order or (*ours, *["middle"] * ("wavelengths" in self.names))

    @property
    def of_spots(self) -> bool:
        """Whether it takes the light of whole fields, with or without what is clipped."""
        return self.squared != "" or self.function in (_rms_spot, _rms_wavefront, _centroid)

    @property
    def of_all_views(self) -> bool:
        """Whether its values are computed of all fields and those that are named taken of these."""
        return self.function is relative_illumination


def _hits(rays: FieldRays) -> tuple[Array, Array]:
    """Hits on the sensor (D, V, W, Q), mm, of the rays that carry light, 0 for others; and the
    part (V, W, Q) of the light of all wavelengths of a view."""
    light = jnp.where(rays.arrives, rays.weights, 0)[..., EXTRAS:]
    # Of each wavelength the light that arrives, as in `psf_moments`.
    light = normalised(light) * rays.wavelength_weights[None, :, None]
    return jnp.where(light[None] > 0, rays.sensor_hits[..., EXTRAS:], 0), light


def _spread(rays: FieldRays, axes: tuple[int, ...]) -> Array:
    """Distances of rays from the centroid over `axes`, times the root of their light, mm, (D, V, W,
    Q)."""
    hits, light = _hits(rays)
    parts, _ = deviations(tuple(hits), normalised(light, axes), rays.symmetry, axes)
    return jnp.stack(parts) * safe_sqrt(light)[None]


def _spot(lens: Lens, rays: FieldRays) -> Array:
    return _spread(rays, (-2, -1))


def _spot_of_colours(lens: Lens, rays: FieldRays) -> Array:
    return _spread(rays, (-1,))


def _spot_chief(lens: Lens, rays: FieldRays) -> Array:
    hits, light = _hits(rays)
    chief = rays.sensor_hits[..., 0]
    middle = chief[..., chief.shape[-1] // 2, None, None]
    return jnp.where(light[None] > 0, hits - middle, 0) * safe_sqrt(light)[None]


def _rms_spot(lens: Lens, rays: FieldRays) -> Array:
    return safe_sqrt(jnp.sum(_spot(lens, rays) ** 2, axis=(0, 2, 3)))


def _centroid(lens: Lens, rays: FieldRays) -> Array:
    hits, light = _hits(rays)
    return safe_divide(jnp.sum(light * hits[-1], (-2, -1)), jnp.sum(light, (-2, -1)))


def _path_difference(lens: Lens, rays: FieldRays) -> Array:
    of_view = lambda bundle: path_differences(lens, rays.wavelengths, bundle, None)[0]  # noqa: E731
    waves = jax.vmap(of_view)(rays.bundle)[..., EXTRAS:]
    _, light = _hits(rays)
    mean = jnp.sum(normalised(light) * waves, axis=-1, keepdims=True)
    return (waves - mean) * safe_sqrt(light)


def _rms_wavefront(lens: Lens, rays: FieldRays) -> Array:
    return safe_sqrt(jnp.sum(_path_difference(lens, rays) ** 2, axis=(1, 2)))


def _throughput(lens: Lens, rays: FieldRays) -> Array:
    return rays.throughput @ rays.wavelength_weights


def _first_order(get: Callable[[FirstOrder], Array]) -> Function:
    """Of distances and wavelengths (Z, W)."""

    def values(lens: Lens, rays: FieldRays) -> Array:
        far, waves = rays.distance[:: rays.fields], rays.wavelengths
        return jax.vmap(lambda distance: get(first_order(lens, distance, waves)))(far)

    return values


def _lens_alone(get: Callable[[FirstOrder], Array]) -> Function:
    """Of wavelengths (W,)."""
    return lambda lens, rays: get(first_order(lens, jnp.inf, rays.wavelengths))


def _back_distance(lens: Lens, rays: FieldRays) -> Array:
    return float(lens.senses[-1]) * back_distance(lens)


def _distortion(lens: Lens, rays: FieldRays) -> Array:
    def ideal_of(field: Array, distance: Array) -> Array:
        return image_height(lens, field, distance, rays.wavelengths)

    real = rays.sensor_hits[..., 0]
    ideal = jnp.moveaxis(jax.vmap(ideal_of)(rays.field, rays.distance), 1, 0)[-len(real) :]
    size = jnp.sum(ideal**2, axis=0)
    return safe_divide(jnp.sum(real * ideal, axis=0) - size, size)


def _lateral_colour(lens: Lens, rays: FieldRays) -> Array:
    points = rays.sensor_hits[..., 0]
    points = points if rays.symmetry == "none" else points[-1:]
    return points[..., 1:] - points[..., :1]


def _chief_ray_angle(lens: Lens, rays: FieldRays) -> Array:
    *across, along = (jnp.where(rays.arrives, a, 0)[..., 0] for a in rays.bundle.arrival)
    sine = safe_sqrt(sum((a**2 for a in across), jnp.zeros_like(along)))
    return jnp.arctan2(sine, jnp.where(sine + along**2 > 0, jnp.abs(along), 1))


def _numerical_aperture(lens: Lens, rays: FieldRays) -> Array:
    arrival = rays.bundle.arrival
    lines = jnp.stack([jnp.where(rays.arrives, a, 0)[..., :EXTRAS] for a in arrival])
    square = jnp.sum((lines[..., 1:] - lines[..., :1]) ** 2, axis=0)
    sines = square * (1 - square / 4)
    top, bottom, side = jnp.moveaxis(sines, -1, 0)
    side = side if len(arrival) == 3 else top  # the meridian stands for all azimuths
    index = lens.index(rays.wavelengths)[-1]
    return index[None] * safe_sqrt((top + bottom + 2 * side) / 4)


def _gap(glass: bool, edge: bool) -> OperandKind:
    def values(lens: Lens, rays: FieldRays) -> Array:
        radius = beam_radius(lens, rays) if edge else jnp.zeros_like(lens.semi_diameter[:-1])
        return gaps(lens, radius, glass)[int(edge)]

    def places(lens: Lens) -> list[int]:
        return [front for front, _ in between(lens, glass)]

    order = ("surfaces", "zones") if edge else ("surfaces",)
    return OperandKind(values, ("surfaces",), places, traced=edge, order=order)


def _incidence(lens: Lens, rays: FieldRays) -> Array:
    least = jnp.min(incidence_cosines(lens, rays), axis=(0, 2, 3))
    return jnp.arctan2(safe_sqrt((1 - least) * (1 + least)), least)


def _glass_map(lens: Lens, rays: FieldRays) -> Array:
    """Of all surfaces; `Operand.placed` names those where a model glass begins."""
    model = lens.dispersion.model
    assert model is not None, "Operand.check refuses it"
    return glass_map_distance(model[1:])


_RAYS = ("fields", "wavelengths", "distances")
_VIEWS = ("distances", "fields")
_OF_RAYS = (*_VIEWS, "wavelengths", "rays")
_COLOURS = ("wavelengths",)
_WAVES_PER_MM = 200.0  # green light at f/5
_SCALES = ("wavelengths", "distances")
OPERANDS: dict[str, OperandKind] = {
    "spot": OperandKind(_spot, _RAYS, squared="rms_spot", order=_OF_RAYS),
    "spot_of_colours": OperandKind(_spot_of_colours, _RAYS, squared="rms_spot", order=_OF_RAYS),
    "spot_chief": OperandKind(_spot_chief, _RAYS, squared="rms_spot", order=_OF_RAYS),
    "rms_spot": OperandKind(_rms_spot, _RAYS, order=_VIEWS),
    "centroid": OperandKind(_centroid, _RAYS, order=_VIEWS),
    "path_difference": OperandKind(
        _path_difference, _RAYS, None, True, "rms_wavefront", _WAVES_PER_MM, _OF_RAYS
    ),
    "rms_wavefront": OperandKind(_rms_wavefront, _RAYS, per_mm=_WAVES_PER_MM, order=_VIEWS),
    "focal_length": OperandKind(_lens_alone(lambda a: a.focal_length), _COLOURS, traced=False),
    "effective_focal_length": OperandKind(
        _lens_alone(lambda a: a.effective_focal_length), _COLOURS, traced=False
    ),
    "back_focal_distance": OperandKind(
        _lens_alone(lambda a: a.back_focal_distance), _COLOURS, traced=False
    ),
    "entrance_pupil": OperandKind(
        _lens_alone(lambda a: 2 * a.entrance_pupil.semi_diameter), _COLOURS, traced=False
    ),
    "f_number": OperandKind(_first_order(lambda a: a.f_number), _SCALES, traced=False),
    "magnification": OperandKind(_first_order(lambda a: a.magnification), _SCALES, traced=False),
    "total_track": OperandKind(lambda lens, rays: lens.sensor, (), traced=False),
    "length": OperandKind(lambda lens, rays: jnp.sum(lens.thickness), (), traced=False),
    "back_distance": OperandKind(_back_distance, (), traced=False),
    "distortion": OperandKind(_distortion, _RAYS),
    "lateral_colour": OperandKind(_lateral_colour, _RAYS, order=("xy", *_VIEWS, "later")),
    "chief_ray_angle": OperandKind(_chief_ray_angle, _RAYS, order=(*_VIEWS, "wavelengths")),
    "numerical_aperture": OperandKind(_numerical_aperture, _RAYS),
    "relative_illumination": OperandKind(relative_illumination, ("fields", "distances")),
    "throughput": OperandKind(_throughput, _RAYS, order=_VIEWS),
    "glass_centre": _gap(True, False),
    "glass_edge": _gap(True, True),
    "air_centre": _gap(False, False),
    "air_edge": _gap(False, True),
    "glass_map": OperandKind(
        _glass_map,
        ("surfaces",),
        model_glasses,
        traced=False,
        rows=lambda lens: [*range(lens.count)],
    ),
    "incidence_angle": OperandKind(
        _incidence, (*_RAYS, "surfaces"), lambda lens: [*lens.active], order=("surfaces",)
    ),
}


def kind_of(kind: str | Function) -> OperandKind:
    """What an operand of a name is, or of a user's function, which may name rays."""
    return OPERANDS[kind] if isinstance(kind, str) else OperandKind(kind, _RAYS, order=("value",))
