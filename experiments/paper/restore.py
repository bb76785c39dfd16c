"""Section 6.2 of the paper: focus a lens and train a restoration network, jointly.

A network is trained for each starting position of the sensor, and for the table of noise levels one
more for each level. Draws figure 5a and restored patches, and writes table 5b.

train.variables: sensor, curvature, conic, coefficients, thickness; for all surfaces or, as in
"curvature 0", for one. scene.field: degrees along y, or [x, y].
"""

import dataclasses
import pathlib
import sys
from typing import Annotated, Any

from drt_jax.learn import train

from . import _command, _common, _report, _settings, _training
from ._common import Numbers, within
from .runs.folder import Run

COLUMNS = ("loss", "sensor_mm", "sigma_um")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(_settings.JointSettings):
    """Settings of the experiment; see configs/restore.yaml.

    table_starts_mm: starts that are trained at each noise level of table_noise.
    """

    table_starts_mm: Annotated[Numbers, within(1e-3, 1e6)]
    table_noise: Annotated[Numbers, within(0, 10)]
    distance_m: Annotated[float, within(1e-3, 1e9)] = 25.0


def run(config: Config, run: Run) -> dict[str, Any]:
    """Trains every start and noise level, and tests them."""
    distance = 1e3 * config.distance_m
    jobs = _training.Jobs(run, config, distance, distance)
    imager, steps = jobs.steps(jobs.blur)
    first = [(start, config.noise) for start in config.starts_mm]
    table = [(start, noise) for noise in config.table_noise for start in config.table_starts_mm]
    trained = {}
    for start, noise in dict.fromkeys([*first, *table]):
        job = _report.start_label(start)
        job += "" if (start, noise) in first else f" noise {noise}"
        trained[start, noise] = jobs.train(job, steps, jobs.lens.start(start), noise)
    rows = []
    for start, noise in table:
        found = trained[start, noise]
        row = {"noise": noise, "start_mm": start, "sensor_mm": float(found["optics"]["sensor"])}
        rows.append(row | train.evaluate(imager, found, jobs.test, distance, noise, config.seed))
    some, noise = _training.textured(jobs.test, 6), table[0][1]
    return {
        **jobs.results("sensor_mm"),
        **_training.images(imager, trained[table[0]], some, distance, noise, 1),
        "parameters": jobs.parameters,
        "test": rows,
        "test_patches": len(jobs.test),
    }


def tables(results: dict[str, Any]) -> dict[str, str]:
    """The comparison with the paper, and table 5b."""
    first = results["test"][0]
    test = f"test MAE at noise {first['noise']:g}, after and before the network"
    errors = " and ".join(_common.number(first[name], ".4f") for name in ("mae", "sensor_mae"))
    rows = [(test, "0.02 and 0.03", errors)]
    measures = ["RMSE", "PSNR dB", "SSIM"]
    header = ["noise", "start mm", "MAE", *measures, "sensor MAE", *measures]
    columns = [a + b for a in ("", "sensor_") for b in ("mae", "rmse", "psnr", "ssim")]
    errors = [[row[name] for name in ("noise", "start_mm", *columns)] for row in results["test"]]
    found = _report.tables("restore", results, "133.35 mm", rows)
    return found | {"restore, table 5b": _common.table(header, errors)}


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws figure 5a and restored patches."""
    _report.draw_numbers(results, figures)
    _report.draw_sensor(results, figures / "figure_5a.png")
    _report.draw_patches(results, [""] * len(results["truth"]), figures / "restored.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
