"""Which neighbouring surfaces of a lens cross, so that light would have to go backwards."""

import itertools
from typing import NamedTuple

import jax
import numpy as np

from .forms import Shape
from .lens import Lens
from .surface import surface_sag

# Neighbours that overlap by less at their rims touch (mm): apertures of prescriptions are rounded.
_TOUCH = 1e-4
_sag = jax.jit(surface_sag, static_argnums=2)


class Pair(NamedTuple):
    """Two neighbours: surfaces that bend light, the second of the last being the sensor.

    first, second: their indices; the sensor's is S.
    gap: between their vertices, mm along the light.
    """

    first: int
    second: int
    gap: float


def neighbours(lens: Lens, gaps: list[float], moved: list[bool]) -> list[Pair]:
    """The pairs of a lens that must keep their order.

    The straight ray between two surfaces that bend light may cross a stop that bends none before
    the first or behind the second, so that it may lie anywhere. A pair of which one is moved
    without the other is left out: away from the axis, or at an angle to it, it may lie before its
    neighbour there and behind it where the light goes.

    gaps: mm from each surface to the next and from the last to the sensor.
    moved: of each surface and the sensor.
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


def heights(lens: Lens, pair: Pair) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances from the axis up to the smaller semi-diameter, mm, and there the sags of both."""
    semi = np.asarray(lens.semi_diameter)
    y = np.linspace(0, min(semi[pair.first], semi[pair.second]), 257, dtype=semi.dtype)
    arrays = [np.asarray(a) for a in (lens.curvature, lens.conic, lens.coefficients)]
    front, back = (
        np.asarray(_sag((0 * y, y), Shape(*(a[k] for a in arrays)), lens.forms[k]))
        for k in pair[:2]
    )
    return y, front, back


def crossing(lens: Lens, pair: Pair) -> float | None:
    """From how far off the axis on, mm, two neighbours cross within both their apertures: 0 if
    their vertices are in the wrong order, None if they do not cross."""
    if pair.gap <= 0:
        return 0.0
    rims = np.asarray(lens.semi_diameter)[[pair.first, pair.second]]
    if pair.second == lens.count or np.all(np.isinf(rims)):
        return None
    y, front, back = heights(lens, pair)
    crossed = lens.senses[pair.second] * (front - back) - pair.gap > _TOUCH
    return float(y[np.argmax(crossed)]) if np.any(crossed) else None


def may_cross(lens: Lens) -> bool:
    """Whether some neighbours, of a lens whose arrays are known, cross inside their apertures, or
    may do so: without apertures, or away from the axis."""
    pairs, semi = neighbours_now(lens), np.asarray(lens.semi_diameter)
    if len(pairs) < max(len(lens.active), 1):
        return True
    open_ones = (np.all(np.isinf(semi[list(pair[:2])])) for pair in pairs[:-1])
    return any(open_ones) or any(crossing(lens, pair) is not None for pair in pairs)


def neighbours_now(lens: Lens) -> list[Pair]:
    """`neighbours` of a lens as its arrays, all known, are now: after an optimiser's step, say."""
    gaps = np.asarray(lens.thickness, float).tolist()
    moves = [np.asarray(a) for a in (lens.decentre, lens.tilt) if a is not None]
    moved = [any(bool(np.any(a[k] != 0)) for a in moves) for k in range(lens.count + 1)]
    return neighbours(lens, [*gaps, float(lens.sensor) - sum(gaps)], moved)


def describe_crossing(lens: Lens, pair: Pair, place: float) -> str:
    """That two neighbours cross, in words; `place` as of `crossing`."""
    second = "the sensor" if pair.second == lens.count else f"surface {pair.second}"
    where = f"from {place:.3g} mm off the axis on" if place else "on the axis"
    return f"surface {pair.first} and {second} cross {where}: {pair.gap:.4g} mm between them"
