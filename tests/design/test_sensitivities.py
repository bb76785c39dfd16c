"""Sensitivity tables, compensators, criteria and grades, compared with lenses that are changed by
hand."""

import csv
import dataclasses
import functools
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import drt_jax
from drt_jax import Scene, design
from drt_jax.design import Assembly, Operand, PerturbedLens, Problem, Tolerance, Variables
from drt_jax.design.grades import GradeName
from drt_jax.design.perturbed import Deviation

SINGLET = drt_jax.load_lens("singlet")
FIELDS = np.radians([[0, 0], [0, 3], [0, -3]])
ERRORS = [Tolerance("thickness", 0.3, (1,)), Tolerance("decentre", 0.4)]
BOTH = [Tolerance("sensor", 3.0), Tolerance("thickness", 0.5, (0,))]


@pytest.fixture(scope="module")
def singlet():
    """A singlet with errors of a thickness and a decentre, and the problem that evaluates it."""
    some = PerturbedLens.from_lens(SINGLET, jnp.array([5.0, 6.0, 6.0]), ERRORS)
    variables = Variables.from_lens(some.lens, ["sensor"])
    scene = Scene.radians(FIELDS, np.inf, [0.5875618])
    return Problem.from_variables(variables, ["spot"], scene, 3), some


_traced = jax.jit(lambda problem, lens: design.as_built(problem, lens, "none").squares)


def spot_of(problem, some, error, sensor=0.0, gap=0.0):
    """The spot of the lens, changed by hand: errors of the thickness and of the decentre along x
    and y, mm."""
    lens, group = some.lens, some.groups[0]
    thickness = lens.thickness.at[1].add(error[0]).at[0].add(gap)
    # The sensor keeps its distance from the last vertex.
    behind = lens.sensor - jnp.sum(lens.thickness) + jnp.sum(thickness) + sensor
    shift = lens.elements.shift.at[group, :2].add(jnp.array(error[1:]))
    elements = dataclasses.replace(lens.elements, shift=shift)
    changed = {"thickness": thickness, "sensor": behind, "elements": elements}
    return float(jnp.sqrt(jnp.mean(_traced(problem, dataclasses.replace(lens, **changed)))))


def focused(problem, some, error):
    """The smallest spot by a scan of the sensor, and the position of the sensor."""
    spot = lambda move: spot_of(problem, some, error, move)  # noqa: E731
    best = optimize.minimize_scalar(spot, bracket=(-0.5, 0.5), tol=1e-8)
    return best.fun, best.x


@pytest.fixture(scope="module")
def table(singlet):
    return design.sensitivity(*singlet)


@pytest.mark.slow
def test_each_row_is_a_lens_disturbed_by_hand(singlet, table):
    nominal, best = focused(*singlet, [0.0, 0.0, 0.0])
    assert table.nominal == pytest.approx(nominal, rel=1e-9)
    for k, size in enumerate([0.3, 0.4, 0.4]):
        for side, sign in enumerate((-1, 1)):
            error = sign * size * np.eye(3)[k]
            spot, move = focused(*singlet, error)
            assert table.after[k, side] == pytest.approx(spot - nominal, abs=1e-9)
            assert table.moves[k, side, 0] == pytest.approx(move - best, abs=1e-5)
            before = spot_of(*singlet, error, best) - nominal
            assert table.before[k, side] == pytest.approx(before, abs=1e-9)
    assert str(table).splitlines()[0].startswith(f"spot: {1e3 * nominal:.4g} um without errors")


@pytest.mark.slow
def test_a_table_of_derivatives_is_that_of_rays_for_small_errors(singlet):
    problem, some = singlet
    small = dataclasses.replace(some, sizes=0.03 * some.sizes)
    traced = design.sensitivity(problem, small, BOTH)
    predicted = design.predict(problem, small, BOTH)
    foretold = design.sensitivity(problem, small, BOTH, predicted)
    for name in ("before", "after", "moves"):
        a, b = getattr(traced, name), getattr(foretold, name)
        np.testing.assert_allclose(b, a, atol=0.02 * np.max(np.abs(a)))
    assert traced.by == "rays" and foretold.by == "second derivatives"


@pytest.mark.slow
def test_compensators_are_where_a_search_within_their_limits_ends(singlet):
    problem, some = singlet
    off = np.array([[0.8, 0.3, -0.5], [-1.0, 0.2, 0.9]])
    found = design.monte_carlo(problem, some, off, BOTH)
    sizes = np.array([0.3, 0.4, 0.4])
    for k, row in enumerate(off):
        spot = lambda m: 1e3 * spot_of(problem, some, row * sizes, *m)  # noqa: E731
        bounds = [(-3, 3), (-0.5, 0.5)]
        best = optimize.minimize(spot, [0.0, 0.0], bounds=bounds, method="Powell", tol=1e-9)
        assert best.fun * (1 - 1e-5) < 1e3 * found.value[k] < best.fun * (1 + 1e-9)
        np.testing.assert_allclose(found.moves[k], best.x, atol=2e-3)
    assert np.max(np.abs(found.moves[:, 1])) == pytest.approx(0.5)  # at its limit
    # Steps with rays for the sensor alone agree with the focus of one trace.
    stepped = design.monte_carlo(problem, some, off, BOTH[:1])
    usual = design.monte_carlo(problem, some, off, "focus")
    np.testing.assert_allclose(stepped.value, usual.value, rtol=1e-9)
    np.testing.assert_allclose(stepped.moves, usual.moves, atol=1e-6)


