"""Least squares within bounds and limits, and many starts: against known optima."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares

import drt_jax
from drt_jax import design
from drt_jax.design import Operand, Solve, Variables, Vary

# Of the singlet of issue 14, by another program: merit at the start and at the optimum, mm^2.
START, OPTIMUM = 30.0924206902, 0.00172898452577
SINGLET = """
surfaces:
  - {{radius: {0}, thickness: 7, glass: N-SF11, semi_diameter: 7.5, stop: true}}
  - {{radius: {1}, glass: air}}
sensor: 37
"""


def solved(function, start, lower, upper, limits=0):
    """By the method alone: the vector, the state."""
    solver = design.BoundedLM(rtol=1e-14, atol=1e-26, limits=limits)
    options = {"lower": jnp.asarray(lower), "upper": jnp.asarray(upper)}

    def told(y, args):
        return function(y), (jnp.zeros(()), ())

    found = optx.least_squares(
        told, solver, jnp.asarray(start), options=options, has_aux=True, max_steps=200, throw=False
    )
    return np.asarray(found.value), found.state


def rosenbrock(y):
    return jnp.stack([10 * (y[1] - y[0] ** 2), 1 - y[0]])


@pytest.mark.parametrize("upper", [(5.0, 5.0), (0.5, 5.0), (5.0, 0.3)])
def test_bounded_minima_are_those_of_scipy(upper):
    lower, start = (-2.0, -2.0), np.array([-1.2, 0.2])
    wanted = least_squares(rosenbrock, start, bounds=(lower, upper), xtol=1e-15, ftol=1e-15).x
    found, state = solved(rosenbrock, start, lower, upper)
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert (
        np.all(found <= upper) and float(state.merit) <= 2 * np.sum(rosenbrock(wanted) ** 2) + 1e-20
    )


def test_one_sided_residuals_count_where_they_are_above_zero():
    """min (x - 3)^2 + (y - 1)^2 + max(0, 100 (x + y - 2))^2: near (2, 0)."""

    def function(y):
        return jnp.stack([y[0] - 3, y[1] - 1, 100 * (y[0] + y[1] - 2)])

    found, state = solved(function, np.zeros(2), (-9.0, -9.0), (9.0, 9.0), limits=1)
    np.testing.assert_allclose(found, [2, 0], atol=2e-4)
    free, _ = solved(lambda y: function(y) + jnp.array([0, 0, -900.0]), np.zeros(2), [-9.0] * 2,
                     [9.0] * 2, limits=1)  # fmt: skip
    np.testing.assert_allclose(free, [3, 1], atol=1e-6)
    assert int(state.jacobians) < 12


def grid(rings):
    rows = [np.zeros((2, 1))]
    for k in range(1, rings + 1):
        angle = 2 * np.pi * np.arange(6 * k) / (6 * k)
        rows.append(k / rings * np.stack([np.cos(angle), np.sin(angle)]))
    points = np.concatenate(rows, axis=1)
    return drt_jax.Pattern(points, np.full(points.shape[1], 1 / points.shape[1]), "disc")


def test_singlet_reaches_the_known_optimum_in_twenty_jacobians(tmp_path):
    """From both signs and from a plane plate; one program serves all three."""
    for first, second in ((1000, -1000), (-1000, 1000), ("inf", "inf")):
        path = tmp_path / "singlet.yaml"
        path.write_text(SINGLET.format(first, second))
        variables = Variables.of(drt_jax.load_lens(path), ["curvature"])
        problem = design.Problem.of(variables, ["spot"], 0.0, 0.55, rule=grid(5))
        if first == 1000:
            np.testing.assert_allclose(problem.merit(variables.start), START, rtol=1e-11)
        found = design.optimise(problem)
        assert found.merit <= OPTIMUM * (1 + 1e-9) and found.jacobians <= 20
        np.testing.assert_allclose(1 / found.lens.curvature[:2], [25.2924, 255.796], rtol=2e-6)


@pytest.fixture(scope="module")
def triplet():
    lens = drt_jax.load_lens("cooke_triplet")
    semi = (
        jnp.full_like(lens.semi_diameter, jnp.inf).at[lens.stop].set(lens.semi_diameter[lens.stop])
    )
    lens = dataclasses.replace(lens, semi_diameter=semi)
    last = lens.live[-1]
    variables = Variables.of(
        lens,
        [Vary("curvature", low=-0.12, high=0.12), Vary("thickness", low=0.1, high=8), "sensor"],
        solves=[Solve("focal_length", surface=last), Solve("entrance_pupil")],
    )
    wanted = ["spot", Operand("glass_edge", low=1.0), Operand("total_track", high=55.0)]
    return design.Problem.of(variables, wanted, np.radians([0.0, 14.0]), 0.5876, rule=3)


def test_limits_are_kept_exactly_and_the_best_is_no_worse(triplet):
    start = float(triplet.merit(triplet.variables.start))
    found = design.optimise(triplet, trials=200)
    assert found.merit < start and found.worst <= 1e-9
    low, high = np.asarray(triplet.variables.low), np.asarray(triplet.variables.high)
    assert np.all(low <= found.vector) and np.all(found.vector <= high)
    assert np.all(np.isfinite(found.history)) and np.all(np.diff(found.history[:, 2]) >= 0)
    assert float(found.lens.sensor) <= 55 + 1e-9
    for name in (drt_jax.focal_length, lambda *a: drt_jax.entrance_pupil(*a).semi_diameter):
        before, after = (name(lens, (0.5875618,)) for lens in (triplet.variables.lens, found.lens))
        np.testing.assert_allclose(after, before, rtol=1e-12)


def test_a_search_ends_as_soon_as_it_is_good(triplet):
    """By its merit and its limits together, at the first trial of which that is true."""
    whole = design.optimise(triplet, trials=40)
    good = float(whole.history[10, 0])
    found = design.optimise(triplet, trials=40, good=good)
    assert found.score <= good and found.merit <= found.score
    count = len(found.history)
    assert 3 <= count < 40
    np.testing.assert_array_equal(found.history, whole.history[:count])
    earlier = design.optimise(triplet, trials=count - 1)
    assert earlier.score > good


def test_many_starts_do_not_depend_on_threads(triplet):
    """Two tiles, one of them not full, and a start that no light passes."""
    starts = design.around(triplet.variables, 18, 2.0, 3)
    starts[5, :4] = [24.0, -24.0, 24.0, -24.0]
    one, two = (
        design.many_starts(triplet, starts, (4, 4), 0.5, threads=threads) for threads in (1, 2)
    )
    np.testing.assert_array_equal(one.merits, two.merits)
    assert one.trials == two.trials and np.sum(np.isfinite(one.merits)) >= 17
    assert [m.start for m in one.minima] == [m.start for m in two.minima]
    merits = [minimum.merit for minimum in one.minima]
    assert merits == sorted(merits) and merits[0] < float(triplet.merit(starts[0]))


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda p: design.many_starts(p, np.zeros((2, 3))), "starts: expected"),
        (lambda p: design.within(p.variables, 4), "sensor: starts within bounds need low and high"),
        (lambda p: design.Problem.of(p.variables, []), "operands: none"),
        (
            lambda p: design.Problem.of(p.variables, ["spot"], colour_weights=[0.0]),
            "colour_weights",
        ),
        (lambda p: design.Problem.of(p.variables, ["magnification"]), "object is at infinity"),
        (lambda p: design.Problem.of(p.variables, [Operand("spot", fields=(3,))]), "no number 3"),
        (lambda p: jax.jit(lambda v: design.optimise(p, v))(p.variables.start), "outside of jax"),
    ],
)
def test_bad_input_gets_one_line(triplet, call, said):
    with pytest.raises(ValueError, match=said) as caught:
        call(triplet)
    assert "\n" not in str(caught.value) and len(str(caught.value)) <= 300
