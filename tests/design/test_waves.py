"""Operands of waves, compared with closed forms of a perfect lens and analyses of the same lens;
and derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Clipped, Gauss, Pattern, Scene, Soft, design, learn, load_lens
from drt_jax.compilation import LARGE, jit
from drt_jax.design import Operand, Problem, Variables, Vary, trace_fields
from drt_jax.image.beam import beam_rule
from drt_jax.rays.solve import solve_aimed

from ..image.test_encircled import ZEROS
from ..image.test_transfer import CIRCLE, COOKE, LIMIT, MIRROR, PARTS, WAVE
from .test_derivatives import OFTEN, assert_derivatives

FIELDS, COLOURS, WEIGHTS = jnp.array([0.0, 0.2]), jnp.array([0.48, 0.6]), jnp.array([2.0, 1.0])
LINES, RADIUS = 25.0, 0.01
ASKED = [
    Operand("mtf", 1.0, at=LINES),
    Operand("strehl", 1.0),
    Operand("encircled_energy", 1.0, at=RADIUS),
]


def told(problem, lens):
    """Values of all operands by name; rays are aimed without a search, which is a third of the
    program."""
    rays = trace_fields(problem.with_solver(solve_aimed), lens)
    return {operand.name: operand.values(lens, rays) for operand in problem.operands}


@pytest.mark.slow
def test_a_perfect_lens_and_other_numbers_compile_nothing():
    """A paraboloid has P10's transfer function of a circle and the energy in Airy's rings."""
    lens, program = load_lens(MIRROR), jax.jit(told)
    variables = Variables.from_lens(lens, ["sensor"])
    for part, wanted, zero, energy in zip(
        PARTS[[2, 3]], [CIRCLE[2], CIRCLE[3]], ZEROS, [0.8378848691733143, 0.9099305350856731]
    ):
        asked = [
            dataclasses.replace(operand, at=at)
            for operand, at in zip(ASKED, (part * LIMIT, None, zero))
        ]
        found = program(
            Problem.from_variables(variables, asked, Scene.radians(0.0, wavelengths=WAVE), 4), lens
        )
        np.testing.assert_allclose(found["mtf"], wanted, rtol=0, atol=1e-4)
        np.testing.assert_allclose(found["strehl"], 1, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found["encircled_energy"], energy, rtol=0, atol=3e-4)
    assert program._cache_size() == 1


@pytest.fixture(scope="module")
def triplet():
    """A vector, and a program that returns values and derivatives for it."""
    vary = [Vary("curvature", (0, 3)), Vary("thickness", (1,)), "sensor"]
    variables, rule = Variables.from_lens(COOKE, vary), Gauss(6, "bilateral")
    problem = Problem.from_variables(
        variables,
        ASKED,
        Scene.radians(FIELDS, wavelengths=COLOURS, wavelength_weights=WEIGHTS),
        rule,
    )

    def twice(x):
        values = told(problem, problem.variables.lens_of(x))
        return values, values

    return variables.start, jit(jax.jacfwd(twice, has_aux=True), OFTEN)


@pytest.mark.slow
def test_derivatives_are_those_of_differences(triplet):
    """Those of the energy agree within 1e-7, the error of the polynomials of its Bessel
    function."""
    x, both = triplet
    assert_derivatives(lambda x: both(x)[1], both(x)[0], x, 1e-5, steps=(1e-3, 1e-4, 1e-5))


@pytest.mark.slow
def test_values_are_those_of_analyses(triplet):
    """Design and analyses use different rays, but the same cells."""
    x, both = triplet
    found, rule = both(x)[1], Gauss(6, "bilateral")
    scene = COOKE, Scene.radians(FIELDS, np.inf, COLOURS, wavelength_weights=WEIGHTS)
    wanted = drt_jax.transfer(*scene, jnp.array([LINES]), sampling=rule).mtf[..., 0]
    np.testing.assert_allclose(found["mtf"], np.ravel(wanted), rtol=0, atol=4e-5)
    wanted = drt_jax.strehl(*scene, sampling=drt_jax.Sampling.of("waves", rule, 64))
    np.testing.assert_allclose(found["strehl"], np.ravel(wanted), rtol=0, atol=2e-4)
    fine = drt_jax.Sampling.of("waves", rule, 128)
    wanted = drt_jax.encircled_energy(*scene, jnp.array([RADIUS]), sampling=fine)[:, 0]
    np.testing.assert_allclose(found["encircled_energy"], wanted, rtol=0, atol=1e-4)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:size.* hold 99 %")
def test_kernels_are_those_of_psf():
    """A user's operand: the light outside of the middle pixel, and its derivative."""
    variables = Variables.from_lens(COOKE, ["sensor"])
    problem = Problem.from_variables(
        variables, ["spot"], Scene.radians(FIELDS, wavelengths=COLOURS), 6
    )

    def beside(x):
        lens = variables.lens_of(x)
        rays = trace_fields(problem.with_solver(solve_aimed), lens)
        kernels = design.psf(lens, rays, 4e-3, 9).kernel
        return jnp.sum(1 - kernels[:, :, 4, 4]), (kernels, rays.rule)

    x = variables.start
    both = jit(jax.value_and_grad(beside, has_aux=True), LARGE)
    (_, (kernels, rule)), slope = both(x)
    assert rule.symmetry == "bilateral"
    # The model that psf(..., "waves", 1e-3) finds, or a finer one.
    fine = drt_jax.Sampling("waves", beam_rule(10, "bilateral"), 128)
    for field, own in zip(FIELDS, kernels):
        wanted = drt_jax.psf(
            COOKE, Scene.point(field, np.inf, COLOURS), 4e-3, 9, sampling=fine
        ).kernel
        assert np.max(np.sum(np.abs(own - wanted), axis=(1, 2))) < 5e-3
    step = 1e-5
    ends = [both(x + h)[0][0] for h in (step, -step)]
    np.testing.assert_allclose(slope[0], (ends[0] - ends[1]) / (2 * step), rtol=1e-5)
    with pytest.raises(ValueError, match="^rule: needs Gauss, Soft or Clipped of"):
        low = Problem.from_variables(variables, ["spot"], Scene.radians(FIELDS), 1)
        jax.eval_shape(lambda lens: design.psf(lens, trace_fields(low, lens), 4e-3), COOKE)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:size.* hold 99 %")
