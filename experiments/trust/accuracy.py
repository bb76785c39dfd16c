"""Run time against error of the spot size, its gradient and the centroid.

Our quadrature by its order stands beside what other programs sum over: random rays (the paper's
256 among them), a square grid, hexapolar rings and the Sobol sequence, traced by the same code.
The truth is an integral over the sequential Snell trace. Writes results.json, whose `curves` has
a row for each scene, method and number of rays, and draws error over time and over rays.

relative_error: of the RMS spot radius sigma, the worst colour. centroid_error: distance between
the centroids over sigma, the worst colour. gradient_error: of the derivatives of sigma (mean of
the colours) by all curvatures, and by all thicknesses and the sensor position: the norm of the
difference over that of the reference, the worse of the two groups. seconds: median time of a
compiled call; gradient_seconds: of one with its gradient in reverse mode.
"""

import dataclasses
import math
import pathlib
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import Lens, pupil, show
from drt_jax.runs.folder import Run

from . import _command, _common
from ._methods import measured, padded, patterns, programs, rays_of
from ._reference import Moments, reference

_QUADRATURE = "quadrature"
_ERRORS = ("relative_error", "centroid_error", "gradient_error", "centroid_gradient_error")
_COLUMNS = ("rays", *_ERRORS, "seconds", "gradient_seconds")
_PROMISE = ("order", "rays", "relative_error")
_TRUTH = ("sigma_mm", "centroid_mm", "reference_error", "reference_gradient_error")
_PANELS = ("on axis", "off axis", "vignetted", "float32")
# Patterns are filled up to these sizes where only errors count, to be compiled once each.
_SHAPES = (1024, 16384)
# What the table shows: the default tolerance, and patterns of so many rays.
_DEFAULT, _RANDOM, _MANY = 1e-6, 256, 16384


