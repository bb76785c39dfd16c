"""Layout drawing: the outlines and rays of a lens as polylines in the (z, y) plane. Also the
clipping of the beam of a field by the apertures.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from ..compilation import ONCE, jit
from ..lens.aperture import depths
from ..lens.clearance import clearance, clipping_surface
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene
from ..lens.surface import by_form, surface_sag
from ..numerics import einsum, program
from ..pupil.patterns import hexapolar
from ..rays.rays import Rays, trace_rays
from ..rays.status import Status
from .figures import FIELD_COLOURS, scale_bar

_POINTS = 161
_RAYS = 640  # rays per trace, so that all traces share one compiled program
_RINGS, _RIM = 10, 240  # rings of rays that fill the stop, and number of rays on its rim
_SCANS = 3  # scans of the meridian for the edges of a beam; each refines the last one
_ON_RIM = 1e-6  # mm: a ray that misses an aperture by less only grazes it
# Words for rays that do not reach the sensor, other than those clipped by an aperture.
ENDS = {
    Status.MISSED: "some miss",
    Status.TIR: "total reflection",
    Status.UNCONVERGED: "no path",
    Status.NO_INDEX: "no index",
    Status.CROSSED: "surfaces cross",
}


class Drawing(NamedTuple):
    """Polylines (N, 2) of (z, y) in mm, in the section x = 0.

    glass: closed outlines of the elements.
    mirrors: faces of the mirrors; NaN where an obscuration covers one.
    stop: the two blades of the stop, drawn even where the stop cuts through a surface.
    sensor: the face of the sensor.
    rays: a list for each field: the arriving rays of an even fan from rim to rim of the stop and,
        of a vignetted beam, the rays at its edges.
    vignetted: clipped rays of the fans, up to the surface that clips them.
    fields: the angles of the fields, radians.
    numbers: the number of each surface that bends light, and the top (z, y) of its outline.
    """

    glass: list[np.ndarray]
    mirrors: list[np.ndarray]
    stop: list[np.ndarray]
    sensor: np.ndarray
    rays: list[list[np.ndarray]]
    vignetted: list[np.ndarray]
    fields: Sequence[float] = ()
    numbers: Sequence[tuple[int, np.ndarray]] = ()


def draw(lens: Lens, scene: Scene | None = None, rays: int = 7) -> Drawing:
    """The polylines of a lens and of a fan of meridional rays for each object point.

    scene: points with fields along y; their middle wavelength counts. By default the axis at
        infinity, in the d line.
    rays: number of rays for each point; rays that do not exist are left out.
    """
    scene = checked_scene(lens, Scene.point() if scene is None else scene)
    points, places = scene.each(), jax.tree.map(np.asarray, _places(lens))
    angles = [float(point.field[1]) for point in points]
    # A surface that does not bend light is neither a corner of a ray nor a face of glass.
    corners = [*lens.active, lens.count]
    hits, ends = [], []
    for point, angle in zip(points, angles, strict=True):
        fan = _fan(lens, point, rays)
        hits.append(fan.points[fan.status == Status.OK][:, corners, :0:-1])
        clipped = fan.status == Status.CLIPPED
        for ray, stop in zip(fan.points[clipped], fan.clips[clipped]):
            cut = [*(k for k in lens.active if k < stop), stop]
            ends.append((ray[cut, :0:-1], angle, float(point.distance)))
    drawn = np.concatenate([np.zeros((1, 2)), *(hit.reshape(-1, 2) for hit in hits)])
    reach = float(np.max(np.abs(drawn[:, 1]))) or 1.0
    z = np.concatenate([drawn[:, 0], places[0]])
    start = np.min(z) - 0.15 * np.ptp(z)
    paths = [
        [_path(ray, start, angle, float(point.distance)) for ray in hit]
        for angle, point, hit in zip(angles, points, hits, strict=True)
    ]
    vignetted = [_path(ray, start, *place) for ray, *place in ends]
    extents = _extents(lens, 1.1 * _widths(lens, hits, reach))
    profiles = np.linspace(*extents, _POINTS, axis=-1)
    sags = np.asarray(_sags(lens, profiles))
    faces = [_placed(places, i, y, sag) for i, (y, sag) in enumerate(zip(profiles, sags))]
    glass = [_outline(places, pair, profiles, sags, faces) for pair in _pieces(lens)]
    pierced = _pierced(lens, profiles)
    mirrors = [
        np.where(pierced[i, :, None], np.nan, faces[i]) for i in np.flatnonzero(lens.mirrors)
    ]
    low, high = faces[lens.stop][[0, -1]]
    outwards = (high - low) / np.linalg.norm(high - low) * 0.15 * reach
    blades = [np.stack([low, low - outwards]), np.stack([high, high + outwards])]
    # The face of the sensor about its centre, as wide as the rays that meet it.
    centre = _placed(places, lens.count, np.zeros(1), np.zeros(1))
    away = [float(np.linalg.norm(path[-1] - centre)) for fan in paths for path in fan]
    wide = max(1.1 * max(away, default=0.0), 0.3 * reach)
    sensor = _placed(places, lens.count, np.array([-wide, wide]), np.zeros(2))
    tops = {i: faces[i][-1, 1] for i in lens.active}
    for pair, outline in zip(_pieces(lens), glass):
        tops |= {i: max(tops[i], np.max(outline[:, 1])) for i in pair}
    numbers = [(i, np.array([faces[i][-1, 0], top])) for i, top in tops.items()]
    return Drawing(glass, mirrors, blades, sensor, paths, vignetted, angles, numbers)


@program
def _places(lens: Lens) -> tuple[jax.Array, jax.Array | None, jax.Array | None]:
    """`Lens.places`, compiled."""
    return lens.places


@program
def _sags(lens: Lens, profiles: jax.Array) -> jax.Array:
    """Sags (S, N) at the heights `profiles` (S, N), mm."""
    shape = jax.tree.map(lambda a: a[..., :-1, None], lens.shape)
    return by_form(surface_sag, (0 * profiles, profiles), shape, lens.forms[:-1])


def _outline(
    places: tuple,
    pair: tuple[int, int],
    profiles: np.ndarray,
    sags: np.ndarray,
    faces: list[np.ndarray],
) -> np.ndarray:
    """The closed outline of a piece of glass with one rim, as it is made: the narrower face is
    continued by a plane; or, where the faces would then cross, with the rims of its own faces.

    places: as in `_placed`.
    profiles, sags: (S, N), mm, heights of the points of the faces, and the sags there.
    """
    low, high = profiles[list(pair), 0].min(), profiles[list(pair), -1].max()
    wide = [np.concatenate([low[None], profiles[i], high[None]]) for i in pair]
    made = [_placed(places, i, y, np.pad(sags[i], 1, "edge")) for i, y in zip(pair, wide)]
    gaps = [made[1][end, 0] - made[0][end, 0] for end in (0, -1)]
    inside = faces[pair[1]][_POINTS // 2, 0] - faces[pair[0]][_POINTS // 2, 0]
    front, back = made if np.all(np.array(gaps) * inside > 0) else (faces[i] for i in pair)
    return np.concatenate([front, back[::-1], front[:1]])


class _Traced(NamedTuple):
    """Q rays of W wavelengths.

    points: (W, Q, S + 1, 3), mm along the axes of the lens. hits: (W, Q, S + 1, 2), x and y from
    the vertices, along the axes of the surfaces. directions: (W, Q, 3), at the sensor, along its
    axes. status: (W, Q). clips: (W, Q), the first surface whose aperture stops a clipped ray.
    """

    points: np.ndarray
    hits: np.ndarray
    directions: np.ndarray
    status: np.ndarray
    clips: np.ndarray


@functools.partial(jit, wanted=ONCE)
def _in_own_axes(lens: Lens, rays: Rays) -> tuple[jax.Array, ...]:
    """The parts of `_Traced`."""
    vertex, across, turned = lens.places
    across = jnp.zeros((len(vertex), 2), vertex.dtype) if across is None else across
    own = rays.points - jnp.concatenate([across, vertex[:, None]], axis=1)[None, None]
    directions = rays.directions[:, :, -1]
    if turned is not None:
        own = einsum("wqsi,sij->wqsj", own, turned)
        directions = directions @ turned[-1]
    clips = clipping_surface(lens, tuple(jnp.moveaxis(own, (3, 2), (0, 1))[:2]))
    return rays.points, own[..., :2], directions, rays.status, clips


def _traced(lens: Lens, scene: Scene, pupil: np.ndarray) -> _Traced:
    """Rays through points (Q, 2) of the stop, in units of its radius."""
    filled = np.resize(pupil, (-(-len(pupil) // _RAYS) * _RAYS, 2))
    found = _in_own_axes(lens, trace_rays(lens, scene, filled))
    return _Traced(*(np.asarray(a)[:, : len(pupil)] for a in found))


def _fan(lens: Lens, scene: Scene, rays: int) -> _Traced:
    """An even fan of meridional rays in the middle wavelength, (Q, ...), then the rays at the
    edges of the light that passes, where the rim of the stop is not the edge."""

    def traced(heights):
        found = _traced(lens, scene, np.stack([0 * heights, heights], axis=-1))
        return jax.tree.map(lambda a: a[scene.reference(None)], found)

    fan, heights = traced(np.linspace(-1.0, 1.0, rays)), np.linspace(-1.0, 1.0, _RAYS)
    for _ in range(_SCANS):
        found = traced(heights)
        good = found.status == Status.OK
        (last,) = np.nonzero(good[1:] != good[:-1])
        if not len(last):
            return fan
        edges = last + good[last + 1]
        pairs = zip(heights[last], heights[last + 1])
        heights = np.concatenate([np.linspace(*pair, _RAYS // len(last)) for pair in pairs])
    return _Traced(*(np.concatenate([a, b[edges]]) for a, b in zip(fan, found)))


class Beam(NamedTuple):
    """Clipping and spot of the light of one field and wavelength that fills the stop.

    clipping: surfaces whose apertures clip rays that no earlier surface clips.
    ends: other failures of rays, in words.
    obscured: True if obscurations alone clip.
    wide: (S + 1,), largest distance of arriving rays from each vertex, mm; 0 if none arrives.
    share: part of the rays in the middle wavelength that arrive.
    spot: RMS radius on the sensor, mm; nan if no light arrives. best, shift: the smallest RMS
        radius at any sensor position, and how far that position is behind the sensor, mm.
    """

    clipping: list[int]
    ends: list[str]
    obscured: bool
    wide: np.ndarray
    share: float
    spot: float
    best: float
    shift: float

    @property
    def clips(self) -> bool:
        """Whether some of the light does not arrive."""
        return bool(self.clipping or self.ends)


def beam_of(lens: Lens, scene: Scene) -> Beam:
    """The beam of one object point: its spot in the middle wavelength, and the clipping and
    failures in all wavelengths."""
    scene, middle = checked_scene(lens, scene), scene.reference(None)
    rim = np.linspace(0, 2 * np.pi, _RIM)
    pupil = np.concatenate([hexapolar(_RINGS)[0], np.stack([np.sin(rim), np.cos(rim)], axis=-1)])
    _, hits, directions, status, clips = _traced(lens, scene, pupil)
    arrives, clipped = status == Status.OK, status == Status.CLIPPED
    clipping = np.unique(clips[clipped]).tolist()
    ends = [words for end, words in ENDS.items() if np.any(status == end)]
    obscured = _obscured(lens, hits[clipped])
    wide = np.max(np.linalg.norm(hits[arrives], axis=-1), axis=0, initial=0.0)
    inside = arrives[middle] & (np.arange(len(pupil)) < len(pupil) - _RIM)
    share = float(np.sum(inside)) / (len(pupil) - _RIM)
    if not share:
        return Beam(clipping, ends, obscured, wide, share, math.nan, math.nan, math.nan)
    hits, slopes = hits[middle, inside, -1], directions[middle, inside]
    hits, slopes = (a - a.mean(axis=0) for a in (hits, slopes[:, :2] / slopes[:, 2:]))
    size, growth = np.mean(np.sum(hits**2, axis=1)), np.mean(np.sum(slopes**2, axis=1))
    shift = -np.mean(np.sum(hits * slopes, axis=1)) / growth if growth > 0 else 0.0
    best = math.sqrt(max(size - growth * shift**2, 0.0))
    return Beam(clipping, ends, obscured, wide, share, math.sqrt(size), best, float(shift))


def beam_hits(lens: Lens, scene: Scene) -> np.ndarray:
    """Hits (W, Q, S + 1, 2) on all surfaces and the sensor, mm from their vertices, of rays evenly
    over the stop from one object point, so that their density is that of the light; inf for those
    that do not arrive."""
    found = _traced(lens, checked_scene(lens, scene), hexapolar(_RINGS)[0])
    return np.where((found.status == Status.OK)[..., None, None], found.hits, np.inf)


def _obscured(lens: Lens, hits: np.ndarray) -> bool:
    """Whether obscurations alone clip rays with hits (Q, S + 1, 2), mm."""
    blocks = () if lens.apertures is None else lens.apertures.blocks
    if not any(blocks) or not len(hits):
        return False
    edges = clearance(lens, (jnp.asarray(hits[..., 0].T), jnp.asarray(hits[..., 1].T)))
    clear = np.append(np.full(lens.count + 1, True), ~np.array(blocks))
    return not np.any(np.asarray(edges)[clear] < -_ON_RIM)  # a ray at the rim of the stop grazes


def _pieces(lens: Lens) -> list[tuple[int, int]]:
    """The two surfaces of each piece of glass."""
    pairs = itertools.pairwise(lens.active)
    return [(i, j) for i, j in pairs if lens.glasses[i + 1] != lens.glasses[0]]


def _widths(lens: Lens, hits: list[np.ndarray], reach: float) -> np.ndarray:
    """Largest ray heights (S,), mm; both faces of a piece of glass get the larger one. `reach` if
    surfaces are decentred or tilted, or where no ray arrives."""
    wide, moved = np.full(lens.count, reach), (lens.decentre, lens.tilt, lens.elements)
    if jax.tree.leaves(moved) or not sum(map(len, hits)):
        return wide
    wide[list(lens.active)] = np.max(np.abs(np.concatenate(hits)[:, :-1, 1]), axis=0)
    pieces = _pieces(lens)
    for i, j in pieces + pieces[::-1]:  # both ways, so that cemented pieces get one width
        wide[[i, j]] = np.max(wide[[i, j]])
    return np.where(wide > 0, wide, reach)


def _extents(lens: Lens, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest y (S,) of the surfaces, mm: from the semi-diameter, else from the clear
    aperture, else from `reach` (S,)."""
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
    """True for points (S, N) of the surfaces, at x = 0, inside an obscuration on the surface."""
    found = np.zeros(y.shape, bool)
    if lens.apertures is not None:
        inside = np.asarray(depths(lens.apertures, (jnp.zeros(y.shape), jnp.asarray(y)))) > 0
        for i, blocks, own in zip(lens.apertures.surfaces, lens.apertures.blocks, inside):
            found[i] |= blocks & own
    return found