def test_the_error_behind_the_filter_is_that_of_kernels_of_psf():
    variables = Variables.from_lens(COOKE, ["sensor"])
    scene, pixel, size = Scene.radians(FIELDS, wavelengths=COLOURS), 6e-3, 15
    waves = drt_jax.Sampling("waves", beam_rule(10, "none"), 64)
    axis = drt_jax.psf(COOKE, Scene.point(wavelengths=COLOURS), pixel, size, sampling=waves)
    line = np.minimum(np.fft.fftfreq(32)[:, None] ** 2 + np.fft.rfftfreq(32)[None] ** 2, 1.0)
    power = (1e-3 / (line + 1e-3))[..., None, None] * (0.2 + 0.8 * np.eye(len(COLOURS)))
    kernels = lambda lens, rays: design.psf(lens, rays, pixel, size, cells=64)  # noqa: E731
    error = design.filter_error(kernels, axis.solid_angle, 0.02, power)
    problem = Problem.from_variables(variables, [design.Operand(error)], scene, 6)
    both = jit(jax.value_and_grad(problem.merit), LARGE)
    x = variables.start
    found, slope = both(x)
    points = Scene.radians(jnp.stack([0 * FIELDS, FIELDS], -1), wavelengths=COLOURS)
    seen = drt_jax.psf(COOKE, points, pixel, size, sampling=waves)
    grain = 0.02 * axis.solid_angle[None] / seen.solid_angle
    wanted = float(jnp.sum(learn.wiener(seen.kernel, grain, power, 1).error))
    assert float(found) == pytest.approx(wanted, rel=2e-3)
    step = 1e-4
    ends = [float(both(x + h)[0]) for h in (step, -step)]
    assert float(slope[0]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "rule, within", [(Soft(6, "bilateral", 0.01), 4e-3), (Clipped(6, "bilateral"), 2e-4)]
)
def test_a_clipped_pupil(rule, within):
    """Compared with analyses of a finer rule; the contrast for light that fills the stop is
    different."""
    lens = dataclasses.replace(COOKE, semi_diameter=COOKE.semi_diameter.at[0].set(6.5))
    variables, field = Variables.from_lens(lens, ["sensor"]), jnp.array([0.0, 0.25])
    asked = [ASKED[0], ASKED[2]]
    values = [
        jax.jit(told)(
            Problem.from_variables(variables, asked, Scene.radians(field, wavelengths=COLOURS), r),
            lens,
        )
        for r in (rule, Gauss(6, "bilateral"))
    ]
    scene = Scene.radians(field, np.inf, COLOURS)
    fine = drt_jax.Sampling.of("waves", Clipped(10, "bilateral"), 128)
    energy = drt_jax.encircled_energy(lens, scene, jnp.array([RADIUS]), sampling=fine)
    wanted = {
        "mtf": drt_jax.transfer(lens, scene, jnp.array([LINES]), sampling=fine).mtf[..., 0],
        "encircled_energy": energy[:, 0],
    }
    for name, each in wanted.items():
        np.testing.assert_allclose(values[0][name], np.ravel(each), rtol=0, atol=within)
        assert np.max(np.abs(values[1][name] - np.ravel(each))) > 5e-3