@dataclasses.dataclass(frozen=True)
class AccuracyScene:
    """What is measured.

    lens: bundled name or YAML path.
    field_deg: angle of the object point.
    distance_m: to the object (.inf: infinity).
    defocus_mm: of the sensor, from the best focus on axis of an object at distance_m.
    front_mm, rear_mm: semi-diameters of the first and last surface, 0 for the lens's own.
    dtype: of everything.
    orders: of the quadrature, instead of the run's.
    most_rays: the largest pattern of this scene.
    """

    lens: str = "double_gauss"
    field_deg: float = 0.0
    distance_m: float = 25.0
    defocus_mm: float = 0.0
    front_mm: float = 0.0
    rear_mm: float = 0.0
    dtype: Literal["float64", "float32"] = "float64"
    orders: tuple[int, ...] = ()
    most_rays: int = 16384

    def __post_init__(self) -> None:
        _common.require(self.distance_m > 0, "scenes.distance_m: must be positive")
        _common.require(min(self.front_mm, self.rear_mm) >= 0, "scenes.front_mm: must be 0 or more")
        _common.require(self.field_deg >= 0, "scenes.field_deg: must be 0 or more")

    @property
    def axial(self) -> bool:
        """Whether the object is on the axis."""
        return self.field_deg == 0

    @property
    def vignetted(self) -> bool:
        """Whether apertures other than the stop are meant to limit the beam."""
        return self.front_mm > 0 or self.rear_mm > 0

    @property
    def panel(self) -> str:
        """The panel of the figures that the scene belongs to."""
        if self.dtype == "float32":
            return "float32"
        return "vignetted" if self.vignetted else "on axis" if self.axial else "off axis"

    @property
    def label(self) -> str:
        """A name of its own for results and progress."""
        far = "inf" if math.isinf(self.distance_m) else f"{self.distance_m:g} m"
        words = [pathlib.Path(self.lens).stem, f"{self.field_deg:g} deg", far]
        words.append(f"{self.defocus_mm:+g} mm")
        if self.vignetted:
            words.append(f"clear {self.front_mm:g} {self.rear_mm:g} mm")
        return ", ".join([*words, *(["float32"] if self.dtype == "float32" else [])])

    def rule(self, order: int) -> drt_jax.PupilRule:
        """The rule of an order that `converged_rule` would try."""
        kind = pupil.Clipped if self.vignetted else pupil.Gauss
        return kind(order, "meridian" if self.axial else "half")


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/accuracy.yaml.

    scenes: what is measured. orders: of the quadrature. rays: nominal sizes of the patterns.
    seeds: how many random patterns, of which the median counts. tolerances: to be kept.
    wavelengths_um: of the colours.
    """

    scenes: tuple[AccuracyScene, ...]
    orders: tuple[int, ...] = (1, 2, 4, 6, 9)
    rays: tuple[int, ...] = (16, 64, 256, 1024, 4096, 16384)
    seeds: int = 3
    tolerances: tuple[float, ...] = (1e-3, 1e-4, 1e-6, 1e-8, 1e-10)
    wavelengths_um: tuple[float, ...] = (0.53,)
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("orders", "rays", "tolerances", "wavelengths_um"):
            _common.require_list(name, getattr(self, name))
        _common.require(len(self.scenes) > 0, "scenes: needs at least one item")
        labels = {scene.label for scene in self.scenes}
        _common.require(len(labels) == len(self.scenes), "scenes: an item stands twice")
        _common.require(min(self.rays) >= 7, "rays: must be at least 7, one hexapolar ring")
        every = [*self.orders, *(order for scene in self.scenes for order in scene.orders)]
        _common.require(min(every) >= 1 and max(every) <= 40, "orders: expected 1 to 40")
        _common.require(self.seeds >= 1, "seeds: must be at least 1")

    def orders_of(self, scene: AccuracyScene) -> tuple[int, ...]:
        """The orders of the quadrature that a scene is measured with."""
        return scene.orders or self.orders

    def sizes_of(self, scene: AccuracyScene) -> list[int]:
        """The nominal sizes of the patterns that a scene is measured with."""
        return [rays for rays in self.rays if rays <= scene.most_rays]


def errors(truth: list[Moments], colours: tuple, gradients: list, surfaces: int) -> list[float]:
    """The four errors of `_ERRORS`; NaN for what was not computed or has no scale."""
    sigma = np.array([moments.sigma for moments in truth])
    centroid = np.array([moments.centroid for moments in truth])
    got, mean = (np.asarray(a, float) for a in colours)
    shift = np.hypot(mean[:, 0], mean[:, 1] - centroid) / sigma
    values = [float(np.max(np.abs(got / sigma - 1))), float(np.max(shift))]
    exact = np.mean([moments.gradient for moments in truth], axis=0)
    for k in range(2):
        if k >= len(gradients) or (k == 1 and not np.any(centroid)):
            values.append(math.nan)
            continue
        groups = slice(0, surfaces), slice(surfaces, None)
        wrong = np.asarray(gradients[k], float) - exact[k]
        norms = [np.linalg.norm(wrong[g]) / np.linalg.norm(exact[k][g]) for g in groups]
        values.append(float(np.max(norms)))
    return values


@dataclasses.dataclass(frozen=True)
class Setting:
    """A scene made ready.

    scene: what it is. lens: in the precision of the scene. arguments: field and distance, arrays.
    wavelengths: um. truth: of each colour.
    """

    scene: AccuracyScene
    lens: Lens
    arguments: tuple
    wavelengths: tuple[float, ...]
    truth: list[Moments]

    def measure(self, gradient: Callable, pattern: tuple = ()) -> list[float]:
        """Errors (4,) of one method, a function of `programs`."""
        rows = np.eye(1 if self.scene.axial else 2, 2)
        rows = jnp.asarray(rows, self.lens.sensor.dtype)
        found = [gradient(self.lens, *self.arguments, *pattern, row) for row in rows]
        return errors(self.truth, found[0][0], [slope for _, slope in found], self.lens.count)

    def seconds(self, program: Callable, *rest: Any) -> float:
        """Median time of a call of a compiled program."""
        return _common.medians([lambda: program(self.lens, *self.arguments, *rest)], 2)[0]


def prepare(scene: AccuracyScene, wavelengths: tuple[float, ...]) -> Setting:
    """Read the lens, focus it on axis, clip it, and integrate the reference."""
    lens = drt_jax.load_lens(scene.lens)
    distance, field = 1e3 * scene.distance_m, math.radians(scene.field_deg)
    spread = drt_jax.focus_moments(lens, 0.0, distance, wavelengths, 1e-9).spread
    _, linear, square = np.sum(np.asarray(spread), axis=(1, 2))
    sensor = float(lens.sensor) - linear / (2 * square) + scene.defocus_mm
    semi = lens.semi_diameter
    for row, aperture in ((0, scene.front_mm), (-2, scene.rear_mm)):
        semi = semi.at[row].set(aperture or semi[row])
    lens = dataclasses.replace(lens, sensor=jnp.asarray(sensor, semi.dtype), semi_diameter=semi)
    truth = reference(lens, field, distance, wavelengths)
    if scene.axial:  # by symmetry; what the integral leaves is rounding
        truth = [moments._replace(centroid=0.0) for moments in truth]
    dtype = jnp.dtype(scene.dtype)
    lens = jax.tree.map(lambda a: a.astype(dtype), lens)
    arguments = jnp.asarray(field, dtype), jnp.asarray(distance, dtype)
    return Setting(scene, lens, arguments, wavelengths, truth)


def rule_row(setting: Setting, order: int) -> list[float]:
    """A row of `_COLUMNS` for the quadrature of an order."""
    scene, row = setting.scene, jnp.asarray([1.0, 0.0], setting.lens.sensor.dtype)
    rule = scene.rule(order)
    value, gradient = programs(rule, scene.axial, setting.wavelengths)
    rays = rays_of(rule, setting.lens, *setting.arguments, setting.wavelengths)
    found = setting.measure(gradient)
    return [rays, *found, setting.seconds(value), setting.seconds(gradient, row)]


def pattern_rows(setting: Setting, size: int, config: Config) -> list[list[float]]:
    """Rows of `_COLUMNS` for the patterns of a nominal size, on which alone time depends."""
    scene, dtype = setting.scene, setting.lens.sensor.dtype
    value, gradient = programs(None, scene.axial, setting.wavelengths)
    choices = patterns(size, config.seeds)
    seconds = setting.seconds(value, *padded(*choices["random"][0], size, dtype))
    shapes = sorted({n for n in config.rays if n in _SHAPES} | {max(config.rays)})
    shape = next(n for n in shapes if n >= size)
    rows = []
    for some in choices.values():
        found = [setting.measure(gradient, padded(*pattern, shape, dtype)) for pattern in some]
        rows.append([some[0][1].size, *np.median(found, axis=0), seconds, math.nan])
    return rows


def tolerances(config: Config, setting: Setting) -> np.ndarray:
    """(T, 3): of each requested tolerance the order, the rays a colour and the error of sigma."""
    rows = []
    field = 0.0 if setting.scene.axial else setting.arguments[0]
    arguments = setting.lens, field, setting.arguments[1], config.wavelengths_um
    for tolerance in config.tolerances:
        rule = drt_jax.converged_rule(*arguments, tolerance)
        colours = measured(*drt_jax.psf_moments(*arguments, rule=rule))[1]
        error = errors(setting.truth, colours, [], setting.lens.count)[0]
        rows.append([rule.order, rays_of(rule, *arguments), error])
    return np.array(rows, float)


def measure(config: Config, scene: AccuracyScene, run: Run) -> dict[str, np.ndarray]:
    """Everything about one scene, rows as in results.json; logs its curves."""
    setting = prepare(scene, config.wavelengths_um)
    curves = [rule_row(setting, order) for order in config.orders_of(scene)]
    for size in config.sizes_of(scene):
        curves += pattern_rows(setting, size, config)
    run.log(scene.label, 0, dict(zip(_COLUMNS, np.array(curves, float).T)))
    truth = [(m.sigma, m.centroid, m.error, m.gradient_error) for m in setting.truth]
    return {
        "curves": np.array(curves, float),
        "tolerances": tolerances(config, setting),
        "truth": np.array(truth),
    }


def run(config: Config, run: Run) -> dict[str, Any]:
    """Measure all scenes, one after the other."""
    results: dict[str, list] = {"curves": [], "tolerances": [], "truth": []}
    kind: tuple = ()
    bar = tqdm(config.scenes, unit="scene", dynamic_ncols=True)
    for scene in bar:
        bar.set_description(scene.label)
        kind, before = (scene.lens, scene.dtype, scene.vignetted), kind
        if kind != before:  # thousands of kernels exhaust what a process may map
            jax.clear_caches()
        found = _common.remembered(run, scene.label, results, lambda: measure(config, scene, run))
        methods = [(_QUADRATURE, order) for order in config.orders_of(scene)]
        methods += [(name, size) for size in config.sizes_of(scene) for name in patterns(16, 1)]
        base = {"scene": scene.label, "panel": scene.panel, "dtype": scene.dtype}
        for key, names, firsts in (
            ("curves", _COLUMNS, [{"method": name, "size": size} for name, size in methods]),
            ("tolerances", _PROMISE, [{"tolerance": t} for t in config.tolerances]),
            ("truth", _TRUTH, [{"wavelength_um": w} for w in config.wavelengths_um]),
        ):
            for first, row in zip(firsts, found[key].tolist()):
                results[key].append(base | first | dict(zip(names, map(plain, row))))
    return results | {"seconds": run.seconds}


def plain(value: float) -> float | int | None:
    """A number for results.json: whole ones as such, None for NaN."""
    if math.isnan(value):
        return None
    return int(value) if value.is_integer() and value else value


def middle(rows: list[dict], key: str) -> float:
    """The median over scenes of a number that is known of all."""
    return float(np.median([row[key] for row in rows]))


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Methods by panel, and what the promised tolerances cost and kept."""
    lines = []
    for panel in _PANELS:
        groups: dict[tuple[str, int], list[dict]] = {}
        for row in results["curves"]:
            if row["panel"] == panel:
                groups.setdefault((row["method"], row["size"]), []).append(row)
        for (method, _), some in shown(groups):
            error, slope = (f"{middle(some, k):.1e}" for k in ("relative_error", "gradient_error"))
            rays, time = int(middle(some, "rays")), _common.duration(middle(some, "seconds"))
            lines.append((panel, method, rays, error, slope, time))
    header = "scenes", "method", "rays a colour", "error of sigma", "of its gradient", "a call"
    kept, promised = [], []
    for panel in _PANELS:
        some = [p for p in results["tolerances"] if p["panel"] == panel]
        promised = list(dict.fromkeys(p["tolerance"] for p in some)) or promised
        cells = []
        for tolerance in promised:
            here = [p for p in some if p["tolerance"] == tolerance]
            worst, most = (max(p[k] for p in here) for k in ("relative_error", "rays"))
            cells.append(f"{most}, {worst:.1e}")
        kept.append((panel, *cells))
    return {
        "accuracy": _common.table(header, lines),
        "accuracy, tolerances": _common.table(
            ("most rays a colour, worst error", *(f"{t:.0e}" for t in promised)), kept
        ),
    }


