"""Many lenses as built: by Monte Carlo simulation, by derivatives, and as an operand of a design.

The figure of merit q of a lens is by default the mean over its fields of the squared RMS radius of
the polychromatic spot, after compensation; an `Assembly` says what else it may be.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from ..compilation import LARGE, ONCE, jit
from ..devices import shared
from ..inputs import require, require_one_of
from ..lens.lens import Lens
from ..numerics import Numbers, concrete, matmul, real_array
from ..pupil.rules import Gauss
from ..rays.solve import solve_aimed
from .assembly import Assembly, Given, mean_of
from .compensation import AsBuilt, Compensator, compensated
from .configurations import AnyProblem, over, shares_of
from .deviations import KINDS
from .field_rays import FieldRays, symmetry_by_structure, trace_views
from .perturbed import PerturbedLens
from .problem import Problem, trace_fields
from .tiles import in_tiles

_TILE = 50  # number of lenses in a tile
_DEVIATION = 0.5  # standard deviation of normal deviations, in units of the largest
# Order of a prediction: gradient of q, Gauss-Newton part of its Hessian, or whole Hessian.
Order = Literal["first", "rays", "second"]
_DETERMINED = 1e-10  # eigenvalues below this, relative to the diagonal, count as 0 in `_inverse`
_ASCENTS = 16  # number of eigenvectors from which ascents start, in both directions


def draw_perturbations(
    perturbed: PerturbedLens, count: int, seed: int, normal: bool = False
) -> np.ndarray:
    """Random deviations (count, P) in units of their largest.

    They are distributed uniformly up to 1, or normally with a standard deviation of 0.5 and cut off
    at 1. The components x and y of one part lie within a circle of radius 1.

    perturbed: the lens and its deviations.
    count: number of lenses.
    seed: seed of NumPy's generator.
    normal: True for the normal distribution.
    """
    rng = np.random.default_rng(seed)
    perturbation = np.empty((count, len(perturbed.deviations)))
    for part in perturbed.parts:
        pending = np.arange(count)
        while len(pending):
            shape = len(pending), len(part)
            drawn = rng.normal(0, _DEVIATION, shape) if normal else rng.uniform(-1, 1, shape)
            perturbation[pending[:, None], part] = drawn
            pending = pending[np.linalg.norm(drawn, axis=1) > 1]
    return perturbation


def variances(perturbed: PerturbedLens, normal: bool = False) -> np.ndarray:
    """Variances (P,) of the deviations that `draw_perturbations` draws.

    The variance of each component is E[r^2] / n for a part with n components: 1 / (n + 2) for the
    uniform distribution in the unit ball. For the normal one, r / 0.5 has the chi distribution of n
    degrees of freedom, cut off at 2.

    perturbed: the lens and its deviations.
    normal: True for the normal distribution.
    """
    from scipy.special import gammainc  # takes a quarter of a second to import

    count = np.array([KINDS[error.kind].axes for error in perturbed.deviations])
    if not normal:
        return 1 / (count + 2)
    most = 1 / (2 * _DEVIATION**2)
    return _DEVIATION**2 * gammainc(count / 2 + 1, most) / gammainc(count / 2, most)


def monte_carlo(
    problem: AnyProblem,
    perturbed: PerturbedLens,
    perturbation: np.ndarray,
    compensator: Given,
    callback: Callable[[int], None] = lambda done: None,
    threads: int | None = None,
    mesh: Mesh | None = None,
) -> AsBuilt:
    """Traces lenses with given deviations.

    The result does not depend on threads, tiles or devices. Where aiming misses a ray, the full ray
    search decides whether the ray exists.

    problem: gives the fields, wavelengths and pupil rule; or `Configurations`, for several.
    perturbed: the lens and its deviations.
    perturbation: (K, P), deviations in units of their largest.
    compensator: as in `as_built`.
    callback: called with the number of lenses done.
    threads: number of threads; None for one per core.
    mesh: devices that share the lenses, of `devices.device_mesh`. A tile then has 50 lenses for
        every device, and `threads` is not used. None for the default device.

    Returns squares (K, V), mm^2, moves (K, C) and values (K,) of all lenses, and values (K, Z) of
    each of Z configurations. ValueError as in `as_built`.
    """
    assembly = Assembly.of(compensator).placed(problem, perturbed.lenses, perturbed.beam_radius)
    shape, width = np.shape(perturbation), len(perturbed.deviations)
    valid = len(shape) == 2 and shape[0] and shape[1] == width
    require(valid, f"perturbation: expected (K, {width}), got shape {shape}")
    rows = np.asarray(perturbation, perturbed.sizes.dtype)

    def traced(problem: AnyProblem, rows: np.ndarray, callback: Callable[[int], None]) -> AsBuilt:
        parts: list[AsBuilt] = []
        whole = problem, perturbed, assembly
        for part in in_tiles(_many, whole, rows, _TILE, threads, mesh):
            parts.append(part)
            callback(sum(len(part.squares) for part in parts))
        return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)

    found = traced(problem.with_solver(solve_aimed), rows, callback)
    # The full search may find rays that aiming does not find.
    failed = np.flatnonzero(~np.all(np.isfinite(found.squares), axis=1))
    if len(failed):
        again = traced(problem, rows[failed], lambda done: None)
        for array, own in zip(found, again):
            array[failed] = own
    return found


@partial(jit, wanted=LARGE, static_argnames="mesh")
def _many(
    problem: AnyProblem,
    perturbed: PerturbedLens,
    assembly: Assembly,
    perturbation: Array,
    mesh: Mesh | None,
) -> AsBuilt:
    """The lenses of one tile, shared among the devices of a mesh."""
    one = lambda problem, lens, assembly, row: assembly.built(problem, lens.lenses_of(row))  # noqa: E731
    many = shared(jax.vmap(one, (None, None, None, 0)), mesh, 3)
    return many(problem, perturbed, assembly, perturbation)


def spots_as_built(
    perturbed: PerturbedLens,
    perturbation: Numbers,
    compensator: Literal["none", "focus"] | Callable[[Lens, Lens], Lens] = "focus",
    order: int = 4,
) -> Callable[[Lens, FieldRays], Array]:
    """A function for `Operand`: the spots of lenses as built, for a design that is insensitive to
    manufacturing errors.

    Its squares are summed over all fields, distances and wavelengths of a problem, and averaged
    over the lenses: the mean squared RMS radius after compensation, for each point. A ray that
    fails in a lens as built counts nothing there.

    perturbed: any lens of the same surfaces, and its deviations. ValueError of the merit for a lens
        of others.
    perturbation: (K, P), deviations in units of their largest, such as `draw_perturbations(
        perturbed, 48, seed)`. Evaluate the design with other draws.
    compensator: what is adjusted in each lens: "none"; "focus", the distance of its sensor; or a
        function of the design and of a lens as built that returns the adjusted lens. With "focus"
        the values do not depend on the sensor of the design: give that a solve, or add the operand
        "spot" with a small weight.
    order: of the pupil rule of each lens.
    """
    adjust = compensator if callable(compensator) else None
    kind: Compensator = "none" if callable(compensator) else compensator
    require_one_of("compensator", kind, ("none", "focus"))
    given = real_array("perturbation", perturbation, perturbed.sizes.dtype)
    width = len(perturbed.deviations)
    fits = given.ndim == 2 and len(given) > 0 and given.shape[1] == width
    require(fits, f"perturbation: expected (K, {width}), got shape {given.shape}")
    rule = Gauss(order, symmetry_by_structure(perturbed.lens))

    def spots_as_built(lens: Lens, rays: FieldRays) -> Array:
        own, other = perturbed.lens.count, lens.count
        require(own == other, f"perturbed: a lens of {own} surfaces, the design has {other}")
        nominal, views = perturbed.around(lens), dataclasses.replace(rays, rule=rule)

        def residuals(row: Array) -> Array:
            built = nominal.lens_of(row)
            built = adjust(nominal.lens, built) if adjust else built
            return compensated(built, trace_views(built, views, solve_aimed), kind)[1]

        return jax.vmap(residuals)(given) / len(given) ** 0.5

    return spots_as_built


class Predicted(NamedTuple):
    """A quadratic model of q: a mean square, such as that of the RMS radii of the spots, mm^2, or
    the mean of another criterion, see `Assembly.measure`.

    q(p) = nominal + gradient.p + p^T H p / 2, where p are deviations in units of their largest.

    nominal: (), q without deviations.
    gradient: (P,), first derivatives of q.
    gauss: (P, P), Gauss-Newton part of the Hessian, 2 J^T J, with J the derivatives of the
        residuals; 0 for a criterion that is no mean square.
    hessian: (P, P), second derivatives of q.
    moves: (C,), compensation without deviations, see `AsBuilt`.
    move_slopes: (P, C), derivatives of the compensation.
    before: the model with all adjustments held as they are without deviations.
    """

    nominal: Array
    gradient: Array
    gauss: Array
    hessian: Array
    moves: Array
    move_slopes: Array
    before: "Predicted | None" = None

    def matrix(self, order: Order) -> Array:
        """Matrix (P, P) of an order: 0 for "first", `gauss` for "rays", `hessian` for "second".

        ValueError for another order.
        """
        require_one_of("order", order, get_args(Order))
        return {"first": 0 * self.hessian, "rays": self.gauss, "second": self.hessian}[order]

    def at(self, perturbation: Array | np.ndarray, order: Order) -> Array:
        """q (K,) for deviations (K, P); below 0 where the model fails.

        perturbation: (K, P), in units of the largest deviations.
        order: as in `matrix`. ValueError for another order.
        """
        bend = jnp.sum(perturbation * matmul(perturbation, self.matrix(order)), axis=-1)
        return self.nominal + matmul(perturbation, self.gradient) + bend / 2

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


def predict(problem: AnyProblem, perturbed: PerturbedLens, compensator: Given) -> Predicted:
    """Predicts q from exact first and second derivatives by deviations.

    The adjustments m are treated as further deviations, z = (p, m), about the lens that is adjusted
    without deviations. The best adjustments for p minimise a sum of squares S, and follow from its
    second derivatives: S_mm m + S_mp p = 0. So q is exact to second order if q is this sum; for
    another criterion the second derivatives of m are neglected. An adjustment at its limit stays
    there; the prediction does not apply the limits of the others.

    problem: gives the fields, wavelengths and pupil rule.
    perturbed: the lens and its deviations.
    compensator: as in `as_built`.

    ValueError as in `as_built`, and for a criterion whose second derivatives are not finite.
    """
    assembly = Assembly.of(compensator).placed(problem, perturbed.lenses, perturbed.beam_radius)
    if not concrete((problem, perturbed)):
        return _predict(problem, perturbed, assembly)
    found = _predict(problem.with_solver(solve_aimed), perturbed, assembly)
    # The full search may find rays that aiming does not find.
    if not bool(jnp.isfinite(found.nominal)):
        found = _predict(problem, perturbed, assembly)
    remedy = "trace lenses instead, by `sensitivity` or `monte_carlo`"
    finite = bool(jnp.all(jnp.isfinite(found.hessian)))
    require(finite, f"criterion: its second derivatives are not finite; {remedy}")
    return found


@partial(jit, wanted=ONCE)
def _predict(problem: AnyProblem, perturbed: PerturbedLens, assembly: Assembly) -> Predicted:
    """`predict` with the solver of the problem.

    With z = (p, m), deviations and adjustments: J, the derivatives of the residuals by z, comes
    from one linearised trace; the Hessian H of q by z, and the rows of the Hessian of S by m, come
    from forward over reverse mode. The free adjustments follow p by dm/dp = -S_mm^-1 S_mp. With
    D = (1, dm/dp) the model in p has the gradient D g and the Hessian D H D^T. Second derivatives
    of a whole trace are large programs, which run once, so they are mapped one by one.
    """
    moves = jax.lax.stop_gradient(assembly.moves(problem, perturbed.lenses))
    shares = shares_of(problem)
    zero = jnp.append(jnp.zeros_like(perturbed.sizes), moves)
    count, units = len(perturbed.sizes), jnp.eye(len(zero), dtype=zero.dtype)

    def measures(z: Array) -> tuple[Array, Array]:
        """The residuals of which q is the sum of squares, and q and S."""
        lenses = assembly.adjusted(perturbed.lenses_of(z[:count]), z[count:])
        residuals, both = zip(*over(problem, measures_of_one, lenses), strict=True)
        parts = [root * own for root, own in zip(jnp.sqrt(shares), residuals, strict=True)]
        return jnp.concatenate(parts), jax.vmap(partial(mean_of, problem))(jnp.stack(both, axis=1))

    def measures_of_one(problem: Problem, lens: Lens) -> tuple[Array, Array]:
        """`measures` of one configuration."""
        rays = trace_fields(problem, lens)
        valid = jnp.all(jnp.isfinite(compensated(lens, rays, "none")[0].squares))
        residuals, q = assembly.measure(lens, rays)
        square = jnp.sum(assembly.pull(lens, rays) ** 2)
        return residuals, jnp.where(valid, jnp.stack([q, square]), jnp.inf)

    def curved(unit: tuple[Array, Array]) -> tuple[Array, Array]:
        """Gradient and Hessian, along a vector, of a combination of q and S."""
        vector, which = unit
        gradient = jax.grad(lambda z: jnp.dot(which, measures(z)[1]))
        return jax.jvp(gradient, (zero,), (vector,))

    _, derivative, values = jax.linearize(measures, zero, has_aux=True)
    jacobian = jax.lax.map(derivative, units)
    which = jnp.repeat(jnp.eye(2, dtype=zero.dtype), np.array([len(zero), len(moves)]), axis=0)
    gradients, rows = jax.lax.map(curved, (jnp.concatenate([units, units[count:]]), which))
    hessian, square = rows[: len(zero)], rows[len(zero) :]
    free = assembly.free(moves)  # an adjustment at its limit stays there
    pulls = jnp.where(free[:, None] & free[None], square[:, count:], 0)
    slopes = -matmul(_inverse(pulls), square[:, :count]).T
    whole = values[0], gradients[0], 2 * matmul(jacobian, jacobian.T), hessian

    def along(directions: Array) -> Predicted:
        """The model for vectors (P, N) of deviations with their adjustments."""
        nominal, slope, *matrices = whole
        gauss, hessian = (matmul(matmul(directions, a), directions.T) for a in matrices)
        slopes = directions[:, count:]
        return Predicted(nominal, matmul(directions, slope), gauss, hessian, moves, slopes)

    held = along(units[:count])
    return along(units[:count].at[:, count:].set(slopes))._replace(before=held)


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric matrix; 0 along eigenvectors of negligible eigenvalues."""
    size = jnp.sqrt(jnp.abs(jnp.diag(matrix)))
    size = jnp.where(size > 0, size, 1)
    scale = size[:, None] * size[None]
    if not len(matrix):
        return matrix
    values, vectors = jnp.linalg.eigh(matrix / scale)
    values = jnp.where(values > _DETERMINED, values, jnp.inf)
    return matmul(vectors / values[None], vectors.T) / scale


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
    part = np.concatenate([np.full(len(own), k) for k, own in enumerate(perturbed.parts)])
    first, same = np.diff(part, prepend=-1) > 0, part[:, None] == part[None]

    def largest_along(vectors: np.ndarray) -> np.ndarray:
        """Vectors (..., P) in which the components of each part have the length 1."""
        size = np.sqrt(vectors**2 @ same)
        return np.where(size > 0, vectors / np.where(size > 0, size, 1), first)

    values, vectors = np.linalg.eigh(matrix)
    # If all deviations are largest, adding a multiple of the unit matrix only adds a constant to q.
    # It makes q convex, so that no step to the largest deviations along the gradient decreases q.
    matrix = matrix + max(0.0, -values[0]) * np.eye(len(matrix))
    steepest = vectors[:, ::-1][:, :_ASCENTS].T
    found = largest_along(np.stack([slope, *steepest, *-steepest]))
    for _ in range(100):
        before = found
        found = largest_along(slope + before @ matrix.T)
        if np.array_equal(found, before):
            break
    return found[int(np.argmax(predicted.at(found, order)))]
