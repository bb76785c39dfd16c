"""Elements: surfaces that shift and tilt together, and coordinate breaks."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import matmul, selected


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Elements:
    """G rigid groups of neighbouring surfaces.

    A group that ends with the sensor is a coordinate break: it moves all that follows. A group is
    tilted about its pivot, then shifted. A group inside of another one comes after it in this
    order, and moves with it.

    shift: (G, 3), along x, y and z, mm.
    tilt: (G, 3), about x, then the rotated y, then the rotated z, right-handed, radians.
    pivot: (G,), along the axis from the vertex of the surface `about`, mm.

    Static:
    spans: first and last surface of each group; S is the sensor.
    about: index of the surface from which each pivot is measured.
    """

    shift: Array
    tilt: Array
    pivot: Array
    spans: tuple[tuple[int, int], ...] = dataclasses.field(metadata={"static": True})
    about: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    only = selected

    def carry(self, axis: Array, point: Array, rotation: Array) -> tuple[Array, Array]:
        """Moves surfaces with their groups, the inner groups first.

        axis: (S + 1,), z of the vertices on the undisturbed axis, mm.
        point: (S + 1, 3), vertices, mm.
        rotation: (S + 1, 3, 3), rotations of the surfaces.

        Returns the moved vertices and rotations.
        """
        for g in reversed(range(len(self.spans))):
            first, last = self.spans[g]
            own = slice(first, last + 1)
            turn = rotation_matrix(self.tilt[g])
            pivot = jnp.zeros_like(point[:1]).at[:, 2].set(axis[self.about[g]] + self.pivot[g])
            moved = pivot + self.shift[g][None] + matmul(point[own] - pivot, turn.T)
            point = point.at[own].set(moved)
            rotation = rotation.at[own].set(matmul(turn[None], rotation[own]))
        return point, rotation


def rotation_matrix(tilt: Array) -> Array:
    """Rotation (3, 3) from the axes of a tilted surface to those of the lens.

    tilt: (3,), about x, then the rotated y, then the rotated z, radians.
    """
    (cx, cy, cz), (sx, sy, sz) = jnp.cos(tilt), jnp.sin(tilt)
    one, zero = jnp.ones_like(cx), jnp.zeros_like(cx)
    about_x = jnp.array([[one, zero, zero], [zero, cx, -sx], [zero, sx, cx]])
    about_y = jnp.array([[cy, zero, sy], [zero, one, zero], [-sy, zero, cy]])
    about_z = jnp.array([[cz, -sz, zero], [sz, cz, zero], [zero, zero, one]])
    return matmul(matmul(about_x, about_y), about_z)
