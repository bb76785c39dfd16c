"""Other optimisers beside ours: the same problem, judged alike, each start done once."""

import dataclasses
import importlib.util
import json
import math
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import design as lenses
from experiments import design
from experiments.runs.config import load_config

from . import _optimisers
from ._settings import Beside, require_told

ROOT = pathlib.Path(__file__).resolve().parents[1]
CONFIGS = ROOT / "configs" / "design"
COUNT = 3
needed = pytest.mark.skipif(
    importlib.util.find_spec("optiland") is None, reason="optiland is not installed"
)


def settings(name, *changes):
    return load_config(design.Config, CONFIGS / f"{name}.yaml", changes)


def recovery():
    """The problem of the recovery, and a lens that is off by more than the rounding of its file."""
    config = settings("recovery")
    start = lenses.open_apertures(drt_jax.load_lens("double_gauss"))
    problem = design.problem_of(config, start)
    return config, problem, design.starts_of(problem.variables, config.starts)[0]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Plane:
    """In place of a problem and its variables: the nearest point to (2, 3), to a scale of 0.01;
    y at most 1 by a bound, x at most 1.5 by a limit. It is (1.5, 1), at distances 0.5
    and 2; x above 10 is broken."""

    low: jax.Array
    high: jax.Array
    solver: object = dataclasses.field(metadata={"static": True}, default=None)

    @property
    def variables(self):
        return self

    def lens_of(self, vector):
        return vector

    def evaluate(self, vector):
        miss = 0.01 * (vector - jnp.asarray([2.0, 3.0]))
        broken = jnp.where(vector[0] > 10, jnp.inf, 0.0)
        return lenses.Evaluation(miss, vector[:1] - 1.5, broken, jnp.int32(0))

    def limits(self, excess):
        return []


PLANE = Plane(jnp.asarray([-jnp.inf, -jnp.inf]), jnp.asarray([jnp.inf, 1.0]))
NEAREST = 1e-4 * (0.5**2 + 2**2)
TASK = _optimisers.Task(
    settings("singlet", "trials=60"), Beside(("adam",), steps=1500, rate=0.01), PLANE, PLANE, 0.0
)


@pytest.mark.parametrize("name, close", [("ours", 1e-9), ("optimistix", 1e-4), ("adam", 1e-3)])
def test_optimisers_keep_limits_and_bounds(name, close):
    """Where what exceeds them counts as much as the rest, x is at 1.5 and 0.5e-4 more."""
    way = _optimisers.PEERS[name](TASK, jnp.zeros(2))
    merit, worst = _optimisers.judged(PLANE, way.vector)
    assert merit == pytest.approx(NEAREST, close) and worst == pytest.approx(0, abs=1e-3)
    assert way.merits[0] == pytest.approx(13e-4) and way.merits[-1] == pytest.approx(merit, 1e-3)
    assert way.jacobians[0] == 1 and np.all(np.diff(way.jacobians) >= 0)
    assert way.seconds > 0 and way.compile_s > 0


def test_a_record_tells_when_the_target_was_met(monkeypatch):
    way = _optimisers.Way(
        jnp.asarray([1.5, 1.0]), NEAREST * np.array([9, 1, 1, 1]), [1, 2, 2, 3], 3.0
    )
    monkeypatch.setitem(_optimisers.PEERS, "ours", lambda task, vector: way)
    targets = (TASK._replace(target=part * NEAREST) for part in (1.01, 0.99))
    there, never = (_optimisers.one("ours", task, jnp.zeros(2)) for task in targets)
    assert there["met"] and there["merit"] == pytest.approx(NEAREST)
    assert (there["met_jacobians"], there["met_s"], there["jacobians"]) == (2, 1.0, 3)
    assert not never["met"] and never["met_jacobians"] is None and never["met_s"] is None


@pytest.mark.parametrize("name", ["ours", "optimistix"])
def test_the_first_trial_is_the_start(name):
    config = dataclasses.replace(TASK.config, trials=1)
    way = _optimisers.PEERS[name](TASK._replace(config=config), jnp.ones(2))
    assert len(way.merits) == 1 and np.array_equal(way.vector, [1, 1])


