"""What became of a ray."""

import enum


class Status(enum.IntEnum):
    """The first of MISSED and TIR along a ray; CLIPPED only if it is whole."""

    OK = 0
    MISSED = 1  # no forward intersection with a surface
    TIR = 2  # total internal reflection
    CLIPPED = 3  # outside a clear aperture, or inside an obscuration
    UNCONVERGED = 4  # the search found no stationary path through the stop point
    NO_INDEX = 5  # the wavelength lies outside the range of a glass
