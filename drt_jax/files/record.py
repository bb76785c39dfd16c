"""Common parts of the readers of other programs' files: a prescription with line numbers."""

import dataclasses
import math
import re
import warnings
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np

from ..inputs import InputError, Lines, one_line, shown
from ..lens.lens import Lens
from .entry import LensError
from .order import CLOSEST, TOUCHING
from .specs import build_lens

Missing = Literal["error", "warn"]
_FAR = 1e10  # mm; from this on, a distance of a file is infinite
_LARGEST = 1e9  # largest length, angle or curvature
_TINY = 1e-6  # mm, semi-diameter of the stop until its size is known
_MEDIUM = ("glass", "index", "nd", "vd", "partial")


@dataclasses.dataclass
class Breaking:
    """A coordinate break: shift in mm, tilt in degrees about x, the turned y and the turned z, and
    thickness, the distance to the next surface or break, mm."""

    line: int
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thickness: float = 0.0


@dataclasses.dataclass
class Row:
    """A surface of a file. name: in messages. entry: as in a prescription. lines: of its keys."""

    name: str
    line: int
    entry: dict[str, Any] = dataclasses.field(default_factory=dict)
    lines: dict[str, int] = dataclasses.field(default_factory=dict)
    thickness: float = 0.0

    def put(self, key: str, value: object, line: int) -> None:
        """Set an entry and its line."""
        self.entry[key] = value
        self.lines[key] = line

    @property
    def plain(self) -> bool:
        """Whether it is a plane in air that has no effect."""
        return set(self.entry) <= {"curvature"} and not self.entry.get("curvature")


@dataclasses.dataclass
class Record:
    """A file as it is read. Lengths in mm.

    path, missing: see `load_lens`. name: of the lens. distance: of the object, below 0 for a
    virtual one behind the first vertex. medium: keys of the object's medium. parts: surfaces and
    coordinate breaks in order; the image is the last surface.
    glasses: those that the file itself defines, as in a prescription. afocal: as in `Lens`.
    notes: what is left out or read differently from the file.
    """

    path: str
    missing: Missing
    name: str = ""
    distance: float = math.inf
    parts: list[Row | Breaking] = dataclasses.field(default_factory=list)
    medium: dict[str, Any] = dataclasses.field(default_factory=dict)
    glasses: dict[str, Any] = dataclasses.field(default_factory=dict)
    afocal: bool = False
    notes: list[str] = dataclasses.field(default_factory=list)

    def error(self, line: int, message: str) -> LensError:
        """An error about a line of the file; line 0: about the whole file."""
        return LensError(f"{self.path}{f', line {line}' if line else ''}: {message}")

    def lacks(self, line: int, message: str) -> None:
        """LensError for a feature that the package lacks, or a note if it may be left out."""
        if self.missing == "error":
            raise self.error(line, f'{message}; missing="warn" leaves it out')
        self.notes.append(f"line {line}: left out: {message}")

    def note_unread(self, solves: list[int], unknown: Mapping[str, int], what: str) -> None:
        """Notes of lines with solves, and of words that are not known. what: kind of the words."""
        if solves:
            some = listed(map(str, solves), 5)
            place = f"line{'s' * (len(solves) > 1)} {some}"
            self.notes.append(f"{place}: solves and pickups are read as the values beside them")
        if unknown:
            some = listed([f"{key} (line {line})" for key, line in unknown.items()], 8)
            self.notes.append(f"{what} that are not known: {some}")

    def say(self) -> None:
        """Issue one warning that lists all notes."""
        if self.notes:
            warnings.warn(f"{self.path}: {'; '.join(self.notes)}", stacklevel=4)

    def number(
        self, line: int, words: list[str], at: int = 0, default: float | None = None
    ) -> float:
        """Word `at` as a finite number; `default` if there is no such word."""
        if at >= len(words):
            if default is None:
                raise self.error(line, f"a number is missing: word {at + 2} of the line")
            return default
        try:
            value = float(words[at]) if len(words[at]) <= 60 else math.nan
        except ValueError:
            value = math.nan
        if "_" in words[at] or not math.isfinite(value):
            raise self.error(line, f"expected a number, got {shown(words[at])}")
        return value

    def bounded(self, line: int, words: list[str], at: int = 0) -> float:
        """A number of magnitude at most 1e9, so that its square does not overflow."""
        value = self.number(line, words, at)
        if abs(value) > _LARGEST:
            raise self.error(line, f"{value:g} is not within {_LARGEST:g}; which unit?")
        return value

    def count(self, line: int, words: list[str], at: int = 0, default: int | None = None) -> int:
        """Word `at` as a whole number; `default` if there is no such word."""
        value = self.number(line, words, at, default)
        if value % 1 or abs(value) > 1e9:
            raise self.error(line, f"expected a whole number, got {value:g}")
        return int(value)

    def numbers(self, line: int, words: list[str], count: int) -> list[float]:
        """The first `count` words as numbers."""
        return [self.number(line, words, i) for i in range(count)]

    def lens(self, semi_diameter: float | None) -> Lens:
        """Build the lens; without `semi_diameter` (mm), the size of its stop is a placeholder."""
        self._spaced()
        top, lines, names = self._prescription(semi_diameter or _TINY)
        image = [part for part in self.parts if isinstance(part, Row)][-1]
        try:
            lens = build_lens(top, self.name or "lens")
        except InputError as error:
            found = re.sub(r"surfaces\[(\d+)\]", lambda m: names[int(m[1])], str(error))
            raise LensError(f"{self.path}{lines.of(error.key)}: {found}", error.key) from None
        return _with_image(lens, image)

    def _spaced(self) -> None:
        """Separate touching surfaces that bend light by the least gap, and add a note."""
        medium, sense, last, before, found = self.medium, 1, False, None, list[str]()
        gap = 0.0
        for part in self.parts:
            if isinstance(part, Breaking):
                last = False
                continue
            own = {key: part.entry[key] for key in _MEDIUM if key in part.entry}
            turns, image = part.entry.get("mirror", False), part is self.parts[-1]
            bends = turns or "phase" in part.entry or own != medium
            if last and before and (bends or image) and abs(gap) < TOUCHING:
                before.thickness += sense * CLOSEST - gap
                found.append(before.name)
            if bends:
                medium, sense = medium if turns else own, -sense if turns else sense
                last, gap = True, 0.0
            before, gap = part, gap + part.thickness
        if found:
            some = listed(found, 8)
            self.notes.append(f"surfaces that touch stand {CLOSEST:g} mm apart: {some}")

    def _prescription(self, semi_diameter: float) -> tuple[dict[str, Any], Lines, list[str]]:
        """The mapping for `build_lens`, the line of each key and the name of each surface."""
        surfaces: list[dict[str, Any]] = []
        elements: list[dict[str, Any]] = []
        lines, names, waiting = Lines(), list[str](), list[Breaking]()
        *rows, image = [part for part in self.parts if isinstance(part, Row)]
        for part in self.parts:
            if isinstance(part, Breaking):
                waiting.append(part)
                if surfaces:
                    surfaces[-1]["thickness"] += part.thickness
                else:
                    self.distance += part.thickness
                continue
            if not surfaces and self.distance <= 0 and part.plain and not waiting:
                self.distance += part.thickness  # a plane at the object
                continue
            i, behind = len(surfaces), sum(own.thickness for own in waiting)
            for own in waiting:
                lines[f"elements[{len(elements)}]"] = own.line
                elements.append(
                    {
                        "surfaces": [i, "sensor"] if part is not image else ["sensor", "sensor"],
                        "about": i if part is not image else "sensor",
                        "pivot": -behind,
                        "shift": list(own.shift),
                        "tilt": list(own.tilt),
                    }
                )
                behind -= own.thickness
            waiting = []
            if part is image:
                lines["sensor"] = part.line
                break
            place = f"surfaces[{i}]"
            lines[place] = part.line
            lines |= {f"{place}.{key}": line for key, line in part.lines.items()}
            names.append(part.name)
            surfaces.append(part.entry | {"thickness": part.thickness})
            if part.entry.get("stop"):
                surfaces[-1]["semi_diameter"] = semi_diameter
        if not surfaces:
            raise self.error(0, "no surface lies between object and image")
        if abs(self.distance) < CLOSEST:
            raise self.error(rows[0].line, "the object touches this surface")
        top: dict[str, Any] = {"surfaces": surfaces, "afocal": self.afocal}
        top |= {"elements": elements} if elements else {}
        top |= {"object": self.medium} if self.medium else {}
        top |= {"glasses": self.glasses} if self.glasses else {}
        moves = {f"sensor_{key}": image.entry.get(key) for key in ("decentre", "tilt")}
        top |= {key: value for key, value in moves.items() if value}
        return top, lines, names


