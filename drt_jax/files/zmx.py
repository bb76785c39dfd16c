"""Read lens files of Zemax OpticStudio, `.zmx`; docs/lens_files.md explains the keywords."""

import dataclasses
import math
from collections.abc import Callable
from typing import get_args

from ..inputs import InputError
from .entry import LensError
from .forms_zmx import EXTRA, TYPES, Surface, breaking, clipping
from .glasses import named_glass
from .model_zmx import to_ours
from .record import Breaking, Missing, Record, Row, distance_of, short
from .system import FieldKind, Use
from .text import Words, words_of

_UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "M": 1000.0}
_SURFACES = 5000
_MOST = 1000  # fields or wavelengths
# Ignored: drawing, names, tolerances, analyses, coatings, polarisation. None changes rays.
_COSMETIC = frozenset(
    """
    VERS MODE PFIL LANG GFAC PUSH SDMA ROPD PICB POLS GLRS GSTD NSCD COFN NOTE AUTH
    IWDP HYPR LUID EERA FIMP HIDE MIRR SLAB POPS COMM BLNK PRIM COAT VPAR VDSZ VCON
    MEMA OEMA OMMA SSID STUD DBDT
    """.split()  # noqa: SIM905
)
_SOLVES = ("PPAR", "PZUP", "MAZH")
# Keywords that change rays and are refused, unless all their numbers are 0.
_REFUSED = {
    "SQOB": "a rectangular obscuration of unknown columns",
    "SPID": "a spider",
    "UDAP": "an aperture from a file",
    "UDOB": "an obscuration from a file",
    "SCBD": "tilts and decentres beside coordinate breaks",
}


@dataclasses.dataclass
class _Block:
    """A surface as its lines are read."""

    row: Row
    kind: str = "STANDARD"
    kind_line: int = 0
    parameters: dict[int, tuple[int, float]] = dataclasses.field(default_factory=dict)
    thickness: float | None = None
    infinite: int = 0
    semi: float = 0.0
    floating: int = 0
    apertures: list[tuple[int, str, list[float]]] = dataclasses.field(default_factory=list)
    centre: list[float] = dataclasses.field(default_factory=list)
    mirror: bool = False


class _Reader:
    """The state of reading one file."""

    def __init__(self, path: str, missing: Missing):
        self.record, self.use = Record(path, missing), Use()
        self.unit, self.makers = 1.0, list[str]()
        self.counts, self.columns = (1, 1), dict[str, list[float]]()
        self.waves: dict[int, tuple[float, float]] = {}
        self.blocks: list[_Block] = []
        self.solves: list[int] = []
        self.unknown: dict[str, int] = {}

    def length(self, words: Words, at: int = 0) -> float:
        return self.record.number(words.line, words.rest, at) * self.unit

    @property
    def block(self) -> _Block:
        return self.blocks[-1]


def _unit(reader: _Reader, words: Words) -> None:
    name = words.rest[0].upper() if words.rest else ""
    if name not in _UNITS:
        raise reader.record.error(
            words.line, f"UNIT {short(name)}: expected one of {', '.join(_UNITS)}"
        )
    reader.unit = _UNITS[name]


def _name(reader: _Reader, words: Words) -> None:
    reader.record.name = short(" ".join(words.rest))


def _makers(reader: _Reader, words: Words) -> None:
    reader.makers = [name.upper() for name in words.rest]


def _aperture(reader: _Reader, words: Words) -> None:
    record, use, line = reader.record, reader.use, words.line
    use.line = line
    if words.key == "FLOA":
        use.aperture, use.aperture_kind = None, None
        return
    value, flag = (record.number(line, words.rest, i, [None, 0.0][i]) for i in (0, 1))
    if words.key == "ENPD":
        use.aperture, use.aperture_kind = value * reader.unit, "pupil diameter"
    elif words.key == "FNUM":
        use.aperture, use.aperture_kind = value, "working f-number" if flag else "f-number"
    else:
        value = math.sin(math.radians(value)) if flag else value
        use.aperture, use.aperture_kind = value, "object NA"


