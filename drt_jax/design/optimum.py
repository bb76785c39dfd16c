"""A problem's optimum: least squares, and limits that hold exactly in the end."""

import time
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..numerics import concrete
from .least_squares import Search, init, promised_gain, step
from .limits import Limit
from .problem import Problem, quick

# What is left of limits when the trials are used up, if it is less than `_NEAR`, is made good in at
# most `_MENDING` trials in which they count so many times more.
_NEAR, _MENDING, _STIFF = 1e-3, 20, 1e4
# Converged is a search if a step that is hardly damped promises less of the merit.
_LEFT = 1e-6
# In its scales no variable goes farther than that.
_FAR = 1e6


Ended = Literal["converged", "target", "steps", "limits", "stuck"]


class Optimum(NamedTuple):
    """What a search came to.

    lens: the best one. vector: (N,). merit: sum of the squares of the residuals; score: with those
    of what exceeds limits. max_violation: by how much the worst limit is exceeded, times its
    weight. limits: all of them by name, the worst first, each in its own unit.
    ended: why: "converged", all limits are kept and next to nothing is to be gained; "target", the
    target merit is reached; "steps", they are used up; "limits", they cannot be kept together;
    "stuck", no trial is better any more, as where surfaces touch, which a limit such as air_edge
    keeps apart.
    history: (T, 3), merit, worst and Jacobians so far by trial. seconds: of all trials but the
    first; first: of that, with compilation if need be.
    """

    lens: Lens
    vector: np.ndarray
    merit: float
    score: float
    max_violation: float
    limits: list[Limit]
    ended: Ended
    history: np.ndarray
    seconds: float
    first: float

    @property
    def converged(self) -> bool:
        """Whether it is an optimum: nothing more is to be gained, and all limits are kept."""
        return self.ended == "converged"

    @property
    def worst_limit(self) -> Limit | None:
        """The limit that is exceeded most or, if none is, the nearest; None without limits."""
        return self.limits[0] if self.limits else None

    @property
    def jacobians(self) -> int:
        """How many were computed."""
        return int(self.history[-1, 2])


@jax.jit
def init_problem(problem: Problem, vector: Array) -> Search:
    """A search from a vector (N,) of a problem's variables."""
    return init(problem.evaluate, vector)


def step_problem(problem: Problem, search: Search) -> Search:
    """One trial more of a problem, unless the search is done."""
    return step(problem.evaluate, search, problem.variables.low, problem.variables.high)


_step = jit(step_problem, LARGE)


def _searched(problem: Problem, tried: Problem, search: Search) -> tuple[Problem, Search]:
    """What to go on with: `tried`, which aims rays, or where the full search of the `problem` finds
    more of them at the best vector, the problem itself, evaluated anew."""
    failed = int(search.evaluation.failed)
    if tried.solver is problem.solver or not failed or int(problem.failed(search.vector)) == failed:
        return tried, search
    again = search._replace(stale=jnp.bool_(True), done=jnp.bool_(False))
    return problem, _step(problem, again)


@jax.jit
def _left(problem: Problem, search: Search) -> Array:
    """What part of the merit a step that is hardly damped promises."""
    return promised_gain(search, problem.variables.low, problem.variables.high)


def _mended(problem: Problem, search: Search) -> Search:
    """A search whose limits are kept, next to one that comes near."""
    stiff = search._replace(
        stale=jnp.bool_(True),
        shift=jnp.zeros_like(search.shift),
        stiffness=jnp.full_like(search.stiffness, _STIFF),
        done=jnp.bool_(False),
    )
    for _ in range(_MENDING):
        stiff = _step(problem, stiff)
        if float(stiff.max_violation) <= 0 or bool(stiff.done):
            break
    return stiff if float(stiff.max_violation) <= 0 else search


def _refuse_fixed(problem: Problem, search: Search) -> None:
    """ValueError for a limit that the start exceeds and no variable moves."""
    excess = np.asarray(search.evaluation.constraints)
    slopes = np.asarray(search.jacobian)[-len(excess) or len(search.jacobian) :]
    if np.any((excess > 0) & (np.max(np.abs(slopes), axis=1, initial=0) * _FAR < excess)):
        beside = _step(problem, init_problem(problem, problem.elsewhere(search.vector)))
        problem.refuse_fixed(excess, beside.evaluation.constraints)


def _refuse_unjudged(search: Search) -> None:
    """ValueError for a search that found no lens that can be judged."""
    if not bool(jnp.isfinite(search.evaluation.overlap)):
        raise ValueError(
            "optimise: the start cannot be judged: no ray of a field passes, or a number is not "
            "finite; begin with weaker curvatures or a smaller stop"
        )


def _why(problem: Problem, search: Search, target_merit: float) -> Ended:
    if target_merit and float(search.score) <= target_merit:
        return "target"
    if not bool(search.done):
        return "steps"
    if float(search.max_violation) > 0:
        return "limits"
    return "converged" if float(_left(problem, search)) <= _LEFT else "stuck"


def optimise(
    problem: Problem,
    vector: Array | None = None,
    max_steps: int = 500,
    callback: Callable[[Search], None] = lambda search: None,
    target_merit: float = 0.0,
) -> Optimum:
    """The optimum next to a vector (N,) of the problem's variables, that of its start by default.

    max_steps: trials at most. callback: called after each. target_merit: the search ends as soon as
    its score, merit plus the squares of what exceeds limits, is no more; 0: at the optimum.

    `Optimum.converged` tells whether it is an optimum, `Optimum.ended` why it is none. If steps
    are used up, limits that are almost kept are made good by some more.

    One program is compiled for a problem, and serves all others that differ in numbers or names
    alone. ValueError if the
    start itself cannot be judged: a lens whose surfaces overlap or of which no number is finite;
    and for a limit of an edge that it exceeds and no variable moves.
    """
    if not concrete((problem, vector)):
        raise ValueError(
            "optimise: call it outside of jax.jit; inside, use least_squares.init and step"
        )
    start = problem.variables.start if vector is None else jnp.asarray(vector)
    low, high = problem.variables.low, problem.variables.high
    tried = quick(problem)
    search = init_problem(tried, jnp.clip(start, low, high))
    begun = time.perf_counter()
    search = jax.block_until_ready(_step(tried, search))
    compiled = time.perf_counter()
    _refuse_fixed(tried, search)
    history = [[search.merit, search.max_violation, search.jacobians]]
    tried, search = _searched(problem, tried, search)
    for _ in range(max_steps - 1):
        search = _step(tried, search)
        history.append([search.merit, search.max_violation, search.jacobians])
        callback(search)
        if search.jacobians > history[-2][2]:  # a better lens
            tried, search = _searched(problem, tried, search)
        if bool(search.done) or float(search.score) <= target_merit:
            break
    _refuse_unjudged(search)
    why = _why(tried, search, target_merit)
    if why != "target" and 0 < float(search.max_violation) <= _NEAR:
        search = _mended(tried, search)
    ended = time.perf_counter()
    limits = sorted(problem.limits(search.evaluation.constraints), key=lambda limit: -limit.excess)
    return Optimum(
        problem.variables.lens_of(search.vector),
        np.asarray(search.vector),
        float(search.merit),
        float(search.score),
        float(search.max_violation),
        limits,
        why,
        np.array(history, float),
        ended - compiled,
        compiled - begun,
    )
