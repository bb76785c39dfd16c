"""A problem's optimum: least squares, and limits that hold exactly in the end.

Limits enter as residuals max(0, excess + shift), and each time that the merit has settled, the
shift takes up what is left of the excess: the method of multipliers (Rockafellar 1973), which keeps
limits without weights that would be stiff.
"""

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
from .least_squares import BoundedLM, LMState, promise
from .limits import Limit
from .problem import Judged, Problem, quick

# A merit has settled when less than `_COARSE` of it is to be gained, while limits are still to be
# met, and in the end `_FINE`. A search aims `_WITHIN` inside of its limits, in their own units
# times the weight, so that they are kept where it comes as near as that.
_COARSE, _FINE, _WITHIN = 1e-5, 1e-13, 1e-9
_ROUNDS = 30
# What is left of limits when the trials are used up, if it is less than `_NEAR`, is made good in at
# most `_MENDING` trials in which they count so many times more.
_NEAR, _MENDING, _STIFF = 1e-3, 20, 1e4
# Converged is a search if a step that is hardly damped promises less of the merit.
_LEFT = 1e-6
# In its scales no variable goes farther than that.
_FAR = 1e6


class Search(NamedTuple):
    """A search for an optimum, as far as it has come.

    vector: (N,), the best so far. state: of the method. shift: (L,), of the limits; stiffness: (),
    how much they count. rounds: (), how often limits were shifted. fine: (), whether limits are met
    and the last digits are sought. done: (), whether nothing more is to be gained.
    """

    vector: Array
    state: LMState
    shift: Array
    stiffness: Array
    rounds: Array
    fine: Array
    done: Array

    @property
    def judged(self) -> Judged:
        """The best vector judged."""
        return self.state.kept

    @property
    def merit(self) -> Array:
        """Sum of the squares of its residuals, ()."""
        return jnp.sum(self.judged.residuals**2, axis=-1)

    @property
    def worst(self) -> Array:
        """By how much the worst limit is exceeded, (); 0 or less where all are kept."""
        return jnp.max(self.judged.excess, axis=-1, initial=0.0)

    @property
    def score(self) -> Array:
        """Merit plus the squares of what exceeds limits, (); inf for a lens that is unphysical."""
        found = self.merit + jnp.sum(jnp.maximum(self.judged.excess, 0) ** 2, axis=-1)
        good = jnp.isfinite(found) & jnp.isfinite(self.state.broken)
        return jnp.where(good, found, jnp.inf)


def _wanted(vector: Array, args: tuple[Problem, Array, Array]) -> tuple[Array, tuple]:
    problem, shift, stiffness = args
    judged = problem.judge(vector)
    limits = stiffness * (judged.excess + _WITHIN + shift)
    return jnp.concatenate([judged.residuals, limits]), (judged.broken, judged)


def begin(problem: Problem, vector: Array) -> Search:
    """A search from a vector (N,) of its variables; nothing is evaluated yet."""
    judged = jax.eval_shape(problem.judge, vector)
    shift = jnp.zeros(judged.excess.shape, vector.dtype)
    count = judged.residuals.size + shift.size
    wanted = jax.ShapeDtypeStruct((count,), vector.dtype)
    state = _method(shift.size).init(None, vector, None, {}, wanted, (None, judged), frozenset())
    no = jnp.bool_(False)
    one = jnp.ones((), vector.dtype)
    return Search(vector, state, shift, one, jnp.zeros((), jnp.int32), no, no)


def _method(limits: int) -> BoundedLM:
    return BoundedLM(rtol=_FINE, atol=0.0, limits=limits)


def turn(problem: Problem, search: Search) -> Search:
    """One trial more, unless the search is done."""
    variables = problem.variables
    options = {"lower": variables.low, "upper": variables.high}
    args = problem, search.shift, search.stiffness
    method = _method(search.shift.size)
    vector, state, _ = method.step(_wanted, search.vector, args, options, search.state, frozenset())
    ended, _ = method.terminate(_wanted, vector, args, options, state, frozenset())
    excess = state.kept.excess
    met = jnp.max(excess, initial=0.0) <= 0
    settled = ended | (~search.fine & ~state.fresh & (jnp.abs(state.gain) < _COARSE))
    shifts = settled & ~met & (search.rounds < _ROUNDS)
    shift = jnp.where(shifts, jnp.maximum(excess + _WITHIN + search.shift, 0), search.shift)
    state = state._replace(fresh=shifts)
    fine = met & (search.fine | settled)
    done = search.done | (ended & ~shifts)
    rounds = search.rounds + shifts.astype(jnp.int32)
    new = Search(vector, state, shift, search.stiffness, rounds, fine, done)
    return jax.tree.map(lambda a, b: jnp.where(search.done, a, b), search, new)


Ended = Literal["converged", "good", "trials", "limits", "stuck"]


class Optimum(NamedTuple):
    """What a search came to.

    lens: the best one. vector: (N,). merit: sum of the squares of the residuals; score: with those
    of what exceeds limits. worst: by how much the worst limit is exceeded, times its weight.
    limits: all of them by name, the worst first, each in its own unit. ended: why: "converged", all
    limits are kept and next to nothing is to be gained; "good", as it was asked to; "trials", that
    are used up; "limits", that cannot be kept together; "stuck", no trial is better any more, as
    where surfaces touch, which a limit such as air_edge keeps apart.
    history: (T, 3), merit, worst and Jacobians so far by trial. seconds: of all trials but the
    first; first: of that, with compilation if need be.
    """

    lens: Lens
    vector: np.ndarray
    merit: float
    score: float
    worst: float
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


