"""The number of pupil cells that a tolerance asks for, found by trials.

The rays are traced once. Each trial evaluates their polynomials on a finer grid. The error falls
with the square of the number of cells or faster, so the change from one trial to the next bounds
the error.
"""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene, over_points
from ..numerics import concrete, known_values
from .beam import Beam, BeamRule, trace_beam
from .beam_psf import CELLS

# Numbers of cells along a side to try.
_TRIALS = (64, 96, 128, 192, 256, 384, 512)
# The error of the finer of two trials is at most their change divided by this: the number of cells
# n rises by 4/3 or more, the error falls as 1 / n^2, and (4/3)^2 - 1 > 0.75.
_STEP = 0.75
# Default tolerance of contrast, Strehl ratio and encircled energy, absolute.
TOLERANCE = 1e-3


@functools.partial(jit, wanted=LARGE)
def beams_of(lens: Lens, scene: Scene, rule: BeamRule) -> Beam:
    """Beams of the points of a scene, which are the first axes of their arrays.

    lens, scene: the lens, and object points with their wavelengths.
    rule: rays and polynomials.
    """
    return over_points(lambda point: trace_beam(lens, point, rule), scene)


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
        before, change, first = None, np.inf, fewest(*known)
        for cells in [n for n in _TRIALS if n >= first or n in _TRIALS[-2:]]:
            now = run(*known, cells=cells)
            if before is not None:
                pairs = zip(jax.tree.leaves(now), jax.tree.leaves(before), strict=True)
                change = max(float(jnp.max(jnp.abs(a - b))) for a, b in pairs) / _STEP
            if change <= tolerance:
                break
            before = now
        else:
            warnings.warn(
                f"{cells} x {cells} cells of the pupil have converged to {change:.0e} only, not to "
                f"{tolerance:.0e}: the blur is too large for them; try kind='rays'",
                stacklevel=4,
            )
    return now if concrete(args) else run(*args, cells=cells)
