"""Section 6.1 of the paper: focus a lens by gradient descent through the sensor layer alone.

Several starting positions of the sensor are trained together, without a network. No ray is
traced in the loop: the moments are polynomials in the sensor position. Draws the lens and
figures 4a and 4b.
"""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import show
from drt_jax.image.sensor import convolve_taps
from drt_jax.learn import train
from drt_jax.learn.data import DataConfig
from drt_jax.runs.folder import Run

from . import _command, _common, _training
from ._training import Scene, Training


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/focus.yaml."""

    starts_mm: tuple[float, ...]
    train: Training
    distance_m: float = 25.0
    noise: float = 0.01
    seed: int = 0
    scene: Scene = Scene()
    camera: train.Camera = train.Camera()
    data: DataConfig = DataConfig()

    def __post_init__(self) -> None:
        _common.require_list("starts_mm", self.starts_mm)
        _common.require_list("distance_m", (self.distance_m,))
        _common.require_noise("noise", self.noise)


def best_focus(loss: Callable, scenes: np.ndarray, low: float, high: float) -> float:
    """Sensor position between `low` and `high` mm of least `loss` (sensor, scenes), in mm: a dense
    search, then a parabola at its minimum."""
    losses = jax.jit(lambda grid, scenes: jax.lax.map(lambda s: loss(s, scenes), grid))
    batch = min(32, len(scenes))
    for _ in range(3):
        grid = np.linspace(low, high, 41)
        step = grid[1] - grid[0]
        total = sum(
            np.asarray(losses(jnp.asarray(grid), scenes[i : i + batch]), float)
            for i in range(0, len(scenes) - batch + 1, batch)
        )
        k = int(np.clip(np.argmin(total), 1, len(grid) - 2))
        low, high = grid[k] - 2 * step, grid[k] + 2 * step
    left, middle, right = total[k - 1 : k + 2]
    return float(grid[k] + step * (left - right) / (2 * (left - 2 * middle + right)))


def run(config: Config, run: Run) -> dict[str, Any]:
    """Train all starts together, and find the best focus independently."""
    lens = drt_jax.load_lens(config.scene.lens)
    distance = 1e3 * config.distance_m
    blur = config.scene.blur(lens, distance, distance)
    imager = train.make_imager(blur, None, config.camera, convolve_taps)
    patches = _training.patches(config)
    rates, depths = {"optics": config.train.optics_rate}, (distance, distance)
    functions = train.make_step(imager, rates, depths, config.seed, vectorised=True)
    labels = tuple(map(_training.start_label, config.starts_mm))
    starts = {"optics": {"sensor": jnp.asarray(config.starts_mm)}}
    scenes = patches.train
    _training.train_job(run, "all starts", functions, starts, scenes, config.noise, config, labels)
    results = _training.start_results(run, config, ("sensor_mm", "sigma_um"))

    def loss(sensor, scenes):
        key, noise = jax.random.key(0), np.float32(config.noise)
        truth, image, _, _ = imager({"optics": {"sensor": sensor}}, scenes, distance, noise, key)
        return jnp.mean(jnp.abs(image - truth))

    every = *config.starts_mm, *results["final_mm"]
    best = best_focus(loss, _training.thinned(scenes, 512), min(every), max(every))
    near = [np.flatnonzero(np.abs(trace - best) <= 0.1) for trace in results["sensor_mm"]]
    first = [int(hits[0]) if hits.size else None for hits in near]
    return results | {"best_focus_mm": best, "batches_to_focus": first, "distance_mm": distance}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Beside the paper, and each start."""
    best = f"{results['best_focus_mm']:.3f}"
    starts, first = results["starts_mm"], results["batches_to_focus"]
    beside = [
        (
            "plane that all starts reach",
            "133.35 mm",
            f"{_training.reached(results)} (dense search on the same loss: {best})",
        ),
        (
            f"batches until within 0.1 mm, starts {', '.join(f'{s:g}' for s in starts)} mm",
            '"within the first 60"',
            ", ".join(map(str, first)),
        ),
        ("training of all starts", "", _common.duration(results["seconds"])),
    ]
    return {"focus": _common.table(("", "paper", "here"), beside)}


def report(results: dict[str, Any], figures: pathlib.Path) -> str:
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
    return tables(results)["focus"]


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    _command.main("focus", Config, ("loss", "sensor_mm", "sigma_um"), run, report, argv)


if __name__ == "__main__":
    main()
