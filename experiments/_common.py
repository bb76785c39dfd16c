"""What the experiments share: checks of settings, results on disk, tables, measured time."""

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
from drt_jax.runs.config import ConfigError
from drt_jax.runs.folder import Run

ROOT = pathlib.Path(__file__).resolve().parent.parent
# A turn of `medians` lasts at least so many seconds.
_TURN = 0.05


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


def require_known(name: str, values: tuple[str, ...], known: Iterable[str]) -> None:
    """ConfigError unless all values are among the known ones."""
    for value in values:
        require(value in known, f"{name}: unknown {value!r}; known: {', '.join(known)}")


def write_results(run: Run, results: dict[str, Any]) -> None:
    """Results of a run: arrays as results.npz, all else as results.json."""
    arrays = {key: value for key, value in results.items() if isinstance(value, np.ndarray)}
    if arrays:
        np.savez_compressed(run.folder / "results.npz", **arrays)
    run.finish({key: value for key, value in results.items() if key not in arrays})


def read_results(folder: pathlib.Path) -> dict[str, Any]:
    """What `write_results` wrote into a run folder. ConfigError if the run is not finished."""
    path = folder / "results.json"
    require(path.is_file(), f"{folder}: no results.json in it: the run is not finished")
    results = json.loads(path.read_text())
    if (folder / "results.npz").is_file():
        with np.load(folder / "results.npz") as arrays:
            results |= dict(arrays)
    return results


def measured(run: Run, unit: str, jobs: dict[str, Callable[[], Any]]) -> list[Any]:
    """What each job returns, as JSON reads it back; from its checkpoint if there is one."""
    found = []
    for job in (bar := tqdm(jobs, unit=unit, dynamic_ncols=True)):
        bar.set_description(job)
        done, text = run.load(job, np.zeros(0, np.uint8), (job,))
        if not done:
            text = np.frombuffer(json.dumps(jobs[job]()).encode(), np.uint8)
            run.save(job, 1, text)
        found.append(json.loads(np.asarray(text).tobytes()))
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
