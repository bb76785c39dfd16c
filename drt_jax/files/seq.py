"""Read lens files of CODE V, `.seq`; docs/lens_files.md says what each command means."""

import dataclasses
import math
from typing import Any, get_args

import numpy as np

from .record import (
    ApertureKind,
    Breaking,
    FieldKind,
    Missing,
    Record,
    Row,
    distance_of,
    rotation_of,
    short,
    turned_back,
    turns_of,
)
from .seq_glass import Glasses
from .seq_surfaces import MOVES, ON_SURFACES, Surface, move
from .seq_text import (
    COSMETIC,
    REFUSED,
    SOLVES,
    SURFACE,
    Command,
    command_of,
    commands_of,
    micrometres,
)
from .specs import SURFACES

_UNITS = {"M": 1.0, "MM": 1.0, "C": 10.0, "CM": 10.0, "I": 25.4, "IN": 25.4}
_APERTURES: dict[str, ApertureKind] = {
    "EPD": "pupil diameter",
    "FNO": "f-number",
    "NA": "image NA",
    "NAO": "object NA",
}
FIELDS = dict(zip(("AN", "OB", "IM", "RI"), get_args(FieldKind), strict=True))
VIGNETTING = ("VUX", "VLX", "VUY", "VLY")
_HEIGHTS = tuple(f"{axis}{kind}" for axis in "XY" for kind in FIELDS)
_LISTS = (*_HEIGHTS, *VIGNETTING, "WTF", "WL", "WTW", "REF")
_MOST = 1000  # fields or wavelengths
_NONE = (0.0, 0.0, 0.0)


class _Reader:
    """The state of reading one file.

    lists, list_lines: numbers of fields and wavelengths by key, and the line of each key's last
        command.
    unit: unit of length, mm.
    radii: whether surfaces have radii (True) or curvatures; None before a command RDM.
    complete: whether the image surface has been read.
    stop: number of the stop surface, 0 until it is known.
    clips: whether apertures are used.
    wanted: the zoom position to read, see `load_system`.
    """

    def __init__(self, path: str, missing: Missing, wanted: int | None):
        self.record, self.wanted = Record(path, missing), wanted
        self.glasses = Glasses(self.record)
        self.lists: dict[str, list[float]] = {}
        self.list_lines: dict[str, int] = {}
        self.surfaces: list[Surface] = []
        self.unit, self.complete, self.stop, self.clips = 1.0, False, 0, True
        self.radii: bool | None = None

    def at(self, command: Command, name: str) -> int:
        """The index of the surface that a qualifier names; 0 is the object."""
        if name == "I" and self.complete:
            return len(self.surfaces) - 1
        known = {"O": 0, "S": self.stop or 1}.get(name, int(name) if name.isdecimal() else -1)
        command.require(0 <= known < len(self.surfaces), f"there is no surface S{name} yet")
        return known

    def targets(self, command: Command) -> list[Surface]:
        """The surfaces that a command applies to: those it names, or else the last one."""
        named = command.of("S")
        command.require(self.surfaces, f"{short(command.key)} before any surface")
        if named is None:
            return [self.surfaces[-1]]
        first, last = (self.at(command, name) for name in named)
        return self.surfaces[first : last + 1]

    def numbers(self, command: Command) -> None:
        """Read a list for all fields or wavelengths, or one number of it if a qualifier F or W
        names its place."""
        key, at = command.key, command.of("F") or command.of("W")
        values = command.numbers(0, max(len(command.values), 1))
        command.require(len(values) <= _MOST, f"{key}: more than {_MOST} numbers")
        self.list_lines[key] = command.line
        if at is None:
            self.lists[key] = values
            return
        one = len(values) == 1 and at[0].isdecimal() and at[0] == at[1]
        command.require(one, f"{key}: expected one number behind one field or wavelength")
        place, own = int(at[0]) - 1, self.lists.setdefault(key, [])
        command.require(0 <= place < _MOST, f"{key}: there is no number {place + 1}")
        own += [0.0] * (place + 1 - len(own))
        own[place] = values[0]


