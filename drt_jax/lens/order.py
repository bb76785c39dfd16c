"""Neighbouring surfaces that cross, so that light would have to go backwards."""

import itertools
from typing import NamedTuple

import jax
import numpy as np

from .forms import Shape
from .lens import Lens
from .surface import surface_sag

# Overlap at the rims that counts as touching, mm: apertures of prescriptions are rounded.
_TOUCH = 1e-4
_sag = jax.jit(surface_sag, static_argnums=2)


class Pair(NamedTuple):
    """Two neighbouring active surfaces, or the last one and the sensor.

    first, second: their indices; the sensor's is S.
    gap: between their vertices along the light, mm.
    """

    first: int
    second: int
    gap: float


def neighbours(lens: Lens, gaps: list[float], moved: list[bool]) -> list[Pair]:
    """The pairs of a lens that must keep their order.

    A dummy stop may lie anywhere: the straight ray between its neighbours is prolonged to it. Pairs
    that are decentred or tilted against each other are left out: their order on the axis may differ
    from that along the light.

    gaps: from each surface to the next, and from the last to the sensor, mm.
    moved: True for each surface, and the sensor, that is decentred or tilted by itself.
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
    """Heights from the axis up to the smaller semi-diameter, and the sags of both surfaces there,
    mm."""
    semi = np.asarray(lens.semi_diameter)
    y = np.linspace(0, min(semi[pair.first], semi[pair.second]), 257, dtype=semi.dtype)
    arrays = [np.asarray(a) for a in (lens.curvature, lens.conic, lens.coefficients)]
    front, back = (
        np.asarray(_sag((0 * y, y), Shape(*(a[k] for a in arrays)), lens.forms[k]))
        for k in pair[:2]
    )
    return y, front, back


def crossing(lens: Lens, pair: Pair) -> float | None:
    """Smallest height at which two neighbours cross inside both apertures, mm; 0 if their vertices
    are in the wrong order, None if they do not cross."""
    if pair.gap <= 0:
        return 0.0
    rims = np.asarray(lens.semi_diameter)[[pair.first, pair.second]]
    if pair.second == lens.count or np.all(np.isinf(rims)):
        return None
    y, front, back = heights(lens, pair)
    crossed = lens.senses[pair.second] * (front - back) - pair.gap > _TOUCH
    return float(y[np.argmax(crossed)]) if np.any(crossed) else None


def may_cross(lens: Lens) -> bool:
    """True if neighbours of a known lens cross inside their apertures or may do so: without
    apertures, or decentred or tilted against each other."""
    pairs, semi = neighbours_now(lens), np.asarray(lens.semi_diameter)
    if len(pairs) < max(len(lens.active), 1):
        return True
    open_ones = (np.all(np.isinf(semi[list(pair[:2])])) for pair in pairs[:-1])
    return any(open_ones) or any(crossing(lens, pair) is not None for pair in pairs)


def neighbours_now(lens: Lens) -> list[Pair]:
    """`neighbours` from the arrays of a known lens, such as after an optimiser's step."""
    gaps = np.asarray(lens.thickness, float).tolist()
    moves = [np.asarray(a) for a in (lens.decentre, lens.tilt) if a is not None]
    moved = [any(bool(np.any(a[k] != 0)) for a in moves) for k in range(lens.count + 1)]
    return neighbours(lens, [*gaps, float(lens.sensor) - sum(gaps)], moved)


def describe_crossing(lens: Lens, pair: Pair, place: float) -> str:
    """A sentence that two neighbours cross. place: height where they do, see `crossing`, mm."""
    second = "the sensor" if pair.second == lens.count else f"surface {pair.second}"
    where = f"from {place:.3g} mm off the axis on" if place else "on the axis"
    return f"surface {pair.first} and {second} cross {where}: {pair.gap:.4g} mm between them"
