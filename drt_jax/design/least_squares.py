"""Least squares by Levenberg and Marquardt's method within bounds, on exact Jacobians.

With the residuals r, the Jacobian J and the diagonal matrix D of the column norms of J, a step d
solves

    (D^-1 J^T J D^-1 + damping I) D d = -D^-1 J^T r

(damping in units of the column norms: More, The Levenberg-Marquardt algorithm, 1978). Let rho be
the decrease of the sum of squares divided by the decrease that the linear model promises. After an
accepted trial the damping is multiplied by max(1/3, 1 - (2 rho - 1)^3); after the first, second,
third, ... rejected trial in a row by 2, 4, 8, ... (Nielsen, Damping parameter in Marquardt's
method, 1999). A variable at a bound is fixed there while the merit falls only beyond the bound.

A constraint c <= 0 enters as the one-sided residual max(0, c + shift). Each time the merit has
settled, the shift is set to max(0, c + shift). This is the method of multipliers (Rockafellar
1973), which meets constraints exactly without large penalty weights.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import matmul, run_if, safe_divide

_DAMPING, _MOST_DAMPING = 1e-3, 1e16  # at the start, and where a search ends
_PARTS = (1.0, 0.5, 0.25, 0.1, 0.03)  # fractions of a step of which the model chooses the best
_SETS = 5  # updates of the active set (bounds and constraints) in one step
# The merit has settled when the model promises a relative gain below `_COARSE`, or below `_FINE`
# once constraints are met. A search only converges towards its constraints, so each constraint is
# tightened by `_WITHIN`, in its own unit, in order to be met.
_COARSE, _FINE, _WITHIN = 1e-5, 1e-13, 1e-9
_ROUNDS = 30  # largest number of shifts


class Evaluation(NamedTuple):
    """Evaluation of a function, such as that of a problem, at a vector.

    residuals: (M,); the merit is the sum of their squares.
    constraints: (L,), violations of the limits times their weights; a limit is met where it is 0 or
        less.
    overlap: (), total overlap of surfaces within the beam, mm, as a measure of an unphysical lens;
        inf where a number is not finite.
    failed: (), int32, number of failed rays.
    """

    residuals: Array
    constraints: Array
    overlap: Array
    failed: Array


Function = Callable[[Array], Evaluation]


class Search(NamedTuple):
    """State of a search for an optimum.

    vector: (N,), best vector so far.
    evaluation: evaluation of that vector.
    residuals: (M + L,), residuals, then the shifted constraints.
    jacobian: (M + L, N), their derivatives.
    total: (), sum of the squares of residuals and of violated constraints.
    scale: (N,), column norms of the Jacobian.
    damping: (), damping of the next step.
    growth: (), factor of the damping after a rejected trial.
    gain: (), gain that the linear model promised for the last trial, relative to the total.
    jacobians, steps: (), int32, numbers of Jacobians and of trials.
    stale: (), bool, True if the vector must be evaluated first: at the start, and after a shift.
    shift: (L,), shifts of the constraints.
    stiffness: (), factor of the constraints.
    rounds: (), int32, number of times that constraints were shifted.
    fine: (), bool, True if constraints are met and the search only refines.
    done: (), bool, True if the search has ended.
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
        """Largest violation of a constraint, (); 0 if all are met."""
        return jnp.max(self.evaluation.constraints, axis=-1, initial=0.0)

    @property
    def score(self) -> Array:
        """Merit plus the squares of the violations of constraints, (); inf for an unphysical
        lens.
        """
        exceeded = jnp.maximum(self.evaluation.constraints, 0)
        score = self.merit + jnp.sum(exceeded**2, axis=-1)
        physical = jnp.isfinite(score) & jnp.isfinite(self.evaluation.overlap)
        return jnp.where(physical, score, jnp.inf)


def init(function: Function, vector: Array) -> Search:
    """The state of a search before the first step. Evaluates nothing.

    function: from a vector (N,) to its evaluation.
    vector: (N,), start.
    """
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
    """One trial of a search; none if the search is done.

    A trial is accepted if the total falls and the overlap does not grow; then its Jacobian is
    computed. The search is done when constraints are met, or were shifted 30 times, and the model
    promises a relative gain below 1e-13 or the damping is above 1e16.

    function: from a vector (N,) to its evaluation.
    search: the state before the trial.
    low, high: (N,), bounds of the vector.
    """
    new = _shifted(_tried(function, search, low, high))
    return jax.tree.map(lambda a, b: jnp.where(search.done, a, b), search, new)


