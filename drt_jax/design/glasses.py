"""Real glasses in place of model glasses, one by one, the least costly first."""

import dataclasses
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..devices import in_turn
from ..lens.glass import Glass, nd_and_vd
from ..lens.glasses import Neighbour, nearest_glasses
from ..lens.lens import Lens, glass_rows, with_glass
from .kinds import model_glasses
from .optimum import Optimum, init_problem, optimise, take_step
from .problem import Problem, quick

# Media are one medium where nd and vd differ by less.
_SAME = (1e-5, 1e-2)
# Least gain of an exchange, relative, and how many are tried before the search ends.
_GAIN, _EXCHANGES = 1e-3, 3


class Snap(NamedTuple):
    """A glass that was exchanged.

    surfaces: behind which it begins; several if their nd or vd are tied.
    glass, replaced: its name, and that of the medium before it.
    model: nd and vd of that medium.
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
    alternatives: by the first surface behind which a glass begins: glasses tried there, all others
        as in `lens`, and `Optimum.score` after the steps of a trial, the best first; inf if light
        fails. Trials meet limits only nearly: compare with the trial of the glass in `lens`.
    problem: in it real glasses vary no more; go on from `optimum.vector`.
    """

    lens: Lens
    optimum: Optimum
    snaps: list[Snap]
    alternatives: dict[int, list[tuple[Neighbour, float]]]
    problem: Problem


class _Trial(NamedTuple):
    """A glass in one place: its problem, the best vector found in some steps, and its score."""

    place: tuple[int, ...]
    near: Neighbour
    problem: Problem
    vector: np.ndarray
    score: float


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


def _with_glass(
    problem: Problem, vector: np.ndarray, place: tuple[int, ...], glass: Glass
) -> tuple[Problem, np.ndarray]:
    """The problem and its vector (N,) with a glass in a place. Its nd and vd are fixed at those
    that mark a real glass. Only numbers differ, so that one program serves all glasses."""
    variables = problem.variables
    scale, dtype = np.asarray(variables.scale), variables.low.dtype
    low, high, vector = (np.array(a) for a in (variables.low, variables.high, vector))
    for k, (kind, row, _) in enumerate(variables.places):
        if kind in ("index", "abbe") and row in place:
            low[k] = high[k] = vector[k] = Glass.model[kind == "abbe"] / scale[k]
    lens, (least, most) = with_glass(variables.lens, glass, place), jnp.array([low, high], dtype)
    own = dataclasses.replace(variables, lens=lens, low=least, high=most)
    return dataclasses.replace(problem, variables=own), vector


@dataclasses.dataclass(frozen=True)
class _Search:
    """Which glasses are tried, see `snap_glasses`."""

    makers: Collection[str] | None
    accept: Callable[[Glass], bool]
    count: int
    steps: int

    def neighbours(self, problem: Problem, lens: Lens, place: tuple[int, ...]) -> list[Neighbour]:
        """Glasses next to the medium in a place of a lens, known at all wavelengths, no two of the
        same constants, and none that this medium touches."""
        waves, points = np.asarray(problem.wavelengths), np.asarray(nd_and_vd(lens.dispersion))
        rows, (nd, vd) = glass_rows(lens, place), points[place[0] + 1].tolist()
        touched = points[~rows & (np.roll(rows, 1) | np.roll(rows, -1))]
        found: dict[tuple, Neighbour] = {}
        for near in nearest_glasses(nd, vd, self.makers, None):
            low, high = np.asarray(near.glass.range, waves.dtype)
            other = np.all(np.any(np.abs(touched - (near.nd, near.vd)) > _SAME, axis=1))
            if other and low <= waves.min() and waves.max() <= high and self.accept(near.glass):
                found.setdefault((near.glass.sellmeier, near.glass.schott), near)
            if len(found) == self.count:
                break
        if not found:
            raise ValueError(
                f"snap_glasses: no glass fits behind surface {place[0]}; accept more, or name "
                "other makers"
            )
        return [*found.values()]

    def trial(
        self, problem: Problem, vector: np.ndarray, place: tuple[int, ...], near: Neighbour
    ) -> _Trial:
        """Some steps of least squares with a glass in a place."""
        own, start = _with_glass(problem, vector, place, near.glass)
        search = init_problem(quick(own), jnp.asarray(start, own.variables.low.dtype))
        for _ in range(self.steps):
            search = take_step(quick(own), search)
        return _Trial(place, near, own, np.asarray(search.vector), float(search.score))

    def ranked(
        self, problem: Problem, found: Optimum, places: Sequence[tuple[int, ...]]
    ) -> list[_Trial]:
        """All trials in some places, the best first."""
        tasks = [(p, n) for p in places for n in self.neighbours(problem, found.lens, p)]
        trials = in_turn(lambda task: self.trial(problem, found.vector, *task), tasks)
        return sorted(trials, key=lambda trial: trial.score)


def _snap(trial: _Trial, found: Optimum, max_steps: int) -> tuple[Snap, Optimum]:
    """The glass of a trial in place of that of an optimum, with least squares of the rest."""
    after = optimise(trial.problem, jnp.asarray(trial.vector), max_steps)
    row = trial.place[0] + 1
    nd, vd = np.asarray(nd_and_vd(found.lens.dispersion))[row].tolist()
    replaced = found.lens.glasses[row]
    own = trial.place, trial.near.glass.name, replaced, (nd, vd), found.score, after.score
    return Snap(*own), after


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
    """Replaces the model glasses of an optimum by real ones.

    Each round tries real glasses in all places that still have a model glass, keeps the one that
    costs least, and optimises what still varies. At the end real glasses are exchanged for
    neighbours as long as the lens gets better.

    found: result of `optimise` for `problem`; the operand `glass_map` keeps its glasses near real
        ones.
    makers: of the glasses, see `glass_makers`; None: all.
    accept: whether to use a glass of theirs.
    count: glasses tried in each place, the nearest in nd and vd.
    steps: of least squares with each.
    max_steps: as in `optimise`, after each snap.
    callback: called after each snap.

    Compiles nothing that `optimise` has not compiled for the problem, unless a glass has more
    constants than those before. ValueError where the lens has no model glass, for an unknown maker,
    and where no glass fits.
    """
    places, search, snaps = _places(problem), _Search(makers, accept, count, steps), list[Snap]()
    left = [*places]
    while left:
        best = search.ranked(problem, found, left)[0]
        snap, found = _snap(best, found, max_steps)
        left.remove(best.place)
        problem = best.problem
        snaps.append(snap)
        callback(snap)
    better = True
    while better:
        ranked, better = search.ranked(problem, found, places), False
        # Better than trials of the glasses that are there.
        names = found.lens.glasses
        now = [t.score for t in ranked if t.near.glass.name == names[t.place[0] + 1]]
        most = (1 - _GAIN) * min(now, default=np.inf)
        for trial in [t for t in ranked if t.score < most][:_EXCHANGES]:
            snap, after = _snap(trial, found, max_steps)
            better = snap.after < (1 - _GAIN) * snap.before
            if better:
                problem, found = trial.problem, after
                snaps.append(snap)
                callback(snap)
                break
    alternatives = {p[0]: [(t.near, t.score) for t in ranked if t.place == p] for p in places}
    # nd and vd of media without a model are exact in the lens of the variables.
    lens = dataclasses.replace(found.lens, dispersion=problem.variables.lens.dispersion)
    return Snapped(lens, found._replace(lens=lens), snaps, alternatives, problem)
