"""Write a lens as a `.zmx` file, the inverse of `zmx`."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np

from ..lens.forms import FORMS
from ..lens.glasses import find_glass, map_point
from ..lens.lens import Lens
from .entry import LensError, require
from .glasses import to_ours, to_theirs, written_names
from .load import System
from .record import FieldKind
from .written import (
    element_of,
    entry_of,
    gap_behind,
    medium_of,
    number_for,
    place_of,
    shapes_of,
)
from .zmx import BESIDE, COLUMNS
from .zmx_configurations import rows
from .zmx_surfaces import APERTURES

_HEAD = """VERS 150514 0 0
MODE SEQ
NAME {name}
UNIT MM X W X CM MR CPMM
FLOA
ENVD 2.0E+1 1 0
GCAT {makers}
RAIM 0 {aiming} 1 1 0 0 0 0 0"""
_AIMING = {"off": 0, "paraxial": 1}
_TYPES = {  # by form: type, its parameters that hold the coefficients
    "asphere": ("EVENASPH", range(1, 9)),
    "odd_asphere": ("ODDASPHE", range(1, 9)),
    "toroid": ("TOROIDAL", range(1, 9)),
    "biconic": ("BICONICX", range(1, 3)),
}
_SERIES = {  # by form: type whose XDAT hold the coefficients
    "asphere": "XASPHERE",
    "odd_asphere": "XOSPHERE",
    "polynomial_xy": "XPOLYNOM",
    "zernike": "SZERNSAG",
    "qbfs": "QED_TYPE",
}
_OTHERS = {"silica": "F_SILICA"}


def zmx_text(systems: Sequence[System]) -> str:
    """The text of a file of one configuration or more. LensError, with the remedy, for features
    that are not written."""
    texts = [_lines(system, len(systems) > 1) for system in systems]
    return "\n".join([*texts[0], *rows(texts), ""])


def _lines(system: System, several: bool) -> list[str]:
    """The lines of one configuration, of one or `several`, before MNUM."""
    lens = system.lens
    media = [medium_of(lens, i) or {} for i in range(lens.count + 1)]
    makers, names = written_names([own["glass"] for own in media if "glass" in own])
    names |= {name: other for name, other in _OTHERS.items() if name in names}
    names = {name: f"{other} 0 0 {_numbers(name)}" for name, other in names.items()}
    head = {"name": " ".join(lens.name.split()), "makers": " ".join(makers)}
    lines = [_HEAD.format(**head, aiming=_AIMING.get(system.ray_aiming, 2)), *_use(system)]
    curvature, conic = (float(a[-1]) for a in (lens.curvature, lens.conic))
    image = ["TYPE STANDARD", f"CURV {curvature!r}", f"CONI {conic!r}"]
    surfaces = [*(_surface(lens, i, names, several) for i in range(lens.count)), image]
    gaps = [gap_behind(lens, i) for i in range(lens.count)]
    blocks, (first, *behind) = _with_breaks(lens, surfaces, gaps)
    far = system.distance + first
    place = repr(far) if math.isfinite(far) else "INFINITY"
    front = ["TYPE STANDARD", "CURV 0.0", f"DISZ {place}", *_glass(lens, 0, names)]
    placed = ([*own, f"DISZ {gap!r}"] for own, gap in zip(blocks, [*behind, 0.0], strict=True))
    for i, block in enumerate([front, *placed]):
        lines += [f"SURF {i}", *(f"  {line}" for line in block)]
    return lines


def _use(system: System) -> list[str]:
    """The lines of fields and wavelengths; each field from the 13th on has a line of its own."""
    kind, waves = get_args(FieldKind).index(system.field_kind), system.wavelengths.tolist()
    turned = system.vignetting * [1, 1, 1, 1, 180 / math.pi]
    fields = np.hstack([system.heights, system.field_weights[:, None], turned]).tolist()
    short = [[0.0, 0.0, 1.0, *[0.0] * 5]] * (BESIDE - len(fields))
    lines = [f"FTYP {kind} 0 {len(fields)} {len(waves)} 0 0 {int(system.lens.afocal)}"]
    for key, column in zip(COLUMNS, zip(*fields[:BESIDE], *short, strict=True), strict=True):
        lines.append(f"{key} {' '.join(map(repr, column))}")
    lines += [f"FEFD {' '.join(map(repr, row))}" for row in fields[BESIDE:]]
    for i, pair in enumerate(zip(waves, system.wavelength_weights.tolist(), strict=True)):
        lines.append(f"WAVM {i + 1} {' '.join(map(repr, pair))}")
    return [*lines, f"PWAV {system.primary + 1}"]


def _numbers(name: str) -> str:
    """nd and vd of a glass, for programs that do not know its name."""
    nd, vd = map_point(find_glass(name)) or (1.5, 40)
    return f"{nd:.7f} {vd:.5f}"


def _surface(lens: Lens, i: int, names: Mapping[str, str], several: bool) -> list[str]:
    """The lines of a surface except those of its position. several: True to write a conic of 0,
    which may differ in other configurations."""
    entry = entry_of(lens, i, {}) | ({"conic": float(lens.conic[i])} if several else {})
    lines = ["STOP"] if "stop" in entry else []
    lines += [*_form(i, entry), f"CURV {entry['curvature']!r}"]
    lines += [f"CONI {entry['conic']!r}"] if "conic" in entry else []
    lines += _glass(lens, i + 1, names)
    lines += [f"DIAM {entry['semi_diameter']!r} 1 0 0 1"] if "semi_diameter" in entry else []
    return lines + _apertures(lens, i)


def _form(i: int, entry: Mapping[str, Any]) -> list[str]:
    """The lines of the type of a surface and its parameters."""
    name = entry.get("form", "asphere")
    own = [entry[key] for key in FORMS[name].named]
    row = [*own, *entry["coefficients"].values()]
    if "phase" in entry:
        return _phase(i, name, entry["phase"], row)
    if name == "asphere" and not any(row):
        return ["TYPE STANDARD"]
    kind, numbers = _TYPES.get(name, ("", ()))
    used = max((k + 1 for k, value in enumerate(row) if value), default=0)
    fits = bool(kind) and used <= len(numbers)
    if not fits and name in _SERIES:
        before = [0] if name == "qbfs" else []
        goes_on = ["PARM 0 1"] if name == "zernike" else []  # terms extend beyond the radius
        terms = row[len(own) :]
        values = _numbered("XDAT", *before, len(terms), *(own or [1.0]), *terms)
        return [f"TYPE {_SERIES[name]}", *goes_on, *values]
    what = f"form {name}" + (f" with {used} coefficients" if kind else "")
    require(fits, f"surfaces[{i}]: .zmx files hold no {what} here: save as .yaml")
    if own and row[0]:
        row[0] = 1 / row[0]  # a radius
    # The last coefficient is written even if it is 0: it preserves the number of columns.
    return [f"TYPE {kind}", *_numbered("PARM", *row[: len(numbers)])]


def _numbered(key: str, *values: float) -> list[str]:
    """Lines of values with their numbers from 1."""
    return [f"{key} {k} {value!r}" for k, value in enumerate(values, 1)]


def _phase(i: int, name: str, phase: Mapping[str, Any], row: list[float]) -> list[str]:
    """The lines of a grating on a conic or a toroid, or of a radial phase (radians, norm radius
    1 mm) on an even asphere. name, row: form and coefficients of the surface."""
    form, order, own = phase["form"], phase["order"], [*phase["coefficients"].values()]
    if form == "linear" and name == "asphere" and not any(row):
        return ["TYPE DGRATING", *_numbered("PARM", own[0] / 1e3, order)]
    if form == "linear" and name == "toroid" and not any(row[1:]):
        radius = 1 / row[0] if row[0] else 0.0
        return ["TYPE TOROGRAT", *_numbered("PARM", radius, own[0] / 1e3, order)]
    what = f"surfaces[{i}].phase: not written to .zmx on this surface: save as .yaml"
    require(form == name == "asphere" and not any(row[8:]), what)
    turn = 2 * math.pi
    whole = [number_for(value, lambda radians: radians / turn, value * turn) for value in own]
    powers, terms = _numbered("PARM", *row[:8]), _numbered("XDAT", len(own), 1.0, *whole)
    return ["TYPE BINARY_2", f"PARM 0 {order!r}", *powers, *terms]


def _glass(lens: Lens, m: int, names: Mapping[str, str]) -> list[str]:
    """The line of medium m: 0 is the object's, m is behind surface m - 1. names: the words of the
    file for each glass."""
    if m and lens.mirrors[m - 1]:
        return ["GLAS MIRROR 0 0 1.5 40"]
    keys = medium_of(lens, m)
    if keys is None:
        what = f"glasses[{m}]: {lens.glasses[m]} has constants of its own, which a .zmx file does"
        raise LensError(f"{what} not hold: save as .yaml, or use with_model_glass")
    if "glass" in keys:
        return [f"GLAS {names[keys['glass']]}"]
    if "index" in keys:
        return [f"GLAS ___BLANK 1 0 {keys['index']!r} 0 0"]
    if not keys:
        return []
    ours = keys["nd"], keys["vd"], keys.get("dPgF", 0.0)
    theirs = to_theirs(*ours)
    rounded = ([round(value, digits) for value in theirs] for digits in range(3, 17))
    # The fewest digits that are read back as the same numbers.
    short = next((values for values in rounded if to_ours(*values) == ours), theirs)
    return [f"GLAS ___BLANK 1 0 {' '.join(map(repr, short))}"]


def _apertures(lens: Lens, i: int) -> list[str]:
    """The lines of the aperture: one shape, or a circle within another."""
    shapes = shapes_of(lens, i)  # clear ones before those that block
    if not shapes:
        return []
    (blocks, kind, size, centre), *others = shapes
    inner = others[0][2][0] if others else 0.0
    ring = [(True, "circle", [inner, inner], centre)]
    if others and (kind != "circle" or blocks or others != ring):
        own = " and ".join(f"{'a blocking' if s[0] else 'a clear'} {s[1]}" for s in shapes)
        what = f"surfaces[{i}]: has {own}; a .zmx surface has one aperture, or a blocking circle in"
        remedy = "put the others on plane surfaces next to it, or save as .yaml"
        raise LensError(f"{what} a clear one of its centre: {remedy}")
    word = APERTURES[kind][blocks]
    if kind == "polygon":
        corners = [*zip(size[::2], size[1::2], strict=True)]
        what = f"surfaces[{i}]: a corner 0 0 ends a polygon in .zmx files: save as .yaml"
        require((0, 0) not in corners, what)
        lines = [f"{word} 0 0 0", 'UDAD 0 "POLYGON.UDA" 1']
        lines += [f"UDAD {n} {x!r} {y!r} 0" for n, (x, y) in enumerate(corners, 1)]
    else:
        pair = [inner, size[0]] if kind == "circle" else size
        lines = [f"{word} {pair[0]!r} {pair[1]!r} 0"]
    return [*lines, f"OBDC {centre[0]!r} {centre[1]!r}"] if any(centre) else lines


def _moves(lens: Lens) -> list[dict[str, Any]]:
    """The moves of elements and of single surfaces, as the entries of elements; outer moves precede
    the moves inside them."""
    found, own = [], lens.elements
    if own is not None:
        found = [element_of(own, g) for g in range(len(own.spans))]
    for i in range(lens.count + 1):
        place = {"decentre": [0.0, 0.0], "tilt": [0.0] * 3} | place_of(lens, i)
        moved = {"shift": [*place["decentre"], 0.0], "tilt": place["tilt"]}
        found.append({"surfaces": [i, i], "about": i, "pivot": 0.0} | moved)
    moves = [move for move in found if any(move["shift"]) or any(move["tilt"])]
    return sorted(moves, key=lambda move: (move["surfaces"][0], -move["surfaces"][1]))


def _with_breaks(
    lens: Lens, surfaces: list[list[str]], gaps: list[float]
) -> tuple[list[list[str]], list[float]]:
    """Insert the coordinate breaks among the blocks of lines of the S surfaces and the image.

    Each move of surfaces about a pivot becomes a break at the pivot in front of its first surface,
    and the inverse break behind its last one. The thickness in front of a break leads along the
    axis to its pivot, so that the thicknesses between two surfaces have the sum of their gap.

    gaps: (S,), thickness behind each surface, mm.

    Returns all blocks, and the thickness (mm) in front of each one. That in front of the first
    block is measured from the first vertex before it is moved.
    """
    moves, axis = _moves(lens), [0.0, *np.cumsum(gaps).tolist()]
    blocks: list[list[str]] = []
    behind: list[float] = []
    for i, surface in enumerate(surfaces):
        before, gap = (i - 1, gaps[i - 1]) if i else (0, 0.0)
        at = 0.0  # mm from surface `before`, along the axis of that surface
        ends = [(move, True) for move in reversed(moves) if move["surfaces"][1] == i - 1]
        begins = [(move, False) for move in moves if move["surfaces"][0] == i]
        for move, back in ends + begins:
            about, along = move["about"], move["shift"][2]
            pivot = {before: 0.0, i: gap}.get(about, axis[about] - axis[before]) + move["pivot"]
            behind.append(pivot - at + (0.0 if back else along))
            # `back` is the inverse: tilts in reverse order, then the decentre.
            numbers = [*move["shift"][:2], *move["tilt"]]
            values = [0.0 - value for value in numbers] if back else numbers
            lines = [f"PARM {k} {value!r}" for k, value in enumerate(values, 1) if value]
            blocks.append(["TYPE COORDBRK", "CURV 0.0", *lines, *(["PARM 6 1"] if back else [])])
            at = pivot + (along if back else 0.0)
        behind.append(gap - at)
        blocks.append(surface)
    return blocks, behind
