"""Compensation, derivatives and Monte Carlo, compared with scans, with differences and with each
other."""

import dataclasses
import math
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import drt_jax
from drt_jax import Scene, design
from drt_jax.design import PerturbedLens, Problem, Tolerance, Variables, tolerance
from drt_jax.design.deviations import KINDS
from drt_jax.design.tolerance import Order
from drt_jax.pupil.rules import Gauss

SINGLET = drt_jax.load_lens("singlet")
FIELDS = np.radians([[0, 0], [0, 3], [0, -3], [3, 0], [-2, 1]])
COLOURS = [0.4861327, 0.6562725]
SIZES = {
    **{"radius": 1.0, "wedge": 6.0, "thickness": 0.3, "index": 2e-3, "abbe": 1.0},
    **{"decentre": 0.4, "tilt": 30.0},
}
ALL = [Tolerance(kind, size) for kind, size in SIZES.items()]


def perturbed(*tolerances):
    return PerturbedLens.from_lens(SINGLET, jnp.array([5.0, 6.0, 6.0]), tolerances or ALL)


def problem_of(lens, fields=FIELDS, rule=3):
    return Problem.from_variables(
        Variables.from_lens(lens, ["sensor"]),
        ["spot"],
        Scene.radians(fields, np.inf, COLOURS),
        rule,
    )


@pytest.fixture(scope="module")
def singlet():
    """The singlet with errors of most kinds, and the problem that evaluates it."""
    some = perturbed()
    return problem_of(some.lens), some


@pytest.fixture(scope="module")
def predicted(singlet):
    return design.predict(*singlet, "focus")


_made = jax.jit(design.as_built, static_argnums=2)


def some_lens(some, seed=5):
    return some.lens_of(jnp.asarray(design.draw_perturbations(some, 1, seed)[0]))


@pytest.mark.slow
def test_squares_are_those_of_the_moments(singlet):
    """The spot of all wavelengths about their centroid, from the moments of each."""
    problem, some = singlet
    lens = some_lens(some)
    found = drt_jax.psf_moments(
        lens, Scene.point(FIELDS[4], np.inf, COLOURS), sampling=problem.rule
    )
    mean, spread = np.asarray(found.mean), np.asarray(found.covariance)
    apart = np.sum((mean - np.mean(mean, axis=0)) ** 2, axis=1)
    wanted = np.mean(np.trace(spread, axis1=1, axis2=2) + apart)
    assert float(_made(problem, lens, "none").squares[4]) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.slow
def test_focus_is_where_a_scan_finds_it(singlet):
    problem, some = singlet
    lens = some_lens(some)
    found = _made(problem, lens, "focus")
    assert np.all(np.isfinite(found.squares))

    def spot(move):
        moved = dataclasses.replace(lens, sensor=lens.sensor + move)
        return float(_made(problem, moved, "none").spot)

    moves = np.linspace(-1, 1, 41) * 0.2 + float(found.moves[0])
    scan = [spot(move) for move in moves]
    assert int(np.argmin(scan)) == 20
    best = optimize.minimize_scalar(spot, (moves[10], moves[20], moves[30]), tol=1e-9)
    assert best.x == pytest.approx(float(found.moves[0]), abs=1e-6)
    assert best.fun == pytest.approx(float(found.spot), rel=1e-10)
    assert float(found.moves[0]) != 0


@pytest.mark.slow
def test_tilt_of_the_sensor_is_where_a_scan_finds_it(singlet):
    """The sensor is really tilted, about its intersection with the axis."""
    problem, some = singlet
    lens = some_lens(some)
    found = _made(problem, lens, "focus and tilt")
    assert float(found.spot) < float(_made(problem, lens, "focus").spot)

    @jax.jit
    def spot(moves):
        tilt = lens.tilt.at[-1, :2].add(jnp.stack([moves[1], -moves[2]]))
        moved = dataclasses.replace(lens, sensor=lens.sensor + moves[0], tilt=tilt)
        return 1e3 * design.as_built(problem, moved, "none").spot

    scales = np.array([0.1, 0.05, 0.05])
    best = optimize.minimize(
        lambda x: float(spot(jnp.asarray(x * scales))), np.zeros(3), method="Nelder-Mead",
        options={"xatol": 1e-5, "fatol": 1e-9, "maxiter": 400},
    )  # fmt: skip
    # A tilted sensor also stretches the spot, by its angle times that of the light.
    np.testing.assert_allclose(best.x * scales, found.moves, rtol=0.1)
    assert best.fun == pytest.approx(1e3 * float(found.spot), rel=1e-3)


