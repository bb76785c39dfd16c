"""Effect of temperature on a lens in mounts of several metals.

The lens is focused at 20 C. Writes results.json: `rows` with `mount`, `celsius`, `focal_mm`,
`shift_um` (shift of the sensor that makes the spots smallest), `spots_um` of all fields without
this shift, and `refocused_um` with it.
"""

import dataclasses
import itertools
import math
import pathlib
import sys
from functools import partial
from typing import Annotated, Any

import drt_jax
from drt_jax import Scene, design

from . import _command, _common, _plots
from ._common import LensFile, Numbers, Wavelengths, not_empty, within
from .runs.folder import Run

# Shifts of the sensor at which spots are computed to find the focus, relative to its position.
_STEP = 1e-3


@dataclasses.dataclass(frozen=True)
class Mount:
    """A metal between the elements. expansion: coefficient of thermal expansion, 1e-6/K."""

    name: str
    expansion: Annotated[float, within(-100, 1000)]


@dataclasses.dataclass(frozen=True)
class Config(LensFile):
    """Settings of the experiment.

    lens: a lens whose glasses are all in the table of glasses.
    fields_deg: fields, degrees. distance_mm: distance of the object; .inf for infinity.
    mounts: metals of the mount, each for all air spaces.
    celsius: temperatures.
    order: order of the pupil rule for focusing.
    tolerance: relative error of the spots.
    """

    lens: str = "double_gauss"
    fields_deg: Numbers = (0.0, 10.0, 14.0)
    distance_mm: Annotated[float, within(1e-3, math.inf)] = math.inf
    wavelengths_um: Wavelengths = (0.4861, 0.5876, 0.6563)
    mounts: Annotated[tuple[Mount, ...], not_empty] = (Mount("aluminium", 23.6),)
    celsius: Annotated[Numbers, within(-100, 200)] = (-20.0, 20.0, 60.0)
    order: Annotated[int, within(1, 40)] = 6
    tolerance: Annotated[float, within(1e-12, 0.5)] = 1e-3


def focused(config: Config, lens: drt_jax.Lens, scene: Scene) -> drt_jax.Lens:
    """The lens with its sensor at the smallest mean square of all spots, which is a parabola in the
    position of the sensor."""
    variables = design.Variables.from_lens(lens, ["sensor"])
    problem = design.Problem.from_variables(variables, ["spot"], scene, config.order)
    step = _STEP * lens.sensor / variables.scale
    low, middle, high = (problem.merit(variables.start + sign * step) for sign in (-1, 0, 1))
    move = 0.5 * step * (low - high) / (low - 2 * middle + high)
    return variables.lens_of(variables.start + move)


def row_of(config: Config, lens: drt_jax.Lens, mount: Mount, celsius: float) -> dict[str, Any]:
    """The lens in a mount at a temperature."""
    scene = Scene.degrees(config.fields_deg, config.distance_mm, config.wavelengths_um)
    model = design.ThermalModel.from_lens(lens, mount.expansion)
    hot = design.at_temperature(lens, celsius, model)
    moved = focused(config, hot, scene)
    middle = config.wavelengths_um[len(config.wavelengths_um) // 2]
    spots = {"spots_um": _common.spots_um(hot, scene, config.tolerance)}
    spots["refocused_um"] = _common.spots_um(moved, scene, config.tolerance)
    shift = 1e3 * float(moved.sensor - hot.sensor)
    focal = float(drt_jax.focal_length(hot, middle)[0])
    return {"mount": mount.name, "celsius": celsius, "focal_mm": focal, "shift_um": shift} | spots


def run(config: Config, run: Run) -> dict[str, Any]:
    """Focuses the lens at 20 C, and computes it at all temperatures in all mounts."""
    scene = Scene.degrees(config.fields_deg, config.distance_mm, config.wavelengths_um)
    lens = focused(config, config.load(), scene)
    jobs = {}
    for mount, celsius in itertools.product(config.mounts, config.celsius):
        jobs[f"{mount.name} {celsius:g}"] = partial(row_of, config, lens, mount, celsius)
    return {"rows": _common.measured(run, "lens", jobs), **_common.settings(config, "lens")}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Focus and spots of each mount and temperature."""
    header = ["mount", "C", "focal length, mm", "focus, um", "RMS um, not refocused", "refocused"]
    rows = []
    for row in results["rows"]:
        focus = f"{row['focal_mm']:.3f}", f"{row['shift_um']:.1f}"
        both = row["spots_um"], row["refocused_um"]
        spots = (", ".join(f"{um:.1f}" for um in some) for some in both)
        rows.append([row["mount"], f"{row['celsius']:g}", *focus, *spots])
    return {"temperature": _common.table(header, rows)}


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws focus and spots of each mount over temperature; for the first mount also refocused
    spots."""

    def mean(row: dict[str, Any], key: str) -> float:
        return math.hypot(*row[key]) / math.sqrt(len(row[key]))

    groups = _common.grouped(results["rows"], "mount")
    with _plots.picture(figures / "temperature.png", 4.5, 3.4, 2) as (left, right):
        for (mount,), rows in groups.items():
            celsius = [row["celsius"] for row in rows]
            left.plot(celsius, [row["shift_um"] for row in rows], "o-", markersize=4, label=mount)
            spots = [mean(row, "spots_um") for row in rows]
            right.plot(celsius, spots, "o-", markersize=4, label=mount)
        (mount,), rows = next(iter(groups.items()))
        celsius, spots = zip(*((row["celsius"], mean(row, "refocused_um")) for row in rows))
        right.plot(celsius, spots, "C0--", label=f"{mount}, refocused")
        _plots.label_axes(left, "temperature (C)", "focus (um)")
        _plots.label_axes(right, "temperature (C)", "RMS spot (um)")
        right.set_ylim(0, 1.1 * right.get_ylim()[1])
        right.legend(loc="lower center", fontsize=8)


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
