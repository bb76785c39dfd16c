"""Write a lens as a prescription, the inverse of `specs`."""

import pathlib
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import yaml

from ..inputs import warn
from ..lens.glass import FRAUNHOFER
from ..lens.lens import Lens
from .apertures import KINDS
from .entry import LensError, require
from .load import System, known_ending, lens_in, system_for
from .write_seq import seq_text
from .write_zmx import zmx_text
from .written import (
    element_of,
    entry_of,
    media_of_lens,
    place_of,
    shapes_of,
    with_short_numbers,
)

# Largest error of the index of a private glass at more wavelengths than its formula can fit.
_PRIVATE = 1e-6
_WEIGHTED = ("heights", "field_weights", "vignetting", "wavelengths", "wavelength_weights")
_CLOSE = 1e-9  # tolerance of numbers read back, relative and in mm; rounding in float32 is larger


def save_lens(lens: Lens | System | Sequence[Lens | System], path: str | pathlib.Path) -> None:
    """Write a lens as a YAML prescription, or as a file of Zemax or CODE V if the path ends in
    `.zmx` or `.seq`.

    `load_lens` reads the same lens from it, to the last digit. Tilts, which files have in degrees,
    and model glasses and radii in `.zmx` are the same to the last digit but one. A number that
    differs only in the last bit from a decimal of at most 12 digits is written as this decimal.

    The text is read back before the file is written. If curvatures, thicknesses, positions, indices
    at the wavelengths, the stop or apertures differ beyond rounding, nothing is written; for a
    `System` this includes distance, fields, vignetting and wavelengths. The file contains the
    constants of glasses that differ from those of the catalogue. A second medium of the same name
    with other constants is called name*.

    lens: a lens; or a `System`, such as `System.of(lens, scene)`, whose fields, wavelengths,
        weights, vignetting and object distance are written into `.zmx` and `.seq` files, with the
        size of the stop. A lens alone is written with an axial field at infinity and the d line. A
        warning names what a `.yaml` file cannot store. Several systems are configurations (zoom
        positions) of one lens, which differ only in numbers: rows behind MNUM, ZOO.
    path: path of the file, which is overwritten; it ends in `.yaml`, `.yml`, `.zmx` or `.seq`.

    LensError for another ending, if the format cannot represent the lens (a prescription has no
    curved sensor), if `Lens.check` or `load_lens` raise an error, or if the file cannot be written.
    """
    kind = known_ending(path)
    given = [lens] if isinstance(lens, Lens | System) else [*lens]
    require(given, "lens: expected a lens, a system, or several systems, got none")
    systems = [own if isinstance(own, System) else system_for(own) for own in given]
    at_20 = all(own.lens.dispersion.thermal is None for own in systems)
    require(at_20, f"{path}: a file has no indices of another temperature; save the lens at 20 C")
    if kind in (".yaml", ".yml"):
        require(len(systems) == 1, f"{path}: a prescription has one configuration: use .zmx, .seq")
        if isinstance(given[0], System):
            warn(f"{path}: fields, wavelengths and vignetting are not written")
    try:
        text = {".zmx": zmx_text, ".seq": seq_text}.get(kind, _yaml_text)(systems)
        text = with_short_numbers(text)
        for system in systems:
            system.lens.check()
    except LensError:
        raise
    except ValueError as error:
        raise LensError(f"{path}: not written: {error}") from error
    for k, system in enumerate(systems):
        _read_back(system, text, path, k + 1 if len(systems) > 1 else None)
    try:
        pathlib.Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise LensError(f"{path}: cannot be written: {error.strerror}") from error


def _read_back(
    system: System, text: str, path: str | pathlib.Path, configuration: int | None
) -> None:
    """LensError if the text of a file does not read back as this system."""
    low, high = system.lens.dispersion.range
    waves = dict.fromkeys([*FRAUNHOFER[:3], *system.wavelengths.tolist()])
    known = [wave for wave in waves if low <= wave <= high]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            again, used = lens_in(text, path, configuration)
    except LensError as error:
        raise LensError(f"{error}; not written, as it could not be read back") from error
    # In .seq, a private glass of six terms approximates a model glass.
    private = known_ending(path) == ".seq" and system.lens.dispersion.model is not None
    room = _PRIVATE if private else 0.0
    found = _difference(system.lens, again, known, room) or _use_difference(system, used)
    where = f" in configuration {configuration}" if configuration else ""
    require(not found, f"{path}: not written: what is read back{where} differs: {found}")


