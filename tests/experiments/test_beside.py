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
from experiments import _beside, _command, _wanted, design
from experiments.runs.config import load_config
from experiments.runs.folder import Run

ROOT = pathlib.Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs" / "design"
COUNT = 3
needed = pytest.mark.skipif(
    importlib.util.find_spec("optiland") is None, reason="optiland is not installed"
)


def settings(name, *changes):
    return load_config(_wanted.Config, CONFIGS / f"{name}.yaml", changes)


def recovery():
    """The problem of the recovery, and a lens that is off by more than the rounding of its file."""
    config = settings("recovery", "beside.seconds=4")
    start = drt_jax.load_lens("double_gauss")
    free = jnp.full_like(start.semi_diameter, jnp.inf)
    semi = free.at[start.stop].set(start.semi_diameter[start.stop])
    problem = design.problem_of(config, dataclasses.replace(start, semi_diameter=semi))
    return config, problem, design.made_vectors(problem.variables, config.starts)[0]


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

    def judge(self, vector):
        miss = 0.01 * (vector - jnp.asarray([2.0, 3.0]))
        broken = jnp.where(vector[0] > 10, jnp.inf, 0.0)
        return lenses.Judged(miss, vector[:1] - 1.5, broken, jnp.int32(0))

    def limits(self, excess):
        return []


PLANE = Plane(jnp.asarray([-jnp.inf, -jnp.inf]), jnp.asarray([jnp.inf, 1.0]))
NEAREST = 1e-4 * (0.5**2 + 2**2)
TASK = _beside.Task(
    settings("singlet", "trials=60", "beside.steps=1500", "beside.rate=0.01"), PLANE, PLANE, 0.0
)


@pytest.mark.parametrize("name, close", [("ours", 1e-9), ("optimistix", 1e-4), ("adam", 1e-3)])
def test_optimisers_keep_limits_and_bounds(name, close):
    """Where what exceeds them counts as much as the rest, x is at 1.5 and 0.5e-4 more."""
    way = _beside.PEERS[name](TASK, jnp.zeros(2))
    merit, worst = _beside.judged(PLANE, way.vector)
    assert merit == pytest.approx(NEAREST, close) and worst == pytest.approx(0, abs=1e-3)
    assert way.merits[0] == pytest.approx(13e-4) and way.merits[-1] == pytest.approx(merit, 1e-3)
    assert way.jacobians[0] == 1 and np.all(np.diff(way.jacobians) >= 0)
    assert way.seconds > 0 and way.compile_s > 0


def test_a_record_tells_when_the_target_was_met(monkeypatch):
    way = _beside.Way(jnp.asarray([1.5, 1.0]), NEAREST * np.array([9, 1, 1, 1]), [1, 2, 2, 3], 3.0)
    monkeypatch.setitem(_beside.PEERS, "ours", lambda task, vector: way)
    targets = (TASK._replace(target=part * NEAREST) for part in (1.01, 0.99))
    there, never = (_beside.one("ours", task, jnp.zeros(2)) for task in targets)
    assert there["met"] and there["merit"] == pytest.approx(NEAREST)
    assert (there["met_jacobians"], there["met_s"], there["jacobians"]) == (2, 1.0, 3)
    assert not never["met"] and never["met_jacobians"] is None and never["met_s"] is None


@pytest.mark.parametrize("name", ["ours", "optimistix"])
def test_the_first_trial_is_the_start(name):
    config = dataclasses.replace(TASK.config, trials=1)
    way = _beside.PEERS[name](TASK._replace(config=config), jnp.ones(2))
    assert len(way.merits) == 1 and np.array_equal(way.vector, [1, 1])


def test_a_limit_that_is_exceeded_is_no_success():
    """(2, 1) is nearer than any point within."""

    def beyond(task, vector):
        return _beside.Way(jnp.asarray([2.0, 1.0]), np.zeros(0), np.zeros(0), 1.0)

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(_beside.PEERS, "ours", beyond)
        found = _beside.one("ours", TASK._replace(target=1.01 * NEAREST), jnp.zeros(2))
    assert found["merit"] == pytest.approx(4e-4) and found["worst"] == pytest.approx(0.5)
    assert found["merit"] < NEAREST and not found["met"]


