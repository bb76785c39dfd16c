"""The settings of a design."""

import dataclasses
import math
from typing import Literal

from drt_jax.design import Operand, Solve, Tie, Vary
from drt_jax.design.growth import SHORTEST
from drt_jax.lens.glasses import glass_makers

from . import _common


@dataclasses.dataclass(frozen=True)
class Starts:
    """Where to start.

    count: how many searches. how: "around" the lens by `spread` times the variables' scales,
    "within" their bounds, or from lenses "made" with curvatures off by `per_cent` and thicknesses
    off by `off_mm` (standard deviations). stages: trials of each search in each stage; keep: the
    part that goes on to the next. seed: of the random numbers.
    """

    count: int = 1
    how: Literal["around", "within", "made"] = "around"
    spread: float = 1.0
    per_cent: float = 1.0
    off_mm: float = 0.1
    stages: tuple[int, ...] = (12, 12, 24, 48, 200)
    keep: float = 0.7
    seed: int = 0

    def __post_init__(self) -> None:
        limits = {"count": (1, 1e5), "spread": (0, 1e3), "stages": (1, 1e4), "keep": (0, 1)}
        _common.require_within("starts.", self, **limits)
        _common.require(len(self.stages) > 0, "starts.stages: needs at least one item")


@dataclasses.dataclass(frozen=True)
class Growth:
    """Design for a part of the fields and of the aperture first, then for more and more.

    first: part to begin with; 1: the whole at once. step: to the next part. good_um: root of the
    mean squared RMS radius with which the next is tried at once, some four times that of the whole
    in the end: a lens that is perfect for a part is spoilt for more, see docs/design.md.
    trials: at most at each part; a step that is not good then is halved.
    """

    first: float = 1.0
    step: float = 0.1
    trials: int = 40
    good_um: float = 10.0

    def __post_init__(self) -> None:
        limits = {"first": (0.01, 1), "step": (SHORTEST, 1), "trials": (1, 1e5)}
        _common.require_within("growth.", self, **limits, good_um=(1e-6, 1e6))


@dataclasses.dataclass(frozen=True)
class Glasses:
    """Real glasses in place of model glasses, in the end.

    makers: of the glasses; none: model glasses stay. names: a pattern of names, such as "N-*".
    count: glasses tried in each place. steps: of least squares with each.
    """

    makers: tuple[str, ...] = ()
    names: str = "*"
    count: int = 8
    steps: int = 12

    def __post_init__(self) -> None:
        _common.require_within("glasses.", self, count=(1, 1e4), steps=(1, 1e4))
        _common.require_known("glasses.makers", self.makers, glass_makers())


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/design/.

    name: of the problem.
    lens: the start, a bundled name or a YAML path. fields_deg: along y. distance_mm: to the object.
    floating: whether clear apertures but the stop's follow the light, instead of vignetting.
    wavelengths_um, colour_weights: of the light, field_weights: of the squares; none: all alike.
    variables, ties, solves, operands: see drt_jax.design. order: of the pupil's rule while
    searching; the best lens is finished with as many rays as `tolerance`, relative, of its spots
    needs. rings: above 0, a hexapolar grid of so many in place of both, as other programs sum.
    trials: at most, of the last search.
    """

    name: str
    lens: str
    variables: tuple[Vary, ...]
    operands: tuple[Operand, ...]
    fields_deg: tuple[float, ...] = (0.0,)
    wavelengths_um: tuple[float, ...] = (0.5875618,)
    colour_weights: tuple[float, ...] = ()
    field_weights: tuple[float, ...] = ()
    distance_mm: float = math.inf
    floating: bool = True
    ties: tuple[Tie, ...] = ()
    solves: tuple[Solve, ...] = ()
    order: int = 4
    rings: int = 0
    tolerance: float = 1e-6
    growth: Growth = Growth()
    trials: int = 500
    starts: Starts = Starts()
    glasses: Glasses = Glasses()

    def __post_init__(self) -> None:
        limits = {"fields_deg": (-89, 89), "wavelengths_um": (1e-4, 1e6), "order": (1, 40)}
        limits |= {
            "rings": (0, 50),
            "tolerance": (1e-12, 0.5),
            "trials": (1, 1e5),
        }
        _common.require_within("", self, **limits)
        for name in ("variables", "operands", "fields_deg", "wavelengths_um"):
            _common.require(len(getattr(self, name)) > 0, f"{name}: needs at least one item")
