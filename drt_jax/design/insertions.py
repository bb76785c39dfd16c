"""One more element: a thin meniscus at each surface, and least squares from both sides of it."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax.numpy as jnp

from ..inputs import require
from ..lens.glass import Glass
from ..lens.insert import inserted
from ..lens.lens import Lens
from .optimum import Optimum, optimise
from .problem import Problem


class Insertion(NamedTuple):
    """A lens with one more element.

    at: surface at which the meniscus was inserted, numbered as in the original lens.
    front: True for a meniscus in front of that surface, False for one behind it.
    way: 1 or -1, the sign of the bending at the start.
    problem, optimum: of the longer lens.
    """

    at: int
    front: bool
    way: int
    problem: Problem
    optimum: Optimum


def insertions(
    lens: Lens,
    problem_of: Callable[[Lens], Problem],
    glass: Glass | None = None,
    thickness: float = 0.05,
    bend: float = 0.05,
    max_steps: int = 100,
) -> Iterator[Insertion]:
    """Puts a thin meniscus at each surface between glass and air, on the side of the air, and
    optimises from there with c2, see below, changed in both directions.

    Let the meniscus have the glass of the surface, no thickness, and no distance from it, and let
    c1, c2, c3 be the curvatures of the three surfaces in order, the original one being c. Then
    (c, u, u) and (u, u, c) have the rays of the original lens for every u. So two lines of merit
    equal to that of the lens cross at (c, c, c), and this point is a saddle: least squares from its
    two sides end at different lenses (Bociort and van Turnhout, Opt. Eng. 48, 063001, 2009). A
    meniscus with a small thickness and distance is close to this saddle.

    lens: a minimum.
    problem_of: returns the problem of a lens with two more surfaces. Its variables should have all
        curvatures, and thicknesses with a lower bound.
    glass: glass of the new elements; None for the glass of the surface at which they are inserted.
    thickness: of the meniscus at the start, and its distance from the surface, mm.
    bend: change of c2 at the start, relative to the largest curvature of the lens.
    max_steps: as in `optimise`.

    Yields an `Insertion` for every place and way, from the first surface on. ValueError for a lens
    without a surface between air and glass.
    """
    media = lens.glasses
    sides = [(i, front) for i in range(lens.count) for front in (True, False)]
    places = []
    for i, front in sides:
        air, own = (i, i + 1) if front else (i + 1, i)
        if media[air] == "air" != media[own] and not lens.mirrors[i]:
            places.append((i, front, own))
    require(places, "lens: has no surface between air and glass")
    size = bend * float(jnp.max(jnp.abs(lens.curvature)))
    for i, front, own in places:
        gap = float(abs(lens.thickness[i - 1])) if front and i else 0.0
        behind, far = (i - 1, gap - 2 * thickness) if gap else (i - front, thickness)
        start = inserted(lens, behind, own if glass is None else glass, i, far, thickness)
        problem = problem_of(start)
        middle = behind + (2 if front else 1)
        for way in (1, -1):
            bent = start.curvature.at[middle].add(way * size)
            vector = problem.variables.vector(dataclasses.replace(start, curvature=bent))
            yield Insertion(i, front, way, problem, optimise(problem, vector, max_steps))
