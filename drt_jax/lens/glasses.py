"""The table of the makers' glasses: by name and maker, by nd and vd, and the hull of its map.

Written by tools/glasses.py, whose head tells sources and form. It is read when a glass is asked
for, line by line what is needed.
"""

import difflib
import functools
import gzip
import pathlib
from collections.abc import Collection
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from .glass import FRAUNHOFER, POWERS, Glass

_TABLE = pathlib.Path(__file__).parent / "catalogue" / "glasses.txt.gz"
# In the plane of nd and vd a difference of 100 of vd counts as one of 1 of nd: the weights, 1 and
# 1e-4 of squares, that Zemax has by default where it replaces model glasses.
_PER_VD = 0.01


class _Entry(NamedTuple):
    """A line of the table: whether its name means it where no maker is given, its maker, the
    temperature in C, its source, and its constants as text."""

    plain: bool
    maker: str
    celsius: str
    source: str
    constants: str


class Neighbour(NamedTuple):
    """A glass of the table with nd, vd, and how far it is from what was asked for: in units of nd,
    100 of vd as one."""

    glass: Glass
    nd: float
    vd: float
    distance: float


@functools.cache
def _table() -> dict[str, list[_Entry]]:
    """All lines by name; the plain one first."""
    table: dict[str, list[_Entry]] = {"air": [_Entry(True, "", "", "", "0.0001 1000000\t\t")]}
    head = ["", "", ""]
    for line in gzip.decompress(_TABLE.read_bytes()).decode().split("\n"):
        if line.startswith("#"):
            head = line[1:].split("\t")
            continue
        name, _, constants = line.partition("\t")
        entry = _Entry(name.startswith("*"), head[0], head[1], head[2], constants)
        entries = table.setdefault(name.removeprefix("*"), [])
        entries.insert(0 if entry.plain else len(entries), entry)
    return table


@functools.cache
def glass_makers() -> tuple[str, ...]:
    """The makers of the table, and Zemax's catalogues MISC and INFRARED."""
    found = {entry.maker for entries in _table().values() for entry in entries}
    return tuple(sorted(found - {""}))


def _glass(name: str, entry: _Entry) -> Glass:
    """A glass by the shortest name that finds it."""
    low_high, sellmeier, schott = (
        tuple(map(float, part.split())) for part in entry.constants.split("\t")
    )
    entries = _table()[name]
    alone = entry is entries[0] if entries[0].plain else not _differ(entries)
    return Glass(
        name if alone else f"{name}_{entry.maker}",
        sellmeier or Glass.sellmeier,
        schott or Glass.schott,
        (low_high[0], low_high[1]),
        maker=entry.maker,
        source=f"{entry.source}; at {entry.celsius} C" if entry.celsius else entry.source,
    )


def _differ(entries: list[_Entry]) -> bool:
    """Whether glasses of one name have different constants, or hold for different ranges."""
    return len({entry.constants for entry in entries}) > 1


def _all() -> list[tuple[str, _Entry]]:
    """All glasses but for air."""
    return [(n, e) for n, entries in _table().items() for e in entries if n != "air"]


@functools.cache
def glass_names() -> tuple[str, ...]:
    """Names that `find_glass` knows, NAME_MAKER where a name is not enough; plain ones first."""
    ordered = sorted(_all(), key=lambda own: not own[1].plain)
    return ("air", *dict.fromkeys(_glass(name, entry).name for name, entry in ordered))


def find_glass(name: str, maker: str | None = None) -> Glass:
    """The glass of a name, and maker. ValueError, listing near names, if there is none, and naming
    the makers, if several have different glasses of this name.

    Names are exact: SK16 and N-SK16 are two glasses. Without a maker, names of Schott's catalogue
    of 2017 mean Schott's glass, SK2 and SK16 Hikari's. Source: `Glass.source`.

    name: as the maker writes it; "SK16_SCHOTT" is SK16 of SCHOTT.
    maker: of `glass_makers()`; None: any.
    """
    table = _table()
    plain, _, after = name.rpartition("_")
    if maker is None and name not in table and plain in table:
        name, maker = plain, after
    if maker is not None and maker.upper() not in glass_makers():
        raise ValueError(
            f"glass {name!r}: unknown maker {maker!r}; makers: {', '.join(glass_makers())}"
        )
    entries = table.get(name, [])
    found = [entry for entry in entries if maker is None or entry.maker == maker.upper()]
    if not found and entries:
        raise ValueError(f"glass {name!r} is not of {maker} but of {_makers(entries)}")
    if not found:
        near = near_names(name)
        hint = f"near names: {', '.join(near)}" if near else "no near name"
        raise ValueError(f"unknown glass {name!r}; {hint}")
    if not found[0].plain and _differ(found):
        raise ValueError(
            f"glass {name!r} is of several makers, {_makers(found)}, with different constants; "
            f"give one, as {name}_{found[0].maker}"
        )
    return _glass(name, found[0])


