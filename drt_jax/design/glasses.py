"""Real glasses in place of model glasses, one by one, the least costly first."""

import concurrent.futures
import dataclasses
import functools
import os
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..lens.glass import Glass, nd_and_vd
from ..lens.glasses import Neighbour, glass_makers, nearest_glasses
from ..lens.lens import Lens, with_glass
from .kinds import model_glasses
from .optimum import Optimum, init_problem, optimise, take_step
from .problem import Problem, quick

# Media are one medium where nd and vd differ by less; a gain worth an exchange, relative.
_SAME, _GAIN = (1e-5, 1e-2), 1e-3


class Alternative(NamedTuple):
    """A glass tried in one place of a lens.

    glass, nd, vd: of the table of glasses.
    score: as `Optimum.score`, after the steps of a trial; inf where light fails.
    """

    glass: Glass
    nd: float
    vd: float
    score: float


class Snap(NamedTuple):
    """A glass that was exchanged.

    surfaces: behind which it begins; several if their nd or vd are tied.
    glass, replaced: its name, and that of the glass before it; "" for a model glass.
    model: nd and vd of the medium that it replaced.
    before, after: `Optimum.score` of the lens before, and after least squares of what still varies.
    """

    surfaces: tuple[int, ...]
    glass: str
    replaced: str
    model: tuple[float, float]
    before: float
    after: float


class Snapped(NamedTuple):
    """Result of `snap_glasses`.

    lens: of real glasses, each with its own dispersion formula.
    optimum: its last optimisation; its lens is `lens`.
    snaps: in their order; exchanges of a real glass for another come last.
    alternatives: for each place, by the first surface behind which its glass begins: what was tried
        in the end, all other glasses as in `lens`, ranked. Trials of some steps meet limits only
        nearly: compare with the glass itself, which stands among them.
    problem: whose real glasses vary no more, to go on with from `optimum.vector`.
    """

    lens: Lens
    optimum: Optimum
    snaps: list[Snap]
    alternatives: dict[int, list[Alternative]]
    problem: Problem


class _Trial(NamedTuple):
    """A glass in one place: its problem, and the best vector found in some steps."""

    place: tuple[int, ...]
    tried: Alternative
    problem: Problem
    vector: np.ndarray


def _places(problem: Problem) -> list[tuple[int, ...]]:
    """The surfaces at which model glasses begin, those together whose nd or vd are tied.
    ValueError for glasses that are tied but not equal, and where there is none."""
    variables = problem.variables
    first = {row: row for row in model_glasses(variables.lens)}
    for (k, follower), line in zip(variables.ties, variables.lines.tolist(), strict=True):
        if follower.kind in ("index", "abbe"):
            if line != [1, 0]:
                raise ValueError(
                    f"snap_glasses: {follower} is tied with a scale or shift; leave this tie out"
                )
            first[follower.row] = variables.places[k].row
    if not first:
        raise ValueError("snap_glasses: the lens has no model glass; see with_model_glass")
    return [tuple(r for r in first if first[r] == row) for row in sorted({*first.values()})]


def _with_glass(problem: Problem, vector: np.ndarray, place: tuple[int, ...], glass: Glass):
    """The problem and its vector (N,) with a glass in a place, whose nd and vd vary no more: as of
    media that are no model glass. Only numbers differ, so that one program serves all glasses."""
    variables = problem.variables
    low, high, vector, scale = (
        np.array(a, float) for a in (variables.low, variables.high, vector, variables.scale)
    )
    for k, (kind, row, _) in enumerate(variables.places):
        if kind in ("index", "abbe") and row in place:
            value = Glass("").model[kind == "abbe"]
            low[k] = high[k] = vector[k] = value / scale[k]
    dtype = variables.low.dtype
    variables = dataclasses.replace(
        variables,
        lens=with_glass(variables.lens, glass, place),
        low=jnp.asarray(low, dtype),
        high=jnp.asarray(high, dtype),
    )
    return dataclasses.replace(problem, variables=variables), vector


