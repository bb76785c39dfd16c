"""User apertures of `.zmx` files: polygons, whose corners UDAD lines give."""

import dataclasses

from .record import Record, Row
from .text import Words

# Each keyword of an aperture, and the key of a prescription.
_USED = {"USAP": "aperture", "USOB": "obscuration", "UOBS": "obscuration"}
LINES = (*_USED, "UDAD")


@dataclasses.dataclass
class UserAperture:
    """The user aperture of a surface. line, key: of its keyword. corners: [x, y], mm."""

    line: int = 0
    key: str = ""
    corners: list[list[float]] = dataclasses.field(default_factory=list)

    def take(self, record: Record, unit: float, words: Words) -> None:
        """Read a line of `LINES`. UDAD: number, x, y, 0 of a corner; number 0 is of a line with
        the name of a file, whose scale comes last. unit: mm. LensError for other numbers."""
        line, key, rest = words.line, words.key, words.rest
        if key != "UDAD":
            self.line, self.key = line, key
            if any(record.numbers(line, rest, len(rest))):
                raise record.error(line, f"{key}: expected zeros; other numbers are not known")
            return
        self.line, number = self.line or line, record.count(line, rest)
        if number == 0:
            if len(rest) > 1 and rest[-1][-1] != '"' and record.number(line, rest[-1:]) != 1:
                raise record.error(line, "UDAD: a scale other than 1; scale the corners")
            return
        if number != len(self.corners) + 1 or any(record.numbers(line, rest, len(rest))[3:]):
            raise record.error(
                line, "UDAD: expected corners 1, 2, ... of a polygon: number, x, y, 0"
            )
        self.corners.append([record.number(line, rest, i) * unit for i in (1, 2)])

    def put(self, record: Record, row: Row, centre: list[float]) -> None:
        """Set the aperture or obscuration. LensError if it is not complete, or more than one."""
        if not self.line:
            return
        corners = list(self.corners)
        while corners and corners[-1] == [0, 0]:  # the end of a polygon
            corners.pop()
        if not self.key or not corners or [0, 0] in corners:
            why = "two polygons: a corner 0 0 ends one" if [0, 0] in corners else "no UDAD lines"
            why = why if self.key else "UDAD lines without USAP or USOB"
            record.lacks(self.line, f"{row.name}: a user aperture with {why}")
            return
        key, shape = (
            _USED[self.key],
            {"polygon": corners} | ({"centre": centre} if any(centre) else {}),
        )
        row.put(key, [*row.entry.get(key, []), shape], self.line)
