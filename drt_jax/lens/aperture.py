"""Apertures other than circles about a vertex: ellipses, rectangles, decentres, obscurations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import safe_divide, safe_sqrt


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Apertures:
    """A apertures, each along the axes of its surface.

    half: (A, 2), half widths along x and y, mm; of a circle the first is the radius, the second is
        not used.
    centre: (A, 2), from the vertex, mm; None if all are centred on their vertices.

    Static, A of each:
    surfaces: indices of the surfaces.
    kinds: "circle", "ellipse" or "rectangle".
    blocks: True for an obscuration, which stops the light inside; False stops the light outside.
    """

    half: Array
    centre: Array | None = None
    surfaces: tuple[int, ...] = dataclasses.field(metadata={"static": True}, kw_only=True)
    kinds: tuple[str, ...] = dataclasses.field(metadata={"static": True}, kw_only=True)
    blocks: tuple[bool, ...] = dataclasses.field(metadata={"static": True}, kw_only=True)

    @property
    def sizes(self) -> Array:
        """Half widths (A, 2) along x and y, mm; of a circle both are the radius."""
        both = np.array([[0, 0 if kind == "circle" else 1] for kind in self.kinds])
        return jnp.take_along_axis(self.half, jnp.asarray(both), axis=1)


def depths(apertures: Apertures, hits: tuple[Array, ...]) -> Array:
    """Distance of hits from the edge of each aperture, (A, ...), mm, to first order; negative
    outside. hits: D arrays (S + 1, ...), on all surfaces, mm; D = 1 on the meridian."""
    found = []
    for k, (surface, kind) in enumerate(zip(apertures.surfaces, apertures.kinds, strict=True)):
        point = [hit[surface] for hit in hits]
        if apertures.centre is not None:
            centre = apertures.centre[k, 2 - len(point) :]
            point = [p - c for p, c in zip(point, centre, strict=True)]
        half = apertures.sizes[k, 2 - len(point) :]
        if kind == "rectangle":
            found.append(jnp.min(jnp.stack([h - abs(p) for h, p in zip(half, point)]), axis=0))
            continue
        scaled = jnp.stack([p / h for p, h in zip(point, half, strict=True)])
        size = safe_sqrt(jnp.sum(scaled**2, axis=0))
        slope = safe_sqrt(sum((q / h) ** 2 for q, h in zip(scaled, half, strict=True)))
        length = jnp.where(slope > 0, safe_divide(size, slope), jnp.min(half))
        found.append((1 - size) * length)
    return jnp.stack(found)
