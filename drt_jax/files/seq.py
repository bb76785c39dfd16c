"""Read lens files of CODE V, `.seq`; docs/lens_files.md says what each command means."""

import math
from collections.abc import Callable

from . import seq_apertures, seq_places, seq_surfaces
from .record import Missing, Record, Row, distance_of, short
from .seq_fields import FIELD_KEYS, WAVE_KEYS, Fields
from .seq_glass import Glasses
from .seq_places import Frames
from .seq_surfaces import Surface
from .seq_text import COSMETIC, REFUSED, SOLVES, Command, command_of, commands_of
from .system import ApertureKind, Use

_UNITS = {"M": 1.0, "MM": 1.0, "C": 10.0, "CM": 10.0, "I": 25.4, "IN": 25.4}
_SURFACES = 5000
_APERTURES: dict[str, ApertureKind] = {
    "EPD": "pupil diameter",
    "FNO": "f-number",
    "NA": "image NA",
    "NAO": "object NA",
}


class _Reader:
    """The state of reading one file."""

    def __init__(self, path: str, missing: Missing):
        self.record, self.use, self.fields = Record(path, missing), Use(), Fields()
        self.glasses = Glasses(self.record)
        self.unit, self.radii, self.said_radii = 1.0, False, False
        self.surfaces: list[Surface] = []
        self.complete, self.stop, self.clips = False, 0, True
        self.solves: list[int] = []
        self.unknown: dict[str, int] = {}

    def at(self, line: int, name: str) -> int:
        """The index of the surface that a qualifier names; 0 is the object."""
        if name == "I" and self.complete:
            return len(self.surfaces) - 1
        known = {"O": 0, "S": self.stop or 1}.get(name, int(name) if name.isdecimal() else -1)
        if not 0 <= known < len(self.surfaces):
            raise self.record.error(line, f"there is no surface S{name} yet")
        return known

    def targets(self, command: Command) -> list[Surface]:
        """The surfaces that a command applies to: those it names, or else the last one."""
        named = command.of("S")
        if not self.surfaces:
            raise self.record.error(command.line, f"{short(command.key)} before any surface")
        if named is None:
            return [self.surfaces[-1]]
        first, last = (self.at(command.line, name) for name in named)
        return self.surfaces[first : last + 1]


def _title(reader: _Reader, command: Command) -> None:
    reader.record.name = short(" ".join(command.values))


def _mode(reader: _Reader, command: Command) -> None:
    reader.radii = not (command.values and command.values[0][:1].upper() == "N")
    reader.said_radii = True


def _new(reader: _Reader, command: Command) -> None:
    if reader.surfaces:
        raise reader.record.error(command.line, "a second lens begins; give it a file of its own")


def _unit(reader: _Reader, command: Command) -> None:
    name = command.values[0].upper() if command.values else ""
    if name not in _UNITS:
        known = "M (millimetres), C or I"
        raise reader.record.error(command.line, f"DIM {short(name)}: expected {known}")
    reader.unit = _UNITS[name]


def _air(reader: _Reader, command: Command) -> None:
    """Compare temperature (C) or pressure (mm Hg) with that of our indices."""
    ours, unit = (20, "C") if command.key == "TEM" else (760, "mm Hg")
    value, line = reader.record.number(command.line, command.values), command.line
    if abs(value - ours) > ours / 4:
        reader.record.lacks(line, f"{value:g} {unit}; our indices are those of {ours}")
    elif value != ours:
        reader.record.notes.append(f"line {line}: {value:g} {unit}; indices are those of {ours}")


def _aperture(reader: _Reader, command: Command) -> None:
    use = reader.use
    use.line, use.aperture = command.line, reader.record.number(command.line, command.values)
    use.aperture_kind = _APERTURES[command.key]


def _checks_apertures(reader: _Reader, command: Command) -> None:
    reader.clips = not (command.values and command.values[0][:1].upper() == "N")


