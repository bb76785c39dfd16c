"""Time that each skip saves: the same result with it and without it, in turns, and both errors.

Each row is one skip. Its two ways differ in a value that is passed, see `_skips`. `rows` have
`group`, `skip`, `error_of`, `factor` (time without / with) and `ways`, of which the first is that
with the skip: `words`, `quartiles_s`, `rays` traced in a call, `compile_s`, `error`, and `once_s`,
the time of the preparation before the first call. The reference is a trace by Snell's law, exact
sums or very many rays. Draws the factors and the errors.
"""

import dataclasses
import math
import pathlib
import sys
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np

from drt_jax import show

from . import _command, _common, _plots, _skips, _skips_pictures
from ._common import Wavelengths, near_and_far, within
from .runs.folder import Run


class Skip(NamedTuple):
    """A row.

    group: name of a group of rows.
    name: what is skipped.
    ways: function of the settings that returns the `_skips.Way` with the skip and that without.
    error_of: quantity to which errors are relative.
    """

    group: str
    name: str
    ways: Callable[[Any], list[_skips.Way]]
    error_of: str = "spot radius"


_DEPTH = "sensor and depth"
SKIPS = {
    "rotational": Skip("rays", "rotational symmetry", partial(_skips.symmetry, on_axis=True)),
    "bilateral": Skip("rays", "bilateral symmetry", partial(_skips.symmetry, on_axis=False)),
    "order": Skip("rays", "order from the error", _skips.order),
    "anew": Skip("rays", "order found in each call", _skips.found_anew),
    "quadrature": Skip("rays", "quadrature, not random rays", _skips.quadrature),
    "dead": Skip("rays", "dead surfaces", _skips.dead),
    "aiming": Skip("rays", "aiming, no search", _skips.aimed),
    "reverse": Skip("derivatives", "one derivative, reverse", _skips.reverse, "derivative"),
    "forward": Skip("derivatives", "one derivative, forward", _skips.forward, "derivative"),
    "sensor": Skip(_DEPTH, "polynomials of the sensor", _skips.sensors),
    "depth": Skip(_DEPTH, "Chebyshev nodes of depth", _skips.depths),
    "separable": Skip("pictures", "separable kernels", _skips_pictures.separable, "white"),
    "polynomials": Skip("pictures", "polynomials, not rays", _skips_pictures.polynomials, "light"),
    "kernels": Skip("pictures", "few kernels for all pixels", _skips_pictures.few_kernels, "light"),
    "kept": Skip("programs", "programs kept", _skips_pictures.kept),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/skips.yaml.

    lens: a centred lens with circular apertures.
    field_deg: field of all rows except the first.
    depths_m: nearest and farthest object of the row on depth.
    to: relative error of spot radii, from which orders follow.
    kernels_to: error of kernels, the sum over the pixels.
    generous: order of a rule that is not fitted to the lens.
    random: number of random rays. rays: number of rays of a histogram.
    planes: number of dead planes that are added.
    picture: pixels along the side of the small picture.
    nodes: number of nodes of its kernels, from the axis to the largest field.
    rows: names of the rows to run; empty for all.
    """

    lens: str = "double_gauss"
    distance_m: Annotated[float, within(1e-3, math.inf)] = 25.0
    field_deg: Annotated[float, within(0.1, 89.9)] = 10.0
    depths_m: Annotated[tuple[float, ...], near_and_far] = (10.0, 50.0)
    wavelengths_um: Wavelengths = (0.6, 0.53, 0.48)
    to: Annotated[float, within(1e-12, 0.1)] = 1e-6
    kernels_to: Annotated[float, within(1e-4, 1)] = 1e-2
    generous: Annotated[int, within(2, 40)] = 20
    random: Annotated[int, within(16, 1e6)] = 16384
    rays: Annotated[int, within(16, 1e6)] = 4096
    planes: Annotated[int, within(0, 100)] = 6
    picture: Annotated[int, within(2, 128)] = 24
    nodes: Annotated[int, within(2, 64)] = 8
    repeats: Annotated[int, within(1, 1e4)] = 15
    rows: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _common.require_known("rows", self.rows, SKIPS)


def measure(config: Config, skip: Skip) -> dict[str, Any]:
    """The row of a skip."""
    ways = skip.ways(config)
    if all(way.call for way in ways):
        times = _common.quartiles([way.call for way in ways], config.repeats)
    else:
        times = [[way.seconds] * 3 for way in ways]
    names = "words", "rays", "compile_s", "error", "once_s"
    found = [
        {name: getattr(way, name) for name in names} | {"quartiles_s": time}
        for way, time in zip(ways, times)
    ]
    row = {"group": skip.group, "skip": skip.name, "error_of": skip.error_of, "ways": found}
    return row | {"factor": times[1][1] / times[0][1]}


def run(config: Config, run: Run) -> dict[str, Any]:
    """Measures row after row."""
    # Programs saved by another run would hide the time of compilation.
    jax.config.update("jax_enable_compilation_cache", False)
    chosen = {name: SKIPS[name] for name in config.rows or SKIPS}
    jobs = {name: partial(measure, config, skip) for name, skip in chosen.items()}
    return {"rows": _common.measured(run, "skip", jobs), "seconds": run.seconds}


def _times(factor: float) -> str:
    """A factor as text, two digits or more."""
    return f"{factor:.0f}" if factor >= 10 else f"{factor:.2g}"


def tables(results: dict[str, Any]) -> dict[str, str]:
    """A table with two lines for each row: with the skip, and without it."""
    lines: list[tuple] = []
    for (group,), rows in _common.grouped(results["rows"], "group").items():
        lines.append((f"**{group}**", *[""] * 7))
        for row in rows:
            firsts = row["skip"], f"error: of the {row['error_of']}"
            for first, way, factor in zip(firsts, row["ways"], (_times(row["factor"]), "1")):
                seconds = _common.duration(way["quartiles_s"][1])
                once = _common.duration(way["once_s"])
                compiling = _common.duration(way["compile_s"])
                error = f"{way['error']:.0e}"
                what = first, way["words"], seconds, factor, way["rays"]
                lines.append((*what, once, compiling, error))
    header = "skip", "call", "time", "saved", "rays", "once", "compile", "error"
    machine = [(_common.one_machine(results),)]
    return {
        "skips, machine": _common.table(("machine of this run",), machine),
        "skips": _common.table(header, lines),
    }


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws bars of the factors, the largest first, and next to them the errors of both ways."""
    rows = sorted(results["rows"], key=lambda row: row["factor"])
    places = np.arange(len(rows))
    figure, (left, right) = show.new(1, 2, 5.6, 0.36 * len(rows) + 1.3)
    right.sharey(left)
    colours = ["C0" if row["factor"] > 1 else "0.6" for row in rows]
    left.barh(places, [row["factor"] - 1 for row in rows], 0.6, 1, color=colours)
    left.axvline(1, color="black", linewidth=1)
    for place, row in zip(places, rows):
        new, old = (_common.duration(way["quartiles_s"][1]) for way in row["ways"])
        note = f"  {_times(row['factor'])} x: {old} to {new}"
        left.text(max(row["factor"], 1), place, note, va="center", fontsize=8)
    errors = np.array([[max(way["error"], 1e-16) for way in row["ways"]] for row in rows])
    right.hlines(places, errors.min(axis=1), errors.max(axis=1), color="0.7", linewidth=1, zorder=1)
    right.plot(errors[:, 1], places, "o", color="C1", mfc="white", markersize=7, label="without")
    right.plot(errors[:, 0], places, "o", color="C0", markersize=4, label="with the skip")
    left.set_yticks(places, [row["skip"] for row in rows])
    least, most = rows[0]["factor"], rows[-1]["factor"]
    left.set(xscale="log", xlim=(0.6 * min(least, 0.5), 150 * max(most, 1)))
    left.set(title="Time of a call without the skip / with it")
    right.set(xscale="log")
    right.tick_params(labelleft=False)
    units = right.secondary_yaxis("right")
    units.set_yticks(places, [f"of the {row['error_of']}" for row in rows], fontsize=8)
    units.tick_params(length=0)
    _plots.label_axes(left, "times as fast", "", "x")
    above = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "title": "Error"}
    _plots.label_axes(right, "relative error", "", "x", ncols=2, **above)
    figure.savefig(figures / "skips.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
