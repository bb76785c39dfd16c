"""Run time against error of the spot size, its gradient and the centroid.

Our quadrature by its order stands beside what other programs sum over: random rays (the paper's
256 among them), a square grid, hexapolar rings and the Sobol sequence, traced by the same code.
The truth is an integral over the sequential Snell trace. Writes results.json, whose `curves` has
a row for each scene, method and number of rays, and pictures of error over time and over rays.

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
from drt_jax import Lens
from drt_jax.show import plot
from drt_jax.runs.folder import Run

from . import _common
from ._methods import (
    fitted_rule,
    measured,
    padded,
    patterns,
    pupil_points,
    quadrature,
    sampled,
    seconds,
)
from ._reference import Moments, reference

_QUADRATURE = "quadrature"
_ERRORS = ("relative_error", "centroid_error", "gradient_error", "centroid_gradient_error")
_COLUMNS = ("rays", *_ERRORS, "seconds", "gradient_seconds")
_PANEL_TITLES = ("on axis", "off axis", "vignetted", "float32")
# Patterns are filled up to these sizes where only errors count, to be compiled once each.
_SHAPES = (1024, 16384)


@dataclasses.dataclass(frozen=True)
class AccuracyScene:
    """lens: bundled name or YAML path. defocus_mm: of the sensor, from the best focus on axis of
    an object at distance_m (.inf: infinity). front_mm, rear_mm: semi-diameters of the first and
    last surface, 0 for the lens's own. orders: of the quadrature, instead of the run's.
    most_rays: the largest pattern of this scene."""

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
    def vignetted(self) -> bool:
        """Whether apertures other than the stop are meant to limit the beam."""
        return self.front_mm > 0 or self.rear_mm > 0

    @property
    def panel(self) -> str:
        """The panel of the figures that the scene belongs to."""
        if self.dtype == "float32":
            return "float32"
        return "vignetted" if self.vignetted else "off axis" if self.field_deg else "on axis"

    @property
    def label(self) -> str:
        """A name of its own for results and progress."""
        far = "inf" if math.isinf(self.distance_m) else f"{self.distance_m:g} m"
        words = [pathlib.Path(self.lens).stem, f"{self.field_deg:g} deg", far]
        words.append(f"{self.defocus_mm:+g} mm")
        if self.vignetted:
            words.append(f"clear {self.front_mm:g} {self.rear_mm:g} mm")
        return ", ".join([*words, *(["float32"] if self.dtype == "float32" else [])])


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/accuracy.yaml."""

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
        _common.require(1 <= min(every) and max(every) <= 40, "orders: expected 1 to 40")
        _common.require(self.seeds >= 1, "seeds: must be at least 1")


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
    """A scene made ready: the lens in its precision, numbers, and the truth of each colour."""

    scene: AccuracyScene
    lens: Lens
    arguments: tuple
    truth: list[Moments]

    def measure(self, gradient: Callable, extra: tuple = (), value: Callable | None = None):
        """Errors (4,) of one method; of its values as `gradient` returns them, or `value` does."""
        arguments = (self.lens, *self.arguments, *extra)
        rows = np.eye(1 if self.scene.field_deg == 0 else 2, 2)
        found = [gradient(*arguments, jnp.asarray(r, self.lens.sensor.dtype)) for r in rows]
        colours = found[0][0] if value is None else value(*arguments)
        return errors(self.truth, colours, [f[1] for f in found], self.lens.curvature.size)


def prepare(scene: AccuracyScene, wavelengths: tuple[float, ...]) -> Setting:
    """Read the lens, focus it on axis, clip it, and integrate the reference."""
    lens = drt_jax.load_lens(scene.lens)
    distance, field = 1e3 * scene.distance_m, math.radians(scene.field_deg)
    spread = drt_jax.focus_moments(lens, 0.0, distance, wavelengths, 1e-9).spread
    _, linear, square = np.sum(np.asarray(spread), axis=(1, 2))
    sensor = float(lens.sensor) - linear / (2 * square) + scene.defocus_mm
    semi = lens.semi_diameter
    if scene.front_mm:
        semi = semi.at[0].set(scene.front_mm)
    if scene.rear_mm:
        semi = semi.at[-1].set(scene.rear_mm)
    lens = dataclasses.replace(lens, sensor=jnp.asarray(sensor, semi.dtype), semi_diameter=semi)
    truth = reference(lens, field, distance, wavelengths)
    if not scene.field_deg:  # by symmetry; what the integral leaves is rounding
        truth = [moments._replace(centroid=0.0) for moments in truth]
    dtype = jnp.dtype(scene.dtype)
    lens = jax.tree.map(lambda a: a.astype(dtype), lens)
    return Setting(scene, lens, (jnp.asarray(field, dtype), jnp.asarray(distance, dtype)), truth)


