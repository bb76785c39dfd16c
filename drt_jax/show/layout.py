"""Outlines of a lens and rays through it, as polylines in the (z, y) plane to be plotted."""

from typing import NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike

from ..rays.fermat import Status
from ..lens.lens import Lens, rotation_matrix
from ..lens.surface import Shape, sag
from ..rays.trace import trace_rays

__all__ = ["Drawing", "draw"]

_POINTS = 41


class Drawing(NamedTuple):
    """Polylines (N, 2) of (z, y) in mm, the section x = 0: glass, closed outlines of the
    elements; mirrors; stop, its two blades; sensor; rays, a list for each field."""

    glass: list[np.ndarray]
    mirrors: list[np.ndarray]
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
    heights = np.linspace(-1.0, 1.0, rays)
    pupil = np.stack([np.zeros_like(heights), heights], axis=-1)
    fields = [float(field) for field in np.atleast_1d(fields)]
    fans = [trace_rays(lens, field, distance, [wavelength], pupil) for field in fields]
    good = [np.asarray(fan.points[0])[np.asarray(fan.status[0]) == Status.OK] for fan in fans]
    reach = max([float(np.max(np.abs(p[..., 1]))) for p in good if p.size], default=1.0)
    lead = 0.15 * float(lens.sensor)
    paths = [
        [_path(ray, lead, field, distance) for ray in points] for field, points in zip(fields, good)
    ]

    semi = np.asarray(lens.semi_diameter)
    semi = np.where(np.isfinite(semi), semi, 1.1 * reach)
    faces = [_profile(lens, i, semi[i]) for i in range(len(semi))]
    glass = [
        np.concatenate([faces[i], faces[i + 1][::-1], faces[i][:1]])
        for i in range(len(faces) - 1)
        if lens.glasses[i + 1] != lens.glasses[0]
    ]
    mirrors = [face for face, mirror in zip(faces, lens.mirrors) if mirror]
    low, high = faces[lens.stop][0], faces[lens.stop][-1]
    outwards = (high - low) / np.linalg.norm(high - low) * 0.15 * reach
    blades = [np.stack([low, low - outwards]), np.stack([high, high + outwards])]
    ends = [path[-1] for fan in paths for path in fan]
    middle = np.array([[float(lens.sensor), 0.0]])
    if lens.decentre is not None:
        middle = middle + np.array([0.0, float(lens.decentre[-1, 1])])
    wide = max([float(np.linalg.norm(end - middle)) for end in ends], default=0.0)
    wide = max(1.1 * wide, 0.3 * reach)
    sensor = _placed(lens, len(semi), np.array([-wide, wide]), np.zeros(2))
    return Drawing(glass, mirrors, blades, sensor, paths)


def _placed(lens: Lens, i: int, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(z, y) along the axes of the lens of points on surface i (or the sensor)."""
    points = np.stack([np.zeros_like(y), y, z], axis=-1)
    if lens.tilt is not None:
        points = points @ np.asarray(rotation_matrix(lens.tilt[i])).T
    across = np.zeros(2) if lens.decentre is None else np.asarray(lens.decentre[i])
    place = lens.sensor if i == len(lens.forms) else lens.vertices[i]
    return np.stack([points[:, 2] + float(place), points[:, 1] + across[1]], axis=-1)


_sag = jax.jit(sag, static_argnums=2)


def _profile(lens: Lens, i: int, semi: float) -> np.ndarray:
    y = np.linspace(-semi, semi, _POINTS).astype(lens.curvature.dtype)
    shape = Shape(*(np.asarray(a)[i] for a in (lens.curvature, lens.conic, lens.coefficients)))
    return _placed(lens, i, y, np.asarray(_sag(np.stack([0 * y, y]), shape, lens.forms[i])))


def _path(points: np.ndarray, lead: float, field: float, distance: float) -> np.ndarray:
    """(z, y) of a ray from `lead` mm before the first vertex to the sensor."""
    first = points[0]
    slope = (first[1] / distance + np.tan(field)) / (first[2] / distance + 1)
    start = [-lead, first[1] - slope * (first[2] + lead)]
    return np.concatenate([[start], points[:, [2, 1]]])
