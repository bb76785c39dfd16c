"""The lenses of several configurations, by the numbers in which they differ."""

import re
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from ..inputs import require, require_one_of
from ..lens.lens import Lens
from ..numerics import concrete
from .parts import PARTS, places_of, with_arrays, with_numbers


def configured(lens: Lens, numbers: Mapping[str, Sequence[float]]) -> tuple[Lens, ...]:
    """The C configurations of a lens, which share all numbers but some.

    lens: the lens.
    numbers: C numbers for each name, such as {"thickness 4": (1.2, 9.8), "sensor": (30.1, 41.5)}.
        A name is a kind of `Vary`, the number of the surface and, of parts with several terms, the
        term: "tilt 3[0]". Units as in `Vary`.

    ValueError, which names it, for a number that the lens does not have, for other counts, and for
    values that `Vary` excludes, such as a semi-diameter below 0, or NaN.
    """
    places, counts = {}, {name: np.shape(row) for name, row in numbers.items()}
    for name in numbers:
        match = re.fullmatch(r"(\w+)(?: (\d+))?(?:\[(\d+)\])?", name)
        kind, *rest = match.groups() if match else (name, None, None)
        require_one_of("configured: kind", kind, PARTS)
        surfaces, terms = (() if number is None else (int(number),) for number in rest)
        found = places_of("configured", lens, kind, surfaces, terms)
        some = f"name one, such as {found[-1]}"
        require(len(found) == 1, f"configured: {name}: is {len(found)} numbers; {some}")
        places[name] = found[0]
    alike = len(set(counts.values())) == 1 and all(len(n) == 1 and n[0] for n in counts.values())
    found_counts = ", ".join(f"{name} has the shape {shape}" for name, shape in counts.items())
    require(alike, f"configured: give as many numbers for each name; {found_counts or 'none'}")
    for name, row in numbers.items():
        least, most = PARTS[places[name].kind].limits
        fits = not concrete(row) or all(least <= n <= most for n in row)
        require(fits, f"configured: {name}: expected numbers from {least:g} to {most:g}, got {row}")
    lens = with_arrays(lens, {place.kind for place in places.values()})
    rows = [[*zip(places.values(), row)] for row in zip(*numbers.values())]
    dtype = lens.curvature.dtype
    return tuple(with_numbers(lens, [(p, jnp.asarray(n, dtype)) for p, n in row]) for row in rows)
