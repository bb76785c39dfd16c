"""Read lens files of Zemax OpticStudio, `.zmx`: the header, with units, aperture, fields and
wavelengths, and the surfaces; docs/lens_files.md explains the keywords."""

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
    Words,
    distance_of,
    short,
    turned_back,
    words_of,
)
from .specs import MEDIUM_KEYS, SURFACES
from .zmx_configurations import choose
from .zmx_surfaces import TYPES, Surface

_UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "M": 1000.0, "METER": 1000.0}
_MOST = 1000  # fields or wavelengths
COLUMNS = ("XFLN", "YFLN", "FWGN", "VDXN", "VDYN", "VCXN", "VCYN", "VANN")
# Lists of older versions. Later versions also write them; they are read if the new ones are absent.
_OLD = ("XFLD", "YFLD", "FWGT", "ZVDX", "ZVDY", "ZVCX", "ZVCY", "ZVAN")
_WAVES = (("WAVN", "WWGN"), ("WAVL", "WWGT"))
_LISTS = {*COLUMNS, *_OLD, *sum(_WAVES, ())}
BESIDE = 12  # fields in a column; each further one has a line FEFD
# The kind of aperture without and with the flag behind the number.
_APERTURES: dict[str, tuple[ApertureKind, ApertureKind]] = {
    "ENPD": ("pupil diameter", "pupil diameter"),
    "FNUM": ("f-number", "working f-number"),
    "OBNA": ("object NA", "object cone angle"),
}
# Ignored: drawing, names, tolerances, analyses, coatings, polarisation. They do not change rays.
_COSMETIC = """
    VERS MODE PFIL LANG GFAC PUSH SDMA ROPD PICB POLS GLRS GSTD NSCD COFN NOTE AUTH
    IWDP HYPR LUID EERA FIMP HIDE MIRR SLAB POPS COMM BLNK PRIM COAT VPAR VDSZ VCON
    MEMA OEMA OMMA SSID STUD DBDT FENF FCOM FSVY SCOL CSUM TCED
""".split()  # noqa: SIM905
_SOLVES = ("PPAR", "PZUP", "MAZH", "CHZH", "EDGE", "PKUP")


