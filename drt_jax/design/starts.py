"""Many starts: parallel searches with successive halving, and a ranking of the minima they find."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from ..compilation import LARGE, jit
from ..devices import shared
from ..inputs import require
from ..numerics import Numbers
from ..rays.solve import solve_aimed
from .configurations import AnyProblem, Configurations, SharedVariables
from .least_squares import Search
from .optimum import init_problem, step_problem
from .problem import trace_fields
from .tiles import in_tiles, tile_size
from .variables import Variables

# Number of searches in a tile. The searches of one tile run in one program on one core.
_TILE = 16
# Two minima count as the same if their merits differ by less than `_SAME_MERIT` (relative), and
# their vectors by less than `_SAME_PLACE` (root mean square, in units of the scales).
_SAME_MERIT, _SAME_PLACE = 1e-3, 1.0


def normal_starts(
    variables: Variables | SharedVariables, count: int, spread: float, seed: int = 0
) -> np.ndarray:
    """Starts around the lens, within the bounds: its own vector, then normally distributed vectors.

    variables: variables of the lens.
    count: number of starts.
    spread: standard deviation, in units of the scales of the variables.
    seed: seed of NumPy's generator.

    Returns (count, N).
    """
    moves = np.random.default_rng(seed).normal(size=(count, len(variables.names)))
    moves[0] = 0
    return np.clip(np.asarray(variables.start) + spread * moves, variables.low, variables.high)


def sobol_starts(variables: Variables | SharedVariables, count: int, seed: int = 0) -> np.ndarray:
    """Starts that are evenly distributed within the bounds (scrambled Sobol sequence).

    variables: variables, all with bounds. ValueError, which names it, for a variable without
        bounds.
    count: number of starts.
    seed: seed of the scrambling.

    Returns (count, N).
    """
    from scipy.stats import qmc  # takes a second to import

    low, high = np.asarray(variables.low), np.asarray(variables.high)
    for name, bounds in zip(variables.names, zip(low, high)):
        bounded = np.all(np.isfinite(bounds))
        require(bounded, f"variables: {name}: starts within bounds need low and high")
    power = int(np.ceil(np.log2(max(count, 2))))
    points = qmc.Sobol(len(low), seed=seed).random_base2(power)[:count]
    return low + points * (high - low)


def as_built_starts(
    variables: Variables, count: int, per_cent: float = 1.0, off_mm: float = 0.1, seed: int = 0
) -> np.ndarray:
    """Starts at lenses as they might be built, with normally distributed errors.

    variables: variables of the lens.
    count: number of starts.
    per_cent: standard deviation of all curvatures, per cent.
    off_mm: standard deviation of all thicknesses, mm.
    seed: seed of NumPy's generator.

    Returns (count, N).
    """
    rng, lens, vectors = np.random.default_rng(seed), variables.lens, []
    for _ in range(count):
        bend = 1 + 0.01 * per_cent * rng.normal(size=lens.count + 1)
        gap = lens.thickness + off_mm * rng.normal(size=lens.count - 1)
        built = dataclasses.replace(lens, curvature=lens.curvature * bend, thickness=gap)
        vectors.append(np.asarray(variables.vector(built)))
    return np.stack(vectors)


class Minimum(NamedTuple):
    """One of the distinct minima.

    vector: (N,), its vector.
    merit, max_violation: as in `Optimum`.
    found: number of searches that ended there.
    start: number of the start of the search with the lowest score.
    """

    vector: np.ndarray
    merit: float
    max_violation: float
    found: int
    start: int


class Starts(NamedTuple):
    """Result of many starts.

    minima: the distinct minima, the best first.
    merits: (K,), score of every start at the end of its search; inf if no ray ever passed.
    steps, jacobians, rays: totals over all searches.
    seconds: total time.
    compile_s: time of the compilation, which is a part of `seconds`.
    best: best score after each tile.
    """

    minima: list[Minimum]
    merits: np.ndarray
    steps: int
    jacobians: int
    rays: int
    seconds: float
    compile_s: float
    best: list[float]


_begin = jax.jit(jax.vmap(init_problem, (None, 0)))


@partial(jit, wanted=LARGE, static_argnames="mesh")
def _advance(problem: AnyProblem, steps: Array, searches: Search, mesh: Mesh | None) -> Search:
    """Takes `steps` steps of a tile of searches. A device whose searches are all done takes
    fewer.
    """
    each = jax.vmap(step_problem, (None, 0))

    def here(problem: AnyProblem, steps: Array, searches: Search) -> Search:
        def more(state: tuple[Array, Search]) -> Array:
            return (state[0] < steps) & ~jnp.all(state[1].done)

        def step(state: tuple[Array, Search]) -> tuple[Array, Search]:
            return state[0] + 1, each(problem, state[1])

        return jax.lax.while_loop(more, step, (jnp.int32(0), searches))[1]

    return shared(here, mesh, 2)(problem, steps, searches)


def many_starts(
    problem: AnyProblem,
    starts: Numbers,
    steps: Sequence[int] = (12, 12, 24, 48, 200),
    survivors: float = 0.5,
    callback: Callable[[int, int, float], None] = lambda done, total, best: None,
    threads: int | None = None,
    mesh: Mesh | None = None,
) -> Starts:
    """Searches from many starts with successive halving (Jamieson and Talwalkar 2016).

    Each stage takes some steps of every remaining search; the better part of them continues to the
    next stage. A search that fails is ranked last. At the end the full ray search evaluates the
    searches whose rays aiming misses. If the best of all is one of them, it continues with the full
    ray search. The result does not depend on threads, tiles or devices.

    problem: the design problem.
    starts: (K, N).
    steps: number of steps of every search in each stage.
    survivors: fraction of the searches that continues to the next stage, at least a tile of 16.
    callback: called with the number of tiles done, the number of all tiles, and the best score so
        far.
    threads: number of threads; None for one per core.
    mesh: devices that share the searches, of `devices.device_mesh`. A tile then has 16 searches for
        every device, and `threads` is not used. None for the default device.

    ValueError for starts of another shape.
    """
    begun = time.perf_counter()
    vectors = np.asarray(starts, float)
    width = len(problem.variables.names)
    valid = vectors.ndim == 2 and vectors.shape[1] == width and len(vectors)
    require(valid, f"starts: expected (K, {width}), got shape {vectors.shape}")
    vectors = np.clip(vectors, problem.variables.low, problem.variables.high)
    tried = problem.with_solver(solve_aimed)
    state = jax.tree.map(np.array, _begin(tried, jnp.asarray(vectors)))
    best: list[float] = []

    def rows(which: np.ndarray) -> Search:
        return jax.tree.map(lambda a: a[which], state)

    def advance(problem: AnyProblem, searches: np.ndarray, steps: int) -> Iterator[None]:
        """Advances searches in place; yields after each tile."""
        done, whole = 0, (problem, np.int32(steps))
        for part in in_tiles(_advance, whole, rows(searches), _TILE, threads, mesh):
            own = searches[done : done + len(part.done)]
            done += len(own)
            for array, new in zip(jax.tree.leaves(state), jax.tree.leaves(part), strict=True):
                array[own] = new
            yield

    sizes = [len(vectors)]
    for _ in steps[1:]:
        sizes.append(min(sizes[-1], max(_TILE, math.ceil(survivors * sizes[-1]))))
    alive = np.arange(len(vectors))
    total = sum(-(-size // tile_size(_TILE, mesh)) for size in sizes)
    [*advance(tried, alive[:1], 0)]
    compiled = time.perf_counter() - begun

    def search(problem: AnyProblem, searches: np.ndarray, steps: int) -> None:
        """Advances searches, and calls `callback` after each tile."""
        for _ in advance(problem, searches, steps):
            best.append(float(np.min(rows(alive).score)))
            callback(len(best), max(total, len(best)), best[-1])

    for size, stage_steps in zip(sizes, steps):
        alive = alive[np.argsort(rows(alive).score, kind="stable")[:size]]
        search(tried, alive, stage_steps)
    lost = state.evaluation.failed.copy()
    missed = alive[lost[alive] > 0]
    state.stale[missed], state.done[missed] = True, False
    total += -(-len(missed) // tile_size(_TILE, mesh))
    search(problem, missed, 1)
    first = alive[np.argmin(rows(alive).score)]
    if state.evaluation.failed[first] < lost[first]:
        search(problem, np.array([first]), steps[-1])
    total_steps, jacobians = int(np.sum(state.steps)), int(np.sum(state.jacobians))
    counts = total_steps, jacobians, total_steps * rays_of(problem)
    seconds, minima = time.perf_counter() - begun, distinct(rows(alive), alive)
    return Starts(minima, np.asarray(state.score), *counts, seconds, compiled, best)


def rays_of(problem: AnyProblem) -> int:
    """Number of rays that one evaluation of a problem traces."""
    if isinstance(problem, Configurations):
        return sum(map(rays_of, problem.problems))
    if not problem.traces:
        return 0
    rays = jax.eval_shape(lambda p: trace_fields(p, p.variables.lens).weights, problem)
    return int(np.prod(rays.shape))


def distinct(searches: Search, numbers: np.ndarray) -> list[Minimum]:
    """The distinct minima of searches (K,), the best first.

    searches: states of the searches.
    numbers: (K,), numbers of their starts.
    """
    scores, vectors = np.asarray(searches.score), np.asarray(searches.vector)
    merits, violations = np.asarray(searches.merit), np.asarray(searches.max_violation)
    found: list[Minimum] = []
    for k in np.argsort(scores, kind="stable"):
        if not np.isfinite(scores[k]):
            continue
        for m, other in enumerate(found):
            near = np.sqrt(np.mean((vectors[k] - other.vector) ** 2)) < _SAME_PLACE
            if near and abs(merits[k] - other.merit) < _SAME_MERIT * other.merit:
                found[m] = other._replace(found=other.found + 1)
                break
        else:
            known = float(merits[k]), float(violations[k]), 1, int(numbers[k])
            found.append(Minimum(vectors[k], *known))
    return found
