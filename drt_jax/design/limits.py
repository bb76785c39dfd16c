"""Limits by name: which value of which operand, and by how much it is beyond."""

import itertools
from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from ..lens.lens import Lens
from .gaps import ZONES
from .operands import Operand
from .values import OPERANDS

_Side = Literal["low", "high"]


class Limit(NamedTuple):
    """One limit of one value; as text, one line that says all of it.

    kind: of the operand. where: which of its values, such as "surface 7, zone 1"; empty if it has
    one. side: which limit. bound: the limit, in the unit of the values. excess: by how much the
    value is beyond it, in that unit, negative within.
    """

    kind: str
    where: str
    side: _Side
    bound: float
    excess: float

    @property
    def value(self) -> float:
        """The value, in its unit."""
        return self.bound + (self.excess if self.side == "high" else -self.excess)

    def __str__(self) -> str:
        name = f"{self.kind} of {self.where}" if self.where else self.kind
        beyond = f"{'beyond' if self.excess > 0 else 'within'} by {abs(self.excess):.3g}"
        return f"{name}: {self.value:.6g}, {self.side} {self.bound:g}, {beyond}"


def limits_of(
    operands: Sequence[Operand], lens: Lens, counts: dict[str, int], excess: np.ndarray
) -> list[Limit]:
    """The limits of operands, in the order of `excess` (L,), see `Operand.excess`; `counts`: of
    "fields", "wavelengths", "distances" and components in "xy"."""
    sides: tuple[_Side, ...] = ("low", "high")
    found: list[Limit] = []
    for operand, side in itertools.product(operands, sides):
        bound = getattr(operand, side)
        if np.isfinite(bound):
            for where in _names(operand, lens, counts):
                beyond = float(excess[len(found)]) / operand.weight
                found.append(Limit(operand.kind, where, side, bound, beyond))
    return found


def _names(operand: Operand, lens: Lens, counts: dict[str, int]) -> list[str]:
    """What each value of an operand is called among the others, in their order."""
    known = OPERANDS[operand.kind]
    parts: list[Iterable[str]] = []
    for axis in known.axes:
        if axis == "zones":
            parts.append([f"zone {zone:g}" for zone in ZONES])
        elif axis == "xy":
            parts.append(["x", "y"] if counts["xy"] == 2 else [""])
        elif axis == "surfaces":
            named, there = operand.surfaces, known.places(lens) if known.places else []
            parts.append([f"surface {k}" for k in there if not named or k in named])
        else:
            name = "wavelengths" if axis in ("middle", "later") else axis
            numbers = getattr(operand, name)
            if axis == "middle" and not numbers:
                continue
            numbers = (numbers or range(counts[name]))[axis == "later" :]
            one = counts[name] == 1
            parts.append(["" if one else f"{name[:-1]} {k}" for k in numbers])
    return [", ".join(filter(None, words)) for words in itertools.product(*parts)]
