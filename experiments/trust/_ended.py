"""Runs that are killed, stopped or started twice: after --resume, their results must be those of an
uninterrupted run, bit for bit.

`python -m experiments._ended N SECONDS MODULE ...` runs `python -m MODULE ...` and kills it while
it writes: SECONDS after it has opened, renamed or removed a file in the folder of --out N times.
"""

import concurrent.futures
import itertools
import json
import os
import pathlib
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ._common import ROOT
from ._damaged_files import clear, row_of

# A short run that trains, writes metrics and checkpoints, and draws.
_TOY = ("train.batches=40", "train.batch=2", "train.patch=16", "train.checkpoint_every=5")
_TOY += ("camera.kernel=9", "data.crops_per_image=2", "starts_mm=[133.0, 134.0]")
# Seconds after which a run counts as hung, and seconds of an uninterrupted run; number of times
# that it opens, renames or removes a file.
_PATIENCE, _WHOLE, _TOUCHES = 240.0, 6.0, 60
_KILLS = 8  # number of kills of one run before it runs to its end
_SIGNALS = ((signal.SIGINT,), (signal.SIGTERM,), (signal.SIGINT, signal.SIGINT))


class _Ended(NamedTuple):
    """The end of a process. fault: "hang", "traceback" or "". message: the last line of its output,
    without progress bars."""

    code: int
    fault: str
    message: str


class _Way(NamedTuple):
    """A way to end a run: by signals after some seconds; or, with `touch` above 0, by SIGKILL some
    seconds after it has touched files of its folder so many times."""

    seconds: float
    signals: tuple[signal.Signals, ...] = ()
    touch: int = 0


def _start(folder: pathlib.Path, resume: bool = False, way: _Way | None = None) -> subprocess.Popen:
    """Starts or resumes the toy run in a folder; with a `way` that counts touches, one that kills
    itself."""
    touch = [__spec__.name, str(way.touch), str(way.seconds)] if way and way.touch else []
    module = [*touch, "experiments.focus", "--out", str(folder)]
    options = ["--resume"] if resume else ["--set", *_TOY]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "errors": "replace"}
    return subprocess.Popen([sys.executable, "-m", *module, *options], cwd=ROOT, **pipes)


def _end_of(process: subprocess.Popen) -> _Ended:
    fault = ""
    try:
        text = process.communicate(timeout=_PATIENCE)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        text, fault = process.communicate()[1], "hang"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    fault = fault or ("traceback" if "Traceback" in text else "")
    return _Ended(process.returncode, fault, lines[-1] if lines else "")


def _result(folder: pathlib.Path) -> dict[str, Any]:
    """Results of a run, without times, and its metrics."""
    results = json.loads((folder / "results.json").read_text())
    return results | {"seconds": None, "metrics.csv": (folder / "metrics.csv").read_text()}


def _outcome(ended: _Ended, folder: pathlib.Path, truth: dict[str, Any]) -> tuple[str, str]:
    """Outcome of a run that ended by itself, and its message or what is wrong."""
    if ended.fault:
        return ended.fault, ended.message
    if ended.code:
        refused = ended.code in (1, 2) and clear(ended.message)
        return "refused" if refused else "wrong", ended.message
    found = _result(folder)
    others = [key for key in sorted({*found, *truth}) if found.get(key) != truth.get(key)]
    return "wrong" if others else "survived", f"not as unbroken: {', '.join(others)}"


def _broken_off(folder: pathlib.Path, way: _Way) -> str:
    """Resumes the run in a folder and ends it; returns what went wrong, "" if nothing did."""
    process = _start(folder, (folder / "config.yaml").is_file(), way)
    if way.signals:
        time.sleep(way.seconds)
    for number in way.signals:
        process.send_signal(number)
        time.sleep(0.05)
    ended = _end_of(process)
    stopped = ended.code == 130 and "stopped" in ended.message and clear(ended.message)
    wrong = way.signals[:1] == (signal.SIGINT,) and ended.code and not stopped
    what = ended.fault or (f"code {ended.code}" if wrong else "")
    return what and f"{what}: {ended.message}"


def rows(
    parent: pathlib.Path, count: int, rngs: list[np.random.Generator]
) -> Iterator[dict[str, Any]]:
    """Rows of runs that are ended `count` times in all, and of runs that are started twice.

    The reference is an uninterrupted run. A third of the ends are kills at random times, a third
    kills at writes, the rest signals. Each run is ended up to `_KILLS` times before it is resumed
    to its end, and two runs work at a time.
    """
    whole, numbers = parent / "whole", itertools.count()
    ended = _end_of(_start(whole))
    if ended.code:
        raise RuntimeError(f"the toy run failed: {ended.message}")
    truth = _result(whole)

    def chain(ways: list[_Way]) -> list[tuple[str, str]]:
        """Outcome of each way. One run is ended in all ways, one after the other, and then resumed
        to its end."""
        folder = parent / f"run {next(numbers)}"
        faults = [_broken_off(folder, way) for way in ways]
        ended = _end_of(_start(folder, resume=True))
        if "nothing to resume" in ended.message:
            ended = _end_of(_start(folder))
        found, message = _outcome(ended, folder, truth)
        found = "wrong" if found == "refused" else found
        return [("wrong", fault) if fault else (found, message) for fault in faults]

    def two(k: int) -> list[tuple[str, str]]:
        """Outcome of two processes in one folder: one does the run, the other refuses."""
        folder = parent / f"run {next(numbers)}"
        first = _start(folder)
        time.sleep(0.7 * k)
        both = [_end_of(_start(folder)), _end_of(first)]
        found = sorted(_outcome(ended, folder, truth) for ended in both)
        right = [outcome for outcome, _ in found] == ["refused", "survived"]
        return [("survived" if right else "wrong", str(found))]

    def side_by_side(function: Callable, items: Iterable) -> Iterator[tuple[str, str]]:
        """Outcomes of all items, two at a time."""
        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            yield from itertools.chain.from_iterable(pool.map(function, items))

    ways = {
        "killed at a random moment": lambda rng, k: _Way(rng.uniform(0, _WHOLE), (signal.SIGKILL,)),
        "killed at a write": lambda rng, k: _Way(
            rng.exponential(1e-3), touch=rng.integers(1, _TOUCHES)
        ),
        "stopped by a signal": lambda rng, k: _Way(rng.uniform(0, _WHOLE), _SIGNALS[k % 3]),
    }
    third = count // 3
    for (kind, way), rng, number in zip(ways.items(), rngs, (third, third, count - 2 * third)):
        some = [way(rng, k) for k in range(number)]
        chains = (some[k : k + _KILLS] for k in range(0, number, _KILLS))
        yield row_of(kind, side_by_side(chain, chains), number)
    yield row_of("two in a folder", side_by_side(two, range(3)), 3)


def _run_and_die() -> None:
    """Runs the module of the command line."""
    turn, seconds, module = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
    sys.argv = [module, *sys.argv[4:]]
    folder = os.path.abspath(sys.argv[sys.argv.index("--out") + 1])
    touches = itertools.count(1)

    def touch(event: str, arguments: tuple) -> None:
        if event not in ("open", "os.rename", "os.remove", "os.mkdir", "os.truncate"):
            return
        path = arguments[0]
        inside = isinstance(path, str | bytes) and os.fsdecode(path).startswith(folder)
        if inside and next(touches) == turn:
            threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL)).start()

    sys.addaudithook(touch)
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _run_and_die()
