"""Values of a lens: what operands take as residuals, compare with a target or keep within limits.

Lengths in mm, angles in radians. Each kind has one value for each of what stands in brackets; of
these an operand may name some: fields, wavelengths, distances, surfaces. "Middle": the middle
colour, unless wavelengths are named.

residuals to be squared, which take neither a target nor limits
    spot: each ray from the centroid of all colours, times the root of the light it stands for: the
        squares of a field add up to the mean square radius of its spot, mm^2. Of the light that
        arrives, so that cutting the worst rays gains: vignetting=False, of this and all that
        follow up to centroid, counts rays that clear apertures clip as if they passed
    spot_of_colours: the same from the centroid of its own colour
    spot_chief: the same from where the chief ray of the middle colour falls
    path_difference: of each ray less the mean of its colour, waves, times the same root: the
        squares add up to the mean square wavefront error of the colours

of spots and wavefronts [distance, field]
    rms_spot: mm, the root of what the squares of spot add up to
    rms_wavefront: waves, of path_difference
    centroid: y on the sensor, mm, of all colours
    throughput: part of the light through the stop that clear apertures let pass; has derivatives
        with the rules Soft and Clipped, while Gauss drops rays one by one
    relative_illumination: by projected solid angles (with clipped light that of the middle colour),
        of that of the first field

of chief rays, through the middle of the stop
    distortion [distance, field, colour: middle]: how much farther out than where the paraxial image
        is, as a part of that; 0 on the axis
    lateral_colour [distance, field, colour but the first]: y on the sensor less that of the first
        colour, mm; x, too, where the pupil rule is one of the whole disc
    chief_ray_angle [distance, field, colour]: with the normal of the sensor's vertex, from 0

    numerical_aperture [distance, field, colour: middle]: index times sine of the angle between the
        chief ray and those through the rim of the stop, root of the mean square, at the sensor

of first order
    focal_length, effective_focal_length, back_focal_distance [colour: middle]: mm; the first in
        image space, n' over power, the second in air, 1 over power
    entrance_pupil [colour: middle]: its diameter, mm
    f_number, magnification [distance, colour: middle]: working f-number; image over object height
    total_track, length, back_distance: first vertex to sensor, to the last vertex, and from that to
        the sensor, mm

of gaps between neighbours that bend light, and before the sensor, by the surface in front of them
    glass_centre, air_centre [surface]: thickness along the light on the axis, mm
    glass_edge, air_edge [surface, zone]: at 0.5, 0.7, 0.85 and 1 of how far the light goes, in y;
        in glass of the larger of both extents, in air of the smaller; see `Seen.extents`
    incidence_angle [surface]: the largest, of all rays, with the normal

of model glasses, by the surface where they begin
    glass_map [surface]: how far nd and vd lie outside of the convex hull of the catalogue, negative
        within, in units of nd, a vd of 100 being as far as an nd of 1; high=0 keeps them within
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..image.wavefront import path_differences
from ..lens.glass import glass_map_distance
from ..lens.lens import Lens
from ..lens.paraxial import FirstOrder, first_order, image_height
from ..numerics import safe_divide, safe_sqrt
from ..rays.status import Status
from ..rays.trace import Bundle
from .gaps import between, gaps
from .kinds import back_distance, model_glasses
from .seen import EXTRAS, Seen


class Which(NamedTuple):
    """What an operand names, counted from 0; empty: all.

    fields, wavelengths, distances: of the problem's. surfaces: of the lens'. vignetting: whether
    rays that clear apertures clip are left out.
    """

    fields: tuple[int, ...]
    wavelengths: tuple[int, ...]
    distances: tuple[int, ...]
    surfaces: tuple[int, ...]
    vignetting: bool = True


class Value(NamedTuple):
    """What an operand judges.

    function: its values, of any shape. names: what an operand of it may name. places: the surfaces
    that have one, None if it is none of surfaces. traced: whether it needs rays. squared: for
    residuals that only mean something as squares, the kind of their sum. per_mm: by how much a ray
    that misses by 1 mm changes it, as what weighs a ray that fails. order: the axes of its values,
    see `axes`; of those of rays, the last ones.
    """

    function: Callable[[Which, Seen], Array]
    names: tuple[str, ...]
    places: Callable[[Lens], list[int]] | None = None
    traced: bool = True
    squared: str = ""
    per_mm: float = 1.0
    order: tuple[str, ...] = ()

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


def _views(which: Which, seen: Seen) -> np.ndarray:
    """Which views are meant: all fields at the first distance, then at the next."""
    fields = which.fields or range(seen.fields)
    distances = which.distances or range(seen.distances)
    return np.array([d * seen.fields + f for d in distances for f in fields])


def _colours(which: Which, seen: Seen) -> np.ndarray:
    return np.array(which.wavelengths or range(seen.views.wavelengths.shape[0]))


def _middle(which: Which, seen: Seen) -> np.ndarray:
    return np.array(which.wavelengths or (seen.views.wavelengths.shape[0] // 2,))


def _hits(which: Which, seen: Seen) -> tuple[Array, Array]:
    """Hits on the sensor (D, V, W, Q), mm, of the rays that carry light, 0 for others; and the
    part (V, W, Q) of the light of all colours of a view: of that which passes the clear apertures
    or, without vignetting, the stop."""
    views, colours = _views(which, seen), _colours(which, seen)
    rays = seen.rays
    light = rays.light
    if not which.vignetting:
        weights = seen.rule.points(seen.lens, seen.views)[1]
        light = jnp.broadcast_to(jnp.pad(weights, ((0, 0), (EXTRAS, 0)))[None], light.shape)
    light = jnp.where(rays.whole, light, 0)[views][:, colours, EXTRAS:]
    # Of each wavelength the light that arrives, as in `psf_moments`.
    light = safe_divide(light, jnp.sum(light, axis=-1, keepdims=True))
    shares = seen.colour_weights[colours]
    light = light * (shares / jnp.sum(shares))[None, :, None]
    hits = jnp.stack([h[views, -1][:, colours, EXTRAS:] for h in rays.bundle.hits])
    return jnp.where(light[None] > 0, hits, 0), light


def _centred(values: Array, light: Array, axes: tuple[int, ...]) -> Array:
    """Values (V, W, Q) less their mean over axes."""
    total, mean = (jnp.sum(a, axis=axes, keepdims=True) for a in (light, light * values))
    return values - safe_divide(mean, total)


def _spread(which: Which, seen: Seen, axes: tuple[int, ...]) -> Array:
    """Distances of rays from the centroid over `axes`, times the root of their light, mm, (D, V, W,
    Q)."""
    hits, light = _hits(which, seen)
    parts = []
    for k, hit in enumerate(hits):
        across = len(hits) == 1 or (k == 0 and seen.rule.symmetry == "half")
        parts.append(hit if across else _centred(hit, light, axes))  # else it averages to 0
    return jnp.stack(parts) * safe_sqrt(light)[None]


def _spot(which: Which, seen: Seen) -> Array:
    return _spread(which, seen, (-2, -1))


def _spot_of_colours(which: Which, seen: Seen) -> Array:
    return _spread(which, seen, (-1,))


def _chief(which: Which, seen: Seen, colours: np.ndarray) -> Array:
    """Where chief rays meet the sensor, (D, V, W), mm."""
    views = _views(which, seen)
    return jnp.stack([h[views, -1][:, colours, 0] for h in seen.rays.bundle.hits])


def _spot_chief(which: Which, seen: Seen) -> Array:
    hits, light = _hits(which, seen)
    chief = _chief(which, seen, _colours(which, seen))
    middle = chief[..., chief.shape[-1] // 2, None, None]
    return jnp.where(light[None] > 0, hits - middle, 0) * safe_sqrt(light)[None]


def _rms_spot(which: Which, seen: Seen) -> Array:
    return safe_sqrt(jnp.sum(_spot(which, seen) ** 2, axis=(0, 2, 3)))


def _centroid(which: Which, seen: Seen) -> Array:
    hits, light = _hits(which, seen)
    return safe_divide(jnp.sum(light * hits[-1], (-2, -1)), jnp.sum(light, (-2, -1)))


def _path_difference(which: Which, seen: Seen) -> Array:
    views, colours = _views(which, seen), _colours(which, seen)
    own = seen.views.wavelengths

    def one(bundle: Bundle) -> Array:
        if not which.vignetting:
            clipped = bundle.status == Status.CLIPPED
            bundle = bundle._replace(status=jnp.where(clipped, Status.OK, bundle.status))
        return path_differences(seen.lens, own, bundle, None)[0]

    waves = jax.vmap(one)(seen.rays.bundle)[views][:, colours, EXTRAS:]
    _, light = _hits(which, seen)
    return _centred(waves, light, (-1,)) * safe_sqrt(light)


def _rms_wavefront(which: Which, seen: Seen) -> Array:
    return safe_sqrt(jnp.sum(_path_difference(which, seen) ** 2, axis=(1, 2)))


def _throughput(which: Which, seen: Seen) -> Array:
    colours, views = _colours(which, seen), _views(which, seen)
    weights = seen.colour_weights[colours]
    return seen.rays.passed[views][:, colours] @ weights / jnp.sum(weights)


def _first_order(get: Callable[[FirstOrder], Array]) -> Callable[[Which, Seen], Array]:
    """Of distances and colours (Z, W)."""

    def values(which: Which, seen: Seen) -> Array:
        far = seen.views.distance[:: seen.fields]
        far = far[np.array(which.distances or range(seen.distances))]
        waves = seen.views.wavelengths
        found = jax.vmap(lambda distance: get(first_order(seen.lens, distance, waves)))(far)
        return found[:, _middle(which, seen)]

    return values


def _lens_alone(get: Callable[[FirstOrder], Array]) -> Callable[[Which, Seen], Array]:
    """Of colours (W,)."""

    def values(which: Which, seen: Seen) -> Array:
        found = first_order(seen.lens, jnp.inf, seen.views.wavelengths)
        return get(found)[_middle(which, seen)]

    return values


def _back_distance(which: Which, seen: Seen) -> Array:
    return float(seen.lens.senses[-1]) * back_distance(seen.lens)


def _distortion(which: Which, seen: Seen) -> Array:
    views, colours = _views(which, seen), _middle(which, seen)
    waves = seen.views.wavelengths

    def ideal_of(field: Array, distance: Array) -> Array:
        return image_height(seen.lens, field, distance, waves)

    real = _chief(which, seen, colours)
    ideal = jax.vmap(ideal_of)(seen.views.field[views], seen.views.distance[views])
    ideal = jnp.moveaxis(ideal, 1, 0)[-len(real) :, :, colours]
    size = jnp.sum(ideal**2, axis=0)
    return safe_divide(jnp.sum(real * ideal, axis=0) - size, size)


def _lateral_colour(which: Which, seen: Seen) -> Array:
    points = _chief(which, seen, _colours(which, seen))
    points = points if seen.rule.symmetry == "disc" else points[-1:]
    return points[..., 1:] - points[..., :1]


def _chief_ray_angle(which: Which, seen: Seen) -> Array:
    views, colours = _views(which, seen), _colours(which, seen)
    whole, arrival = seen.rays.whole, seen.rays.bundle.arrival
    *across, along = (jnp.where(whole, a, 0)[views][:, colours, 0] for a in arrival)
    sine = safe_sqrt(sum((a**2 for a in across), jnp.zeros_like(along)))
    return jnp.arctan2(sine, jnp.where(sine + along**2 > 0, jnp.abs(along), 1))


def _numerical_aperture(which: Which, seen: Seen) -> Array:
    views, colours = _views(which, seen), _middle(which, seen)
    whole, arrival = seen.rays.whole, seen.rays.bundle.arrival
    lines = jnp.stack([jnp.where(whole, a, 0)[views][:, colours, :EXTRAS] for a in arrival])
    square = jnp.sum((lines[..., 1:] - lines[..., :1]) ** 2, axis=0)
    sines = square * (1 - square / 4)
    top, bottom, side = jnp.moveaxis(sines, -1, 0)
    side = side if len(arrival) == 3 else top  # the meridian stands for all azimuths
    index = seen.lens.index(seen.views.wavelengths)[-1, colours]
    return index[None] * safe_sqrt((top + bottom + 2 * side) / 4)


def _illumination(which: Which, seen: Seen) -> Array:
    return seen.illumination[_views(which, seen)]


def _gap(glass: bool, edge: bool) -> Value:
    def values(which: Which, seen: Seen) -> Array:
        lens = seen.lens
        extents = seen.extents if edge else jnp.zeros_like(lens.semi_diameter[:-1])
        return gaps(lens, extents, glass, which.surfaces)[int(edge)]

    def places(lens: Lens) -> list[int]:
        return [front for front, _ in between(lens, glass)]

    order = ("surfaces", "zones") if edge else ("surfaces",)
    return Value(values, ("surfaces",), places, traced=edge, order=order)


def _incidence(which: Which, seen: Seen) -> Array:
    live = [k for k, i in enumerate(seen.lens.live) if i in (which.surfaces or seen.lens.live)]
    cosines = seen.cosines[_views(which, seen)][:, np.array(live)]
    least = jnp.min(cosines[:, :, _colours(which, seen)], axis=(0, 2, 3))
    return jnp.arctan2(safe_sqrt((1 - least) * (1 + least)), least)


def _glass_map(which: Which, seen: Seen) -> Array:
    model = seen.lens.dispersion.model
    assert model is not None, "Operand.check refuses it"
    return glass_map_distance(model[np.array(sorted(which.surfaces), int) + 1])


_RAYS = ("fields", "wavelengths", "distances")
_VIEWS = ("distances", "fields")
_OF_RAYS = (*_VIEWS, "wavelengths", "rays")
_COLOURS = ("wavelengths",)
_WAVES_PER_MM = 200.0  # green light at f/5
_SCALES = ("wavelengths", "distances")
OPERANDS: dict[str, Value] = {
    "spot": Value(_spot, _RAYS, squared="rms_spot", order=_OF_RAYS),
    "spot_of_colours": Value(_spot_of_colours, _RAYS, squared="rms_spot", order=_OF_RAYS),
    "spot_chief": Value(_spot_chief, _RAYS, squared="rms_spot", order=_OF_RAYS),
    "rms_spot": Value(_rms_spot, _RAYS, order=_VIEWS),
    "centroid": Value(_centroid, _RAYS, order=_VIEWS),
    "path_difference": Value(
        _path_difference, _RAYS, None, True, "rms_wavefront", _WAVES_PER_MM, _OF_RAYS
    ),
    "rms_wavefront": Value(_rms_wavefront, _RAYS, per_mm=_WAVES_PER_MM, order=_VIEWS),
    "focal_length": Value(_lens_alone(lambda a: a.focal_length), _COLOURS, traced=False),
    "effective_focal_length": Value(
        _lens_alone(lambda a: a.effective_focal_length), _COLOURS, traced=False
    ),
    "back_focal_distance": Value(
        _lens_alone(lambda a: a.back_focal_distance), _COLOURS, traced=False
    ),
    "entrance_pupil": Value(
        _lens_alone(lambda a: 2 * a.entrance_pupil.semi_diameter), _COLOURS, traced=False
    ),
    "f_number": Value(_first_order(lambda a: a.f_number), _SCALES, traced=False),
    "magnification": Value(_first_order(lambda a: a.magnification), _SCALES, traced=False),
    "total_track": Value(lambda which, seen: seen.lens.sensor, (), traced=False),
    "length": Value(lambda which, seen: jnp.sum(seen.lens.thickness), (), traced=False),
    "back_distance": Value(_back_distance, (), traced=False),
    "distortion": Value(_distortion, _RAYS),
    "lateral_colour": Value(_lateral_colour, _RAYS, order=("xy", *_VIEWS, "later")),
    "chief_ray_angle": Value(_chief_ray_angle, _RAYS, order=(*_VIEWS, "wavelengths")),
    "numerical_aperture": Value(_numerical_aperture, _RAYS),
    "relative_illumination": Value(_illumination, ("fields", "distances")),
    "throughput": Value(_throughput, _RAYS, order=_VIEWS),
    "glass_centre": _gap(True, False),
    "glass_edge": _gap(True, True),
    "air_centre": _gap(False, False),
    "air_edge": _gap(False, True),
    "glass_map": Value(_glass_map, ("surfaces",), model_glasses, traced=False),
    "incidence_angle": Value(
        _incidence, (*_RAYS, "surfaces"), lambda lens: [*lens.live], order=("surfaces",)
    ),
}
