"""Section 6.2 of the paper: focus a lens and train a restoration network, jointly.

Each starting position of the sensor trains its own network; for the table of noise levels one
more network for each level. Writes figure 5a, table 5b and results.json.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax.learn import network
from drt_jax.show import plot
from drt_jax.learn import train
from drt_jax.learn.data import DataConfig
from drt_jax.runs.folder import Run

from . import _common
from ._common import JointTraining, Scene


@dataclasses.dataclass(frozen=True)
class Net:
    """Skips of RED-Net: skip_every n joins every n-th pair of layers, input_skip adds the
    input to the output."""

    skip_every: int = 2
    input_skip: bool = True


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/restore.yaml.

    starts_mm are trained at `noise`; table_starts_mm at each of table_noise. test_patches: how
    many of the test patches the table is measured on (0: all).
    """

    starts_mm: tuple[float, ...]
    table_starts_mm: tuple[float, ...]
    table_noise: tuple[float, ...]
    train: JointTraining
    distance_m: float = 25.0
    noise: float = 0.01
    test_patches: int = 0
    seed: int = 0
    network: Net = Net()
    scene: Scene = Scene()
    camera: train.Camera = train.Camera()
    data: DataConfig = DataConfig()

    def __post_init__(self) -> None:
        _common.require_list("starts_mm", self.starts_mm)
        _common.require_list("table_starts_mm", self.table_starts_mm)
        _common.require_list("table_noise", self.table_noise, -1.0)
        _common.require_list("distance_m", (self.distance_m,))
        _common.require_noise("noise", self.noise, *self.table_noise)


def run(config: Config, run: Run) -> None:
    """Train every start and noise level, test, write the results and figures."""
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
    init_network, restore = drt_jax.red_net(**dataclasses.asdict(config.network))
    weights = init_network(jax.random.key(config.seed))
    imager = train.make_imager(blur, restore, config.camera)
    test_imager = jax.jit(imager)
    init, step = train.make_step(imager, _common.rates(config), (distance, distance), config.seed)
    patches = _common.patches(config)
    test = _common.thinned(patches.test, config.test_patches)
    print(f"RED-Net with {network.count_parameters(weights)} parameters")

    jobs = {(start, config.noise): f"start {start}" for start in config.starts_mm}
    for noise in config.table_noise:
        for start in config.table_starts_mm:
            jobs.setdefault((start, noise), f"start {start} noise {noise}")
    trained = {}
    for (start, noise), job in jobs.items():
        parameters = {"optics": {"sensor": jnp.asarray(start)}, "network": weights}
        trained[start, noise] = _common.train_job(
            run, job, init, step, parameters, patches.train, noise, config
        )
    rows = [
        {
            "noise": noise,
            "start_mm": start,
            "sensor_mm": float(trained[start, noise]["optics"]["sensor"]),
            **train.evaluate(
                test_imager, trained[start, noise], test, distance, noise, config.seed
            ),
        }
        for noise in config.table_noise
        for start in config.table_starts_mm
    ]
    traces = {f"start {s}": run.metrics(f"start {s}") for s in config.starts_mm}
    window = _common.final_window(config)
    results = {
        "parameters": network.count_parameters(weights),
        "starts_mm": list(config.starts_mm),
        "final_mm": [float(np.mean(t["sensor_mm"][-window:])) for t in traces.values()],
        "final_window_batches": window,
        "test": rows,
        "test_patches": len(test),
        "seconds": run.seconds,
    }
    path = run.finish(results)
    figures = [run.figures / "figure_5a.png", run.figures / "restored.png"]
    figure, axes = plot.new(width=7, height=4.5)
    lines = {k: (t["step"], t["sensor_mm"]) for k, t in traces.items()}
    plot.convergence(axes, lines, "sensor position (mm)")
    figure.savefig(figures[0])
    chosen = trained[config.table_starts_mm[0], config.table_noise[0]]
    _patches(test_imager, chosen, test, distance, config.table_noise[0]).savefig(figures[1])

    print(
        _common.table(
            ("start mm", "final mm"), list(zip(results["starts_mm"], results["final_mm"]))
        )
    )
    columns = (
        "noise",
        "start_mm",
        "mae",
        "rmse",
        "psnr",
        "ssim",
        "sensor_mae",
        "sensor_rmse",
        "sensor_psnr",
        "sensor_ssim",
    )
    print(_common.table(columns, [tuple(row[c] for c in columns) for row in rows]))
    print(f"results in {path}")
    for item in figures:
        print(f"figure {item}")


def _patches(imager, parameters, test, distance, noise):
    chosen = _common.textured(test, 6)
    truth, sensor, restored, _ = map(
        np.asarray, imager(parameters, chosen, distance, np.float32(noise), jax.random.key(1))
    )
    rows = {"truth": truth, "sensor": sensor, "restored": restored}
    return plot.patch_grid(rows, [""] * len(chosen), _common.rmse_notes(rows))


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    _common.main("restore", Config, ("loss", "sensor_mm", "sigma_um"), run, argv)


if __name__ == "__main__":
    main()
