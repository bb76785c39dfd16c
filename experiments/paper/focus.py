"""Section 6.1 of the paper: focus a lens by gradient descent through the sensor layer alone.

Several starting positions of the sensor are trained together, without a network. If only the
sensor is trained, the loop traces no rays, because the moments are polynomials in the sensor
position. Draws the lens and figures 4a and 4b.

train.variables: sensor, curvature, conic, coefficients, thickness; for all surfaces or, as in
"curvature 0", for one. scene.field: degrees along y, or [x, y].
"""

import dataclasses
import math
import pathlib
import sys
from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from drt_jax.image.sensor import convolve_taps

from . import _command, _common, _plots, _report, _settings, _training
from .runs.folder import Run

COLUMNS = ("loss", "sensor_mm", "sigma_um")
# Bound of the relative rounding error of a mean of many numbers in float32.
_ROUNDING = 1e-5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(_settings.Settings):
    """Settings of the experiment; see configs/focus.yaml."""

    distance_m: Annotated[float, _common.within(1e-3, 1e9)] = 25.0


def best_focus(loss: Callable, scenes: np.ndarray, low: float, high: float) -> float:
    """Sensor position of the smallest `loss` (sensor, scenes) between `low` and `high`, mm, by four
    dense searches, with an error of a ten thousandth of the interval. NaN if there is no minimum
    inside: if the loss is smallest at an end, up to rounding, or is not finite somewhere."""
    losses = jax.jit(lambda grid, scenes: jax.lax.map(lambda s: loss(s, scenes), grid))
    batch = min(32, len(scenes))
    parts = [scenes[i : i + batch] for i in range(0, len(scenes) - batch + 1, batch)]
    for turn in range(4):
        grid = np.linspace(low, high, 41)
        found = sum(np.asarray(losses(jnp.asarray(grid), part), float) for part in parts)
        k = np.argmin(found)  # the index of a NaN if there is one
        if not turn and not found[k] < (1 - _ROUNDING) * np.min(found[[0, -1]]):
            return math.nan
        best, low, high = grid[k], grid[max(k - 2, 0)], grid[min(k + 2, 40)]
    return float(best)


def run(config: Config, run: Run) -> dict[str, Any]:
    """Trains all starts together, and finds the best focus independently."""
    distance = 1e3 * config.distance_m
    jobs = _training.Jobs(run, config, distance, distance)
    imager, steps = jobs.steps(jobs.blur, several=True, convolve=convolve_taps)
    labels = tuple(map(_report.start_label, config.starts_mm))
    starts = jobs.lens.start(config.starts_mm)
    jobs.train("all starts", steps, starts, config.noise, labels)
    results = jobs.results("sensor_mm", "sigma_um") | {"distance_mm": distance}
    if jobs.lens.names:  # the best focus is that of a fixed lens
        return results

    def loss(sensor, scenes):
        key, noise = jax.random.key(0), np.float32(config.noise)
        truth, image, _, _ = imager({"optics": {"sensor": sensor}}, scenes, distance, noise, key)
        return jnp.mean(jnp.abs(image - truth))

    every = *config.starts_mm, *results["final_mm"]
    low, high = min(every), max(every)
    margin = (high - low) / 2  # all starts may lie on one side
    scenes = _training.thinned(jobs.scenes, 512)
    best = best_focus(loss, scenes, low - margin, high + margin)
    near = [np.flatnonzero(np.abs(trace - best) <= 0.1) for trace in results["sensor_mm"]]
    first = [int(hits[0]) if hits.size else None for hits in near]
    return results | {"best_focus_mm": best, "batches_to_focus": first}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """The comparison with the paper, and the trained numbers."""
    search, firsts = "", []
    if "best_focus_mm" in results:
        best = results["best_focus_mm"]
        found = "no minimum was found" if best is None else f"{best:.3f}"
        search = f" (dense search on the same loss: {found})"
        starts = ", ".join(f"{start:g}" for start in results["starts_mm"])
        first = ", ".join("never" if n is None else str(n) for n in results["batches_to_focus"])
        what = f"batches until within 0.1 mm, starts {starts} mm"
        firsts = [(what, '"within the first 60"', first)]
    took = ("training of all starts", "", _common.duration(results["seconds"]))
    return _report.tables("focus", results, "133.35 mm", [*firsts, took], search)


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the lens and figures 4a, if the sensor is trained, and 4b."""
    _report.draw_lens(results, results["distance_mm"], figures / "lens.png")
    _report.draw_numbers(results, figures)
    best = results.get("best_focus_mm")
    mark = None if best is None else (best, f"best focus {best:.2f}")
    for name, column, label, level in (
        ("figure_4a", "sensor_mm", "sensor position (mm)", mark),
        ("figure_4b", "sigma_um", "mean blur of R, G, B, σ (µm)", None),
    )[not _report.moves(results) :]:
        with _plots.picture(figures / f"{name}.png", 5.5, 4, 2) as axes:
            for ax, batches in zip(axes, (None, 100)):
                lines = _report.start_lines(results, column, batches)
                _plots.curves(ax, lines, "training batch", label, level)
            axes[1].set_title("the first 100 batches", fontsize=9)


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
