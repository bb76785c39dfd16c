"""How thick a lens is between its surfaces, on the axis and towards the rim."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.surface import by_form, surface_sag

# Where edges are judged, in parts of the larger or smaller of two beam radii.
ZONES = np.array([0.5, 0.7, 0.85, 1.0])


def between(lens: Lens, glass: bool) -> list[tuple[int, int]]:
    """Neighbouring surfaces that bend light, and the last of them and the sensor, with glass or
    with air between; what is before the lens counts as air, too."""
    air = lens.glasses[0], "air"
    pairs = itertools.pairwise([*lens.active, lens.count])
    return [(i, j) for i, j in pairs if (lens.glasses[i + 1] not in air) == glass]


def gaps(lens: Lens, beam_radius: Array, glass: bool) -> tuple[Array, Array]:
    """Thickness on the axis (G,) and at zones towards the rim (G, Z), mm along the light, of the
    gaps of `between`, in glass or in air. In glass up to the larger of both beam radii (S,), in air
    to the smaller; before the sensor to that of the last surface."""
    dtype = lens.curvature.dtype
    pairs = between(lens, glass)
    if not pairs:
        return jnp.zeros(0, dtype), jnp.zeros((0, ZONES.size), dtype)
    front, back = (np.array(rows) for rows in zip(*pairs))
    sense = jnp.asarray(lens.senses[back], dtype)
    vertices = lens.vertices
    beam_radius = jnp.append(beam_radius, beam_radius[lens.active[-1]])
    wide = jnp.maximum if glass else jnp.minimum
    y = wide(beam_radius[front], beam_radius[back])[:, None] * jnp.asarray(ZONES, dtype)[None]

    def heights(rows: np.ndarray) -> Array:
        shape = jax.tree.map(lambda a: a[..., rows, None], lens.shape)
        return by_form(surface_sag, (0 * y, y), shape, tuple(lens.forms[i] for i in rows))

    axis = sense * (vertices[back] - vertices[front])
    return axis, axis[:, None] + sense[:, None] * (heights(back) - heights(front))
