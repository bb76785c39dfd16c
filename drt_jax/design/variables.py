"""Variables: some numbers of a lens as a vector, with bounds, ties and solves."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require_one_of
from ..lens.lens import Lens
from .kinds import (
    KINDS,
    SERIES,
    VariableKind,
    back_distance,
    lift_of,
    step_of,
    whole_numbers,
    word_terms,
)
from .solves import Solve, fix_solves

_How = Literal["equal", "opposite", "cemented"]
# Typical change of a coefficient with a bound `sag`, relative to the bound.
_STEP_OF_SAG = 0.03
# The kinds that cemented neighbours share.
_SHAPE = ("curvature", "conic", "coefficients")
_WHY_NONE = {
    "coefficients": "the lens has none; write them into its prescription, zeros too",
    "phase": "the lens has none; write one into its prescription, zeros too",
    "thickness": "the lens has one surface; its distance to the sensor is the kind sensor",
    "index": "the lens has no model glass; write nd and vd into its prescription",
    "abbe": "the lens has no model glass; write nd and vd into its prescription",
}


class Place(NamedTuple):
    """One number of a lens: its kind, its row (mostly a surface) and its term within the row."""

    kind: str
    row: int
    term: int

    def __str__(self) -> str:
        term = f"[{self.term}]" if self.kind in (*SERIES, "tilt", "decentre") else ""
        return self.kind if self.kind == "sensor" else f"{self.kind} {self.row}{term}"


def _places(
    what: str, lens: Lens, kind: str, surfaces: tuple[int, ...], terms: tuple[int, ...] = ()
) -> list[Place]:
    """Places of a kind.

    ValueError, which begins with `what`, for a surface or term that does not exist; the message
    lists those that do.
    """
    known = KINDS[kind]
    allowed, count = known.allowed(lens), known.terms(lens)
    if not allowed or not count:
        raise ValueError(f"{what}: {kind}: {_WHY_NONE.get(kind, 'the lens has none')}")
    for name, named, possible in (("surface", surfaces, allowed), ("term", terms, range(count))):
        for number in named:
            if number not in possible:
                some = ", ".join(map(str, possible))
                raise ValueError(f"{what}: {kind}: no {name} {number}; there are {some}")
    return [
        Place(kind, row, term)
        for row in surfaces or known.rows(lens)
        for term in terms or word_terms(lens, kind, row)
    ]


@dataclasses.dataclass(frozen=True)
class Vary:
    """Variables of one kind, with bounds.

    kind: "curvature", "conic", "coefficients", "thickness" (behind a surface; the sensor keeps its
        distance from the last vertex), "sensor" (its distance from the last vertex), "index" and
        "abbe" of the model glass that begins behind a surface, "tilt", "decentre", "semi_diameter",
        or "phase" (coefficients of diffractive surfaces, waves / mm^power, see `Phase`).
    surfaces: numbers of surfaces from 0; () for all that have one (curvature, conic, coefficients,
        tilt, decentre: active surfaces; semi_diameter: finite ones; phase: those with one).
    terms: numbers of coefficients, or components of a tilt or decentre, from 0; () for all except
        the coefficient of r^2 of a surface, which the curvature replaces, and a norm radius.
    low, high: bounds in the units of the lens. A sensor without bounds stays on its side of the
        last vertex, so that a real image does not become a virtual one.
    scale: typical change in the units of the lens; 0 to choose it from the kind, the semi-diameter
        of the stop and `sag`.
    sag, semi_diameter: for coefficients, mm, instead of low and high: each coefficient changes the
        sag by at most `sag` at the distance `semi_diameter` from the axis, the largest beam of the
        design. This leaves low powers free and keeps high ones small. For a phase, `sag` is in
        waves.
    """

    kind: VariableKind
    surfaces: tuple[int, ...] = ()
    terms: tuple[int, ...] = ()
    low: float = -np.inf
    high: float = np.inf
    scale: float = 0.0
    sag: float = 0.0
    semi_diameter: float = 0.0

    def __post_init__(self) -> None:
        require_one_of("variables: kind", self.kind, KINDS)
        self._check_sag()
        for name in ("surfaces", "terms"):
            numbers = whole_numbers(f"variables: {self.kind}: {name}", getattr(self, name))
            object.__setattr__(self, name, numbers)
        if not self.low < self.high:
            raise ValueError(
                f"variables: {self.kind}: low {self.low:g} is not below high {self.high:g}; "
                "exchange them"
            )
        low, high = KINDS[self.kind].limits
        if not max(self.low, low) < min(self.high, high):
            raise ValueError(
                f"variables: {self.kind}: {self.low:g} to {self.high:g} lies outside of {low:g} "
                f"to {high:g}; widen it"
            )
        object.__setattr__(self, "low", max(self.low, low))
        object.__setattr__(self, "high", min(self.high, high))
        if not 0 <= self.scale < np.inf:
            raise ValueError(
                f"variables: {self.kind}: scale: must be above 0, or 0 to have it chosen, "
                f"got {self.scale:g}"
            )

    def _check_sag(self) -> None:
        """Raises ValueError for `sag` and `semi_diameter` that do not fit together or the kind."""
        pair = self.sag, self.semi_diameter
        if pair == (0, 0):
            return
        what = "variables: sag and semi_diameter"
        if self.kind not in SERIES:
            raise ValueError(f"{what}: are of coefficients, not of {self.kind}; give low and high")
        if not all(0 < number < np.inf for number in pair):
            raise ValueError(f"{what}: give both, above 0 mm, got {pair[0]:g} and {pair[1]:g}")
        if (self.low, self.high) != (-np.inf, np.inf):
            raise ValueError(f"{what}: stand instead of low and high; leave these out")

    def bounds(self, lens: Lens, place: Place) -> tuple[float, float, float]:
        """Low bound, high bound and scale of one variable, in the units of the lens."""
        if not self.sag:
            low, high = self.low, self.high
            if self.kind == "sensor" and (low, high) == (-np.inf, np.inf):
                behind = float(back_distance(lens))
                low, high = (0.0 if behind > 0 else low), (0.0 if behind < 0 else high)
            return low, high, self.scale or step_of(lens, *place)
        most = self.sag / lift_of(lens, self.kind, place.row, place.term, self.semi_diameter)
        return -most, most, self.scale or _STEP_OF_SAG * most

    def places(self, lens: Lens) -> list[Place]:
        """The places of the variables. ValueError for a surface or term that does not exist."""
        return _places("variables", lens, self.kind, self.surfaces, self.terms)


@dataclasses.dataclass(frozen=True)
class Tie:
    """A tie of numbers of several surfaces: followers = scale x leader + shift.

    surfaces: numbers of two or more surfaces; the first is the leader.
    how: "equal", "opposite" (with the other sign), or "cemented" (two neighbours of one shape).
    kind: kind of the numbers, see `Vary`; not used by "cemented", which ties the whole shape.
    scale: factor, not 0; not for "cemented".
    shift: added to the followers, in the unit of the kind; not for "cemented".
    """

    surfaces: tuple[int, ...]
    how: _How = "equal"
    kind: VariableKind | Literal["cemented"] = "curvature"
    scale: float = 1.0
    shift: float = 0.0

    def __post_init__(self) -> None:
        require_one_of("ties: how", self.how, get_args(_How))
        require_one_of("ties: kind", self.kind, KINDS)
        numbers = whole_numbers("ties: surfaces", self.surfaces)
        object.__setattr__(self, "surfaces", numbers)
        if len(numbers) < 2 or len(set(numbers)) < len(numbers):
            raise ValueError(f"ties: expected two or more different surfaces, got {numbers}")
        if self.how == "cemented" and (len(numbers) != 2 or abs(numbers[0] - numbers[1]) != 1):
            raise ValueError(f"ties: cemented: expected two neighbours, got {numbers}")
        if self.how == "cemented" and (self.scale, self.shift) != (1, 0):
            raise ValueError("ties: cemented: takes neither scale nor shift; leave them out")
        if not (math.isfinite(self.scale) and self.scale and math.isfinite(self.shift)):
            raise ValueError(
                f"ties: expected a scale that is not 0 and a shift, got {self.scale:g} and "
                f"{self.shift:g}"
            )

    @property
    def line(self) -> tuple[float, float]:
        """Factor and shift of the followers; the factor is negative for "opposite"."""
        return (-self.scale if self.how == "opposite" else self.scale), self.shift

    def pairs(self, lens: Lens) -> list[tuple[Place, Place]]:
        """Pairs of a leader and a follower. ValueError as in `Vary.places`."""
        first, *others = self.surfaces
        kinds: tuple[str, ...] = (self.kind,)
        if self.how == "cemented":
            kinds = tuple(kind for kind in _SHAPE if KINDS[kind].terms(lens))
            if lens.forms[first] != lens.forms[others[0]]:
                raise ValueError(
                    f"ties: cemented: surfaces {first} and {others[0]} are of the forms "
                    f"{lens.forms[first]} and {lens.forms[others[0]]}; write both alike"
                )
        terms = {kind: tuple(range(KINDS[kind].terms(lens))) for kind in kinds}
        rows = {kind: _places("ties", lens, kind, self.surfaces, terms[kind]) for kind in kinds}
        return [
            (leader, follower)
            for places in rows.values()
            for leader in places
            for follower in places
            if leader.row == first and follower.row != first and leader.term == follower.term
        ]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Variables:
    """N numbers of a lens as a vector, each in units of its scale.

    lens: the lens at the start; all other numbers stay as they are in it.
    low, high: (N,), bounds of the vector.
    scale: (N,), in the units of the lens.
    solves: the solves, in the order in which they are applied.
    lines: (T, 2), factor and shift of each tie.

    Static:
    places: N places in the lens.
    ties: T pairs of the index of a leader and the place of a follower.
    """

    lens: Lens
    low: Array
    high: Array
    scale: Array
    solves: tuple[Solve, ...]
    lines: Array
    places: tuple[Place, ...] = dataclasses.field(metadata={"static": True})
    ties: tuple[tuple[int, Place], ...] = dataclasses.field(metadata={"static": True})

    @classmethod
    def from_lens(
        cls,
        lens: Lens,
        vary: Sequence[Vary | VariableKind],
        ties: Sequence[Tie] = (),
        solves: Sequence[Solve] = (),
    ) -> "Variables":
        """Makes the variables of a lens.

        lens: the lens at the start.
        vary: variables; the name of a kind stands for all variables of that kind.
        ties: numbers that follow a variable, or a number that does not change.
        solves: conditions that hold exactly.

        ValueError, which begins with the name of the argument, for a number that does not exist, is
        named twice, or is both a variable and solved; and as in `Lens.check`.
        """
        lens.check()
        varied = [Vary(v) if isinstance(v, str) else v for v in vary]
        found = [(place, v) for v in varied for place in v.places(lens)]
        following = [(p, f, t.line) for t in ties for p, f in t.pairs(lens)]
        solved = [Place(*solve.place(lens)) for solve in solves]
        taken = {*(f for _, f, _ in following), *solved}
        _refuse_twice("solves", solved, "is what two of them change")
        _refuse_twice("ties", [f for _, f, _ in following] + solved, "follows twice")
        for leader, follower, _ in following:
            if leader in taken:
                raise ValueError(
                    f"ties: {leader}, which {follower} follows, itself follows from a tie or a "
                    "solve; begin with another surface"
                )
        # If all numbers of a kind vary, tied and solved ones are left out. Naming one is an error.
        for place, v in found:
            if place in taken and v.surfaces:
                raise ValueError(
                    f"variables: {place} follows from a tie or a solve; leave it out here"
                )
        found = [(place, v) for place, v in found if place not in taken]
        _refuse_twice("variables", [place for place, _ in found], "stands twice")
        if not found:
            more = "fewer solves or more variables are needed" if solves else "name some"
            raise ValueError(f"variables: none is left; {more}")
        if len(solves) > len(found):
            raise ValueError(
                f"solves: {len(solves)} of them, but {len(found)} variables; leave some out"
            )
        index = {place: k for k, (place, _) in enumerate(found)}
        # Followers of a number that does not vary are set once, here.
        fixed = [(f, a * _number(lens, p) + b) for p, f, (a, b) in following if p not in index]
        lens = _with_numbers(_with_arrays(lens, {place.kind for place, _ in found}), fixed)
        dtype = lens.curvature.dtype
        rows = np.array([v.bounds(lens, place) for place, v in found])
        bounds, scale = np.split(rows, [2], axis=1)
        low, high = jnp.asarray(bounds / scale, dtype).T
        tied = [(index[p], f, line) for p, f, line in following if p in index]
        lines = jnp.asarray([line for *_, line in tied], dtype).reshape(-1, 2)
        places, ties_ = tuple(place for place, _ in found), tuple(tie[:2] for tie in tied)
        scales = jnp.asarray(scale[:, 0], dtype)
        variables = cls(lens, low, high, scales, (), lines, places, ties_)
        fixed_solves, start = fix_solves(variables.lens_of(variables.start), solves)
        return dataclasses.replace(variables, lens=start, solves=fixed_solves)

    @classmethod
    def joined(cls, sets: "Variables | Sequence[Variables]") -> "Variables":
        """Joins several sets of variables of one lens.

        ValueError for no set, for something that is not a set, for sets of different lenses, and
        for a number that varies or follows twice.
        """
        if isinstance(sets, Variables):
            return sets
        found = list(sets) if isinstance(sets, Sequence) else [sets]
        if not found or not all(isinstance(own, Variables) for own in found):
            raise ValueError("variables: expected Variables.from_lens(lens, [...]), or several")
        kinds, lenses = {place.kind for own in found for place in own.places}, []
        for each in found:
            lens = _with_arrays(each.lens, kinds)
            for own in found:  # ties and solves have changed the lens of each set
                lens = dataclasses.replace(own, lens=lens).lens_of(own.start)
            lenses.append(lens)
        for lens in lenses[1:]:
            if not _same(lenses[0], lens):
                raise ValueError("variables: of different lenses; make them from one lens")
        taken = [*(p for own in found for p in own.places), *(p for s in found for _, p in s.ties)]
        _refuse_twice("variables", taken, "stands twice")
        ends = np.cumsum([0, *(len(own.places) for own in found)]).tolist()

        def both(name: str) -> Any:
            return jnp.concatenate([getattr(own, name) for own in found])

        return dataclasses.replace(
            found[0],
            lens=lenses[0],
            **{name: both(name) for name in ("low", "high", "scale", "lines")},
            solves=tuple(solve for own in found for solve in own.solves),
            places=tuple(place for own in found for place in own.places),
            ties=tuple((k + end, p) for end, own in zip(ends, found) for k, p in own.ties),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the variables, such as "curvature 3"."""
        return tuple(map(str, self.places))

    @property
    def start(self) -> Array:
        """The vector (N,) of the lens at the start, within its bounds."""
        return jnp.clip(self.vector(self.lens), self.low, self.high)

    def vector(self, lens: Lens) -> Array:
        """The vector (N,) of a lens."""
        return jnp.stack([_number(lens, place) for place in self.places]) / self.scale

    def numbers(self, vector: Array) -> Array:
        """The numbers (N,) of a vector (N,), in the units of the lens."""
        return vector * self.scale

    def lens_of(self, vector: Array) -> Lens:
        """The lens of a vector, with ties and solves applied. Bounds are not applied.

        Works in `jit`, `vmap` and under differentiation.

        vector: (N,), in units of the scales.
        """
        numbers = self.numbers(vector)
        changes = [(place, numbers[k]) for k, place in enumerate(self.places)]
        pairs = zip(self.ties, self.lines, strict=True)
        changes += [(place, line[0] * numbers[k] + line[1]) for (k, place), line in pairs]
        lens = _with_numbers(self.lens, changes)
        for solve in self.solves:
            lens = solve.apply(lens)
        return lens


