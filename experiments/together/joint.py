"""Design a lens and its network together, over field and depth, and compare with least squares.

An arm is one way to design lens and network. All arms start from the same spoilt lens:

- `focus` trains the sensor position and the network;
- `spots` and `mtf` optimise the lens by least squares, then train the network; `longer` is `spots`
  with twice the training steps;
- `joint` trains all variables and the network from the spoilt lens, `joint_from_spots` from the
  lens of `spots`, both by Adam; `cosine_from_spots` has decreasing rates;
- `rays` and `rays_from_spots` are `joint` and `joint_from_spots` with ray steps
  (`design.RaySteps`); `rays_from_mtf` starts from the lens of `mtf`;
- `frozen` trains the lens of `spots` with the network of `spots` fixed;
- `tolerant` is `rays_from_spots` with lenses as built, `built_network` is `spots` with lenses as
  built; `built_spots` optimises the lens for spots of lenses as built, and `tolerant_from_built`
  continues jointly from there.

With `taps`, the network starts with the best linear filter of its lens: `stopped` is `spots` with
the best of `stops`, `freed` also varies the kinds in `held`; `filter` optimises the lens for the
error of the filter, and `rays_from_filter` continues jointly. Every arm has the same data, number
of steps and initial networks. Another image model evaluates them: waves, more fields, more
wavelengths, images that no arm has used. Writes lenses/ARM SEED.yaml.
"""

import dataclasses
import math
import pathlib
import sys
import textwrap
from typing import Annotated, Any, Literal

import numpy as np

from drt_jax import Scene, load_lens, show
from drt_jax.design import Operand, Solve, Tie, Tolerance, Vary
from drt_jax.learn.data import DataConfig

from . import _command, _common, _plots, _report, _settings, _sharing
from ._common import Colours, different, near_and_far, not_empty, odd, or_zero, within
from ._setup import ARMS
from ._train_arms import run as run
from .runs.folder import Run as Run

COLUMNS = ("loss",)
# Measures of images in the table, with their digits.
_MEASURES = {"mae": 4, "rmse": 4, "psnr": 2, "ssim": 4, "sensor_psnr": 2}


@dataclasses.dataclass(frozen=True)
class StartErrors:
    """Errors of the spoilt lens, the start of all arms: standard deviations of all curvatures, per
    cent, and thicknesses, mm."""

    per_cent: Annotated[float, within(0, 50)] = 2.0
    off_mm: Annotated[float, within(0, 100)] = 0.05
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Camera:
    """Sensor. pixel_um: side of a pixel. kernel: side of the kernels, pixels, odd. tolerance: sum
    of the errors of a kernel's pixels in training. kind: of the kernels in training, by "rays" or
    by "waves" (with as many cells as in the evaluation)."""

    pixel_um: Annotated[float, within(0.05, 1e4)] = 6.0
    kernel: Annotated[int, within(3, 255), odd] = 21
    tolerance: Annotated[float, within(1e-4, 0.5)] = 0.03
    kind: Literal["rays", "waves"] = "rays"


@dataclasses.dataclass(frozen=True)
class Training:
    """Length and speed of training.

    points: object points of a step, which share the batch.
    optics_rate: Adam's rate of each variable, as the change of the spots by a step, um.
    rays_um: RMS displacement of the rays by the first steps of `rays`, um; later steps become
        shorter as a cosine.
    taps_rate: Adam's rate of the taps of the filter.
    """

    batches: Annotated[int, within(1, 1e7)] = 400
    batch: Annotated[int, within(1, 4096)] = 8
    patch: Annotated[int, within(7, 4096)] = 32
    points: Annotated[int, within(1, 4096)] = 4
    optics_rate: Annotated[float, within(0, 10)] = 0.1
    rays_um: Annotated[float, within(0, 1e3)] = 1.0
    taps_rate: Annotated[float, within(0, 10)] = 1e-5
    network_rate: Annotated[float, within(0, 10)] = 1e-3
    checkpoint_every: int = 200

    def __post_init__(self) -> None:
        shared = self.batch % self.points == 0
        _common.require(shared, "train.batch: expected a multiple of train.points")


@dataclasses.dataclass(frozen=True)
class Judge:
    """The independent image model of the evaluation.

    rings: fields, each at another azimuth. depths: distances, equidistant in 1 / distance.
    waves: wavelengths of each channel. cells: of the wave kernels, along a side.
    patches: for each point. builds: lenses as built, for arms of `tolerances`.
    others: a folder of further photographs for the evaluation: all, and the thirds with the least
        and the most colour; empty for none.
    """

    rings: Annotated[int, within(1, 64)] = 8
    depths: Annotated[int, within(1, 64)] = 1
    waves: Annotated[int, within(1, 15)] = 3
    width_um: Annotated[float, within(0, 1)] = 0.04
    cells: Annotated[int, within(16, 1024)] = 128
    patches: Annotated[int, within(1, 1000)] = 4
    builds: Annotated[int, within(0, 1e4)] = 0
    others: str = ""


