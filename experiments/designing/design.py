"""Design a lens: least squares on exact Jacobians, within limits, from one start or from many.

The settings name variables, operands and starts. Writes the designed lens as designed.yaml, which
load_lens reads back, the start and other minima beside it, figures, and results.json: `rows` with
`problem`, `merit_start`, `merit_end`, `spots_um`, `jacobians`, `rays`, `seconds`, `compile_s`.
`python -m comparisons.design` adds results of other optimisers.
"""

import dataclasses
import fnmatch
import math
import sys
import time
from typing import Any

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import Pattern, Scene, design
from drt_jax.design.growth import SHORTEST, grow_once, start_growth

from . import _command, _common, _sharing
from ._pictures import draw as draw
from ._wanted import Config as Config, Starts
from .runs.folder import Run

COLUMNS = ("merit", "worst", "jacobians")
_DRAWN = 6  # most minima that are drawn
# Counts and times without a search.
_NOTHING = {"trials": 0, "jacobians": 0, "seconds": 0.0, "compile_s": 0.0}


def problem_of(config: Config, lens: drt_jax.Lens, order: int | None = None) -> design.Problem:
    """The problem of the settings for a lens."""
    solves = []
    for solve in config.solves:
        waves = config.wavelengths_um
        if solve.kind != "best_focus":
            waves = (waves[len(waves) // 2],)
        solves.append(dataclasses.replace(solve, distance=config.distance_mm, wavelengths=waves))
    return design.Problem.from_variables(
        design.Variables.from_lens(lens, config.variables, config.ties, solves),
        config.operands,
        Scene.grid(
            np.radians(config.fields_deg),
            config.distance_mm,
            config.wavelengths_um,
            wavelength_weights=config.colour_weights or None,
            field_weights=config.field_weights or None,
        ),
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


def spots_um(config: Config, lens: drt_jax.Lens) -> list[float]:
    """RMS radii of the spots of all fields about the centroid of all wavelengths, to the tolerance,
    without code of drt_jax.design."""
    weights = np.array(config.colour_weights or np.ones(len(config.wavelengths_um)))
    weights = weights / weights.sum()
    found = []
    for field in np.radians(config.fields_deg):
        moments = drt_jax.psf_moments(
            lens, Scene.point(field, config.distance_mm, config.wavelengths_um), config.tolerance
        )
        mean, covariance = np.asarray(moments.mean), np.asarray(moments.covariance)
        squares = np.sum((mean - weights @ mean) ** 2, axis=1)
        squares = squares + np.trace(covariance, axis1=1, axis2=2)
        found.append(1e3 * math.sqrt(weights @ squares))
    return found


def order_of(config: Config, lens: drt_jax.Lens) -> int:
    """The order of the pupil rule that the spots of a lens need."""
    fields = np.radians([[0.0, field] for field in config.fields_deg])
    scene = Scene.radians(fields, config.distance_mm, config.wavelengths_um)
    rule = drt_jax.converge(drt_jax.psf_moments, lens, scene, config.tolerance)
    return getattr(rule, "order", config.order)


class _Progress(tqdm):
    """A progress bar with the merit and the worst limit."""

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


def grown(config: Config, problem: design.Problem, run: Run) -> drt_jax.Lens:
    """Designs the lens for growing parts of field and aperture. ConfigError if growth stops."""
    settings = config.growth
    target = len(config.fields_deg) * (1e-3 * settings.good_um) ** 2
    saved = run.kept("growth")
    growth = start_growth(problem, settings.first, settings.step)
    if saved is not None:
        growth = growth._replace(**saved | {"vector": np.array(saved["vector"])})
    while not growth.ended:
        with _Progress(f"{growth.part:.1%} of field and aperture", settings.trials) as bar:
            growth = grow_once(problem, growth, target, settings.trials, bar.searched)
        state = growth._asdict() | {"vector": growth.vector.tolist(), "failed": None}
        run.keep("growth", state)
    message = f"growth: stops at {growth.done:.1%} of field and aperture, where no step leads to "
    message += f"{settings.good_um:g} um: {_reason(config, growth.failed)}"
    _common.require(growth.done >= 1, message)
    return problem.variables.lens_of(jnp.asarray(growth.vector))


def _reason(config: Config, failed: design.Optimum | None) -> str:
    """Why growth stops, and the remedy."""
    if failed is None:
        return f"a step would be less than {SHORTEST:g}"
    size = 1e3 * math.sqrt(failed.merit / len(config.fields_deg))
    if size > config.growth.good_um:
        return f"the next comes to {size:.3g}; raise growth.good_um or growth.trials"
    return f"{failed.worst_limit} is in the way; widen this limit or change the start"


def starts_of(variables: design.Variables, starts: Starts) -> np.ndarray:
    """Vectors (K, N) of the starts."""
    count, seed = starts.count, starts.seed
    if count == 1:
        return np.asarray(variables.start)[None]
    if starts.how == "as_built":
        return design.as_built_starts(variables, count, starts.per_cent, starts.off_mm, seed)
    if starts.how == "normal":
        return design.normal_starts(variables, count, starts.spread, seed)
    return design.sobol_starts(variables, count, seed)


def searched(config: Config, problem: design.Problem) -> dict[str, Any]:
    """Vectors at the ends of the searches from the starts, best first, with counts and times."""
    variables, starts = problem.variables, config.starts
    if starts.count == 1:
        return {"vectors": [variables.start.tolist()], "merits": [], "no_worse": None} | _NOTHING
    vectors = starts_of(variables, starts)
    mesh = _sharing.mesh_of(config.devices)
    with _Progress(f"{starts.count} starts", 1) as bar:
        how = starts.stages, starts.keep, bar.tiles
        found = design.many_starts(problem, vectors, *how, mesh=mesh)
    _common.require(len(found.minima) > 0, "starts: no ray passes any of them; widen the bounds")
    return {
        "vectors": [minimum.vector.tolist() for minimum in found.minima],
        "merits": [minimum.merit for minimum in found.minima],
        "no_worse": int(np.sum(found.merits <= float(problem.merit(variables.start)))),
        "count": starts.count,
        "found": [minimum.found for minimum in found.minima],
        "passed": int(np.isfinite(found.merits).sum()),
        "trials": found.steps,
        "jacobians": found.jacobians,
        "seconds": found.seconds - found.compile_s,
        "compile_s": found.compile_s,
        "best": found.best,
    }


def finished(config: Config, problem: design.Problem, found: dict[str, Any]) -> dict[str, Any]:
    """Optimises the best vector with the rule that it needs."""
    with _Progress("least squares", config.trials) as bar:
        vector = jnp.asarray(found["vectors"][0])
        parts = [design.optimise(problem, vector, config.trials, bar.searched)]
        order = config.order if config.rings else order_of(config, parts[0].lens)
        if order > config.order:
            problem = problem.with_order(order)
            vector = jnp.asarray(parts[0].vector)
            parts.append(design.optimise(problem, vector, config.trials, bar.searched))
    history = parts[0].history
    for part in parts[1:]:
        before = np.array([0, 0, history[-1, 2]])
        history = np.concatenate([history, part.history + before])
    end, glasses = _snapped(config, problem, parts[-1])
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


def _snapped(
    config: Config, problem: design.Problem, found: design.Optimum
) -> tuple[design.Optimum, dict[str, Any]]:
    """The optimum, with real glasses if these are wanted, and what each of them has cost."""
    some, begun = config.glasses, time.perf_counter()
    if not some.makers:
        return found, {}
    accept = lambda glass: fnmatch.fnmatchcase(glass.name, some.names)  # noqa: E731
    given = some.makers, accept, some.count, some.steps
    with tqdm(desc="glasses", unit="glass", dynamic_ncols=True) as bar:
        snapped = design.snap_glasses(problem, found, *given, callback=lambda snap: bar.update())
    ranked = {
        i: [[near.glass.name, score if math.isfinite(score) else None] for near, score in own]
        for i, own in snapped.alternatives.items()
    }
    exchanged = {"snaps": [snap._asdict() for snap in snapped.snaps], "alternatives": ranked}
    return snapped.optimum, exchanged | {"snap_s": time.perf_counter() - begun}


def _designed(variables: design.Variables, end: dict[str, Any]) -> drt_jax.Lens:
    """The lens of the end, with its glasses."""
    lens, snaps = variables.lens, end["glasses"].get("snaps", [])
    for surface, name in {i: snap["glass"] for snap in snaps for i in snap["surfaces"]}.items():
        lens = drt_jax.with_glass(lens, drt_jax.find_glass(name), [surface])
    found = dataclasses.replace(variables, lens=lens).lens_of(jnp.asarray(end["vector"]))
    return dataclasses.replace(found, dispersion=lens.dispersion) if snaps else found


def _foci(config: Config, lens: drt_jax.Lens) -> list[float]:
    """(W,), the focus of light through 0.7 of the aperture less that of the last wavelength, over
    the focal length."""
    waves = config.wavelengths_um
    foci = np.asarray(
        drt_jax.axial_colour(lens, Scene.point(0.0, config.distance_mm, waves), (0.7,)).real
    )[:, 0]
    return ((foci - foci[-1]) / np.asarray(drt_jax.focal_length(lens, waves))).tolist()


def run(config: Config, run: Run) -> dict[str, Any]:
    """Grows, searches, finishes, and writes the lens."""
    start = drt_jax.load_lens(config.lens)
    start = design.open_apertures(start) if config.floating else start
    _common.require(
        not config.glasses.makers or start.dispersion.model is not None,
        f"glasses: {config.lens} has no model glass; give nd and vd in place of its glasses",
    )
    first = problem_of(config, start)
    begin = grown(config, first, run) if config.growth.first < 1 else start
    problem = problem_of(config, begin)
    found = run.once("starts", lambda: searched(config, problem))
    end = run.once("finish", lambda: finished(config, problem, found))
    history = np.array(end["history"])
    run.log("least squares", 0, dict(zip(COLUMNS, history.T)))
    some, lenses = end["glasses"], {"start": start, "designed": _designed(problem.variables, end)}
    for k, vector in enumerate(found["vectors"][1:_DRAWN]):
        lenses[f"minimum_{k + 1}"] = problem.variables.lens_of(jnp.asarray(vector))
    for name, lens in lenses.items():
        lens = design.fit_apertures(problem, lens) if config.floating else lens
        drt_jax.save_lens(lens, run.folder / f"{name}.yaml")
    rays, before = design.rays_of(problem), run.kept("growth") or {"steps": 0, "first": 0.0}
    before = _NOTHING | before | {"trials": before["steps"], "compile_s": before["first"]}
    row = {
        "problem": config.name,
        "merit_start": float(first.merit(first.variables.start)),
        "merit_end": end["merit_end"],
        "worst_limit": end["worst"],
        "spots_um": spots_um(config, drt_jax.load_lens(run.folder / "designed.yaml")),
        "jacobians": before["jacobians"] + found["jacobians"] + int(history[-1, 2]),
        "rays": rays * (before["trials"] + found["trials"] + len(history)),
        "seconds": before["seconds"] + found["seconds"] + end["seconds"],
        "compile_s": before["compile_s"] + found["compile_s"] + end["compile_s"],
    }
    return {
        "rows": [row],
        "lens": config.lens,
        "how": config.starts.how,
        "fields_deg": list(config.fields_deg),
        "wavelengths_um": list(config.wavelengths_um),
        "distance_mm": config.distance_mm if math.isfinite(config.distance_mm) else None,
        "tolerance": config.tolerance,
        "starts": {key: value for key, value in found.items() if key != "vectors"},
        "history": history.tolist(),
        "glasses": some | {"foci": _foci(config, lenses["designed"])} if some else {},
    }


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Tables of the spots by field, and of counts and times."""
    (row,), starts = results["rows"], results["starts"]
    fields = results["fields_deg"]
    peers = row.get("peer_spots_um") or [None] * len(fields)
    spots = [[field, um, peer] for field, um, peer in zip(fields, row["spots_um"], peers)]
    totals = (None if None in um else math.hypot(*um) for um in (row["spots_um"], peers))
    spots.append(["root of the sum of squares", *totals])
    rows = [
        ["merit, mm^2, start", row["merit_start"]],
        ["merit, mm^2, end", row["merit_end"]],
        ["worst limit exceeded by", row["worst_limit"]],
        ["Jacobians", row["jacobians"]],
        ["rays traced", row["rays"]],
        ["seconds", row["seconds"]],
        ["compilation, s", row["compile_s"]],
    ]
    if glasses := results.get("glasses"):
        rows.append(["seconds for the glasses", glasses["snap_s"]])
        foci = zip(results["wavelengths_um"], glasses["foci"], strict=True)
        rows += [[f"focus at {um:.4f} um, over the focal length", place] for um, place in foci]
    if starts["merits"]:
        rows += [["starts that pass light", starts["passed"]], ["minima", len(starts["merits"])]]
        rows += [["minima a minute", 60 * len(starts["merits"]) / max(starts["seconds"], 1e-9)]]
    if results["how"] == "as_built":
        rows.append(["starts no worse than the lens", f"{starts['no_worse']} of {starts['count']}"])
    name = row["problem"]
    found = {
        f"design, {name}: spots": _common.table(("field, deg", "RMS um", "by Optiland"), spots),
        f"design, {name}": _common.table(("what", "value"), rows),
    }
    if glasses:
        found[f"design, {name}: glasses"] = _glasses_table(glasses["snaps"])
    if results.get("beside"):
        found[f"design, {name}: beside"] = _peers_table(results["beside"], results["how"])
    return found


def _glasses_table(snaps: list[dict[str, Any]]) -> str:
    """Each glass that was exchanged in a row, with its cost."""
    header = ["behind surface", "nd", "vd", "becomes", "merit before", "after"]
    keys = ("glass", "before", "after")
    rows = [[", ".join(map(str, s["surfaces"])), *s["model"], *map(s.get, keys)] for s in snaps]
    return _common.table(header, rows)


def _peers_table(rows: list[dict[str, Any]], how: str) -> str:
    """Table of other optimisers, see `comparisons`."""
    goal = "no worse than the lens" if how == "as_built" else "within 1% of the design"
    header = ["optimiser", f"starts {goal}", "merit, best", "median", "limit exceeded by"]
    header += ["Jacobians until then", "s until then", "s a start"]
    lines = []
    for row in rows:
        met = "not installed" if row["met"] is None else f"{row['met']} of {row['starts']}"
        worst = max((x for x in row["worst"] if x is not None), default=None)
        medians = (_median(row[key]) for key in ("met_jacobians", "met_s", "seconds"))
        lines.append([row["optimiser"], met, row["best"], row["median"], worst, *medians])
    return _common.table(header, lines)


def _median(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
