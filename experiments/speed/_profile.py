"""A performance profile (Dolan and More, Math. Program. 91, 2002): the share of many scenes that
each program solves, over the ratio of its time to that of the fastest program.

A scene is a lens with its clear apertures and an object point in one wavelength. It is solved to a
tolerance if the error of the RMS spot radius sigma is within the tolerance. Each program is swept
over its own samplings, from few rays to many, until an error is below `_ENOUGH`, a call takes more
than `_LONGEST`, or more rays do not help.
"""

import dataclasses
import itertools
import math
import pathlib
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
from jax import Array

import drt_jax
from drt_jax import Gauss, Lens, Scene
from drt_jax.lens.order import may_cross
from drt_jax.pupil.clipped import Clipped

from . import _common, _peers
from ._common import Numbers, not_empty, within
from ._reference import reference, relative_error, sigmas

TOLERANCES = (1e-3, 1e-6, 1e-9)
# Ends of a sweep: an error, and seconds of a call. More rays help if they divide the error by
# _HELP.
_ENOUGH, _LONGEST, _HELP = 1e-9, 1.0, 1.5
# Orders and sizes of our rule for a clipped pupil; orders of one size share a compiled program and
# have the same time.
_CLIPPED = (6, 14), (10, 14), (14, 14), (28, 28)
# Other patterns are left out: random points need a million rays for 1e-3.
_PATTERNS = ("hexapolar", "Gaussian")
_GREEN = 0.5875618  # um
Made = Iterator[tuple[Callable, float]]
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class LensFields:
    """A lens and its widest field.

    lens: bundled name or YAML path.
    field_deg: widest field.
    """

    lens: str
    field_deg: Annotated[float, within(1e-6, 89.9)]


@dataclasses.dataclass(frozen=True)
class Profile:
    """Settings of the profile.

    lenses: bundled lenses, for an object at infinity in green light.
    files: folder of `.zmx` files, at their primary wavelength; "" for none.
    parts: fields relative to the widest.
    rays, orders, own_orders: samplings to try, each from few rays to many: numbers of rays of
        patterns, orders of the quadratures of other programs, and orders of ours, each of which is
        compiled.
    repeats: number of timed turns.
    """

    lenses: tuple[LensFields, ...] = ()
    files: str = ""
    parts: Annotated[Numbers, within(0, 1)] = (0.0, 0.7, 1.0)
    rays: Annotated[tuple[int, ...], not_empty, within(7, 1e6)] = (256, 2048, 16384)
    orders: Annotated[tuple[int, ...], not_empty, within(1, 40)] = (4, 6, 8, 12)
    own_orders: Annotated[tuple[int, ...], not_empty, within(1, 40)] = (4, 7, 12)
    repeats: Annotated[int, within(1, 1e4)] = 5


class At(NamedTuple):
    """A lens and an object point, as arguments of `reference` and `_peers.Lens`: field along y in
    radians, distance in mm, and one wavelength in um."""

    lens: Lens
    field: float
    distance: float
    wavelengths: tuple[float]


@jax.jit
def _sigma(lens: Lens, scene: Scene, rule: Any) -> Array:
    return sigmas(drt_jax.psf_moments(lens, scene, rule))


def _ours(at: At, sizes: Profile, clipped: bool, error: Callable) -> Made:
    """(call, error) of Gauss rules on the stop or, for a clipped pupil, of rules fitted to it."""
    lens, *seen = at
    scene, symmetry = Scene.point(*seen), drt_jax.pupil.symmetry_of(lens, at.field)
    rules: list[Any] = [Gauss(order, symmetry) for order in sizes.own_orders]
    if clipped:
        rules = [Clipped(order, symmetry, size, may_cross(lens)) for order, size in _CLIPPED]
    for rule in rules:
        call = partial(_sigma, lens, scene, rule)
        yield call, error(call())


def sweep(made: Made) -> Made:
    """The calls of a sweep until it ends, see the module docstring."""
    before = np.inf
    for call, error in made:
        yield call, error
        start = time.perf_counter()
        jax.block_until_ready(call())
        slow = time.perf_counter() - start > _LONGEST
        if error < _ENOUGH or slow or not error * _HELP < before:
            return
        before = error


def attempt(sweeps: Sequence[Made]) -> tuple[list[list[Callable]], Row]:
    """For each tolerance, the first call of each sweep that reaches it; and a row of results:
    `error`, the smallest error; `first_s`; and `why`, the reason if no call reaches the first
    tolerance."""
    calls: list[list[Callable]] = [[] for _ in TOLERANCES]
    start, least, why = time.perf_counter(), np.inf, ""
    for made in sweeps:
        found: list[tuple[Callable, float]] = []
        try:
            found.extend(sweep(made))
        except ImportError as missing:
            why = f"{missing.name} is not installed"
        except Exception as failure:  # other programs may raise anything
            why = why or f"{type(failure).__name__}: {failure}".splitlines()[0][:60]
        for some, tolerance in zip(calls, TOLERANCES):
            some += [call for call, error in found if error <= tolerance][:1]
        least = min([least, *(error for _, error in found if error >= 0)])
    if np.isfinite(least):
        why = "" if calls[0] else f"no sampling comes to {TOLERANCES[0]:.0e}"
    error = float(least) if np.isfinite(least) else None
    why = why or ("" if calls[0] else "the spot is not finite")
    return calls, {"error": error, "first_s": time.perf_counter() - start, "why": why}


