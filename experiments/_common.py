"""What the experiments share: checks of settings, results on disk, tables, measured time."""

import dataclasses
import importlib.util
import io
import json
import math
import pathlib
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any

import jax
import numpy as np
from tqdm import tqdm

from drt_jax import Lens, Scene, load_lens, load_system, psf_moments

from .runs.config import ConfigError
from .runs.folder import Run
from .runs.machine import hardware

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


# Checks of one setting, written as Annotated[float, within(0, 1)]: functions of its value that
# return what is wrong, "" for nothing.
Check = Callable[[Any], str]


def within(low: float, high: float) -> Check:
    """A number, or all items of a list, from `low` to `high`."""

    def check(value: Any) -> str:
        items = value if isinstance(value, tuple) else (value,)
        outside = [item for item in items if not low <= item <= high]
        return f"expected {low:g} to {high:g}, got {outside[0]!r}" if outside else ""

    return check


def not_empty(value: tuple) -> str:
    """A list with at least one item."""
    return "" if value else "needs at least one item"


def different(value: tuple) -> str:
    """A list of items that all differ."""
    return "" if len(set(value)) == len(value) else "an item stands twice"


def odd(value: int) -> str:
    """An odd number."""
    return "" if value % 2 else "expected an odd number"


def or_zero(check: Check) -> Check:
    """0, or a value that another check accepts."""
    return lambda value: "" if value == 0 else (wrong := check(value)) and f"{wrong}, or 0"


def three_colours(value: tuple) -> str:
    """Wavelengths of R, G and B."""
    return "" if len(value) == 3 else "expected three, for R, G, B"


def near_and_far(value: tuple) -> str:
    """Two distances."""
    ordered = len(value) == 2 and 0 < value[0] <= value[1]
    return "" if ordered else "expected the nearest and the farthest distance in m"


# A list of different numbers.
Numbers = Annotated[tuple[float, ...], not_empty, different]
# Wavelengths in um, also those of R, G and B.
Wavelengths = Annotated[Numbers, within(1e-4, 1e6)]
Colours = Annotated[tuple[float, ...], three_colours, within(1e-4, 1e6)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class LensFile:
    """Settings that name a lens.

    lens: bundled name, or path of a .yaml, .zmx or .seq file.
    configuration: of a .zmx or .seq file that has several, from 1; null for the one it is in.
    """

    lens: str
    configuration: int | None = None

    def load(self) -> Lens:
        """The lens. LensError as of `load_lens`."""
        return load_lens(self.lens, configuration=self.configuration)

    def distance(self) -> float:
        """Distance of the object, mm: that of a .zmx or .seq file, else inf."""
        if pathlib.Path(self.lens).suffix.lower() not in (".zmx", ".seq"):
            return math.inf
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # `load` has warned
            return float(load_system(self.lens, configuration=self.configuration).distance)


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


def one_machine(results: dict[str, Any]) -> str:
    """The machine of results, as a line of text. ConfigError for results of several machines,
    whose times must not be in one table."""
    kinds = {hardware(record) for record in results["machines"]}
    words = "times of two machines are never in one table: begin the run anew on one of them"
    require(len(kinds) == 1, f"machines: {' and '.join(sorted(kinds))}: {words}")
    first = results["machines"][-1]  # the one that began
    versions = ", ".join(f"{name} {number}" for name, number in first["versions"].items())
    load = f"load {first['load']} at the start, commit {first['commit']}"
    return f"{hardware(first)}, {load}; Python {first['python']}, {versions}"


def settings(config: Any, *names: str) -> dict[str, Any]:
    """Some settings by name, for results: tuples as lists."""
    values = {name: getattr(config, name) for name in names}
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def spot_um(lens: Lens, scene: Scene, tolerance: float) -> tuple[float, float]:
    """RMS radius of the spot of all wavelengths about their mean centroid, um, and the smallest
    throughput of a wavelength.

    scene: one object point.
    tolerance: relative error, which fixes the pupil rule.
    """
    found = psf_moments(lens, scene, tolerance)
    mean, covariance = np.asarray(found.mean), np.asarray(found.covariance)
    weights = np.asarray(scene.spectrum)
    away = mean - np.average(mean, axis=0, weights=weights)
    squares = np.trace(covariance, axis1=1, axis2=2) + np.sum(away**2, axis=1)
    radius = 1e3 * math.sqrt(np.average(squares, weights=weights))
    return radius, float(np.min(found.throughput))


def spots_um(lens: Lens, scene: Scene, tolerance: float) -> list[float]:
    """The radius of `spot_um` for each field of a scene."""
    return [spot_um(lens, scene.at(field), tolerance)[0] for field in np.asarray(scene.field)]


def measured(run: Run, unit: str, jobs: dict[str, Callable[[], Any]]) -> list[Any]:
    """Results of jobs, as JSON reads them back; from a checkpoint if there is one."""
    found = []
    for job in (bar := tqdm(jobs, unit=unit, dynamic_ncols=True)):
        bar.set_description(job)
        found.append(run.once(job, jobs[job]))
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
    """Median seconds of each call, see `timed`."""
    return [float(np.median(taken)) for taken in timed(calls, repeats)]


def quartiles(calls: Sequence[Callable[[], Any]], repeats: int) -> list[list[float]]:
    """First quartile, median and third quartile of the seconds of each call, see `timed`."""
    return [np.quantile(taken, (0.25, 0.5, 0.75)).tolist() for taken in timed(calls, repeats)]


def timed(calls: Sequence[Callable[[], Any]], repeats: int) -> list[list[float]]:
    """Seconds of each call, in turns, after one call that does not count. Calls above a second are
    made three times.

    The first call of a turn does not count either, because threads of the previous program may
    still be active.
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
    return times
