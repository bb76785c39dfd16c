"""Tolerances by derivatives: the mean squared spot as a quadratic function of deviations."""

from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import ONCE, jit
from ..inputs import require_one_of
from ..numerics import concrete, matmul
from .compensate import Compensator, check, compensated
from .perturbed import PerturbedLens
from .problem import Problem, quick

# Order of a prediction: gradient of q, Gauss-Newton part of its Hessian, or whole Hessian.
Order = Literal["first", "rays", "second"]
_ASCENTS = 16  # eigenvectors from which ascents start, in both directions


class Predicted(NamedTuple):
    """Model of q, the mean squared RMS radius, mm^2, as a function of deviations in units of their
    largest.

    nominal: (), q without deviations.
    gradient: (P,), first derivatives.
    gauss: (P, P), Gauss-Newton part of the Hessian, 2 J^T J.
    hessian: (P, P), second derivatives.
    moves: (C,), compensation without deviations, see `AsBuilt`.
    move_slopes: (P, C), derivatives of the compensation.
    """

    nominal: Array
    gradient: Array
    gauss: Array
    hessian: Array
    moves: Array
    move_slopes: Array

    def matrix(self, order: Order) -> Array:
        """Matrix (P, P) of an order: 0 for "first", `gauss` for "rays", `hessian` for "second".
        ValueError for another order."""
        require_one_of("order", order, get_args(Order))
        if order == "first":
            return 0 * self.hessian
        return self.gauss if order == "rays" else self.hessian

    def at(self, perturbation: Array | np.ndarray, order: Order) -> Array:
        """q (K,) for deviations (K, P); below 0 where the model fails. ValueError as `matrix`."""
        return (
            self.nominal
            + matmul(perturbation, self.gradient)
            + jnp.sum(perturbation * matmul(perturbation, self.matrix(order)), axis=-1) / 2
        )

    def moments(self, variances: Array, order: Order) -> tuple[Array, Array]:
        """Mean and standard deviation of q, () each, for independent deviations with variances
        (P,). The mean is exact for the quadratic model; the standard deviation holds for normal
        deviations (root sum of squares). ValueError as in `matrix`."""
        matrix = self.matrix(order)
        mean = self.nominal + matmul(jnp.diag(matrix), variances) / 2
        pairs = matmul(matmul(variances, matrix**2), variances) / 2
        return mean, jnp.sqrt(matmul(self.gradient**2, variances) + pairs)


def predict(problem: Problem, perturbed: PerturbedLens, compensator: Compensator) -> Predicted:
    """Predicts q from exact first and second derivatives. ValueError as in `as_built`."""
    check(problem, perturbed.lens, compensator)
    if not concrete((problem, perturbed)):
        return _predict(problem, perturbed, compensator)
    found = _predict(quick(problem), perturbed, compensator)
    # What aiming does not find, the full search may.
    return found if bool(jnp.isfinite(found.nominal)) else _predict(problem, perturbed, compensator)


def _predict_all(problem: Problem, perturbed: PerturbedLens, compensator: Compensator) -> Predicted:
    zero = jnp.zeros_like(perturbed.sizes)
    units = jnp.eye(len(zero), dtype=zero.dtype)

    def rays(perturbation: Array) -> tuple[tuple[Array, Array], Array]:
        found, offsets = compensated(problem, perturbed.lens_of(perturbation), compensator)
        return (jnp.ravel(offsets) / jnp.sqrt(len(found.squares)), found.moves), found.squares

    def measure(perturbation: Array) -> Array:
        return jnp.mean(
            compensated(problem, perturbed.lens_of(perturbation), compensator)[0].squares
        )

    (offsets, moves), push, squares = jax.linearize(rays, zero, has_aux=True)
    derivatives, slopes = jax.lax.map(push, units)
    hessian = jax.lax.map(lambda unit: jax.jvp(jax.grad(measure), (zero,), (unit,))[1], units)
    gradient, gauss = 2 * matmul(derivatives, offsets), 2 * matmul(derivatives, derivatives.T)
    return Predicted(jnp.mean(squares), gradient, gauss, hessian, moves, slopes)


# Second derivatives of a whole trace are large to compile and run once.
_predict = jit(_predict_all, ONCE, static_argnums=2)


def worst_case(
    perturbed: PerturbedLens, predicted: Predicted, order: Order = "second"
) -> np.ndarray:
    """Largest deviations (P,) with the largest predicted q that several ascents find, which may not
    be the global maximum. They start at the gradient and at the largest eigenvectors. ValueError
    for an unknown order."""
    slope, matrix = np.asarray(predicted.gradient), np.asarray(predicted.matrix(order))
    values, vectors = np.linalg.eigh(matrix)
    # Where all deviations are largest, a multiple of the unit matrix only adds a constant to q. It
    # makes q convex, so that the largest step along its gradient never descends.
    matrix = matrix + max(0.0, -values[0]) * np.eye(len(matrix))
    largest = vectors[:, ::-1][:, :_ASCENTS].T
    found: list[np.ndarray] = []
    for start in (slope, *largest, *-largest):
        perturbation = _to_the_ends(perturbed, start)
        for _ in range(100):
            perturbation, before = (
                _to_the_ends(perturbed, slope + matrix @ perturbation),
                perturbation,
            )
            if np.array_equal(perturbation, before):
                break
        found.append(perturbation)
    sizes = np.asarray(predicted.at(np.array(found), order))
    return found[int(np.argmax(sizes))]


def _to_the_ends(perturbed: PerturbedLens, vector: np.ndarray) -> np.ndarray:
    """The largest deviations (P,) along a vector (P,): each part has the length 1."""
    perturbation = np.zeros(len(vector))
    for part in perturbed.parts:
        size = np.linalg.norm(vector[part])
        perturbation[part] = vector[part] / size if size > 0 else np.eye(len(part))[0]
    return perturbation
