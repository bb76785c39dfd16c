"""Other optimisers on the problem of `design`, each from the same starts, one after the other.

All are judged alike: by our rays, as many as the spots of the design need, the numbers within their
bounds, focal length and entrance pupil as the solves have them. What each is told of the problem
stands at its function.
"""

import functools
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from experiments.design import Config
from jax import Array
from tqdm import tqdm

from drt_jax import design, learn
from drt_jax.compilation import LARGE, jit
from drt_jax.design.media import between

from . import _optiland
from ._settings import Beside

# What ends the search of optimistix, relative and absolute.
_FINE = 1e-9
# Of a lens that was not disturbed there is no nominal merit: ours is to be met to this part.
_NEAR = 0.01


class Task(NamedTuple):
    """What is to be done.

    config: the settings of the design, settings: of the comparison. problem: as it is searched.
    judging: with the rays that judge. target: a merit to be reached.
    """

    config: Config
    settings: Beside
    problem: design.Problem
    judging: design.Problem
    target: float


class Way(NamedTuple):
    """The way of an optimiser from one start.

    vector: (N,), where it ends. merits: (T,), with the squares of what exceeds limits, at the start
    and after each step; none where they are not told. jacobians: (T,), computed by then. seconds:
    of all steps; compile_s: before them.
    """

    vector: Array
    merits: np.ndarray
    jacobians: np.ndarray
    seconds: float
    compile_s: float = 0.0


def ours(task: Task, vector: Array) -> Way:
    """`drt_jax.design.optimise`, at most `trials`; no number where it cannot judge the start."""
    try:
        compiled = design.optimise(task.problem, vector, 1).first
        found = design.optimise(task.problem, vector, task.config.trials)
    except ValueError:
        return Way(jnp.full_like(vector, jnp.nan), np.zeros(0), np.zeros(0), 0.0)
    merit, worst, jacobians = found.history.T
    merits = merit + np.maximum(worst, 0) ** 2
    return Way(jnp.asarray(found.vector), merits, jacobians, found.seconds, compiled)


def marquardt(task: Task, vector: Array) -> Way:
    """optimistix.LevenbergMarquardt on the same residuals, at most `trials`. It knows neither
    bounds nor limits, so what exceeds them is a residual more, of weight 1 in their units or in
    scales of the variables; nor the veto of broken lenses."""
    most = task.config.trials
    run = functools.partial(_marquardt, task.problem, vector, most=most)
    (end, merits, count), *times = _timed(run, most)
    merits = np.asarray(merits)[: int(count)]
    return Way(end, merits, 1 + np.arange(len(merits)), *times)


def adam(task: Task, vector: Array) -> Way:
    """`learn.adam` on the sum of the same squares, numbers clipped to their bounds after each of
    `steps`, over which the rate falls to 0. What is counted are gradients."""
    steps, rate = task.settings.steps, task.settings.rate
    run = functools.partial(_adam, task.problem, vector, most=steps, rate=rate)
    (end, merits), *times = _timed(run, steps)
    return Way(end, np.asarray(merits), 1 + np.arange(len(merits)), *times)


def optiland(task: Task, vector: Array) -> Way | None:
    """Optiland's LeastSquares on the deviations of its rays, see `_optiland.recover`, within
    `seconds`; Jacobians by differences. None where it is not installed.

    Bounds, and limits of thicknesses on the axis, are those of its variables; the focal length is
    an operand, and so are limits of edges. It knows neither the zones of an edge but the rim, nor
    one across the stop, nor the veto of broken lenses; off axis it aims at the paraxial pupil."""
    variables, config = task.problem.variables, task.config
    found = _optiland.recover(
        variables.lens_of(vector),
        told(task.problem),
        fields_deg=config.fields_deg,
        wavelengths_um=config.wavelengths_um,
        distance_mm=config.distance_mm,
        seconds=task.settings.seconds,
    )
    if found is None:
        return None
    ends = [variables.vector(lens) for lens in (*found["lenses"], found["lens"])]
    merits = np.array([score(*judged(task.judging, end)) for end in ends])
    return Way(ends[-1], merits, 1 + np.arange(len(ends)), found["seconds"])


def of_radii(name: str, task: Task, vector: Array) -> Way | None:
    """An optimiser of both radii of a singlet by its RMS spot, see `_optiland.singlet`. None where
    Optiland is not installed."""
    variables = task.problem.variables
    found = _optiland.singlet((name,), variables.lens_of(vector))
    if found is None:
        return None
    end, none = variables.vector(found[name]["lens"]), np.zeros(0)
    return Way(end, none, none, found[name]["seconds"])