def test_a_limit_that_is_exceeded_is_no_success():
    """(2, 1) is nearer than any point within."""

    def beyond(task, vector):
        return _optimisers.Way(jnp.asarray([2.0, 1.0]), np.zeros(0), np.zeros(0), 1.0)

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(_optimisers.PEERS, "ours", beyond)
        found = _optimisers.one("ours", TASK._replace(target=1.01 * NEAREST), jnp.zeros(2))
    assert found["merit"] == pytest.approx(4e-4) and found["worst"] == pytest.approx(0.5)
    assert found["merit"] < NEAREST and not found["met"]


def test_a_lens_that_is_no_number_is_null(monkeypatch):
    way = _optimisers.Way(jnp.asarray([np.nan, 1.0]), np.full(2, np.nan), np.arange(2), 1.0)
    monkeypatch.setitem(_optimisers.PEERS, "ours", lambda task, vector: way)
    found = _optimisers.one("ours", TASK, jnp.zeros(2))
    assert found["merit"] is None and found["worst"] is None and not found["met"]


def test_a_broken_lens_is_null_and_no_end_of_the_run():
    """Ours refuses to begin with it; the others go where they like."""
    start = jnp.asarray([20.0, 0.0])
    found = _optimisers.one("ours", TASK._replace(target=1.0), start)
    assert found["merit"] is None and found["worst"] is None and not found["met"]
    assert _optimisers.judged(PLANE, start)[1] == np.inf


def test_what_lies_beyond_the_bounds_is_brought_back():
    assert _optimisers.judged(PLANE, jnp.asarray([1.0, 5.0])) == pytest.approx((5e-4, 0.0))


def test_optiland_is_told_the_problem():
    _, problem, _ = recovery()
    told = _optimisers.told(problem)
    assert set(told.bends) == {0, 1, 2, 4, 6, 8, 9, 10}
    thick = {i: (2.0, 20.0) for i in (0, 2, 3, 6, 7, 9)}
    gaps = {i: pytest.approx((0.3, 20.0)) for i in range(10)} | {10: pytest.approx((20.0, 100.0))}
    assert told.gaps == gaps | {i: pytest.approx(ends) for i, ends in thick.items()}
    glass, air = ([(i, low, math.inf) for i in some] for some, low in _EDGES)
    assert told.edges == glass + air
    lens = problem.variables.lens
    middle = np.array([0.5876])
    focal = float(drt_jax.focal_length(lens, middle)[0])
    pupil = 2 * float(drt_jax.first_order(lens, jnp.inf, middle).entrance_pupil.semi_diameter[0])
    assert (told.focal_length, told.pupil_mm) == pytest.approx((focal, pupil), 1e-12)


# Surfaces and limits; the air that holds the stop is behind the fourth, the last is the sensor's.
_EDGES = (((0, 2, 3, 6, 7, 9), 0.5), ((1, 8, 10), 0.1))


def told_by(name, task, vector):
    """In place of `one`: nothing is computed."""
    if name.startswith("optiland"):
        return None
    found = {"merit": float(vector[0]), "worst": 0.0, "met": float(vector[0]) < 2, "seconds": 0.5}
    return found | {"compile_s": 0.0, "jacobians": 3, "met_jacobians": 2, "met_s": 0.1}


def test_a_row_has_all_starts_and_what_is_missing_is_null(monkeypatch):
    config, peers = settings("singlet"), Beside(("ours", "optiland LeastSquares", "adam"))
    problem = design.problem_of(config, drt_jax.load_lens(CONFIGS / "lenses/singlet_crude.yaml"))
    vectors = np.array([[1.0, -1.0], [2.0, -1.0], [1.5, -1.0]])
    monkeypatch.setattr(_optimisers, "one", told_by)
    row = {"merit_start": 3.0, "merit_end": 2.0}
    rows = _optimisers.beside(config, peers, problem, vectors, 4, row)
    ours, missing, _ = rows
    assert ours["merit"] == [1, 2, 1.5] and (ours["best"], ours["median"]) == (1, 1.5)
    assert ours["met"] == 2 and ours["starts"] == COUNT
    assert missing["met"] is None and missing["best"] is None and missing["seconds"] == []
    assert set(_optimisers.peer(rows).values()) == {None}
    json.dumps(rows, allow_nan=False)


