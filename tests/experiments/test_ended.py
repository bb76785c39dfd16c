"""Runs that end early: Ctrl-C, kill -9 and full disks at every moment, ignored signals, results
that are not finite. The folder is then empty, or has a run that resumes to the same numbers."""

import importlib
import json
import os
import pathlib
import re
import resource
import signal
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import _command, _common, focus
from experiments.runs.config import ConfigError
from experiments.runs.folder import Run

from . import counting

ROOT = pathlib.Path(__file__).resolve().parents[2]
CONFIG = ROOT / "tests" / "experiments" / "counting.yaml"


def main(*argv):
    """The exit code of the command line."""
    try:
        _command.main(counting, [*map(str, argv)])
    except SystemExit as ended:
        return ended.code
    return 0


def begin(folder, *options):
    return main("--config", CONFIG, "--out", folder, *options)


def left(folder):
    """The files of a run, without its seconds and its machine, whose load changes."""
    results = json.loads((folder / "results.json").read_text(), parse_constant=pytest.fail)
    results.pop("seconds"), results.pop("machines")
    with np.load(folder / "results.npz") as arrays:
        losses = arrays["losses"].tolist()
    drawn = (folder / "figures" / "found.txt").read_text()
    assert not list(folder.rglob("*.partial"))
    return results, losses, drawn, (folder / "metrics.csv").read_bytes()


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    assert begin(folder) == 0
    return left(folder)


def go_on(folder, said):
    """Runs the command that the last line names."""
    if "nothing was begun" in said:
        return begin(folder)
    option = re.search(f"(--resume|--report) --out {re.escape(str(folder))}", said)[1]
    return main(option, "--out", folder)


def pressing(monkeypatch, moments):
    """Sends Ctrl-C at some moments, see `counting`; returns a function that returns the number of
    moments."""
    seen = []

    def act(moment):
        seen.append(moment)
        if moment in moments:
            signal.raise_signal(signal.SIGINT)

    for name, call in counting.at_each_write(act).items():
        monkeypatch.setattr(os, name, call)
    return lambda: len(seen)


@pytest.mark.slow
@pytest.mark.parametrize("again", [(), (1,), (2, 3)], ids=["once", "twice", "three times"])
def test_ctrl_c_at_any_moment_says_what_it_leaves(again, unbroken, tmp_path, monkeypatch, capsys):
    said, moment = set(), 0
    while True:
        folder = tmp_path / str(moment)
        with monkeypatch.context() as patch:
            count = pressing(patch, [moment, *(moment + k for k in again)])
            code = begin(folder)
            if moment >= count():
                break
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert code == 130 and line.startswith("stopped; "), (moment, line)
        said.add(re.sub(r"--out .*", "", line))
        assert go_on(folder, line) == 0, (moment, line)
        assert left(folder) == unbroken, moment
        moment += 1
    assert code == 0 and moment > 50
    assert said == {
        "stopped; nothing was begun",
        "stopped; what it wrote is whole; go on with --resume ",
        "stopped; the results are whole; draw them with --report ",
    }


@pytest.mark.slow
def test_kill_at_any_moment(unbroken, tmp_path):
    """No handler runs: the file that is being written is incomplete, the lock is removed."""
    command = [sys.executable, "-m", "tests.experiments.counting", "killed", tmp_path, CONFIG]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 50
    for moment in range(0, int(done.stdout), 3):
        assert left(tmp_path / str(moment)) == unbroken, moment


