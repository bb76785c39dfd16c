"""Semi-diameters, apertures and obscurations of the surfaces of a prescription."""

import math
from typing import NamedTuple

import numpy as np

from ..lens.aperture import Apertures
from ..lens.forms import FORMS
from ..lens.polygon import CORNERS, convex_pieces, tidied
from ..numerics import array
from .entry import Entry

KINDS = ("circle", "ellipse", "rectangle", "polygon")
_MOST = 6  # obscurations per lens: n of them multiply the number of rays by 2^n
_TERMS = 64  # largest such factor, with polygons of several convex pieces
_MANY = 20  # apertures per surface


class _Aperture(NamedTuple):
    """One aperture or obscuration. half, centre: mm along x and y; centre is empty if not given.
    corners: (N, 2), mm from the centre, and pieces of a polygon; empty for others."""

    entry: Entry
    kind: str
    half: list[float]
    centre: list[float]
    corners: np.ndarray
    pieces: tuple[tuple[int, ...], ...]

    @property
    def reach(self) -> float:
        """The largest distance of its edge from the vertex, mm."""
        if self.kind == "polygon":
            return float(np.max(np.hypot(*(self.corners + (self.centre or 0)).T)))
        x, y = (abs(c) for c in self.centre or (0.0, 0.0))
        if self.kind == "rectangle":
            return math.hypot(x + self.half[0], y + self.half[1])
        return math.hypot(x, y) + max(self.half)


def _read(surface: Entry, key: str) -> list[_Aperture]:
    """The shapes of the key `aperture` or `obscuration`, which holds one mapping or a list."""
    given = surface.get(key, [])
    many = isinstance(given, list)
    if many:
        surface.require(len(given) <= _MANY, key, f"{len(given)} are more than {_MANY}")
    found = []
    for i, values in enumerate(given if many else [given]):
        entry = Entry(values, surface.name(key) + f"[{i}]" * many, (*KINDS, "centre"))
        kinds = [kind for kind in KINDS if kind in entry]
        entry.require(len(kinds) == 1, "", f"give one of {', '.join(KINDS)}")
        (kind,) = kinds
        centre = entry.vector("centre", 2)
        if kind == "polygon":
            found.append(_Aperture(entry, kind, [1.0, 1.0], centre, *_polygon(entry)))
            continue
        half = [entry.number(kind)] * 2 if kind == "circle" else entry.vector(kind, 2)
        entry.require(half and min(half) > 0, kind, "must be positive, in mm")
        found.append(_Aperture(entry, kind, half, centre, np.zeros((0, 2)), ()))
    return found


def _polygon(entry: Entry) -> tuple[np.ndarray, tuple[tuple[int, ...], ...]]:
    """Corners (N, 2), mm, and convex pieces of the entry `polygon`."""
    rows = entry["polygon"]
    if not isinstance(rows, list | tuple) or not 3 <= len(rows) <= CORNERS:
        raise entry.error("polygon", f"expected 3 to {CORNERS} corners [x, y], mm, in their order")
    each = Entry(dict(enumerate(rows)), entry.name("polygon"), range(len(rows)))
    with entry.naming("polygon"):
        corners = tidied(np.array([each.vector(i, 2) for i in each]))
        pieces = convex_pieces(corners)
    return corners, pieces


def _check_reach(surface: Entry, entry: Entry, key: str, reach: float) -> None:
    bent = (1 + surface.number("conic", 0.0)) * surface.curvature() ** 2
    if FORMS[surface.get("form", "asphere")].round and bent * reach**2 >= 1:
        beyond = f"{reach:g} mm reaches beyond the surface, which ends at {bent**-0.5:g} mm"
        raise entry.error(key, f"{beyond}; lower it, or the curvature")


def semi_diameter(surface: Entry) -> float:
    """The clear semi-diameter about the vertex, mm, within the domain of the sag. That of the stop
    is finite: if it is not given, it is the radius of a circle around the smallest aperture of the
    stop."""
    semi = surface.positive("semi_diameter", math.inf, finite=False)
    if math.isinf(semi) and surface.flag("stop"):
        semi = min((own.reach for own in _read(surface, "aperture")), default=math.inf)
        surface.require(math.isfinite(semi), "semi_diameter", "the stop needs one, or an aperture")
    if math.isfinite(semi):
        _check_reach(surface, surface, "semi_diameter", semi)
    return semi


def apertures_of(surfaces: list[Entry]) -> Apertures | None:
    """All apertures and obscurations of the surfaces; None if there are none.

    Obscurations and polygons of several convex pieces make the open area a sum of terms, see
    `Apertures.terms`. Each term is traced with its own rays, so that their number is limited.
    """
    found = [
        (i, key == "obscuration", own)
        for i, surface in enumerate(surfaces)
        for key in ("aperture", "obscuration")
        for own in _read(surface, key)
    ]
    for i, blocks, own in found:
        if not blocks:
            _check_reach(surfaces[i], own.entry, own.kind, own.reach)
    blocked = [own.entry for _, blocks, own in found if blocks]
    if len(blocked) > _MOST:
        raise blocked[_MOST].error("", f"a lens has {_MOST} obscurations at most; join some")
    if not found:
        return None
    places, blocking, shapes = zip(*found, strict=True)
    centres, most = [own.centre for own in shapes], max(len(own.corners) for own in shapes)
    corners = [np.pad(own.corners, ((0, most - len(own.corners)), (0, 0))) for own in shapes]
    apertures = Apertures(
        array([own.half for own in shapes]),
        array([centre or [0.0, 0.0] for centre in centres]) if any(centres) else None,
        array(corners) if most else None,
        surfaces=places,
        kinds=tuple(own.kind for own in shapes),
        blocks=blocking,
        pieces=tuple(own.pieces for own in shapes),
    )
    times = len(apertures.terms()[0])
    what = f"the apertures of the lens need {times} sets of rays, {_TERMS} at most"
    what = f"{what}: join some, or give polygons fewer inward corners"
    surfaces[0].require(times <= _TERMS, "", what)
    return apertures
