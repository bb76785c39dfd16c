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

__all__ = [
    "disc",
    "half_disc",
    "hexapolar",
    "meridian",
    "random_disc",
    "sobol",
    "sobol_disc",
    "square_grid",
]
