"""Kinds of surfaces of `.seq` files: conversion of their coefficients to prescription entries."""

import dataclasses
from collections.abc import Callable

from ..lens.forms import noll_of_fringe
from .record import Record, Row, short
from .seq_apertures import Clips
from .seq_places import Place
from .seq_text import Command

LETTERS = dict(zip("ABCDEFGHJ", range(4, 22, 2), strict=True))  # powers of r; CODE V has no I
_ANAMORPHIC = {f"{letter}R": power for letter, power in zip("ABCD", (4, 6, 8, 10), strict=True)}
_LOPSIDED = tuple(f"{letter}P" for letter in "ABCD")
COEFFICIENTS = ("K", *LETTERS, "KX", "KY", *_ANAMORPHIC, *_LOPSIDED, "CUF")
KINDS = ("SPH", "CON", "ASP", "XTO", "YTO", "CYL", "AAS", "SPS")
DIFFRACTIVE = ("DIF", "HOR", "HWL", "HCT", "HCO", "GRO", "GRS", "GRX", "GRY", "GRZ")
_SPECIAL_TERMS, _LEAST = 99, 1e-6


@dataclasses.dataclass
class Surface:
    """A surface as its commands are read; numbers are in units of the file.

    curvature, curvature_x: 1/unit; curvature_x with its line, or None if it is not given. kind: one
    of `KINDS`. special: the type of SPS. terms: coefficients by key; keys of SPS are C1, C2, ....
    phase: values of `DIFFRACTIVE` by key. glass: (line, word).
    """

    row: Row
    curvature: float = 0.0
    curvature_x: tuple[int, float] | None = None
    thickness: float = 0.0
    glass: tuple[int, str] = (0, "")
    kind: str = "SPH"
    kind_line: int = 0
    special: str = ""
    terms: dict[str, tuple[int, float]] = dataclasses.field(default_factory=dict)
    phase: dict[str, tuple[int, float | str]] = dataclasses.field(default_factory=dict)
    place: Place = dataclasses.field(default_factory=Place)
    clips: Clips = dataclasses.field(default_factory=Clips)

    def term(self, key: str) -> float:
        """A coefficient; 0 if it is not given."""
        return self.terms.get(key, (0, 0.0))[1]

    def shape(self, record: Record, command: Command) -> None:
        """Read a command of `KINDS`."""
        self.kind, self.kind_line, self.special = command.key, command.line, ""
        if command.key != "SPS":
            return
        self.special = short(command.values[0]).upper() if command.values else ""
        if self.special not in _SPECIAL:
            known = ", ".join(_SPECIAL)
            raise record.error(
                command.line, f"{self.row.name}: SPS {self.special} is not read; known: {known}"
            )
        if len(command.values) > 1:
            self.terms["NRADIUS"] = command.line, record.bounded(command.line, command.values, 1)

    def entries(self, record: Record, unit: float) -> None:
        """Write form, curvature and coefficients as entries of a prescription."""
        row, kind = self.row, self.kind
        row.entry.setdefault("curvature", self.curvature / unit)
        allowed = {
            "CON": {"K"},
            "ASP": {"K", *LETTERS},
            **{key: {"K", *LETTERS} for key in ("XTO", "YTO", "CYL")},
            "AAS": {"KX", "KY", *_ANAMORPHIC, *_LOPSIDED},
            "SPS": self.terms.keys(),
        }.get(kind, set())
        for key, (line, value) in self.terms.items():
            if value and key not in allowed:
                raise record.error(line, f"{row.name}: {key} on a surface of kind {kind}")
        conic = self.term(
            {"AAS": "KY", "SPS": _SPECIAL.get(self.special, ("K",))[0]}.get(kind, "K")
        )
        if conic:
            row.put("conic", conic, self.kind_line)
        if self.curvature_x and kind not in ("XTO", "YTO", "CYL", "AAS"):
            line, across = self.curvature_x
            if across not in (0.0, self.curvature):
                raise record.error(line, f"{row.name}: a curvature in x on kind {kind}")
        if kind in ("CON", "ASP"):
            self._powers(unit)
        elif kind in ("XTO", "YTO", "CYL"):
            self._toroid(record, unit)
        elif kind == "AAS":
            self._anamorphic(record, unit)
        elif kind == "SPS":
            _SPECIAL[self.special][1](self, record, unit)

    def _powers(self, unit: float) -> None:
        found = {p: self.term(key) * unit ** (1 - p) for key, p in LETTERS.items()}
        found = {p: a for p, a in found.items() if a}
        if found:
            self.row.put("coefficients", found, self.kind_line)

    def _toroid(self, record: Record, unit: float) -> None:
        """A curve in y rotated about an axis along y; XTO: in x, ours turned by 90 degrees."""
        row, line = self.row, self.kind_line
        across, along = (self.curvature_x or (0, 0.0))[1] / unit, self.curvature / unit
        turned = self.kind == "XTO" or (self.kind == "CYL" and across != 0)
        if self.kind == "CYL" and across and along:
            raise record.error(line, f"{row.name}: a cylinder that is curved both ways")
        row.put("form", "toroid", line)
        row.put("curvature", across if turned else along, line)
        row.put("curvature_x", along if turned else across, line)
        if turned:
            row.put("tilt", [0.0, 0.0, 90.0], line)
        self._powers(unit)

    def _anamorphic(self, record: Record, unit: float) -> None:
        row, line = self.row, self.kind_line
        for key in _LOPSIDED:
            if self.term(key):
                raise record.error(self.terms[key][0], f"{row.name}: {key}, a lopsided asphere")
        row.put("form", "biconic", line)
        given = self.curvature_x[1] if self.curvature_x else self.curvature
        row.put("curvature_x", given / unit, line)
        row.put("conic_x", self.term("KX"), line)
        found = {p: self.term(key) * unit ** (1 - p) for key, p in _ANAMORPHIC.items()}
        row.put("coefficients", {p: a for p, a in found.items() if a}, line)

    def _special(self, record: Record, first: int, count: int, *others: str) -> dict[int, float]:
        """The nonzero ones of `count` coefficients from number `first` on, keyed from 0."""
        found = {}
        for key, (line, value) in self.terms.items():
            number = int(key[1:]) - first if key[1:].isdecimal() and key[0] == "C" else -1
            if 0 <= number < count:
                found[number] = value
            elif value and key not in ("NRADIUS", *others):
                raise record.error(line, f"{self.row.name}: SCO {key} of SPS {self.special}")
        return {k: value for k, value in found.items() if value}

    def radius(self, record: Record, default: float = 0.0) -> float:
        """The norm radius of the coefficients, in units of the file."""
        value = self.term("NRADIUS") or default
        if not _LEAST <= value <= 1 / _LEAST:
            raise record.error(
                self.kind_line, f"{self.row.name}: SPS {self.special} of NRADIUS {value:g}"
            )
        return value

    def diffraction(self, record: Record, unit: float) -> None:
        """Write gratings and radial phases as entries of a prescription."""
        if not self.phase:
            return
        line, kind = self.phase.get("DIF", (next(iter(self.phase.values()))[0], ""))
        value = {key: own for key, (_, own) in self.phase.items()}
        if kind == "GRT":
            if value.get("GRX") or value.get("GRZ"):
                raise record.error(line, f"{self.row.name}: a grating whose lines are not along x")
            spacing, order = value.get("GRS", 0.0), value.get("GRO", 1.0)
            if not spacing:
                raise record.error(line, f"{self.row.name}: a grating without a spacing, GRS")
            terms: dict[object, float] = {"y": 1 / (float(spacing) * unit)}
            form = "linear"
        elif kind == "DOE" and value.get("HCT") == "R":
            wave = float(value.get("HWL", 0.0)) * 1e-6  # mm
            if wave <= 0:
                raise record.error(line, f"{self.row.name}: a phase without a wavelength, HWL")
            order, form = value.get("HOR", 1.0), "asphere"
            found = {2 * int(k[1:]): v for k, v in value.items() if k[0] == "C"}
            terms = {p: float(v) * unit ** (1 - p) / wave for p, v in found.items() if v}
        else:
            what = f"DIF {kind} with HCT {value.get('HCT', '')}".removesuffix(" with HCT ")
            raise record.error(line, f"{self.row.name}: {short(what)}; known: GRT, DOE with HCT R")
        if terms and order:
            phase = {"form": form, "order": order, "coefficients": terms}
            self.row.put("phase", phase, line)


