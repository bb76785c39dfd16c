"""Section 6.1 of the paper: focus a lens by gradient descent through the sensor layer alone.

Several starting positions of the sensor are trained together, without a network. No ray is
traced in the loop: the moments are polynomials in the sensor position. Draws the lens and
figures 4a and 4b.
"""

import dataclasses
import pathlib
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drt_jax import show
from drt_jax.image.sensor import convolve_taps
from drt_jax.runs.folder import Run

from . import _command, _common, _training

COLUMNS = ("loss", "sensor_mm", "sigma_um")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(_training.Settings):
    """Settings of the experiment; see configs/focus.yaml."""

    distance_m: float = 25.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _common.require_list("distance_m", (self.distance_m,))


def best_focus(loss: Callable, scenes: np.ndarray, low: float, high: float) -> float:
    """Sensor position between `low` and `high` mm of least `loss` (sensor, scenes), to a ten
    thousandth of the interval: a dense search, four times."""
    losses = jax.jit(lambda grid, scenes: jax.lax.map(lambda s: loss(s, scenes), grid))
    batch = min(32, len(scenes))
    parts = [scenes[i : i + batch] for i in range(0, len(scenes) - batch + 1, batch)]
    for _ in range(4):
        grid = np.linspace(low, high, 41)
        k = np.argmin(sum(np.asarray(losses(jnp.asarray(grid), part), float) for part in parts))
        best, low, high = grid[k], grid[max(k - 2, 0)], grid[min(k + 2, 40)]
    return float(best)


def run(config: Config, run: Run) -> dict[str, Any]:
    """Train all starts together, and find the best focus independently."""
    distance = 1e3 * config.distance_m
    jobs = _training.Jobs(run, config, distance, distance)
    blur = config.scene.blur(distance, distance)
    imager, steps = jobs.steps(blur, several=True, convolve=convolve_taps)
    labels = tuple(map(_training.start_label, config.starts_mm))
    starts = {"sensor": jnp.asarray(config.starts_mm)}
    jobs.train("all starts", steps, starts, config.noise, labels)
    results = jobs.results("sensor_mm", "sigma_um")

    def loss(sensor, scenes):
        key, noise = jax.random.key(0), np.float32(config.noise)
        truth, image, _, _ = imager({"optics": {"sensor": sensor}}, scenes, distance, noise, key)
        return jnp.mean(jnp.abs(image - truth))

    every = *config.starts_mm, *results["final_mm"]
    best = best_focus(loss, _training.thinned(jobs.scenes, 512), min(every), max(every))
    near = [np.flatnonzero(np.abs(trace - best) <= 0.1) for trace in results["sensor_mm"]]
    first = [int(hits[0]) if hits.size else None for hits in near]
    return results | {"best_focus_mm": best, "batches_to_focus": first, "distance_mm": distance}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Beside the paper, and each start."""
    search = f" (dense search on the same loss: {results['best_focus_mm']:.3f})"
    starts = ", ".join(f"{start:g}" for start in results["starts_mm"])
    first = ", ".join(map(str, results["batches_to_focus"]))
    beside = [
        ("plane that all starts reach", "133.35 mm", _training.reached(results) + search),
        (f"batches until within 0.1 mm, starts {starts} mm", '"within the first 60"', first),
        ("training of all starts", "", _common.duration(results["seconds"])),
    ]
    return {"focus": _common.table(("", "paper", "here"), beside)}


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draw the lens and figures 4a and 4b."""
    _training.draw_lens(results["lens"], results["distance_mm"], figures / "lens.png")
    best = results["best_focus_mm"]
    for name, column, label, level in (
        ("figure_4a", "sensor_mm", "sensor position (mm)", (best, f"best focus {best:.2f}")),
        ("figure_4b", "sigma_um", "mean blur of R, G, B, σ (µm)", None),
    ):
        figure, (left, right) = show.new(1, 2, 5.5, 4)
        show.convergence(left, _training.start_lines(results, column), label, level)
        show.convergence(right, _training.start_lines(results, column, 100), label, level)
        right.set_title("the first 100 batches", fontsize=9)
        figure.savefig(figures / f"{name}.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
