"""Surface types of `.zmx` files: conversion of their parameters to prescription entries."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..lens.forms import noll_of_fringe, powers_xy
from .record import Breaking, Record, Row, turned_back

EXTRA = 13  # the parameter number of XDAT 1
_QCON = 11  # most Qcon terms: as powers, the last one loses 8 of 16 digits


class Surface(NamedTuple):
    """A surface of a file before its type is interpreted. unit: the file's unit of length, mm.

    parameters: (line, value) by number, values as in the file; XDAT begins at number 13.
    semi: the value of DIAM, mm.
    """

    record: Record
    row: Row
    unit: float
    parameters: dict[int, tuple[int, float]]
    semi: float = 0.0

    def value(self, number: int) -> float:
        """A parameter; 0 if it is not given."""
        return self.parameters.get(number, (0, 0.0))[1]

    def put(self, key: str, value: object) -> None:
        """Set an entry; its line is that of the surface."""
        self.row.put(key, value, self.row.line)

    def only(self, *known: int) -> None:
        """Refuse nonzero parameters whose number is not in `known`."""
        for number, (line, value) in self.parameters.items():
            if value and number not in known:
                extra = f" (XDAT {number - EXTRA + 1})" if number >= EXTRA else ""
                what = f"parameter {number}{extra} of {self.row.name} is not read"
                raise self.record.error(line, what)

    def powers(self, numbers: dict[int, int]) -> None:
        """Set the coefficients. numbers: the power of the height by number of the parameter."""
        found = {p: self.value(k) * self.unit ** (1 - p) for k, p in numbers.items()}
        found = {p: a for p, a in found.items() if a}
        if found:
            self.put("coefficients", found)

    def series(self, first: int = EXTRA) -> tuple[float, list[float]]:
        """The norm radius (mm) of a series, and its values as in the file. From parameter `first`
        on, the file holds the number of values, the radius and the values; others are ignored."""
        count, radius = self.value(first), self.value(first + 1) * self.unit
        line = self.parameters.get(first, (self.row.line, 0))[0]
        if count % 1 or not 0 <= count <= 300:
            raise self.record.error(line, f"{self.row.name}: {count:g} terms; give 0 to 300")
        found = [self.value(first + 2 + k) for k in range(int(count))]
        if any(found) and not 1e-6 <= radius <= 1e6:
            raise self.record.error(line, f"{self.row.name}: a norm radius of {radius:g} mm")
        return radius, found

    def spread(self, radius: float, found: dict[Any, tuple[float, int]]) -> dict[Any, float]:
        """Coefficients by key: each value of `found` over the given power of the radius."""
        with np.errstate(all="ignore"):
            terms = {k: float(v / np.float64(radius) ** p) for k, (v, p) in found.items() if v}
        for key, value in terms.items():
            if not (value and math.isfinite(value)):
                raise self.record.error(self.row.line, f"{self.row.name}: term {key} overflows")
        return terms

    def curvature(self, number: int) -> float:
        """The curvature (1/mm) of a parameter that holds a radius; 0 if that is 0."""
        radius = self.value(number) * self.unit
        return 1 / radius if abs(radius) > 1e-12 else 0.0


def _even(surface: Surface) -> None:
    surface.only(*range(1, 9))
    surface.powers({k: 2 * k for k in range(1, 9)})


def _odd(surface: Surface) -> None:
    surface.only(*range(1, 9))
    surface.put("form", "odd_asphere")
    surface.powers({k: k for k in range(1, 9)})


def _toroid(surface: Surface) -> None:
    # XDAT holds the number of Zernike terms, their radius and the terms, which must be 0.
    none = range(EXTRA, 400) if not surface.value(EXTRA) else (EXTRA, EXTRA + 1)
    surface.only(*range(9), *none)
    surface.put("form", "toroid")
    surface.put("curvature_x", surface.curvature(1))
    surface.powers({k: 2 * (k - 1) for k in range(2, 9)})


def _biconic(surface: Surface) -> None:
    surface.only(1, 2)
    surface.put("form", "biconic")
    surface.put("curvature_x", surface.curvature(1))
    surface.put("conic_x", surface.value(2))


def _tilted(surface: Surface) -> None:
    surface.only(1, 2)
    surface.put("form", "polynomial_xy")
    surface.put("coefficients", {"x1y0": surface.value(1), "x0y1": surface.value(2)})


def _extended(surface: Surface, form: str, keys: Callable[[int], tuple[Any, int]]) -> None:
    """A conic plus a series over a norm radius; `keys(k)` gives the key and power of term k."""
    surface.only(*range(EXTRA, 400))
    radius, found = surface.series()
    terms = {keys(k)[0]: (a * surface.unit, keys(k)[1]) for k, a in enumerate(found)}
    surface.put("form", form)
    surface.put("coefficients", surface.spread(radius, terms))


def _extended_xy(k: int) -> tuple[str, int]:
    i, j = powers_xy(k + 1)[k]
    return f"x{i}y{j}", i + j


def _extended_even(surface: Surface) -> None:
    """An extended asphere. Some programs write an even asphere under this name, with its
    coefficients in PARM 1 to 8 and no XDAT."""
    if not surface.value(EXTRA) and any(surface.value(k) for k in range(1, 9)):
        name = surface.row.name
        surface.record.notes.append(f"{name}: XASPHERE with PARM and no XDAT is an even asphere")
        return _even(surface)
    _extended(surface, "asphere", lambda k: (2 * k + 2, 2 * k + 2))


def _binary(surface: Surface) -> None:
    """An even asphere with the phase order (a_1 u^2 + a_2 u^4 + ...) in radians."""
    surface.only(*range(9), *range(EXTRA, 400))
    surface.powers({k: 2 * k for k in range(1, 9)})
    radius, found = surface.series()
    terms = {2 * k + 2: (a / (2 * math.pi), 2 * k + 2) for k, a in enumerate(found)}
    phase = surface.spread(radius, terms)
    if phase and 0 not in surface.parameters:
        raise surface.record.error(surface.row.line, f"{surface.row.name}: PARM 0, the order")
    if phase and surface.value(0):
        surface.put("phase", {"form": "asphere", "order": surface.value(0), "coefficients": phase})


def _forbes(surface: Surface) -> None:
    """Forbes' aspheres. Type 0 is Qbfs, with orthonormal slopes. Type 1 is Qcon, with terms
    u^4 P_m^(0,4)(2 u^2 - 1), which become polynomials in u^2."""
    surface.only(*range(EXTRA, 400))
    radius, found = surface.series(EXTRA + 1)
    found = [a * surface.unit for a in found]
    if surface.value(EXTRA) not in (0, 1):
        raise surface.record.error(surface.row.line, f"{surface.row.name}: neither Qbfs nor Qcon")
    if not any(found):
        return
    if surface.value(EXTRA) == 0:
        surface.put("form", "qbfs")
        surface.put("norm_radius", radius)
        surface.put("coefficients", {m: a for m, a in enumerate(found) if a})
        return
    if any(found[_QCON:]):
        what = f"{surface.row.name}: of Qcon {_QCON} terms are exact enough as powers"
        raise surface.record.error(surface.row.line, what)
    total: dict[int, float] = {}
    for m, a in enumerate(found):
        for s in range(m + 1):
            part = math.comb(m + 4 + s, m) * math.comb(m, s) * (-1) ** (m - s)
            total[4 + 2 * s] = total.get(4 + 2 * s, 0.0) + a * part
    surface.put("coefficients", surface.spread(radius, {p: (a, p) for p, a in total.items()}))


def _zernike(surface: Surface, fringe: bool = False) -> None:
    """Conic, even powers of r and Zernike polynomials, Noll's or `fringe`, which are 1 at the rim.
    The powers are converted to Zernike terms:
    u^2k = sum_s (2 s + 1) k!^2 / ((k - s)! (k + s + 1)!) R_2s(u)."""
    surface.only(0, *range(1, 9), *range(EXTRA, 400))
    radius, found = surface.series()
    terms = {k + 1: a * surface.unit for k, a in enumerate(found) if a}
    if fringe and max(terms, default=0) > 37:
        what = f"{surface.row.name}: fringe terms end with 37 here"
        raise surface.record.error(surface.row.line, what)
    if fringe:
        nolls = {k: noll_of_fringe(k) for k in terms}
        terms = {nolls[k][0]: a / nolls[k][1] for k, a in terms.items()}
    if not terms:
        surface.powers({k: 2 * k for k in range(1, 9)})
        return
    if not surface.value(0) and surface.semi > radius * (1 + 1e-9):
        line = surface.row.line
        what = f"{surface.row.name}: Zernike terms that end at {radius:g} mm are not read"
        raise surface.record.error(line, f"{what}; set PARM 0, extrapolate, to 1")
    for k in range(1, 9):
        height = surface.value(k) * surface.unit * (radius / surface.unit) ** (2 * k)
        for s in range(k + 1 if height else 0):
            below = math.factorial(k - s) * math.factorial(k + s + 1)
            part = (2 * s + 1) * math.factorial(k) ** 2 / below
            j = s * (2 * s + 1) + 1
            terms[j] = terms.get(j, 0.0) + height * part / math.sqrt(2 * s + 1)
    if max(terms) > 91:
        line = surface.row.line
        raise surface.record.error(line, f"{surface.row.name}: Zernike terms end with 91 here")
    surface.put("form", "zernike")
    surface.put("norm_radius", radius)
    surface.put("coefficients", terms)


def _irregular(surface: Surface) -> None:
    """A conic with Zs u^4 + Za v^2 + Zc u^2 v, where u and v are r and y over the semi-diameter;
    decentred, then tilted about x and y, by itself."""
    surface.only(*range(1, 9))
    shift, tilt, bends = ([surface.value(k) for k in own] for own in ((1, 2), (3, 4), (5, 6, 7)))
    row = surface.row
    if any(bends[1:]) and surface.value(8):
        raise surface.record.error(row.line, f"{row.name}: IRREGULA with an angle, PARM 8")
    if any(bends) and not surface.semi:
        raise surface.record.error(row.line, f"{row.name}: IRREGULA without DIAM")
    if any(shift) or any(tilt):
        surface.put("decentre", [value * surface.unit for value in shift])
        surface.put("tilt", [*tilt, 0.0])
    if any(bends):
        one, two, three = (value * surface.unit for value in bends)
        terms = {"x4y0": (one, 4), "x2y2": (2 * one, 4), "x0y4": (one, 4), "x0y2": (two, 2)}
        surface.put("form", "polynomial_xy")
        all_terms = terms | {"x2y1": (three, 3), "x0y3": (three, 3)}
        surface.put("coefficients", surface.spread(surface.semi, all_terms))


def _grating(surface: Surface, lines: int = 1, order: int = 2) -> None:
    """A grating with lines along x, given per um; the order has the same sign as ours."""
    surface.only(*range(1, order + 1))
    if surface.value(lines) and surface.value(order):
        per_mm = {"y": 1e3 * surface.value(lines)}
        phase = {"form": "linear", "order": surface.value(order), "coefficients": per_mm}
        surface.put("phase", phase)


def _toroidal_grating(surface: Surface) -> None:
    _grating(surface, 2, 3)
    surface.put("form", "toroid")
    surface.put("curvature_x", surface.curvature(1))


TYPES: dict[str, Callable[[Surface], None]] = {
    "STANDARD": lambda surface: None,
    "EVENASPH": _even,
    "ODDASPHE": _odd,
    "TOROIDAL": _toroid,
    "BICONICX": _biconic,
    "TILTSURF": _tilted,
    "DGRATING": _grating,
    "TOROGRAT": _toroidal_grating,
    "XASPHERE": _extended_even,
    "XOSPHERE": lambda surface: _extended(surface, "odd_asphere", lambda k: (k + 1, k + 1)),
    "XPOLYNOM": lambda surface: _extended(surface, "polynomial_xy", _extended_xy),
    "BINARY_2": _binary,
    "QED_TYPE": _forbes,
    "SZERNSAG": _zernike,
    "FZERNSAG": lambda surface: _zernike(surface, fringe=True),
    "IRREGULA": _irregular,
}


def breaking(surface: Surface, thickness: float) -> Breaking:
    """A coordinate break: a decentre, then tilts about x, y, z. With the order flag: tilts about z,
    y, x, then a decentre along the new axes."""
    surface.only(*range(1, 7))
    shift = tuple(surface.value(k) * surface.unit for k in (1, 2))
    tilt: Any = tuple(surface.value(k) for k in (3, 4, 5))
    moved: Any = (*shift, 0.0)
    if surface.value(6) and any(tilt):
        turn, tilt = turned_back(tilt)
        moved = tuple((turn @ np.array(moved)).tolist()) if any(shift) else moved
    if not all(map(math.isfinite, (*moved, *tilt))):
        raise surface.record.error(surface.row.line, "a coordinate break that is not finite")
    return Breaking(surface.row.line, moved, tilt, thickness)


def clipping(
    record: Record, row: Row, found: list[tuple[int, str, list[float]]], centre: list[float]
) -> None:
    """Set apertures and obscurations about a centre. found: line, keyword and two lengths (mm) of
    each. DIAM alone clips nothing, nor does an aperture beyond the end of the surface."""
    for line, kind, (one, two) in found:
        shape: dict[str, object] = {"centre": centre} if any(centre) else {}
        if kind in ("SQAP", "SQOB", "ELAP", "ELOB"):
            shape["rectangle" if kind[:2] == "SQ" else "ellipse"] = [one, two]
            key = "obscuration" if kind[2:] == "OB" else "aperture"
            row.put(key, [*row.entry.get(key, []), shape], line)
            continue
        if kind == "OBSC" and one > 0:
            record.lacks(line, f"{row.name}: an obscuration that is a ring")
            continue
        inner = two if kind == "OBSC" else one
        if inner > 0:
            blocked = [*row.entry.get("obscuration", []), shape | {"circle": inner}]
            row.put("obscuration", blocked, line)
        rim = row.entry.get("conic", 0.0) + 1, row.entry["curvature"]
        ends = row.entry.get("form") is None and rim[0] * (rim[1] * two) ** 2 >= 1
        if kind == "CLAP" and two > 0 and not (ends and not any(centre)):
            if not any(centre) and not row.entry.get("stop") and "semi_diameter" not in row.entry:
                row.put("semi_diameter", two, line)
                continue
            wide = [*row.entry.get("aperture", []), shape | {"circle": two}]
            row.put("aperture", wide, line)
