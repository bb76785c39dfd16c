"""Pupil rules in rising order, in which they are tried until a tolerance is met."""

from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from ..lens.lens import Lens
from ..lens.order import may_cross
from ..pupil.clipped import Clipped, ClippedGroup
from ..pupil.rules import Gauss, Pattern, Symmetry, gauss_points

_MAX_ORDER = 40
# Orders for a clipped pupil and their sizes (`Clipped.size`). Three orders form a group, because
# three must agree and one search finds the points of all three. Groups of equal sizes share a
# compiled program.
_CLIPPED = (
    ((4, 5, 6), (10, 11, 12)),
    ((7, 8, 9), (10, 11, 12)),
    ((10, 11, 12), (10, 11, 12)),
    ((14, 17, 20), (14, 17, 20)),
    ((24, 28, 32), (36, 39, 42)),
    ((36, 39, 42), (36, 39, 42)),
)
# Numbers of rays that patterns are padded to, so that only a few programs are compiled.
_SIZES = {"rotational": (_MAX_ORDER + 2,), "bilateral": (208, 416, 1768, 3696)}
_SIZES["none"] = _SIZES["bilateral"]


class Group(NamedTuple):
    """Rules that are traced together.

    traced: a rule that has the points of all of them.
    rules: pairs of each rule and a rule with the points of `traced` in which only its own points
        have weight.
    """

    traced: Pattern | ClippedGroup
    rules: Sequence[tuple[Gauss | Clipped, Pattern | ClippedGroup]]


def rules_by_order(lens: Lens, symmetry: Symmetry, clipped: bool) -> Iterator[Group]:
    """Rules in rising order, in groups.

    lens: the lens.
    symmetry: of the rules, see `symmetry_of`.
    clipped: whether the rules are fitted to the open part of a clipped pupil.
    """
    if not clipped:
        order = 2
        while order <= _MAX_ORDER + 1:
            yield (group := _gauss_group(order, symmetry))
            order = group.rules[-1][0].order + 1
        return
    crossing = may_cross(lens)
    for orders, sizes in _CLIPPED:
        rules = [Clipped(n, symmetry, n, crossing) for n in orders]
        traced, *own = (
            ClippedGroup(np.array(orders, np.int32), np.int32(k), sizes, symmetry, crossing)
            for k in range(-1, len(orders))
        )
        yield Group(traced, [*zip(rules, own)])


@cache
def _gauss_group(first: int, symmetry: Symmetry) -> Group:
    """The Gauss rule of an order, and those of the next orders as long as all their points
    together are at most half of the smallest size. The pattern is padded with rays of weight 0
    along the rim of the stop, where clear apertures clip first."""
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
    found, start = [], 0
    for k, (_, weights) in enumerate(rules):
        padded = np.pad(weights, (start, size - start - weights.size))
        found.append((Gauss(first + k, symmetry), Pattern(points, padded, symmetry)))
        start += weights.size
    return Group(found[0][1], found)