def _odd(surface: Surface, record: Record, unit: float) -> None:
    found = surface._special(record, 2, 30, "C1", "C33")
    surface.terms.setdefault("NRADIUS", surface.terms.get("C33", (0, 0.0)))
    radius = surface.radius(record, 1.0)
    terms = {k + 1: v / radius ** (k + 1) * unit**-k for k, v in found.items()}
    surface.row.put("form", "odd_asphere", surface.kind_line)
    surface.row.put("coefficients", terms, surface.kind_line)


def _polynomial(surface: Surface, record: Record, unit: float) -> None:
    found, radius = surface._special(record, 2, 65, "C1"), surface.radius(record, 1.0)
    pairs = [(n - j, j) for n in range(1, 11) for j in range(n + 1)]
    terms = {}
    for k, value in found.items():
        i, j = pairs[k]
        terms[f"x{i}y{j}"] = value / radius ** (i + j) * unit ** (1 - i - j)
    surface.row.put("form", "polynomial_xy", surface.kind_line)
    surface.row.put("coefficients", terms, surface.kind_line)


def _forbes(surface: Surface, record: Record, unit: float) -> None:
    surface.terms.setdefault("NRADIUS", surface.terms.get("C1", (0, 0.0)))
    found = surface._special(record, 3, 14, "C1", "C17")
    surface.row.put("form", "qbfs", surface.kind_line)
    surface.row.put("norm_radius", surface.radius(record) * unit, surface.kind_line)
    surface.row.put("coefficients", {k: v * unit for k, v in found.items()}, surface.kind_line)


