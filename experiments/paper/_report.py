"""Tables and figures of the paper's experiments, from their results alone."""

import pathlib
from typing import Any

import numpy as np

import drt_jax
from drt_jax import Scene, show

from . import _plots
from ._common import number, panels, table
from ._optics import Trained

# Images of patches, in the order of an imager.
IMAGES = ("truth", "sensor", "restored")
# Errors are drawn so many times as large.
_GAIN = 4
_ERROR = f"error x {_GAIN}"
_UNITS = {"sensor": "mm", "thickness": "mm", "curvature": "1/mm"}


def start_label(start: float) -> str:
    """Name of the job that starts at a sensor position, mm."""
    return f"start {start}"


def start_lines(results: dict[str, Any], column: str, batches: int | None = None) -> dict:
    """(batch, value) by start of the first `batches`, for `_plots.curves`."""
    rows = [values[:batches] for values in results[column]]
    labels = map(start_label, results["starts_mm"])
    return {label: (np.arange(len(row)), row) for label, row in zip(labels, rows)}


def reached(results: dict[str, Any]) -> str:
    """Planes at which the starts ended, as text."""
    if None in results["final_mm"]:
        return "not finite"
    low, high = (f"{end(results['final_mm']):.3f}" for end in (min, max))
    return f"{low} mm" if low == high else f"{low} to {high} mm"


def moves(results: dict[str, Any]) -> bool:
    """True if the sensor is trained."""
    return "sensor" in results.get("variables", ["sensor"])


def planes(results: dict[str, Any], paper: str, more: str = "") -> list[tuple[str, str, str]]:
    """Table row of the plane that all starts reach; none if more than the sensor is trained."""
    row = "plane that all starts reach", paper, reached(results) + more
    return [] if "numbers" in results else [row]


def gaussian(results: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Table row of the error of the Gaussian kernel against waves; none without it."""
    words = [
        f"{50 * row['misplaced']:.0f} % of the light, {row['contrast']:.2f} of the contrast at "
        f"{row['distance_m']:g} m"
        for row in results.get("gaussian", [])
    ]
    what = "error of the Gaussian kernel against waves: light in wrong pixels, contrast"
    return [(what, "", "; ".join(words))] if words else []


def comparison(results: dict[str, Any], rows: list[tuple[str, str, str]]) -> str:
    """A table of (what, paper, ours); without the paper if it has no such numbers."""
    if results.get("paper", True):
        return table(("", "paper", "here"), rows)
    return table(("", "here"), [(what, here) for what, _, here in rows])


def numbers_tables(name: str, results: dict[str, Any]) -> dict[str, str]:
    """The table `name` of the trained numbers; none if only the sensor is trained."""
    if "numbers" not in results:
        return {}
    titles = {"rms_um": f"RMS radius um at {results['spot_mm'] / 1e3:.4g} m"}
    titles |= {"light": "least share of light", "loss": "mean loss, first and last batches"}
    runs = results["numbers"]
    rows = []
    for key in runs[0][0]:
        title = titles.get(key, f"{key} {_UNITS.get(key.split()[0], '')}".strip())
        pairs = [[number(column[key], ".6g") for column in columns] for columns in runs]
        rows.append((title, *(" to ".join(pair) for pair in pairs)))
    return {name: table(("", *map(start_label, results["starts_mm"])), rows)}


def draw_sensor(results: dict[str, Any], path: pathlib.Path) -> None:
    """Figure of the sensor position of all starts over training, if it is trained."""
    if moves(results):
        figure, axes = show.new(width=7, height=4.5)
        lines = start_lines(results, "sensor_mm")
        _plots.curves(axes, lines, "training batch", "sensor position (mm)")
        figure.savefig(path)


def draw_numbers(results: dict[str, Any], folder: pathlib.Path) -> None:
    """Figures numbers.png, of the trained numbers, and designed.png, of the lens of the first start
    before and after; none if only the sensor is trained."""
    if "numbers" not in results:
        return
    trained = Trained.of(results["lens"], tuple(results["variables"]))
    labels = list(map(start_label, results["starts_mm"]))
    figure, axes = panels(len(labels), 6, 4)
    for ax, label, changes in zip(axes, labels, results["changes_mm"]):
        lines = {n: (np.arange(len(row)), row) for n, row in zip(trained.names, changes)}
        _plots.curves(ax, lines, "training batch", "change, as mm of the sensor")
        ax.set_title(label, fontsize=9)
    figure.savefig(folder / "numbers.png")
    figure, axes = show.new(2, 1, 8, 3)
    titles = labels[0], f"{labels[0]}, trained"
    for ax, values, title in zip(axes, results["numbers"][0], titles):
        _draw(ax, trained.lens_of(values), results, results["spot_mm"])
        ax.set_title(title, fontsize=9)
    figure.savefig(folder / "designed.png")


def _draw(axes: Any, lens: drt_jax.Lens, results: dict[str, Any], distance: float) -> None:
    field = np.radians(np.ravel(results.get("field", 0.0))[-1])
    show.lens_drawing(axes, show.draw(lens, Scene.radians(field, distance)))


def draw_lens(results: dict[str, Any], distance: float, path: pathlib.Path) -> None:
    """Figure of the lens with its beam from a distance in mm, at the field along y."""
    lens = drt_jax.load_lens(results["lens"])
    figure, axes = show.new(width=8, height=4)
    _draw(axes, lens, results, distance)
    axes.set_title(lens.name)
    figure.savefig(path)


def draw_patches(results: dict[str, Any], titles: list[str], path: pathlib.Path) -> None:
    """Figure of the `images` of patches, with the RMSE of all but the truth, and of the errors
    that are left."""
    rows = {name: np.float32(results[name]) for name in IMAGES}
    errors = {name: rows[name] - rows["truth"] for name in IMAGES[1:]}
    notes = {name: rmse_of(some) for name, some in errors.items()}
    rows[_ERROR] = error_map(errors["restored"])
    _plots.patch_grid(rows, titles, notes).savefig(path)


def rmse_of(errors: np.ndarray) -> list[str]:
    """Root mean square of the errors of each patch, as text."""
    return [f"{np.sqrt(np.mean(error**2)):.3f}" for error in errors]


def error_map(errors: np.ndarray) -> np.ndarray:
    """Errors of images (N, H, W, C) as images: grey where there is none."""
    return 0.5 + _GAIN * errors
