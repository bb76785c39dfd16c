"""Runs that are killed, stopped or started twice resume to the results of an unbroken run, bit for
bit."""

import concurrent.futures
import itertools
import json
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from tqdm import tqdm

from ._common import ROOT
from ._outcomes import Tally, clear

# A short run that trains, writes metrics and checkpoints, and draws.
_TOY = ("train.batches=40", "train.batch=2", "train.patch=16", "train.checkpoint_every=5")
_TOY += ("camera.kernel=9", "data.crops_per_image=2", "starts_mm=[133.0, 134.0]")
# Seconds after which a run counts as hung, and that an unbroken one takes; files that it touches.
_PATIENCE, _WHOLE, _TOUCHES = 240.0, 6.0, 60
_KILLS = 8  # kills of one run before it may end
_MODULE = "experiments.focus"


class Ended:
    """The end of a process: its exit code, its messages, and whether it hung."""

    def __init__(self, process: subprocess.Popen, seconds: float = _PATIENCE):
        try:
            self.text = process.communicate(timeout=seconds)[1].decode("utf-8", "replace")
            self.hung = False
        except subprocess.TimeoutExpired:
            process.kill()
            self.text = process.communicate()[1].decode("utf-8", "replace")
            self.hung = True
        self.code = process.returncode

    @property
    def message(self) -> str:
        """The last line, behind progress bars."""
        lines = [line.strip() for line in re.split(r"[\r\n]+", self.text)]
        return next((line for line in reversed(lines) if line), "")


def start(folder: pathlib.Path, *options: str, dying: tuple[str, ...] = ()) -> subprocess.Popen:
    """Starts the toy run in a folder. dying: arguments of `_dying`."""
    module = ["experiments._dying", *dying, _MODULE] if dying else [_MODULE]
    settings = () if "--resume" in options else ("--set", *_TOY)
    command = [sys.executable, "-m", *module, "--out", str(folder), *options, *settings]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=ROOT, **pipes)


def resumed(folder: pathlib.Path) -> Ended:
    """Resumes the run in a folder, or starts it where nothing was begun."""
    ended = Ended(start(folder, "--resume"))
    return Ended(start(folder)) if "nothing to resume" in ended.message else ended


def result(folder: pathlib.Path) -> Any:
    """Results of a run except the seconds, and its metrics."""
    results = json.loads((folder / "results.json").read_text())
    return results | {"seconds": None}, (folder / "metrics.csv").read_text()


def difference(folder: pathlib.Path, truth: Any) -> str:
    """The first difference of a run from the truth, as text; "" for none."""
    (results, metrics), (true, true_metrics) = result(folder), truth
    for key in sorted({*results, *true}):
        if results.get(key) != true.get(key):
            return f"{key} is {results.get(key)}, not {true.get(key)}"
    lines = itertools.zip_longest(metrics.splitlines(), true_metrics.splitlines())
    for k, pair in enumerate(lines):
        if pair[0] != pair[1]:
            return f"metrics.csv, line {k + 1} is {pair[0]!r}, not {pair[1]!r}"
    return ""


def outcome(ended: Ended, folder: pathlib.Path, truth: Any) -> str:
    """Outcome of a run that was not disturbed, see `_outcomes`."""
    if ended.hung:
        return "hang"
    if "Traceback" in ended.text:
        return "traceback"
    if ended.code == 0:
        return "survived" if result(folder) == truth else "wrong"
    return "refused" if ended.code in (1, 2) and clear(ended.message) else "wrong"


def side_by_side(kind: str, trials: list[Callable[[], list[tuple[str, str]]]]) -> dict[str, Any]:
    """Runs trials, two at a time, and returns the row of their kind."""
    tally = Tally(kind)
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        running = [pool.submit(trial) for trial in trials]
        ready = concurrent.futures.as_completed(running)
        for done in tqdm(ready, total=len(trials), unit="run", leave=False, dynamic_ncols=True):
            for found, example in done.result():
                tally.add(found, example)
    return tally.row