def _fields(reader: _Reader, words: Words) -> None:
    record, line = reader.record, words.line
    kind, telecentric, fields, waves = (
        record.count(line, words.rest, i, d) for i, d in enumerate((None, 0, 1, 1))
    )
    kinds: tuple[FieldKind, ...] = get_args(FieldKind)
    if not 0 <= kind < len(kinds):
        raise record.error(line, f"fields of kind {kind}; give angles or heights")
    if telecentric:
        record.lacks(line, "telecentric object space: all rays go through the stop here")
    if not (1 <= fields <= _MOST and 1 <= waves <= _MOST):
        raise record.error(line, f"{fields} fields and {waves} wavelengths")
    reader.use.field_kind, reader.use.field_line = kinds[kind], line
    reader.counts = fields, waves


def _column(reader: _Reader, words: Words) -> None:
    """Read one number per field; numbers beyond the number of fields are ignored."""
    count = min(len(words.rest), _MOST)
    reader.columns[words.key] = reader.record.numbers(words.line, words.rest, count)


def _wave(reader: _Reader, words: Words) -> None:
    record, line = reader.record, words.line
    i = record.count(line, words.rest)
    if not 1 <= i <= _MOST:
        raise record.error(line, f"wavelength number {i}")
    value = record.number(line, words.rest, 1)
    if not value > 0:
        raise record.error(line, f"a wavelength of {value:g} um")
    reader.waves[i] = value, record.number(line, words.rest, 2, 1.0)


def _primary(reader: _Reader, words: Words) -> None:
    reader.use.primary = reader.record.count(words.line, words.rest) - 1
    reader.use.primary_line = words.line


def _aiming(reader: _Reader, words: Words) -> None:
    mode = reader.record.count(words.line, words.rest, 1, 0)
    reader.use.ray_aiming = {0: "off", 1: "paraxial"}.get(mode, "real")


def _environment(reader: _Reader, words: Words) -> None:
    values = [reader.record.number(words.line, words.rest, i, d) for i, d in enumerate((20, 1, 0))]
    if values[2] and values[:2] != [20, 1]:
        reader.record.lacks(words.line, f"{values[0]:g} C and {values[1]:g} atm; ours are 20 and 1")


def _surface(reader: _Reader, words: Words) -> None:
    number, due = reader.record.count(words.line, words.rest), len(reader.blocks)
    if number != due:
        raise reader.record.error(words.line, f"SURF {number} stands where SURF {due} should")
    if due > _SURFACES:
        raise reader.record.error(words.line, f"more than {_SURFACES} surfaces")
    reader.blocks.append(_Block(Row(f"SURF {number}", words.line), kind_line=words.line))


def _type(reader: _Reader, words: Words) -> None:
    reader.block.kind = words.rest[0].upper() if words.rest else ""
    reader.block.kind_line = words.line


def _stop(reader: _Reader, words: Words) -> None:
    reader.block.row.put("stop", True, words.line)


def _curvature(reader: _Reader, words: Words) -> None:
    value = reader.record.number(words.line, words.rest) / reader.unit
    reader.block.row.put("curvature", value, words.line)
    if len(words.rest) > 1 and words.rest[1] not in ("0", "1"):  # 1 is a variable
        reader.solves.append(words.line)


def _conic(reader: _Reader, words: Words) -> None:
    value = reader.record.number(words.line, words.rest)
    if value:
        reader.block.row.put("conic", value, words.line)


def _thickness(reader: _Reader, words: Words) -> None:
    reader.block.row.lines["thickness"] = words.line
    if words.rest and words.rest[0].upper() in ("INFINITY", "INF"):
        reader.block.infinite, reader.block.thickness = words.line, math.inf
    else:
        reader.block.thickness = reader.length(words)


def _parameter(reader: _Reader, words: Words) -> None:
    number = reader.record.count(words.line, words.rest)
    value = reader.record.number(words.line, words.rest, 1)
    number += EXTRA - 1 if words.key == "XDAT" else 0
    reader.block.parameters[number] = words.line, value


