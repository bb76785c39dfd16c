"""Glasses of `.seq` files: names, codes, and private catalogues between PRV and END."""

import re
from typing import Any

import numpy as np

from ..lens.glasses import plain_names
from .glasses import in_catalogues, named_glass
from .record import Record, Row, short
from .seq_text import Command

_CODE = re.compile(r"(\d{3,17})\.(\d{3,18})")
_SHORT_CODE = re.compile(r"\d{6}")
_PAIR = re.compile(r"(\d\.\d{1,17}):(\d{2,3}(?:\.\d{1,17})?)")
_POWERS = (0, -2, 2, -4, -6, -8)  # of L in Schott's formula; each further index adds one
_SCHOTT = (0, 2, -2, -4, -6, -8)
_SAME = 1e-9  # um, tolerance for equal wavelengths
_MOST = 1000


def code_of(word: str) -> tuple[float, float] | None:
    """nd and vd of a code as 517642, 517.642, 516800.641700 or 1.5168:64.17; None for a name."""
    found = _CODE.fullmatch(word)
    if found:
        return float(f"1.{found[1]}"), float(f"{found[2][:2]}.{found[2][2:]}")
    if _SHORT_CODE.fullmatch(word):
        return 1 + int(word[:3]) / 1000, int(word[3:]) / 10
    found = _PAIR.fullmatch(word)
    return (float(found[1]), float(found[2])) if found else None


def folded(name: str) -> str:
    """The name of a glass as CODE V writes it: without hyphens, in capitals."""
    return re.sub(r"[^A-Z0-9]", "", name.upper())


