"""Growth: a design for a part of the fields and aperture, extended step by step to the whole."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from .configurations import AnyProblem, Configurations
from .least_squares import Search
from .optimum import Optimum, optimise
from .solves import Solve

# Smallest step to the next part, and the factor by which the step grows after a success.
SHORTEST, _FASTER = 0.002, 1.2


class Growth(NamedTuple):
    """State of a growth. A part is a fraction of the fields and of the aperture.

    done: largest part that meets the target; 1 for the whole, 0 for none yet.
    part: part to try next.
    step: step from the part after that to the next.
    vector: (N,), best vector of the variables for the part `done`.
    failed: last search that missed the target; None if none did.
    steps, jacobians, seconds, first: totals over all searches, see `Optimum`.
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
        """True once the whole is reached, or once the step is below 0.002."""
        return self.done >= 1 or self.step < SHORTEST


def part_of(problem: AnyProblem, part: Array | float) -> AnyProblem:
    """The problem for a part of its fields and aperture.

    Only numbers differ, so that one compiled program serves all parts.

    problem: the whole problem.
    part: factor of the fields; and of the aperture: of the entrance pupil or f-number of a solve,
        if there is one, else of the stop.
    """
    if isinstance(problem, Configurations):
        return problem.map(lambda one: part_of(one, part))

    def own(solve: Solve) -> Solve:
        if not solve.aperture:
            return solve
        is_pupil = solve.kind == "entrance_pupil"
        return solve.with_value(solve.value * part if is_pupil else solve.value / part)

    variables = problem.variables
    lens = variables.lens
    if not any(solve.aperture for solve in variables.solves):
        semi = lens.semi_diameter.at[lens.stop].multiply(part)
        lens = dataclasses.replace(lens, semi_diameter=semi)
    solves = tuple(map(own, variables.solves))
    variables = dataclasses.replace(variables, lens=lens, solves=solves)
    return dataclasses.replace(problem, variables=variables, fields=problem.fields * part)


def start_growth(problem: AnyProblem, first: float = 0.3, step: float = 0.1) -> Growth:
    """The state before the first search.

    first: part to begin with.
    step: step to the next part.
    """
    return Growth(0.0, first, step, np.asarray(problem.variables.start))


def grow_once(
    problem: AnyProblem,
    growth: Growth,
    target_merit: float,
    max_steps: int = 40,
    callback: Callable[[Search], None] = lambda search: None,
) -> Growth:
    """Optimises the next part.

    The part is accepted if its score is at most the target; the next step is then 1.2 times as
    long. Otherwise the step is halved. Arguments as in `grow`.
    """
    part, vector = growth.part, jnp.asarray(growth.vector)
    found = optimise(part_of(problem, part), vector, max_steps, callback, target_merit)
    growth = growth._replace(
        steps=growth.steps + len(found.history),
        jacobians=growth.jacobians + found.jacobians,
        seconds=growth.seconds + found.seconds,
        first=growth.first + found.first,
    )
    if found.score <= target_merit:
        step = _FASTER * growth.step
        later = growth._replace(done=part, step=step, vector=found.vector)
        return later._replace(part=min(part + step, 1.0))
    step, done = growth.step / 2, growth.done
    return growth._replace(
        step=step, part=min(done + step, 1.0) if done else part / 2, failed=found
    )


def grow(
    problem: AnyProblem,
    target_merit: float,
    first: float = 0.3,
    step: float = 0.1,
    max_steps: int = 40,
    callback: Callable[[Search], None] = lambda search: None,
) -> Growth:
    """Designs a lens for a part of its fields and aperture, and extends the part to the whole.

    If the whole meets the target, `Growth.done` is 1; start `optimise` from its `vector`.

    problem: the whole problem.
    target_merit: score, as `Optimum.score`, at which a part is accepted; about 16 times the merit
        that is wanted of the whole. A lens that is perfect for a part is a bad start for a larger
        part.
    first: part to begin with.
    step: first step. It grows by a factor of 1.2 after a success and halves after a failure, down
        to 0.002.
    max_steps: largest number of steps for each part.
    callback: called with the search after each step.
    """
    growth = start_growth(problem, first, step)
    while not growth.ended:
        growth = grow_once(problem, growth, target_merit, max_steps, callback)
    return growth
