"""Files of other programs: their lines and words, and the prescription built from them."""

import codecs
import contextlib
import dataclasses
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal

import numpy as np

from ..inputs import InputError, Lines, one_line, read_bytes, shown, warn
from ..lens.forms import powers_xy
from ..lens.lens import Lens
from .entry import LensError
from .specs import CLOSEST, MEDIUM_KEYS, TOUCHING, build_lens

Missing = Literal["error", "warn"]
ApertureKind = Literal[
    "pupil diameter", "f-number", "working f-number", "object NA", "object cone angle", "image NA"
]
FieldKind = Literal["angle", "object height", "paraxial image height", "real image height"]
# Name and degree of each term of a polynomial in x and y.
XY: list[tuple[Any, int]] = [(f"x{i}y{j}", i + j) for i, j in powers_xy(300)]
_FILE = 2**24  # bytes of a file
_LINES = 400_000
LONGEST = 4000  # characters read of a line
_FAR = 1e10  # mm; from this on, a distance of a file is infinite
_LARGEST = 1e9  # largest length, angle or curvature
_TINY = 1e-6  # mm, semi-diameter of the stop until its size is known
_MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_LE: "utf-16", codecs.BOM_BE: "utf-16"}


@dataclasses.dataclass
class Breaking:
    """A coordinate break.

    shift: decentre, mm. tilt: degrees about x, the rotated y and the rotated z.
    thickness: distance to the next surface or break, mm.
    """

    line: int
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thickness: float = 0.0


@dataclasses.dataclass
class Use:
    """Fields, wavelengths and aperture of a file, with the names of `System`.

    stop: size of the stop, mm, if the file gives it.
    line, field_line, primary_line: lines of the aperture, the fields and the wavelengths.
    """

    aperture: float | None = None
    aperture_kind: ApertureKind | None = None
    field_kind: FieldKind = "angle"
    heights: list[tuple[float, float]] = dataclasses.field(default_factory=lambda: [(0.0, 0.0)])
    field_weights: list[float] = dataclasses.field(default_factory=lambda: [1.0])
    vignetting: list[list[float]] = dataclasses.field(default_factory=lambda: [[0.0] * 5])
    wavelengths: list[float] = dataclasses.field(default_factory=list)
    wavelength_weights: list[float] = dataclasses.field(default_factory=list)
    primary: int = 0
    ray_aiming: str = ""
    stop: float | None = None
    line: int = 0
    field_line: int = 0
    primary_line: int = 0