def test_a_lens_that_is_no_number_is_null(monkeypatch):
    way = _beside.Way(jnp.asarray([np.nan, 1.0]), np.full(2, np.nan), np.arange(2), 1.0)
    monkeypatch.setitem(_beside.PEERS, "ours", lambda task, vector: way)
    found = _beside.one("ours", TASK, jnp.zeros(2))
    assert found["merit"] is None and found["worst"] is None and not found["met"]


def test_a_broken_lens_is_null_and_no_end_of_the_run():
    """Ours refuses to begin with it; the others go where they like."""
    start = jnp.asarray([20.0, 0.0])
    found = _beside.one("ours", TASK._replace(target=1.0), start)
    assert found["merit"] is None and found["worst"] is None and not found["met"]
    assert _beside.judged(PLANE, start)[1] == np.inf


def test_what_lies_beyond_the_bounds_is_brought_back():
    assert _beside.judged(PLANE, jnp.asarray([1.0, 5.0])) == pytest.approx((5e-4, 0.0))


def test_optiland_is_told_the_problem():
    _, problem, _ = recovery()
    told = _beside.told(problem)
    assert set(told.bends) == {0, 1, 2, 4, 6, 8, 9, 10}
    thick = {i: (2.0, 20.0) for i in (0, 2, 3, 6, 7, 9)}
    gaps = {i: pytest.approx((0.3, 20.0)) for i in range(10)} | {10: pytest.approx((20.0, 100.0))}
    assert told.gaps == gaps | {i: pytest.approx(ends) for i, ends in thick.items()}
    glass, air = ([(i, low, math.inf) for i in some] for some, low in _EDGES)
    assert told.edges == glass + air
    lens = problem.variables.lens
    middle = np.array([0.5876])
    focal = float(drt_jax.focal_length(lens, middle)[0])
    pupil = 2 * float(drt_jax.entrance_pupil(lens, middle).semi_diameter[0])
    assert (told.focal_length, told.pupil_mm) == pytest.approx((focal, pupil), 1e-12)


# Surfaces and limits; the air that holds the stop is behind the fourth, the last is the sensor's.
_EDGES = (((0, 2, 3, 6, 7, 9), 0.5), ((1, 8, 10), 0.1))


def told_by(name, task, vector):
    """In place of `one`: nothing is computed."""
    if name.startswith("optiland"):
        return None
    found = {"merit": float(vector[0]), "worst": 0.0, "met": float(vector[0]) < 2, "seconds": 0.5}
    return found | {"compile_s": 0.0, "jacobians": 3, "met_jacobians": 2, "met_s": 0.1}


def test_starts_are_done_once_and_what_is_missing_is_null(tmp_path, monkeypatch):
    config = settings("singlet", "beside.peers=[ours, optiland LeastSquares, adam]")
    problem = design.problem_of(config, drt_jax.load_lens(CONFIGS / "lenses/singlet_crude.yaml"))
    vectors = np.array([[1.0, -1.0], [2.0, -1.0], [1.5, -1.0]])
    end, done = {"order": 4, "merit_start": 3.0, "merit_end": 2.0}, []

    def one(name, task, vector):
        assert task.target == pytest.approx(2.02)
        if len(done) == killed:
            raise KeyboardInterrupt
        done.append(f"{name} {float(vector[0])}")
        return told_by(name, task, vector)

    monkeypatch.setattr(_beside, "one", one)
    killed = 2
    with Run(tmp_path / "run", config, (), False) as run, pytest.raises(KeyboardInterrupt):
        _beside.beside(config, problem, vectors, end, run)
    killed = -1
    with Run(tmp_path / "run", config, (), True) as run:
        rows = _beside.beside(config, problem, vectors, end, run)
    assert done[:3] == ["ours 1.0", "ours 2.0", "ours 1.5"] and len(done) == 3 * COUNT
    ours, missing, _ = rows
    assert ours["merit"] == [1, 2, 1.5] and (ours["best"], ours["median"]) == (1, 1.5)
    assert ours["met"] == 2 and ours["starts"] == COUNT
    assert missing["met"] is None and missing["best"] is None and missing["seconds"] == []
    assert set(_beside.peer(rows).values()) == {None}
    said = _beside.table(rows, "around")
    assert "not installed" in said and "2 of 3" in said and "within 1% of the design" in said
    json.dumps(rows, allow_nan=False)


