"""Convert decentres and tilts of a lens to the coordinate breaks of a `.zmx` file."""

from typing import NamedTuple

import numpy as np

from ..lens.lens import Lens
from .exact import degrees_of


class _Move(NamedTuple):
    """A shift (mm) and a tilt (degrees) of surfaces `first` to `last`. They turn about the point on
    the axis at `pivot`, mm from surface `about`."""

    first: int
    last: int
    about: int
    pivot: float
    shift: list[float]
    tilt: list[float]


def _moves(lens: Lens) -> list[_Move]:
    """The moves of elements and of single surfaces; outer moves precede the moves inside them."""
    found, single = [], lens.count + 1
    if (own := lens.elements) is not None:
        rows = (np.asarray(a, float).tolist() for a in (own.pivot, own.shift, own.tilt))
        for (first, last), about, pivot, shift, tilt in zip(
            own.spans, own.about, *rows, strict=True
        ):
            found.append(_Move(first, last, about, pivot, shift, [degrees_of(a) for a in tilt]))
    across = np.zeros((single, 2)) if lens.decentre is None else np.asarray(lens.decentre, float)
    turned = np.zeros((single, 3)) if lens.tilt is None else np.asarray(lens.tilt, float)
    for i, (xy, tilt) in enumerate(zip(across.tolist(), turned.tolist(), strict=True)):
        found.append(_Move(i, i, i, 0.0, [*xy, 0.0], [degrees_of(a) for a in tilt]))
    moved = [move for move in found if any(move.shift) or any(move.tilt)]
    return sorted(moved, key=lambda move: (move.first, -move.last))


def _break(move: _Move, back: bool) -> list[str]:
    """A coordinate break; with `back` its inverse: tilts in reverse order, then the decentre."""
    numbers = [*move.shift[:2], *move.tilt]
    values = [0.0 - value for value in numbers] if back else numbers
    lines = [f"PARM {k} {value!r}" for k, value in enumerate(values, 1) if value]
    return ["TYPE COORDBRK", "CURV 0.0", *lines, *(["PARM 6 1"] if back else [])]


def with_breaks(
    lens: Lens, surfaces: list[list[str]], gaps: list[float]
) -> tuple[list[list[str]], list[float]]:
    """Insert the coordinate breaks among the blocks of lines of the S surfaces and the image.
    Returns all blocks, and the thickness (mm) in front of each one; in front of the first it counts
    from the first vertex before it is moved. gaps: (S,), mm, behind the surfaces."""
    moves, axis = _moves(lens), [0.0, *np.cumsum(gaps).tolist()]
    blocks: list[list[str]] = []
    behind: list[float] = []
    for i, surface in enumerate(surfaces):
        before, gap = (i - 1, gaps[i - 1]) if i else (0, 0.0)
        at = 0.0  # mm from surface `before`, along the axis of that surface
        ends = [(move, True) for move in reversed(moves) if move.last == i - 1]
        for move, back in ends + [(move, False) for move in moves if move.first == i]:
            known = {before: 0.0, i: gap}
            start = known.get(move.about, axis[move.about] - axis[before])
            behind.append(start + move.pivot - at + (0.0 if back else move.shift[2]))
            blocks.append(_break(move, back))
            at = start + move.pivot + (move.shift[2] if back else 0.0)
        behind.append(gap - at)
        blocks.append(surface)
    return blocks, behind
