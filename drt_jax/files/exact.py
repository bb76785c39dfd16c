"""Numbers for written files that read back as exactly the numbers they stand for."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np


def number_for(target: float, read: Callable[[float], float], guess: float) -> float:
    """The number near `guess` that `read` maps to `target`, or as close to it as possible."""
    near = (guess + np.arange(-8, 9) * np.spacing(abs(guess))).tolist()
    return min([guess, *near], key=lambda number: abs(read(number) - target))


def degrees_of(angle: np.floating | float) -> float:
    """The angle in degrees that reads back as `angle` (radians), or as close as possible."""
    return number_for(float(angle), lambda d: float(jnp.radians(d)), float(np.degrees(angle)))
