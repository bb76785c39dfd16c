"""The best linear filter: its closed-form error compared with images that NumPy makes and
filters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import learn
from drt_jax.image.kernel import gaussian_psf
from drt_jax.image.sensor import noise_of
from drt_jax.image.wiener import apply_filter, power_of, wiener

SIDE, MIX = 32, np.array([[1.0, 0.8], [0.8, 1.2]])


@pytest.fixture(scope="module")
def scene():
    """Spectrum of a scene with two channels, kernels of three points, and noise."""
    frequency = np.fft.fftfreq(SIDE)
    line = 0.01 / (frequency[:, None] ** 2 + frequency[None] ** 2 + 0.01)
    mean = jnp.array([[0.5, -0.3], [0.0, 0.4]])
    spread = np.array([[1.0, 0.3], [2.0, 0.5], [0.6, 4.0]])
    kernels = jnp.stack([gaussian_psf(mean, s[:, None, None] * np.eye(2), 1.0, 15) for s in spread])
    noise = np.array([[0.05, 0.1], [0.1, 0.05], [0.05, 0.05]])
    return line[..., None, None] * MIX, kernels, noise


def images(power, kernels, noise, count=600):
    """Periodic random scenes with this spectrum, and their images in the camera."""
    rng = np.random.default_rng(0)
    white = rng.normal(size=(count, SIDE, SIDE, 2)) @ np.linalg.cholesky(MIX).T
    shape = np.sqrt(power[..., :1, 0])
    truth = np.fft.ifft2(np.fft.fft2(white, axes=(1, 2)) * shape, axes=(1, 2)).real
    padded = np.zeros((*kernels.shape[:2], SIDE, SIDE))
    padded[..., :15, :15] = kernels
    response = np.moveaxis(np.fft.fft2(np.roll(padded, (-7, -7), (2, 3))), 1, -1)
    point = rng.integers(0, len(kernels), count)
    seen = np.fft.ifft2(np.fft.fft2(truth, axes=(1, 2)) * response[point], axes=(1, 2)).real
    return truth, seen + noise[point][:, None, None] * rng.normal(size=seen.shape)


def test_the_error_is_that_of_filtered_images(scene):
    power, kernels, noise = scene
    found = wiener(kernels, noise, power[:, : SIDE // 2 + 1], 31)
    truth, seen = images(*scene)
    wide = np.pad(seen, ((0, 0), (15, 15), (15, 15), (0, 0)), "wrap")
    errors = np.mean(
        (np.asarray(apply_filter(found.taps, jnp.asarray(wide))) - truth) ** 2, (0, 1, 2)
    )
    np.testing.assert_allclose(np.sum(found.error, (0, 1)), errors, rtol=0.02)
    # No other filter is better: the error grows to both sides.
    rng = np.random.default_rng(1)
    for _ in range(3):
        other = found.taps + 0.01 * rng.normal(size=found.taps.shape)
        worse = np.asarray(apply_filter(other, jnp.asarray(wide))) - truth
        assert np.mean(worse**2) > 1.02 * np.mean(errors)


def test_the_error_has_the_derivative_of_finite_differences(scene):
    power, _, noise = scene

    def error(width):
        mean = jnp.zeros((2, 2))
        own = jnp.stack(
            [gaussian_psf(mean, w * jnp.eye(2)[None].repeat(2, 0), 1.0, 15) for w in width]
        )
        return jnp.sum(wiener(own, noise[: len(width)], power[:, : SIDE // 2 + 1], 1).error)

    widths, step = jnp.array([1.0, 3.0]), 1e-5
    slope = jax.grad(error)(widths)
    for k in range(2):
        move = step * np.eye(2)[k]
        rise = (float(error(widths + move)) - float(error(widths - move))) / (2 * step)
        assert float(slope[k]) == pytest.approx(rise, rel=1e-6)


def test_without_blur_or_noise_the_filter_changes_nothing():
    point = jnp.zeros((1, 3, 5, 5)).at[:, :, 2, 2].set(1.0)
    power = np.eye(3) * np.ones((16, 9, 1, 1))
    found = wiener(point, 1e-9, power, 7)
    np.testing.assert_allclose(found.taps[3, 3], np.eye(3), atol=1e-9)
    assert np.sum(found.error) < 1e-12
    assert np.sum(abs(np.asarray(found.taps))) == pytest.approx(3, abs=1e-6)
    with pytest.raises(ValueError, match="power: 16 frequencies a side are too few for"):
        wiener(point, 0.0, power, 17)
    with pytest.raises(ValueError, match="kernels of 5 pixels and 6 taps: give odd numbers"):
        wiener(point, 0.0, power, 6)


def test_the_mean_of_the_power_is_the_mean_square():
    rng = np.random.default_rng(0)
    patches = rng.integers(0, 256, (400, 40, 40, 3), np.uint8)
    power = power_of(patches, 32)
    twice = np.where(np.isin(np.arange(17), (0, 16)), 1.0, 2.0)
    square = np.sum(power * twice[None, :, None, None], (0, 1)) / 32**2
    np.testing.assert_allclose(square, np.var(patches / 255) * np.eye(3), atol=1e-3)
    with pytest.raises(ValueError, match="patches: 40 pixels a side, fewer than side: 64"):
        power_of(patches)


def test_noise_of_read_and_shot():
    light, value = jnp.array([1.0, 0.25, 1e-3]), jnp.array([0.5, 1.0, 1.0])
    np.testing.assert_allclose(noise_of(0.01, light, value), [0.01, 0.04, 0.5])
    both = noise_of((0.01, 0.02), light, value)
    np.testing.assert_allclose(both[0], np.sqrt(0.01**2 + 0.5 * 0.02**2))
    np.testing.assert_allclose(both[1], np.sqrt(0.04**2 + 4 * 0.02**2))


def test_a_network_begins_as_its_filter_and_trains_it():
    taps = jnp.zeros((5, 5, 3, 3), jnp.float32).at[2, 2].set(jnp.eye(3, dtype=jnp.float32))
    init, restore = learn.filtered(learn.red_net(1, 4), taps)
    parameters, seen = init(jax.random.key(0)), jnp.ones((2, 12, 12, 3), jnp.float32)
    plain = learn.red_net(1, 4)[1](parameters["network"], seen[:, 2:-2, 2:-2])
    np.testing.assert_allclose(restore(parameters, seen), plain, atol=1e-5)
    slopes = jax.grad(lambda p: jnp.sum(restore(p, seen) ** 2))(parameters)
    assert np.all(np.max(np.abs(slopes["taps"]), (2, 3)) > 0)
