"""The sensor layer against scipy.ndimage."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from drt_jax.image import sensor
from drt_jax.image.kernel import SeparableKernel, gaussian_psf, separable_psf

from ..conftest import assert_close

convolve, convolve_taps = jax.jit(sensor.convolve), jax.jit(sensor.convolve_taps)
sensor_layer = jax.jit(sensor.sensor_layer)


@functools.cache
def kernels(dense):
    mean = jnp.array([[0.4, -1.2], [0.0, 0.3], [-2.0, 0.0]])
    covariance = jnp.array(
        [[[4.0, 1.5], [1.5, 2.0]], [[0.3, 0.1], [0.1, 0.2]], [[9.0, 0], [0, 3.0]]]
    )
    covariance = covariance if dense else covariance * jnp.eye(2)[None]
    psf = gaussian_psf if dense else separable_psf
    return jax.jit(psf, static_argnums=(2, 3))(mean, covariance, 1.0, 9)


@pytest.mark.parametrize("dense", [False, True])
@pytest.mark.parametrize("convolve", [convolve, convolve_taps])
def test_valid_convolution_is_scipys(dense, convolve):
    scenes = np.random.default_rng(0).random((2, 30, 41, 3))
    kernel = kernels(dense)
    ours = convolve(jnp.asarray(scenes), kernel)
    full = np.asarray(kernel if dense else kernel.dense())
    assert ours.shape == (2, 22, 33, 3)
    for b in range(2):
        for c in range(3):
            wanted = ndimage.convolve(scenes[b, :, :, c], full[c])[4:-4, 4:-4]
            np.testing.assert_allclose(ours[b, :, :, c], wanted, atol=1e-14)


def test_separable_path_and_its_gradient_agree_with_the_dense_one():
    scenes = jnp.asarray(np.random.default_rng(1).random((1, 20, 20, 3)))
    weights = jnp.asarray(np.random.default_rng(2).random((1, 12, 12, 3)))

    def fast(kernel):
        return jnp.sum(weights * convolve(scenes, kernel))

    def slow(kernel):
        return jnp.sum(weights * convolve(scenes, kernel.dense()))

    kernel = kernels(False)
    np.testing.assert_allclose(fast(kernel), slow(kernel), rtol=1e-13)
    for a, b in zip(jax.grad(fast)(kernel), jax.grad(slow)(kernel)):
        np.testing.assert_allclose(a, b, rtol=1e-11)


def test_tap_by_tap_has_the_derivatives_of_the_banded_products():
    rng = np.random.default_rng(3)
    scenes, change = (jnp.asarray(rng.random((2, 20, 24, 3))) for _ in range(2))
    kernel = kernels(False)
    moved = SeparableKernel(kernel.column**2, kernel.row**3)

    def both(convolve):
        tangent = jax.jvp(convolve, (scenes, kernel), (change, moved))[1]
        return tangent, *jax.tree.leaves(jax.vjp(convolve, scenes, kernel)[1](tangent))

    assert_close(jax.jit(both, static_argnums=0)(convolve_taps), both(convolve), 1e-13)


def test_a_constant_scene_stays_constant_and_precision_is_the_scenes():
    scenes = jnp.full((1, 20, 20, 3), 0.25, jnp.float32)
    image = sensor_layer(scenes, kernels(False), 0.0, jax.random.key(0))
    assert image.dtype == jnp.float32
    np.testing.assert_allclose(image, 0.25, rtol=1e-6)


def test_noise_is_white_of_the_given_strength_and_follows_the_key():
    scenes = jnp.zeros((4, 108, 108, 3), jnp.float32)
    one = sensor_layer(scenes, kernels(False), 0.03, jax.random.key(1))
    np.testing.assert_allclose(np.std(one), 0.03, rtol=0.02)
    neighbours = np.corrcoef(np.ravel(one[:, :, 1:]), np.ravel(one[:, :, :-1]))[0, 1]
    assert abs(neighbours) < 0.02
    np.testing.assert_array_equal(
        one, sensor_layer(scenes, kernels(False), 0.03, jax.random.key(1))
    )
    assert np.any(one != sensor_layer(scenes, kernels(False), 0.03, jax.random.key(2)))


def test_kernel_of_one_pixel_changes_nothing():
    scenes = jnp.asarray(np.random.default_rng(0).random((1, 5, 6, 3)))
    kernel = SeparableKernel(jnp.ones((3, 1)), jnp.ones((3, 1)))
    np.testing.assert_array_equal(convolve(scenes, kernel), scenes)


SCENES = jnp.zeros((1, 12, 12, 3))
REFUSED = {
    "uint8": (SCENES.astype(jnp.uint8), r"not uint8: give scenes\.astype\(jnp\.float32\) / 255"),
    "whole numbers": (SCENES.astype(jnp.int32), "not int32: give floating numbers"),
    "too low": (SCENES[:, :8], "8 x 12 pixels are smaller than the kernel of 9"),
    "too narrow": (SCENES[:, :, :8], "12 x 8 pixels are smaller than the kernel of 9"),
    "one image": (SCENES[0], "scenes: expected"),
    "grey": (SCENES[..., :1], "scenes: expected"),
}


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.parametrize("dense", [False, True])
def test_scenes_that_do_not_fit_are_refused(name, dense):
    scenes, message = REFUSED[name]
    for call in (convolve, convolve_taps, sensor.convolve):
        with pytest.raises(ValueError, match=message):
            call(scenes, kernels(dense))
    for call in (sensor_layer, sensor.sensor_layer):
        with pytest.raises(ValueError, match=message):
            call(scenes, kernels(dense), 0.0, jax.random.key(0))
