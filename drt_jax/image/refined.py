"""Refinement: finer trials until the error is within a tolerance. It also finds the number of pupil
cells.

For the cells, the rays are traced once. Each trial evaluates their polynomials on a finer grid. The
error falls with the square of the number of cells or faster, so the change from one trial to the
next bounds the error.
"""

import collections
import functools
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from ..compilation import LARGE, jit
from ..inputs import warn
from ..lens.lens import Lens
from ..lens.scene import Scene, over_points
from ..numerics import concrete, known_values
from ..pupil.rules import rule_rays
from ..rays.known import Known
from .beam import Beam, BeamRule, trace_beam
from .beam_psf import CELLS

T = TypeVar("T")
# Numbers of cells along a side to try.
_TRIALS = (64, 96, 128, 192, 256, 384, 512)
# The error of the finer of two trials is at most their change divided by this: the number of cells
# n rises by 4/3 or more, the error falls as 1 / n^2, and (4/3)^2 - 1 > 0.75.
STEP = 0.75
# Default tolerance of contrast, Strehl ratio and encircled energy, absolute.
TOLERANCE = 1e-3


def require_known(tree: Any, what: str, function: str) -> Any:
    """The numbers of a tree from which a sampling is chosen. ValueError inside `jit` and `vmap`.

    tree: arguments of the choice.
    what, function: name of the sampling, and the public function that takes it, for the message.
    """
    known = known_values(tree)
    if known is None:
        raise ValueError(
            f"inside jax.jit or jax.vmap {what} cannot be chosen for a tolerance: make the "
            f"sampling outside and pass it on, sampling=drt_jax.converge(drt_jax.{function}, ...)"
        )
    return known


def refine(
    trials: Iterable[T], error: Callable[..., float], tolerance: float, together: int = 2
) -> tuple[list[T], float]:
    """Makes ever finer trials until the error is within a tolerance.

    trials: from coarse to fine. They are made one by one, and none after the error is small enough.
    error: function of the last `together` trials, as many arguments, the finest last.
    tolerance: bound of the error.
    together: number of trials that are compared.

    Returns the last trials, the finest last, and their error. It is above the tolerance if no
    trials meet it, and inf if there are fewer than `together`.
    """
    last: collections.deque[T] = collections.deque(maxlen=together)
    found = np.inf
    for trial in trials:
        last.append(trial)
        if len(last) == together and (found := error(*last)) <= tolerance:
            break
    return list(last), found


def beams_of(lens: Lens, scene: Scene, rule: BeamRule) -> Beam:
    """Beams of the points of a scene, which are the first axes of their arrays.

    lens, scene: the lens, and object points with their wavelengths.
    rule: rays and polynomials.
    """
    return _beams(lens, scene, rule, rule_rays(lens, scene, rule.rule))


@functools.partial(jit, wanted=LARGE)
def _beams(lens: Lens, scene: Scene, rule: BeamRule, known: Known) -> Beam:
    """`beams_of`, compiled."""
    return over_points(lambda point, known: trace_beam(lens, point, rule, known), scene, known)


def to_tolerance(
    run: Callable[..., Any], args: tuple, cells: int | None, tolerance: float, fewest: Callable
) -> Any:
    """`run(*args, cells=cells)` with the fewest cells for which the error of each number is below a
    tolerance.

    run: function that returns arrays.
    args: its positional arguments.
    cells: a number of cells; None to find it, or `CELLS` inside of `jit` and `vmap`.
    tolerance: absolute.
    fewest: function of the same arguments; returns the number of cells to begin with.

    Warns if no trial meets the tolerance.
    """
    known = known_values(args)
    if cells is not None or known is None:
        return run(*args, cells=CELLS if cells is None else cells)
    with jax.core.eval_context():
        first = fewest(*known)
        tried = [n for n in _TRIALS if n >= first or n in _TRIALS[-2:]]
        trials = ((n, run(*known, cells=n)) for n in tried)
        (*_, (cells, found)), error = refine(trials, _change, tolerance)
        if error > tolerance:
            warn(
                f"{cells} x {cells} cells of the pupil have converged to {error:.0e} only, not to "
                f"{tolerance:.0e}: the blur is too large for them; try kind='rays'"
            )
    return found if concrete(args) else run(*args, cells=cells)


def _change(before: tuple[int, Any], now: tuple[int, Any]) -> float:
    """Bound of the error of the finer of two trials: pairs of a number of cells and arrays."""
    pairs = zip(jax.tree.leaves(now[1]), jax.tree.leaves(before[1]), strict=True)
    return max(float(jnp.max(jnp.abs(a - b))) for a, b in pairs) / STEP