def height(lens, rays):
    """Height of the chief ray on the axis, as a user writes an operand."""
    return rays.sensor_hits[-1][:1, 0, 0]


@pytest.mark.slow
def test_any_operand_is_a_criterion(singlet):
    problem, some = singlet
    boresight = Assembly("none", Operand("centroid", fields=(0,)))
    off = np.eye(3)
    found = design.monte_carlo(problem, some, off, boresight).value
    # A thin lens that is shifted moves the image of a far point by the same amount.
    np.testing.assert_allclose(found, [0, 0, 0.4], atol=0.03)
    own = design.monte_carlo(problem, some, off, Assembly("none", height)).value
    np.testing.assert_allclose(own, found, atol=0.01)
    waves = Assembly("focus", "path_difference")
    built = design.monte_carlo(problem, some, off[:1], waves)
    lens = some.lens_of(jnp.asarray(off[0]))
    lens = dataclasses.replace(lens, sensor=lens.sensor + built.moves[0, 0])
    rays = design.trace_fields(problem, lens)
    each = Operand("rms_wavefront").values(lens, rays)
    assert float(built.value[0]) == pytest.approx(float(jnp.sqrt(jnp.mean(each**2))), rel=1e-9)


@pytest.mark.slow
def test_transfer_as_criterion_is_that_of_the_refocused_lens(singlet):
    problem, some = singlet
    sharp = Assembly("focus", Operand("mtf", target=1, at=10.0))
    found = design.monte_carlo(problem, some, np.array([[0.0, 1.0, 0.0]]), sharp)
    lens = some.lens_of(jnp.array([0.0, 1.0, 0.0]))
    lens = dataclasses.replace(lens, sensor=lens.sensor + found.moves[0, 0])
    scene = Scene.radians(FIELDS, np.inf, [0.5875618])
    otf = drt_jax.transfer(lens, scene, [10.0], "waves", sampling=problem.rule).otf
    assert found.value[0] == pytest.approx(float(np.mean(np.abs(np.asarray(otf)))), rel=0.01)


@pytest.mark.slow
def test_second_derivatives_of_a_transfer_function():
    """Compiled without any optimisation, this program returned NaN."""
    lens = design.open_apertures(drt_jax.load_lens("cooke_triplet"))
    some = PerturbedLens.from_lens(lens, lens.semi_diameter[:-1], [Tolerance("radius", 0.05)])
    variables = Variables.from_lens(some.lens, ["sensor"])
    problem = Problem.from_variables(variables, ["spot"], Scene.degrees(10, np.inf, [0.5876]))
    sharp = Operand("mtf", target=1, at=30.0)
    predicted = design.predict(problem, some, Assembly([Tolerance("sensor", 1.0)], sharp))
    sensor = some.lens.sensor + predicted.moves[0]
    some = dataclasses.replace(some, lens=dataclasses.replace(some.lens, sensor=sensor))
    rows = np.concatenate([np.zeros((1, 6)), 0.02 * np.eye(6), -0.02 * np.eye(6)])
    values = design.monte_carlo(problem, some, rows, Assembly("none", sharp)).value
    none, plus, minus = np.split(np.asarray(values), [1, 7])
    slope, bend = (plus - minus) / 0.04, (plus + minus - 2 * none) / 4e-4
    held = predicted.before
    np.testing.assert_allclose(held.gradient, slope, atol=1e-3 * np.max(np.abs(slope)))
    diagonal = np.diag(np.asarray(held.hessian))
    np.testing.assert_allclose(diagonal, bend, atol=0.01 * np.max(np.abs(bend)))


@pytest.mark.slow
def test_inverse_sensitivity_keeps_the_drop(singlet):
    problem, some = singlet
    drop = 2e-3
    kept = design.inverse_sensitivity(problem, some, "focus", drop)
    table = design.sensitivity(problem, kept)
    assert np.max(table.growth) == pytest.approx(drop, rel=1e-3)
    assert float(kept.sizes[1]) == float(kept.sizes[2])  # x and y of one decentre
    nominal, _ = focused(*singlet, [0.0, 0.0, 0.0])
    spots = [focused(*singlet, [0.0, *row])[0] for row in float(kept.sizes[1]) * np.eye(2)]
    assert max(spots) - nominal == pytest.approx(drop, rel=1e-3)
    # An error with too little effect gets the largest size.
    little = design.inverse_sensitivity(problem, some, "focus", 1e3, most=2.0)
    np.testing.assert_allclose(little.sizes, 2 * some.sizes)


