"""Compare a lens with what is read back from the text that stands for it."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ..lens.lens import Lens
from .apertures import shapes_of
from .system import System

_KINDS = ("circle", "ellipse", "rectangle", "polygon")
_CLOSE = 1e-9  # relative, and in mm; rounding of float32 is larger


def difference(one: Lens, two: Lens, waves: list[float], indices: float = 0.0) -> str:
    """The first difference of a lens `two`, read back, from `one`, beyond rounding, as text; empty
    if there is none. Places count from the first surface: a file need not tell where that stands.

    waves: wavelengths where indices are compared, um. indices: how far they may differ.
    """
    for name in ("count", "stop", "mirrors", "forms", "afocal"):
        a, b = getattr(one, name), getattr(two, name)
        if name == "forms":  # an even asphere may be written as an odd one
            a, b = ([form.removeprefix("odd_") for form in own] for own in (a, b))
        if a != b:
            return f"{name} {a}, read back {b}"
    close = max(_CLOSE, 256 * float(np.finfo(np.asarray(one.curvature).dtype).eps))
    return _first(_numbers(one, two, waves, indices, close), close)


def use_difference(system: System, used: Mapping[str, Any]) -> str:
    """The same of the use of a lens. used: fields of `System` that were read back."""
    for name in ("field_kind", "primary"):
        a, b = getattr(system, name), used.get(name, getattr(system, name))
        if a != b:
            return f"{name} {a}, read back {b}"
    pairs = ((name, getattr(system, name), b) for name, b in used.items() if name != "field_kind")
    return _first(((name, _used(name, a), _used(name, b), _CLOSE) for name, a, b in pairs), _CLOSE)


def _used(name: str, values: Any) -> np.ndarray:
    """A field of `System` as an array; a pupil that is not vignetted is not turned."""
    found = np.array(values, float)
    if name == "vignetting":
        found[:, 4] *= np.any(found[:, :4], axis=1)
    return found


def _first(pairs: Iterator[Any], close: float) -> str:
    """The first difference of pairs of arrays, see `_numbers`."""
    for name, a, b, least in pairs:
        if a.shape != b.shape:
            return f"{name}: {len(a)} of them, read back {len(b)}"
        with np.errstate(invalid="ignore"):  # inf - inf
            room = np.maximum(least, close * np.minimum(np.abs(a), np.abs(b)))
            off = (a != b) & ~(np.abs(a - b) <= room)
        if np.any(off):
            at = tuple(np.argwhere(off)[0])
            place = f"[{', '.join(map(str, at))}]" if at else ""
            return f"{name}{place} {a[at]:.10g}, read back {b[at]:.10g}"
    return ""


def _numbers(
    one: Lens, two: Lens, waves: list[float], indices: float, close: float
) -> Iterator[Any]:
    """Arrays of both lenses with their name and the absolute tolerance. close: of a length of 1."""
    both = one, two
    size = close * max(1.0, abs(float(one.sensor)))
    # Elements that move along the axis become thicknesses in files of other programs.
    spaced = one.elements is None and two.elements is None
    for name in ("curvature", "conic", *(("thickness", "sensor") if spaced else ())):
        parts = [np.asarray(getattr(own, name), float) for own in both]
        yield name, *parts, size if name in ("thickness", "sensor") else 0.0
    yield "coefficients", *_padded(*map(_coefficients, both)), 0.0
    yield "stop's semi_diameter", *(_at(own.semi_diameter, own.stop) for own in both), 0.0
    yield "apertures", *map(_apertures, both), size
    yield "index", *(np.asarray(own.index(waves), float) for own in both), max(_CLOSE, indices)
    rows = ["decentre", "vertex", "rotation"]
    for name, *parts in zip(rows, *map(_places, both), strict=True):
        yield name, *parts, size if name != "rotation" else max(1e-8, close)
    phases = [own.phase for own in both]
    if any(phase is not None for phase in phases):
        yield "phase", *_padded(*map(_phase, phases)), 0.0


def _at(values: Any, row: int) -> np.ndarray:
    return np.asarray(values, float)[row]


def _padded(one: np.ndarray, two: np.ndarray) -> list[np.ndarray]:
    """Rows of coefficients filled up to one length by zeros."""
    width = max(one.shape[1], two.shape[1])
    return [np.pad(a, ((0, 0), (0, width - a.shape[1]))) for a in (one, two)]


def _coefficients(lens: Lens) -> np.ndarray:
    """Rows of coefficients; those of even aspheres as those of odd ones."""
    given = np.asarray(lens.coefficients, float)
    rows = np.pad(given, ((0, 0), (0, given.shape[1])))
    for i, form in enumerate(lens.forms):
        if form == "asphere":
            rows[i, ::2], rows[i, 1::2] = 0, given[i]
    return rows


def _places(lens: Lens) -> list[np.ndarray]:
    z, across, turned = lens.places
    rows = lens.count + 1
    return [
        np.zeros((rows, 2)) if across is None else np.asarray(across, float),
        np.asarray(z - z[0], float),
        np.tile(np.eye(3), (rows, 1, 1)) if turned is None else np.asarray(turned, float),
    ]


def _apertures(lens: Lens) -> np.ndarray:
    """Rows of surface, whether it blocks, number of the kind, centre and size, sorted; short rows
    are filled up by zeros."""
    shapes = [(i, shape) for i in range(lens.count) for shape in shapes_of(lens, i)]
    rows = [[i, own.blocks, _KINDS.index(own.kind), *own.centre, *own.size] for i, own in shapes]
    wide = max(map(len, rows), default=0)
    return np.array([[*row, *[0.0] * (wide - len(row))] for row in sorted(rows)], float)


def _phase(phase: Any) -> np.ndarray:
    """Rows of surface, order and coefficients."""
    if phase is None:
        return np.zeros((0, 2))
    order = np.asarray(phase.order, float)[:, None]
    return np.hstack([np.array(phase.surfaces)[:, None], order, np.asarray(phase.coefficients)])
