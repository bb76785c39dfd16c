"""The error computed image by image equals that of the whole batch, with its gradient."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import devices, learn
from drt_jax.learn import mean_error, train
from drt_jax.learn.error import restored

from ..conftest import assert_close
from ..test_devices import ended, started


def red_net(layers, channels):
    init, restore = learn.red_net(layers, channels, dtype=jnp.float64)
    return init(jax.random.key(0)), restore


def pixel_by_pixel():
    """A user's network: smooth, without convolutions, with weights in a tuple."""
    rng = np.random.default_rng(1)
    weights = jnp.asarray(rng.normal(size=(3, 8))), jnp.asarray(rng.normal(size=(8, 3)))

    def restore(weights, images):
        return images + jnp.tanh(images @ weights[0]) @ weights[1]

    return weights, restore


def convolved():
    """A user's network with XLA's convolution."""
    kernel = jnp.asarray(np.random.default_rng(2).normal(size=(5, 5, 3, 3)))
    names = "NHWC", "HWIO", "NHWC"

    def restore(kernel, images):
        return jax.lax.conv_general_dilated(images, kernel, (1, 1), "SAME", dimension_numbers=names)

    return kernel, restore


# A network, the shape of its images, and the number of groups; 0 if all are processed at once.
CASES = {
    "Winograd's": (lambda: red_net(2, 32), (2, 64, 62, 3), 2),
    "several": (lambda: red_net(1, 32), (6, 32, 33, 3), 2),
    "small": (lambda: red_net(2, 6), (14, 20, 30, 3), 7),
    "a prime": (lambda: red_net(1, 4), (7, 20, 30, 3), 7),
    "larger": (pixel_by_pixel, (2, 80, 70, 3), 2),
    "a user's": (pixel_by_pixel, (5, 40, 40, 3), 5),
    "a user's convolution": (convolved, (4, 64, 64, 3), 0),
    "few channels": (lambda: red_net(1, 6), (3, 64, 64, 3), 0),
}


def pair(shape):
    rng = np.random.default_rng(0)
    return jnp.asarray(rng.random(shape)), jnp.asarray(rng.random(shape))


def whole(restore, weights, images, truth):
    return jnp.mean(jnp.abs(restore(weights, images) - truth))


def with_slopes(error, restore):
    return jax.value_and_grad(functools.partial(error, restore), (0, 1, 2))


@pytest.mark.parametrize("case", CASES)
def test_value_and_gradient_are_those_of_the_whole_batch(case):
    make, shape, groups = CASES[case]
    (weights, restore), given = make(), pair(shape)
    ours, wanted = (jax.jit(with_slopes(e, restore)) for e in (mean_error, whole))
    assert_close(ours(weights, *given), wanted(weights, *given), 1e-12)
    np.testing.assert_allclose(
        mean_error(restore, weights, *given), whole(restore, weights, *given), rtol=1e-12
    )
    program = str(jax.make_jaxpr(with_slopes(mean_error, restore))(weights, *given))
    in_groups = f"{groups},{shape[0] // max(groups, 1)},{','.join(map(str, shape[1:]))}]"
    assert in_groups in program if groups else "scan" not in program


def test_every_mode_of_derivatives():
    (weights, restore), given = pixel_by_pixel(), pair((4, 64, 64, 3))
    ours, wanted = (lambda w, e=e: e(restore, w, *given) for e in (mean_error, whole))
    forward = [jax.jit(lambda e=e: jax.jvp(e, (weights,), (weights,)))() for e in (ours, wanted)]
    assert_close(*forward, 1e-12)
    # Second derivatives, and many networks at once.
    twice = [
        jax.jit(lambda e=e: jax.jvp(jax.grad(e), (weights,), (weights,)))() for e in (ours, wanted)
    ]
    assert_close(*twice, 1e-11)
    several = jax.tree.map(lambda a: jnp.stack([a, 2 * a]), weights)
    assert_close(*(jax.jit(jax.vmap(jax.grad(e)))(several) for e in (ours, wanted)), 1e-12)


