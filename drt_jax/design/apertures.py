"""Clear apertures that follow the light of a design instead of clipping it."""

import dataclasses

import jax.numpy as jnp

from ..lens.lens import Lens
from .problem import Problem


def open_apertures(lens: Lens) -> Lens:
    """The lens with infinite semi-diameters, except that of the stop."""
    free = jnp.full_like(lens.semi_diameter, jnp.inf)
    own = lens.semi_diameter[lens.stop]
    return dataclasses.replace(lens, semi_diameter=free.at[lens.stop].set(own))


def fit_apertures(problem: Problem, lens: Lens, margin: float = 0.01) -> Lens:
    """The lens with semi-diameters that just pass the light of all fields of a problem; the stop
    keeps its own.

    lens: a lens with open apertures, see `open_apertures`.
    margin: relative increase of the semi-diameters.
    """
    wide = jnp.append((1 + margin) * problem.beam_radius(lens), jnp.inf)
    own = lens.semi_diameter[lens.stop]
    return dataclasses.replace(lens, semi_diameter=wide.at[lens.stop].set(own))
