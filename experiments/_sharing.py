"""Devices that share a run, in one process or in several."""

import contextlib
import os
import pathlib
import shutil
import tempfile
import threading
from collections.abc import Iterator
from typing import Any

import jax
from jax.experimental.multihost_utils import sync_global_devices
from jax.sharding import Mesh

from drt_jax.devices import device_mesh

from ._common import require
from .runs.config import ConfigError

# Seconds that a process waits for the others at the start; and later, for a sign of life.
_PATIENCE, _SILENCE = 60, 30
HELP = (
    "one of several processes that share the run, by the address of the first, their count and the "
    "number of this one, from 0, such as 10.0.0.1:9876,2,0; auto under SLURM or Open MPI"
)


def require_shared(devices: int, name: str, count: int) -> None:
    """ConfigError unless devices can share a count of that name."""
    require(devices > 0, f"devices: expected 1 or more, got {devices}")
    remedy = f"devices: {devices} cannot share {name} of {count} evenly: give a divisor of it"
    require(count % devices == 0, remedy)


def mesh_of(devices: int) -> Mesh | None:
    """The devices that share a run; None for one alone."""
    return None if devices == jax.process_count() == 1 else device_mesh(devices)


def join(text: str) -> None:
    """Joins the other processes of a run. ConfigError for an option of another form, and if they do
    not come."""
    given: dict[str, Any] = {}
    if text != "auto":
        address, *rest = text.split(",")
        numbers = [int(part) if part.isdecimal() else -1 for part in rest]
        right = len(numbers) == 2 and 0 <= numbers[1] < numbers[0] and ":" in address
        require(right, f"--processes: expected host:port,count,number or auto, got {text!r}")
        given = {"num_processes": numbers[0], "process_id": numbers[1]}
        given["coordinator_address"] = address
    remedy = f"start all processes within {_PATIENCE} s, with one address"
    late = f"error: --processes {text}: the others did not come: {remedy}"
    # JAX would abort with a trace of its stack.
    watch = threading.Timer(_PATIENCE, leave, (late, 2))
    watch.daemon = True
    watch.start()
    try:
        jax.distributed.initialize(
            **given, initialization_timeout=2 * _PATIENCE, heartbeat_timeout_seconds=_SILENCE
        )
    except (ValueError, RuntimeError) as error:
        what = " ".join(str(error).split())[:200]
        raise ConfigError(f"--processes {text}: {what}") from error
    finally:
        watch.cancel()


def leave(message: str, code: int) -> None:
    """Ends this process with a message, and does not wait for the others of the run."""
    os.write(2, f"\n{message}\n".encode())
    os._exit(code)


@contextlib.contextmanager
def own_folder(folder: pathlib.Path, resume: bool) -> Iterator[pathlib.Path]:
    """The folder that this process works in: for the first process the folder of the run; for any
    other a temporary copy, and its output is suppressed."""
    several, first = jax.process_count() > 1, jax.process_index() == 0
    with contextlib.ExitStack() as stack:
        own = folder
        if not first:
            own = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory())) / folder.name
            if resume:
                require(folder.is_dir(), f"{folder}: every process needs the run to resume")
                shutil.copytree(folder, own)
        if several:  # nobody writes before all have read
            sync_global_devices(str(folder.name))
        if not first:
            nothing = stack.enter_context(open(os.devnull, "w"))
            stack.enter_context(contextlib.redirect_stdout(nothing))
            stack.enter_context(contextlib.redirect_stderr(nothing))
        yield own
