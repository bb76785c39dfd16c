"""Training jobs of the paper's experiments, and the patches of images for them."""

import dataclasses
import functools
import pathlib
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import learn
from drt_jax.devices import copied, gathered, shared, split
from drt_jax.image.diagnose import crossed
from drt_jax.image.sensor import convolve
from drt_jax.learn import network, train
from drt_jax.learn.data import DataConfig, Patches, batches, load_patches

from ._common import require, settings, spot_um
from ._optics import Trained, middle
from ._report import IMAGES, start_label
from ._settings import JointSettings, Settings
from ._sharing import mesh_of
from .runs.config import ConfigError
from .runs.disk import replace
from .runs.folder import Run
from .runs.interrupt import deferred_interrupt

# Tolerance of wave kernels, the sum of absolute errors of their pixels.
_KERNELS = 0.05
# Largest number of skipped files that are listed on the terminal; the run folder has all.
_NAMED = 20


@dataclasses.dataclass(frozen=True)
class Loop:
    """The loop of training of one job.

    steps: numbers of the steps, from the last checkpoint on.
    checkpoint_every: number of steps between checkpoints, rounded up to the next report.
    mesh: devices among which a batch is divided; None for one device.
    """

    run: Run
    job: str
    steps: range
    checkpoint_every: int
    mesh: Any

    def train(
        self, step: Callable, state: Any, scenes: Iterator[np.ndarray], noise: float, log: Callable
    ) -> Any:
        """Trains with a progress bar and checkpoints, and returns the last state.
        KeyboardInterrupt, after a checkpoint, if the user stops it. log: called with each report of
        `train.fit`."""
        saved, total = self.steps.start, self.steps.stop
        bar = tqdm(total=total, initial=saved, desc=self.job, unit="batch", dynamic_ncols=True)

        def report(start: int, metrics: dict[str, np.ndarray], state: Any) -> None:
            nonlocal saved
            done = start + len(metrics["loss"])
            log(start, metrics, state)
            bar.update(len(metrics["loss"]))
            bar.set_postfix_str(f"loss={np.array2string(metrics['loss'][-1], precision=3)}")
            if asked() or done == total or done - saved >= self.checkpoint_every:
                self.run.save(self.job, done, state)
                saved = done

        def stopping() -> None:
            print("\nstopping after this step; once more stops at once", file=sys.stderr)

        stream = (split(self.mesh, some) for some in scenes)
        # Each report waits for the device. Reports are rare if a step takes milliseconds.
        every = 10 if jax.default_backend() == "cpu" else 113
        with bar, deferred_interrupt(stopping) as asked:
            state = copied(self.mesh, state)
            state = train.fit(step, state, stream, noise, self.steps, every, report, asked)
            if asked():
                raise KeyboardInterrupt
        return jax.tree.map(jnp.asarray, gathered(state))


