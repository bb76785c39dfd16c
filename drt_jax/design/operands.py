"""Operands: what a design is judged by, as vectors of residuals and limits."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..image.wavefront import path_differences
from ..lens.lens import Lens
from ..lens.paraxial import first_order, image_height
from ..lens.surface import by_form, surface_sag
from ..numerics import safe_divide, safe_sqrt
from ..rays.status import Status
from .seen import EXTRAS, Seen


@dataclasses.dataclass(frozen=True)
class Operand:
    """One thing that is wanted of a lens: a target, or limits that are kept.

    kind: one of `OPERANDS`, see there for values and units.
    target: of the values. low, high: limits instead of a target; kept exactly in the end.
    weight: the residual is weight times the difference, in the units of the values.
    fields, wavelengths, distances, surfaces: which of the problem's, or of the lens', from 0;
        empty: all.
    """

    kind: str
    target: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    weight: float = 1.0
    fields: tuple[int, ...] = ()
    wavelengths: tuple[int, ...] = ()
    distances: tuple[int, ...] = ()
    surfaces: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in OPERANDS:
            raise ValueError(f"operands: unknown kind {self.kind!r}; known: {', '.join(OPERANDS)}")
        if not self.low < self.high:
            raise ValueError(
                f"operands: {self.kind}: low {self.low:g} is not below high {self.high:g}; "
                "exchange them"
            )
        if not 0 < self.weight < math.inf:
            raise ValueError(f"operands: {self.kind}: weight: must be above 0, got {self.weight:g}")
        if not math.isfinite(self.target):
            raise ValueError(f"operands: {self.kind}: target: must be finite, got {self.target:g}")

    @property
    def limits(self) -> bool:
        """Whether it is limits that are kept, not a target."""
        return math.isfinite(self.low) or math.isfinite(self.high)

    def values(self, seen: Seen) -> Array:
        """The values (K,) of a lens, of which the target is taken or which the limits bound."""
        return jnp.ravel(OPERANDS[self.kind](self, seen))

    def residuals(self, seen: Seen) -> Array:
        """(K,), the squares of which add up in the merit; none for limits."""
        if self.limits:
            return jnp.zeros(0)
        return self.weight * (self.values(seen) - self.target)

    def excess(self, seen: Seen) -> Array:
        """By how much each value is beyond each limit, times the weight, negative within; none for
        a target."""
        if not self.limits:
            return jnp.zeros(0)
        values = self.values(seen)
        sides = [self.low - values] * math.isfinite(self.low)
        sides += [values - self.high] * math.isfinite(self.high)
        return self.weight * jnp.concatenate(sides)


def _views(operand: Operand, seen: Seen) -> np.ndarray:
    """Which views are meant: all fields at the first distance, then at the next."""
    fields = operand.fields or range(seen.fields)
    distances = operand.distances or range(seen.distances)
    return np.array([d * seen.fields + f for d in distances for f in fields])


def _colours(operand: Operand, seen: Seen) -> np.ndarray:
    return np.array(operand.wavelengths or range(seen.views.wavelengths.shape[0]))


def _surfaces(operand: Operand, lens: Lens) -> list[int]:
    return list(operand.surfaces or range(lens.count))


def _hits(operand: Operand, seen: Seen) -> tuple[Array, Array]:
    """Hits on the sensor (D, V, W, Q), mm, of the rays that carry light, 0 for others; and the
    part (V, W, Q) of the light of all colours of a view."""
    views, colours = _views(operand, seen), _colours(operand, seen)
    rays = seen.rays
    light = rays.light[views][:, colours, EXTRAS:] * seen.colour_weights[colours, None]
    light = light / jnp.sum(seen.colour_weights[colours])
    good = (rays.bundle.status == Status.OK)[views][:, colours, EXTRAS:]
    hits = jnp.stack([h[views, -1][:, colours, EXTRAS:] for h in rays.bundle.hits])
    light = jnp.where(good, light, 0)
    return jnp.where(light > 0, hits, 0), light


def _centred(values: Array, light: Array, axes: tuple[int, ...]) -> Array:
    """Values (..., V, W, Q) less their mean over axes."""
    total = jnp.sum(light, axis=axes, keepdims=True)
    mean = safe_divide(
        jnp.sum(light * values, axis=axes, keepdims=True), jnp.broadcast_to(total, total.shape)
    )
    return values - mean


def _spread(operand: Operand, seen: Seen, axes: tuple[int, ...]) -> Array:
    """Distances of rays from the centroid over `axes`, times the root of their light, mm."""
    hits, light = _hits(operand, seen)
    parts = []
    for k, hit in enumerate(hits):
        across = len(hits) == 1 or (k == 0 and seen.rule.symmetry == "half")
        parts.append(hit if across else _centred(hit, light, axes))  # x averages to 0
    return jnp.stack(parts) * safe_sqrt(light)


def _spot(operand: Operand, seen: Seen) -> Array:
    return _spread(operand, seen, (-2, -1))


def _spot_of_colours(operand: Operand, seen: Seen) -> Array:
    return _spread(operand, seen, (-1,))


def _chief(operand: Operand, seen: Seen) -> Array:
    """Where chief rays meet the sensor, (D, V, W), mm."""
    views, colours = _views(operand, seen), _colours(operand, seen)
    hits = [h[views, -1][:, colours, 0] for h in seen.rays.bundle.hits]
    return jnp.stack(hits)


def _spot_chief(operand: Operand, seen: Seen) -> Array:
    hits, light = _hits(operand, seen)
    chief = _chief(operand, seen)
    middle = chief[..., chief.shape[-1] // 2, None, None]
    return jnp.where(light > 0, hits - middle, 0) * safe_sqrt(light)


def _rms_spot(operand: Operand, seen: Seen) -> Array:
    spread = _spread(operand, seen, (-2, -1))
    return safe_sqrt(jnp.sum(spread**2, axis=(0, 2, 3)))


def _centroid(operand: Operand, seen: Seen) -> Array:
    hits, light = _hits(operand, seen)
    return safe_divide(jnp.sum(light * hits[-1], (-2, -1)), jnp.sum(light, (-2, -1)))


def _path_difference(operand: Operand, seen: Seen) -> Array:
    views, colours = _views(operand, seen), _colours(operand, seen)
    own = seen.views.wavelengths

    def one(bundle: Any) -> Array:
        return path_differences(seen.lens, own, bundle, None)[0]

    waves = jax.vmap(one)(seen.rays.bundle)[views][:, colours, EXTRAS:]
    _, light = _hits(operand, seen)
    return _centred(waves, light, (-1,)) * safe_sqrt(light)


def _first_order(name: str) -> Callable[[Operand, Seen], Array]:
    def values(operand: Operand, seen: Seen) -> Array:
        distances = seen.views.distance[:: seen.fields]
        some = distances[np.array(operand.distances or (0,))]
        each = [getattr(first_order(seen.lens, d, seen.views.wavelengths), name) for d in some]
        colours = np.array(operand.wavelengths or (seen.views.wavelengths.shape[0] // 2,))
        return jnp.stack(each)[:, colours]

    return values


def _entrance_pupil(operand: Operand, seen: Seen) -> Array:
    pupil = first_order(seen.lens, seen.views.distance[0], seen.views.wavelengths).entrance_pupil
    colours = np.array(operand.wavelengths or (seen.views.wavelengths.shape[0] // 2,))
    return 2 * pupil.semi_diameter[colours]


def _paraxial_heights(operand: Operand, seen: Seen) -> Array:
    """(V, W), mm, of the middle colour, where the sensor is."""
    views = _views(operand, seen)
    lens, middle = seen.lens, seen.views.wavelengths.shape[0] // 2
    found = [
        image_height(lens, seen.views.field[v, 1], seen.views.distance[v], seen.views.wavelengths)
        for v in views
    ]
    return jnp.stack(found)[:, middle]


def _distortion(operand: Operand, seen: Seen) -> Array:
    middle = seen.views.wavelengths.shape[0] // 2
    views = _views(operand, seen)
    real = seen.rays.bundle.hits[-1][views, -1][:, middle, 0]
    ideal = _paraxial_heights(operand, seen)
    return safe_divide(real - ideal, ideal)


def _lateral_colour(operand: Operand, seen: Seen) -> Array:
    heights = _chief(operand, seen)[-1]
    return heights[:, 1:] - heights[:, :1]


def _chief_ray_angle(operand: Operand, seen: Seen) -> Array:
    views, colours = _views(operand, seen), _colours(operand, seen)
    cosine = seen.rays.bundle.arrival[-1][views][:, colours, 0]
    return jnp.arctan2(safe_sqrt(1 - cosine**2), jnp.abs(cosine))


def _track(operand: Operand, seen: Seen) -> Array:
    return seen.lens.sensor


def _length(operand: Operand, seen: Seen) -> Array:
    return jnp.sum(seen.lens.thickness)


# Where edges are judged, in parts of the larger or smaller of two extents.
_ZONES = np.array([0.5, 0.7, 0.85, 1.0])


def gaps(
    lens: Lens, extents: Array, glass: bool, surfaces: tuple[int, ...] = ()
) -> tuple[Array, Array]:
    """Thickness on the axis (G,) and at zones towards the rim (G, Z), mm along the light, of the
    gaps between neighbouring surfaces that bend light, in glass or in air; of those behind some
    surfaces alone, if any are named. In glass up to the larger of both extents (S,), in air to the
    smaller."""
    live, media = lens.live, lens.glasses
    pairs = [
        (i, j)
        for i, j in zip(live, live[1:])
        if (media[i + 1] != media[0]) == glass and (not surfaces or i in surfaces)
    ]
    if not pairs:
        return jnp.zeros(0), jnp.zeros((0, _ZONES.size))
    front, back = (np.array(rows) for rows in zip(*pairs))
    sense = jnp.asarray(lens.senses[back], lens.curvature.dtype)
    vertices = lens.vertices
    wide = jnp.maximum if glass else jnp.minimum
    y = wide(extents[front], extents[back])[:, None] * _ZONES

    def heights(rows: np.ndarray) -> Array:
        shape = jax.tree.map(lambda a: a[..., rows, None], lens.shape)
        return by_form(surface_sag, (0 * y, y), shape, tuple(lens.forms[i] for i in rows))

    axis = sense * (vertices[back] - vertices[front])
    return axis, axis[:, None] + sense[:, None] * (heights(back) - heights(front))


def _gap(glass: bool, edge: bool) -> Callable[[Operand, Seen], Array]:
    def values(operand: Operand, seen: Seen) -> Array:
        extents = seen.extents if edge else seen.lens.semi_diameter[:-1]
        extents = extents if edge else jnp.zeros_like(extents)
        return gaps(seen.lens, extents, glass, operand.surfaces)[int(edge)]

    return values


def _incidence(operand: Operand, seen: Seen) -> Array:
    cosines = seen.cosines[np.array(_surfaces_live(operand, seen.lens))]
    return jnp.arccos(jnp.clip(cosines, -1, 1 - 1e-12))


def _surfaces_live(operand: Operand, lens: Lens) -> list[int]:
    return [k for k, i in enumerate(lens.live) if not operand.surfaces or i in operand.surfaces]


def _illumination(operand: Operand, seen: Seen) -> Array:
    return seen.illumination[_views(operand, seen)]


OPERANDS: dict[str, Callable[[Operand, Seen], Array]] = {
    "spot": _spot,
    "spot_of_colours": _spot_of_colours,
    "spot_chief": _spot_chief,
    "rms_spot": _rms_spot,
    "centroid": _centroid,
    "path_difference": _path_difference,
    "focal_length": _first_order("focal_length"),
    "back_focal_distance": _first_order("back_focal_distance"),
    "f_number": _first_order("f_number"),
    "magnification": _first_order("magnification"),
    "entrance_pupil": _entrance_pupil,
    "total_track": _track,
    "length": _length,
    "distortion": _distortion,
    "lateral_colour": _lateral_colour,
    "chief_ray_angle": _chief_ray_angle,
    "relative_illumination": _illumination,
    "glass_centre": _gap(True, False),
    "glass_edge": _gap(True, True),
    "air_centre": _gap(False, False),
    "air_edge": _gap(False, True),
    "incidence_angle": _incidence,
}

# Those that need no ray.
_FIRST_ORDER = {
    *("focal_length", "back_focal_distance", "f_number", "magnification", "entrance_pupil"),
    *("total_track", "length", "glass_centre", "air_centre"),
}
TRACED = frozenset(set(OPERANDS) - _FIRST_ORDER)
