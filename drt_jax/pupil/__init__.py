"""Where rays cross the stop: patterns of points and quadrature rules."""

from .patterns import (
    disc,
    half_disc,
    hexapolar,
    meridian,
    random_disc,
    sobol,
    sobol_disc,
    square_grid,
)
from .rules import PupilRule, pupil_points, symmetry_of

__all__ = [
    "PupilRule",
    "disc",
    "half_disc",
    "hexapolar",
    "meridian",
    "pupil_points",
    "random_disc",
    "sobol",
    "sobol_disc",
    "square_grid",
    "symmetry_of",
]