def _fringe(surface: Surface, record: Record, unit: float) -> None:
    """Convert fringe polynomials, which are 1 at the rim, to ours, whose mean square is 1."""
    surface.terms.setdefault("NRADIUS", surface.terms.get("C3", (0, 0.0)))
    found, terms = surface._special(record, 4, 37, "C1", "C3"), dict[int, float]()
    for k, value in found.items():
        number, rim = noll_of_fringe(k + 1)
        terms[number] = value * unit / rim
    surface.row.put("form", "zernike", surface.kind_line)
    surface.row.put("norm_radius", surface.radius(record) * unit, surface.kind_line)
    surface.row.put("coefficients", terms, surface.kind_line)


_SPECIAL: dict[str, tuple[str, Callable[[Surface, Record, float], None]]] = {
    "ODD": ("C1", _odd),  # the key of the conic, the reader of the others
    "XYP": ("C1", _polynomial),
    "QBF": ("C17", _forbes),
    "ZFR": ("C1", _fringe),
}


def special_key(surface: Surface, record: Record, command: Command) -> str:
    """The key of a coefficient of SCO, as C5 or NRADIUS; the names K and AR5 are converted."""
    number = command.of("C")
    name = f"C{number[0]}" if number else (command.values.pop(0).upper() if command.values else "")
    if name == "K" and surface.special in _SPECIAL:
        name = _SPECIAL[surface.special][0]
    if name[:2] == "AR" and name[2:].isdecimal() and surface.special == "ODD" and len(name) < 5:
        name = f"C{int(name[2:]) + 1}"
    known = name == "NRADIUS" or (name[1:].isdecimal() and name[0] == "C" and len(name) < 4)
    if not known or name == "C0":
        raise record.error(command.line, f"SCO {short(name)}: expected C1 to C{_SPECIAL_TERMS}")
    return name