@dataclasses.dataclass
class Head:
    """What the lines of the header have set so far; `record.use` has lengths in mm.

    unit: unit of length of the file, mm.
    makers: the catalogues of GCAT.
    counts: number of fields and of wavelengths, if FTYP has them.
    columns: numbers per field or wavelength, by keyword.
    more: lines FEFD, one per field from the 13th on.
    waves: wavelength (um) and weight by number.
    """

    record: Record
    unit: float = 1.0
    makers: list[str] = dataclasses.field(default_factory=list)
    counts: tuple[int | None, int | None] = (None, None)
    columns: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    more: list[list[float]] = dataclasses.field(default_factory=list)
    waves: dict[int, tuple[float, float]] = dataclasses.field(default_factory=dict)

    def take(self, words: Words) -> bool:
        """Read a line; False if its keyword is not known."""
        record, use = self.record, self.record.use
        match words.key:
            case "NAME":
                record.name = short(" ".join(words.values))
            case "GCAT":
                self.makers = [name.upper() for name in words.values]
            case "UNIT":
                name = words.values[0].upper() if words.values else ""
                what = f"UNIT {short(name)}: expected one of {', '.join(_UNITS)}"
                words.require(name in _UNITS, what)
                self.unit = _UNITS[name]
            case "FLOA":
                use.line, use.aperture, use.aperture_kind = words.line, None, None
            case "ENPD" | "FNUM" | "OBNA":
                value, flag = words.number(), words.number(1, 0.0)
                use.aperture = value * self.unit if words.key == "ENPD" else value
                use.line, use.aperture_kind = words.line, _APERTURES[words.key][flag != 0]
            case "FTYP":
                self._fields(words)
            case "FEFD":
                if len(self.more) < _MOST:
                    self.more.append(words.numbers(0, len(COLUMNS)))
            case "WAVM":
                i = words.count()
                words.require(1 <= i <= _MOST, f"wavelength number {i}")
                self.waves[i] = _positive(record, words.line, words.number(1)), words.number(2, 1.0)
            case "PWAV":
                use.primary, use.primary_line = words.count() - 1, words.line
            case "RAIM":
                use.ray_aiming = {0: "off", 1: "paraxial"}.get(words.count(1, 0), "real")
            case "ENVD":
                degrees, pressure, used = (words.number(i, d) for i, d in enumerate((20, 1, 0)))
                if used and (degrees, pressure) != (20, 1):
                    what = f"{degrees:g} C and {pressure:g} atm; ours are 20 and 1"
                    record.lacks(words.line, what)
            case key if key in _LISTS:  # entries beyond the number of fields are not used
                self.columns[key] = words.numbers(0, min(len(words.values), _MOST))
            case _:
                return False
        return True

    def _fields(self, words: Words) -> None:
        """FTYP: the kind of fields, telecentric or not, the numbers of fields and wavelengths."""
        record, kind, telecentric = self.record, words.count(), words.count(1, 0)
        known = 0 <= kind < len(get_args(FieldKind))
        words.require(known, f"fields of kind {kind}; give angles or heights")
        if telecentric:
            record.lacks(words.line, "telecentric object space: all rays go through the stop here")
        record.use.field_kind, record.use.field_line = get_args(FieldKind)[kind], words.line
        if len(words.values) > 2:
            fields, waves = words.count(2), words.count(3, 1)
            known = 1 <= fields <= _MOST and 1 <= waves <= _MOST
            words.require(known, f"{fields} fields and {waves} wavelengths")
            self.counts = fields, waves
        record.afocal = words.count(6, 0) == 1

    def finish(self) -> None:
        """Write fields and wavelengths into `use`: the first entries of each column, in order."""
        record, use = self.record, self.record.use
        for keys in _WAVES:
            values, weights = (self.columns.get(key, []) for key in keys)
            for i, value in enumerate(() if self.waves else values):
                weight = weights[i] if i < len(weights) else 1.0
                self.waves[i + 1] = _positive(record, use.field_line, value), weight
        for old, key in zip(_OLD, COLUMNS, strict=True):
            self.columns.setdefault(key, self.columns.get(old, []))
        known = max(len(self.columns[key]) for key in COLUMNS[:2])
        fields = self.counts[0] or (min(known, BESIDE) or 1) + len(self.more)
        waves = self.counts[1] or max(self.waves, default=1)
        for i in range(1, waves + 1):
            record.require(i in self.waves, use.field_line, f"WAVM {i} of {waves} is missing")
        used = [self.waves[i] for i in range(1, waves + 1)]
        use.wavelengths, use.wavelength_weights = ([pair[k] for pair in used] for k in (0, 1))
        x, y, use.field_weights, *parts = (self._column(key, fields) for key in COLUMNS)
        unit = 1.0 if use.field_kind == "angle" else self.unit
        use.heights = [(a * unit, b * unit) for a, b in zip(x, y, strict=True)]
        parts[4] = [math.radians(value) for value in parts[4]]
        use.vignetting = [*map(list, zip(*parts, strict=True))]

    def _column(self, key: str, fields: int) -> list[float]:
        """The numbers of a column for all fields. If the file does not have the column, they are 1
        for weights and 0 for others."""
        k, found = COLUMNS.index(key), self.columns[key]
        found = found or [float(key == "FWGN")] * (min(fields, BESIDE) if self.more else fields)
        found = found[:BESIDE] + [row[k] for row in self.more] if self.more else found
        what = f"{key} has {len(found)} of {fields} fields"
        self.record.require(len(found) >= fields, self.record.use.field_line, what)
        return found[:fields]


def _positive(record: Record, line: int, value: float) -> float:
    record.require(value > 0, line, f"a wavelength of {value:g} um")
    return value


def read_zmx(
    path: str, missing: Missing, lines: list[str], configuration: int | None = None
) -> Record:
    """Read the lines of a `.zmx` file into a record of its surfaces, fields, wavelengths and
    aperture. LensError with the line.

    `choose` first writes the numbers of the configuration into the lines. Lines before the first
    SURF belong to the header, lines behind it to the last surface. The surfaces end at MNUM, at the
    first line that is not indented, or at the first key of the merit function; the rest is ignored.

    path: its name in messages. configuration: see `load_system`.
    """
    record, surfaces, tail = Record(path, missing), list[Surface](), False
    head, found = Head(record), words_of(record, lines)
    choose(record, found, configuration)
    whole = not any(words.key == "VERS" for words in found)
    indented = any(w.indented for w in found if w.key in ("TYPE", "CURV", "DISZ"))
    own: Head | Surface = head  # reads the present line
    for words in found:
        if words.key == "MODE":
            sequential = words.values[:1] in (["SEQ"], [])
            words.require(sequential, "not sequential; save a sequential system")
        if words.key == "SURF":
            words.require(not tail, "a surface behind the merit function")
            number, due = words.count(), len(surfaces)
            words.require(number == due, f"SURF {number} stands where SURF {due} should")
            words.require(due <= SURFACES, f"more than {SURFACES} surfaces")
            own = Surface(record, f"SURF {number}", words.line, head.unit, makers=head.makers)
            surfaces.append(own)
        elif words.key == "MNUM":
            tail = whole = True
        elif not tail and own.take(words):
            continue
        elif surfaces and indented and not words.indented:
            tail = True
        elif words.key in _SOLVES:
            record.solves.append(words.line)
        elif not tail and words.key not in _COSMETIC:
            tail = bool(surfaces) and not indented and words.key in ("TOL", "DMFS", "MOFF")
            if not tail:
                record.unknown.setdefault(short(words.key), words.line)
    record.require(surfaces, 0, "no line begins with SURF: is it a .zmx file?")
    _finish(record, head, surfaces, whole)
    return record


