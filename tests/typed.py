"""Calls as shown on pages, for mypy: `make check` reads this file, nothing runs it. A line with
`type: ignore` has a call that mypy must reject; if it no longer does, mypy reports it."""

import jax.numpy as jnp
from jax import Array

import drt_jax
from drt_jax import design, learn, pupil

RGB = (0.6, 0.53, 0.48)
LENS = drt_jax.load_lens("double_gauss")

rule: drt_jax.pupil.PupilRule = drt_jax.converge(
    drt_jax.psf_moments, LENS, drt_jax.Scene.point(0.0, 25e3, RGB)
)
rule = drt_jax.converge(
    drt_jax.psf_moments,
    LENS,
    drt_jax.Scene.grid([(0.0, 0.1), (0.05, 0.2)], [25e3, float("inf")], RGB),
)
moments = drt_jax.psf_moments(
    LENS, drt_jax.Scene.point((0.0, 0.1), 25e3, [0.6, 0.53]), sampling=rule
)
mean, covariance = moments.mean, moments.covariance
kernel: Array = learn.gaussian_psf(mean, covariance, pixel=4.4e-3)
rows: drt_jax.results.SeparableKernel = learn.separable_psf(mean, covariance, 4.4e-3)
rays: drt_jax.results.Rays = drt_jax.trace_rays(
    LENS, drt_jax.Scene.point(0.1, 25e3, RGB), [(0.0, 0.0), (0.0, 1.0)]
)
wave: drt_jax.results.Wavefront = drt_jax.wavefront(
    LENS, drt_jax.Scene.point(0.1, 25e3, RGB), pupil.hexapolar(3)[0]
)

variables = design.Variables.from_lens(LENS, [design.Vary("curvature"), "sensor"])
problem = design.Problem.from_variables(
    variables, ["spot"], drt_jax.Scene.radians([0.0, 0.1], wavelengths=RGB, field_weights=(1, 2))
)
field: design.Problem = design.Problem.from_variables(
    variables, ["spot"], drt_jax.Scene.radians(jnp.zeros(2), wavelengths=RGB)
)
design.Tolerance("radius", 0.1)

design.Operand("sopt")  # type: ignore[arg-type]
design.Vary("curvatures")  # type: ignore[arg-type]
design.Tolerance("radii", 0.1)  # type: ignore[arg-type]
design.Problem.from_variables(variables, ["sopt"])  # type: ignore[list-item]
drt_jax.Gauss(6, "full")  # type: ignore[arg-type]
