"""Read lens files of Zemax OpticStudio, `.zmx`; docs/lens_files.md explains the keywords."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from .entry import LensError
from .forms_zmx import EXTRA, TYPES, Surface, breaking, clipping
from .glasses import named_glass
from .model_zmx import model_keys
from .record import Breaking, Missing, Record, Row, distance_of, short
from .system import Use
from .text import Words, words_of
from .user_zmx import LINES, UserAperture
from .zmx_head import KEYS, Head

_SURFACES = 5000
# Ignored: drawing, names, tolerances, analyses, coatings, polarisation. None changes rays.
_COSMETIC = frozenset(
    """
    VERS MODE PFIL LANG GFAC PUSH SDMA ROPD PICB POLS GLRS GSTD NSCD COFN NOTE AUTH
    IWDP HYPR LUID EERA FIMP HIDE MIRR SLAB POPS COMM BLNK PRIM COAT VPAR VDSZ VCON
    MEMA OEMA OMMA SSID STUD DBDT FENF FCOM FSVY SCOL CSUM TCED
    """.split()  # noqa: SIM905
)
_SOLVES = ("PPAR", "PZUP", "MAZH", "CHZH", "EDGE", "PKUP")
# Apertures that are refused.
_REFUSED = {
    "SPID": "a spider",
    "UDAP": "an aperture from a file",
    "UDOB": "an obscuration from a file",
}


@dataclasses.dataclass
class _Block:
    """A surface as its lines are read. moves: the parameters of a coordinate break in front of the
    surface (1) and behind it (2)."""

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
    moves: dict[int, dict[int, tuple[int, float]]] = dataclasses.field(default_factory=dict)
    user: UserAperture = dataclasses.field(default_factory=UserAperture)


class _Reader:
    """The state of reading one file."""

    def __init__(self, path: str, missing: Missing):
        self.record = Record(path, missing)
        self.head = Head(self.record)
        self.blocks: list[_Block] = []
        self.solves: list[int] = []
        self.unknown: dict[str, int] = {}

    @property
    def unit(self) -> float:
        """The file's unit of length, mm."""
        return self.head.unit

    def length(self, words: Words, at: int = 0) -> float:
        return self.record.number(words.line, words.rest, at) * self.unit

    @property
    def block(self) -> _Block:
        return self.blocks[-1]


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
    found: dict[str, Any] = {}
    if name.isdecimal() and len(name) == 6:
        found = model_keys(record, row, line, 1 + int(name[:3]) / 1000, int(name[3:]) / 10, 0.0)
    elif name == "___BLANK":
        nd, vd, above = (record.number(line, rest, i, d) for i, d in ((3, None), (4, None), (5, 0)))
        found = model_keys(record, row, line, nd, vd, above)
    else:
        found = named_glass(
            record, row, line, name, reader.head.makers, _beside(record, row, line, rest)
        )
    for key, value in found.items():
        row.put(key, value, line)


def _beside(record: Record, row: Row, line: int, rest: list[str]) -> dict[str, Any]:
    """The keys of the model glass of nd and vd behind a name; empty if they are none, such as the
    placeholder 1.5 and 40 of OpticStudio."""
    try:
        nd, vd, above = (record.number(line, rest, i, 0.0) for i in (3, 4, 5))
        known = nd > 1 and (nd, vd) != (1.5, 40)
        return model_keys(record, row, line, nd, vd, above) if known else {}
    except LensError:
        return {}


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
    if words.key != "SPID" or any(word.strip("+-.0") for word in words.rest):
        reader.record.lacks(words.line, f"{words.key}, {_REFUSED[words.key]}")


def _moves(reader: _Reader, words: Words) -> None:
    """SCBD: tilt and decentre in front of a surface (1) or behind it (2), with order, a pickup
    and five numbers; a coordinate return (3) is a solve."""
    record, line, rest = reader.record, words.line, words.rest
    where = record.count(line, rest)
    if where == 3:
        reader.solves.append(line)
        return
    if where not in (1, 2):
        raise record.error(line, f"SCBD {where}: expected 1, 2 or 3")
    own = {k + 1: (line, record.number(line, rest, 3 + k)) for k in range(5)}
    if any(value for _, value in own.values()):
        reader.block.moves[where] = own | {6: (line, record.count(line, rest, 1))}


