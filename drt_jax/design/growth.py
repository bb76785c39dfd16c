"""Growth: design for a part of the fields and of the aperture first, then for more and more."""

import copy
import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from .least_squares import Search
from .optimum import Optimum, optimise
from .problem import Problem

# A step to the next part is no smaller; one that succeeds is followed by a step so much larger.
SHORTEST, _FASTER = 0.002, 1.2


class Growth(NamedTuple):
    """How far a lens has grown.

    done: the largest part that meets the target, 1 for all, 0 for none yet. part: the one to try
    next, step: from there. vector: (N,), of the variables, the best for `done`. failed: the last
    search that missed the target, None if none did.
    steps, jacobians, seconds, first: of all searches, see `Optimum`.
    """

    done: float
    part: float
    step: float
    vector: np.ndarray
    failed: Optimum | None = None
    steps: int = 0
    jacobians: int = 0
    seconds: float = 0.0
    first: float = 0.0

    @property
    def ended(self) -> bool:
        """Whether the whole is reached, or no step leads farther."""
        return self.done >= 1 or self.step < SHORTEST


def part_of(problem: Problem, part: Array | float) -> Problem:
    """The problem for a part of its fields and of its aperture: the entrance pupil or f-number of a
    solve, else the stop. Numbers alone differ, so that one program serves all parts."""
    variables, solves = problem.variables, []
    lens = variables.lens
    for solve in variables.solves:
        own = copy.copy(solve)
        if solve.aperture:
            value = solve.value * part if solve.kind == "entrance_pupil" else solve.value / part
            object.__setattr__(own, "value", value)
        solves.append(own)
    if not any(solve.aperture for solve in solves):
        semi = lens.semi_diameter.at[lens.stop].multiply(part)
        lens = dataclasses.replace(lens, semi_diameter=semi)
    variables = dataclasses.replace(variables, lens=lens, solves=tuple(solves))
    return dataclasses.replace(problem, variables=variables, fields=problem.fields * part)


def start_growth(problem: Problem, first: float = 0.3, step: float = 0.1) -> Growth:
    """The start of a problem, to be grown from a part `first` in steps of about `step`."""
    return Growth(0.0, first, step, np.asarray(problem.variables.start))


def grow_once(
    problem: Problem,
    growth: Growth,
    target_merit: float,
    max_steps: int = 40,
    callback: Callable[[Search], None] = lambda search: None,
) -> Growth:
    """One part more: accepted when its score is the target or less, else tried with half the
    step."""
    part, done, step = growth.part, growth.done, growth.step
    vector = jnp.asarray(growth.vector)
    found = optimise(part_of(problem, part), vector, max_steps, callback, target_merit)
    met = found.score <= target_merit
    if met:
        done, step = part, _FASTER * step
    else:
        step /= 2
    return growth._replace(
        done=done,
        part=min(done + step, 1.0) if done else part / 2,
        step=step,
        vector=found.vector if met else growth.vector,
        failed=growth.failed if met else found,
        steps=growth.steps + len(found.history),
        jacobians=growth.jacobians + found.jacobians,
        seconds=growth.seconds + found.seconds,
        first=growth.first + found.first,
    )


def grow(
    problem: Problem,
    target_merit: float,
    first: float = 0.3,
    step: float = 0.1,
    max_steps: int = 40,
    callback: Callable[[Search], None] = lambda search: None,
) -> Growth:
    """Design a lens for a part of its fields and aperture, then for more and more.

    target_merit: with which the next part is tried at once, in the unit of `Optimum.score`; some 16
        times the merit that the whole is to have: a lens that is perfect for a part is spoilt for
        more. first: part to begin with. step: to the next; 1.2 times as much after one that meets
        the target, half as much after one that does not, down to 0.002. max_steps: at each part.
    callback: called after each step of a search.

    `Growth.done` is 1 where the whole meets the target; its `vector` is then the start of
    `optimise`. One program serves all parts.
    """
    growth = start_growth(problem, first, step)
    while not growth.ended:
        growth = grow_once(problem, growth, target_merit, max_steps, callback)
    return growth
