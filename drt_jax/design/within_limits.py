"""Keeps a lens in training within the limits of a problem."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import matmul, safe_divide, safe_sqrt
from ..rays.solve import solve_aimed
from .configurations import AnyProblem

# A limit with a violation up to this counts as met, in the units of `Evaluation.constraints`.
_MET = 1e-4
# Largest number of projections; the number of further evaluations, which halve the step.
_ROUNDS, _HALVINGS = 3, 6
# Of `nearest`: largest number of turns for each row.
_TURNS = 5


class _State(NamedTuple):
    """State of the search.

    tried: (), int32, number of vectors evaluated so far.
    vector: (N,), to be evaluated next.
    allowed: (3,), allowed violation, overlap and number of failed rays.
    done: (), bool, True if the vector is allowed.
    """

    tried: Array
    vector: Array
    allowed: Array
    done: Array


def nearest(vector: Array, metric: Array, rows: Array, most: Array) -> Array:
    """Projection of a vector v onto rows @ x <= most: the x that minimises
    (x - v)^T metric (x - v).

    By the Kuhn-Tucker conditions x = v - metric^-1 rows^T u, with a multiplier u >= 0 for each row
    that is 0 unless the row is active. For active rows, G u = rows v - most with
    G = rows metric^-1 rows^T. This is the active-set method of non-negative least squares: add the
    row that is violated most, solve for u, and remove rows whose multiplier would become negative,
    until no row is violated. It always ends (Lawson and Hanson, Solving Least Squares Problems,
    1974, ch. 23).

    vector: (N,). metric: (N, N), positive definite. rows: (L, N). most: (L,); inf for no limit.
    """
    back = jnp.linalg.solve(metric, rows.T)
    size = safe_sqrt(jnp.diagonal(matmul(rows, back)))
    unit = safe_divide(jnp.ones_like(size), size)  # 0 for a row of zeros
    back, over = back * unit[None], (matmul(rows, vector) - most) * unit
    square = matmul(rows, back) * unit[:, None]
    count, one = len(most), jnp.eye(len(most), dtype=vector.dtype)
    eps = float(jnp.finfo(vector.dtype).eps)
    tiny = eps * one  # keeps the matrix regular if rows are parallel
    exact = eps**0.5 / 16  # a row is met up to this fraction of the largest multiplier

    def turn(state: tuple) -> tuple:
        push, active, _, turns = state
        both = active[:, None] & active[None]
        wanted = jnp.linalg.solve(jnp.where(both, square, one) + tiny, jnp.where(active, over, 0))
        fits = jnp.all(~active | (wanted > 0))
        left = jnp.where(active, -jnp.inf, over - matmul(square, wanted))
        worst = jnp.argmax(left)
        ends = fits & (left[worst] <= exact * jnp.max(jnp.abs(wanted), initial=0.0))
        # Shorten the step so that no multiplier becomes negative: one of them becomes 0.
        part = jnp.where(active & (wanted <= 0), safe_divide(push, push - wanted), 1.0)
        some = push + jnp.min(part) * (wanted - push)
        kept = active & (jnp.arange(count) != jnp.argmin(part)) & (some > 0)
        grown = active | (jnp.arange(count) == worst)
        new = jnp.where(fits, wanted, jnp.where(kept, some, 0))
        return new, jnp.where(fits, jnp.where(ends, active, grown), kept), ends, turns + 1

    start = jnp.zeros_like(most), jnp.zeros(count, bool), jnp.bool_(False), 0
    goes_on = lambda state: ~state[2] & (state[3] < _TURNS * count)  # noqa: E731
    push = jax.lax.while_loop(goes_on, turn, start)[0]
    return vector - matmul(back, push)


def within_limits(
    problem: AnyProblem, before: Array, after: Array, metric: Array | None = None
) -> Array:
    """The vector with which an optimiser continues: `after`, changed as little as needed.

    A vector is allowed if its largest violation of a limit is at most 1e-4 or that of `before`, if
    surfaces overlap by no more than at `before`, and if no more rays fail. (A number that is not
    finite counts as an infinite overlap.) While the vector nearest to `after` within the bounds
    violates a limit, up to three rounds take the one nearest to `after` within the bounds and the
    limits, which are linearised at the last vector. If it is still not allowed, a backtracking line
    search halves its step from `before`. If none of nine vectors is allowed, the result is
    `before`. So violations do not grow even if limits cannot be met. Works in `jit`.

    problem: its bounds and limits count, its merit does not.
    before, after: (N,), vectors before and after an update.
    metric: (N, N), positive definite; the squared length of a change d is d^T metric d. None: the
        unit matrix, in the units of the variables. If the changes of many variables in a step
        compensate each other, use the metric of the optimiser, see `RaySteps`.

    Returns (N,).
    """
    problem = problem.with_solver(solve_aimed)
    low, high = problem.variables.low, problem.variables.high
    after = jnp.where(jnp.isfinite(after), after, before)
    one = jnp.eye(len(after), dtype=after.dtype)
    bounds, ends = jnp.concatenate([one, -one]), jnp.concatenate([high, -low])
    metric = one if metric is None else metric
    wanted = jnp.clip(nearest(after, metric, bounds, ends), low, high)

    def projected(vector: Array, violations: Array) -> Array:
        """The vector nearest to `after` within bounds and limits, linear about `vector`."""
        slopes = jax.jacfwd(lambda v: problem.evaluate(v).constraints)(vector)
        most = jnp.concatenate([matmul(slopes, vector) - violations, ends])
        found = nearest(after, metric, jnp.concatenate([slopes, bounds]), most)
        return jnp.clip(jnp.where(jnp.isfinite(found), found, vector), low, high)

    def next_state(state: _State) -> _State:
        """Evaluates a vector, and chooses the next one if it is not allowed."""
        # `before` is evaluated in the same loop, so that the program contains the trace only once.
        found = problem.evaluate(state.vector)
        most = jnp.max(found.constraints, initial=0.0)
        now = jnp.stack([most, found.overlap, found.failed.astype(most.dtype)])
        is_first = state.tried == 0
        allowed = jnp.where(
            is_first, jnp.maximum(now, jnp.array([_MET, 0.0, 0.0], now.dtype)), state.allowed
        )
        projects = (state.tried <= _ROUNDS) & (most > 0) & ~is_first
        halfway = jnp.where(state.tried < _ROUNDS + _HALVINGS, (before + state.vector) / 2, before)
        new = jnp.where(is_first, wanted, halfway)
        if found.constraints.size:
            violations = found.constraints
            new = jax.lax.cond(projects, projected, lambda v, _: new, state.vector, violations)
        done = ~is_first & jnp.all(now <= allowed)
        return _State(state.tried + 1, jnp.where(done, state.vector, new), allowed, done)

    begun = _State(jnp.zeros((), jnp.int32), before, jnp.zeros(3, before.dtype), jnp.bool_(False))
    last = _ROUNDS + _HALVINGS
    return jax.lax.while_loop(lambda s: ~s.done & (s.tried <= last), next_state, begun).vector