@pytest.mark.slow
def test_a_sensor_that_stands_oblique_is_focused_along_the_axis(singlet):
    """Compensated lenses whose sensors are really moved need no further compensation, and have the
    same spots."""
    problem, some = singlet
    tilt = some_lens(some).tilt.at[-1].set(jnp.array([0.5, -0.4, 0.3]))
    lens = dataclasses.replace(some_lens(some), tilt=tilt)
    found = _made(problem, lens, "focus")
    moved = dataclasses.replace(lens, sensor=lens.sensor + found.moves[0])
    assert float(_made(problem, moved, "focus").moves[0]) == pytest.approx(0, abs=1e-12)
    wanted = _made(problem, moved, "none").squares
    np.testing.assert_allclose(found.squares, wanted, rtol=1e-12)


def measures(singlet, off):
    return np.mean(design.monte_carlo(*singlet, np.asarray(off), "focus", threads=1).squares, 1)


@pytest.mark.slow
def test_gradient_and_hessian_are_those_of_differences(singlet, predicted):
    """They agree with central differences of some step to six digits; for larger steps the error is
    proportional to the square of the step."""
    count = len(singlet[1].deviations)
    units = np.eye(count)
    steps = np.array([0.4, 0.2, 0.1, 0.05, 0.01])
    ends = [s * h * u for h in steps for u in units for s in (1, -1)]
    one = measures(singlet, ends).reshape(len(steps), count, 2)
    gradient, hessian = np.asarray(predicted.gradient), np.asarray(predicted.hessian)
    slopes = (one[..., 0] - one[..., 1]) / (2 * steps[:, None])
    errors = np.linalg.norm(slopes - gradient, axis=1) / np.linalg.norm(gradient)
    assert errors.min() < 1e-6
    np.testing.assert_allclose(errors[:2] / errors[1:3], 4, rtol=0.2)
    nominal = measures(singlet, [0 * units[0]])[0]
    assert nominal == pytest.approx(float(predicted.nominal), rel=1e-12)
    rows, columns = np.triu_indices(count, 1)
    bends = np.zeros((len(steps), count, count))
    for k, h in enumerate(steps):
        pairs = [h * (s * units[i] + t * units[j])
                 for i, j in zip(rows, columns) for s in (1, -1) for t in (1, -1)]  # fmt: skip
        four = measures(singlet, pairs).reshape(-1, 4) @ [1, -1, -1, 1] / (4 * h**2)
        bends[k][rows, columns] = bends[k][columns, rows] = four
        bends[k][np.diag_indices(count)] = (one[k].sum(axis=1) - 2 * nominal) / h**2
    errors = np.linalg.norm(bends - hessian, axis=(1, 2)) / np.linalg.norm(hessian)
    assert errors.min() < 1e-5
    np.testing.assert_allclose(errors[:2] / errors[1:3], 4, rtol=0.2)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12 * np.abs(hessian).max())


@pytest.mark.slow
def test_what_rays_know_of_second_derivatives_are_their_products(singlet, predicted):
    problem, some = singlet

    @jax.jit
    def residuals(off):
        lens = some.lens_of(off)
        return tolerance.compensated(lens, tolerance.trace_fields(problem, lens), "focus")[1]

    units = jnp.eye(len(some.deviations))
    rows = [np.ravel(residuals(1e-4 * u) - residuals(-1e-4 * u)) / 2e-4 for u in units]
    products = 2 * np.array(rows) @ np.array(rows).T / len(FIELDS)
    np.testing.assert_allclose(predicted.gauss, products, atol=1e-6 * products.max())
    assert np.linalg.eigvalsh(predicted.gauss)[0] > -1e-12 * products.max()