class Toy:
    """The toy run, its true result, and folders for trials."""

    def __init__(self, folder: pathlib.Path):
        self._folder = folder
        self._numbers = itertools.count()  # shared by two threads
        self.whole = self.new()
        ended = Ended(start(self.whole))
        if ended.code:
            raise RuntimeError(f"the toy run failed: {ended.message}")
        self.truth = result(self.whole)

    def new(self) -> pathlib.Path:
        """A new folder, which does not exist yet."""
        return self._folder / f"run {next(self._numbers)}"

    def ends(self, ways: list[Callable[[pathlib.Path], str]]) -> list[tuple[str, str]]:
        """Ends one run in several ways, resumes it to its end, and returns the outcome of each way.
        ways: functions of the folder that return what went wrong, "" for nothing."""
        folder = self.new()
        faults = [way(folder) for way in ways]
        ended = resumed(folder)
        found, message = outcome(ended, folder, self.truth), ended.message
        if found == "wrong" and ended.code == 0:
            message = difference(folder, self.truth)
        found = "wrong" if found == "refused" else found
        shutil.rmtree(folder, ignore_errors=True)
        return [("wrong", fault) if fault else (found, message) for fault in faults]


def _go_on(folder: pathlib.Path, **dying: Any) -> subprocess.Popen:
    begun = (folder / "config.yaml").is_file()
    return start(folder, *(("--resume",) if begun else ()), **dying)


def _after(seconds: float, *signals: signal.Signals) -> Callable[[pathlib.Path], str]:
    """A way to end a run: signals after some seconds."""

    def end(folder: pathlib.Path) -> str:
        process = _go_on(folder)
        time.sleep(seconds)
        for number in signals:
            process.send_signal(number)
            time.sleep(0.05)
        ended = Ended(process)
        if ended.hung:
            return "hung"
        if "Traceback" in ended.text:
            return ended.text[-300:]
        stopped = ended.code == 130 and "stopped" in ended.message and clear(ended.message)
        if signals[0] == signal.SIGINT and ended.code and not stopped:
            return f"code {ended.code}: {ended.message}"
        return ""

    return end


def _at_touch(turn: int, seconds: float) -> Callable[[pathlib.Path], str]:
    """A way to end a run: SIGKILL some seconds after touch number `turn` of its folder."""

    def end(folder: pathlib.Path) -> str:
        ended = Ended(_go_on(folder, dying=(str(turn), str(seconds))))
        return "hung" if ended.hung else ended.text[-300:] * ("Traceback" in ended.text)

    return end


def _chained(toy: Toy, kind: str, ways: list[Callable[[pathlib.Path], str]]) -> dict[str, Any]:
    chains = [ways[k : k + _KILLS] for k in range(0, len(ways), _KILLS)]
    return side_by_side(kind, [lambda chain=chain: toy.ends(chain) for chain in chains])


def killed(toy: Toy, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Runs killed at random moments, from the first import on."""
    ways = [_after(rng.uniform(0, _WHOLE), signal.SIGKILL) for _ in range(count)]
    return _chained(toy, "killed at a random moment", ways)


def killed_at_writes(toy: Toy, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Runs killed while they write."""
    ways = [_at_touch(int(rng.integers(1, _TOUCHES)), rng.exponential(1e-3)) for _ in range(count)]
    return _chained(toy, "killed at a write", ways)


def stopped(toy: Toy, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Runs stopped by Ctrl-C, by SIGTERM, or by Ctrl-C twice."""
    kinds = ((signal.SIGINT,), (signal.SIGTERM,), (signal.SIGINT,) * 2)
    ways = [_after(rng.uniform(0, _WHOLE), *kinds[k % 3]) for k in range(count)]
    return _chained(toy, "stopped by a signal", ways)


def two(toy: Toy, count: int) -> dict[str, Any]:
    """Two processes in one folder: one does the run, the other refuses."""

    def trial(k: int) -> list[tuple[str, str]]:
        folder = toy.new()
        first = start(folder)
        time.sleep(0.7 * k)
        both = [Ended(start(folder)), Ended(first)]
        found = sorted(outcome(ended, folder, toy.truth) for ended in both)
        right = found == ["refused", "survived"]
        text = " / ".join(ended.message for ended in both)
        return [("survived" if right else "wrong", f"{found}: {text}")]

    return side_by_side("two in a folder", [lambda k=k: trial(k) for k in range(count)])
