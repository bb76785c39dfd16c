"""What the experiments share: the command line, errors, training one job in a run folder."""

import argparse
import dataclasses
import datetime
import math
import os
import pathlib
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax.runs import config as configs
from drt_jax.show import layout as drawing
from drt_jax.show import plot
from drt_jax.learn import train
from drt_jax.learn.data import Patches, batches, load_patches
from drt_jax.runs.folder import Run, deferred_interrupt

_ROOT = pathlib.Path(__file__).resolve().parent.parent


def require(condition: bool, message: str) -> None:
    """ConfigError with the message, which names the key, unless the condition holds."""
    if not condition:
        raise configs.ConfigError(message)


def require_list(name: str, values: tuple[float, ...], low: float = 0.0) -> None:
    """ConfigError unless a list of settings has items, all different, finite and above `low`."""
    require(len(values) > 0, f"{name}: needs at least one item")
    require(len(set(values)) == len(values), f"{name}: an item stands twice")
    for value in values:
        require(low < value < math.inf, f"{name}: expected numbers above {low:g}, got {value!r}")


def require_noise(name: str, *values: float) -> None:
    """ConfigError unless all values are usable as standard deviations."""
    for value in values:
        require(0 <= value < math.inf, f"{name}: expected 0 or more, got {value!r}")


@dataclasses.dataclass(frozen=True)
class Scene:
    """lens: bundled name or YAML path. wavelengths_um: of the three channels, R, G, B.
    tolerance: relative error of the blur that fixes the number of rays."""

    lens: str = "double_gauss"
    wavelengths_um: tuple[float, ...] = (0.6, 0.53, 0.48)
    tolerance: float = 1e-9

    def __post_init__(self) -> None:
        require(len(self.wavelengths_um) == 3, "scene.wavelengths_um: expected three, for R, G, B")


@dataclasses.dataclass(frozen=True)
class Training:
    """batches: steps of each job. batch: patches in one. patch: their side in pixels.
    optics_rate: Adam's learning rate in mm. checkpoint_every: in batches, or when metrics are
    next written."""

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


def main(
    name: str,
    kind: type,
    columns: tuple[str, ...],
    run: Callable[[Any, Run], None],
    argv: list[str] | None = None,
) -> None:
    """Command line of one experiment: read the settings, open the folder, run, report errors."""
    default = _ROOT / "configs" / f"{name}.yaml"
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{name}",
        description=(sys.modules[run.__module__].__doc__ or "").strip(),
        epilog="settings:\n  " + "\n  ".join(configs.describe(kind)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--config", metavar="FILE", help=f"YAML settings (default: configs/{name}.yaml)"
    )
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        nargs="+",
        action="extend",
        default=[],
        help="change settings, such as --set train.batch=8 data.root=photos",
    )
    parser.add_argument(
        "--out", metavar="DIR", help=f"run folder (default: a new one in runs/{name})"
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with the run in --out (default: the latest unfinished one in runs/NAME)",
    )
    options = parser.parse_args(argv)
    # The caller, not the library, chooses the precision: optics in float64.
    jax.config.update("jax_enable_x64", True)
    _keep_programs()
    started = time.perf_counter()
    folder = None
    try:
        folder = _folder(name, options)
        source = options.config or default
        if options.resume and not options.config:
            source = folder / "config.yaml"
            if not source.is_file():
                raise configs.ConfigError(f"{folder}: nothing to resume: no config.yaml in it")
        config = configs.load_config(kind, source, options.set)
        opened = Run(folder, config, columns, options.resume)
        print(f"{name}: run folder {folder}")
        run(config, opened)
    except KeyboardInterrupt:
        where = f"; go on with --resume --out {folder}" if folder else ""
        raise SystemExit(_say(f"stopped{where}", 130)) from None
    except OSError as error:
        what = f"{error.filename or folder}: {error.strerror or error}"
        remedy = "mend this and start again"
        if folder and (folder / "metrics.csv").exists():
            remedy = (
                f"the last checkpoint is whole: mend this, then go on with --resume --out {folder}"
            )
        raise SystemExit(_say(f"{what}; {remedy}", 1)) from error
    except ValueError as error:
        if not _ours(error):
            raise
        raise SystemExit(_say(str(error), 2)) from None
    print(f"done in {time.perf_counter() - started:.0f} s")


