"""Section 6.3 of the paper: extended depth of field with a chromatic lens and a network.

The object distance is random in each batch. Every starting position of the sensor is trained
jointly with its network; one start also with the sensor fixed, for comparison. No ray is
traced in the loop: the moments are interpolated in 1/distance. Writes figures 6a, 6b and 7,
table 2 and results.json.
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
from drt_jax.numerics import safe_sqrt
from drt_jax.runs.folder import Run

from . import _common
from ._common import JointTraining, Scene
from .restore import Net


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/edof.yaml.

    depth_m: nearest and farthest object in training. fixed_mm: the start that is also trained
    with the sensor fixed; one of starts_mm. table_depth_m: depths of table 2; patch_depth_m:
    those of figure 7. test_patches: how many of the test patches are used (0: all).
    """

    starts_mm: tuple[float, ...]
    fixed_mm: float
    train: JointTraining
    depth_m: tuple[float, ...] = (10.0, 50.0)
    table_depth_m: tuple[float, ...] = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0)
    patch_depth_m: tuple[float, ...] = (10.0, 20.0, 30.0, 40.0, 50.0)
    noise: float = 0.01
    test_patches: int = 0
    seed: int = 0
    network: Net = Net()
    scene: Scene = Scene(lens="double_gauss_addon")
    camera: train.Camera = train.Camera()
    data: DataConfig = DataConfig()

    def __post_init__(self) -> None:
        for name in ("starts_mm", "depth_m", "table_depth_m", "patch_depth_m"):
            _common.require_list(name, getattr(self, name))
        _common.require(
            len(self.depth_m) == 2 and self.depth_m[0] < self.depth_m[1],
            "depth_m: expected the nearest and the farthest distance in m",
        )
        _common.require(
            any(self.depth_m[0] <= depth <= self.depth_m[1] for depth in self.table_depth_m),
            "table_depth_m: none lies within depth_m",
        )
        _common.require(
            self.fixed_mm in self.starts_mm, f"fixed_mm: {self.fixed_mm} must be one of starts_mm"
        )
        _common.require_noise("noise", self.noise)


