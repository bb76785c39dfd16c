"""Add elements to a lens one by one: thin meniscuses at every surface, least squares from each.

The lens is optimised. Then a thin meniscus is inserted at each surface of each of the best lenses,
and least squares descend in both directions from this saddle point (`drt_jax.design.insertions`).
The best lenses continue with the next element; the best of all gets real glasses, if makers are
given. Writes the lenses as ADDED_RANK.yaml and designed.yaml, and results.json: `rows`, one for
each different lens, with `elements`, `form` (signs of the powers of the elements, S for the stop),
`merit`, `spots_um` of the fields, and `at`, `front`, `way` of the meniscus.
"""

import dataclasses
import functools
import pathlib
import sys
import time
from typing import Annotated, Any

import numpy as np

import drt_jax
from drt_jax import Scene, design, show

from . import _command, _common, _plots
from ._common import within
from .design import Config as Design, problem_of, snapped
from .runs.folder import Run

COLUMNS = ("merit",)
_SAME = 0.01  # lenses whose merits differ relatively by less count as the same lens
_DRAWN = 6  # largest number of lenses that are drawn, of those with most elements


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/elements.yaml.

    design: the lens and its problem as in experiments.design, without starts and growth. Variables
        and operands must not name surfaces, because the numbers of surfaces change.
    elements: number of elements that are added.
    keep: number of best lenses that get one more element.
    thickness_mm: thickness of a meniscus at the start, and its distance from the surface.
    bend: change of its curvature at the start, relative to the largest curvature of the lens.
    """

    design: Design
    elements: Annotated[int, within(1, 20)] = 2
    keep: Annotated[int, within(1, 100)] = 2
    thickness_mm: Annotated[float, within(1e-5, 100)] = 0.05
    bend: Annotated[float, within(1e-4, 10)] = 0.05

    def __post_init__(self) -> None:
        problem = self.design
        named = [vary.kind for vary in problem.variables if vary.surfaces]
        named += [operand.kind for operand in problem.operands if operand.surfaces]
        named += [solve.kind for solve in problem.solves]
        what = f"design: {', '.join(named)} names surfaces, whose numbers change"
        _common.require(not named, f"{what}: leave them out")


def form_of(lens: drt_jax.Lens, wavelength: float) -> str:
    """Signs of the powers of the elements in air, and the stop: "+-S+"."""
    index = np.asarray(lens.index(wavelength))[:, 0]
    power, form = np.diff(index) * np.asarray(lens.curvature)[:-1], ""
    for i in range(lens.count):
        form += "S" if i == lens.stop else ""
        if index[i + 1] > 1.01:
            reduced = float(lens.thickness[i]) / index[i + 1]
            own = power[i] + power[i + 1] - power[i] * power[i + 1] * reduced
            form += "+" if own > 0 else "-"
    return form


class _Search:
    """State that all numbers of elements share."""

    def __init__(self, config: Config, run: Run) -> None:
        self.config, self.folder = config, run.folder
        waves = config.design.wavelengths_um
        self.wave = waves[len(waves) // 2]
        self.problem = functools.partial(problem_of, config.design)

    def kept(self, elements: int, rank: int) -> drt_jax.Lens:
        """A lens that was saved."""
        return design.open_apertures(drt_jax.load_lens(self.folder / f"{elements}_{rank}.yaml"))

    def told(
        self, name: str, problem: design.Problem, best: design.Optimum, place: dict[str, Any]
    ) -> dict[str, Any]:
        """Saves a lens, and returns its row."""
        lens, of = best.lens, self.config.design
        drt_jax.save_lens(design.fit_apertures(problem, lens), self.folder / f"{name}.yaml")
        form = form_of(lens, self.wave)
        return {
            "file": name,
            "elements": sum(sign != "S" for sign in form),
            "form": form,
            "merit": best.merit,
            "worst_limit": best.max_violation,
            "spots_um": _common.spots_um(lens, of.scene, of.tolerance),
            **place,
        }

    def start(self) -> list[dict[str, Any]]:
        """Row of the lens itself, optimised."""
        lens = design.open_apertures(self.config.design.load())
        problem = self.problem(lens)
        best = design.optimise(problem, problem.variables.start, self.config.design.trials)
        return [self.told("0_0", problem, best, {})]

    def level(self, added: int, before: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Rows of all different lenses with one more element, the best first."""
        config, found = self.config, list[design.Insertion]()
        given = None, config.thickness_mm, config.bend, config.design.trials
        for rank in range(len(before[: config.keep])):
            for one in design.insertions(self.kept(added - 1, rank), self.problem, *given):
                found.append(one)
                side = "in front of" if one.front else "behind"
                merit = f"merit {one.optimum.merit:.4g}, limits {one.optimum.max_violation:.1g}"
                print(f"{added}: {side} surface {one.at}, {one.way:+d}: {merit}", flush=True)
        found.sort(key=lambda one: one.optimum.score)
        different: list[design.Insertion] = []
        for one in found:
            own = one.optimum.score
            if not different or own > (1 + _SAME) * different[-1].optimum.score:
                different.append(one)
        rows = []
        for rank, one in enumerate(different):
            place = {"at": one.at, "front": one.front, "way": one.way}
            rows.append(self.told(f"{added}_{rank}", one.problem, one.optimum, place))
        return rows

    def real(self, added: int) -> list[dict[str, Any]]:
        """Row of the best lens, with real glasses if makers are named; saved as designed.yaml."""
        lens = self.kept(added, 0)
        problem = self.problem(lens)
        best = design.optimise(problem, problem.variables.start, self.config.design.trials)
        best, _ = snapped(self.config.design, problem, best)
        names = {"glasses": [glass for glass in best.lens.glasses if glass != "air"]}
        return [self.told("designed", problem, best, names)]


