"""Configurations of `.zmx` files: rows behind MNUM, one for each configuration.

The surfaces and the header have the numbers of the current configuration. The rows of another one
are written over them before they are read.
"""

from collections.abc import Sequence

from .entry import LensError
from .record import Record, Words
from .written import differing

# The keyword of a surface, of a list over fields and of the entry of a wavelength that a row
# changes.
_SURFACE = {"THIC": "DISZ", "CRVT": "CURV", "CONN": "CONI", "SDIA": "DIAM"}
_FIELD = {
    "XFIE": "XFLN", "YFIE": "YFLN", "FLWT": "FWGN", "FVDX": "VDXN", "FVDY": "VDYN",
    "FVCX": "VCXN", "FVCY": "VCYN", "FVAN": "VANN"
}  # fmt: skip
_WAVE = {"WAVE": 1, "WLWT": 2}
_APERTURE = "ENPD", "FNUM", "OBNA"
_NO_NUMBER = "MOFF", "MCOM", "NOTE"


def choose(record: Record, found: list[Words], configuration: int | None) -> None:
    """Write the numbers of a configuration over those of the current one, in place.

    LensError for a number that the file does not have; where a row that differs is not known, as in
    `Record.lacks`.

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
    """The rows of each operand, one for each configuration, in any order."""
    operands: dict[tuple[str, ...], dict[str, Words]] = {}
    for words in found:
        if len(words.values) > 2:
            where, number = words.values[:2]
            operands.setdefault((words.key, where), {})[number] = words
    names = [str(k + 1) for k in range(count)]
    return [[own[n] for n in names] for own in operands.values() if own.keys() >= {*names}]


def _write(record: Record, found: list[Words], row: Words) -> None:
    """Write the number of a row over the one that is read."""
    key, where, value = row.key, row.count(), row.values[2]
    row.number(2)  # LensError for what is no number
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
    elif key == "APER":
        for words in head:
            if words.key in _APERTURE:
                words.values[:1] = [value]
    else:
        record.lacks(row.line, f"{key}, which differs between configurations")


def rows(texts: Sequence[Sequence[str]]) -> list[str]:
    """The lines from MNUM on, of the lines of a file for each configuration. LensError for lines
    that differ and that no row changes."""
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
