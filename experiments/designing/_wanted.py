"""The settings of a design."""

import dataclasses
import fnmatch
import math
from typing import Literal

from drt_jax.design import Operand, Solve, Tie, Vary
from drt_jax.design.growth import SHORTEST
from drt_jax.lens.glasses import glass_makers, nearest_glasses

from . import _common


@dataclasses.dataclass(frozen=True)
class Starts:
    """Starts of the search.

    count: number of searches.
    how: "normal", about the lens; "sobol", within the bounds; "as_built", lenses with errors.
    spread: of "normal", standard deviation in scales of the variables.
    per_cent, off_mm: of "as_built", standard deviations of curvatures and thicknesses.
    stages: trials of each search in each stage.
    keep: fraction of searches that survive a stage.
    """

    count: int = 1
    how: Literal["normal", "sobol", "as_built"] = "normal"
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
    """Design for a part of field and aperture first, then for more.

    first: part at the start; 1 for no growth.
    step: step to the next part.
    trials: most trials at each part; a step that misses good_um then is halved.
    good_um: root mean square of the RMS radii at which the next part begins, about four times that
        of the final lens: a lens that is perfect for a part is bad for more, see docs/design.md.
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
        names = (near.glass.name for near in nearest_glasses(1.6, 50, self.makers or None, None))
        some = any(fnmatch.fnmatchcase(name, self.names) for name in names)
        _common.require(some, f"glasses.names: no glass of these makers is like {self.names!r}")


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/design/.

    lens: start, a bundled name or YAML path.
    variables, ties, solves, operands: see drt_jax.design.
    fields_deg: field angles along y.
    wavelengths_um, colour_weights: wavelengths and their weights; empty for equal weights.
    field_weights: weights of the squares of each field; empty for equal weights.
    floating: True for clear apertures that follow the light, except the stop's; False for
        vignetting.
    order: order of the pupil rule of the search.
    tolerance: relative error of the spots, which fixes the rule for the last search.
    rings: above 0, rings of a hexapolar grid instead of both rules, as in other programs.
    trials: most trials of the last search.
    devices: that share the searches from many starts, see docs/devices.md.
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
    devices: int = dataclasses.field(default=1, compare=False)

    def __post_init__(self) -> None:
        limits = {"fields_deg": (-89, 89), "wavelengths_um": (1e-4, 1e6), "order": (1, 40)}
        limits |= {"rings": (0, 50), "tolerance": (1e-12, 0.5), "trials": (1, 1e5)}
        limits |= {"devices": (1, 1e4)}
        _common.require_within("", self, **limits)
        for name in ("variables", "operands", "fields_deg", "wavelengths_um"):
            _common.require(len(getattr(self, name)) > 0, f"{name}: needs at least one item")
