"""Derivatives of operands by all kinds of variables, and of the merit of failing rays, compared
with central differences of varied steps, in forward and reverse mode."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Clipped, Gauss, Scene, design, load_lens
from drt_jax.compilation import LARGE, jit
from drt_jax.design import OPERANDS, Operand, Problem, Variables, Vary, trace_fields
from drt_jax.design.failures import failures
from drt_jax.rays.solve import solve_aimed

from .test_operands import COLOURS, model

EVERY = [
    *(Vary("curvature", (0, 6)), Vary("conic", (2,)), Vary("coefficients", (2,), (1,))),
    *(Vary("thickness", (0, 3)), Vary("sensor"), Vary("index", (0,)), Vary("abbe", (2,))),
    *(Vary("tilt", (2,)), Vary("decentre", (5,)), Vary("semi_diameter", (0, 4))),
]
STEPS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
# For functions that are evaluated a hundred times: this optimisation takes no longer to compile.
OFTEN = {**LARGE, "xla_backend_optimization_level": 1}


def differences(value, x, steps):
    """Central differences of the leaves of a tree, (K, N) each, for each step."""
    for h in steps:
        pairs = [jax.device_get((value(x + h * e), value(x - h * e))) for e in np.eye(len(x))]
        slopes = [jax.tree.map(lambda a, b, h=h: (a - b) / (2 * h), *pair) for pair in pairs]
        yield jax.tree.map(lambda *columns: np.stack(columns, axis=-1), *slopes)


def assert_derivatives(value, jacobian, x, rtol, floor=1e-2, steps=STEPS):
    """Compares the derivative of each kind by each number with the best of the differences: within
    `rtol` of the largest derivative by that number, plus `floor` times the largest derivative by
    any number."""
    best = jax.tree.map(lambda a: np.full(a.shape, np.inf), jacobian)
    for found in differences(value, x, steps):
        best = jax.tree.map(
            lambda b, f, j: np.minimum(b, np.abs(f - np.asarray(j))), best, found, jacobian
        )
    for kind, j in jacobian.items():
        assert np.all(np.isfinite(j)), kind
        column = np.max(np.abs(j), axis=0, initial=0)
        assert np.all(best[kind] <= rtol * (column + floor * np.max(column))), kind
        assert np.max(column) > 0, kind


@pytest.fixture(scope="module")
def crooked(tmp_path_factory):
    """A lens without symmetry, with an aperture in front that clips some rays of the last field."""
    variables = Variables.from_lens(model(tmp_path_factory.mktemp("lens")), EVERY)
    # In `throughput`, rays drop out one by one; for waves see test_waves.
    kinds = [k for k, value in OPERANDS.items() if k != "throughput" and not value.of_waves]
    fields = [[0.02, 0.05], [0.01, 0.25], [0.03, 0.45]]
    problem = Problem.from_variables(
        variables, kinds, Scene.radians(fields, 800.0, COLOURS), Gauss(3, "none")
    )
    moves = np.random.default_rng(0).normal(size=len(variables.places))
    # Aiming alone, as in optimisers: a third of the program, with the same derivatives.
    return problem.with_solver(solve_aimed), variables.start + moves


@pytest.mark.slow
def test_every_derivative_by_every_kind_of_variable(crooked):
    problem, x = crooked

    def flat(x):
        lens = problem.variables.lens_of(x)
        rays = trace_fields(problem, lens)
        told = {operand.kind: operand.values(lens, rays) for operand in problem.operands}
        return told | {"failures": jnp.ravel(failures(lens, rays))}, rays.bundle.status

    rng = np.random.default_rng(0)
    sizes = {k: a.shape for k, a in jax.eval_shape(flat, x)[0].items()}
    weights = {k: jnp.asarray(rng.normal(size=size)) for k, size in sizes.items()}

    @partial(jit, wanted=LARGE)
    def both_modes(x):
        """All columns of the Jacobian in forward mode; for reverse mode one product with the
        transpose is compared."""
        _, forward, status = jax.linearize(flat, x, has_aux=True)
        jacobian = jax.vmap(forward, out_axes=-1)(jnp.eye(len(x)))
        return jacobian, jax.linear_transpose(forward, x)(weights)[0], status

    jacobian, gradient, status = both_modes(x)
    status = np.asarray(status)[..., 4:]
    clipped, failed = status == 3, (status != 0) & (status != 3)
    assert clipped.any() and failed[2].any() and not failed[2].all() and not failed[:2].any()
    assert_derivatives(jit(lambda x: flat(x)[0], OFTEN), jacobian, x, 1e-6)
    wanted = sum(weights[k] @ j for k, j in jacobian.items())
    np.testing.assert_allclose(gradient, wanted, rtol=1e-8, atol=1e-9 * np.max(np.abs(wanted)))


@pytest.mark.slow
def test_derivatives_of_a_fitted_pupil():
    """Where apertures clip the beam, the points of the rule change with the lens."""
    lens = load_lens("camera_50mm")
    vary = [Vary("curvature", (0,)), Vary("index", (2,)), Vary("semi_diameter", (2, 8))]
    kinds = ("rms_spot", "rms_wavefront", "centroid", "relative_illumination", "throughput")
    rule = Clipped(4, "bilateral")
    fields = np.radians([0.0, 20.0])
    problem = Problem.from_variables(
        Variables.from_lens(lens, vary), kinds, Scene.radians(fields, wavelengths=COLOURS[1]), rule
    )

    def values(x):
        lens = problem.variables.lens_of(x)
        rays = trace_fields(problem, lens)
        return {kind: Operand(kind).values(lens, rays) for kind in kinds}

    x = problem.variables.start
    value = jit(values, OFTEN)
    jacobian = jit(jax.jacfwd(values), LARGE)(x)
    # The derivatives are those of the exact integral; the error of the rule changes less.
    assert_derivatives(value, jacobian, x, 1e-4, floor=1.0)


@pytest.fixture(scope="module")
def strong(tmp_path_factory):
    """A problem, and a vector for which the last surface is too strong for the outer rays."""
    lens = model(tmp_path_factory.mktemp("lens"))
    variables = Variables.from_lens(lens, [Vary("curvature", (0, 3, 5, 6)), "sensor"])
    problem = Problem.from_variables(
        variables, ["spot"], Scene.radians([0.0, 0.15], wavelengths=COLOURS[:2]), 4
    )
    return problem, variables.start.at[3].multiply(2.9)


@pytest.mark.slow
def test_rays_that_fail_have_a_smooth_merit(strong):
    """The merit is finite; its gradient in forward and reverse mode agrees with differences."""
    problem, x = strong
    whole = jax.jit(lambda x: trace_fields(problem, problem.variables.lens_of(x)).arrives)(x)
    assert 0.02 < 1 - np.mean(whole) < 0.5
    both = jit(jax.value_and_grad(problem.merit), LARGE)
    merit, gradient = both(x)
    assert 0 < merit < np.inf and np.all(np.isfinite(gradient))
    found = jit(jax.jacfwd(problem.merit), LARGE)(x)
    np.testing.assert_allclose(found, gradient, rtol=1e-8, atol=1e-9 * np.max(np.abs(gradient)))
    best = np.inf
    for h in (1e-2, 1e-3, 1e-4, 1e-5):
        slopes = [(both(x + h * e)[0] - both(x - h * e)[0]) / (2 * h) for e in np.eye(len(x))]
        best = np.minimum(best, np.abs(np.stack(slopes) - gradient))
    assert np.max(best) < 1e-7 * np.max(np.abs(gradient))
    # The gradient makes the surface weaker, so that it passes more light.
    assert gradient[3] * x[3] > 0


@pytest.mark.slow
def test_a_few_steps_bring_all_rays_through(strong):
    problem, x = strong
    found = design.optimise(problem, x, max_steps=15)
    assert bool(jnp.all(trace_fields(problem, found.lens).arrives))
    assert found.merit < 1e-2 * found.history[0, 0]


@pytest.mark.slow
def test_random_lenses_are_never_nan(strong):
    """Merit and gradients are finite however many rays fail, with aiming alone as in optimisers,
    and for a few lenses with the full search."""
    problem, x = strong
    both, full = (
        jit(jax.vmap(jax.value_and_grad(p.merit)), LARGE)
        for p in (problem.with_solver(solve_aimed), problem)
    )
    rng = np.random.default_rng(0)
    sizes = 10 ** rng.uniform(-1, 1.5, (64, 1))
    some = x[None] + sizes * rng.normal(size=(64, len(x)))
    for merits, gradients in (both(some), full(some[:3])):
        assert not np.any(np.isnan(merits)) and np.all(np.isfinite(gradients))