def rows_at(at: At, sizes: Profile) -> list[Row]:
    """A row for each program. ValueError if the reference has no spot there."""
    if at.lens.elements or at.lens.apertures or at.lens.phase or at.lens.tilt is not None:
        raise ValueError("the reference knows centred lenses with round apertures alone")
    truth = reference(*at, slopes=False)
    error = partial(relative_error, truth)
    work = {"drt_jax": [_ours(at, sizes, bool(truth.clipped[0]), error)]}
    numbers = cache(partial(_peers.Lens, *at))

    def theirs(spot: Callable, aim: str, pattern: str) -> Made:
        for size in sizes.orders if pattern == "Gaussian" else sizes.rays:
            call = spot(numbers(), _peers.rays_of(_peers.PATTERNS[pattern], size, aim))
            yield call, error(call())

    ways = list(itertools.product(("iterative", "paraxial"), _PATTERNS))
    for name, (spot, _) in _peers.SPOTS.items():
        work[name] = [theirs(spot, *way) for way in ways]
    tried = {name: attempt(sweeps) for name, sweeps in work.items()}
    every = {id(call): call for calls, _ in tried.values() for some in calls for call in some}
    times = dict(zip(every, _common.quartiles([*every.values()], sizes.repeats)))
    known = {"field_deg": math.degrees(at.field), "reference_error": float(truth.error[0])}
    rows = []
    for name, (calls, row) in tried.items():
        own = [[times[id(call)] for call in some] for some in calls]
        best = [min(some, key=lambda q: q[1], default=None) for some in own]
        rows.append(known | {"program": name} | row | {"quartiles_s": best})
    return rows


def of_lens(name: str, make: Callable, sizes: Profile) -> dict[str, list[Row]]:
    """Rows of the scenes of a lens, which share compiled programs; and the reasons for scenes
    without rows. make: function that returns the scenes."""
    jax.clear_caches()
    found: dict[str, list[Row]] = {"profile": [], "left_out": []}
    field = None
    try:
        for at in make():
            field = math.degrees(at.field)
            found["profile"] += [{"lens": name} | row for row in rows_at(at, sizes)]
    except ValueError as why:  # wider fields have no reference either
        found["left_out"] += [{"lens": name, "field_deg": field, "why": str(why)[:120]}]
    return found


def bundled(of: LensFields, parts: Sequence[float]) -> list[At]:
    """Scenes of a lens: an object at infinity, at parts of the widest field."""
    lens, widest = drt_jax.load_lens(of.lens), math.radians(of.field_deg)
    return [At(lens, part * widest, math.inf, (_GREEN,)) for part in parts]


def from_file(path: pathlib.Path, parts: Sequence[float]) -> list[At]:
    """Scenes of a lens file, at its primary wavelength. ValueError if there are none."""
    system = drt_jax.load_system(path)
    if system.fields is None:
        raise ValueError("real image heights")
    widest = float(np.max(np.hypot(*np.asarray(system.fields).T)))
    fields = dict.fromkeys(part * widest for part in parts)
    wavelength = float(system.wavelengths[system.primary])
    return [At(system.lens, field, float(system.distance), (wavelength,)) for field in fields]


def jobs(sizes: Profile) -> dict[str, Callable]:
    """Functions that measure each lens, by name."""
    makers = {of.lens: partial(bundled, of, sizes.parts) for of in sizes.lenses}
    folder = sizes.files and pathlib.Path(sizes.files)
    for path in sorted(folder.glob("*.zmx")) if folder and folder.is_dir() else ():
        makers[path.name] = partial(from_file, path, sizes.parts)
    return {name: partial(of_lens, name, make, sizes) for name, make in makers.items()}


def ratios(rows: Sequence[Row], k: int) -> dict[str, np.ndarray]:
    """By program, its time divided by that of the fastest program, for each scene whose reference
    is accurate enough for TOLERANCES[k]; inf if the program does not solve the scene."""
    errors = ((row, row["reference_error"]) for row in rows)
    known = [row for row, error in errors if error is not None and 3 * error < TOLERANCES[k]]
    seconds: dict[str, list[float]] = {}
    for row in known:
        time_of = row["quartiles_s"][k]
        seconds.setdefault(row["program"], []).append(time_of[1] if time_of else np.inf)
    if not known:
        return {}
    fastest = np.min(list(seconds.values()), axis=0)
    solved = np.where(np.isfinite(fastest), fastest, 1.0)
    return {name: np.array(own) / solved for name, own in seconds.items()}


def summary(rows: Sequence[Row]) -> str:
    """Table of the share of scenes that each program solves, the median ratio of its time to that
    of the fastest program, and the median time of first calls."""
    lines = []
    for (program,), own in _common.grouped(rows, "program").items():
        cells = []
        for k in range(len(TOLERANCES)):
            own_ratios = ratios(rows, k).get(program, np.array([]))
            done = own_ratios[np.isfinite(own_ratios)]
            cells += [f"{len(done)} of {len(own_ratios)}"]
            cells += [f"{np.median(done):.3g}" if len(done) else ""]
        first = float(np.median([row["first_s"] for row in own]))
        lines.append((program, *cells, _common.duration(first)))
    levels = sum(((f"to {level:.0e}", "median ratio") for level in TOLERANCES), ())
    return _common.table(("program", *levels, "first calls of a sweep"), lines)


def reasons(rows: Sequence[Row]) -> str:
    """Table of the reasons why scenes are not solved to the first tolerance, with counts."""
    counts = Counter((row["program"], row["why"]) for row in rows if row["why"])
    lines = [(*key, count) for key, count in counts.items()]
    return _common.table(("program", f"not to {TOLERANCES[0]:.0e} because", "scenes"), lines)


def not_compared(rows: Sequence[Row]) -> str:
    """Table of the reasons why scenes are left out, with the lenses."""
    lines = [
        (re.sub(r"\S*/", "", why), ", ".join(dict.fromkeys(row["lens"] for row in own)))
        for (why,), own in _common.grouped(rows, "why").items()
    ]
    return _common.table(("not compared because", "lenses"), lines)
