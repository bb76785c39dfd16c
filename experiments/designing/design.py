"""Design a lens: least squares on exact Jacobians, within limits, from one start or from many.

Reads what varies, what is wanted and where to start from the settings; writes the designed lens as
designed.yaml, which load_lens reads back, pictures before and after, and results.json: `rows` with
`problem`, `merit_start`, `merit_end`, `spots_um`, `jacobians`, `rays`, `seconds`, `compile_s`.
"""

import dataclasses
import math
import time
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import design
from drt_jax.design import Operand, Solve, Tie, Vary

from . import _common

COLUMNS = ("merit", "worst", "jacobians")


@dataclasses.dataclass(frozen=True)
class Starts:
    """Where to start.

    count: how many searches. how: "around" the lens by `spread` times the variables' scales, or
    "within" their bounds. stages: trials of each search in each stage; after each the better half
    goes on. seed: of the random numbers.
    """

    count: int = 1
    how: Literal["around", "within"] = "around"
    spread: float = 1.0
    stages: tuple[int, ...] = (12, 12, 24, 48, 200)
    seed: int = 0

    def __post_init__(self) -> None:
        limits = {"count": (1, 1e5), "spread": (0, 1e3), "stages": (1, 1e4)}
        _common.require_within("starts.", self, **limits)
        _common.require(len(self.stages) > 0, "starts.stages: needs at least one item")


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/design/.

    lens: the start, a bundled name or a YAML path. fields_deg: along y. distance_mm: to the object.
    wavelengths_um, colour_weights: of the light; no weights: all alike. variables, ties, solves,
    operands: see drt_jax.design. order: of the pupil's rule while searching; the best lens is
    finished with as many rays as `tolerance`, relative, of its spots needs. growth: parts of the
    fields and of the aperture to design for, one after the other, before the whole. trials: at most,
    of the last search.
    """

    lens: str
    variables: tuple[Vary, ...]
    operands: tuple[Operand, ...]
    fields_deg: tuple[float, ...] = (0.0,)
    wavelengths_um: tuple[float, ...] = (0.5875618,)
    colour_weights: tuple[float, ...] = ()
    distance_mm: float = math.inf
    ties: tuple[Tie, ...] = ()
    solves: tuple[Solve, ...] = ()
    order: int = 4
    tolerance: float = 1e-6
    growth: tuple[float, ...] = ()
    trials: int = 500
    starts: Starts = Starts()

    def __post_init__(self) -> None:
        limits = {"fields_deg": (-89, 89), "wavelengths_um": (1e-4, 1e6), "order": (1, 40)}
        limits |= {"tolerance": (1e-12, 0.5), "growth": (0.01, 1), "trials": (1, 1e5)}
        _common.require_within("", self, **limits)
        for name in ("variables", "operands", "fields_deg", "wavelengths_um"):
            _common.require(len(getattr(self, name)) > 0, f"{name}: needs at least one item")


def problem_of(
    config: Config, lens: drt_jax.Lens, part: float = 1.0, order: int | None = None
) -> design.Problem:
    """The problem of the settings for a lens; `part`: of the fields and of the aperture."""
    solves = []
    for solve in config.solves:
        colours = config.wavelengths_um
        if solve.kind != "best_focus":
            colours = (colours[len(colours) // 2],)
        solve = dataclasses.replace(solve, distance=config.distance_mm, wavelengths=colours)
        if solve.kind in ("entrance_pupil", "f_number") and solve.value:
            value = solve.value * part if solve.kind == "entrance_pupil" else solve.value / part
            solve = dataclasses.replace(solve, value=value)
        solves.append(solve)
    if part < 1 and not any(s.kind in ("entrance_pupil", "f_number") for s in solves):
        semi = lens.semi_diameter.at[lens.stop].multiply(part)
        lens = dataclasses.replace(lens, semi_diameter=semi)
    variables = design.Variables.of(lens, config.variables, config.ties, solves)
    return design.Problem.of(
        variables,
        config.operands,
        np.radians(config.fields_deg) * part,
        config.wavelengths_um,
        config.distance_mm,
        config.order if order is None else order,
        config.colour_weights or None,
    )


def spots_um(config: Config, lens: drt_jax.Lens) -> list[float]:
    """RMS radii of the spots of all fields about the centroid of all colours, with as many rays as
    the tolerance needs: by none of the code that designs."""
    weights = np.array(config.colour_weights or np.ones(len(config.wavelengths_um)))
    weights = weights / weights.sum()
    found = []
    for field in np.radians(config.fields_deg):
        moments = drt_jax.psf_moments(
            lens, field, config.distance_mm, config.wavelengths_um, config.tolerance
        )
        mean, spread = np.asarray(moments.mean), np.asarray(moments.covariance)
        apart = np.sum((mean - weights @ mean) ** 2, axis=1)
        found.append(1e3 * math.sqrt(weights @ (np.trace(spread, axis1=1, axis2=2) + apart)))
    return found


def order_of(config: Config, lens: drt_jax.Lens) -> int:
    """The order of the pupil's rule that the spots of a lens need."""
    scene = config.distance_mm, config.wavelengths_um, config.tolerance
    rules = (drt_jax.converged_rule(lens, f, *scene) for f in np.radians(config.fields_deg))
    return max(getattr(rule, "order", config.order) for rule in rules)


