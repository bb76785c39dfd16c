"""Tolerances: the effect of deviations on the spots, by derivatives and by Monte Carlo.

The measure q of a lens is the mean over its fields of the squared RMS radius of the polychromatic
spot, after optimal compensation. Squared radii are quadratic in the position of the sensor, so that
a small linear system gives the compensation of every lens.
"""

import concurrent.futures
import os
from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from ..compilation import LARGE, ONCE, jit
from ..devices import copied, gathered, shared, split
from ..image.spot import deviations, normalised
from ..inputs import shown
from ..lens.lens import Lens
from ..numerics import concrete, safe_divide, safe_sqrt
from ..rays.status import Status
from .field_rays import EXTRAS, FieldRays, symmetry_by_structure, trace_views
from .perturbed import PerturbedLens
from .problem import Problem, quick

# Adjustment of every lens: the distance of the sensor, or also its tilts about x and y.
Compensator = Literal["none", "focus", "focus and tilt"]
# Order of a prediction: gradient of q, Gauss-Newton part of its Hessian, or whole Hessian.
Order = Literal["first", "rays", "second"]
_TILE = 50  # lenses of a tile, in one program on one core
_STEPS = {"none": 0, "focus": 1, "focus and tilt": 3}
_SYMMETRIES = ("rotational", "bilateral", "none")  # from the least of the pupil to all of it
_ASCENTS = 16  # eigenvectors from which ascents start, in both directions
_DEVIATION = 0.5  # standard deviation of normal deviations, in units of the largest


class AsBuilt(NamedTuple):
    """A lens as built, after compensation.

    squares: (V,), squared RMS radii of the spots, mm^2; inf where rays fail or no light passes.
    moves: (C,), compensation: shift of the sensor, mm, then its tilts about x and -y, radians.
    """

    squares: Array
    moves: Array

    @property
    def spot(self) -> Array:
        """The root of q, (), mm."""
        return jnp.sqrt(jnp.mean(self.squares, axis=-1))


def _spots(rays: FieldRays) -> tuple[Array, Array, Array]:
    """Distances from the centroid, mm, and how they grow with the sensor's distance, (D, V, W Q)
    each, times the root of the light; and centroids (2, V), mm."""
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


def _compensated(problem: Problem, lens: Lens, compensator: Compensator) -> tuple[AsBuilt, Array]:
    """A lens after compensation, and its residuals (D, V, W Q): distances from the centroids, whose
    squares add up to those of the RMS radii, mm."""
    rays = trace_views(lens, problem.views(), problem.solver)
    offsets, growth, (x, y) = _spots(rays)
    # The sensor moves by d + a y + b x along its normal where a spot is; d in parts of `sensor`.
    motion = lens.sensor_motion
    normal = jnp.ones_like(x) if motion is None else jnp.broadcast_to(motion[2], x.shape)
    levers = jnp.stack([normal, y, x])[: _STEPS[compensator]]
    moves = jnp.zeros(0, x.dtype)
    if len(levers):
        square = jnp.sum(growth**2, axis=(0, 2))
        matrix = (levers * square[None]) @ levers.T
        lit = matrix[0, 0] > 0
        matrix = jnp.where(lit, matrix, jnp.eye(len(levers), dtype=x.dtype))
        moves = jnp.linalg.solve(matrix, -levers @ jnp.sum(offsets * growth, axis=(0, 2)))
        offsets = offsets + growth * (moves @ levers)[None, :, None]
    light = rays.weights[..., EXTRAS:] > 0
    failed = jnp.any(light & ~rays.arrives[..., EXTRAS:], axis=(1, 2))
    valid = ~failed & jnp.all(rays.throughput > 0, axis=1)
    squares = jnp.where(valid, jnp.sum(offsets**2, axis=(0, 2)), jnp.inf)
    return AsBuilt(squares, moves), offsets


def as_built(problem: Problem, lens: Lens, compensator: Compensator) -> AsBuilt:
    """Evaluates a lens at the fields of a problem after compensation. Works in `jit`, `vmap` and
    under differentiation.

    ValueError for an unknown compensator, for one that the fields do not determine, and for a rule
    with more symmetry than the lens.
    """
    _check(problem, lens, compensator)
    return _compensated(problem, lens, compensator)[0]


def _require_known(what: str, word: object, known: tuple[str, ...]) -> None:
    if word not in known:
        raise ValueError(f"{what}: unknown {shown(word)}; known: {', '.join(known)}")


