"""Variables: some numbers of a lens as a vector, with bounds, ties and solves."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from .kinds import KINDS, step_of
from .solves import Solve

_How = Literal["equal", "opposite", "cemented"]
# What neighbours that are cemented share.
_SHAPE = ("curvature", "conic", "coefficients")


@dataclasses.dataclass(frozen=True)
class Vary:
    """Numbers of a lens that may change, within bounds.

    kind: "curvature", "conic", "coefficients", "thickness" (behind a surface; the sensor keeps its
        distance from the last vertex), "sensor" (behind the last vertex), "index" and "abbe" of the
        model glass behind a surface, "tilt", "decentre", "semi_diameter".
    surfaces: which, from 0; empty: all that have one (curvature, conic, coefficients, tilt,
        decentre: those that bend light; semi_diameter: those that are finite).
    terms: of coefficients, and the components of a tilt or decentre, from 0; empty: all (of an
        asphere all but that of r^2, which is its curvature).
    low, high: bounds in the units of the lens.
    scale: a typical change; 0: chosen by the kind and the stop's semi-diameter.
    """

    kind: str
    surfaces: tuple[int, ...] = ()
    terms: tuple[int, ...] = ()
    low: float = -np.inf
    high: float = np.inf
    scale: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"variables: unknown kind {self.kind!r}; known: {', '.join(KINDS)}")
        low, high = KINDS[self.kind].limits
        object.__setattr__(self, "low", max(self.low, low))
        object.__setattr__(self, "high", min(self.high, high))
        if not self.low < self.high:
            raise ValueError(
                f"variables: {self.kind}: low {self.low:g} is not below high {self.high:g}; within "
                f"{low:g} and {high:g}, exchange them"
            )
        if not 0 <= self.scale < np.inf:
            raise ValueError(f"variables: {self.kind}: scale: must be above 0, got {self.scale:g}")

    def places(self, lens: Lens) -> "list[Place]":
        """The numbers it stands for. ValueError, listing those that exist, for one that does
        not."""
        kind = KINDS[self.kind]
        allowed, count = kind.allowed(lens), kind.terms(lens)
        if not allowed or not count:
            raise ValueError(f"variables: {self.kind}: {_NONE.get(self.kind, 'the lens has none')}")
        for what, given, known in (
            ("surface", self.surfaces, allowed),
            ("term", self.terms, range(count)),
        ):
            for number in given:
                if number not in known:
                    some = ", ".join(map(str, known))
                    raise ValueError(
                        f"variables: {self.kind}: no {what} {number}; there are {some}"
                    )
        return [
            Place(self.kind, row, term)
            for row in self.surfaces or kind.rows(lens)
            for term in self.terms or range(self._first(lens, row), count)
        ]

    def _first(self, lens: Lens, row: int) -> int:
        return int(self.kind == "coefficients" and lens.forms[row] == "asphere")


_NONE = {
    "coefficients": "the lens has none; write them into its prescription, zeros too",
    "index": "the lens has no model glass; write nd and vd into its prescription",
    "abbe": "the lens has no model glass; write nd and vd into its prescription",
}


@dataclasses.dataclass(frozen=True)
class Tie:
    """Numbers that follow the first of them.

    surfaces: two or more; the others follow the first.
    how: "equal", "opposite", or "cemented": two neighbours of one shape.
    kind: of the numbers, see `Vary`; of "cemented", all of the shape.
    """

    surfaces: tuple[int, ...]
    how: _How = "equal"
    kind: str = "curvature"

    def __post_init__(self) -> None:
        if self.how not in get_args(_How):
            raise ValueError(f"ties: unknown {self.how!r}; known: {', '.join(get_args(_How))}")
        if len(set(self.surfaces)) < 2 or len(set(self.surfaces)) < len(self.surfaces):
            raise ValueError(f"ties: expected two or more different surfaces, got {self.surfaces}")
        if self.how == "cemented" and (
            len(self.surfaces) != 2 or abs(self.surfaces[0] - self.surfaces[1]) != 1
        ):
            raise ValueError(f"ties: cemented: expected two neighbours, got {self.surfaces}")

    def pairs(self, lens: Lens) -> "list[tuple[Place, Place]]":
        """Leaders and followers."""
        first, *others = self.surfaces
        kinds = _SHAPE if self.how == "cemented" else (self.kind,)
        return [
            (Place(kind, first, term), Place(kind, other, term))
            for kind in kinds
            if kind not in _SHAPE or KINDS[kind].terms(lens)
            for other in others
            for term in {p.term for p in Vary(kind, (first, other)).places(lens)}
        ]


class Place(NamedTuple):
    """One number of a lens."""

    kind: str
    row: int
    term: int

    def __str__(self) -> str:
        term = f"[{self.term}]" if self.kind in ("coefficients", "tilt", "decentre") else ""
        return self.kind if self.kind == "sensor" else f"{self.kind} {self.row}{term}"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Variables:
    """N numbers of a lens as a vector of order 1, each in units of its scale.

    lens: the start; what does not vary stays as in it.
    low, high: (N,), bounds of the vector; scale: (N,), in the units of the lens.

    Static:
    places: which numbers. ties: (leader, follower, sign). solves: applied in their order.
    """

    lens: Lens
    low: Array
    high: Array
    scale: Array
    places: tuple[Place, ...] = dataclasses.field(metadata={"static": True})
    ties: tuple[tuple[int, Place, float], ...] = dataclasses.field(
        metadata={"static": True}, default=()
    )
    solves: tuple[Solve, ...] = dataclasses.field(metadata={"static": True}, default=())

    @classmethod
    def of(
        cls,
        lens: Lens,
        vary: Sequence[Vary | str],
        ties: Sequence[Tie] = (),
        solves: Sequence[Solve] = (),
    ) -> "Variables":
        """The variables of a lens.

        vary: what may change; a word alone is all of a kind. ties: what follows a variable, or
        stays tied to what does not change. solves: conditions that hold exactly.

        ValueError, which begins with the list that is wrong, for a number that does not exist,
        stands twice, or is both a variable and what a solve determines.
        """
        wanted = [Vary(v) if isinstance(v, str) else v for v in vary]
        found = [(place, v) for v in wanted for place in v.places(lens)]
        following = [(p, f, t) for t in ties for p, f in t.pairs(lens)]
        followers = [f for _, f, _ in following]
        solved = [solve.place(lens) for solve in solves]
        _refuse_twice("solves", [Place(*place) for place in solved], "is what two solves change")
        _refuse_twice("ties", followers, "follows twice")
        # A word for all of a kind leaves out what is tied or solved; a number that is named stays.
        taken = {*followers, *(Place(*place) for place in solved)}
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
        for leader, _, tie in following:
            if leader not in index:
                raise ValueError(f"ties: {leader} is no variable; add it, or lead with another")
        lens = _with_arrays(lens, {place.kind for place, _ in found})
        dtype = lens.curvature.dtype
        scale = np.array([v.scale or step_of(lens, *place[::2]) for place, v in found])
        bounds = (np.array([getattr(v, side) for _, v in found]) for side in ("low", "high"))
        low, high = (jnp.asarray(bound / scale, dtype) for bound in bounds)
        tied = tuple((index[p], f, -1.0 if t.how == "opposite" else 1.0) for p, f, t in following)
        places = tuple(place for place, _ in found)
        made = cls(lens, low, high, jnp.asarray(scale, dtype), places, tied)
        start = made.lens_of(jnp.clip(made.vector(lens), low, high))
        held = []
        for solve in solves:
            held.append(solve.found(start))
            start = held[-1].apply(start)
        return dataclasses.replace(made, lens=start, solves=tuple(held))

    @property
    def names(self) -> tuple[str, ...]:
        """Such as "curvature 3"."""
        return tuple(map(str, self.places))

    @property
    def start(self) -> Array:
        """The vector (N,) of the lens at the start, within its bounds."""
        return jnp.clip(self.vector(self.lens), self.low, self.high)

    def vector(self, lens: Lens) -> Array:
        """The vector (N,) of a lens."""
        numbers = [KINDS[p.kind].read(lens)[p.row, p.term] for p in self.places]
        return jnp.stack(numbers) / self.scale

    def numbers(self, vector: Array) -> Array:
        """The numbers (N,), in the units of the lens."""
        return vector * self.scale

    def lens_of(self, vector: Array) -> Lens:
        """The lens of a vector (N,), its ties and solves kept. Differentiable, in `jit` and `vmap`
        too; bounds are whoever's who makes the vector."""
        numbers = vector * self.scale
        tied = [(place, numbers[k] * sign) for k, place, sign in self.ties]
        changes = [*((place, numbers[k]) for k, place in enumerate(self.places)), *tied]
        lens = self.lens
        # Thicknesses before the sensor, which is told from the last vertex.
        for kind in KINDS:
            own = [(place, number) for place, number in changes if place.kind == kind]
            if own:
                rows = np.array([place.row for place, _ in own])
                terms = np.array([place.term for place, _ in own])
                array = KINDS[kind].read(lens)
                array = array.at[rows, terms].set(jnp.stack([number for _, number in own]))
                lens = KINDS[kind].write(lens, array)
        for solve in self.solves:
            lens = solve.apply(lens)
        return lens


def _refuse_twice(what: str, places: Sequence[Place], said: str) -> None:
    for place, group in itertools.groupby(sorted(places)):
        if len(list(group)) > 1:
            raise ValueError(f"{what}: {place} {said}; leave one out")


def _with_arrays(lens: Lens, kinds: set[str]) -> Lens:
    """The lens with arrays of zeros in place of none, where they vary."""
    for kind in kinds & {"tilt", "decentre"}:
        lens = KINDS[kind].write(lens, KINDS[kind].read(lens))
    return lens
