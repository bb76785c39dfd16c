"""The header of `.zmx` files: units, aperture, fields, wavelengths; docs/lens_files.md explains
the keywords."""

import dataclasses
import math
from collections.abc import Callable
from typing import get_args

from .record import Record, short
from .system import FieldKind, Use
from .text import Words

_UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "M": 1000.0, "METER": 1000.0}
_MOST = 1000  # fields or wavelengths
COLUMNS = ("XFLN", "YFLN", "FWGN", "VDXN", "VDYN", "VCXN", "VCYN", "VANN")
# Lists of older versions, which later ones write beside their own; read where those are absent.
_OLD = dict(
    zip(("XFLD", "YFLD", "FWGT", "ZVDX", "ZVDY", "ZVCX", "ZVCY", "ZVAN"), COLUMNS, strict=True)
)
_WAVES = (("WAVN", "WWGN"), ("WAVL", "WWGT"))
BESIDE = 12  # fields in a column; each further one has a line FEFD


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
        known = max(map(len, (self.columns[key] for key in COLUMNS[:2])))
        fields = self.counts[0] or (min(known, BESIDE) or 1) + len(self.more)
        waves = self.counts[1] or max(self.waves, default=1)
        for i in range(1, waves + 1):
            if i not in self.waves:
                raise record.error(use.field_line, f"WAVM {i} of {waves} is missing")
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
        if len(found) < fields:
            what = f"{key} has {len(found)} of {fields} fields"
            raise self.record.error(self.use.field_line, what)
        return found[:fields]


def _positive(record: Record, line: int, value: float) -> float:
    if not value > 0:
        raise record.error(line, f"a wavelength of {value:g} um")
    return value


def _unit(head: Head, words: Words) -> None:
    name = words.rest[0].upper() if words.rest else ""
    if name not in _UNITS:
        known = ", ".join(_UNITS)
        raise head.record.error(words.line, f"UNIT {short(name)}: expected one of {known}")
    head.unit = _UNITS[name]


def _name(head: Head, words: Words) -> None:
    head.record.name = short(" ".join(words.rest))


def _makers(head: Head, words: Words) -> None:
    head.makers = [name.upper() for name in words.rest]


def _aperture(head: Head, words: Words) -> None:
    record, use, line = head.record, head.use, words.line
    use.line = line
    if words.key == "FLOA":
        use.aperture, use.aperture_kind = None, None
        return
    value, flag = (record.number(line, words.rest, i, [None, 0.0][i]) for i in (0, 1))
    if words.key == "ENPD":
        use.aperture, use.aperture_kind = value * head.unit, "pupil diameter"
    elif words.key == "FNUM":
        use.aperture, use.aperture_kind = value, "working f-number" if flag else "f-number"
    else:
        use.aperture, use.aperture_kind = value, "object cone angle" if flag else "object NA"


def _fields(head: Head, words: Words) -> None:
    record, line = head.record, words.line
    kind, telecentric = (record.count(line, words.rest, i, d) for i, d in enumerate((None, 0)))
    kinds: tuple[FieldKind, ...] = get_args(FieldKind)
    if not 0 <= kind < len(kinds):
        raise record.error(line, f"fields of kind {kind}; give angles or heights")
    if telecentric:
        record.lacks(line, "telecentric object space: all rays go through the stop here")
    head.use.field_kind, head.use.field_line = kinds[kind], line
    if len(words.rest) > 2:
        fields, waves = (record.count(line, words.rest, i, 1) for i in (2, 3))
        if not (1 <= fields <= _MOST and 1 <= waves <= _MOST):
            raise record.error(line, f"{fields} fields and {waves} wavelengths")
        head.counts = fields, waves
    record.afocal = record.count(line, words.rest, 6, 0) == 1


def _column(head: Head, words: Words) -> None:
    """Read one number per field; numbers beyond the number of fields are ignored."""
    count = min(len(words.rest), _MOST)
    head.columns[words.key] = head.record.numbers(words.line, words.rest, count)


def _further(head: Head, words: Words) -> None:
    if len(head.more) < _MOST:
        head.more.append(head.record.numbers(words.line, words.rest, len(COLUMNS)))


def _wave(head: Head, words: Words) -> None:
    record, line = head.record, words.line
    i = record.count(line, words.rest)
    if not 1 <= i <= _MOST:
        raise record.error(line, f"wavelength number {i}")
    value = _positive(record, line, record.number(line, words.rest, 1))
    head.waves[i] = value, record.number(line, words.rest, 2, 1.0)


def _primary(head: Head, words: Words) -> None:
    head.use.primary = head.record.count(words.line, words.rest) - 1
    head.use.primary_line = words.line


def _aiming(head: Head, words: Words) -> None:
    mode = head.record.count(words.line, words.rest, 1, 0)
    head.use.ray_aiming = {0: "off", 1: "paraxial"}.get(mode, "real")


def _environment(head: Head, words: Words) -> None:
    values = [head.record.number(words.line, words.rest, i, d) for i, d in enumerate((20, 1, 0))]
    if values[2] and values[:2] != [20, 1]:
        head.record.lacks(words.line, f"{values[0]:g} C and {values[1]:g} atm; ours are 20 and 1")


KEYS: dict[str, Callable[[Head, Words], None]] = {
    **dict.fromkeys(("ENPD", "FNUM", "OBNA", "FLOA"), _aperture),
    **dict.fromkeys((*COLUMNS, *_OLD, *sum(_WAVES, ())), _column),
    **{"UNIT": _unit, "NAME": _name, "GCAT": _makers, "FTYP": _fields, "WAVM": _wave},
    **{"PWAV": _primary, "RAIM": _aiming, "ENVD": _environment, "FEFD": _further},
}
