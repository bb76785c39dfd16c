"""A lens in section: its outlines and rays as polylines in the (z, y) plane, and their picture."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from matplotlib.axes import Axes

from ..lens.aperture import depths
from ..lens.lens import Lens, sag
from ..rays.status import Status
from ..rays.trace import trace_rays

_POINTS = 161
_FIELDS = ("tab:blue", "tab:green", "tab:red", "tab:purple", "tab:orange")


class Drawing(NamedTuple):
    """Polylines (N, 2) of (z, y) in mm, the section x = 0.

    glass: closed outlines of the elements.
    mirrors: their faces; NaN where an obscuration lies on one.
    stop: its two blades, also where it pokes through a surface.
    sensor: its face.
    rays: a list for each field.
    vignetted: rays that do not arrive, as far as the surface whose aperture stops them.
    """

    glass: list[np.ndarray]
    mirrors: list[np.ndarray]
    stop: list[np.ndarray]
    sensor: np.ndarray
    rays: list[list[np.ndarray]]
    vignetted: list[np.ndarray]


def draw(
    lens: Lens,
    fields: float | Sequence[float] = 0.0,
    distance: float = float("inf"),
    wavelength: float = 0.55,
    rays: int = 7,
) -> Drawing:
    """The polylines of a lens and of a fan of meridional rays for each field.

    fields: angles along y, radians.
    distance: from the object to the first vertex, mm.
    wavelength: um.
    rays: how many for each field; those that do not exist are left out.
    """
    angles = [float(angle) for angle in np.atleast_1d(fields)]
    heights = np.linspace(-1.0, 1.0, rays)
    pupil = np.stack([np.zeros_like(heights), heights], axis=-1)
    # A surface that bends no light is no corner of a ray, nor a face of glass.
    corners = [*lens.live, lens.count]
    hits, ends = [], []
    for angle in angles:
        fan = trace_rays(lens, angle, distance, wavelength, pupil)
        points, status = np.asarray(fan.points[0]), np.asarray(fan.status[0])
        hits.append(points[status == Status.OK][:, corners, :0:-1])
        clipped = points[status == Status.CLIPPED]
        for ray, stop in zip(clipped, np.argmax(outside(lens, clipped), axis=1)):
            cut = [*(k for k in lens.live if k < stop), stop]
            ends.append((ray[cut, :0:-1], angle))
    drawn = np.concatenate([np.zeros((1, 2)), *(hit.reshape(-1, 2) for hit in hits)])
    reach = float(np.max(np.abs(drawn[:, 1]))) or 1.0
    z = np.concatenate([drawn[:, 0], np.asarray(lens.places[0])])
    start = np.min(z) - 0.15 * np.ptp(z)
    paths = [
        [_path(ray, start, angle, distance) for ray in hit]
        for angle, hit in zip(angles, hits, strict=True)
    ]
    vignetted = [_path(ray, start, angle, distance) for ray, angle in ends]
    profiles = np.linspace(*_extents(lens, 1.1 * reach), _POINTS, axis=-1)
    faces = [_placed(lens, i, y, sag(lens, i, 0.0, y)) for i, y in enumerate(profiles)]
    glass = [
        np.concatenate([faces[i], faces[j][::-1], faces[i][:1]])
        for i, j in itertools.pairwise(lens.live)
        if lens.glasses[i + 1] != lens.glasses[0]
    ]
    pierced = _pierced(lens, profiles)
    mirrors = [
        np.where(pierced[i, :, None], np.nan, faces[i]) for i in np.flatnonzero(lens.mirrors)
    ]
    blades, sensor = _blades(faces[lens.stop], reach), _sensor(lens, paths, reach)
    return Drawing(glass, mirrors, blades, sensor, paths, vignetted)


def outside(lens: Lens, points: np.ndarray) -> np.ndarray:
    """Whether rays through points (Q, S + 1, 3), mm along the axes of the lens, are stopped by an
    aperture of each surface, (Q, S + 1); the stop's rim stops none, as it is filled."""
    hits = local_hits(lens, points)
    semi = np.asarray(lens.semi_diameter.at[lens.stop].set(jnp.inf))
    found = np.linalg.norm(hits, axis=-1) > semi
    if lens.apertures is not None:
        inside = depths(lens.apertures, tuple(jnp.asarray(a.T) for a in np.moveaxis(hits, -1, 0)))
        for surface, blocks, depth in zip(lens.apertures.surfaces, lens.apertures.blocks, inside):
            found[:, surface] |= (np.asarray(depth) > 0) == blocks
    return found


