"""Run time against error of the spot size, its gradient and the centroid.

Compares our quadrature of increasing order with the patterns of other programs, traced by the same
code: random rays (also the paper's 256), a square grid, hexapolar rings and the Sobol sequence.
The reference is an integral over the sequential trace by Snell's law. Writes results.json, whose
`curves` has a row for each scene, method and number of rays, and draws error over time and over
rays. Columns of a row:

relative_error: relative error of the RMS spot radius sigma, for the worst wavelength.
centroid_error: distance of the centroids divided by sigma, for the worst wavelength.
gradient_error: error of the derivatives of sigma (mean over the wavelengths) by all curvatures, and
    by all thicknesses and the sensor position: norm of the difference divided by that of the
    reference, for the worse of the two groups.
seconds: median time of a compiled call.
gradient_seconds: the same for a call with gradients in reverse mode.
"""

import dataclasses
import functools
import math
import pathlib
import sys
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import drt_jax
from drt_jax import Lens, Scene, pupil
from drt_jax.pupil import PupilRule

from . import _command, _common, _plots
from ._common import Numbers, Wavelengths, different, grouped, not_empty, within
from ._reference import Moments, flatten, gradient_error, reference, relative_error, sigmas
from .runs.folder import Run

_QUADRATURE = "quadrature"
# For the table: the default tolerance, and the sizes of patterns.
_DEFAULT, _RANDOM, _MANY = 1e-6, 256, 16384
_SIZES = (16, 64, 256, 1024, 4096, 16384)
_order, _rays = within(1, 40), within(7, 1e7)  # one hexapolar ring has 7 rays


@dataclasses.dataclass(frozen=True)
class AccuracyScene:
    """A scene.

    lens: bundled name or YAML path.
    field_deg: field angle of the object.
    distance_m: distance of the object, .inf for infinity.
    defocus_mm: sensor position minus that of the best axial focus for the distance.
    front_mm, rear_mm: semi-diameters of the first and last surface; 0 for those of the lens.
    orders: orders for this scene, instead of those of the run.
    most_rays: number of rays of the largest pattern.
    """

    lens: str = "double_gauss"
    field_deg: Annotated[float, within(0, 89.9)] = 0.0
    distance_m: Annotated[float, within(1e-3, math.inf)] = 25.0
    defocus_mm: Annotated[float, within(-1e6, 1e6)] = 0.0
    front_mm: Annotated[float, within(0, 1e6)] = 0.0
    rear_mm: Annotated[float, within(0, 1e6)] = 0.0
    dtype: Literal["float64", "float32"] = "float64"
    orders: Annotated[tuple[int, ...], _order] = ()
    most_rays: Annotated[int, _rays] = 16384

    @property
    def vignetted(self) -> bool:
        """True if apertures other than the stop are meant to limit the beam."""
        return self.front_mm > 0 or self.rear_mm > 0

    @property
    def kind(self) -> tuple:
        """Key of scenes that are measured one after the other and share compiled programs."""
        return self.lens, self.dtype, self.vignetted

    @property
    def panel(self) -> str:
        """The panel of the scene in figures."""
        if self.dtype == "float32":
            return "float32"
        return "vignetted" if self.vignetted else "off axis" if self.field_deg else "on axis"

    @property
    def label(self) -> str:
        """The name of the scene in results and progress."""
        far = "inf" if math.isinf(self.distance_m) else f"{self.distance_m:g} m"
        words = [pathlib.Path(self.lens).stem, f"{self.field_deg:g} deg", far]
        words.append(f"{self.defocus_mm:+g} mm")
        if self.vignetted:
            words.append(f"clear {self.front_mm:g} {self.rear_mm:g} mm")
        return ", ".join([*words, "float32"] if self.dtype == "float32" else words)

    def rule(self, order: int) -> PupilRule:
        """The rule of an order that `converged_rule` would try."""
        kind = drt_jax.Clipped if self.vignetted else drt_jax.Gauss
        return kind(order, "bilateral" if self.field_deg else "rotational")