def told(problem: design.Problem) -> _optiland.Told:
    """Of a problem, what `_optiland.recover` is told."""
    variables, lens = problem.variables, problem.variables.lens
    bends, gaps = dict[int, tuple[float, float]](), dict[int, tuple[float, float]]()
    ends = np.stack([variables.low, variables.high], axis=1) * np.asarray(variables.scale)[:, None]
    for place, (low, high) in zip(variables.places, ends.tolist()):
        where = bends if place.kind == "curvature" else gaps
        where[lens.count - 1 if place.kind == "sensor" else place.row] = low, high
    held = {"focal_length": 0.0, "entrance_pupil": 0.0}
    for solve in variables.solves:
        held[solve.kind] = float(solve.value)
        if solve.kind == "focal_length":
            bends[solve.surface] = -math.inf, math.inf
    edges = []
    for operand in (operand for operand in problem.operands if operand.limits):
        for front, back in between(lens, operand.kind.startswith("glass")):
            if back > front + 1 or (operand.surfaces and front not in operand.surfaces):
                continue
            least = -math.inf if operand.low is None else float(operand.low)
            most = math.inf if operand.high is None else float(operand.high)
            if operand.kind.endswith("edge"):
                edges.append((front, least, most))
            elif front in gaps:
                low, high = gaps[front]
                gaps[front] = max(low, least), min(high, most)
    return _optiland.Told(bends, gaps, *held.values(), edges)


def _squares(vector: Array, problem: design.Problem) -> Array:
    """Residuals, and what exceeds limits and bounds as residuals more."""
    variables, found = problem.variables, problem.evaluate(vector)
    beyond = jnp.concatenate([variables.low - vector, vector - variables.high])
    return jnp.concatenate([found.residuals, jnp.maximum(jnp.append(found.constraints, beyond), 0)])


@functools.partial(jit, wanted=LARGE, static_argnames="most")
def _marquardt(
    problem: design.Problem, vector: Array, trials: Array, most: int
) -> tuple[Array, Array, Array]:
    """Where at most `trials`, of `most`, lead; merits (most,) on the way; how many there were."""
    method = optx.LevenbergMarquardt(rtol=_FINE, atol=_FINE)
    function = lambda y, args: (_squares(y, args), None)  # noqa: E731
    shape = jax.eval_shape(lambda y: _squares(y, problem), vector)
    scene = problem, {}
    state = method.init(function, vector, *scene, shape, None, frozenset())
    leaves, form = jax.tree.flatten(state)
    static = [None if hasattr(leaf, "dtype") else leaf for leaf in leaves]

    def arrays(state: Any) -> list[Array]:
        return [leaf for leaf in jax.tree.leaves(state) if hasattr(leaf, "dtype")]

    def whole(arrays: list[Array]) -> Any:
        those = iter(arrays)
        return form.unflatten([next(those) if leaf is None else leaf for leaf in static])

    def more(now: tuple) -> Array:
        k, y, state, _ = now
        state = whole(state)
        done, result = method.terminate(function, y, *scene, state, frozenset())
        return (k < trials) & ~done & (result == optx.RESULTS.successful)

    def step(now: tuple) -> tuple:
        k, y, state, merits = now
        state = whole(state)
        y, state, _ = method.step(function, y, *scene, state, frozenset())
        merits = merits.at[k].set(jnp.sum(state.f_info.residual**2))
        return k + 1, y, arrays(state), merits

    merits = jnp.full_like(vector, jnp.inf, shape=most)
    begin = jnp.int32(0), vector, arrays(state), merits
    count, vector, _, merits = jax.lax.while_loop(more, step, begin)
    return vector, merits, count


@functools.partial(jit, wanted=LARGE, static_argnames="most")
def _adam(
    problem: design.Problem, vector: Array, steps: Array, most: int, rate: float
) -> tuple[Array, Array]:
    """Where `steps`, of `most`, lead; and merits (most,) before each."""
    init, update = learn.adam(1.0)
    variables = problem.variables
    slope = jax.value_and_grad(lambda y: jnp.sum(_squares(y, problem) ** 2))

    def step(k: Array, now: tuple) -> tuple:
        y, state, merits = now
        merit, gradient = slope(y)
        move, state = update(gradient, state)
        part = 1 - k.astype(y.dtype) / most
        y = jnp.clip(y + part * rate * move, variables.low, variables.high)
        return y, state, merits.at[k].set(merit)

    begin = vector, init(vector), jnp.full_like(vector, jnp.inf, shape=most)
    vector, _, merits = jax.lax.fori_loop(0, steps, step, begin)
    return vector, merits