class _Search(NamedTuple):
    """What is tried: glasses of makers that are accepted, `count` of them next to the medium in
    each place, `steps` of least squares with each."""

    makers: Collection[str] | None
    accept: Callable[[Glass], bool]
    count: int
    steps: int

    def neighbours(self, problem: Problem, lens: Lens, place: tuple[int, ...]) -> list[Neighbour]:
        """Glasses next to the medium in a place of a lens, known at all wavelengths, no two of the
        same constants, and none that this medium touches."""
        waves, media = np.asarray(problem.wavelengths), lens.glasses
        points = np.asarray(nd_and_vd(lens.dispersion))
        ends = [
            (r, next((k for k in range(r + 1, len(media)) if media[k] != media[r + 1]), r))
            for r in place
        ]
        touched = points[np.ravel(ends)]
        found: dict[tuple, Neighbour] = {}
        for near in nearest_glasses(*points[place[0] + 1].tolist(), self.makers, 10_000):
            low, high = near.glass.range
            same = np.all(np.abs(touched - (near.nd, near.vd)) < _SAME, axis=1)
            if low <= waves.min() and waves.max() <= high and not same.any():
                if self.accept(near.glass):
                    found.setdefault((near.glass.sellmeier, near.glass.schott), near)
            if len(found) == self.count:
                break
        return [*found.values()]

    def trial(self, problem: Problem, vector: np.ndarray, place: tuple[int, ...], near: Neighbour):
        own, start = _with_glass(problem, vector, place, near.glass)
        search = init_problem(quick(own), jnp.asarray(start, own.variables.low.dtype))
        for _ in range(self.steps):
            search = take_step(quick(own), search)
        tried = Alternative(near.glass, near.nd, near.vd, float(search.score))
        return _Trial(place, tried, own, np.asarray(search.vector))

    def ranked(
        self, problem: Problem, found: Optimum, places: Sequence[tuple[int, ...]]
    ) -> list[_Trial]:
        """All trials in some places, the best first."""
        tasks = [(p, n) for p in places for n in self.neighbours(problem, found.lens, p)]
        with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
            run = functools.partial(self.trial, problem, found.vector)
            trials = [*pool.map(lambda task: run(*task), tasks)]
        return sorted(trials, key=lambda trial: trial.tried.score)


def snap_glasses(
    problem: Problem,
    found: Optimum,
    makers: Collection[str] | None = ("SCHOTT",),
    accept: Callable[[Glass], bool] = lambda glass: True,
    count: int = 8,
    steps: int = 12,
    max_steps: int = 100,
    callback: Callable[[Snap], None] = lambda snap: None,
) -> Snapped:
    """Replaces the model glasses of an optimum by real ones, one by one: each time that, of all
    glasses next to those that are left, which costs least, with least squares of what still varies.
    Then exchanges real glasses for neighbours while that makes the lens better.

    found: of `optimise` for `problem`, which the operand `glass_map` keeps near real glasses.
    makers: of the glasses, see `glass_makers`; None: all.
    accept: whether to use a glass of theirs.
    count: glasses tried in each place.
    steps: of least squares with each.
    max_steps: as in `optimise`, after each snap.
    callback: called after each snap.

    Compiles nothing that `optimise` has not compiled for the problem, unless a glass has more
    constants than those before. ValueError where the lens has no model glass, for an unknown maker,
    and where no glass fits.
    """
    places, search = _places(problem), _Search(makers, accept, count, steps)
    left, snaps = places, list[Snap]()
    while True:
        ranked = search.ranked(problem, found, left or places)
        if not ranked:
            raise ValueError("snap_glasses: no glass fits; accept more or name other makers")
        best, own = ranked[0], {}
        if not left:
            for trial in ranked:
                own.setdefault(trial.place[0], []).append(trial.tried)
            names = {p[0]: found.lens.glasses[p[0] + 1] for p in places}
            now = [t.tried.score for t in ranked if t.tried.glass.name == names[t.place[0]]]
            if best.tried.score >= (1 - _GAIN) * max(now, default=np.inf):
                break
        after = optimise(best.problem, jnp.asarray(best.vector), max_steps)
        if not left and after.score >= found.score:
            break
        row = best.place[0] + 1
        snap = Snap(
            best.place,
            best.tried.glass.name,
            "" if left else found.lens.glasses[row],
            tuple(np.asarray(nd_and_vd(found.lens.dispersion))[row].tolist()),
            found.score,
            after.score,
        )
        snaps.append(snap)
        callback(snap)
        problem, found = best.problem, after
        left = [place for place in left if place != best.place]
    return Snapped(found.lens, found, snaps, own, problem)
