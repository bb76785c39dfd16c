"""What the paper's experiments share: settings, trained jobs, tables and pictures of them."""

import dataclasses
import functools
import math
import pathlib
import sys
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import show
from drt_jax.image.sensor import convolve
from drt_jax.learn import network, train
from drt_jax.learn.data import DataConfig, batches, load_patches
from drt_jax.runs.folder import Run
from drt_jax.runs.interrupt import deferred_interrupt
from drt_jax.runs.write import replace

from ._common import require, require_list, require_within

# So many files that were skipped are named on the terminal, all of more in the run's folder.
_NAMED = 20


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is photographed, and through which lens.

    lens: bundled name or YAML path. wavelengths_um: of the three channels, R, G, B. tolerance:
    relative error of the blur that fixes the number of rays.
    """

    lens: str = "double_gauss"
    wavelengths_um: tuple[float, ...] = (0.6, 0.53, 0.48)
    tolerance: float = 1e-9

    def __post_init__(self) -> None:
        require(len(self.wavelengths_um) == 3, "scene.wavelengths_um: expected three, for R, G, B")
        require_within("scene.", self, wavelengths_um=(1e-4, 1e6), tolerance=(1e-14, 0.5))

    def blur(self, near: float, far: float) -> Callable:
        """The blur by the sensor's position and the distance, from `near` to `far` mm."""
        scene = 0.0, (near, far), self.wavelengths_um, self.tolerance
        return drt_jax.moments_model(drt_jax.load_lens(self.lens), ("sensor",), *scene)[1]


@dataclasses.dataclass(frozen=True)
class Training:
    """How long, and how fast.

    batches: steps of each job. batch: patches in one. patch: their side in pixels. optics_rate:
    Adam's learning rate in mm. checkpoint_every: in batches, or when metrics are next written.
    """

    batches: int
    batch: int = 16
    patch: int = 64
    optics_rate: float = 1e-3
    checkpoint_every: int = 200

    def __post_init__(self) -> None:
        # 7: the window of the SSIM.
        sizes = {"batch": (1, 4096), "patch": (7, 4096), "checkpoint_every": (1, math.inf)}
        rates = {f"{name}_rate": (0, 10) for name in self.rates}
        require_within("train.", self, batches=(1, math.inf), **sizes, **rates)

    @property
    def rates(self) -> dict[str, float]:
        """Learning rates of the groups of parameters."""
        rates = {name: rate for name, rate in vars(self).items() if name.endswith("_rate")}
        return {name.removesuffix("_rate"): rate for name, rate in rates.items()}


@dataclasses.dataclass(frozen=True)
class JointTraining(Training):
    """network_rate: Adam's learning rate of the network; the rest as in `Training`."""

    network_rate: float = 1e-3


