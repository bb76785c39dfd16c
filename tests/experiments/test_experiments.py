"""The paper's experiments at toy size: what they write, how they resume, their errors; and the
settings and tables of all experiments."""

import importlib
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml
from skimage import io

from drt_jax.learn import train
from experiments import _command, _common, tables
from experiments.runs.config import load_config
from experiments.runs.folder import Run, begun

ROOT = pathlib.Path(__file__).resolve().parents[2]
CONFIGS = dict(_common.settings_files())
SMALL = [
    "train.batch=2",
    "train.patch=16",
    "train.batches=25",
    "train.checkpoint_every=10",
    "camera.kernel=9",
    "data.crops_per_image=2",
]
TOY = {
    "focus": [*SMALL, "starts_mm=[133.0, 134.0]"],
    "restore": [
        *SMALL,
        "starts_mm=[133.0, 134.0]",
        "table_starts_mm=[133.0]",
        "table_noise=[0.01, 0.05]",
        "test_patches=3",
    ],
    "edof": [
        *SMALL,
        "starts_mm=[145.25, 145.5]",
        "table_depth_m=[5.0, 20.0]",
        "patch_depth_m=[10.0, 50.0]",
        "test_patches=3",
    ],
}
NAMES = ["focus", *(pytest.param(name, marks=pytest.mark.slow) for name in TOY if name != "focus")]
KEYS = {
    "focus": {"starts_mm", "final_mm", "best_focus_mm", "batches_to_focus", "seconds"},
    "restore": {"parameters", "starts_mm", "final_mm", "test"},
    "edof": {"starts_mm", "final_mm", "table"},
}
FIGURES = {
    "focus": {"lens", "figure_4a", "figure_4b"},
    "restore": {"figure_5a", "restored"},
    "edof": {"lens", "figure_6a", "figure_6b", "figure_7"},
}


def main(name, *argv):
    _command.main(importlib.import_module(f"experiments.{name}"), [*map(str, argv)])


def toy(name, folder):
    main(name, "--out", folder, "--set", *TOY[name])


def stop(name, folder, settings, *moment):
    """Sends Ctrl-C at a moment of a run: a job, and the first step of the metrics that it has
    logged."""
    log = Run.log

    def interrupting(self, job, step, rows):
        log(self, job, step, rows)
        if (job, step) == moment:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stopped:
        patch.setattr(Run, "log", interrupting)
        main(name, "--out", folder, "--set", *settings)
    assert stopped.value.code == 130 and not (folder / "results.json").exists()


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """The run folder of each experiment, run once without interruption."""
    folders = {}

    def run(name):
        if name not in folders:
            folders[name] = tmp_path_factory.mktemp("unbroken") / name
            toy(name, folders[name])
        return folders[name]

    return run


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_config_loads_strictly(path):
    kind = CONFIGS[path].Config
    others = {"seed": "99", "repeats": "99", "seeds": "99", "folders": "[elsewhere]"}
    others |= {"starts": "{seed: 99}", "parts": "[0.5]", "trials": "99", "bend": "0.5"}
    others |= {"celsius": "[99]"}
    name = next(name for name in others if name in kind.__dataclass_fields__)
    other = "starts.seed=99" if name == "starts" else f"{name}={others[name]}"
    assert load_config(kind, path) != load_config(kind, path, [other])


@pytest.mark.parametrize("name", NAMES)
def test_a_run_explains_itself(name, unbroken):
    folder = unbroken(name)
    results = json.loads((folder / "results.json").read_text())
    assert KEYS[name] <= set(results) and len(results["final_mm"]) == 2
    assert {path.stem for path in (folder / "figures").glob("*.png")} == FIGURES[name]
    for path in (folder / "figures").glob("*.png"):
        assert io.imread(path).std() > 5, f"{path} is blank"
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["train"]["batches"] == 25 and config["camera"]["form"] == "integrated"
    distances = [row["distance_m"] for row in results["gaussian"]]
    assert distances == ([10, 50] if name == "edof" else [25])
    assert all(0 < row["misplaced"] < 2 and row["contrast"] < 1 for row in results["gaussian"])
    if name == "restore":
        assert results["parameters"] == 298_947
        assert [row["noise"] for row in results["test"]] == [0.01, 0.05]
        assert results["test"][1]["sensor_mae"] > results["test"][0]["sensor_mae"]
    if name == "edof":
        assert [row["depth_m"] for row in results["table"]] == [5, 20]
        assert {"mae", "rmse"} <= set(results["table"][0]["fixed"])


@pytest.mark.parametrize("name", ["focus", pytest.param("restore", marks=pytest.mark.slow)])
def test_an_interrupted_run_resumes_to_the_same_numbers(name, unbroken, tmp_path, capsys):
    """Ctrl-C in the middle of a job, then --resume: metrics and results are those of an
    uninterrupted run."""
    stop(name, tmp_path / "run", TOY[name], "start 134.0", 10)
    assert "--resume" in capsys.readouterr().err
    main(name, "--resume", "--out", tmp_path / "run")
    assert_same(unbroken(name), tmp_path / "run")


def assert_same(wanted, folder):
    rows = [sorted((f / "metrics.csv").read_text().splitlines()) for f in (wanted, folder)]
    assert rows[0] == rows[1]
    results = [json.loads((f / "results.json").read_text()) for f in (wanted, folder)]
    for result in results:
        result.pop("seconds"), result.pop("machines")
    assert results[0] == results[1]


