"""Design a lens: least squares with exact Jacobians and limits, from one start or from many.

The settings name variables, operands and starts. Writes the designed lens as designed.yaml, which
load_lens reads; in the same folder the start and other minima, figures, and results.json: `rows`
with `problem`, `merit_start`, `merit_end`, `spots_um`, `jacobians`, `rays`, `seconds`, `compile_s`.
`python -m comparisons.design` adds results of other optimisers.
"""

import dataclasses
import fnmatch
import math
import sys
import time
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import Pattern, Scene, design
from drt_jax.design import Operand, Solve, Tie, Vary
from drt_jax.design.growth import SHORTEST, grow_once, start_growth
from drt_jax.lens.glasses import glass_makers, nearest_glasses

from . import _command, _common
from ._common import LensFile, not_empty, require, require_known, within
from ._design_report import draw as draw, tables as tables
from ._searches import Progress, Starts, searched, starts_of as starts_of
from .runs.folder import Run

COLUMNS = ("merit", "worst", "jacobians")
_DRAWN = 6  # largest number of minima that are drawn


@dataclasses.dataclass(frozen=True)
class Growth:
    """Growth: the lens is first designed for a part of field and aperture, then for larger parts.

    first: part at the start; 1 for no growth.
    step: step to the next part.
    trials: largest number of trials at each part; if good_um is not reached, the step is halved.
    good_um: root mean square of the RMS radii at which the next part starts, about four times that
        of the final lens. A lens that is perfect for a part is bad for a larger part, see
        docs/design.md.
    """

    first: Annotated[float, within(0.01, 1)] = 1.0
    step: Annotated[float, within(SHORTEST, 1)] = 0.1
    trials: Annotated[int, within(1, 1e5)] = 40
    good_um: Annotated[float, within(1e-6, 1e6)] = 10.0


