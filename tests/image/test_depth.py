"""Moments over depth: interpolation compared with tracing, and the cheapest model for the trained
numbers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Gauss, Scene, focus_moments, load_lens, psf_moments
from drt_jax.learn import depth_moments, moments_model

from ..conftest import RGB, assert_close

LENS = load_lens("double_gauss_addon")
NEAR, FAR = 1e4, 5e4


@pytest.mark.slow
@pytest.mark.parametrize("field", [0.0, pytest.param(0.05, marks=pytest.mark.slow)])
def test_depth_interpolation_is_the_traced_moment(field):
    depths = depth_moments(LENS, Scene.point(field, (5e3, 5e4), RGB), 1e-11)
    for distance in (5e3, 6.1e3, 1.7e4, 3.3e4, 5e4):
        wanted = focus_moments(LENS, Scene.point(field, distance, RGB), 1e-11)
        ours = depths.at(distance)
        size = np.max(np.asarray(wanted.spread), axis=(1, 2), keepdims=True)
        np.testing.assert_allclose(ours.spread / size, wanted.spread / size, atol=1e-10)
        np.testing.assert_allclose(ours.mean, wanted.mean, atol=1e-10)


@pytest.mark.slow
def test_gradient_of_the_depth_interpolation_is_the_traced_one():
    """By the distance and the sensor position, within 1e-10 of the largest value over the range."""
    depths = depth_moments(LENS, Scene.point(0.05, (5e3, 5e4), RGB[:2]), 1e-13)
    rule = Gauss(16, "bilateral")

    def interpolated(distance, sensor):
        found = depths.at(1 / distance).at(sensor)
        return found.mean[:, 1] * 1e-2, found.covariance

    def traced(distance, sensor):
        moved = dataclasses.replace(LENS, sensor=sensor)
        moments = psf_moments(moved, Scene.point(0.05, 1 / distance, RGB[:2]), sampling=rule)
        return moments.mean[:, 1] * 1e-2, moments.covariance

    ours, wanted = (
        jax.jit(jax.vmap(jax.jacrev(f, argnums=(0, 1)), (0, None))) for f in (interpolated, traced)
    )
    scene = 1 / jnp.array([5.1e3, 7e3, 1.7e4, 4.9e4]), LENS.sensor
    assert_close(ours(*scene), wanted(*scene), 1e-10, 1e-18)


@pytest.mark.slow
def test_cheapest_model_agrees_with_retracing():
    values, cheap = moments_model(LENS, ("sensor",), Scene.point(0.0, (NEAR, FAR), RGB), 1e-10)
    everything, retrace = moments_model(
        LENS, ("sensor", "curvature"), Scene.point(0.0, (NEAR, FAR), RGB), 1e-10
    )
    assert set(values) == {"sensor"} and set(everything) == {"sensor", "curvature"}
    retrace = jax.jit(retrace)
    for distance in (1e4, 2.2e4, 5e4):
        found = cheap(values, distance), retrace(everything, jnp.asarray(distance))
        for a, b in zip(*map(jax.tree.leaves, found), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-14)
        assert found[0].separable and found[1].separable
    # The cheap model traces no ray: it has no loop, and no square root of a root finder.
    assert "while" not in str(jax.make_jaxpr(cheap)(values, 2e4))
    assert "while" in str(jax.make_jaxpr(retrace)(everything, 2e4))


def test_one_depth_is_a_polynomial_in_the_sensor():
    values, cheap = moments_model(LENS, ("sensor",), Scene.point(0.0, (FAR, FAR), RGB))
    found = cheap({"sensor": values["sensor"] + 1}, FAR)
    wanted = focus_moments(LENS, Scene.point(0.0, FAR, RGB))
    assert_close(found, wanted.at(LENS.sensor + 1), 1e-12, 1e-18)
    np.testing.assert_array_equal(found.throughput, wanted.throughput)


def test_bad_requests():
    for wrong in (-1.0, 1e4):
        with pytest.raises(ValueError, match="expected 0 < near < far"):
            depth_moments(LENS, Scene.point(0.0, (wrong, 1e4), RGB))
    for wrong in (0.0, np.nan):
        with pytest.raises(ValueError, match="distance: must be 1e-06 mm or more"):
            depth_moments(LENS, Scene.point(0.0, (wrong, 1e4), RGB))
    with pytest.raises(ValueError, match="inside jax.jit"):
        jax.jit(lambda far: depth_moments(LENS, Scene.point(0.0, (5e3, far), RGB)).near)(5e4)
    depths = depth_moments(LENS, Scene.point(0.0, (NEAR, FAR), RGB), 1e-3)
    for beyond in (0.9 * NEAR, 1.1 * FAR, np.inf):
        with pytest.raises(ValueError, match="is not within 10000 and 50000 mm"):
            depths.at(beyond)
