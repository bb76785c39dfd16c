"""The elements of a prescription: groups of surfaces that move together about a pivot."""

import itertools

import jax.numpy as jnp

from ..inputs import shown
from ..lens.elements import Elements
from .entry import Entry, array

_MOST = 500
_KEYS = ("surfaces", "about", "pivot", "shift", "tilt")


def elements_of(top: Entry, count: int) -> Elements | None:
    """The elements of a lens of `count` surfaces; None if there are none."""
    listed = top.get("elements", [])
    if not isinstance(listed, list):
        raise top.error("elements", "expected a list")
    if len(listed) > _MOST:
        raise top.error("elements", f"{len(listed)} are more than {_MOST}")
    entries = [Entry(entry, f"elements[{g}]", _KEYS) for g, entry in enumerate(listed)]
    # Outer elements precede the elements inside them.
    spans = {id(entry): _span(entry, count) for entry in entries}
    entries.sort(key=lambda entry: (spans[id(entry)][0], -spans[id(entry)][1]))
    if not entries:
        return None
    for one, two in itertools.combinations(entries, 2):
        (_, last), (first, end) = spans[id(one)], spans[id(two)]
        if first <= last < end:
            raise two.error(
                "surfaces", f"cuts into {one.place}: put one inside the other, or apart"
            )
    return Elements(
        shift=array([entry.vector("shift", 3) or [0.0] * 3 for entry in entries]),
        tilt=jnp.radians(array([entry.vector("tilt", 3) or [0.0] * 3 for entry in entries])),
        pivot=array([entry.number("pivot", 0.0) for entry in entries]),
        spans=tuple(spans[id(entry)] for entry in entries),
        about=tuple(_row(e, "about", e.get("about", spans[id(e)][0]), count) for e in entries),
    )


def _span(entry: Entry, count: int) -> tuple[int, int]:
    given = entry.get("surfaces")
    if not isinstance(given, list | tuple) or len(given) != 2:
        raise entry.error("surfaces", f"expected [first, last], got {shown(given)}")
    first, last = (_row(entry, "surfaces", end, count) for end in given)
    if first > last:
        raise entry.error("surfaces", f"expected [first, last], got {shown(given)}")
    return first, last


def _row(entry: Entry, key: str, value: object, count: int) -> int:
    """The index of a surface; `count` for the sensor."""
    row = count if value == "sensor" else value
    if type(row) is not int or not 0 <= row <= count:
        raise entry.error(
            key, f"expected a surface, 0 to {count - 1}, or sensor; got {shown(value)}"
        )
    return row