def _glass(reader: _Reader, words: Words) -> None:
    record, row, line, rest = reader.record, reader.block.row, words.line, words.rest
    name = rest[0] if rest else ""
    if name.upper() == "MIRROR":
        row.put("mirror", True, line)
        return
    if name != "___BLANK":
        if name.isdecimal() and len(name) == 6:
            index, abbe, above = 1 + int(name[:3]) / 1000, int(name[3:]) / 10, 0.0
        else:
            for key, value in named_glass(record, row, line, name, reader.makers).items():
                row.put(key, value, line)
            return
    else:
        index, abbe = (record.number(line, rest, i) for i in (3, 4))
        above = record.number(line, rest, 5, 0.0)
    if not abbe:
        row.put("index", index, line)
        return
    if not (1 < index <= 4 and 10 <= abbe <= 120):
        raise record.error(line, f"{row.name}: no model glass has nd {index:g} and vd {abbe:g}")
    for part, own in zip(("nd", "vd", "partial"), to_ours(index, abbe, above), strict=True):
        row.put(part, own, line)


def _diameter(reader: _Reader, words: Words) -> None:
    reader.block.semi = abs(reader.length(words))


def _floating(reader: _Reader, words: Words) -> None:
    reader.block.floating = words.line


def _clip(reader: _Reader, words: Words) -> None:
    values = [v * reader.unit for v in reader.record.numbers(words.line, words.rest, 2)]
    reader.block.apertures.append((words.line, words.key, values))


def _centre(reader: _Reader, words: Words) -> None:
    reader.block.centre = [reader.length(words, i) for i in (0, 1)]


def _refused(reader: _Reader, words: Words) -> None:
    numbers = [word for word in words.rest if word.replace(".", "").replace("0", "")]
    if numbers:
        reader.record.lacks(words.line, f"{words.key}, {_REFUSED[words.key]}")


_COLUMNS = ("XFLN", "YFLN", "FWGN", "VDXN", "VDYN", "VCXN", "VCYN", "VANN")
_HEADER: dict[str, Callable[[_Reader, Words], None]] = {
    **dict.fromkeys(("ENPD", "FNUM", "OBNA", "FLOA"), _aperture),
    **dict.fromkeys(_COLUMNS, _column),
    **{"UNIT": _unit, "NAME": _name, "GCAT": _makers, "FTYP": _fields, "WAVM": _wave},
    **{"PWAV": _primary, "RAIM": _aiming, "ENVD": _environment},
}
_SURFACE: dict[str, Callable[[_Reader, Words], None]] = {
    **{"TYPE": _type, "STOP": _stop, "CURV": _curvature, "CONI": _conic, "DISZ": _thickness},
    **dict.fromkeys(("PARM", "XDAT"), _parameter),
    **{"GLAS": _glass, "DIAM": _diameter, "FLAP": _floating, "OBDC": _centre},
    **dict.fromkeys(("CLAP", "SQAP", "ELAP", "OBSC", "ELOB"), _clip),
    **dict.fromkeys(_REFUSED, _refused),
}


def _configurations(reader: _Reader, words: Words) -> None:
    count = reader.record.count(words.line, words.rest, 0, 1)
    if count > 1:
        now = reader.record.count(words.line, words.rest, 1, 1)
        reader.record.notes.append(f"line {words.line}: of {count} configurations number {now}")


def read_zmx(path: str, missing: Missing) -> tuple[Record, Use]:
    """Read a `.zmx` file into a record of its surfaces and their use. LensError with the line."""
    try:
        lines = words_of(path)
    except InputError as error:
        raise LensError(f"{path}: {error}") from error
    reader, tail, behind = _Reader(path, missing), False, False
    indented = any(w.indented for w in lines if w.key in ("TYPE", "CURV", "DISZ"))
    for words in lines:
        if words.key == "SURF":
            if tail:
                raise reader.record.error(words.line, "a surface behind the merit function")
            _surface(reader, words)
        elif words.key == "MODE" and words.rest[:1] not in (["SEQ"], []):
            raise reader.record.error(words.line, "not sequential; save a sequential system")
        elif words.key == "MNUM":
            tail, behind = True, True
            _configurations(reader, words)
        elif not reader.blocks and words.key in _HEADER:
            _HEADER[words.key](reader, words)
        elif reader.blocks and not tail and words.key in _SURFACE:
            _SURFACE[words.key](reader, words)
        elif reader.blocks and indented and not words.indented:
            tail = True
        elif words.key in _SOLVES:
            reader.solves.append(words.line)
        elif not tail and words.key not in _COSMETIC:
            tail = bool(reader.blocks) and not indented and words.key in ("TOL", "DMFS", "MOFF")
            if not tail:
                reader.unknown.setdefault(short(words.key), words.line)
    if not reader.blocks:
        raise LensError(f"{path}: no line begins with SURF: is it a .zmx file?")
    _finish(reader, behind or not any(words.key == "VERS" for words in lines))
    return reader.record, reader.use


