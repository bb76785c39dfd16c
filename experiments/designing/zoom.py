"""Re-optimise a zoom lens, or one that focuses, in all configurations of its file at once.

The settings name the moving variables, which have a value for each configuration, and the shared
variables. Writes the lens of each configuration, before and after, as YAML, and results.json:
`rows` with `configuration`, `focal_mm`, `merit_start`, `merit_moved` (after optimising the moving
variables alone; with many starts `merit_starts`, of the best start), `merit_end`, and `spots_um` at
start and end; for near objects also `magnification` and `breathing` at start and end.
"""

import dataclasses
import math
import pathlib
import sys
import time
from collections.abc import Sequence
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Scene, design, show
from drt_jax.design import Operand, Vary
from drt_jax.design.operands import OperandName
from drt_jax.files.load import System

from . import _command, _common, _plots, _searches
from ._common import not_empty, require, within
from ._searches import Starts
from .runs.folder import Run

COLUMNS = ("merit", "worst", "jacobians")
# Results of many starts that are written; a start is good if its spots are at most this many times
# the best ones.
_KEPT, _GOOD = ("count", "passed", "scores", "trials", "seconds", "compile_s"), (1.1, 1.5, 2.0)


@dataclasses.dataclass(frozen=True)
class Keep:
    """An operand whose value each configuration keeps.

    kind: an operand that needs no rays; "magnification" is for near objects only.
    per_cent: allowed change of its value.
    values: one value for each configuration; empty for the values of the file.
    """

    kind: OperandName
    per_cent: Annotated[float, within(1e-6, 1e3)] = 1.0
    values: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment.

    lens: a `.zmx` or `.seq` file with several configurations, fields and wavelengths.
    moving: variables with a value for each configuration.
    shared: variables that all configurations share.
    operands: operands of each configuration.
    keep: operands whose value each configuration keeps.
    weights: weights of the squares of each configuration; empty for equal weights.
    order: order of the pupil rule.
    tolerance: relative error of the spots.
    trials: largest number of trials of a search.
    starts: number of starts; if it is above 1, the best of the searches is continued.
    """

    lens: str = "configs/design/lenses/us5568323.zmx"
    moving: Annotated[tuple[Vary, ...], not_empty] = (Vary("sensor"),)
    shared: tuple[Vary, ...] = (Vary("curvature"),)
    operands: Annotated[tuple[Operand, ...], not_empty] = (Operand("spot"),)
    keep: tuple[Keep, ...] = ()
    weights: tuple[float, ...] = ()
    order: Annotated[int, within(1, 40)] = 4
    tolerance: Annotated[float, within(1e-12, 0.5)] = 1e-3
    trials: Annotated[int, within(1, 1e5)] = 600
    starts: Starts = Starts()


def problem_of(
    config: Config, system: System, vary: tuple[Vary, ...], number: int = 0
) -> design.Problem:
    """The problem of one configuration.

    A solve of its stop keeps the f-number. The values of `keep` become limits about the values of
    the settings, or about those at the start; a magnification is left out for an object at
    infinity. number: of the configuration, from 0.
    """
    wave = float(system.wavelengths[system.primary])
    solve = design.Solve("f_number", distance=system.distance, wavelengths=(wave,))
    lens = design.open_apertures(system.lens)
    variables, kept = design.Variables.from_lens(lens, vary, solves=[solve]), []
    far = math.isinf(system.distance)
    for keep in (keep for keep in config.keep if not (far and keep.kind == "magnification")):
        alone = design.Problem.from_variables(variables, [keep.kind], system.scene)
        (value,) = np.asarray(alone.evaluate(variables.start).residuals).tolist()
        value = keep.values[number] if keep.values else value
        most = 0.01 * keep.per_cent * abs(value)
        kept.append(Operand(keep.kind, low=value - most, high=value + most))
    operands = (*config.operands, *kept)
    return design.Problem.from_variables(variables, operands, system.scene, config.order)


def zoom_of(
    config: Config, systems: list[System], shared: tuple[Vary, ...]
) -> design.Configurations:
    """The problem of all configurations."""
    vary = (*config.moving, *shared)
    problems = [problem_of(config, system, vary, k) for k, system in enumerate(systems)]
    lens = problems[0].variables.lens
    own = [str(place) for vary in config.moving for place in vary.places(lens)]
    return design.Configurations.from_problems(problems, own, config.weights or None)


def searched(
    config: Config, zoom: design.Configurations, run: Run, job: str, vector: Any = None
) -> dict[str, Any]:
    """Result of a search from `vector`, or from the start if it is None: vector, merits, limit and
    time."""
    begun = time.perf_counter()
    found = design.optimise(zoom, vector, max_steps=config.trials)
    run.log(job, 0, dict(zip(COLUMNS, found.history.T)))
    return {
        "vector": found.vector.tolist(),
        "merits": zoom.merits(jnp.asarray(found.vector)).tolist(),
        "ended": found.ended,
        "worst": str(found.worst_limit or ""),
        "jacobians": found.jacobians,
        "seconds": found.seconds,
        "compile_s": time.perf_counter() - begun - found.seconds,
    }


def focusing(systems: list[System], lenses: Sequence[drt_jax.Lens]) -> design.Focusing:
    """Magnification; and breathing at the image of the largest field of the first configuration."""
    scene, wave = systems[0].scene, systems[0].wavelengths[systems[0].primary]
    point = dataclasses.replace(scene.at(scene.field[-1]), wavelengths=jnp.array([wave]))
    point = dataclasses.replace(point, wavelength_weights=None)
    height = drt_jax.image_point(lenses[0], point)[0, 1]
    return design.focusing(lenses, [system.distance for system in systems], height, float(wave))


def run(config: Config, run: Run) -> dict[str, Any]:
    """Optimises the moving variables, then all, and writes the lens of each configuration.

    With many starts, the best of their searches replaces the search of the moving variables. Each
    search is a job whose result is stored, so that a run can be resumed after it.
    """
    first = drt_jax.load_system(config.lens, configuration=1)
    count = range(1, first.configurations + 1)
    systems = [drt_jax.load_system(config.lens, configuration=k) for k in count]
    require(len(systems) > 1, f"lens: {config.lens} has one configuration; give several")
    for keep in config.keep:
        fits = len(keep.values) in (0, len(systems))
        require(fits, f"keep: {keep.kind}: values: give one for each of {len(systems)}, or none")
    zoom, ends = zoom_of(config, systems, config.shared), {}
    begin = best = zoom.variables.start
    many: dict[str, Any] = {}
    if config.starts.count > 1:
        many = run.once("starts", lambda: _searches.searched(zoom, config.starts))
        best = jnp.asarray(many["vectors"][0])
        middle = {"starts": zoom.merits(best).tolist()}
    else:
        moved = zoom_of(config, systems, ())
        ends["moved"] = run.once("moved", lambda: searched(config, moved, run, "moved"))
        middle = {"moved": ends["moved"]["merits"]}
    ends["designed"] = run.once("designed", lambda: searched(config, zoom, run, "designed", best))
    end = zoom.fitted(ends["designed"]["vector"], margin=1e-3)
    lenses = {"start": [system.lens for system in systems], "designed": end}
    rows: list[dict[str, Any]] = [{"configuration": k} for k in count]
    merits = {"start": zoom.merits(begin).tolist(), **middle, "end": ends["designed"]["merits"]}
    for name, values in merits.items():
        for row, value in zip(rows, values, strict=True):
            row[f"merit_{name}"] = value
    for name, some in lenses.items():
        for row, system, lens in zip(rows, systems, some, strict=True):
            drt_jax.save_lens(lens, run.folder / f"{name}_{row['configuration']}.yaml")
            row[f"spots_um_{name}"] = _common.spots_um(lens, system.scene, config.tolerance)
            wave = system.wavelengths[system.primary :][:1]
            focal = drt_jax.first_order(lens, system.distance, wave).effective_focal_length
            row[f"focal_mm_{name}"] = float(focal[0])
    if not all(math.isinf(system.distance) for system in systems):
        for name, some in lenses.items():
            seen = focusing(systems, some)
            for row, *both in zip(rows, seen.magnification, seen.breathing, strict=True):
                row[f"magnification_{name}"], row[f"breathing_{name}"] = map(float, both)
    for row, system in zip(rows, systems, strict=True):
        far = system.distance
        row["fields_deg"] = np.degrees(np.asarray(system.scene.field)[:, 1]).tolist()
        row["distance_mm"] = far if math.isfinite(far) else None
    searches = {name: {k: v for k, v in end.items() if k != "vector"} for name, end in ends.items()}
    waves = {"wavelengths_um": first.wavelengths.tolist()}
    found = {"starts": {key: many[key] for key in _KEPT}} if many else {}
    return {"rows": rows, "searches": searches, **found, **waves, "lens": config.lens}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Merit and spots of each configuration before and after, and the searches."""
    first = {"configuration": "configuration", "focal_mm_designed": "focal length, mm"}
    if "magnification_designed" in results["rows"][0]:
        first |= {"magnification_designed": "magnification", "breathing_designed": "breathing"}
    starts = results.get("starts")
    between = f"best of {starts['count']} starts" if starts else "gaps alone"
    header = [*first.values(), "merit, mm^2, of the file", between, "all"]
    header += ["RMS um, of the file", "all"]
    rows = []
    for row in results["rows"]:
        merits = (row[f"merit_{k}"] for k in ("start", "starts" if starts else "moved", "end"))
        both = row["spots_um_start"], row["spots_um_designed"]
        spots = (", ".join(f"{um:.1f}" for um in some) for some in both)
        rows.append([*(row[key] + 0 for key in first), *merits, *spots])  # no -0
    keys = ("ended", "jacobians", "seconds", "compile_s", "worst")
    searches = [[name, *map(end.get, keys)] for name, end in results["searches"].items()]
    titles = ["search", "ended", "Jacobians", "seconds", "compilation, s", "the nearest limit"]
    name = pathlib.Path(results["lens"]).stem + (f", {starts['count']} starts" if starts else "")
    found = {
        f"zoom, {name}": _common.table(header, rows),
        f"zoom, {name}: searches": _common.table(titles, searches),
    }
    if starts:
        sizes = _sizes(results)
        good = [int(np.sum(sizes <= factor * sizes[0])) for factor in _GOOD]
        rows = [["that pass light", starts["passed"]]]
        rows += [[f"spots within {f:g} times the best", n] for f, n in zip(_GOOD, good)]
        rows += [["trials of all", starts["trials"]], ["seconds", starts["seconds"]]]
        rows += [["compilation, s", starts["compile_s"]]]
        title = f"{starts['count']} starts", ""
        found[f"zoom, {name}: ends"] = _common.table(title, rows)
    return found


