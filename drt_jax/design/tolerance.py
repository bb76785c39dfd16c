"""A lens as built: its spots after compensation, by Monte Carlo simulation and by derivatives.

The figure of merit q of a lens is the mean over its fields of the squared RMS radius of the
polychromatic spot, after optimal compensation. The distance o of a ray from the centroid changes
linearly with the shift t of the sensor at the spot, o + g t, where g is the slope of the ray less
the mean slope. So q is quadratic in the compensation, and the normal equations of a small linear
least-squares problem give the optimal compensation.
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
from scipy.special import gammainc

from ..compilation import LARGE, ONCE, jit
from ..devices import shared
from ..image.spot import deviations, normalised
from ..inputs import require, require_one_of
from ..lens.lens import Lens
from ..numerics import Numbers, concrete, matmul, real_array, safe_divide, safe_sqrt
from ..pupil.rules import Gauss
from ..rays.solve import solve_aimed
from ..rays.status import Status
from .field_rays import EXTRAS, FieldRays, symmetry_by_structure, trace_views
from .perturbed import KINDS, PerturbedLens
from .problem import Problem, quick, trace_fields
from .tiles import in_tiles

# What is adjusted in every lens: the distance of the sensor, or also its tilts about x and y.
Compensator = Literal["none", "focus", "focus and tilt"]
_STEPS = {"none": 0, "focus": 1, "focus and tilt": 3}
_SYMMETRIES = ("rotational", "bilateral", "none")  # by the traced part of the pupil, smallest first
_TILE = 50  # number of lenses in a tile
_DEVIATION = 0.5  # standard deviation of normal deviations, in units of the largest
# Order of a prediction: gradient of q, Gauss-Newton part of its Hessian, or whole Hessian.
Order = Literal["first", "rays", "second"]
_ASCENTS = 16  # number of eigenvectors from which ascents start, in both directions


class AsBuilt(NamedTuple):
    """A lens as built, after compensation.

    squares: (V,), squared RMS radii of the spots, mm^2; inf where rays fail or no light passes.
    moves: (C,), compensation: the shift of the sensor, mm, then its tilts about x and -y, radians.
    """

    squares: Array
    moves: Array

    @property
    def spot(self) -> Array:
        """The square root of q, (), mm."""
        return jnp.sqrt(jnp.mean(self.squares, axis=-1))


def _spots(rays: FieldRays) -> tuple[Array, Array, Array]:
    """Distances of rays from the centroid of their view, and the derivatives of these distances.

    Returns distances, mm, and their derivatives by the shift of the sensor, (D, V, W Q) each, times
    the root of the weight of the ray; and the centroids (2, V), mm.
    """
    waves = rays.wavelength_weights[None, :, None]
    light = (rays.weights * waves)[..., EXTRAS:]
    passes = (rays.bundle.status == Status.OK)[..., EXTRAS:] & (light > 0)
    light = jnp.where(passes, light, 0)
    arrival = [a[..., EXTRAS:] for a in rays.bundle.arrival]
    hits = [h[:, -1, :, EXTRAS:] for h in rays.bundle.hits]
    slopes = [safe_divide(a, arrival[-1]) for a in arrival[:-1]]
    weight = normalised(light, (-2, -1))
    root = safe_sqrt(weight)

    def scaled(values: list[Array]) -> tuple[Array, tuple[Array, ...]]:
        known = tuple(jnp.where(passes, value, 0) for value in values)
        parts, means = deviations(known, weight, rays.symmetry, (-2, -1))
        return jnp.stack([root * part for part in parts]).reshape(len(hits), len(light), -1), means

    (offsets, means), (growth, _) = scaled(hits), scaled(slopes)
    centre = jnp.stack(means)[..., 0, 0]
    return offsets, growth, jnp.concatenate([jnp.zeros_like(centre[: 2 - len(hits)]), centre])


def compensated(lens: Lens, rays: FieldRays, compensator: Compensator) -> tuple[AsBuilt, Array]:
    """A lens with traced rays after compensation, and its residuals. Call `check` before.

    With the distances o and their derivatives g of all rays, and the shift of the sensor t_v =
    sum_k m_k l_kv at the spot of view v (levers l: 1, y and x of the centroid), the compensation m
    solves (sum g^2 l l^T) m = -sum o g l.

    Returns the result, and the residuals (D, V, W Q): distances from the centroids, mm, whose
    squares add up to the squared RMS radii.
    """
    offsets, growth, (x, y) = _spots(rays)
    # At a spot (x, y) the sensor moves by d n + a y + b x along its normal, where d is the change
    # of `Lens.sensor`, n the normal component of the motion of the sensor, and a, b are the tilts.
    motion = lens.sensor_motion
    normal = jnp.ones_like(x) if motion is None else jnp.broadcast_to(motion[2], x.shape)
    levers = jnp.stack([normal, y, x])[: _STEPS[compensator]]
    moves = jnp.zeros(0, x.dtype)
    if len(levers):
        square = jnp.sum(growth**2, axis=(0, 2))
        matrix = matmul(levers * square[None], levers.T)
        lit = matrix[0, 0] > 0
        matrix = jnp.where(lit, matrix, jnp.eye(len(levers), dtype=x.dtype))
        moves = jnp.linalg.solve(matrix, -matmul(levers, jnp.sum(offsets * growth, axis=(0, 2))))
        offsets = offsets + growth * matmul(moves, levers)[None, :, None]
    light = rays.weights[..., EXTRAS:] > 0
    failed = jnp.any(light & ~rays.arrives[..., EXTRAS:], axis=(1, 2))
    valid = ~failed & jnp.all(rays.throughput > 0, axis=1)
    squares = jnp.where(valid, jnp.sum(offsets**2, axis=(0, 2)), jnp.inf)
    return AsBuilt(squares, moves), offsets


def as_built(problem: Problem, lens: Lens, compensator: Compensator) -> AsBuilt:
    """Evaluates a lens at the fields of a problem after compensation.

    Works in `jit`, `vmap` and under differentiation.

    problem: gives the fields, wavelengths and pupil rule.
    lens: the lens as built.
    compensator: "none", "focus" (the distance of the sensor) or "focus and tilt" (also its tilts
        about x and y).

    ValueError for an unknown compensator, for one that the fields do not determine, and for a pupil
    rule with more symmetry than the lens.
    """
    check(problem, lens, compensator)
    return compensated(lens, trace_fields(problem, lens), compensator)[0]


def check(problem: Problem, lens: Lens, compensator: str) -> None:
    """Raises the ValueErrors of `as_built`."""
    require_one_of("compensator", compensator, get_args(Compensator))
    has, needs = problem.rule.symmetry, symmetry_by_structure(lens, axial=True)
    require(
        _SYMMETRIES.index(has) >= _SYMMETRIES.index(needs),
        f'rule: "{has}" leaves out part of the pupil, but deviations break the symmetry; use one '
        f'of symmetry "{needs}", such as Gauss(6, "{needs}")',
    )
    if compensator == "focus and tilt" and concrete(problem.fields):
        tangents = np.tan(np.asarray(problem.fields, float))
        require(
            np.linalg.matrix_rank(np.c_[np.ones(len(tangents)), tangents]) == 3,
            "compensator: focus and tilt: the fields lie on a line, about which any tilt is as "
            "good; add fields beside it",
        )


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
    count = np.array([KINDS[error.kind].axes for error in perturbed.deviations])
    if not normal:
        return 1 / (count + 2)
    most = 1 / (2 * _DEVIATION**2)
    return _DEVIATION**2 * gammainc(count / 2 + 1, most) / gammainc(count / 2, most)


def monte_carlo(
    problem: Problem,
    perturbed: PerturbedLens,
    perturbation: np.ndarray,
    compensator: Compensator,
    callback: Callable[[int], None] = lambda done: None,
    threads: int | None = None,
    mesh: Mesh | None = None,
) -> AsBuilt:
    """Traces lenses with given deviations.

    The result does not depend on threads, tiles or devices. Where aiming misses a ray, the full ray
    search decides whether the ray exists.

    problem: gives the fields, wavelengths and pupil rule.
    perturbed: the lens and its deviations.
    perturbation: (K, P), deviations in units of their largest.
    compensator: as in `as_built`.
    callback: called with the number of lenses done.
    threads: number of threads; None for one per core.
    mesh: devices that share the lenses, of `devices.device_mesh`. A tile then has 50 lenses for
        every device, and `threads` is not used. None for the default device.

    Returns squares (K, V), mm^2, and moves (K, C) of all lenses. ValueError as in `as_built`.
    """
    check(problem, perturbed.lens, compensator)
    shape, width = np.shape(perturbation), len(perturbed.deviations)
    valid = len(shape) == 2 and shape[0] and shape[1] == width
    require(valid, f"perturbation: expected (K, {width}), got shape {shape}")
    rows = np.asarray(perturbation, perturbed.sizes.dtype)
    many = partial(_many, compensator=compensator)

    def traced(problem: Problem, rows: np.ndarray, callback: Callable[[int], None]) -> AsBuilt:
        parts: list[AsBuilt] = []
        for part in in_tiles(many, (problem, perturbed), rows, _TILE, threads, mesh):
            parts.append(part)
            callback(sum(len(part.squares) for part in parts))
        return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)

    found = traced(quick(problem), rows, callback)
    # The full search may find rays that aiming does not find.
    failed = np.flatnonzero(~np.all(np.isfinite(found.squares), axis=1))
    if len(failed):
        again = traced(problem, rows[failed], lambda done: None)
        for array, own in zip(found, again):
            array[failed] = own
    return found


@partial(jit, wanted=LARGE, static_argnames=("mesh", "compensator"))
def _many(
    problem: Problem,
    perturbed: PerturbedLens,
    perturbation: Array,
    mesh: Mesh | None,
    compensator: Compensator,
) -> AsBuilt:
    """The lenses of one tile, shared among the devices of a mesh."""

    def one(problem: Problem, perturbed: PerturbedLens, row: Array) -> AsBuilt:
        lens = perturbed.lens_of(row)
        return compensated(lens, trace_fields(problem, lens), compensator)[0]

    return shared(jax.vmap(one, (None, None, 0)), mesh, 2)(problem, perturbed, perturbation)


def spots_as_built(
    perturbed: PerturbedLens,
    perturbation: Numbers,
    compensator: Literal["none", "focus"] | Callable[[Lens, Lens], Lens] = "focus",
    order: int = 4,
) -> Callable[[Lens, FieldRays], Array]:
    """An operand of your own: the spots of lenses as built, for a design that stays good when it is
    made.

    Its squares are summed over all fields, distances and wavelengths of a problem, and averaged
    over the lenses: the mean squared RMS radius after compensation, for each point. A ray that
    fails in a lens as built counts nothing there.

    perturbed: any lens of the same surfaces, and its deviations.
    perturbation: (K, P), deviations in units of their largest, such as `draw_perturbations(
        perturbed, 48, seed)`. Judge the design by others.
    compensator: "none"; "focus": the sensor of each lens moves to its least spots, so that the
        sensor of the design does not matter: give it a solve, or a light "spot" beside; or a
        function of the design and of a lens as built, that returns this lens adjusted.
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
        nominal, views = perturbed.around(lens), dataclasses.replace(rays, rule=rule)

        def residuals(row: Array) -> Array:
            built = nominal.lens_of(row)
            built = adjust(nominal.lens, built) if adjust else built
            return compensated(built, trace_views(built, views, solve_aimed), kind)[1]

        return jax.vmap(residuals)(given) / len(given) ** 0.5

    return spots_as_built


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
        return {"first": 0 * self.hessian, "rays": self.gauss, "second": self.hessian}[order]

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


