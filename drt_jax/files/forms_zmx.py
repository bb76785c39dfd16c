"""The types of surfaces of `.zmx` files: their parameters as entries of a prescription."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .record import Breaking, Record, Row, turned_back


class Surface(NamedTuple):
    """A surface of a file before its type is looked at. unit: mm of its unit of length.

    parameters: (line, value) by number, as they stand there.
    """

    record: Record
    row: Row
    unit: float
    parameters: dict[int, tuple[int, float]]

    def value(self, number: int) -> float:
        """A parameter; 0 if it is not given."""
        return self.parameters.get(number, (0, 0.0))[1]

    def put(self, key: str, value: object) -> None:
        """An entry, on the line of the surface."""
        self.row.put(key, value, self.row.line)

    def only(self, *known: int) -> None:
        """Refuse other parameters that are not 0."""
        for number, (line, value) in self.parameters.items():
            if value and number not in known:
                self.record.lacks(line, f"parameter {number} of {self.row.name}")

    def powers(self, numbers: dict[int, int]) -> None:
        """Coefficients by power of length, from parameters."""
        found = {p: self.value(k) * self.unit ** (1 - p) for k, p in numbers.items()}
        found = {p: a for p, a in found.items() if a}
        if found:
            self.put("coefficients", found)

    def curvature(self, number: int) -> float:
        """1 / a radius, 0 for none, in 1/mm."""
        radius = self.value(number) * self.unit
        return 1 / radius if abs(radius) > 1e-12 else 0.0


def _standard(surface: Surface) -> None:
    pass


def _even(surface: Surface) -> None:
    surface.only(*range(1, 9))
    surface.powers({k: 2 * k for k in range(1, 9)})


def _odd(surface: Surface) -> None:
    surface.only(*range(1, 9))
    surface.put("form", "odd_asphere")
    surface.powers({k: k for k in range(1, 9)})


def _toroid(surface: Surface) -> None:
    surface.only(*range(1, 9))
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


def _grating(surface: Surface, lines: int = 1, order: int = 2) -> None:
    """Lines a um along x; the order turns light as ours of the same sign."""
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
    "STANDARD": _standard,
    "EVENASPH": _even,
    "ODDASPHE": _odd,
    "TOROIDAL": _toroid,
    "BICONICX": _biconic,
    "TILTSURF": _tilted,
    "DGRATING": _grating,
    "TOROGRAT": _toroidal_grating,
}


def breaking(surface: Surface, thickness: float) -> Breaking:
    """A coordinate break: decentre, then tilt about x, y, z; with the order flag tilt about z, y,
    x, then decentre along the new axes."""
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
    """Apertures and obscurations, each a line, a keyword and two lengths in mm, about a centre;
    DIAM alone clips nothing, nor does what lies beyond the end of a surface."""
    for line, kind, (one, two) in found:
        shape: dict[str, object] = {"centre": centre} if any(centre) else {}
        if kind in ("SQAP", "ELAP", "ELOB"):
            shape["rectangle" if kind == "SQAP" else "ellipse"] = [one, two]
            key = "obscuration" if kind == "ELOB" else "aperture"
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
