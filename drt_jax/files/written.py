"""A lens as entries of a prescription, from which all kinds of files are written."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..lens.elements import Elements
from ..lens.forms import FORMS
from ..lens.glass import ANY, Dispersion
from ..lens.glasses import find_glass, glass_names
from ..lens.lens import Lens
from .entry import require

# Largest number of digits of a decimal that a person types; and a pattern of numbers that may be
# such a decimal with a rounding error.
_TYPED = 12
_LONG = re.compile(r"(?<![\w.])-?\d+\.\d{9,}(e[-+]?\d+)?(?![\w.])")
Shape = tuple[bool, str, list[float], list[float]]


def number_for(target: float, read: Callable[[float], float], *guesses: float) -> float:
    """The number that `read` maps closest to `target`, of: decimals of the last guess, the shortest
    first; the guesses; and the neighbours of the last guess. Of equally close ones, the first."""
    last = guesses[-1]
    near = (last + np.arange(-8, 9) * np.spacing(abs(last))).tolist()
    return min([*_decimals(last), *guesses, *near], key=lambda number: abs(read(number) - target))


def _decimals(number: float) -> list[float]:
    """A number rounded to decimals, the shortest first."""
    return [float(f"{number:.{digits}g}") for digits in range(1, _TYPED + 1)]


def with_short_numbers(text: str) -> str:
    """The text of a file with decimals as a person types them. A number that differs only in the
    last bit from a decimal of at most 12 digits is replaced by it: 587.5618 for
    587.5618000000001."""

    def short(match: re.Match[str]) -> str:
        number = float(match[0])
        near = (own for own in _decimals(number) if abs(own - number) <= np.spacing(abs(number)))
        found = next(map(repr, near), match[0])
        return found if "." in found else found.replace("e", ".0e")  # YAML needs a point

    return _LONG.sub(short, text)


def degrees_of(angles: Any) -> list[float]:
    """Angles in degrees that read back as `angles` (radians), or as close as possible."""
    own, wide = np.asarray(angles), np.asarray(angles, float)
    rows = zip(wide.tolist(), np.degrees(own).tolist(), np.degrees(wide).tolist(), strict=True)

    def read(degrees: float) -> float:
        return float(jnp.radians(degrees))

    return [number_for(angle, read, *guesses) if angle else angle for angle, *guesses in rows]


def gap_behind(lens: Lens, i: int) -> float:
    """The thickness (mm) behind a surface; the last one makes their sum equal `lens.sensor`."""
    gaps = np.asarray(lens.thickness, float).tolist()
    if i < lens.count - 1:
        return gaps[i]
    before, sensor = sum(gaps), float(lens.sensor)
    return number_for(sensor, lambda gap: before + gap, sensor - before)


def entry_of(lens: Lens, i: int, behind: Mapping[str, Any]) -> dict[str, Any]:
    """The entry of surface i, with all coefficients, even those of 0. behind: keys of the medium
    behind it."""
    conic, semi = float(lens.conic[i]), float(lens.semi_diameter[i])
    entry: dict[str, Any] = {"curvature": float(lens.curvature[i])}
    entry |= {"conic": conic} if conic else {}
    entry |= {"form": lens.forms[i]} if lens.forms[i] != "asphere" else {}
    entry |= _coefficients(lens.forms[i], lens.coefficients[i])
    entry |= {"thickness": float(lens.thickness[i])} if i < lens.count - 1 else {}
    entry |= {"mirror": True} if lens.mirrors[i] else behind
    entry |= {"semi_diameter": semi} if math.isfinite(semi) else {}
    entry |= {"stop": True} if i == lens.stop else {}
    return entry | place_of(lens, i) | _phase(lens, i) | _apertures(lens, i)


def _coefficients(name: str, row: Any) -> dict[str, Any]:
    """The coefficients of a form: those with keys of their own, and the others by their names in
    files."""
    form, values = FORMS[name], np.asarray(row).tolist()
    rest = dict(zip(form.powers, values[len(form.named) :], strict=False))
    return dict(zip(form.named, values, strict=False)) | {"coefficients": rest}


def place_of(lens: Lens, i: int) -> dict[str, Any]:
    """Decentre in mm and tilt in degrees of a surface or the sensor."""
    place = {}
    if lens.decentre is not None:
        place["decentre"] = np.asarray(lens.decentre[i]).tolist()
    if lens.tilt is not None:
        place["tilt"] = degrees_of(lens.tilt[i])
    return place


def element_of(elements: Elements, g: int) -> dict[str, Any]:
    """The entry of element g."""
    return {
        "surfaces": list(elements.spans[g]),
        "about": elements.about[g],
        "pivot": float(elements.pivot[g]),
        "shift": np.asarray(elements.shift[g]).tolist(),
        "tilt": degrees_of(elements.tilt[g]),
    }


def _phase(lens: Lens, i: int) -> dict[str, Any]:
    """The entry `phase` of a diffractive surface; empty for others."""
    if lens.phase is None or i not in lens.phase.surfaces:
        return {}
    row = lens.phase.surfaces.index(i)
    form, order = lens.phase.forms[row], float(lens.phase.order[row])
    terms = _coefficients(form, lens.phase.coefficients[row])
    return {"phase": {"form": form, "order": order} | terms}


def _apertures(lens: Lens, i: int) -> dict[str, Any]:
    """The apertures and obscurations of a surface."""
    extra, found = lens.apertures, dict[str, Any]()
    for k in () if extra is None else np.flatnonzero(np.array(extra.surfaces) == i).tolist():
        assert extra is not None
        kind, half = extra.kinds[k], np.asarray(extra.half[k]).tolist()
        size = half[0] if kind == "circle" else half
        own = {kind: np.asarray(extra.outline(k)).tolist() if kind == "polygon" else size}
        if extra.centre is not None:
            own["centre"] = np.asarray(extra.centre[k]).tolist()
        found.setdefault("obscuration" if extra.blocks[k] else "aperture", []).append(own)
    return found


def shapes_of(lens: Lens, i: int) -> list[Shape]:
    """All apertures and obscurations of a surface, sorted.

    Each has: whether it blocks light, its kind, its size (half widths in x and y; for a circle its
    radius twice; for a polygon x and y of all corners) and its centre, mm. A semi-diameter is a
    circle like others, except that of the stop, which is not an aperture.
    """
    own, semi, found = _apertures(lens, i), float(lens.semi_diameter[i]), list[Shape]()
    if math.isfinite(semi) and i != lens.stop:
        own.setdefault("aperture", []).append({"circle": semi})
    for key, shapes in own.items():
        for shape in shapes:
            kind = next(kind for kind in shape if kind != "centre")
            size = np.ravel(shape[kind]).tolist() * (1 + (kind == "circle"))
            found.append((key == "obscuration", kind, size, shape.get("centre", [0.0, 0.0])))
    return sorted(found)


def medium_of(lens: Lens, i: int) -> dict[str, Any] | None:
    """Prescription keys of medium i; None if it can be described only by its constants."""
    own = constants_of(lens.dispersion, i)
    if lens.dispersion.model is not None and lens.dispersion.model[i, 0] != 1:
        what = f"glasses[{i}]: a prescription has nd and vd and no other constants"
        require(not own.keys() - {"range"}, what)
        nd, vd = np.asarray(lens.dispersion.model[i]).tolist()
        dPgF = lens.dispersion.dPgF
        above = {} if dPgF is None or not dPgF[i] else {"dPgF": float(dPgF[i])}
        return {"nd": nd, "vd": vd} | above
    if not own:
        return {}
    if own.keys() == {"schott"} and not any(own["schott"][1:]):
        return {"index": math.sqrt(own["schott"][0])}
    unnamed = lens.glasses[i] in lens.labels.unnamed.glasses  # returned by a jitted function
    for name in glass_names() if unnamed else [lens.glasses[i]]:
        try:
            glass = find_glass(name)
        except ValueError:
            return None
        alike = np.float32(glass.range[1]) == np.float32(lens.dispersion.ranges[i, 1])
        if alike and own == constants_of(Dispersion.of([glass]), 0):
            return {"glass": name}
    return None


def constants_of(dispersion: Dispersion, i: int) -> dict[str, Any]:
    """The constants of medium i as in `glasses` of a prescription; empty for air."""
    parts = (dispersion.strength, dispersion.resonance, dispersion.schott)
    strength, resonance, schott = (np.asarray(part[i]).tolist() for part in parts)
    terms = max((k + 1 for k, pair in enumerate(zip(strength, resonance)) if any(pair)), default=0)
    constants: dict[str, Any] = {}
    if terms:
        constants["sellmeier"] = strength[:terms] + resonance[:terms]
    schott = schott if any(schott[6:]) else schott[:6]
    if schott != [1, 0, 0, 0, 0, 0]:
        constants["schott"] = schott
    known = np.asarray(dispersion.ranges[i])
    if not np.array_equal(known, np.asarray(ANY, known.dtype)):
        constants["range"] = known.tolist()
    return constants


def media_of_lens(lens: Lens) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Keys of each medium (empty for air), and the glasses that the file must define."""
    plain = [medium_of(lens, i) for i in range(lens.count + 1)]
    described = {name for name, keys in zip(lens.glasses, plain, strict=True) if keys is None}
    media: list[dict[str, Any]] = []
    glasses: dict[str, Any] = {}
    for i, (name, keys) in enumerate(zip(lens.glasses, plain, strict=True)):
        if i and name == lens.glasses[i - 1]:  # same medium: the constants of the one in front
            keys = media[-1]
        elif keys is None or keys.get("glass") in described:
            own = constants_of(lens.dispersion, i)
            while glasses.setdefault(name, own) != own:  # another medium has this name
                name += "*"
            keys = {"glass": name}
        media.append(keys)
    return media, glasses


def differing(
    texts: Sequence[Sequence[str]], begins: str
) -> Iterator[tuple[int, list[str], int, list[str]]]:
    """The words that differ between the lines of C configurations of one lens, except its name.

    Each is a tuple: number of the surface (-1 in front of the first); words of the line in the
    first configuration; number of the word; the C words. LensError if the configurations do not
    have the same lines.

    begins: start of the first line of each surface.
    """
    what = "configurations differ in more than numbers: glasses, forms, tilts, fields or apertures"
    require(len({*map(len, texts)}) == 1, what)
    surface = -1
    for lines in zip(*texts, strict=True):
        surface += lines[0].startswith(begins)
        words = [line.split() for line in lines]
        if words[0][0] in ("NAME", "TITLE"):
            continue
        require(len({*map(len, words)}) == 1, f"{what}: {lines[0].strip()[:80]}")
        for at, values in enumerate(zip(*words, strict=True)):
            if len({*values}) > 1:
                yield surface, words[0], at, [*values]