def _surface(reader: _Reader, command: Command) -> None:
    """S, SO, SI or S with a number: begin a new surface, or change an existing one."""
    record, line, name = reader.record, command.line, command.key[1:]
    if name == "S" or (reader.complete and name != "I" and not name.isdecimal()):
        raise record.error(line, f"{command.key}: a surface behind the image")
    due = len(reader.surfaces)
    number = {"": due, "O": 0, "I": due - reader.complete}.get(name)
    number = int(name) if number is None else number
    reader.complete = reader.complete or name == "I"
    if number > due:
        raise record.error(line, f"{command.key} stands where S{due} should")
    if number > _SURFACES:
        raise record.error(line, f"more than {_SURFACES} surfaces")
    if number == due:
        called = {"O": "SO", "I": "SI"}.get(name, f"S{number}")
        reader.surfaces.append(Surface(Row(called, line)))
    surface, words = reader.surfaces[number], command.values
    for key, handler in (("RDY" if reader.radii else "CUY", _curvature), ("THI", _thickness)):
        if words:
            handler(reader, command._replace(key=key, values=words[:1]), surface)
        words = words[1:]
    if words:
        _glass(reader, command._replace(key="GLA", values=words), surface)


def _number(reader: _Reader, command: Command) -> float | None:
    """The value of a command; None for a solve, whose value is given elsewhere."""
    words = command.values
    if words and words[0][:3].upper() in SOLVES:
        reader.solves.append(command.line)
        return None
    if len(words) > 1:
        raise reader.record.error(
            command.line, f"{command.key}: what is {short(' '.join(words[1:]))} behind its value?"
        )
    return reader.record.number(command.line, words)


def _curvature(reader: _Reader, command: Command, surface: Surface) -> None:
    value = _number(reader, command)
    if value is None:
        return
    if command.key in ("RDY", "RDX"):
        value = 1 / value if abs(value) > 1e-12 else 0.0
    elif abs(value) > 1e9:
        raise reader.record.error(command.line, f"a curvature of {value:g}; which unit?")
    if command.key in ("RDX", "CUX"):
        surface.curvature_x = command.line, value
    else:
        surface.curvature = value
        surface.row.lines["curvature"] = command.line


def _thickness(reader: _Reader, command: Command, surface: Surface) -> None:
    value = _number(reader, command)
    if value is not None:
        surface.thickness = value
        surface.row.lines["thickness"] = command.line


def _glass(reader: _Reader, command: Command, surface: Surface) -> None:
    """A glass, AIR, REFL or REFR; REFR may also follow a glass."""
    record, line = reader.record, command.line
    modes = [word.upper()[:4] for word in command.values if word.upper()[:4] in ("REFL", "REFR")]
    names = [word for word in command.values if word.upper()[:4] not in ("REFL", "REFR")]
    if len(names) > (command.key != "RMD") or len(modes) > 1:
        what = short(" ".join(command.values))
        raise record.error(line, f"{command.key} {what}: expected one glass, REFL or REFR")
    if names and "REFL" in modes:
        raise record.error(line, "a glass and a mirror: give one of them")
    if names:
        surface.glass = line, names[0]
    if modes or names:
        surface.row.entry.pop("mirror", None)
    if "REFL" in modes:
        surface.glass = line, ""
        surface.row.put("mirror", True, line)


def _stop(reader: _Reader, command: Command) -> None:
    named = command.of("S")
    reader.stop = reader.at(command.line, named[0]) if named else len(reader.surfaces) - 1


def _coefficient(reader: _Reader, command: Command, surface: Surface) -> None:
    value = reader.record.number(command.line, command.values)
    surface.terms[command.key] = command.line, value


def _special(reader: _Reader, command: Command, surface: Surface) -> None:
    command = command._replace(values=[*command.values])
    key = seq_surfaces.special_key(surface, reader.record, command)
    surface.terms[key] = command.line, reader.record.number(command.line, command.values)


def _move(reader: _Reader, command: Command, surface: Surface) -> None:
    surface.place.take(reader.record, command)


