"""How far inside of the edges of a lens rays pass: what clips them, softly or not, and where."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import safe_sqrt
from .aperture import depths
from .lens import Lens


def clearance(lens: Lens, hits: tuple[Array, ...]) -> Array:
    """How far inside of each edge hits lie, (E, ...) in mm; below 0 the edge stops the ray.

    The first S + 1 edges are the circles of `semi_diameter`, inf where there is none, and at the
    stop, whose rim no point that is aimed at is outside of; then come `lens.apertures`.
    hits: D arrays (S + 1, ...) in mm on all surfaces, D = 1 on the meridian.
    """
    semi = lens.semi_diameter.at[lens.stop].set(jnp.inf)
    radius = safe_sqrt(sum((h**2 for h in hits[1:]), hits[0] ** 2))
    circles = semi.reshape(-1, *[1] * (radius.ndim - 1)) - radius
    extra = lens.apertures
    if extra is None:
        return circles
    sign = np.where(extra.blocks, -1, 1).reshape(-1, *[1] * (radius.ndim - 1))
    return jnp.concatenate([circles, jnp.asarray(sign, radius.dtype) * depths(extra, hits)])


def clipping_surface(lens: Lens, hits: tuple[Array, ...]) -> Array:
    """The first surface with an edge that stops rays, (...) int32; of rays that pass, the one with
    the nearest edge. hits: as of `clearance`."""
    extra, none = lens.apertures, lens.count + 1
    edges = clearance(lens, hits)
    stops = (edges < 0) | (edges == jnp.min(edges, axis=0, keepdims=True))
    surfaces = np.array([*range(none), *(() if extra is None else extra.surfaces)], np.int32)
    surfaces = surfaces.reshape(-1, *[1] * (edges.ndim - 1))
    return jnp.min(jnp.where(stops, surfaces, np.int32(none)), axis=0)
