"""Surfaces of `.zmx` files: their lines, and conversion to prescription entries."""

import dataclasses
import math
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from ..lens.forms import noll_of_fringe
from .entry import LensError
from .glasses import code_of, model_keys, named_glass
from .record import XY, Row, Words

EXTRA = 13  # the parameter number of XDAT 1
_XDAT = range(EXTRA, 400)
_EIGHT = range(1, 9)
# The power of the height by number of the parameter, and key and power of each term of a series.
_ODD, _EVEN = {k: k for k in _EIGHT}, {k: 2 * k for k in _EIGHT}
_ODD_TERMS = [(k, k) for k in range(1, 301)]
_EVEN_TERMS = [(2 * k, 2 * k) for k in range(1, 301)]
_QCON = 11  # most Qcon terms: as powers, the last one loses 8 of 16 digits
# The keywords of each shape, clear and blocking. A circle has an inner and an outer radius, and
# UDAD lines give the corners of a polygon.
APERTURES = {
    "circle": ("CLAP", "OBSC"),
    "rectangle": ("SQAP", "SQOB"),
    "ellipse": ("ELAP", "ELOB"),
    "polygon": ("USAP", "USOB"),
}
_APERTURES = {
    word: (kind, "obscuration" if blocks else "aperture")
    for kind, words in APERTURES.items()
    for blocks, word in enumerate(words)
} | {"UOBS": ("polygon", "obscuration")}


