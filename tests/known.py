"""Rays that one program searches for and all others use: a program that only differentiates rays
then does not contain the search, which takes most of the compilation."""

import dataclasses
import functools

import jax
import numpy as np

from drt_jax.lens.lens import HELD
from drt_jax.rays.find import find_many
from drt_jax.rays.solve import reattach
from drt_jax.rays.trace import aims


def freed(lens):
    """The lens with all numbers free: also derivatives by the stop and by glasses."""
    return dataclasses.replace(lens, free=tuple(HELD))


def bendable(lens):
    """The lens with derivatives by all numbers: every row may be curved, and no number is held."""
    return dataclasses.replace(freed(lens), curved=tuple(range(lens.count + 1)))


@jax.jit
def search(lens, scene, points):
    """The rays of a bundle, see `find.Found`."""
    return find_many(*aims(lens, scene, points))


def known(found):
    """A solver for `trace_bundle` and `moments` with known rays; it supports all derivatives."""
    return functools.partial(reattach, found)


def check_slopes(program, lens, steps, rtol):
    """Compares gradients with central differences of the fourth order, along one random direction
    of each kind of numbers.

    program: function of the lens that returns ((value, anything), gradient), for all. steps: by
    kind, the size of a step; numbers that are 0 or infinite do not change.
    """
    gradient = program(lens)[1]
    for seed, (name, step) in enumerate(steps.items()):
        value = np.asarray(getattr(lens, name))
        way = step * np.random.default_rng(seed).normal(size=value.shape)
        way = np.where(np.isfinite(value) & (value != 0), way, 0)
        moved = (dataclasses.replace(lens, **{name: value + s * way}) for s in (-2, -1, 1, 2))
        a, b, c, d = (float(program(one)[0][0]) for one in moved)
        slope, found = (
            (8 * (c - b) - (d - a)) / 12,
            np.sum(np.asarray(getattr(gradient, name)) * way),
        )
        assert slope != 0
        np.testing.assert_allclose(found, slope, rtol=rtol, err_msg=name)
