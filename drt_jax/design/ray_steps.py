"""Ray steps: an optimiser of a lens whose steps are scaled by the displacement of its rays.

Adam has a rate for each variable, but the image depends on combinations of variables. The Jacobian
of the rays gives these combinations without the noise of a batch. Let J be the Jacobian by the
variables of the hits on the sensor, relative to the centroid of their object point and scaled to
the mean square, and g the gradient of a loss:

    A = J^T J, mm^2 of mean square displacement;  B = A + damping diag(A)
    m <- b1 m + (1 - b1) g,   n <- b2 n + (1 - b2) g^T B^-1 g
    step = -size B^-1 m / sqrt(n), with the bias of m and n removed as in Adam.

If successive gradients agree, the step moves the rays by `size`, root mean square; otherwise by
less. The step does not depend on the units of the variables and of the loss, nor on the batch size.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import matmul, safe_divide, safe_sqrt
from ..rays.solve import solve_aimed
from .problem import Problem
from .within_limits import within_limits


class RayState(NamedTuple):
    """State of `RaySteps`: number of steps, (); running means of the gradient, (N,), and of its
    square in the metric, (); the metric B, (N, N), mm^2, and the RMS spot, (), mm, made with it."""

    steps: Array
    first: Array
    second: Array
    metric: Array
    spot: Array


def cosine(size: float, steps: int, warm: int = 10) -> Callable[[Array], Array]:
    """A schedule: the length of step k, from 0: rises to `size` in `warm` steps, and falls to 0 at
    `steps` as half a period of a cosine."""

    def length(k: Array) -> Array:
        part = jnp.minimum(k / steps, 1.0)
        return size * jnp.minimum((k + 1) / warm, 1.0) * (1 + jnp.cos(math.pi * part)) / 2

    return length


@dataclasses.dataclass(frozen=True)
class RaySteps:
    """An optimiser of the vector of a lens, by gradients of any loss.

    spots: problem with the operand "spot"; the metric B uses the rays of its fields, distances and
        wavelengths.
    limits: problem whose bounds and limits hold; updates are projected onto them in the metric B,
        see `within_limits`.
    size: RMS displacement of the hits by a step, mm; or a function of the number of the step, such
        as `cosine`.
    share: largest step as a fraction of the present RMS spot, so that a step does not destroy spots
        that are far smaller than `size`.
    damping: relative addition to the diagonal of A; it limits steps in directions that hardly move
        rays.
    every: number of steps after which B is renewed.
    b1, b2: decay rates of the means.
    """

    spots: Problem
    limits: Problem
    size: float | Callable[[Array], Array]
    share: float = 0.2
    damping: float = 1e-3
    every: int = 10
    b1: float = 0.9
    b2: float = 0.99

    def init(self, vector: Array) -> RayState:
        """The state before the first step."""
        one, steps = jnp.eye(len(vector), dtype=vector.dtype), jnp.zeros((), jnp.int32)
        return RayState(steps, 0 * vector, 0 * vector[0], one, 0 * vector[0])

    def metric(self, vector: Array) -> tuple[Array, Array]:
        """B, (N, N), mm^2, and the RMS spot, (), mm, at a vector."""
        spots = self.spots.with_solver(solve_aimed)
        views = len(spots.fields) * len(spots.distances)

        def hits(vector: Array) -> tuple[Array, Array]:
            residuals = spots.evaluate(vector).residuals
            return residuals, safe_sqrt(jnp.vdot(residuals, residuals) / views)

        slopes, spot = jax.jacfwd(hits, has_aux=True)(vector)
        square = matmul(slopes.T, slopes) / views
        diagonal = jnp.diagonal(square)
        # The element of a variable that moves no ray only keeps B regular.
        idle = jnp.where(diagonal > 0, self.damping * diagonal, jnp.max(diagonal))
        return square + jnp.diag(idle), spot

    def update(self, gradient: Array, state: RayState, vector: Array) -> tuple[Array, RayState]:
        """The next vector (N,), and the next state. Works in `jit`."""
        renew = state.steps % self.every == 0
        old = lambda _: (state.metric, state.spot)  # noqa: E731
        metric, spot = jax.lax.cond(renew, self.metric, old, vector)
        gradient = gradient.astype(vector.dtype)
        square = jnp.vdot(gradient, jnp.linalg.solve(metric, gradient))
        first = self.b1 * state.first + (1 - self.b1) * gradient
        second = self.b2 * state.second + (1 - self.b2) * square
        bias = [1 - b ** (state.steps + 1).astype(vector.dtype) for b in (self.b1, self.b2)]
        length = safe_sqrt(second / bias[1])
        unit = safe_divide(jnp.linalg.solve(metric, first) / bias[0], length)
        k = state.steps.astype(vector.dtype)
        size = jnp.minimum(self.size(k) if callable(self.size) else self.size, self.share * spot)
        new = within_limits(self.limits, vector, vector - size * unit, metric)
        return new, RayState(state.steps + 1, first, second, metric, spot)
