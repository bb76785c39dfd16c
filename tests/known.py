"""Rays searched for by one program and known to all others: a program that only differentiates
rays need not hold the search for them, which is most of what there is to compile."""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from drt_jax.rays.find import find_many
from drt_jax.rays.solve import reattach
from drt_jax.rays.system import system_of


def bendable(lens):
    """The lens, every row of which may be curved: derivatives by all shapes."""
    return dataclasses.replace(lens, curved=tuple(range(lens.count + 1)))


def aims(lens, scene, points):
    """The system of a lens, and the stop points, D arrays (W, Q) in mm, of points (Q,) or (W, Q)
    on the unit disc; D = 1 for meridional rays."""
    system = system_of(lens, scene, len(points))
    radius, waves = lens.semi_diameter[lens.stop], scene.wavelengths.shape[0]
    target = (jnp.broadcast_to(radius * p, (waves, p.shape[-1])) for p in points)
    return system, tuple(target)


@jax.jit
def search(lens, scene, points):
    """The rays of a bundle, see `find.Found`."""
    return find_many(*aims(lens, scene, points))


def known(found):
    """A solver for `trace_bundle` and `moments` that has found its rays: all derivatives."""
    return functools.partial(reattach, found)