def _tried(function: Function, search: Search, low: Array, high: Array) -> Search:
    """The state after one trial.

    `jax.linearize` gives the residuals of the trial and their linear map. Only if the trial is
    accepted is this map evaluated for the N unit vectors, which gives the Jacobian; otherwise the
    state keeps the old one, with a larger damping.
    """

    def residuals_of(vector: Array) -> tuple[Array, Evaluation]:
        values = function(vector)
        limits = search.stiffness * (values.constraints + _WITHIN + search.shift)
        return jnp.concatenate([values.residuals, limits]), values

    sided = _sided(search)
    move, promised = _proposal(search, low, high)
    vector = jnp.where(search.stale, search.vector, jnp.clip(search.vector + move, low, high))
    residuals, derivative, values = jax.linearize(residuals_of, vector, has_aux=True)
    total = jnp.sum(_counting(residuals, sided) ** 2)
    finite = jnp.isfinite(total) & jnp.isfinite(values.overlap)
    better = finite & (total < search.total) & (values.overlap <= search.evaluation.overlap)
    taken = search.stale | better
    ratio = safe_divide(search.total - total, promised)
    units = jnp.eye(vector.size, dtype=vector.dtype)
    jacobian = run_if(taken, lambda _: jax.vmap(derivative, out_axes=1)(units), search.jacobian)
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
    """Shifts violated constraints once the merit has settled (method of multipliers), and decides
    whether the search is done.
    """
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
    """The residuals that count: one-sided residuals below 0 are set to 0."""
    return jnp.where(sided, jnp.maximum(residuals, 0), residuals)


def _sided(search: Search) -> Array:
    """Mask (M + L,) of the one-sided residuals, which belong to constraints."""
    count = search.residuals.shape[-1]
    return jnp.arange(count) >= count - search.shift.shape[-1]


def _proposal(search: Search, low: Array, high: Array) -> tuple[Array, Array]:
    """The damped step within the bounds (N,), and the decrease of the total that the linear model
    promises.

    Which constraints count, and which variables are fixed at a bound, is decided by the model at
    the end of the step. Since this depends on the step, the step is computed five times, each time
    with the active set of the step before.
    """
    y, sided = search.vector, _sided(search)
    scale = jnp.where(search.scale > 0, search.scale, 1)
    move, fixed = jnp.zeros_like(y), jnp.zeros(y.shape, bool)
    for k in range(_SETS):
        model = search.residuals + matmul(search.jacobian, move)
        counts = (~sided | (model > 0)).astype(y.dtype)
        gradient = matmul(search.jacobian.T, counts * search.residuals)
        square = matmul(search.jacobian.T, counts[:, None] * search.jacobian)
        if not k:
            fixed = ((y <= low) & (gradient > 0)) | ((y >= high) & (gradient < 0))
        # The equations in units of the column norms. Fixed variables keep their move.
        free = (~fixed).astype(y.dtype)
        matrix = square / scale[:, None] / scale[None] * free[:, None] * free[None]
        matrix = matrix + jnp.diag(search.damping * free + (1 - free))
        right = -(gradient + matmul(square, move * (1 - free))) / scale * free
        step = jax.scipy.linalg.solve(matrix, right, assume_a="pos") / scale
        move = jnp.where(fixed, move, step)
        fixed = fixed | (y + move < low) | (y + move > high)
        move = jnp.clip(y + move, low, high) - y
    move = jnp.where(jnp.isfinite(move), move, 0)
    # If the active set did not converge, a part of the step may be better than the whole step.
    parts = jnp.asarray(_PARTS, y.dtype)
    model = search.residuals[:, None] + matmul(search.jacobian, move)[:, None] * parts[None]
    totals = jnp.sum(_counting(model, sided[:, None]) ** 2, axis=0)
    best = jnp.argmin(totals)
    return parts[best] * move, jnp.sum(_counting(search.residuals, sided) ** 2) - totals[best]


def promised_gain(search: Search, low: Array, high: Array) -> Array:
    """Relative gain (), as the linear model promises it for a step with a damping of 1e-3."""
    search = search._replace(damping=jnp.full_like(search.damping, _DAMPING))
    gain = _proposal(search, low, high)[1]
    return safe_divide(jnp.abs(gain), search.total)
