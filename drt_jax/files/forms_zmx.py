"""Surface types of `.zmx` files: conversion of their parameters to prescription entries."""

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from ..lens.forms import noll_of_fringe, powers_xy
from .record import Breaking, Row, turned_back

EXTRA = 13  # the parameter number of XDAT 1
_XDAT = range(EXTRA, 400)
_EIGHT = range(1, 9)
_XY = [(f"x{i}y{j}", i + j) for i, j in powers_xy(300)]  # name and degree of each term
_QCON = 11  # most Qcon terms: as powers, the last one loses 8 of 16 digits
# The line and the value of each parameter by its number.
Parameters = dict[int, tuple[int, float]]


@dataclasses.dataclass
class Surface(Row):
    """A surface as its lines are read.

    makers: the catalogues of the header. parameters: as in the file; XDAT begins at number 13.
    kind: its type. gap, semi: DISZ and DIAM, mm. infinite, floating, user_line: lines of an
    infinite DISZ, of FLAP and of a user aperture; 0 without. apertures: line, keyword and two
    lengths (mm) of each, about `centre`. moves: the parameters of a coordinate break in front of
    the surface (1) and behind it (2). user, corners: the keyword of a user aperture and its corners
    [x, y], mm.
    """

    makers: list[str] = dataclasses.field(default_factory=list)
    kind: str = "STANDARD"
    kind_line: int = 0
    parameters: Parameters = dataclasses.field(default_factory=dict)
    gap: float | None = None
    infinite: int = 0
    semi: float = 0.0
    floating: int = 0
    apertures: list[tuple[int, str, list[float]]] = dataclasses.field(default_factory=list)
    centre: list[float] = dataclasses.field(default_factory=list)
    moves: dict[int, Parameters] = dataclasses.field(default_factory=dict)
    user: str = ""
    user_line: int = 0
    corners: list[list[float]] = dataclasses.field(default_factory=list)

    def value(self, number: int) -> float:
        """A parameter; 0 if it is not given."""
        return self.parameters.get(number, (0, 0.0))[1]

    def only(self, known: Collection[int] | None) -> None:
        """Refuse nonzero parameters whose number is not in `known`; None refuses none."""
        for number, (line, value) in self.parameters.items():
            if known is not None and value and number not in known:
                extra = f" (XDAT {number - EXTRA + 1})" if number >= EXTRA else ""
                what = f"parameter {number}{extra} of {self.name} is not read"
                raise self.record.error(line, what)

    def powers(self, powers: Mapping[int, int]) -> dict[int, float]:
        """Coefficients in mm. powers: of the height by number of the parameter."""
        return self.powers_in_mm({p: self.value(k) for k, p in powers.items()})

    def odd_powers(self) -> dict[int, float]:
        """Parameters 1 to 8 as coefficients of r to r^8."""
        return self.powers({k: k for k in _EIGHT})

    def even_powers(self) -> dict[int, float]:
        """Parameters 1 to 8 as coefficients of r^2 to r^16."""
        return self.powers({k: 2 * k for k in _EIGHT})

    def series(self, first: int = EXTRA) -> tuple[float, list[float]]:
        """The norm radius (mm) of a series, and its values as in the file. From parameter `first`
        on, the file holds the number of values, the radius and the values; others are ignored."""
        count, radius = self.value(first), self.value(first + 1) * self.unit
        line = self.parameters.get(first, (self.line, 0))[0]
        known = count % 1 == 0 and 0 <= count <= 300
        self.require(known, f"{count:g} terms; give 0 to 300", line)
        found = [self.value(first + 2 + k) for k in range(int(count))]
        known = 1e-6 <= radius <= 1e6 or not any(found)
        self.require(known, f"a norm radius of {radius:g} mm", line)
        return radius, found

    def spread(self, radius: float, found: dict[Any, tuple[float, int]]) -> dict[Any, float]:
        """Coefficients by key: each value of `found` over the given power of the radius."""
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
    surface.shape("toroid", terms, more={"curvature_x": surface.curvature(1)})


def _extended(surface: Surface, form: str, keys: Callable[[int], tuple[Any, int]]) -> None:
    """A conic plus a series over a norm radius; `keys(k)` gives the key and power of term k."""
    radius, found = surface.series()
    terms = {keys(k)[0]: (a * surface.unit, keys(k)[1]) for k, a in enumerate(found)}
    surface.shape(form, surface.spread(radius, terms))


