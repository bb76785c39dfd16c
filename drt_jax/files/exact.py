"""Numbers of written files that are read as the very numbers that they stand for."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np


def number_for(target: float, read: Callable[[float], float], guess: float) -> float:
    """The number next to `guess` of which `read` makes `target`, or what is nearest to it."""
    near = (guess + np.arange(-8, 9) * np.spacing(abs(guess))).tolist()
    return min([guess, *near], key=lambda number: abs(read(number) - target))


def degrees_of(angle: np.floating | float) -> float:
    """The number of degrees that is read as this angle in radians, or the next to it."""
    return number_for(float(angle), lambda d: float(jnp.radians(d)), float(np.degrees(angle)))
