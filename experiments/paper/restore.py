"""Section 6.2 of the paper: focus a lens and train a restoration network, jointly.

Each starting position of the sensor trains its own network; for the table of noise levels one
more network for each level. Draws figure 5a and restored patches, and writes table 5b.
"""

import dataclasses
import functools
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drt_jax.learn import train
from drt_jax.runs.folder import Run

from . import _command, _common, _training


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(_training.JointSettings):
    """Settings of the experiment; see configs/restore.yaml.

    starts_mm: trained at `noise`.
    table_starts_mm: trained at each of table_noise.
    """

    table_starts_mm: tuple[float, ...]
    table_noise: tuple[float, ...]
    distance_m: float = 25.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _common.require_list("table_starts_mm", self.table_starts_mm)
        _common.require_list("table_noise", self.table_noise, -1.0)
        _common.require_list("distance_m", (self.distance_m,))
        _common.require_noise("table_noise", *self.table_noise)


def run(config: Config, run: Run) -> dict[str, Any]:
    """Train every start and noise level, and test."""
    distance = 1e3 * config.distance_m
    jobs = _training.Jobs(run, config, distance, distance)
    blur = config.scene.blur(distance, distance)
    imager = train.make_imager(blur, jobs.restore, config.camera)
    functions, imager = jobs.step(imager), jax.jit(imager)
    names = {(start, config.noise): _training.start_label(start) for start in config.starts_mm}
    table = [(start, noise) for noise in config.table_noise for start in config.table_starts_mm]
    for start, noise in table:
        names.setdefault((start, noise), f"{_training.start_label(start)} noise {noise}")
    trained = {}
    for (start, noise), job in names.items():
        parameters = {"optics": {"sensor": jnp.asarray(start)}, "network": jobs.weights}
        trained[start, noise] = jobs.train(job, functions, parameters, noise)
    rows = []
    for start, noise in table:
        found = trained[start, noise]
        row = {"noise": noise, "start_mm": start, "sensor_mm": float(found["optics"]["sensor"])}
        rows.append(row | train.evaluate(imager, found, jobs.test, distance, noise, config.seed))
    some, noise = _training.textured(jobs.test, 6), np.float32(table[0][1])
    found, key = trained[table[0]], jax.random.key(1)
    return {
        **jobs.results("sensor_mm"),
        **_training.images(imager, found, some, distance, noise, key),
        "parameters": jobs.parameters,
        "test": rows,
        "test_patches": len(jobs.test),
    }


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Beside the paper, and table 5b."""
    first, columns = results["test"][0], ("mae", "rmse", "psnr", "ssim")
    beside = [
        ("plane that all starts reach", "133.35 mm", _training.reached(results)),
        (
            f"test MAE at noise {first['noise']:g}, after and before the network",
            "0.02 and 0.03",
            f"{first['mae']:.4f} and {first['sensor_mae']:.4f}",
        ),
    ]
    header = ["noise", "start mm", "MAE", "RMSE", "PSNR dB", "SSIM"]
    header += ["sensor MAE", "RMSE", "PSNR dB", "SSIM"]
    rows = []
    for row in results["test"]:
        values = [row[prefix + name] for prefix in ("", "sensor_") for name in columns]
        rows.append((row["noise"], row["start_mm"], *values))
    return {
        "restore": _common.table(("", "paper", "here"), beside),
        "restore, table 5b": _common.table(header, rows),
    }


def report(results: dict[str, Any], figures: pathlib.Path) -> str:
    """Draw figure 5a and restored patches."""
    _training.draw_sensor(results, figures / "figure_5a.png")
    _training.draw_patches(results, [""] * len(results["truth"]), figures / "restored.png")
    return "\n\n".join(tables(results).values())


main = functools.partial(
    _command.main, "restore", Config, ("loss", "sensor_mm", "sigma_um"), run, report
)

if __name__ == "__main__":
    main()
