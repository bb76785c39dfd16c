"""Status codes of rays."""

import enum

from jax import Array


class Status(enum.IntEnum):
    """Status of a ray: the first failure along it; CLIPPED only if nothing else fails."""

    OK = 0
    MISSED = 1  # no forward intersection with a surface
    TIR = 2  # total internal reflection
    CLIPPED = 3  # outside a clear aperture, or inside an obscuration
    UNCONVERGED = 4  # the search found no stationary path through the stop point
    NO_INDEX = 5  # the wavelength lies outside the range of a glass
    CROSSED = 6  # neighbouring surfaces cross: the ray would have to step back to the second


def reaches_sensor(status: Array) -> Array:
    """True for rays that exist, clipped or not: OK and CLIPPED. status: any shape; bool."""
    return (status == Status.OK) | (status == Status.CLIPPED)
