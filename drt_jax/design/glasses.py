"""Replaces model glasses by real glasses, one place after the other, the least costly one first."""

import dataclasses
import re
from collections.abc import Callable, Collection, Iterator
from itertools import islice
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..devices import in_turn
from ..inputs import require
from ..lens.glass import Glass, nd_and_vd
from ..lens.glasses import Neighbour, nearest_glasses
from ..lens.lens import Lens, glass_rows, with_glass
from ..rays.solve import solve_aimed
from .configurations import AnyProblem, Configurations, problems_of
from .media import model_glasses
from .optimum import Optimum, init_problem, optimise, take_step
from .problem import Problem

# Two media count as the same medium if their nd and vd differ by less than this.
_SAME = (1e-5, 1e-2)
# Smallest relative gain for which a real glass is exchanged, and the number of exchanges that are
# tried before the search ends.
_GAIN, _EXCHANGES = 1e-3, 3
# Names of glasses with cerium against radiation (G05, G18, ...) and of melts of high transmission,
# which have the constants of another glass; the wavelength (um) down to which glass shall be clear.
_SPECIAL, _CLEAR = re.compile(r"(G\d\d|HT(i|ultra)?)(_|$)"), 0.44


class Snap(NamedTuple):
    """A glass that was exchanged.

    surfaces: surfaces behind which the glass begins; several if their nd or vd are tied.
    glass, replaced: name of the new glass, and of the medium before.
    model: nd and vd of the medium before.
    before, after: `Optimum.score` of the lens before the exchange, and after least squares of the
        remaining variables.
    """

    surfaces: tuple[int, ...]
    glass: str
    replaced: str
    model: tuple[float, float]
    before: float
    after: float


class Snapped(NamedTuple):
    """Result of `snap_glasses`.

    lens: the lens with real glasses, each with its own dispersion formula; of several
        configurations the first.
    optimum: the last optimisation; its lens is `lens`.
    snaps: the exchanges in their order. Exchanges of a real glass for another real glass come last.
    alternatives: by the first surface behind which a glass begins: the glasses that were tried
        there, all others being as in `lens`, and `Optimum.score` after the steps of the trial, the
        best first; inf if rays fail. Trials meet limits only nearly, so compare a score with that
        of the trial of the glass in `lens`.
    problem: the problem in which real glasses are not varied; continue from `optimum.vector`.
    lenses: `lens` in each configuration.
    """

    lens: Lens
    optimum: Optimum
    snaps: list[Snap]
    alternatives: dict[int, list[tuple[Neighbour, float]]]
    problem: AnyProblem
    lenses: tuple[Lens, ...]


class _Trial(NamedTuple):
    """A glass in one place: its problem, the best vector found in some steps, and the score of
    it.
    """

    place: tuple[int, ...]
    near: Neighbour
    problem: AnyProblem
    vector: np.ndarray
    score: float


def ordinary_glass(glass: Glass) -> bool:
    """Whether the maker of a glass sells it as a regular product today, by its `status`.

    False for obsolete and special glasses (on inquiry, for moulding in moulds of one customer),
    for glasses without a status, such as plastics, for radiation-resistant glasses (SF6G05),
    variants of high transmission (N-SF6HT), and glasses whose constants begin above 0.44 um.
    """
    sold = glass.status in ("standard", "preferred")
    return sold and not _SPECIAL.search(glass.name) and glass.range[0] <= _CLEAR


def _places(problem: Problem) -> list[tuple[int, ...]]:
    """The places of model glasses: tuples of the surfaces behind which they begin.

    Surfaces whose nd or vd are tied form one place. ValueError for glasses that are tied by a scale
    or shift, and if the lens has no model glass.
    """
    variables = problem.variables
    first = {row: row for row in model_glasses(variables.lens)}
    for (k, follower), line in zip(variables.ties, variables.lines.tolist(), strict=True):
        if follower.kind in ("index", "abbe"):
            what = f"snap_glasses: {follower} is tied with a scale or shift; leave this tie out"
            require(line == [1, 0], what)
            first[follower.row] = variables.places[k].row
    require(first, "snap_glasses: the lens has no model glass; see with_model_glass")
    return [tuple(r for r in first if first[r] == row) for row in sorted({*first.values()})]


def _shared_places(problem: AnyProblem) -> list[tuple[int, ...]]:
    """`_places` of all configurations.

    ValueError for configurations at other temperatures, or with glasses of their own.
    """
    each = problems_of(problem)
    cold = all(one.variables.environment is None for one in each)
    require(cold, "problem: snap_glasses takes one at 20 C, where its glasses are those of makers")
    places = _places(each[0])
    apart = [n for n in problem.variables.names if re.match(r"(index|abbe) .* of configuration", n)]
    alike = not apart and all(_places(one) == places for one in each)
    own = ", ".join(apart) or "their model glasses differ"
    require(alike, f"problem: snap_glasses: {own}; one glass serves all configurations: share it")
    return places


def _with_glass(
    problem: AnyProblem, vector: np.ndarray, place: tuple[int, ...], glass: Glass
) -> tuple[AnyProblem, np.ndarray]:
    """The problem, and its vector (N,), with a real glass in a place, in all configurations.

    The variables nd and vd of this glass are fixed at the values that mark a real glass. Only
    numbers differ, so that one compiled program serves all glasses.
    """

    def fixed(problem: Problem) -> Problem:
        variables = problem.variables
        scale, dtype = np.asarray(variables.scale), variables.low.dtype
        low, high = np.array(variables.low), np.array(variables.high)
        for k, (kind, row, _) in enumerate(variables.places):
            if kind in ("index", "abbe") and row in place:
                low[k] = high[k] = Glass.model[kind == "abbe"] / scale[k]
        least, most = jnp.array([low, high], dtype)
        lens = with_glass(variables.lens, glass, place)
        own = dataclasses.replace(variables, lens=lens, low=least, high=most)
        return dataclasses.replace(problem, variables=own)

    found = problem.map(fixed) if isinstance(problem, Configurations) else fixed(problem)
    return found, np.clip(vector, found.variables.low, found.variables.high)