@dataclasses.dataclass(frozen=True)
class Net:
    """RED-Net joins every `skip_every` pairs of layers; input_skip: whether also its ends."""

    skip_every: int = 2
    input_skip: bool = True

    def __post_init__(self) -> None:
        require_within("network.", self, skip_every=(0, 5))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of all three experiments.

    starts_mm: sensor positions from which training starts. noise: standard deviation of the
    sensor's, for values from 0 to 1. seed: of the patches, the noise and the network.
    """

    starts_mm: tuple[float, ...]
    train: Training
    noise: float = 0.01
    seed: int = 0
    scene: Scene = Scene()
    camera: train.Camera = train.Camera()
    data: DataConfig = DataConfig()

    def __post_init__(self) -> None:
        require_list("starts_mm", self.starts_mm)
        require_within("", self, starts_mm=(1e-3, 1e6), noise=(0, 10))


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointSettings(Settings):
    """Settings with a network; test_patches: how many of the test patches are used (0: all)."""

    train: JointTraining
    test_patches: int = 0
    network: Net = Net()


class Jobs:
    """The training jobs of a run.

    scenes, test: patches to train with, and to measure on.
    restore, parameters: the network if the settings have one, and the number of its weights.
    """

    def __init__(self, run: Run, config: Settings, near: float, far: float) -> None:
        """near, far: of the objects in training, mm."""
        self._run, self._config, self._depths = run, config, (near, far)
        self._network: dict[str, Any] = {}
        self.restore = None
        side = config.train.patch + config.camera.kernel - 1
        reading = functools.partial(tqdm, desc="reading images", leave=False)
        patches = load_patches(config.data, side, config.seed, reading)
        for line in patches.skipped[:_NAMED]:
            print(f"skipped {line}", file=sys.stderr)
        if len(patches.skipped) > _NAMED:
            listed = run.folder / "skipped.txt"
            replace(listed, "".join(f"{line}\n" for line in patches.skipped).encode())
            print(f"skipped {len(patches.skipped)} in all, named in {listed}", file=sys.stderr)
        counts = f"{len(patches.train)} training and {len(patches.test)} test patches"
        print(f"{counts} of {side} x {side}")
        self.scenes = patches.train
        if isinstance(config, JointSettings):
            self.test = thinned(patches.test, config.test_patches)
            init, self.restore = drt_jax.red_net(**dataclasses.asdict(config.network))
            self._network["network"] = weights = init(jax.random.key(config.seed))
            self.parameters = network.count_parameters(weights)
            print(f"RED-Net with {self.parameters} parameters")

    def steps(
        self, blur: Callable, several: bool = False, convolve: Callable = convolve
    ) -> tuple[Callable, tuple[Callable, Callable]]:
        """The imager through a blur, and (init, step) for it, of several jobs at once or of one."""
        config = self._config
        imager = train.make_imager(blur, self.restore, config.camera, convolve)
        rates = config.train.rates
        step = train.make_step(imager, rates, self._depths, config.seed, vectorised=several)
        return jax.jit(imager), step

    def train(
        self,
        job: str,
        steps: tuple[Callable, Callable],
        optics: dict[str, Any],
        noise: float,
        labels: tuple[str, ...] = (),
    ) -> dict[str, Any]:
        """Train one job, or several at once with a label each, from its last checkpoint on.

        steps: of `steps`. optics: its parameters at the start.
        Returns the trained parameters. KeyboardInterrupt, after a checkpoint, if the user asked to
        stop.
        """
        run, setting, labels = self._run, self._config.train, labels or (job,)
        init, step = steps
        total = setting.batches
        first, state = run.load(job, init({"optics": optics} | self._network), labels, total)
        saved = first
        bar = tqdm(total=total, initial=first, desc=job, unit="batch", dynamic_ncols=True)

        def report(start: int, metrics: dict[str, np.ndarray], state: Any) -> None:
            nonlocal saved
            done = start + len(metrics["loss"])
            for k, label in enumerate(labels):
                rows = {n: v.reshape(len(v), -1)[:, k] for n, v in metrics.items()}
                run.log(label, start, rows)
                require_finite(label, start, rows["loss"])
            bar.update(len(metrics["loss"]))
            bar.set_postfix_str(f"loss={np.array2string(metrics['loss'][-1], precision=3)}")
            if asked() or done == total or done - saved >= setting.checkpoint_every:
                run.save(job, done, state)
                saved = done

        def stopping() -> None:
            print("\nstopping after this step; once more stops at once", file=sys.stderr)

        stream = batches(self.scenes, setting.batch, self._config.seed, first)
        # Each report waits for the device: rarely where a step takes milliseconds.
        every = 10 if jax.default_backend() == "cpu" else 113
        with bar, deferred_interrupt(stopping) as asked:
            state = train.fit(step, state, stream, noise, range(first, total), every, report, asked)
            if asked():
                raise KeyboardInterrupt
        return state[0]

    def results(self, *columns: str) -> dict[str, Any]:
        """What is kept of the training of all starts, which log as `start_label`: their final
        sensor positions, averaged over the last tenth of the batches (at least 20, at most all),
        and metrics by column (starts, batches)."""
        config = self._config
        window = min(config.train.batches, max(20, config.train.batches // 10))
        traces = [self._run.metrics(start_label(start)) for start in config.starts_mm]
        return {
            "lens": config.scene.lens,
            "starts_mm": list(config.starts_mm),
            "final_mm": [float(np.mean(trace["sensor_mm"][-window:])) for trace in traces],
            "final_window_batches": window,
            "seconds": self._run.seconds,
            **{column: np.stack([trace[column] for trace in traces]) for column in columns},
        }


def require_finite(label: str, first: int, losses: np.ndarray) -> None:
    """ConfigError, with the batch, unless all losses of a job are finite; `first`: their batch."""
    lost = np.flatnonzero(~np.isfinite(losses))
    what = f"{label}: the loss is not finite from batch {first + lost[:1].sum()} on"
    require(not lost.size, f"{what}; leave this start out, or lower the learning rates")


def start_label(start: float) -> str:
    """The job of a starting position of the sensor, mm."""
    return f"start {start}"


def start_lines(results: dict[str, Any], column: str, batches: int | None = None) -> dict:
    """(batch, value) by start, for `show.convergence`, of the first `batches`."""
    rows = [values[:batches] for values in results[column]]
    labels = map(start_label, results["starts_mm"])
    return {label: (np.arange(len(row)), row) for label, row in zip(labels, rows)}


def reached(results: dict[str, Any]) -> str:
    """The planes at which the starts ended, in words."""
    if None in results["final_mm"]:
        return "not finite"
    low, high = (f"{end(results['final_mm']):.3f}" for end in (min, max))
    return f"{low} mm" if low == high else f"{low} to {high} mm"


def draw_sensor(results: dict[str, Any], path: pathlib.Path) -> None:
    """Picture of the sensor position of all starts over training."""
    figure, axes = show.new(width=7, height=4.5)
    show.convergence(axes, start_lines(results, "sensor_mm"), "sensor position (mm)")
    figure.savefig(path)


def draw_lens(name: str, distance: float, path: pathlib.Path) -> None:
    """Picture of a lens with its axial beam from `distance` mm."""
    lens = drt_jax.load_lens(name)
    figure, axes = show.new(width=8, height=4)
    show.lens_drawing(axes, show.draw(lens, 0.0, distance))
    axes.set_title(lens.name)
    figure.savefig(path)


_IMAGES = ("truth", "sensor", "restored")


def images(
    imager: Callable, parameters: Any, scenes: np.ndarray, distance: float, noise: float, seed: int
) -> dict[str, np.ndarray]:
    """Truth, sensor and restored images of patches, for `draw_patches`."""
    found = imager(parameters, scenes, distance, np.float32(noise), jax.random.key(seed))
    return {name: np.asarray(image, np.float16) for name, image in zip(_IMAGES, found)}


def draw_patches(results: dict[str, Any], titles: list[str], path: pathlib.Path) -> None:
    """Picture of the `images`, each but the truth with its RMSE."""
    rows = {name: np.float32(results[name]) for name in _IMAGES}
    errors = {name: rows[name] - rows["truth"] for name in _IMAGES[1:]}
    notes = {n: [f"{np.sqrt(np.mean(e**2)):.3f}" for e in some] for n, some in errors.items()}
    show.patch_grid(rows, titles, notes).savefig(path)


def thinned(patches: np.ndarray, count: int) -> np.ndarray:
    """At most `count` patches (0: all), spread evenly over the set."""
    if not count or count >= len(patches):
        return patches
    return np.asarray(patches[np.linspace(0, len(patches) - 1, count).astype(int)])


def textured(patches: np.ndarray, count: int) -> np.ndarray:
    """`count` patches for a picture, spread evenly over the half with more contrast."""
    contrast = np.std(patches.reshape(len(patches), -1), axis=1)
    return thinned(patches[np.argsort(contrast)[len(patches) // 2 :]], count)
