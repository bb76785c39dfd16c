"""The folder of a run: resolved config, metrics, checkpoints, results, figures.

A run that was killed at any moment can be resumed: one process at a time works in the folder, a
checkpoint replaces its predecessor atomically and is checked before use, and resuming drops metrics
beyond the checkpoint.
"""

import contextlib
import dataclasses
import hashlib
import io
import json
import math
import pathlib
import time
import urllib.parse
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drt_jax.inputs import shown

from .config import ConfigError, dump_config, load_config
from .disk import finite, locked, packed, replace, sweep, unpacked
from .machine import machine
from .metrics import Metrics

_OTHERS = "other settings than those in config.yaml"


def begun(folder: pathlib.Path) -> bool:
    """True if a folder holds a run with metrics, checkpoints or results."""
    if any((folder / "checkpoints").glob("*.npz")) or (folder / "results.json").exists():
        return True
    metrics = folder / "metrics.csv"
    return metrics.is_file() and len(metrics.read_bytes().splitlines()) > 1


class Run:
    """One run in one folder, with one or more jobs, such as starting points. No other process can
    open the folder before `close`, or before the end of a `with` block.

    figures: folder of its figures.
    """

    def __init__(self, folder: pathlib.Path, config: Any, columns: tuple[str, ...], resume: bool):
        """Opens the folder.

        config: dataclass with all settings of the run.
        columns: columns of metrics.csv after `job` and `step`.
        resume: True to resume the run in the folder.

        ConfigError if another process works in the folder. Without `resume`: if it already contains
        a run. With `resume`: if it contains no run, a run with other settings, or damaged metrics.
        """
        self.folder = folder
        self.figures = folder / "figures"
        self._metrics = Metrics(folder / "metrics.csv", columns)
        self._earlier, self._opened = 0.0, time.perf_counter()
        self._saved: set[str] = set()  # jobs of which this process has written a checkpoint
        self._machines = [machine()]  # also the machines of checkpoints that were read
        # All settings except those that do not change the results.
        about = {f.name for f in dataclasses.fields(config) if f.compare}
        compared = {n: v for n, v in dataclasses.asdict(config).items() if n in about}
        settings = json.dumps(compared, sort_keys=True)
        self._settings = hashlib.sha256(settings.encode()).hexdigest()
        if resume and not (folder / "config.yaml").is_file():
            raise ConfigError(f"{folder}: nothing to resume: no config.yaml in it")
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as stack:
            stack.enter_context(locked(folder))
            for part in (folder, folder / "checkpoints"):
                sweep(part)
            saved = folder / "config.yaml"
            if not resume:
                if begun(folder):
                    remedy = "add --resume to go on with it, or choose another --out"
                    raise ConfigError(f"{folder}: holds a run already; {remedy}")
                self._metrics.write([])
                replace(saved, dump_config(config).encode())
            elif load_config(type(config), saved) == config:
                self._metrics.mend()
            else:
                wrong = f"{saved}: the run to resume was started with other settings"
                remedy = "leave out --config and --set to take its own, or choose another --out"
                raise ConfigError(f"{wrong}; {remedy}")
            self.figures.mkdir(exist_ok=True)
            self._held = stack.pop_all()

    def close(self) -> None:
        """Unlocks the folder; nothing more may be written."""
        self._held.close()

    def __enter__(self) -> "Run":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def seconds(self) -> float:
        """Time spent on the run, s, with the time before it was resumed."""
        return self._earlier + time.perf_counter() - self._opened

    def log(self, job: str, step: int, rows: dict[str, np.ndarray]) -> None:
        """Appends metrics of consecutive steps.

        step: first step, 0 at the start of a job.
        rows: (N,) values of N steps by column; other columns stay empty.
        """
        self._metrics.append(job, step, rows)

    def metrics(self, job: str) -> dict[str, np.ndarray]:
        """Logged metrics of one job, arrays by column, with `step`; NaN where empty."""
        return self._metrics.of(job)

    def save(self, job: str, step: int, tree: Any) -> None:
        """Writes a checkpoint: the state `tree` of a job after `step` logged steps. ConfigError if
        the state is not finite; the previous checkpoint is then kept."""
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
        if not finite(leaves):
            remedy = "lower the learning rates; the last checkpoint is of an earlier step"
            raise ConfigError(f"{job}: numbers that are not finite after {step} steps; {remedy}")
        self._metrics.sync()  # a checkpoint is useless without its metrics
        about = {"job": job, "step": step, "seconds": self.seconds, "settings": self._settings}
        about["machine"] = self._machines[0]
        replace(self._path(job), packed(about, leaves))
        self._saved.add(job)

    def load(self, job: str, tree: Any, logged: tuple[str, ...], most: int) -> tuple[int, Any]:
        """The last checkpoint of a job as (step, state); (0, tree) without one.

        tree: state of the same structure, shapes and dtypes.
        logged: names under which the job logs; their metrics beyond the checkpoint are dropped.
        most: number of steps of the job.

        ConfigError, with the remedy, for a checkpoint that is damaged or does not belong to the
        job, and if metrics before it are missing.
        """
        leaves, structure = jax.tree.flatten(tree)
        forms = [(np.shape(leaf), np.dtype(jnp.result_type(leaf))) for leaf in leaves]
        step, found = self._found(job, logged, most, forms)
        if found is None:
            return 0, tree
        return step, jax.tree.unflatten(structure, map(jnp.asarray, found))

    def keep(self, job: str, value: Any) -> None:
        """Writes the checkpoint of a finished job: its result, as JSON."""
        text = np.frombuffer(json.dumps(value).encode(), np.uint8)
        self.save(job, len(self.metrics(job)["step"]), text)

    def kept(self, job: str) -> Any:
        """The result of a job that was written by `keep`. If there is none, drops the metrics of
        the job and returns None. ConfigError as in `load`."""
        _, found = self._found(job, (job,), math.inf, None)
        return None if found is None else json.loads(found[0].tobytes())

    def once(self, job: str, make: Callable[[], Any]) -> Any:
        """The result of a job, as read back from JSON: from its checkpoint if there is one, else
        computed by `make` and written. ConfigError as in `load`."""
        if self.kept(job) is None:
            self.keep(job, make())
        return self.kept(job)

    def _found(
        self, job: str, logged: tuple[str, ...], most: float, forms: list | None
    ) -> tuple[int, list[np.ndarray] | None]:
        """Step and arrays of the checkpoint of a job, after all checks; (0, None) if there is none.
        Drops metrics beyond the checkpoint. forms: shape and dtype of each array; None for any."""
        path, step, leaves = self._path(job), 0, None
        if path.is_file():
            try:
                about, leaves = unpacked(path.read_bytes())
                step, own = about["step"], [(leaf.shape, leaf.dtype) for leaf in leaves]
                for right, wrong in (
                    (about["job"] == job, f"belongs to the job {shown(about['job'])}"),
                    (about["settings"] == self._settings, f"belongs to {_OTHERS}"),
                    (0 <= step <= most, f"is of step {step}, not of one from 0 to {most}"),
                    (forms in (None, own), "holds arrays of other shapes or dtypes"),
                    (finite(leaves), "holds numbers that are not finite"),
                ):
                    if not right:
                        raise ValueError(wrong)
            except ValueError as error:
                raise ConfigError(f"{path}: {error}; delete it to begin this job anew") from error
            if job not in self._saved:
                self._earlier = max(self._earlier, about["seconds"])
                if (other := about.get("machine")) and other not in self._machines:
                    self._machines.append(other)
        remedy = f"delete {path.relative_to(self.folder)} to begin this job anew"
        self._metrics.cut(logged, step, remedy)
        return step, leaves

    def _path(self, job: str) -> pathlib.Path:
        return self.folder / "checkpoints" / f"{urllib.parse.quote(job, safe=' ,')}.npz"

    def finish(self, results: dict[str, Any]) -> None:
        """Writes the results, arrays as results.npz, the rest as results.json, and sorts the
        metrics.

        JSON has no NaN and no infinity: they become null. In results.json, `not_finite` lists the
        names of the results in either file that are not finite, if there are any; `machines` has
        the records of `machine` of all processes that worked on the run, the last one first.
        """
        self._metrics.order()
        arrays: dict[str, Any] = {n: a for n, a in results.items() if isinstance(a, np.ndarray)}
        bad = [name for name, array in arrays.items() if not np.all(np.isfinite(array))]
        plain = {n: _finite(value, n, bad) for n, value in results.items() if n not in arrays}
        if arrays:
            file = io.BytesIO()
            np.savez_compressed(file, **arrays)
            replace(self.folder / "results.npz", file.getvalue())
        plain |= {"not_finite": bad} if bad else {}
        plain["machines"] = self._machines
        text = json.dumps(plain, indent=2, allow_nan=False) + "\n"
        replace(self.folder / "results.json", text.encode())


def _finite(value: Any, name: str, bad: list[str]) -> Any:
    """A value for JSON: None replaces numbers that are not finite; their names are added to
    `bad`."""
    if isinstance(value, dict):
        return {key: _finite(item, f"{name}.{key}", bad) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item, f"{name}[{i}]", bad) for i, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        bad.append(name)
        return None
    return value
