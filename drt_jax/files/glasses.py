"""Glasses of other programs' lens files: lookup of their names in our catalogues."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ..lens.glass import Glass
from ..lens.glasses import find_glass, glass_makers, spellings
from .record import Record, Row, short

# Other programs' names of materials whose constants equal ours.
_SAME = {"F_SILICA": "silica", "SILICA": "silica"}
_PLAIN: dict[str, dict[str, Any]] = {"AIR": {}, "N15": {"index": 1.5}}  # of Zemax's MISC
_NIKON = {"NIKON": "HIKARI"}


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
    record: Record,
    row: Row,
    line: int,
    name: str,
    makers: Sequence[str],
    beside: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The prescription entries of a glass, found by name in the catalogues of these makers, or of
    all makers if `makers` is empty. If no catalogue knows the name: `beside`, the keys that the
    file gives beside it, with a note; LensError without any, or if other makers alone have it."""
    if name.upper() in _PLAIN:
        return _PLAIN[name.upper()]
    own = _SAME.get(name.upper(), name)
    found = in_catalogues(own, makers)
    try:
        alone = find_glass(own)
    except ValueError as error:
        if not found and beside and not spellings(own):
            numbers = " ".join(f"{key} {value:.7g}" for key, value in beside.items())
            record.notes.append(
                f"line {line}: {row.name}: no catalogue has {short(name)}: {numbers}, as beside it"
            )
            return dict(beside)
        if not found:
            raise record.error(
                line, f"{row.name}: {error}; give nd and vd as a model glass in the file"
            ) from None
    else:
        if not makers or not alone.maker or own.endswith(f"_{alone.maker}"):
            return {"glass": alone.name}
        if not found:
            raise record.error(
                line,
                f"{row.name}: {short(own)} is known of {alone.maker}, the file's catalogues are "
                f"{short(' '.join(makers))}; add the right one behind GCAT, or give nd and vd",
            )
    return {"glass": found.name}


def written_names(names: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Catalogues that hold all these glasses, and the name of each glass there. If an earlier
    catalogue has another glass of this name, it is NAME_MAKER, which other programs do not know."""
    glasses = {name: find_glass(name) for name in names}
    makers = {glass.maker for glass in glasses.values()} - {"", "SCHOTT"}
    order, written = [*sorted(makers), "SCHOTT"], {}
    for name, glass in glasses.items():
        plain = name.removesuffix(f"_{glass.maker}")
        met = in_catalogues(plain, order)
        alone = not glass.maker or (met is not None and met == glass)
        written[name] = plain if alone else f"{plain}_{glass.maker}"
    return order, written
