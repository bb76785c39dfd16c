"""The folder of a run: what is written is read back, and a run continues from its checkpoint."""

import dataclasses
import json
import math
import os

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.runs.config import ConfigError
from experiments.runs.folder import Run


@dataclasses.dataclass(frozen=True)
class Config:
    batches: int = 10


def opened(tmp_path, resume=False, config=Config()):
    return Run(tmp_path / "run", config, ("loss", "sensor_mm"), resume)


def rows(count):
    return {"loss": np.arange(float(count)), "sensor_mm": np.ones(count)}


def test_metrics_and_checkpoints_round_trip(tmp_path):
    with opened(tmp_path) as run:
        assert (run.folder / "metrics.csv").read_bytes() == b"job,step,loss,sensor_mm,check\r\n"
        run.log("a", 0, {"loss": np.array([0.1, 1 / 3]), "sensor_mm": np.array([1.0, 2.0])})
        run.log("b", 0, {"loss": np.array([5.0])})
        read = run.metrics("a")
        assert read["loss"][1] == 1 / 3 and read["step"].tolist() == [0, 1]
        assert np.isnan(run.metrics("b")["sensor_mm"][0])
        tree = {"x": jnp.array([1.0, jnp.pi]), "y": (jnp.ones((2, 2), jnp.float32), jnp.int32(3))}
        run.save("a", 2, tree)
        step, back = run.load("a", tree, ("a",), 10)
        assert step == 2 and back["x"][1] == jnp.pi and back["y"][0].dtype == jnp.float32


def test_metrics_beyond_the_checkpoint_are_dropped(tmp_path):
    with opened(tmp_path) as run:
        for start in (0, 2):
            run.log("a", start, rows(2))
            run.log("b, 5 deg", start, rows(2))
        run.save("a", 2, jnp.ones(1))
    with open(run.folder / "metrics.csv", "a") as file:
        file.write("a,4,0.5,13")  # an incomplete line, after a kill
    with opened(tmp_path, resume=True) as again:
        assert again.load("a", jnp.ones(1), ("a",), 10)[0] == 2
        assert again.metrics("a")["step"].tolist() == [0, 1]
        assert again.metrics("b, 5 deg")["step"].tolist() == [0, 1, 2, 3]
        assert again.load("b, 5 deg", jnp.ones(1), ("b, 5 deg",), 10)[0] == 0
        assert again.metrics("b, 5 deg")["step"].tolist() == []


def test_the_metrics_of_a_finished_run_do_not_tell_where_it_was_stopped(tmp_path):
    """Jobs that are trained together are logged alternately, with any number of steps at a time."""
    kept = {name: np.arange(6.0) / 7 for name in ("loss", "sensor_mm")}
    files = []
    for ends in ((6,), (1, 4, 6)):
        with opened(tmp_path / str(len(ends))) as run:
            for start, end in zip((0, *ends), ends, strict=False):
                for job in ("b", "a"):
                    run.log(job, start, {name: column[start:end] for name, column in kept.items()})
            run.finish({})
        files.append((run.folder / "metrics.csv").read_bytes())
    assert files[0] == files[1] and files[0].count(b"\n") == 13


def test_seconds_are_counted_once(tmp_path, monkeypatch):
    """A job that the same process has written adds no time; one of an earlier process does."""
    clock = iter(range(0, 1000, 10))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(clock)))
    with opened(tmp_path) as run:
        for job in "abc":
            run.keep(job, 1)
            assert run.kept(job) == 1
        assert run.seconds == 40
    with opened(tmp_path, resume=True) as again:
        assert again.kept("c") == 1
        assert again.seconds == 30 + 10