_SURFACE: dict[str, Callable[[_Reader, Words], None]] = {
    **{"TYPE": _type, "STOP": _stop, "CURV": _curvature, "CONI": _conic, "DISZ": _thickness},
    **dict.fromkeys(("PARM", "XDAT"), _parameter),
    **{"GLAS": _glass, "DIAM": _diameter, "FLAP": _floating, "OBDC": _centre},
    **dict.fromkeys(("CLAP", "SQAP", "ELAP", "OBSC", "SQOB", "ELOB"), _clip),
    **dict.fromkeys(LINES, lambda r, words: r.block.user.take(r.record, r.unit, words)),
    **dict.fromkeys(_REFUSED, _refused),
    "SCBD": _moves,
}


def _configurations(reader: _Reader, words: Words) -> None:
    count = reader.record.count(words.line, words.rest, 0, 1)
    if count > 1:
        now = reader.record.count(words.line, words.rest, 1, 1)
        reader.record.notes.append(f"line {words.line}: of {count} configurations number {now}")


def read_zmx(path: str, missing: Missing, lines: list[str]) -> tuple[Record, Use]:
    """Read the lines of a `.zmx` file into a record of its surfaces and their use. LensError with
    the line. path: its name in messages."""
    found = words_of(lines)
    reader, tail, behind = _Reader(path, missing), False, False
    indented = any(w.indented for w in found if w.key in ("TYPE", "CURV", "DISZ"))
    for words in found:
        if words.key == "SURF":
            if tail:
                raise reader.record.error(words.line, "a surface behind the merit function")
            _surface(reader, words)
        elif words.key == "MODE" and words.rest[:1] not in (["SEQ"], []):
            raise reader.record.error(words.line, "not sequential; save a sequential system")
        elif words.key == "MNUM":
            tail, behind = True, True
            _configurations(reader, words)
        elif not reader.blocks and words.key in KEYS:
            KEYS[words.key](reader.head, words)
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
    _finish(reader, behind or not any(words.key == "VERS" for words in found))
    return reader.record, reader.head.use


def _finish(reader: _Reader, whole: bool) -> None:
    """Do the checks and conversions that need all lines."""
    record, use = reader.record, reader.head.use
    first, last = reader.blocks[0], reader.blocks[-1]
    if len(reader.blocks) < 3 or last.thickness or last.infinite:
        raise record.error(last.row.line, "the last SURF is no image: is the file cut short?")
    if last.thickness is None:
        raise record.error(last.row.line, "SURF without DISZ: is the file cut short?")
    if not whole:
        record.notes.append("no MNUM behind the surfaces: is the file cut short?")
    record.note_unread(reader.solves, reader.unknown, "keywords")
    if first.row.entry.get("curvature") or first.kind != "STANDARD" or first.moves:
        raise record.error(first.row.line, "SURF 0: an object that is not flat")
    if first.thickness is None:
        raise record.error(first.row.line, "SURF 0 without DISZ, the distance of the object")
    stops = [block for block in reader.blocks if block.row.entry.get("stop")]
    if not stops:
        stops = [next(block for block in reader.blocks[1:] if block.kind != "COORDBRK")]
        stops[0].row.put("stop", True, stops[0].row.line)
        record.notes.append(f"no STOP: the stop is {stops[0].row.name}")
    if len(stops) > 1 or stops[0] in (first, last):
        raise record.error(0, f"{len(stops)} surfaces have STOP; exactly one in the lens must")
    record.distance = distance_of(first.thickness)
    record.medium = {
        key: value
        for key, value in first.row.entry.items()
        if key in ("glass", "index", "nd", "vd", "partial")
    }
    for block in reader.blocks[1:]:
        record.parts += _parts(reader, block, block is last)
    use.stop = stops[0].semi
    reader.head.finish()


def _parts(reader: _Reader, block: _Block, image: bool) -> list[Row | Breaking]:
    """A surface with the breaks in front of it and behind it, or a coordinate break."""
    record, row = reader.record, block.row
    if block.infinite:
        raise record.error(block.infinite, f"{row.name}: an infinite thickness; give a length")
    surface = Surface(record, row, reader.unit, block.parameters, block.semi)
    row.thickness = block.thickness or 0.0
    if block.kind == "COORDBRK":
        if image or row.entry.get("stop"):
            what = "image" if image else "stop"
            raise record.error(row.line, f"{row.name}: a coordinate break is no {what}")
        return [breaking(surface, row.thickness)]
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
    rim = [(block.floating, "CLAP", [0.0, block.semi])] if block.floating else []
    clipping(record, row, rim + block.apertures, block.centre)
    block.user.put(record, row, block.centre)
    parts: list[Row | Breaking] = [row]
    moves = {k: surface._replace(parameters=own) for k, own in block.moves.items()}
    if 1 in moves:
        parts.insert(0, breaking(moves[1], 0.0))
    if 2 in moves and not image:
        parts.append(breaking(moves[2], row.thickness))
        row.thickness = 0.0
    return parts
