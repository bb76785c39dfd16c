"""Glasses of other programs' lens files: their names in our catalogues, and model glasses of Zemax.

OpticStudio's model glasses have n = 1 + (nd - 1) + (nd - 1) / vd ((M1 + P M2) . (1, 1/L,
1/L^3.5)) with P = 0.6438 - 0.001682 vd + dP, within 1.9e-10 of 170 listings. This is Conrady's
formula through spectral lines rounded to four decimals; ours is the same formula through the exact
lines.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..lens.glass import FRAUNHOFER, NORMAL_LINE, Glass
from ..lens.glasses import find_glass, glass_makers, spellings
from .record import Row, short

# Other programs' names of materials whose constants equal ours.
_SAME = {"F_SILICA": "silica", "SILICA": "silica"}
_PLAIN: dict[str, dict[str, Any]] = {"AIR": {}, "N15": {"index": 1.5}}  # of Zemax's MISC
_CODE = re.compile(r"(\d{3,17})\.(\d{3,18})")
_SHORT_CODE = re.compile(r"\d{6}")
_PAIR = re.compile(r"(\d\.\d{1,17}):(\d{2,3}(?:\.\d{1,17})?)")
_NIKON = {"NIKON": "HIKARI"}
_POWERS = np.array([0.0, -1.0, -3.5])
_ROUNDING = 1e-12  # a P_gF that differs by less from the normal line lies on it
_M1 = np.array([-7.12849, 4.95284, -0.202244])
_M2 = np.array([8.84931, -6.91677, 0.454415])


def code_of(word: str) -> tuple[float, float] | None:
    """nd and vd of a code as 517642, 517.642, 516800.641700 or 1.5168:64.17; None for a name."""
    if found := _CODE.fullmatch(word):
        return float(f"1.{found[1]}"), float(f"{found[2][:2]}.{found[2][2:]}")
    if _SHORT_CODE.fullmatch(word):
        return 1 + int(word[:3]) / 1000, int(word[3:]) / 10
    found = _PAIR.fullmatch(word)
    return (float(found[1]), float(found[2])) if found else None


def in_catalogues(name: str, catalogues: Sequence[str]) -> Glass | None:
    """The glass of a name, in any case, from the first of these catalogues that has it; or None.

    catalogues: makers in capitals; a suffix as in OHARA_210226_CATALOG is ignored.
    """
    for catalogue in catalogues:
        word = re.split(r"[^A-Z]", catalogue, maxsplit=1)[0]
        maker = _NIKON.get(word, word)
        for own in spellings(name) if maker in glass_makers() else ():
            try:
                return find_glass(own, maker)
            except ValueError:  # the glass is of another maker
                continue
    return None


def named_glass(
    row: Row, line: int, name: str, makers: Sequence[str], beside: Mapping[str, Any] = _PLAIN["AIR"]
) -> dict[str, Any]:
    """The prescription entries of a glass, which is looked up by name.

    makers: makers whose catalogues are searched; empty for all.
    beside: keys that the file gives together with the name. They are used, with a note, if no
        catalogue has the name.

    LensError if no catalogue has the name and `beside` is empty, or if only catalogues of other
    makers have it.
    """
    if name.upper() in _PLAIN:
        return _PLAIN[name.upper()]
    own = _SAME.get(name.upper(), name)
    found = in_catalogues(own, makers)
    try:
        alone = find_glass(own)
    except ValueError as error:
        if not found and beside and not spellings(own):
            numbers = " ".join(f"{key} {value:.7g}" for key, value in beside.items())
            what = f"{row.name}: no catalogue has {short(name)}: {numbers}, as in its line"
            row.record.note(line, what)
            return dict(beside)
        what = f"{error}; give nd and vd as a model glass in the file"
    else:
        if not makers or not alone.maker or own.endswith(f"_{alone.maker}"):
            return {"glass": alone.name}
        what = f"{short(own)} is known of {alone.maker}, the file's catalogues are"
        remedy = "add the right one behind GCAT, or give nd and vd"
        what = f"{what} {short(' '.join(makers))}; {remedy}"
    if found is None:
        raise row.record.error(line, f"{row.name}: {what}")
    return {"glass": found.name}


def written_names(names: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Catalogues that have all these glasses, and the name of each glass in them. If an earlier
    catalogue has another glass of the same name, the name becomes NAME_MAKER, which other programs
    do not know."""
    glasses = {name: find_glass(name) for name in names}
    makers = {glass.maker for glass in glasses.values()} - {"", "SCHOTT"}
    order, written = [*sorted(makers), "SCHOTT"], {}
    for name, glass in glasses.items():
        plain = name.removesuffix(f"_{glass.maker}")
        met = in_catalogues(plain, order)
        alone = not glass.maker or (met is not None and met == glass)
        written[name] = plain if alone else f"{plain}_{glass.maker}"
    return order, written


def to_ours(nd: float, vd: float, above: float) -> tuple[float, float, float]:
    """nd, vd and dPgF of our model glass from nd, vd and dP of a file."""
    mean = (nd - 1) / vd
    terms = mean * (_M1 + (NORMAL_LINE[0] + NORMAL_LINE[1] * vd + above) * _M2)
    terms[0] += nd
    d, f, c, g = (np.array(FRAUNHOFER)[:, None] ** _POWERS) @ terms
    abbe = (d - 1) / (f - c)
    dPgF = float((g - f) / (f - c) - NORMAL_LINE[0] - NORMAL_LINE[1] * abbe)
    return float(d), float(abbe), dPgF if abs(dPgF) > _ROUNDING else 0.0


def to_theirs(nd: float, vd: float, above: float) -> tuple[float, float, float]:
    """nd, vd and dP of a file from nd, vd and dPgF of our model glass."""
    lines = np.array(FRAUNHOFER)[:, None] ** _POWERS
    mean = (nd - 1) / vd
    wanted = np.array([nd - 1, mean, (NORMAL_LINE[0] + NORMAL_LINE[1] * vd + above) * mean])
    ours = np.stack([lines[0], lines[1] - lines[2], lines[3] - lines[1]])
    terms = np.linalg.solve(ours, wanted)
    own = np.stack([np.array([1.0, 0, 0]), _M1, _M2], axis=1)
    index, mean, part = np.linalg.solve(own, terms)
    abbe = index / mean
    dPgF = float(part / mean - NORMAL_LINE[0] - NORMAL_LINE[1] * abbe)
    return float(1 + index), float(abbe), dPgF


def model_keys(row: Row, line: int, nd: float, vd: float, above: float) -> dict[str, Any]:
    """The prescription keys of a medium with nd, vd and dP of a file; vd = 0 means a constant
    index. LensError for values that no glass has."""
    if not vd:
        return {"index": nd}
    require_glass(row, line, nd, vd)
    return dict(zip(("nd", "vd", "dPgF"), to_ours(nd, vd, above), strict=True))


def require_glass(row: Row, line: int, nd: float, vd: float) -> None:
    """LensError if no glass has this nd and vd."""
    row.require(1 < nd <= 4 and 10 <= vd <= 120, f"no glass has nd {nd:g} and vd {vd:g}", line)