@dataclasses.dataclass(frozen=True)
class Glasses:
    """Real glasses, which replace the model glasses at the end.

    makers: makers of the glasses; empty to keep the model glasses.
    names: pattern of names, such as "N-*".
    count: number of glasses tried for each model glass.
    steps: steps of least squares with each.
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
class Config(LensFile):
    """Settings of the experiment; see configs/design/.

    lens: the start.
    variables, ties, solves, operands: see drt_jax.design.
    fields_deg: field angles along y.
    wavelengths_um, colour_weights: wavelengths and their weights; empty for equal weights.
    field_weights: weights of the squares of each field; empty for equal weights.
    floating: True for clear apertures, except the stop's, that follow the size of the beam; False
        for vignetting.
    order: order of the pupil rule of the search.
    tolerance: relative error of the spots, which determines the rule of the last search.
    rings: above 0: number of rings of a hexapolar grid, which replaces both rules, as in other
        programs.
    trials: largest number of trials of the last search.
    devices: number of devices for the searches from many starts, see docs/devices.md.
    """

    name: str
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

    @property
    def scene(self) -> Scene:
        """All fields in all wavelengths, with their weights."""
        fields = np.radians(self.fields_deg)
        weights = {"wavelength_weights": self.colour_weights or None}
        weights["field_weights"] = self.field_weights or None
        return Scene.radians(fields, self.distance_mm, self.wavelengths_um, **weights)


def problem_of(config: Config, lens: drt_jax.Lens, order: int | None = None) -> design.Problem:
    """The problem of the settings for a lens."""
    waves = config.wavelengths_um
    middle = (waves[len(waves) // 2],)
    solves = []
    for solve in config.solves:
        seen = waves if solve.kind == "best_focus" else middle
        solves.append(dataclasses.replace(solve, distance=config.distance_mm, wavelengths=seen))
    return design.Problem.from_variables(
        design.Variables.from_lens(lens, config.variables, config.ties, solves),
        config.operands,
        config.scene,
        _grid(config.rings) if config.rings else (order or config.order),
    )


def _grid(rings: int) -> Pattern:
    """Rays of equal weight on equidistant rings, 6 k on ring k, and one in the centre."""
    points = [np.zeros((1, 2))]
    for k in range(1, rings + 1):
        angle = 2 * np.pi * np.arange(6 * k) / (6 * k)
        points.append(k / rings * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    positions = np.concatenate(points)
    return Pattern(positions, np.full(len(positions), 1 / len(positions)), "none")


def order_of(config: Config, lens: drt_jax.Lens) -> int:
    """The order of the pupil rule that the spots of a lens need."""
    rule = drt_jax.converge(drt_jax.psf_moments, lens, config.scene, config.tolerance)
    return getattr(rule, "order", config.order)


def grown(config: Config, problem: design.Problem, run: Run) -> drt_jax.Lens:
    """Designs the lens for larger and larger parts of field and aperture. ConfigError, with the
    reason and the remedy, if growth stops."""
    settings, count = config.growth, len(config.fields_deg)
    target = count * (1e-3 * settings.good_um) ** 2
    saved = run.kept("growth")
    growth = start_growth(problem, settings.first, settings.step)
    if saved is not None:
        growth = growth._replace(**saved | {"vector": np.array(saved["vector"])})
    while not growth.ended:
        with Progress(f"{growth.part:.1%} of field and aperture", settings.trials) as bar:
            growth = grow_once(problem, growth, target, settings.trials, bar.searched)
        run.keep("growth", growth._asdict() | {"vector": growth.vector.tolist(), "failed": None})
    if growth.done < 1:
        reason, failed = f"a step would be less than {SHORTEST:g}", growth.failed
        if failed is not None:
            size = 1e3 * math.sqrt(failed.merit / count)
            reason = f"{failed.worst_limit} is in the way; widen this limit or change the start"
            if size > settings.good_um:
                reason = f"the next comes to {size:.3g}; raise growth.good_um or growth.trials"
        where = f"growth: stops at {growth.done:.1%} of field and aperture"
        require(False, f"{where}, where no step leads to {settings.good_um:g} um: {reason}")
    return problem.variables.lens_of(jnp.asarray(growth.vector))


def finished(config: Config, problem: design.Problem, found: dict[str, Any]) -> dict[str, Any]:
    """Optimises the best vector with the rule that it needs."""
    with Progress("least squares", config.trials) as bar:
        vector = jnp.asarray(found["vectors"][0])
        parts = [design.optimise(problem, vector, config.trials, bar.searched)]
        order = config.order if config.rings else order_of(config, parts[0].lens)
        if order > config.order:
            problem, vector = problem.with_order(order), jnp.asarray(parts[0].vector)
            parts.append(design.optimise(problem, vector, config.trials, bar.searched))
    history = np.concatenate([part.history for part in parts])
    first = parts[0].history
    history[len(first) :, 2] += first[-1, 2]  # number of Jacobians of both searches
    end, glasses = snapped(config, problem, parts[-1])
    return {
        "vector": end.vector.tolist(),
        "merit_end": end.merit,
        "worst": end.max_violation,
        "order": order,
        "history": history.tolist(),
        "seconds": sum(part.seconds for part in parts),
        "compile_s": sum(part.first for part in parts),
        "glasses": glasses,
    }


def snapped(
    config: Config, problem: design.Problem, found: design.Optimum
) -> tuple[design.Optimum, dict[str, Any]]:
    """The optimum, with real glasses if makers are given; and the cost of each of them."""
    some, begun = config.glasses, time.perf_counter()
    if not some.makers:
        return found, {}
    accept = lambda glass: fnmatch.fnmatchcase(glass.name, some.names)  # noqa: E731
    given = some.makers, accept, some.count, some.steps
    with tqdm(desc="glasses", unit="glass", dynamic_ncols=True) as bar:
        snapped = design.snap_glasses(problem, found, *given, callback=lambda snap: bar.update())
    ranked = {}
    for i, own in snapped.alternatives.items():
        ranked[i] = [[n.glass.name, score if math.isfinite(score) else None] for n, score in own]
    exchanged = {"snaps": [snap._asdict() for snap in snapped.snaps], "alternatives": ranked}
    return snapped.optimum, exchanged | {"snap_s": time.perf_counter() - begun}


def _designed(variables: design.Variables, end: dict[str, Any]) -> drt_jax.Lens:
    """The lens at the end of the search, with its glasses."""
    lens, snaps = variables.lens, end["glasses"].get("snaps", [])
    for surface, name in {i: snap["glass"] for snap in snaps for i in snap["surfaces"]}.items():
        lens = drt_jax.with_glass(lens, drt_jax.find_glass(name), [surface])
    found = dataclasses.replace(variables, lens=lens).lens_of(jnp.asarray(end["vector"]))
    return dataclasses.replace(found, dispersion=lens.dispersion) if snaps else found


def _foci(config: Config, lens: drt_jax.Lens) -> list[float]:
    """(W,), focus of rays at 0.7 of the aperture minus that of the last wavelength, divided by the
    focal length."""
    waves = config.wavelengths_um
    scene = Scene.point(0.0, config.distance_mm, waves)
    foci = np.asarray(drt_jax.axial_colour(lens, scene, (0.7,)).real)[:, 0]
    return ((foci - foci[-1]) / np.asarray(drt_jax.focal_length(lens, waves))).tolist()


def run(config: Config, run: Run) -> dict[str, Any]:
    """Runs growth, searches and the last search, and writes the lens.

    Each of the three is a job of the run, whose result is stored: a run that is resumed continues
    with the next one.
    """
    start = config.load()
    start = design.open_apertures(start) if config.floating else start
    model = not config.glasses.makers or start.dispersion.model is not None
    none = f"glasses: {config.lens} has no model glass; give nd and vd in place of its glasses"
    require(model, none)
    first = problem_of(config, start)
    begin = grown(config, first, run) if config.growth.first < 1 else start
    problem = problem_of(config, begin)
    found = run.once("starts", lambda: searched(problem, config.starts, config.devices))
    end = run.once("finish", lambda: finished(config, problem, found))
    history = np.array(end["history"])
    run.log("least squares", 0, dict(zip(COLUMNS, history.T)))
    some, lenses = end["glasses"], {"start": start, "designed": _designed(problem.variables, end)}
    for k, vector in enumerate(found["vectors"][1:_DRAWN]):
        lenses[f"minimum_{k + 1}"] = problem.variables.lens_of(jnp.asarray(vector))
    for name, lens in lenses.items():
        lens = design.fit_apertures(problem, lens) if config.floating else lens
        drt_jax.save_lens(lens, run.folder / f"{name}.yaml")
    grew = run.kept("growth") or {"steps": 0, "jacobians": 0, "seconds": 0.0, "first": 0.0}
    designed = drt_jax.load_lens(run.folder / "designed.yaml")
    trials = grew["steps"] + found["trials"] + len(history)
    row = {
        "problem": config.name,
        "merit_start": float(first.merit(first.variables.start)),
        "merit_end": end["merit_end"],
        "worst_limit": end["worst"],
        "spots_um": _common.spots_um(designed, config.scene, config.tolerance),
        "jacobians": grew["jacobians"] + found["jacobians"] + int(history[-1, 2]),
        "rays": design.rays_of(problem) * trials,
        "seconds": grew["seconds"] + found["seconds"] + end["seconds"],
        "compile_s": grew["first"] + found["compile_s"] + end["compile_s"],
    }
    return {
        "rows": [row],
        **_common.settings(config, "lens", "fields_deg", "wavelengths_um", "tolerance"),
        "how": config.starts.how,
        "distance_mm": config.distance_mm if math.isfinite(config.distance_mm) else None,
        "starts": {key: value for key, value in found.items() if key != "vectors"},
        "history": history.tolist(),
        "glasses": some | {"foci": _foci(config, lenses["designed"])} if some else {},
    }


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
