"""Section 6.1 of the paper: focus a lens by gradient descent through the sensor layer alone.

Several starting positions of the sensor are trained together, without a network. No ray is
traced in the loop: the moments are polynomials in the sensor position. Writes figures 4a and
4b and results.json.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax.show import plot
from drt_jax.learn import train
from drt_jax.learn.data import DataConfig
from drt_jax.runs.folder import Run

from . import _common
from ._common import Scene, Training


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


def best_focus(imager, scenes: np.ndarray, distance: float, noise: float, span: tuple) -> float:
    """Sensor position of least training loss: a dense search, then a parabola at its minimum."""
    key = jax.random.key(0)

    def loss(sensor, scenes):
        truth, image, _, _ = imager(
            {"optics": {"sensor": sensor}}, scenes, distance, np.float32(noise), key
        )
        return jnp.mean(jnp.abs(image - truth))

    losses = jax.jit(lambda grid, scenes: jax.lax.map(lambda s: loss(s, scenes), grid))
    batch = min(32, len(scenes))
    low, high = span
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


def run(config: Config, run: Run) -> None:
    """Train all starts together, find the best focus independently, write the results."""
    lens = drt_jax.load_lens(config.scene.lens)
    distance = 1e3 * config.distance_m
    _, blur = drt_jax.moments_model(
        lens,
        ("sensor",),
        0.0,
        (distance, distance),
        config.scene.wavelengths_um,
        config.scene.tolerance,
    )
    imager = train.make_imager(blur, None, config.camera, forward=True)
    patches = _common.patches(config)
    starts = jnp.asarray(config.starts_mm)
    init, step = train.make_step(
        imager,
        {"optics": config.train.optics_rate},
        (distance, distance),
        config.seed,
        vectorised=True,
    )
    labels = tuple(f"start {start}" for start in config.starts_mm)
    _common.train_job(
        run,
        "all starts",
        init,
        step,
        {"optics": {"sensor": starts}},
        patches.train,
        config.noise,
        config,
        labels,
    )
    seconds = run.seconds

    traces = {label: run.metrics(label) for label in labels}
    final = [float(np.mean(t["sensor_mm"][-200:])) for t in traces.values()]
    span = min(*config.starts_mm, *final), max(*config.starts_mm, *final)
    some = _common.thinned(patches.train, 512)
    best = best_focus(imager, some, distance, config.noise, span)
    near = [np.flatnonzero(np.abs(t["sensor_mm"] - best) <= 0.1) for t in traces.values()]
    first = [int(hits[0]) if hits.size else None for hits in near]
    results = {
        "starts_mm": list(config.starts_mm),
        "final_mm": final,
        "best_focus_mm": best,
        "batches_to_focus": first,
        "seconds": seconds,
    }
    path = run.finish(results)
    figures = [_common.draw_lens(run, lens, distance)]
    for name, column, label in (
        ("figure_4a", "sensor_mm", "sensor position (mm)"),
        ("figure_4b", "sigma_um", "mean blur of R, G, B, σ (µm)"),
    ):
        figure, (left, right) = plot.new(1, 2, 5.5, 4)
        lines = {k: (t["step"], t[column]) for k, t in traces.items()}
        level = (best, f"best focus {best:.2f}") if column == "sensor_mm" else None
        plot.convergence(left, lines, label, level)
        plot.convergence(
            right, {k: (x[:100], y[:100]) for k, (x, y) in lines.items()}, label, level
        )
        right.set_title("the first 100 batches", fontsize=9)
        figures.append(run.figures / f"{name}.png")
        figure.savefig(figures[-1])
    rows = list(zip(config.starts_mm, final, [str(n) for n in first]))
    print(_common.table(("start mm", "final mm", "batches to within 0.1 mm"), rows))
    print(f"best focus by dense search on the same loss: {best:.3f} mm")
    print(f"training took {seconds:.1f} s; results in {path}")
    for item in figures:
        print(f"figure {item}")


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    _common.main("focus", Config, ("loss", "sensor_mm", "sigma_um"), run, argv)


if __name__ == "__main__":
    main()