def methods(config: Config, scene: AccuracyScene) -> list[tuple[str, int]]:
    """What one scene is measured with: (method, order or nominal number of rays)."""
    rows = [(_QUADRATURE, order) for order in scene.orders or config.orders]
    counts = [rays for rays in config.rays if rays <= scene.most_rays]
    return rows + [(name, rays) for rays in counts for name in patterns(16, 1)]


def curves(config: Config, setting: Setting, advance: Callable[[], Any]) -> np.ndarray:
    """Rows of `_COLUMNS`, one for each of `methods`."""
    scene, rows = setting.scene, []
    arguments = (setting.lens, *setting.arguments)
    row = jnp.asarray([1.0, 0.0], setting.lens.sensor.dtype)
    axial = scene.field_deg == 0
    shapes = sorted({n for n in config.rays if n in _SHAPES} | {max(config.rays)})
    nominal, timed = 0, (math.nan, math.nan)
    for method, size in methods(config, scene):
        if method == _QUADRATURE:
            rule, order = None, size
            if scene.vignetted:
                rule, order = fitted_rule(size, axial, config.wavelengths_um, *arguments), None
            value, gradient = quadrature(order, axial, config.wavelengths_um)
            found = setting.measure(gradient, (rule,), value=value)
            calls = lambda: value(*arguments, rule), lambda: gradient(*arguments, rule, row)
            rows.append([pupil_points(rule or size, axial), *found, *map(seconds, calls)])
        else:
            value, gradient = sampled(config.wavelengths_um)
            choices = patterns(size, config.seeds)[method]
            if size != nominal:  # the time of a pattern depends on its size alone
                extra = padded(*choices[0], size, row.dtype)
                jax.block_until_ready(value(*arguments, *extra))
                nominal, timed = size, (seconds(lambda: value(*arguments, *extra)), math.nan)
            shape = next(n for n in shapes if n >= size)
            found = [
                setting.measure(gradient, padded(*pattern, shape, row.dtype)) for pattern in choices
            ]
            rows.append([choices[0][1].size, *np.median(found, axis=0), *timed])
        advance()
    return np.array(rows, float)


def tolerances(config: Config, setting: Setting) -> np.ndarray:
    """(T, 3): of each requested tolerance the order, the rays a colour and the error of sigma."""
    scene, rows = setting.scene, []
    field = 0.0 if scene.field_deg == 0 else setting.arguments[0]
    arguments = setting.lens, field, setting.arguments[1], config.wavelengths_um
    for tolerance in config.tolerances:
        order = drt_jax.pupil_order(*arguments, tolerance)
        colours = measured(*drt_jax.psf_moments(*arguments, order=order))[1]
        error = errors(setting.truth, colours, [], setting.lens.curvature.size)[0]
        rays = pupil_points(order, scene.field_deg == 0)
        rows.append([getattr(order, "order", order), rays, error])
    return np.array(rows, float)


def run(config: Config, run: Run) -> None:
    """Measure all scenes, one after the other, draw and print what was found."""
    rows: list[dict] = []
    promises: list[dict] = []
    truths: list[dict] = []
    kind: tuple = ()
    total = sum(len(methods(config, scene)) + 1 for scene in config.scenes)
    with tqdm(total=total, unit="method", dynamic_ncols=True) as bar:
        for scene in config.scenes:
            bar.set_description(scene.label)
            names = methods(config, scene)
            empty = {
                "curves": np.zeros((len(names), len(_COLUMNS))),
                "tolerances": np.zeros((len(config.tolerances), 3)),
                "truth": np.zeros((len(config.wavelengths_um), 4)),
            }
            step, found = run.load(scene.label, empty, (scene.label,))
            if step:
                bar.update(len(names) + 1)
            else:
                kind, before = (scene.lens, scene.dtype, scene.vignetted), kind
                if kind != before:  # thousands of kernels exhaust what a process may map
                    jax.clear_caches()
                setting = prepare(scene, config.wavelengths_um)
                bar.update()
                found = {
                    "curves": curves(config, setting, bar.update),
                    "tolerances": tolerances(config, setting),
                    "truth": np.array(
                        [(m.sigma, m.centroid, m.error, m.gradient_error) for m in setting.truth]
                    ),
                }
                run.save(scene.label, 1, found)
                run.log(scene.label, 0, dict(zip(_COLUMNS, found["curves"].T)))
            base = {"scene": scene.label, "panel": scene.panel, "dtype": scene.dtype}
            for (method, size), values in zip(names, np.asarray(found["curves"])):
                numbers = [None if math.isnan(v) else float(v) for v in values[1:]]
                row = {**base, "method": method, "size": size, "rays": int(values[0])}
                rows.append({**row, **dict(zip(_COLUMNS[1:], numbers))})
            for tolerance, values in zip(config.tolerances, np.asarray(found["tolerances"])):
                numbers = {"order": int(values[0]), "rays": int(values[1])}
                numbers["relative_error"] = float(values[2])
                promises.append({**base, "tolerance": tolerance, **numbers})
            for colour, values in zip(config.wavelengths_um, np.asarray(found["truth"])):
                keys = ("sigma_mm", "centroid_mm", "reference_error", "reference_gradient_error")
                numbers = dict(zip(keys, map(float, values)))
                truths.append({**base, "wavelength_um": colour, **numbers})
    path = run.finish(
        {"curves": rows, "tolerances": promises, "truth": truths, "seconds": run.seconds}
    )
    summary(rows, promises, truths)
    print(f"results in {path}")
    for item in draw(run, rows):
        print(f"figure {item}")


