"""Lenses, scenes and rays for the tests of `find` and `solve`, and a scalar of the rays."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from drt_jax import Scene, Status
from drt_jax.lens.scene import checked_scene

from ..known import aims, bendable, known, search
from .systems import COLOURS, lens_with

POINTS = tuple(jnp.asarray(p) for p in ([0.0, 0.5, -0.3, 0.8, -0.9], [0.1, 0.6, -0.8, -0.2, 0.1]))
# A mirror and a stop that bends light, all tilted; and meridional rays with a stop that bends none.
PROBLEMS = {"tilted": ("active", True, 2), "meridional": ("between", False, 1)}


@functools.cache
def problem(name):
    """A lens, a scene, points and the rays through them."""
    stop, tilted, dim = PROBLEMS[name]
    lens, points = bendable(lens_with(stop, tilted)), POINTS[2 - dim :]
    scene = checked_scene(lens, Scene.point([0.03, -0.05] if dim == 2 else 0.08, 300.0, COLOURS))
    found = search(lens, scene, points)
    assert np.all(found.status == Status.OK)
    return lens, scene, points, found


def random_like(tree, seed=0):
    generator = np.random.default_rng(seed)
    return jax.tree.map(lambda a: jnp.asarray(generator.normal(size=a.shape)), tree)


def weighed(hits, weights):
    """A scalar that is not linear in the hits."""
    return sum(jnp.sum(w * h + 1e-2 * (w * h) ** 2) for w, h in zip(weights, hits, strict=True))


def outcome(lens, scene, points, found, weights):
    """The scalar for known rays."""
    hits = known(found)(*aims(lens, scene, points)).hits
    return weighed(hits, weights)


gradient = jax.jit(jax.grad(outcome, (0, 1, 2)))
crossings = jax.jit(lambda lens, scene, points: aims(lens, scene, points)[1])
