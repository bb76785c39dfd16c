"""Tables and figures of the paper's experiments, made from results.json alone."""

import pathlib
from typing import Any

import numpy as np

import drt_jax
from drt_jax import Scene, show

from . import _plots
from ._common import number, table
from ._optics import Trained

# Images of patches, in the order in which an imager returns them.
IMAGES = ("truth", "sensor", "restored")
_ERROR = f"error x {_plots.GAIN}"
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
    """Final sensor positions of the starts, as text."""
    if None in results["final_mm"]:
        return "not finite"
    low, high = (f"{end(results['final_mm']):.3f}" for end in (min, max))
    return f"{low} mm" if low == high else f"{low} to {high} mm"


def moves(results: dict[str, Any]) -> bool:
    """True if the sensor is trained."""
    return "sensor" in results.get("variables", ["sensor"])


def tables(
    name: str, results: dict[str, Any], plane: str, rows: list[tuple[str, str, str]], more: str = ""
) -> dict[str, str]:
    """The table `name`, which compares the paper with the results here, or has only these if the
    paper has no numbers for the settings; and a table of the trained numbers, if more than the
    sensor is trained.

    plane: final sensor position of all starts in the paper.
    rows: quantity, value in the paper, value here.
    more: text that is added to the final sensor positions here.
    """
    if "numbers" not in results:
        rows = [("plane that all starts reach", plane, reached(results) + more), *rows]
    kernels = [
        f"{50 * row['misplaced']:.0f} % of the light, {row['contrast']:.2f} of the contrast at "
        f"{row['distance_m']:g} m"
        for row in results.get("gaussian", [])
    ]
    if kernels:
        what = "error of the Gaussian kernel against waves: light in wrong pixels, contrast"
        rows = [*rows, (what, "", "; ".join(kernels))]
    if results.get("paper", True):
        found = {name: table(("", "paper", "here"), rows)}
    else:
        found = {name: table(("", "here"), [(what, here) for what, _, here in rows])}
    return found | ({f"{name}, lens": _numbers(results)} if "numbers" in results else {})


def _numbers(results: dict[str, Any]) -> str:
    """Table of the trained numbers, before and after."""
    titles = {"rms_um": f"RMS radius um at {results['spot_mm'] / 1e3:.4g} m"}
    titles |= {"light": "least share of light", "loss": "mean loss, first and last batches"}
    runs = results["numbers"]
    rows = []
    for key in runs[0][0]:
        title = titles.get(key, f"{key} {_UNITS.get(key.split()[0], '')}".strip())
        pairs = [[number(column[key], ".6g") for column in columns] for columns in runs]
        rows.append((title, *(" to ".join(pair) for pair in pairs)))
    return table(("", *map(start_label, results["starts_mm"])), rows)


def draw_sensor(results: dict[str, Any], path: pathlib.Path) -> None:
    """Figure of the sensor position of all starts over training, if it is trained."""
    if moves(results):
        with _plots.picture(path, 7, 4.5) as (axes,):
            lines = start_lines(results, "sensor_mm")
            _plots.curves(axes, lines, "training batch", "sensor position (mm)")


def draw_numbers(results: dict[str, Any], folder: pathlib.Path) -> None:
    """Draws numbers.png, the trained numbers, and designed.png, the lens of the first start before
    and after training. Draws nothing if only the sensor is trained."""
    if "numbers" not in results:
        return
    trained = Trained.of(results["lens"], tuple(results["variables"]))
    labels = list(map(start_label, results["starts_mm"]))
    with _plots.picture(folder / "numbers.png", 6, 4, len(labels)) as axes:
        for ax, label, changes in zip(axes, labels, results["changes_mm"]):
            lines = {n: (np.arange(len(row)), row) for n, row in zip(trained.names, changes)}
            _plots.curves(ax, lines, "training batch", "change, as mm of the sensor")
            ax.set_title(label, fontsize=9)
    with _plots.picture(folder / "designed.png", 8, 3, 2, columns=1) as axes:
        titles = labels[0], f"{labels[0]}, trained"
        for ax, values, title in zip(axes, results["numbers"][0], titles):
            _draw(ax, trained.lens_of(values), results, results["spot_mm"], title)


def _draw(axes: Any, lens: drt_jax.Lens, results: dict[str, Any], far: float, title: str) -> None:
    """Draws a lens with its beam from a distance in mm, at the field along y."""
    field = np.radians(np.ravel(results.get("field", 0.0))[-1])
    show.lens_drawing(axes, show.draw(lens, Scene.radians(field, far))).set_title(title, fontsize=9)


def draw_lens(results: dict[str, Any], distance: float, path: pathlib.Path) -> None:
    """Figure of the lens with its beam from a distance in mm."""
    lens = drt_jax.load_lens(results["lens"])
    with _plots.picture(path, 8, 4) as (axes,):
        _draw(axes, lens, results, distance, lens.name)


def draw_patches(results: dict[str, Any], titles: list[str], path: pathlib.Path) -> None:
    """Figure of the `images` of patches, with the RMSE of all except the true images; and of the
    remaining errors."""
    truth, sensor, restored = (np.float32(results[name]) for name in IMAGES)
    rows = {"sensor": sensor, "restored": restored}
    _plots.patch_grid(path, titles, truth, rows, {_ERROR: restored})