@dataclasses.dataclass(frozen=True)
class Map:
    """Scenes for which optimised lenses are compared after their best filters, without training.
    noise: as of the experiment. near_m: nearest objects. plates: at each of `stops`, factors of the
        coefficients in the lens's file, such as those of a cubic plate; they must be `held`."""

    noise: Annotated[tuple[float, ...], within(1e-4, 10), different] = ()
    near_m: Annotated[tuple[float, ...], within(1e-3, math.inf), different] = ()
    plates: Annotated[tuple[float, ...], within(-1e3, 1e3), different] = ()


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/joint.yaml.

    lens: the lens before it is disturbed, a bundled name or YAML path.
    variables, ties, solves, limits: as in experiments.design; `limits` hold in least squares and
        in training.
    field_deg: largest field angle; fields cover the disc.
    model_glass: surfaces behind which a model glass takes the place of the lens's own, so that
        "index" and "abbe" can vary.
    held: kinds of variables that least squares on spots and MTF leave as they are.
    stops: diameters of the entrance pupil that `stopped` tries, relative to that of the solve
        `entrance_pupil`; `filter` and joint arms choose their own, within `limits`.
    depth_m: nearest and farthest object, .inf for infinity.
    noise, shot: standard deviation of the read noise, and of the shot noise of white, where the
        light is that of the whole stop on the axis.
    taps: side of the filter in front of the network, pixels, odd; 0 for none.
    mtf_at: cycles/mm, of the arm `mtf`.
    arms: of the experiment's description; none if there is a `map`.
    map: further scenes, for which least squares finish lenses, but no network is trained.
    seeds: starts of the network, with data and noise of their own.
    tolerances: of parts of the lens, for `tolerant` and judge.builds.
    refocus: True if the sensor of a lens as built follows its paraxial focus.
    devices: that share each batch, see docs/devices.md; another number goes on with the same run.
    """

    name: str
    lens: str
    variables: Annotated[tuple[Vary, ...], not_empty]
    limits: tuple[Operand, ...] = ()
    ties: tuple[Tie, ...] = ()
    solves: tuple[Solve, ...] = ()
    model_glass: tuple[int, ...] = ()
    held: tuple[str, ...] = ()
    stops: Annotated[tuple[float, ...], within(0.01, 1)] = ()
    spoil: StartErrors = StartErrors()
    field_deg: Annotated[float, within(1e-3, 80)] = 10.0
    depth_m: Annotated[tuple[float, ...], near_and_far] = (math.inf, math.inf)
    wavelengths_um: Annotated[Colours, within(0.1, 100)] = (0.6, 0.53, 0.48)
    camera: Camera = Camera()
    noise: Annotated[float, within(0, 10)] = 0.01
    shot: Annotated[float, within(0, 10)] = 0.0
    taps: Annotated[int, within(0, 63), or_zero(odd)] = 0
    mtf_at: Annotated[float, within(1e-3, 1e4)] = 30.0
    network: _settings.Net = _settings.Net()
    train: Training = Training()
    arms: Annotated[tuple[Literal[*ARMS], ...], different] = ("focus", "spots", "joint")
    seeds: Annotated[int, within(1, 100)] = 3
    tolerances: tuple[Tolerance, ...] = ()
    refocus: bool = False
    judge: Judge = Judge()
    map: Map = Map()
    data: DataConfig = DataConfig()
    devices: int = dataclasses.field(default=1, compare=False)

    def __post_init__(self) -> None:
        _sharing.require_shared(self.devices, "train.batch", self.train.batch)
        for arm in self.arms:
            begins, lacks = ARMS[arm].begins, []
            if ARMS[arm].frozen and "spots" not in self.arms:
                lacks.append("spots")
            if begins in ("stopped", "freed", "filter") and not self.taps:
                lacks.append("taps above 0")
            if begins in ("stopped", "freed") and not self.stops:
                lacks.append("stops")
            _common.require(not lacks, f"arms: {arm} needs {' and '.join(lacks)}")
        _common.require_known("held", self.held, sorted({vary.kind for vary in self.variables}))
        fits = not self.taps or self.camera.kernel < 64
        _common.require(fits, "camera.kernel: expected at most 63 pixels where there are taps")
        solved = not self.stops or "entrance_pupil" in {solve.kind for solve in self.solves}
        _common.require(solved, "stops: needs the solve entrance_pupil")
        asked = self.map.noise or self.map.near_m or self.map.plates
        mapped = not asked or (self.taps and self.stops)
        _common.require(bool(mapped), "map: needs taps above 0 and stops")
        some = self.arms or (self.map.noise and self.map.near_m) or self.map.plates
        _common.require(bool(some), "arms: expected one or more, or a map")
        held = not self.map.plates or "coefficients" in self.held
        _common.require(held, "map.plates: needs coefficients among variables and held")
        builds = self.judge.builds or any(ARMS[arm].as_built for arm in self.arms)
        missing = "tolerances: needs at least one item for lenses as built"
        _common.require(bool(self.tolerances) or not builds, missing)


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Errors of all arms, and their differences from the arm `spots`."""
    name, found = results["name"], {}
    if results.get("map"):  # older runs have no key
        found[f"joint, {name}: map"] = _map_table(results["map"])
    if results.get("plates"):
        groups = _common.grouped(results["plates"], "f_number")
        cells = {n: [f"{row['db']:.2f}" for row in own] for (n,), own in groups.items()}
        lines = [[f"f/{number:.1f}", *own] for number, own in cells.items()]
        header = ["stop", *(f"{row['factor']:g}" for row in next(iter(groups.values())))]
        found[f"joint, {name}: plates"] = _common.table(header, lines)
    if not results["rows"]:
        return found
    header = ["arm", "seeds", "MAE", "RMSE", "PSNR dB", "SSIM"]
    header += ["PSNR dB before the network", "PSNR dB less that of spots", "spot um", "ms a step"]
    rows = []
    groups = _common.grouped(results["rows"], "arm")
    base = {row["seed"]: row["psnr"] for row in groups.get(("spots",), [])}
    for (arm,), own in groups.items():
        ahead = [row["psnr"] - base[row["seed"]] for row in own if row["seed"] in base]
        cells = [_spread([row[m] for row in own], digits) for m, digits in _MEASURES.items()]
        cells.append(_spread(ahead, 2) if ahead and arm != "spots" else "")
        spot = _spread([row["spot_um"] for row in own], 2)
        speed = f"{1e3 * float(np.median([row['step_s'] for row in own])):.3g}"
        rows.append([ARMS[arm].title, len(own), *cells, spot, speed])
    found[f"joint, {name}"] = _common.table(header, rows)
    if "others_psnr" in results["rows"][0]:
        header = ["arm", "PSNR dB of other photographs", "least coloured third", "most coloured"]
        names = [f"{name}_psnr" for name in ("others", "grey", "coloured")]
        lines = []
        for (arm,), own in groups.items():
            lines.append([ARMS[arm].title, *(_spread([row[n] for row in own], 2) for n in names)])
        found[f"joint, {name}: other photographs"] = _common.table(header, lines)
    behind = results["filter_db"]
    if any(behind.values()):
        lines = [[key, f"{db:.2f}"] for key, db in behind.items()]
        header = ["lens", "PSNR dB behind its best filter, closed form"]
        found[f"joint, {name}: before training"] = _common.table(header, lines)
    if results["builds"]:
        header = ["arm", "PSNR dB as designed", "mean as built", "10th percentile"]
        keys, lines = ["designed", "mean", "low"], []
        if "others_mean" in results["builds"][0]:
            header += ["other photographs: mean", "their 10th percentile"]
            keys += ["others_mean", "others_low"]
        for (arm,), own in _common.grouped(results["builds"], "arm").items():
            parts = [[row[key] for row in own] for key in keys]
            lines.append([ARMS[arm].title, *(_spread(part, 2) for part in parts)])
        found[f"joint, {name}: as built"] = _common.table(header, lines)
    return found