def _neighbours(
    problem: AnyProblem,
    lens: Lens,
    place: tuple[int, ...],
    makers: Collection[str] | None,
    accept: Callable[[Glass], bool],
) -> Iterator[Neighbour]:
    """The accepted glasses for a place of a lens, the nearest to its medium first.

    The index of each is known at all wavelengths, no two have the same constants, and none is the
    same as a medium that touches this one.
    """
    points = np.asarray(nd_and_vd(lens.dispersion))
    waves = np.concatenate([np.asarray(one.wavelengths) for one in problems_of(problem)])
    rows, (nd, vd) = glass_rows(lens, place), points[place[0] + 1].tolist()
    touched = points[~rows & (np.roll(rows, 1) | np.roll(rows, -1))]
    known: set[tuple] = set()
    for near in nearest_glasses(nd, vd, makers, None):
        low, high = np.asarray(near.glass.range, waves.dtype)
        other = np.all(np.any(np.abs(touched - (near.nd, near.vd)) > _SAME, axis=1))
        constants = near.glass.sellmeier, near.glass.schott
        fits = other and low <= waves.min() and waves.max() <= high and constants not in known
        if fits and accept(near.glass):
            known.add(constants)
            yield near
    remedy = "accept more than design.ordinary_glass, or name other makers"
    require(known, f"snap_glasses: no glass fits behind surface {place[0]}; {remedy}")


def snap_glasses(
    problem: AnyProblem,
    found: Optimum,
    makers: Collection[str] | None = ("SCHOTT",),
    accept: Callable[[Glass], bool] = ordinary_glass,
    count: int = 8,
    steps: int = 12,
    max_steps: int = 100,
    callback: Callable[[Snap], None] = lambda snap: None,
) -> Snapped:
    """Replaces the model glasses of an optimum by real ones.

    Each round tries real glasses in all places that still have a model glass, keeps the one that
    increases the score least, and optimises the remaining variables. At the end real glasses are
    exchanged for neighbouring glasses as long as the score falls by at least 0.1 %.

    problem: the problem of the optimum, of one configuration or of several, which share glasses.
    found: result of `optimise` for `problem`. The operand `glass_map` keeps its model glasses near
        real ones.
    makers: makers of the glasses, see `glass_makers`; None for all.
    accept: function of a glass, whether it may be used; by default `ordinary_glass`, which leaves
        out what is not sold today.
    count: number of glasses tried in each place, the nearest in nd and vd.
    steps: number of steps of least squares with each of them.
    max_steps: as in `optimise`, after each exchange.
    callback: called with each exchange.

    Compiles nothing that `optimise` has not compiled for the problem, unless a glass has more
    constants than those before. ValueError if the lens has no model glass, for an unknown maker,
    if no glass fits, and for configurations at other temperatures or with glasses of their own.
    """

    def run(task: tuple[tuple[int, ...], Neighbour]) -> _Trial:
        """Some steps of least squares with a glass in a place."""
        place, near = task
        own, start = _with_glass(problem, found.vector, place, near.glass)
        tried = own.with_solver(solve_aimed)
        search = init_problem(tried, jnp.asarray(start, own.variables.low.dtype))
        for _ in range(steps):
            search = take_step(tried, search)
        return _Trial(place, near, own, np.asarray(search.vector), float(search.score))

    places, snaps = _shared_places(problem), list[Snap]()
    left, done = [*places], False
    while not done:
        tasks = [
            (place, near)
            for place in left or places
            for near in islice(_neighbours(problem, found.lens, place, makers, accept), count)
        ]
        ranked = sorted(in_turn(run, tasks), key=lambda trial: trial.score)
        names = found.lens.glasses
        present = [t.score for t in ranked if t.near.glass.name == names[t.place[0] + 1]]
        # A model glass must be replaced; a real glass only by a better one.
        most = (1 - _GAIN) * min(present, default=np.inf)
        tried = ranked[:1] if left else [t for t in ranked if t.score < most][:_EXCHANGES]
        done = True
        for trial in tried:
            after = optimise(trial.problem, jnp.asarray(trial.vector), max_steps)
            row = trial.place[0] + 1
            nd, vd = np.asarray(nd_and_vd(found.lens.dispersion))[row].tolist()
            both = trial.near.glass.name, names[row]
            snap = Snap(trial.place, *both, (nd, vd), found.score, after.score)
            if left or snap.after < (1 - _GAIN) * snap.before:
                problem, found, done = trial.problem, after, False
                left = [place for place in left if place != trial.place]
                snaps.append(snap)
                callback(snap)
                break
    alternatives = {p[0]: [(t.near, t.score) for t in ranked if t.place == p] for p in places}
    # In the lens of the variables, nd and vd of media without a model are exact; in `found.lens`
    # they have passed through the vector.
    ends = problem.lenses(found.vector) if isinstance(problem, Configurations) else (found.lens,)
    lens, *more = (
        dataclasses.replace(end, dispersion=one.variables.lens.dispersion)
        for end, one in zip(ends, problems_of(problem), strict=True)
    )
    last = found._replace(lens=lens)
    return Snapped(lens, last, snaps, alternatives, problem, (lens, *more))
