"""Requested tolerance and actual error of every quantity that has a tolerance.

Each lens is evaluated at some fields, in float64 and float32. The reference is the same function in
float64 with much finer sampling (`Quantity.finest`); `accuracy` compares spots with another tracer.
Writes results.json, whose `rows` have `quantity`, `lens`, `field_deg`, `dtype`, `tolerance` and
`error`, or in `refused` the reason why there is no value: float32 cannot reach the tolerance, or
the quantity is undefined for the scene. Draws error over tolerance, with the diagonal.
"""

import dataclasses
import functools
import math
import pathlib
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Lens, Scene

from . import _command, _common, _plots
from ._common import Numbers, not_empty, within
from ._reference import sigmas
from .runs.folder import Run

_SIZE, _SIDE = 15, 64  # of kernels and of the photograph, pixels


class Setting(NamedTuple):
    """A lens with an object point and pixels.

    lens, scene: the lens in some dtype, and one object point in one wavelength.
    pixel: side of a pixel, mm: kernels are as wide as the spot.
    """

    lens: Lens
    scene: Scene
    pixel: float


class Quantity(NamedTuple):
    """A quantity that has a tolerance.

    value: function of a `Setting` and a tolerance.
    error: function of a value and the reference; the error as the tolerance defines it.
    tolerances: the requested tolerances.
    finest: tolerance of the reference.
    """

    value: Callable[[Setting, float], Any]
    error: Callable[[np.ndarray, np.ndarray], float]
    tolerances: tuple[float, ...]
    finest: float


def spot(at: Setting, tolerance: float) -> Any:
    """RMS radius of the spot (1,), mm."""
    return sigmas(drt_jax.psf_moments(at.lens, at.scene, tolerance))


def kernel(at: Setting, tolerance: float) -> Any:
    """Kernel of waves (1, size, size)."""
    return drt_jax.psf(at.lens, at.scene, at.pixel, _SIZE, "waves", tolerance).kernel


def contrast(at: Setting, tolerance: float) -> Any:
    """Transfer function at a tenth, a fifth and two fifths of a cycle a pixel."""
    frequencies = np.array([0.1, 0.2, 0.4]) / at.pixel
    return drt_jax.transfer(at.lens, at.scene, frequencies, sampling=tolerance).otf


def strehl(at: Setting, tolerance: float) -> Any:
    """Strehl ratio (1,)."""
    return drt_jax.strehl(at.lens, at.scene, tolerance)


def energy(at: Setting, tolerance: float) -> Any:
    """Energy within one, two and four pixels of the centroid."""
    radii = np.array([1.0, 2.0, 4.0]) * at.pixel
    return drt_jax.encircled_energy(at.lens, at.scene, radii, sampling=tolerance)


def illumination(at: Setting, tolerance: float) -> Any:
    """Relative illumination (1,)."""
    return drt_jax.relative_illumination(at.lens, at.scene, tolerance)


def photograph(at: Setting, tolerance: float) -> Any:
    """A picture of white noise of variance 1 whose corners lie in the field, (side, side, 1)."""
    noise = np.random.default_rng(0).normal(size=(_SIDE, _SIDE, 1))
    focal = float(drt_jax.focal_length(at.lens, at.scene.wavelengths)[0])
    pixel = 2**0.5 * abs(focal) * math.tan(max(float(at.scene.field[1]), 0.01)) / _SIDE
    picture = jnp.asarray(noise, at.lens.curvature.dtype)
    return drt_jax.render(at.lens, picture, np.inf, pixel, at.scene.wavelengths, tolerance)


