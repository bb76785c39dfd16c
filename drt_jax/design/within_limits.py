"""Keeps a lens in training within the limits of a problem."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import matmul
from .problem import Problem, quick

# Largest violation that counts as met, in the units of `Evaluation.constraints`.
_MET = 1e-4
# Steps of the projection, and halvings of the way back.
_ROUNDS, _HALVINGS = 3, 6


class _Turn(NamedTuple):
    """State of the search.

    tried: (), int32, vectors evaluated so far.
    vector: (N,), to be evaluated next.
    allowed: (3,), largest violation, overlap and number of failed rays.
    done: (), bool, True if the vector is allowed.
    """

    tried: Array
    vector: Array
    allowed: Array
    done: Array


def within_limits(problem: Problem, before: Array, after: Array) -> Array:
    """The vector (N,) that an optimiser goes on with: `after`, changed as little as needed.

    problem: its bounds and limits count, its merit does not.
    before, after: (N,), vectors before and after an update.

    Bounds are clipped. If a limit is violated, Newton steps of least length lead back onto it. If
    that still leaves a limit violated, surfaces that overlap, rays that fail or a number that is
    not finite, and more than before, the way from `before` is halved; after six halvings `before`
    stays. Without a limit that can be met, the lens at least gets no worse. Works in `jit`.
    """
    problem = quick(problem)
    low, high = problem.variables.low, problem.variables.high
    after = jnp.clip(jnp.where(jnp.isfinite(after), after, before), low, high)

    def onto(vector: Array, beyond: Array) -> Array:
        slopes = jax.jacfwd(lambda v: problem.evaluate(v).constraints)(vector)
        slopes = jnp.where((beyond > 0)[:, None], slopes, 0)
        square = matmul(slopes, slopes.T)
        tiny = jnp.finfo(vector.dtype).eps * (1 + jnp.trace(square))
        square = square + tiny * jnp.eye(len(beyond), dtype=vector.dtype)
        step = matmul(slopes.T, jnp.linalg.solve(square, jnp.maximum(beyond, 0)))
        return jnp.clip(vector - jnp.where(jnp.isfinite(step), step, 0), low, high)

    def turn(state: _Turn) -> _Turn:
        # One loop evaluates everything, so that the trace stands once in the program.
        found = problem.evaluate(state.vector)
        most = jnp.max(found.constraints, initial=0.0)
        now = jnp.stack([most, found.overlap, found.failed.astype(most.dtype)])
        is_first = state.tried == 0
        allowed = jnp.where(
            is_first, jnp.maximum(now, jnp.array([_MET, 0.0, 0.0], now.dtype)), state.allowed
        )
        projects = (state.tried <= _ROUNDS) & (most > 0) & ~is_first
        back = jnp.where(state.tried < _ROUNDS + _HALVINGS, (before + state.vector) / 2, before)
        new = jnp.where(is_first, after, back)
        if found.constraints.size:
            beyond = found.constraints
            new = jax.lax.cond(projects, onto, lambda v, _: new, state.vector, beyond)
        done = ~is_first & jnp.all(now <= allowed)
        return _Turn(state.tried + 1, jnp.where(done, state.vector, new), allowed, done)

    begun = _Turn(jnp.zeros((), jnp.int32), before, jnp.zeros(3, before.dtype), jnp.bool_(False))
    last = _ROUNDS + _HALVINGS
    return jax.lax.while_loop(lambda s: ~s.done & (s.tried <= last), turn, begun).vector
