"""The media of a prescription: glasses by name, index, code, nd and vd, or constants."""

from typing import Any

from ..inputs import shown
from ..lens.glass import POWERS, VISIBLE, Glass, model_glass
from ..lens.glasses import find_glass, flaw
from .entry import Entry

_DENSEST = 10
MEDIUM_KEYS = ("glass", "index", "nd", "vd", "partial")


def _own_glasses(top: Entry) -> dict[str, Glass]:
    """The glasses that the prescription itself defines, by name."""
    names = top.get("glasses", {})
    entries = Entry(names, "glasses", list(names) if isinstance(names, dict) else ["NAME"])
    keys = ("sellmeier", "schott", "range")
    return {str(n): _own_glass(str(n), Entry(entries[n], entries.name(n), keys)) for n in entries}


def _own_glass(name: str, entry: Entry) -> Glass:
    if "sellmeier" not in entry and "schott" not in entry:
        raise entry.error("", "give sellmeier, schott or both")
    terms = entry.get("sellmeier", [0.0, 0.0])
    if not isinstance(terms, list) or not terms or len(terms) % 2:
        raise entry.error("sellmeier", f"expected a list, all B and then all C, got {shown(terms)}")
    powers = entry.get("schott", [])
    more = isinstance(powers, list) and 6 < len(powers) <= len(POWERS)
    lengths = {"sellmeier": len(terms), "schott": len(powers) if more else 6}
    constants: dict[str, Any] = {
        key: tuple(entry.vector(key, n)) for key, n in lengths.items() if key in entry
    }
    low, high = entry.vector("range", 2) or VISIBLE
    if not 0 < low < high:
        raise entry.error("range", f"expected 0 < shortest < longest, got {low:g} and {high:g} um")
    glass = Glass(name, range=(low, high), **constants)
    if wrong := flaw(glass):
        raise entry.error("sellmeier" if "lies" in wrong else "", wrong)
    return glass


def _medium(entry: Entry, own: dict[str, Glass]) -> Glass:
    given = [key for key in ("glass", "index", "nd") if key in entry]
    if len(given) > 1:
        raise entry.error("", f"give either {' or '.join(given)}, not both")
    if ("nd" in entry) != ("vd" in entry):
        raise entry.error("", "nd and vd make a model glass together: give both or neither")
    if "nd" in entry:
        values = entry.number("nd"), entry.number("vd"), entry.number("partial", 0.0)
        return _model_glass(entry, "nd", *values)
    if "partial" in entry:
        raise entry.error("partial", "belongs to a model glass: give nd and vd as well")
    if "index" in entry:
        value = entry.number("index")
        if not 1 <= value <= _DENSEST:
            raise entry.error("index", f"{value:g} is not between 1 and {_DENSEST}")
        if value == 1:  # the same medium as air: a surface between the two refracts nothing
            return find_glass("air")
        return Glass(f"index {value!r}", schott=(value**2, 0.0, 0.0, 0.0, 0.0, 0.0))
    if "glass" not in entry:
        return find_glass("air")
    name = entry.text("glass", "air")
    if name in own:
        return own[name]
    if len(name) == 6 and name.isdecimal():  # a glass code: 1000 (nd - 1), then 10 vd
        return _model_glass(entry, "glass", 1 + int(name[:3]) / 1000, int(name[3:]) / 10)
    try:
        return find_glass(name)
    except ValueError as error:
        raise entry.error("glass", str(error)) from error


def _model_glass(entry: Entry, key: str, *values: float) -> Glass:
    try:
        return model_glass(*values)
    except ValueError as error:
        raise entry.error(key, str(error)) from error


def media_of(top: Entry, surfaces: list[Entry]) -> list[Glass]:
    """The medium in front of the lens, then the medium behind each surface."""
    own = _own_glasses(top)
    media = [_medium(Entry(top.get("object", {}), "object", MEDIUM_KEYS), own)]
    for surface in surfaces:
        mirror = surface.flag("mirror")
        for key in MEDIUM_KEYS:
            if mirror and key in surface:
                raise surface.error(key, "behind a mirror is the medium before it")
        media.append(media[-1] if mirror else _medium(surface, own))
    return media
