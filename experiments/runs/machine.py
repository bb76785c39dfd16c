"""A record of the machine of a run, on which its times depend."""

import contextlib
import os
import pathlib
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import jax

_ROOT = pathlib.Path(__file__).resolve().parents[2]
_PACKAGES = "drt_jax", "jax", "jaxlib", "numpy", "scipy"
_PEERS = "optiland", "batoid", "prysm", "rayoptics", "torch"


def machine() -> dict[str, Any]:
    """The machine, versions and commit of this process.

    cpu: model. cores: number of cores that this process may use.
    device, devices: kind and number of JAX's devices.
    load: mean number of running processes in the last minute.
    python, versions: of Python, and of packages.
    commit: of the checkout, with + if a file differs from it; None outside of a checkout.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = {}
    for name in (*_PACKAGES, *_PEERS):
        with contextlib.suppress(PackageNotFoundError):
            versions[name] = version(name)
    return {
        "cpu": _cpu(),
        "cores": cores,
        "device": jax.local_devices()[0].device_kind,
        "devices": jax.device_count(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "versions": versions,
        "commit": _commit(),
    }


def hardware(record: dict[str, Any]) -> str:
    """The processor, cores and device of a record of `machine`, as text."""
    return f"{record['cpu']}, {record['cores']} cores, {record['device']}"


def _cpu() -> str:
    with contextlib.suppress(OSError):
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        if names:
            return names[0]
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    if not (_ROOT / ".git").exists():
        return None
    words = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        done = subprocess.run(words, cwd=_ROOT, capture_output=True, text=True, check=True)
        return done.stdout.strip()
    return None