def _surface(reader: _Reader, command: Command) -> None:
    """S, SO, SI or S with a number: start a new surface, or change an existing one."""
    name, due, words = command.key[1:], len(reader.surfaces), command.values
    before = not reader.complete or name == "I" or name.isdecimal()
    command.require(name != "S" and before, f"{command.key}: a surface behind the image")
    number = {"": due, "O": 0, "I": due - reader.complete}.get(name)
    number = int(name) if number is None else number
    reader.complete = reader.complete or name == "I"
    command.require(number <= due, f"{command.key} stands where S{due} should")
    command.require(number <= SURFACES, f"more than {SURFACES} surfaces")
    if number == due:
        called = {"O": "SO", "I": "SI"}.get(name, f"S{number}")
        reader.surfaces.append(Surface(reader.record, called, command.line))
    own = reader.surfaces[number]
    keys = ("RDY" if reader.radii else "CUY", "THI", "GLA")
    for key, values in zip(keys, (words[:1], words[1:2], words[2:]), strict=True):
        if values:
            ON_SURFACES[key](own, dataclasses.replace(command, key=key, values=values))


def _zoom(reader: _Reader, command: Command) -> None:
    """`ZOO 3`, or a command with a value for each zoom position."""
    record, line, words = reader.record, command.line, command.values
    if words and words[0].isdecimal():
        record.choose(line, command.count(), 1, reader.wanted)
    elif words:
        own = command_of(record, line, words[0].upper()[:3], words[1:])
        known = own.key not in _LISTS or own.qualifiers
        own.require(known, f"ZOO {own.key}: name the field or the wavelength, as F1 or W1")
        if own.values:
            at, count = record.configuration, len(own.values)
            own.require(count in (1, record.configurations), f"ZOO {own.key}: {count} values")
            value = own.values[at - 1 if count > 1 else 0]
            _take(reader, dataclasses.replace(own, values=[value]))


def _take(reader: _Reader, command: Command) -> None:
    """Execute a command that is not in the private catalogue.

    The order of the cases matters: a key may be a surface, a list of fields or wavelengths, a
    command of the whole lens, a solve, or a command of one surface. Other keys are ignored, refused
    or noted as unknown.
    """
    if (zoom := command.of("Z")) and str(reader.record.configuration) not in zoom:
        return  # for another zoom position, see `_zoom`
    record, use, line = reader.record, reader.record.use, command.line
    first = command.values[0].upper() if command.values else ""
    match command.key:
        case key if SURFACE.fullmatch(key):
            _surface(reader, command)
        case key if key in _LISTS:
            reader.numbers(command)
        case "TIT":
            record.name = short(" ".join(command.values))
        case "RDM":
            reader.radii = first[:1] != "N"
        case "CA":
            reader.clips = first[:1] != "N"
        case "LEN":
            command.require(not reader.surfaces, "a second lens begins; give it a file of its own")
        case "DIM" | "DDM":
            what = f"DIM {short(first)}: expected M (millimetres), C or I"
            command.require(first in _UNITS, what)
            reader.unit = _UNITS[first]
        case "TEM" | "PRE" as key:
            ours, unit = (20, "C") if key == "TEM" else (760, "mm Hg")
            value = command.number()
            if abs(value - ours) > ours / 4:
                record.lacks(line, f"{value:g} {unit}; our indices are those of {ours}")
            elif value != ours:
                record.note(line, f"{value:g} {unit}; indices are those of {ours}")
        case "EPD" | "FNO" | "NA" | "NAO" as key:
            use.line, use.aperture, use.aperture_kind = line, command.number(), _APERTURES[key]
        case "STO":
            named = command.of("S")
            reader.stop = reader.at(command, named[0]) if named else len(reader.surfaces) - 1
        case "RET":
            own = [first for letter, first, _ in command.qualifiers if letter == "S"]
            command.require(1 <= len(own) <= 2, "RET: expected the surface to return to, as RET S2")
            moved = reader.at(command, own[0]) if len(own) == 2 else len(reader.surfaces) - 1
            command.require(reader.surfaces, "RET before any surface")
            move(reader.surfaces[moved], command)
            reader.surfaces[moved].target = reader.at(command, own[-1])
        case "ZOO":
            _zoom(reader, command)
        case key if key in SOLVES:
            record.solves.append(line)
        case key if key in ON_SURFACES:
            for surface in reader.targets(command):
                ON_SURFACES[key](surface, command)
        case key if key not in COSMETIC:
            command.require(key not in REFUSED, f"{key} is not read")
            record.unknown.setdefault(short(key), line)


