"""Section 6.3 of the paper: extended depth of field with a chromatic lens and a network.

The object distance is random in each batch. Every starting position of the sensor is trained
jointly with its network; one start also with the sensor fixed, for comparison. No ray is
traced in the loop: the moments are interpolated in 1/distance. Draws the lens and figures 6a, 6b
and 7, and writes table 2.
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
from drt_jax.learn import train
from drt_jax.learn.data import DataConfig
from drt_jax.numerics import safe_sqrt
from drt_jax.runs.folder import Run

from . import _command, _common, _training
from ._training import JointTraining, Net, Scene


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/edof.yaml.

    fixed_mm: the start that is also trained with the sensor fixed; one of starts_mm.
    depth_m: nearest and farthest object in training.
    table_depth_m: depths of table 2.
    patch_depth_m: depths of figure 7.
    test_patches: how many of the test patches are used (0: all).
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


def run(config: Config, run: Run) -> dict[str, Any]:
    """Train jointly and with the sensor fixed, and test over depth."""
    lens = drt_jax.load_lens(config.scene.lens)
    depths = *config.depth_m, *config.table_depth_m, *config.patch_depth_m
    blur = config.scene.blur(lens, 1e3 * min(depths), 1e3 * max(depths))
    weights, restore, _ = config.network.build(config.seed)
    patches = _training.patches(config)
    near, far = (1e3 * depth for depth in config.depth_m)

    def trained(job: str, blur: Callable, optics: dict) -> tuple[Callable, dict]:
        imager = train.make_imager(blur, restore, config.camera)
        functions = train.make_step(imager, config.train.rates, (near, far), config.seed)
        parameters = {"optics": optics, "network": weights}
        scenes, noise = patches.train, config.noise
        found = _training.train_job(run, job, functions, parameters, scenes, noise, config)
        return jax.jit(imager), found

    joint = {}
    for start in config.starts_mm:
        sensor = {"sensor": jnp.asarray(start)}
        joint[start] = trained(_training.start_label(start), blur, sensor)
    place = {"sensor": jnp.asarray(config.fixed_mm)}
    fixed = trained(f"fixed {config.fixed_mm}", lambda _, distance: blur(place, distance), {})
    models = {"fixed": fixed, "joint": joint[config.fixed_mm]}
    results = _training.start_results(run, config, ("sensor_mm",))
    final = results["final_mm"][config.starts_mm.index(config.fixed_mm)]
    return {
        **results,
        **tested(config, models, _training.thinned(patches.test, config.test_patches)),
        **blur_over_depth(blur, (config.fixed_mm, final), near, far),
    }


def tested(config: Config, models: dict[str, tuple], test: np.ndarray) -> dict[str, Any]:
    """Errors of both models over depth, and patches of the joint one."""
    noise, rows = config.noise, []
    for depth in config.table_depth_m:
        errors = {
            name: train.evaluate(*model, test, 1e3 * depth, noise, config.seed)
            for name, model in models.items()
        }
        rows.append({"depth_m": depth, **errors})
    near, far = config.depth_m
    inside = [row for row in rows if near <= row["depth_m"] <= far]
    chosen = _training.textured(test, len(config.patch_depth_m))
    parts = []
    for k, depth in enumerate(config.patch_depth_m):
        some, key = chosen[k % len(chosen)][None], jax.random.key(k)
        model = models["joint"]
        parts.append(_training.images(*model, some, 1e3 * depth, np.float32(noise), key))
    return {
        **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
        "joint_sensor_mm": float(models["joint"][1]["optics"]["sensor"]),
        "depth_m": list(config.depth_m),
        "patch_depth_m": list(config.patch_depth_m),
        "table": rows,
        "mean_mae": {n: float(np.mean([row[n]["mae"] for row in inside])) for n in models},
        "mean_rmse": {n: float(np.mean([row[n]["rmse"] for row in inside])) for n in models},
        "test_patches": len(test),
    }


def blur_over_depth(blur: Callable, sensors: tuple, near: float, far: float) -> dict[str, Any]:
    """Blur in um along y of each colour, by depth in m, at sensor positions in mm."""
    grid = np.linspace(near, far, 121)
    sigma = jax.vmap(lambda d, s: safe_sqrt(blur({"sensor": s}, d)[1][:, 0]), in_axes=(0, None))
    curves = [1e3 * np.asarray(sigma(jnp.asarray(grid), sensor)) for sensor in sensors]
    return {
        "blur_sensor_mm": list(sensors),
        "blur_depth_m": grid / 1e3,
        "blur_um": np.stack(curves),
    }


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Beside the paper, and table 2."""
    mean, rows = results["mean_mae"], results["table"]
    better = [r["depth_m"] for r in rows if r["fixed"]["mae"] < r["joint"]["mae"]]
    beside = [
        ("plane that all starts reach", "145.29 mm", _training.reached(results)),
        (
            "joint against fixed sensor",
            "joint better, but for 15 to 20 m",
            f"mean MAE over training depths {mean['joint']:.4f} against {mean['fixed']:.4f}; "
            f"fixed better at {', '.join(f'{depth:g}' for depth in better) or 'no'} m",
        ),
    ]
    errors = [(m.upper() + " " + n, n, m) for n in ("fixed", "joint") for m in ("mae", "rmse")]
    lines = [(title, *(f"{row[n][m]:.4f}" for row in rows)) for title, n, m in errors]
    header = "depth m", *(f"{row['depth_m']:g}" for row in rows)
    return {
        "edof": _common.table(("", "paper", "here"), beside),
        "edof, table 2": _common.table(header, lines),
    }


def report(results: dict[str, Any], figures: pathlib.Path) -> str:
    """Draw the lens and figures 6a, 6b and 7."""
    far = 1e3 * results["depth_m"][1]
    _training.draw_lens(results["lens"], far, figures / "lens.png")
    _training.draw_sensor(results, figures / "figure_6a.png")
    figure, axes = show.new(width=7, height=4.5)
    labels = [f"{sensor:.2f} mm" for sensor in results["blur_sensor_mm"]]
    show.sigma_over_depth(axes, results["blur_depth_m"], dict(zip(labels, results["blur_um"])))
    figure.savefig(figures / "figure_6b.png")
    titles = [f"{depth:g} m" for depth in results["patch_depth_m"]]
    _training.draw_patches(results, titles, figures / "figure_7.png")
    return "\n\n".join(tables(results).values())


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    columns = "loss", "sensor_mm", "sigma_um", "depth_mm"
    _command.main("edof", Config, columns, run, report, argv)


if __name__ == "__main__":
    main()
