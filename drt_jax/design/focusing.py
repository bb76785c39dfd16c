"""What a lens that focuses does to the picture: angle of view, breathing and magnification."""

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
    """Picture of each of C configurations.

    angle: (C,), radians, at least 0: half the angle of view, between the axis and the object point
        whose chief ray meets the sensor at the given height, seen from the paraxial entrance pupil;
        inf if no chief ray comes there.
    breathing: (C,), tan(angle) relative to that of the first configuration, less 1: below 0 the
        picture is magnified, as if the lens became longer; inf if one of the angles is inf, or for
        a height of 0.
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

    An angle of a finite object needs a point that it is seen from. Here, and where breathing is
    measured, this is the entrance pupil of the configuration, the centre of perspective; a field
    of `Scene` is seen from the first vertex.

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
    breathing = tangents / jnp.where(both, tangents[0], 1) - 1
    return Focusing(
        jnp.where(known, jnp.arctan(tangents), jnp.inf),
        jnp.where(both, breathing, jnp.inf),
        magnifications,
        lengths,
    )
