"""Pupil rules by rising order, as they are tried until a tolerance is met."""

from collections.abc import Iterator
from functools import cache

import numpy as np

from ..lens.lens import Lens
from ..lens.order import may_cross
from ..pupil.clipped import Clipped
from ..pupil.rules import Gauss, Pattern, PupilRule, Symmetry, gauss_points

_MAX_ORDER = 40
# First order for a clipped pupil, and the step to the next.
_CLIPPED = 4, 2
# Numbers of rays that patterns are padded to, so that they share a few compiled programs.
_SIZES = {"rotational": (_MAX_ORDER + 2,), "bilateral": (208, 416, 1768, 3696)}
_SIZES["none"] = _SIZES["bilateral"]

# A rule, and the rule that is traced for it.
Tried = tuple[Gauss | Clipped, PupilRule]


def rules_by_order(lens: Lens, symmetry: Symmetry, clipped: bool) -> Iterator[list[Tried]]:
    """Rules by rising order, in groups of which all are traced at once: one pattern has the points
    of all Gauss rules of a group, and each rule its own weights.

    symmetry: of the rules, see `symmetry_of`.
    clipped: whether the rules are fitted to the light that apertures leave.
    """
    if not clipped:
        order = 2
        while order <= _MAX_ORDER + 1:
            yield (group := _gauss_group(order, symmetry))
            order = group[-1][0].order + 1
        return
    first, step = _CLIPPED
    crossing = may_cross(lens)
    for order in range(first, _MAX_ORDER + step + 1, step):
        size = 20 if order <= 20 else _MAX_ORDER + 2
        rule, used = (Clipped(order, symmetry, n, crossing) for n in (order, size))
        yield [(rule, used)]


@cache
def _gauss_group(first: int, symmetry: Symmetry) -> list[Tried]:
    """The Gauss rule of an order, and those of the next orders as long as all their points are at
    most half of the smallest size. The pattern is padded with weightless rays along the rim of
    the stop, where clear apertures clip first."""
    sizes, rules = _SIZES[symmetry], [gauss_points(first, symmetry)]
    total, order = rules[0][1].size, first + 1
    while total + (following := gauss_points(order, symmetry))[1].size <= sizes[0] / 2:
        rules.append(following)
        total, order = total + following[1].size, order + 1
    columns = rules[0][0].shape[1]
    size = next(size for size in sizes if size >= total + columns)
    missing = size - total
    span = np.pi if symmetry == "bilateral" else 2 * np.pi
    angle = np.linspace(-np.pi / 2, span - np.pi / 2, missing)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rim = rim if columns == 2 else np.ones((missing, 1))
    points = np.concatenate([*(p for p, _ in rules), rim])
    found: list[Tried] = []
    start = 0
    for k, (_, weights) in enumerate(rules):
        padded = np.pad(weights, (start, size - start - weights.size))
        found.append((Gauss(first + k, symmetry), Pattern(points, padded, symmetry)))
        start += weights.size
    return found
