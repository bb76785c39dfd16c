"""Searches from many starts: their settings, starts, progress bar, and ends."""

import dataclasses
from typing import Annotated, Any, Literal

import numpy as np
from tqdm import tqdm

from drt_jax import design
from drt_jax.design.configurations import AnyProblem

from . import _sharing
from ._common import not_empty, require, within


@dataclasses.dataclass(frozen=True)
class Starts:
    """Starts of the search.

    count: number of searches.
    how: "normal", normally distributed about the lens; "sobol", Sobol points within the bounds;
        "as_built", lenses with errors.
    spread: for "normal", standard deviation in scales of the variables.
    per_cent, off_mm: for "as_built", standard deviations of curvatures and thicknesses.
    stages: number of trials of each search in each stage.
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


class Progress(tqdm):
    """A progress bar with the merit and the largest violation of a limit."""

    def __init__(self, title: str, total: int):
        super().__init__(total=total, desc=title, unit="trial", dynamic_ncols=True)

    def searched(self, search: design.Search) -> None:
        """Shows one trial."""
        self.update()
        worst = f"worst limit={float(search.max_violation):+.2g}"
        self.set_postfix_str(f"merit={float(search.merit):.6g} {worst}")

    def tiles(self, done: int, total: int, best: float) -> None:
        """Shows one tile of many starts."""
        self.total = total
        self.update(done - self.n)
        self.set_postfix_str(f"best={best:.6g}")


def starts_of(variables: Any, starts: Starts) -> np.ndarray:
    """Vectors (K, N) of the starts."""
    count, seed = starts.count, starts.seed
    if count == 1:
        return np.asarray(variables.start)[None]
    if starts.how == "as_built":
        return design.as_built_starts(variables, count, starts.per_cent, starts.off_mm, seed)
    if starts.how == "normal":
        return design.normal_starts(variables, count, starts.spread, seed)
    return design.sobol_starts(variables, count, seed)


def searched(problem: AnyProblem, starts: Starts, devices: int = 1) -> dict[str, Any]:
    """Vectors at the ends of the searches from the starts, best first, with counts and times.
    `scores` has the scores of all starts, None where no ray passed in any trial."""
    variables = problem.variables
    if starts.count == 1:
        nothing = {"trials": 0, "jacobians": 0, "seconds": 0.0, "compile_s": 0.0}
        return {"vectors": [variables.start.tolist()], "merits": [], "no_worse": None} | nothing
    vectors = starts_of(variables, starts)
    mesh = _sharing.mesh_of(devices)
    with Progress(f"{starts.count} starts", 1) as bar:
        how = starts.stages, starts.keep, bar.tiles
        found = design.many_starts(problem, vectors, *how, mesh=mesh)
    require(len(found.minima) > 0, "starts: no ray passes any of them; widen the bounds")
    return {
        "vectors": [minimum.vector.tolist() for minimum in found.minima],
        "merits": [minimum.merit for minimum in found.minima],
        "no_worse": int(np.sum(found.merits <= float(problem.merit(variables.start)))),
        "count": starts.count,
        "scores": [score if np.isfinite(score) else None for score in found.merits.tolist()],
        "found": [minimum.found for minimum in found.minima],
        "passed": int(np.isfinite(found.merits).sum()),
        "trials": found.steps,
        "jacobians": found.jacobians,
        "seconds": found.seconds - found.compile_s,
        "compile_s": found.compile_s,
        "best": found.best,
    }
