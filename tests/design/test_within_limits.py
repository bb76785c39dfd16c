"""A lens in training stays within its limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Scene, design, load_lens

pytestmark = pytest.mark.slow  # one program of twenty seconds

LIMITS = [
    design.Operand("glass_edge", low=0.5),
    design.Operand("air_edge", low=0.1),
    design.Operand("total_track", high=62.0),
]


@pytest.fixture(scope="module")
def problem():
    lens = load_lens("cooke_triplet")
    vary = [design.Vary("curvature", low=-0.2, high=0.2), "thickness", "sensor"]
    variables = design.Variables.from_lens(lens, vary)
    return design.Problem.from_variables(variables, LIMITS, Scene.radians(np.radians([0, 15])), 4)


@pytest.fixture(scope="module")
def hold(problem):
    return jax.jit(lambda before, after: design.within_limits(problem, before, after))


def test_an_update_within_all_limits_stays_as_it_is(problem, hold):
    start = problem.variables.start
    after = start + 1e-3
    assert np.max(problem.evaluate(after).constraints) < 0
    np.testing.assert_array_equal(hold(start, after), after)


@pytest.mark.parametrize("far", [3.0, 30.0, 1e4])
def test_a_wild_update_is_led_back_onto_the_limits(problem, hold, far):
    start = problem.variables.start
    after = start + far * jnp.asarray(np.random.default_rng(3).normal(size=start.size))
    found = problem.evaluate(hold(start, after))
    assert np.max(problem.evaluate(after).constraints) > 1e-3
    assert np.max(found.constraints) <= 1e-4  # mm
    assert float(found.overlap) == 0
    assert int(found.failed) == 0


def test_it_slides_along_a_limit(problem):
    # At the limit of the track, a gradient towards longer tracks still moves the rest of the lens.
    track = design.Problem.from_variables(problem.variables, LIMITS[-1:])
    start = problem.variables.start
    push = jnp.asarray([name == "sensor" for name in problem.variables.names], start.dtype)
    edge = design.within_limits(track, start, start + 110 * push)
    assert float(track.evaluate(edge).constraints[0]) == pytest.approx(0, abs=1e-4)
    side = jnp.zeros_like(start).at[0].set(1e-3)
    moved = design.within_limits(track, edge, edge + push + side)
    assert float(moved[0] - edge[0]) == pytest.approx(1e-3, rel=1e-6)
    assert float(track.evaluate(moved).constraints[0]) <= 1e-4


def test_numbers_that_are_not_finite_change_nothing(problem, hold):
    start = problem.variables.start
    np.testing.assert_array_equal(hold(start, start.at[2].set(np.nan)), start)


def test_bounds_are_clipped(problem, hold):
    start = problem.variables.start
    found = hold(start, start.at[1].add(1e6))
    high = problem.variables.high
    assert np.all(np.asarray(found) <= np.asarray(high))
    assert np.all(np.isfinite(found))