def _finish(record: Record, head: Head, surfaces: list[Surface], whole: bool) -> None:
    """Do the checks and conversions that need all lines."""
    first, last = surfaces[0], surfaces[-1]
    ends = len(surfaces) > 2 and not last.gap
    record.require(ends, last.line, "the last SURF is no image: is the file cut short?")
    record.require(last.gap is not None, last.line, "SURF without DISZ: is the file cut short?")
    if not whole:
        record.notes.append("no MNUM behind the surfaces: is the file cut short?")
    record.note_unread("keywords")
    flat = not first.entry.get("curvature") and first.kind == "STANDARD" and not first.moves
    first.require(flat, "an object that is not flat")
    if first.gap is None:
        raise record.error(first.line, "SURF 0 without DISZ, the distance of the object")
    stops = [surface for surface in surfaces if surface.entry.get("stop")]
    if not stops:
        stops = [next(surface for surface in surfaces[1:] if surface.kind != "COORDBRK")]
        stops[0].put("stop", True)
        record.notes.append(f"no STOP: the stop is {stops[0].name}")
    inside = len(stops) == 1 and stops[0] is not first and stops[0] is not last
    record.require(inside, 0, f"{len(stops)} surfaces have STOP; exactly one in the lens must")
    record.distance, entry = distance_of(first.gap), first.entry
    record.medium = {key: entry[key] for key in entry if key in MEDIUM_KEYS}
    for surface in surfaces[1:]:
        record.parts += _parts(surface, surface is last)
    record.use.stop = stops[0].semi
    head.finish()


def _breaking(surface: Surface, values: dict[Any, tuple[int, float]], thickness: float) -> Breaking:
    """A coordinate break: a decentre, then tilts about x, y, z. With the order flag: tilts about z,
    y, x, then a decentre along the new axes."""
    own = dataclasses.replace(surface, values=values)
    own.only(range(1, 7))
    x, y = (own.value(k) * own.unit for k in (1, 2))
    tilt: Any = tuple(own.value(k) for k in (3, 4, 5))
    moved: Any = (x, y, 0.0)
    if own.value(6) and any(tilt):
        turn, tilt = turned_back(tilt)
        moved = tuple((turn @ np.array(moved)).tolist()) if x or y else moved
    finite = all(map(math.isfinite, (*moved, *tilt)))
    own.record.require(finite, own.line, "a coordinate break that is not finite")
    return Breaking(own.line, moved, tilt, thickness)


def _parts(surface: Surface, image: bool) -> list[Row | Breaking]:
    """A surface with the breaks in front of it and behind it, or a coordinate break."""
    kind, moves = surface.kind, surface.moves
    line, what = surface.lines.get("thickness", 0), "an infinite thickness; give a length"
    surface.require(surface.gap != math.inf, what, line)
    surface.thickness = surface.gap or 0.0
    if kind == "COORDBRK":
        inside = not image and not surface.entry.get("stop")
        surface.require(inside, f"a coordinate break is no {'image' if image else 'stop'}")
        return [_breaking(surface, surface.values, surface.thickness)]
    where = " of the image" if image else f"; known: COORDBRK, {', '.join(TYPES)}"
    if kind == "PARAXIAL":
        where = ": an ideal thin lens is none of our surfaces; give real ones"
    known = kind in (("STANDARD", "EVENASPH") if image else TYPES)
    surface.require(known, f"type {short(kind)} is not known{where}", surface.kind_line)
    surface.entry.setdefault("curvature", 0.0)
    make, parameters = TYPES[kind]
    surface.only(parameters)
    make(surface)
    surface.require(not image or not surface.entry.get("coefficients"), "an aspheric image")
    surface.clip()
    parts: list[Row | Breaking] = [surface]
    if 1 in moves:
        parts.insert(0, _breaking(surface, moves[1], 0.0))
    if 2 in moves and not image:
        parts.append(_breaking(surface, moves[2], surface.thickness))
        surface.thickness = 0.0
    return parts
