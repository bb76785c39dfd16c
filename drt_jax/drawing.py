"""Outlines of a lens and rays through it, as polylines in the (z, y) plane to be plotted."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from .fermat import Status
from .lens import Lens
from .surface import Shape, sag
from .trace import trace_rays

__all__ = ["Drawing", "draw"]

_POINTS = 41


class Drawing(NamedTuple):
    """Polylines (N, 2) of (z, y) in mm: glass, closed outlines of the elements; stop, its two
    blades; sensor; rays, a list for each field."""

    glass: list[np.ndarray]
    stop: list[np.ndarray]
    sensor: np.ndarray
    rays: list[list[np.ndarray]]


def draw(
    lens: Lens,
    fields: ArrayLike = (0.0,),
    distance: float = float("inf"),
    wavelength: float = 0.55,
    rays: int = 7,
) -> Drawing:
    """Draw a lens with `rays` meridional rays for each field angle (radians, along y)."""
    heights = jnp.linspace(-1.0, 1.0, rays)
    pupil = jnp.stack([jnp.zeros_like(heights), heights], axis=-1)
    fields = [float(field) for field in np.atleast_1d(fields)]
    fans = [trace_rays(lens, field, distance, [wavelength], pupil) for field in fields]
    good = [np.asarray(fan.points[0])[np.asarray(fan.status[0]) == Status.OK] for fan in fans]
    reach = max([float(np.max(np.abs(p[..., 1]))) for p in good if p.size], default=1.0)
    lead = 0.15 * float(lens.sensor)
    paths = [
        [_path(ray, lead, field, distance) for ray in points] for field, points in zip(fields, good)
    ]

    vertices = np.asarray(lens.vertices)
    semi = np.asarray(lens.semi_diameter)
    semi = np.where(np.isfinite(semi), semi, 1.1 * reach)
    faces = [_profile(lens, i, vertices[i], semi[i]) for i in range(len(vertices))]
    glass = [
        np.concatenate([faces[i], faces[i + 1][::-1], faces[i][:1]])
        for i in range(len(faces) - 1)
        if lens.glasses[i + 1] != "air"
    ]
    z, a = vertices[lens.stop], semi[lens.stop]
    blades = [np.array([[z, sign * a], [z, sign * (a + 0.15 * reach)]]) for sign in (-1, 1)]
    high = max((abs(path[-1, 1]) for fan in paths for path in fan), default=0.0)
    high = max(1.1 * high, 0.3 * reach)
    sensor = np.array([[float(lens.sensor), -high], [float(lens.sensor), high]])
    return Drawing(glass, blades, sensor, paths)


def _profile(lens: Lens, i: int, vertex: float, semi: float) -> np.ndarray:
    y: Array = jnp.linspace(-semi, semi, _POINTS)
    shape = Shape(lens.curvature[i], lens.conic[i], lens.coefficients[i])
    z = sag(jnp.stack([0 * y, y]), shape, lens.forms[i])
    return np.stack([vertex + np.asarray(z), np.asarray(y)], axis=-1)


def _path(points: np.ndarray, lead: float, field: float, distance: float) -> np.ndarray:
    """(z, y) of a ray from `lead` mm before the first vertex to the sensor."""
    first = points[0]
    slope = (first[1] / distance + np.tan(field)) / (first[2] / distance + 1)
    start = [-lead, first[1] - slope * (first[2] + lead)]
    return np.concatenate([[start], points[:, [2, 1]]])