def local_hits(lens: Lens, points: np.ndarray) -> np.ndarray:
    """x and y (Q, S + 1, 2), along the axes of the surfaces and from their vertices, of points
    (Q, S + 1, 3) along the axes of the lens, mm."""
    vertex, across, turned = jax.tree.map(np.asarray, lens.places)
    across = np.zeros((len(vertex), 2)) if across is None else across
    own = points - np.concatenate([across, vertex[:, None]], axis=1)
    return (own if turned is None else np.einsum("qsi,sij->qsj", own, turned))[..., :2]


def _extents(lens: Lens, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest y (S,) of the surfaces, mm: of their semi-diameters or, where there is
    none, of their clear apertures; `reach` where there is none either."""
    semi, extra = np.asarray(lens.semi_diameter)[:-1], lens.apertures
    low, high = -semi, semi.copy()
    if extra is not None:
        half = np.asarray(extra.sizes)[:, 1]
        centre = 0 * half if extra.centre is None else np.asarray(extra.centre)[:, 1]
        for k, i in enumerate(extra.surfaces):
            if np.isinf(semi[i]) and not extra.blocks[k]:
                low[i] = max(low[i], centre[k] - half[k])
                high[i] = min(high[i], centre[k] + half[k])
    return np.where(np.isinf(low), -reach, low), np.where(np.isinf(high), reach, high)


def _pierced(lens: Lens, y: np.ndarray) -> np.ndarray:
    """Whether points (S, N) at x = 0 of all surfaces lie inside of an obscuration on them."""
    found = np.zeros(y.shape, bool)
    if lens.apertures is not None:
        inside = np.asarray(depths(lens.apertures, (jnp.zeros(y.shape), jnp.asarray(y)))) > 0
        for i, blocks, own in zip(lens.apertures.surfaces, lens.apertures.blocks, inside):
            found[i] |= blocks & own
    return found


def lens_drawing(axes: Axes, drawing: Drawing) -> Axes:
    """The polylines that `draw` gives, on the axes of a figure."""
    for outline in drawing.glass:
        axes.fill(*outline.T, facecolor="#cfe4f5", edgecolor="#30506b", linewidth=0.8)
    for mirror in drawing.mirrors:
        axes.plot(*mirror.T, color="#30506b", linewidth=2)
    for fan, colour in zip(drawing.rays, itertools.cycle(_FIELDS)):
        for ray in fan:
            axes.plot(*ray.T, color=colour, linewidth=0.6)
    for ray in drawing.vignetted:
        axes.plot(*ray.T, color="grey", linewidth=0.6, linestyle=":")
    for blade in drawing.stop:
        axes.plot(*blade.T, color="black", linewidth=2.5, solid_capstyle="butt", zorder=3)
    axes.plot(*drawing.sensor.T, color="black", linewidth=1.5)
    axes.set_aspect("equal")
    axes.set(xlabel="z from the first vertex (mm)", ylabel="y (mm)")
    return axes


def _placed(lens: Lens, i: int, y: np.ndarray, z: ArrayLike) -> np.ndarray:
    """(z, y) along the axes of the lens of points on surface i (or the sensor)."""
    vertex, across, turned = jax.tree.map(lambda a: np.asarray(a[i]), lens.places)
    points = np.stack([np.zeros_like(y), y, z], axis=-1)
    if turned is not None:
        points = points @ turned.T
    return points[:, :0:-1] + np.array([vertex, 0.0 if across is None else across[1]])


def _path(corners: np.ndarray, start: float, angle: float, distance: float) -> np.ndarray:
    """(z, y) of a ray from the plane `start` before the lens through its corners."""
    z, y = corners[0]
    slope = (y / distance + np.tan(angle)) / (z / distance + 1)
    return np.concatenate([[[start, y - slope * (z - start)]], corners])


def _blades(face: np.ndarray, reach: float) -> list[np.ndarray]:
    low, high = face[0], face[-1]
    outwards = (high - low) / np.linalg.norm(high - low) * 0.15 * reach
    return [np.stack([low, low - outwards]), np.stack([high, high + outwards])]


def _sensor(lens: Lens, paths: list[list[np.ndarray]], reach: float) -> np.ndarray:
    """As wide as the rays that meet it, about its centre."""
    middle = _placed(lens, lens.count, np.zeros(1), np.zeros(1))
    ends = [float(np.linalg.norm(path[-1] - middle)) for fan in paths for path in fan]
    wide = max(1.1 * max(ends, default=0.0), 0.3 * reach)
    return _placed(lens, lens.count, np.array([-wide, wide]), np.zeros(2))
