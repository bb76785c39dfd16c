"""The settings of a design."""

import dataclasses
import fnmatch
import math
from typing import Annotated, Literal

from drt_jax.design import Operand, Solve, Tie, Vary
from drt_jax.design.growth import SHORTEST
from drt_jax.lens.glasses import glass_makers, nearest_glasses

from ._common import not_empty, require, require_known, within


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

    count: Annotated[int, within(1, 1e5)] = 1
    how: Literal["normal", "sobol", "as_built"] = "normal"
    spread: Annotated[float, within(0, 1e3)] = 1.0
    per_cent: float = 1.0
    off_mm: float = 0.1
    stages: Annotated[tuple[int, ...], within(1, 1e4), not_empty] = (12, 12, 24, 48, 200)
    keep: Annotated[float, within(0, 1)] = 0.7
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Growth:
    """Design for a part of field and aperture first, then for more.

    first: part at the start; 1 for no growth.
    step: step to the next part.
    trials: most trials at each part; a step that misses good_um then is halved.
    good_um: root mean square of the RMS radii at which the next part begins, about four times that
        of the final lens: a lens that is perfect for a part is bad for more, see docs/design.md.
    """

    first: Annotated[float, within(0.01, 1)] = 1.0
    step: Annotated[float, within(SHORTEST, 1)] = 0.1
    trials: Annotated[int, within(1, 1e5)] = 40
    good_um: Annotated[float, within(1e-6, 1e6)] = 10.0


@dataclasses.dataclass(frozen=True)
class Glasses:
    """Real glasses in place of model glasses, in the end.

    makers: of the glasses; none: model glasses stay. names: a pattern of names, such as "N-*".
    count: glasses tried in each place. steps: of least squares with each.
    """

    makers: tuple[str, ...] = ()
    names: str = "*"
    count: Annotated[int, within(1, 1e4)] = 8
    steps: Annotated[int, within(1, 1e4)] = 12

    def __post_init__(self) -> None:
        require_known("glasses.makers", self.makers, glass_makers())
        names = (near.glass.name for near in nearest_glasses(1.6, 50, self.makers or None, None))
        some = any(fnmatch.fnmatchcase(name, self.names) for name in names)
        require(some, f"glasses.names: no glass of these makers is like {self.names!r}")


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
    variables: Annotated[tuple[Vary, ...], not_empty]
    operands: Annotated[tuple[Operand, ...], not_empty]
    fields_deg: Annotated[tuple[float, ...], within(-89, 89), not_empty] = (0.0,)
    wavelengths_um: Annotated[tuple[float, ...], within(1e-4, 1e6), not_empty] = (0.5875618,)
    colour_weights: tuple[float, ...] = ()
    field_weights: tuple[float, ...] = ()
    distance_mm: float = math.inf
    floating: bool = True
    ties: tuple[Tie, ...] = ()
    solves: tuple[Solve, ...] = ()
    order: Annotated[int, within(1, 40)] = 4
    rings: Annotated[int, within(0, 50)] = 0
    tolerance: Annotated[float, within(1e-12, 0.5)] = 1e-6
    growth: Growth = Growth()
    trials: Annotated[int, within(1, 1e5)] = 500
    starts: Starts = Starts()
    glasses: Glasses = Glasses()
    devices: Annotated[int, within(1, 1e4)] = dataclasses.field(default=1, compare=False)