class Glasses:
    """The private catalogue of a file, and lookup of makers' glasses by name."""

    def __init__(self, record: Record):
        self.record, self.waves = record, list[float]()
        self.tables: dict[str, Command] = {}
        self.waves_of: dict[str, list[float]] = {}
        self.used: dict[str, dict[str, Any]] = {}

    def take(self, command: Command) -> None:
        """Read a line of the private catalogue."""
        if command.key == "PWL" and not command.quoted:
            values = self.record.numbers(command.line, command.values, len(command.values))
            if not values or not 0.1 <= min(values) <= max(values) <= 1e9:
                raise self.record.error(command.line, "PWL: expected wavelengths in nm")
            if len({*values}) < len(values):
                raise self.record.error(command.line, "PWL: a wavelength stands twice")
            self.waves = [value / 1000 for value in values]
            return
        if len(self.tables) >= _MOST:
            raise self.record.error(command.line, f"more than {_MOST} private glasses")
        self.tables[command.key.upper()] = command
        self.waves_of[command.key.upper()] = self.waves

    def medium(self, row: Row, line: int, word: str, system: list[float]) -> dict[str, Any]:
        """The entries of the medium that a word names; `system`: wavelengths of the file, um."""
        if word.upper() in ("", "AIR"):
            return {}
        if word.upper() in self.tables:
            return {"glass": self._private(word.upper(), system)}
        code = code_of(word)
        if code:
            if not (1 < code[0] <= 4 and 10 <= code[1] <= 120):
                raise self.record.error(
                    line, f"{row.name}: no glass has nd {code[0]:g} and vd {code[1]:g}"
                )
            note = "glasses of a code have its nd and vd; between the lines they are models"
            if note not in self.record.notes:
                self.record.notes.append(note)
            return {"nd": code[0], "vd": code[1]}
        name, _, maker = word.partition("_")
        makers = [maker.upper()] if maker and maker.upper() != "SPECIAL" else []
        known = [other for other in plain_names() if folded(other) == folded(name)]
        known = [other for other in known if in_catalogues(other, makers)] or known
        known = [other for other in known if other == name] or known
        if len(known) > 1 and not makers:
            raise self.record.error(
                line, f"{row.name}: glass {short(word)} may be {' or '.join(known)}; add _MAKER"
            )
        return dict(named_glass(self.record, row, line, known[0] if known else name, makers))

    def _private(self, name: str, system: list[float]) -> str:
        """Add a private glass to the glasses of the prescription; return its name there."""
        if name not in self.used:
            command, waves = self.tables[name], self.waves_of[name]
            words = command.values
            if words and words[0].upper() in _FORMULAS:
                self.used[name] = self._formula(command, waves)
            else:
                self.used[name] = self._table(command, waves, system)
        return name

    def _formula(self, command: Command, waves: list[float]) -> dict[str, Any]:
        record, line, words = self.record, command.line, command.values
        kind, count = words[0].upper(), len(words) - 1
        values = record.numbers(line, words[1:], count)
        if count > _FORMULAS[kind] or not count:
            raise record.error(line, f"{short(command.key)}: {kind} with {count} constants")
        own: dict[str, Any] = {"range": [min(waves), max(waves)] if len(waves) > 1 else [1e-4, 1e6]}
        if kind in ("GMS", "SLM"):
            if count % 2:
                raise record.error(line, f"{short(command.key)}: {kind} takes pairs of constants")
            return own | {"sellmeier": [*values[::2], *values[1::2]]}
        values += [0.0] * (6 - len(values))
        if kind == "CAU":  # n = a + b / L^2 + c / L^4
            a, b, c = values[:3]
            values = [a * a, 0.0, 2 * a * b, 2 * a * c + b * b, 2 * b * c, c * c]
        return own | {"schott": values}

    def _table(self, command: Command, waves: list[float], system: list[float]) -> dict[str, Any]:
        """Schott's formula for a table. It passes through all of up to six indices; else through up
        to five at the file's wavelengths, with a least-squares fit to those near them."""
        record, line, name = self.record, command.line, short(command.key)
        if not waves or len(command.values) != len(waves):
            many = f"{len(command.values)} indices for {len(waves)} wavelengths of PWL"
            raise record.error(line, f"{name}: {many}; known formulas: {', '.join(_FORMULAS)}")
        table = sorted(zip(waves, record.numbers(line, command.values, len(waves)), strict=True))
        if not all(1 < index <= 10 for _, index in table):
            raise record.error(line, f"{name}: an index that is not between 1 and 10")
        at, indices = np.array(_near(table, system)).T
        held = [k for k in range(len(at)) if any(abs(at[k] - w) < _SAME for w in system)][:5]
        if len(at) <= 6:
            held = [*range(len(at))]
        constants, off = schott_through(at, indices, held)
        record.notes.append(
            f"line {line}: {name}: Schott's formula through the indices of the table"
            + (f", {off:.1g} off at most" if off > _SAME else "; between them CODE V may differ")
        )
        low, high = float(at.min()), float(at.max())
        ends = [low, high] if low < high else [low * (1 - _SAME), high * (1 + _SAME)]
        return {"schott": constants, "range": ends}


def schott_through(
    at: np.ndarray, indices: np.ndarray, held: list[int]
) -> tuple[list[float], float]:
    """Schott's formula through indices: its six constants, and how far it is off at most.

    at: wavelengths, um. held: which of them it passes through; the others by least squares.
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
    if held:  # what rounding has left
        solution = solution + np.linalg.lstsq(rows[held], (wanted - rows @ solution)[held])[0]
    off = np.abs(np.sqrt(np.maximum(rows @ solution, 0)) - indices).max()
    known = dict(zip(_POWERS[:terms], (solution / scale).tolist(), strict=True))
    return [known.get(p, 0.0) for p in _SCHOTT], float(off)


def _near(table: list[tuple[float, float]], system: list[float]) -> list[tuple[float, float]]:
    """The rows of a table between the file's wavelengths, extended on both sides until there are at
    least eight."""
    inside = [k for k, (wave, _) in enumerate(table) if min(system) <= wave <= max(system)]
    above = sum(wave < min(system) for wave, _ in table)
    first, end = (
        max((inside or [above])[0] - 1, 0),
        min((inside or [above - 1])[-1] + 2, len(table)),
    )
    while end - first < 8 and end - first < len(table):
        first, end = max(first - 1, 0), min(end + 1, len(table))
    return table[first:end]


_FORMULAS = {"LAU": 6, "GML": 6, "GMS": 40, "SLM": 40, "CAU": 3}