def read_seq(
    path: str, missing: Missing, lines: list[str], configuration: int | None = None
) -> Record:
    """Read the lines of a `.seq` file into a record of its surfaces, fields, wavelengths and
    aperture. LensError with the line. path: its name in messages. configuration: see
    `load_system`."""
    reader, private, ended = _Reader(path, missing, configuration), False, False
    for own in commands_of(reader.record, lines):
        if ended:
            note = f"what follows the GO of the lens, from line {own.line} on, is not read"
            reader.record.notes.append(note)
            break
        ended = reader.complete and own.key == "GO" and not own.quoted
        if own.key in ("PRV", "END") and not own.quoted:
            private = own.key == "PRV"
        elif private:
            reader.glasses.take(own)
        elif own.key:
            _take(reader, own)
    _finish(reader)
    return reader.record


def _finish(reader: _Reader) -> None:
    """Do the checks and conversions that need all commands."""
    record, surfaces = reader.record, reader.surfaces
    use, require = record.use, record.require
    waves = use.wavelengths = [*map(micrometres, reader.lists.get("WL", []))]
    require(surfaces, 0, "no surface, SO, S or SI: is it a .seq file?")
    whole = reader.complete and len(surfaces) > 2
    require(whole, surfaces[-1].line, "no SI follows, the image: is the file cut short?")
    if reader.radii is None:
        record.notes.append("no RDM: the numbers of surfaces are curvatures")
    require(0 < (reader.stop or 1) < len(surfaces) - 1, 0, "the stop is no surface of the lens")
    if not reader.stop:
        record.notes.append("no STO: the stop is surface 1")
    record.note_unread("commands")
    if record.configurations == 1:
        record.choose(0, 1, 1, reader.wanted)
    require(waves, 0, "no wavelength is given: WL, in nm")
    require(use.aperture_kind, 0, "no aperture is given: EPD, FNO, NA or NAO")
    surfaces[reader.stop or 1].put("stop", True)
    _use(reader)
    _parts(reader)
    if use.aperture_kind == "pupil diameter":
        use.aperture = (use.aperture or 0.0) * reader.unit
    elif use.aperture_kind == "f-number" and math.isfinite(record.distance) and use.aperture:
        use.aperture, use.aperture_kind = 1 / (2 * use.aperture), "image NA"
    use.ray_aiming = "chief"


