"""Model glasses of `.zmx` files: conversion between OpticStudio's formula and `model_glass`.

OpticStudio's indices are n = 1 + (nd - 1) + (nd - 1) / vd ((M1 + P M2) . (1, 1/L, 1/L^3.5)) with
P = 0.6438 - 0.001682 vd + dP, within 1.9e-10 of 170 listings. This is Conrady's formula through
spectral lines rounded to four decimals; ours is the same formula through the exact lines.
"""

from typing import Any

import numpy as np

from .record import Record, Row

_POWERS = np.array([0.0, -1.0, -3.5])
_LINES = (0.5875618, 0.4861327, 0.6562725, 0.4358343)
_NORMAL = 0.6438, -0.001682
_ROUNDING = 1e-12  # a P_gF that is as near to the normal line lies on it
_M1 = np.array([-7.12849, 4.95284, -0.202244])
_M2 = np.array([8.84931, -6.91677, 0.454415])


def to_ours(nd: float, vd: float, above: float) -> tuple[float, float, float]:
    """nd, vd and partial of our model glass from nd, vd and dP of a file."""
    mean = (nd - 1) / vd
    terms = mean * (_M1 + (_NORMAL[0] + _NORMAL[1] * vd + above) * _M2)
    terms[0] += nd
    d, f, c, g = (np.array(_LINES)[:, None] ** _POWERS) @ terms
    abbe = (d - 1) / (f - c)
    partial = float((g - f) / (f - c) - _NORMAL[0] - _NORMAL[1] * abbe)
    return float(d), float(abbe), partial if abs(partial) > _ROUNDING else 0.0


def to_theirs(nd: float, vd: float, above: float) -> tuple[float, float, float]:
    """nd, vd and dP of a file from nd, vd and partial of our model glass."""
    lines = np.array(_LINES)[:, None] ** _POWERS
    mean = (nd - 1) / vd
    wanted = np.array([nd - 1, mean, (_NORMAL[0] + _NORMAL[1] * vd + above) * mean])
    ours = np.stack([lines[0], lines[1] - lines[2], lines[3] - lines[1]])
    terms = np.linalg.solve(ours, wanted)
    own = np.stack([np.array([1.0, 0, 0]), _M1, _M2], axis=1)
    index, mean, part = np.linalg.solve(own, terms)
    abbe = index / mean
    return float(1 + index), float(abbe), float(part / mean - _NORMAL[0] - _NORMAL[1] * abbe)


def model_keys(
    record: Record, row: Row, line: int, nd: float, vd: float, above: float
) -> dict[str, Any]:
    """The keys of a medium of nd, vd and dP in a file; vd 0 is a constant index. LensError for
    numbers that no glass has."""
    if not vd:
        return {"index": nd}
    if not (1 < nd <= 4 and 10 <= vd <= 120):
        raise record.error(line, f"{row.name}: no model glass has nd {nd:g} and vd {vd:g}")
    return dict(zip(("nd", "vd", "partial"), to_ours(nd, vd, above), strict=True))