@dataclasses.dataclass
class Surface(Row):
    """What the lines of a surface have set so far; XDAT starts at number 13 of its `values`.

    makers: the catalogues of the header.
    gap, semi: DISZ and DIAM, mm.
    apertures: line, keyword and two lengths (mm) of each aperture, about `centre`.
    moves: the values of a coordinate break in front of the surface (1) and behind it (2).
    user, corners: the keyword of a user aperture and its corners [x, y], mm.

    `lines` has FLAP and `user` if the surface has a floating or a user aperture.
    """

    kind: str = "STANDARD"
    makers: list[str] = dataclasses.field(default_factory=list)
    gap: float | None = None
    semi: float = 0.0
    apertures: list[tuple[int, str, list[float]]] = dataclasses.field(default_factory=list)
    centre: list[float] = dataclasses.field(default_factory=list)
    moves: dict[int, dict[Any, tuple[int, float]]] = dataclasses.field(default_factory=dict)
    user: str = ""
    corners: list[list[float]] = dataclasses.field(default_factory=list)

    def take(self, words: Words) -> bool:
        """Read a line of the surface; False if its keyword is not known."""
        line, key, values = words.line, words.key, words.values
        match key:
            case "TYPE":
                self.kind, self.kind_line = values[0].upper() if values else "", line
            case "STOP":
                self.put("stop", True, line)
            case "CURV":
                self.put("curvature", words.number() / self.unit, line)
                if values[1:] and values[1] not in ("0", "1"):  # 1 is a variable
                    self.record.solves.append(line)
            case "CONI":
                if conic := words.number():
                    self.put("conic", conic, line)
            case "DISZ":
                infinite = values and values[0].upper() in ("INFINITY", "INF")
                self.gap = math.inf if infinite else words.number() * self.unit
                self.lines["thickness"] = line
            case "PARM" | "XDAT":
                number = words.count() + (EXTRA - 1 if key == "XDAT" else 0)
                self.values[number] = line, words.number(1)
            case "GLAS":
                for name, value in self._glass(words).items():
                    self.put(name, value, line)
            case "DIAM":
                self.semi = abs(words.number() * self.unit)
            case "FLAP":
                self.lines["FLAP"] = line
            case "CLAP" | "SQAP" | "ELAP" | "OBSC" | "SQOB" | "ELOB":
                self.apertures.append((line, key, self._lengths(words, 0)))
            case "OBDC":
                self.centre = self._lengths(words, 0)
            case "USAP" | "USOB" | "UOBS":
                self.lines["user"], self.user = line, key
                zeros = not any(words.numbers(0, len(values)))
                words.require(zeros, f"{key}: expected zeros; other numbers are not known")
            case "UDAD":
                self._corner(words)
            case "SPID":
                if any(word.strip("+-.0") for word in values):
                    self.record.lacks(line, "SPID, a spider")
            case "UDAP" | "UDOB":
                kind = "aperture" if key == "UDAP" else "obscuration"
                self.record.lacks(line, f"{key}, an {kind} from a file")
            case "SCBD":
                self._move(words)
            case _:
                return False
        return True

    def _lengths(self, words: Words, first: int) -> list[float]:
        """Two values of a line, from number `first` on, in mm."""
        return [value * self.unit for value in words.numbers(first, first + 2)]

    def _glass(self, words: Words) -> dict[str, Any]:
        """The entries of the medium behind the surface: a mirror, a code, a model glass or a
        name."""
        line, name = words.line, words.values[0] if words.values else ""
        if name.upper() == "MIRROR":
            return {"mirror": True}
        if name.isdecimal() and len(name) == 6 and (code := code_of(name)):
            return model_keys(self, line, *code, 0.0)
        if name == "___BLANK":
            return model_keys(self, line, words.number(3), words.number(4), words.number(5, 0))
        beside: dict[str, Any] = {}
        try:  # nd and vd behind a name, unless they are OpticStudio's placeholders 1.5 and 40
            nd, vd, above = (words.number(i, 0.0) for i in (3, 4, 5))
            if nd > 1 and (nd, vd) != (1.5, 40):
                beside = model_keys(self, line, nd, vd, above)
        except LensError:
            pass
        return named_glass(self, line, name, self.makers, beside)

    def _move(self, words: Words) -> None:
        """SCBD: tilt and decentre in front of the surface (1) or behind it (2), with order, a
        pickup and five numbers; a coordinate return (3) is a solve."""
        where = words.count()
        words.require(where in (1, 2, 3), f"SCBD {where}: expected 1, 2 or 3")
        if where == 3:
            self.record.solves.append(words.line)
        elif any(numbers := words.numbers(3, 8)):
            six = [*numbers, words.count(1)]
            self.moves[where] = {k: (words.line, value) for k, value in enumerate(six, 1)}

    def _corner(self, words: Words) -> None:
        """UDAD: number, x, y, 0 of a corner. A line with the number 0 names a file and ends with
        its scale."""
        values, number = words.values, words.count()
        self.lines.setdefault("user", words.line)
        if number == 0:
            named = len(values) < 2 or values[-1][-1] == '"'
            scale = 1.0 if named else words.number(len(values) - 1)
            words.require(scale == 1, "UDAD: a scale other than 1; scale the corners")
            return
        due = number == len(self.corners) + 1 and not any(words.numbers(0, len(values))[3:])
        words.require(due, "UDAD: expected corners 1, 2, ... of a polygon: number, x, y, 0")
        self.corners.append(self._lengths(words, 1))

    def clip(self) -> None:
        """Set apertures and obscurations. Neither DIAM alone nor an aperture beyond the domain of
        the sag clips rays."""
        about: dict[str, Any] = {"centre": self.centre} if any(self.centre) else {}
        floating = self.lines.get("FLAP", 0)
        rim = [(floating, "CLAP", [0.0, self.semi])] if floating else []
        for line, word, (one, two) in rim + self.apertures:
            kind, key = _APERTURES[word]
            if kind != "circle":
                self.put_shape(key, about | {kind: [one, two]}, line)
                continue
            clear = word == "CLAP"
            inner = one if clear else two
            if not clear and one > 0:
                self.record.lacks(line, f"{self.name}: an obscuration that is a ring")
            elif inner > 0:
                self.put_shape("obscuration", about | {"circle": inner}, line)
            if clear and two > 0:
                self.put_clear(about | {"circle": two}, line)
        if line := self.lines.get("user", 0):
            self._polygon(about, line)

    def _polygon(self, about: dict[str, Any], line: int) -> None:
        """Set the polygon of a user aperture; `about` has its centre."""
        corners = list(self.corners)
        while corners and corners[-1] == [0, 0]:  # the end of a polygon
            corners.pop()
        why = "no UDAD lines" if not corners else ""
        why = "two polygons: a corner 0 0 ends one" if [0, 0] in corners else why
        why = why if self.user else "UDAD lines without USAP or USOB"
        if why:
            self.record.lacks(line, f"{self.name}: a user aperture with {why}")
        else:
            kind, key = _APERTURES[self.user]
            self.put_shape(key, about | {kind: corners}, line)

    def only(self, known: Collection[int] | None) -> None:
        """LensError for nonzero parameters whose number is not in `known`; None accepts all."""
        for number, (line, value) in self.values.items():
            if known is not None and value and number not in known:
                extra = f" (XDAT {number - EXTRA + 1})" if number >= EXTRA else ""
                what = f"parameter {number}{extra} of {self.name} is not read"
                raise self.record.error(line, what)

    def series(self, first: int = EXTRA) -> tuple[float, list[float]]:
        """The norm radius (mm) of a series, and its values as in the file. From parameter `first`
        on, the file has the number of values, the radius, and the values; the rest is ignored."""
        count, radius = self.value(first), self.value(first + 1) * self.unit
        line = self.values.get(first, (self.line, 0))[0]
        self.require(count % 1 == 0 and 0 <= count <= 300, f"{count:g} terms; give 0 to 300", line)
        found = [self.value(first + 2 + k) for k in range(int(count))]
        known = 1e-6 <= radius <= 1e6 or not any(found)
        self.require(known, f"a norm radius of {radius:g} mm", line)
        return radius, found

    def spread(self, radius: float, found: dict[Any, tuple[float, int]]) -> dict[Any, float]:
        """Coefficients by key: each value of `found` divided by the given power of the radius."""
        with np.errstate(all="ignore"):
            terms = {k: float(v / np.float64(radius) ** p) for k, (v, p) in found.items() if v}
        for key, value in terms.items():
            self.require(value and math.isfinite(value), f"term {key} overflows")
        return terms

    def curvature(self, number: int) -> float:
        """The curvature (1/mm) of a parameter that holds a radius; 0 if that is 0."""
        radius = self.value(number) * self.unit
        return 1 / radius if abs(radius) > 1e-12 else 0.0