_begin = jax.jit(begin)
_turn = jit(turn, LARGE)


def _searched(problem: Problem, tried: Problem, search: Search) -> tuple[Problem, Search]:
    """What to go on with: `tried`, which aims rays, or where the full search of the `problem` finds
    more of them at the best vector, the problem itself, evaluated anew."""
    failed = int(search.judged.failed)
    if tried.solver is problem.solver or not failed or int(problem.failed(search.vector)) == failed:
        return tried, search
    state = search.state._replace(fresh=jnp.bool_(True))
    return problem, _turn(problem, search._replace(state=state, done=jnp.bool_(False)))


@jax.jit
def _left(problem: Problem, search: Search) -> Array:
    """What part of the merit a step that is hardly damped promises."""
    bounds = problem.variables.low, problem.variables.high
    return promise(search.vector, search.state, *bounds, search.shift.size)


def _mended(problem: Problem, search: Search) -> Search:
    """A search whose limits are kept, next to one that comes near."""
    stiff = search._replace(
        state=search.state._replace(fresh=jnp.bool_(True)),
        shift=jnp.zeros_like(search.shift),
        stiffness=jnp.full_like(search.stiffness, _STIFF),
        done=jnp.bool_(False),
    )
    for _ in range(_MENDING):
        stiff = _turn(problem, stiff)
        if float(stiff.worst) <= 0 or bool(stiff.done):
            break
    return stiff if float(stiff.worst) <= 0 else search


def _refuse_fixed(problem: Problem, search: Search) -> None:
    """ValueError for a limit that the start exceeds and no variable moves."""
    excess = np.asarray(search.judged.excess)
    slopes = np.asarray(search.state.jacobian)[-len(excess) or len(search.state.jacobian) :]
    if np.any((excess > 0) & (np.max(np.abs(slopes), axis=1, initial=0) * _FAR < excess)):
        beside = _turn(problem, _begin(problem, problem.elsewhere(search.vector)))
        problem.refuse_fixed(excess, beside.judged.excess)


def _refuse_unjudged(search: Search) -> None:
    """ValueError for a search that found no lens that can be judged."""
    if not bool(jnp.isfinite(search.state.broken)):
        raise ValueError(
            "optimise: the start cannot be judged: no ray of a field passes, or a number is not "
            "finite; begin with weaker curvatures or a smaller stop"
        )


def _why(problem: Problem, search: Search, good: float) -> Ended:
    if good and float(search.score) <= good:
        return "good"
    if not bool(search.done):
        return "trials"
    if float(search.worst) > 0:
        return "limits"
    return "converged" if float(_left(problem, search)) <= _LEFT else "stuck"


def optimise(
    problem: Problem,
    vector: Array | None = None,
    trials: int = 500,
    report: Callable[[Search], None] = lambda search: None,
    good: float = 0.0,
) -> Optimum:
    """The optimum next to a vector (N,) of the problem's variables, that of its start by default.

    trials: at most. report: called after each, to show how far it is. good: the search ends as soon
    as its merit plus the squares of what exceeds limits is no more; 0: at the optimum. For a part
    of a field or an aperture that shall grow, some 16 times the merit that the whole is to have: a
    lens that is perfect for a part is spoilt for more.

    `Optimum.converged` tells whether it is an optimum, `Optimum.ended` why it is none. If trials
    are used up, limits that are almost kept are made good by some more.

    One program is compiled for a problem, and serves all others of its kind. ValueError if the
    start itself cannot be judged: a lens whose surfaces overlap or of which no number is finite;
    and for a limit of an edge that it exceeds and no variable moves.
    """
    if not concrete((problem, vector)):
        raise ValueError("optimise: call it outside of jax.jit; inside, use begin and turn")
    start = problem.variables.start if vector is None else jnp.asarray(vector)
    low, high = problem.variables.low, problem.variables.high
    tried = quick(problem)
    search = _begin(tried, jnp.clip(start, low, high))
    begun = time.perf_counter()
    search = jax.block_until_ready(_turn(tried, search))
    compiled = time.perf_counter()
    _refuse_fixed(tried, search)
    history = [[search.merit, search.worst, search.state.jacobians]]
    tried, search = _searched(problem, tried, search)
    for _ in range(trials - 1):
        search = _turn(tried, search)
        history.append([search.merit, search.worst, search.state.jacobians])
        report(search)
        if search.state.jacobians > history[-2][2]:  # a better lens
            tried, search = _searched(problem, tried, search)
        if bool(search.done) or float(search.score) <= good:
            break
    _refuse_unjudged(search)
    why = _why(tried, search, good)
    if why != "good" and 0 < float(search.worst) <= _NEAR:
        search = _mended(tried, search)
    ended = time.perf_counter()
    limits = sorted(problem.limits(search.judged.excess), key=lambda limit: -limit.excess)
    return Optimum(
        problem.variables.lens_of(search.vector),
        np.asarray(search.vector),
        float(search.merit),
        float(search.score),
        float(search.worst),
        limits,
        why,
        np.array(history, float),
        ended - compiled,
        compiled - begun,
    )