def _check(problem: Problem, lens: Lens, compensator: str) -> None:
    _require_known("compensator", compensator, get_args(Compensator))
    has, needs = problem.rule.symmetry, symmetry_by_structure(lens, axial=True)
    if _SYMMETRIES.index(has) < _SYMMETRIES.index(needs):
        raise ValueError(
            f'rule: "{has}" leaves out part of the pupil, but deviations break the symmetry; '
            f'use one of symmetry "{needs}", such as Gauss(6, "{needs}")'
        )
    if compensator == "focus and tilt" and concrete(problem.fields):
        tangents = np.tan(np.asarray(problem.fields, float))
        if np.linalg.matrix_rank(np.c_[np.ones(len(tangents)), tangents]) < 3:
            raise ValueError(
                "compensator: focus and tilt: the fields lie on a line, about which any tilt is "
                "as good; add fields beside it"
            )


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
        _require_known("order", order, get_args(Order))
        if order == "first":
            return 0 * self.hessian
        return self.gauss if order == "rays" else self.hessian

    def at(self, perturbation: Array | np.ndarray, order: Order) -> Array:
        """q (K,) for deviations (K, P); below 0 where the model fails. ValueError as `matrix`."""
        return (
            self.nominal
            + perturbation @ self.gradient
            + jnp.sum(perturbation * (perturbation @ self.matrix(order)), axis=-1) / 2
        )

    def moments(self, variances: Array, order: Order) -> tuple[Array, Array]:
        """Mean and standard deviation of q, () each, for independent deviations with variances
        (P,). The mean is exact for the quadratic model; the standard deviation holds for normal
        deviations (root sum of squares). ValueError as in `matrix`."""
        matrix = self.matrix(order)
        mean = self.nominal + jnp.diag(matrix) @ variances / 2
        pairs = variances @ matrix**2 @ variances / 2
        return mean, jnp.sqrt(self.gradient**2 @ variances + pairs)


def predict(problem: Problem, perturbed: PerturbedLens, compensator: Compensator) -> Predicted:
    """Predicts q from exact first and second derivatives. ValueError as in `as_built`."""
    _check(problem, perturbed.lens, compensator)
    if not concrete((problem, perturbed)):
        return _predict(problem, perturbed, compensator)
    found = _predict(quick(problem), perturbed, compensator)
    # What aiming does not find, the full search may.
    return found if bool(jnp.isfinite(found.nominal)) else _predict(problem, perturbed, compensator)


def _predict_all(problem: Problem, perturbed: PerturbedLens, compensator: Compensator) -> Predicted:
    zero = jnp.zeros_like(perturbed.sizes)
    units = jnp.eye(len(zero), dtype=zero.dtype)

    def rays(perturbation: Array) -> tuple[tuple[Array, Array], Array]:
        found, offsets = _compensated(problem, perturbed.lens_of(perturbation), compensator)
        return (jnp.ravel(offsets) / jnp.sqrt(len(found.squares)), found.moves), found.squares

    def measure(perturbation: Array) -> Array:
        return jnp.mean(
            _compensated(problem, perturbed.lens_of(perturbation), compensator)[0].squares
        )

    (offsets, moves), push, squares = jax.linearize(rays, zero, has_aux=True)
    derivatives, slopes = jax.lax.map(push, units)
    hessian = jax.lax.map(lambda unit: jax.jvp(jax.grad(measure), (zero,), (unit,))[1], units)
    gradient, gauss = 2 * derivatives @ offsets, 2 * derivatives @ derivatives.T
    return Predicted(jnp.mean(squares), gradient, gauss, hessian, moves, slopes)


# Second derivatives of a whole trace are large to compile and run once.
_predict = jit(_predict_all, ONCE, static_argnums=2)


def _parts(perturbed: PerturbedLens) -> list[list[int]]:
    """Indices of the deviations of each part: one, or the components x and y."""
    parts: dict[tuple, list[int]] = {}
    for k, error in enumerate(perturbed.deviations):
        parts.setdefault(error[:2], []).append(k)
    return list(parts.values())


def draw_perturbations(
    perturbed: PerturbedLens, count: int, seed: int, normal: bool = False
) -> np.ndarray:
    """Random deviations (count, P) in units of their largest: uniform up to 1, or normal with a
    standard deviation of 0.5, cut off at 1. Components x and y of one part lie within a circle."""
    rng = np.random.default_rng(seed)
    perturbation = np.empty((count, len(perturbed.deviations)))
    for part in _parts(perturbed):
        todo = np.arange(count)
        while len(todo):
            shape = len(todo), len(part)
            some = rng.normal(0, _DEVIATION, shape) if normal else rng.uniform(-1, 1, shape)
            perturbation[todo[:, None], part] = some
            todo = todo[np.linalg.norm(some, axis=1) > 1]
    return perturbation