class Jobs:
    """The training jobs of a run.

    lens: lens with its trained numbers.
    blur: function of `Trained.blur`.
    scenes, test: training and test patches.
    restore: network, None without one.
    parameters: number of its weights.
    """

    def __init__(self, run: Run, config: Settings, near: float, far: float, *more: float) -> None:
        """near, far: nearest and farthest object in training, mm. more: other distances of tests,
        mm."""
        self._run, self._config, self._depths = run, config, (near, far)
        self.lens = Trained.of(config.scene.lens, config.train.variables)
        self.blur = self.lens.blur(config.scene, min([near, *more]), max([far, *more]))
        # The last valid values of each job.
        self._good: dict[str, dict[str, float]] = {}
        self._network: dict[str, Any] = {}
        self._mesh = mesh_of(getattr(config, "devices", 1))
        self.restore = None
        side = config.train.patch + config.camera.kernel - 1
        patches = read_patches(config.data, side, config.seed, run.folder)
        self.scenes = patches.train
        if isinstance(config, JointSettings):
            self.test = thinned(patches.test, config.test_patches)
            init, self.restore = learn.red_net(**asdict(config.network))
            self._network["network"] = weights = init(jax.random.key(config.seed))
            self.parameters = network.count_parameters(weights)
            print(f"RED-Net with {self.parameters} parameters")

    @functools.cached_property
    def _scale(self) -> dict[str, float]:
        """`Trained.scale` at the middle distance; {} if only the sensor is trained."""
        names, distance = self.lens.names, middle(*self._depths)
        return self.lens.scale(self._config.scene, distance) if names else {}

    def steps(
        self, blur: Callable, several: bool = False, convolve: Callable = convolve
    ) -> tuple[Callable, tuple[Callable, Callable]]:
        """The imager of a blur and its (init, step), for one job or for several jobs at once."""
        config = self._config
        both = self.restore, shared(self.restore, self._mesh, 1)
        plain, spread = (train.make_imager(blur, net, config.camera, convolve) for net in both)
        optics, setting = config.train.optics_rate, config.train
        rates: dict[str, Any] = {"optics": optics, "network": getattr(setting, "network_rate", 0.0)}
        if self._scale:
            rates["optics"] = {name: optics * size for name, size in self._scale.items()}
        step = train.make_step(spread, rates, self._depths, config.seed, vectorised=several)
        return jax.jit(plain), step

    def train(
        self,
        job: str,
        steps: tuple[Callable, Callable],
        optics: dict[str, Any],
        noise: float,
        labels: tuple[str, ...] = (),
    ) -> dict[str, Any]:
        """Trains one job, or several jobs at once with a label for each, from the last checkpoint
        on, and returns the trained parameters. KeyboardInterrupt, after a checkpoint, if the user
        stops it.

        steps: result of `steps`.
        optics: parameters of the optics at the start.
        noise: standard deviation of the noise.
        """
        run, setting, labels = self._run, self._config.train, labels or (job,)
        init, step = steps
        total = setting.batches
        first, state = run.load(job, init({"optics": optics} | self._network), labels, total)
        self._good |= {label: values_of(state[0], k) for k, label in enumerate(labels)}

        def log(start: int, metrics: dict[str, np.ndarray], state: Any) -> None:
            for k, label in enumerate(labels):
                rows = {n: v.reshape(len(v), -1)[:, k] for n, v in metrics.items()}
                run.log(label, start, rows)
                self._check(label, start, rows, values_of(state[0], k))

        scenes = batches(self.scenes, setting.batch, self._config.seed, first)
        loop = Loop(run, job, range(first, total), setting.checkpoint_every, self._mesh)
        state = loop.train(step, state, scenes, noise, log)
        for label in labels:
            self._save_lens(label)
        return state[0]

    def _check(
        self, label: str, first: int, rows: dict[str, np.ndarray], values: dict[str, float]
    ) -> None:
        """ConfigError for numbers that are not finite and for surfaces that cross. The lens of the
        last valid report is saved before."""
        try:
            require_finite(label, first, rows["loss"])
            require_finite(label, first, rows["sigma_um"], "blur")
            wrong = "" if np.all(np.isfinite([*values.values()])) else "the lens is not finite"
            if values and self.lens.names and not wrong:
                wrong = "".join(crossed(self.lens.lens_of(values)).split("; ")[1:2])
            what = f"{label}: after batch {first + len(rows['loss']) - 1} {wrong}"
            require(not wrong, f"{what}; leave this start out, or lower train.optics_rate")
        except ConfigError as error:
            if not self._good[label]:
                raise
            raise ConfigError(f"{error}; the lens before is {self._save_lens(label)}") from error
        self._good[label] = values

    def _save_lens(self, label: str) -> pathlib.Path:
        """Writes the last valid lens of a job."""
        path = self._run.folder / "designed" / f"{label}.yaml"
        path.parent.mkdir(exist_ok=True)
        if self._good[label]:
            drt_jax.save_lens(self.lens.lens_of(self._good[label]), path)
        return path

    def results(self, *columns: str) -> dict[str, Any]:
        """Results of all starts: final sensor positions, averaged over the last tenth of the
        batches (at least 20, at most all), and metrics (starts, batches) by column."""
        config = self._config
        window = min(config.train.batches, max(20, config.train.batches // 10))
        traces = [self._run.metrics(start_label(start)) for start in config.starts_mm]
        numbers = self._numbers(traces, window) if self.lens.names else {}
        return {
            **settings(config, "paper", "starts_mm"),
            **settings(config.scene, "lens", "field"),
            **settings(config.train, "variables"),
            "final_mm": [float(np.mean(trace["sensor_mm"][-window:])) for trace in traces],
            "final_window_batches": window,
            "seconds": self._run.seconds,
            **{column: np.stack([trace[column] for trace in traces]) for column in columns},
            "gaussian": self._gaussian(),
            **numbers,
        }

    def _gaussian(self) -> list[dict[str, float]]:
        """Error of Gaussian kernels, compared with waves, for the lens of the first start and the
        nearest and the farthest object; [] if wave kernels do not converge."""
        config, camera = self._config, self._config.camera
        lens = self.lens.lens_of(self._good[start_label(config.starts_mm[0])])
        distances = sorted(set(self._depths))
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            try:
                pixel = 1e-3 * camera.pixel_um
                scene = config.scene.seen(*distances)
                found = drt_jax.gaussian_error(lens, scene, pixel, camera.kernel, _KERNELS)
            except (UserWarning, ValueError):
                return []
        columns = zip(distances, np.ravel(found.misplaced), np.ravel(found.contrast))
        return [{"distance_m": d / 1e3, "misplaced": m, "contrast": c} for d, m, c in columns]

    def _numbers(self, traces: list[dict[str, np.ndarray]], window: int) -> dict[str, Any]:
        """Trained numbers, loss and spot of each start, before and after, and changes of the
        numbers (starts, numbers, batches) in units of `Trained.scale`, mm."""
        config, distance = self._config, middle(*self._depths)
        rows, changes = [], []
        for start, trace in zip(config.starts_mm, traces):
            pair = [self.lens.start(start), self._good[start_label(start)]]
            losses = trace["loss"][:window], trace["loss"][-window:]
            columns = [{name: float(number) for name, number in values.items()} for values in pair]
            for column, values, loss in zip(columns, pair, losses):
                lens, scene = self.lens.lens_of(values), config.scene
                radius, light = spot_um(lens, scene.seen(distance), scene.tolerance)
                column |= {"rms_um": radius, "light": light, "loss": float(np.mean(loss))}
            rows.append(columns)
            changes.append([(trace[n] - trace[n][0]) / self._scale[n] for n in self.lens.names])
        return {"numbers": rows, "changes_mm": np.array(changes), "spot_mm": distance}


def values_of(parameters: dict[str, Any], k: int) -> dict[str, float]:
    """Trained numbers of the lens of job k."""
    return {name: float(np.ravel(value)[k]) for name, value in parameters["optics"].items()}


def require_finite(label: str, first: int, losses: np.ndarray, what: str = "loss") -> None:
    """ConfigError, with the batch, unless all losses of a job are finite. first: first batch."""
    lost = np.flatnonzero(~np.isfinite(losses))
    what = f"{label}: the {what} is not finite from batch {first + lost[:1].sum()} on"
    require(not lost.size, f"{what}; leave this start out, or lower the learning rates")


def read_patches(config: DataConfig, side: int, seed: int, folder: pathlib.Path) -> Patches:
    """Reads patches of images, with a progress bar. Prints their number and the files that were
    skipped; a long list is written to skipped.txt of the folder."""
    reading = functools.partial(tqdm, desc="reading images", leave=False)
    patches = load_patches(config, side, seed, reading)
    for line in patches.skipped[:_NAMED]:
        print(f"skipped {line}", file=sys.stderr)
    if len(patches.skipped) > _NAMED:
        listed = folder / "skipped.txt"
        replace(listed, "".join(f"{line}\n" for line in patches.skipped).encode())
        print(f"skipped {len(patches.skipped)} in all, named in {listed}", file=sys.stderr)
    counts = f"{len(patches.train)} training and {len(patches.test)} test patches"
    print(f"{counts} of {side} x {side}")
    return patches


def images(
    imager: Callable, parameters: Any, scenes: np.ndarray, where: Any, noise: float, seed: int
) -> dict[str, np.ndarray]:
    """True, sensor and restored images of patches, for `draw_patches`. where: argument of `imager`,
    the distance or the object points."""
    found = imager(parameters, scenes, where, np.float32(noise), jax.random.key(seed))
    return {name: np.asarray(image, np.float16) for name, image in zip(IMAGES, found)}


def thinned(patches: np.ndarray, count: int) -> np.ndarray:
    """At most `count` patches, evenly over the set; all for 0."""
    if not count or count >= len(patches):
        return patches
    return np.asarray(patches[np.linspace(0, len(patches) - 1, count).astype(int)])


def textured(patches: np.ndarray, count: int) -> np.ndarray:
    """At most `count` patches for a figure, evenly over the half with more contrast."""
    contrast = np.std(patches.reshape(len(patches), -1), axis=1)
    return thinned(patches[np.argsort(contrast)[len(patches) // 2 :]], count)
