"""Levenberg and Marquardt's method within bounds, on exact Jacobians.

More, The Levenberg-Marquardt algorithm (1978): damping in units of the largest column norms seen;
Nielsen, Damping parameter in Marquardt's method (1999): its size by the gain of each trial. Numbers
that meet a bound are held there while the merit would fall beyond it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jax import Array

from ..numerics import run_if, safe_divide

_DAMPING, _MOST_DAMPING = 1e-3, 1e16
_PARTS = (1.0, 0.5, 0.25, 0.1, 0.03)
_HOLDS = 5  # how often what is held at a bound, and which limits count, is asked in one step


class LMState(NamedTuple):
    """residuals (M,), jacobian (M, N) and merit () at the best vector so far; broken: by how much
    it is unphysical. scale: (N,), largest column norms. damping, growth: (). gain: what the model
    promised of the last trial, relative to the merit. jacobians, trials: (), int32. fresh: nothing
    is evaluated yet, or what is wanted has changed. kept: what else the function told there."""

    residuals: Array
    jacobian: Array
    merit: Array
    broken: Array
    scale: Array
    damping: Array
    growth: Array
    gain: Array
    jacobians: Array
    trials: Array
    fresh: Array
    kept: Any


class BoundedLM(optx.AbstractLeastSquaresSolver):
    """Least squares within bounds.

    `fn(y, args)` returns residuals (M,) and, as its auxiliary output, by how much y (N,) is
    unphysical, (), and a tree of arrays to keep. The last `limits` of the residuals are one-sided:
    they count where they are above 0. A trial is taken if the merit, the sum of the squares of what
    counts, falls and y is no more unphysical than before. Options: "lower" and "upper", (N,). Ends
    when the model promises less than `rtol` of the merit, when that is below `atol`, or when no
    trial is taken any more (RESULTS.nonlinear_divergence).
    """

    rtol: float
    atol: float
    limits: int = 0
    norm: Callable = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> LMState:
        """Nothing is evaluated yet."""
        one, count = jnp.ones((), y.dtype), jnp.zeros((), jnp.int32)
        residuals = jnp.zeros(f_struct.shape, y.dtype)
        infinite = jnp.inf * one
        return LMState(
            residuals,
            jnp.zeros((residuals.size, y.size), y.dtype),
            *(infinite, infinite, jnp.zeros_like(y), _DAMPING * one, 2 * one, infinite),
            *(count, count, jnp.bool_(True)),
            jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), aux_struct[1]),
        )

    def step(self, fn, y, args, options, state, tags) -> tuple[Array, LMState, Any]:
        """One trial, and if it is taken, the Jacobian there."""
        lower, upper = options["lower"], options["upper"]
        sided = jnp.arange(state.residuals.size) >= state.residuals.size - self.limits
        move, promised = _proposal(y, state, lower, upper, sided)
        trial = jnp.where(state.fresh, y, jnp.clip(y + move, lower, upper))
        residuals, push, aux = jax.linearize(lambda y: fn(y, args), trial, has_aux=True)
        broken, told = aux
        merit = jnp.sum(_counting(residuals, sided) ** 2)
        finite = jnp.isfinite(merit) & jnp.isfinite(broken)
        better = finite & (merit < state.merit) & (broken <= state.broken)
        taken = state.fresh | better
        ratio = safe_divide(state.merit - merit, promised)
        units = jnp.eye(y.size, dtype=y.dtype)
        jacobian = run_if(taken, lambda _: jax.vmap(push, out_axes=1)(units), state.jacobian)
        jacobian = jnp.where(jnp.isfinite(jacobian), jacobian, 0)
        kept = (residuals, merit, broken, jnp.sqrt(jnp.sum(jacobian**2, axis=0)))
        old = state.residuals, state.merit, state.broken, state.scale
        residuals, merit, broken, scale = (jnp.where(taken, a, b) for a, b in zip(kept, old))
        shrink = jnp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3)
        damping = jnp.where(better, state.damping * shrink, state.damping * state.growth)
        new = LMState(
            residuals,
            jacobian,
            merit,
            broken,
            scale,
            jnp.where(state.fresh, state.damping, damping),
            jnp.where(better | state.fresh, 2, 2 * state.growth),
            jnp.where(state.fresh, jnp.inf, safe_divide(promised, state.merit)),
            state.jacobians + taken.astype(jnp.int32),
            state.trials + 1,
            jnp.bool_(False),
            jax.tree.map(lambda a, b: jnp.where(taken, a, b), told, state.kept),
        )
        return jnp.where(taken, trial, y), new, aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Array, optx.RESULTS]:
        """Whether nothing more is to be gained, or no trial is taken any more."""
        small = ((state.gain >= 0) & (state.gain <= self.rtol)) | (state.merit <= self.atol)
        stuck = state.damping > _MOST_DAMPING
        results = optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        return ~state.fresh & (small | stuck), optx.RESULTS.where(stuck & ~small, *results)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Nothing to add."""
        return y, aux, {"num_jacobians": state.jacobians}


def _counting(residuals: Array, sided: Array) -> Array:
    """The residuals (M,), 0 where they are one-sided and not above 0."""
    return jnp.where(sided, jnp.maximum(residuals, 0), residuals)


def _proposal(
    y: Array, state: LMState, lower: Array, upper: Array, sided: Array
) -> tuple[Array, Array]:
    """The damped step within the bounds, and by how much the model has the merit fall. Which limits
    count, and which numbers are held at a bound, follows from where the step leads."""
    scale = jnp.where(state.scale > 0, state.scale, 1)
    move, held = jnp.zeros_like(y), jnp.zeros(y.shape, bool)
    for turn in range(_HOLDS):
        ahead = state.residuals + state.jacobian @ move
        counts = (~sided | (ahead > 0)).astype(y.dtype)
        gradient = state.jacobian.T @ (counts * state.residuals)
        square = state.jacobian.T @ (counts[:, None] * state.jacobian)
        if not turn:
            held = ((y <= lower) & (gradient > 0)) | ((y >= upper) & (gradient < 0))
        # In units of the columns' norms; what is held moves as far as it does already.
        free = (~held).astype(y.dtype)
        matrix = square / scale[:, None] / scale[None] * free[:, None] * free[None]
        matrix = matrix + jnp.diag(state.damping * free + (1 - free))
        right = -(gradient + square @ (move * (1 - free))) / scale * free
        step = jax.scipy.linalg.solve(matrix, right, assume_a="pos") / scale
        move = jnp.where(held, move, step)
        held = held | (y + move < lower) | (y + move > upper)
        move = jnp.clip(y + move, lower, upper) - y
    move = jnp.where(jnp.isfinite(move), move, 0)
    # Where that goes round in circles, a part of the step is better than all of it.
    parts = jnp.asarray(_PARTS, y.dtype)
    ahead = state.residuals[:, None] + (state.jacobian @ move)[:, None] * parts[None]
    merits = jnp.sum(_counting(ahead, sided[:, None]) ** 2, axis=0)
    best = jnp.argmin(merits)
    return parts[best] * move, jnp.sum(_counting(state.residuals, sided) ** 2) - merits[best]


def promise(y: Array, state: LMState, lower: Array, upper: Array, limits: int) -> Array:
    """What part of the merit, (), a step from y that is hardly damped is promised to gain; the last
    `limits` of the residuals are one-sided."""
    sided = jnp.arange(state.residuals.size) >= state.residuals.size - limits
    state = state._replace(damping=jnp.full_like(state.damping, _DAMPING))
    gain = _proposal(y, state, lower, upper, sided)[1]
    return safe_divide(jnp.abs(gain), state.merit)
