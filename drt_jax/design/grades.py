"""Published grades of precision of single elements, as data.

Makers publish the tolerances that they guarantee at their usual price. None of these charts
describes the mount: add tolerances for shifts and tilts of elements and for air spaces.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple

from ..inputs import require_one_of
from ..lens.lens import Lens
from .deviations import KINDS, ToleranceKind
from .media import pieces_of
from .perturbed import Tolerance

GradeName = Literal[
    "commercial", "precision", "high precision", "moulded", "moulded precision", "turned",
    "turned precision"
]  # fmt: skip
_GLASS = (
    'radius and thickness: Edmund Optics, "Understanding Optical Specifications" (typical, '
    'precision, high quality); nd and vd: Optimax, "Manufacturing Tolerance Chart"; web pages, 2026'
)
_PLASTIC = (
    'Apollo Optical Systems, "Manufacturing Tolerances"; irregularity for 25 mm of diameter, '
    "from fringes at 632.8 nm; web page, 2026"
)
_RED = 632.8 / 546.074  # fringes of a HeNe laser in those of `Tolerance`


class Grade(NamedTuple):
    """A grade of precision.

    sizes: largest deviation of each kind, in the units of `Tolerance`; "thickness" is that of the
        elements.
    source: who publishes it.
    """

    sizes: Mapping[ToleranceKind, float]
    source: str


GRADES: dict[GradeName, Grade] = {
    "commercial": Grade({"radius": 0.5, "thickness": 0.2, "index": 1e-3, "abbe": 0.8}, _GLASS),
    "precision": Grade({"radius": 0.1, "thickness": 0.05, "index": 5e-4, "abbe": 0.5}, _GLASS),
    # For this grade the chart uses the measured index of each melt, and gives no remaining error.
    "high precision": Grade({"radius": 0.01, "thickness": 0.01}, _GLASS),
    "moulded": Grade({"radius": 1.0, "thickness": 0.025, "irregularity": 6 * _RED}, _PLASTIC),
    "moulded precision": Grade(
        {"radius": 0.5, "thickness": 0.015, "irregularity": 3 * _RED}, _PLASTIC
    ),
    "turned": Grade({"radius": 0.5, "thickness": 0.02, "irregularity": 4 * _RED}, _PLASTIC),
    "turned precision": Grade(
        {"radius": 0.1, "thickness": 0.005, "irregularity": 2 * _RED}, _PLASTIC
    ),
}


def graded(lens: Lens, grade: GradeName) -> list[Tolerance]:
    """The tolerances of the elements of a lens, all of one grade.

    Kinds that no part of the lens can have are left out.

    lens: the lens.
    grade: a key of `GRADES`: "commercial", "precision", "high precision" (ground and polished
        glass); "moulded", "moulded precision", "turned", "turned precision" (plastic).

    ValueError for another grade.
    """
    require_one_of("grade", grade, GRADES)
    glass = {row for rows in pieces_of(lens).values() for row in rows}
    found = []
    for kind, size in GRADES[grade].sizes.items():
        places = tuple(KINDS[kind].places(lens))
        if kind == "thickness":
            places = tuple(place for place in places if place + 1 in glass)
        if places:
            found.append(Tolerance(kind, size, places))
    return found
