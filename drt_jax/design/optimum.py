"""Optimisation of a problem: least squares with limits that are met exactly."""

import time
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require
from ..lens.edit import named
from ..lens.lens import Lens
from ..numerics import concrete
from ..rays.solve import solve_aimed
from .configurations import AnyProblem, SharedVariables
from .least_squares import Search, init, promised_gain, step
from .limits import Limit, refuse_fixed
from .variables import Variables

# Violations of at most `_NEAR` that remain at the end are removed in at most `_MENDING` more steps,
# in which constraints are multiplied by `_STIFF`.
_NEAR, _MENDING, _STIFF = 1e-3, 20, 1e4
# A search has converged if the relative gain that the linear model promises for a step with little
# damping is at most `_LEFT`.
_LEFT = 1e-6
_AGAIN = ", re-optimised"  # behind the name of a lens: what it says may no longer be true
_promised_gain = jax.jit(promised_gain)
Ended = Literal["converged", "target", "steps", "limits", "stuck"]


class Optimum(NamedTuple):
    """Result of an optimisation.

    lens: the best lens; of several configurations the first, see `Configurations.lenses`. Its name
        says that it is re-optimised, see `named`.
    vector: (N,), its vector.
    merit: sum of the squares of the residuals.
    score: merit plus the squares of the violations of limits.
    max_violation: largest violation of a limit times its weight; 0 if all are met.
    limits: all limits by name, the largest violation first, each in its own unit.
    ended: why the search ended. "converged": all limits are met, and the linear model predicts a
        relative decrease of at most 1e-6. "target": the target merit is reached. "steps": the steps
        are used up. "limits": some limits are not met at the end, for instance because they
        contradict each other. "stuck": all limits are met, but no trial is better, for instance
        because surfaces touch, which a limit such as air_edge prevents; or only the last steps met
        the limits, before the merit had settled.
    history: (T, 3), merit, largest violation and number of Jacobians after each trial.
    seconds: time of all trials except the first.
    first: time of the first trial, with compilation if it is needed, s.
    variables: the variables, which name the numbers of the vector.
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
    variables: Variables | SharedVariables

    def __str__(self) -> str:
        """About ten lines: merit, reason of the end, limits that are active or violated, variables
        with units, and variables at a bound."""
        times = f"{self.jacobians} Jacobians, {self.first:.1f} + {self.seconds:.1f} s"
        active = [limit for limit in self.limits if limit.excess > -1e-6 * (1 + abs(limit.bound))]
        met = "all met" if self.max_violation <= 0 else f"violated by {self.max_violation:.3g}"
        lines = [f"{self.ended}: merit {self.merit:.6g}, score {self.score:.6g}; {times}"]
        if self.limits:
            lines.append(f"  {len(self.limits)} limits, {met}; {len(active)} active")
        lines += [f"    {limit}" for limit in active[:3]]
        return "\n".join([*lines, *self.variables.described(self.vector)])

    @property
    def converged(self) -> bool:
        """True if the search converged to an optimum that meets all limits."""
        return self.ended == "converged"

    @property
    def worst_limit(self) -> Limit | None:
        """The limit with the largest violation; if all are met, the one nearest to its bound; None
        without limits.
        """
        return self.limits[0] if self.limits else None

    @property
    def jacobians(self) -> int:
        """Number of Jacobians computed."""
        return int(self.history[-1, 2])


@jax.jit
def init_problem(problem: AnyProblem, vector: Array) -> Search:
    """The state of a search before the first step from a vector (N,) of the variables."""
    return init(problem.evaluate, vector)


def step_problem(problem: AnyProblem, search: Search) -> Search:
    """One trial of a search for a problem; none if the search is done."""
    return step(problem.evaluate, search, problem.variables.low, problem.variables.high)


take_step = jit(step_problem, LARGE)


def _again(search: Search) -> Search:
    """A search that evaluates its vector again and continues."""
    return search._replace(stale=jnp.bool_(True), done=jnp.bool_(False))


def _mended(problem: AnyProblem, search: Search) -> Search:
    """Continues a search with stiff constraints until all limits are met.

    Returns that search, or the original one if the limits are not met within 20 steps.
    """
    stiff = _again(search)._replace(
        shift=jnp.zeros_like(search.shift), stiffness=jnp.full_like(search.stiffness, _STIFF)
    )
    for _ in range(_MENDING):
        stiff = take_step(problem, stiff)
        if float(stiff.max_violation) <= 0:
            return stiff
        if bool(stiff.done):
            break
    return search


def _why(problem: AnyProblem, search: Search, target_merit: float) -> Ended:
    """Why a search ended, see `Optimum.ended`."""
    if target_merit and float(search.score) <= target_merit:
        return "target"
    if not bool(search.done):
        return "steps"
    if float(search.max_violation) > 0:
        return "limits"
    gain = _promised_gain(search, problem.variables.low, problem.variables.high)
    return "converged" if float(gain) <= _LEFT else "stuck"


def optimise(
    problem: AnyProblem,
    vector: Array | None = None,
    max_steps: int = 500,
    callback: Callable[[Search], None] = lambda search: None,
    target_merit: float = 0.0,
) -> Optimum:
    """Searches for the optimum near a vector by Levenberg and Marquardt's method.

    Read `Optimum.converged` and `Optimum.ended`. Small violations of limits that remain at the end
    are removed by a few more steps.

    problem: the design problem, of one configuration or of several.
    vector: (N,), start of the variables; None for that of the problem.
    max_steps: largest number of trials.
    callback: called with the search after each trial.
    target_merit: the search ends once its score is at most this; 0 to search for the optimum.

    One compiled program serves all problems that differ only in numbers or names. ValueError if the
    start cannot be evaluated (no ray of a field passes, or a number is not finite), for a limit
    that the start violates and that no variable changes, and inside of `jax.jit`.
    """
    what = "optimise: call it outside of jax.jit; inside, use least_squares.init and step"
    require(concrete((problem, vector)), what)
    start = problem.variables.start if vector is None else jnp.asarray(vector)
    tried, history = problem.with_solver(solve_aimed), list[list[Array]]()
    search = init_problem(tried, jnp.clip(start, problem.variables.low, problem.variables.high))
    begun = compiled = time.perf_counter()
    for _ in range(max(max_steps, 1)):
        search = jax.block_until_ready(take_step(tried, search))
        if not history:
            compiled = time.perf_counter()
            slopes = np.asarray(search.jacobian)[search.evaluation.residuals.size :]
            refuse_fixed(tried.limits, search.evaluation.constraints, slopes)
        before = history[-1][2] if history else 0
        history.append([search.merit, search.max_violation, search.jacobians])
        callback(search)
        # The rays of `tried` are only aimed. If the full ray search finds more of those of a better
        # lens, the search continues with it, and evaluates the vector again.
        lost, only_aimed = int(search.evaluation.failed), tried.solver is not problem.solver
        searches = search.jacobians > before and lost and only_aimed
        if searches and int(problem.failed(search.vector)) != lost:
            tried, search = problem, take_step(problem, _again(search))
        ended = bool(search.done) or float(search.score) <= target_merit
        if ended and len(history) > 1:
            break
    what = "optimise: the start cannot be evaluated: no ray of a field passes, or a number is not"
    remedy = "begin with weaker curvatures or a smaller stop"
    require(jnp.isfinite(search.evaluation.overlap), f"{what} finite; {remedy}")
    why = _why(tried, search, target_merit)
    if why != "target" and 0 < float(search.max_violation) <= _NEAR:
        search = _mended(tried, search)
        if why == "limits" and float(search.max_violation) <= 0:
            why = _why(tried, search._replace(done=jnp.bool_(True)), 0.0)
    seconds = time.perf_counter() - compiled
    limits = problem.limits(search.evaluation.constraints)
    lens = problem.variables.lens_of(search.vector)
    if lens.name:
        lens = named(lens, lens.name.removesuffix(_AGAIN) + _AGAIN)
    return Optimum(
        lens,
        np.asarray(search.vector),
        float(search.merit),
        float(search.score),
        float(search.max_violation),
        sorted(limits, key=lambda limit: -limit.excess),
        why,
        np.array(history, float),
        seconds,
        compiled - begun,
        problem.variables,
    )
