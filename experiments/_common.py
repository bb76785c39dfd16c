"""What the experiments share: checks of settings, results on disk, tables, measured time."""

import importlib.util
import io
import json
import math
import pathlib
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from drt_jax import show

from .runs.config import ConfigError
from .runs.folder import Run

ROOT = pathlib.Path(__file__).resolve().parent.parent
# Settings, at the top of a checkout; in a wheel within this package.
_BASES = (ROOT, ROOT / "experiments")
BASE = next((base for base in _BASES if (base / "configs").is_dir()), ROOT)
CONFIGS = BASE / "configs"
# Shortest turn of `medians`, s.
_TURN = 0.05


def experiment(*names: str) -> Any:
    """The experiment of the first name that has a module."""
    known = (f"experiments.{name}" for name in names)
    return importlib.import_module(next(filter(importlib.util.find_spec, known)))


def settings_files() -> list[tuple[pathlib.Path, Any]]:
    """Files of settings with their experiment, that of the file's name or else of its folder's.
    Folders `lenses` hold other files."""
    paths = sorted(CONFIGS.rglob("*.yaml"))
    return [(p, experiment(p.stem, p.parent.name)) for p in paths if p.parent.name != "lenses"]


def require(condition: bool, message: str) -> None:
    """Raises ConfigError with the message, which names the key, unless the condition holds."""
    if not condition:
        raise ConfigError(message)


def require_different(name: str, values: Sequence[Any]) -> None:
    """ConfigError for an item that is given twice."""
    require(len(set(values)) == len(values), f"{name}: an item stands twice")


def require_list(name: str, values: tuple[float, ...], low: float = 0.0) -> None:
    """ConfigError unless a list of settings has items, all different, finite and above `low`."""
    require(len(values) > 0, f"{name}: needs at least one item")
    require_different(name, values)
    for value in values:
        require(low < value < math.inf, f"{name}: expected numbers above {low:g}, got {value!r}")


def require_within(prefix: str, settings: Any, **limits: tuple[float, float]) -> None:
    """ConfigError unless the settings, or all their items, lie within limits, both included.

    prefix: prefix of the names in messages, such as "train.".
    limits: lowest and highest value by name.
    """
    for name, (low, high) in limits.items():
        value = getattr(settings, name)
        for item in value if isinstance(value, tuple) else (value,):
            expected = f"{prefix}{name}: expected {low:g} to {high:g}"
            require(low <= item <= high, f"{expected}, got {item!r}")


def require_known(name: str, values: tuple[str, ...], known: Iterable[str]) -> None:
    """ConfigError unless all values are among the known ones."""
    for value in values:
        require(value in known, f"{name}: unknown {value!r}; known: {', '.join(known)}")


def read_results(folder: pathlib.Path) -> dict[str, Any]:
    """Reads what `Run.finish` wrote. ConfigError if the run is not finished or its results are
    damaged."""
    path = folder / "results.json"
    require(path.is_file(), f"{folder}: no results.json in it: the run is not finished")
    results: dict[str, Any] = {}
    for part in (path, *folder.glob("results.npz")):
        content = part.read_bytes()
        try:
            whole = json.loads(content) if part == path else np.load(io.BytesIO(content))
            results |= dict(whole)
        except Exception as error:  # a damaged archive may raise anything
            remedy = f"have it written again with --resume --out {folder}"
            raise ConfigError(f"{part}: the file is damaged; {remedy}") from error
    return results


def measured(run: Run, unit: str, jobs: dict[str, Callable[[], Any]]) -> list[Any]:
    """Results of jobs, as JSON reads them back; from a checkpoint if there is one."""
    found = []
    for job in (bar := tqdm(jobs, unit=unit, dynamic_ncols=True)):
        bar.set_description(job)
        if run.kept(job) is None:
            run.keep(job, jobs[job]())
        found.append(run.kept(job))
    return found


def grouped(rows: Iterable[dict], *keys: str) -> dict[tuple, list[dict]]:
    """Rows by their values of the keys, in order of appearance."""
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table that is legible as plain text; None is an empty cell."""

    def say(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.4g}"
        return "" if value is None else str(value)

    cells = [[say(value) for value in row] for row in (header, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells)]
    lines = ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in cells]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def rings(rays: int) -> int:
    """Number of hexapolar rings of at most `rays` rays."""
    return int((math.sqrt(12 * rays - 3) - 3) / 6)


def panels(count: int, width: float, height: float, columns: int = 2) -> tuple[Any, Any]:
    """A figure with panels in columns, and their axes."""
    columns = min(columns, count)
    figure, axes = show.new(-(-count // columns), columns, width, height)
    for spare in np.ravel(axes)[count:]:
        spare.set_visible(False)
    return figure, np.ravel(axes)


def number(value: float | None, form: str) -> str:
    """A result as text; None stands for one that was not finite."""
    return "not finite" if value is None else format(value, form)


def duration(seconds: float | None) -> str:
    """A time in the unit that suits it."""
    if seconds is None:
        return ""
    if seconds < 1:
        return f"{1e3 * seconds:.3g} ms"
    return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1f} s"


def medians(calls: Sequence[Callable[[], Any]], repeats: int) -> list[float]:
    """Median seconds of each call, in turns, after one call that does not count. Calls above a
    second are made three times.

    The first call of a turn does not count either, because threads of the program before may still
    spin.
    """
    times: list[list[float]] = [[] for _ in calls]
    for call in calls:
        jax.block_until_ready(call())
    for k in range(repeats):
        for call, taken in zip(calls, times):
            if k >= 3 and np.median(taken) > 1:
                continue
            jax.block_until_ready(call())
            began = time.perf_counter()
            while (start := time.perf_counter()) - began < _TURN:
                jax.block_until_ready(call())
                taken.append(time.perf_counter() - start)
    return [float(np.median(taken)) for taken in times]
