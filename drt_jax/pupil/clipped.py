"""Quadrature fitted to the part of the pupil that clear apertures leave."""

import dataclasses

import jax
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene
from ..rays.system import Vector
from .rules import Gauss, PupilRule, Symmetry, check_order

__all__ = ["Clipped"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Clipped(PupilRule):
    """Gauss rules between the corners of the boundary and along the radii to it.

    order: nodes along a radius.
    symmetry: see `symmetry_of`.
    """

    order: int = dataclasses.field(metadata={"static": True})
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})

    def __post_init__(self) -> None:
        check_order(self.order)

    def points(self, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
        """Points and weights, which follow the lens."""
        return Gauss(self.order, self.symmetry).points(lens, scene)
