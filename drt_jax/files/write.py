"""Write a lens as a prescription, the inverse of `specs`."""

import math
import pathlib
import warnings
from typing import Any

import numpy as np
import yaml
from jax import Array

from ..lens.elements import Elements
from ..lens.forms import FORMS
from ..lens.glass import FRAUNHOFER
from ..lens.lens import Lens
from .compare import difference, use_difference
from .entry import LensError
from .exact import degrees_of
from .media_out import media_of_lens
from .system import System, system_for
from .write_seq import seq_text
from .write_zmx import zmx_text
from .yaml import known_ending, lens_in

# How far the index of a private glass may be off at more wavelengths than it can be made for.
_PRIVATE = 1e-6


def save_lens(lens: Lens | System, path: str | pathlib.Path) -> None:
    """Write a lens as a YAML prescription, or as a file of Zemax or CODE V if the path ends in
    `.zmx` or `.seq`. `load_lens` reads the same lens from it, to the last digit (tilts, which files
    hold in degrees, and model glasses and radii in `.zmx`: to the last digit but one).

    The text is read back before it becomes a file: if curvatures, thicknesses, places, indices at
    the wavelengths, the stop, apertures or, of a `System`, distance, fields, vignetting and
    wavelengths differ beyond rounding, nothing is written. The file contains the constants of
    glasses that differ from the catalogue's. A second medium of the same name with other constants
    is called name*.

    lens: a lens; or a `System`, whose fields, wavelengths, vignetting and distance of the object
        stand in `.zmx` and `.seq` files, with the size of the stop; a lens alone is written with an
        axial field at infinity and the d line. A warning tells what `.yaml` has not.
    path: of the file, which is overwritten; it ends in `.yaml`, `.yml`, `.zmx` or `.seq`.

    LensError for another ending, if the file cannot hold the lens, such as a prescription a curved
    sensor, if `Lens.check` or `load_lens` refuse it, or if the file cannot be written.
    """
    kind = known_ending(path)
    system = lens if isinstance(lens, System) else system_for(lens)
    if kind in (".yaml", ".yml") and isinstance(lens, System):
        warnings.warn(f"{path}: fields, wavelengths and vignetting are not written", stacklevel=2)
    try:
        text = {".zmx": zmx_text, ".seq": seq_text}.get(kind, _yaml_text)(system)
        system.lens.check()
    except LensError:
        raise
    except ValueError as error:
        raise LensError(f"{path}: not written: {error}") from error
    low, high = system.lens.dispersion.range
    waves = dict.fromkeys([*FRAUNHOFER[:3], *system.wavelengths.tolist()])
    known = [wave for wave in waves if low <= wave <= high]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            again, used = lens_in(text, path)
    except LensError as error:
        raise LensError(f"{error}; not written, as it could not be read back") from error
    # A private glass of .seq stands for a model glass by six terms.
    room = _PRIVATE if kind == ".seq" and system.lens.dispersion.model is not None else 0.0
    if found := difference(system.lens, again, known, room) or use_difference(system, used):
        raise LensError(f"{path}: not written: what is read back differs: {found}")
    try:
        pathlib.Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise LensError(f"{path}: cannot be written: {error.strerror}") from error


def _yaml_text(system: System) -> str:
    lens = system.lens
    if np.any([np.asarray(a)[-1] for a in (lens.curvature, lens.conic)]):
        raise LensError("sensor: a prescription has none that is curved")
    top: dict[str, Any] = {"name": lens.name} if lens.name else {}
    media, glasses = media_of_lens(lens)
    top |= {"glasses": glasses} if glasses else {}
    top |= {"object": media[0]} if media[0] else {}
    top["surfaces"] = [_surface(lens, i, media[i + 1]) for i in range(lens.count)]
    if lens.elements is not None:
        top["elements"] = [_element(lens.elements, g) for g in range(len(lens.elements.spans))]
    top["sensor"] = float(lens.sensor)
    top |= {"afocal": True} if lens.afocal else {}
    top |= {f"sensor_{key}": value for key, value in _place(lens, lens.count).items()}
    return yaml.safe_dump(top, sort_keys=False, default_flow_style=None, width=1000)


def _surface(lens: Lens, i: int, behind: dict[str, Any]) -> dict[str, Any]:
    entry: dict[str, Any] = {"curvature": float(lens.curvature[i])}
    if lens.conic[i] != 0:
        entry["conic"] = float(lens.conic[i])
    if lens.forms[i] != "asphere":
        entry["form"] = lens.forms[i]
    named, rest = _coefficients(lens.forms[i], lens.coefficients[i])
    entry |= named
    # Zeros of one surface preserve the number of columns.
    if rest and (any(rest.values()) or (i == 0 and not np.any(lens.coefficients))):
        entry["coefficients"] = rest
    if i < lens.count - 1:
        entry["thickness"] = float(lens.thickness[i])
    if lens.mirrors[i]:
        entry["mirror"] = True
    else:
        entry |= behind
    if math.isfinite(lens.semi_diameter[i]):
        entry["semi_diameter"] = float(lens.semi_diameter[i])
    if i == lens.stop:
        entry["stop"] = True
    return entry | _place(lens, i) | _phase(lens, i) | _apertures(lens, i)


def _coefficients(name: str, row: Array) -> tuple[dict, dict]:
    """The coefficients of a form with keys of their own, and the others by their names in files."""
    form, values = FORMS[name], np.asarray(row).tolist()
    named = dict(zip(form.named, values, strict=False))
    return named, dict(zip(form.powers, values[len(form.named) :], strict=False))


def _element(elements: Elements, g: int) -> dict[str, Any]:
    return {
        "surfaces": list(elements.spans[g]),
        "about": elements.about[g],
        "pivot": float(elements.pivot[g]),
        "shift": np.asarray(elements.shift[g]).tolist(),
        "tilt": [degrees_of(angle) for angle in np.asarray(elements.tilt[g])],
    }


def _phase(lens: Lens, i: int) -> dict[str, Any]:
    """The entry `phase` of a diffractive surface; empty for others."""
    if lens.phase is None or i not in lens.phase.surfaces:
        return {}
    row = lens.phase.surfaces.index(i)
    form, order = lens.phase.forms[row], float(lens.phase.order[row])
    named, rest = _coefficients(form, lens.phase.coefficients[row])
    return {"phase": {"form": form, "order": order} | named | {"coefficients": rest}}


def _apertures(lens: Lens, i: int) -> dict[str, Any]:
    """The apertures and obscurations of a surface."""
    extra, found = lens.apertures, dict[str, Any]()
    if extra is None:
        return found
    for k in np.flatnonzero(np.array(extra.surfaces) == i):
        half = np.asarray(extra.half[k]).tolist()
        own = {extra.kinds[k]: half[0] if extra.kinds[k] == "circle" else half}
        if extra.kinds[k] == "polygon":
            own["polygon"] = np.asarray(extra.outline(int(k))).tolist()
        if extra.centre is not None:
            own["centre"] = np.asarray(extra.centre[k]).tolist()
        found.setdefault("obscuration" if extra.blocks[k] else "aperture", []).append(own)
    return found


def _place(lens: Lens, i: int) -> dict[str, Any]:
    """Decentre in mm and tilt in degrees of a surface or the sensor."""
    place = {}
    if lens.decentre is not None:
        place["decentre"] = np.asarray(lens.decentre[i]).tolist()
    if lens.tilt is not None:
        place["tilt"] = [degrees_of(angle) for angle in np.asarray(lens.tilt[i])]
    return place
