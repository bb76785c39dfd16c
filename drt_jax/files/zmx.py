"""Read lens files of Zemax OpticStudio, `.zmx`; docs/lens_files.md explains the keywords."""

import math
from typing import Any

from .entry import LensError
from .forms_zmx import EXTRA, TYPES, Surface, breaking
from .glasses import model_keys, named_glass
from .record import Breaking, Missing, Record, Row, Words, distance_of, short, words_of
from .specs import MEDIUM_KEYS
from .system import Use
from .zmx_head import Head

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
# User apertures, whose corners UDAD lines give: the key of a prescription.
_USER = {"USAP": "aperture", "USOB": "obscuration", "UOBS": "obscuration"}
_SHAPES = {"SQ": "rectangle", "EL": "ellipse"}


def _take(surface: Surface, words: Words) -> bool:
    """Read a line of a surface; False if its keyword is not known."""
    record, line, values = surface.record, words.line, words.values
    match words.key:
        case "TYPE":
            surface.kind, surface.kind_line = values[0].upper() if values else "", line
        case "STOP":
            surface.put("stop", True, line)
        case "CURV":
            surface.put("curvature", words.number() / surface.unit, line)
            if values[1:] and values[1] not in ("0", "1"):  # 1 is a variable
                record.solves.append(line)
        case "CONI":
            if conic := words.number():
                surface.put("conic", conic, line)
        case "DISZ":
            surface.lines["thickness"] = line
            if values and values[0].upper() in ("INFINITY", "INF"):
                surface.infinite, surface.gap = line, math.inf
            else:
                surface.gap = words.number() * surface.unit
        case "PARM" | "XDAT":
            number = words.count() + (EXTRA - 1 if words.key == "XDAT" else 0)
            surface.parameters[number] = line, words.number(1)
        case "GLAS":
            for key, value in _glass(surface, words).items():
                surface.put(key, value, line)
        case "DIAM":
            surface.semi = abs(words.number() * surface.unit)
        case "FLAP":
            surface.floating = line
        case "CLAP" | "SQAP" | "ELAP" | "OBSC" | "SQOB" | "ELOB":
            sizes = [value * surface.unit for value in words.numbers(0, 2)]
            surface.apertures.append((line, words.key, sizes))
        case "OBDC":
            surface.centre = [value * surface.unit for value in words.numbers(0, 2)]
        case "USAP" | "USOB" | "UOBS" | "UDAD":
            _user_line(surface, words)
        case "SPID" | "UDAP" | "UDOB":
            if words.key != "SPID" or any(word.strip("+-.0") for word in values):
                record.lacks(line, f"{words.key}, {_REFUSED[words.key]}")
        case "SCBD":
            _moves(surface, words)
        case _:
            return False
    return True


def _glass(surface: Surface, words: Words) -> dict[str, Any]:
    """The entries of the medium behind a surface: a mirror, a code, a model glass or a name."""
    line = words.line
    name = words.values[0] if words.values else ""
    if name.upper() == "MIRROR":
        return {"mirror": True}
    if name.isdecimal() and len(name) == 6:
        return model_keys(surface, line, 1 + int(name[:3]) / 1000, int(name[3:]) / 10, 0.0)
    if name == "___BLANK":
        nd, vd, above = words.number(3), words.number(4), words.number(5, 0)
        return model_keys(surface, line, nd, vd, above)
    beside: dict[str, Any] = {}
    try:  # nd and vd behind a name, but for the placeholder 1.5 and 40 of OpticStudio
        nd, vd, above = (words.number(i, 0.0) for i in (3, 4, 5))
        if nd > 1 and (nd, vd) != (1.5, 40):
            beside = model_keys(surface, line, nd, vd, above)
    except LensError:
        pass
    return named_glass(surface, line, name, surface.makers, beside)


def _moves(surface: Surface, words: Words) -> None:
    """SCBD: tilt and decentre in front of a surface (1) or behind it (2), with order, a pickup
    and five numbers; a coordinate return (3) is a solve."""
    where = words.count()
    if where == 3:
        surface.record.solves.append(words.line)
        return
    words.require(where in (1, 2), f"SCBD {where}: expected 1, 2 or 3")
    own = {k + 1: (words.line, words.number(3 + k)) for k in range(5)}
    if any(value for _, value in own.values()):
        surface.moves[where] = own | {6: (words.line, words.count(1))}


def _user_line(surface: Surface, words: Words) -> None:
    """A line of a user aperture. UDAD: number, x, y, 0 of a corner; number 0 is of a line with the
    name of a file, whose scale comes last."""
    values, key = words.values, words.key
    if key != "UDAD":
        surface.user_line, surface.user = words.line, key
        zeros = not any(words.numbers(0, len(values)))
        words.require(zeros, f"{key}: expected zeros; other numbers are not known")
        return
    surface.user_line, number = surface.user_line or words.line, words.count()
    if number == 0:
        scaled = len(values) > 1 and values[-1][-1] != '"' and words.number(len(values) - 1) != 1
        words.require(not scaled, "UDAD: a scale other than 1; scale the corners")
        return
    due = number == len(surface.corners) + 1 and not any(words.numbers(0, len(values))[3:])
    words.require(due, "UDAD: expected corners 1, 2, ... of a polygon: number, x, y, 0")
    surface.corners.append([value * surface.unit for value in words.numbers(1, 3)])