def _timed(run: Callable[[Array], Any], steps: int) -> tuple[Any, float, float]:
    """What is found in so many steps, their seconds, and those before the first."""
    begun = time.perf_counter()
    jax.block_until_ready(run(jnp.int32(0)))
    compiled = time.perf_counter()
    found = jax.block_until_ready(run(jnp.int32(steps)))
    return found, time.perf_counter() - compiled, compiled - begun


_judge = jit(lambda problem, vector: problem.evaluate(vector), LARGE)


def judged(problem: design.Problem, vector: Array) -> tuple[float, float]:
    """The merit of a vector within its bounds, and by how much the worst limit is exceeded, or
    surfaces overlap."""
    variables = problem.variables
    found = _judge(problem, jnp.clip(vector, variables.low, variables.high))
    worst = jnp.maximum(jnp.max(found.constraints, initial=0.0), found.overlap)
    return float(jnp.sum(found.residuals**2)), float(worst)


def score(merit: float, worst: float) -> float:
    """A merit with the square of what exceeds the worst limit."""
    return merit + max(worst, 0.0) ** 2


PEERS: dict[str, Callable[[Task, Array], Way | None]] = {
    "ours": ours,
    "optimistix": marquardt,
    "adam": adam,
    "optiland": optiland,
}


def one(name: str, task: Task, vector: Array) -> dict[str, Any] | None:
    """What an optimiser came to from one start, as a record; None where it is not installed."""
    peer = PEERS.get(name) or functools.partial(of_radii, name.removeprefix("optiland "))
    way = peer(task, vector)
    if way is None:
        return None
    merit, worst = judged(task.judging, way.vector)
    known = math.isfinite(merit + worst)
    record = {"merit": merit if known else None, "worst": worst if known else None}
    record |= {"met": known and score(merit, worst) <= task.target}
    record |= {"seconds": way.seconds, "compile_s": way.compile_s}
    record["jacobians"] = int(way.jacobians[-1]) if len(way.jacobians) else None
    met = np.flatnonzero(way.merits <= task.target)
    there = int(met[0]) if len(met) else None
    steps = max(len(way.merits) - 1, 1)
    record["met_jacobians"] = None if there is None else int(way.jacobians[there])
    record["met_s"] = None if there is None else way.seconds * there / steps
    return record


def beside(
    config: Config, settings: Beside, problem: design.Problem, vectors: np.ndarray, order: int,
    row: dict[str, Any],
) -> list[dict[str, Any]]:  # fmt: skip
    """A row for each optimiser of the settings from starts (K, N); order: of the rule that judges;
    row: of our own design."""
    judging = problem if config.rings else problem.with_order(max(order, config.order))
    made = config.starts.how == "made" and config.starts.count > 1
    target = row["merit_start"] if made else (1 + _NEAR) * row["merit_end"]
    task = Task(config, settings, problem, judging, target)
    low, high = problem.variables.low, problem.variables.high
    jobs = {
        f"{name}, start {k}": functools.partial(one, name, task, jnp.clip(vector, low, high))
        for name in settings.peers
        for k, vector in enumerate(jnp.asarray(vectors[: settings.starts or None]))
    }
    found = [jobs[job]() for job in tqdm(jobs, unit="start", dynamic_ncols=True)]
    each = np.split(np.array(found, object), len(settings.peers)) if found else []
    return [summary(name, list(records)) for name, records in zip(settings.peers, each)]


def summary(name: str, records: list[dict[str, Any] | None]) -> dict[str, Any]:
    """All starts of an optimiser: lists by start; all else None where it is not installed."""
    some = [record for record in records if record]
    row = {"optimiser": name, "starts": len(records), "met": None, "best": None, "median": None}
    for key in ("merit", "worst", "seconds", "compile_s", "jacobians", "met_jacobians", "met_s"):
        row[key] = [record[key] for record in some]
    merits = [merit for merit in row["merit"] if merit is not None]
    if some:
        row["met"] = sum(record["met"] for record in some)
    if merits:
        row |= {"best": min(merits), "median": float(np.median(merits))}
    return row


def peer(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of Optiland's optimisers that with the best lens: `peer`, its name; `peer_merit`, the best of
    all starts; `peer_s`, of all of them. None without."""
    known = [r for r in rows if r["optimiser"].startswith("optiland") and r["best"] is not None]
    if not known:
        return {"peer": None, "peer_merit": None, "peer_s": None}
    row = min(known, key=lambda row: row["best"])
    name, merit = row["optimiser"], row["best"]
    return {"peer": name, "peer_merit": merit, "peer_s": sum(row["seconds"])}