@dataclasses.dataclass
class Record:
    """What has been read from a file so far. Lengths in mm.

    path, missing: see `load_lens`.
    name: of the lens.
    use: fields, wavelengths and aperture.
    distance: of the object; below 0 for a virtual object behind the first vertex.
    medium: keys of the medium of object space.
    parts: surfaces and coordinate breaks in order; the image is the last surface.
    glasses: glasses that the file defines, as in a prescription.
    afocal: as in `Lens`.
    configurations: number of configurations. configuration: the one that is read, from 1.
    notes: what is left out or read differently from the file.
    solves: lines with solves. unknown: unknown words, each with its line.
    """

    path: str
    missing: Missing
    name: str = ""
    use: Use = dataclasses.field(default_factory=Use)
    distance: float = math.inf
    parts: list["Row | Breaking"] = dataclasses.field(default_factory=list)
    medium: dict[str, Any] = dataclasses.field(default_factory=dict)
    glasses: dict[str, Any] = dataclasses.field(default_factory=dict)
    afocal: bool = False
    notes: list[str] = dataclasses.field(default_factory=list)
    solves: list[int] = dataclasses.field(default_factory=list)
    unknown: dict[str, int] = dataclasses.field(default_factory=dict)
    configurations: int = 1
    configuration: int = 1

    def error(self, line: int, message: str) -> LensError:
        """An error about a line of the file; line 0: about the whole file."""
        return LensError(f"{self.path}{f', line {line}' if line else ''}: {message}")

    def require(self, condition: object, line: int, message: str) -> None:
        """Raise `error` unless the condition holds."""
        if not condition:
            raise self.error(line, message)

    def lacks(self, line: int, message: str) -> None:
        """LensError for an unsupported feature, or a note if it may be left out."""
        if self.missing == "error":
            raise self.error(line, f'{message}; missing="warn" leaves it out')
        self.note(line, f"left out: {message}")

    def note(self, line: int, message: str) -> None:
        """Add a note about a line."""
        self.notes.append(f"line {line}: {message}")

    def choose(self, line: int, count: int, current: int, wanted: int | None) -> None:
        """Set the configuration that is read: `wanted` or, if that is None, `current` with a note.
        LensError for a number that does not exist."""
        self.configurations, self.configuration = count, current if wanted is None else wanted
        some = f"the file has {count}, from 1" if count > 1 else "the file has one alone"
        known = wanted is None or (isinstance(wanted, int) and 1 <= wanted <= count)
        self.require(known, line, f"there is no configuration {wanted!r}; {some}")
        if wanted is None and count > 1:
            self.note(line, f"of {count} configurations number {current}; give `configuration`")

    def note_unread(self, what: str) -> None:
        """Add notes of solves and of unknown words. what: kind of the words."""
        if self.solves:
            some = _listed(map(str, self.solves), 5)
            place = f"line{'s' * (len(self.solves) > 1)} {some}"
            self.notes.append(f"{place}: solves and pickups are read as their present values")
        if self.unknown:
            some = _listed([f"{key} (line {line})" for key, line in self.unknown.items()], 8)
            self.notes.append(f"{what} that are not known: {some}")

    def say(self) -> None:
        """Issue one warning that lists all notes."""
        if self.notes:
            warn(f"{self.path}: {'; '.join(self.notes)}")

    def lens(self, semi_diameter: float | None) -> Lens:
        """Build the lens; without `semi_diameter` (mm), the size of its stop is a placeholder."""
        self._separate()
        *rows, image = [part for part in self.parts if isinstance(part, Row)]
        top, lines, names = self._prescription(semi_diameter or _TINY)
        self.require(names, 0, "no surface lies between object and image")
        self.require(abs(self.distance) >= CLOSEST, rows[0].line, "the object touches this surface")
        moves = {f"sensor_{key}": image.entry.get(key) for key in ("decentre", "tilt")}
        more = {"object": self.medium, "glasses": self.glasses, "afocal": self.afocal, **moves}
        top |= {key: value for key, value in more.items() if value}
        try:
            lens = build_lens(top, self.name or "lens")
        except InputError as error:
            found = re.sub(r"surfaces\[(\d+)\]", lambda m: names[int(m[1])], str(error))
            raise LensError(f"{self.path}{lines.of(error.key)}: {found}", error.key) from None
        if not (curvature := image.entry.get("curvature", 0.0)):
            return lens
        bent = lens.curvature.at[-1].set(curvature)
        conic = lens.conic.at[-1].set(image.entry.get("conic", 0.0))
        curved = (*lens.curved, lens.count)
        return dataclasses.replace(lens, curvature=bent, conic=conic, curved=curved)

    def _separate(self) -> None:
        """Separate touching surfaces that bend light by the least gap, and add a note."""
        medium, sense, gap, found = self.medium, 1, 0.0, list[str]()
        before: Row | None = None  # the surface in front, if one before it bends light
        for part in self.parts:
            if isinstance(part, Breaking):
                before = None
                continue
            own = {key: part.entry[key] for key in MEDIUM_KEYS if key in part.entry}
            mirror = part.entry.get("mirror", False)
            bends = mirror or "phase" in part.entry or own != medium
            if before and (bends or part is self.parts[-1]) and abs(gap) < TOUCHING:
                before.thickness += sense * CLOSEST - gap
                found.append(before.name)
            if bends:
                medium, sense, gap = medium if mirror else own, -sense if mirror else sense, 0.0
            before, gap = part if bends or before else None, gap + part.thickness
        if found:
            some = _listed(found, 8)
            self.notes.append(f"surfaces that touch stand {CLOSEST:g} mm apart: {some}")

    def _prescription(self, semi_diameter: float) -> tuple[dict[str, Any], Lines, list[str]]:
        """Surfaces and elements for `build_lens`, the line of each key, and the name of each
        surface. The distance of the object is measured from the first surface.

        A coordinate break becomes an element from the next surface to the sensor. Its pivot lies on
        the axis in front of this surface, at the position of the break. The thickness of the break
        is added to that of the surface before it. Planes in air without an effect in front of the
        first surface are left out.
        """
        surfaces: list[dict[str, Any]] = []
        elements: list[dict[str, Any]] = []
        lines, names, waiting = Lines(), list[str](), list[Breaking]()
        for part in self.parts:
            inside = surfaces or waiting or self.distance > 0
            if isinstance(part, Breaking) or (part.plain and not inside):
                waiting += [part] if isinstance(part, Breaking) else []
                if surfaces:
                    surfaces[-1]["thickness"] += part.thickness
                else:
                    self.distance += part.thickness
                continue
            image, behind = part is self.parts[-1], sum(own.thickness for own in waiting)
            i: int | str = "sensor" if image else len(surfaces)
            for own in waiting:
                lines[f"elements[{len(elements)}]"] = own.line
                turned = {"shift": list(own.shift), "tilt": list(own.tilt)}
                elements.append({"surfaces": [i, "sensor"], "about": i, "pivot": -behind, **turned})
                behind -= own.thickness
            waiting = []
            if image:
                lines["sensor"] = part.line
                break
            place = f"surfaces[{i}]"
            lines[place] = part.line
            lines |= {f"{place}.{key}": line for key, line in part.lines.items()}
            names.append(part.name)
            surfaces.append(part.entry | {"thickness": part.thickness})
            if part.entry.get("stop"):
                surfaces[-1]["semi_diameter"] = semi_diameter
        return {"surfaces": surfaces} | ({"elements": elements} if elements else {}), lines, names


