"""Write a lens as a `.zmx` file, the inverse of `zmx`."""

import math
from collections.abc import Mapping
from typing import get_args

import numpy as np

from ..lens.forms import FORMS
from ..lens.glasses import find_glass, map_point
from ..lens.lens import Lens
from .apertures import Shape, shapes_of
from .breaks_out import with_breaks
from .entry import LensError
from .exact import number_for
from .glasses import written_names
from .media_out import medium_of
from .model_zmx import to_ours, to_theirs
from .system import FieldKind, System
from .zmx_head import BESIDE, COLUMNS

_HEAD = """VERS 150514 0 0
MODE SEQ
NAME {name}
UNIT MM X W X CM MR CPMM
FLOA
ENVD 2.0E+1 1 0
GCAT {makers}
RAIM 0 {aiming} 1 1 0 0 0 0 0"""
_AIMING = {"off": 0, "paraxial": 1}
_TYPES = {  # by form: type, parameters of the coefficients, whether the first is a radius
    "asphere": ("EVENASPH", range(1, 9), False),
    "odd_asphere": ("ODDASPHE", range(1, 9), False),
    "toroid": ("TOROIDAL", range(1, 9), True),
    "biconic": ("BICONICX", range(1, 3), True),
}
_SERIES = {  # by form: type whose XDAT hold the coefficients, the values before them
    "asphere": ("XASPHERE", ()),
    "odd_asphere": ("XOSPHERE", ()),
    "polynomial_xy": ("XPOLYNOM", ()),
    "zernike": ("SZERNSAG", ()),
    "qbfs": ("QED_TYPE", (0,)),
}
_OTHERS = {"silica": "F_SILICA"}
_KEYS = {"rectangle": ("SQAP", "SQOB"), "ellipse": ("ELAP", "ELOB")}  # clear, blocking


def zmx_text(system: System) -> str:
    """The text of a file. LensError, with the remedy, for features that are not written."""
    lens = system.lens
    media = [medium_of(lens, i) or {} for i in range(lens.count + 1)]
    makers, names = written_names([own["glass"] for own in media if "glass" in own])
    names |= {name: other for name, other in _OTHERS.items() if name in names}
    names = {name: f"{other} 0 0 {_numbers(name)}" for name, other in names.items()}
    head = {"name": " ".join(lens.name.split()), "makers": " ".join(makers)}
    lines = [_HEAD.format(**head, aiming=_AIMING.get(system.ray_aiming, 2)), *_use(system)]
    curvature, conic = (float(a[-1]) for a in (lens.curvature, lens.conic))
    image = ["TYPE STANDARD", f"CURV {curvature!r}", f"CONI {conic!r}"]
    surfaces = [*(_surface(lens, i, names) for i in range(lens.count)), image]
    gaps = [gap_behind(lens, i) for i in range(lens.count)]
    blocks, (first, *behind) = with_breaks(lens, surfaces, gaps)
    far = system.distance + first
    place = repr(far) if math.isfinite(far) else "INFINITY"
    front = ["TYPE STANDARD", "CURV 0.0", f"DISZ {place}", *_glass(lens, 0, names)]
    placed = ([*own, f"DISZ {gap!r}"] for own, gap in zip(blocks, [*behind, 0.0], strict=True))
    for i, block in enumerate([front, *placed]):
        lines += [f"SURF {i}", *(f"  {line}" for line in block)]
    return "\n".join([*lines, "MNUM 1 1", ""])


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


def gap_behind(lens: Lens, i: int) -> float:
    """The thickness (mm) behind a surface; the last one makes their sum equal `lens.sensor`."""
    gaps = np.asarray(lens.thickness, float).tolist()
    if i < lens.count - 1:
        return gaps[i]
    before, sensor = sum(gaps), float(lens.sensor)
    return number_for(sensor, lambda gap: before + gap, sensor - before)


def _surface(lens: Lens, i: int, names: Mapping[str, str]) -> list[str]:
    lines = ["STOP"] if i == lens.stop else []
    lines += [*_form(lens, i), f"CURV {float(lens.curvature[i])!r}"]
    lines += [f"CONI {float(lens.conic[i])!r}"] if lens.conic[i] else []
    lines += _glass(lens, i + 1, names)
    semi = float(lens.semi_diameter[i])
    lines += [f"DIAM {semi!r} 1 0 0 1"] if math.isfinite(semi) else []
    return lines + _apertures(lens, i)


def _form(lens: Lens, i: int) -> list[str]:
    name, row = lens.forms[i], np.asarray(lens.coefficients[i], float).tolist()
    if lens.phase is not None and i in lens.phase.surfaces:
        return _phase(lens, i, row)
    if name == "asphere" and not any(row):
        return ["TYPE STANDARD"]
    kind, numbers, radius = _TYPES.get(name, ("", (), False))
    used = [k for k, value in enumerate(row) if value]
    if name in _SERIES and (not kind or (used and used[-1] >= len(numbers))):
        kind, before = _SERIES[name]
        size, terms = (row[0], row[1:]) if FORMS[name].named else (1.0, row)
        goes_on = ["PARM 0 1"] if name == "zernike" else []  # terms extend beyond the radius
        return [f"TYPE {kind}", *goes_on, *_extra(*before, len(terms), size, *terms)]
    if not kind or (used and used[-1] >= len(numbers)):
        what = f"form {name}" + (f" with {used[-1] + 1} coefficients" if kind else "")
        raise LensError(f"surfaces[{i}]: .zmx files hold no {what} here: save as .yaml")
    if radius and row[0]:
        row[0] = 1 / row[0]
    # The last coefficient, even 0, preserves the number of columns.
    return [
        f"TYPE {kind}",
        *(f"PARM {n} {value!r}" for n, value in zip(numbers, row, strict=False)),
    ]


