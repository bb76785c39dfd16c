"""A run folder that is damaged, or in which another process works: an error of one line that names
the file and the remedy, or a repair if nothing is lost."""

import dataclasses
import json
import pathlib
import re
import resource
import subprocess
import sys
import threading
import zlib

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.runs.config import ConfigError
from experiments.runs.disk import packed, replace, unpacked
from experiments.runs.folder import Run

HEADER = b"job,step,loss,check\r\n"


@dataclasses.dataclass(frozen=True)
class Config:
    seed: int = 0


def opened(folder, resume=False, config=Config()):
    return Run(folder, config, ("loss",), resume)


def state():
    return {"x": jnp.array([1.0, 2.0]), "count": jnp.int32(7)}


def load(run, job="a"):
    return run.load(job, state(), (job,), 10)


@pytest.fixture
def folder(tmp_path):
    """Two jobs, stopped at step 4 of 10, after six and four steps were logged."""
    with opened(tmp_path / "run") as run:
        for job, steps in (("a", 6), ("b", 4)):
            run.log(job, 0, {"loss": np.arange(float(steps))})
            run.save(job, 4, state())
    return run.folder


def refused(call, *words):
    """The error of a call, which must have one line."""
    with pytest.raises(ConfigError) as found:
        call()
    line = str(found.value)
    assert all(word in line for word in words), line
    assert "\n" not in line and len(line) <= 300
    return line


def resumed(folder, job="a"):
    with opened(folder, resume=True) as run:
        return load(run, job)


@pytest.mark.parametrize("content", [b"", HEADER[:3], HEADER[:-1], HEADER, None], ids=repr)
def test_metrics_without_rows_are_said_and_the_job_can_begin_anew(folder, content):
    """The file is as after a kill, or on a full disk, before the header was written."""
    path = folder / "metrics.csv"
    path.unlink() if content is None else path.write_bytes(content)
    words = "metrics.csv: not one row of a for each of the 4 steps", "delete checkpoints/a.npz"
    refused(lambda: resumed(folder), *words)
    assert path.read_bytes() == HEADER
    (folder / "checkpoints" / "a.npz").unlink()
    with opened(folder, resume=True) as run:
        assert load(run)[0] == 0
        run.log("a", 0, {"loss": np.ones(2)})
        assert run.metrics("a")["loss"].tolist() == [1, 1]


def test_metrics_without_rows_or_checkpoints_are_no_loss(tmp_path):
    opened(tmp_path / "run").close()
    path = tmp_path / "run" / "metrics.csv"
    for content in (b"", b"job,st"):
        path.write_bytes(content)
        assert resumed(path.parent)[0] == 0 and path.read_bytes() == HEADER
        path.write_bytes(content)
        opened(path.parent).close()
        assert path.read_bytes() == HEADER


@pytest.mark.parametrize(
    "old, new, words",
    [
        (b"a,1,1.0", b"a,x9,1.0", "line 3: invalid literal for int() with base 10: 'x9'"),
        (b"a,1,1.0", b"a,1,1.o", "line 3: could not convert string to float: '1.o'"),
        (b"a,1,1.0", b"a,1", "line 3: expected 4 values, got 3"),
        (b"a,1,1.0", b"a,1,1.0,", "line 3: expected 4 values, got 5"),
        (b"a,1,1.0", b"a,1,1.5", "line 3: its checksum is another"),
        (b"a,1,1.0", b"a,1,\xff\xfe", "line 3: could not convert string to float"),
        (b"a,1,1.0", b"a," + 5000 * b"1" + b",1.0", "line 3: "),
        (b"a,1,1.0", b'"a,1,1.0', "line 11: expected 4 values"),
        (b"job,step,loss", b"job,loss,step", "line 1: expected the header job,step,loss"),
        (HEADER, b"", "line 1: expected the header"),
        (HEADER, b"\x00\x80", "line 1: "),
        (b"a,1,1.0", b"\xff,1,1.0", "line 3: its checksum is another"),
    ],
    ids=range(12),
)
def test_damaged_metrics_are_named_with_their_line(folder, old, new, words):
    path = folder / "metrics.csv"
    content = path.read_bytes().replace(old, new, 1)
    path.write_bytes(content)
    refused(lambda: resumed(folder), f"{path}, {words}", "mend it, or delete the file and ")
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    "old, new",
    [("a,2,2.0", None), ("a,2,2.0", "a,1,1.0"), ("a,0,0.0", "b,0,0.0"), ("a,3,3.0", "a,-3,3.0")],
    ids=["missing", "doubled", "of another job", "negative"],
)
def test_rows_missing_before_the_checkpoint_are_said(folder, old, new):
    path = folder / "metrics.csv"
    lines = path.read_text().splitlines()
    own = [] if new is None else [f"{new},{zlib.crc32(new.encode()):08x}"]
    k = next(k for k, line in enumerate(lines) if line.startswith(old))
    content = "".join(f"{line}\r\n" for line in lines[:k] + own + lines[k + 1 :]).encode()
    path.write_bytes(content)
    words = "not one row of a for each of the 4 steps before its checkpoint", "put them back, or"
    refused(lambda: resumed(folder), *words)
    assert path.read_bytes() == content


