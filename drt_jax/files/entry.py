"""Checked reading of the mappings of a file: each error names the place and the remedy."""

import contextlib
import difflib
import math
from collections.abc import Iterator, Sequence
from typing import Any

from jax import Array

from ..inputs import InputError, shown
from ..numerics import array

# The largest magnitudes of numbers, beyond any lens and far below overflow: LONG of lengths in mm
# and most others, STEEP of curvatures and conics, WIDE of coefficients and radii.
LONG, STEEP, WIDE = 1e9, 1e6, 1e30
_LONGEST = 100  # characters of a name


class LensError(InputError):
    """A prescription that cannot be used; the message names the file, the key and the remedy."""


def require(condition: object, message: str, key: str = "") -> None:
    """LensError unless the condition holds. key: the entry of a prescription."""
    if not condition:
        raise LensError(message, key)


class Entry(dict[Any, Any]):
    """A mapping of a prescription, with its name for messages.

    values: the mapping.
    place: its name, such as "surfaces[0]"; empty for the prescription itself.
    keys: the keys that it may have.
    """

    def __init__(self, values: object, place: str, keys: Sequence[Any]):
        self.place = place
        known = ", ".join(map(str, keys[:20])) + (", ..." if len(keys) > 20 else "")
        if not isinstance(values, dict):
            raise self.error("", f"expected a mapping with the keys {known}")
        super().__init__(values)
        for key in self:
            if key not in keys:
                word = str(key)[:_LONGEST]
                near = difflib.get_close_matches(word, map(str, keys), n=1, cutoff=0.7)
                hint = f"did you mean {near[0]!r}? " if near else ""
                message = f"{self.place or 'top'}: unknown key {shown(key)}; {hint}known: {known}"
                raise LensError(message.removeprefix("top: "), self.name(word))

    def name(self, key: object) -> str:
        """The name in messages of the entry `key`, or of the mapping if `key` is empty."""
        return ".".join(filter(None, (self.place, str(key))))

    def error(self, key: object, message: str) -> LensError:
        """An error about the entry `key`, or about the mapping if `key` is empty."""
        name = self.name(key)
        return LensError(": ".join(filter(None, (name, message))), name)

    def require(self, condition: object, key: object, message: str) -> None:
        """LensError about the entry `key` unless the condition holds."""
        if not condition:
            raise self.error(key, message)

    @contextlib.contextmanager
    def naming(self, key: object) -> Iterator[None]:
        """Turn a ValueError into a LensError about the entry `key`."""
        try:
            yield
        except ValueError as error:
            raise self.error(key, str(error)) from error

    def number(
        self, key: object, default: float | None = None, finite: bool = True, most: float = LONG
    ) -> float:
        """A number of magnitude at most `most`; `finite=False` allows inf. It may be given as text,
        because YAML 1.1 reads 1e-3 and inf as text."""
        value: Any = self.get(key, default)
        number = math.nan
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            number = math.nan if isinstance(value, bool) else float(value)
        if math.isnan(number):
            raise self.error(key, f"expected a number, got {shown(value)}")
        if math.isinf(number):
            self.require(not finite, key, "must be finite")
        elif abs(number) > most:
            raise self.error(key, f"{number:g} is not between {-most:g} and {most:g}; which unit?")
        return number

    def positive(self, key: object, default: float | None = None, finite: bool = True) -> float:
        """A number above 0; `finite=False` allows inf."""
        value = self.number(key, default, finite)
        self.require(value > 0, key, "must be positive")
        return value

    def text(self, key: str, default: str) -> str:
        """Text of at most 100 characters; a whole number is converted to text."""
        value = self.get(key, default)
        number = type(value) is int and 0 <= value < 10**_LONGEST
        self.require(number or isinstance(value, str), key, f"expected text, got {shown(value)}")
        what = f"expected at most {_LONGEST} characters, got {shown(value)}"
        self.require(len(str(value)) <= _LONGEST, key, what)
        return str(value)

    def vector(self, key: str, length: int) -> list[float]:
        """A list of `length` numbers; empty if the key is not given."""
        values = self.get(key)
        if values is None:
            return []
        if not isinstance(values, list | tuple) or len(values) != length:
            raise self.error(key, f"expected a list of {length} numbers, got {shown(values)}")
        each = Entry(dict(enumerate(values)), self.name(key), range(length))
        return [each.number(i) for i in range(length)]

    def flag(self, key: str) -> bool:
        """True or false; false if the key is not given."""
        value = self.get(key, False)
        self.require(isinstance(value, bool), key, "expected true or false")
        return value

    def curvature(self, suffix: str = "") -> float:
        """The curvature (1/mm) from the key `radius` or `curvature`, followed by `suffix`."""
        radius, curvature = f"radius{suffix}", f"curvature{suffix}"
        one = (radius in self) != (curvature in self)
        self.require(one, "", f"give either {radius} (inf for a plane) or {curvature}")
        if curvature in self:
            return self.number(curvature, most=STEEP)
        value = self.number(radius, finite=False, most=WIDE)
        what = f"{value:g} is no surface; a plane is {radius}: inf"
        self.require(abs(value) >= 1 / STEEP, radius, what)
        return 1 / value


def table(rows: list[list[float]], width: int) -> Array:
    """Rows of numbers as an array (rows, `width`); zeros fill up short rows."""
    return array([[*row, *[0.0] * (width - len(row))] for row in rows])