def _yaml_text(systems: Sequence[System]) -> str:
    lens = systems[0].lens
    curved = any(np.asarray(part)[-1] for part in (lens.curvature, lens.conic))
    require(not curved, "sensor: a prescription has none that is curved")
    top: dict[str, Any] = {"name": lens.name} if lens.name else {}
    media, glasses = media_of_lens(lens)
    top |= {"glasses": glasses} if glasses else {}
    top |= {"object": media[0]} if media[0] else {}
    top["surfaces"] = [entry_of(lens, i, media[i + 1]) for i in range(lens.count)]
    for i, entry in enumerate(top["surfaces"]):
        # Zeros of one surface preserve the number of columns.
        zeros = entry["coefficients"] and i == 0 and not np.any(lens.coefficients)
        if not zeros and not any(entry["coefficients"].values()):
            del entry["coefficients"]
    if (groups := lens.elements) is not None:
        top["elements"] = [element_of(groups, g) for g in range(len(groups.spans))]
    top["sensor"] = float(lens.sensor)
    top |= {"afocal": True} if lens.afocal else {}
    top |= {f"sensor_{key}": value for key, value in place_of(lens, lens.count).items()}
    return yaml.safe_dump(top, sort_keys=False, default_flow_style=None, width=1000)


def _difference(one: Lens, two: Lens, waves: list[float], indices: float = 0.0) -> str:
    """The first difference beyond rounding between a lens `one` and the lens `two` that was read
    back, as text; empty if there is none. Positions are measured from the first surface, because a
    file need not contain its position.

    waves: wavelengths at which indices are compared, um. indices: their largest difference.
    """
    for name in ("count", "stop", "mirrors", "forms", "afocal"):
        a, b = getattr(one, name), getattr(two, name)
        if name == "forms":  # an even asphere may be written as an odd one
            a, b = ([form.removeprefix("odd_") for form in own] for own in (a, b))
        if a != b:
            return f"{name} {a}, read back {b}"
    close = max(_CLOSE, 256 * float(np.finfo(np.asarray(one.curvature).dtype).eps))
    size = close * max(1.0, abs(float(one.sensor)))
    room = dict.fromkeys(("thickness", "sensor", "apertures", "decentre", "vertex"), size)
    room |= {"index": max(_CLOSE, indices), "rotation": max(1e-8, close)}
    # Elements that move along the axis become thicknesses in files of other programs.
    spaced = one.elements is None and two.elements is None
    both = [_numbers(lens, waves, spaced) for lens in (one, two)]
    pairs = [(name, a, both[1][name], room.get(name, 0.0)) for name, a in both[0].items()]
    return _first(pairs, close)


def _use_difference(system: System, used: Mapping[str, Any]) -> str:
    """The first difference of fields, wavelengths and aperture, as in `_difference`. used: fields
    of `System` that were read back."""
    for name in ("field_kind", "primary"):
        a, b = getattr(system, name), used.get(name, getattr(system, name))
        if a != b:
            return f"{name} {a}, read back {b}"
    pairs = []
    for name in (*_WEIGHTED, "distance") if used else ():
        both = [np.array(own, float) for own in (getattr(system, name), used[name])]
        for found in both if name == "vignetting" else ():
            found[:, 4] *= np.any(found[:, :4], axis=1)  # rotation of an unvignetted pupil: none
        pairs.append((name, *both, _CLOSE))
    return _first(pairs, _CLOSE)


def _first(pairs: list[Any], close: float) -> str:
    """The first difference of pairs of arrays, as text. pairs: name, both arrays, and absolute
    tolerance; shorter rows of coefficients are padded with zeros."""
    for name, a, b, least in pairs:
        if name in ("coefficients", "phase"):
            wide = max(a.shape[1], b.shape[1])
            a, b = (np.pad(own, ((0, 0), (0, wide - own.shape[1]))) for own in (a, b))
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


def _numbers(lens: Lens, waves: list[float], spaced: bool) -> dict[str, np.ndarray]:
    """Arrays of a lens by name. spaced: True to include thicknesses, for a lens whose surfaces are
    placed by thicknesses alone."""
    rows, (z, across, turned) = lens.count + 1, lens.places
    decentre = np.zeros((rows, 2)) if across is None else np.asarray(across, float)
    rotation = np.tile(np.eye(3), (rows, 1, 1)) if turned is None else np.asarray(turned, float)
    given, semi = np.asarray(lens.coefficients, float), np.asarray(lens.semi_diameter, float)
    coefficients = np.pad(given, ((0, 0), (0, given.shape[1])))
    for i, form in enumerate(lens.forms):
        if form == "asphere":  # as an odd one
            coefficients[i, ::2], coefficients[i, 1::2] = 0, given[i]
    listed = sorted(
        [i, blocks, KINDS.index(kind), *centre, *size]
        for i in range(lens.count)
        for blocks, kind, size, centre in shapes_of(lens, i)
    )
    wide = max(map(len, listed), default=0)
    phase = np.zeros((0, 2))  # rows of surface, order and coefficients
    if (own := lens.phase) is not None:
        phase = np.column_stack([own.surfaces, own.order, own.coefficients])
    names = ("curvature", "conic", *(("thickness", "sensor") if spaced else ()))
    return {name: np.asarray(getattr(lens, name), float) for name in names} | {
        "coefficients": coefficients,
        "stop's semi_diameter": semi[lens.stop],
        "apertures": np.array([[*row, *[0.0] * (wide - len(row))] for row in listed], float),
        "index": np.asarray(lens.index(waves), float),
        "decentre": decentre,
        "vertex": np.asarray(z - z[0], float),
        "rotation": rotation,
        "phase": phase,
    }