def test_the_goal_is_the_lens_that_was_disturbed(monkeypatch):
    config = settings("singlet", "starts.how=made", "starts.count=2")
    monkeypatch.setattr(_optimisers, "one", lambda name, task, vector: {"target": task.target})
    monkeypatch.setattr(_optimisers, "summary", lambda name, records: records)
    row = {"merit_start": 3.0, "merit_end": 2.0}
    (records,) = _optimisers.beside(config, Beside(("adam",)), PLANE, np.zeros((2, 2)), 4, row)
    assert records == 2 * [{"target": 3.0}]


def test_the_row_has_the_best_of_optilands():
    some = [{"optimiser": n, "best": b, "seconds": s} for n, b, s in _BESTS]
    found = _optimisers.peer(some)
    assert found == {"peer": "optiland", "peer_merit": 2.0, "peer_s": 7.0}


_BESTS = (("ours", 1.0, [1.0]), ("optiland Adam", 3.0, [9.0]), ("optiland", 2.0, [3.0, 4.0]))


@pytest.mark.parametrize(
    "name, changes, peers, said",
    [
        ("recovery", ["variables=[{kind: conic}]"], ["optiland"], "optiland: knows curvatures"),
        ("recovery", ["ties=[{surfaces: [0, 1]}]"], ["optiland"], "optiland: knows curvatures"),
        ("recovery", ["operands=[{kind: rms_spot}]"], ["optiland"], "optiland: knows curvatures"),
        ("recovery", ["floating=false"], ["optiland"], "optiland: knows curvatures"),
        ("recovery", [], ["optiland Adam"], "optiland Adam: knows a singlet"),
        ("recovery", [], ["adam", "adam"], "peers: an item stands twice"),
        ("recovery", [], ["zemax"], "peers: unknown 'zemax'; known: ours"),
        ("singlet", ["rings=4"], ["optiland Adam"], "optiland Adam: knows a singlet"),
    ],
)
def test_what_cannot_be_told_is_refused(name, changes, peers, said):
    with pytest.raises(ValueError, match=said):
        require_told(settings(name, *changes), Beside(tuple(peers)).peers)


def test_results_without_them_have_no_table_of_them():
    results = json.loads((ROOT / "results/design/recovery/results.json").read_text())
    results.pop("beside", None)
    name = "design, recovery: beside"
    assert name not in design.tables(results)
    rows = [_optimisers.summary("adam", [told_by("adam", TASK, jnp.ones(2))])]
    assert "no worse than the lens" in design.tables(results | {"beside": rows})[name]


@needed
def test_optiland_keeps_bounds_limits_and_focal_length():
    """From the same start, within seconds: nearly all of what there is to be gained."""
    config, problem, vector = recovery()
    start = jnp.asarray(vector)
    before, _ = _optimisers.judged(problem, start)
    task = _optimisers.Task(config, Beside(("optiland",), seconds=4), problem, problem, 1.8e-4)
    found = _optimisers.one("optiland", task, start)
    assert before > 2e-3 > 1.8e-4 > found["merit"] and found["met"] and found["worst"] < 1e-3
    assert found["met_jacobians"] <= found["jacobians"] and 2 < found["seconds"] < 60


@needed
def test_an_optimiser_of_radii_is_judged_by_our_rays():
    config = settings("singlet")
    problem = design.problem_of(config, drt_jax.load_lens(CONFIGS / "lenses/singlet_crude.yaml"))
    task = _optimisers.Task(config, Beside(("optiland",), seconds=4), problem, problem, 0.0018)
    found = _optimisers.one("optiland OptimizerGeneric 1/R", task, problem.variables.start)
    assert found["merit"] == pytest.approx(0.00172898452577, 1e-6) and found["met"]