def test_the_goal_is_the_lens_that_was_disturbed(tmp_path, monkeypatch):
    config = settings("singlet", "beside.peers=[adam]", "starts.how=made", "starts.count=2")
    monkeypatch.setattr(_beside, "one", lambda name, task, vector: {"target": task.target})
    monkeypatch.setattr(_beside, "summary", lambda name, records: records)
    end = {"order": 4, "merit_start": 3.0, "merit_end": 2.0}
    with Run(tmp_path / "run", config, (), False) as run:
        (records,) = _beside.beside(config, PLANE, np.zeros((2, 2)), end, run)
    assert records == 2 * [{"target": 3.0}]


def test_the_row_has_the_best_of_optilands():
    some = [{"optimiser": n, "best": b, "seconds": s} for n, b, s in _BESTS]
    found = _beside.peer(some)
    assert found == {"peer": "optiland", "peer_merit": 2.0, "peer_s": 7.0}


_BESTS = (("ours", 1.0, [1.0]), ("optiland Adam", 3.0, [9.0]), ("optiland", 2.0, [3.0, 4.0]))


@pytest.mark.parametrize(
    "name, changes, said",
    [
        ("recovery", ["variables=[{kind: conic}]"], "beside.peers: optiland: knows curvatures"),
        ("recovery", ["ties=[{surfaces: [0, 1]}]"], "beside.peers: optiland: knows curvatures"),
        ("recovery", ["operands=[{kind: rms_spot}]"], "beside.peers: optiland: knows curvatures"),
        ("recovery", ["floating=false"], "beside.peers: optiland: knows curvatures"),
        ("recovery", ["beside.peers=[optiland Adam]"], "optiland Adam: knows a singlet"),
        ("recovery", ["beside.peers=[adam, adam]"], "beside.peers: an item stands twice"),
        ("recovery", ["beside.peers=[zemax]"], "beside.peers: unknown 'zemax'; known: ours"),
        ("recovery", ["beside.seconds=0"], "beside.seconds: expected 0.001 to 100000, got 0"),
        ("singlet", ["rings=4"], "beside.peers: optiland OptimizerGeneric: knows a singlet"),
    ],
)
def test_what_cannot_be_told_is_refused(name, changes, said):
    with pytest.raises(ValueError) as caught:
        settings(name, *changes)
    assert said in str(caught.value)


@pytest.mark.slow
def test_a_run_has_them_in_its_rows(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    changes = ["beside.peers=[ours, optiland Adam]", "trials=40"]
    argv = ["--config", "configs/design/singlet.yaml", "--out", str(tmp_path / "run"), "--set"]
    _command.main(design, [*argv, *changes])
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    (row,), (ours, missing) = results["rows"], results["beside"]
    assert row["peer"] is None and row["peer_merit"] is None and row["peer_s"] is None
    assert row["peer_spots_um"] is None and missing["best"] is None
    assert ours["best"] == pytest.approx(0.00172898452577, 1e-6) and ours["met"] == 1
    assert "optiland Adam | not installed" in capsys.readouterr().out


def test_results_without_them_have_no_table_of_them():
    results = json.loads((ROOT / "results/design/recovery/results.json").read_text())
    results.pop("beside", None)
    name = "design, recovery: beside"
    assert name not in design.tables(results)
    rows = [_beside.summary("adam", [told_by("adam", TASK, jnp.ones(2))])]
    assert "no worse than the lens" in design.tables(results | {"beside": rows})[name]


@needed
def test_optiland_keeps_bounds_limits_and_focal_length():
    """From the same start, within seconds: nearly all of what there is to be gained."""
    config, problem, vector = recovery()
    start = jnp.asarray(vector)
    before, _ = _beside.judged(problem, start)
    task = _beside.Task(config, problem, problem, 1.8e-4)
    found = _beside.one("optiland", task, start)
    assert before > 2e-3 > 1.8e-4 > found["merit"] and found["met"] and found["worst"] < 1e-3
    assert found["met_jacobians"] <= found["jacobians"] and 2 < found["seconds"] < 60


@needed
def test_an_optimiser_of_radii_is_judged_by_our_rays():
    config = settings("singlet")
    problem = design.problem_of(config, drt_jax.load_lens(CONFIGS / "lenses/singlet_crude.yaml"))
    task = _beside.Task(config, problem, problem, 0.0018)
    found = _beside.one("optiland OptimizerGeneric 1/R", task, problem.variables.start)
    assert found["merit"] == pytest.approx(0.00172898452577, 1e-6) and found["met"]
