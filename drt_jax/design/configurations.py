"""Several configurations of one lens as one design problem: a zoom, or a lens that focuses.

Each configuration is a `Problem` of its own, with its own lens, scene and operands. One vector of
variables serves all: configuration c takes its part `vector[index[c]]`, in which a shared variable
has the same place for every c and an own variable a place for each. Problems of one structure are
evaluated together, by `jax.vmap` over the numbers that differ between them.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..lens.lens import Lens
from ..numerics import Numbers
from ..rays.solve import Solver
from .least_squares import Evaluation
from .limits import Limit
from .parts import Place
from .problem import Problem, weights_of, with_apertures
from .variables import Variables

# Shared numbers count as equal if they differ by at most this, relative to number and scale.
_EQUAL = 1e-6
# Most numbers that are printed.
_TOLD = 8


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class SharedVariables:
    """The variables of several configurations as one vector (N,): shared ones, then own ones.

    low, high: (N,), bounds of the vector.
    scale: (N,), in the units of the lens.
    start: (N,), the vector of the lenses at the start.
    first: the variables of the first configuration.
    index: (n,), positions of these in the vector.

    Static:
    names: N names, such as "curvature 3" and "thickness 4 of configuration 1",
        counted from 1 as in files.
    """

    low: Array
    high: Array
    scale: Array
    start: Array
    first: Variables
    index: Array
    names: tuple[str, ...] = dataclasses.field(metadata={"static": True})

    def numbers(self, vector: Array) -> Array:
        """The numbers (N,) of a vector (N,), in the units of the lens."""
        return vector * self.scale

    def described(self, vector: Numbers) -> list[str]:
        """Lines on the numbers of a vector (N,), at most ten, as `Variables.described`."""
        numbers = np.asarray(vector) * np.asarray(self.scale)
        lines = [f"{self.first.lens.name or 'lens'}: {len(self.names)} variables of configurations"]
        rows = [f"  {name}: {number:.5g}" for name, number in zip(self.names, numbers)]
        more = [f"  and {len(rows) - _TOLD} more"] if len(rows) > _TOLD else []
        return [*lines, *rows[:_TOLD], *more]

    def lens_of(self, vector: Array) -> Lens:
        """The lens of the first configuration at a vector (N,), see `Configurations.lenses`."""
        return self.first.lens_of(vector[self.index])


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Alike:
    """G problems of one structure.

    problem: the first of them.
    own: the leaves that differ, each (G, ...).
    index: (G, n), positions of the variables of each problem in the vector.

    Static:
    differ: positions of these leaves in the list of leaves of the problem.
    numbers: G numbers of the configurations.
    """

    problem: Problem
    own: tuple[Array, ...]
    index: Array
    differ: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    numbers: tuple[int, ...] = dataclasses.field(metadata={"static": True})

    @classmethod
    def stacked(cls, problems: dict[int, Problem], index: Sequence[np.ndarray]) -> "_Alike":
        """Problems by number, with the leaves that differ between them stacked."""
        first, *_ = problems.values()
        rows = list(zip(*map(jax.tree.leaves, problems.values()), strict=True))
        alike = (all(a is row[0] or np.array_equal(a, row[0]) for a in row) for row in rows)
        differ = tuple(k for k, same in enumerate(alike) if not same)
        own = tuple(jnp.stack(rows[k]) for k in differ)
        places = jnp.stack([jnp.asarray(index[number]) for number in problems])
        return cls(first, own, places, differ, tuple(problems))

    def one(self, own: Sequence[Array]) -> Problem:
        """The problem with these leaves in place of those that differ."""
        leaves, structure = jax.tree.flatten(self.problem)
        for k, leaf in zip(self.differ, own, strict=True):
            leaves[k] = leaf
        return jax.tree.unflatten(structure, leaves)

    def each(self) -> "list[tuple[int, Problem, Array]]":
        """Number, problem and index of each configuration."""
        return [
            (number, self.one([a[k] for a in self.own]), self.index[k])
            for k, number in enumerate(self.numbers)
        ]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Configurations:
    """A design problem of C configurations, for `optimise`, `many_starts` and `grow`.

    Residuals and constraints of the configurations are concatenated.

    groups: the problems, grouped by structure.
    variables: the variables of all as one vector.
    weights: (C,), factors of the squares of the residuals of each configuration, with the mean 1.
    """

    groups: tuple[_Alike, ...]
    variables: SharedVariables
    weights: Array

    @classmethod
    def from_problems(
        cls, problems: Sequence[Problem], own: Sequence[str] = (), weights: Numbers | None = None
    ) -> "Configurations":
        """Makes one problem of the problems of C configurations.

        problems: one for each configuration: its lens, scene, operands, ties and solves. Problems
            that differ only in numbers are evaluated together.
        own: variables of which each configuration has its own: names as in `Variables.names`
            ("thickness 4"), or kinds ("sensor"). All other variables are shared: each
            configuration varies them, from the same number. Their bounds all hold.
        weights: (C,), of the squares of the residuals of each configuration; None for 1.

        ValueError, which begins with the name of the argument, for an unknown name, for a shared
        variable that some configuration does not vary or begins from another number, for bounds
        that contradict each other, and for a solve of a curvature, which cannot hold in all.
        """
        problems = list(problems)
        known = problems and all(isinstance(problem, Problem) for problem in problems)
        require(known, "problems: expected Problem.from_variables(...), one for each configuration")
        index, slots = _slots(problems, own)
        problems = _shared(problems, index, len(slots))
        arrays = np.empty((4, len(slots)))
        for problem, where in zip(reversed(problems), reversed(index)):
            v = problem.variables
            arrays[:, where] = v.low, v.high, v.scale, v.start
        first = problems[0].variables
        low, high, scale, start = jnp.asarray(arrays, first.low.dtype)
        where = jnp.asarray(index[0])
        joined = SharedVariables(low, high, scale, start, first, where, tuple(slots))
        given = np.ones(len(problems)) if weights is None else weights
        shares = weights_of("weights", given, len(problems))
        return cls(_groups(problems, index), joined, jnp.asarray(shares, first.low.dtype))

    @property
    def problems(self) -> list[Problem]:
        """The problem of each configuration."""
        return [problem for _, problem, _ in self._each()]

    def _each(self) -> list[tuple[int, Problem, Array]]:
        """Number, problem and index of each configuration, in their order."""
        return sorted((e for group in self.groups for e in group.each()), key=lambda e: e[0])

    def lenses(self, vector: Numbers) -> tuple[Lens, ...]:
        """The lens of each configuration at a vector (N,), with ties and solves applied."""
        y = jnp.asarray(vector)
        return tuple(problem.variables.lens_of(y[own]) for _, problem, own in self._each())

    def fitted(self, vector: Numbers, margin: float = 0.01) -> tuple[Lens, ...]:
        """The lenses at a vector (N,) with common semi-diameters that just pass all rays of all
        configurations, see `fit_apertures`; each stop keeps its own."""
        lenses = self.lenses(vector)
        wide = jnp.append((1 + margin) * self.beam_radius(lenses), jnp.inf)
        return tuple(with_apertures(lens, wide) for lens in lenses)

    def beam_radius(self, lenses: Sequence[Lens]) -> Array:
        """Radius of the largest beam footprint of all configurations on each surface (S,), mm."""
        pairs = zip(self.problems, lenses, strict=True)
        return jnp.max(jnp.stack([problem.beam_radius(lens) for problem, lens in pairs]), axis=0)

    def over(self, function: Callable, *rows: Sequence[Any]) -> list[Any]:
        """A function of each configuration: C results, of one program for problems alike.

        function: of the problem of a configuration, and of its part of the rows; it is mapped over
            those that differ only in numbers.
        rows: sequences of C pytrees of arrays, alike in structure.
        """
        found: dict[int, Any] = {}
        for group in self.groups:
            own = [[row[number] for number in group.numbers] for row in rows]
            stacked = [jax.tree.map(lambda *a: jnp.stack(a), *some) for some in own]
            each = jax.vmap(lambda own, _, *row, g=group: function(g.one(own), *row))(
                group.own, jnp.array(group.numbers), *stacked
            )
            for k, number in enumerate(group.numbers):
                found[number] = jax.tree.map(lambda a, k=k: a[k], each)
        return [found[number] for number in sorted(found)]

    def evaluate_each(self, vector: Array) -> list[Evaluation]:
        """The evaluation of each configuration at a vector (N,), without the weights.

        Works in `jit`, `vmap` and under differentiation.
        """
        parts = [vector[own] for _, _, own in self._each()]
        return self.over(lambda problem, part: problem.evaluate(part), parts)

    def evaluate(self, vector: Array) -> Evaluation:
        """Residuals, constraints, overlap and number of failed rays, as `Problem.evaluate`."""
        each = self.evaluate_each(vector)
        roots = jnp.sqrt(self.weights)
        residuals = jnp.concatenate([roots[k] * one.residuals for k, one in enumerate(each)])
        constraints = jnp.concatenate([one.constraints for one in each])
        overlap, failed = sum(one.overlap for one in each), sum(one.failed for one in each)
        return Evaluation(residuals, constraints, jnp.asarray(overlap), jnp.asarray(failed))

    @jax.jit
    def merits(self, vector: Array) -> Array:
        """Sum of the squares of the residuals of each configuration (C,), without the weights."""
        return jnp.stack([jnp.sum(one.residuals**2) for one in self.evaluate_each(vector)])

    @jax.jit
    def merit(self, vector: Array) -> Array:
        """Sum of the squares of all residuals, with the weights, ()."""
        return jnp.sum(self.evaluate(vector).residuals ** 2)

    @jax.jit
    def failed(self, vector: Array) -> Array:
        """Number of failed rays, (), int32."""
        return self.evaluate(vector).failed

    def limits(self, constraints: Numbers) -> list[Limit]:
        """The limits by name, in the order of `Evaluation.constraints`; see `Problem.limits`."""
        rows, found = np.asarray(constraints), list[Limit]()
        for number, problem, _ in self._each():
            for limit in problem.limits(rows[len(found) :]):
                where = ", ".join(filter(None, (f"configuration {number + 1}", limit.where)))
                found.append(limit._replace(where=where))
        return found

    @property
    def solver(self) -> Solver:
        """The ray solver of all problems."""
        return self.groups[0].problem.solver

    def with_solver(self, solver: Solver) -> "Configurations":
        """The same with another ray solver."""
        replace = dataclasses.replace
        groups = (replace(own, problem=own.problem.with_solver(solver)) for own in self.groups)
        return replace(self, groups=tuple(groups))

    def map(self, function: Callable[[Problem], Any]) -> "Configurations":
        """The same with other problems, such as `lambda p: p.with_order(8)`.

        function: from the problem of a configuration to one of the same variables, whose bounds
            may be others.
        """
        _, old, index = zip(*self._each(), strict=True)
        problems, shared = [*map(function, old)], self.variables
        low, high = shared.low, shared.high
        for own, where in zip((problem.variables for problem in problems), index):
            low, high = low.at[where].set(own.low), high.at[where].set(own.high)
        first = problems[0].variables
        shared = dataclasses.replace(shared, low=low, high=high, first=first)
        groups = _groups(problems, [*map(np.asarray, index)])
        return dataclasses.replace(self, groups=groups, variables=shared)


# What `optimise` takes: one configuration, or several.
AnyProblem = Problem | Configurations


def problems_of(problem: AnyProblem) -> list[Problem]:
    """The problem of each configuration, or the one that is given."""
    return problem.problems if isinstance(problem, Configurations) else [problem]


def over(problem: AnyProblem, function: Callable, *rows: Sequence[Any]) -> list[Any]:
    """`Configurations.over`, also of one problem, whose rows have one part."""
    if isinstance(problem, Configurations):
        return problem.over(function, *rows)
    return [function(problem, *(part for (part,) in rows))]


def shares_of(problem: AnyProblem) -> Array:
    """Weights (C,) of the configurations of a problem, with the sum 1."""
    if isinstance(problem, Configurations):
        return problem.weights / len(problem.weights)
    return jnp.ones(1, problem.fields.dtype)


def _groups(problems: Sequence[Problem], index: Sequence[np.ndarray]) -> tuple[_Alike, ...]:
    """Problems with the same structure and shapes together."""
    found: dict[Any, dict[int, Problem]] = {}
    for number, problem in enumerate(problems):
        leaves, structure = jax.tree.flatten(problem)
        key = structure, tuple((np.shape(leaf), leaf.dtype) for leaf in leaves)
        found.setdefault(key, {})[number] = problem
    return tuple(_Alike.stacked(alike, index) for alike in found.values())


def _slots(
    problems: Sequence[Problem], own: Sequence[str]
) -> tuple[list[np.ndarray], dict[str, int]]:
    """Positions of the variables of each problem in the vector, and the names of the vector."""
    sets = [problem.variables.places for problem in problems]
    words = {own} if isinstance(own, str) else {*own}
    is_own = lambda place: bool({str(place), place.kind} & words)  # noqa: E731
    known = {word for places in sets for place in places for word in (str(place), place.kind)}
    for name in sorted(words):
        some = ", ".join(sorted(str(place) for place in sets[0]))
        require(name in known, f"own: no variable is named {name!r}; there are {some}")
    shared = [place for place in sets[0] if not is_own(place)]
    for number, places in enumerate(sets):
        others: set[Place] = set(shared).symmetric_difference(p for p in places if not is_own(p))
        some = ", ".join(sorted(map(str, others)))
        what = f"variables: configuration {number + 1} and 1 do not both vary {some}"
        require(not others, f"{what}; vary it in all, or name it in own")
    slots = {str(place): k for k, place in enumerate(shared)}
    index = []
    for number, places in enumerate(sets):
        names = [f"{p} of configuration {number + 1}" if is_own(p) else str(p) for p in places]
        index.append(np.array([slots.setdefault(name, len(slots)) for name in names], np.int32))
    return index, slots


def _shared(problems: Sequence[Problem], index: Sequence[np.ndarray], count: int) -> list[Problem]:
    """The problems with one scale and common bounds for each shared variable.

    ValueError for a shared variable that begins from different numbers or has no common bounds, and
    for a solve that changes a curvature.
    """
    scale, value = np.ones(count), np.zeros(count)
    low, high = np.full(count, -np.inf), np.full(count, np.inf)
    for own, where in zip([p.variables for p in reversed(problems)], reversed(index)):
        for solve in own.solves:
            what = f"solves: {solve.kind}: changes curvature {solve.surface}, which all"
            remedy = "configurations share; take an operand with a target"
            require(solve.focuses or solve.aperture, f"{what} {remedy}")
        step = np.asarray(own.scale, float)
        scale[where], value[where] = step, step * np.asarray(own.start)
        low[where] = np.maximum(low[where], step * np.asarray(own.low))
        high[where] = np.minimum(high[where], step * np.asarray(own.high))
    found = []
    for number, (problem, where) in enumerate(zip(problems, index)):
        own = problem.variables
        begins = np.asarray(own.scale * own.start, float)
        off = np.abs(begins - value[where]) > _EQUAL * (scale[where] + np.abs(value[where]))
        for name, is_off, at, first in zip(own.names, off, begins, value[where]):
            starts = f"at {first:g} in configuration 1 and at {at:g} in {number + 1}"
            what = f"variables: {name} is shared, but begins {starts}"
            require(not is_off, f"{what}; give it one number, or name it in own")
        for name, is_empty in zip(own.names, low[where] >= high[where]):
            require(not is_empty, f"variables: {name}: its bounds have no common range; widen one")
        steps = scale[where]
        rows = jnp.asarray([low[where] / steps, high[where] / steps, steps], own.low.dtype)
        own = dataclasses.replace(own, low=rows[0], high=rows[1], scale=rows[2])
        found.append(dataclasses.replace(problem, variables=own))
    return found