def _map_table(rows: list[dict[str, Any]]) -> str:
    """A line for each scene: PSNR and f-number of its lenses."""
    lines = []
    for row in rows:
        cells = [f"{db:.2f} (f/{number:.1f})" for db, number in row["lenses"].values()]
        best, *others = (row["lenses"][name][0] for name in ("filter", "freed", "stopped"))
        gains = [f"{best - other:+.2f}" for other in others]
        near = row["near_m"] or math.inf
        lines.append([f"{near:g}", f"{row['noise']:g}", *cells, *gains])
    header = ["nearest, m", "noise", *rows[0]["lenses"], "filter less freed", "less stopped"]
    return _common.table(header, lines)


def _spread(values: list[float], digits: int) -> str:
    """Mean and standard deviation as text."""
    text = f"{np.mean(values):.{digits}f}"
    return f"{text} ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else text


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws losses, lenses, and patches through each lens before and after the network."""
    titles = {name: arm.title for name, arm in ARMS.items()}
    if results.get("map"):
        groups = _common.grouped(results["map"], "near_m")
        with _plots.picture(figures / "map.png", 4.5, 4, len(groups), 3) as axes:
            for ax, ((near,), own) in zip(axes, groups.items()):
                noise = [row["noise"] for row in own]
                for name in own[0]["lenses"]:
                    ax.semilogx(noise, [row["lenses"][name][0] for row in own], "o-", label=name)
                ax.set_xticks(noise, [f"{value:g}" for value in noise])
                ax.minorticks_off()
                ax.set_title(f"{near:g} m to infinity" if near else "far objects")
                _plots.label_axes(ax, "noise", "PSNR behind the best filter (dB)")
    if results.get("plates"):
        with _plots.picture(figures / "plates.png", 5.5, 4) as (ax,):
            for (number,), own in _common.grouped(results["plates"], "f_number").items():
                factors, db = zip(*((row["factor"], row["db"]) for row in own))
                ax.plot(factors, db, "o-", label=f"f/{number:.1f}")
            _plots.label_axes(ax, "strength of the plate", "PSNR behind the best filter (dB)")
    if not results["rows"]:
        return
    seconds = {row["arm"]: row["step_s"] for row in results["rows"]}  # of the last seed
    lines = {arm: _smooth(loss) for arm, loss in zip(results["arms"], results["losses"])}
    with _plots.picture(figures / "losses.png", 6.5, 4.5, 2) as axes:
        for ax, label, scale in zip(axes, ("training batch", "seconds"), ({}, seconds)):
            own = {titles[a]: (scale.get(a, 1) * x, y) for a, (x, y) in lines.items()}
            _plots.curves(ax, own, label, "mean absolute error")
            ax.set_yscale("log")
        axes[1].get_legend().remove()
    drawn = results["drawn"]
    fields = np.radians([0.0, 0.7 * results["field_deg"], results["field_deg"]])
    scene = Scene.radians(fields, results["far_mm"] or math.inf)
    with _plots.picture(figures / "lenses.png", 5, 3, len(drawn), columns=3) as axes:
        for ax, name in zip(axes, drawn):
            lens = load_lens(figures.parent / "lenses" / f"{name}.yaml")
            show.lens_drawing(ax, show.draw(lens, scene))
            ax.set_title(titles.get(name.split()[0], name), fontsize=9)
            ax.get_legend().remove()
    arms = results["pictures"]
    truth = np.float32(results[f"{arms[0]} truth"])  # the same of all arms
    degrees = [f"{field:.1f} deg" for field in results["pictures_deg"][: len(truth)]]
    errors = {}
    for arm in arms:
        parts = {key: results[f"{arm} {key}"] for key in _report.IMAGES}
        _report.draw_patches(parts, degrees, figures / f"patches_{arm}.png")
        errors[arm.replace("_", "\n")] = np.float32(parts["restored"])
    _plots.patch_grid(figures / "errors.png", degrees, truth, {}, errors)
    if any("each" in row for row in results["builds"]):
        with _plots.picture(figures / "builds.png", 6.5, 4.5) as (ax,):
            for (arm,), own in _common.grouped(results["builds"], "arm").items():
                values = np.sort(np.ravel([row["each"] for row in own]))
                ax.plot(values, np.linspace(100, 0, len(values)), label=titles[arm])
            _plots.label_axes(ax, "PSNR as built, at least (dB)", "lenses (%)")
    if "photographs" in results:
        _draw_photographs(results, scene, figures)


def _draw_photographs(results: dict[str, Any], scene: Scene, figures: pathlib.Path) -> None:
    """Draws a photograph through two lenses, a row each: lens, scene, sensor image, restored."""
    arms = results["photographs"]
    what = "worst tenth as built: " if results["builds"] else ""
    with _plots.picture(figures / "photograph.png", 3.2, 3.2, 4 * len(arms), 4) as axes:
        for row, arm, mean in zip(axes.reshape(-1, 4), arms, results["measure"]):
            lens = load_lens(figures.parent / "lenses" / f"{arm} 0.yaml")
            show.lens_drawing(row[0], show.draw(lens, scene)).get_legend().remove()
            about = textwrap.fill(ARMS[arm].title, 44)
            row[0].set_title(f"{about}\n{what}{mean:.1f} dB", fontsize=9)
            truth, *others = (np.float32(results[f"photograph {arm} {i}"]) for i in _report.IMAGES)
            titles = ["scene"]
            for name, image in zip(_report.IMAGES[1:], others):
                titles.append(f"{name}, {-10 * np.log10(np.mean((image - truth) ** 2)):.1f} dB")
            for ax, image, title in zip(row[1:], (truth, *others), titles):
                ax.imshow(np.clip(image, 0, 1))
                ax.set_title(title, fontsize=9)
                ax.set(xticks=[], yticks=[])


def _smooth(loss: list[float | None]) -> tuple[np.ndarray, np.ndarray]:
    """Steps and means of the loss over a twentieth of the training."""
    values = np.array(loss, float)
    width = max(1, len(values) // 20)
    count = len(values) // width
    return (np.arange(count) + 0.5) * width, values[: count * width].reshape(count, width).mean(1)


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
