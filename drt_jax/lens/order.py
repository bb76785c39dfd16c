"""Neighbouring surfaces that cross, so that light would have to travel backwards between them."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from .forms import Shape
from .lens import Lens
from .surface import surface_sag

# Overlap at the rims up to which surfaces only touch, mm: apertures of prescriptions are rounded.
_TOUCH = 1e-4
# Number of heights where sags are compared.
_HEIGHTS = 257
# Number of surfaces of a form in one call. The rest is filled with repeated surfaces, so that all
# lenses share a compiled program.
_TOGETHER = 32
_sag = jax.jit(surface_sag, static_argnums=2)


class Pair(NamedTuple):
    """Two neighbouring active surfaces, or the last one and the sensor.

    first, second: their indices; that of the sensor is S.
    gap: distance between their vertices along the light, mm.
    """

    first: int
    second: int
    gap: float


def neighbours(lens: Lens, gaps: list[float], moved: list[bool]) -> list[Pair]:
    """The pairs of a lens that must keep their order.

    A dummy stop may lie anywhere, because the straight ray between its neighbours is extended to
    it. Pairs that are decentred or tilted against each other are left out, because their order on
    the axis may differ from that along the light.

    gaps: from each surface to the next, and from the last one to the sensor, mm.
    moved: for each surface and the sensor, True if it is decentred or tilted by itself.
    """
    groups = () if lens.elements is None else lens.elements.spans
    separated = lambda i, j: any((a <= i <= b) != (a <= j <= b) for a, b in groups)  # noqa: E731
    chain = itertools.pairwise([*(lens.active or (lens.stop,)), lens.count])
    senses = lens.senses.tolist()
    return [
        Pair(i, j, senses[i + 1] * sum(gaps[i:j]))
        for i, j in chain
        if not (moved[i] or moved[j] or separated(i, j))
    ]


def heights(lens: Lens, pairs: Sequence[Pair]) -> tuple[np.ndarray, np.ndarray]:
    """Sags of the surfaces of P pairs at the same heights from the axis.

    Returns the heights (P, Y), up to the smaller semi-diameter of the pair, and the sags (P, 2, Y)
    of both surfaces there, mm. Pairs without apertures have only heights of 0.
    """
    rows = np.array([pair[:2] for pair in pairs], int).reshape(-1, 2)
    semi = np.asarray(lens.semi_diameter)
    sags = np.zeros((*rows.shape, _HEIGHTS), semi.dtype)
    rim = np.min(semi[rows], axis=1)
    y = np.linspace(0, np.where(np.isinf(rim), 0, rim), _HEIGHTS, axis=1, dtype=semi.dtype)
    terms = np.asarray(lens.coefficients).T
    shape = Shape(*(np.asarray(a)[..., None] for a in (lens.curvature, lens.conic, terms)))  # type: ignore[arg-type]
    for form in set(lens.forms):
        places = np.argwhere(np.array(lens.forms)[rows] == form)
        for start in range(0, len(places), _TOGETHER):
            which, end = np.resize(places[start : start + _TOGETHER], (_TOGETHER, 2)).T
            own = jax.tree.map(lambda a, k=rows[which, end]: a[..., k, :], shape)
            sags[which, end] = _sag((0 * y[which], y[which]), own, form)
    return y, sags


def crossings(lens: Lens, pairs: Sequence[Pair]) -> list[float | None]:
    """The smallest height at which each pair of neighbours crosses inside of both apertures, mm.

    It is 0 if their vertices are in the wrong order, and None if they do not cross. The sensor
    crosses nothing: where it lies in front of the last surface, the image is virtual.
    """
    semi, senses, found = np.asarray(lens.semi_diameter), lens.senses, []
    for pair, y, (front, back) in zip(pairs, *heights(lens, pairs), strict=True):
        with np.errstate(invalid="ignore"):  # sags may be inf, or no number
            overlap = senses[pair.second] * (front - back) - pair.gap
            crossed = overlap > _TOUCH
        limited = pair.second < lens.count and not np.all(np.isinf(semi[[*pair[:2]]]))
        place = _zero(y, overlap, np.argmax(crossed)) if limited and np.any(crossed) else None
        found.append(0.0 if pair.gap <= 0 and pair.second < lens.count else place)
    return found


def _zero(y: np.ndarray, overlap: np.ndarray, at: Any) -> float:
    """The height before y[at] from which surfaces with an overlap (Y,) at heights (Y,) overlap."""
    apart = np.flatnonzero(overlap[:at] <= 0)
    if not len(apart) or not np.isfinite(overlap[apart[-1] + 1]):
        return float(y[at])
    pair = slice(apart[-1], apart[-1] + 2)
    return float(np.interp(0.0, overlap[pair], y[pair]))


def may_cross(lens: Lens) -> bool:
    """True if neighbouring surfaces of a lens with known numbers cross, or may cross.

    Only crossings inside of the apertures count. A crossing cannot be excluded without apertures,
    and for surfaces that are decentred or tilted against each other.
    """
    pairs, semi = neighbours_now(lens), np.asarray(lens.semi_diameter)
    if len(pairs) < max(len(lens.active), 1):
        return True
    open_ones = (np.all(np.isinf(semi[list(pair[:2])])) for pair in pairs[:-1])
    return any(open_ones) or any(p is not None for p in crossings(lens, pairs))


def neighbours_now(lens: Lens) -> list[Pair]:
    """`neighbours` from the arrays of a lens with known numbers, for instance after a step of an
    optimiser.
    """
    gaps = np.asarray(lens.thickness, float).tolist()
    moves = [np.asarray(a) for a in (lens.decentre, lens.tilt) if a is not None]
    moved = [any(bool(np.any(a[k] != 0)) for a in moves) for k in range(lens.count + 1)]
    return neighbours(lens, [*gaps, float(lens.sensor) - sum(gaps)], moved)


def describe_crossing(lens: Lens, pair: Pair, place: float) -> str:
    """A sentence that says that two neighbours cross.

    place: height where they cross, mm, see `crossings`.
    """
    where = f"at y = {place:.4g} mm" if place else "on the axis"
    both = f"surfaces {pair.first} and {pair.second}"
    if pair.second == lens.count:
        both = f"surface {pair.first} and the sensor"
    return f"{both} cross {where}: {pair.gap:.4g} mm between their vertices"
