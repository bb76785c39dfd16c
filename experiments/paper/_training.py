"""What the paper's experiments share: settings, a trained job, pictures of it."""

import dataclasses
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
from drt_jax.learn import network, train
from drt_jax.learn.data import Patches, batches, load_patches
from drt_jax.runs.folder import Run, deferred_interrupt

from ._common import require


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is photographed, and through which lens.

    lens: bundled name or YAML path.
    wavelengths_um: of the three channels, R, G, B.
    tolerance: relative error of the blur that fixes the number of rays.
    """

    lens: str = "double_gauss"
    wavelengths_um: tuple[float, ...] = (0.6, 0.53, 0.48)
    tolerance: float = 1e-9

    def __post_init__(self) -> None:
        require(len(self.wavelengths_um) == 3, "scene.wavelengths_um: expected three, for R, G, B")

    def blur(self, lens: drt_jax.Lens, near: float, far: float) -> Callable:
        """The blur by the sensor's position and the distance, from `near` to `far` mm."""
        return drt_jax.moments_model(
            lens, ("sensor",), 0.0, (near, far), self.wavelengths_um, self.tolerance
        )[1]


@dataclasses.dataclass(frozen=True)
class Training:
    """How long, and how fast.

    batches: steps of each job.
    batch: patches in one.
    patch: their side in pixels.
    optics_rate: Adam's learning rate in mm.
    checkpoint_every: in batches, or when metrics are next written.
    """

    batches: int
    batch: int = 16
    patch: int = 64
    optics_rate: float = 1e-3
    checkpoint_every: int = 200

    def __post_init__(self) -> None:
        for name in ("batches", "batch", "checkpoint_every"):
            require(getattr(self, name) >= 1, f"train.{name}: must be at least 1")
        require(self.patch >= 7, "train.patch: must be at least 7, the window of the SSIM")
        require(0 <= self.optics_rate < math.inf, "train.optics_rate: must be 0 or more")


@dataclasses.dataclass(frozen=True)
class JointTraining(Training):
    """network_rate: Adam's learning rate of the network; the rest as in `Training`."""

    network_rate: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 <= self.network_rate < math.inf, "train.network_rate: must be 0 or more")

    @property
    def rates(self) -> dict[str, float]:
        """The learning rates of both groups of parameters."""
        return {"optics": self.optics_rate, "network": self.network_rate}


@dataclasses.dataclass(frozen=True)
class Net:
    """Skips of RED-Net.

    skip_every: every so many pairs of layers are joined.
    input_skip: whether the input is added to the output.
    """

    skip_every: int = 2
    input_skip: bool = True

    def build(self, seed: int) -> tuple[Any, Callable, int]:
        """Its first weights, its function, and how many parameters it has."""
        init, restore = drt_jax.red_net(**dataclasses.asdict(self))
        weights = init(jax.random.key(seed))
        count = network.count_parameters(weights)
        print(f"RED-Net with {count} parameters")
        return weights, restore, count


def patches(config: Any) -> Patches:
    """Patches of the run's images, with the context that its blur needs; says what was skipped."""
    side = config.train.patch + config.camera.kernel - 1
    loaded = load_patches(
        config.data, side, config.seed, lambda work: tqdm(work, desc="reading images", leave=False)
    )
    for line in loaded.skipped:
        print(f"skipped {line}", file=sys.stderr)
    print(f"{len(loaded.train)} training and {len(loaded.test)} test patches of {side} x {side}")
    return loaded


def train_job(
    run: Run,
    job: str,
    functions: tuple[Callable, Callable],
    parameters: dict[str, Any],
    scenes: np.ndarray,
    noise: float,
    config: Any,
    labels: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Train one job, or several vectorised ones with a label each, from its last checkpoint on.

    run: where metrics and checkpoints go. functions: of `train.make_step`. parameters: to start
    from. scenes: training patches. noise: standard deviation. Returns the trained parameters.
    KeyboardInterrupt, after a checkpoint, if the user asked to stop.
    """
    init, step = functions
    labels, several, total = labels or (job,), bool(labels), config.train.batches
    first, state = run.load(job, init(parameters), labels)
    saved = first
    bar = tqdm(total=total, initial=first, desc=job, unit="batch", dynamic_ncols=True)

    def notify() -> None:
        print("\nstopping after this step; once more stops at once", file=sys.stderr)

    with bar, deferred_interrupt(notify) as asked:

        def report(start: int, metrics: dict[str, np.ndarray], state: Any) -> None:
            nonlocal saved
            done = start + len(metrics["loss"])
            for k, label in enumerate(labels):
                run.log(label, start, {n: v[:, k] if several else v for n, v in metrics.items()})
            bar.update(len(metrics["loss"]))
            bar.set_postfix_str(f"loss={np.array2string(metrics['loss'][-1], precision=3)}")
            if asked() or done == total or done - saved >= config.train.checkpoint_every:
                run.save(job, done, state)
                saved = done

        stream = batches(scenes, config.train.batch, config.seed, first)
        # Each report waits for the device: rarely where a step takes milliseconds.
        every = 10 if jax.default_backend() == "cpu" else 113
        state = train.fit(step, state, stream, noise, first, total, every, report, asked)
        if asked():
            raise KeyboardInterrupt
    return state[0]


def start_results(run: Run, config: Any, columns: tuple[str, ...]) -> dict[str, Any]:
    """What is kept of the training of all starts, which log as `start_label`: their final sensor
    positions, averaged over the last tenth of the batches (at least 20, at most all), and metrics
    by column (starts, batches)."""
    window = min(config.train.batches, max(20, config.train.batches // 10))
    traces = [run.metrics(start_label(start)) for start in config.starts_mm]
    return {
        "lens": config.scene.lens,
        "starts_mm": list(config.starts_mm),
        "final_mm": [float(np.mean(trace["sensor_mm"][-window:])) for trace in traces],
        "final_window_batches": window,
        "seconds": run.seconds,
        **{column: np.stack([trace[column] for trace in traces]) for column in columns},
    }


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
    low, high = min(results["final_mm"]), max(results["final_mm"])
    same = f"{low:.3f}" == f"{high:.3f}"
    return f"{low:.3f} mm" if same else f"{low:.3f} to {high:.3f} mm"


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


def images(imager: Callable, parameters: Any, scenes: np.ndarray, *rest: Any) -> dict:
    """Truth, sensor and restored images of patches, for `draw_patches`."""
    names = "truth", "sensor", "restored"
    return {n: np.asarray(a, np.float16) for n, a in zip(names, imager(parameters, scenes, *rest))}


def draw_patches(results: dict[str, Any], titles: list[str], path: pathlib.Path) -> None:
    """Picture of the `images`, each but the truth with its RMSE."""
    rows = {name: np.float32(results[name]) for name in ("truth", "sensor", "restored")}
    errors = {name: rows[name] - rows["truth"] for name in ("sensor", "restored")}
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