def test_a_disk_that_is_full_at_any_size_costs_nothing(unbroken, tmp_path, capsys):
    """Files cannot grow beyond a limit, which is one byte, or a few, larger in each turn."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    codes = set()
    for size in (0, 5, 13, 20, 40, 60, 100, 140, 300, 900, 1200, 1500, 5000):
        folder = tmp_path / str(size)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
        try:
            code = begin(folder)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        codes.add(code)
        line = capsys.readouterr().err.strip()
        if code:
            assert code == 1 and line.startswith("error: ") and "mend this, then" in line
            assert line.count("\n") == 0 and go_on(folder, line) == 0, (size, line)
        assert left(folder) == unbroken, size
    assert codes == {0, 1}


def test_an_output_folder_that_is_a_file(tmp_path, capsys):
    path = tmp_path / "file"
    path.write_text("mine")
    assert begin(path) == begin(path / "below") == 1
    for line in capsys.readouterr().err.strip().splitlines():
        assert line.startswith(f"error: {path}") and "nothing was begun: mend this" in line
    assert path.read_text() == "mine"


def test_names_with_spaces_and_other_signs(unbroken, tmp_path):
    assert begin(tmp_path / "a b, ü 🔭 %s {x}" / "%2F") == 0
    assert left(tmp_path / "a b, ü 🔭 %s {x}" / "%2F") == unbroken


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_training_is_heard_or_stays_ignored(number, unbroken, tmp_path):
    """As when a shell starts a program in the background of a script, or with `nohup`."""
    pressed = ["--set", f"pressed={int(number)}"]
    command = [sys.executable, "-m", "tests.experiments.counting", "--config", CONFIG, *pressed]
    for ignored, code in (("''", 0), ("-", 130)):
        folder = tmp_path / f"trap {ignored}"
        shell = ["sh", "-c", f'trap {ignored} INT TERM; exec "$@"', "sh", *command, "--out", folder]
        done = subprocess.run(shell, cwd=ROOT, capture_output=True, text=True, timeout=100)
        assert done.returncode == code, done.stderr
        if code:
            assert done.stderr == (
                f"stopped; what it wrote is whole; go on with --resume --out {folder}\n"
            )
            again = main("--resume", "--out", folder)
            while again == 130:
                again = main("--resume", "--out", folder)
            assert again == 0
        assert left(folder) == unbroken


EARLY = """
import os, signal
os.kill(os.getpid(), signal.SIGINT)
raise SystemExit(7)
"""


@pytest.mark.parametrize("name", ["focus", "restore", "edof", "benchmark", "tables"])
def test_ctrl_c_while_importing(name, tmp_path):
    """Sent during the first import of JAX: one line of output, unless it is ignored."""
    (tmp_path / "jax").mkdir()
    (tmp_path / "jax" / "__init__.py").write_text(EARLY)
    command = [sys.executable, "-m", f"experiments.{name}", "--out", str(tmp_path / "run")]
    found = os.environ | {"PYTHONPATH": str(tmp_path)}
    for ignored, code, said in (("-", 130, "\nstopped; nothing was begun\n"), ("''", 7, "")):
        shell = ["sh", "-c", f'trap {ignored} INT; exec "$@"', "sh", *command]
        done = subprocess.run(shell, cwd=ROOT, env=found, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (code, said)
    assert not (tmp_path / "run").exists()


def test_ctrl_c_in_a_program_ends_it_wherever_it_is(tmp_path):
    """Also where an exception would be lost, in a finalizer."""
    code = """
import os, signal, sys
sys.argv[0] = "-m"
import experiments

class Late:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            pass

print("said", end="")
late = Late()
del late
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 130
    assert (done.stdout, done.stderr) == ("said", "\nstopped; nothing was begun\n")


def test_a_live_run_keeps_others_out(tmp_path, capsys):
    folder = tmp_path / "run"
    with Run(folder, counting.Config(), counting.COLUMNS, False):
        for options in (["--config", CONFIG], ["--resume"]):
            assert main("--out", folder, *options) == 2
            said = capsys.readouterr().err
            assert said.count("\n") == 1 and "works in this folder; wait for it, or" in said
    assert main("--resume", "--out", folder) == 0


def test_results_that_are_not_finite_are_said(tmp_path, capsys):
    """They are null in the file, are named on the terminal, and give an exit code; also when they
    are reported again."""
    folder = tmp_path / "run"
    assert begin(folder, "--set", "result=.inf") == 1
    said = capsys.readouterr()
    assert said.err == f"error: not finite, null in {folder}/results.json: nan\n"
    assert "found {'one': " in said.out and left(folder)[0]["nan"] is None
    assert main("--report", "--out", folder) == 1 and main("--resume", "--out", folder) == 1