def _keep_programs() -> None:
    """Keep compiled programs for the next run, in JAX_COMPILATION_CACHE_DIR or the user's cache."""
    if not jax.config.jax_compilation_cache_dir:
        home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(pathlib.Path(home) / "drt_jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def _say(message: str, code: int) -> int:
    print(f"error: {message}" if code != 130 else message, file=sys.stderr)
    return code


def _ours(error: ValueError) -> bool:
    """Whether this project raised it, about its input; any other is a fault to be shown whole."""
    raised = pathlib.Path(traceback.extract_tb(error.__traceback__)[-1].filename)
    return raised.parent.name in ("drt_jax", "experiments")


def _folder(name: str, options: argparse.Namespace) -> pathlib.Path:
    if options.out:
        return pathlib.Path(options.out)
    parent = pathlib.Path("runs") / name
    if not options.resume:
        return parent / datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    folders = sorted(
        p
        for p in parent.glob("*")
        if (p / "metrics.csv").is_file() and not (p / "results.json").is_file()
    )
    if not folders:
        raise configs.ConfigError(
            f"nothing to resume in {parent}: no unfinished run; name a run folder with --out"
        )
    return folders[-1]


def patches(config: Any, progress: str = "reading images") -> Patches:
    """Patches of the run's images, with the context that its blur needs; says what was skipped."""
    side = config.train.patch + config.camera.kernel - 1
    loaded = load_patches(
        config.data, side, config.seed, lambda work: tqdm(work, desc=progress, leave=False)
    )
    for line in loaded.skipped:
        print(f"skipped {line}", file=sys.stderr)
    print(f"{len(loaded.train)} training and {len(loaded.test)} test patches of {side} x {side}")
    return loaded


def train_job(
    run: Run,
    job: str,
    init: Callable,
    step: Callable,
    parameters: dict[str, Any],
    scenes: np.ndarray,
    noise: float,
    config: Any,
    labels: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Train one job, or several vectorised ones with a label each, from its last checkpoint on.

    Logs metrics and saves checkpoints in `run`; returns the trained parameters.
    KeyboardInterrupt, after a checkpoint, if the user asked to stop.
    """
    total = config.train.batches
    first, state = run.load(job, init(parameters), labels or (job,))
    saved = first
    bar = tqdm(total=total, initial=first, desc=job, unit="batch", dynamic_ncols=True)

    def notify() -> None:
        print("\nstopping after this step; once more stops at once", file=sys.stderr)

    with bar, deferred_interrupt(notify) as asked:

        def report(start: int, metrics: dict[str, np.ndarray], state: Any) -> None:
            nonlocal saved
            done = start + len(metrics["loss"])
            for k, label in enumerate(labels or (job,)):
                run.log(label, start, {n: v[:, k] if labels else v for n, v in metrics.items()})
            bar.update(len(metrics["loss"]))
            last = {n: np.array2string(v[-1], precision=3) for n, v in metrics.items()}
            bar.set_postfix_str(
                " ".join(f"{n}={last[n]}" for n in ("loss", "sensor_mm") if n in last)
            )
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


def draw_lens(run: Run, lens: drt_jax.Lens, distance: float) -> pathlib.Path:
    """The lens with its axial beam, as figures/lens.png."""
    figure, axes = plot.new(width=8, height=4)
    plot.lens_drawing(axes, *drawing.draw(lens, [0.0], distance))
    axes.set_title(lens.name)
    path = run.figures / "lens.png"
    figure.savefig(path)
    return path


def table(header: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    """A plain-text table."""

    def say(value: Any) -> str:
        if not isinstance(value, float):
            return str(value)
        return f"{value:.3f}" if abs(value) >= 10 else f"{value:.4g}"

    cells = [header, *([say(value) for value in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    return "\n".join("  ".join(c.rjust(w) for c, w in zip(row, widths)) for row in cells)


def rates(config: Any) -> dict[str, float]:
    """Adam's learning rates of both groups."""
    return {"optics": config.train.optics_rate, "network": config.train.network_rate}


def final_window(config: Any) -> int:
    """How many of the last batches a final sensor position is averaged over: a tenth, at
    least 20, at most all."""
    return min(config.train.batches, max(20, config.train.batches // 10))


def thinned(patches: np.ndarray, count: int) -> np.ndarray:
    """At most `count` patches (0: all), spread evenly over the set."""
    if not count or count >= len(patches):
        return patches
    return np.asarray(patches[np.linspace(0, len(patches) - 1, count).astype(int)])


def textured(patches: np.ndarray, count: int) -> np.ndarray:
    """`count` patches for a picture, spread evenly over the half with more contrast."""
    contrast = np.std(patches.reshape(len(patches), -1), axis=1)
    return thinned(patches[np.argsort(contrast)[len(patches) // 2 :]], count)


def rmse_notes(rows: dict[str, Any]) -> dict[str, list[str]]:
    """RMSE of each image against the truth, as notes for `plot.patch_grid`."""
    return {
        name: [f"{np.sqrt(np.mean((t - i) ** 2)):.3f}" for t, i in zip(rows["truth"], images)]
        for name, images in rows.items()
        if name != "truth"
    }
