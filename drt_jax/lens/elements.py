"""Elements: neighbouring surfaces that shift and tilt together, and turns of the axis."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Elements:
    """G groups of neighbouring surfaces, each rigid; one that ends with the sensor turns the axis
    of all that follows (a coordinate break).

    A group is shifted, then tilted about its pivot. Groups may hold others, which come behind them
    in this order and move within them.

    shift: (G, 3) in mm, along x, y and z.
    tilt: (G, 3) in radians, about x, then the turned y, then the turned z, right-handed.
    pivot: (G,) in mm, along the axis from the vertex of the surface `about`.

    Static:
    spans: first and last surface of each; S is the sensor.
    about: of each, the index of the surface.
    """

    shift: Array
    tilt: Array
    pivot: Array
    spans: tuple[tuple[int, int], ...] = dataclasses.field(metadata={"static": True})
    about: tuple[int, ...] = dataclasses.field(metadata={"static": True})

    def carry(self, axis: Array, point: Array, rotation: Array) -> tuple[Array, Array]:
        """Vertices (S + 1, 3) in mm and rotations (S + 1, 3, 3) of the surfaces, moved; `axis`
        (S + 1,): where the vertices lie on the axis without any move, mm."""
        for g in reversed(range(len(self.spans))):
            first, last = self.spans[g]
            own = slice(first, last + 1)
            turned = rotation_matrix(self.tilt[g])
            pivot = jnp.zeros_like(point[:1]).at[:, 2].set(axis[self.about[g]] + self.pivot[g])
            moved = pivot + self.shift[g][None] + (point[own] - pivot) @ turned.T
            point, rotation = (
                point.at[own].set(moved),
                rotation.at[own].set(turned[None] @ rotation[own]),
            )
        return point, rotation


def rotation_matrix(tilt: Array) -> Array:
    """(3, 3) from the axes of a tilted surface to those of the lens; `tilt` (3,) in radians."""
    (cx, cy, cz), (sx, sy, sz) = jnp.cos(tilt), jnp.sin(tilt)
    one, zero = jnp.ones_like(cx), jnp.zeros_like(cx)
    about_x = jnp.array([[one, zero, zero], [zero, cx, -sx], [zero, sx, cx]])
    about_y = jnp.array([[cy, zero, sy], [zero, one, zero], [-sy, zero, cy]])
    about_z = jnp.array([[cz, -sz, zero], [sz, cz, zero], [zero, zero, one]])
    return about_x @ about_y @ about_z
