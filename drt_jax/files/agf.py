"""Glass catalogues in Zemax's `.agf` format, for the dispersion formulas that `Glass` holds."""

import os
from collections.abc import Callable, Collection
from typing import Any

from ..lens.glass import Glass
from ..lens.glasses import flaw
from .record import Missing, Record, Words, lines_of, naming, short, words_of

_Forms = tuple[list[float], list[float]]  # sellmeier and schott of `Glass`
# Zemax's numbers of the status of a glass, see `Glass.status`.
_STATUS = {0: "standard", 1: "preferred", 2: "obsolete", 3: "special", 4: "melt"}


def _sellmeier(terms: int) -> Callable[[list[float]], _Forms]:
    return lambda c: (c[: 2 * terms : 2] + c[1 : 2 * terms : 2], [1.0] + [0.0] * 5)


def _powers(*order: int) -> Callable[[list[float]], _Forms]:
    """The formula whose coefficient k is entry `order[k]` of `Glass.schott`."""

    def formula(c: list[float]) -> _Forms:
        placed = dict(zip(order, c, strict=False))
        schott = [placed.get(place, 0.0) for place in range(10)]
        return [0.0] * 2, schott[: 10 if schott[9] else 9 if any(schott[6:]) else 6]

    return formula


def _pole(b: float, c: float) -> tuple[float, float, float]:
    """Split b / (L^2 - c) into a constant, Sellmeier's B for this c and a coefficient of L^-2."""
    return (-b / c, b / c, 0.0) if c else (0.0, 0.0, b)


def _sellmeier_2(c: list[float]) -> _Forms:
    less, strength, inverse = _pole(c[3], c[4] ** 2)
    return [c[1], strength, c[2] ** 2, c[4] ** 2], [1 + c[0] + less, 0.0, inverse, 0.0, 0.0, 0.0]


def _handbook_1(c: list[float]) -> _Forms:
    less, strength, inverse = _pole(c[1], c[2])
    return [strength, c[2]], [c[0] + less, -c[3], inverse, 0.0, 0.0, 0.0]


# Zemax's number of a formula: its conversion to `Glass`, and its number of coefficients.
_FORMULAS: dict[int, tuple[Callable[[list[float]], _Forms], int]] = {
    1: (_powers(0, 1, 2, 3, 4, 5), 6),
    2: (_sellmeier(3), 6),
    4: (_sellmeier_2, 5),
    6: (_sellmeier(4), 8),
    7: (_handbook_1, 4),
    8: (lambda c: ([c[1], c[2]], [c[0], -c[3], 0.0, 0.0, 0.0, 0.0]), 4),
    9: (lambda c: ([c[1], c[3], c[2], c[4]], [c[0]] + [0.0] * 5), 5),
    10: (_powers(0, 1, 2, 3, 4, 5, 7, 8), 8),
    11: (_sellmeier(5), 10),
    12: (_powers(0, 1, 2, 3, 4, 5, 6, 9), 8),
    13: (_powers(0, 1, 6, 2, 3, 4, 5, 7, 8), 9),
}


def load_agf(
    path: str | os.PathLike, names: Collection[str] | None = None, missing: Missing = "error"
) -> dict[str, Glass]:
    """Read the glasses of a `.agf` file by name: indices at the file's temperatures, relative to
    air, status, thermal constants and expansion.

    Zemax writes zeros for unknown values. A glass whose thermal constants or whose expansion are
    all zero therefore has none.

    LensError, with the line, if the file is not a `.agf` file, if the formula of a glass is not 1,
    2, 4 or 6 to 13 of Zemax, or if the index of a glass is not above 1 everywhere in its range.

    path: a file of at most 16 MB.
    names: the glasses to read; None reads all.
    missing: "warn" leaves out glasses that cannot be read, and names them in one warning.
    """
    record, blocks = Record(str(path), missing), list[dict[str, Words]]()
    with naming(path):
        lines = words_of(record, lines_of(path))
    for words in lines:
        if words.key == "NM":
            blocks.append({})
        if blocks:
            blocks[-1].setdefault(words.key, words)
    record.require(blocks, 0, "no line begins with NM: is this a catalogue of glasses?")
    found: dict[str, Glass] = {}
    constants = lambda glass: (glass.sellmeier, glass.schott, glass.range)  # noqa: E731
    for block in blocks:
        head = block["NM"]
        head.require(len(head.values) >= 2, "expected NM, a name and the number of a formula")
        glass = _glass(record, block) if names is None or head.values[0] in names else None
        if glass and constants(found.setdefault(glass.name, glass)) != constants(glass):
            record.lacks(head.line, f"{short(glass.name)}: another glass of this name")
    record.say()
    return found


def _glass(record: Record, block: dict[str, Words]) -> Glass | None:
    """The glass of a block of lines.

    block: the line of each key. None for a glass that is left out.
    """
    head, name = block["NM"], block["NM"].values[0]
    formula, called = head.count(1), short(name)
    if formula not in _FORMULAS:
        known = ", ".join(map(str, _FORMULAS))
        record.lacks(head.line, f"{called}: formula {formula} is not read, of {known}")
        return None
    for key in ("CD", "LD"):
        head.require(key in block, f"{called}: its line {key} is missing")
    (makes, count), terms, ends = _FORMULAS[formula], block["CD"], block["LD"]
    many = max(count, min(len(terms.values), 10))
    values = [terms.number(i, 0.0) for i in range(many)]
    if any(values[count:]):
        record.lacks(terms.line, f"{called}: formula {formula} with more than {count} terms")
        return None
    sellmeier, schott = makes(values)
    low, high = ends.numbers(0, 2)
    ends.require(0 < low < high, f"{called}: no range: {low:g} to {high:g} um")
    more: dict[str, Any] = {"status": _STATUS.get(int(head.number(6, -1.0)), "")}
    if "TD" in block:
        *thermal, celsius = (block["TD"].number(at, 20.0 if at == 6 else 0.0) for at in range(7))
        more |= {"thermal": tuple(thermal) if any(thermal) else (), "celsius": celsius}
    expansion = block["ED"].number(0, 0.0) if "ED" in block else 0.0
    more["expansion"] = expansion if expansion > 0 else None
    glass = Glass(name, tuple(sellmeier), tuple(schott), (low, high), **more)
    if wrong := flaw(glass):
        record.lacks(terms.line, f"{called}: {wrong}")
        return None
    return glass