def _toroid(surface: Surface) -> None:
    # XDAT holds the number of Zernike terms, their radius and the terms, which must be 0.
    if surface.value(EXTRA):
        surface.only((*range(9), EXTRA, EXTRA + 1))
    terms = surface.powers({k: 2 * (k - 1) for k in _EIGHT[1:]})
    surface.shape("toroid", terms, curvature_x=surface.curvature(1))


def _extended(surface: Surface, form: str, keys: Sequence[tuple[Any, int]]) -> None:
    """A conic plus a series over a norm radius. keys: the key and the power of each term."""
    radius, found = surface.series()
    terms = {key: (a * surface.unit, p) for (key, p), a in zip(keys, found, strict=False)}
    surface.shape(form, surface.spread(radius, terms))


def _extended_even(surface: Surface) -> None:
    """An extended asphere. Some programs write an even asphere under this name, with its
    coefficients in PARM 1 to 8 and no XDAT."""
    if not surface.value(EXTRA) and any(map(surface.value, _EIGHT)):
        what = "XASPHERE with PARM and no XDAT is an even asphere"
        surface.record.notes.append(f"{surface.name}: {what}")
        surface.only(_EIGHT)
        surface.shape("asphere", surface.powers(_EVEN))
        return
    surface.only(_XDAT)
    _extended(surface, "asphere", _EVEN_TERMS)


def _binary(surface: Surface) -> None:
    """An even asphere with the phase order (a_1 u^2 + a_2 u^4 + ...) in radians."""
    surface.shape("asphere", surface.powers(_EVEN))
    radius, found = surface.series()
    terms = {2 * k + 2: (a / (2 * math.pi), 2 * k + 2) for k, a in enumerate(found)}
    phase = surface.spread(radius, terms)
    surface.require(not phase or 0 in surface.values, "PARM 0, the order")
    if phase:
        _phase(surface, "asphere", surface.value(0), phase)


def _phase(surface: Surface, form: str, order: float, terms: dict[Any, float]) -> None:
    if order:
        surface.put("phase", {"form": form, "order": order, "coefficients": terms})


def _forbes(surface: Surface) -> None:
    """Forbes' aspheres. Type 0 is Qbfs, with orthonormal slopes. Type 1 is Qcon, with terms
    u^4 P_m^(0,4)(2 u^2 - 1), which become polynomials in u^2."""
    radius, found = surface.series(EXTRA + 1)
    found = [a * surface.unit for a in found]
    kind = surface.value(EXTRA)
    surface.require(kind in (0, 1), "neither Qbfs nor Qcon")
    if not any(found):
        return
    if kind == 0:
        surface.shape("qbfs", {m: a for m, a in enumerate(found) if a}, norm_radius=radius)
        return
    surface.require(not any(found[_QCON:]), f"of Qcon {_QCON} terms are exact enough as powers")
    total: dict[int, float] = {}
    for m, a in enumerate(found):
        for s in range(m + 1):
            part = math.comb(m + 4 + s, m) * math.comb(m, s) * (-1) ** (m - s)
            total[4 + 2 * s] = total.get(4 + 2 * s, 0.0) + a * part
    surface.shape("asphere", surface.spread(radius, {p: (a, p) for p, a in total.items()}))


