"""Steps of a lens that are measured by the motion of its rays, and the projection onto limits in a
metric."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg, optimize

from drt_jax import Scene, design, load_lens
from drt_jax.design.within_limits import nearest


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_vector_is_that_of_scipy(seed):
    """Metrics with the condition 1e8; rows that are nearly parallel, repeated, or zero."""
    rng = np.random.default_rng(seed)
    count, rows = 9, 14
    turn = np.linalg.qr(rng.normal(size=(count, count)))[0]
    metric = turn @ np.diag(np.logspace(-8, 0, count)) @ turn.T
    lines = rng.normal(size=(rows, count))
    lines[1] = lines[0] + 1e-3 * lines[1]
    lines[2], lines[3] = lines[4], 0
    wanted, most = 3 * rng.normal(size=count), rng.uniform(0, 1, rows)
    most[5] = np.inf
    found = nearest(*map(jnp.asarray, (wanted, metric, lines, most)))
    assert np.max(lines @ found - most) <= 1e-7  # 0 is allowed: a solution exists
    some = np.isfinite(most) & np.any(lines, axis=1)
    # z = root (x - wanted) of least length with g z >= h (Lawson and Hanson, ch. 23, LDP).
    root = np.linalg.cholesky(metric).T
    g = -linalg.solve_triangular(root, lines[some].T, trans="T").T
    h = lines[some] @ wanted - most[some]
    sides = np.vstack([g.T, h])
    side = np.eye(count + 1)[-1]
    left = sides @ optimize.nnls(sides, side, maxiter=1000)[0] - side
    exact = wanted + linalg.solve_triangular(root, -left[:-1] / left[-1])

    def far(x):
        return (x - wanted) @ metric @ (x - wanted)

    assert np.max(lines @ exact - most) <= 1e-5
    assert far(found) == pytest.approx(far(exact), rel=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_in_float32_it_ends_and_is_near(seed):
    rng = np.random.default_rng(seed)
    metric = np.diag(np.logspace(-3, 0, 6))
    given = 3 * rng.normal(size=6), metric, rng.normal(size=(9, 6)), rng.uniform(0, 1, 9)
    exact = nearest(*map(jnp.asarray, given))
    found = nearest(*(jnp.asarray(a, jnp.float32) for a in given))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, exact, atol=2e-2 * np.max(np.abs(exact)))


def test_a_vector_within_all_rows_stays():
    vector = jnp.array([0.1, -0.2])
    stays = nearest(vector, jnp.diag(jnp.array([1.0, 9.0])), jnp.eye(2), jnp.array([1.0, jnp.inf]))
    np.testing.assert_array_equal(stays, vector)


def test_a_cosine_rises_and_falls():
    length = design.cosine(2.0, 100)
    k = jnp.array([0.0, 9.0, 50.0, 100.0, 500.0])
    np.testing.assert_allclose(length(k), [0.2, 1.96, 1.0, 0, 0], atol=1e-2)


LIMITS = [design.Operand("glass_edge", low=0.5), design.Operand("air_edge", low=0.1)]


def problems(name, vary, field, solves=()):
    lens = load_lens(name)
    variables = design.Variables.from_lens(design.open_apertures(lens), vary, solves=solves)
    scene = Scene.radians(np.radians([0, 0.7 * field, field]), np.inf, (0.6, 0.53, 0.48))
    make = design.Problem.from_variables
    return make(variables, ["spot"], scene, 5), make(variables, LIMITS, scene, 5)


@pytest.fixture(scope="module")
def triplet():
    vary = [design.Vary("curvature", low=-0.12, high=0.12), design.Vary("thickness", low=0.3)]
    solves = [design.Solve("focal_length", value=50, surface=5)]
    return problems("cooke_triplet", [*vary, "sensor"], 15, solves)


@pytest.mark.slow
def test_a_step_moves_the_rays_by_its_size_and_no_unit_counts(triplet):
    spots, limits = triplet
    start = spots.variables.start + 0.01
    steps = design.RaySteps(spots, limits, 1e-3, damping=1e-6)
    gradient = jax.grad(spots.merit)(start)
    first, state = jax.jit(steps.update)(gradient, steps.init(start), start)
    hits = lambda v: spots.evaluate(v).residuals  # noqa: E731
    _, moved = jax.jvp(hits, (start,), (first - start,))
    views = len(spots.fields) * len(spots.distances)
    assert float(jnp.linalg.norm(moved)) / views**0.5 == pytest.approx(1e-3, rel=0.05)
    again, _ = jax.jit(steps.update)(1e6 * gradient, steps.init(start), start)
    np.testing.assert_allclose(again, first, rtol=1e-9)
    assert int(state.steps) == 1 and np.linalg.eigvalsh(state.metric)[0] > 0


@pytest.mark.slow
def test_no_step_exceeds_a_share_of_the_spots(triplet):
    """Steps much larger than the spots moved a phone lens away from spots of 0.1 um."""
    spots, limits = triplet
    start = spots.variables.start
    gradient = jax.grad(spots.merit)(start + 0.01)
    residuals = lambda v: spots.evaluate(v).residuals  # noqa: E731
    spot = jnp.linalg.norm(residuals(start)) / len(spots.fields) ** 0.5
    steps = design.RaySteps(spots, limits, 1.0, share=0.01, damping=1e-6)
    new, state = jax.jit(steps.update)(gradient, steps.init(start), start)
    _, moved = jax.jvp(residuals, (start,), (new - start,))
    assert float(state.spot) == pytest.approx(float(spot), rel=1e-9)
    length = jnp.linalg.norm(moved) / len(spots.fields) ** 0.5
    assert float(length / spot) == pytest.approx(0.01, rel=0.05)


@pytest.mark.slow
def test_it_ends_where_least_squares_ends_within_bounds_and_limits(triplet):
    """From a disturbed lens, with exact gradients of the spots."""
    spots, limits = triplet
    start = design.as_built_starts(spots.variables, 1, 3.0, 0.05, 0)[0]
    start = jnp.clip(start, spots.variables.low, spots.variables.high)
    best = design.optimise(spots, start)
    steps = design.RaySteps(spots, limits, design.cosine(5e-3, 150))

    @jax.jit
    def step(_, both):
        vector, state = both
        return steps.update(jax.grad(spots.merit)(vector), state, vector)

    vector, _ = jax.lax.fori_loop(0, 150, step, (start, steps.init(start)))
    merits = [float(spots.merit(v)) for v in (start, vector, best.vector)]
    assert merits[2] < 0.5 * merits[0]
    assert merits[1] < 1.1 * merits[2]
    found = limits.evaluate(vector)
    assert np.max(found.constraints) <= 1e-4 and float(found.overlap) == 0
    low, high = np.asarray(spots.variables.low), np.asarray(spots.variables.high)
    assert np.all(low <= vector) and np.all(vector <= high)