def run(config: Config, run: Run) -> dict[str, Any]:
    """Optimises the lens, adds elements, and writes the lenses."""
    search, begun = _Search(config, run), time.perf_counter()
    levels = [run.once("start", search.start)]
    for added in range(1, config.elements + 1):
        make = functools.partial(search.level, added, levels[-1])
        levels.append(run.once(f"{added} more", make))
        run.log("elements", added, {"merit": np.array([levels[-1][0]["merit"]])})
    rows = [row for level in levels for row in level]
    rows += run.once("designed", functools.partial(search.real, config.elements))
    return {
        "rows": rows,
        "seconds": time.perf_counter() - begun,
        **_common.settings(config.design, "name", "fields_deg", "wavelengths_um"),
    }


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Tables of the best lens for each number of elements, and of all forms with most elements."""
    header = ["elements", "form", "merit, mm^2", "spots, um", "worst limit exceeded by", "lenses"]
    lines = []
    *rows, last = results["rows"]
    for (count,), own in _common.grouped(rows, "elements").items():
        lines.append([count, *_cells(own[0]), len(own)])
    lines.append([f"{last['elements']}, {', '.join(last['glasses'])}", *_cells(last), 1])
    forms = [[row["form"], *_cells(row)[1:]] for row in own]
    name = results["name"]
    return {
        f"elements, {name}": _common.table(header, lines),
        f"elements, {name}: forms": _common.table(header[1:-1], forms),
    }


def _cells(row: dict[str, Any]) -> list[Any]:
    spots = ", ".join(f"{spot:.3g}" for spot in row["spots_um"])
    return [row["form"], row["merit"], spots, row["worst_limit"]]


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the best lens for each number of elements, and all forms with most elements."""
    *rows, last = results["rows"]
    groups = [own for own in _common.grouped(rows, "elements").values()]
    scene = Scene.degrees(results["fields_deg"], np.inf, results["wavelengths_um"][:1])
    sets = {"elements": [own[0] for own in groups] + [last], "forms": groups[-1][:_DRAWN]}
    for name, shown in sets.items():
        with _plots.picture(figures / f"{name}.png", 4.5, 2, len(shown), columns=3) as axes:
            for ax, row in zip(axes, shown):
                lens = drt_jax.load_lens(figures.parent / f"{row['file']}.yaml")
                show.lens_drawing(ax, show.draw(lens, scene)).get_legend().remove()
                ax.set_title(f"{row['form']}   {row['merit']:.3g} mm$^2$", fontsize=9)


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
