"""Rays that are found outside of `jax.jit`, by compiled programs that all analyses of a lens share.

The search for rays is most of what an analysis compiles. An analysis of known numbers therefore
finds its rays first, in tiles of one size (`known_rays`), and its own program only gives them
derivatives. Inside of `jax.jit` and `jax.vmap`, where numbers are not known, its program searches.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import eager_values
from .find import Found
from .solve import Solver, reattach, solve, solve_aimed
from .status import Status
from .system import System, Vector
from .trace import Bundle, aims, bundle_of

# Number of rays of a tile, by the number of stop coordinates. A Gauss rule of 13 nodes fills one.
TILE = {1: 42, 2: 208}
# Larger bundles are found by polynomials, in the program of the analysis.
_MOST = 1024


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Known:
    """A `Solver` that returns rays that were found before; it searches if there are none.

    found: the rays; None for a search. For a scene of several points, the P points are the first
        axis of all arrays.
    plan: result of `PupilRule.plan`, with the same first axis.
    """

    found: Found | None = None
    plan: Any = None

    def __call__(self, system: System, target: Vector) -> Found:
        """The rays through stop points, with derivatives in every mode."""
        found = self.found
        return solve(system, target) if found is None else reattach(found, system, target)


# Nothing is known.
SEARCH = Known()


def known_rays(
    lens: Lens,
    scene: Scene,
    sampling: Any,
    aim: Callable[[Lens, Scene, Any], tuple[Vector, Any]] | None = None,
) -> Known:
    """Finds the rays of all points of a scene. The result has no rays inside of `jax.jit` and
    `jax.vmap`, and for more than 1024 rays.

    sampling: stop points, D arrays (Q,) or (W, Q); or the argument from which `aim` makes them.
    aim: function of the lens, a scene of one point, and the sampling. Returns stop points and a
        plan.
    """
    known = eager_values((lens, scene, sampling))
    if known is None:
        return SEARCH
    lens, scene, sampling = known
    each = []
    for point in scene.each() if scene.shape else [scene]:
        points, plan = aim(lens, point, sampling) if aim else (sampling, None)
        each.append(Known(_found(lens, point, points), plan))
    return jax.tree.map(lambda *a: np.stack(a), *each) if scene.shape else each[0]


def _found(lens: Lens, scene: Scene, points: Vector) -> Found | None:
    """Rays of one point: aimed, and searched for in tiles where aiming fails."""
    stop = wide(scene, points)
    if stop.shape[-1] > _MOST:
        return None

    def tile(points: np.ndarray) -> Found:
        found = trace_tile(lens, scene, (*points,), solve_aimed)[1]
        missing = np.all(np.isfinite(points), axis=0) & (np.asarray(found.status) != Status.OK)
        return trace_tile(lens, scene, (*points,), solve)[1] if np.any(missing) else found

    return joined(map(tile, tiles(stop)), stop.shape[-1])


def wide(scene: Scene, points: Any) -> np.ndarray:
    """Stop points, D arrays (Q,) or (W, Q), as an array (D, W, Q)."""
    known = jax.tree.map(np.asarray, points)
    shape = scene.wavelengths.size, known[0].shape[-1]
    return np.stack([np.broadcast_to(p, shape) for p in known])


def tiles(stop: np.ndarray) -> list[np.ndarray]:
    """Stop points (D, W, Q) in tiles of the size `TILE`. The last one repeats rays."""
    size, count = TILE[len(stop)], stop.shape[-1]
    return [stop[..., rays] for rays in np.resize(np.arange(count), (-(-count // size), size))]


def joined(parts: Iterable[Any], count: int) -> Any:
    """Joins trees of arrays (..., Q) of tiles along the rays, and keeps the first `count` rays, as
    NumPy arrays. Of scalars it keeps the largest."""

    def join(*arrays: Array) -> np.ndarray:
        every = [np.asarray(a) for a in arrays]
        whole = np.concatenate(every, axis=-1)[..., :count] if every[0].ndim else np.max(every)
        return np.asarray(whole)

    return jax.tree.map(join, *parts)


@functools.partial(jit, wanted=LARGE, static_argnames="solver")
def trace_tile(lens: Lens, scene: Scene, points: Vector, solver: Solver) -> tuple[Bundle, Found]:
    """Rays of one tile, (W, Q): as `trace_bundle` returns them, and as the solver found them."""
    system, target = aims(lens, scene, points)
    found = solver(system, target)
    return bundle_of(lens, scene, system, target, found), found