def _return(reader: _Reader, command: Command) -> None:
    """RET Sn for the last surface, or RET Sk Sn for surface k."""
    named = [q for q in command.qualifiers if q[0] == "S"]
    if not 1 <= len(named) <= 2:
        raise reader.record.error(command.line, "RET: expected the surface to return to, as RET S2")
    own = reader.at(command.line, named[0][1]) if len(named) == 2 else len(reader.surfaces) - 1
    surface = reader.surfaces[own] if reader.surfaces else None
    if surface is None:
        raise reader.record.error(command.line, "RET before any surface")
    surface.place.take(reader.record, command)
    surface.place.target = reader.at(command.line, named[-1][1])


def _diffract(reader: _Reader, command: Command, surface: Surface) -> None:
    record, words, line = reader.record, command.values, command.line
    if command.key in ("DIF", "HCT"):
        surface.phase[command.key] = line, short(words[0]).upper() if words else ""
        return
    number = command.of("C")
    if (number is None) == (command.key == "HCO"):
        raise record.error(line, "HCO: expected HCO C1 and a number")
    key = f"C{number[0]}" if number else command.key
    if number and not (number[0].isdecimal() and 1 <= int(number[0]) <= 100):
        raise record.error(line, f"HCO {key}: expected C1 to C100")
    surface.phase[key] = line, record.number(line, words)


def _zoom(reader: _Reader, command: Command) -> None:
    """`ZOO 3`, or a command with a value for each zoom position; the first value is used."""
    record, line, words = reader.record, command.line, command.values
    if words and words[0].isdecimal():
        if record.count(line, words) > 1:
            record.notes.append(f"line {line}: of {words[0]} zoom positions the first")
        return
    if not words:
        return
    own = command_of(line, words[0].upper()[:3], False, words[1:])
    if (own.key in FIELD_KEYS or own.key in WAVE_KEYS) and not own.qualifiers:
        raise record.error(line, f"ZOO {own.key}: name the field or the wavelength, as F1 or W1")
    if own.values:
        _dispatch(reader, own._replace(values=own.values[:1]))


_SYSTEM: dict[str, Callable[[_Reader, Command], None]] = {
    **{
        "TIT": _title,
        "RDM": _mode,
        "LEN": _new,
        "DIM": _unit,
        "DDM": _unit,
        "TEM": _air,
        "PRE": _air,
        "STO": _stop,
    },
    **dict.fromkeys(_APERTURES, _aperture),
    **{"CA": _checks_apertures, "ZOO": _zoom, "RET": _return},
}
_OF_SURFACES: dict[str, Callable[[_Reader, Command, Surface], None]] = {
    **dict.fromkeys(("RDY", "CUY", "RDX", "CUX"), _curvature),
    **{"THI": _thickness, "GLA": _glass, "RMD": _glass, "SCO": _special},
    **dict.fromkeys(seq_surfaces.KINDS, lambda r, command, s: s.shape(r.record, command)),
    **dict.fromkeys(seq_surfaces.COEFFICIENTS, _coefficient),
    **dict.fromkeys(seq_apertures.KEYS, lambda r, command, s: s.clips.take(r.record, command)),
    **dict.fromkeys((*seq_places.KEYS, "DAR", "BEN", "REV"), _move),
    **dict.fromkeys(seq_surfaces.DIFFRACTIVE, _diffract),
}


def _dispatch(reader: _Reader, command: Command) -> None:
    """Execute a command from outside the private catalogue."""
    key, zoom = command.key, command.of("Z")
    if zoom and zoom[0] != "1":
        return  # for another zoom position, see `_zoom`
    if key == "S" or key in ("SO", "SI") or (key[0] == "S" and key[1:].isdecimal()):
        _surface(reader, command)
    elif key in FIELD_KEYS or key in WAVE_KEYS:
        reader.fields.take(reader.record, command)
    elif key in _SYSTEM:
        _SYSTEM[key](reader, command)
    elif key in SOLVES:
        reader.solves.append(command.line)
    elif key in _OF_SURFACES:
        for surface in reader.targets(command):
            _OF_SURFACES[key](reader, command, surface)
    elif key in REFUSED:
        raise reader.record.error(command.line, f"{key} is not read")
    elif key not in COSMETIC:
        reader.unknown.setdefault(short(key), command.line)