def test_without_a_network_the_images_count():
    images, truth = pair((2, 8, 8, 3))
    assert mean_error(None, None, images, truth) == jnp.mean(jnp.abs(images - truth))
    assert restored(None, None, images, truth) is images


def test_a_fixed_network_and_weights_that_stay():
    (weights, restore), given = red_net(1, 4), pair((7, 20, 30, 3))
    ours, wanted = (
        jax.jit(jax.grad(functools.partial(e, lambda _, images: restore(weights, images)), 1))
        for e in (mean_error, whole)
    )
    assert_close(ours(None, *given), wanted(None, *given), 1e-12)

    def stays(weights, images):
        return restore(jax.lax.stop_gradient(weights), images)

    slopes = jax.jit(jax.grad(functools.partial(mean_error, stays)))(weights, *given)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(slopes))


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_device_that_shares_with_none(wrapped):
    (weights, restore), given = red_net(1, 4), pair((7, 20, 30, 3))
    one = devices.shared(restore, devices.device_mesh(1), 1)
    ours = jax.jit(with_slopes(mean_error, (lambda *a: one(*a)) if wrapped else one))
    wanted = with_slopes(whole, restore)(weights, *given)
    assert_close(ours(weights, *given), wanted, 1e-12)


TWO_DEVICES = """
import json, jax, numpy as np
jax.config.update("jax_enable_x64", True)
from drt_jax import devices
from tests.learn import test_error as t
(weights, restore), given = t.red_net(1, 6), t.pair((14, 20, 30, 3))
mesh = devices.device_mesh(2)
one = devices.shared(restore, mesh, 1)
placed = devices.copied(mesh, weights), *devices.split(mesh, given)
wanted = t.with_slopes(t.whole, restore)(weights, *given)
apart = []
for shared in (one, lambda *a: one(*a)):
    found = jax.jit(t.with_slopes(t.mean_error, shared))(*placed)
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    apart.append(max(float(np.max(np.abs(a - b)) / np.max(np.abs(b))) for a, b in pairs))
print(json.dumps(apart))
"""


@pytest.mark.slow
def test_two_devices_that_share():
    assert max(json.loads(ended(started("-c", TWO_DEVICES, count=2)).splitlines()[-1])) < 1e-12


def alone(restore, images, truth):
    """An imager that consists of a network alone."""

    def imager(parameters, *_, last):
        error = last(restore, parameters["network"], images, truth)
        return truth, images, error, jnp.zeros(3)

    return imager


@pytest.mark.slow
def test_a_step_of_the_paper_takes_little_memory():
    """16 patches of 64 x 64 and 298,947 parameters: 100 MB. With all features at once it is 460."""
    init, restore = learn.red_net()
    images, truth = (a.astype(jnp.float32) for a in pair((16, 64, 64, 3)))
    rates = {"optics": 1e-3, "network": 1e-3}
    start, step = train.make_step(alone(restore, images, truth), rates, (1.0, 1.0), 0)
    state = start({"optics": {}, "network": init(jax.random.key(0))})
    program = step.lower(state, np.zeros((), np.uint8), np.float32(0), np.int32(0)).compile()
    assert program.memory_analysis().temp_size_in_bytes < 100e6


def test_a_step_is_one_of_adam_on_the_gradient_of_the_whole_batch():
    (weights, restore), given = red_net(1, 6), pair((7, 20, 30, 3))
    rates = {"optics": 0.0, "network": 1e-3}
    start, step = train.make_step(alone(restore, *given), rates, (1.0, 1.0), 0)
    state = start({"optics": {}, "network": weights})
    (after, moments), found = step(state, None, np.float32(0), np.int32(0))
    error, slopes = with_slopes(whole, restore)(weights, *given)
    np.testing.assert_allclose(found["loss"], error, rtol=1e-12)
    begin, update = learn.adam(1e-3)
    updates, wanted = update(slopes[0], begin(weights))
    assert_close(moments.first["network"], wanted.first, 1e-12)
    assert_close(after["network"], learn.apply_updates(weights, updates), 1e-9)