def _clip(surface: Surface) -> None:
    """Set apertures and obscurations. DIAM alone clips nothing, nor does an aperture beyond the end
    of the surface."""
    record = surface.record
    about: dict[str, Any] = {"centre": surface.centre} if any(surface.centre) else {}
    rim = [(surface.floating, "CLAP", [0.0, surface.semi])] if surface.floating else []
    for line, kind, (one, two) in rim + surface.apertures:
        if kind[:2] in _SHAPES:
            key = "obscuration" if kind[2:] == "OB" else "aperture"
            surface.put_shape(key, about | {_SHAPES[kind[:2]]: [one, two]}, line)
            continue
        ring = kind == "OBSC" and one > 0
        inner = two if kind == "OBSC" else one
        if ring:
            record.lacks(line, f"{surface.name}: an obscuration that is a ring")
        elif inner > 0:
            surface.put_shape("obscuration", about | {"circle": inner}, line)
        if kind == "CLAP" and two > 0:
            surface.put_clear(about | {"circle": two}, line)
    if not surface.user_line:
        return
    corners = list(surface.corners)
    while corners and corners[-1] == [0, 0]:  # the end of a polygon
        corners.pop()
    why = "no UDAD lines" if not corners else ""
    why = "two polygons: a corner 0 0 ends one" if [0, 0] in corners else why
    why = why if surface.user else "UDAD lines without USAP or USOB"
    if why:
        record.lacks(surface.user_line, f"{surface.name}: a user aperture with {why}")
    else:
        surface.put_shape(_USER[surface.user], about | {"polygon": corners}, surface.user_line)


def read_zmx(path: str, missing: Missing, lines: list[str]) -> tuple[Record, Use]:
    """Read the lines of a `.zmx` file into a record of its surfaces and their use. LensError with
    the line. path: its name in messages."""
    record, surfaces, tail = Record(path, missing), list[Surface](), False
    head, found = Head(record), words_of(record, lines)
    whole = not any(words.key == "VERS" for words in found)
    indented = any(w.indented for w in found if w.key in ("TYPE", "CURV", "DISZ"))

    def taken(words: Words) -> bool:
        """Whether a line is of the header, or of a surface in front of the tail."""
        return not tail and _take(surfaces[-1], words) if surfaces else head.take(words)

    for words in found:
        if words.key == "SURF":
            words.require(not tail, "a surface behind the merit function")
            number, due = words.count(), len(surfaces)
            words.require(number == due, f"SURF {number} stands where SURF {due} should")
            words.require(due <= _SURFACES, f"more than {_SURFACES} surfaces")
            own = Surface(record, f"SURF {number}", words.line, head.unit, makers=head.makers)
            surfaces.append(own)
        elif words.key == "MODE" and words.values[:1] not in (["SEQ"], []):
            raise words.error("not sequential; save a sequential system")
        elif words.key == "MNUM":
            tail = whole = True
            if (count := words.count(0, 1)) > 1:
                what = f"of {count} configurations number {words.count(1, 1)}"
                record.note(words.line, what)
        elif taken(words):
            continue
        elif surfaces and indented and not words.indented:
            tail = True
        elif words.key in _SOLVES:
            record.solves.append(words.line)
        elif not tail and words.key not in _COSMETIC:
            tail = bool(surfaces) and not indented and words.key in ("TOL", "DMFS", "MOFF")
            if not tail:
                record.unknown.setdefault(short(words.key), words.line)
    if not surfaces:
        raise LensError(f"{path}: no line begins with SURF: is it a .zmx file?")
    _finish(record, head, surfaces, whole)
    return record, head.use


def _finish(record: Record, head: Head, surfaces: list[Surface], whole: bool) -> None:
    """Do the checks and conversions that need all lines."""
    first, last = surfaces[0], surfaces[-1]
    ends = len(surfaces) > 2 and not last.gap and not last.infinite
    what = "the last SURF is no image: is the file cut short?"
    record.require(ends, last.line, what)
    what = "SURF without DISZ: is the file cut short?"
    record.require(last.gap is not None, last.line, what)
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
    what = f"{len(stops)} surfaces have STOP; exactly one in the lens must"
    record.require(inside, 0, what)
    record.distance, entry = distance_of(first.gap), first.entry
    record.medium = {key: entry[key] for key in entry if key in MEDIUM_KEYS}
    for surface in surfaces[1:]:
        record.parts += _parts(surface, surface is last)
    head.use.stop = stops[0].semi
    head.finish()


def _parts(surface: Surface, image: bool) -> list[Row | Breaking]:
    """A surface with the breaks in front of it and behind it, or a coordinate break."""
    kind, moves = surface.kind, surface.moves
    surface.require(not surface.infinite, "an infinite thickness; give a length", surface.infinite)
    surface.thickness = surface.gap or 0.0
    if kind == "COORDBRK":
        inside = not image and not surface.entry.get("stop")
        surface.require(inside, f"a coordinate break is no {'image' if image else 'stop'}")
        return [breaking(surface, surface.parameters, surface.thickness)]
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
    _clip(surface)
    parts: list[Row | Breaking] = [surface]
    if 1 in moves:
        parts.insert(0, breaking(surface, moves[1], 0.0))
    if 2 in moves and not image:
        parts.append(breaking(surface, moves[2], surface.thickness))
        surface.thickness = 0.0
    return parts