def _different_labels(scenes: tuple[AccuracyScene, ...]) -> str:
    return different(tuple(scene.label for scene in scenes))


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/accuracy.yaml.

    orders: orders of the quadrature.
    rays: nominal sizes of the patterns.
    seeds: number of random patterns, whose median error is reported.
    tolerances: tolerances of the rules that are tested.
    """

    scenes: Annotated[tuple[AccuracyScene, ...], not_empty, _different_labels]
    orders: Annotated[tuple[int, ...], not_empty, different, _order] = (1, 2, 4, 6, 9)
    rays: Annotated[tuple[int, ...], not_empty, different, _rays] = _SIZES
    seeds: Annotated[int, within(1, 1000)] = 3
    tolerances: Annotated[Numbers, within(1e-14, 0.5)] = (1e-3, 1e-4, 1e-6, 1e-8, 1e-10)
    wavelengths_um: Wavelengths = (0.53,)
    seed: int = 0


@jax.jit
def spot(lens: Lens, scene: Scene, rule: PupilRule) -> tuple[Array, Array]:
    """sigma (W,) and centroids (W, 2), mm."""
    moments = drt_jax.psf_moments(lens, scene, sampling=rule)
    return sigmas(moments), moments.mean


@jax.jit
def spot_and_gradients(lens: Lens, *rest: Any) -> tuple[tuple[Array, Array], Array]:
    """`spot`, and the derivatives (2, P) of sigma and of the height of the centroid, means over the
    wavelengths, in reverse mode."""

    def means(lens):
        sigma, mean = found = spot(lens, *rest)
        return jnp.stack([jnp.mean(sigma), jnp.mean(mean[:, 1])]), found

    _, back, found = jax.vjp(means, lens, has_aux=True)
    rows = jnp.eye(2, dtype=lens.sensor.dtype)
    return found, jax.vmap(lambda row: flatten(back(row)[0]))(rows)


def patterns(rays: int, seeds: int, dtype: Any) -> dict[str, list[PupilRule]]:
    """Patterns of other programs by method, with at most `rays` points. They are padded with points
    of weight 0, so that all share a compiled program. There are `seeds` random patterns."""
    sides = range(2 * math.isqrt(rays), 0, -1)
    side = next(n for n in sides if pupil.square_grid(n)[1].size <= rays)

    def padded(pattern):
        points, weights = pattern
        missing = rays - weights.size
        points, weights = np.pad(points, ((0, missing), (0, 0))), np.pad(weights, (0, missing))
        return drt_jax.Pattern(points.astype(dtype), weights.astype(dtype))

    return {
        "random": [padded(pupil.random_disc(rays, seed)) for seed in range(seeds)],
        "square grid": [padded(pupil.square_grid(side))],
        "hexapolar": [padded(pupil.hexapolar(_common.rings(rays)))],
        "Sobol": [padded(pupil.sobol_disc(rays))],
    }


def spot_errors(truth: Moments, sigma: Array, mean: Array) -> tuple[float, float]:
    """relative_error and centroid_error."""
    x, y = np.asarray(mean, float).T
    shift = np.hypot(x, y - truth.centroid) / truth.sigma
    return relative_error(truth, sigma), float(np.max(shift))


def row_of(arguments: tuple, truth: Moments, rules: Sequence[PupilRule]) -> dict:
    """A row of `curves` for rules of one kind and size: median of their errors, time of the first
    rule."""
    exact = np.mean(truth.gradient, axis=0)
    found = []
    for rule in rules:
        values, slopes = spot_and_gradients(*arguments, rule)
        pairs = zip(exact, np.asarray(slopes, float))
        wrong = [gradient_error(a, b, arguments[0].count) for a, b in pairs]
        found.append([*spot_errors(truth, *values), *wrong])
    names = ("relative_error", "centroid_error", "gradient_error", "centroid_gradient_error")
    errors = [None if math.isnan(error) else float(error) for error in np.median(found, axis=0)]
    calls = [functools.partial(f, *arguments, rules[0]) for f in (spot, spot_and_gradients)]
    times = dict(zip(("seconds", "gradient_seconds"), _common.medians(calls, 2)))
    return {"rays": count_rays(arguments, rules[0]), **dict(zip(names, errors)), **times}


def count_rays(arguments: tuple, rule: PupilRule) -> int:
    """Number of rays of the first wavelength whose weight is not 0."""
    weights = drt_jax.pupil.pupil_points(*arguments, rule)[1]
    return int(np.count_nonzero(np.asarray(weights)[0]))


def prepare(scene: AccuracyScene, wavelengths: tuple[float, ...]) -> tuple[tuple, Moments]:
    """The lens, focused on axis and with the clear apertures of the scene; its scene; and the
    reference."""
    lens = drt_jax.load_lens(scene.lens)
    distance, field = 1e3 * scene.distance_m, math.radians(scene.field_deg)
    spread = drt_jax.focus_moments(lens, Scene.point(0.0, distance, wavelengths), 1e-9).spread
    _, linear, square = np.sum(np.asarray(spread), axis=(1, 2))
    sensor = float(lens.sensor) - linear / (2 * square) + scene.defocus_mm
    semi = lens.semi_diameter
    for row, aperture in ((0, scene.front_mm), (-2, scene.rear_mm)):
        semi = semi.at[row].set(aperture or semi[row])
    lens = dataclasses.replace(lens, sensor=jnp.asarray(sensor, semi.dtype), semi_diameter=semi)
    lens = dataclasses.replace(lens, curved=(lens.stop,))  # gradients by every curvature
    truth = reference(lens, field, distance, wavelengths)
    if not scene.field_deg:  # exactly 0 by symmetry
        flat = truth.gradient * np.array([[1.0], [0.0]])
        truth = truth._replace(centroid=0 * truth.centroid, gradient=flat)
    arguments = lens, Scene.point(field, distance, wavelengths)
    return jax.tree.map(lambda a: jnp.asarray(a, scene.dtype), arguments), truth


def measure(config: Config, scene: AccuracyScene) -> dict[str, list[dict]]:
    """Measures one scene and returns its rows of results.json."""
    first = next(other for other in config.scenes if other.kind == scene.kind)
    if scene.vignetted or scene is first:
        jax.clear_caches()  # thousands of kernels exceed the memory maps of a process
    arguments, truth = prepare(scene, config.wavelengths_um)
    kinds = [(_QUADRATURE, n, [scene.rule(n)]) for n in scene.orders or config.orders]
    for size in (n for n in config.rays if n <= scene.most_rays):
        found = patterns(size, config.seeds, scene.dtype)
        kinds += [(name, size, rules) for name, rules in found.items()]
    curves = [{"method": n, "size": k} | row_of(arguments, truth, rules) for n, k, rules in kinds]
    tolerances = []
    for tolerance in config.tolerances:
        row = {"tolerance": tolerance, "order": None, "rays": None, "relative_error": None}
        tolerances.append(row)
        try:
            rule = drt_jax.converge(drt_jax.psf_moments, *arguments, tolerance)
        except ValueError as refusal:  # a tolerance that float32 cannot reach
            if scene.dtype == "float64":
                raise refusal
            continue
        error = spot_errors(truth, *spot(*arguments, rule))[0]
        row |= {"order": rule.order, "rays": count_rays(arguments, rule), "relative_error": error}
    known = {"wavelength_um": config.wavelengths_um, "sigma_mm": truth.sigma}
    known |= {"centroid_mm": truth.centroid, "reference_error": truth.error}
    known |= {"reference_gradient_error": truth.gradient_error}
    exact = [dict(zip(known, row)) for row in zip(*known.values())]
    about = {"scene": scene.label, "panel": scene.panel, "dtype": scene.dtype}
    found = {"curves": curves, "tolerances": tolerances, "truth": exact}
    return {key: [about | row for row in rows] for key, rows in found.items()}


def run(config: Config, run: Run) -> dict[str, Any]:
    """Measures all scenes."""
    jobs = {s.label: functools.partial(measure, config, s) for s in config.scenes}
    found = _common.measured(run, "scene", jobs)
    results = {key: sum((rows[key] for rows in found), []) for key in found[0]}
    return results | {"seconds": run.seconds}


def middle(rows: list[dict], key: str) -> float:
    """Median of a number over scenes."""
    return float(np.median([row[key] for row in rows]))


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Tables of methods by panel, and of rays and errors by tolerance."""
    lines = []
    for (panel,), some in grouped(results["curves"], "panel").items():
        for method, rows in shown(grouped(some, "method", "size")):
            error, slope = (f"{middle(rows, k):.1e}" for k in ("relative_error", "gradient_error"))
            rays, time = int(middle(rows, "rays")), _common.duration(middle(rows, "seconds"))
            lines.append((panel, method, rays, error, slope, time))
    header = "scenes", "method", "rays a colour", "error of sigma", "of its gradient", "a call"
    tolerances, costs = results["tolerances"], []
    for (panel,), some in grouped(tolerances, "panel").items():
        cells = [panel]
        for rows in grouped(some, "tolerance").values():
            kept = [row for row in rows if row["rays"] is not None]
            worst = max((row["relative_error"] for row in kept), default=0)
            most = max((row["rays"] for row in kept), default=0)
            cells.append(f"{most}, {worst:.1e}" if len(kept) == len(rows) else "refused")
        costs.append(cells)
    first = "most rays a colour, worst error"
    columns = [f"{tolerance:.0e}" for (tolerance,) in grouped(tolerances, "tolerance")]
    return {
        "accuracy": _common.table(header, lines),
        "accuracy, tolerances": _common.table((first, *columns), costs),
    }


