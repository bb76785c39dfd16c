"""A call gives the same numbers outside of `jax.jit` and inside; failures give bad results."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Gauss, Scene, Status, load_lens, psf_moments, trace_rays
from drt_jax.image.converged import converged_rule

from ..conftest import assert_close

RULE = Gauss(4, "bilateral")
SCENE = (0.05, np.inf, (0.6, 0.48))


@jax.jit
def blur(lens, field, distance, wavelengths):
    """Moments by `RULE`, and the gradient by the lens of the sum of all variances."""

    def total(lens):
        spot = psf_moments(lens, Scene.point(field, distance, wavelengths), sampling=RULE)
        return jnp.sum(spot.covariance), spot

    return jax.grad(total, has_aux=True)(lens)


def typed(field, distance, wavelengths):
    """A scene as arrays, so that all share one program."""
    return jnp.asarray(float(field)), jnp.asarray(float(distance)), jnp.asarray(wavelengths)


@pytest.fixture(scope="module")
def singlet():
    return load_lens("singlet")


@pytest.mark.parametrize("how", [jax.jit, jax.vmap])
@pytest.mark.parametrize("call", [psf_moments, drt_jax.focus_moments, converged_rule])
def test_inside_a_trace_a_rule_is_asked_for(singlet, how, call):
    function = how(lambda field: call(singlet, Scene.point(field, *SCENE[1:])))
    with pytest.raises(ValueError, match=r"sampling=drt_jax\.converge"):
        function(jnp.zeros(2) if how is jax.vmap else 0.0)


CLIPPED = pytest.param("double_gauss", np.radians(14), np.inf, marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize("name, field, distance", [("singlet", 0.0, 1e4), CLIPPED])
def test_eager_and_compiled_agree(name, field, distance):
    """Moments to 1e-12 and the gradient of the variances to 1e-10, at the default tolerance. An
    eager gradient knows its numbers and needs no rule."""
    lens, colours = load_lens(name), (0.6, 0.48)
    if name == "double_gauss":
        edges = (0.8 * lens.semi_diameter).at[lens.stop].set(9.0)
        lens = dataclasses.replace(lens, semi_diameter=edges)
    rule = drt_jax.converge(drt_jax.psf_moments, lens, Scene.point(field, distance, colours))

    def total(lens, rule=1e-6):
        spot = psf_moments(lens, Scene.point(field, distance, colours), sampling=rule)
        return jnp.sum(spot.covariance), spot

    compiled, inside = jax.jit(jax.grad(total, has_aux=True))(lens, rule)
    eager, outside = jax.grad(total, has_aux=True)(lens)
    assert np.all(np.isfinite(inside.covariance)) and np.all(inside.throughput > 0)
    assert_close(outside, inside, 1e-12)
    assert_close(eager, compiled, 1e-10)
    plain = psf_moments(lens, Scene.point(field, distance, colours))
    assert_close(plain, inside, 1e-12)
    if name == "double_gauss":
        assert isinstance(rule, drt_jax.Clipped) and np.all(inside.throughput < 0.9)


@pytest.mark.slow
def test_a_lens_that_passes_no_ray(singlet):
    """An error outside; inside, a variance of inf, a throughput of 0 and derivatives of 0."""
    scene = (1.5, np.inf, (0.6, 0.48))  # all rays miss the lens
    with pytest.raises(ValueError, match="no ray at .*: 100% misses surface 1"):
        psf_moments(singlet, Scene.point(*scene))
    with pytest.raises(ValueError, match="no ray at .*: 100% misses surface 1"):
        psf_moments(singlet, Scene.point(*scene), sampling=RULE)
    gradient, spot = blur(singlet, *typed(*scene))
    assert np.all(np.isposinf(spot.covariance[:, [0, 1], [0, 1]]))
    assert np.all(spot.throughput == 0)
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_a_wavelength_without_an_index(singlet):
    """An error outside; inside, this wavelength has the worst result, and does not change
    others."""
    for call in (psf_moments, converged_rule):
        with pytest.raises(ValueError, match=r"0\.1 um is outside the range"):
            call(singlet, Scene.point(*SCENE[:2], (0.6, 0.1)))
    with pytest.raises(ValueError, match=r"0\.1 um is outside the range"):
        trace_rays(singlet, Scene.point(*SCENE[:2], (0.1,)), np.zeros((1, 2)))
    gradient, spot = blur(singlet, *typed(*SCENE[:2], (0.6, 0.1)))
    assert np.all(np.isposinf(spot.covariance[1, [0, 1], [0, 1]])) and spot.throughput[1] == 0
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
    _, good = blur(singlet, *typed(*SCENE))
    np.testing.assert_allclose(spot.covariance[0], good.covariance[0], rtol=1e-12, atol=1e-20)
    assert np.any(gradient.curvature != 0)


@pytest.mark.slow
def test_rays_mean_the_same_inside(singlet):
    """Points, path and status of rays that arrive, are clipped, miss, or have no index."""
    lens = dataclasses.replace(singlet, semi_diameter=singlet.semi_diameter.at[1].set(4.0))
    pupil = np.stack(np.meshgrid([0.0], np.linspace(-3, 3, 13)), -1).reshape(-1, 2)

    @jax.jit
    def inside(lens, field, distance, wavelengths):
        return trace_rays(lens, Scene.point(field, distance, wavelengths), pupil)

    rays = inside(lens, *typed(0.1, np.inf, (0.6,)))
    again = trace_rays(lens, Scene.point(0.1, np.inf, (0.6,)), pupil)
    kinds = {Status(int(status)) for status in np.unique(again.status)}
    assert {Status.OK, Status.CLIPPED} <= kinds
    np.testing.assert_array_equal(rays.status, again.status)
    for ours, other in zip(rays[:3], again[:3]):
        np.testing.assert_allclose(ours, other, rtol=0, atol=1e-12)
    dark = inside(lens, *typed(0.1, np.inf, (0.1,)))
    assert np.all(dark.status == Status.NO_INDEX)
    assert np.all(dark.points == 0) and np.all(dark.path == 0)
