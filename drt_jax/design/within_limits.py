"""Keeps a lens in training within the limits of a problem."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import matmul
from .problem import Problem, quick

# A limit with a violation up to this counts as met, in the units of `Evaluation.constraints`.
_MET = 1e-4
# Largest number of projections; the number of further evaluations, which halve the step.
_ROUNDS, _HALVINGS = 3, 6


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


def within_limits(problem: Problem, before: Array, after: Array) -> Array:
    """The vector with which an optimiser continues: `after`, changed as little as needed.

    Bounds are clipped. A vector is allowed if its largest violation of a limit is at most 1e-4 or
    that of `before`, if surfaces overlap by no more than at `before`, and if no more rays fail. (A
    number that is not finite counts as an infinite overlap.) While `after` violates a limit, up to
    three Newton steps of least length project it onto the violated limits: with their violations c
    and the Jacobian J of c, a step is -J^T (J J^T)^-1 c. If the vector is still not allowed, a
    backtracking line search halves its step from `before`. If none of nine vectors is allowed, the
    result is `before`. So the lens does not get worse even if limits cannot be met. Works in `jit`.

    problem: its bounds and limits count, its merit does not.
    before, after: (N,), vectors before and after an update.

    Returns (N,).
    """
    problem = quick(problem)
    low, high = problem.variables.low, problem.variables.high
    after = jnp.clip(jnp.where(jnp.isfinite(after), after, before), low, high)

    def projected(vector: Array, violations: Array) -> Array:
        """One Newton step of least length onto the violated limits, within the bounds."""
        slopes = jax.jacfwd(lambda v: problem.evaluate(v).constraints)(vector)
        slopes = jnp.where((violations > 0)[:, None], slopes, 0)
        square = matmul(slopes, slopes.T)
        tiny = jnp.finfo(vector.dtype).eps * (1 + jnp.trace(square))
        square = square + tiny * jnp.eye(len(violations), dtype=vector.dtype)
        step = matmul(slopes.T, jnp.linalg.solve(square, jnp.maximum(violations, 0)))
        return jnp.clip(vector - jnp.where(jnp.isfinite(step), step, 0), low, high)

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
        new = jnp.where(is_first, after, halfway)
        if found.constraints.size:
            violations = found.constraints
            new = jax.lax.cond(projects, projected, lambda v, _: new, state.vector, violations)
        done = ~is_first & jnp.all(now <= allowed)
        return _State(state.tried + 1, jnp.where(done, state.vector, new), allowed, done)

    begun = _State(jnp.zeros((), jnp.int32), before, jnp.zeros(3, before.dtype), jnp.bool_(False))
    last = _ROUNDS + _HALVINGS
    return jax.lax.while_loop(lambda s: ~s.done & (s.tried <= last), next_state, begun).vector