@pytest.mark.release
def test_contrast_designs_a_lens_of_more_contrast():
    """The triplet at 50 cycles/mm, from the optimum of least squares on spots."""
    lens, waves = COOKE, (0.486, 0.588, 0.656)
    fields, rule = np.radians([0.0, 14.0, 20.0]), Gauss(5, "bilateral")
    variables = Variables.from_lens(
        lens, ["curvature", "sensor"], solves=[design.Solve("focal_length", 50.0, surface=5)]
    )
    spots = design.optimise(
        Problem.from_variables(variables, ["spot"], Scene.radians(fields, wavelengths=waves), rule)
    )
    sharp = Problem.from_variables(
        variables, [Operand("mtf", 1.0, at=50.0)], Scene.radians(fields, wavelengths=waves), rule
    )
    best = design.optimise(sharp, spots.vector, max_steps=40)
    before, after = (
        np.asarray(drt_jax.transfer(found.lens, Scene.radians(fields, np.inf, waves), [50.0]).mtf)
        for found in (spots, best)
    )
    assert np.mean(after) > np.mean(before) + 0.05 and np.min(after) > np.min(before)


@pytest.mark.slow
def test_rules_that_give_no_polynomials_and_names_of_limits():
    variables = Variables.from_lens(COOKE, ["sensor"])
    limit = Operand("mtf", low=0.3, at=50.0, fields=(1,))
    points, weights = drt_jax.pupil.disc(3, 6)
    for rule in (Gauss(1, "none"), Pattern(points, weights), Clipped(2, "bilateral")):
        with pytest.raises(ValueError, match="^operands: mtf: rule: needs Gauss or Soft of"):
            Problem.from_variables(variables, [limit], Scene.radians(FIELDS), rule)
    padded = Problem.from_variables(
        variables, ["spot"], Scene.radians(FIELDS), Clipped(4, "none", 20)
    )
    assert padded.rule.size == 4
    problem = Problem.from_variables(variables, [limit], Scene.radians(FIELDS))
    names = [str(each) for each in problem.limits(np.array([0.1, -0.1]))]
    assert names[0] == "mtf of field 1, tangential, frequency 50: 0.2, low 0.3, beyond by 0.1"
    assert names[1] == "mtf of field 1, sagittal, frequency 50: 0.4, low 0.3, within by 0.1"
