"""Polygons: which corners are valid, and decomposition into convex pieces.

A quadrature that is fitted to a boundary needs convex pieces. They are chosen once, from known
corners, as numbers of corners; the corners may then vary.
"""

import itertools

import numpy as np

from ..inputs import require

# Largest number of corners of a polygon in a file, and of a convex piece.
CORNERS, _SIDES = 64, 24
# Area up to which a triangle counts as empty, relative to the square of the size of the polygon.
_TINY = 1e-12


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the signed area of triangles of points (..., 2); positive if the corners are
    counterclockwise.
    """
    (p, q), (r, s) = np.moveaxis(b - a, -1, 0), np.moveaxis(c - a, -1, 0)
    return np.asarray(p * s - q * r)


def _least(corners: np.ndarray) -> float:
    """Twice the area, mm^2, up to which a triangle counts as empty."""
    return float(_TINY * np.max(np.ptp(corners, axis=0)) ** 2)


def tidied(corners: np.ndarray) -> np.ndarray:
    """The corners (N, 2) of a polygon without repeated corners and without corners on a straight
    line.

    ValueError if fewer than three remain.
    """
    for k in reversed(range(len(corners))):
        three = np.take(corners, (k - 1, k, k + 1), axis=0, mode="wrap")
        if len(corners) > 2 and abs(_turn(*three)) <= _least(corners):
            corners = np.delete(corners, k, axis=0)
    require(len(corners) >= 3, "needs three corners that do not lie on one line")
    return corners


def convex_pieces(corners: np.ndarray) -> tuple[tuple[int, ...], ...]:
    """Convex pieces of a polygon (N, 2), each the numbers of its corners counterclockwise, at most
    24.

    Ears are cut off, which gives triangles; then pieces are joined as long as the result is convex
    (Hertel and Mehlhorn, 1983). ValueError if sides cross or touch, or if `tidied` would leave
    corners out.
    """
    is_tidy = len(tidied(corners)) == len(corners)
    require(is_tidy, "has a corner twice, or one on a straight side: leave it out")
    require(not _crosses(corners), "its sides cross or touch")
    ring = list(range(len(corners)))
    if np.sum(_turn(corners[0], corners, np.roll(corners, -1, axis=0))) < 0:
        ring = ring[::-1]
    pieces = []
    while len(ring) > 3:
        turned = (ring[k:] + ring[:k] for k in range(len(ring)))
        ring = next(own for own in turned if _is_ear(corners, own))
        pieces.append(tuple(ring[:3]))
        del ring[1]
    return tuple(_joined(corners, [*pieces, tuple(ring)]))


def _crosses(corners: np.ndarray) -> bool:
    """Whether two sides that are not neighbours have a point in common."""
    ends = [*zip(corners, np.roll(corners, -1, axis=0))]
    for i, j in itertools.combinations(range(len(ends)), 2):
        if j - i in (1, len(ends) - 1):
            continue
        (a, b), (c, d) = ends[i], ends[j]
        low, high = np.minimum(a, b), np.maximum(a, b)
        near = np.all(np.minimum(c, d) <= high) and np.all(np.maximum(c, d) >= low)
        through = _turn(a, b, c) * _turn(a, b, d) <= 0, _turn(c, d, a) * _turn(c, d, b) <= 0
        if near and all(through):
            return True
    return False


def _is_ear(corners: np.ndarray, ring: list[int]) -> bool:
    """Whether the first three corners of a ring form a counterclockwise triangle that contains no
    other corner.
    """
    a, b, c = corners[ring[:3]]
    least, others = _least(corners), corners[ring[3:]]
    within = [_turn(p, q, others) >= -least for p, q in ((a, b), (b, c), (c, a))]
    return bool(_turn(a, b, c) > least and not np.any(np.all(within, axis=0)))


def _joined(corners: np.ndarray, pieces: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """Joins pieces until no two of them can be joined to a convex piece of at most 24 corners."""
    for p, q in itertools.permutations(pieces, 2):
        for k in np.flatnonzero(np.isin(p, q)):
            at = q.index(p[k])
            first, second = (*p[k:], *p[:k]), (*q[at + 1 :], *q[: at + 1])
            if first[-1] != second[0]:  # no side of both
                continue
            new = first + second[1:-1]
            near = (corners[np.roll(new, turn)] for turn in (1, 0, -1))
            if len(new) <= _SIDES and np.all(_turn(*near) > _least(corners)):
                return _joined(corners, [*(own for own in pieces if not {*own} <= {*new}), new])
    return pieces
