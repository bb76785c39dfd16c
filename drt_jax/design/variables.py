"""Variables: some numbers of a lens as a vector, with bounds, ties and solves."""

import collections
import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require, require_one_of, whole_numbers
from ..lens.lens import Lens
from ..lens.temperature import ThermalModel, at_temperature
from ..numerics import Numbers, concrete
from .media import back_distance
from .parts import (
    PARTS,
    SERIES,
    Place,
    VariableKind,
    lift_of,
    number_at,
    places_of,
    step_of,
    with_arrays,
    with_numbers,
)
from .solves import Solve, fix_solves

_How = Literal["equal", "opposite", "cemented"]
# Typical change of a coefficient with a bound `sag`, relative to the bound.
_STEP_OF_SAG = 0.03
# Most numbers of a kind in a line of text.
_MOST_TOLD = 8
_UNITS = {
    "curvature": "1/mm",
    "coefficients": "mm^(1 - power)",
    "tilt": "radians",
    "phase": "waves/mm^power",
} | dict.fromkeys(("thickness", "sensor", "decentre", "semi_diameter"), "mm")
# The parts that cemented neighbours share.
_SHAPE = ("curvature", "conic", "coefficients")


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
        require_one_of("variables: kind", self.kind, PARTS)
        what = f"variables: {self.kind}"
        for name in ("surfaces", "terms"):
            object.__setattr__(self, name, whole_numbers(f"{what}: {name}", getattr(self, name)))
        order = f"low {self.low:g} is not below high {self.high:g}; exchange them"
        require(self.low < self.high, f"{what}: {order}")
        size = f"scale: must be above 0, or 0 to have it chosen, got {self.scale:g}"
        require(0 <= self.scale < np.inf, f"{what}: {size}")
        pair, both = (self.sag, self.semi_diameter), "variables: sag and semi_diameter"
        if pair != (0, 0):
            series = self.kind in SERIES
            require(series, f"{both}: are of coefficients, not of {self.kind}; give low and high")
            given = all(0 < number < np.inf for number in pair)
            require(given, f"{both}: give both, above 0 mm, got {pair[0]:g} and {pair[1]:g}")
            free = (self.low, self.high) == (-np.inf, np.inf)
            require(free, f"{both}: replace low and high; leave these out")
        least, most = PARTS[self.kind].limits
        low, high = max(self.low, least), min(self.high, most)
        between = f"{self.low:g} to {self.high:g} lies outside of {least:g} to {most:g}"
        require(low < high, f"{what}: {between}; widen it")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def bounds(self, lens: Lens, place: Place) -> tuple[float, float, float]:
        """Low bound, high bound and scale of one variable, in the units of the lens."""
        if not self.sag:
            low, high = self.low, self.high
            if self.kind == "sensor" and (low, high) == (-np.inf, np.inf):
                behind = float(back_distance(lens))
                low, high = (0.0 if behind > 0 else low), (0.0 if behind < 0 else high)
            return low, high, self.scale or step_of(lens, place)
        most = self.sag / lift_of(lens, place, self.semi_diameter)
        return -most, most, self.scale or _STEP_OF_SAG * most

    def places(self, lens: Lens) -> list[Place]:
        """The places of the variables. ValueError for a surface or term that does not exist."""
        return places_of("variables", lens, self.kind, self.surfaces, self.terms)


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
    kind: VariableKind = "curvature"
    scale: float = 1.0
    shift: float = 0.0

    def __post_init__(self) -> None:
        require_one_of("ties: how", self.how, get_args(_How))
        require_one_of("ties: kind", self.kind, PARTS)
        numbers = whole_numbers("ties: surfaces", self.surfaces)
        object.__setattr__(self, "surfaces", numbers)
        several = len(numbers) >= 2 and len(set(numbers)) == len(numbers)
        require(several, f"ties: expected two or more different surfaces, got {numbers}")
        if self.how == "cemented":
            neighbours = len(numbers) == 2 and abs(numbers[0] - numbers[1]) == 1
            require(neighbours, f"ties: cemented: expected two neighbours, got {numbers}")
            plain = (self.scale, self.shift) == (1, 0)
            require(plain, "ties: cemented: takes neither scale nor shift; leave them out")
        line = math.isfinite(self.scale) and self.scale and math.isfinite(self.shift)
        got = f"got {self.scale:g} and {self.shift:g}"
        require(line, f"ties: expected a scale that is not 0 and a shift, {got}")

    @property
    def line(self) -> tuple[float, float]:
        """Factor and shift of the followers; the factor is negative for "opposite"."""
        return (-self.scale if self.how == "opposite" else self.scale), self.shift

    def pairs(self, lens: Lens) -> list[tuple[Place, Place]]:
        """Pairs of a leader and a follower. ValueError as in `Vary.places`."""
        first, *others = self.surfaces
        kinds: tuple[str, ...] = (self.kind,)
        terms = {kind: range(PARTS[kind].read(lens).shape[1]) for kind in (self.kind, *_SHAPE)}
        if self.how == "cemented":
            kinds = tuple(kind for kind in _SHAPE if terms[kind])
            one, two = lens.forms[first], lens.forms[others[0]]
            are = f"surfaces {first} and {others[0]} are of the forms {one} and {two}"
            require(one == two, f"ties: cemented: {are}; give both the same form")
        for kind in kinds:
            places_of("ties", lens, kind, self.surfaces)
        return [
            (Place(kind, first, term), Place(kind, row, term))
            for kind in kinds
            for term in terms[kind]
            for row in others
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
    environment: temperature, C, and thermal model, see `at_temperature`; None at 20 C.

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
    environment: tuple[Array, ThermalModel] | None = None

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
        vary: variables; the name of a kind alone means all variables of that kind.
        ties: numbers that follow a variable, or a number that does not change.
        solves: conditions that hold exactly.

        ValueError, which begins with the name of the argument, for a number that does not exist, is
        named twice, or is both a variable and solved; and as in `Lens.check`.
        """
        lens.check()
        varied = [Vary(v) if isinstance(v, str) else v for v in vary]
        found = [(place, v) for v in varied for place in v.places(lens)]
        following = [(p, f, t.line) for t in ties for p, f in t.pairs(lens)]
        solved = [solve.place(lens) for solve in solves]
        followers = [f for _, f, _ in following] + solved
        _refuse_twice("solves", solved, "is what two of them change")
        _refuse_twice("ties", followers, "follows twice")
        for leader, follower, _ in following:
            what = f"ties: {leader}, which {follower} follows, itself follows from a tie or a solve"
            require(leader not in followers, f"{what}; begin with another surface")
        # If all numbers of a kind vary, tied and solved ones are left out. Naming one is an error.
        for place, v in found:
            free = not (place in followers and v.surfaces)
            require(free, f"variables: {place} follows from a tie or a solve; leave it out here")
        found = [(place, v) for place, v in found if place not in followers]
        _refuse_twice("variables", [place for place, _ in found], "stands twice")
        more = "fewer solves or more variables are needed" if solves else "name some"
        require(found, f"variables: none is left; {more}")
        counts = f"{len(solves)} of them, but {len(found)} variables"
        require(len(solves) <= len(found), f"solves: {counts}; leave some out")
        index = {place: k for k, (place, _) in enumerate(found)}
        # Followers of a number that does not vary are set once, here.
        fixed = [(f, a * number_at(lens, p)[0] + b) for p, f, (a, b) in following if p not in index]
        lens = with_numbers(with_arrays(lens, {place.kind for place in index}), fixed)
        dtype = lens.curvature.dtype
        rows = np.array([v.bounds(lens, place) for place, v in found])
        low, high = jnp.asarray(rows[:, :2] / rows[:, 2:], dtype).T
        tied = [(index[p], f, line) for p, f, line in following if p in index]
        scale = jnp.asarray(rows[:, 2], dtype)
        lines = jnp.asarray([line for *_, line in tied], dtype).reshape(-1, 2)
        places, pairs = tuple(index), tuple((k, f) for k, f, _ in tied)
        variables = cls(lens, low, high, scale, (), lines, places, pairs)
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
        are_sets = found and all(isinstance(own, Variables) for own in found)
        require(are_sets, "variables: expected Variables.from_lens(lens, [...]), or several")
        cold = all(own.environment is None for own in found)
        require(cold, "variables: join the sets first, then take them at a temperature")
        kinds, lenses = {place.kind for own in found for place in own.places}, []
        for each in found:
            lens = with_arrays(each.lens, kinds)
            for own in found:  # ties and solves have changed the lens of each set
                lens = dataclasses.replace(own, lens=lens).lens_of(own.start)
            lenses.append(lens)
        first = lenses[0]
        for lens in lenses[1:]:
            alike = str(jax.tree.structure(first)) == str(jax.tree.structure(lens)) and all(
                map(np.array_equal, jax.tree.leaves(first), jax.tree.leaves(lens))
            )
            require(alike, "variables: of different lenses; make them from one lens")
        ends = np.cumsum([0, *(len(own.places) for own in found)]).tolist()
        places = tuple(place for own in found for place in own.places)
        ties = tuple((k + end, p) for end, own in zip(ends, found) for k, p in own.ties)
        _refuse_twice("variables", [*places, *(p for _, p in ties)], "stands twice")

        def both(name: str) -> Any:
            return jnp.concatenate([getattr(own, name) for own in found])

        solves = tuple(solve for own in found for solve in own.solves)
        low, high, scale, lines = map(both, ("low", "high", "scale", "lines"))
        return cls(first, low, high, scale, solves, lines, places, ties)

    def __str__(self) -> str:
        """A few lines: numbers by kind with their units, those at a bound by name."""
        return "\n".join(self.described(self.start)) if concrete(self) else repr(self)

    def described(self, vector: Numbers) -> list[str]:
        """Lines on the numbers of a vector (N,): a title, a line for each kind with its unit, and
        the variables at a bound by name, at most four."""
        numbers = np.asarray(vector) * np.asarray(self.scale)
        low, high = (np.asarray(bound) * np.asarray(self.scale) for bound in (self.low, self.high))
        counts = f"{len(self.places)} variables, {len(self.ties)} ties, {len(self.solves)} solves"
        lines = [f"{self.lens.name or 'lens'}: {counts}"]
        for kind in dict.fromkeys(place.kind for place in self.places):
            rows = [k for k, place in enumerate(self.places) if place.kind == kind]
            names = [self.names[k].removeprefix(kind).strip() for k in rows[:_MOST_TOLD]]
            each = [
                f"{f'[{name}] ' if name else ''}{numbers[k]:.5g}" for k, name in zip(rows, names)
            ]
            more = f", ... ({len(rows)})" if len(rows) > _MOST_TOLD else ""
            unit = f" ({_UNITS[kind]})" if kind in _UNITS else ""
            lines.append(f"  {kind}{unit}: {', '.join(each)}{more}")
        near = 1e-6 * np.abs(np.asarray(self.scale))
        sides = (("low", low, numbers - low), ("high", high, high - numbers))
        bounds = [
            f"{place} at its {side} bound {bound[k]:.5g} {_UNITS.get(place.kind, '')}".rstrip()
            for k, place in enumerate(self.places)
            for side, bound, room in sides
            if room[k] <= near[k]
        ]
        others = [f"and {len(bounds) - 4} more at a bound"] if len(bounds) > 4 else []
        return lines + [f"  {line}" for line in (*bounds[:4], *others)]

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
        return jnp.stack([number_at(lens, place)[0] for place in self.places]) / self.scale

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
        lens = with_numbers(self.lens, changes)
        for solve in self.solves:
            lens = solve.apply(lens)
        return lens if self.environment is None else at_temperature(lens, *self.environment)

    def at_temperature(self, celsius: Numbers, model: ThermalModel) -> "Variables":
        """The same variables, numbers of the lens at 20 C, whose `lens_of` is the lens at another
        temperature. Ties and solves hold at 20 C.

        celsius: (), C. model: as in `design.at_temperature`; made of the lens, so that glasses that
            vary keep it.
        """
        now = jnp.asarray(celsius, self.low.dtype)
        return dataclasses.replace(self, environment=(now, model))


def _refuse_twice(what: str, places: Iterable[Place], reason: str) -> None:
    """Raises ValueError for a place that occurs twice."""
    for place, count in collections.Counter(places).items():
        require(count == 1, f"{what}: {place} {reason}; leave one out")
