"""How focusing changes the image: angle of view, breathing and magnification."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ..image.field import field_of_image
from ..inputs import require
from ..lens.lens import Lens
from ..lens.paraxial import first_order
from ..numerics import Numbers


class Focusing(NamedTuple):
    """Angle of view, breathing and magnification of each of C configurations.

    angle: (C,), radians, at least 0: half the angle of view, between the axis and the object point
        whose chief ray meets the sensor at the given height, measured at the paraxial entrance
        pupil; inf if no chief ray meets this point.
    breathing: (C,), tan(angle) divided by tan(angle) of the first configuration, minus 1. If it is
        negative, the angle of view is smaller, as with a longer focal length. It is inf if one of
        the angles is inf, and for a height of 0.
    magnification: (C,), paraxial, 0 for an object at infinity.
    focal_length: (C,), effective, mm.
    """

    angle: Array
    breathing: Array
    magnification: Array
    focal_length: Array


def focusing(
    lenses: Sequence[Lens], distances: Sequence[Numbers], height: Numbers, wavelength: Numbers
) -> Focusing:
    """Angle of view, focus breathing and magnification of a lens in several configurations.

    The angle of a finite object depends on the reference point. Here it is the entrance pupil of
    the configuration, the centre of perspective, as in measurements of breathing. A field of
    `Scene` refers to the first vertex.

    lenses: C lenses, such as `Configurations.lenses` returns them.
    distances: C distances of the object from the first vertex, mm; may be inf.
    height: of the image point on the sensor, along y, mm.
    wavelength: one, um.

    ValueError for other counts, and as `field_of_image`.
    """
    counts = len(lenses), len(distances)
    require(counts[0] == counts[1] > 0, f"distances: {counts[1]} for {counts[0]} lenses")
    rows = []
    for lens, distance in zip(lenses, distances, strict=True):
        point = jnp.stack([jnp.zeros_like(lens.sensor), jnp.asarray(height, lens.sensor.dtype)])
        field = field_of_image(lens, point, distance, wavelength)[1]
        far = jnp.asarray(distance, field.dtype)
        first = first_order(lens, far, jnp.atleast_1d(jnp.asarray(wavelength, field.dtype)))
        share = 1 / (1 + first.entrance_pupil.position[0] / far)
        rows.append((field, share, first.magnification[0], first.effective_focal_length[0]))
    fields, shares, magnifications, lengths = map(jnp.stack, zip(*rows, strict=True))
    known = jnp.isfinite(fields)
    tangents = jnp.abs(jnp.tan(jnp.where(known, fields, 0)) * shares)
    both = known & known[0] & (tangents[0] > 0)
    breathing = jnp.where(both, tangents / jnp.where(both, tangents[0], 1) - 1, jnp.inf)
    angles = jnp.where(known, jnp.arctan(tangents), jnp.inf)
    return Focusing(angles, breathing, magnifications, lengths)
