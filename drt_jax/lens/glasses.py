"""The table of the makers' glasses: by name and maker, by nd and vd, and the glass map.

tools/glasses.py writes the table and describes its sources and form.
"""

import dataclasses
import difflib
import functools
import gzip
import itertools
import pathlib
from collections.abc import Collection
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..numerics import matmul
from .glass import FRAUNHOFER, POWERS, Glass

_TABLE = pathlib.Path(__file__).parent / "catalogue" / "glasses.txt.gz"
# Distances in the glass map are in units of nd, where 100 of vd count as 1 of nd. These are Zemax's
# default weights (1 and 1e-4 of squares) for the replacement of model glasses.
_PER_VD = 0.01


class _Entry(NamedTuple):
    """A glass of the table. plain: True if the name without a maker means this glass."""

    plain: bool
    glass: Glass


class Neighbour(NamedTuple):
    """A glass of the table, with its nd and vd and its distance from a point of the glass map.

    The distance is in units of nd, where 100 of vd count as 1.
    """

    glass: Glass
    nd: float
    vd: float
    distance: float


@functools.cache
def _table() -> dict[str, list[_Entry]]:
    """The glasses of each name without a maker; the one that the name alone means comes first.

    Each glass has the shortest name by which `find_glass` finds it: the name alone, or NAME_MAKER.
    """
    table = {"air": [_Entry(True, Glass("air"))]}
    maker = source = celsius = ""
    for line in gzip.decompress(_TABLE.read_bytes()).decode().split("\n"):
        if line.startswith("#"):
            maker, celsius, source = line[1:].split("\t")[:3]
            source = f"{source}; at {celsius} C" if celsius else source
            continue
        marked, *constants, status = line.split("\t")
        numbers = [tuple(map(float, part.split())) for part in constants]
        ends, sellmeier, schott, thermal, expansion = numbers
        name, plain = marked.removeprefix("*"), marked.startswith("*")
        entries = table.setdefault(name, [])
        glass = Glass(
            name,
            sellmeier or Glass.sellmeier,
            schott or Glass.schott,
            (ends[0], ends[1]),
            maker=maker,
            source=source,
            thermal=thermal,
            expansion=expansion[0] if expansion else None,
            celsius=float(celsius or 20),
            status=status,
        )
        entries.insert(0 if plain else len(entries), _Entry(plain, glass))
    for name, entries in table.items():
        differ = len({(g.sellmeier, g.schott, g.range) for _, g in entries}) > 1
        for k, (plain, glass) in enumerate(entries):
            if not plain and (differ or entries[0].plain):
                entries[k] = _Entry(plain, dataclasses.replace(glass, name=f"{name}_{glass.maker}"))
    return table


@functools.cache
def glass_makers() -> tuple[str, ...]:
    """Makers in the table, including Zemax's catalogues MISC and INFRARED."""
    found = {entry.glass.maker for entries in _table().values() for entry in entries}
    return tuple(sorted(found - {""}))


def _known_maker(maker: str, what: str = "") -> str:
    """A maker in capitals. ValueError, whose message begins with `what`, for an unknown one."""
    makers = glass_makers()
    require(maker.upper() in makers, f"{what}unknown maker {maker!r}; makers: {', '.join(makers)}")
    return maker.upper()


@functools.cache
def glass_names() -> tuple[str, ...]:
    """Names of all glasses, NAME_MAKER where a name is ambiguous; plain names first."""
    entries = sorted(itertools.chain(*_table().values()), key=lambda entry: not entry.plain)
    return tuple(dict.fromkeys(entry.glass.name for entry in entries))


def find_glass(name: str, maker: str | None = None) -> Glass:
    """Finds a glass by name.

    Names are exact: SK16 and N-SK16 are two glasses. Without a maker, names in Schott's catalogue
    of 2017 mean Schott's glass; SK2 and SK16 mean Hikari's. For its source see `Glass.source`.

    name: as the maker writes it; "SK16_SCHOTT" is SK16 of SCHOTT.
    maker: one of `glass_makers()`; None for any.

    ValueError for an unknown name (the message lists similar names), and for a name of several
    makers with different glasses (it lists the makers).
    """
    table = _table()
    plain, _, after = name.rpartition("_")
    if maker is None and name not in table and plain in table:
        name, maker = plain, after
    maker = None if maker is None else _known_maker(maker, f"glass {name!r}: ")
    if name not in table:
        near = ", ".join(near_names(name))
        hint = f"near names: {near}" if near else "no near name"
        raise ValueError(f"unknown glass {name!r}; {hint}")
    glasses = [entry.glass for entry in table[name]]
    of = ", ".join(glass.maker or "no maker" for glass in glasses)
    found = [glass for glass in glasses if maker is None or glass.maker == maker]
    require(found, f"glass {name!r} is not of {maker} but of {of}")
    several = f"glass {name!r} is of several makers, {of}, with different constants; give one, as "
    require(maker is not None or found[0].name == name, several + found[0].name)
    return found[0]


