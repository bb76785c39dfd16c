"""A lens as built: tolerances, and the deviations of its parts as a vector."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require, require_one_of
from ..lens.elements import Elements
from ..lens.lens import Lens
from .deviations import KINDS, Errors, ToleranceKind
from .media import elements_of
from .parts import with_arrays


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """Largest deviation of parts of one kind, in both directions.

    kind: one of the following. A fringe is half a wave of 546 nm.
        Of surfaces: "radius", of the vertex, per cent; "fringes", a change of curvature, measured
        along the normal at the rim of the beam; "irregularity", a cylinder, in fringes between both
        directions (half of them along y, and minus half of them along x); "wedge", a tilt about x
        and y, arc minutes.
        Behind surfaces: "thickness", mm; "index", of the d line; "abbe", per cent.
        Of elements: "decentre" along x and y, mm; "tilt" about x and y through the first vertex,
        arc minutes.
        Of the sensor: "sensor", its distance, mm; "sensor tilt" about x and y, arc minutes.
    size: largest deviation, in these units.
    which: numbers of surfaces or elements, from 0; () for all that have this kind of deviation.
    own: True if the deviation of each configuration is its own, such as that of a gap which a cam
        sets in each position of a zoom; False for one that all configurations share.
    """

    kind: ToleranceKind
    size: float
    which: tuple[int, ...] = ()
    own: bool = False

    def __post_init__(self) -> None:
        require_one_of("tolerances: kind", self.kind, KINDS)
        most = KINDS[self.kind].most
        below = "" if math.isinf(most) else f" and below {most:g}"
        what = f"tolerances: {self.kind}: size: must be above 0{below}, got {self.size:g}"
        require(0 < self.size < most, what)


class Deviation(NamedTuple):
    """One number of a lens that deviates.

    kind: as in `Tolerance`.
    place: number of the surface or element.
    axis: component, 0 for x, 1 for y; 0 for a kind without components.
    configuration: index of the only configuration that deviates, whose name counts from 1; None
        if all do.
    """

    kind: str
    place: int
    axis: int
    configuration: int | None = None

    def __str__(self) -> str:
        kind = KINDS[self.kind]
        axis = f", {'xy'[self.axis]}" if kind.axes > 1 else ""
        place = "" if kind.whole == "sensor" else f" of {kind.whole} {self.place}"
        own = "" if self.configuration is None else f" of configuration {self.configuration + 1}"
        return f"{self.kind}{place}{axis}{own}"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PerturbedLens:
    """A lens with P deviations, in one configuration or in several.

    lens: the nominal lens, with all arrays that the deviations need; of several configurations the
        first.
    beam_radius: (S,), radius of the beam footprint on each surface, mm.
    sizes: (P,), largest deviations, in the units of `Tolerance`.
    others: nominal lenses of the other configurations.

    Static:
    deviations: the P deviations; the components x and y of one part follow each other.
    spans: first and last surface of each element.
    groups: index of each element in `lens.elements`.
    """

    lens: Lens
    beam_radius: Array
    sizes: Array
    deviations: tuple[Deviation, ...] = dataclasses.field(metadata={"static": True})
    spans: tuple[tuple[int, int], ...] = dataclasses.field(metadata={"static": True})
    groups: tuple[int, ...] = dataclasses.field(metadata={"static": True}, default=())
    others: tuple[Lens, ...] = ()

    @classmethod
    def from_lens(
        cls, lens: Lens | Sequence[Lens], beam_radius: Array, tolerances: Sequence[Tolerance]
    ) -> "PerturbedLens":
        """The lens with the deviations that tolerances allow.

        lens: the nominal lens; for several configurations a sequence of lenses with the same parts.
        beam_radius: (S,), mm, for instance that of `Problem.beam_radius` or, the largest of all,
            of `Configurations.beam_radius`.
        tolerances: the tolerances.

        ValueError for no tolerance, for a part that does not exist (the message lists those that
        do) or is named twice, and for configurations of other surfaces or elements.
        """
        lens, *others = [lens] if isinstance(lens, Lens) else lens
        shape = np.shape(beam_radius)
        require(shape == (lens.count,), f"beam_radius: expected ({lens.count},), got shape {shape}")
        sizes: dict[Deviation, float] = {}
        for tolerance in tolerances:
            for deviation in _deviations_of(lens, tolerance, 1 + len(others)):
                what = f"tolerances: {deviation} is named twice; remove one"
                require(deviation not in sizes, what)
                sizes[deviation] = tolerance.size
        require(sizes, "tolerances: none; name at least one")
        spans, dtype = elements_of(lens), lens.curvature.dtype
        (lens, groups), *more = (_with_parts(one, spans, sizes) for one in (lens, *others))
        structure: Any = jax.tree.structure(lens)
        for number, (other, own) in enumerate(more, start=2):
            same = structure == jax.tree.structure(other) and elements_of(other) == spans
            what = f"lens: configuration {number} differs from 1 in more than numbers (surfaces,"
            what = f"{what} elements, tilts that only one has); make them by `configured`"
            require(same and own == groups, what)
        numbers = jnp.asarray(beam_radius, dtype), jnp.asarray([*sizes.values()], dtype)
        rest = tuple(other for other, _ in more)
        return cls(lens, *numbers, tuple(sizes), spans, groups, rest)

    def around(self, *lenses: Lens) -> "PerturbedLens":
        """The same deviations about another nominal lens with the same surfaces; for several
        configurations about a sequence of lenses. Works in `jit`."""
        first, *others = (_with_parts(lens, self.spans, self.deviations)[0] for lens in lenses)
        return dataclasses.replace(self, lens=first, others=tuple(others))

    @property
    def lenses(self) -> tuple[Lens, ...]:
        """The nominal lens of each configuration."""
        return self.lens, *self.others

    @property
    def parts(self) -> list[list[int]]:
        """Indices of the deviations of each part: one index, or two for the components x and y."""
        parts: dict[tuple, list[int]] = {}
        for k, error in enumerate(self.deviations):
            parts.setdefault((*error[:2], error.configuration), []).append(k)
        return list(parts.values())

    def lens_of(self, perturbation: Array) -> Lens:
        """The lens with a perturbation.

        Works in `jit`, `vmap` and under differentiation.

        perturbation: (P,), deviations in units of their largest.
        """
        return self.lenses_of(perturbation)[0]

    def lenses_of(self, perturbation: Array) -> list[Lens]:
        """The lens of each configuration with a perturbation (P,), as `lens_of`."""
        by = perturbation * self.sizes
        return [self._disturbed(lens, number, by) for number, lens in enumerate(self.lenses)]

    def _disturbed(self, nominal: Lens, number: int, by: Array) -> Lens:
        """The nominal lens of a configuration with deviations (P,), in the units of `Tolerance`."""
        lens = nominal
        kinds: dict[str, list[int]] = {}
        for k, error in enumerate(self.deviations):
            if error.configuration in (None, number):
                kinds.setdefault(error.kind, []).append(k)
        for kind, own in kinds.items():
            at, axis = np.array([self.deviations[k][1:3] for k in own]).T
            at = np.array(self.groups)[at] if KINDS[kind].whole == "element" else at
            errors = Errors(nominal, self.beam_radius, at, axis, by[np.array(own)])
            lens = KINDS[kind].change(lens, errors)
        return lens


def _deviations_of(lens: Lens, tolerance: Tolerance, configurations: int) -> list[Deviation]:
    """The deviations that one tolerance allows; see `PerturbedLens.from_lens`."""
    kind = KINDS[tolerance.kind]
    possible, what = kind.places(lens), f"tolerances: {tolerance.kind}"
    require(possible, f"{what}: {kind.why_none}")
    some = ", ".join(map(str, possible))
    for place in tolerance.which:
        require(place in possible, f"{what}: no {kind.whole} {place} can deviate; there are {some}")
    each = range(configurations) if tolerance.own and configurations > 1 else [None]
    places = itertools.product(each, tolerance.which or possible, range(kind.axes))
    return [Deviation(tolerance.kind, place, axis, only) for only, place, axis in places]


def _with_parts(
    lens: Lens, spans: tuple[tuple[int, int], ...], deviations: Iterable[Deviation]
) -> tuple[Lens, tuple[int, ...]]:
    """The same lens with all arrays that deviations need; and the groups of its elements, see
    `PerturbedLens`."""
    kinds, groups = {deviation.kind for deviation in deviations}, tuple[int, ...]()
    if any(KINDS[kind].whole == "element" for kind in kinds):
        lens, groups = _with_elements(lens, spans)
    if kinds & {"wedge", "sensor tilt"}:
        lens = with_arrays(lens, ["tilt"])
    if "irregularity" in kinds:
        lens = _with_cylinders(lens)
    return lens, groups


def _with_elements(lens: Lens, spans: tuple[tuple[int, int], ...]) -> tuple[Lens, tuple[int, ...]]:
    """The same lens with a group for each element, and the indices of these groups.

    Groups that the lens already has are kept, inside of the new ones or around them.
    """
    zero, old = jnp.zeros(3, lens.curvature.dtype), lens.elements
    new = [(span, span[0], zero, zero, zero[0]) for span in spans]
    kept = [] if old is None else [*zip(old.spans, old.about, old.shift, old.tilt, old.pivot)]
    for ((a, b), *_), (first, last) in itertools.product(kept, spans):
        what = f"tolerances: the element of surfaces {first} to {last} is cut by that of the"
        what = f"{what} lens file, {a} to {b}; put one inside the other, or apart"
        require(not (a < first <= b < last or first < a <= last < b), what)
    # A group comes before the groups inside it.
    groups = sorted([*kept, *new], key=lambda group: (group[0][0], -group[0][1]))
    where, about, *arrays = zip(*groups)
    shift, tilt, pivot = map(jnp.stack, arrays)
    elements = Elements(shift, tilt, pivot, where, about)
    order = [id(group) for group in groups]
    return dataclasses.replace(lens, elements=elements), tuple(order.index(id(g)) for g in new)


def _with_cylinders(lens: Lens) -> Lens:
    """The same lens with every asphere as a biconic of equal curvatures."""
    round_ = np.array([form == "asphere" for form in lens.forms])
    own = jnp.stack([lens.curvature, lens.conic], axis=1)
    wide = jnp.concatenate([own, lens.coefficients], axis=1)
    narrow = jnp.concatenate([lens.coefficients, jnp.zeros_like(own)], axis=1)
    wide = jnp.where(round_[:, None], wide, narrow)
    forms = tuple("biconic" if r else form for r, form in zip(round_, lens.forms))
    return dataclasses.replace(lens, coefficients=wide, forms=forms)
