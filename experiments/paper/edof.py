"""Section 6.3 of the paper: extended depth of field with a chromatic lens and a network.

The object distance is random in each batch. Each starting position of the sensor is trained jointly
with a network; for comparison one start is also trained with the sensor fixed. If only the sensor
is trained, the loop traces no rays, because the moments are interpolated in 1/distance. Draws the
lens and figures 6a, 6b and 7, and writes table 2.

train.variables: sensor, curvature, conic, coefficients, thickness; for all surfaces or, as in
"curvature 0", for one. scene.field: degrees along y, or [x, y].
"""

import dataclasses
import pathlib
import sys
from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from drt_jax.learn import train

from . import _command, _common, _optics, _plots, _report, _settings, _training
from ._common import Numbers, near_and_far, within
from .runs.folder import Run

COLUMNS = ("loss", "sensor_mm", "sigma_um", "depth_mm")
_Depths = Annotated[Numbers, within(1e-3, 1e9)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(_settings.JointSettings):
    """Settings of the experiment; see configs/edof.yaml.

    fixed_mm: the one of starts_mm that is also trained with the sensor fixed.
    depth_m: nearest and farthest object in training.
    table_depth_m, patch_depth_m: distances of table 2 and figure 7.
    """

    fixed_mm: float
    depth_m: Annotated[_Depths, near_and_far] = (10.0, 50.0)
    table_depth_m: _Depths = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0)
    patch_depth_m: _Depths = (10.0, 20.0, 30.0, 40.0, 50.0)
    scene: _optics.Scene = _optics.Scene(lens="double_gauss_addon")

    def __post_init__(self) -> None:
        super().__post_init__()
        some = any(map(self.trained_at, self.table_depth_m))
        _common.require(some, "table_depth_m: none lies within depth_m")
        start = self.fixed_mm in self.starts_mm
        _common.require(start, f"fixed_mm: {self.fixed_mm} must be one of starts_mm")

    def trained_at(self, depth: float) -> bool:
        """True if a depth in m lies within those of training."""
        return self.depth_m[0] <= depth <= self.depth_m[1]


def run(config: Config, run: Run) -> dict[str, Any]:
    """Trains jointly and with the sensor fixed, and tests over depth."""
    near, far = (1e3 * depth for depth in config.depth_m)
    more = (1e3 * depth for depth in (*config.table_depth_m, *config.patch_depth_m))
    jobs = _training.Jobs(run, config, near, far, *more)
    blur = jobs.blur
    imager, steps = jobs.steps(blur)
    joint = {}
    for start in config.starts_mm:
        optics = jobs.lens.start(start)
        joint[start] = jobs.train(_report.start_label(start), steps, optics, config.noise)
    place = jobs.lens.start(config.fixed_mm)
    still, steps = jobs.steps(lambda _, depth: blur(place, depth))
    fixed = jobs.train(f"fixed {config.fixed_mm}", steps, {}, config.noise)
    best = joint[config.fixed_mm]
    results = jobs.results("sensor_mm")
    final = best["optics"]
    if not jobs.lens.names:
        final = {"sensor": results["final_mm"][config.starts_mm.index(config.fixed_mm)]}
    return {
        **results,
        **tested(config, {"fixed": (still, fixed), "joint": (imager, best)}, jobs.test),
        **blur_over_depth(blur, (place, final), near, far),
        "joint_sensor_mm": float(best["optics"]["sensor"]),
        **_common.settings(config, "depth_m", "patch_depth_m"),
    }


def tested(config: Config, models: dict[str, tuple], test: np.ndarray) -> dict[str, Any]:
    """Errors of both models over depth, and patches of the joint one."""
    noise, rows, parts = config.noise, [], []
    for depth in config.table_depth_m:
        row: dict[str, Any] = {"depth_m": depth}
        for name, model in models.items():
            row[name] = train.evaluate(*model, test, 1e3 * depth, noise, config.seed)
        rows.append(row)
    inside = [row for row in rows if config.trained_at(row["depth_m"])]
    chosen = _training.textured(test, len(config.patch_depth_m))
    for k, depth in enumerate(config.patch_depth_m):
        some = chosen[k % len(chosen)][None]
        parts.append(_training.images(*models["joint"], some, 1e3 * depth, noise, k))
    return {
        **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
        "table": rows,
        "mean_mae": {n: float(np.mean([row[n]["mae"] for row in inside])) for n in models},
        "mean_rmse": {n: float(np.mean([row[n]["rmse"] for row in inside])) for n in models},
        "test_patches": len(test),
    }


def blur_over_depth(blur: Callable, lenses: tuple, near: float, far: float) -> dict[str, Any]:
    """Blur of each wavelength over depth, um. lenses: trained numbers of each lens."""
    grid = np.linspace(near, far, 121)
    sigma = jax.vmap(lambda d, v: train.blur_width(blur(v, d).covariance), in_axes=(0, None))
    curves = np.stack([1e3 * np.asarray(sigma(jnp.asarray(grid), values)) for values in lenses])
    sensors = [float(values["sensor"]) for values in lenses]
    return {"blur_sensor_mm": sensors, "blur_depth_m": grid / 1e3, "blur_um": curves}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """The comparison with the paper, and table 2."""
    mean, rows = results["mean_mae"], results["table"]
    pairs = [(row["depth_m"], row["fixed"]["mae"], row["joint"]["mae"]) for row in rows]
    better = [f"{d:g}" for d, a, b in pairs if None not in (a, b) and a < b]
    joint, fixed = (_common.number(mean[name], ".4f") for name in ("joint", "fixed"))
    means = f"mean MAE over training depths {joint} against {fixed}"
    against = f"{means}; fixed better at {', '.join(better) or 'no'} m"
    compared = [("joint against fixed sensor", "joint better, but for 15 to 20 m", against)]
    errors = [(m.upper() + " " + n, n, m) for n in ("fixed", "joint") for m in ("mae", "rmse")]
    lines = [(title, *(_common.number(row[n][m], ".4f") for row in rows)) for title, n, m in errors]
    header = "depth m", *(f"{row['depth_m']:g}" for row in rows)
    found = _report.tables("edof", results, "145.29 mm", compared)
    return found | {"edof, table 2": _common.table(header, lines)}


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the lens and figures 6a, 6b and 7."""
    _report.draw_lens(results, 1e3 * results["depth_m"][1], figures / "lens.png")
    _report.draw_numbers(results, figures)
    _report.draw_sensor(results, figures / "figure_6a.png")
    labels = [f"{sensor:.2f} mm" for sensor in results["blur_sensor_mm"]]
    if "numbers" in results or len(set(labels)) < len(labels):
        labels = [f"{label}, {name}" for label, name in zip(labels, ("fixed", "trained"))]
    with _plots.picture(figures / "figure_6b.png", 7, 4.5) as (ax,):
        for k, (label, sigma) in enumerate(zip(labels, results["blur_um"])):
            pale = {} if k else {"linestyle": ":", "alpha": 0.6}
            for blur, colour in zip(np.transpose(sigma), ("red", "green", "blue")):
                style = {"color": f"tab:{colour}", "label": f"{colour[0].upper()}, {label}"}
                ax.plot(results["blur_depth_m"], blur, **style, **pale)
        ax.set_ylim(0, None)
        _plots.label_axes(ax, "object distance (m)", r"blur $\sigma$ (µm)", ncols=len(labels))
    titles = [f"{depth:g} m" for depth in results["patch_depth_m"]]
    _report.draw_patches(results, titles, figures / "figure_7.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
