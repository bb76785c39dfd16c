"""Run time against error of several programs, each swept over its own samplings."""

import itertools
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

import drt_jax
from drt_jax import Lens, Scene

from . import _common, _peers, _work
from ._reference import changed

OURS, NODES = "drt_jax", "our nodes"
# Errors for which the table of `summary` has times.
LEVELS = (1e-2, 1e-3, 1e-6)


class Try(NamedTuple):
    """One sampling of one program.

    size: number of rays per wavelength.
    call: function without arguments that is timed.
    error: relative error of its result.
    """

    program: str
    sampling: str
    size: int
    call: Callable[[], Any]
    error: float


def aimed(lens: Lens, scene: Scene, order: int, values: Array) -> _peers.Rays:
    """The nodes of our rule for a field along y, as rays that we aim through the lens with each row
    of `values`. order: order of the rule."""
    points, weights = (np.asarray(a) for a in drt_jax.pupil.half_disc(order, order + 1))
    trace = jax.vmap(lambda v: drt_jax.trace_rays(changed(lens, v), scene, points))
    rays = jax.jit(trace)(values)
    launch = np.asarray(rays.points[..., 0, :]), np.asarray(rays.directions[..., 0, :])
    return _peers.Rays(points, weights, launch=launch, free=(0, 1))


def samplings(
    lens: Lens, scene: Scene, sizes: Iterable[int], orders: Iterable[int], values: Array
) -> Iterator[tuple[str, Callable]]:
    """(name, rays) of all samplings: each pattern at the paraxial pupil and at the stop, and our
    nodes, with launches that we compute. values: numbers of the variants of the lens."""
    for aim, where in (("paraxial", "paraxial pupil"), ("iterative", "aimed at the stop")):
        for kind, pattern in _peers.PATTERNS.items():
            for size in orders if kind == "Gaussian" else sizes:
                yield f"{kind}, {where}", partial(_peers.rays_of, pattern, size, aim)
    for order in orders:
        yield NODES, partial(aimed, lens, scene, order, values)


def of_spots(
    numbers: _peers.Lens, samplings: Iterable[tuple], what: Callable
) -> Iterator[tuple[str, str, Callable]]:
    """The argument `ways` of `tried` for all programs. samplings: result of `samplings`. what:
    function of a program's `_peers.Spots`, a lens and rays that returns the call."""
    for sampling, rays_of in samplings:
        for program, spots in _peers.SPOTS.items():

            def make() -> tuple[int, Callable]:
                rays = rays_of()
                return len(rays.weights), what(spots, numbers, rays)

            yield program, sampling, make


def tried(ways: Iterable[tuple], error: Callable) -> tuple[list[Try], dict[str, str]]:
    """All tries of other programs; and, by program, the reason why there are none.

    ways: program, sampling, and a function that returns the number of rays and the call.
    error: function that returns the error of the result of a call.
    """
    found: list[Try] = []
    notes: dict[str, str] = {}
    for program, sampling, make in ways:

        def ready() -> tuple[int, Callable, float]:
            size, call = make()
            return size, call, error(call())

        launched = ", launched by us" if sampling == NODES else ""
        ((label, content),) = _work.peer(program, ready, launched).items()
        if isinstance(content, str):
            notes.setdefault(program, content)
        else:
            found.append(Try(label, sampling, *content))
    done = {one.program.split()[0] for one in found}
    return found, {name: why for name, why in notes.items() if name not in done}


def rows_of(
    task: str, ours: list[Try], ways: Iterable[tuple], error: Callable, repeats: int
) -> dict[str, Any]:
    """Curves of a task for results.json, with `quartiles_s` of alternating calls; and the reasons
    why programs have none. ways, error: see `tried`."""
    others, notes = tried(ways, error)
    tries = [*ours, *others]
    seconds = _common.quartiles([one.call for one in tries], repeats)
    rows = [
        {"task": task, "program": one.program, "sampling": one.sampling, "size": one.size}
        | {"error": one.error, "quartiles_s": own, "repeats": repeats}
        for one, own in zip(tries, seconds)
    ]
    return {"curves": rows, "missing": notes}


def least(rows: list[dict[str, Any]], error: float) -> float:
    """Smallest median time, s, of the rows within an error; inf if there are none."""
    known = (row["quartiles_s"][1] for row in rows if row["error"] <= error)
    return min(known, default=np.inf)


def faster(rows: list[dict[str, Any]], own: list[dict[str, Any]]) -> str:
    """The ranges of errors that a program reaches in less time than `drt_jax`, as text."""
    errors = sorted({row["error"] for row in (*rows, *own)}, reverse=True)
    runs = itertools.groupby(errors, lambda error: least(rows, error) < least(own, error))
    won = [[f"{error:.0e}" for error in run] for wins, run in runs if wins]
    return ", ".join(" to ".join(dict.fromkeys((run[0], run[-1]))) for run in won) or "never"


def summary(rows: list[dict[str, Any]]) -> str:
    """Table of the rows of `rows_of`: smallest error, and times to reach some errors, by task and
    program; and the errors at which the program is faster than `drt_jax`."""
    lines = []
    for (task,), some in _common.grouped(rows, "task").items():
        groups = _common.grouped(some, "program")
        for (program,), own in groups.items():
            seconds = (least(own, level) for level in LEVELS)
            times = [_common.duration(s) if np.isfinite(s) else "" for s in seconds]
            best = f"{min(row['error'] for row in own):.0e}"
            versus = "" if program == OURS else faster(own, groups[(OURS,)])
            lines.append((task, program, best, *times, versus))
    levels = (f"to {level:.0e}" for level in LEVELS)
    return _common.table(("work", "program", "least error", *levels, "faster than we at"), lines)
