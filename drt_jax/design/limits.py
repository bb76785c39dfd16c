"""Limits by name: the value of an operand, and by how much it violates its limit."""

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from ..inputs import require
from ..lens.lens import Lens
from ..numerics import Numbers
from .media import ZONES
from .operands import Operand
from .values import OPERANDS, kind_of

_Side = Literal["low", "high"]
# No variable moves a limit if none of them would meet it by a change of `_FAR` times its scale.
_FAR = 1e6


class Limit(NamedTuple):
    """One limit of one value. Its text is one complete line.

    kind: kind of the operand.
    where: name of the value, such as "surface 7, zone 1"; empty if the operand has only one value.
    side: "low" or "high".
    bound: the limit, in the unit of the values.
    excess: violation in that unit; negative if the limit is met.
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
    operands: Sequence[Operand],
    lens: Lens,
    counts: dict[str, int],
    sizes: Sequence[int],
    constraints: np.ndarray,
) -> list[Limit]:
    """The limits of operands by name.

    operands: operands of a problem.
    lens: the lens, which names the surfaces.
    counts: numbers of "fields", "wavelengths", "distances", and of components "xy".
    sizes: number of constraints of each operand with a user's function; other numbers are not used.
    constraints: (L,), see `Operand.constraints`.
    """
    found: list[Limit] = []
    for operand, size in zip(operands, sizes, strict=True):
        for side in operand.sides:
            bound, weight = float(getattr(operand, side)), float(operand.weight)
            for where in _names(operand, lens, counts, size // len(operand.sides)):
                beyond = float(constraints[len(found)]) / weight
                found.append(Limit(operand.name, where, side, bound, beyond))
    return found


def refuse_fixed(
    limits: Callable[[Numbers], list[Limit]], constraints: Numbers, slopes: Numbers
) -> None:
    """Raises ValueError for a limit that is exceeded and that no variable moves.

    Its row of the Jacobian is 0 to rounding. Limits on rays are left out, because the violation by
    a failed ray does not change until the ray passes.

    limits: the limits by name of constraints, such as `Problem.limits`.
    constraints: (L,), constraints at a vector.
    slopes: (L, N), their derivatives there.
    """
    excess = np.asarray(constraints)
    steepest = np.max(np.abs(np.asarray(slopes)), axis=1, initial=0)
    fixed = (excess > 0) & np.isfinite(excess) & (steepest * _FAR < excess)
    for limit, is_fixed in zip(limits(excess) if fixed.any() else [], fixed):
        of_rays = limit.kind not in OPERANDS or "fields" in OPERANDS[limit.kind].names
        remedy = "leave this limit out, widen it, or vary what it depends on"
        require(of_rays or not is_fixed, f"operands: {limit}, and no variable moves it; {remedy}")


def _names(operand: Operand, lens: Lens, counts: dict[str, int], size: int) -> list[str]:
    """Names of the values of an operand, in their order. size: number of values of a user's
    function.
    """
    known = kind_of(operand.kind)
    parts: list[Iterable[str]] = []
    for axis in known.axes:
        if axis == "zones":
            parts.append([f"zone {zone:g}" for zone in ZONES])
        elif axis == "sections":
            parts.append(["tangential", "sagittal"])
        elif axis == "value":
            parts.append([f"value {k}" if size > 1 else "" for k in range(size)])
        elif axis == "xy":
            parts.append(["x", "y"] if counts["xy"] == 2 else [""])
        elif axis == "surfaces":
            named, surfaces_of = operand.surfaces, known.rows or known.places
            surfaces = surfaces_of(lens) if surfaces_of else []
            parts.append([f"surface {k}" for k in surfaces if not named or k in named])
        else:
            name = "wavelengths" if axis in ("middle", "later") else axis
            numbers = getattr(operand, name)
            if axis == "middle" and not numbers:
                continue
            numbers = (numbers or range(counts[name]))[axis == "later" :]
            one = counts[name] == 1
            parts.append(["" if one else f"{name[:-1]} {k}" for k in numbers])
    if operand.at is not None:
        parts.append([f"{known.at} {float(operand.at):g}"])
    return [", ".join(filter(None, words)) for words in itertools.product(*parts)]