def test_what_a_job_found_is_kept_with_its_metrics(tmp_path):
    """Also for a job whose name is not valid as the name of a file; the metrics of an interrupted
    job are dropped."""
    found = {"rows": [1, "x", None], "bad": float("inf")}
    with opened(tmp_path) as run:
        assert run.kept("../lens.yaml") is None
        run.log("../lens.yaml", 0, rows(3))
        run.keep("../lens.yaml", found)
        run.log("b", 0, rows(3))
    assert [path.name for path in run.folder.rglob("*.npz")] == ["..%2Flens.yaml.npz"]
    with opened(tmp_path, resume=True) as run:
        assert run.kept("../lens.yaml") == found and run.kept("b") is None
        assert len(run.metrics("../lens.yaml")["step"]) == 3 and not len(run.metrics("b")["step"])


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    with opened(tmp_path) as run:
        run.log("a", 0, rows(2))
        run.save("a", 1, jnp.ones(3))
        for module, name in ((np, "savez"), (os, "fsync"), (os, "replace")):
            monkeypatch.setattr(module, name, full)
            with pytest.raises(OSError, match="No space left"):
                run.save("a", 2, jnp.zeros(3))
            monkeypatch.undo()
        assert run.load("a", jnp.zeros(3), ("a",), 10)[0] == 1
    assert not list(run.folder.rglob("*.partial"))


def test_seconds_go_on_after_a_resume(tmp_path):
    with opened(tmp_path) as run:
        run.log("a", 0, rows(1))
        run._opened -= 1000.0  # an hour of work, say
        run.save("a", 1, jnp.ones(1))
    with opened(tmp_path, resume=True) as again:
        again.load("a", jnp.ones(1), ("a",), 10)
        assert 1000 <= again.seconds < 1100


def test_results_name_every_machine_that_worked_on_them(tmp_path):
    with opened(tmp_path) as run:
        run._machines[0]["cpu"] = "another"
        run.keep("a", 1)
    with opened(tmp_path, resume=True) as again:
        assert again.once("a", lambda: 2) == 1
        again.finish({})
    found = json.loads((again.folder / "results.json").read_text())["machines"]
    assert len(found) == 2 and found[0]["cpu"] != found[1]["cpu"] == "another"
    assert all(record["cores"] > 0 and "jax" in record["versions"] for record in found)


def test_a_run_that_failed_before_its_first_step_leaves_the_folder_free(tmp_path):
    opened(tmp_path).close()
    opened(tmp_path, config=Config(11)).close()
    with opened(tmp_path, resume=True, config=Config(11)) as run:
        assert run.folder == tmp_path / "run"


def test_clear_errors(tmp_path):
    with pytest.raises(ConfigError, match="nothing to resume"):
        opened(tmp_path, resume=True)
    assert not (tmp_path / "run").exists()
    with opened(tmp_path) as run:
        run.log("a", 0, rows(1))
    with pytest.raises(ConfigError, match="holds a run already; add --resume"):
        opened(tmp_path)
    with pytest.raises(ConfigError, match="started with other settings"):
        opened(tmp_path, resume=True, config=Config(11))


def test_results_are_json_always(tmp_path):
    """Numbers that are not finite become null, and are listed."""
    found = {
        "good": 1.5,
        "none": None,
        "best": math.nan,
        "rows": [{"mae": 0.1, "psnr": np.float64(np.inf)}, {"mae": -math.inf}],
        "curve": np.array([1.0, np.nan]),
        "steps": np.arange(3),
    }
    with opened(tmp_path) as run:
        run.finish(found)
    text = (run.folder / "results.json").read_text()
    assert "NaN" not in text and "Infinity" not in text
    results = json.loads(text)
    assert results.pop("machines") and results == {
        "good": 1.5,
        "none": None,
        "best": None,
        "rows": [{"mae": 0.1, "psnr": None}, {"mae": None}],
        "not_finite": ["curve", "best", "rows[0].psnr", "rows[1].mae"],
    }
    with np.load(run.folder / "results.npz") as arrays:
        assert set(arrays.files) == {"curve", "steps"}
    with pytest.raises(ConfigError, match="holds a run already"):
        opened(tmp_path)