def summary(rows: list[dict], promises: list[dict], truths: list[dict]) -> None:
    """Print the worst and the typical scene of each panel."""
    lines = []
    for panel in _PANEL_TITLES:
        for method, size in dict.fromkeys((r["method"], r["size"]) for r in rows):
            if method != _QUADRATURE and size not in (256, 16384):
                continue
            wanted = panel, method, size
            some = [r for r in rows if (r["panel"], r["method"], r["size"]) == wanted]
            if some:
                rays, error, slope, time_ = (
                    float(np.median([r[key] for r in some]))
                    for key in ("rays", "relative_error", "gradient_error", "seconds")
                )
                worst = max(r["relative_error"] for r in some)
                lines.append((panel, method, int(rays), error, slope, worst, 1e3 * time_))
    header = ("scenes", "method", "rays", "sigma error", "gradient error", "worst sigma", "ms")
    print(_common.table(header, lines))
    lines = []
    for panel in _PANEL_TITLES:
        for tolerance in dict.fromkeys(p["tolerance"] for p in promises):
            some = [p for p in promises if (p["panel"], p["tolerance"]) == (panel, tolerance)]
            if some:
                most = max(p["rays"] for p in some)
                lines.append((panel, tolerance, most, max(p["relative_error"] for p in some)))
    print(_common.table(("scenes", "tolerance", "most rays", "worst sigma error"), lines))
    error = max(t["reference_error"] for t in truths)
    gradient = max(t["reference_gradient_error"] for t in truths)
    print(f"errors of the reference, at most: values {error:.0e}, gradients {gradient:.0e}")


def draw(run: Run, rows: list[dict]) -> list:
    """Error over time and over rays, a panel for each group of scenes; median and range."""
    paths, panels = [], [p for p in _PANEL_TITLES if any(r["panel"] == p for r in rows)]
    for name, x, y, xlabel in (
        ("time_error", "seconds", "relative_error", "time of a call (ms)"),
        ("rays_error", "rays", "relative_error", "rays a colour"),
        ("gradient_error", "rays", "gradient_error", "rays a colour"),
    ):
        ylabel = "error of σ, relative" if y == "relative_error" else "error of dσ, relative"
        columns = min(2, len(panels))
        figure, axes = plot.new(-(-len(panels) // columns), columns, 5.2, 3.9)
        for ax in np.ravel(axes)[len(panels) :]:
            ax.set_visible(False)
        for ax, panel in zip(np.ravel(axes), panels):
            curves, note = {}, None
            here = [r for r in rows if r["panel"] == panel]
            for method in dict.fromkeys(r["method"] for r in here):
                some = [r for r in here if r["method"] == method]
                groups = {k: [r for r in some if r["size"] == k] for k in {r["size"] for r in some}}
                # A size that few scenes have would bend the line of their median.
                most = max(map(len, groups.values()))
                groups = {k: g for k, g in sorted(groups.items()) if 2 * len(g) >= most}
                scale = 1e3 if x == "seconds" else 1.0
                across = [scale * float(np.median([r[x] for r in g])) for g in groups.values()]
                curves[method] = across, [[r[y] for r in g] for g in groups.values()]
                if method == "random" and 256 in groups:
                    k = list(groups).index(256)
                    note = across[k], float(np.median(curves[method][1][k])), "the paper's 256 rays"
            plot.error_curves(ax, curves, xlabel, ylabel, note)
            count = len({r["scene"] for r in here})
            ax.set_title(f"{panel}, {count} scene{'s' * (count != 1)}", fontsize=10)
        paths.append(run.figures / f"{name}.png")
        figure.savefig(paths[-1])
    return paths


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    _common.main("accuracy", Config, _COLUMNS, run, argv)


if __name__ == "__main__":
    main()