def _finish(reader: _Reader, whole: bool) -> None:
    """Do the checks and conversions that need all lines."""
    record, use = reader.record, reader.use
    first, last = reader.blocks[0], reader.blocks[-1]
    if len(reader.blocks) < 3 or last.thickness or last.infinite:
        raise record.error(last.row.line, "the last SURF is no image: is the file cut short?")
    if last.thickness is None:
        raise record.error(last.row.line, "SURF without DISZ: is the file cut short?")
    if not whole:
        record.notes.append("no MNUM behind the surfaces: is the file cut short?")
    record.note_unread(reader.solves, reader.unknown, "keywords")
    if first.row.entry.get("curvature") or first.kind != "STANDARD":
        raise record.error(first.row.line, "SURF 0: an object that is not flat")
    if first.thickness is None:
        raise record.error(first.row.line, "SURF 0 without DISZ, the distance of the object")
    record.distance = distance_of(first.thickness)
    record.medium = {
        key: value
        for key, value in first.row.entry.items()
        if key in ("glass", "index", "nd", "vd", "partial")
    }
    for block in reader.blocks[1:]:
        record.parts.append(_part(reader, block, block is last))
    stops = [block for block in reader.blocks if block.row.entry.get("stop")]
    if len(stops) != 1 or stops[0] in (first, last):
        raise record.error(0, f"{len(stops)} surfaces have STOP; exactly one in the lens must")
    use.stop = stops[0].semi
    _use(reader)


def _part(reader: _Reader, block: _Block, image: bool) -> Row | Breaking:
    record, row = reader.record, block.row
    if block.infinite:
        raise record.error(block.infinite, f"{row.name}: an infinite thickness; give a length")
    surface = Surface(record, row, reader.unit, block.parameters, block.semi)
    row.thickness = block.thickness or 0.0
    if block.kind == "COORDBRK":
        if image or row.entry.get("stop"):
            what = "image" if image else "stop"
            raise record.error(row.line, f"{row.name}: a coordinate break is no {what}")
        return breaking(surface, row.thickness)
    if block.kind not in TYPES or (image and block.kind not in ("STANDARD", "EVENASPH")):
        where = " of the image" if image else f"; known: COORDBRK, {', '.join(TYPES)}"
        if block.kind == "PARAXIAL":
            where = ": an ideal thin lens is none of our surfaces; give real ones"
        raise record.error(
            block.kind_line, f"{row.name}: type {short(block.kind)} is not known{where}"
        )
    row.entry.setdefault("curvature", 0.0)
    TYPES[block.kind](surface)
    if image and row.entry.get("coefficients"):
        raise record.error(row.line, f"{row.name}: an aspheric image")
    if block.floating:
        block.apertures.insert(0, (block.floating, "CLAP", [0.0, block.semi]))
    clipping(record, row, block.apertures, block.centre)
    return row


def _use(reader: _Reader) -> None:
    """Write fields and wavelengths into `use`: the first entries of each column, in order."""
    record, use, (fields, waves) = reader.record, reader.use, reader.counts
    for i in range(1, waves + 1):
        if i not in reader.waves:
            raise record.error(use.field_line, f"WAVM {i} of {waves} is missing")
    used = [reader.waves[i] for i in range(1, waves + 1)]
    use.wavelengths, use.wavelength_weights = ([pair[k] for pair in used] for k in (0, 1))

    def column(key: str, default: float) -> list[float]:
        values = reader.columns.get(key, [default] * fields)
        if len(values) < fields:
            raise record.error(use.field_line, f"{key} has {len(values)} of {fields} fields")
        return values[:fields]

    unit = 1.0 if use.field_kind == "angle" else reader.unit
    x, y = ([v * unit for v in column(key, 0.0)] for key in ("XFLN", "YFLN"))
    use.heights = [*zip(x, y, strict=True)]
    use.field_weights = column("FWGN", 1.0)
    parts = [column(key, 0.0) for key in ("VDXN", "VDYN", "VCXN", "VCYN", "VANN")]
    parts[4] = [math.radians(value) for value in parts[4]]
    use.vignetting = [[*row] for row in zip(*parts, strict=True)]
