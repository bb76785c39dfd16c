"""The folder of a run: resolved config, metrics as they come, checkpoints, results, figures.

Everything is written so that a run killed at any moment can go on: a checkpoint replaces its
predecessor in one step, and metrics that lie beyond it are dropped when the run resumes.
"""

import contextlib
import csv
import io
import json
import os
import pathlib
import signal
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .config import ConfigError, dump_config, load_config


class Run:
    """One run in one folder; several jobs (starting points, say) may share it."""

    def __init__(self, folder: pathlib.Path, config: Any, columns: tuple[str, ...], resume: bool):
        """Open the folder.

        folder: created if need be.
        config: a dataclass, all settings of the run.
        columns: of metrics.csv, after `job` and `step`.
        resume: whether to go on with the run that the folder holds.

        ConfigError if it holds another run that has begun to train, or on resuming a run with
        another configuration, or one that does not exist.
        """
        self.folder = folder
        self.figures = folder / "figures"
        self._metrics = folder / "metrics.csv"
        self._columns = ("job", "step", *columns)
        self._earlier, self._opened = 0.0, time.perf_counter()
        saved = folder / "config.yaml"
        if resume:
            if not saved.is_file():
                raise ConfigError(f"{folder}: nothing to resume: no config.yaml in it")
            if load_config(type(config), saved) != config:
                raise ConfigError(
                    f"{saved}: the run to resume was started with other settings; "
                    "leave out --config and --set to take its own, or choose another --out"
                )
        elif self._metrics.exists():
            raise ConfigError(
                f"{folder}: holds a run already; add --resume to go on with it, "
                "or choose another --out"
            )
        self.figures.mkdir(parents=True, exist_ok=True)
        if not resume:
            self._replace("config.yaml", dump_config(config).encode())

    @property
    def seconds(self) -> float:
        """Time spent on the run, in the processes before a resume too."""
        return self._earlier + time.perf_counter() - self._opened

    def log(self, job: str, step: int, rows: dict[str, np.ndarray]) -> None:
        """Append metrics of consecutive steps.

        step: the first of them.
        rows: (N,) values of N steps by column; a column that is not among them stays empty.
        """
        with open(self._metrics, "a", newline="") as file:
            writer = csv.DictWriter(file, self._columns, extrasaction="ignore")
            if not file.tell():
                writer.writeheader()
            for i, values in enumerate(zip(*rows.values())):
                row = zip(rows, map(float, values))
                writer.writerow({"job": job, "step": step + i, **dict(row)})

    def metrics(self, job: str) -> dict[str, np.ndarray]:
        """The logged metrics of one job, arrays by column (with `step`); NaN where empty."""
        with open(self._metrics, newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["job"] == job]
        return {c: np.array([float(row[c] or "nan") for row in rows]) for c in self._columns[1:]}

    def save(self, job: str, step: int, tree: Any) -> None:
        """Checkpoint: the state `tree` of `job` after `step` steps."""
        arrays: dict[str, Any] = {f"leaf{i}": a for i, a in enumerate(jax.tree.leaves(tree))}
        arrays |= {"step": step, "seconds": self.seconds}
        file = io.BytesIO()
        np.savez(file, **arrays)
        self._replace(f"checkpoints/{job}.npz", file.getvalue())

    def load(self, job: str, tree: Any, logged: tuple[str, ...]) -> tuple[int, Any]:
        """The last checkpoint of `job` as (step, state); (0, tree) if there is none.

        tree: a state of the same structure.
        logged: the names under which the job logs; their metrics beyond the checkpoint are dropped.
        """
        path = self.folder / "checkpoints" / f"{job}.npz"
        step = 0
        if path.is_file():
            leaves, structure = jax.tree.flatten(tree)
            try:
                with open(path, "rb") as file, np.load(file) as saved:
                    stored = [jnp.asarray(saved[f"leaf{i}"]) for i in range(len(leaves))]
                    step = int(saved["step"])
                    self._earlier = max(self._earlier, float(saved["seconds"]))
            except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
                raise ConfigError(
                    f"{path}: not a checkpoint of this run; delete it to start the job anew"
                ) from error
            tree = jax.tree.unflatten(structure, stored)
        self._truncate(logged, step)
        return step, tree

    def _truncate(self, jobs: tuple[str, ...], step: int) -> None:
        if not self._metrics.exists():
            return
        with open(self._metrics, newline="") as file:
            header, *rows = list(csv.reader(file)) or [list(self._columns)]
        whole = [row for row in rows if len(row) == len(self._columns)]
        kept = [row for row in whole if row[0] not in jobs or int(row[1]) < step]
        if len(kept) < len(rows):
            text = io.StringIO(newline="")
            csv.writer(text).writerows([header, *kept])
            self._replace("metrics.csv", text.getvalue().encode())

    def finish(self, results: dict[str, Any]) -> pathlib.Path:
        """Write results.json and return its path."""
        self._replace("results.json", (json.dumps(results, indent=2) + "\n").encode())
        return self.folder / "results.json"

    def _replace(self, name: str, content: bytes) -> None:
        """Write a file whole or not at all."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = path.with_name(path.name + ".partial")
        try:
            with open(scratch, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(scratch, path)
        finally:
            scratch.unlink(missing_ok=True)


@contextlib.contextmanager
def deferred_interrupt(notify: Callable[[], None] = lambda: None) -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C (or SIGTERM) into a question: yields a function that says whether
    one came, to be asked where stopping is safe. A second one acts at once.

    notify: called when the first one comes.

    A signal that is ignored, as SIGINT is under `nohup`, stays so.
    """
    asked = False
    # Only the main thread may handle signals; None: a handler from outside Python.
    main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if main else ()
    previous = {n: h for n in numbers if (h := signal.getsignal(n)) not in (None, signal.SIG_IGN)}

    def ask(number: int, frame: Any) -> None:
        nonlocal asked
        asked = True
        signal.signal(number, previous[signal.Signals(number)])
        notify()

    for number in previous:
        signal.signal(number, ask)
    try:
        yield lambda: asked
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