def lens_drawing(axes: Axes, drawing: Drawing, half: bool = False) -> Axes:
    """Draw the polylines of `draw` on the axes of a figure.

    half: True for a half section, the part above the axis.
    """
    for outline in drawing.glass:
        axes.fill(*outline.T, facecolor="#cfe4f5", edgecolor="#30506b", linewidth=0.8)
    for mirror in drawing.mirrors:
        axes.plot(*mirror.T, color="#30506b", linewidth=2)
    for fan, colour in zip(drawing.rays, itertools.cycle(FIELD_COLOURS)):
        for ray in fan:
            axes.plot(*ray.T, color=colour, linewidth=0.6)
    if len(drawing.fields) > 1:
        for field, colour in zip(drawing.fields, itertools.cycle(FIELD_COLOURS)):
            axes.plot([], [], color=colour, label=f"{math.degrees(field):.4g}°")
        axes.legend(
            title="field", fontsize=8, title_fontsize=8, loc="upper left", bbox_to_anchor=(1, 1)
        )
    for ray in drawing.vignetted:
        axes.plot(*ray.T, color="grey", linewidth=0.6, linestyle=":")
    for blade in drawing.stop:
        axes.plot(*blade.T, color="black", linewidth=2.5, solid_capstyle="butt", zorder=3)
    axes.plot(*drawing.sensor.T, color="black", linewidth=1.5)
    for number, (z, y) in drawing.numbers:
        style: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "fontsize": 6}
        axes.annotate(str(number), (z, y), (0, 2 + 6 * (number % 2)), **style)
    axes.set_aspect("equal")
    axes.margins(y=0.1)
    axes.set(xlabel="z from the first vertex (mm)", ylabel="y (mm)")
    if half:
        axes.set_ylim(bottom=0)
    return scale_bar(axes, "mm")


def _placed(places: tuple, i: int, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(z, y), along the axes of the lens, of points on surface i (or the sensor). places:
    `Lens.places` as NumPy arrays."""
    vertex, across, turned = jax.tree.map(lambda a: a[i], places)
    points = np.stack([np.zeros_like(y), y, z], axis=-1)
    if turned is not None:
        points = points @ turned.T
    return points[:, :0:-1] + np.array([vertex, 0.0 if across is None else across[1]])


def _path(corners: np.ndarray, start: float, angle: float, distance: float) -> np.ndarray:
    """(z, y) of a ray through its corners, from the plane `start` before the lens. The first
    segment of a steep ray is cut to twice the distance to that plane."""
    z, y = corners[0]
    slope = (y / distance + np.tan(angle)) / (z / distance + 1)
    step = (z - start) * min(1.0, 2 / math.hypot(1.0, slope))
    return np.concatenate([[[z - step, y - slope * step]], corners])
