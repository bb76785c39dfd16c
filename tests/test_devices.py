"""Work that is divided among several devices gives the results of one device. On virtual devices of
the CPU."""

import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import devices
from experiments import _command, restore
from experiments.runs.config import load_config
from experiments.runs.folder import Run

HERE, PIXEL = pathlib.Path(__file__).parent, "brightest pixel"
TOY = [
    *("starts_mm=[133.5]", "table_starts_mm=[133.5]", "table_noise=[0.01]", "test_patches=4"),
    *("scene.tolerance=1e-3", "camera.kernel=5", "data.crops_per_image=6"),
    # 32 channels and patches of 32 pixels: convolutions by Winograd's filtering.
    *("network.layers=1", "network.channels=32"),
    "train={batches: 120, batch: 8, patch: 32, checkpoint_every: 10}",
]


def started(*words, count=1, **own):
    """Starts a process with `count` virtual devices."""
    parts = [str(HERE.parent), os.environ.get("PYTHONPATH", "")]
    own |= {"JAX_NUM_CPU_DEVICES": str(count), "PYTHONPATH": os.pathsep.join(filter(None, parts))}
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [sys.executable, *words], env=os.environ | own, stdout=pipe, stderr=pipe, text=True
    )


def ended(process):
    """The output of a process, which must succeed."""
    out, err = process.communicate(timeout=1200)
    assert process.returncode == 0, err
    return out


def test_one_device_needs_no_mesh():
    def double(x):
        return 2 * x

    assert devices.shared(double, None, 1) is double
    tree = {"a": jnp.ones(3), "b": 1}
    assert devices.split(None, tree) is devices.copied(None, tree) is tree
    assert type(devices.gathered(tree)["a"]) is np.ndarray


def test_a_mesh_of_one_shares_all():
    mesh = devices.device_mesh(1)
    call = jax.jit(devices.shared(lambda w, x: w * x, mesh, 1))
    rows = devices.split(mesh, np.arange(4.0))
    assert np.array_equal(call(devices.copied(mesh, np.float64(3)), rows), 3 * np.arange(4.0))
    slope = jax.grad(lambda w: jnp.sum(call(w, rows)))(jnp.asarray(2.0))
    assert float(slope) == 6


@pytest.mark.parametrize(
    "count, message", [(0, "cannot be shared by 1"), (7, "set JAX_NUM_CPU_DEVICES=7")]
)
def test_devices_that_are_not_there(count, message):
    with pytest.raises(ValueError, match=f"devices: {count}.*{message}"):
        devices.device_mesh(count)


@pytest.mark.parametrize(
    "words, message",
    [
        (["--set", "devices=3"], "devices: 3 cannot share train.batch of 8 evenly"),
        (["--set", "devices=0"], "devices: expected 1 or more, got 0"),
        (["--set", "devices=4"], "devices: 4 of kind cpu are asked, 1 is here"),
        (["--processes", "here,2,0"], "--processes: expected host:port,count,number or auto"),
        (["--processes", "here:1,2,2"], "--processes: expected host:port,count,number or auto"),
    ],
)
def test_what_cannot_be_shared_is_refused_in_a_line(words, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        _command.main(restore, ["--out", str(tmp_path / "run"), "--set", *TOY, *words])
    assert stop.value.code == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert message in line


@pytest.mark.release
def test_eight_devices_compute_what_one_does():
    """Monte Carlo, searches, kernels and rays in float64; losses and weights in float32."""
    found = json.loads(ended(started(str(HERE / "sharing.py"), count=8)).splitlines()[-1])
    # Of weights, after some steps.
    assert found.pop("training") < 1e-4 and found.pop("joint_training") < 1e-4
    assert found.pop("starts") < 1e-9
    assert set(found) == {"monte_carlo", "kernels", "rays"} and max(found.values()) < 1e-13


@pytest.mark.slow
def test_without_what_suits_cpus_and_in_float32_the_numbers_are_the_same():
    """As on another kind of device: spots, slopes, rays, a kernel, as-built lenses, training."""
    double, single = (
        json.loads(ended(started(str(HERE / "plainly.py"), JAX_ENABLE_X64=x)).splitlines()[-1])
        for x in "10"
    )
    assert double.keys() == single.keys()
    assert abs(single.pop(PIXEL) / double.pop(PIXEL) - 1) < 0.05  # to the tolerance of the model
    for name, value in double.items():
        assert abs(single[name] - value) <= 1e-3 * abs(value), name


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@pytest.mark.slow
def test_a_run_of_two_processes_whose_one_is_killed_goes_on_with_one(tmp_path):
    """The loss curve is that of one device, before the kill and after it."""
    alone, both = tmp_path / "alone", tmp_path / "both"
    words = ["-m", "experiments.restore", "--out"]
    ended(started(*words, str(alone), "--set", *TOY))
    port, more = free_port(), [*TOY, "devices=8"]
    pair = [
        started(
            *words, str(both), "--processes", f"127.0.0.1:{port},2,{k}", "--set", *more, count=4
        )
        for k in range(2)
    ]
    until = time.monotonic() + 600
    while not any((both / "checkpoints").glob("*.npz")):
        assert time.monotonic() < until and all(p.poll() is None for p in pair)
        time.sleep(0.02)
    pair[1].kill()
    _, err = pair[0].communicate(timeout=300)
    # If the network does not tell, JAX's service aborts what waits, without a word of ours.
    told = pair[0].returncode == 1 and "--resume" in err.splitlines()[-1]
    assert told or pair[0].returncode == -signal.SIGABRT, err
    assert not (both / "results.json").exists()
    pair[1].communicate(timeout=30)
    assert pair[1].returncode == -signal.SIGKILL
    ended(started(*words, str(both), "--resume", "--set", "devices=1"))
    curves = []
    for folder in (alone, both):
        config = load_config(restore.Config, folder / "config.yaml")
        with Run(folder, config, restore.COLUMNS, True) as run:
            curves.append(run.metrics("start 133.5")["loss"])
    assert len(curves[0]) == 120 and np.max(np.abs(curves[1] / curves[0] - 1)) < 1e-3
