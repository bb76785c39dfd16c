"""As many cells of the pupil as a tolerance asks for, found by trials.

The rays are traced once; each trial evaluates their polynomials on a finer grid. Its error falls
with the square of the number of cells or faster, so that the change from one trial to the next
tells it.
"""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import concrete, known_values
from ..pupil.rules import PupilRule
from .beam import Beam, beam_rule, trace_beam

# Cells along a side to try, and where values are not known.
_TRIALS = (64, 96, 128, 192, 256, 384, 512)
CELLS = 128
# The least change to the next trial, a step of 4/3 or more, for an error of 1 that is left.
_STEP = 0.75
# Default tolerance of contrast, Strehl ratio and encircled energy, absolute.
TOLERANCE = 1e-3


@functools.partial(jit, wanted=LARGE, static_argnames="degree")
def beams_of(lens: Lens, fields: Array, axis: Scene, rule: PupilRule, degree: int) -> Beam:
    """Beams of fields (F, 2): their arrays begin with the field. axis: the scene of the axis."""
    made = beam_rule(degree, rule.symmetry, rule)
    one = lambda field: trace_beam(lens, Scene(field, axis.distance, axis.wavelengths), made)  # noqa: E731
    return jax.vmap(one)(fields)


def to_tolerance(
    of: Callable[..., Any], given: tuple, cells: int | None, tolerance: float, fewest: Callable
) -> Any:
    """`of(*given, cells=cells)`, arrays, with the fewest cells that keep the error of each number
    below a tolerance. cells: so many; None: found, or `CELLS` inside of `jit` and `vmap`. fewest:
    of `given`, the number of cells to begin with.

    ValueError for a tolerance that is not between 0 and 1. Warns if no trial meets it."""
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance: expected a number between 0 and 1, got {tolerance!r}")
    known = known_values(given)
    if cells is not None or known is None:
        return of(*given, cells=CELLS if cells is None else cells)
    with jax.core.eval_context():
        before, change, first = None, np.inf, fewest(*known)
        for cells in [n for n in _TRIALS if n >= first or n in _TRIALS[-2:]]:
            now = of(*known, cells=cells)
            if before is not None:
                pairs = zip(jax.tree.leaves(now), jax.tree.leaves(before), strict=True)
                change = max(float(jnp.max(jnp.abs(a - b))) for a, b in pairs) / _STEP
            if change <= tolerance:
                break
            before = now
        else:
            warnings.warn(
                f"{cells} x {cells} cells of the pupil have converged to {change:.0e} only, not to "
                f"{tolerance:.0e}: the blur is too large for them; try model='rays'",
                stacklevel=4,
            )
    return now if concrete(given) else of(*given, cells=cells)