def _sizes(results: dict[str, Any]) -> np.ndarray:
    """RMS spots over all fields of all configurations, um, the smallest first, of the starts at
    which rays pass. They follow from the scores."""
    count = sum(len(row["fields_deg"]) for row in results["rows"])
    scores = [score for score in results["starts"]["scores"] if score is not None]
    return 1e3 * np.sqrt(np.sort(scores) / count)


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws start and end in all configurations, side by side at one scale, with the sensors
    aligned."""
    panels = [(row, name) for row in results["rows"] for name in ("start", "designed")]
    lenses, scenes, waves = [], [], results["wavelengths_um"]
    for row, name in panels:
        lenses.append(drt_jax.load_lens(figures.parent / f"{name}_{row['configuration']}.yaml"))
        scenes.append(Scene.degrees(row["fields_deg"], row["distance_mm"] or math.inf, waves))
    with _plots.picture(figures / "zoom.png", 5.8, 2.5, len(panels), 2) as axes:
        for ax, (row, name) in zip(show.configurations(axes, lenses, scenes), panels):
            spot = math.hypot(*row[f"spots_um_{name}"]) / math.sqrt(len(row["fields_deg"]))
            focal = row[f"focal_mm_{name}"]
            ax.set_title(f"{name}, f = {focal:.1f} mm, spots {spot:.1f} um", fontsize=9)
    if results.get("starts"):
        with _plots.picture(figures / "starts.png", 6, 3.4) as (ax,):
            sizes = _sizes(results)
            ax.semilogy(np.arange(1, len(sizes) + 1), sizes, "o", markersize=3)
            _plots.label_axes(ax, "start, the best first", "RMS spot of all positions (um)")
            ax.grid(alpha=0.3, which="both")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