def read_seq(path: str, missing: Missing, lines: list[str]) -> tuple[Record, Use]:
    """Read the lines of a `.seq` file into a record of its surfaces and their use. LensError with
    the line. path: its name in messages."""
    reader, private, ended = _Reader(path, missing), False, False
    for own in commands_of(lines):
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
            _dispatch(reader, own)
    _finish(reader)
    return reader.record, reader.use


def _finish(reader: _Reader) -> None:
    """Do the checks and conversions that need all commands."""
    record, use, surfaces = reader.record, reader.use, reader.surfaces
    if not surfaces:
        raise record.error(0, "no surface, SO, S or SI: is it a .seq file?")
    if not reader.complete or len(surfaces) < 3:
        raise record.error(
            surfaces[-1].row.line, "no SI follows, the image: is the file cut short?"
        )
    if not reader.said_radii:
        record.notes.append("no RDM: the numbers of surfaces are curvatures")
    if not 0 < (reader.stop or 1) < len(surfaces) - 1:
        raise record.error(0, "the stop is no surface of the lens")
    if not reader.stop:
        record.notes.append("no STO: the stop is surface 1")
    record.note_unread(reader.solves, reader.unknown, "commands")
    if not reader.fields.wavelengths:
        raise record.error(0, "no wavelength is given: WL, in nm")
    if use.aperture_kind is None:
        raise record.error(0, "no aperture is given: EPD, FNO, NA or NAO")
    surfaces[reader.stop or 1].row.put("stop", True, surfaces[reader.stop or 1].row.line)
    reader.fields.finish(record, use, reader.unit)
    _parts(reader)
    if use.aperture_kind == "pupil diameter":
        use.aperture = (use.aperture or 0.0) * reader.unit
    elif use.aperture_kind == "f-number" and math.isfinite(record.distance) and use.aperture:
        use.aperture, use.aperture_kind = 1 / (2 * use.aperture), "image NA"
    use.ray_aiming = "chief"


def _parts(reader: _Reader) -> None:
    """Convert object, surfaces and image to parts of the record, in mm."""
    record, unit, (first, *others) = reader.record, reader.unit, reader.surfaces
    if first.curvature or first.terms or first.place.moved or first.place.kind:
        raise record.error(first.row.line, "SO: an object that is not flat on the axis")
    record.distance = distance_of(first.thickness * unit if first.thickness < 1e9 else math.inf)
    record.medium = _medium(reader, first)
    image = others[-1]
    others[-2].thickness += image.thickness  # defocus
    image.thickness = 0.0
    frames = Frames(record, unit)
    for surface in others:
        row = surface.row
        row.thickness = surface.thickness * unit
        if abs(row.thickness) >= 1e9:
            raise record.error(
                row.lines.get("thickness", row.line), f"{row.name}: an infinite thickness"
            )
        surface.entries(record, unit)
        if surface is image:
            if {"form", "coefficients"} & row.entry.keys() or surface.phase:
                raise record.error(row.line, f"{row.name}: an aspheric image")
        else:
            row.entry |= _medium(reader, surface)
            surface.diffraction(record, unit)
        if surface.clips.found and surface is image:
            record.notes.append("apertures of the image clip nothing")
        elif surface.clips.found and reader.clips:
            stop = bool(row.entry.get("stop"))
            size = surface.clips.entries(record, row, unit, stop)
            reader.use.stop = size if stop else reader.use.stop
        record.parts += frames.parts(row, surface.place, surface is image)
    if not reader.clips:
        record.notes.append("CA NO: the apertures are not used")
    record.glasses = reader.glasses.used


def _medium(reader: _Reader, surface: Surface) -> dict[str, object]:
    line, word = surface.glass
    return reader.glasses.medium(surface.row, line, word, reader.fields.wavelengths)
