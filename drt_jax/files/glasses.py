"""Glasses of lens files of other programs: names of their catalogues in ours."""

from collections.abc import Sequence

from ..lens.glass import find_glass
from .record import Record, Row, short

# Of our catalogue: whose glasses those are that are not Schott's; see its head.
MAKERS = {"SK2": "HIKARI", "SK16": "HIKARI"}
_PLAIN = {"air", "water", "silica", "CaF2", "PMMA", "polycarbonate", "polystyrene", "SAN", "COC"}
_PLAIN |= {"E48R", "480R", "330R", "Optorez-1330"}
# What other programs call substances whose constants in their catalogues are the same.
_SAME = {"F_SILICA": "silica", "SILICA": "silica"}


def named_glass(
    record: Record, row: Row, line: int, name: str, makers: Sequence[str]
) -> dict[str, str]:
    """The entry of a glass, by its name in the catalogues of these makers; empty: of any. LensError
    for one that we have not from one of them."""
    own = _SAME.get(name.upper(), name)
    try:
        find_glass(own)
    except ValueError as error:
        raise record.error(
            line, f"{row.name}: {error}; give nd and vd as a model glass in the file"
        ) from None
    maker = MAKERS.get(own, "SCHOTT")
    if own not in _PLAIN and makers and maker not in makers:
        raise record.error(
            line,
            f"{row.name}: we have {short(own)} of {maker} alone, the file's catalogues are "
            f"{short(' '.join(makers))}; give nd and vd as a model glass in the file",
        )
    return {"glass": own}


def maker_of(name: str) -> str:
    """Whose glass it is; "" for a substance that has no maker."""
    return "" if name in _PLAIN else MAKERS.get(name, "SCHOTT")