def _with_image(lens: Lens, image: Row) -> Lens:
    """The lens with the curvature and conic of the file's image on its sensor."""
    curvature, conic = image.entry.get("curvature", 0.0), image.entry.get("conic", 0.0)
    if not curvature:
        return lens
    return dataclasses.replace(
        lens,
        curvature=lens.curvature.at[-1].set(curvature),
        conic=lens.conic.at[-1].set(conic),
        curved=(*lens.curved, lens.count),
    )


def listed(words: Iterable[str], most: int) -> str:
    """Words as a list of at most `most`, and how many more there are."""
    found = [*words]
    return ", ".join(found[:most]) + (f" and {n} more" if (n := len(found) - most) > 0 else "")


def distance_of(value: float) -> float:
    """A distance of a file, mm; inf from 1e10 mm on, in front of the lens or behind it."""
    return math.inf if abs(value) >= _FAR else value


def rotation_of(tilt: tuple[float, float, float]) -> np.ndarray:
    """The rotation matrix (3, 3) of tilts in degrees about x, the turned y and the turned z."""
    x, y, z = _turns(tilt)
    return x @ y @ z


def _turns(tilt: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a, b, c = np.radians(tilt)
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return x, y, z


def turns_of(turn: np.ndarray) -> tuple[float, float, float]:
    """Tilts in degrees about x, the turned y and the turned z of a rotation matrix (3, 3)."""
    return (
        math.degrees(math.atan2(-turn[1, 2], turn[2, 2])),
        math.degrees(math.asin(max(-1.0, min(1.0, turn[0, 2])))),
        math.degrees(math.atan2(-turn[0, 1], turn[0, 0])),
    )


def turned_back(tilt: tuple[float, float, float]) -> tuple[np.ndarray, tuple[float, float, float]]:
    """The rotation matrix (3, 3) of tilts in degrees about z, the turned y and the turned x, and
    the same rotation as tilts about x, the turned y and the turned z."""
    x, y, z = _turns(tilt)
    turn = z @ y @ x
    return turn, tilt if np.count_nonzero(tilt) <= 1 else turns_of(turn)


def short(text: str) -> str:
    """Text of a file on one line of at most 60 characters, for messages and names."""
    return one_line(text)[:60]