def test_a_killed_run_resumes_to_the_same_numbers(unbroken, tmp_path):
    """kill -9 after the first metrics: only the steps since the checkpoint are lost."""
    folder = tmp_path / "run"
    command = [
        sys.executable,
        "-m",
        "experiments.focus",
        "--out",
        str(folder),
        "--set",
        *TOY["focus"],
    ]
    process = subprocess.Popen(
        command, cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 120
    while not begun(folder) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    process.wait()
    main("focus", "--resume", "--out", folder)
    assert_same(unbroken("focus"), folder)


def test_finished_run_resumes_at_once(unbroken, capsys):
    before = (unbroken("focus") / "metrics.csv").read_text()
    main("focus", "--resume", "--out", unbroken("focus"))
    assert (unbroken("focus") / "metrics.csv").read_text() == before
    assert "dense search on the same loss" in capsys.readouterr().out


@pytest.mark.slow
def test_of_many_skipped_files_a_few_are_named_and_all_are_listed(tmp_path, capsys):
    generator = np.random.default_rng(0)
    (tmp_path / "photographs").mkdir()
    for k in range(33):
        side = 64 if k < 3 else 8
        pixels = generator.integers(0, 256, (side, side, 3), dtype=np.uint8)
        path = tmp_path / "photographs" / f"{k}.png"
        io.imsave(path, pixels, check_contrast=False)
    folder = tmp_path / "run"
    some = [*TOY["focus"], "train.batches=1", f"data.root={tmp_path / 'photographs'}"]
    main("focus", "--out", folder, "--set", *some)
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("skipped ")]
    assert len(said) == 21 and said[-1] == f"skipped 30 in all, named in {folder / 'skipped.txt'}"
    listed = (folder / "skipped.txt").read_text().splitlines()
    assert len(listed) == 30 and all("8 x 8 pixels, smaller than 24" in line for line in listed)


@pytest.mark.parametrize("name", NAMES)
def test_pictures_are_drawn_again_without_the_run(name, unbroken, tmp_path, monkeypatch, capsys):
    """From the results alone: the same figures to the last byte, and the same tables."""
    folder = tmp_path / "copy"
    folder.mkdir()
    for path in unbroken(name).glob("results.*"):
        (folder / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(train, "fit", None)
    main(name, "--report", "--out", folder)
    assert "| " in capsys.readouterr().out
    drawn = {path.name: path.read_bytes() for path in (folder / "figures").iterdir()}
    assert drawn == {p.name: p.read_bytes() for p in (unbroken(name) / "figures").iterdir()}


def test_tables_of_the_pages_are_those_of_the_results():
    """`python -m experiments.tables` would change nothing."""
    found, used = tables.all_tables(), []
    for page in tables.pages():
        text = page.read_text()
        assert tables.filled(text, found) == text, f"{page.name}: run python -m experiments.tables"
        used += [name for name in found if f"<!-- table: {name} -->" in text]
    assert sorted(used) == sorted(found)
    with pytest.raises(ValueError, match="unknown 'none'"):
        tables.filled("<!-- table: none -->\n<!-- end -->", found)


def test_every_row_of_evidence_is_made_by_a_command():
    """No table of this page is written by hand."""
    text = (_common.ROOT / "docs" / "evidence.md").read_text()
    left = tables._BLOCK.sub("", text)
    assert "<!-- table: benchmark, curves -->" in text
    assert not [line for line in left.splitlines() if line.startswith("|")]


def test_tables_of_a_gpu_stay_empty_until_they_are_measured():
    text = "<!-- table: gpu: benchmark -->\n*not measured*\n<!-- end -->"
    assert tables.filled(text, {}) == text
    assert "| 1 |" in tables.filled(text, {"gpu: benchmark": "| 1 |"})


def test_a_table_can_be_read_as_text():
    text = _common.table(("a", "bc"), [(1, 0.123456), ("long", None)])
    assert text.splitlines() == [
        "| a    | bc     |",
        "|------|--------|",
        "| 1    | 0.1235 |",
        "| long |        |",
    ]


@pytest.mark.slow
def test_interrupt_in_the_last_steps_of_a_job_stops_before_the_next(tmp_path):
    """In the last report of the job; reports are at steps 0, 10 and 20 to 24."""
    stop("restore", tmp_path / "run", TOY["restore"], "start 133.0", 20)
    lines = (tmp_path / "run" / "metrics.csv").read_text().splitlines()[1:]
    assert {line.split(",")[0] for line in lines} == {"start 133.0"}


def test_a_second_run_does_not_overwrite_the_first(unbroken, capsys):
    with pytest.raises(SystemExit) as stopped:
        toy("focus", unbroken("focus"))
    assert stopped.value.code == 2 and "holds a run already" in capsys.readouterr().err


def test_full_disk_is_reported_with_the_remedy(tmp_path, capsys, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device", "checkpoint.npz")

    monkeypatch.setattr(Run, "save", full)
    with pytest.raises(SystemExit) as stopped:
        toy("focus", tmp_path / "run")
    error = capsys.readouterr().err
    assert stopped.value.code == 1 and "No space left on device" in error and "--resume" in error


@pytest.mark.parametrize("name", TOY)
def test_help_lists_the_settings(name, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(name, "--help")
    text = capsys.readouterr().out
    assert stopped.value.code == 0 and "train.optics_rate: a number" in text and "Section 6" in text
