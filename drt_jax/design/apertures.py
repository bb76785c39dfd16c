"""Clear apertures that follow the beam of a design instead of clipping it."""

import dataclasses

import jax.numpy as jnp

from ..lens.lens import Lens
from .problem import Problem


def open_apertures(lens: Lens) -> Lens:
    """The lens with infinite semi-diameters, except for the stop, which keeps its own.

    lens: the lens. Its `apertures` are not changed.
    """
    free = jnp.full_like(lens.semi_diameter, jnp.inf)
    own = lens.semi_diameter[lens.stop]
    return dataclasses.replace(lens, semi_diameter=free.at[lens.stop].set(own))


def fit_apertures(problem: Problem, lens: Lens, margin: float = 0.01) -> Lens:
    """The lens with semi-diameters that just pass the rays of all fields of a problem.

    The stop keeps its own semi-diameter.

    problem: the problem whose rays must pass.
    lens: a lens with open apertures, see `open_apertures`.
    margin: relative increase of the semi-diameters.
    """
    wide = jnp.append((1 + margin) * problem.beam_radius(lens), jnp.inf)
    own = lens.semi_diameter[lens.stop]
    return dataclasses.replace(lens, semi_diameter=wide.at[lens.stop].set(own))
