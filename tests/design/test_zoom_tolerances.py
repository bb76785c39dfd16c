"""Tolerances of a zoom, compared with lenses that are changed and refocused by hand in each
position."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from drt_jax import Scene, design, load_lens
from drt_jax.design import (
    Assembly,
    Configurations,
    Operand,
    PerturbedLens,
    Problem,
    Tolerance,
    Variables,
    configured,
)

# Two plano-convex lenses; the second and the sensor move.
ZOOM = {
    "surfaces": [
        {"radius": 60.0, "thickness": 3.0, "nd": 1.5, "vd": 60.0},
        {"radius": "inf", "thickness": 10.0},
        {"radius": 50.0, "thickness": 2.0, "nd": 1.6, "vd": 50.0, "semi_diameter": 4, "stop": True},
        {"radius": "inf"},
    ],
    "sensor": 60.0,
}
ERRORS = [
    Tolerance("radius", 1.0, (0,)),
    Tolerance("thickness", 0.2, (1,), own=True),
    Tolerance("decentre", 0.1, (1,)),
]
WEIGHTS = np.array([0.5, 1.5]) / 2


@functools.cache
def zoom():
    """The zoom, the problems of each position and of both, and the lens with its errors."""
    lenses = configured(load_lens(ZOOM), {"thickness 1": (10.0, 30.0), "sensor": (45.4, 41.5)})
    problems = [
        Problem.from_variables(
            Variables.from_lens(lens, ["sensor"]),
            ["spot"],
            Scene.degrees([[0, 0], [0, angle], [0, -angle]], np.inf, 0.55),
            3,
        )
        for lens, angle in zip(lenses, (4, 3))
    ]
    # errors move elements, which breaks the symmetry of the pupil
    problems = [
        dataclasses.replace(p, rule=dataclasses.replace(p.rule, symmetry="none")) for p in problems
    ]
    both = Configurations.from_problems(problems, ["sensor"], [1, 3])
    assert len(both.groups) == 1
    radius = both.beam_radius(lenses)
    return problems, both, PerturbedLens.from_lens(lenses, radius, ERRORS)


_traced = jax.jit(lambda problem, lens: design.as_built(problem, lens, "none").squares)


def squares(number, error=(0, 0, 0, 0, 0), sensor=0.0, gap=0.0):
    """Mean square of the spots of one position, changed by hand: the radius of surface 0 in per
    cent, the gap of each position, the shift along x and y of the second lens, mm."""
    problems, _, some = zoom()
    lens = some.lenses[number]
    curvature = lens.curvature.at[0].set(1 / (60 * (1 + error[0] / 100)))
    change = error[1 + number] + gap
    thickness = lens.thickness.at[1].add(change)
    shift = jnp.array([*error[3:], 0.0])
    elements = dataclasses.replace(lens.elements, shift=lens.elements.shift.at[1].set(shift))
    changed = {"curvature": curvature, "thickness": thickness, "elements": elements}
    moved = dataclasses.replace(lens, **changed, sensor=lens.sensor + change + sensor)
    return float(jnp.mean(_traced(problems[number], moved)))


def focused(error):
    """Each position at its own best focus: squares and positions of the sensor."""
    spots = [lambda m, k=k: 1e3 * squares(k, error, m) for k in (0, 1)]
    found = [optimize.minimize_scalar(spot, bracket=(-0.5, 0.5), tol=1e-8) for spot in spots]
    return np.array([one.fun for one in found]) / 1e3, [one.x for one in found]


def focused_once(error):
    """Both positions with one common best focus."""
    mean = lambda m: 1e3 * sum(w * squares(k, error, m) for k, w in enumerate(WEIGHTS))  # noqa: E731
    found = optimize.minimize_scalar(mean, bracket=(-0.5, 0.5), tol=1e-8)
    return np.array([squares(k, error, found.x) for k in (0, 1)]), [found.x]


SIZES = np.array([1.0, 0.2, 0.2, 0.1, 0.1])


def test_errors_are_common_or_of_one_configuration():
    _, _, some = zoom()
    assert [str(one) for one in some.deviations] == [
        "radius of surface 0",
        "thickness of surface 1 of configuration 1",
        "thickness of surface 1 of configuration 2",
        "decentre of element 1, x",
        "decentre of element 1, y",
    ]
    assert [len(part) for part in some.parts] == [1, 1, 1, 2]
    one, two = some.lenses_of(jnp.array([1.0, 0.5, -1.0, 0.0, 1.0]))
    np.testing.assert_allclose([one.thickness[1], two.thickness[1]], [10.1, 29.8])
    np.testing.assert_allclose([one.curvature[0], two.curvature[0]], 1 / 60.6)
    np.testing.assert_array_equal(one.elements.shift, two.elements.shift)
    # With one configuration, shared and separate errors are the same.
    alone = PerturbedLens.from_lens(some.lens, some.beam_radius, ERRORS)
    assert str(alone.deviations[1]) == "thickness of surface 1"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("compensator", "by_hand"), [("focus", focused), ("common focus", focused_once)]
)
def test_each_row_is_the_zoom_disturbed_by_hand(compensator, by_hand):
    _, both, some = zoom()
    table = design.sensitivity(both, some, compensator)
    nominal, best = by_hand(np.zeros(5))
    spot = lambda each: (WEIGHTS @ each) ** 0.5  # noqa: E731
    assert table.nominal == pytest.approx(spot(nominal), rel=1e-9)
    for k, size in enumerate(SIZES):
        for side, sign in enumerate((-1, 1)):
            error = sign * size * np.eye(5)[k]
            each, moves = by_hand(error)
            changes = np.sqrt(each) - np.sqrt(nominal)
            np.testing.assert_allclose(table.each[k, side], changes, atol=2e-8)  # by the scan
            assert table.after[k, side] == pytest.approx(spot(each) - spot(nominal), abs=1e-9)
            shift = np.subtract(moves, best)
            np.testing.assert_allclose(table.moves[k, side], shift, atol=1e-5)
            held = [squares(c, error, move) for c, move in enumerate(np.broadcast_to(best, 2))]
            before = spot(np.array(held)) - spot(nominal)
            assert table.before[k, side] == pytest.approx(before, abs=1e-9)
    rows = table.rows()
    assert rows[0][6:8] == ["in configuration 1 (um)", "in configuration 2 (um)"]
    names = {
        "focus": ["sensor of configuration 1 (mm)", "sensor of configuration 2 (mm)"],
        "common focus": ["sensor (mm)"],
    }
    assert rows[0][8:] == names[compensator] and len(rows) == 6
    # An error of one position alone does not change another position that has its own focus.
    if compensator == "focus":
        np.testing.assert_allclose(table.each[1, :, 1], 0, atol=1e-15)
        assert abs(table.each[1, 0, 0]) > 1e-5


@pytest.mark.slow
def test_shared_and_own_adjustments_are_where_a_search_ends():
    """One sensor position for both, and a gap for each position, within limits."""
    _, both, some = zoom()
    kinds = [Tolerance("sensor", 2.0), Tolerance("thickness", 0.15, (1,), own=True)]
    off = np.array([[0.9, 0.2, -0.4, 0.1, -0.3], [-0.5, -1.0, 0.2, 0.6, 0.5]])
    found = design.monte_carlo(both, some, off, kinds)
    free = 0
    for k, row in enumerate(off):
        mean = lambda m, row=row: (  # noqa: E731
            1e6 * sum(w * squares(c, row * SIZES, m[0], m[1 + c]) for c, w in enumerate(WEIGHTS))
        )
        bounds = [(-2, 2), (-0.15, 0.15), (-0.15, 0.15)]
        best = optimize.minimize(mean, np.zeros(3), method="L-BFGS-B", bounds=bounds)
        value = 1e6 * found.value[k] ** 2
        assert best.fun * (1 - 1e-4) < value < best.fun * (1 + 1e-5)
        np.testing.assert_allclose(found.moves[k], best.x, atol=5e-3)
        free += np.sum(np.abs(found.moves[k, 1:]) < 0.149)
    assert free < 4  # the others are at their limits
    np.testing.assert_allclose(found.value, np.sqrt(found.each**2 @ WEIGHTS), rtol=1e-12)


@pytest.mark.slow
def test_second_derivatives_are_those_of_lenses():
    _, both, some = zoom()
    small = dataclasses.replace(some, sizes=0.1 * some.sizes)
    for compensator in ("common focus", [Tolerance("sensor", 2.0)]):
        predicted = design.predict(both, small, compensator)
        draws = design.draw_perturbations(small, 12, seed=1)
        traced = np.asarray(design.monte_carlo(both, small, draws, "common focus").value) ** 2
        first, second = (
            np.max(np.abs(predicted.at(draws, order) - traced)) for order in ("first", "second")
        )
        assert second < 0.03 * first and first > 1e-8
    table = design.sensitivity(both, small, compensator, predicted)
    assert table.each is None and table.adjustments == (("sensor", "mm"),)


@pytest.mark.slow
def test_all_positions_have_to_be_good():
    """Lenses one by one compared with all together; and a criterion that is not a mean square."""
    problems, both, some = zoom()
    draws = design.draw_perturbations(some, 6, seed=0)
    sharp = Assembly("focus", Operand("mtf", target=1, at=20.0))
    built = design.monte_carlo(both, some, draws, sharp)
    for number, (problem, lens) in enumerate(zip(problems, some.lenses)):
        drawn = draws[:, [0, 1 + number, 3, 4]]
        alone = PerturbedLens.from_lens(lens, some.beam_radius, ERRORS)
        one = design.monte_carlo(problem, alone, drawn, sharp)
        np.testing.assert_allclose(built.each[:, number], one.value, rtol=1e-9)
        np.testing.assert_allclose(built.moves[:, number], one.moves[:, 0], atol=1e-9)
    np.testing.assert_allclose(built.value, built.each @ WEIGHTS, rtol=1e-12)
    level = float(np.median(np.min(built.each, axis=1)))
    share = np.mean(np.all(built.each >= level, axis=1))
    np.testing.assert_allclose(design.yields(built.each, [level, 0.0], sharp), [share, 1])


def test_what_does_not_fit_is_refused():
    problems, both, some = zoom()
    zero = np.zeros((1, 5))
    with pytest.raises(ValueError, match="problem: has 1 configurations, the lens 2"):
        design.monte_carlo(problems[0], some, zero, "focus")
    alone = PerturbedLens.from_lens(some.lens, some.beam_radius, ERRORS)
    with pytest.raises(ValueError, match="problem: has 2 configurations, the lens 1"):
        design.predict(both, alone, "focus")
    other = load_lens("singlet")
    with pytest.raises(ValueError, match="lens: configuration 2 differs from 1"):
        PerturbedLens.from_lens([some.lens, other], some.beam_radius, ERRORS)
