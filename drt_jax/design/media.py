"""Media of a lens: gaps of glass and air between surfaces, pieces of glass, and elements."""

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


def is_solid(lens: Lens, medium: int) -> bool:
    """Whether a medium is neither air nor the medium in front of the lens."""
    return lens.glasses[medium] not in ("air", lens.glasses[0])


def between(lens: Lens, glass: bool) -> list[tuple[int, int]]:
    """Pairs of neighbouring active surfaces with glass, or with air, between them.

    The sensor counts as a surface, and the medium in front of the lens as air.

    glass: True for pairs with glass between them, False for pairs with air.
    """
    pairs = itertools.pairwise([*lens.active, lens.count])
    return [(i, j) for i, j in pairs if is_solid(lens, i + 1) == glass]


def gaps(lens: Lens, beam_radius: Array, glass: bool) -> tuple[Array, Array]:
    """Thicknesses of the G gaps of `between`, on the axis and towards the rim, mm along the light.

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


def elements_of(lens: Lens) -> tuple[tuple[int, int], ...]:
    """First and last surface of each element: neighbouring active surfaces with glass between them.

    Cemented elements count as one. A mirror in air is an element of one surface.
    """
    spans: list[tuple[int, int]] = []
    for i in lens.active:
        if spans and is_solid(lens, i):
            spans[-1] = (spans[-1][0], i)
        else:
            spans.append((i, i))
    return tuple(spans)


def pieces_of(lens: Lens) -> dict[int, tuple[int, ...]]:
    """The media of each piece of glass, by the surface in front of it.

    A piece has several media if a mirror sends light back into it, or if a surface inside of it is
    not active.
    """
    pieces: dict[int, tuple[int, ...]] = {}
    for i in filter(lambda i: is_solid(lens, i + 1), range(lens.count)):
        inside = lens.mirrors[i] or i not in lens.active
        first, media = pieces.popitem() if pieces and inside and is_solid(lens, i) else (i, ())
        pieces[first] = (*media, i + 1)
    return pieces


def model_glasses(lens: Lens) -> list[int]:
    """Surfaces behind which a model glass begins."""
    model, media = lens.dispersion.model, lens.glasses
    if model is None:
        return []
    known = np.asarray(model)[:, 0] > 1
    return [i for i in range(lens.count) if known[i + 1] and media[i] != media[i + 1]]


def back_distance(lens: Lens) -> Array:
    """Distance from the last vertex to the sensor along the axis, (), mm."""
    return lens.sensor - jnp.sum(lens.thickness)
