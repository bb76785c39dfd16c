import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax.learn import adam, apply_updates, red_net
from drt_jax.learn.network import count_parameters


def test_parameter_count_of_the_paper():
    init, _ = red_net()
    parameters = init(jax.random.key(0))
    assert count_parameters(parameters) == 298_947
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(parameters))


@pytest.mark.parametrize("skip_every", [0, 1, 2])
@pytest.mark.parametrize("input_skip", [False, True])
def test_against_a_plain_numpy_network(skip_every, input_skip):
    """The same layers written as loops: 3 + 3 layers of 4 channels."""
    init, apply = red_net(3, 4, skip_every, input_skip)
    parameters = init(jax.random.key(1))
    parameters = jax.tree.map(lambda a: a + 0.1, parameters)
    image = np.random.default_rng(0).random((2, 6, 7, 3)).astype(np.float32)

    def layer(x, p):
        padded = np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        out = np.zeros((*x.shape[:3], p["bias"].size)) + np.asarray(p["bias"])
        for i in range(3):
            for j in range(3):
                out += padded[:, i : i + x.shape[1], j : j + x.shape[2]] @ np.asarray(
                    p["kernel"][i, j]
                )
        return out

    x, outputs = image, []
    for i in range(3):
        x = np.maximum(layer(x, parameters[i]), 0)
        outputs.append(x)
    for i in range(3, 6):
        x = layer(x, parameters[i])
        mirror = 4 - i  # the convolution whose output has this one's place
        if skip_every and mirror >= 0 and (2 - mirror) % skip_every == 0 and mirror < 2:
            x = x + outputs[mirror]
        if i < 5:
            x = np.maximum(x, 0)
    wanted = x + image if input_skip else x
    np.testing.assert_allclose(apply(parameters, jnp.asarray(image)), wanted, rtol=2e-4, atol=2e-4)


def test_starts_near_the_identity_and_keeps_float32():
    init, apply = red_net()
    image = jax.random.uniform(jax.random.key(0), (1, 16, 16, 3), jnp.float32)
    restored = apply(init(jax.random.key(2)), image)
    assert restored.dtype == jnp.float32
    assert float(jnp.mean(jnp.abs(restored - image))) < 0.2


def test_learns_to_denoise():
    """A small network, trained for 150 steps, has a smaller error than its noisy input."""
    init, apply = red_net(2, 8)
    clean = jnp.full((4, 16, 16, 3), 0.5, jnp.float32)
    noisy = clean + 0.1 * jax.random.normal(jax.random.key(0), clean.shape, jnp.float32)
    start, update = adam(3e-3)
    parameters = init(jax.random.key(1))
    state = start(parameters)

    @jax.jit
    def step(parameters, state):
        gradient = jax.grad(lambda p: jnp.mean(jnp.abs(apply(p, noisy) - clean)))(parameters)
        updates, state = update(gradient, state)
        return apply_updates(parameters, updates), state

    for _ in range(150):
        parameters, state = step(parameters, state)
    before, after = (float(jnp.mean(jnp.abs(a - clean))) for a in (noisy, apply(parameters, noisy)))
    assert after < 0.6 * before


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("bands", [1, 8])
def test_bands_and_dtype_are_arguments(bands, dtype):
    init, apply = red_net(1, 4, bands=bands, dtype=dtype)
    parameters = init(jax.random.key(0))
    assert {leaf.dtype for leaf in jax.tree.leaves(parameters)} == {jnp.dtype(dtype)}
    images = jnp.ones((1, 4, 4, bands), dtype)
    restored = jax.eval_shape(apply, parameters, images)
    assert restored.shape == images.shape and restored.dtype == dtype
    with pytest.raises(ValueError, match=rf"images: expected \(B, H, W, {bands}\), {images.dtype}"):
        apply(parameters, jnp.ones((1, 4, 4, 3), dtype))
    other = jnp.float64 if dtype == jnp.float32 else jnp.float32
    with pytest.raises(ValueError, match="see bands and dtype of red_net"):
        apply(parameters, images.astype(other))


def test_bad_sizes():
    with pytest.raises(ValueError, match="must be positive"):
        red_net(layers=0)
