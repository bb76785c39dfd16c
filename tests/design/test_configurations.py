"""Several configurations as one problem, compared with single problems, closed forms and finite
differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Scene, design, first_order, load_lens
from drt_jax.design import Configurations, Operand, Problem, Solve, Tie, Variables, Vary, configured
from drt_jax.design.optimum import take_step
from drt_jax.rays.solve import solve_aimed

GAP, SENSOR = "thickness 3", "sensor"
# Two thin lenses with the powers 1 / 100 and 1 / 60 in air, each with a curved first surface.
PAIR = """
surfaces:
  - {radius: 50.0, thickness: 1.0e-6, nd: 1.5, vd: 60.0, semi_diameter: 0.005, stop: true}
  - {radius: inf, thickness: 20.0, semi_diameter: 0.005}
  - {radius: 30.0, thickness: 1.0e-6, nd: 1.5, vd: 60.0, semi_diameter: 0.005}
  - {radius: inf, thickness: 30.0, semi_diameter: 0.005}
"""


def scene(distance, fields=(0, 14)):
    return Scene.degrees(fields, distance, 0.55)


def triplet(lens, distance=np.inf, weight=1.0, fields=(0, 14)):
    """A problem of the triplet with variables curvatures, two of them tied, and a gap; the sensor
    is solved."""
    variables = Variables.from_lens(
        lens,
        ["curvature", Vary("thickness", (3,), low=1.0, high=9.0)],
        [Tie((0, 5), "opposite")],
        [Solve("paraxial_focus", distance=distance)],
    )
    operands = ["spot", Operand("air_edge", low=0.9, weight=weight), Operand("total_track", 60.0)]
    return Problem.from_variables(variables, operands, scene(distance, fields), 2)


@functools.cache
def problems():
    lenses = configured(load_lens("cooke_triplet"), {GAP: (4.75, 5.25)})
    return triplet(lenses[0]), triplet(lenses[1], 400.0, 2.0)


@functools.cache
def both():
    joined = Configurations.from_problems(problems(), [GAP], [1, 3])
    return joined.with_solver(solve_aimed)


@functools.cache
def evaluated():
    """Vectors at the start and near it, with values and derivatives of both problems."""
    start = both().variables.start
    moves = np.random.default_rng(0).normal(size=start.size)
    y = start + 0.05 * jnp.asarray(moves)

    def values(y):
        found = both().evaluate(y)
        return jnp.concatenate([found.residuals, found.constraints]), found

    @jax.jit
    def all_of(y):
        rows, found = values(y)
        return rows, jax.jacfwd(lambda y: values(y)[0])(y), found

    return y, all_of


@pytest.mark.slow
def test_two_configurations_are_two_problems():
    y, all_of = evaluated()
    _, _, found = all_of(y)
    shared, own = y[:5], y[5:]
    assert both().variables.names == (
        *(f"curvature {k}" for k in range(5)),
        "thickness 3 of configuration 1",
        "thickness 3 of configuration 2",
    )
    residuals, constraints = [], []
    evaluate = jax.jit(lambda problem, y: problem.evaluate(y))
    for k, (problem, weight) in enumerate(zip(problems(), (0.5, 1.5))):
        one = evaluate(problem.with_solver(solve_aimed), jnp.append(shared, own[k]))
        residuals.append(np.sqrt(weight) * one.residuals)
        constraints.append(one.constraints)
    np.testing.assert_allclose(found.residuals, np.concatenate(residuals), rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.constraints, np.concatenate(constraints), rtol=0, atol=1e-13)
    # Only the numbers that differ have an axis of configurations.
    (group,) = both().groups
    assert group.numbers == (0, 1) and len(group.differ) < 6


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    y, all_of = evaluated()
    _, slopes, _ = all_of(y)
    assert float(jnp.max(jnp.abs(slopes))) > 0.1
    for k in range(y.size):
        step = jnp.zeros_like(y).at[k].set(1e-4)
        pairs = [(all_of(y + m * step)[0] - all_of(y - m * step)[0]) / (2 * m) for m in (1, 2)]
        ahead = (4 * pairs[0] - pairs[1]) / 3 / 1e-4
        np.testing.assert_allclose(slopes[:, k], ahead, rtol=1e-6, atol=1e-8)


def test_lenses_share_all_but_their_own():
    y, _ = evaluated()
    first, second = both().lenses(y)
    np.testing.assert_array_equal(first.curvature, second.curvature)
    np.testing.assert_array_equal(first.curvature[5], -first.curvature[0])
    gaps = np.flatnonzero(np.asarray(first.thickness != second.thickness))
    assert gaps.tolist() == [3]
    for lens, problem in zip((first, second), problems()):  # each solve holds in its own scene
        again = problem.variables.solves[0].apply(lens)
        np.testing.assert_allclose(lens.sensor, again.sensor, rtol=1e-13)


def test_a_group_moves_between_two_that_stand():
    """A tie with a gap that has a value for each configuration."""
    made = []
    for lens in configured(load_lens("cooke_triplet"), {"thickness 1": (6.0, 5.0)}):
        tie = Tie((1, 3), "opposite", "thickness", shift=10.5)
        variables = Variables.from_lens(lens, [Vary("thickness", (1,)), "curvature"], [tie])
        made.append(Problem.from_variables(variables, [Operand("effective_focal_length", 50.0)]))
    joined = Configurations.from_problems(made, "thickness 1")
    lenses = joined.lenses(joined.variables.start)
    np.testing.assert_allclose([lens.thickness[1] for lens in lenses], [6, 5], rtol=1e-14)
    np.testing.assert_allclose([lens.thickness[3] for lens in lenses], [4.5, 5.5], rtol=1e-14)


def test_limits_name_their_configuration():
    y, all_of = evaluated()
    _, _, found = all_of(y)
    limits = both().limits(found.constraints)
    assert len(limits) == found.constraints.size
    half = len(limits) // 2
    assert [limit.where.split(",")[0] for limit in limits[half - 1 : half + 1]] == [
        "configuration 1",
        "configuration 2",
    ]
    np.testing.assert_allclose(limits[half].excess * 2.0, found.constraints[half])


def pair(tmp_path, focal_lengths):
    """Two groups, with a configuration for each focal length; both groups move, to keep the
    focus."""
    path = tmp_path / "pair.yaml"
    path.write_text(PAIR)
    count = len(focal_lengths)
    made = []
    for lens, wanted in zip(
        configured(load_lens(path), {"thickness 1": np.linspace(10, 40, count)}), focal_lengths
    ):
        variables = Variables.from_lens(
            lens, [Vary("thickness", (1,))], solves=[Solve("paraxial_focus")]
        )
        operands = [Operand("effective_focal_length", wanted)]
        made.append(Problem.from_variables(variables, operands))
    return made


def test_a_zoom_of_two_groups_is_that_of_the_closed_form(tmp_path):
    """The distance is d = f1 + f2 - f1 f2 / f, and the focus f (1 - d / f1) behind the second
    group."""
    wanted = np.array([40.0, 50.0, 60.0])
    zoom = Configurations.from_problems(pair(tmp_path, wanted), ["thickness 1"])
    found = design.optimise(zoom)
    assert found.merit < 1e-18
    gaps = 160 - 6000 / wanted
    for lens, gap, focus in zip(zoom.lenses(jnp.asarray(found.vector)), gaps, wanted):
        np.testing.assert_allclose(lens.thickness[1], gap, atol=1e-4)
        back = lens.sensor - jnp.sum(lens.thickness)
        np.testing.assert_allclose(back, focus * (1 - gap / 100), atol=1e-4)
    count = take_step.program()._cache_size()
    again = Configurations.from_problems(pair(tmp_path, wanted + 3), ["thickness"])
    assert design.optimise(again).merit < 1e-18 and take_step.program()._cache_size() == count


@pytest.mark.slow
def test_a_lens_that_focuses_is_designed():
    """At infinity and at 400 mm the designed lens is better than the start, and in no configuration
    as good as a lens for this configuration alone."""
    joined = Configurations.from_problems(problems(), [GAP])
    start = joined.merits(joined.variables.start)
    found = design.optimise(joined)
    each = joined.merits(jnp.asarray(found.vector))
    assert found.converged and found.merit < 0.7 * float(jnp.sum(start))
    np.testing.assert_allclose(found.merit, jnp.sum(each), rtol=1e-10)
    alone = [design.optimise(problem).merit for problem in problems()]
    assert found.merit >= sum(alone) * (1 - 1e-9)
    some = design.many_starts(joined, design.normal_starts(joined.variables, 4, 0.1), (40, 200))
    assert some.minima[0].merit <= found.merit * (1 + 1e-6)


@pytest.mark.slow
def test_problems_of_other_structures_stand_side_by_side():
    """One configuration has three fields, the other two."""
    one, two = problems()
    more = triplet(two.variables.lens, 400.0, 2.0, (0, 10, 14))
    joined = Configurations.from_problems([more, one, two], [GAP])
    assert [group.numbers for group in joined.groups] == [(0,), (1, 2)]
    start = joined.variables.start
    expected = [float(p.merit(p.variables.start)) for p in (more, one, two)]
    np.testing.assert_allclose(joined.merits(start), expected, rtol=1e-12)
    part = design.part_of(joined, 0.5)
    half = design.part_of(more, 0.5)
    np.testing.assert_allclose(
        part.merits(part.variables.start)[0], half.merit(half.variables.start), rtol=1e-12
    )


def other(**changed):
    lens = load_lens("cooke_triplet")
    given = {"vary": ["curvature"], "solves": [], "lens": lens} | changed
    variables = Variables.from_lens(given["lens"], given["vary"], solves=given["solves"])
    return Problem.from_variables(variables, [Operand("total_track", 60.0)])


REFUSED = {
    "own: no variable is named 'thickness 9'": ([{}, {}], ["thickness 9"]),
    "own: no variable is named 'conic'": ([{}, {}], "conic"),
    "do not both vary conic 0": ([{}, {"vary": ["curvature", Vary("conic", (0,))]}], []),
    "sensor is shared, but begins at 42": (
        [{"vary": ["sensor"]}, {"vary": ["sensor"], "lens": configured(
            load_lens("cooke_triplet"), {"sensor": (45.0,)})[0]}], []),
    "bounds have no common range": (
        [{"vary": [Vary("sensor", low=40, high=42.21)]}, {"vary": [Vary("sensor", low=42.21)]}],
        []),
    "solves: focal_length: changes curvature 4": (
        [{"solves": [Solve("focal_length", surface=4)]}] * 2, []),
    "problems: expected Problem": ([], []),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_what_does_not_fit_is_refused(message):
    given, own = REFUSED[message]
    with pytest.raises(ValueError, match=message):
        Configurations.from_problems([other(**one) for one in given], own)


def test_updates_are_led_back_within_the_bounds_of_all():
    shared = Configurations.from_problems(
        [other(vary=[Vary("sensor", low=low)]) for low in (41.5, 42.0)]
    )
    start = shared.variables.start
    held = design.within_limits(shared, start, start - 5.0 / shared.variables.scale)
    np.testing.assert_allclose(shared.variables.numbers(held), [42.0])


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"curvature": (0.1,)}, "curvature: is 6 numbers; name one, such as curvature 5"),
        ({"gap 3": (1.0,)}, "kind"),
        ({"thickness 9": (1.0,)}, "no surface 9; there are 0, 1"),
        ({"sensor": (40.0, 41.0), "thickness 1": (5.0,)}, "as many numbers for each name"),
        ({}, "as many numbers"),
        ({"thickness 3": (np.nan, 1.0)}, "thickness 3: expected numbers from -inf to inf, got"),
        ({"semi_diameter 3": (3.8, -1.0)}, "semi_diameter 3: expected numbers from 1e-06 to inf"),
    ],
)
def test_configured_refuses(numbers, message):
    with pytest.raises(ValueError, match=message):
        configured(load_lens("cooke_triplet"), numbers)


def test_configured_folds_a_mirror_and_keeps_the_rest():
    lens = load_lens("cooke_triplet")
    one, two = configured(lens, {"tilt 2[0]": (0.0, 0.1), "thickness 1": (6.0, 7.0)})
    np.testing.assert_array_equal(two.tilt[2], [0.1, 0, 0])
    np.testing.assert_allclose(two.sensor - one.sensor, 1.0)  # it keeps its distance
    np.testing.assert_array_equal(one.curvature, lens.curvature)


@pytest.mark.slow
def test_an_athermal_pair_is_that_of_the_closed_form():
    """Thin lenses of N-FK51A and N-BK7 in contact, 100 mm in front of the sensor in an aluminium
    tube, are in focus at -20 and at 60 C. The powers at 20 C solve two linear equations."""
    surface = {"thickness": 1e-6, "semi_diameter": 0.005}
    rows = [
        surface | {"radius": 60.0, "glass": "N-FK51A", "stop": True},
        surface | {"radius": "inf"},
        surface | {"radius": 400.0, "glass": "N-BK7"},
        {"radius": "inf", "semi_diameter": 0.005},
    ]
    lens = load_lens({"surfaces": rows, "sensor": 100.0})
    model = design.ThermalModel.from_lens(lens, 23.6)
    cold = Variables.from_lens(lens, [Vary("curvature", (0, 2))])
    sets = [cold.at_temperature(celsius, model) for celsius in (-20.0, 60.0)]
    one = Scene.point(wavelengths=0.55)
    problems = [Problem.from_variables(own, [Operand("spot", weight=1e6)], one, 2) for own in sets]
    joined = Configurations.from_problems(problems)
    assert len(joined.groups) == 1 and joined.variables.names == cold.names
    found = design.optimise(joined, max_steps=40)
    lenses = [design.at_temperature(lens, celsius, model) for celsius in (-20.0, 60.0)]
    index = np.array([np.asarray(own.index(0.55))[[1, 3], 0] for own in (lens, *lenses)])
    grow = 1 + 1e-6 * np.array([[-40.0], [40.0]]) * np.array([12.74, 7.1])
    powers = (index[1:] - 1) / (index[0] - 1) / grow
    wanted = np.linalg.solve(powers, 1 / (100 * (1 + 23.6e-6 * np.array([-40.0, 40.0]))))
    curvature = np.asarray(cold.lens_of(found.vector).curvature)[[0, 2]]
    np.testing.assert_allclose(curvature * (index[0] - 1), wanted, rtol=1e-4)
    # the lens of each configuration is that at its temperature; it is in focus, but the lens
    # with one glass is not
    hot = joined.lenses(found.vector)[1]
    assert hot.glasses[1] == "N-FK51A at 60 C"
    focus = [float(first_order(own, np.inf, 0.55).back_focal_distance[0]) for own in lenses]
    assert abs(focus[1] - float(lenses[1].sensor)) > 0.01
    focal = float(first_order(hot, np.inf, 0.55).back_focal_distance[0])
    np.testing.assert_allclose(focal, hot.sensor, atol=2e-4)
    with pytest.raises(ValueError, match="join the sets first"):
        Variables.joined(sets)