def plain_names() -> list[str]:
    """Names in the table, without makers."""
    return [*_table()]


def spellings(name: str) -> list[str]:
    """Names in the table that differ from a name only in upper and lower case."""
    return [own for own in _table() if own.lower() == name.lower()]


def near_names(name: str, count: int = 6) -> list[str]:
    """At most `count` names of glasses that look like `name`."""
    folded, name = dict.fromkeys(own.lower() for own in _table()), name.lower()
    near = difflib.get_close_matches(name, folded, n=count, cutoff=0.5)
    near += [known for known in folded if name in known and known not in near]
    alike = [own for known in near[:count] for own in spellings(known)]
    names = (entry.glass.name for own in alike for entry in _table()[own])
    return [*dict.fromkeys(names)][:count]


def indices(glass: Glass, wavelengths: np.ndarray) -> np.ndarray:
    """Index (W,) of a glass of the table in float64, without JAX.

    wavelengths: (W,), um.
    """
    square = np.square(wavelengths)
    b, c = np.reshape(glass.sellmeier, (2, -1, 1))
    powers = square[:, None] ** (np.array(POWERS[: len(glass.schott)]) / 2)
    terms = np.sum(b * square / (square - c), axis=0)
    return np.sqrt(terms + powers @ np.asarray(glass.schott, float))


def flaw(glass: Glass) -> str:
    """Why the constants of a glass give no index above 1 within its range; empty if they do."""
    low, high = glass.range
    strength, resonance = np.reshape(glass.sellmeier, (2, -1))
    for c in resonance[strength != 0]:
        if low**2 <= c <= high**2:
            return f"C = {c:g} um^2 lies within the range; narrow it"
    waves = np.linspace(low, high, 257)
    with np.errstate(all="ignore"):
        wrong = waves[~(indices(glass, waves) > 1)]
    remedy = "mend the constants or the range"
    return f"no index above 1 at {wrong[0]:g} um; {remedy}" if len(wrong) else ""


def map_point(glass: Glass) -> tuple[float, float] | None:
    """nd and vd of a glass of the table.

    None if its range does not contain the lines F, d and C, or if it has no dispersion.
    """
    if glass.range[0] > FRAUNHOFER[1] or glass.range[1] < FRAUNHOFER[2]:
        return None
    d, f, c = indices(glass, np.array(FRAUNHOFER[:3])).tolist()
    return (d, (d - 1) / (f - c)) if f > c else None


@functools.cache
def _mapped() -> tuple[list[_Entry], np.ndarray]:
    """All solids that have nd and vd; and their nd and vd (G, 2)."""
    solids = (own for name, own in _table().items() if name.lower() not in ("air", "water"))
    each = ((entry, map_point(entry.glass)) for entry in itertools.chain(*solids))
    entries, points = zip(*((entry, point) for entry, point in each if point), strict=True)
    return [*entries], np.array(points)


def nearest_glasses(
    nd: float, vd: float, makers: Collection[str] | None = None, count: int | None = 10
) -> list[Neighbour]:
    """The glasses nearest to nd and vd in the glass map, the nearest first.

    The distance is that of the points (nd, vd / 100).

    nd, vd: index at the d line, and Abbe number.
    makers: some of `glass_makers()`; None for all. ValueError for unknown makers.
    count: largest number of glasses; None for all.
    """
    only = None if makers is None else {*map(_known_maker, makers)}
    entries, points = _mapped()
    away = np.hypot(points[:, 0] - nd, _PER_VD * (points[:, 1] - vd))
    own = [
        Neighbour(entries[i].glass, float(points[i, 0]), float(points[i, 1]), float(away[i]))
        for i in np.argsort(away, kind="stable")
        if only is None or entries[i].glass.maker in only
    ]
    return own[:count]


@functools.cache
def _glass_map() -> np.ndarray:
    """Convex hull of the plain glasses except water in nd and vd / 100.

    Returns (E, 3): the outward normal of each edge, and the signed distance of the origin from it.
    """
    from scipy.spatial import ConvexHull  # takes half a second to import

    entries, points = _mapped()
    return ConvexHull(points[[entry.plain for entry in entries]] * (1, _PER_VD)).equations


def glass_map_distance(model: Array) -> Array:
    """Distance (G,) of glasses from the convex hull of the plain glasses except water.

    It is negative inside, in units of nd, where 100 of vd count as 1: the largest signed distance
    from an edge.

    model: (G, 2), nd and vd.
    """
    edges = jnp.asarray(_glass_map(), model.dtype)
    scaled = model * jnp.array([[1, _PER_VD]], model.dtype)
    return jnp.max(matmul(scaled, edges[:, :2].T) + edges[None, :, 2], axis=1)