def variances(perturbed: PerturbedLens, normal: bool = False) -> np.ndarray:
    """Variances (P,) of the deviations that `draw_perturbations` draws."""
    found = np.empty(len(perturbed.deviations))
    for part in _parts(perturbed):
        count = len(part)
        if not normal:
            found[part] = 1 / (count + 2)  # of the ball of that dimension
            continue
        # Of the chi distribution cut off at 1, by the midpoint rule in r.
        r = (np.arange(1000) + 0.5) / 1000
        density = r ** (count - 1) * np.exp(-(r**2) / (2 * _DEVIATION**2))
        found[part] = density @ r**2 / density.sum() / count
    return found


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
    for part in _parts(perturbed):
        size = np.linalg.norm(vector[part])
        perturbation[part] = vector[part] / size if size > 0 else np.eye(len(part))[0]
    return perturbation


def monte_carlo(
    problem: Problem,
    perturbed: PerturbedLens,
    perturbation: np.ndarray,
    compensator: Compensator,
    callback: Callable[[int], None] = lambda done: None,
    threads: int | None = None,
    mesh: Mesh | None = None,
) -> AsBuilt:
    """Traces lenses with given deviations; arrays (K, V) and (K, C). The result does not depend on
    threads, tiles or devices. Where aiming misses a ray, the full ray search decides whether it
    exists.

    perturbation: (K, P), deviations in units of their largest.
    callback: called with the number of lenses done.
    threads: number of threads; None for one per core.
    mesh: devices that share the lenses, of `devices.device_mesh`; each tile then is one for every
        device, and `threads` is not used. None for the default device.

    ValueError as in `as_built`.
    """
    _check(problem, perturbed.lens, compensator)
    width = len(perturbed.deviations)
    if np.ndim(perturbation) != 2 or np.shape(perturbation)[1] != width or not len(perturbation):
        raise ValueError(f"perturbation: expected (K, {width}), got shape {np.shape(perturbation)}")
    how = compensator, threads, mesh
    found = _in_tiles(quick(problem), perturbed, perturbation, callback, *how)
    # What aiming does not find, the full search may.
    failed = np.flatnonzero(~np.all(np.isfinite(found.squares), axis=1))
    if len(failed):
        again = _in_tiles(problem, perturbed, perturbation[failed], lambda done: None, *how)
        for array, rows in zip(found, again):
            array[failed] = rows
    return found


def _in_tiles(
    problem: Problem,
    perturbed: PerturbedLens,
    perturbation: np.ndarray,
    callback: Callable[[int], None],
    compensator: Compensator,
    threads: int | None,
    mesh: Mesh | None,
) -> AsBuilt:
    """`monte_carlo` with the solver of the problem."""
    size, width = _TILE * (mesh.size if mesh else 1), perturbation.shape[1]
    tiles = [perturbation[k : k + size] for k in range(0, len(perturbation), size)]
    problem, perturbed = copied(mesh, (problem, perturbed))

    def run(rows: np.ndarray) -> AsBuilt:
        whole = np.resize(rows, (size, width))  # a tile that is not full repeats its rows
        whole = split(mesh, whole.astype(perturbed.sizes.dtype))
        found = gathered(_many(problem, perturbed, whole, compensator, mesh))
        return jax.tree.map(lambda a: a[: len(rows)], found)

    parts, done = [run(tiles[0])], len(tiles[0])  # compiled once, not by all threads
    callback(done)
    # Devices that share a tile take the tiles in one order.
    with concurrent.futures.ThreadPoolExecutor(1 if mesh else threads or os.cpu_count()) as pool:
        for part in pool.map(run, tiles[1:]):
            parts.append(part)
            done += len(part.squares)
            callback(done)
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def _many_of(
    problem: Problem,
    perturbed: PerturbedLens,
    perturbation: Array,
    compensator: Compensator,
    mesh: Mesh | None,
) -> AsBuilt:
    def one(problem: Problem, perturbed: PerturbedLens, row: Array) -> AsBuilt:
        return _compensated(problem, perturbed.lens_of(row), compensator)[0]

    return shared(jax.vmap(one, (None, None, 0)), mesh, 2)(problem, perturbed, perturbation)


_many = jit(_many_of, LARGE, static_argnums=(3, 4))