def _zernike(surface: Surface, fringe: bool = False) -> None:
    """Conic, even powers of r and Zernike polynomials, Noll's or `fringe`, which are 1 at the rim.
    The powers are converted to Zernike terms:
    u^2k = sum_s (2 s + 1) k!^2 / ((k - s)! (k + s + 1)!) R_2s(u)."""
    radius, found = surface.series()
    terms = {k + 1: a * surface.unit for k, a in enumerate(found) if a}
    if fringe:
        surface.require(max(terms, default=0) <= 37, "fringe terms end with 37 here")
        nolls = {k: noll_of_fringe(k) for k in terms}
        terms = {nolls[k][0]: a / nolls[k][1] for k, a in terms.items()}
    if not terms:
        surface.shape("asphere", surface.powers(_EVEN))
        return
    what = f"Zernike terms that end at {radius:g} mm are not read; set PARM 0, extrapolate, to 1"
    surface.require(surface.value(0) or surface.semi <= radius * (1 + 1e-9), what)
    for k in _EIGHT:
        height = surface.value(k) * surface.unit * (radius / surface.unit) ** (2 * k)
        for s in range(k + 1 if height else 0):
            below = math.factorial(k - s) * math.factorial(k + s + 1)
            part = (2 * s + 1) * math.factorial(k) ** 2 / below
            j = s * (2 * s + 1) + 1
            terms[j] = terms.get(j, 0.0) + height * part / math.sqrt(2 * s + 1)
    surface.require(max(terms) <= 91, "Zernike terms end with 91 here")
    surface.shape("zernike", terms, norm_radius=radius)


def _irregular(surface: Surface) -> None:
    """A conic with Zs u^4 + Za v^2 + Zc u^2 v, where u and v are r and y over the semi-diameter;
    decentred, then tilted about x and y, by itself."""
    shift, tilt, bends = ([surface.value(k) for k in own] for own in ((1, 2), (3, 4), (5, 6, 7)))
    surface.require(not (any(bends[1:]) and surface.value(8)), "IRREGULA with an angle, PARM 8")
    surface.require(surface.semi or not any(bends), "IRREGULA without DIAM")
    if any(shift) or any(tilt):
        surface.put("decentre", [value * surface.unit for value in shift])
        surface.put("tilt", [*tilt, 0.0])
    if any(bends):
        one, two, three = (value * surface.unit for value in bends)
        terms = {"x4y0": (one, 4), "x2y2": (2 * one, 4), "x0y4": (one, 4), "x0y2": (two, 2)}
        terms |= {"x2y1": (three, 3), "x0y3": (three, 3)}
        surface.shape("polynomial_xy", surface.spread(surface.semi, terms))


def _grating(surface: Surface, lines: int = 1) -> None:
    """A grating with lines along x, given per um by parameter `lines`; the order, which is the next
    parameter, has the same sign as ours."""
    if surface.value(lines):
        per_mm = {"y": 1e3 * surface.value(lines)}
        _phase(surface, "linear", surface.value(lines + 1), per_mm)


def _toroidal_grating(surface: Surface) -> None:
    _grating(surface, 2)
    surface.shape("toroid", {}, curvature_x=surface.curvature(1))


def _biconic(surface: Surface) -> None:
    surface.shape("biconic", {}, curvature_x=surface.curvature(1), conic_x=surface.value(2))


def _tilted(surface: Surface) -> None:
    surface.shape("polynomial_xy", {"x1y0": surface.value(1), "x0y1": surface.value(2)})


# By type: the function that converts its parameters to entries, and the numbers of the parameters
# that it reads. Others must be 0; with None they are ignored.
TYPES: dict[str, tuple[Callable[[Surface], None], Collection[int] | None]] = {
    "STANDARD": (lambda surface: None, None),
    "EVENASPH": (lambda surface: surface.shape("asphere", surface.powers(_EVEN)), _EIGHT),
    "ODDASPHE": (lambda surface: surface.shape("odd_asphere", surface.powers(_ODD)), _EIGHT),
    "TOROIDAL": (_toroid, (*range(9), *_XDAT)),
    "BICONICX": (_biconic, (1, 2)),
    "TILTSURF": (_tilted, (1, 2)),
    "DGRATING": (_grating, (1, 2)),
    "TOROGRAT": (_toroidal_grating, (1, 2, 3)),
    "XASPHERE": (_extended_even, None),
    "XOSPHERE": (lambda surface: _extended(surface, "odd_asphere", _ODD_TERMS), _XDAT),
    "XPOLYNOM": (lambda surface: _extended(surface, "polynomial_xy", XY), _XDAT),
    "BINARY_2": (_binary, (*range(9), *_XDAT)),
    "QED_TYPE": (_forbes, _XDAT),
    "SZERNSAG": (_zernike, (*range(9), *_XDAT)),
    "FZERNSAG": (lambda surface: _zernike(surface, fringe=True), (*range(9), *_XDAT)),
    "IRREGULA": (_irregular, _EIGHT),
}
