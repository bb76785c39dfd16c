"""Tolerances: random deviations of a lens, and Monte Carlo simulation with them."""

from collections.abc import Callable

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh

from ..compilation import LARGE, jit
from ..devices import copied, gathered, in_turn, shared, split
from .compensate import AsBuilt, Compensator, check, compensated
from .perturbed import PerturbedLens
from .problem import Problem, quick

_TILE = 50  # number of lenses in a tile, which runs in one program on one core
_DEVIATION = 0.5  # standard deviation of normal deviations, in units of the largest


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
    uniform distribution in the unit ball; for the normal one, the density of r is proportional to
    r^(n - 1) exp(-2 r^2) up to 1.

    perturbed: the lens and its deviations.
    normal: True for the normal distribution.
    """
    found = np.empty(len(perturbed.deviations))
    for part in perturbed.parts:
        count = len(part)
        if not normal:
            found[part] = 1 / (count + 2)  # a uniform distribution in the ball of this dimension
            continue
        # The second moment of the chi distribution cut off at 1, by the midpoint rule in r.
        r = (np.arange(1000) + 0.5) / 1000
        density = r ** (count - 1) * np.exp(-(r**2) / (2 * _DEVIATION**2))
        found[part] = density @ r**2 / density.sum() / count
    return found


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
    width = len(perturbed.deviations)
    if np.ndim(perturbation) != 2 or np.shape(perturbation)[1] != width or not len(perturbation):
        raise ValueError(f"perturbation: expected (K, {width}), got shape {np.shape(perturbation)}")
    how = compensator, threads, mesh
    found = _in_tiles(quick(problem), perturbed, perturbation, callback, *how)
    # The full search may find rays that aiming does not find.
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
    """`monte_carlo` with the solver of the problem alone."""
    size, width = _TILE * (mesh.size if mesh else 1), perturbation.shape[1]
    tiles = [perturbation[k : k + size] for k in range(0, len(perturbation), size)]
    problem, perturbed = copied(mesh, (problem, perturbed))

    def run(rows: np.ndarray) -> AsBuilt:
        whole = np.resize(rows, (size, width))  # a tile that is not full repeats its rows
        whole = split(mesh, whole.astype(perturbed.sizes.dtype))
        found = gathered(_many(problem, perturbed, whole, compensator, mesh))
        return jax.tree.map(lambda a: a[: len(rows)], found)

    parts, done = [], 0
    # Devices that share a tile take the tiles in one order.
    for part in in_turn(run, tiles, 1 if mesh else threads):
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
    """The lenses of one tile, shared among the devices of a mesh."""

    def one(problem: Problem, perturbed: PerturbedLens, row: Array) -> AsBuilt:
        return compensated(problem, perturbed.lens_of(row), compensator)[0]

    return shared(jax.vmap(one, (None, None, 0)), mesh, 2)(problem, perturbed, perturbation)


_many = jit(_many_of, LARGE, static_argnums=(3, 4))