@pytest.mark.slow
def test_a_lens_that_fails_never_looks_good(singlet):
    problem, some = singlet
    off = np.array([[0.0, 0.0, 0.0], [0.0, 500.0, 0.0]])
    light = Assembly("none", Operand("throughput", target=1))
    found = design.monte_carlo(problem, some, off, light).value
    assert found[0] == pytest.approx(1) and found[1] == -np.inf
    np.testing.assert_allclose(design.yields(found, [0.9, 0.0], light), 0.5)
    assert design.monte_carlo(problem, some, off, "focus").value[1] == np.inf


@pytest.mark.slow
def test_a_lens_that_fails_without_errors_is_refused(singlet):
    problem, some = singlet
    wide = dataclasses.replace(problem, fields=jnp.array([[0.0, 0.0], [0.0, 1.5]]))
    for ask in (design.sensitivity, functools.partial(design.inverse_sensitivity, drop=1e-3)):
        with pytest.raises(ValueError, match="without errors rays of the lens fail"):
            ask(wide, some, compensator="none")


def some_table():
    """A table of two errors."""
    deviations = Deviation("thickness", 1, 0), Deviation("decentre", 0, 1)
    after = np.array([[1e-4, -1e-4], [2e-3, np.inf]])
    arrays = np.array([0.3, 0.4]), after, after, np.array([[[0.1], [-0.2]], [[0.0], [0.0]]])
    pairs = (("sensor", "mm"),)
    return design.Sensitivity("spot", "um", 1e3, 5e-3, 0.0, deviations, *arrays, pairs, "rays")


def test_a_table_is_read_worst_first(tmp_path):
    table = some_table()
    np.testing.assert_allclose(table.growth, [1e-4, np.inf])
    first, heads, worst, other = str(table).splitlines()
    assert first == "spot: 5 um without errors; changes by rays"
    assert heads.split("  ")[0] == "error" and heads.endswith("after + (um)  sensor (mm)")
    assert " ".join(worst.split()) == "decentre of element 0, y 0.4 mm +2 fails +2 fails 0"
    assert other.split()[-3:] == ["+0.1", "-0.1", "0.2"]
    assert len(table.worst(1).sizes) == 1
    table.csv(tmp_path / "table.csv")
    with open(tmp_path / "table.csv", newline="") as file:
        assert [*csv.reader(file)] == table.rows()
    high = table._replace(nominal=0.6, target=1.0, after=np.array([[0.1, -0.1], [0.0, -0.3]]))
    np.testing.assert_allclose(high.growth, [0.1, 0.3])


def test_yields_are_shares_of_lenses():
    values = np.array([3e-3, 1e-3, np.inf, 2e-3])
    np.testing.assert_array_equal(design.yields(values, [1e-3, 2.5e-3, 1.0]), [0.25, 0.5, 0.75])
    sharp = Assembly(criterion=Operand("mtf", target=1, at=30.0))
    values = np.array([0.4, 0.6, -np.inf])
    np.testing.assert_allclose(design.yields(values, [0.5, 0.3], sharp), [1 / 3, 2 / 3])


def test_grades_are_tolerances_of_a_lens():
    lens = drt_jax.load_lens("double_gauss")
    assert get_args(GradeName) == tuple(design.GRADES)
    for name, grade in design.GRADES.items():
        some = {one.kind: one for one in design.graded(lens, name)}
        assert {kind: one.size for kind, one in some.items()} == dict(grade.sizes)
        assert some["thickness"].which == (0, 2, 3, 6, 7, 9)  # of glass, not of air
        assert grade.source
    mirror = design.graded(drt_jax.load_lens("hubble"), "commercial")
    assert [one.kind for one in mirror] == ["radius"]
    with pytest.raises(ValueError, match="^grade: expected one of commercial, precision"):
        design.graded(lens, "best")


@pytest.mark.parametrize(
    "compensator, told",
    [
        ([("sensor", 1.0)], "^compensator: .* common focus, focus and tilt or a list of Tol"),
        ([Tolerance("thickness", 1.0, (7,))], "thickness: no surface 7 can deviate; there are 0"),
        (Assembly("focus", "spots"), "^operands: kind: expected one of spot"),
        (Assembly("focus", Operand("spot", fields=(5,))), "fields: no number 5; there are 0, 1"),
    ],
)
def test_what_cannot_be_assembled_is_refused_by_name(singlet, compensator, told):
    with pytest.raises(ValueError, match=told):
        design.sensitivity(*singlet, compensator)


def test_a_drop_is_above_0(singlet):
    for drop, most, told in ((0.0, 10.0, "^drop: must be above 0"), (1e-3, -1.0, "^most: must be")):
        with pytest.raises(ValueError, match=told):
            design.inverse_sensitivity(*singlet, "focus", drop, most)
