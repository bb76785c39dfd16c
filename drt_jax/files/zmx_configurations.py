"""Configurations of `.zmx` files: rows behind MNUM, one for each configuration.

The surfaces and the header have the numbers of the current configuration. To read another one, its
rows replace these numbers in the lines before the lines are read.
"""

import collections
from collections.abc import Sequence

from .entry import LensError
from .record import Record, Words
from .written import differing

# By keyword of a row: the keyword that it changes, of a surface, of a list over fields and of a
# wavelength.
_SURFACE = {"THIC": "DISZ", "CRVT": "CURV", "CONN": "CONI", "SDIA": "DIAM"}
_FIELD = {
    "XFIE": "XFLN", "YFIE": "YFLN", "FLWT": "FWGN", "FVDX": "VDXN", "FVDY": "VDYN",
    "FVCX": "VCXN", "FVCY": "VCYN", "FVAN": "VANN"
}  # fmt: skip
_WAVE = {"WAVE": 1, "WLWT": 2}
_APERTURE = "ENPD", "FNUM", "OBNA"
_NO_NUMBER = "MOFF", "MCOM", "NOTE", "LTTL"
_AIR = "TEMP", "PRES"


def choose(record: Record, found: list[Words], configuration: int | None) -> None:
    """Replace the numbers of the current configuration by those of another one, in place.

    LensError if the file has no such configuration. A row of an unknown kind that differs between
    configurations is treated by `Record.lacks`.

    found: the lines of the file. configuration: its number in the file, from 1; None for the
    current one.
    """
    at = next((k for k, words in enumerate(found) if words.key == "MNUM"), None)
    line, count, current = 0, 1, 1
    if at is not None:
        line, count, current = found[at].line, found[at].count(0, 1), found[at].count(1, 1)
    record.choose(line, count, current, configuration)
    if at is None or record.configuration == current:
        return
    for rows in _operands(found[at + 1 :], count):
        own, before = rows[record.configuration - 1], rows[current - 1]
        if own.key not in _NO_NUMBER and own.values[2] != before.values[2]:
            _write(record, found, own)


def _operands(found: list[Words], count: int) -> list[list[Words]]:
    """The rows of each operand, one for each configuration, in any order. Operands of one name and
    place, such as PRAM of two parameters, are told apart by their order."""
    operands: dict[tuple[str, str, int], dict[str, Words]] = {}
    before = collections.Counter[tuple[str, str, str]]()
    for words in found:
        if len(words.values) > 2:
            where, number = words.values[:2]
            row = words.key, where, number
            operands.setdefault((words.key, where, before[row]), {})[number] = words
            before[row] += 1
    names = [str(k + 1) for k in range(count)]
    return [[own[n] for n in names] for own in operands.values() if own.keys() >= {*names}]


def _write(record: Record, found: list[Words], row: Words) -> None:
    """Replace the number that a row changes."""
    key, where, value = row.key, row.count(), row.values[2]
    what = f"{key}, which differs between configurations"
    if key in _AIR:
        return record.lacks(row.line, what)
    known = key in (*_SURFACE, *_FIELD, *_WAVE, "APER")
    row.require(known, f"{what}: not supported; save each configuration as a file of its own")
    row.number(2)  # LensError if it is not a number
    starts = [k for k, words in enumerate(found) if words.key == "SURF"]
    head = found[: min(starts, default=0)]
    what = f"{key} {where}: the file has none"
    if key in _SURFACE:
        row.require(0 <= where < len(starts), what)
        start, end = starts[where], [*starts, len(found)][where + 1]
        name = _SURFACE[key]
        own = [words for words in found[start:end] if words.key == name]
        if own:
            own[0].values[:1] = [value]
        else:
            found.insert(start + 1, Words(record, row.line, name, [value], True))
    elif key in _FIELD:
        lists = [words for words in head if words.key == _FIELD[key]]
        row.require(lists and 1 <= where <= len(lists[0].values), what)
        lists[0].values[where - 1] = value
    elif key in _WAVE:
        waves = [words for words in head if words.key == "WAVM" and words.count() == where]
        row.require(waves and len(waves[0].values) > _WAVE[key], what)
        waves[0].values[_WAVE[key]] = value
    else:
        for words in head:
            if words.key in _APERTURE:
                words.values[:1] = [value]


def rows(texts: Sequence[Sequence[str]]) -> list[str]:
    """The lines from MNUM on. texts: the lines of the file for each configuration. LensError if
    they differ in something that no row can change."""
    of_surface, of_field = ({own: row for row, own in t.items()} for t in (_SURFACE, _FIELD))
    of_wave = {place: row for row, place in _WAVE.items()}
    found = [f"MNUM {len(texts)} 1"]
    for surface, words, at, values in differing(texts, "SURF"):
        key = words[0]
        if surface >= 0 and at == 1 and key in of_surface:
            operand = f"{of_surface[key]} {surface}"
        elif key in of_field:
            operand = f"{of_field[key]} {at}"
        elif key == "WAVM" and at > 1:
            operand = f"{of_wave[at - 1]} {words[1]}"
        else:
            some = f"{' '.join(words)[:40]}, {' and '.join(values)}"
            raise LensError(f"configurations differ in {some}, which no row of .zmx changes here")
        for k, value in enumerate(values, 1):
            number = "1.0E+10" if value == "INFINITY" else value
            found.append(f"{operand} {k} {number} 0 0 0 1 1 1 0 0")
    return found
