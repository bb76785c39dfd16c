"""Checks of what a user gives, with the same words for variables, operands and tolerances."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from ..inputs import shown


def require(condition: object, message: str) -> None:
    """Raises ValueError with the message unless the condition holds."""
    if not condition:
        raise ValueError(message)


def whole_numbers(what: str, given: Any) -> tuple[int, ...]:
    """Numbers of surfaces and the like as a tuple of int.

    ValueError, which begins with `what`, unless `given` is an iterable of whole numbers.
    """
    numbers = given if isinstance(given, Iterable) and not isinstance(given, str) else [None]
    found = tuple(numbers)
    if all(isinstance(n, int | np.integer) and not isinstance(n, bool) for n in found):
        return tuple(map(int, found))
    raise ValueError(f"{what}: expected whole numbers from 0, such as (0, 2), got {shown(given)}")
