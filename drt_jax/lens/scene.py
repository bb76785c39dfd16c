"""The scene: from where light of which wavelengths enters a lens."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from .lens import Lens


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scene:
    """An object point and its colours, arrays of one floating dtype.

    field: (2,) angles in radians along x and y; positive light travels upwards.
    distance: () from the object plane to the first vertex in mm, inf allowed.
    wavelengths: (W,) in um.
    """

    field: Array
    distance: Array
    wavelengths: Array


def scene_of(lens: Lens, field: ArrayLike, distance: ArrayLike, wavelengths: ArrayLike) -> Scene:
    """A scene in the dtype of the lens: one type for numbers, NumPy's and JAX's arrays.

    field: one angle (along y) or two (x, y) in radians. distance: mm, inf allowed. wavelengths:
    (W,) or one, um. ValueError for other shapes.
    """
    dtype = lens.curvature.dtype
    angles = jnp.asarray(field, dtype)
    if angles.ndim == 0:
        angles = jnp.stack([jnp.zeros_like(angles), angles])
    if angles.shape != (2,):
        raise ValueError(f"field: expected one angle or two, got shape {angles.shape}")
    colours = jnp.atleast_1d(jnp.asarray(wavelengths, dtype))
    if colours.ndim != 1 or not colours.size:
        raise ValueError(f"wavelengths: expected one or a list, got shape {colours.shape}")
    far = jnp.asarray(distance, dtype)
    if far.ndim:
        raise ValueError(f"distance: expected one number, got shape {far.shape}")
    return Scene(angles, far, colours)


def field_of_height(height: ArrayLike, distance: ArrayLike) -> Array:
    """The field angle in radians of an object point `height` mm above the axis.

    `distance` mm from the object plane to the first vertex, finite. Light from above the axis
    travels downwards, so that the angle is negative.
    """
    return -jnp.arctan(jnp.asarray(height, float) / jnp.asarray(distance, float))