def _number(lens: Lens, place: Place) -> Array:
    """The number () of a lens at a place."""
    return KINDS[place.kind].read(lens)[place.row, place.term]


def _with_numbers(lens: Lens, changes: Sequence[tuple[Place, Array]]) -> Lens:
    """The lens with changed numbers.

    Thicknesses are written before the sensor, whose distance counts from the last vertex.
    """
    for name, kind in KINDS.items():
        own = [(place, number) for place, number in changes if place.kind == name]
        if own:
            rows, terms = (np.array([place[k] for place, _ in own]) for k in (1, 2))
            numbers = jnp.stack([number for _, number in own])
            lens = kind.write(lens, kind.read(lens).at[rows, terms].set(numbers))
    return lens


def _same(one: Lens, two: Lens) -> bool:
    """Whether two lenses with known numbers are equal."""
    alike = str(jax.tree.structure(one)) == str(jax.tree.structure(two))
    return alike and all(map(np.array_equal, jax.tree.leaves(one), jax.tree.leaves(two)))


def _refuse_twice(what: str, places: Iterable[Place], reason: str) -> None:
    """Raises ValueError for a place that occurs twice."""
    for place, group in itertools.groupby(sorted(places)):
        if len(list(group)) > 1:
            raise ValueError(f"{what}: {place} {reason}; leave one out")


def _with_arrays(lens: Lens, kinds: set[str]) -> Lens:
    """The lens with arrays of zeros for tilts and decentres that vary but are None."""
    for kind in kinds & {"tilt", "decentre"}:
        lens = KINDS[kind].write(lens, KINDS[kind].read(lens))
    return lens