def shown(groups: dict[tuple, list[dict]]) -> list[tuple[str, list[dict]]]:
    """Selects from rows by (method, size): the first two orders within the default tolerance, the
    paper's random rays, and the best large pattern."""
    errors = {kind: middle(rows, "relative_error") for kind, rows in groups.items()}
    rules = [kind for kind in groups if kind[0] == _QUADRATURE]
    chosen = [kind for kind in rules if errors[kind] < _DEFAULT][:2] or rules[-1:]
    chosen += [kind for kind in groups if kind == ("random", _RANDOM)]
    large = [kind for kind in groups if kind[0] != "random" and kind[1] == _MANY]
    chosen += sorted(large, key=errors.__getitem__)[:1]
    return [(kind[0], groups[kind]) for kind in chosen]


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws error over time and over rays, median and range, a panel for each group of scenes."""
    groups = grouped(results["curves"], "panel")
    for name, x, y, xlabel, ylabel in (
        ("time_error", "seconds", "relative_error", "time of a call (ms)", "σ"),
        ("rays_error", "rays", "relative_error", "rays a colour", "σ"),
        ("gradient_error", "rays", "gradient_error", "rays a colour", "dσ"),
    ):
        with _plots.picture(figures / f"{name}.png", 5.2, 3.9, len(groups)) as axes:
            for ax, ((panel,), rows) in zip(axes, groups.items()):
                draw_panel(ax, rows, x, y, (xlabel, f"error of {ylabel}, relative"))
                count = len(grouped(rows, "scene"))
                ax.set_title(f"{panel}, {count} scene{'s' * (count != 1)}", fontsize=10)
    keys = "reference_error", "reference_gradient_error"
    error, slope = (max(row[key] for row in results["truth"]) for key in keys)
    print(f"\nerrors of the reference, at most: values {error:.0e}, gradients {slope:.0e}")


def draw_panel(axes: Any, rows: list[dict], x: str, y: str, labels: tuple[str, str]) -> None:
    """Draws column y over column x of the scenes of a panel, by method."""
    curves, note = {}, None
    for (method,), some in grouped(rows, "method").items():
        groups = sorted(grouped(some, "size").items())
        # Sizes that only few scenes have would distort the line of the median.
        most = max(len(group) for _, group in groups)
        groups = [(size, group) for (size,), group in groups if 2 * len(group) >= most]
        across = [middle(group, x) * (1e3 if x == "seconds" else 1) for _, group in groups]
        curves[method] = across, [[row[y] for row in group] for _, group in groups]
        for place, (size, group) in zip(across, groups):
            if (method, size) == ("random", _RANDOM):
                note = place, middle(group, y), f"the paper's {_RANDOM} rays"
    _plots.error_curves(axes, curves, *labels, note)


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
