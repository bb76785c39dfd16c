"""Least squares by Levenberg and Marquardt's method within bounds, on exact Jacobians.

More, The Levenberg-Marquardt algorithm (1978): damping in units of the largest column norms seen;
Nielsen, Damping parameter in Marquardt's method (1999): its size by the gain of each trial. Numbers
that meet a bound are fixed there while the merit would fall beyond it.

Constraints c <= 0 enter as one-sided residuals max(0, c + shift). Each time that the merit has
settled, the shift takes up what is left of c: the method of multipliers (Rockafellar 1973), which
keeps constraints without weights that would be stiff.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import run_if, safe_divide

_DAMPING, _MOST_DAMPING = 1e-3, 1e16
_PARTS = (1.0, 0.5, 0.25, 0.1, 0.03)
_SETS = 5  # how often what is fixed at a bound, and which constraints count, is asked in one step
# A merit has settled when less than `_COARSE` of it is to be gained, while constraints are still to
# be met, and in the end `_FINE`. A search aims `_WITHIN` inside of its constraints, in their own
# units, so that they are kept where it comes as near as that.
_COARSE, _FINE, _WITHIN = 1e-5, 1e-13, 1e-9
_ROUNDS = 30


class Evaluation(NamedTuple):
    """What a function says of a vector, such as a problem of a lens.

    residuals: (M,), whose squares add up to the merit.
    constraints: (L,), by how much values are beyond their limits, times their weights; kept where
        they are 0 or less.
    overlap: (), by how much it is unphysical: how far surfaces overlap within the light, mm; inf
        where a number is not finite.
    failed: (), int32, how many rays fail.
    """

    residuals: Array
    constraints: Array
    overlap: Array
    failed: Array


Function = Callable[[Array], Evaluation]


class Search(NamedTuple):
    """A search for an optimum, as far as it has come.

    vector: (N,), the best so far. evaluation: of it. residuals: (M + L,), with those of the
    constraints; jacobian: (M + L, N); total: (), the sum of the squares of what counts.
    scale: (N,), the largest column norms seen. damping, growth: (). gain: (), what the model
    promised of the last trial, relative to the total. jacobians, steps: (), int32.
    stale: (), whether the vector must be evaluated first: at the start, and when what is asked
    changes. shift: (L,), of the constraints; stiffness: (), how much they count. rounds: (), how
    often they were shifted. fine: (), whether constraints are met and the last digits are sought.
    done: (), whether nothing more is to be gained.
    """

    vector: Array
    evaluation: Evaluation
    residuals: Array
    jacobian: Array
    total: Array
    scale: Array
    damping: Array
    growth: Array
    gain: Array
    jacobians: Array
    steps: Array
    stale: Array
    shift: Array
    stiffness: Array
    rounds: Array
    fine: Array
    done: Array

    @property
    def merit(self) -> Array:
        """Sum of the squares of the residuals without constraints, ()."""
        return jnp.sum(self.evaluation.residuals**2, axis=-1)

    @property
    def max_violation(self) -> Array:
        """By how much the worst constraint is exceeded, (); 0 where all are kept."""
        return jnp.max(self.evaluation.constraints, axis=-1, initial=0.0)

    @property
    def score(self) -> Array:
        """Merit plus the squares of what exceeds constraints, (); inf for an unphysical lens."""
        exceeded = jnp.maximum(self.evaluation.constraints, 0)
        score = self.merit + jnp.sum(exceeded**2, axis=-1)
        physical = jnp.isfinite(score) & jnp.isfinite(self.evaluation.overlap)
        return jnp.where(physical, score, jnp.inf)


def init(function: Function, vector: Array) -> Search:
    """A search from a vector (N,); nothing is evaluated yet."""
    values = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(function, vector))
    count, dtype = values.residuals.size + values.constraints.size, vector.dtype
    one, zero, no = jnp.ones((), dtype), jnp.zeros((), jnp.int32), jnp.bool_(False)
    return Search(
        vector=vector,
        evaluation=values._replace(overlap=jnp.inf * one),
        residuals=jnp.zeros(count, dtype),
        jacobian=jnp.zeros((count, vector.size), dtype),
        total=jnp.inf * one,
        scale=jnp.zeros_like(vector),
        damping=_DAMPING * one,
        growth=2 * one,
        gain=jnp.inf * one,
        jacobians=zero,
        steps=zero,
        stale=jnp.bool_(True),
        shift=jnp.zeros_like(values.constraints),
        stiffness=one,
        rounds=zero,
        fine=no,
        done=no,
    )


def step(function: Function, search: Search, low: Array, high: Array) -> Search:
    """One trial more within bounds (N,), unless the search is done.

    A trial is taken if the total falls and it is no more unphysical; then the Jacobian is computed
    there. Done when the model promises less than 1e-13 of the total, or no trial is taken any more,
    and constraints are met or were shifted 30 times.
    """
    new = _shifted(_tried(function, search, low, high))
    return jax.tree.map(lambda a, b: jnp.where(search.done, a, b), search, new)


def _tried(function: Function, search: Search, low: Array, high: Array) -> Search:
    """One trial, and if it is taken, the Jacobian there."""

    def residuals_of(vector: Array) -> tuple[Array, Evaluation]:
        values = function(vector)
        limits = search.stiffness * (values.constraints + _WITHIN + search.shift)
        return jnp.concatenate([values.residuals, limits]), values

    sided = _sided(search)
    move, promised = _proposal(search, low, high)
    vector = jnp.where(search.stale, search.vector, jnp.clip(search.vector + move, low, high))
    residuals, push, values = jax.linearize(residuals_of, vector, has_aux=True)
    total = jnp.sum(_counting(residuals, sided) ** 2)
    finite = jnp.isfinite(total) & jnp.isfinite(values.overlap)
    better = finite & (total < search.total) & (values.overlap <= search.evaluation.overlap)
    taken = search.stale | better
    ratio = safe_divide(search.total - total, promised)
    units = jnp.eye(vector.size, dtype=vector.dtype)
    jacobian = run_if(taken, lambda _: jax.vmap(push, out_axes=1)(units), search.jacobian)
    jacobian = jnp.where(jnp.isfinite(jacobian), jacobian, 0)
    shrink = jnp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3)
    damping = jnp.where(better, search.damping * shrink, search.damping * search.growth)

    def best(new: Any, old: Any) -> Any:
        return jax.tree.map(lambda a, b: jnp.where(taken, a, b), new, old)

    return search._replace(
        vector=best(vector, search.vector),
        evaluation=best(values, search.evaluation),
        residuals=best(residuals, search.residuals),
        jacobian=jacobian,
        total=best(total, search.total),
        scale=best(jnp.sqrt(jnp.sum(jacobian**2, axis=0)), search.scale),
        damping=jnp.where(search.stale, search.damping, damping),
        growth=jnp.where(taken, 2, 2 * search.growth),
        gain=jnp.where(search.stale, jnp.inf, safe_divide(promised, search.total)),
        jacobians=search.jacobians + taken.astype(jnp.int32),
        steps=search.steps + 1,
        stale=jnp.bool_(False),
    )


def _shifted(search: Search) -> Search:
    """The multipliers: where the merit has settled, constraints that are exceeded are shifted."""
    constraints = search.evaluation.constraints
    small = ((search.gain >= 0) & (search.gain <= _FINE)) | (search.total <= 0)
    ended = small | (search.damping > _MOST_DAMPING)
    met = jnp.max(constraints, initial=0.0) <= 0
    settled = ended | (~search.fine & (jnp.abs(search.gain) < _COARSE))
    shifts = settled & ~met & (search.rounds < _ROUNDS)
    shift = jnp.maximum(constraints + _WITHIN + search.shift, 0)
    return search._replace(
        stale=shifts,
        shift=jnp.where(shifts, shift, search.shift),
        rounds=search.rounds + shifts.astype(jnp.int32),
        fine=met & (search.fine | settled),
        done=search.done | (ended & ~shifts),
    )


def _counting(residuals: Array, sided: Array) -> Array:
    """The residuals (M,), 0 where they are one-sided and not above 0."""
    return jnp.where(sided, jnp.maximum(residuals, 0), residuals)


def _sided(search: Search) -> Array:
    """Which residuals (M + L,) are those of constraints."""
    count = search.residuals.shape[-1]
    return jnp.arange(count) >= count - search.shift.shape[-1]


def _proposal(search: Search, low: Array, high: Array) -> tuple[Array, Array]:
    """The damped step within the bounds, and by how much the model has the total fall. Which
    constraints count, and which numbers are fixed at a bound, follows from where the step leads."""
    y, sided = search.vector, _sided(search)
    scale = jnp.where(search.scale > 0, search.scale, 1)
    move, fixed = jnp.zeros_like(y), jnp.zeros(y.shape, bool)
    for k in range(_SETS):
        model = search.residuals + search.jacobian @ move
        counts = (~sided | (model > 0)).astype(y.dtype)
        gradient = search.jacobian.T @ (counts * search.residuals)
        square = search.jacobian.T @ (counts[:, None] * search.jacobian)
        if not k:
            fixed = ((y <= low) & (gradient > 0)) | ((y >= high) & (gradient < 0))
        # In units of the columns' norms; what is fixed moves as far as it does already.
        free = (~fixed).astype(y.dtype)
        matrix = square / scale[:, None] / scale[None] * free[:, None] * free[None]
        matrix = matrix + jnp.diag(search.damping * free + (1 - free))
        right = -(gradient + square @ (move * (1 - free))) / scale * free
        step = jax.scipy.linalg.solve(matrix, right, assume_a="pos") / scale
        move = jnp.where(fixed, move, step)
        fixed = fixed | (y + move < low) | (y + move > high)
        move = jnp.clip(y + move, low, high) - y
    move = jnp.where(jnp.isfinite(move), move, 0)
    # Where that goes round in circles, a part of the step is better than all of it.
    parts = jnp.asarray(_PARTS, y.dtype)
    model = search.residuals[:, None] + (search.jacobian @ move)[:, None] * parts[None]
    totals = jnp.sum(_counting(model, sided[:, None]) ** 2, axis=0)
    best = jnp.argmin(totals)
    return parts[best] * move, jnp.sum(_counting(search.residuals, sided) ** 2) - totals[best]


def promised_gain(search: Search, low: Array, high: Array) -> Array:
    """What part of the total, (), a step that is hardly damped is promised to gain."""
    search = search._replace(damping=jnp.full_like(search.damping, _DAMPING))
    gain = _proposal(search, low, high)[1]
    return safe_divide(jnp.abs(gain), search.total)
