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
# A turn of `medians` lasts at least so many seconds.
_TURN = 0.05


def experiment(*names: str) -> Any:
    """The module of the first of these names that is one's."""
    known = (f"experiments.{name}" for name in names)
    return importlib.import_module(next(filter(importlib.util.find_spec, known)))


def settings_files() -> list[tuple[pathlib.Path, Any]]:
    """The files of settings, and the experiment of each: that of its name, or else of its folder's.
    What lies in a folder `lenses` is none."""
    paths = sorted((ROOT / "configs").rglob("*.yaml"))
    return [(p, experiment(p.stem, p.parent.name)) for p in paths if p.parent.name != "lenses"]


def require(condition: bool, message: str) -> None:
    """ConfigError with the message, which names the key, unless the condition holds."""
    if not condition:
        raise ConfigError(message)


def require_list(name: str, values: tuple[float, ...], low: float = 0.0) -> None:
    """ConfigError unless a list of settings has items, all different, finite and above `low`."""
    require(len(values) > 0, f"{name}: needs at least one item")
    require(len(set(values)) == len(values), f"{name}: an item stands twice")
    for value in values:
        require(low < value < math.inf, f"{name}: expected numbers above {low:g}, got {value!r}")


def require_within(prefix: str, settings: Any, **limits: tuple[float, float]) -> None:
    """ConfigError unless the settings of these names, of lists every item, lie within their limits,
    both included.

    prefix: of the settings in messages, such as "train.".
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
    """What `Run.finish` wrote into a run folder. ConfigError if the run is not finished, or its
    results are damaged."""
    path = folder / "results.json"
    require(path.is_file(), f"{folder}: no results.json in it: the run is not finished")
    results: dict[str, Any] = {}
    for part in (path, *folder.glob("results.npz")):
        content = part.read_bytes()
        try:
            whole = json.loads(content) if part == path else np.load(io.BytesIO(content))
            results |= dict(whole)
        except Exception as error:  # what reading a damaged archive can raise has no end
            remedy = f"have it written again with --resume --out {folder}"
            raise ConfigError(f"{part}: the file is damaged; {remedy}") from error
    return results


def measured(run: Run, unit: str, jobs: dict[str, Callable[[], Any]]) -> list[Any]:
    """What each job returns, as JSON reads it back; from its checkpoint if there is one."""
    found = []
    for job in (bar := tqdm(jobs, unit=unit, dynamic_ncols=True)):
        bar.set_description(job)
        if run.kept(job) is None:
            run.keep(job, jobs[job]())
        found.append(run.kept(job))
    return found


def grouped(rows: Iterable[dict], *keys: str) -> dict[tuple, list[dict]]:
    """Rows by their values of the keys, in the order of their first."""
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table that can be read as plain text too; nothing is shown for None."""

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
    """How many hexapolar rings hold at most so many rays."""
    return int((math.sqrt(12 * rays - 3) - 3) / 6)


def panels(count: int, width: float, height: float) -> tuple[Any, Any]:
    """A figure of so many panels in two columns, and their axes."""
    columns = min(2, count)
    figure, axes = show.new(-(-count // columns), columns, width, height)
    for spare in np.ravel(axes)[count:]:
        spare.set_visible(False)
    return figure, np.ravel(axes)


def number(value: float | None, form: str) -> str:
    """A result in words; one that was not finite is None."""
    return "not finite" if value is None else format(value, form)


def duration(seconds: float | None) -> str:
    """A time in the unit that suits it."""
    if seconds is None:
        return ""
    if seconds < 1:
        return f"{1e3 * seconds:.3g} ms"
    return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1f} s"


def medians(calls: Sequence[Callable[[], Any]], repeats: int) -> list[float]:
    """Median seconds of each call, made in turns after one that does not count; those that take
    over a second are made three times.

    The first call of a turn does not count either: the threads of another program go on spinning
    for a while, and would be counted against this one.
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
