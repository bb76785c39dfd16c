"""`python -m drt_jax check`: runs the scenes and describes the machine."""

import argparse
import concurrent.futures
import dataclasses
import importlib.metadata
import json
import os
import pathlib
import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import numpy as np

from ..inputs import require
from . import scenes
from .truth import TRUTHS

_PROGRAMS = ("jax", "jaxlib", "numpy", "scipy", "optimistix")
_AT_ONCE = 2  # scenes: XLA compiles a program on one core


@dataclasses.dataclass(frozen=True)
class Row:
    """Result of a scene.

    name: of the scene.
    error: largest error, in the unit of its truth; None if there is none.
    first: seconds of the first call, with compilation, while another scene may be compiled.
    again: ms of a further call, the fastest of three.
    message: what went wrong; "" for nothing.
    """

    name: str
    error: float | None = None
    first: float | None = None
    again: float | None = None
    message: str = ""

    @property
    def right(self) -> bool:
        """True if all errors are within the allowed error."""
        return self.error is not None and self.error <= TRUTHS[self.name].allowed


def rows(names: Iterable[str]) -> Iterator[Row]:
    """The rows of scenes, in order; two scenes are compiled at the same time. Further calls are
    timed when nothing else is compiled, so rows come at the end."""
    with concurrent.futures.ThreadPoolExecutor(_AT_ONCE) as pool:
        try:
            found = [*pool.map(_first, names)]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    for row, call in found:
        yield dataclasses.replace(row, again=_again(call)) if call else row


def _first(name: str) -> tuple[Row, scenes.Call | None]:
    """The row of a scene without further calls, and the call; None for a scene that failed."""
    began = time.perf_counter()
    try:
        call = getattr(scenes, name)()
        found = np.asarray(call(), float)
        wanted = np.array(TRUTHS[name].values)
        require(found.shape == wanted.shape, f"{found.shape} numbers instead of {wanted.shape}")
    except Exception as error:  # whatever it is belongs into the report
        return Row(name, message=f"{type(error).__name__}: {error}"), None
    apart, first = float(np.max(np.abs(found - wanted))), time.perf_counter() - began
    return Row(name, apart, first), call


def _again(call: scenes.Call) -> float:
    """The fastest of three calls, ms."""
    times = []
    for _ in range(3):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(1e3 * (time.perf_counter() - began))
    return min(times)


def kept_programs() -> int | None:
    """How many compiled programs are kept on disk; None if none are kept."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    return len([*pathlib.Path(folder).glob("*-cache")]) if folder else None


def machine() -> dict[str, str]:
    """Versions, devices and settings that a report must name."""
    about = {"drt_jax": _own_version(), "Python": platform.python_version()}
    about |= {name: _version(name) for name in _PROGRAMS}
    cores = os.cpu_count()
    about["system"] = f"{platform.system()} {platform.machine()}, {cores} cores"
    about["devices"] = ", ".join(f"{d.platform} {d.device_kind}" for d in jax.devices())
    if jax.default_backend() == "cpu" and pathlib.Path("/dev/nvidia0").exists():
        about["devices"] += "; a GPU of NVIDIA is here, unused: pip install 'jax[cuda12]'"
    given = os.environ.get("JAX_ENABLE_X64")
    own = "not set: other programs begin in float32" if given is None else given
    about["float64"] = f"{'on' if jax.config.values['jax_enable_x64'] else 'off'}, by this command"
    about["float64"] += f"; JAX_ENABLE_X64 {own}"
    about["flags"] = os.environ.get("XLA_FLAGS", "") or "no XLA_FLAGS"
    kept, folder = kept_programs(), jax.config.values["jax_compilation_cache_dir"]
    about["programs"] = "not kept" if kept is None else f"{kept} kept in {folder}"
    return about


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _own_version() -> str:
    """The version of this package, and the commit of a checkout."""
    top, said = pathlib.Path(__file__).resolve().parents[2], _version("drt_jax")
    if not (top / ".git").exists():
        return said
    words = ["git", "-C", str(top), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        ran = subprocess.run(words, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return f"{said}, a checkout"
    return f"{said}, commit {ran.stdout.strip()}"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command line."""
    parser.add_argument("scenes", nargs="*", help=f"some of {', '.join(TRUTHS)}; default: all")
    parser.add_argument("--json", type=pathlib.Path, help="a file for all of it, for a bug report")


def output(options: argparse.Namespace, say: Callable[[str], None]) -> Iterator[str]:
    """The scenes compared with their truth, as lines of a table; SystemExit with 1 if one is wrong.
    say: called with the name of each step."""
    names = options.scenes or [*TRUTHS]
    if unknown := [name for name in names if name not in TRUTHS]:
        raise ValueError(f"scenes: no {unknown[0]!r}; known: {', '.join(TRUTHS)}")
    began, about, kept = time.perf_counter(), machine(), kept_programs()
    yield from (*(f"{name:<11} {value}" for name, value in about.items()), "")
    say("compiling and comparing: up to a minute and a half if nothing is kept")
    found = [*rows(names)]
    head = f"{'scene':<9}{'compared':<49}{'error':>8} {'allowed':<19}"
    yield f"{head}{'first s':>7}{'again ms':>10}{'usual':>7}"
    for row in found:
        truth = TRUTHS[row.name]
        line = f"{row.name:<9}{truth.about:<49}"
        if row.error is None:
            yield from (f"{line}  FAILED", f"  ! {row.message}")
            continue
        allowed = f"{truth.allowed:.1e} {truth.unit}"
        times = f"{row.first:>7.1f}{row.again:>10.2g}{truth.usual:>7g}"
        yield f"{line}{row.error:>8.1e} {allowed:<19}{times}  {'ok' if row.right else 'WRONG'}"
        if not row.right:
            yield f"  ! expected: {truth.source}; allowed: {truth.why}"
    seconds, right = time.perf_counter() - began, sum(row.right for row in found)
    new = "" if kept is None else f", {(kept_programs() or 0) - kept} programs compiled and kept"
    yield from ("", f"{right} of {len(found)} scenes are right, in {seconds:.0f} s{new}")
    if options.json:
        text = json.dumps(report(found, about, seconds), indent=2)
        options.json.write_text(text + "\n", encoding="utf-8")
    if right < len(found):
        raise SystemExit(1)


def report(found: list[Row], about: dict[str, str], seconds: float) -> dict[str, Any]:
    """The whole result of a run, for JSON."""
    every = []
    for row in found:
        truth = TRUTHS[row.name]._asdict()
        del truth["values"]
        every.append(dataclasses.asdict(row) | truth | {"right": row.right})
    right = all(row.right for row in found)
    return {"right": right, "seconds": round(seconds, 1), "machine": about, "scenes": every}