@dataclasses.dataclass
class Row:
    """A surface of a file.

    name: its name in messages. unit: unit of length of the file, mm. kind: its type.
    values: (line, value) of each parameter, by number or key as in the file.
    entry: its entry in a prescription, in mm. lines: the line of each key of `entry`.
    thickness: mm.
    """

    record: Record
    name: str
    line: int
    unit: float = 1.0
    kind: str = ""
    kind_line: int = 0
    values: dict[Any, tuple[int, float]] = dataclasses.field(default_factory=dict)
    entry: dict[str, Any] = dataclasses.field(default_factory=dict)
    lines: dict[str, int] = dataclasses.field(default_factory=dict)
    thickness: float = 0.0

    def require(self, condition: object, message: str, line: int = 0) -> None:
        """LensError about the surface unless the condition holds. line: line for the message, 0
        for the first line of the surface."""
        if not condition:
            raise self.record.error(line or self.line, f"{self.name}: {message}")

    def put(self, key: str, value: object, line: int = 0) -> None:
        """Set a key of the entry. line: its line in the file, 0 for that of the surface."""
        self.entry[key] = value
        self.lines[key] = line or self.line

    def value(self, key: object) -> float:
        """A parameter; 0 if it is not given."""
        return self.values.get(key, (0, 0.0))[1]

    def powers(self, keys: Mapping[Any, int]) -> dict[int, float]:
        """Coefficients that are not 0, in mm. keys: the power of the height of each parameter."""
        return {p: a for key, p in keys.items() if (a := self.value(key) * self.unit ** (1 - p))}

    def shape(self, form: str, terms: Mapping[Any, float], **more: object) -> None:
        """Set the form, its coefficients if there are any, and its other keys, `more`."""
        own = {"form": form} if form != "asphere" else {}
        for key, value in (own | ({"coefficients": terms} if terms else {}) | more).items():
            self.put(key, value, self.kind_line)

    def put_shape(self, key: str, shape: Mapping[str, Any], line: int) -> None:
        """Add a shape to the entry `aperture` or `obscuration`."""
        self.put(key, [*self.entry.get(key, []), shape], line)

    def put_clear(self, shape: Mapping[str, Any], line: int, named: bool = False) -> bool:
        """Add a clear aperture. Return False for a circle beyond the domain of the sag, which clips
        nothing.

        The first circle about the vertex becomes the semi-diameter, except at the stop, whose size
        follows from the aperture of the file, and except for a circle that is `named`.
        """
        entry, radius = self.entry, 0.0 if "centre" in shape else shape.get("circle", 0.0)
        rim = (entry.get("conic", 0.0) + 1) * (entry["curvature"] * radius) ** 2
        if entry.get("form") is None and rim >= 1:
            return False
        if radius and not (named or entry.get("stop") or "semi_diameter" in entry):
            self.put("semi_diameter", radius, line)
        else:
            self.put_shape("aperture", shape, line)
        return True

    @property
    def plain(self) -> bool:
        """Whether it is a plane in air that has no effect."""
        return set(self.entry) <= {"curvature"} and not self.entry.get("curvature")


@dataclasses.dataclass
class Words:
    """A line of a file, or a command.

    line: its number from 1. key: its first word. values: its other words.
    indented: whether the line is indented.
    """

    record: Record
    line: int
    key: str
    values: list[str]
    indented: bool = False

    def require(self, condition: object, message: str) -> None:
        """LensError about this line unless the condition holds."""
        self.record.require(condition, self.line, message)

    def number(self, at: int = 0, default: float | None = None) -> float:
        """Value `at` as a finite number; `default` if there is no such value."""
        if at >= len(self.values) and default is not None:
            return default
        self.require(at < len(self.values), f"a number is missing: word {at + 2} of the line")
        word, value = self.values[at], math.nan
        if len(word) <= 60 and "_" not in word:
            with contextlib.suppress(ValueError):
                value = float(word)
        if not math.isfinite(value):
            raise self.record.error(self.line, f"expected a number, got {shown(word)}")
        return value

    def numbers(self, first: int, end: int) -> list[float]:
        """`values[first:end]` as numbers."""
        return [self.number(at) for at in range(first, end)]

    def bounded(self, at: int = 0) -> float:
        """A number of magnitude at most 1e9, so that its square does not overflow."""
        value = self.number(at)
        self.require(abs(value) <= _LARGEST, f"{value:g} is not within {_LARGEST:g}; which unit?")
        return value

    def count(self, at: int = 0, default: int | None = None) -> int:
        """Value `at` as a whole number; `default` if there is no such value."""
        value = self.number(at, default)
        whole = value % 1 == 0 and abs(value) <= 1e9
        self.require(whole, f"expected a whole number, got {value:g}")
        return int(value)