def shown(groups: dict[tuple[str, int], list[dict]]) -> list[tuple[tuple[str, int], list[dict]]]:
    """Of the measured (method, size): the first two orders within the default tolerance, random
    rays as in the paper, and the best of large patterns."""
    rules = [k for k, rows in groups.items() if k[0] == _QUADRATURE]
    chosen = [k for k in rules if middle(groups[k], "relative_error") < _DEFAULT][:2] or rules[-1:]
    chosen += [k for k in groups if k == ("random", _RANDOM)]
    large = [k for k in groups if k[0] not in (_QUADRATURE, "random") and k[1] == _MANY]
    chosen += sorted(large, key=lambda k: middle(groups[k], "relative_error"))[:1]
    return [(k, groups[k]) for k in chosen]


def report(results: dict[str, Any], figures: pathlib.Path) -> str:
    """Draw error over time and over rays, a panel for each group of scenes; median and range."""
    rows = results["curves"]
    panels = [p for p in _PANELS if any(r["panel"] == p for r in rows)]
    for name, x, y, xlabel, ylabel in (
        ("time_error", "seconds", "relative_error", "time of a call (ms)", "σ"),
        ("rays_error", "rays", "relative_error", "rays a colour", "σ"),
        ("gradient_error", "rays", "gradient_error", "rays a colour", "dσ"),
    ):
        columns = min(2, len(panels))
        figure, axes = show.new(-(-len(panels) // columns), columns, 5.2, 3.9)
        for ax in np.ravel(axes)[len(panels) :]:
            ax.set_visible(False)
        for ax, panel in zip(np.ravel(axes), panels):
            here = [r for r in rows if r["panel"] == panel]
            draw_panel(ax, here, x, y, (xlabel, f"error of {ylabel}, relative"))
            count = len({r["scene"] for r in here})
            ax.set_title(f"{panel}, {count} scene{'s' * (count != 1)}", fontsize=10)
        figure.savefig(figures / f"{name}.png")
    error, slope = (max(t[key] for t in results["truth"]) for key in _TRUTH[2:])
    truth = f"errors of the reference, at most: values {error:.0e}, gradients {slope:.0e}"
    return "\n\n".join([*tables(results).values(), truth])


def draw_panel(axes: Any, rows: list[dict], x: str, y: str, labels: tuple[str, str]) -> None:
    """Column y over column x of the scenes of a panel, by method."""
    curves, note = {}, None
    for method in dict.fromkeys(r["method"] for r in rows):
        some = [r for r in rows if r["method"] == method]
        groups = {k: [r for r in some if r["size"] == k] for k in {r["size"] for r in some}}
        # A size that few scenes have would bend the line of their median.
        most = max(map(len, groups.values()))
        groups = {k: g for k, g in sorted(groups.items()) if 2 * len(g) >= most}
        across = {k: middle(g, x) * (1e3 if x == "seconds" else 1) for k, g in groups.items()}
        curves[method] = list(across.values()), [[r[y] for r in g] for g in groups.values()]
        if method == "random" and _RANDOM in groups:
            place = across[_RANDOM], middle(groups[_RANDOM], y)
            note = *place, f"the paper's {_RANDOM} rays"
    show.error_curves(axes, curves, *labels, note)


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    _command.main("accuracy", Config, _COLUMNS, run, report, argv)


if __name__ == "__main__":
    main()
