"""Clearance: the signed distance of rays from the edges that clip them."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import safe_sqrt
from .aperture import depths
from .lens import Lens


def clearance(lens: Lens, hits: tuple[Array, ...]) -> Array:
    """Distance of hits from each of E edges, (E, ...), mm; negative if the edge stops the ray.

    The first S + 1 edges are the circles of `semi_diameter`, with the clearance semi_diameter - r.
    It is inf where there is no circle, and at the stop, because rays are aimed inside of its rim.
    Then follow the edges of `lens.apertures`, with the sign reversed for obscurations.

    hits: D arrays (S + 1, ...), on all surfaces, mm; D = 1 on the meridian.
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
    """The first surface that clips each ray, (...), int32.

    For a ray that passes, it is the surface with the nearest edge.

    hits: as in `clearance`.
    """
    extra, none = lens.apertures, lens.count + 1
    edges = clearance(lens, hits)
    stops = (edges < 0) | (edges == jnp.min(edges, axis=0, keepdims=True))
    surfaces = np.array([*range(none), *(() if extra is None else extra.surfaces)], np.int32)
    surfaces = surfaces.reshape(-1, *[1] * (edges.ndim - 1))
    return jnp.min(jnp.where(stops, surfaces, np.int32(none)), axis=0)