def test_a_run_in_a_latest_folder_is_resumed_if_it_began(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    parent = tmp_path / "runs" / "counting"
    for name, steps in (("1", 1), ("2", 0)):
        with Run(parent / name, counting.Config(), counting.COLUMNS, False) as run:
            run.log("one", 0, {"loss": np.ones(steps)})
    assert main("--resume") == 0 and (parent / "1" / "results.json").exists()
    assert main("--resume") == 2 and "nothing to resume in" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["results.json", "results.npz"])
@pytest.mark.parametrize("content", [b"", b"{\n", b"null", b"PK\x03\x04"], ids=repr)
def test_damaged_results_are_named(name, content, unbroken, tmp_path, capsys):
    folder = tmp_path / "run"
    assert begin(folder) == 0
    (folder / name).write_bytes(content)
    with pytest.raises(ConfigError, match=f"{name}: the file is damaged; have it written again"):
        _common.read_results(folder)
    assert main("--report", "--out", folder) == 2
    assert main("--resume", "--out", folder) == 0 and left(folder) == unbroken


LOSSES = {
    "flat": (lambda s: 0.25 + 0 * s, False),
    "flat but for rounding": (lambda s: 0.25 + 1e-7 * jnp.sin(1e3 * s), False),
    "falls to an end": (lambda s: 1 / s, False),
    "not finite": (lambda s: jnp.nan * s, False),
    "not finite at an end": (lambda s: jnp.where(s > 1.01, (s - 1.5) ** 2, jnp.nan), False),
    "infinite away from it": (lambda s: jnp.where(s > 1.2, (s - 1.5) ** 2, jnp.inf), True),
    "a parabola": (lambda s: 1 + (s - 1.5) ** 2, True),
}


@pytest.mark.parametrize("case", LOSSES)
def test_a_minimum_is_found_or_not(case):
    loss, there = LOSSES[case]
    scenes = np.zeros((2, 1))
    best = focus.best_focus(lambda sensor, _: loss(sensor), scenes, 1.0, 2.0)
    assert abs(best - 1.5) < 1e-4 if there else np.isnan(best)
    assert np.isnan(focus.best_focus(lambda sensor, _: loss(sensor), scenes, 1.5, 1.5))


def test_a_focus_that_was_not_found_is_said_and_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(focus._report, "draw_lens", lambda *args: None)
    rows = {"sensor_mm": np.ones((2, 30)), "sigma_um": np.full((2, 30), np.nan)}
    known = {"lens": "singlet", "starts_mm": [1.0, 2.0], "distance_mm": 1e4, "seconds": 1.0}
    found = {"best_focus_mm": None, "batches_to_focus": [None, 3], "final_mm": [None, 1.5]}
    (text,) = focus.tables(known | found).values()
    assert "not finite (dense search on the same loss: no minimum was found)" in text
    assert "never, 3" in text
    focus.draw(known | found | rows, tmp_path)
    assert len(list(tmp_path.glob("figure_4?.png"))) == 2


def test_errors_that_are_not_finite_are_words_in_the_tables():
    for name in ("restore", "edof"):
        results = _common.read_results(ROOT / "results" / name)
        rows = results["test"] if name == "restore" else results["table"]
        broken = rows[0] if name == "restore" else rows[0]["joint"]
        broken |= dict.fromkeys(broken)
        if name == "restore":
            broken |= {"noise": 0.01, "start_mm": 133.0}
        else:
            results["mean_mae"]["joint"] = None
        tables = importlib.import_module(f"experiments.{name}").tables(results)
        assert "not finite" in str(tables)


def test_a_loss_that_is_not_finite_ends_the_training():
    losses = np.array([1.0, 2.0, np.nan, np.inf])
    focus._training.require_finite("start 1.0", 10, losses[:2])
    with pytest.raises(ConfigError, match="start 1.0: the loss is not finite from batch 12 on; "):
        focus._training.require_finite("start 1.0", 10, losses)


@pytest.mark.parametrize(
    "path", sorted(ROOT.glob("results/*/results.json")), ids=lambda path: path.parent.name
)
def test_results_kept_with_the_code_are_json(path):
    constants: list[str] = []  # NaN and Infinity, which JSON does not have
    found = json.loads(path.read_text(), parse_constant=constants.append)
    assert found and not constants
