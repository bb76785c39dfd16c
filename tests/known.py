"""Rays searched for by one program and known to all others: a program that only differentiates
rays need not hold the search for them, which is most of what there is to compile."""

import dataclasses
import functools

import jax

from drt_jax.rays.find import find_many
from drt_jax.rays.solve import reattach
from drt_jax.rays.trace import aims


def bendable(lens):
    """The lens, every row of which may be curved: derivatives by all shapes."""
    return dataclasses.replace(lens, curved=tuple(range(lens.count + 1)))


@jax.jit
def search(lens, scene, points):
    """The rays of a bundle, see `find.Found`."""
    return find_many(*aims(lens, scene, points))


def known(found):
    """A solver for `trace_bundle` and `moments` that has found its rays: all derivatives."""
    return functools.partial(reattach, found)
