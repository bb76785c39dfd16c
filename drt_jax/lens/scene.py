"""The scene: an object point and wavelengths."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import Numbers, concrete, real_array
from .lens import Lens

_RIGHT = np.pi / 2
# Smallest distance of an object in front of the first vertex or behind it, mm: the square of
# 1 / distance is still finite in float32.
NEAREST = 1e-6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scene:
    """An object point and its wavelengths, as arrays of one floating dtype.

    field: (2,), angles along x and y, radians: light travels along (tan x, tan y, 1).
    distance: (), from the object plane to the first vertex, mm; inf, or -inf, for an object at
        infinity. Below 0 for a virtual object: light that converges to a point behind the first
        vertex.
    wavelengths: (W,), um.
    """

    field: Array
    distance: Array
    wavelengths: Array

    @property
    def possible(self) -> Array:
        """True if light from the object can enter the lens, (), bool.

        This needs angles below 90 degrees and a distance other than 0. In a trace, the rays of
        other scenes are MISSED.
        """
        return jnp.all(ahead(self.field)) & away_from_vertex(self.distance)

    @property
    def tangent(self) -> Array:
        """Tangents (2,) of the field angles; 0 for an angle of 90 degrees or more."""
        return jnp.tan(jnp.where(ahead(self.field), self.field, 0))

    @property
    def vergence(self) -> Array:
        """1 / distance, (), 1/mm; 0 for a distance of 0."""
        return vergence_of(self.distance)


def ahead(angle: Array) -> Array:
    """True where light at an angle to the axis (...), radians, travels forwards, bool."""
    return jnp.abs(angle) < _RIGHT


def away_from_vertex(distance: Array) -> Array:
    """True where an object at a distance (...), mm, does not lie at the first vertex, bool."""
    return jnp.abs(distance) >= NEAREST


def vergence_of(distance: Array) -> Array:
    """1 / distance (...), 1/mm; 0 for a distance of 0."""
    good = away_from_vertex(distance)
    return jnp.where(good, 1 / jnp.where(good, distance, 1), 0)


def scene_of(lens: Lens, field: Numbers, distance: Numbers, wavelengths: Numbers) -> Scene:
    """A scene in the dtype of the lens.

    lens: the lens.
    field: one angle (along y) or two (x, y), radians: light travels along (tan x, tan y, 1).
    distance: from the object plane to the first vertex, mm, see `Scene`.
    wavelengths: (W,) or one, um.

    ValueError for other shapes, for anything that is not a real number, for a lens whose arrays do
    not fit together, and, as far as values are known, for an angle of 90 degrees or more, a
    distance within 1e-6 mm of 0 or a wavelength outside the range of a glass. See `Scene.possible`.
    """
    lens.check()
    dtype = lens.curvature.dtype
    angles = field_array(field, dtype)
    if angles.shape not in ((), (2,)):
        raise ValueError(f"field: expected one angle or two, got shape {angles.shape}")
    if angles.ndim == 0:
        angles = jnp.stack([jnp.zeros_like(angles), angles])
    return Scene(angles, distance_array(distance, dtype), lens.checked_wavelengths(wavelengths))


def field_array(field: Numbers, dtype: Any) -> Array:
    """Angles as an array (...), radians.

    ValueError for anything that is not an angle, and for a known angle of 90 degrees or more.
    """
    angles = real_array("field", field, dtype)
    for angle in _known(field):
        if not abs(angle) < _RIGHT:
            raise ValueError(
                f"field: {angle:g} rad = {np.degrees(angle):.4g} degrees, must be below 90; angles "
                f"are radians: np.radians({angle:g})"
            )
    return angles


def fields_array(fields: Numbers, dtype: Any) -> Array:
    """Angles of F fields as an array (F, 2), radians.

    fields: one angle, (F,) along y, or (F, 2). ValueError for other shapes, and as in
        `field_array`.
    """
    angles = jnp.atleast_1d(field_array(fields, dtype))
    if angles.ndim == 1:
        angles = jnp.stack([jnp.zeros_like(angles), angles], axis=-1)
    if angles.ndim != 2 or angles.shape[1] != 2 or not len(angles):
        raise ValueError(f"fields: expected (F,) or (F, 2), got shape {angles.shape}")
    return angles


def spectrum_of(weights: Numbers | None, scene: Scene, dtype: Any) -> Array:
    """Weights of the wavelengths of a scene as an array (W,), of any sum.

    weights: (W,), or None for equal weights. ValueError for another shape.
    """
    count = scene.wavelengths.shape[0]
    if weights is None:
        return jnp.ones(count, dtype)
    spectrum = real_array("wavelength_weights", weights, dtype)
    if spectrum.shape != (count,):
        raise ValueError(f"wavelength_weights: expected ({count},), got {spectrum.shape}")
    return spectrum


def distance_array(distance: Numbers, dtype: Any) -> Array:
    """A distance as an array (), mm.

    ValueError for other shapes, for anything that is not a number, and for a known distance within
    1e-6 mm of 0.
    """
    far = real_array("distance", distance, dtype)
    if far.ndim:
        raise ValueError(f"distance: expected one number, got shape {far.shape}")
    for value in _known(distance):
        if not abs(far.dtype.type(value)) >= far.dtype.type(NEAREST):  # 1e-6 in float32, too
            raise ValueError(
                f"distance: must be {NEAREST:g} mm or more, inf for an object at infinity, below "
                f"0 for light that converges to a point behind the first vertex; got {value:g}"
            )
    return far


def _known(values: Numbers) -> list[float]:
    """The values as a list; empty inside a trace."""
    return np.ravel(np.asarray(values, float)).tolist() if concrete(values) else []


def field_of_height(height: Numbers, distance: Numbers) -> Array:
    """Field angle (...) of an object point, radians.

    The angle is negative for a point above the axis, from which light travels downwards.

    height: (...), of the object point above the axis, mm.
    distance: (), from the object plane to the first vertex, finite, mm.

    ValueError for a known distance that is 0 or not finite. Inside a trace the angle is then 90
    degrees, from which no light enters the lens.
    """
    heights = real_array("height", height, float)
    far = distance_array(distance, float)
    if np.inf in np.abs(_known(distance)):
        raise ValueError("distance: at infinity an object has a field, but no height")
    good = away_from_vertex(far) & (jnp.abs(far) < jnp.inf)
    return jnp.where(good, -jnp.arctan(heights / jnp.where(good, far, 1)), _RIGHT)


def points_arrays(fields: Numbers, distances: Numbers, dtype: jnp.dtype) -> tuple[Array, Array]:
    """Fields (B, 2), radians, and distances (B,), mm, of B object points.

    One distance serves all points. ValueError for other shapes.
    """
    angles = real_array("fields", fields, dtype)
    far = real_array("distances", distances, dtype)
    if angles.ndim != 2 or angles.shape[1] != 2 or far.shape not in ((), angles.shape[:1]):
        raise ValueError(
            f"fields, distances: expected (B, 2) and (B,), got {angles.shape} and {far.shape}"
        )
    return angles, jnp.broadcast_to(far, angles.shape[:1])
