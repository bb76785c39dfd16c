"""What may be off in a lens as it is made: kinds of errors, how large, and of which parts."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens

# Forms whose first coefficient is the curvature along x.
WITH_X = ("biconic", "toroid")


class Kind(NamedTuple):
    """A kind of error: of what, whether in x and y, in which unit, and how large it may be."""

    whole: str
    axes: int
    unit: str
    most: float = math.inf


# As the keys of `KINDS`, which a test compares.
ToleranceKind = Literal[
    "radius", "fringes", "irregularity", "wedge", "thickness", "index", "abbe", "shift",
    "tilt"
]  # fmt: skip
KINDS = {
    "radius": Kind("surface", 1, "%", 100),
    "fringes": Kind("surface", 1, "fringes"),
    "irregularity": Kind("surface", 1, "fringes"),
    "wedge": Kind("surface", 2, "arc min"),
    "thickness": Kind("surface", 1, "mm"),
    "index": Kind("surface", 1, ""),
    "abbe": Kind("surface", 1, "%", 100),
    "shift": Kind("element", 2, "mm"),
    "tilt": Kind("element", 2, "arc min"),
}


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """By how much parts of a kind may be off, to either side.

    kind: of surfaces "radius", that of the vertex, in per cent; "fringes", another curvature, told
        by how far the rim of the light is off along the normal; "irregularity", a cylinder, in
        fringes between both directions, half of them along y and minus half along x; "wedge", a
        tilt, in arc minutes about x and y. Behind surfaces "thickness" in mm, "index" (of the line
        d) and "abbe" in per cent. Of elements "shift" across the axis in mm, along x and y, and
        "tilt" about their first vertex in arc minutes, about x and y. A fringe is half a wave of
        546 nm.
    size: the largest error, in these units.
    which: surfaces or elements, from 0; empty: all that there are.
    """

    kind: ToleranceKind
    size: float
    which: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"tolerances: unknown kind {self.kind!r}; known: {', '.join(KINDS)}")
        most = KINDS[self.kind].most
        if not 0 < self.size < most:
            below = "" if math.isinf(most) else f" and below {most:g}"
            raise ValueError(
                f"tolerances: {self.kind}: size: must be above 0{below}, got {self.size:g}"
            )


class Deviation(NamedTuple):
    """One number that may be off: what, where (a surface or an element), and its component."""

    kind: str
    place: int
    axis: int

    def __str__(self) -> str:
        kind = KINDS[self.kind]
        axis = f", {'xy'[self.axis]}" if kind.axes > 1 else ""
        return f"{self.kind} of {kind.whole} {self.place}{axis}"


def _solid(lens: Lens, medium: int) -> bool:
    return lens.glasses[medium] not in ("air", lens.glasses[0])


def elements_of(lens: Lens) -> tuple[tuple[int, int], ...]:
    """First and last surface of each element: neighbours that bend light, with glass between them,
    cemented ones together; a mirror in air is one."""
    spans: list[tuple[int, int]] = []
    for i in lens.active:
        if spans and _solid(lens, i):
            spans[-1] = (spans[-1][0], i)
        else:
            spans.append((i, i))
    return tuple(spans)


def pieces_of(lens: Lens) -> dict[int, tuple[int, ...]]:
    """The media that each piece of glass is, by the surface before it: several where a mirror sends
    light back into it, or a surface in it bends none."""
    pieces: dict[int, tuple[int, ...]] = {}
    for i in range(lens.count):
        inside = lens.mirrors[i] or i not in lens.active
        if not _solid(lens, i + 1):
            continue
        if pieces and inside and _solid(lens, i):
            first, media = pieces.popitem()
            pieces[first] = (*media, i + 1)
        else:
            pieces[i] = (i + 1,)
    return pieces


def x_curvatures(lens: Lens, at: np.ndarray) -> Array:
    """Curvatures along x of some surfaces, 1/mm, where they have one of their own; else 0."""
    has = np.array([lens.forms[i] in WITH_X for i in at])
    if not has.any():
        return jnp.zeros(len(at), lens.curvature.dtype)
    return jnp.where(has, lens.coefficients[at, 0], 0)


def deviations_of(lens: Lens, tolerances: Sequence[Tolerance]) -> dict[Deviation, float]:
    """The errors that some tolerances allow, and how large each may be, in the units of
    `Tolerance`; those in x and in y of one part are neighbours.

    ValueError, which lists what there is, for none, and for a part that does not exist or stands
    twice.
    """
    sizes: dict[Deviation, float] = {}
    for tolerance in tolerances:
        kind = tolerance.kind
        there = _there(lens, kind)
        if not there:
            raise ValueError(f"tolerances: {kind}: {_NONE.get(kind, 'the lens has none')}")
        for place in tolerance.which:
            if place not in there:
                raise ValueError(
                    f"tolerances: {kind}: no {KINDS[kind].whole} {place} that could be off; "
                    f"there are {', '.join(map(str, there))}"
                )
        axes = range(KINDS[kind].axes)
        for place, axis in itertools.product(tolerance.which or there, axes):
            error = Deviation(kind, place, axis)
            if error in sizes:
                raise ValueError(f"tolerances: {error} stands twice; leave one out")
            sizes[error] = tolerance.size
    if not sizes:
        raise ValueError("tolerances: none; name at least one")
    return sizes


_NONE = {
    "radius": "no surface is curved; of planes, tolerance fringes",
    "irregularity": "no surface is a sphere, a conic, an even asphere or has one more curvature",
    "thickness": "there is one surface; none has a thickness behind it",
    "index": "the lens has no glass",
    "abbe": "the lens has no glass",
}


def _there(lens: Lens, kind: str) -> list[int]:
    """The numbers of the surfaces or elements that may be off."""
    active = list(lens.active)
    if KINDS[kind].whole == "element":
        return list(range(len(elements_of(lens))))
    if kind == "thickness":
        return list(range(lens.count - 1))
    if kind in ("index", "abbe"):
        return list(pieces_of(lens))
    if kind == "radius":
        curved = np.asarray(lens.curvature) != 0
        curved[:-1] |= np.asarray(x_curvatures(lens, np.arange(lens.count))) != 0
        return [i for i in active if curved[i]]
    if kind == "irregularity":
        return [i for i in active if lens.forms[i] in ("asphere", *WITH_X)]
    return active