def _extended_even(surface: Surface) -> None:
    """An extended asphere. Some programs write an even asphere under this name, with its
    coefficients in PARM 1 to 8 and no XDAT."""
    if not surface.value(EXTRA) and any(map(surface.value, _EIGHT)):
        what = "XASPHERE with PARM and no XDAT is an even asphere"
        surface.record.notes.append(f"{surface.name}: {what}")
        surface.only(_EIGHT)
        surface.shape("asphere", surface.even_powers())
        return
    surface.only(_XDAT)
    _extended(surface, "asphere", lambda k: (2 * k + 2, 2 * k + 2))


def _binary(surface: Surface) -> None:
    """An even asphere with the phase order (a_1 u^2 + a_2 u^4 + ...) in radians."""
    surface.shape("asphere", surface.even_powers())
    radius, found = surface.series()
    terms = {2 * k + 2: (a / (2 * math.pi), 2 * k + 2) for k, a in enumerate(found)}
    phase = surface.spread(radius, terms)
    surface.require(not phase or 0 in surface.parameters, "PARM 0, the order")
    if phase and surface.value(0):
        surface.put("phase", {"form": "asphere", "order": surface.value(0), "coefficients": phase})


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
        terms = {m: a for m, a in enumerate(found) if a}
        surface.shape("qbfs", terms, more={"norm_radius": radius})
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
        surface.shape("asphere", surface.even_powers())
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
    surface.shape("zernike", terms, more={"norm_radius": radius})


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


def _grating(surface: Surface, lines: int = 1, order: int = 2) -> None:
    """A grating with lines along x, given per um; the order has the same sign as ours."""
    if surface.value(lines) and surface.value(order):
        per_mm = {"y": 1e3 * surface.value(lines)}
        phase = {"form": "linear", "order": surface.value(order), "coefficients": per_mm}
        surface.put("phase", phase)


def _toroidal_grating(surface: Surface) -> None:
    _grating(surface, 2, 3)
    surface.shape("toroid", {}, more={"curvature_x": surface.curvature(1)})


def _biconic(surface: Surface) -> None:
    own = {"curvature_x": surface.curvature(1), "conic_x": surface.value(2)}
    surface.shape("biconic", {}, more=own)


def _tilted(surface: Surface) -> None:
    surface.shape("polynomial_xy", {"x1y0": surface.value(1), "x0y1": surface.value(2)})


# By type: what makes entries of its parameters, and the numbers of these; None: all are ignored.
TYPES: dict[str, tuple[Callable[[Surface], None], Collection[int] | None]] = {
    "STANDARD": (lambda surface: None, None),
    "EVENASPH": (lambda surface: surface.shape("asphere", surface.even_powers()), _EIGHT),
    "ODDASPHE": (lambda surface: surface.shape("odd_asphere", surface.odd_powers()), _EIGHT),
    "TOROIDAL": (_toroid, (*range(9), *_XDAT)),
    "BICONICX": (_biconic, (1, 2)),
    "TILTSURF": (_tilted, (1, 2)),
    "DGRATING": (_grating, (1, 2)),
    "TOROGRAT": (_toroidal_grating, (1, 2, 3)),
    "XASPHERE": (_extended_even, None),
    "XOSPHERE": (
        lambda surface: _extended(surface, "odd_asphere", lambda k: (k + 1, k + 1)),
        _XDAT,
    ),
    "XPOLYNOM": (lambda surface: _extended(surface, "polynomial_xy", _XY.__getitem__), _XDAT),
    "BINARY_2": (_binary, (*range(9), *_XDAT)),
    "QED_TYPE": (_forbes, _XDAT),
    "SZERNSAG": (_zernike, (*range(9), *_XDAT)),
    "FZERNSAG": (lambda surface: _zernike(surface, fringe=True), (*range(9), *_XDAT)),
    "IRREGULA": (_irregular, _EIGHT),
}


def breaking(surface: Surface, parameters: Parameters, thickness: float) -> Breaking:
    """A coordinate break: a decentre, then tilts about x, y, z. With the order flag: tilts about z,
    y, x, then a decentre along the new axes."""
    own = dataclasses.replace(surface, parameters=parameters)
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
