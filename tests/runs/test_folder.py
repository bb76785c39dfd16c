import dataclasses
import os
import signal
import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax.runs.config import ConfigError
from drt_jax.runs.folder import Run, deferred_interrupt


@dataclasses.dataclass(frozen=True)
class Config:
    batches: int = 10


def opened(tmp_path, resume=False, config=Config()):
    return Run(tmp_path / "run", config, ("loss", "sensor_mm"), resume)


def test_metrics_and_checkpoints_round_trip(tmp_path):
    run = opened(tmp_path)
    run.log("a", 0, {"loss": np.array([0.1, 1 / 3]), "sensor_mm": np.array([1.0, 2.0])})
    run.log("b", 0, {"loss": np.array([5.0])})
    read = run.metrics("a")
    assert read["loss"][1] == 1 / 3 and read["step"].tolist() == [0, 1]
    assert np.isnan(run.metrics("b")["sensor_mm"][0])
    tree = {"x": jnp.array([1.0, jnp.pi]), "y": (jnp.ones((2, 2), jnp.float32), jnp.int32(3))}
    run.save("a", 2, tree)
    step, back = run.load("a", tree, ("a",))
    assert step == 2 and back["x"][1] == jnp.pi and back["y"][0].dtype == jnp.float32


def test_metrics_beyond_the_checkpoint_are_dropped(tmp_path):
    run = opened(tmp_path)
    for start in (0, 2):
        run.log("a", start, {"loss": np.ones(2), "sensor_mm": np.ones(2)})
        run.log("b, 5 deg", start, {"loss": np.ones(2), "sensor_mm": np.ones(2)})
    run.save("a", 2, jnp.ones(1))
    with open(run.folder / "metrics.csv", "a") as file:
        file.write("a,4,0.5")  # a line cut off by a kill
    again = opened(tmp_path, resume=True)
    assert again.load("a", jnp.ones(1), ("a",))[0] == 2
    assert again.metrics("a")["step"].tolist() == [0, 1]
    assert again.metrics("b, 5 deg")["step"].tolist() == [0, 1, 2, 3]
    assert again.load("b, 5 deg", jnp.ones(1), ("b, 5 deg",))[0] == 0
    assert again.metrics("b, 5 deg")["step"].tolist() == []


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path, monkeypatch):
    run = opened(tmp_path)
    run.save("a", 1, jnp.ones(3))

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="No space left"):
        run.save("a", 2, jnp.zeros(3))
    monkeypatch.undo()
    assert run.load("a", jnp.zeros(3), ("a",))[0] == 1
    assert not list(run.folder.rglob("*.partial"))


def test_seconds_go_on_after_a_resume(tmp_path):
    run = opened(tmp_path)
    run.log("a", 0, {"loss": np.ones(1)})
    run._opened -= 1000.0  # an hour of work, say
    run.save("a", 1, jnp.ones(1))
    again = opened(tmp_path, resume=True)
    again.load("a", jnp.ones(1), ("a",))
    assert 1000 <= again.seconds < 1100


def test_a_run_that_failed_before_its_first_step_leaves_the_folder_free(tmp_path):
    opened(tmp_path)
    opened(tmp_path, config=Config(11))
    assert opened(tmp_path, resume=True, config=Config(11)).folder == tmp_path / "run"


def test_clear_errors(tmp_path):
    with pytest.raises(ConfigError, match="nothing to resume"):
        opened(tmp_path, resume=True)
    run = opened(tmp_path)
    run.log("a", 0, {"loss": np.ones(1)})
    with pytest.raises(ConfigError, match="holds a run already; add --resume"):
        opened(tmp_path)
    with pytest.raises(ConfigError, match="started with other settings"):
        opened(tmp_path, resume=True, config=Config(11))
    run.save("a", 1, jnp.ones(100))
    path = run.folder / "checkpoints" / "a.npz"
    for content in (b"garbage", path.read_bytes()[:200], b""):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match="not a checkpoint of this run; delete it"):
            run.load("a", jnp.ones(1), ("a",))


def press_ctrl_c():
    """KeyboardInterrupt where the handler raises it; a handler runs between two bytecodes."""
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.05)


def test_first_interrupt_is_deferred_second_is_not():
    with deferred_interrupt() as asked:
        assert not asked()
        press_ctrl_c()
        assert asked()
        with pytest.raises(KeyboardInterrupt):
            press_ctrl_c()
    with pytest.raises(KeyboardInterrupt):
        press_ctrl_c()


IGNORED = """
import signal
from drt_jax.runs.folder import deferred_interrupt

handler = signal.getsignal(signal.SIGTERM)
with deferred_interrupt() as asked:
    signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN and not asked()
    signal.raise_signal(signal.SIGTERM)
    assert asked()
assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
assert signal.getsignal(signal.SIGTERM) == handler
"""


@pytest.mark.parametrize(
    "command",
    [
        [sys.executable, "-c", IGNORED],
        [*f"{sys.executable} -m pytest -n 0 -p no:cacheprovider -k deferred".split(), __file__],
    ],
    ids=["a run", "these tests"],
)
def test_an_ignored_interrupt_stays_ignored(command):
    """As `nohup` starts a program: the run goes on, and the test above neither fails nor waits."""
    started = ["sh", "-c", 'trap "" INT; exec "$@"', "sh", *command]
    done = subprocess.run(started, timeout=100, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