def _makers(entries: list[_Entry]) -> str:
    return ", ".join(entry.maker or "no maker" for entry in entries)


@functools.cache
def _folded() -> dict[str, list[str]]:
    folded: dict[str, list[str]] = {}
    for name in _table():
        folded.setdefault(name.lower(), []).append(name)
    return folded


def spellings(name: str) -> list[str]:
    """Names of the table that differ by capitals alone."""
    return _folded().get(name.lower(), [])


def near_names(name: str, count: int = 6) -> list[str]:
    """Names that `find_glass` knows and that look like `name`."""
    folded, name = _folded(), name.lower()
    near = difflib.get_close_matches(name, folded, n=count, cutoff=0.5)
    near += [known for known in folded if name in known and known not in near]
    entries = ((own, entry) for at in near for own in folded[at] for entry in _table()[own])
    return [*dict.fromkeys(_glass(own, entry).name for own, entry in entries)][:count]


def indices(glass: Glass, wavelengths: np.ndarray) -> np.ndarray:
    """The index (W,) of a glass of the table at wavelengths (W,) in um, in float64, without JAX."""
    square = np.square(wavelengths)
    b, c = np.reshape(glass.sellmeier, (2, -1, 1))
    powers = square[:, None] ** (np.array(POWERS[: len(glass.schott)]) / 2)
    terms = np.sum(b * square / (square - c), axis=0)
    return np.sqrt(terms + powers @ np.asarray(glass.schott, float))


@functools.cache
def _mapped() -> tuple[list[tuple[Glass, bool]], np.ndarray]:
    """Solids that are known at the lines F and C, and whether each is plain, with nd and vd."""
    found, points = [], []
    for name, entry in _all():
        glass = _glass(name, entry)
        low, high = glass.range
        if low <= FRAUNHOFER[1] and high >= FRAUNHOFER[2] and name.lower() != "water":
            nd, f, c = indices(glass, np.array(FRAUNHOFER[:3]))
            if f > c:
                found.append((glass, entry.plain))
                points.append((nd, (nd - 1) / (f - c)))
    return found, np.array(points)


def nearest_glasses(
    nd: float, vd: float, makers: Collection[str] | None = None, count: int = 10
) -> list[Neighbour]:
    """Glasses next to nd and vd in the glass map, the nearest first.

    The distance is that of nd and vd / 100. ValueError for unknown makers.

    makers: of `glass_makers()`; None: of all.
    count: how many, at most.
    """
    wanted = None if makers is None else {maker.upper() for maker in makers}
    for maker in sorted((wanted or set()) - {*glass_makers()}):
        raise ValueError(f"unknown maker {maker!r}; makers: {', '.join(glass_makers())}")
    glasses, points = _mapped()
    away = np.hypot(points[:, 0] - nd, _PER_VD * (points[:, 1] - vd))
    own = [
        Neighbour(glasses[i][0], float(points[i, 0]), float(points[i, 1]), float(away[i]))
        for i in np.argsort(away, kind="stable")
        if wanted is None or glasses[i][0].maker in wanted
    ]
    return own[:count]


@functools.cache
def _glass_map() -> tuple[np.ndarray, np.ndarray]:
    """The edges of the convex hull of the plain glasses but for water, in nd and scaled vd: their
    normals (E, 2), outwards, and how far they are from the origin (E,)."""
    glasses, found = _mapped()
    plain = found[[plain for _, plain in glasses]] * (1, _PER_VD)
    points: list[tuple[float, float]] = [(nd, vd) for nd, vd in plain.tolist()]
    corners: list[tuple[float, float]] = []
    for ordered in (sorted(points), sorted(points, reverse=True)):  # below, then above
        half: list[tuple[float, float]] = []
        for x, y in ordered:
            while len(half) > 1 and _left_of(half[-2], half[-1], (x, y)) <= 0:
                half.pop()
            half.append((x, y))
        corners += half[:-1]
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return normals, np.sum(normals * corners, axis=1)


def _left_of(a: tuple[float, float], b: tuple[float, float], point: tuple[float, float]) -> float:
    """Above 0 for a point to the left of the way from a to b."""
    return (b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])


def glass_map_distance(model: Array) -> Array:
    """How far glasses of nd and vd (G, 2) lie outside of the convex hull of the plain glasses, but
    for water: (G,), from its farthest edge, negative within, in units of nd, 100 of vd as one.
    """
    normals, away = (jnp.asarray(a, model.dtype) for a in _glass_map())
    scaled = model * jnp.array([[1, _PER_VD]], model.dtype)
    return jnp.max(scaled @ normals.T - away[None], axis=1)