class _Progress:
    """A progress bar with the merit and the worst limit; and their rows for the metrics."""

    def __init__(self, title: str, total: int):
        self._bar = tqdm(total=total, desc=title, unit="trial", dynamic_ncols=True)

    def searched(self, search: design.Search) -> None:
        """After one trial."""
        self._bar.update()
        self._bar.set_postfix_str(
            f"merit={float(search.merit):.6g} worst limit={float(search.worst):+.2g}"
        )

    def tiles(self, done: int, total: int, best: float) -> None:
        """After one tile of many starts."""
        self._bar.total = total
        self._bar.update(done - self._bar.n)
        self._bar.set_postfix_str(f"best={best:.6g}")

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()


def _grown(config: Config, lens: drt_jax.Lens) -> drt_jax.Lens:
    """The lens designed for parts of the fields and the aperture, one after the other."""
    for part in config.growth:
        problem = problem_of(config, lens, part)
        with _Progress(f"{part:.0%} of field and aperture", config.trials) as bar:
            found = design.optimise(problem, trials=config.trials, report=bar.searched)
        kept = found.lens.semi_diameter.at[lens.stop].set(lens.semi_diameter[lens.stop])
        lens = dataclasses.replace(found.lens, semi_diameter=kept)
    return lens


def search(config: Config, start: drt_jax.Lens) -> dict[str, Any]:
    """The vectors that many starts came to, best first, and what that took; of one start, its own
    vector alone."""
    problem = problem_of(config, _grown(config, start))
    variables, some = problem.variables, config.starts
    if some.count == 1:
        return {"vectors": [variables.start.tolist()], "merits": [], "rays": 0, "seconds": 0.0}
    if some.how == "around":
        vectors = design.around(variables, some.count, some.spread, some.seed)
    else:
        vectors = design.within(variables, some.count, some.seed)
    with _Progress(f"{some.count} starts", 1) as bar:
        found = design.many_starts(problem, vectors, some.stages, report=bar.tiles)
    _common.require(len(found.minima) > 0, "starts: no ray passes any of them; widen the bounds")
    return {
        "vectors": [minimum.vector.tolist() for minimum in found.minima],
        "merits": [minimum.merit for minimum in found.minima],
        "found": [minimum.found for minimum in found.minima],
        "worst": [minimum.worst for minimum in found.minima],
        "passed": int(np.isfinite(found.merits).sum()),
        "trials": found.trials,
        "jacobians": found.jacobians,
        "rays": found.rays,
        "seconds": found.seconds,
    }


def finish(config: Config, start: drt_jax.Lens, found: dict[str, Any]) -> dict[str, Any]:
    """The best vector brought to the optimum with as many rays as it needs."""
    lens = _grown(config, start) if not found["merits"] else start
    problem = problem_of(config, lens)
    vector = jnp.asarray(found["vectors"][0])
    told = [float(problem.merit(problem.variables.start))]
    begun = time.perf_counter()
    with _Progress("least squares", config.trials) as bar:
        best = design.optimise(problem, vector, config.trials, bar.searched)
        order = order_of(config, best.lens)
        history, seconds = best.history, best.seconds
        if order > config.order:
            finer = problem_of(config, lens, order=order)
            best = design.optimise(finer, jnp.asarray(best.vector), config.trials, bar.searched)
            later = best.history + [0, 0, history[-1, 2]]
            history, seconds = np.concatenate([history, later]), seconds + best.seconds
    trials = len(history)
    return {
        "vector": best.vector.tolist(),
        "merit_start": told[0],
        "merit_end": best.merit,
        "worst": best.worst,
        "jacobians": int(history[-1, 2]),
        "rays": trials * design.rays_of(problem),
        "seconds": seconds,
        "compile_s": time.perf_counter() - begun - seconds,
        "order": order,
        "history": history.tolist(),
    }