def _extra(*values: float) -> list[str]:
    return [f"XDAT {k + 1} {value!r}" for k, value in enumerate(values)]


def _phase(lens: Lens, i: int, row: list[float]) -> list[str]:
    """A grating on a conic or a toroid; or a radial phase (radians, norm radius 1 mm) on an even
    asphere."""
    assert lens.phase is not None
    at = lens.phase.surfaces.index(i)
    order, form = float(lens.phase.order[at]), lens.phase.forms[at]
    own = np.asarray(lens.phase.coefficients[at], float).tolist()
    if form == "linear" and lens.forms[i] == "asphere" and not any(row):
        return ["TYPE DGRATING", f"PARM 1 {own[0] / 1e3!r}", f"PARM 2 {order!r}"]
    if form == "linear" and lens.forms[i] == "toroid" and not any(row[1:]):
        radius = 1 / row[0] if row[0] else 0.0
        numbers = enumerate((radius, own[0] / 1e3, order), 1)
        return ["TYPE TOROGRAT", *(f"PARM {k} {value!r}" for k, value in numbers)]
    if form != "asphere" or lens.forms[i] != "asphere" or any(row[8:]):
        raise LensError(f"surfaces[{i}].phase: not written to .zmx on this surface: save as .yaml")
    powers = [f"PARM {k + 1} {value!r}" for k, value in enumerate(row[:8])]
    turn = 2 * math.pi
    whole = [number_for(value, lambda radians: radians / turn, value * turn) for value in own]
    return ["TYPE BINARY_2", f"PARM 0 {order!r}", *powers, *_extra(len(own), 1.0, *whole)]


def _glass(lens: Lens, m: int, names: Mapping[str, str]) -> list[str]:
    """The line of medium m: 0 is the object's, m is behind surface m - 1. names: the words of the
    file for each glass."""
    if m and lens.mirrors[m - 1]:
        return ["GLAS MIRROR 0 0 1.5 40"]
    keys = medium_of(lens, m)
    if keys is None:
        raise LensError(
            f"glasses[{m}]: {lens.glasses[m]} has constants of its own, which a .zmx file does not "
            "hold: save as .yaml, or use with_model_glass"
        )
    if "glass" in keys:
        return [f"GLAS {names[keys['glass']]}"]
    if "index" in keys:
        return [f"GLAS ___BLANK 1 0 {keys['index']!r} 0 0"]
    if not keys:
        return []
    ours = keys["nd"], keys["vd"], keys.get("partial", 0.0)
    theirs = to_theirs(*ours)
    for digits in range(3, 17):  # the fewest digits that read back
        short = (round(theirs[0], digits), round(theirs[1], digits), round(theirs[2], digits))
        if to_ours(*short) == ours:
            theirs = short
            break
    return [f"GLAS ___BLANK 1 0 {' '.join(map(repr, theirs))}"]


def _apertures(lens: Lens, i: int) -> list[str]:
    """The lines of the aperture: one shape, or a circle within another."""
    shapes = sorted(shapes_of(lens, i))  # clear ones before those that block
    if not shapes:
        return []
    (blocks, kind, size, centre), *others = shapes
    inner = others[0].size[0] if others else 0.0
    ring = Shape(True, "circle", [inner] * 2, centre)
    if others and not (kind == "circle" and not blocks and others == [ring]):
        own = " and ".join(f"{'a blocking' if s.blocks else 'a clear'} {s.kind}" for s in shapes)
        raise LensError(
            f"surfaces[{i}]: has {own}; a .zmx surface has one aperture, or a blocking circle in a "
            "clear one of its centre: put the others on plane surfaces of their own beside it, or "
            "save as .yaml"
        )
    if kind == "polygon":
        corners = [*zip(size[::2], size[1::2], strict=True)]
        if (0, 0) in corners:
            raise LensError(
                f"surfaces[{i}]: a corner 0 0 ends a polygon in .zmx files: save as .yaml"
            )
        lines = [f"{'USOB' if blocks else 'USAP'} 0 0 0", 'UDAD 0 "POLYGON.UDA" 1']
        lines += [f"UDAD {n} {x!r} {y!r} 0" for n, (x, y) in enumerate(corners, 1)]
    elif kind == "circle":
        lines = [f"{'OBSC' if blocks else 'CLAP'} {inner!r} {size[0]!r} 0"]
    else:
        lines = [f"{_KEYS[kind][blocks]} {size[0]!r} {size[1]!r} 0"]
    return [*lines, f"OBDC {centre[0]!r} {centre[1]!r}"] if any(centre) else lines
