"""Decentres and tilts of `.seq` files: conversion to coordinate breaks around a surface.

ADE and BDE turn left-handed about x and the turned y, CDE right-handed about the turned z. Rays
that CODE V lists through three tilted mirrors confirm the sense of ADE.
"""

import dataclasses

import numpy as np

from .record import Breaking, Record, Row, rotation_of, turned_back, turns_of
from .seq_text import Command

KEYS = ("XDE", "YDE", "ZDE", "ADE", "BDE", "CDE")
KINDS = ("DAR", "BEN", "REV", "RET")
Triple = tuple[float, float, float]


@dataclasses.dataclass
class Place:
    """Decentre and tilt of a surface. values: by key, in units of the file. kind: one of `KINDS` or
    "". target: the surface that RET returns to. line: of the last command."""

    values: dict[str, float] = dataclasses.field(default_factory=dict)
    kind: str = ""
    target: int = 0
    line: int = 0

    @property
    def moved(self) -> bool:
        """Whether the surface is decentred or tilted."""
        return any(self.values.values())

    def take(self, record: Record, command: Command) -> None:
        """Read a command of `KEYS` or `KINDS`; the reader sets the target of RET."""
        self.line = command.line
        if command.key in KEYS:
            self.values[command.key] = record.bounded(command.line, command.values)
            return
        if self.kind not in ("", command.key):
            raise record.error(command.line, f"both {self.kind} and {command.key}")
        self.kind = command.key

    def of(self, unit: float) -> tuple[Triple, Triple]:
        """Shift in mm and tilt in degrees in our sense: right-handed about x, y and z."""
        x, y, z, a, b, c = (self.values.get(key, 0.0) for key in KEYS)
        return (x * unit, y * unit, z * unit), (0.0 - a, 0.0 - b, c)


@dataclasses.dataclass
class Frames:
    """The axis at each surface: its origin `point` (3,), mm, and its rotation `turn` (3, 3)."""

    record: Record
    unit: float
    point: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    turn: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    before: list[tuple[np.ndarray, np.ndarray, bool]] = dataclasses.field(default_factory=list)

    def parts(self, row: Row, place: Place, image: bool) -> list[Row | Breaking]:
        """A surface with the breaks before and behind it; the last part takes its thickness."""
        (shift, tilt), kind, line = place.of(self.unit), place.kind, place.line
        own: list[Row | Breaking] = [row]
        if kind == "RET":
            own = [self._back(place), row]
        elif kind == "DAR" and place.moved:
            row.put("decentre", [*shift[:2]], line)
            row.put("tilt", (np.array(tilt) + row.entry.get("tilt", [0, 0, 0])).tolist(), line)
            if shift[2]:
                away = (0.0, 0.0, -shift[2])
                none = (0.0, 0.0, 0.0)
                own = [Breaking(line, (0.0, 0.0, shift[2])), row, Breaking(line, away, none)]
        elif kind == "REV" and place.moved:
            turn, back = turned_back((-tilt[0], -tilt[1], -tilt[2]))
            moved = turn @ -np.array(shift) if any(shift) else np.zeros(3)
            own = [row, Breaking(line, tuple(moved.tolist()), back)]
        elif place.moved:
            own = [Breaking(line, shift, tilt), row]
            if kind == "BEN":
                if tilt[2] or (tilt[0] and tilt[1]):
                    raise self.record.error(line, f"{row.name}: BEN with tilts about several axes")
                own.append(Breaking(line, (0.0, 0.0, 0.0), tilt))
        if image and (own[-1] is not row or kind == "RET"):
            raise self.record.error(line, f"{row.name}: {kind} at the image")
        for part in own:
            if part is row:
                self.before.append((self.point, self.turn, place.moved or kind != ""))
            elif isinstance(part, Breaking):
                self.point = self.point + self.turn @ np.array(part.shift)
                self.turn = self.turn @ rotation_of(part.tilt)
        self.point = self.point + self.turn @ np.array([0, 0, row.thickness])
        if isinstance(own[-1], Breaking):
            own[-1].thickness, row.thickness = row.thickness, 0.0
        return own

    def _back(self, place: Place) -> Breaking:
        """The break from the axis here to the axis of an earlier surface."""
        if place.moved:
            raise self.record.error(place.line, "RET with a decentre or tilt of its own")
        if not 1 <= place.target <= len(self.before):
            raise self.record.error(place.line, f"RET: surface {place.target} is not before it")
        point, turn, moved = self.before[place.target - 1]
        if moved:
            raise self.record.error(
                place.line,
                f"RET: surface {place.target} is moved itself; return to one that is not",
            )
        shift = self.turn.T @ (point - self.point)
        return Breaking(place.line, tuple(shift.tolist()), turns_of(self.turn.T @ turn))
