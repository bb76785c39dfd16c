"""The header of `.zmx` files: units, aperture, fields, wavelengths; docs/lens_files.md explains
the keywords."""

import dataclasses
import math
from typing import get_args

from .record import Record, Words, short
from .system import ApertureKind, FieldKind, Use

_UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "M": 1000.0, "METER": 1000.0}
_MOST = 1000  # fields or wavelengths
COLUMNS = ("XFLN", "YFLN", "FWGN", "VDXN", "VDYN", "VCXN", "VCYN", "VANN")
# Lists of older versions, which later ones write beside their own; read where those are absent.
_OLD = dict(
    zip(("XFLD", "YFLD", "FWGT", "ZVDX", "ZVDY", "ZVCX", "ZVCY", "ZVAN"), COLUMNS, strict=True)
)
_WAVES = (("WAVN", "WWGN"), ("WAVL", "WWGT"))
_LISTS = {*COLUMNS, *_OLD, *sum(_WAVES, ())}
BESIDE = 12  # fields in a column; each further one has a line FEFD
# The kind of aperture without and with the flag behind the number.
_APERTURES: dict[str, tuple[ApertureKind, ApertureKind]] = {
    "ENPD": ("pupil diameter", "pupil diameter"),
    "FNUM": ("f-number", "working f-number"),
    "OBNA": ("object NA", "object cone angle"),
}


@dataclasses.dataclass
class Head:
    """The header as its lines are read. Lengths in `use` are in mm.

    unit: the file's unit of length, mm. makers: the catalogues of GCAT. counts: of fields and of
    wavelengths, where FTYP tells them. columns: numbers per field or wavelength by keyword. more:
    lines FEFD, one per field from the 13th on. waves: wavelength (um) and weight by number.
    """

    record: Record
    use: Use = dataclasses.field(default_factory=Use)
    unit: float = 1.0
    makers: list[str] = dataclasses.field(default_factory=list)
    counts: tuple[int | None, int | None] = (None, None)
    columns: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    more: list[list[float]] = dataclasses.field(default_factory=list)
    waves: dict[int, tuple[float, float]] = dataclasses.field(default_factory=dict)

    def take(self, words: Words) -> bool:
        """Read a line; False if its keyword is not known."""
        use, record = self.use, self.record
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
            case key if key in _LISTS:  # what is beyond the number of fields is not used
                self.columns[key] = words.numbers(0, min(len(words.values), _MOST))
            case _:
                return False
        return True

    def _fields(self, words: Words) -> None:
        """FTYP: the kind of fields, telecentric or not, the numbers of fields and wavelengths."""
        kind, telecentric = words.count(), words.count(1, 0)
        kinds: tuple[FieldKind, ...] = get_args(FieldKind)
        known = 0 <= kind < len(kinds)
        words.require(known, f"fields of kind {kind}; give angles or heights")
        if telecentric:
            what = "telecentric object space: all rays go through the stop here"
            self.record.lacks(words.line, what)
        self.use.field_kind, self.use.field_line = kinds[kind], words.line
        if len(words.values) > 2:
            fields, waves = words.count(2), words.count(3, 1)
            known = 1 <= fields <= _MOST and 1 <= waves <= _MOST
            words.require(known, f"{fields} fields and {waves} wavelengths")
            self.counts = fields, waves
        self.record.afocal = words.count(6, 0) == 1

    def finish(self) -> None:
        """Write fields and wavelengths into `use`: the first entries of each column, in order."""
        record, use = self.record, self.use
        for keys in _WAVES:
            values, weights = (self.columns.get(key, []) for key in keys)
            for i, value in enumerate(() if self.waves else values):
                weight = weights[i] if i < len(weights) else 1.0
                self.waves[i + 1] = _positive(record, use.field_line, value), weight
        for old, key in _OLD.items():
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
        use.vignetting = [[*row] for row in zip(*parts, strict=True)]

    def _column(self, key: str, fields: int) -> list[float]:
        """The numbers of all fields; those of a column that the file does not have are 1 for
        weights, else 0."""
        k, found = COLUMNS.index(key), self.columns[key]
        found = found or [float(key == "FWGN")] * (min(fields, BESIDE) if self.more else fields)
        found = found[:BESIDE] + [row[k] for row in self.more] if self.more else found
        what = f"{key} has {len(found)} of {fields} fields"
        self.record.require(len(found) >= fields, self.use.field_line, what)
        return found[:fields]


def _positive(record: Record, line: int, value: float) -> float:
    record.require(value > 0, line, f"a wavelength of {value:g} um")
    return value