@contextlib.contextmanager
def naming(path: str | os.PathLike) -> Iterator[None]:
    """Turn an InputError about a file into a LensError that begins with its path."""
    try:
        yield
    except LensError:
        raise
    except InputError as error:
        raise LensError(f"{path}: {error}") from error


def lines_of(path: str | os.PathLike) -> list[str]:
    """The lines of a file of at most 16 MB. A byte order mark or the zero bytes of UTF-16 decide
    the encoding; otherwise it is UTF-8 if the file is valid UTF-8, else Latin-1. InputError, with
    the byte or character, if the file is not text."""
    content = read_bytes(path, _FILE, "lens file")
    known = next((name for mark, name in _MARKS.items() if content.startswith(mark)), "")
    head = content[:1000]
    for start, name in (1, "utf-16-le"), (0, "utf-16-be"):
        if not known and head[start::2].count(0) > len(head) // 4:
            known = name
    try:
        text = content.decode(known or "utf-8")
    except UnicodeDecodeError as error:
        if known:
            what = f"byte {error.start} is no {known} text: is the file cut short?"
            raise InputError(what) from error
        text = content.decode("latin-1")
    odd = re.search("[\x00-\x08\x0e-\x19\x1b-\x1f]", text)
    if odd:
        raise InputError(f"character {odd.start()} is no text: is this a lens file?")
    lines = text.splitlines()
    if len(lines) > _LINES:
        raise InputError(f"{len(lines)} lines are more than {_LINES}; is it the right file?")
    return lines


def words_of(record: Record, lines: list[str]) -> list[Words]:
    """The lines of a file split into words, without empty lines; long notes are truncated."""
    found = []
    for i, text in enumerate(lines, 1):
        if len(text) > LONGEST and re.match(r"\s*[A-Z]{4}\s+[-+.\d]", text):
            raise InputError(f"line {i}: {len(text)} characters are more than {LONGEST}")
        words = text[:LONGEST].split()
        if words:
            key, indented = one_line(words[0]).upper(), text[0].isspace()
            found.append(Words(record, i, key, words[1:], indented))
    return found


def _listed(words: Iterable[str], most: int) -> str:
    """Words as a list of at most `most`, and how many more there are."""
    found = [*words]
    return ", ".join(found[:most]) + (f" and {n} more" if (n := len(found) - most) > 0 else "")


def distance_of(value: float) -> float:
    """A distance of a file, mm; inf if its magnitude is 1e10 mm or more."""
    return math.inf if abs(value) >= _FAR else value


def rotation_of(tilt: tuple[float, float, float]) -> np.ndarray:
    """The rotation matrix (3, 3) of tilts in degrees about x, the rotated y and the rotated z."""
    x, y, z = _turns(tilt)
    return x @ y @ z


def _turns(tilt: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a, b, c = np.radians(tilt)
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return x, y, z


def turns_of(turn: np.ndarray) -> tuple[float, float, float]:
    """Tilts in degrees about x, the rotated y and the rotated z of a rotation matrix (3, 3)."""
    return (
        math.degrees(math.atan2(-turn[1, 2], turn[2, 2])),
        math.degrees(math.asin(max(-1.0, min(1.0, turn[0, 2])))),
        math.degrees(math.atan2(-turn[0, 1], turn[0, 0])),
    )


def turned_back(tilt: tuple[float, float, float]) -> tuple[np.ndarray, tuple[float, float, float]]:
    """The rotation matrix (3, 3) of tilts in degrees about z, the rotated y and the rotated x, and
    the same rotation as tilts about x, the rotated y and the rotated z."""
    x, y, z = _turns(tilt)
    turn = z @ y @ x
    return turn, tilt if np.count_nonzero(tilt) <= 1 else turns_of(turn)


def short(text: str) -> str:
    """Text of a file on one line of at most 60 characters, for messages and names."""
    return one_line(text)[:60]
