"""Tolerances and deviations of a lens as built: their kinds, sizes and the parts that have them."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require_one_of
from ..lens.lens import Lens

# Forms whose first coefficient is the curvature along x.
WITH_X = ("biconic", "toroid")


class Kind(NamedTuple):
    """A kind of deviation.

    whole: what deviates, a "surface" or an "element".
    axes: number of components, 2 for x and y.
    unit: unit of the deviation.
    most: upper bound of the size, in that unit.
    """

    whole: str
    axes: int
    unit: str
    most: float = math.inf


# The keys of `KINDS`; a test compares them.
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
    """Largest deviation of parts of one kind, in both directions.

    kind: one of the following. A fringe is half a wave of 546 nm.
        Of surfaces: "radius", of the vertex, per cent; "fringes", a change of curvature, measured
        along the normal at the rim of the beam; "irregularity", a cylinder, in fringes between both
        directions (half of them along y, and minus half of them along x); "wedge", a tilt about x
        and y, arc minutes.
        Behind surfaces: "thickness", mm; "index", of the d line; "abbe", per cent.
        Of elements: "shift" along x and y, mm; "tilt" about x and y through the first vertex, arc
        minutes.
    size: largest deviation, in these units.
    which: numbers of surfaces or elements, from 0; () for all that have this kind of deviation.
    """

    kind: ToleranceKind
    size: float
    which: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        require_one_of("tolerances: kind", self.kind, KINDS)
        most = KINDS[self.kind].most
        if not 0 < self.size < most:
            below = "" if math.isinf(most) else f" and below {most:g}"
            raise ValueError(
                f"tolerances: {self.kind}: size: must be above 0{below}, got {self.size:g}"
            )


class Deviation(NamedTuple):
    """One number of a lens that deviates.

    kind: as in `Tolerance`.
    place: number of the surface or element.
    axis: component, 0 for x, 1 for y; 0 for a kind without components.
    """

    kind: str
    place: int
    axis: int

    def __str__(self) -> str:
        kind = KINDS[self.kind]
        axis = f", {'xy'[self.axis]}" if kind.axes > 1 else ""
        return f"{self.kind} of {kind.whole} {self.place}{axis}"


def _solid(lens: Lens, medium: int) -> bool:
    """Whether a medium is neither air nor the medium in front of the lens."""
    return lens.glasses[medium] not in ("air", lens.glasses[0])


def elements_of(lens: Lens) -> tuple[tuple[int, int], ...]:
    """First and last surface of each element: neighbouring active surfaces with glass between them.

    Cemented elements count as one. A mirror in air is an element of one surface.
    """
    spans: list[tuple[int, int]] = []
    for i in lens.active:
        if spans and _solid(lens, i):
            spans[-1] = (spans[-1][0], i)
        else:
            spans.append((i, i))
    return tuple(spans)


def pieces_of(lens: Lens) -> dict[int, tuple[int, ...]]:
    """The media of each piece of glass, by the surface in front of it.

    A piece has several media if a mirror sends light back into it, or if a surface inside of it is
    not active.
    """
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
    """Curvatures along x of the surfaces `at`, 1/mm; 0 for a form without a separate curvature
    along x.
    """
    has = np.array([lens.forms[i] in WITH_X for i in at])
    if not has.any():
        return jnp.zeros(len(at), lens.curvature.dtype)
    return jnp.where(has, lens.coefficients[at, 0], 0)


def deviations_of(lens: Lens, tolerances: Sequence[Tolerance]) -> dict[Deviation, float]:
    """The deviations that tolerances allow, with the largest size of each.

    Sizes are in the units of `Tolerance`. The components x and y of one part follow each other.

    ValueError for no tolerance, for a part that does not exist (the message lists those that do),
    and for a part that is named twice.
    """
    sizes: dict[Deviation, float] = {}
    for tolerance in tolerances:
        kind = tolerance.kind
        possible = _possible_places(lens, kind)
        if not possible:
            raise ValueError(f"tolerances: {kind}: {_WHY_NONE.get(kind, 'the lens has none')}")
        for place in tolerance.which:
            if place not in possible:
                raise ValueError(
                    f"tolerances: {kind}: no {KINDS[kind].whole} {place} can deviate; "
                    f"there are {', '.join(map(str, possible))}"
                )
        axes = range(KINDS[kind].axes)
        for place, axis in itertools.product(tolerance.which or possible, axes):
            deviation = Deviation(kind, place, axis)
            if deviation in sizes:
                raise ValueError(f"tolerances: {deviation} is named twice; remove one")
            sizes[deviation] = tolerance.size
    if not sizes:
        raise ValueError("tolerances: none; name at least one")
    return sizes


_WHY_NONE = {
    "radius": "no surface is curved; for planes use fringes",
    "irregularity": "no surface is a sphere, conic, even asphere, biconic or toroid",
    "thickness": "the lens has one surface, without a thickness behind it",
    "index": "the lens has no glass",
    "abbe": "the lens has no glass",
}


def _possible_places(lens: Lens, kind: str) -> list[int]:
    """Numbers of the surfaces or elements that can have deviations of a kind."""
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