def largest(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest difference."""
    return float(np.max(np.abs(found - truth)))


def relative(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest relative difference."""
    return largest(found / truth, np.ones_like(truth))


def summed(found: np.ndarray, truth: np.ndarray) -> float:
    """Sum of the differences of a kernel's pixels."""
    return float(np.max(np.sum(np.abs(found - truth), axis=(-2, -1))))


def rms(found: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square difference of pictures."""
    return float(np.sqrt(np.mean((found - truth) ** 2)))


QUANTITIES = {
    "spot": Quantity(spot, relative, (1e-3, 1e-5, 1e-7, 1e-9), 1e-11),
    "kernel": Quantity(kernel, summed, (1e-1, 3e-2, 1e-2), 1e-3),
    "contrast": Quantity(contrast, largest, (1e-2, 3e-3, 1e-3), 1e-6),
    "strehl": Quantity(strehl, largest, (1e-2, 3e-3, 1e-3), 1e-6),
    "energy": Quantity(energy, largest, (1e-2, 3e-3, 1e-3), 1e-5),
    "illumination": Quantity(illumination, largest, (1e-2, 1e-4, 1e-6), 1e-10),
    "photograph": Quantity(photograph, rms, (1e-2, 3e-3), 3e-4),
}


@dataclasses.dataclass(frozen=True)
class View:
    """A lens and its largest field. lens: a bundled name or a file."""

    lens: str
    field_deg: Annotated[float, within(0, 89.9)] = 0.0


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/requested.yaml.

    views: lenses.
    parts: fields relative to the largest.
    quantities: names from `QUANTITIES`.
    """

    views: Annotated[tuple[View, ...], not_empty]
    parts: Annotated[Numbers, within(0, 1)] = (0.0, 0.7, 1.0)
    dtypes: Annotated[tuple[Literal["float64", "float32"], ...], not_empty] = ("float64", "float32")
    quantities: Annotated[tuple[Literal[*QUANTITIES], ...], not_empty] = tuple(QUANTITIES)
    wavelength_um: Annotated[float, within(1e-4, 1e6)] = 0.53


def measure(config: Config, view: View) -> list[dict[str, Any]]:
    """The rows of a lens."""
    jax.clear_caches()  # thousands of kernels exceed the memory maps of a process
    lens, rows = drt_jax.load_lens(view.lens), []
    for part in config.parts:
        field = math.radians(part * view.field_deg)
        scene = Scene.point(field, np.inf, (config.wavelength_um,))
        radius = float(spot(Setting(lens, scene, 0.0), 1e-3)[0])
        pixel = max(6 * radius, 12e-3 * config.wavelength_um) / _SIZE
        about = {"lens": pathlib.Path(view.lens).stem, "field_deg": part * view.field_deg}
        for name in config.quantities:
            quantity = QUANTITIES[name]
            truth, why = answered(quantity, Setting(lens, scene, pixel), quantity.finest)
            for dtype in config.dtypes:
                at = Setting(*jax.tree.map(lambda a: jnp.asarray(a, dtype), (lens, scene)), pixel)
                for tolerance in quantity.tolerances:
                    found, refused = (None, why) if why else answered(quantity, at, tolerance)
                    error = None if refused else quantity.error(found, truth)
                    row = {"quantity": name, "dtype": dtype, "tolerance": tolerance}
                    rows.append(about | row | {"error": error, "refused": refused})
    return rows


def answered(quantity: Quantity, at: Setting, tolerance: float) -> tuple[np.ndarray | None, str]:
    """The value in float64 or complex128, and ""; or None and the reason why there is no value."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the error shows a tolerance that is not reached
            found = np.asarray(quantity.value(at, tolerance))
    except ValueError as refusal:
        return None, str(refusal)
    return found.astype(np.promote_types(found.dtype, np.float64)), ""


def run(config: Config, run: Run) -> dict[str, Any]:
    """Measures lens after lens."""
    jobs = {view.lens: functools.partial(measure, config, view) for view in config.views}
    return {"rows": sum(_common.measured(run, "lens", jobs), []), "seconds": run.seconds}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Table of how often each tolerance is kept, by quantity and dtype, with the worst error."""
    lines = []
    for (quantity, dtype), rows in _common.grouped(results["rows"], "quantity", "dtype").items():
        ratios = [row["error"] / row["tolerance"] for row in rows if row["error"] is not None]
        kept = sum(ratio <= 1 for ratio in ratios)
        refused = sum(bool(row["refused"]) for row in rows)
        middle, worst = (f"{f(ratios):.2g}" if ratios else "" for f in (np.median, np.max))
        lines.append((quantity, dtype, len(rows), kept, len(ratios) - kept, refused, middle, worst))
    header = "quantity", "dtype", "asked", "kept", "missed", "refused"
    return {"requested": _common.table((*header, "error / tolerance", "at worst"), lines)}


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws error over tolerance, a panel for each quantity."""
    groups = _common.grouped(results["rows"], "quantity")
    with _plots.picture(figures / "requested.png", 4, 3.4, len(groups), 3) as axes:
        for ax, ((quantity,), rows) in zip(axes, groups.items()):
            ends = np.array([min(r["tolerance"] for r in rows), max(r["tolerance"] for r in rows)])
            ax.plot(ends, ends, "k-", linewidth=1, label="error = tolerance")
            for k, ((dtype,), some) in enumerate(_common.grouped(rows, "dtype").items()):
                found = [row for row in some if row["error"] is not None]
                x = np.array([row["tolerance"] for row in found]) * (0.94, 1.06)[k]
                y = np.maximum([row["error"] for row in found], 1e-3 * ends[0])
                lost = sum(bool(row["refused"]) for row in some)
                label = dtype + (f", {lost} of {len(some)} refused" if lost else "")
                ax.loglog(x, y, "ox"[k], color=f"C{k}", markersize=4, alpha=0.7, label=label)
            ax.set_title(quantity, fontsize=10)
            _plots.label_axes(ax, "tolerance asked for", "error", loc="best")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
