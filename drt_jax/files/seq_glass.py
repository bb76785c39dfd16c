"""Glasses of `.seq` files: names, codes, and private catalogues between PRV and END."""

import bisect
import re
from typing import Any

import numpy as np

from ..lens.glasses import plain_names
from .glasses import code_of, in_catalogues, named_glass, require_glass
from .record import Record, short
from .seq_surfaces import Surface
from .seq_text import Command, micrometres

_POWERS = (0, -2, 2, -4, -6, -8)  # of L in Schott's formula; each further index adds one
_SCHOTT = (0, 2, -2, -4, -6, -8)
_SAME = 1e-9  # um, tolerance for equal wavelengths
_MOST = 1000


def folded(name: str) -> str:
    """The name of a glass as CODE V writes it: without hyphens, in capitals."""
    return re.sub(r"[^A-Z0-9]", "", name.upper())


class Glasses:
    """The private catalogue of a file, and lookup of makers' glasses by name.

    tables: by name, the command of a private glass and its wavelengths, um.
    used: glasses of the prescription.
    """

    def __init__(self, record: Record):
        self.record, self.waves = record, list[float]()
        self.tables: dict[str, tuple[Command, list[float]]] = {}
        self.used: dict[str, dict[str, Any]] = {}

    def take(self, command: Command) -> None:
        """Read a line of the private catalogue."""
        if command.key == "PWL" and not command.quoted:
            values = command.numbers(0, len(command.values))
            known = bool(values) and 0.1 <= min(values) <= max(values) <= 1e9
            command.require(known, "PWL: expected wavelengths in nm")
            command.require(len({*values}) == len(values), "PWL: a wavelength stands twice")
            self.waves = [*map(micrometres, values)]
            return
        command.require(len(self.tables) < _MOST, f"more than {_MOST} private glasses")
        self.tables[command.key.upper()] = command, self.waves

    def medium(self, surface: Surface) -> dict[str, Any]:
        """The entries of the medium behind a surface."""
        (line, word), record = surface.glass, self.record
        private = word.upper()
        if private in ("", "AIR"):
            return {}
        if private in self.tables:
            if private not in self.used:
                self.used[private] = _private(*self.tables[private])
            return {"glass": private}
        if code := code_of(word):
            require_glass(surface, line, *code)
            note = "glasses of a code have its nd and vd; between the lines they are models"
            record.notes += [note] if note not in record.notes else []
            return dict(zip(("nd", "vd"), code, strict=True))
        name, _, maker = word.partition("_")
        makers = [maker.upper()] if maker and maker.upper() != "SPECIAL" else []
        known_as = [other for other in plain_names() if folded(other) == folded(name)]
        known_as = [other for other in known_as if in_catalogues(other, makers)] or known_as
        known_as = [other for other in known_as if other == name] or known_as
        what = f"glass {short(word)} may be {' or '.join(known_as)}; add _MAKER"
        surface.require(len(known_as) < 2 or makers, what, line)
        return dict(named_glass(surface, line, known_as[0] if known_as else name, makers))


def _private(command: Command, waves: list[float]) -> dict[str, Any]:
    """The constants of a private glass, from its formula or its table of indices."""
    name, words = short(command.key), command.values
    kind, count = words[0].upper() if words else "", len(words) - 1
    if kind not in _FORMULAS:
        return _table(command, waves)
    values = command.numbers(1, count + 1)
    command.require(0 < count <= _FORMULAS[kind], f"{name}: {kind} with {count} constants")
    own: dict[str, Any] = {"range": [min(waves), max(waves)] if len(waves) > 1 else [1e-4, 1e6]}
    if kind in ("GMS", "SLM"):
        command.require(count % 2 == 0, f"{name}: {kind} takes pairs of constants")
        return own | {"sellmeier": [*values[::2], *values[1::2]]}
    values += [0.0] * (6 - len(values))
    if kind == "CAU":  # n = a + b / L^2 + c / L^4
        a, b, c = values[:3]
        values = [a * a, 0.0, 2 * a * b, 2 * a * c + b * b, 2 * b * c, c * c]
    return own | {"schott": values}


def _table(command: Command, waves: list[float]) -> dict[str, Any]:
    """Schott's formula for a table of indices.

    It passes through all indices of a table of up to six. For a longer table it passes through up
    to five indices at the wavelengths of the file, and is a least-squares fit to those near them.
    """
    name, count = short(command.key), len(command.values)
    system = command.record.use.wavelengths
    many = f"{count} indices for {len(waves)} wavelengths of PWL"
    known = f"known formulas: {', '.join(_FORMULAS)}"
    command.require(waves and count == len(waves), f"{name}: {many}; {known}")
    table = sorted(zip(waves, command.numbers(0, count), strict=True))
    inside = all(1 < index <= 10 for _, index in table)
    command.require(inside, f"{name}: an index that is not between 1 and 10")
    at, indices = np.array(_near(table, system)).T
    held = [k for k in range(len(at)) if any(abs(at[k] - w) < _SAME for w in system)][:5]
    held = [*range(len(at))] if len(at) <= 6 else held
    constants, off = schott_through(at, indices, held)
    how = f", {off:.1g} off at most" if off > _SAME else "; between them CODE V may differ"
    what = f"{name}: Schott's formula through the indices of the table{how}"
    command.record.note(command.line, what)
    low, high = float(at.min()), float(at.max())
    ends = [low, high] if low < high else [low * (1 - _SAME), high * (1 + _SAME)]
    return {"schott": constants, "range": ends}


def schott_through(
    at: np.ndarray, indices: np.ndarray, held: list[int]
) -> tuple[list[float], float]:
    """Schott's formula through indices: its six constants, and its largest error.

    at: wavelengths, um. indices: the indices there.
    held: the wavelengths at which the formula equals the index; the others are fitted by least
        squares.
    """
    terms = len(at) if len(at) <= 6 else min(6, 4 + len(held))
    powers = np.power.outer(at, _POWERS[:terms]).astype(float)
    wanted, scale = indices**2, np.abs(powers).max(axis=0)
    # Least squares among the solutions that pass through the held indices.
    rows = powers / scale
    solution = np.linalg.lstsq(rows[held], wanted[held])[0] if held else np.zeros(terms)
    free = np.linalg.svd(rows[held])[2][len(held) :].T if held else np.eye(terms)
    if free.size:
        rest = wanted - rows @ solution
        solution = solution + free @ np.linalg.lstsq(rows @ free, rest)[0]
    if held:  # correct the rounding error at the held wavelengths
        solution = solution + np.linalg.lstsq(rows[held], (wanted - rows @ solution)[held])[0]
    off = np.abs(np.sqrt(np.maximum(rows @ solution, 0)) - indices).max()
    known = dict(zip(_POWERS[:terms], (solution / scale).tolist(), strict=True))
    return [known.get(p, 0.0) for p in _SCHOTT], float(off)


def _near(table: list[tuple[float, float]], system: list[float]) -> list[tuple[float, float]]:
    """The rows of a table between the wavelengths of the file, extended on both sides to at least
    eight rows."""
    waves = [wave for wave, _ in table]
    first = max(bisect.bisect_left(waves, min(system)) - 1, 0)
    end = min(bisect.bisect_right(waves, max(system)) + 1, len(table))
    while end - first < 8 and end - first < len(table):
        first, end = max(first - 1, 0), min(end + 1, len(table))
    return table[first:end]


_FORMULAS = {"LAU": 6, "GML": 6, "GMS": 40, "SLM": 40, "CAU": 3}