@pytest.mark.slow
def test_predictions_are_monte_carlo(singlet, predicted):
    """The quadratic form of all second derivatives, with errors so small that it is accurate."""
    off = 0.1 * design.draw_perturbations(singlet[1], 200, 3)
    true = measures(singlet, off)
    foretold = np.asarray(predicted.at(off, "second"))
    assert np.max(np.abs(foretold - true)) < 0.02 * np.std(true)
    first = np.asarray(predicted.at(off, "first"))
    assert np.max(np.abs(foretold - true)) < 0.2 * np.max(np.abs(first - true))
    many = design.draw_perturbations(singlet[1], 50_000, 4)
    for order in ("first", "rays", "second"):
        mean, deviation = predicted.moments(design.variances(singlet[1]), order)
        q = np.asarray(predicted.at(many, order))
        assert abs(q.mean() - mean) < 4 * q.std() / math.sqrt(len(q))
        # Squares of uniform errors vary less than those of normal ones.
        assert 0.98 * q.std() < deviation < (1.02 if order == "first" else 1.3) * q.std()
    moves = design.monte_carlo(*singlet, off, "focus").moves
    linear = np.asarray(predicted.moves) + off @ np.asarray(predicted.move_slopes)
    np.testing.assert_allclose(moves, linear, atol=0.02 * np.std(moves))


def as_they_are(lens, built):
    return built


@pytest.mark.slow
@pytest.mark.parametrize("compensator, given", [("none", as_they_are), ("focus", "focus")])
def test_spots_of_lenses_as_built_as_an_operand(singlet, compensator, given):
    """Its merit and its derivative are those of a Monte Carlo run."""
    problem, some = singlet
    off = design.draw_perturbations(some, 7, 5)
    operand = design.Operand(design.spots_as_built(some, off, given, order=3))
    variables = Variables.from_lens(SINGLET, ["curvature", "sensor"])
    scene = Scene.radians(FIELDS, np.inf, COLOURS)
    built = Problem.from_variables(variables, [operand], scene, 3)

    def traced(vector):
        around = some.around(variables.lens_of(vector))
        found = design.monte_carlo(problem, around, off, compensator)
        return float(np.sum(np.mean(found.squares, axis=0)))

    start = variables.start
    merit, slopes = jax.jit(jax.value_and_grad(built.merit))(start)
    assert float(merit) == pytest.approx(traced(start), rel=1e-10)
    steps = 1e-5 * np.eye(len(start))
    wanted = [(traced(start + step) - traced(start - step)) / 2e-5 for step in steps]
    # With refocusing, the result does not depend on the sensor of the design.
    np.testing.assert_allclose(slopes, wanted, rtol=1e-5, atol=1e-8 * np.max(np.abs(wanted)))


@pytest.mark.parametrize(
    "change, told",
    [
        ({"perturbation": np.zeros((0, 3))}, r"perturbation: expected \(K, 13\), got shape"),
        ({"compensator": "focus and tilt"}, "compensator: expected one of none, focus"),
    ],
)
def test_lenses_as_built_that_are_no_operand(singlet, change, told):
    width = len(singlet[1].deviations)
    given = {"perturbation": np.zeros((2, width))} | change
    with pytest.raises(ValueError, match=told.replace("13", str(width))):
        design.spots_as_built(singlet[1], **given)


def test_lenses_as_built_refuse_a_lens_of_other_surfaces(singlet):
    other = drt_jax.load_lens("cooke_triplet")
    operand = design.spots_as_built(singlet[1], np.zeros((1, len(singlet[1].deviations))))
    told = f"perturbed: a lens of 3 surfaces, the design has {other.count}"
    with pytest.raises(ValueError, match=told):
        operand(other, None)


@pytest.mark.parametrize("word", ["gradient", "second derivatives", "", 2, None])
def test_orders_that_are_unknown_are_refused(word):
    """Before, they silently meant the second order."""
    whole = np.eye(2)
    some = design.Predicted(1.0, np.ones(2), 2 * whole, 6 * whole, np.zeros(1), np.zeros((2, 1)))
    off = np.array([[1.0, -1.0], [0.5, 0.5]])
    values = {"first": [1, 2], "rays": [3, 2.5], "second": [7, 3.5]}
    assert set(values) == set(get_args(Order))
    for order, q in values.items():
        np.testing.assert_allclose(some.at(off, order), q)
    ways = (
        lambda: some.at(off, word),
        lambda: some.matrix(word),
        lambda: some.moments(np.ones(2), word),
        lambda: design.worst_case(perturbed(Tolerance("radius", 1.0)), some, word),
    )
    for way in ways:
        with pytest.raises(ValueError, match="order: expected one of first, rays, second"):
            way()


