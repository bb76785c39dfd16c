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
_ASCENTS = 16  # number of eigenvectors from which ascents start, in both directions


class Predicted(NamedTuple):
    """A quadratic model of q, the mean squared RMS radius of the spots, mm^2.

    q(p) = nominal + gradient.p + p^T H p / 2, where p are deviations in units of their largest.

    nominal: (), q without deviations.
    gradient: (P,), first derivatives of q.
    gauss: (P, P), Gauss-Newton part of the Hessian, 2 J^T J, with J the derivatives of the
        residuals.
    hessian: (P, P), second derivatives of q.
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

        ValueError for another order.
        """
        require_one_of("order", order, get_args(Order))
        if order == "first":
            return 0 * self.hessian
        return self.gauss if order == "rays" else self.hessian

    def at(self, perturbation: Array | np.ndarray, order: Order) -> Array:
        """q (K,) for deviations (K, P); below 0 where the model fails.

        perturbation: (K, P), in units of the largest deviations.
        order: as in `matrix`. ValueError for another order.
        """
        return (
            self.nominal
            + matmul(perturbation, self.gradient)
            + jnp.sum(perturbation * matmul(perturbation, self.matrix(order)), axis=-1) / 2
        )

    def moments(self, variances: Array, order: Order) -> tuple[Array, Array]:
        """Mean and standard deviation of q, () each, for independent deviations.

        The mean is exact for the quadratic model. The standard deviation is exact for the quadratic
        model if deviations are normal; without the matrix it is the root sum of squares.

        variances: (P,), variances of the deviations.
        order: as in `matrix`. ValueError for another order.
        """
        matrix = self.matrix(order)
        mean = self.nominal + matmul(jnp.diag(matrix), variances) / 2
        pairs = matmul(matmul(variances, matrix**2), variances) / 2
        return mean, jnp.sqrt(matmul(self.gradient**2, variances) + pairs)


def predict(problem: Problem, perturbed: PerturbedLens, compensator: Compensator) -> Predicted:
    """Predicts q from exact first and second derivatives by deviations.

    problem: gives the fields, wavelengths and pupil rule.
    perturbed: the lens and its deviations.
    compensator: as in `as_built`.

    ValueError as in `as_built`.
    """
    check(problem, perturbed.lens, compensator)
    if not concrete((problem, perturbed)):
        return _predict(problem, perturbed, compensator)
    found = _predict(quick(problem), perturbed, compensator)
    # The full search may find rays that aiming does not find.
    return found if bool(jnp.isfinite(found.nominal)) else _predict(problem, perturbed, compensator)


def _predict_all(problem: Problem, perturbed: PerturbedLens, compensator: Compensator) -> Predicted:
    """The body of `predict`: J from one linearised trace, the Hessian by forward over reverse
    mode.
    """
    zero = jnp.zeros_like(perturbed.sizes)
    units = jnp.eye(len(zero), dtype=zero.dtype)

    def rays(perturbation: Array) -> tuple[tuple[Array, Array], Array]:
        found, offsets = compensated(problem, perturbed.lens_of(perturbation), compensator)
        return (jnp.ravel(offsets) / jnp.sqrt(len(found.squares)), found.moves), found.squares

    def measure(perturbation: Array) -> Array:
        return jnp.mean(
            compensated(problem, perturbed.lens_of(perturbation), compensator)[0].squares
        )

    (offsets, moves), derivative, squares = jax.linearize(rays, zero, has_aux=True)
    derivatives, slopes = jax.lax.map(derivative, units)
    hessian = jax.lax.map(lambda unit: jax.jvp(jax.grad(measure), (zero,), (unit,))[1], units)
    gradient, gauss = 2 * matmul(derivatives, offsets), 2 * matmul(derivatives, derivatives.T)
    return Predicted(jnp.mean(squares), gradient, gauss, hessian, moves, slopes)


# Second derivatives of a whole trace are large to compile and run once.
_predict = jit(_predict_all, ONCE, static_argnums=2)


def worst_case(
    perturbed: PerturbedLens, predicted: Predicted, order: Order = "second"
) -> np.ndarray:
    """Largest deviations (P,) with a large predicted q, the worst that several ascents find.

    Each ascent repeats p <- the largest deviations along the gradient of q at p, until p does not
    change. Ascents start at the gradient without deviations and at 16 eigenvectors of the matrix,
    in both directions. The result may not be the global maximum.

    perturbed: the lens and its deviations.
    predicted: the model of q.
    order: as in `Predicted.matrix`. ValueError for another order.
    """
    slope, matrix = np.asarray(predicted.gradient), np.asarray(predicted.matrix(order))
    values, vectors = np.linalg.eigh(matrix)
    # If all deviations are largest, adding a multiple of the unit matrix only adds a constant to q.
    # It makes q convex, so that no step to the largest deviations along the gradient decreases q.
    matrix = matrix + max(0.0, -values[0]) * np.eye(len(matrix))
    largest = vectors[:, ::-1][:, :_ASCENTS].T
    found: list[np.ndarray] = []
    for start in (slope, *largest, *-largest):
        perturbation = _largest_along(perturbed, start)
        for _ in range(100):
            perturbation, before = (
                _largest_along(perturbed, slope + matrix @ perturbation),
                perturbation,
            )
            if np.array_equal(perturbation, before):
                break
        found.append(perturbation)
    sizes = np.asarray(predicted.at(np.array(found), order))
    return found[int(np.argmax(sizes))]


def _largest_along(perturbed: PerturbedLens, vector: np.ndarray) -> np.ndarray:
    """The largest deviations (P,) along a vector (P,): the components of each part have the length
    1.
    """
    perturbation = np.zeros(len(vector))
    for part in perturbed.parts:
        size = np.linalg.norm(vector[part])
        perturbation[part] = vector[part] / size if size > 0 else np.eye(len(part))[0]
    return perturbation
