"""Glass catalogues in Zemax's `.agf` format, for the dispersion formulas that `Glass` holds."""

import os
from collections.abc import Callable, Collection

from ..inputs import InputError
from ..lens.glass import Glass
from ..lens.glasses import flaw
from .entry import LensError
from .record import Missing, Record, short
from .text import Words, lines_of, words_of

_Forms = tuple[list[float], list[float]]  # sellmeier and schott of `Glass`


def _sellmeier(terms: int) -> Callable[[list[float]], _Forms]:
    return lambda c: (c[: 2 * terms : 2] + c[1 : 2 * terms : 2], [1.0] + [0.0] * 5)


def _powers(*order: int) -> Callable[[list[float]], _Forms]:
    """The formula whose coefficient k stands at place `order[k]` of `Glass.schott`."""

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
    """Read the glasses of a `.agf` file by name: at the file's temperatures, relative to air.

    LensError, with the line, if this is no such file, or if a glass has another formula than
    Zemax's 1, 2, 4 and 6 to 13, or has no index above 1 somewhere within its range.

    path: a file of at most 16 MB.
    names: the glasses to read; None reads all.
    missing: "warn" leaves out such glasses and names them in one warning.
    """
    record = Record(str(path), missing)
    try:
        lines = words_of(lines_of(path))
    except InputError as error:
        raise LensError(f"{path}: {error}") from None
    blocks: list[dict[str, Words]] = []
    for words in lines:
        if words.key == "NM":
            blocks.append({})
        if blocks:
            blocks[-1].setdefault(words.key, words)
    if not blocks:
        raise record.error(0, "no line begins with NM: is this a catalogue of glasses?")
    found: dict[str, Glass] = {}
    for block in blocks:
        line, rest = block["NM"].line, block["NM"].rest
        if len(rest) < 2:
            raise record.error(line, "expected NM, a name and the number of a formula")
        if names is not None and rest[0] not in names:
            continue
        glass = _glass(record, block)
        if glass and found.setdefault(glass.name, glass) != glass:
            record.lacks(line, f"{short(glass.name)}: another glass of this name")
    record.say()
    return found


def _glass(record: Record, block: dict[str, Words]) -> Glass | None:
    line, name, formula = block["NM"].line, block["NM"].rest[0], record.count(*block["NM"][::2], 1)
    if formula not in _FORMULAS:
        known = ", ".join(map(str, _FORMULAS))
        record.lacks(line, f"{short(name)}: formula {formula} is not read, of {known}")
        return None
    for key in ("CD", "LD"):
        if key not in block:
            raise record.error(line, f"{short(name)}: its line {key} is missing")
    makes, count = _FORMULAS[formula]
    _, (at, _, rest, _) = block["LD"], block["CD"]
    values = [record.number(at, rest, i, 0.0) for i in range(max(count, min(len(rest), 10)))]
    if any(values[count:]):
        record.lacks(at, f"{short(name)}: formula {formula} with more than {count} terms")
        return None
    sellmeier, schott = makes(values)
    low, high = record.numbers(block["LD"].line, block["LD"].rest, 2)
    if not 0 < low < high:
        raise record.error(block["LD"].line, f"{short(name)}: no range: {low:g} to {high:g} um")
    glass = Glass(name, tuple(sellmeier), tuple(schott), (low, high))
    if wrong := flaw(glass):
        record.lacks(at, f"{short(name)}: {wrong}")
        return None
    return glass