@pytest.mark.slow
def test_nothing_drawn_is_worse_than_the_worst_case(singlet, predicted):
    some = singlet[1]
    many = np.asarray(predicted.at(design.draw_perturbations(some, 20_000, 1), "second"))
    for order in ("first", "second"):
        off = design.worst_case(some, predicted, order)
        for part in some.parts:
            assert np.linalg.norm(off[part]) == pytest.approx(1)
        assert float(predicted.at(off, "second")) > np.max(many)


@pytest.mark.parametrize("normal", [False, True])
def test_errors_are_drawn_within_circles(normal):
    some = perturbed(Tolerance("decentre", 1.0), Tolerance("radius", 1.0), Tolerance("tilt", 1.0))
    off = design.draw_perturbations(some, 100_000, 0, normal)
    for part in some.parts:
        assert 0.99 < np.max(np.linalg.norm(off[:, part], axis=1)) <= 1
    assert [len(part) for part in some.parts] == [2, 1, 2]
    np.testing.assert_allclose(off.var(axis=0), design.variances(some, normal), rtol=0.02)
    assert np.array_equal(off, design.draw_perturbations(some, 100_000, 0, normal))


@pytest.mark.slow
def test_monte_carlo_depends_on_neither_threads_nor_tiles(singlet, monkeypatch):
    off = design.draw_perturbations(singlet[1], 120, 2)
    told = []
    one = design.monte_carlo(*singlet, off, "focus", told.append, threads=1)
    assert told == [50, 100, 120]
    three = design.monte_carlo(*singlet, off, "focus", threads=3)
    assert all(np.array_equal(a, b) for a, b in zip(one, three))
    some = design.monte_carlo(*singlet, off[60:63], "focus")
    assert all(np.array_equal(a, b[60:63]) for a, b in zip(some, one))
    single = _made(singlet[0], singlet[1].lens_of(jnp.asarray(off[60])), "focus")
    for a, b in zip(single, one):
        np.testing.assert_allclose(a, b[60], rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_lenses_that_pass_no_light_are_as_bad_as_can_be(singlet):
    """Errors of any size give no NaN, and no good spot from the few rays that are left."""
    off = 1e3 * design.draw_perturbations(singlet[1], 50, 0)
    found = design.monte_carlo(*singlet, off, "focus")
    assert not any(np.isnan(a).any() for a in found)
    assert np.mean(np.isinf(found.spot)) > 0.5
    assert np.all(np.isfinite(found.moves))


@pytest.mark.slow
def test_half_a_pupil_is_enough_where_nothing_is_moved():
    centred = [t for t in ALL if KINDS[t.kind].axes == 1]
    for others in ([], [Tolerance("irregularity", 9.0)]):
        some = perturbed(*others, *centred)
        assert problem_of(some.lens, FIELDS[:3]).rule.symmetry == "bilateral"
    lens = some_lens(perturbed(*centred))
    half, disc = (
        _made(problem_of(lens, FIELDS[:3], Gauss(4, symmetry)), lens, "none").squares
        for symmetry in ("bilateral", "none")
    )
    np.testing.assert_allclose(half, disc, rtol=1e-9)
    radius = _made(problem_of(lens, [0.0], Gauss(4, "rotational")), lens, "none").squares
    np.testing.assert_allclose(radius, disc[:1], rtol=1e-9)


def test_what_cannot_be_is_refused_by_name(singlet):
    problem, some = singlet
    off = np.zeros((1, len(some.deviations)))
    with pytest.raises(ValueError, match="^compensator: expected one of none, focus"):
        design.predict(problem, some, "zoom")
    line = problem_of(some.lens, FIELDS[:3])
    with pytest.raises(ValueError, match="^compensator: focus and tilt: the fields lie on a line"):
        design.monte_carlo(line, some, off, "focus and tilt")
    for rule, needs in ((Gauss(3, "bilateral"), "none"), (Gauss(3, "rotational"), "none")):
        with pytest.raises(ValueError, match=f'^rule: "{rule.symmetry}" .* Gauss.6, "{needs}".'):
            design.as_built(problem_of(some.lens, rule=rule), some.lens, "focus")
    for bad in (off[0], off[:, 1:], off[:0]):
        with pytest.raises(ValueError, match=r"^perturbation: expected \(K, 13\), got shape"):
            design.monte_carlo(problem, some, bad, "focus")
