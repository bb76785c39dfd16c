"""The imager and its training step, compared with its parts put together by hand."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, learn
from drt_jax.image.kernel import gaussian_psf
from drt_jax.image.sensor import convolve
from drt_jax.learn import train

from ..conftest import RGB

CAMERA = train.Camera(kernel=9)


@functools.cache
def blur(near=25000.0, far=25000.0):
    """The moments of a lens whose sensor is trained."""
    lens = drt_jax.load_lens("double_gauss")
    return learn.moments_model(lens, ("sensor",), Scene.point(0.0, (near, far), RGB), 1e-9)[1]


def scenes(seed=0, count=3):
    return np.random.default_rng(seed).integers(0, 255, (count, 24, 24, 3), dtype=np.uint8)


@pytest.mark.slow
def test_imager_is_the_chain_by_hand():
    imager = train.make_imager(blur(), None, CAMERA)
    sensor = jnp.array(133.2)
    truth, image, restored, sigma = imager(
        {"optics": {"sensor": sensor}},
        scenes(),
        jnp.array(25000.0),
        np.float32(0),
        jax.random.key(0),
    )
    x = scenes().astype(np.float32) / np.float32(255)
    np.testing.assert_array_equal(truth, x[:, 4:-4, 4:-4])
    spot = blur()({"sensor": sensor}, 25000.0)
    kernel = gaussian_psf(spot.mean, spot.covariance, 4.4e-3, 9)
    np.testing.assert_allclose(image, convolve(jnp.asarray(x, float), kernel), atol=1e-6)
    assert image.dtype == jnp.float32 and restored is image
    np.testing.assert_allclose(sigma, np.sqrt(spot.covariance[:, 1, 1]))


def test_gradient_of_the_loss_by_the_sensor_position():
    """Through network, sensor layer, kernel and moments, compared with finite differences."""
    init, restore = learn.red_net(2, 4)
    weights = init(jax.random.key(0))
    imager = train.make_imager(blur(), restore, CAMERA)

    def loss(sensor):
        parameters = {"optics": {"sensor": sensor}, "network": weights}
        truth, _, restored, _ = imager(
            parameters, scenes(), jnp.array(25000.0), np.float32(0.01), jax.random.key(0)
        )
        return jnp.mean(((restored - truth) ** 2).astype(jnp.float64))

    at, h = jnp.array(133.1), 2e-2
    central = [(loss(at + k * h) - loss(at - k * h)) / (2 * k * h) for k in (1, 2)]
    difference = (4 * central[0] - central[1]) / 3
    np.testing.assert_allclose(jax.grad(loss)(at), difference, rtol=2e-3)


@pytest.mark.parametrize("start", [132.9, 133.9])
def test_training_moves_the_sensor_to_focus_and_compiles_once(start):
    imager = train.make_imager(blur(), None, CAMERA)
    init, step = train.make_step(imager, {"optics": 0.1}, (25000.0, 25000.0), seed=0)
    state = init({"optics": {"sensor": jnp.array(start)}})
    reports = []

    def report(first, metrics, state):
        reports.append((first, metrics))

    state = train.fit(step, state, itertools.repeat(scenes()), 0.01, range(40), 16, report)
    assert [first for first, _ in reports] == [0, 16, 32]
    assert reports[-1][1]["loss"].shape == (8,)
    assert abs(float(state[0]["optics"]["sensor"]) - 133.39) < 0.15
    assert step._cache_size() == 1


def test_training_stops_when_asked_with_a_report():
    def step(state, scenes, noise, index):
        return state + 1, {"loss": jnp.asarray(float(index))}

    seen, stop = [], [False, True]
    state = train.fit(
        step,
        0,
        itertools.repeat(None),
        0.0,
        range(3, 99),
        10,
        lambda start, metrics, state: seen.append((start, metrics["loss"].tolist(), state)),
        lambda: len(seen) == 1 and stop.pop(0),
    )
    assert seen == [(3, list(range(3, 13)), 10), (13, [13.0, 14.0], 12)] and state == 12


def test_a_colour_without_rays_is_black_and_moves_no_other():
    def blur(values, distance):
        passed = jnp.array([1.0, 0.5, 0.0])
        mean = 17 + jnp.zeros((3, 2)) * values["sensor"]
        covariance = jnp.zeros((3, 2, 2)) * values["sensor"]
        none = passed[:, None] == 0
        covariance = jnp.where(none[..., None], jnp.diag(jnp.full(2, jnp.inf)), covariance)
        return drt_jax.results.Moments(jnp.where(none, 0, mean), covariance, passed, separable=True)

    imager = train.make_imager(blur, None, CAMERA)
    others = (jnp.array(1.0), np.float32(0), jax.random.key(0))

    @jax.jit
    def image(sensor):
        return imager({"optics": {"sensor": sensor}}, scenes(), *others)

    (truth, sensor_image, _, sigma), pull_back = jax.vjp(image, 1.0)
    wanted = truth * np.array([[[[1, 0.5, 0]]]], np.float32)
    np.testing.assert_allclose(sensor_image, wanted, rtol=1e-6)
    reverse = pull_back((truth, sensor_image, sensor_image, sigma))
    assert all(jnp.all(slope == 0) for slope in (*reverse, *jax.jvp(image, (1.0,), (1.0,))[1]))
    np.testing.assert_array_equal(sigma, [0, 0, np.inf])


def test_depth_is_uniform_and_steps_depend_on_seed_and_index_alone():
    imager = train.make_imager(blur(1e4, 5e4), None, CAMERA)
    init, step = train.make_step(imager, {"optics": 0.0}, (1e4, 5e4), seed=3)
    depths = []
    for k in range(200):
        _, metrics = step(
            init({"optics": {"sensor": jnp.array(133.0)}}), scenes(), np.float32(0), np.int32(k)
        )
        depths.append(float(metrics["depth_mm"]))
    assert 1e4 <= min(depths) < 1.1e4 and 4.9e4 < max(depths) <= 5e4
    np.testing.assert_allclose(np.mean(depths), 3e4, atol=2.5e3)
    _, again = step(
        init({"optics": {"sensor": jnp.array(133.0)}}), scenes(), np.float32(0), np.int32(7)
    )
    assert float(again["depth_mm"]) == depths[7]


def test_network_stays_in_float32():
    init_network, restore = learn.red_net(1, 2)
    imager = train.make_imager(blur(), restore, CAMERA)
    init, step = train.make_step(
        imager, {"optics": 1e-2, "network": 1e-3}, (25000.0, 25000.0), seed=0
    )
    state = init(
        {"optics": {"sensor": jnp.array(133.0)}, "network": init_network(jax.random.key(0))}
    )
    text = step.lower(state, scenes(), np.float32(0), np.int32(0)).as_text()
    products = [
        line
        for line in text.splitlines()
        if ("dot_general" in line or "convolution" in line) and "tensor<3x16x16x" in line
    ]
    assert products and all("xf32>" in line and "f64" not in line for line in products)
    (parameters, _), _ = step(state, scenes(), np.float32(0), np.int32(0))
    assert parameters["optics"]["sensor"].dtype == jnp.float64
    assert all(a.dtype == jnp.float32 for a in jax.tree.leaves(parameters["network"]))


@pytest.mark.filterwarnings("ignore:divide by zero")  # the PSNR of a perfect image is inf
def test_metrics_of_known_images():
    """A camera that adds 0.1 everywhere has MAE and RMSE 0.1 and PSNR 20 dB."""

    def imager(parameters, patches, distance, noise, key):
        truth = jnp.asarray(patches, jnp.float32) / 255
        return truth, truth + 0.1, truth, jnp.zeros(3)

    result = train.evaluate(imager, {}, scenes(count=5), 1.0, 0.0, 0, batch=2)
    np.testing.assert_allclose(
        [result["sensor_mae"], result["sensor_rmse"], result["sensor_psnr"]],
        [0.1, 0.1, 20],
        rtol=1e-5,
    )
    assert result["mae"] == result["rmse"] == 0 and result["ssim"] == 1


def test_width_of_a_blur_is_that_of_both_axes():
    whole = jnp.array([[[9.0, 2.0], [2.0, 7.0]], [[jnp.inf, 0.0], [0.0, jnp.inf]]])
    np.testing.assert_allclose(train.blur_width(whole), [8**0.5, np.inf])
    round_ = jnp.diag(jnp.array([4.0, 4.0]))[None]
    np.testing.assert_allclose(train.blur_width(round_), [2])


def test_bad_camera():
    with pytest.raises(ValueError, match="camera.kernel: expected an odd number"):
        train.Camera(kernel=20)
    with pytest.raises(ValueError, match="camera.pixel_um"):
        train.Camera(pixel_um=0.0)