@partial(jit, wanted=ONCE, static_argnames="compensator")
def _predict(problem: Problem, perturbed: PerturbedLens, compensator: Compensator) -> Predicted:
    """`predict` with the solver of the problem: J from one linearised trace, the Hessian by forward
    over reverse mode. Second derivatives of a whole trace are large to compile and run once.
    """
    zero = jnp.zeros_like(perturbed.sizes)
    units = jnp.eye(len(zero), dtype=zero.dtype)

    def rays(perturbation: Array) -> tuple[tuple[Array, Array], Array]:
        lens = perturbed.lens_of(perturbation)
        found, offsets = compensated(lens, trace_fields(problem, lens), compensator)
        return (jnp.ravel(offsets) / jnp.sqrt(len(found.squares)), found.moves), found.squares

    (offsets, moves), derivative, squares = jax.linearize(rays, zero, has_aux=True)
    derivatives, slopes = jax.lax.map(derivative, units)
    merit = jax.grad(lambda perturbation: jnp.mean(rays(perturbation)[1]))
    hessian = jax.lax.map(lambda unit: jax.jvp(merit, (zero,), (unit,))[1], units)
    gradient, gauss = 2 * matmul(derivatives, offsets), 2 * matmul(derivatives, derivatives.T)
    return Predicted(jnp.mean(squares), gradient, gauss, hessian, moves, slopes)


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
