"""Thicknesses of glass and air between surfaces, on the axis and towards the rim."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.surface import by_form, surface_sag

# Heights at which edge thicknesses are measured, in units of the larger (glass) or the smaller
# (air) beam radius of the two surfaces.
ZONES = np.array([0.5, 0.7, 0.85, 1.0])


def between(lens: Lens, glass: bool) -> list[tuple[int, int]]:
    """Pairs of neighbouring active surfaces with glass, or with air, between them.

    The sensor counts as a surface, and the medium in front of the lens as air.

    glass: True for pairs with glass between them, False for pairs with air.
    """
    air = lens.glasses[0], "air"
    pairs = itertools.pairwise([*lens.active, lens.count])
    return [(i, j) for i, j in pairs if (lens.glasses[i + 1] not in air) == glass]


def gaps(lens: Lens, beam_radius: Array, glass: bool) -> tuple[Array, Array]:
    """Thicknesses of the G gaps of `between`, mm along the light.

    beam_radius: (S,), mm. In glass, zones reach the larger radius of the two surfaces, in air the
        smaller one; in front of the sensor, the radius of the last surface.
    glass: True for gaps of glass, False for air.

    Returns the thicknesses on the axis (G,), and at the zones towards the rim (G, Z).
    """
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
