"""The media of a prescription: glasses by name, by index, by code, by nd and vd."""

from ..lens.glass import Glass, find_glass, model_glass
from .entry import Entry

MEDIUM_KEYS = ("glass", "index", "nd", "vd")


def _medium(entry: Entry) -> Glass:
    given = [key for key in ("glass", "index", "nd") if key in entry]
    if len(given) > 1:
        raise entry.error("", f"give either {' or '.join(given)}, not both")
    if ("nd" in entry) != ("vd" in entry):
        raise entry.error("", "nd and vd make a model glass together: give both or neither")
    if "nd" in entry:
        return _model_glass(entry, "nd", entry.number("nd"), entry.number("vd"))
    if "index" in entry:
        value = entry.number("index")
        if value < 1:
            raise entry.error("index", f"{value:g} is below 1")
        if value == 1:  # the same medium as air, so that a surface between both bends no light
            return find_glass("air")
        return Glass(f"index {value!r}", schott=(value**2, 0.0, 0.0, 0.0, 0.0, 0.0))
    name = str(entry.get("glass", "air"))
    if len(name) == 6 and name.isdecimal():  # the code of a glass: (nd - 1) 1000 and 10 vd
        return _model_glass(entry, "glass", 1 + int(name[:3]) / 1000, int(name[3:]) / 10)
    try:
        return find_glass(name)
    except ValueError as error:
        raise entry.error("glass", str(error)) from error


def _model_glass(entry: Entry, key: str, nd: float, vd: float) -> Glass:
    try:
        return model_glass(nd, vd)
    except ValueError as error:
        raise entry.error(key, str(error)) from error


def media_of(top: Entry, surfaces: list[Entry]) -> list[Glass]:
    """The medium in front of the lens, and that behind each surface."""
    media = [_medium(Entry(top.get("object", {}), "object", MEDIUM_KEYS))]
    for surface in surfaces:
        mirror = surface.flag("mirror")
        for key in MEDIUM_KEYS:
            if mirror and key in surface:
                raise surface.error(key, "behind a mirror is the medium before it")
        media.append(media[-1] if mirror else _medium(surface))
    return media