def _use(reader: _Reader) -> None:
    """Write fields and wavelengths in the form of `System`.

    A list that is missing, or shorter than the number of fields or wavelengths, is filled up with
    its default value; a longer one raises LensError.
    """
    record, lists, lines = reader.record, reader.lists, reader.list_lines
    use, waves = record.use, record.use.wavelengths

    def column(key: str, default: float, count: int) -> list[float]:
        values = lists.get(key, [])
        what = f"{key} has {len(values)} numbers for {count}"
        record.require(len(values) <= count, lines.get(key, 0), what)
        return values + [default] * (count - len(values))

    record.require(min(waves) > 0, lines["WL"], f"a wavelength of {1000 * min(waves):g} nm")
    use.wavelength_weights = column("WTW", 1.0, len(waves))
    reference = lists.get("REF", [float(len(waves) // 2 + 1)])[0]
    use.primary, use.primary_line = int(reference) - 1, lines.get("REF", 0)
    what = f"REF {reference:g}: expected a whole number"
    record.require(reference % 1 == 0, use.primary_line, what)
    if "REF" not in lists and len(waves) > 1:
        record.notes.append("no REF: the reference is the wavelength in the middle")
    given = [key for key in _HEIGHTS if key in lists]
    kinds = {key[1:] for key in given} or {"AN"}
    use.field_line = max((lines[key] for key in given), default=0)
    what = f"fields of two kinds: {', '.join(given)}"
    record.require(len(kinds) == 1, lines[given[-1]] if given else 0, what)
    kind, count = kinds.pop(), max((len(lists[key]) for key in given), default=1)
    use.field_kind = FIELDS[kind]
    scale = 1.0 if kind == "AN" else reader.unit
    x, y = (column(f"{axis}{kind}", 0.0, count) for axis in "XY")
    use.heights = [(a * scale, b * scale) for a, b in zip(x, y, strict=True)]
    use.field_weights = column("WTF", 1.0, count)
    use.vignetting = [
        [(b - a) / 2, (d - c) / 2, (a + b) / 2, (c + d) / 2, 0.0]
        for a, b, c, d in zip(*(column(key, 0.0, count) for key in VIGNETTING), strict=True)
    ]


@dataclasses.dataclass
class _Frames:
    """The local axes at each surface: origin `point` (3,), mm, and rotation `turn` (3, 3)."""

    record: Record
    point: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    turn: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    before: list[tuple[np.ndarray, np.ndarray, bool]] = dataclasses.field(default_factory=list)

    def parts(self, surface: Surface, image: bool) -> list[Row | Breaking]:
        """A surface with the breaks in front of it and behind it; the last part has its thickness.

        A decentre and tilt becomes a break in front of the surface, which moves all that follows.
        With DAR only the surface is moved. With REV the inverse break follows the surface. With BEN
        the tilt is repeated behind the surface, as at a folding mirror. RET returns to the axis of
        an earlier surface.
        """
        kind, line = surface.turn, surface.move_line
        x, y, z, a, b, c = (surface.moves.get(key, 0.0) for key in MOVES)
        shift = (x * surface.unit, y * surface.unit, z * surface.unit)
        tilt = (0.0 - a, 0.0 - b, c)  # right-handed
        before: Breaking | None = None
        behind: Breaking | None = None
        if kind == "RET":
            before = self._back(surface)
        elif kind == "DAR" and surface.moved:
            surface.put("decentre", [*shift[:2]], line)
            turned = np.array(tilt) + surface.entry.get("tilt", [0, 0, 0])
            surface.put("tilt", turned.tolist(), line)
            if shift[2]:
                before = Breaking(line, (0.0, 0.0, shift[2]))
                behind = Breaking(line, (0.0, 0.0, -shift[2]))
        elif kind == "REV" and surface.moved:
            turn, back = turned_back((-tilt[0], -tilt[1], -tilt[2]))
            moved: Any = (turn @ -np.array(shift)).tolist() if any(shift) else _NONE
            behind = Breaking(line, tuple(moved), back)
        elif surface.moved:
            before = Breaking(line, shift, tilt)
            if kind == "BEN":
                one = not tilt[2] and not (tilt[0] and tilt[1])
                surface.require(one, "BEN with tilts about several axes", line)
                behind = Breaking(line, _NONE, tilt)
        stays = not behind and kind != "RET"
        surface.require(stays or not image, f"{kind} at the image", line)
        own: list[Row | Breaking] = [part for part in (before, surface, behind) if part]
        for part in own:
            if isinstance(part, Breaking):
                self.point = self.point + self.turn @ np.array(part.shift)
                self.turn = self.turn @ rotation_of(part.tilt)
            else:
                self.before.append((self.point, self.turn, surface.moved or kind != ""))
        self.point = self.point + self.turn @ np.array([0, 0, surface.thickness])
        if behind:
            behind.thickness, surface.thickness = surface.thickness, 0.0
        return own

    def _back(self, surface: Surface) -> Breaking:
        """The break from the axis here to the axis of an earlier surface."""
        require, target, line = self.record.require, surface.target, surface.move_line
        require(not surface.moved, line, "RET with a decentre or tilt of its own")
        require(1 <= target <= len(self.before), line, f"RET: surface {target} is not before it")
        point, turn, moved = self.before[target - 1]
        what = f"RET: surface {target} is moved itself; return to one that is not"
        require(not moved, line, what)
        shift = self.turn.T @ (point - self.point)
        return Breaking(line, tuple(shift.tolist()), turns_of(self.turn.T @ turn))


def _parts(reader: _Reader) -> None:
    """Convert object, surfaces and image to parts of the record, in mm."""
    record, unit, (first, *others) = reader.record, reader.unit, reader.surfaces
    flat = not (first.curvature or first.values or first.moved or first.turn)
    record.require(flat, first.line, "SO: an object that is not flat on the axis")
    record.distance = distance_of(first.gap * unit if first.gap < 1e9 else math.inf)
    record.medium = reader.glasses.medium(first)
    image, frames = others[-1], _Frames(record)
    others[-2].gap += image.gap  # defocus
    image.gap = 0.0
    for surface in others:
        surface.unit, surface.thickness = unit, surface.gap * unit
        line = surface.lines.get("thickness", 0)
        surface.require(abs(surface.thickness) < 1e9, "an infinite thickness", line)
        surface.entries()
        if surface is image:
            flat = not ({"form", "coefficients"} & surface.entry.keys() or surface.phase)
            surface.require(flat, "an aspheric image")
        else:
            surface.entry |= reader.glasses.medium(surface)
            surface.diffraction()
        if surface.clips and surface is image:
            record.notes.append("apertures of the image clip nothing")
        elif surface.clips and reader.clips:
            size = surface.clip()
            record.use.stop = size if surface.entry.get("stop") else record.use.stop
        record.parts += frames.parts(surface, surface is image)
    if not reader.clips:
        record.notes.append("CA NO: the apertures are not used")
    record.glasses = reader.glasses.used