def run(config: Config, run: Run) -> None:
    """Train jointly and with the sensor fixed, test over depth, write results and figures."""
    lens = drt_jax.load_lens(config.scene.lens)
    depths = [*config.depth_m, *config.table_depth_m, *config.patch_depth_m]
    span = 1e3 * min(depths), 1e3 * max(depths)
    _, blur = drt_jax.moments_model(
        lens, ("sensor",), 0.0, span, config.scene.wavelengths_um, config.scene.tolerance
    )
    init_network, restore = drt_jax.red_net(**dataclasses.asdict(config.network))
    weights = init_network(jax.random.key(config.seed))
    print(f"RED-Net with {network.count_parameters(weights)} parameters")
    patches = _common.patches(config)
    test = _common.thinned(patches.test, config.test_patches)
    near, far = (1e3 * depth for depth in config.depth_m)

    imager = train.make_imager(blur, restore, config.camera)
    init, step = train.make_step(imager, _common.rates(config), (near, far), config.seed)
    joint = {}
    for start in config.starts_mm:
        parameters = {"optics": {"sensor": jnp.asarray(start)}, "network": weights}
        joint[start] = _common.train_job(
            run, f"start {start}", init, step, parameters, patches.train, config.noise, config
        )

    def fixed_blur(values, distance):
        return blur({"sensor": jnp.asarray(config.fixed_mm)}, distance)

    fixed_imager = train.make_imager(fixed_blur, restore, config.camera)
    init, step = train.make_step(fixed_imager, _common.rates(config), (near, far), config.seed)
    fixed = _common.train_job(
        run,
        f"fixed {config.fixed_mm}",
        init,
        step,
        {"optics": {}, "network": weights},
        patches.train,
        config.noise,
        config,
    )

    best = joint[config.fixed_mm]
    models = {"fixed": (jax.jit(fixed_imager), fixed), "joint": (jax.jit(imager), best)}
    rows = []
    for depth in config.table_depth_m:
        row = {"depth_m": depth}
        for name, (model, parameters) in models.items():
            row[name] = train.evaluate(
                model, parameters, test, 1e3 * depth, config.noise, config.seed
            )
        rows.append(row)
    traces = {f"start {s}": run.metrics(f"start {s}") for s in config.starts_mm}
    window = _common.final_window(config)
    inside = [row for row in rows if near <= 1e3 * row["depth_m"] <= far]
    results = {
        "starts_mm": list(config.starts_mm),
        "final_mm": [float(np.mean(t["sensor_mm"][-window:])) for t in traces.values()],
        "final_window_batches": window,
        "joint_sensor_mm": float(best["optics"]["sensor"]),
        "table": rows,
        "mean_mae": {n: float(np.mean([row[n]["mae"] for row in inside])) for n in models},
        "mean_rmse": {n: float(np.mean([row[n]["rmse"] for row in inside])) for n in models},
        "test_patches": len(test),
        "seconds": run.seconds,
    }
    path = run.finish(results)

    figures = [_common.draw_lens(run, lens, far)]
    figures += [run.figures / f"figure_{name}.png" for name in ("6a", "6b", "7")]
    figure, axes = plot.new(width=7, height=4.5)
    lines = {k: (t["step"], t["sensor_mm"]) for k, t in traces.items()}
    plot.convergence(axes, lines, "sensor position (mm)")
    figure.savefig(figures[1])
    final = results["final_mm"][config.starts_mm.index(config.fixed_mm)]
    figure, axes = plot.new(width=7, height=4.5)
    grid = np.linspace(near, far, 121)
    sigma = jax.vmap(lambda d, s: safe_sqrt(blur({"sensor": s}, d)[1][:, 0]), in_axes=(0, None))
    plot.sigma_over_depth(
        axes,
        grid / 1e3,
        {
            f"{s:.2f} mm": 1e3 * np.asarray(sigma(jnp.asarray(grid), s))
            for s in (config.fixed_mm, final)
        },
    )
    figure.savefig(figures[2])
    _patches(*models["joint"], test, config).savefig(figures[3])

    print(
        _common.table(
            ("start mm", "final mm"), list(zip(results["starts_mm"], results["final_mm"]))
        )
    )
    print(
        _common.table(
            ("depth m", "MAE fixed", "MAE joint", "RMSE fixed", "RMSE joint"),
            [(r["depth_m"], *(r[n][m] for m in ("mae", "rmse") for n in models)) for r in rows],
        )
    )
    mean = results["mean_mae"]
    print(
        f"mean MAE from {config.depth_m[0]:g} to {config.depth_m[1]:g} m: sensor fixed at "
        f"{config.fixed_mm:g} mm {mean['fixed']:.5f}, trained jointly {mean['joint']:.5f}"
    )
    print(f"results in {path}")
    for item in figures:
        print(f"figure {item}")


def _patches(imager, parameters, test, config):
    """Figure 7: truth, sensor image and restored image, a patch for each depth."""
    count = len(config.patch_depth_m)
    chosen = _common.textured(test, count)
    rows = {"truth": [], "sensor": [], "restored": []}
    for k, depth in enumerate(config.patch_depth_m):
        patch = chosen[k % len(chosen)][None]
        images = imager(parameters, patch, 1e3 * depth, np.float32(config.noise), jax.random.key(k))
        for name, image in zip(rows, images):
            rows[name].append(np.asarray(image)[0])
    return plot.patch_grid(
        rows, [f"{depth:g} m" for depth in config.patch_depth_m], _common.rmse_notes(rows)
    )


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    _common.main("edof", Config, ("loss", "sensor_mm", "sigma_um", "depth_mm"), run, argv)


if __name__ == "__main__":
    main()