def test_rows_come_whole_or_not_at_all(folder):
    """The disk becomes full while rows are written."""
    path = folder / "metrics.csv"
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with opened(folder, resume=True) as run:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 20, limits[1]))
        try:
            with pytest.raises(OSError):
                run.log("b", 4, {"loss": np.ones(6)})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert path.read_bytes() == before
        run.log("b", 4, {"loss": np.ones(6)})
        assert run.metrics("b")["step"].tolist() == list(range(10))


def rewritten(path, leaves=None, **changes):
    """The checkpoint with some parts changed, and with a correct checksum."""
    about, own = unpacked(path.read_bytes())
    path.write_bytes(packed(about | changes, own if leaves is None else leaves))


def leaves(x, count=7):
    return [np.array(count, np.int32), np.array(x)]  # in the order of the names


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"leaves": leaves([1.0])}, "holds arrays of other shapes or dtypes"),
        ({"leaves": leaves([1.0, 2.0])[:1]}, "holds arrays of other shapes"),
        ({"leaves": leaves(np.float32([1, 2]))}, "holds arrays of other shapes or dtypes"),
        ({"leaves": leaves([1.0, np.nan])}, "holds numbers that are not finite"),
        ({"leaves": leaves([1.0, -np.inf])}, "holds numbers that are not finite"),
        ({"leaves": leaves(["x", "y"])}, "holds arrays of other shapes or dtypes"),
        ({"job": "b"}, "belongs to the job 'b'"),
        ({"step": 500}, "is of step 500, not of one from 0 to 10"),
        ({"step": -3}, "is of step -3, not of one"),
        ({"settings": "0"}, "belongs to other settings than those in config.yaml"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_checkpoint_of_something_else_is_refused(folder, changes, words):
    path = folder / "checkpoints" / "a.npz"
    rewritten(path, **changes)
    refused(lambda: resumed(folder), f"{path}: {words}", "delete it to begin this job anew")
    path.unlink()
    assert resumed(folder)[0] == 0
    assert resumed(folder, "b")[0] == 4


def test_a_checkpoint_of_another_job_or_other_settings_is_refused(folder):
    """A file is copied over it; config.yaml is edited."""
    path = folder / "checkpoints" / "a.npz"
    whole = path.read_bytes()
    path.write_bytes((folder / "checkpoints" / "b.npz").read_bytes())
    refused(lambda: resumed(folder), "a.npz: belongs to the job 'b'")
    path.write_bytes(whole)
    assert resumed(folder)[0] == 4
    (folder / "config.yaml").write_text("seed: 1\n")
    with opened(folder, resume=True, config=Config(1)) as run:
        refused(lambda: load(run), "a.npz: belongs to other settings than those in config.yaml")


def test_a_damaged_checkpoint_is_refused(folder):
    path = folder / "checkpoints" / "a.npz"
    whole = path.read_bytes()
    foreign = folder / "foreign.npz"
    np.savez(foreign, x=np.ones(3))
    with np.load(path) as saved:
        changed = {**saved, "leaf1": saved["leaf1"] + 1}
    np.savez(folder / "changed.npz", **changed)
    for content in (b"", b"garbage", whole[:200], whole[: len(whole) // 2], foreign.read_bytes()):
        path.write_bytes(content)
        refused(lambda: resumed(folder), f"{path}: is no checkpoint", "delete it to begin")
        assert path.read_bytes() == content
    path.write_bytes((folder / "changed.npz").read_bytes())
    refused(lambda: resumed(folder), f"{path}: is damaged: its checksum is another", "delete it")
    path.write_bytes(whole)
    assert resumed(folder)[0] == 4


def test_no_flipped_bit_of_a_checkpoint_passes(folder):
    """The checkpoint is refused or, if the byte has no meaning, gives the same numbers."""
    whole = (folder / "checkpoints" / "a.npz").read_bytes()
    wanted, passed = unpacked(whole), 0
    for k in range(0, len(whole), 5):
        content = bytearray(whole)
        content[k] ^= 1 << k % 8
        try:
            found = unpacked(bytes(content))
        except ValueError:
            continue
        passed += 1
        assert [a.tobytes() for a in found[1]] == [a.tobytes() for a in wanted[1]]
        assert found[0] == wanted[0]
    assert passed < len(whole) / 5 / 4


def test_a_state_that_is_not_finite_is_not_saved(folder):
    with opened(folder, resume=True) as run:
        bad = state() | {"x": jnp.array([1.0, jnp.nan])}
        refused(lambda: run.save("a", 6, bad), "a: numbers that are not finite after 6 steps")
        assert load(run)[0] == 4


HOLDER = """
import dataclasses, pathlib, sys, time
from experiments.runs.folder import Run
Config = dataclasses.make_dataclass("Config", [("seed", int, 0)], frozen=True)
run = Run(pathlib.Path(sys.argv[1]), Config(), ("loss",), True)
print("open", flush=True)
time.sleep(60)
"""


def test_one_process_at_a_time_works_in_a_folder(folder):
    """The lock of a process that was killed is removed."""
    command = [sys.executable, "-c", HOLDER, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "open\n"
        said = f"another process (pid {other.pid}) works in this folder; wait for it, or choose"
        for resume in (True, False):
            refused(lambda: opened(folder, resume=resume), f"{folder}: {said} another --out")
        other.kill()
    assert resumed(folder)[0] == 4
    with opened(folder, resume=True) as run:
        refused(lambda: opened(folder, resume=True), "works in this folder")
        run.close()
        assert resumed(folder)[0] == 4


def test_a_refused_folder_is_given_back(folder):
    refused(lambda: opened(folder), "holds a run already")
    assert resumed(folder)[0] == 4


def test_what_a_kill_left_half_written_is_removed(folder):
    for part in (folder, folder / "checkpoints"):
        (part / "0123456789abcdef.drt_jax.partial").write_bytes(b"half")
        (part / "mine.partial").write_bytes(b"of somebody else")
    assert resumed(folder)[0] == 4
    assert {path.name for path in folder.rglob("*.partial")} == {"mine.partial"}


def test_two_writes_of_one_file_do_not_meet(tmp_path):
    path = tmp_path / "file"
    contents = [bytes([k]) * 100_000 for k in range(4)]
    failures = []

    def write(content):
        try:
            for _ in range(10):
                replace(path, content)
        except OSError as error:
            failures.append(error)

    threads = [threading.Thread(target=write, args=(content,)) for content in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures and path.read_bytes() in contents
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_checkpoint_reads_as_any_archive_of_numpy(folder):
    with np.load(folder / "checkpoints" / "a.npz") as saved:
        about = json.loads(str(saved["about"]))
        assert about["job"] == "a" and about["step"] == 4 and about["seconds"] > 0
        assert saved["leaf1"].tolist() == [1, 2] and re.fullmatch("[0-9a-f]{64}", about["settings"])
    assert pathlib.Path(folder / "config.yaml").is_file()
