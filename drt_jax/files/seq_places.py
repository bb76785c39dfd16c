"""Apertures, decentres and tilts of `.seq` files: conversion to prescription entries and to
coordinate breaks around a surface.

ADE and BDE turn left-handed about x and the turned y, CDE right-handed about the turned z. Rays
that CODE V lists through three tilted mirrors confirm the sense of ADE.
"""

import dataclasses
from typing import Any

import numpy as np

from .record import Breaking, Record, Row, rotation_of, turned_back, turns_of
from .seq_surfaces import MOVES, SIZES, Surface

_SHAPES = {"C": "circle", "R": "rectangle", "E": "ellipse"}
_NONE = (0.0, 0.0, 0.0)


def clip(surface: Surface) -> float | None:
    """Write the apertures of a surface as prescription entries. Return the radius (mm) of a circle
    about the vertex of the stop, which `lens_of` may take for the stop itself; None if there is
    none."""
    record, size = surface.record, None
    for (use, label), sizes in surface.clips.items():
        shapes = [] if use == "EDG" else _shapes(surface, sizes)  # a rim clips nothing
        if use == "HOL" and shapes:
            line = next(iter(sizes.values()))[0]
            record.note(line, f"{surface.name}: a hole is read as an obscuration")
        for line, shape in shapes:
            if use != "CLR":
                surface.put_shape("obscuration", shape, line)
            elif surface.put_clear(shape, line, bool(label)) and not label:
                size = size if "centre" in shape else shape.get("circle") or size
    return size if surface.entry.get("stop") else None


def _shapes(
    surface: Surface, sizes: dict[str, tuple[int, float]]
) -> list[tuple[int, dict[str, Any]]]:
    """The shapes of one use and label, each with its line."""
    unit, found = surface.unit, []
    value = {key: size for key, (_, size) in sizes.items()}
    centre = [value.get("ADX", 0.0) * unit, value.get("ADY", 0.0) * unit]
    turned = "tilt" in surface.entry  # the axes of an XTO surface lie along y and -x
    centre = [centre[1], -centre[0]] if turned else centre
    for letter in dict.fromkeys(key[0] for key in sizes if key[0] in SIZES):
        keys = SIZES[letter]
        line = next(own for key, (own, _) in sizes.items() if key in keys)
        given = all(key in value for key in keys)
        surface.require(given, f"give both {' and '.join(keys)}", line)
        half, turn = [value[key] * unit for key in keys], value.get("ARO", 0.0) % 180
        if letter != "C" and turn not in (0, 90):
            what = f"{surface.name}: an aperture turned by {turn:g} degrees"
            surface.record.lacks(line, what)
            continue
        half = half[::-1] if (turn == 90) != turned else half
        shape: dict[str, Any] = {_SHAPES[letter]: half[0] if letter == "C" else half}
        found.append((line, shape | ({"centre": centre} if any(centre) else {})))
    return found


@dataclasses.dataclass
class Frames:
    """The axis at each surface: its origin `point` (3,), mm, and its rotation `turn` (3, 3)."""

    record: Record
    point: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    turn: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    before: list[tuple[np.ndarray, np.ndarray, bool]] = dataclasses.field(default_factory=list)

    def parts(self, surface: Surface, image: bool) -> list[Row | Breaking]:
        """A surface with the breaks before and behind it; the last part takes its thickness."""
        kind, line = surface.turn, surface.move_line
        x, y, z, a, b, c = (surface.moves.get(key, 0.0) for key in MOVES)
        shift = (x * surface.unit, y * surface.unit, z * surface.unit)
        tilt = (0.0 - a, 0.0 - b, c)  # right-handed
        own: list[Row | Breaking] = [surface]
        if kind == "RET":
            own = [self._back(surface), surface]
        elif kind == "DAR" and surface.moved:
            surface.put("decentre", [*shift[:2]], line)
            turned = np.array(tilt) + surface.entry.get("tilt", [0, 0, 0])
            surface.put("tilt", turned.tolist(), line)
            if shift[2]:
                there, away = (0.0, 0.0, shift[2]), (0.0, 0.0, -shift[2])
                own = [Breaking(line, there), surface, Breaking(line, away)]
        elif kind == "REV" and surface.moved:
            turn, back = turned_back((-tilt[0], -tilt[1], -tilt[2]))
            moved: Any = (turn @ -np.array(shift)).tolist() if any(shift) else _NONE
            own = [surface, Breaking(line, tuple(moved), back)]
        elif surface.moved:
            own = [Breaking(line, shift, tilt), surface]
            if kind == "BEN":
                one = not tilt[2] and not (tilt[0] and tilt[1])
                surface.require(one, "BEN with tilts about several axes", line)
                own.append(Breaking(line, _NONE, tilt))
        stays = own[-1] is surface and kind != "RET"
        surface.require(stays or not image, f"{kind} at the image", line)
        for part in own:
            if isinstance(part, Breaking):
                self.point = self.point + self.turn @ np.array(part.shift)
                self.turn = self.turn @ rotation_of(part.tilt)
            else:
                self.before.append((self.point, self.turn, surface.moved or kind != ""))
        self.point = self.point + self.turn @ np.array([0, 0, surface.thickness])
        if isinstance(own[-1], Breaking):
            own[-1].thickness, surface.thickness = surface.thickness, 0.0
        return own

    def _back(self, surface: Surface) -> Breaking:
        """The break from the axis here to the axis of an earlier surface."""
        require, target, line = self.record.require, surface.target, surface.move_line
        require(not surface.moved, line, "RET with a decentre or tilt of its own")
        known = 1 <= target <= len(self.before)
        require(known, line, f"RET: surface {target} is not before it")
        point, turn, moved = self.before[target - 1]
        what = f"RET: surface {target} is moved itself; return to one that is not"
        require(not moved, line, what)
        shift = self.turn.T @ (point - self.point)
        return Breaking(line, tuple(shift.tolist()), turns_of(self.turn.T @ turn))
