"""Rays of a rule traced in tiles of a fixed size, so that rules of all sizes share a compiled
program. For use outside of traces only."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene
from ..pupil.clipped import ClippedGroup, Fitted
from ..pupil.rules import Pattern, PupilRule
from ..rays.find import Found
from ..rays.solve import Solver
from ..rays.status import Status
from ..rays.system import Vector
from ..rays.trace import Bundle, aims, bundle_of
from .moments import FocusMoments, weigh

# Number of rules that are weighed at once: the orders of a clipped group.
AT_ONCE = 3
# Number of rays of a tile, by the number of stop coordinates. A Gauss rule of 13 nodes fills one.
_TILE = {1: 42, 2: 208}


class Traced(NamedTuple):
    """Traced rays of a rule.

    weights: (1 or W, Q), weights of the rule.
    bundle: the rays.
    found: their hits on the active surfaces; MISSED for rays that were not traced.
    failing: True if a ray fails.
    cut: True if a ray is clipped.
    """

    weights: np.ndarray
    bundle: Bundle
    found: Found
    failing: bool
    cut: bool


def trace_rule(lens: Lens, scene: Scene, rule: PupilRule, solver: Solver) -> Traced:
    """Traces the rays of a rule. Rays of weight 0 are left out if the rule is fitted to a
    clipped pupil."""
    points, weights = jax.tree.map(np.asarray, _points(lens, scene, rule))
    waves, total = scene.wavelengths.size, weights.shape[-1]
    # Rays of weight 0 are padding in fitted rules. In other rules they show whether light is
    # clipped.
    fitted = isinstance(rule, Fitted)
    rays = np.flatnonzero(np.any(weights, axis=0)) if fitted else np.arange(total)
    size, count = _TILE[len(points)], len(rays)
    tiles = np.resize(rays if count else 0, (max(-(-count // size), 1), size))
    every = [np.broadcast_to(p, (waves, total)) for p in points]
    parts = [_trace(lens, scene, tuple(p[:, tile] for p in every), solver) for tile in tiles]

    def whole(*parts: Array) -> np.ndarray:  # (..., size) each -> (..., Q)
        """Joins arrays of the tiles to one with all Q rays."""
        arrays = [np.asarray(a) for a in parts]
        if not arrays[0].ndim:
            return np.max(arrays, axis=0)
        joined = np.concatenate(arrays, axis=-1)[..., :count]
        blank = Status.MISSED if joined.dtype == np.int32 else 0
        found = np.full((*joined.shape[:-1], total), blank, joined.dtype)
        found[..., rays] = joined
        return found

    bundle, found = parts[0] if total == size else jax.tree.map(whole, *parts)
    status = np.asarray(bundle.status)[:, rays]
    cut = status == Status.CLIPPED
    failing = np.any((status != Status.OK) & ~cut)
    return Traced(weights, bundle, found, bool(failing), bool(np.any(cut)))


def weigh_rules(
    lens: Lens, rules: Sequence[Pattern | ClippedGroup], traced: Traced
) -> list[FocusMoments]:
    """Moments, as NumPy arrays, of traced rays by several rules.

    lens: the lens.
    rules: up to `AT_ONCE` rules with the points of the rule that the rays were traced for: orders
        of the group, or patterns.
    traced: the rays.
    """

    def own(rule: Pattern | ClippedGroup) -> np.ndarray:
        """Weights (1 or W, Q) of one rule."""
        if isinstance(rule, ClippedGroup):
            return np.where(rule.own(lens)[None], traced.weights, 0)
        return np.asarray(rule.weights, lens.curvature.dtype)[None]

    # Always `AT_ONCE` rules, so that all calls share a program.
    weights = np.stack([own(rules[min(k, len(rules) - 1)]) for k in range(AT_ONCE)])
    found = jax.tree.map(np.asarray, _weigh(lens, rules[0], weights, traced.bundle))
    return [jax.tree.map(lambda a: a[k], found) for k in range(len(rules))]


@partial(jit, wanted=LARGE)
def _points(lens: Lens, scene: Scene, rule: PupilRule) -> tuple[Vector, Array]:
    """Points and weights of a rule, compiled."""
    return rule.points(lens, scene)


@partial(jit, wanted=LARGE, static_argnames="solver")
def _trace(lens: Lens, scene: Scene, points: Vector, solver: Solver) -> tuple[Bundle, Found]:
    """Rays of one tile."""
    system, target = aims(lens, scene, points)
    found = solver(system, target)
    return bundle_of(lens, scene, system, target, found), found


_weigh = jit(jax.vmap(weigh, (None, None, 0, None)), LARGE)
